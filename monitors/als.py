"""Measurement-noise covariance from the innovations of a running filter: autocovariance least squares (Abdel-Hafez ALS).

The gains in the epoch log do not depend on the noise that is sought, so the covariance of the innovations at lags 0..N-1
is *linear* in it. With Abar_k = phi_{k+1} (I - K_k H_k), L_k = phi_{k+1} K_k and R = sum_i theta_i E_i:

    P^i_{k+1} = Abar P^i Abar' + L E_i L'       one recursion per unknown, exact for a time-varying system
    P^0_{k+1} = Abar P^0 Abar'                  what is left of the covariance at the window's start
    P^q_{k+1} = Abar P^q Abar' + Qd_k           process noise (known, or a scale q to be estimated too)
    E[r_k r_k']     = H P H' + R
    E[r_{k+j} r_k'] = H_{k+j} Abar_{k+j-1} .. Abar_{k+1} C_k,   C_k = Abar_k P_k H_k' - L_k R

averaged over the same epochs as the data and solved by non-negative (diagonal R) or plain (symmetric R) least squares.
Odelson, Rajamani and Rawlings 2006 give the time-invariant form; Abdel-Hafez ALS, eq. 16, freezes the matrices at one epoch,
which needs a stable phi (I - K H): it is not, see ``frozen``. The measurement noise must be white: feed discriminator
outputs, one per integration, not smoothed pseudoranges.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numba import njit
from pydantic import BaseModel, ConfigDict, Field, model_validator

from nav.eskf import EpochLog, Eskf


@dataclass(frozen=True)
class AlsModel:
    """Linear model of the lagged innovation covariances of one log window; data-free, so shared by Monte Carlo runs.

    ``known`` (N, p, p) and ``columns`` (q, N, p, p): E[mean of r_{k+j} r_k'] = known + sum_i theta_i columns_i.
    ``basis`` names the unknowns: pairs (a, b) of rows, or (-1, -1) for the process-noise scale.
    """

    rows: np.ndarray
    basis: tuple[tuple[int, int], ...]
    known: np.ndarray
    columns: np.ndarray
    end_known: np.ndarray
    end_columns: np.ndarray
    counts: np.ndarray
    settle: int


@dataclass(frozen=True)
class AlsResult:
    """``r_cov_m2`` (p, p) estimate; ``q_scale`` NaN unless asked for; ``covariance`` (n, n) the *actual* covariance of
    the filter's error after the last update, with which it should be restarted; ``condition`` of the weighted system.
    """

    rows: np.ndarray
    r_cov_m2: np.ndarray
    q_scale: float
    covariance: np.ndarray
    condition: float
    n_epochs: int

    @property
    def sigma_m(self) -> np.ndarray:
        """Square roots of the diagonal, (p,)."""
        return np.sqrt(np.clip(np.diag(self.r_cov_m2), 0.0, None))


@njit(cache=True, nogil=True)
def _basis_term(row_pairs, i, l_rows, out):
    """out <- L E_i L' for E_i = e_a e_b' + e_b e_a' (a != b) or e_a e_a'."""
    a, b = row_pairs[i, 0], row_pairs[i, 1]
    n = l_rows.shape[0]
    for x in range(n):
        for y in range(n):
            v = l_rows[x, a] * l_rows[y, b]
            if a != b:
                v += l_rows[x, b] * l_rows[y, a]
            out[x, y] += v


@njit(cache=True, nogil=True)
def _accumulate(
    phi, qd, h, k, var, used, rows, other, pairs, p_start, lags, settle, known_out, column_out, counts
):
    """Propagate all parts through the log and sum the model of lags 0..N-1 over epochs k >= settle.

    Parts: 0 = start covariance and rows of known R, 1 = process noise, 2.. = unknown basis matrices.
    Returns the parts (2 + q, n, n) of the posterior covariance after the last update.
    """
    e_count, n = phi.shape[0], phi.shape[1]
    p = rows.size
    q = pairs.shape[0]
    parts = np.zeros((2 + q, n, n))
    parts[0] = p_start
    flat = parts.reshape((2 + q) * n, n)
    turned = np.empty_like(parts)
    # Transposed, so that all parts are one product: H P of this epoch, and the propagated C of the last ones, by age.
    hp = np.zeros((2 + q, p, n))
    stacked = hp.reshape((2 + q) * p, n)
    ct = np.zeros((lags, 2 + q, p, n))
    used_then = np.zeros((lags, p))
    for e in range(e_count):
        he = np.empty((p, n))
        we = np.empty(p)
        for a in range(p):
            we[a] = 1.0 if used[e, rows[a]] else 0.0
            he[a] = h[e, rows[a]]
        ht = np.ascontiguousarray(he.T)
        # Lags j >= 1 of older epochs, then lag 0 of this one.
        for j in range(1, min(lags, e - settle + 1)):
            old = (e - j) % lags
            blocks = np.dot(ct[old].reshape((2 + q) * p, n), ht).reshape(2 + q, p, p)
            for i in range(2 + q):
                block = blocks[i].T
                for a in range(p):
                    for b in range(p):
                        w = we[a] * used_then[old, b]
                        if i < 2:
                            known_out[i, j, a, b] += w * block[a, b]
                        else:
                            column_out[i - 2, j, a, b] += w * block[a, b]
            for a in range(p):
                for b in range(p):
                    counts[j, a, b] += we[a] * used_then[old, b]
        if e >= settle:
            pht = np.dot(flat, ht).reshape(2 + q, n, p)
            for i in range(2 + q):
                for x in range(n):
                    for a in range(p):
                        hp[i, a, x] = pht[i, x, a]
            blocks = np.dot(stacked, ht).reshape(2 + q, p, p)
            for i in range(2 + q):
                block = blocks[i]
                if i >= 2:
                    a, b = pairs[i - 2, 0], pairs[i - 2, 1]
                    block[a, b] += 1.0
                    if a != b:
                        block[b, a] += 1.0
                for a in range(p):
                    for b in range(p):
                        w = we[a] * we[b]
                        if i < 2:
                            known_out[i, 0, a, b] += w * block[a, b]
                        else:
                            column_out[i - 2, 0, a, b] += w * block[a, b]
            for a in range(p):
                for b in range(p):
                    counts[0, a, b] += we[a] * we[b]
        # After the last epoch stop at the posterior: the update without a further prediction.
        lead = phi[e + 1] if e + 1 < e_count else np.eye(n)
        gain = lead @ k[e]
        abar = lead - gain @ h[e]
        at = np.ascontiguousarray(abar.T)
        l_rows = np.empty((n, p))
        for a in range(p):
            l_rows[:, a] = gain[:, rows[a]]
        for j in range(1, min(lags - 1, e - settle + 1)):
            old = (e - j) % lags
            ct[old] = np.dot(ct[old].reshape((2 + q) * p, n), at).reshape(2 + q, p, n)
        if e >= settle:
            now = e % lags
            ct[now] = np.dot(stacked, at).reshape(2 + q, p, n)
            for i in range(q):
                a, b = pairs[i, 0], pairs[i, 1]
                ct[now, 2 + i, b] -= l_rows[:, a]
                if a != b:
                    ct[now, 2 + i, a] -= l_rows[:, b]
            used_then[now] = we
        # P' = Abar (P Abar')  as two stacked products, P symmetric.
        right = np.dot(flat, at).reshape(2 + q, n, n)
        for i in range(2 + q):
            for x in range(n):
                for y in range(n):
                    turned[i, x, y] = right[i, y, x]
        flat[:] = np.dot(turned.reshape((2 + q) * n, n), at)
        for o in other:
            if used[e, o]:
                for x in range(n):
                    for y in range(n):
                        parts[0, x, y] += gain[x, o] * gain[y, o] * var[e, o]
        if e + 1 < e_count:
            for x in range(n):
                for y in range(n):
                    parts[1, x, y] += qd[e + 1, x, y]
        for i in range(q):
            _basis_term(pairs, i, l_rows, parts[2 + i])
    return parts


def row_pairs(p: int, full: bool) -> np.ndarray:
    """Unknowns (q, 2): the diagonal first, then, for a full symmetric R, the pairs above it."""
    pairs = [(a, a) for a in range(p)]
    if full:
        pairs += [(a, b) for a in range(p) for b in range(a + 1, p)]
    return np.array(pairs, dtype=np.int64)


def als_model(
    log: EpochLog,
    rows: np.ndarray | None = None,
    n_lags: int = 2,
    full: bool = False,
    settle: int = 100,
    p_start: np.ndarray | None = None,
    joint_q: bool = False,
) -> AlsModel:
    """Build the linear model from the log alone.

    Parameters
    ----------
    log : EpochLog
        Window of E epochs; the first ``settle`` are used to forget the start, the rest to compare with data.
    rows : (p,) int
        Measurement rows whose noise is sought; the others keep the R of the log. Default: every row ever used.
    n_lags : int
        N of the seed: lags 0 .. N-1. N = 1 already identifies R; N >= 2 is needed when q is sought too.
    full : bool
        Symmetric R instead of diagonal.
    p_start : (n, n)
        Actual covariance of the prior error at the first epoch; default the filter's claim, whose error is a
        nuisance that ``settle`` must outlast.
    joint_q : bool
        Seek a scale q of the process noise too.
    """
    e_count = log.n_epochs
    rows = np.flatnonzero(log.used.any(axis=0)) if rows is None else np.asarray(rows, dtype=np.int64)
    if n_lags < 1 or settle < 0:
        raise ValueError(f"ALS needs at least one lag and settle >= 0, not {n_lags} and {settle}.")
    if rows.size == 0:
        raise ValueError("ALS needs at least one used measurement row in the log.")
    need = settle + n_lags + rows.size
    if e_count < need:
        raise ValueError(
            f"The residual bank holds {e_count} epochs; {n_lags} lags after {settle} settling epochs on "
            f"{rows.size} rows need at least {need}."
        )
    if np.any(log.var[log.used] < 0):
        raise ValueError("The epoch log holds negative measurement variances.")
    p = rows.size
    pairs = row_pairs(p, full)
    other = np.setdiff1d(np.flatnonzero(log.used.any(axis=0)), rows).astype(np.int64)
    known, columns = np.zeros((2, n_lags, p, p)), np.zeros((len(pairs), n_lags, p, p))
    counts = np.zeros((n_lags, p, p))
    start = log.p[0] if p_start is None else np.asarray(p_start, dtype=np.float64)
    args = log.phi, log.qd, log.h, log.k, log.var, log.used, rows.astype(np.int64), other, pairs
    parts = _accumulate(*args, np.ascontiguousarray(start), n_lags, settle, known, columns, counts)
    if np.any(counts[0].diagonal() < n_lags + p):
        raise ValueError(
            "A measurement row was used too seldom in the window for ALS: leave it out of `rows` or wait."
        )
    scale = np.where(counts > 0, 1.0 / np.maximum(counts, 1.0), 0.0)
    known, columns = known * scale, columns * scale
    basis = [(int(a), int(b)) for a, b in pairs]
    end_columns = parts[2:]
    if joint_q:
        columns = np.concatenate([columns, known[1:2]])
        end_columns = np.concatenate([end_columns, parts[1:2]])
        known_sum, end_known = known[0], parts[0]
        basis.append((-1, -1))
    else:
        known_sum, end_known = known.sum(axis=0), parts[0] + parts[1]
    return AlsModel(rows, tuple(basis), known_sum, columns, end_known, end_columns, counts, settle)


def autocovariance(r: np.ndarray, used: np.ndarray, n_lags: int, settle: int) -> np.ndarray:
    """Sample lagged covariances (N, p, p) of innovations (E, p), mean of r_{k+j} r_k' (Abdel-Hafez ALS, eq. 15)."""
    y = np.where(used, r, 0.0)[settle:]
    w = used[settle:].astype(np.float64)
    out = np.empty((n_lags, r.shape[1], r.shape[1]))
    for j in range(n_lags):
        last = y.shape[0] - j
        out[j] = (y[j:].T @ y[:last]) / np.maximum(w[j:].T @ w[:last], 1.0)
    return out


def solve(model: AlsModel, sample: np.ndarray, weighted: bool = True) -> AlsResult:
    """Least squares of ``sample`` (N, p, p) against the model.

    Equation (a, b) is weighted by 1/sqrt(C_aa C_bb), C the sample covariance of the innovations at lag 0. Diagonal R
    (and q): non-negative least squares. Full R: least squares, then negative eigenvalues set to zero.
    """
    p = model.rows.size
    root = np.sqrt(np.clip(np.diag(sample[0]), 1e-300, None)) if weighted else np.ones(p)
    weight = np.broadcast_to(1.0 / np.outer(root, root), sample.shape)
    matrix = (model.columns * weight).reshape(len(model.basis), -1).T
    target = ((sample - model.known) * weight).ravel()
    # Unit columns: q and R have different units; the condition number is that of the scaled system.
    norm = np.linalg.norm(matrix, axis=0)
    norm = np.where(norm > 0, norm, 1.0)
    scaled = matrix / norm
    condition = float(np.linalg.cond(scaled))
    if not condition < 1e8:
        raise ValueError(
            "The ALS equations are singular: the window does not tell the unknown variances apart."
        )
    full = any(a != b for a, b in model.basis)
    if full:
        theta = np.linalg.lstsq(scaled, target, rcond=None)[0] / norm
    else:
        from scipy.optimize import nnls

        theta = nnls(scaled, target)[0] / norm
    cov = np.zeros((p, p))
    q_scale = float("nan")
    for value, (a, b) in zip(theta, model.basis):
        if a < 0:
            q_scale = float(value)
        else:
            cov[a, b] = cov[b, a] = value
    if full:
        lam, vec = np.linalg.eigh(cov)
        cov = (vec * np.clip(lam, 0.0, None)) @ vec.T
    actual = model.end_known + np.tensordot(theta, model.end_columns, axes=1)
    n_epochs = int(model.counts[0].diagonal().min())
    return AlsResult(model.rows, cov, q_scale, 0.5 * (actual + actual.T), condition, n_epochs)


def estimate(log: EpochLog, rows: np.ndarray | None = None, weighted: bool = True, **options) -> AlsResult:
    """ALS on one log window: ``als_model`` (which takes ``options``), sample covariances, ``solve``."""
    model = als_model(log, rows, **options)
    n_lags = model.known.shape[0]
    data = autocovariance(log.r[:, model.rows], log.used[:, model.rows], n_lags, model.settle)
    return solve(model, data, weighted)


def uncompensated(log: EpochLog, rows: np.ndarray | None = None, settle: int = 100) -> np.ndarray:
    """R := sample covariance of the innovations, no account of their correlation with the filter's error (p, p)."""
    rows = np.flatnonzero(log.used.any(axis=0)) if rows is None else np.asarray(rows)
    return autocovariance(log.r[:, rows], log.used[:, rows], 1, settle)[0]


@dataclass(frozen=True)
class FrozenAls:
    """The printed form (Abdel-Hafez ALS, eq. 16) with the matrices frozen at one epoch: a labelled comparison, not for use."""

    r_cov_m2: np.ndarray
    spectral_radius: float
    condition: float


def frozen(log: EpochLog, sample: np.ndarray, index: int = -1) -> FrozenAls:
    """Abdel-Hafez ALS, eq. 16-17, with phi, K, H frozen at epoch ``index``; ``sample`` (N, m, m) as in ``autocovariance``.

    Solves (I - phibar kron phibar) for every unknown, which is singular up to rounding whenever the spectral radius of
    phibar = phi (I - K H) is 1 or more; both figures are returned. All rows must be used; the solution is full and
    symmetrised, unweighted.
    """
    phi, k, h, qd = log.phi[index], log.k[index], log.h[index], log.qd[index]
    n, m = k.shape
    n_lags = sample.shape[0]
    gain = phi @ k
    bar = phi - gain @ h
    system = np.eye(n * n) - np.kron(bar, bar)
    unit = np.eye(m)

    def lags(p, r):
        first = h @ p @ h.T + r
        c = bar @ p @ h.T - gain @ r
        tail = [h @ np.linalg.matrix_power(bar, j) @ c for j in range(n_lags - 1)]
        return np.array([first, *tail])

    sources = [qd.ravel()] + [np.outer(gain[:, a], gain[:, b]).ravel() for a in range(m) for b in range(m)]
    steady = np.linalg.solve(system, np.array(sources).T).T.reshape(-1, n, n)
    known = lags(steady[0], np.zeros((m, m)))
    columns = [
        lags(steady[1 + a * m + b], np.outer(unit[a], unit[b])).ravel() for a in range(m) for b in range(m)
    ]
    theta = np.linalg.lstsq(np.array(columns).T, (sample - known).ravel(), rcond=None)[0].reshape(m, m)
    radius = float(np.abs(np.linalg.eigvals(bar)).max())
    return FrozenAls(0.5 * (theta + theta.T), radius, float(np.linalg.cond(system)))


class Als(BaseModel):
    """Scenario section of the live estimator: a window of ``window_epochs`` after ``settle_epochs``, again and again.

    After each estimate the filter is retuned (R and, because it was tuned wrongly, P) and residuals are collected anew:
    with unequal satellites the second pass is the accurate one.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    kind: Literal["als"] = "als"
    n_lags: int = Field(2, ge=1, le=20)
    """Lags of the innovations' autocovariance that are fitted, N."""
    window_epochs: int = Field(500, ge=20, le=100_000)
    """Navigation epochs in one estimate."""
    settle_epochs: int = Field(100, ge=0, le=100_000)
    """Epochs left out after the start and after each retuning."""
    pause_epochs: int = Field(0, ge=0, le=1_000_000)
    """Epochs without an estimate after each, to save time."""
    full: bool = False
    """Estimate a full R instead of a diagonal one."""
    joint_q: bool = False
    """Estimate the scale of the process noise too."""
    retune_p: bool = True
    """Restart the filter's covariance when R is retuned."""

    @model_validator(mode="after")
    def _fits(self):
        if self.window_epochs <= self.n_lags:
            raise ValueError(
                f"window_epochs = {self.window_epochs} are shorter than the {self.n_lags} lags: lengthen the window or lower n_lags"
            )
        return self

    def start(self, rows: np.ndarray | None = None) -> "AlsRun":
        """Start on the measurement rows whose noise is to be estimated (range, rate, or both; default all used)."""
        return AlsRun(self, rows)


LEAST_USE = 0.5
"""Share of a window in which a row must have been used to have its noise estimated by the live estimator."""


def _often_used(log: EpochLog, rows: np.ndarray | None) -> np.ndarray:
    """Those of ``rows`` (default all) that were used in enough epochs; the others keep the R of the log."""
    rows = np.arange(log.used.shape[1]) if rows is None else np.asarray(rows)
    return rows[log.used[:, rows].mean(axis=0) >= LEAST_USE]


class AlsRun:
    """Call once per navigation epoch, right after the filter's update; returns an AlsResult when a window is full.

    ``unavailable`` holds the one-sentence reason when the last full window could not be used, else None. The caller
    gives the filter the new R; P is replaced here (``retune_p``) and the log begins anew.
    """

    def __init__(self, spec: Als, rows: np.ndarray | None = None):
        self.spec = spec
        self.rows = rows
        self.result: AlsResult | None = None
        self.unavailable: str | None = None
        self._seen = 0

    def __call__(self, filt: Eskf, respond: bool = True) -> AlsResult | None:
        """Look at the filter's log; with ``respond=False`` the filter is only read, never touched."""
        result = self.look(filt.log)
        if result is not None and respond and self.spec.retune_p:
            filt.reset(result.covariance)
        return result

    def restart(self) -> None:
        """The log begins anew, as after a reset of the filter by somebody else."""
        self._seen = 0

    def look(self, take: Callable[[int], EpochLog], epochs: int = 1) -> AlsResult | None:
        """The same on any log that is ``epochs`` longer than at the last call; ``take(n)`` gives its last n."""
        spec, need = self.spec, self.spec.settle_epochs + self.spec.window_epochs
        self._seen += epochs
        if self._seen < need:
            return None
        self._seen = -spec.pause_epochs
        try:
            log = take(need)
            self.result = estimate(
                log,
                _often_used(log, self.rows),
                n_lags=spec.n_lags,
                full=spec.full,
                settle=spec.settle_epochs,
                joint_q=spec.joint_q,
            )
        except (ValueError, np.linalg.LinAlgError) as error:
            self.unavailable = str(error)
            return None
        self.unavailable = None
        return self.result
