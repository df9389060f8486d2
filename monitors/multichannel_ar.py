"""Multichannel autoregressive monitor: residual energy of a vector prediction of the taps.

x[n] + A_1 x[n-1] + .. + A_p x[n-p] = e[n], x the K taps of one epoch. Coefficients by the Nuttall-Strand
algorithm (Marple, Digital Spectral Analysis with Applications, 1987, section 15.6): order by order, the
cross reflection matrix D minimises the weighted forward and backward residual energies,

    Pf^ Pf^-1 D + D Pb^-1 Pb^ = 2 Pfb^,   A = -D Pb^-1,   C = -D^H Pf^-1

(Pf^, Pb^, Pfb^ sample covariances of the residuals, Pf, Pb the recursion's). ``vieira_morf`` is the variant
printed in Ouzeau et al. 2008, table 3: Lambda = Pf^-1/2 Pfb^ Pb^-H/2 from the sample covariances.
"""

import copy
import math
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from monitors.records import checked_corr, statistics

__all__ = ["ArModel", "MultichannelAr", "MultichannelArRun", "first_order_energy", "fit"]


class ArModel:
    """Coefficients (p, K, K), residual covariance (K, K), number of vectors it was fitted to."""

    def __init__(self, coefficients, covariance, n):
        self.coefficients, self.covariance, self.n = coefficients, covariance, n

    def residuals(self, x):
        """e[n] for n >= p, (N - p, K), of x (N, K)."""
        p = len(self.coefficients)
        e = x[p:].copy()
        for i, A in enumerate(self.coefficients, 1):
            e += x[p - i : len(x) - i] @ A.T
        return e


def fit(x, order=1, method="nuttall_strand"):
    """Fit a multichannel AR model.

    Parameters
    ----------
    x : complex (N, K)
        Vectors in time order.
    order : int
        p >= 1.
    method : str
        "nuttall_strand" or "vieira_morf".

    Raises
    ------
    ValueError
        N <= 2 (p + 1) K: fewer vectors than a fit needs.
    """
    N, K = x.shape
    _check_length(N, K, order)
    x = np.asarray(x, complex)
    step = {"nuttall_strand": _nuttall_strand, "vieira_morf": _vieira_morf}
    if method not in step:
        raise ValueError(f"unknown AR method {method!r}: use nuttall_strand or vieira_morf")
    forward = backward = x
    Pf = Pb = x.T @ x.conj() / N
    A, C = np.zeros((0, K, K), complex), np.zeros((0, K, K), complex)
    for _ in range(order):
        f, b = forward[1:], backward[:-1]
        a, c = step[method](f, b, Pf, Pb)
        A, C = (
            np.concatenate([A + a @ C[::-1], a[None]]),
            np.concatenate([C + c @ A[::-1], c[None]]),
        )
        Pf, Pb = Pf - a @ c @ Pf, Pb - c @ a @ Pb
        Pf, Pb = 0.5 * (Pf + Pf.conj().T), 0.5 * (Pb + Pb.conj().T)
        forward, backward = f + b @ a.T, b + f @ c.T
    return ArModel(A, Pf, N)


def _check_length(N, K, order):
    need = 2 * (order + 1) * K
    if need >= N:
        raise ValueError(
            f"an AR({order}) model of {K} taps needs more than 2 (p + 1) K = {need} vectors, {N} were given: "
            "lengthen the window or shorten the integrations"
        )


def _nuttall_strand(f, b, Pf, Pb):
    from scipy.linalg import solve_sylvester

    n = len(f)
    Pf_hat, Pb_hat, Pfb_hat = f.T @ f.conj() / n, b.T @ b.conj() / n, f.T @ b.conj() / n
    D = solve_sylvester(Pf_hat @ np.linalg.inv(Pf), np.linalg.solve(Pb, Pb_hat), 2 * Pfb_hat)
    return -np.linalg.solve(Pb.T, D.T).T, -np.linalg.solve(Pf.T, D.conj()).T


def _vieira_morf(f, b, Pf, Pb):
    n = len(f)
    Lf = np.linalg.cholesky(f.T @ f.conj() / n)
    Lb = np.linalg.cholesky(b.T @ b.conj() / n)
    partial = np.linalg.solve(Lf, np.linalg.solve(Lb, (f.T @ b.conj() / n).conj().T).conj().T)
    # The reflection coefficients are scaled by the recursion's own covariances.
    Rf, Rb = np.linalg.cholesky(Pf), np.linalg.cholesky(Pb)
    a = -Rf @ np.linalg.solve(Rb.T, partial.T).T
    c = -Rb @ np.linalg.solve(Rf.T, partial.conj()).T
    return a, c


def first_order_energy(x):
    """Trace of the residual covariance of a Nuttall-Strand fit of order 1, complex64 (N, K) -> float.

    With Pf = Pb = P and L L^H = P the residuals that order 1 starts from are x without its first or last vector, so
    the Lyapunov equation reads (a I - u u^H) D' + D' (a I - v v^H) = C in D = L D' L^H, with u = L^-1 x_0 / sqrt(N - 1),
    v = L^-1 x_{N-1} / sqrt(N - 1), a = N / (N - 1), C = 2 L^-1 Pfb^ L^-H: each matrix has two eigenvalues, and D' is C
    with its four parts (along u or not, along v or not) over the sums of theirs. tr Pf' = |L|^2 - |L D'|^2.
    """
    from scipy.linalg.blas import ctrsm
    from scipy.linalg.lapack import cpotrf

    n = len(x)
    L, fault = cpotrf((x.T @ x.conj()) / np.float32(n), lower=1, clean=1)
    if fault:
        raise ValueError("the vectors of this window are linearly dependent: no AR model can be fitted")
    ends = x[[0, -1]].T / np.float32(math.sqrt(n - 1))
    Y = ctrsm(1, L, np.concatenate([x[1:].T @ x[:-1].conj(), ends], axis=1), lower=1)
    C = ctrsm(2 / (n - 1), L, Y[:, :-2], side=1, lower=1, trans_a=2)
    (u, uu), (v, vv) = _unit(Y[:, -2]), _unit(Y[:, -1])
    a = n / (n - 1)
    left, right = u.conj() @ C, C @ v
    both = np.outer(u, (left @ v) * v.conj())
    along_u, along_v = np.outer(u, left) - both, np.outer(right, v.conj()) - both
    D = (C - along_u - along_v - both) / (2 * a)
    D += along_u / (2 * a - uu) + along_v / (2 * a - vv) + both / (2 * a - uu - vv)
    return float(np.vdot(L, L).real - np.vdot(LD := L @ D, LD).real)


def _unit(x):
    """Vector of length one, and the squared length it had."""
    power = np.vdot(x, x).real
    return x / np.sqrt(power), power


class MultichannelAr(BaseModel):
    """Log ratio of the residual energy in a sliding window to its trained value.

    Statistic, by ``form``: "refit": log tr(Pf of a fit in the window) / tr(trained Pf), the paper's; a CW is
    perfectly predictable, so it hides from a fit. "fixed": log mean |e|^2 with the trained coefficients.
    "whitened": log mean e^H S^-1 e / K, S the trained residual covariance.
    Null model: for "whitened" and Gaussian residuals N K times the ratio is about chi2 / 2 of 2 N K degrees;
    slow fading makes the logarithm strongly skewed: take the threshold from data.
    Cost: (p + 1) complex K x K products per epoch, about 2 us at 35 taps; "refit" one fit per hop, 0.2 ms of
    order 1 (``first_order_energy``), 1.3 ms and more of others.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    kind: Literal["AR"] = "AR"
    order: int = Field(1, ge=1, le=8)
    """Order p of the autoregressive model."""
    window_s: float = Field(3.0, gt=0, le=100)
    """Length of the window whose residual is compared."""
    hop_s: float = Field(0.5, gt=0, le=100)
    """Step of the window."""
    form: Literal["refit", "fixed", "whitened"] = "whitened"
    """Which residual energy: of a new fit, of the trained model, or of it whitened."""
    method: Literal["nuttall_strand", "vieira_morf"] = "nuttall_strand"
    """Algorithm of the fit."""
    input: Literal["I", "IQ"] = "IQ"
    """Model the in-phase taps alone, or both components."""
    wipe_sign: bool = True  # multiply each vector by the sign of its prompt: removes data signs

    def start(self, taps_chips, integration_s, signal="L1CA", prn=1, waveform=None):
        """-> MultichannelArRun. Refuses a window with too few vectors."""
        return MultichannelArRun(self, np.asarray(taps_chips, float), integration_s)


class MultichannelArRun:
    """See ``MultichannelAr``."""

    def __init__(self, spec, taps_chips, integration_s):
        self.spec, self.integration_s = spec, integration_s
        self.n_taps, self.prompt = len(taps_chips), int(np.argmin(np.abs(taps_chips)))
        self.window = round(spec.window_s / integration_s)
        self.hop = max(1, round(spec.hop_s / integration_s))
        _check_length(self.window, self.n_taps, spec.order)
        self.model = None
        self._parts = []
        self._restart()

    def _restart(self):
        self.epoch = 0
        self._last = np.zeros((0, self.n_taps), np.complex64)
        self._energy = np.zeros(0)

    def fresh(self):
        """A copy that keeps the training and begins at epoch 0."""
        run = copy.copy(self)
        run._restart()
        return run

    def train(self, corr):
        """Coefficients, residual covariance and reference energy from quiet epochs, complex64 (n, K).

        Called again, the model becomes the average over the calls' fits, each weighted by its length: train
        over many channel realisations.
        """
        x = self._prepare(corr)
        part = fit(x, self.spec.order, self.spec.method)
        self._parts.append((part, part.n))
        weight = sum(n for _, n in self._parts)
        A = sum(m.coefficients * n for m, n in self._parts) / weight
        S = sum(m.covariance * n for m, n in self._parts) / weight
        self.model = ArModel(A, S, weight)
        self._operators(A, S)

    def _operators(self, A, S):
        whiten = np.eye(self.n_taps)
        if self.spec.form == "whitened":
            whiten = np.linalg.inv(np.linalg.cholesky(S)) / math.sqrt(self.n_taps)
        self._trace = float(np.trace(S).real)
        scale = 1.0 / math.sqrt(self._trace) if self.spec.form == "fixed" else 1.0
        whole = np.concatenate([np.eye(self.n_taps)[None], A])
        self._matrices = (scale * whiten @ whole).astype(np.complex64).transpose(0, 2, 1).copy()

    def _prepare(self, corr):
        corr = checked_corr(corr, self.n_taps)
        if self.spec.wipe_sign:
            corr = corr * np.where(corr[:, self.prompt].real < 0, -1, 1).astype(np.float32)[:, None]
        return corr if self.spec.input == "IQ" else corr.real.astype(np.complex64)

    def energies(self, x):
        """Normalised residual energy of each vector but the first p: mean 1 when nothing has changed."""
        p = self.spec.order
        e = x[p:] @ self._matrices[0]
        for i in range(1, p + 1):
            e += x[p - i : len(x) - i] @ self._matrices[i]
        parts = e.view(np.float32)
        return np.einsum("nk,nk->n", parts, parts)

    def __call__(self, corr, sample_index=None):
        """STATISTIC, one per hop once a window is full; ``corr`` complex64 (n, K)."""
        if self.model is None:
            raise ValueError("the AR monitor is not trained: call train with quiet epochs first")
        x = np.concatenate([self._last, self._prepare(corr)])
        first = self.epoch - len(self._last)  # epoch of x[0]
        ends = self._ends(first + len(x))
        value = (
            self._refit(x, ends - first) if self.spec.form == "refit" else self._fixed(x, ends - self.epoch)
        )
        index = None if sample_index is None else np.asarray(sample_index)[ends - self.epoch]
        self.epoch += len(corr)
        keep = self.window - 1 if self.spec.form == "refit" else self.spec.order
        self._last = x[max(0, len(x) - keep) :]
        return statistics(value, ends, self.integration_s, np.nan, index)

    def _ends(self, stop):
        """Last epochs of the windows that end among the new epochs: window - 1 + m hop."""
        m0 = max(0, -(-(self.epoch - self.window + 1) // self.hop))
        return np.arange(self.window - 1 + m0 * self.hop, stop, self.hop)

    def _refit(self, x, ends):
        windows = [x[e - self.window + 1 : e + 1] for e in ends]
        if self.spec.order == 1 and self.spec.method == "nuttall_strand":
            energy = [first_order_energy(w) for w in windows]
        else:
            models = [fit(w, self.spec.order, self.spec.method) for w in windows]
            energy = [np.trace(m.covariance).real for m in models]
        return np.log(np.array(energy) / self._trace)

    def _fixed(self, x, ends):
        """Mean energy over each window, from a running buffer of window - 1 older energies."""
        new = self.energies(x)
        if self.epoch == 0:
            new = np.concatenate([np.full(min(self.spec.order, len(x)), np.nan), new])
        past = self._energy
        e = np.concatenate([past, new])
        self._energy = e[max(0, len(e) - self.window + 1) :]
        total = np.concatenate([[0.0], np.cumsum(np.nan_to_num(e))])
        whole = np.cumsum(np.concatenate([[0], np.isfinite(e)]))
        stop = ends + len(past) + 1
        start = stop - self.window
        return np.log((total[stop] - total[start]) / (whole[stop] - whole[start]))


DETECTORS = (MultichannelAr,)
