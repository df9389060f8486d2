"""Error-state Kalman filter engine and its epoch log, the only thing that the integrity monitors read.

Error state = true - estimate; innovation = measured - predicted. The engine owns P and the log, not the nominal state:
after ``update`` the caller injects the returned dx with the error model's ``inject``.
"""

from typing import NamedTuple

import numpy as np

from nav import eskf_kernels as kernels


class EpochLog(NamedTuple):
    """One row per update, E epochs, n states, m measurement rows (row = channel slot, kept when not used).

    ``phi[e]``, ``qd[e]`` lead from the posterior of update e-1 to the prior of update e; the prediction error then obeys
    eps_{e+1} = phi_{e+1} (I - K_e H_e) eps_e - phi_{e+1} K_e v_e + w_{e+1}.
    """

    t_s: np.ndarray  # (E,)
    phi: np.ndarray  # (E, n, n)
    qd: np.ndarray  # (E, n, n)
    h: np.ndarray  # (E, m, n)
    k: np.ndarray  # (E, n, m)
    r: np.ndarray  # (E, m) innovations
    s: np.ndarray  # (E, m, m) claimed innovation covariance
    var: np.ndarray  # (E, m) R that the filter used
    p: np.ndarray  # (E, n, n) claimed prior covariance
    used: np.ndarray  # (E, m) bool

    @property
    def n_epochs(self) -> int:
        """Number of epochs held."""
        return self.t_s.size


def empty_log(n_epochs: int, n: int, m: int, covariances: bool = True) -> EpochLog:
    """An EpochLog of zeros; without ``covariances`` of the innovations ``s`` is (E, 0, 0)."""
    shapes = {
        "phi": (n, n),
        "qd": (n, n),
        "h": (m, n),
        "k": (n, m),
        "r": (m,),
        "s": (m, m) if covariances else (0, 0),
        "var": (m,),
        "p": (n, n),
    }
    arrays = {key: np.zeros((n_epochs, *shape)) for key, shape in shapes.items()}
    return EpochLog(t_s=np.zeros(n_epochs), used=np.zeros((n_epochs, m), dtype=np.bool_), **arrays)


def epochs_of(ring: EpochLog) -> list[EpochLog]:
    """Views of every row of a ring."""
    return [EpochLog(*(array[i, ...] for array in ring)) for i in range(ring.n_epochs)]


def newest(ring: EpochLog, count: int, n_epochs: int | None = None, held: int | None = None) -> EpochLog:
    """The last ``n_epochs`` epochs of a ring, oldest first (copies).

    ``count``: epochs written so far, row k holding epoch k modulo the ring's length; ``held``: the last of them that still count.
    Raises ValueError when more are asked for than there are.
    """
    have = min(count if held is None else held, ring.n_epochs)
    want = have if n_epochs is None else n_epochs
    if want > have:
        raise ValueError(f"the log holds {have} epochs, {want} were asked for: wait or shorten the window")
    index = np.arange(count - want, count) % ring.n_epochs
    return EpochLog(*(array[index] for array in ring))


def discretise(f: np.ndarray, q_diag: np.ndarray, dt_s: float) -> tuple[np.ndarray, np.ndarray]:
    """(Phi, Qd) of one step; see ``eskf_kernels.discretise``."""
    phi, qd = np.empty_like(f), np.empty_like(f)
    kernels.discretise(np.ascontiguousarray(f), np.ascontiguousarray(q_diag), dt_s, phi, qd)
    return phi, qd


def van_loan(f: np.ndarray, q_diag: np.ndarray, dt_s: float) -> tuple[np.ndarray, np.ndarray]:
    """(Phi, Qd) exactly, by the matrix exponential of [[-F, Qc], [0, F']] dt (Van Loan 1978, theorem 1).

    For long steps (1 s and more), where the second-order form of ``discretise`` is not good enough.
    """
    from scipy.linalg import expm

    n = f.shape[0]
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n], block[:n, n:], block[n:, n:] = -f, np.diag(q_diag), f.T
    e = expm(block * dt_s)
    phi = np.ascontiguousarray(e[n:, n:].T)
    qd = phi @ e[:n, n:]
    return phi, 0.5 * (qd + qd.T)


class Eskf:
    """The filter: P, and a ring of the last ``log_length`` epochs.

    Parameters
    ----------
    p0 : (n, n) float64
        Covariance of true - estimate at the start; symmetric, positive semidefinite.
    m_max : int
        Measurement rows (channel slots) of every update.
    log_length : int
        Epochs that the ring keeps.
    """

    def __init__(self, p0: np.ndarray, m_max: int, log_length: int = 1024):
        p0 = np.array(p0, dtype=np.float64)
        if p0.ndim != 2 or p0.shape[0] != p0.shape[1] or not np.allclose(p0, p0.T) or np.any(np.diag(p0) < 0):
            raise ValueError(
                "P0 of the error-state filter must be a square symmetric matrix without negative variances."
            )
        if m_max < 1 or log_length < 2:
            raise ValueError(
                f"The filter needs m_max >= 1 and log_length >= 2, not {m_max} and {log_length}."
            )
        self.p = p0
        n = p0.shape[0]
        self._ring = empty_log(log_length, n, m_max)
        self._count = 0
        self._phi, self._qd = np.eye(n), np.zeros((n, n))
        self._dx = np.zeros(n)

    def predict(self, phi: np.ndarray, qd: np.ndarray) -> None:
        """Propagate by one step; several steps between two updates are chained in the log."""
        kernels.predict(self.p, phi, qd)
        kernels.chain(self._phi, self._qd, phi, qd)

    def update(
        self, z: np.ndarray, h: np.ndarray, var: np.ndarray, used: np.ndarray | None = None, t_s: float = 0.0
    ):
        """Process one epoch and log it; returns dx (n,), valid until the next call.

        ``z`` (m,) innovations, ``h`` (m, n), ``var`` (m,) variances or (m, m) covariance, ``used`` (m,) bool.
        Raises ValueError for a variance that is not positive or an innovation that is not finite in a used row.
        """
        m = self._ring.r.shape[1]
        used = np.ones(m, dtype=np.bool_) if used is None else np.asarray(used, dtype=np.bool_)
        if z.shape != (m,) or h.shape != (m, self.p.shape[0]) or used.shape != (m,):
            raise ValueError(
                f"An update of this filter has {m} rows and {self.p.shape[0]} states; z is {z.shape}, H {h.shape}."
            )
        diagonal = np.diag(var) if var.ndim == 2 else var
        if not (np.all(diagonal[used] > 0) and np.all(np.isfinite(z[used]))):
            raise ValueError("Used measurement rows need finite innovations and variances above zero.")
        i = self._count % self._ring.t_s.size
        log = self._ring
        log.t_s[i], log.phi[i], log.qd[i] = t_s, self._phi, self._qd
        log.h[i] = np.where(used[:, None], h, 0.0)
        log.r[i], log.var[i], log.used[i], log.p[i] = np.where(used, z, 0.0), diagonal, used, self.p
        if var.ndim == 2:
            self._update_full(log, i, var)
        else:
            kernels.innovation_covariance(self.p, log.h[i], log.var[i], log.used[i], log.s[i])
            kernels.update(self.p, log.h[i], log.var[i], log.used[i], log.r[i], log.k[i], self._dx)
        self._count += 1
        self._phi[:] = np.eye(self.p.shape[0])
        self._qd[:] = 0.0
        return self._dx

    def _update_full(self, log: EpochLog, i: int, cov: np.ndarray) -> None:
        """Correlated R: whiten by its Cholesky factor, update, and map the gain back."""
        u = np.flatnonzero(log.used[i])
        low = np.linalg.cholesky(cov[np.ix_(u, u)])
        h = np.ascontiguousarray(np.linalg.solve(low, log.h[i][u]))
        z = np.linalg.solve(low, log.r[i][u])
        k = np.zeros((self.p.shape[0], u.size))
        log.s[i] = 0.0
        log.s[i][np.ix_(u, u)] = log.h[i][u] @ self.p @ log.h[i][u].T + cov[np.ix_(u, u)]
        kernels.update(self.p, h, np.ones(u.size), np.ones(u.size, dtype=np.bool_), z, k, self._dx)
        log.k[i] = 0.0
        log.k[i][:, u] = np.linalg.solve(low.T, k.T).T

    def reset(self, p: np.ndarray) -> None:
        """Replace P (retuning, or a reset ordered by a monitor); the log of the old filter is dropped."""
        self.p[:] = p
        self._count = 0

    @property
    def n_rows(self) -> int:
        """Measurement rows of every update."""
        return self._ring.r.shape[1]

    @property
    def n_logged(self) -> int:
        """Epochs now in the ring."""
        return min(self._count, self._ring.t_s.size)

    def log(self, n_epochs: int | None = None) -> EpochLog:
        """The last ``n_epochs`` epochs, oldest first (copies)."""
        return newest(self._ring, self._count, n_epochs)


def nis(log: EpochLog) -> tuple[np.ndarray, np.ndarray]:
    """Normalised innovation squared of every epoch and its degrees of freedom; NaN where S is not positive definite."""
    pairs = [kernels.nis(log.r[e], log.s[e], log.used[e]) for e in range(log.n_epochs)]
    return np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])


def linear_log(
    phi: np.ndarray, qd: np.ndarray, h: np.ndarray, var: np.ndarray, p0: np.ndarray, dt_s: float
) -> EpochLog:
    """Log of a filter run on a known linear model (gains only; ``r`` is zero until filled by ``replay``).

    ``phi``, ``qd`` (E, n, n); ``h`` (E, m, n); ``var`` (m,) the filter's R; ``p0`` posterior covariance before epoch 0.
    """
    n_epochs, m, n = h.shape
    log = empty_log(n_epochs, n, m)
    log.t_s[:] = np.arange(n_epochs) * dt_s
    log.phi[:], log.qd[:], log.h[:], log.var[:], log.used[:] = phi, qd, h, var, True
    kernels.gain_schedule(p0.copy(), log.phi, log.qd, log.h, log.var, log.used, log.k, log.s, log.p)
    return log


def replay(log: EpochLog, p0, cov_v, runs: int, rng: np.random.Generator, qd_scale: float = 1.0, e0=None):
    """Simulate the true errors of a filter with the log's gains: innovations (E, runs, m) and errors (E, runs, n).

    True noise: w ~ N(0, qd_scale Qd), v ~ N(0, cov_v) with ``cov_v`` (m, m) or (m,) variances, posterior error before
    epoch 0 ~ N(0, p0) unless ``e0`` (runs, n) is given.
    """
    e_count, m, n = log.h.shape
    root_v = np.diag(np.sqrt(cov_v)) if np.ndim(cov_v) == 1 else np.linalg.cholesky(cov_v)
    w = rng.standard_normal((e_count, runs, n)) @ (np.sqrt(qd_scale) * psd_root(log.qd)).transpose(0, 2, 1)
    v = rng.standard_normal((e_count, runs, m)) @ root_v.T
    e0 = (
        rng.standard_normal((runs, n)) @ psd_root(np.asarray(p0)).T
        if e0 is None
        else np.ascontiguousarray(e0)
    )
    r, err = np.empty_like(v), np.empty_like(w)
    kernels.replay(e0, log.phi, log.h, log.k, w, v, r, err)
    return r, err


def psd_root(matrix: np.ndarray) -> np.ndarray:
    """Square root A of a positive semidefinite matrix (stack), A A' = matrix.

    Taken of the correlation matrix: eigenvalues of a matrix that mixes rad^2 with m^2 would lose the small ones.
    """
    diag = np.sqrt(np.diagonal(matrix, axis1=-2, axis2=-1))
    inv = np.where(diag > 0, 1.0 / np.where(diag > 0, diag, 1.0), 0.0)
    lam, vec = np.linalg.eigh(matrix * inv[..., :, None] * inv[..., None, :])
    return diag[..., :, None] * vec * np.sqrt(np.clip(lam, 0.0, None))[..., None, :]
