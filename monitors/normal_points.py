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
from nav.eskf import EpochLog, empty_log, epochs_of, newest
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


@njit(cache=True, nogil=True)
def divide(kept, count, info, mean, row, scale, z, h, own, seen, single, r_used, h_used, var, used):
    """A window's sums into normal points, by row, and into the log's; ``kept`` (S,): the slot has had one satellite only."""
    slots = kept.size
    for i in range(2 * slots):
        seen[i] = count[i] > 0 and kept[i % slots]
        used[i] = seen[i] and scale[i] < EXCLUDED_M2
        own[i] = 1.0 / info[i] if seen[i] else 1.0
        z[i] = mean[i] / info[i] if seen[i] else 0.0
        single[i] = count[i] / info[i] if seen[i] else np.nan
        var[i], r_used[i] = own[i] * scale[i], z[i] if used[i] else 0.0
        for j in range(row.shape[1]):
            h[i, j] = row[i, j] if seen[i] else 0.0
            h_used[i, j] = row[i, j] if used[i] else 0.0


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
        self._views = epochs_of(self._ring)
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
        kept = np.array([a == b for a, b in zip(names, self.names)])
        log = self._views[self.count % self.length]
        divide(
            kept, self._n, self._info, self._mean, self._row, scale, self.z, self.h, self.own, self.seen, self.single, log.r,
            log.h, log.var, log.used,
        )  # fmt: skip
        self.names, self.epochs, self.dx = list(names), int(max(self._n.max(), 1)), self._moved
        if first is not None:
            eskf_kernels.predict(first, self._phi, self._qd)
            log.t_s[...], log.phi[:], log.qd[:], log.p[:] = t_s, self._phi, self._qd, first
            eskf_kernels.update(first, log.h, log.var, log.used, log.r, log.k, np.empty_like(self.dx))
            self.count += 1
        self._open()
        return first is not None

    def restart(self, p: np.ndarray) -> None:
        """Forget the epochs: the filter has another covariance, ``p``, from now on."""
        self.count, self._start = 0, p.copy()
        self._open()

    def last(self) -> EpochLog:
        """The last normal point (views, ``s`` empty)."""
        return self._views[(self.count - 1) % self.length]

    def log(self, n_epochs: int | None = None) -> EpochLog:
        """The last ``n_epochs`` normal points, oldest first (copies, ``s`` left empty)."""
        return newest(self._ring, self.count, n_epochs)
