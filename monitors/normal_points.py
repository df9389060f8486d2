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
def gather(at, phi, qd, h, z, own, dx, gain, total_phi, total_qd, moved, row, mean, info, count):
    """Epochs ``at`` (k,) of the filter's rings into the window's sums, in place.

    ``h`` (E, m, n), ``z``, ``own`` (E, m) the receiver's own variances, 0 where there was nothing; ``gain`` (m,) the column of
    each row's clock; ``total_*``, ``moved`` (n,): transition, process noise and corrections since the window began;
    ``row`` (m, n) newest row of unit gain; ``mean``, ``info``, ``count`` (m,): sums of w z'/g, of w = g^2/own, and of epochs.
    """
    for e in at:
        eskf_kernels.chain(total_phi, total_qd, phi[e], qd[e])
        moved[:] = np.dot(phi[e], moved)
        for i in range(count.size):
            g = h[e, i, gain[i]]
            if own[e, i] <= 0.0 or g <= 0.0:
                continue
            value = z[e, i]
            for j in range(moved.size):
                value += h[e, i, j] * moved[j]
                row[i, j] = h[e, i, j] / g
            mean[i] += value * g / own[e, i]
            info[i] += g * g / own[e, i]
            count[i] += 1
        for j in range(moved.size):
            moved[j] += dx[e, j]


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


@njit(cache=True, nogil=True)
def finish(
    kept, scale, prior, known, total_phi, total_qd, moved, row, mean, info, count, z, h, own, seen, single, dx, phi, qd, p,
    h_used, k, r_used, var, used,
):  # fmt: skip
    """End of a window: ``divide``; with ``known`` covariance ``prior`` at its start, the log's epoch; the sums begin anew."""
    divide(kept, count, info, mean, row, scale, z, h, own, seen, single, r_used, h_used, var, used)
    dx[:] = moved
    if known:
        phi[:], qd[:] = total_phi, total_qd
        eskf_kernels.predict(prior, phi, qd)
        p[:] = prior
        eskf_kernels.update(prior, h_used, var, used, r_used, k, np.empty(dx.size))
    total_phi[:], total_qd[:], moved[:] = np.eye(dx.size), 0.0, 0.0
    mean[:], info[:], count[:] = 0.0, 0.0, 0


class NormalPoints:
    """Log of a steering filter with the face of ``nav.navlog.NavigatorLog``: ``add`` its epochs, ``close`` a window.

    After ``close``: ``z`` (2S,), ``h`` (2S, n), ``own`` (2S,), ``seen`` (2S,), ``dx`` what the filter corrected in all,
    ``epochs`` of the window and ``single`` (2S,) the mean variance of one of them.
    """

    def __init__(self, n: int, slots: int, clock: int, drift: int, length: int = 64):
        m = 2 * slots
        self.slots, self.length, self.count = slots, length, 0
        self.names: list[str | None] = [None] * slots
        self._all = np.ones(slots, np.bool_)
        self.z, self.own, self.seen = np.zeros(m), np.ones(m), np.zeros(m, np.bool_)
        self.h, self.dx = np.zeros((m, n)), np.zeros(n)
        self._gain = np.repeat(np.array([clock, drift]), slots)
        self.epochs, self.single = 0, np.full(m, np.nan)
        self._ring = empty_log(length, n, m, covariances=False)
        self._views = epochs_of(self._ring)
        self._start: np.ndarray | None = None
        self._sums = (
            np.eye(n), np.zeros((n, n)), np.zeros(n), np.zeros((m, n)), np.zeros(m), np.zeros(m), np.zeros(m, np.int64)
        )  # fmt: skip

    def add(self, at, phi, qd, h, z, own, dx) -> None:
        """Epochs ``at`` (k,) of the filter's rings, see ``gather``."""
        gather(at, phi, qd, h, z, own, dx, self._gain, *self._sums)

    def close(self, t_s: float, names: list[str | None], scale: np.ndarray, p: np.ndarray) -> bool:
        """End the window: rows of ``names`` (S,), variances times ``scale`` (2S,); ``p`` (n, n) the filter's covariance now.

        False for the first one, before which nothing is known of the covariance at its start.
        """
        first, self._start = self._start, p.copy()
        # A slot that changed hands within the window holds two satellites' ranges.
        kept = self._all
        if names != self.names:
            kept = np.array([a == b for a, b in zip(names, self.names)])
        log = self._views[self.count % self.length]
        self.names, self.epochs = names, max(int(self._sums[-1].max()), 1)
        finish(
            kept, scale, self._start if first is None else first, first is not None, *self._sums, self.z, self.h, self.own,
            self.seen, self.single, self.dx, log.phi, log.qd, log.p, log.h, log.k, log.r, log.var, log.used,
        )  # fmt: skip
        log.t_s[...] = t_s
        self.count += first is not None
        return first is not None

    def restart(self, p: np.ndarray) -> None:
        """Forget the epochs: the filter has another covariance, ``p``, since the last window ended just now."""
        self.count, self._start = 0, p.copy()

    def last(self) -> EpochLog:
        """The last normal point (views, ``s`` empty)."""
        return self._views[(self.count - 1) % self.length]

    def log(self, n_epochs: int | None = None) -> EpochLog:
        """The last ``n_epochs`` normal points, oldest first (copies, ``s`` left empty)."""
        return newest(self._ring, self.count, n_epochs)
