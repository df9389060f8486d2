"""What the integrity monitors read of the navigator's Kalman filter, and what they may hand back to it.

Rows 0..S-1 of the log are the ranges, rows S..2S-1 the range rates of S satellite slots; a satellite keeps its slot. The
filter is only watched: recording changes nothing in it.
"""

from typing import NamedTuple

import numpy as np

from nav import eskf_kernels, kernels
from nav.eskf import EpochLog, empty_log

REMEDY = np.dtype(
    [
        ("system", "S1"),
        ("prn", "i4"),
        ("variance_m2", "f8"),  # of the range, NaN: the receiver's own
        ("bias_m", "f8"),  # to subtract from the range
        ("exclude", "?"),
        ("weaken", "f8"),  # factor on the variances; below 1: none
    ]
)
"""What holds for one satellite from the next navigation epoch on."""
EXCLUDED_M2 = 1e12
"""Variance of an excluded row: it weighs nothing and is still compared with the prediction."""


class Remedy(NamedTuple):
    """Rows of REMEDY; ``dx`` (n,), ``p`` (n, n): a state correction and covariance to begin the next epoch with, or None;
    ``extra`` (n, n): what the correction itself may be wrong by, to be reported beside the filter's covariance.
    """

    rows: np.ndarray
    dx: np.ndarray | None = None
    p: np.ndarray | None = None
    extra: np.ndarray | None = None

    def find(self, system, prn) -> np.ndarray:
        """Index of the row of each satellite, -1 where there is none."""
        keys = {(bytes(r["system"]), int(r["prn"])): i for i, r in enumerate(self.rows)}
        return np.array([keys.get((bytes(s), int(n)), -1) for s, n in zip(system, prn)], dtype=int)


class NavigatorLog:
    """Ring of the last epochs of the navigator's filter.

    After an update: ``names`` of the slots, ``z`` (2S,), ``h`` (2S, n), ``own`` (2S,) the receiver's own variances, ``seen``
    (2S,) of *all* satellites at hand, excluded ones too, and ``dx``, what the update changed.
    """

    def __init__(self, slots: int = 20, length: int = 256):
        self.slots, self.length = slots, length
        self.names: list[str | None] = [None] * slots
        self.unplaced: set[str] = set()
        self._clear()

    def _clear(self) -> None:
        n, m = kernels.N_EKF, 2 * self.slots
        self._ring, self.count = empty_log(self.length, n, m), 0
        self._views = [EpochLog(*(array[i, ...] for array in self._ring)) for i in range(self.length)]
        self.z, self.h, self.own = np.zeros(m), np.zeros((m, n)), np.ones(m)
        self.seen, self.dx = np.zeros(m, np.bool_), np.zeros(n)
        self._phi, self._qd = np.eye(n), np.zeros((n, n))
        self._prior = np.zeros((n, n))

    def restart(self) -> None:
        """The filter began anew: what was logged says nothing of it."""
        self._clear()

    def drop(self) -> None:
        """Forget the epochs, as after a retuning."""
        self.count = 0

    def predicted(self, dt_s: float, p: np.ndarray, spec) -> None:
        """The filter was propagated by ``dt_s`` to covariance ``p``; ``spec`` a FilterSpec."""
        n = kernels.N_EKF
        qd, unused = np.zeros((n, n)), np.zeros(n)
        noise = spec.accel_psd_m2_s3, spec.clock_f_m2_s, spec.clock_g_m2_s3, spec.isb_psd_m2_s
        kernels.pvt_predict(unused, qd, dt_s, *noise)
        phi = np.eye(n)
        phi[[0, 1, 2, 6], [3, 4, 5, 7]] = dt_s
        eskf_kernels.chain(self._phi, self._qd, phi, qd)
        self._prior = p.copy()

    def slot(self, name: str) -> int:
        """Slot of a satellite, a new one if need be; -1 when all are taken."""
        if name in self.names:
            return self.names.index(name)
        if None not in self.names:
            self.unplaced.add(name)
            return -1
        i = self.names.index(None)
        self.names[i] = name
        return i

    def updated(self, t_s, names, los, second, innovation, variance, own, used, dx) -> None:
        """One update: per satellite ``names``, ``los`` (n, 3), ``second``; ranges, then rates: the innovations (2n,), the
        variances that the filter took, its own without remedies, whether it took the row; ``dx`` the whole correction.
        """
        m, s, n = 2 * self.slots, self.slots, len(names)
        at = np.array([self.slot(name) for name in names], dtype=int)
        known = at >= 0
        i = self.count % self.length
        log = self._ring
        for array in (self.z, self.h, self.seen):
            array[:] = 0
        self.own[:] = 1.0
        var, took = np.ones(m), np.zeros(m, np.bool_)
        for part in range(2):
            rows, mine = at[known] + part * s, slice(part * n, (part + 1) * n)
            self.z[rows], self.own[rows] = innovation[mine][known], own[mine][known]
            var[rows], took[rows], self.seen[rows] = variance[mine][known], used[mine][known] > 0, True
            self.h[rows, 3 * part : 3 * part + 3] = -los[known]
            self.h[rows, 6 + part] = 1.0
            if part == 0:
                self.h[rows, 8] = second[known]
        log.t_s[i], log.phi[i], log.qd[i], log.p[i] = t_s, self._phi, self._qd, self._prior
        log.r[i], log.var[i], log.used[i] = np.where(took, self.z, 0.0), var, took
        log.h[i] = np.where(took[:, None], self.h, 0.0)
        eskf_kernels.innovation_covariance(self._prior, log.h[i], var, took, log.s[i])
        unused = np.zeros_like(dx)
        eskf_kernels.update(self._prior.copy(), log.h[i], var, took, log.r[i], log.k[i], unused)
        self.dx = dx
        self.count += 1
        self._phi[:], self._qd[:] = np.eye(dx.size), 0.0

    def last(self) -> EpochLog:
        """The last epoch (views)."""
        return self._views[(self.count - 1) % self.length]

    def log(self, n_epochs: int | None = None) -> EpochLog:
        """The last ``n_epochs`` epochs, oldest first (copies)."""
        have = min(self.count, self.length)
        want = have if n_epochs is None else n_epochs
        if want > have:
            raise ValueError(
                f"the log holds {have} epochs, {want} were asked for: wait or shorten the window"
            )
        index = np.arange(self.count - want, self.count) % self.length
        return EpochLog(*(array[index] for array in self._ring))
