"""An offset of one range, of unknown size since an unknown epoch, and what it did to a filter that did not know of it.

The filter goes on as if there were none; the offset is estimated beside it from the filter's innovations (Friedland 1969,
IEEE Trans. Automatic Control 14, 359-367; onset and size as in Willsky and Jones 1976, ibid. 21, 108-112). An offset a s_k
of row i, s_k = 1 or t_k - t_o since the onset o, moves the state by a c_k and the innovations by a g_k:

    g_k = s_k e_i - H_k phi_k c_{k-1} ,   c_k = phi_k c_{k-1} + K_k g_k ,
    J_k = J_{k-1} + g' S^-1 g ,  b_k = b_{k-1} + g' S^-1 r ,   S^-1 = R^-1 (I - H K) ,

with K the gain of the whole epoch. Given the onset, a is Gaussian with precision J + 1/tau^2 and mean b / (J + 1/tau^2), so that
x - a c with covariance P + var(a) c c' is what a filter with one more state would have. Onsets and both shapes weigh by their
evidence, (1 + J tau^2)^-1/2 exp(b^2 / (2 (J + 1/tau^2))); the moments are those of the mixture.
"""

from typing import NamedTuple

import numpy as np

from nav.eskf import EpochLog

RATE_SIGMA_MPS = 1.0
"""A priori sigma of a drifting offset: the ramps of Vanek 1999, 0.5 to 2 ft/s, and more."""
RECENT, SPARSE = 50, 4
"""An onset may be any of the last so many epochs; before them, every so manieth."""
NEGLIGIBLE = 1e-9
"""Onsets of less than this share of the largest weight are forgotten."""


class Posterior(NamedTuple):
    """``effect`` (n,) on the filter's state and its covariance ``cov`` (n, n); ``size_m`` of the offset at a time asked for."""

    effect: np.ndarray
    cov: np.ndarray
    size_m: float


class SeparateBias:
    """Offsets of ``row`` of a filter of ``n`` states that begin at any epoch fed with ``onset=True``; a priori sigma ``tau_m``."""

    def __init__(self, row: int, n: int, tau_m: float) -> None:
        self.row, self.tau_m = row, tau_m
        self._c = np.zeros((n, 0))
        self._since_s, self._drifts = np.zeros(0), np.zeros(0, bool)
        self._info, self._score = np.zeros(0), np.zeros(0)

    def _shape(self, t_s: float) -> np.ndarray:
        return np.where(self._drifts, t_s - self._since_s, 1.0)

    def _begin(self, since_s: float) -> None:
        """A step and a drift of an onset just after ``since_s``."""
        self._c = np.column_stack([self._c, np.zeros((len(self._c), 2))])
        self._since_s = np.append(self._since_s, [since_s, since_s])
        self._drifts = np.append(self._drifts, [False, True])
        self._info, self._score = np.append(self._info, [0.0, 0.0]), np.append(self._score, [0.0, 0.0])

    def __call__(self, e: EpochLog, r: np.ndarray, dt_s: float, onset: bool = False) -> None:
        """One epoch ``e`` of the log, ``r`` (m,) its innovations as they were without any correction, ``dt_s`` after the last."""
        if onset:
            self._begin(float(e.t_s) - dt_s)
        u = np.flatnonzero(e.used)
        h, k = e.h[u], e.k[:, u]
        c = e.phi @ self._c
        g = (u == self.row)[:, None] * self._shape(float(e.t_s)) - h @ c
        moved = k @ g
        weighted = (g - h @ moved) / e.var[u, None]
        self._info += np.sum(g * weighted, axis=0)
        self._score += r[u] @ weighted
        self._c = c + moved

    def posterior(self, t_s: float) -> Posterior:
        """Effect of the offset on the state now, and its size at ``t_s``; forgets onsets that do not count."""
        sigma = np.where(self._drifts, RATE_SIGMA_MPS, self.tau_m)
        precision = self._info + sigma**-2.0
        size = self._score / precision
        log_w = 0.5 * (self._score * size - np.log(precision * sigma**2))
        w = np.exp(log_w - log_w.max())
        w /= w.sum()
        each = self._c * size
        effect = each @ w
        cov = (self._c * (w / precision)) @ self._c.T + (each * w) @ each.T - np.outer(effect, effect)
        out = Posterior(effect, cov, float(w @ (size * self._shape(t_s))))
        self._keep(w > NEGLIGIBLE * w.max())
        return out

    def _keep(self, these: np.ndarray) -> None:
        self._c, self._since_s, self._drifts = self._c[:, these], self._since_s[these], self._drifts[these]
        self._info, self._score = self._info[these], self._score[these]


class Removal(NamedTuple):
    """What is asked of the filter: ``shift``, offsets (m) by name to take off the ranges of the next epoch, ``dx`` (n,) to add to
    its state, ``extra`` (n, n) to add to the covariance that it reports or, at the end of an offset (``ended``), to its own.
    """

    shift: dict[str, float]
    dx: np.ndarray | None = None
    extra: np.ndarray | None = None
    ended: bool = False


class BiasRemoval:
    """Takes the offset of one satellite out of a filter for as long as it is named; call once per epoch of the filter's log.

    Keeps the innovations as they would be had nothing been taken out, r + u - H phi t, where u are the offsets taken off the
    ranges and t what that and earlier corrections have done to the state: t <- phi t + K (u - H phi t) - dx.
    """

    def __init__(self, tau_m: float, memory: int) -> None:
        self.tau_m, self.memory = tau_m, memory
        self.name: str | None
        self.forget()

    def forget(self) -> None:
        """The filter took a state of somebody else's, in which nothing was corrected."""
        self.name, self._age = None, 0
        self._run: SeparateBias | None = None
        self._as_if: list[tuple[np.ndarray, float]] = []
        self._taken, self._extra, self._t_s = np.zeros(0), np.zeros(0), np.nan

    def __call__(self, log, name: str | None, shift: dict[str, float]) -> Removal:
        """``log`` of the filter, its newest epoch unseen so far; ``name`` the satellite at fault; ``shift`` in force then."""
        e, n = log.last(), log.dx.size
        if self._taken.size != n:
            self.forget()
            self._taken = np.zeros(n)
        if log.count <= len(self._as_if):  # another covariance: what was corrected stays corrected
            self._as_if.clear()
        dt_s = float(e.t_s) - self._t_s if np.isfinite(self._t_s) else 0.0
        self._t_s = float(e.t_s)
        self._as_if.append((self._undone(e, log.names, shift), dt_s))
        del self._as_if[: -self.memory]
        if name is None or name not in log.names:
            return self._end(log)
        if name == self.name and self._run is not None:
            self._age += 1
            self._run(e, *self._as_if[-1])
        else:
            self.name, self._age = name, 1
            self._run = self._since(log, name, self._as_if)
        now = self._run.posterior(self._t_s + dt_s)
        dx, self._taken, self._extra = self._taken - now.effect, now.effect, now.cov
        return Removal({name: now.size_m}, dx, now.cov)

    def _undone(self, e: EpochLog, names, shift: dict[str, float]) -> np.ndarray:
        """Innovations of the epoch without any correction."""
        u = np.zeros(e.r.size)
        for name, value in shift.items():
            if name in names:
                u[names.index(name)] = value
        t = e.phi @ self._taken
        moved = np.where(e.used, u - e.h @ t, 0.0)
        self._taken = t + e.k @ moved
        return np.where(e.used, e.r + moved, 0.0)

    def _since(self, log, name: str, innovations) -> SeparateBias:
        """An offset of ``name`` that began in one of the last epochs, whose ``innovations`` are given."""
        run = SeparateBias(log.names.index(name), log.dx.size, self.tau_m)
        part = log.log(min(len(innovations), log.count, log.length))
        n = part.n_epochs
        for k, (r, dt_s) in enumerate(innovations[-n:]):
            onset = n - k <= RECENT or k % SPARSE == 0
            run(EpochLog(*(array[k] for array in part)), r, dt_s, onset)
        return run

    def _end(self, log) -> Removal:
        """No satellite is named: what was taken off since the offset really ended is given back, as an offset of its own."""
        if self.name is None:
            return Removal({})
        name, extra, age = self.name, self._extra, min(self._age, log.count, log.length)
        self.name = self._run = None
        if name in log.names:
            held = [(np.where(u, r, 0.0), dt) for (_, dt), r, u in zip(self._as_if[-age:], *_tail(log, age))]
            after = self._since(log, name, held).posterior(self._t_s)
            dx, extra = -after.effect, extra + after.cov
        else:
            dx = None
        self.forget()
        return Removal({}, dx, extra, True)


def _tail(log, n: int) -> tuple[np.ndarray, np.ndarray]:
    part = log.log(n)
    return part.r, part.used
