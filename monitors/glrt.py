"""Matched-subspace detector of code-line interference with the correlation peak projected out.

z = s(direct path, near echoes) + g a(f) + n over the taps d, n with covariance s2 R(d_i - d_j) per component.
Whitened by W = R^(-1/2), the subspace of H = [R(d + a)] (a: delays of the direct path and near echoes; d > 0
early) is projected out, and T = max_f |a(f)^H W' P W z|^2 / (2 s2 |P W a(f)|^2), a(f) = exp(-2 pi i f d /
fc). Scharf & Friedlander, "Matched subspace detectors", IEEE Trans. SP 42(8), 1994, section V, with a
maximum over f.
"""

import copy
import math
from typing import Literal

import numpy as np
from numba import njit
from pydantic import BaseModel, ConfigDict, Field

from monitors.fft import block_width, to_columns
from monitors.records import checked_corr, statistics
from signals.constants import CHIP_RATE_HZ
from tracking.correlator_model import filtered_autocorrelation

__all__ = ["GlrtMonitor", "GlrtRun"]

_BLOCK = 256  # epochs at a time: the products stay in the second-level cache
_MANY_DEGREES = 1e7  # of the noise variance, from which it counts as known
_GUARD_CHIPS = {"L1CA": (-0.3, 0.0, 0.3, 0.65, 1.0), "E1B": (-0.15, 0.0, 0.15, 0.3, 0.6)}


@njit(cache=True, nogil=True, fastmath={"contract", "nnan", "nsz"})
def _bin_powers(p, q, power):
    """|y(+f)|^2 and |y(-f)|^2 from the real products p = Br Z, q = Bi Z -> ``power`` (2 F, E)."""
    n = p.shape[1] // 2
    n_f = p.shape[0]
    for k in range(n_f):
        for e in range(n):
            pr = p[k, e]
            pi = p[k, n + e]
            qr = q[k, e]
            qi = q[k, n + e]
            power[k, e] = (pr - qi) * (pr - qi) + (pi + qr) * (pi + qr)
            power[n_f + k, e] = (pr + qi) * (pr + qi) + (pi - qr) * (pi - qr)


@njit(cache=True, nogil=True)
def _windows(power, n_valid, length, total, filled, out, where):
    """Sum powers over windows of ``length`` epochs and take the maximum -> number of windows, new fill."""
    n_bins = power.shape[0]
    done = 0
    lo = 0
    while lo < n_valid:
        m = min(length - filled, n_valid - lo)
        for k in range(n_bins):
            s = total[k]
            for e in range(lo, lo + m):
                s += power[k, e]
            total[k] = s
        lo += m
        filled += m
        if filled == length:
            best = 0
            for k in range(1, n_bins):
                if total[k] > total[best]:
                    best = k
            out[done] = total[best]
            where[done] = best
            done += 1
            total[:] = 0.0
            filled = 0
    return done, filled


@njit(cache=True, nogil=True, fastmath={"contract", "nnan", "nsz"})
def _peaks(p, q, best, where):
    """Maximum of ``_bin_powers`` and its row, without the table: ``best`` float32, ``where`` int32 (E,)."""
    n = p.shape[1] // 2
    n_f = p.shape[0]
    best[:] = np.float32(-1.0)
    for k in range(n_f):
        for e in range(n):
            pr = p[k, e]
            pi = p[k, n + e]
            qr = q[k, e]
            qi = q[k, n + e]
            plus = (pr - qi) * (pr - qi) + (pi + qr) * (pi + qr)
            minus = (pr + qi) * (pr + qi) + (pi - qr) * (pi - qr)
            power = max(plus, minus)
            row = np.int32(k) if plus >= minus else np.int32(n_f + k)
            where[e] = row if power > best[e] else where[e]
            best[e] = max(best[e], power)


class GlrtMonitor(BaseModel):
    """Whitened matched-subspace test over code-line frequencies, per epoch or summed over a window.

    Statistic: T above; summed over M epochs without phase for ``accumulate_epochs`` = M.
    Null model: each frequency Exp(1) (a sum of M: Gamma(M)), so threshold = ln(N_eff / P_FA), N_eff the
    effective number of frequencies (60 to 110 here); constant false-alarm rate, blind to the peak and near
    echoes. Under a CW of amplitude K on a grid frequency: P_MD = ncx2.cdf(2 threshold, 2, |P W a|^2 K^2 /
    s2). Cost: two real F x K matrix products per epoch, about 0.3 us at 35 taps and 68 frequencies of each
    sign.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    kind: Literal["GLRT"] = "GLRT"
    guard_chips: tuple[float, ...] | None = None  # delays projected out; None: those of the interference note
    grid_hz: float = Field(15e3, gt=0)  # taps that span D chips resolve about fc / D
    max_hz: float = Field(1.023e6, gt=0, le=4e6)
    """Largest code-line frequency that is tested."""
    accumulate_epochs: int = Field(1, ge=1, le=100_000)
    """Epochs summed without phase, M."""
    noise_variance: float | None = Field(None, gt=0)  # per component; None: from training
    bandwidth_hz: float | None = Field(None, ge=2e5, le=60e6)
    """Front-end filter, brick wall, both sides of L1: it colours the noise of the taps, rounds the peak and lets no
    line beyond its edge pass. None: no filter (in a campaign that of the twin)."""

    def start(self, taps_chips, integration_s, signal="L1CA", prn=1, waveform=None):
        """-> GlrtRun."""
        return GlrtRun(self, np.asarray(taps_chips, float), integration_s, signal, prn, waveform)


class GlrtRun:
    """See ``GlrtMonitor``."""

    def __init__(self, spec, taps_chips, integration_s, signal, prn, waveform):
        self.spec, self.integration_s, self.taps_chips = spec, integration_s, taps_chips
        guard = spec.guard_chips
        if guard is None:
            guard = _GUARD_CHIPS["L1CA" if signal == "L1CA" else "E1B"]
        if len(guard) >= len(taps_chips):
            raise ValueError(f"{len(guard)} guard delays leave nothing of {len(taps_chips)} taps: use fewer")
        code = signal, prn
        filtered = waveform, spec.bandwidth_hz
        R = filtered_autocorrelation(*code, taps_chips[:, None] - taps_chips[None, :], *filtered)
        self.whitener, self._root = _whitener(R, spec.bandwidth_hz is not None)
        H = filtered_autocorrelation(*code, taps_chips[:, None] + np.array(guard)[None, :], *filtered)
        basis, size, _ = np.linalg.svd(self.whitener @ H, full_matrices=False)
        basis = basis[:, size > 1e-6 * size[0]]
        dimensions = len(self.whitener)
        self.projector = np.eye(dimensions) - basis @ basis.T
        self.rank = dimensions - basis.shape[1]
        if self.rank < 1:
            raise ValueError("the guard delays leave nothing of these taps behind this filter: use fewer")
        self._set_grid()
        self.noise_variance = spec.noise_variance
        self.chip_rate_hz = CHIP_RATE_HZ
        self._energy, self.count = 0.0, 0
        self._restart()

    def _restart(self):
        n_f, K = len(self.frequency_hz), len(self.taps_chips)
        self.epoch, self._filled = 0, 0
        self._sum = np.zeros(2 * n_f)
        self._z = np.empty((K, 2 * _BLOCK), np.float32)
        self._p, self._q = (np.empty((n_f, 2 * _BLOCK), np.float32) for _ in range(2))

    def fresh(self):
        """A copy that keeps the training and begins at epoch 0."""
        run = copy.copy(self)
        run._restart()
        return run

    def _set_grid(self):
        spec = self.spec
        edge = min(spec.max_hz, 0.5 * (spec.bandwidth_hz or math.inf))
        f = spec.grid_hz * np.arange(math.floor(edge / spec.grid_hz * (1 + 1e-12)) + 1)
        PW = self.projector @ self.whitener
        a = PW @ np.exp(-2j * np.pi * np.outer(self.taps_chips, f) / CHIP_RATE_HZ)
        gain = np.linalg.norm(a, axis=0)
        keep = gain > 0.05 * gain.max()  # a line inside the projected subspace cannot be seen
        self.frequency_hz, self.gain = f[keep], gain[keep]
        B = (a[:, keep] / gain[keep]).conj().T @ PW
        self._b_re, self._b_im = B.real.astype(np.float32), B.imag.astype(np.float32)
        self.operator = PW
        unit = a[:, keep] / gain[keep]
        self.directions = np.concatenate([unit, unit.conj()], axis=1)

    def line_gain(self, frequency_hz):
        """|P W a(f)|: amplitude of a unit CW at f after whitening and projection."""
        a = np.exp(-2j * np.pi * self.taps_chips * frequency_hz / CHIP_RATE_HZ)
        return float(np.linalg.norm(self.operator @ a))

    def _products(self, z):
        n = z.shape[1]
        if n != self._p.shape[1]:
            self._p, self._q = (np.empty((len(self.frequency_hz), n), np.float32) for _ in range(2))
        np.matmul(self._b_re, z, out=self._p)
        np.matmul(self._b_im, z, out=self._q)

    def powers(self, z):
        """|y_f|^2 of each epoch, float32 (2 F, E): +f, then -f; ``z`` float32 (K, 2 E), in-phase |
        quadrature.
        """
        self._products(z)
        power = np.empty((2 * len(self.frequency_hz), z.shape[1] // 2), np.float32)
        _bin_powers(self._p, self._q, power)
        return power

    def block(self, z):
        """T of each epoch of a block float32 (K, 2 E) -> float32 (E,), and the row of its frequency, int32
        (E,).
        """
        n = z.shape[1] // 2
        best, where = np.empty(n, np.float32), np.zeros(n, np.int32)
        self._products(z)
        _peaks(self._p, self._q, best, where)
        return best * np.float32(0.5 / self._variance()), where

    def whitened_statistic(self, y):
        """T of whitened vectors y = W z, complex (n, K), float64 (n,); slow, for tests and importance
        sampling.
        """
        return 0.5 / self._variance() * np.max(np.abs(y @ self.directions.conj()) ** 2, axis=1)

    def _variance(self):
        if self.noise_variance is None:
            raise ValueError("the GLRT monitor does not know the noise: call train, or set noise_variance")
        return self.noise_variance

    def train(self, corr):
        """Noise variance from what the projection leaves: mean |P W z|^2 / (2 rank); ``corr`` complex64 (n,
        K).
        """
        corr = checked_corr(corr, len(self.taps_chips))
        y = corr @ self.operator.T.astype(np.complex64)
        self._energy += float(np.sum(y.real**2, dtype=float) + np.sum(y.imag**2, dtype=float))
        self.count += len(corr)
        if self.spec.noise_variance is None and self.count:
            self.noise_variance = self._energy / (2 * self.rank * self.count)

    def effective_bins(self, n_draws=200_000, seed=0, tail=1e-3):
        """N_eff: P(T > t) e^t at the ``tail`` quantile of drawn white noise (single epoch).

        The maximum over a smooth random field is, far out, that of N_eff independent bins.
        """
        rng = np.random.Generator(np.random.Philox(seed))
        root = self._root  # noise with covariance R
        parts = []
        for _ in range(max(1, n_draws // _BLOCK)):
            g = rng.standard_normal((root.shape[1], 2 * _BLOCK), np.float32)
            power = self.powers((root @ g).astype(np.float32))
            parts.append(0.5 * power.max(axis=0))
        values = np.concatenate(parts)
        t = np.quantile(values, 1 - tail)
        return float(np.mean(values > t) * math.exp(t))

    def threshold(self, p_fa, n_eff):
        """t with N_eff Q(M, t) = P_FA (M = 1: ln(N_eff / P_FA)); Q the regularised upper incomplete gamma.

        A noise variance from n training epochs of ``rank`` dimensions has nu = 2 n rank degrees of freedom, so that
        T / M is F distributed with 2 M and nu of them: what a training of seconds leaves open.
        """
        from scipy.special import betaincinv, gammainccinv

        if not 0 < p_fa < 1:
            raise ValueError(f"p_fa = {p_fa:g} must lie between 0 and 1")
        M, p = self.spec.accumulate_epochs, min(p_fa / n_eff, 1.0)
        nu = 2 * self.rank * self.count if self.spec.noise_variance is None else 0
        if not 0 < nu < _MANY_DEGREES:
            return float(gammainccinv(M, p))
        return float(0.5 * nu * (1 / betaincinv(0.5 * nu, M, p) - 1))

    def miss_probability(self, amplitude, frequency_hz, threshold):
        """P_MD against a CW of ``amplitude`` at one tap: single bin, so an upper bound when f is on the
        grid.
        """
        from scipy.stats import ncx2

        m = self.spec.accumulate_epochs
        lam = m * (amplitude * self.line_gain(frequency_hz)) ** 2 / self._variance()
        return float(ncx2.cdf(2 * threshold, 2 * m, lam))

    def __call__(self, corr, sample_index=None):
        """STATISTIC, one per epoch or per window of ``accumulate_epochs``; ``corr`` complex64 (n, K)."""
        corr = checked_corr(corr, len(self.taps_chips))
        M = self.spec.accumulate_epochs
        values, bins, ends = [], [], []
        width = block_width(len(corr), _BLOCK)
        z = self._z if width == _BLOCK else np.empty((len(self.taps_chips), 2 * width), np.float32)
        for lo in range(0, len(corr), width):
            m = min(width, len(corr) - lo)
            to_columns(corr, lo, z)
            value, where, last = self._epochs(z, m) if M == 1 else self._windows(z, m)
            values.append(value)
            bins.append(where)
            ends.append(lo + last)
        value, end = np.concatenate(values or [[]]), np.concatenate(ends or [[]]).astype(np.int64)
        signed_hz = np.concatenate([self.frequency_hz, -self.frequency_hz])
        hz = signed_hz[np.concatenate(bins).astype(np.int64)] if bins else np.zeros(0)
        index = None if sample_index is None else np.asarray(sample_index)[end]
        result = statistics(value, self.epoch + end, self.integration_s, hz, index)
        self.epoch += len(corr)
        return result

    def _epochs(self, z, m):
        value, where = self.block(z)
        return value[:m], where[:m], np.arange(m)

    def _windows(self, z, m):
        """Windows that end among the next m epochs: statistic, row, last epoch."""
        M = self.spec.accumulate_epochs
        out, where = np.empty(m), np.empty(m, np.int64)
        first = M - self._filled - 1
        power = self.powers(z)
        done, self._filled = _windows(power, m, M, self._sum, self._filled, out, where)
        return out[:done] * (0.5 / self._variance()), where[:done], first + M * np.arange(done)


def _whitener(R, filtered):
    """W (r, K) with W R W^T = I, and a root G (K, r) of R; refuses taps that carry no independent noise.

    Behind a filter taps closer than its resolution share their noise: W keeps the r directions that have any.
    """
    R = 0.5 * (R + R.T)
    if filtered:
        value, vector = np.linalg.eigh(R)
        keep = value > 1e-4 * value[-1]
        root = np.sqrt(value[keep])
        return vector[:, keep].T / root[:, None], vector[:, keep] * root
    try:
        root = np.linalg.cholesky(R)
    except np.linalg.LinAlgError:
        raise ValueError(
            "the noise of these taps is linearly dependent: use a wider tap spacing for the GLRT"
        ) from None
    return np.linalg.inv(root), root


DETECTORS = (GlrtMonitor,)
