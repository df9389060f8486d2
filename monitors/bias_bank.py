"""Bank of bias hypotheses on one satellite at a time (Abdel-Hafez bias), in log probabilities with a floor.

The innovation of a biased epoch is r = H eps + v + mu e_i. The projector N = I - H (H'H)^-1 H' removes the filter's
error; its non-trivial right singular vectors V1 (m - rank H rows) give rt = V1 r with mean mu V1[:, i] and covariance
Gamma = V1 R V1' (Abdel-Hafez bias, eq. 10-17; eq. 17 is a covariance, so it is centred, and R need not be sigma^2 I).
The Gaussian exponent needs no decomposition at run time: with

    W = V1' Gamma^-1 V1 = R^-1 - R^-1 H (H' R^-1 H)^-1 H' R^-1 ,
    -1/2 (rt - mu V1_i)' Gamma^-1 (rt - mu V1_i) = -1/2 (r'W r - 2 mu (W r)_i + mu^2 W_ii) .

The recursion of eq. 19 in linear probabilities locks out: a hypothesis that reached 0 never returns, and all
densities underflow at large residuals. Here log probabilities are floored, so that a bias is found again after a long
clean time; delay ~ max[(ln(1/floor) + ln 99) / D_null, ln 99 / D_neighbour], D = W_ii dmu^2 / 2 nats per epoch.
"""

import math
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from numba import njit
from pydantic import BaseModel, ConfigDict, Field, field_validator

SINGULAR = 1e-9
"""Relative size below which a column of H counts as dependent on the others."""
NOT_FINITE, NOT_POSITIVE = -2, -1
FINITE = "H must be a finite matrix of one row per satellite."


@lru_cache(maxsize=4096)
def chi2_limit(dof: int, p: float) -> float:
    """Chi-square quantile exceeded with probability p, kept."""
    from scipy.special import chdtri

    return float(chdtri(dof, p))


def projector(h: np.ndarray) -> np.ndarray:
    """N = I - H (H'H)^-1 H' (Abdel-Hafez bias, eq. 10); H (m, q) without zero columns, full rank."""
    q, _ = np.linalg.qr(geometry(h))
    return np.eye(h.shape[0]) - q @ q.T


def parity_rows(h: np.ndarray) -> np.ndarray:
    """V1 (m - q, m): right singular vectors of the projector with singular value 1 (Abdel-Hafez bias, eq. 12)."""
    hg = geometry(h)
    _, _, vt = np.linalg.svd(projector(hg))
    return vt[: hg.shape[0] - hg.shape[1]]


@njit(cache=True, nogil=True)
def whitened_parity(h, var, w):
    """W = R^-1 - R^-1 H (H' R^-1 H)^-1 H' R^-1 into ``w`` (m, m), R = diag(var); returns the rank of H and its non-zero columns.

    Orthonormal basis Q of R^-1/2 H by Gram-Schmidt, each column twice (Bjorck 1967); W = R^-1/2 (I - Q Q') R^-1/2.
    The rank is NOT_FINITE or NOT_POSITIVE, and nothing computed, where H or the variances are no good.
    """
    m, n = h.shape
    q = np.zeros((n, m))
    root = np.empty(m)
    columns = 0
    for j in range(n):
        filled = False
        for a in range(m):
            if not math.isfinite(h[a, j]):
                return NOT_FINITE, 0
            filled |= h[a, j] != 0.0
        columns += filled
    for a in range(m):
        if not var[a] > 0.0:
            return NOT_POSITIVE, columns
        root[a] = 1.0 / math.sqrt(var[a])
    rank = 0
    for j in range(n):
        size = 0.0
        for a in range(m):
            q[rank, a] = h[a, j] * root[a]
            size += q[rank, a] * q[rank, a]
        for _ in range(2):
            for i in range(rank):
                dot = 0.0
                for a in range(m):
                    dot += q[i, a] * q[rank, a]
                for a in range(m):
                    q[rank, a] -= dot * q[i, a]
        left = 0.0
        for a in range(m):
            left += q[rank, a] * q[rank, a]
        if left <= SINGULAR * SINGULAR * size:
            continue
        left = 1.0 / math.sqrt(left)
        for a in range(m):
            q[rank, a] *= left
        rank += 1
        if rank == m:
            break
    for a in range(m):
        for b in range(m):
            acc = 1.0 if a == b else 0.0
            for i in range(rank):
                acc -= q[i, a] * q[i, b]
            w[a, b] = acc * root[a] * root[b]
    return rank, columns


@njit(cache=True, nogil=True)
def enough(rank, m, columns):
    """Whether m rows of that rank in so many non-zero columns are one more than a fault of one row needs to be seen."""
    return m >= rank + 2 and rank >= min(columns, 4)


def geometry(h: np.ndarray) -> np.ndarray:
    """The non-zero columns of H, checked: at least two more rows than columns, and full rank."""
    h = _finite(h)
    hg = h[:, np.abs(h).max(axis=0) > 0]
    # The range part of any navigation filter observes 3 coordinates and one clock per constellation.
    value = np.linalg.svd(hg, compute_uv=False)
    rank = int((value > SINGULAR * value[0]).sum()) if value.size else 0
    _check(rank, *hg.shape)
    if rank < hg.shape[1]:
        u, _, _ = np.linalg.svd(hg, full_matrices=False)
        hg = u[:, :rank]
    return hg


def _finite(h: np.ndarray) -> np.ndarray:
    h = np.ascontiguousarray(h, dtype=np.float64)
    if h.ndim != 2 or not np.isfinite(h).all():
        raise ValueError(FINITE)
    return h


def _check(rank: int, m: int, columns: int) -> None:
    if m < rank + 2:
        raise ValueError(
            f"The bias bank needs {rank + 2} satellites to tell which one is biased, {m} are in use."
        )
    if rank < min(columns, 4):
        raise ValueError("The satellite geometry is singular: H has no full column rank.")


def parity_weight(h: np.ndarray, var: np.ndarray) -> tuple[np.ndarray, int]:
    """(W (m, m) of the module's docstring, its degrees of freedom) for R = diag(``var``), m^2."""
    h, var = np.ascontiguousarray(h, dtype=np.float64), np.ascontiguousarray(var, dtype=np.float64)
    if h.ndim != 2:
        raise ValueError(FINITE)
    w = np.empty((var.size, var.size))
    rank, columns = whitened_parity(h, var, w)
    if rank == NOT_FINITE:
        raise ValueError(FINITE)
    if rank == NOT_POSITIVE:
        raise ValueError("The bias bank needs measurement variances above zero.")
    _check(rank, var.size, columns)
    return w, var.size - rank


def weight_matrix(h: np.ndarray, r_cov: np.ndarray) -> np.ndarray:
    """W (m, m) of the module's docstring; ``r_cov`` (m,) variances or (m, m) covariance, m^2."""
    if np.ndim(r_cov) == 1:
        return parity_weight(h, r_cov)[0]
    hg, cov = geometry(h), np.asarray(r_cov)
    if not np.all(np.diag(cov) > 0):
        raise ValueError("The bias bank needs measurement variances above zero.")
    ri = np.linalg.inv(cov)
    rh = ri @ hg
    return ri - rh @ np.linalg.solve(hg.T @ rh, rh.T)


@njit(cache=True, nogil=True)
def log_sum_exp(values):
    """ln sum exp, without overflow."""
    top = values[0]
    for v in values:
        top = max(top, v)
    acc = 0.0
    for v in values:
        acc += math.exp(v - top)
    return top + math.log(acc)


@njit(cache=True, nogil=True)
def update_log(log_p, w, r, row, bias_m, log_floor):
    """One epoch of the log recursion in place; ``row``, ``bias_m`` (M,) describe the hypotheses (row 0 of no bias).

    Returns r'W r, the chi-square of the null hypothesis.
    """
    m = r.size
    wr = np.zeros(m)
    own = np.zeros(m)
    null = 0.0
    for a in range(m):
        for b in range(m):
            wr[a] += w[a, b] * r[b]
        null += r[a] * wr[a]
        own[a] = w[a, a]
    weigh(log_p, wr, own, row, bias_m, log_floor)
    return null


@njit(cache=True, nogil=True)
def weigh(log_p, wr, own, row, bias_m, log_floor):
    """The recursion itself: ``wr`` (m,) W r, ``own`` (m,) diagonal of W."""
    for i in range(log_p.size):
        s, mu = row[i], bias_m[i]
        log_p[i] += mu * wr[s] - 0.5 * mu * mu * own[s]
    total = log_sum_exp(log_p)
    clipped = False
    for i in range(log_p.size):
        log_p[i] -= total
        if log_p[i] < log_floor:
            log_p[i] = log_floor
            clipped = True
    if clipped:
        total = log_sum_exp(log_p)
        for i in range(log_p.size):
            log_p[i] -= total


@njit(cache=True, nogil=True)
def bank_epoch(log_p, chi2, count, at, w, r, row, bias_m, log_floor):
    """One epoch of a bank: ``w`` (k, k), ``r`` (k,) of the satellites in its places ``at`` (k,).

    ``chi2`` (F, M) ring of the last epochs' chi-square of each hypothesis, of which ``count`` were before. Returns the most
    probable hypothesis and its sum.
    """
    places = row.max() + 1
    wr, own = np.zeros(places), np.zeros(places)
    null = 0.0
    for i in range(at.size):
        for j in range(at.size):
            wr[at[i]] += w[i, j] * r[j]
        null += r[i] * wr[at[i]]
        own[at[i]] = w[i, i]
    weigh(log_p, wr, own, row, bias_m, log_floor)
    now = count % chi2.shape[0]
    for i in range(row.size):
        s, mu = row[i], bias_m[i]
        chi2[now, i] = null - 2 * mu * wr[s] + mu * mu * own[s]
    best = np.argmax(log_p)
    total = 0.0
    for e in range(min(count + 1, chi2.shape[0])):
        total += chi2[e, best]
    return best, total


@njit(cache=True, nogil=True)
def ranges_epoch(log_p, chi2, dof, count, at, r, h, var, used, row, bias_m, log_floor):
    """``bank_epoch`` of satellites (m,) in places ``at``, those ``used`` (m,), from their rows ``h`` (m, n) and variances.

    ``dof`` (F,) ring of degrees of freedom. Returns (most probable, its chi-square, degrees of freedom), (-1, 0, 0) and
    nothing changed where ``parity_weight`` would refuse.
    """
    u = np.flatnonzero(used)
    w = np.empty((u.size, u.size))
    rank, columns = whitened_parity(h[u], var[u], w)
    if not enough(rank, u.size, columns):
        return -1, 0.0, 0
    dof[count % dof.size] = u.size - rank
    best, total = bank_epoch(log_p, chi2, count, at[u], w, r[u], row, bias_m, log_floor)
    return best, total, dof[: min(count + 1, dof.size)].sum()


@njit(cache=True, nogil=True)
def update_linear(p, w, r, row, bias_m, log_norm):
    """Abdel-Hafez bias, eq. 18-19 as printed, in linear probabilities: a labelled comparison. 0/0 gives NaN, as it would."""
    m = r.size
    wr = np.zeros(m)
    null = 0.0
    for a in range(m):
        for b in range(m):
            wr[a] += w[a, b] * r[b]
        null += r[a] * wr[a]
    total = 0.0
    for i in range(p.size):
        s, mu = row[i], bias_m[i]
        p[i] *= math.exp(log_norm - 0.5 * (null - 2.0 * mu * wr[s] + mu * mu * w[s, s]))
        total += p[i]
    for i in range(p.size):
        p[i] = p[i] / total if total > 0.0 else math.nan


@njit(cache=True, nogil=True)
def run_many(w, r, row, bias_m, log_floor, out):
    """Log recursion over ``r`` (runs, E, m) with one W; writes log probabilities ``out`` (runs, E, M)."""
    runs, e_count, _ = r.shape
    log_p = np.empty(row.size)
    for i in range(runs):
        log_p[:] = -math.log(row.size)
        for e in range(e_count):
            update_log(log_p, w, r[i, e], row, bias_m, log_floor)
            out[i, e] = log_p


@njit(cache=True, nogil=True)
def run_many_linear(w, r, row, bias_m, log_norm, out):
    """Linear recursion over ``r`` (runs, E, m); writes probabilities ``out`` (runs, E, M)."""
    runs, e_count, _ = r.shape
    p = np.empty(row.size)
    for i in range(runs):
        p[:] = 1.0 / row.size
        for e in range(e_count):
            update_linear(p, w, r[i, e], row, bias_m, log_norm)
            out[i, e] = p


def hypotheses(grid_m: np.ndarray, m: int) -> tuple[np.ndarray, np.ndarray]:
    """(row, bias_m) of the M = m (p - 1) + 1 hypotheses, the null first.

    ``grid_m`` (p,) for all satellites or (m, p) per satellite; every grid must contain 0 once.
    """
    grid = np.broadcast_to(np.atleast_2d(np.asarray(grid_m, dtype=np.float64)), (m, np.shape(grid_m)[-1]))
    if not np.all(np.isfinite(grid)):
        raise ValueError("The hypothesis grid must be finite.")
    if np.any((grid == 0).sum(axis=1) != 1) or any(np.unique(g).size != g.size for g in grid):
        raise ValueError("Every hypothesis grid must contain 0 (no bias) exactly once and no value twice.")
    pairs = [(s, mu) for s in range(m) for mu in grid[s] if mu != 0.0]
    if not pairs:
        raise ValueError("A hypothesis grid needs at least one bias besides 0.")
    row = np.array([0] + [s for s, _ in pairs], dtype=np.int64)
    return row, np.array([0.0] + [mu for _, mu in pairs])


def log_normaliser(h: np.ndarray, r_cov: np.ndarray) -> float:
    """-1/2 ln((2 pi)^n |Gamma|) of the density in Abdel-Hafez bias, eq. 18."""
    v1 = parity_rows(h)
    gamma = v1 @ (np.diag(r_cov) if np.ndim(r_cov) == 1 else r_cov) @ v1.T
    return -0.5 * (v1.shape[0] * math.log(2 * math.pi) + np.linalg.slogdet(gamma)[1])


class BiasBank(BaseModel):
    """Scenario section of the bias bank.

    ``fit_epochs`` and ``fit_p_false`` set the goodness-of-fit test: the parity residuals of the last epochs, less the
    best hypothesis, must be chi-square, or nothing is declared ("none of these").
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    kind: Literal["bias_bank"] = "bias_bank"
    grid_m: tuple[float, ...] = (-10.0, -5.0, 0.0, 5.0, 10.0)
    """Biases hypothesised on each satellite."""
    floor: float = Field(1e-6, gt=0, lt=0.01)
    """Probability below which no hypothesis may fall, so that it can come back."""
    declare: float = Field(0.99, gt=0.5, lt=1)
    """A bias is declared when its probability exceeds this."""
    fit_epochs: int = Field(10, ge=1, le=1000)
    """Epochs of the goodness-of-fit test."""
    fit_p_false: float = Field(1e-4, gt=0, lt=0.5)
    """False-alarm probability of the goodness-of-fit test."""

    @field_validator("grid_m")
    @classmethod
    def _has_zero(cls, value):
        hypotheses(np.array(value), 1)
        return value

    def start(self, m: int) -> "BiasBankRun":
        """Start a bank on m satellite slots."""
        return BiasBankRun(self, m)


class BiasReport(NamedTuple):
    """State of the bank after one epoch.

    ``probability`` (M,) with ``row``, ``bias_m`` (M,); ``best`` the most probable hypothesis; ``fits`` whether the
    residuals agree with it; ``declared`` = probable enough, fitting, and not the null. ``fit_chi2`` on ``fit_dof``.
    """

    probability: np.ndarray
    row: np.ndarray
    bias_m: np.ndarray
    best: int
    fits: bool
    declared: bool
    fit_chi2: float
    fit_dof: int


class BiasBankRun:
    """Call once per epoch with the filter's *uncorrected* range innovations (add back any bias already applied)."""

    def __init__(self, spec: BiasBank, m: int):
        self.spec = spec
        self.row, self.bias_m = hypotheses(np.array(spec.grid_m), m)
        self.log_p = np.full(self.row.size, -math.log(self.row.size))
        self.unavailable: str | None = None
        self._chi2 = np.zeros((spec.fit_epochs, self.row.size))
        self._dof = np.zeros(spec.fit_epochs, dtype=np.int64)
        self._count = 0
        self._log_floor = math.log(spec.floor)

    def __call__(self, r: np.ndarray, h: np.ndarray, r_cov: np.ndarray, used: np.ndarray | None = None):
        """Update with innovations ``r`` (m,), rows ``h`` (m, n), R ``r_cov`` (m,) or (m, m); returns a BiasReport.

        None when the test is unavailable this epoch (too few satellites, singular geometry); ``unavailable`` says why
        and the probabilities are kept.
        """
        m = r.size
        used = np.ones(m, dtype=np.bool_) if used is None else np.asarray(used, dtype=np.bool_)
        if np.ndim(r_cov) == 1:
            return self.ranges(np.arange(m), r, h, r_cov, used)
        u, slot = np.flatnonzero(used), self._count % self.spec.fit_epochs
        try:
            w = weight_matrix(h[u], np.asarray(r_cov)[np.ix_(u, u)])
        except (ValueError, np.linalg.LinAlgError) as error:
            self.unavailable = str(error)
            return None
        self._dof[slot] = u.size - np.linalg.matrix_rank(h[u], tol=SINGULAR)
        hypotheses = self.row, self.bias_m, self._log_floor
        best, chi2 = bank_epoch(self.log_p, self._chi2, self._count, u, w, r[u], *hypotheses)
        return self._report(best, chi2, int(self._dof[: self._count + 1].sum()))

    def ranges(self, at: np.ndarray, r: np.ndarray, h: np.ndarray, var: np.ndarray, used: np.ndarray):
        """The same of satellites in places ``at`` of the bank, all arrays in their order, ``var`` (m,) variances."""
        r, h, var = (np.ascontiguousarray(a, dtype=np.float64) for a in (r, h, var))
        hypotheses = self.row, self.bias_m, self._log_floor
        best, chi2, dof = ranges_epoch(
            self.log_p, self._chi2, self._dof, self._count, at, r, h, var, used, *hypotheses
        )
        if best < 0:
            try:
                parity_weight(h[used], var[used])
            except ValueError as error:
                self.unavailable = str(error)
            return None
        return self._report(best, chi2, dof)

    def grown(self, m: int) -> "BiasBankRun":
        """A bank for ``m`` satellite slots, the first of which carry on as here."""
        run = self.spec.start(m)
        run.log_p[: self.log_p.size] = self.log_p
        # A newcomer's hypotheses begin where any other improbable one stands.
        run.log_p[self.log_p.size :] = math.log(self.spec.floor)
        run._chi2[:, : self.log_p.size] = self._chi2
        run._chi2[:, self.log_p.size :] = self._chi2[:, :1]
        run._dof[:], run._count = self._dof, self._count
        return run

    def _report(self, best: int, chi2: float, dof: int) -> BiasReport:
        self.unavailable = None
        self._count += 1
        fits = chi2 <= chi2_limit(dof, self.spec.fit_p_false)
        likely = self.log_p[best] > math.log(self.spec.declare)
        declared = bool(likely and fits and best != 0)
        return BiasReport(np.exp(self.log_p), self.row, self.bias_m, best, fits, declared, chi2, dof)

    def correction_m(self, report: BiasReport) -> np.ndarray:
        """Bias (m,) to subtract from the measured ranges: the declared one, else zeros."""
        out = np.zeros(int(self.row.max()) + 1)
        if report.declared:
            out[report.row[report.best]] = report.bias_m[report.best]
        return out
