"""An offset of one range, nobody knows which, of unknown size since an unknown epoch, and what it did to the filter.

The filter goes on as if there were none; the offset is estimated beside it from the filter's innovations (Friedland 1969,
IEEE Trans. Automatic Control 14, 359-367; onset and size as in Willsky and Jones 1976, ibid. 21, 108-112). An offset a s_k
of row i, s_k = 1 or t_k - t_o since the onset o (until it may end, when it stays), moves the state by a c_k and the innovations by a g_k:

    g_k = s_k e_i - H_k phi_k c_{k-1} ,   c_k = phi_k c_{k-1} + K_k g_k ,
    J_k = J_{k-1} + g' S^-1 g ,  b_k = b_{k-1} + g' S^-1 r ,   S^-1 = R^-1 (I - H K) ,

with K the gain of the whole epoch. Given the onset, a is Gaussian with precision J + 1/tau^2 and mean b / (J + 1/tau^2), so that
x - a c with covariance P + var(a) c c' is what a filter with one more state would have. Satellites, onsets and both shapes weigh
by their evidence, (1 + J tau^2)^-1/2 exp(b^2 / (2 (J + 1/tau^2))); the moments are those of the mixture. Where the geometry
hardly tells two satellites apart, both are corrected, each by what it may be, and the claim holds the doubt.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from nav.eskf import EpochLog

RATE_SIGMA_MPS = 1.0
"""A priori sigma of a drifting offset: the ramps of Vanek 1999, 0.5 to 2 ft/s, and more."""
RECENT, SPARSE = 50, 4
"""An onset may be any of the last so many epochs; before them, every so manieth."""
NEGLIGIBLE = 1e-9
"""Hypotheses of less than this share of the largest weight are forgotten."""
WORTH = 0.01
"""Ranges of satellites of less than this weight are left as they are, and drifts of less are not thought to end."""
ENDS = 0.01
"""Share of the weight of a drift that goes over, each epoch, to the one that has just ended: 20 s at 5 Hz."""


class Posterior(NamedTuple):
    """``effect`` (n,) on the filter's state and its covariance ``cov`` (n, n); by row (m,) at a time asked for the offset
    ``size_m``, times the probability that it is this row's, and that probability, ``weight``.
    """

    effect: np.ndarray
    cov: np.ndarray
    size_m: np.ndarray
    weight: np.ndarray


class SeparateBias:
    """Offsets of one of ``rows`` of a filter of ``n`` states that begin at any epoch fed with ``onset=True``; a priori sigma ``tau_m``."""

    def __init__(self, rows: ArrayLike, n: int, tau_m: float) -> None:
        self.rows, self.tau_m = np.asarray(rows), tau_m
        self._c, self._row = np.zeros((n, 0)), np.zeros(0, np.int64)
        self._since_s, self._until_s, self._drifts = np.zeros(0), np.zeros(0), np.zeros(0, bool)
        self._info, self._score, self._prior = np.zeros(0), np.zeros(0), np.zeros(0)

    def _shape(self, t_s: float) -> np.ndarray:
        return np.where(self._drifts, np.minimum(t_s, self._until_s) - self._since_s, 1.0)

    def _append(self, c, row, since_s, until_s, drifts, info, score, prior) -> None:
        self._c, self._row = np.column_stack([self._c, c]), np.append(self._row, row)
        self._since_s, self._until_s = np.append(self._since_s, since_s), np.append(self._until_s, until_s)
        self._drifts, self._prior = np.append(self._drifts, drifts), np.append(self._prior, prior)
        self._info, self._score = np.append(self._info, info), np.append(self._score, score)

    def _begin(self, since_s: float) -> None:
        """A step and a drift of every row, of an onset just after ``since_s``."""
        new = 2 * len(self.rows)
        zero, since = np.zeros(new), np.full(new, since_s)
        drifts = np.arange(new) % 2 == 1
        c = np.zeros((len(self._c), new))
        self._append(c, np.repeat(self.rows, 2), since, zero + np.inf, drifts, zero, zero, zero)

    def _end(self, t_s: float) -> None:
        """The likeliest drift of every row may have ended at ``t_s``."""
        _, w = self._weights()
        going = np.where(self._drifts & np.isinf(self._until_s), w, 0.0)
        best = [
            k
            for row in self.rows
            if going[k := int(np.argmax(np.where(self._row == row, going, 0.0)))] > WORTH
        ]
        if best:
            self._append(
                self._c[:, best], self._row[best], self._since_s[best], np.full(len(best), t_s), self._drifts[best],
                self._info[best], self._score[best], self._prior[best] + math.log(ENDS),
            )  # fmt: skip

    def _weights(self) -> tuple[np.ndarray, np.ndarray]:
        """Precision of every hypothesis' size and its probability."""
        sigma = np.where(self._drifts, RATE_SIGMA_MPS, self.tau_m)
        precision = self._info + sigma**-2.0
        log_w = self._prior + 0.5 * (self._score**2 / precision - np.log(precision * sigma**2))
        w = np.exp(log_w - log_w.max())
        return precision, w / w.sum()

    def __call__(self, e: EpochLog, r: np.ndarray, dt_s: float, onset: bool = False) -> None:
        """One epoch ``e`` of the log, ``r`` (m,) its innovations as they were without any correction, ``dt_s`` after the last."""
        if self._row.size:
            self._end(float(e.t_s) - dt_s)
        if onset:
            self._begin(float(e.t_s) - dt_s)
        u = np.flatnonzero(e.used)
        h, k = e.h[u], e.k[:, u]
        c = e.phi @ self._c
        g = (u[:, None] == self._row) * self._shape(float(e.t_s)) - h @ c
        moved = k @ g
        weighted = (g - h @ moved) / e.var[u, None]
        self._info += np.sum(g * weighted, axis=0)
        self._score += r[u] @ weighted
        self._c = c + moved

    def posterior(self, t_s: float, m: int) -> Posterior:
        """Effect of the offset on the state now, its size at ``t_s`` by each of the filter's ``m`` rows; forgets what does not count."""
        precision, w = self._weights()
        size = self._score / precision
        each = self._c * size
        effect = each @ w
        cov = (self._c * (w / precision)) @ self._c.T + (each * w) @ each.T - np.outer(effect, effect)
        of_row = np.bincount(self._row, w * size * self._shape(t_s), m)
        out = Posterior(effect, cov, of_row, np.bincount(self._row, w, m))
        self._keep(w > NEGLIGIBLE * w.max())
        return out

    def without(self, rows: ArrayLike) -> None:
        """Another satellite has these rows now."""
        self._keep(~np.isin(self._row, rows))

    def _keep(self, these: np.ndarray) -> None:
        self._c, self._row = self._c[:, these], self._row[these]
        self._since_s, self._until_s = self._since_s[these], self._until_s[these]
        self._drifts, self._prior = self._drifts[these], self._prior[these]
        self._info, self._score = self._info[these], self._score[these]
        self.rows = np.unique(self._row)


class Removal(NamedTuple):
    """What is asked of the filter: ``shift``, offsets (m) by name to take off the ranges of the next epoch, ``dx`` (n,) to add to
    its state, ``extra`` (n, n) to add to the covariance that it reports or, at the end of an offset (``ended``), to its own.
    """

    shift: dict[str, float]
    dx: np.ndarray | None = None
    extra: np.ndarray | None = None
    ended: bool = False


class BiasRemoval:
    """Takes an offset out of a filter for as long as some satellite is named; call once per epoch of the filter's log.

    Whose it is, is judged anew by the filter's own innovations: the name may be that of a satellite much alike. Keeps the
    innovations as they would be had nothing been taken out, r + u - H phi t, where u are the offsets taken off the ranges and
    t what that and earlier corrections have done to the state: t <- phi t + K (u - H phi t) - dx.
    """

    def __init__(self, tau_m: float, memory: int) -> None:
        self.tau_m, self.memory = tau_m, memory
        self.name: str | None
        self._names: list[str | None] = []
        self.forget()

    def forget(self) -> None:
        """The filter took a state of somebody else's, in which nothing was corrected."""
        self.name, self._age = None, 0
        self._run: SeparateBias | None = None
        self._as_if: list[tuple[np.ndarray, float]] = []
        self._taken, self._extra, self._t_s = np.zeros(0), np.zeros(0), np.nan

    def __call__(self, log, name: str | None, shift: dict[str, float]) -> Removal:
        """``log`` of the filter, its newest epoch unseen so far; ``name`` the satellite at fault; ``shift`` in force then."""
        self._hear(log, shift)
        if name is None or name not in log.names:
            return self._end(log)
        if self._run is None or self._excludes(log.names.index(name), name):
            self._age, seen = 1, [k for k, n in enumerate(log.names) if n is not None]
            self._run = self._since(log, seen, self._as_if)
        else:
            self._age += 1
            self._run(log.last(), *self._as_if[-1])
        self.name = name
        now = self._run.posterior(self._t_s + self._as_if[-1][1], log.z.size)
        dx, self._taken, self._extra = self._taken - now.effect, now.effect, now.cov
        return Removal(self._worth(log, now), dx, now.cov)

    def _excludes(self, row: int, name: str) -> bool:
        """Whether a satellite that is named only now has been ruled out, or all have: another offset then."""
        assert self._run is not None
        return not len(self._run.rows) or (name != self.name and row not in self._run.rows)

    def _hear(self, log, shift: dict[str, float]) -> None:
        """The newest epoch into the memory, which another covariance or another satellite in a slot ends."""
        e, n = log.last(), log.dx.size
        if self._taken.size != n:
            self.forget()
            self._taken = np.zeros(n)
        moved = [k for k, (a, b) in enumerate(zip(self._names, log.names)) if a not in (None, b)]
        if log.count <= len(self._as_if) or moved:
            self._as_if.clear()
        if moved and self._run is not None:
            self._run.without(moved)
        self._names = list(log.names)
        dt_s = float(e.t_s) - self._t_s if np.isfinite(self._t_s) else 0.0
        self._t_s = float(e.t_s)
        self._as_if.append((self._undone(e, log.names, shift), dt_s))
        del self._as_if[: -self.memory]

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

    @staticmethod
    def _worth(log, now: Posterior) -> dict[str, float]:
        """Offsets by name of the satellites that may well be meant."""
        return {str(log.names[k]): float(now.size_m[k]) for k in np.flatnonzero(now.weight > WORTH)}

    def _since(self, log, rows, innovations) -> SeparateBias:
        """An offset of one of ``rows`` that began in one of the last epochs, whose ``innovations`` are given."""
        run = SeparateBias(rows, log.dx.size, self.tau_m)
        part = log.log(min(len(innovations), log.count, log.length))
        n = part.n_epochs
        for k, (r, dt_s) in enumerate(innovations[-n:]):
            onset = n - k <= RECENT or k % SPARSE == 0
            run(EpochLog(*(array[k] for array in part)), r, dt_s, onset)
        return run

    def _end(self, log) -> Removal:
        """No satellite is named: what was taken off since the offset really ended is given back, as an offset of its own."""
        if self._run is None:
            return Removal({})
        rows, extra, age = self._run.rows, self._extra, min(self._age, log.count, log.length)
        dx = None
        if len(rows):
            held = [(np.where(u, r, 0.0), dt) for (_, dt), r, u in zip(self._as_if[-age:], *_tail(log, age))]
            after = self._since(log, rows, held).posterior(self._t_s, log.z.size)
            dx, extra = -after.effect, extra + after.cov
        self.forget()
        return Removal({}, dx, extra, True)


def _tail(log, n: int) -> tuple[np.ndarray, np.ndarray]:
    part = log.log(n)
    return part.r, part.used
