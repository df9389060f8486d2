"""A fast filter's epoch log for monitors: thinned to normal points, and whole for what wants every innovation.

An ultra-tight filter is updated fifty times a second with ranges whose noise is ten times that of a fifth of a second's
mean. Monitors of ranges lose nothing by the mean. Over the window from one normal point to the next the filter's own
corrections are taken back, m <- phi m, z'_k = z_k + H_k m, m <- m + dx, so that, with weights w_k = g_k^2 / R_k,

    sum(w_k z'_k / g_k) / sum(w_k) = H eps + noise,   eps ~ N(0, phi P phi' + Qd),   R = 1 / sum(w_k)

with P the covariance at the window's start and g the discriminators' gains, which the filter's rows carry. In deep noise a
gain comes near zero now and then: that epoch tells nothing, and z / g of it is kilometres.
"""

import numpy as np
from numba import njit

from nav import eskf_kernels
from nav.eskf import EpochLog, empty_log
from nav.navlog import EXCLUDED_M2


@njit(cache=True, nogil=True)
def gather(phi, qd, h, z, own, dx, gain, total_phi, total_qd, moved, row, mean, info, count):
    """One epoch of the filter into the window's sums, in place.

    ``h`` (m, n), ``z``, ``own`` (m,) the receiver's own variances, 0 where there was nothing; ``gain`` (m,) the column of
    each row's clock; ``total_*``, ``moved`` (n,): transition, process noise and corrections since the window began;
    ``row`` (m, n) newest row of unit gain; ``mean``, ``info``, ``count`` (m,): sums of w z'/g, of w = g^2/own, and of epochs.
    """
    eskf_kernels.chain(total_phi, total_qd, phi, qd)
    moved[:] = np.dot(phi, moved)
    for i in range(z.size):
        g = h[i, gain[i]]
        if own[i] <= 0.0 or g <= 0.0:
            continue
        value = z[i]
        for j in range(moved.size):
            value += h[i, j] * moved[j]
            row[i, j] = h[i, j] / g
        mean[i] += value * g / own[i]
        info[i] += g * g / own[i]
        count[i] += 1
    for j in range(moved.size):
        moved[j] += dx[j]


class NormalPoints:
    """Log of a steering filter with the face of ``nav.navlog.NavigatorLog``: ``add`` every epoch, ``close`` a window.

    After ``close``: ``z`` (2S,), ``h`` (2S, n), ``own`` (2S,), ``seen`` (2S,), ``dx`` what the filter corrected in all,
    ``epochs`` of the window and ``single`` (2S,) the mean variance of one of them.
    """

    def __init__(self, n: int, slots: int, clock: int, drift: int, length: int = 64):
        m = 2 * slots
        self.slots, self.length, self.count = slots, length, 0
        self.names: list[str | None] = [None] * slots
        self.z, self.own, self.seen = np.zeros(m), np.ones(m), np.zeros(m, np.bool_)
        self.h, self.dx = np.zeros((m, n)), np.zeros(n)
        self._gain = np.repeat(np.array([clock, drift]), slots)
        self.epochs, self.single = 0, np.full(m, np.nan)
        self._ring = empty_log(length, n, m)
        self._views = [EpochLog(*(array[i, ...] for array in self._ring)) for i in range(length)]
        self._start: np.ndarray | None = None
        self._open()

    def _open(self) -> None:
        n, m = self.dx.size, self.z.size
        self._phi, self._qd, self._moved = np.eye(n), np.zeros((n, n)), np.zeros(n)
        self._row, self._mean, self._info = np.zeros((m, n)), np.zeros(m), np.zeros(m)
        self._n = np.zeros(m, np.int64)

    def add(self, phi, qd, h, z, own, dx) -> None:
        """One epoch of the filter."""
        gather(
            phi, qd, h, z, own, dx, self._gain, self._phi, self._qd, self._moved, self._row, self._mean, self._info,
            self._n,
        )  # fmt: skip

    def close(self, t_s: float, names: list[str | None], scale: np.ndarray, p: np.ndarray) -> bool:
        """End the window: rows of ``names`` (S,), variances times ``scale`` (2S,); ``p`` (n, n) the filter's covariance now.

        False for the first one, before which nothing is known of the covariance at its start.
        """
        first, self._start = self._start, p.copy()
        # A slot that changed hands within the window holds two satellites' ranges.
        kept = np.tile([a == b for a, b in zip(names, self.names)], 2)
        seen = (self._n > 0) & kept
        info = np.where(seen, self._info, 1.0)
        self.names, self.seen, self.epochs = list(names), seen, int(max(self._n.max(), 1))
        self.z, self.own = np.where(seen, self._mean / info, 0.0), 1.0 / info
        self.h, self.dx = np.where(seen[:, None], self._row, 0.0), self._moved
        self.single = np.where(seen, self._n / info, np.nan)
        phi, qd = self._phi, self._qd
        self._open()
        if first is None:
            return False
        self._store(t_s, phi, qd, scale, first)
        return True

    def _store(self, t_s, phi, qd, scale, p) -> None:
        log, i = self._ring, self.count % self.length
        eskf_kernels.predict(p, phi, qd)
        used = self.seen & (scale < EXCLUDED_M2)
        log.t_s[i], log.phi[i], log.qd[i], log.p[i], log.used[i] = t_s, phi, qd, p, used
        log.var[i], log.r[i] = self.own * scale, np.where(used, self.z, 0.0)
        log.h[i] = np.where(used[:, None], self.h, 0.0)
        after, unused = p.copy(), np.zeros_like(self.dx)
        eskf_kernels.update(after, log.h[i], log.var[i], used, log.r[i], log.k[i], unused)
        self.count += 1

    def restart(self, p: np.ndarray) -> None:
        """Forget the epochs: the filter has another covariance, ``p``, from now on."""
        self.count, self._start = 0, p.copy()
        self._open()

    def last(self) -> EpochLog:
        """The last normal point (views, ``s`` empty)."""
        return self._views[(self.count - 1) % self.length]

    def log(self, n_epochs: int | None = None) -> EpochLog:
        """The last ``n_epochs`` normal points, oldest first (copies, ``s`` left empty)."""
        have = min(self.count, self.length)
        want = have if n_epochs is None else n_epochs
        if want > have:
            raise ValueError(
                f"the log holds {have} epochs, {want} were asked for: wait or shorten the window"
            )
        index = np.arange(self.count - want, self.count) % self.length
        return EpochLog(*(array[index] for array in self._ring))
