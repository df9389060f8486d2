"""What the integrity monitors read of the navigator's Kalman filter, and what they may hand back to it.

Rows 0..S-1 of the log are the ranges, rows S..2S-1 the range rates of S satellite slots; a satellite keeps its slot. The
filter is only watched: recording changes nothing in it.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from nav import eskf_kernels, kernels
from nav.eskf import EpochLog, empty_log, epochs_of, newest

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


@njit(cache=True, nogil=True)
def propagate(total_phi, total_qd, prior, p, dt_s, accel_psd, clock_f, clock_g, isb_psd):
    """One propagation of the navigator's filter by ``dt_s`` to ``p`` (``kernels.pvt_predict``) into the log's sums."""
    n = p.shape[0]
    phi, qd = np.eye(n), np.zeros((n, n))
    kernels.pvt_predict(np.zeros(n), qd, dt_s, accel_psd, clock_f, clock_g, isb_psd)
    phi[0, 3] = phi[1, 4] = phi[2, 5] = phi[6, 7] = dt_s
    eskf_kernels.chain(total_phi, total_qd, phi, qd)
    prior[:] = p


@njit(cache=True, nogil=True)
def record(
    at, los, second, innovation, variance, own, used, z, h, own_all, seen, total_phi, total_qd, prior, phi, qd, p, r_used,
    h_used, k, var, took,
):  # fmt: skip
    """One update into the rows of its slots ``at`` (n,), -1: none; see ``NavigatorLog.updated``. Outputs have 2S rows.

    ``total_*``, ``prior`` (n, n) from ``propagate`` go into the log's ``phi``, ``qd``, ``p`` and begin anew.
    """
    n, slots = at.size, z.size // 2
    for array in (z, r_used):
        array[:] = 0.0
    h[:], h_used[:], own_all[:], var[:], seen[:], took[:] = 0.0, 0.0, 1.0, 1.0, False, False
    for part in range(2):
        for i in range(n):
            if at[i] < 0:
                continue
            row, mine = at[i] + part * slots, i + part * n
            z[row], own_all[row], var[row], seen[row] = innovation[mine], own[mine], variance[mine], True
            for j in range(3):
                h[row, 3 * part + j] = -los[i, j]
            h[row, 6 + part] = 1.0
            if part == 0:
                h[row, 8] = second[i]
            if used[mine] > 0:
                took[row], r_used[row], h_used[row] = True, z[row], h[row]
    phi[:], qd[:], p[:] = total_phi, total_qd, prior
    eskf_kernels.update(prior, h_used, var, took, r_used, k, np.empty(prior.shape[0]))
    total_phi[:], total_qd[:] = np.eye(prior.shape[0]), 0.0


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
        self._ring, self.count = empty_log(self.length, n, m, covariances=False), 0
        self._views = epochs_of(self._ring)
        self.z, self.h, self.own = np.zeros(m), np.zeros((m, n)), np.ones(m)
        self.seen, self.dx = np.zeros(m, np.bool_), np.zeros(n)
        self._phi, self._qd = np.eye(n), np.zeros((n, n))
        self._prior = np.zeros((n, n))
        self._named, self._at = list[str](), np.zeros(0, np.int64)

    def restart(self) -> None:
        """The filter began anew: what was logged says nothing of it."""
        self._clear()

    def drop(self) -> None:
        """Forget the epochs, as after a retuning."""
        self.count = 0

    def predicted(self, dt_s: float, p: np.ndarray, spec) -> None:
        """The filter was propagated by ``dt_s`` to covariance ``p``; ``spec`` a FilterSpec."""
        noise = spec.accel_psd_m2_s3, spec.clock_f_m2_s, spec.clock_g_m2_s3, spec.isb_psd_m2_s
        propagate(self._phi, self._qd, self._prior, p, dt_s, *noise)

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
        if names != self._named:
            self._named, self._at = list(names), np.array([self.slot(name) for name in names], dtype=np.int64)
        log = self._views[self.count % self.length]
        log.t_s[...] = t_s
        record(
            self._at, los, second, innovation, variance, own, used, self.z, self.h, self.own, self.seen, self._phi, self._qd,
            self._prior, log.phi, log.qd, log.p, log.r, log.h, log.k, log.var, log.used,
        )  # fmt: skip
        self.dx = dx
        self.count += 1

    def last(self) -> EpochLog:
        """The last epoch (views, ``s`` empty)."""
        return self._views[(self.count - 1) % self.length]

    def log(self, n_epochs: int | None = None) -> EpochLog:
        """The last ``n_epochs`` epochs, oldest first (copies, ``s`` left empty)."""
        return newest(self._ring, self.count, n_epochs)
