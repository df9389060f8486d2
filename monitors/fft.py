"""Snapshot FFT monitor of multicorrelator outputs (Ouzeau et al. 2008, section IV; Bastide 2001)."""

import copy
import math
from typing import Literal

import numpy as np
from numba import njit
from pydantic import BaseModel, ConfigDict, Field

from monitors.records import checked_corr, statistics
from signals.constants import CHIP_RATE_HZ

__all__ = ["FftMonitor", "FftRun", "block_width", "to_columns"]

_BLOCK = 1024
_GRAIN = 64


def block_width(n, most):
    """Columns in which n epochs are worked on: few epochs do not pay for a whole block."""
    return min(most, max(1, -(-n // _GRAIN)) * _GRAIN)


@njit(cache=True, nogil=True)
def to_columns(corr, lo, out):
    """Epochs lo .. of complex64 (n, K) as float32 (K, 2 E), in-phase | quadrature; zero beyond the end."""
    n_taps, n = out.shape[0], out.shape[1] // 2
    m = min(n, corr.shape[0] - lo)
    for k in range(n_taps):
        for e in range(m):
            z = corr[lo + e, k]
            out[k, e] = z.real
            out[k, n + e] = z.imag
        out[k, m:n] = 0.0
        out[k, n + m :] = 0.0


@njit(nogil=True, fastmath={"contract", "nnan", "nsz"})
def _sum_and_difference(a, b, total, difference):
    for e in range(len(a)):
        i = np.uint64(e)
        x, y = a[i], b[i]
        total[i], difference[i] = x + y, x - y


@njit(cache=True, nogil=True, fastmath={"contract", "nnan", "nsz"})
def _fold(z, even, odd):
    """Even and odd part about the centre tap: rows x_0, x_n + x_-n and x_n - x_-n."""
    h = odd.shape[0]
    even[0] = z[h]
    for k in range(h):
        _sum_and_difference(z[h + 1 + k], z[h - 1 - k], even[k + 1], odd[k])


@njit(cache=True, nogil=True, fastmath={"contract", "nnan", "nsz"})
def _peak_complex(c, s, best, where):
    """Max over bins +-k of |C_k -+ j S_k|^2; ``where`` holds the signed bin."""
    n = c.shape[1] // 2
    best[:] = np.float32(0.0)
    where[:] = np.int32(0)
    for k in range(c.shape[0]):
        for e in range(n):
            cr = c[k, e]
            ci = c[k, n + e]
            sr = s[k, e]
            si = s[k, n + e]
            plus = (cr + si) * (cr + si) + (ci - sr) * (ci - sr)
            minus = (cr - si) * (cr - si) + (ci + sr) * (ci + sr)
            p = max(plus, minus)
            b = np.int32(k) if plus >= minus else np.int32(-k)
            where[e] = b if p > best[e] else where[e]
            best[e] = max(best[e], p)


@njit(cache=True, nogil=True, fastmath={"contract", "nnan", "nsz"})
def _peak_real(c, s, best, where):
    """Max over bins of C_k^2 + S_k^2 of the in-phase half."""
    n = c.shape[1] // 2
    best[:] = np.float32(0.0)
    where[:] = np.int32(0)
    for k in range(c.shape[0]):
        for e in range(n):
            p = c[k, e] * c[k, e] + s[k, e] * s[k, e]
            where[e] = np.int32(k) if p > best[e] else where[e]
            best[e] = max(best[e], p)


class FftMonitor(BaseModel):
    """Maximum of the Fourier transform over the taps of one epoch, standardised by its training.

    Statistic: (m - mean m) / std m, m = max_k |sum_n z_n e^{-2 pi i k n / N}|; the paper alarms on its
    modulus. Null model: none that is exact; m is right-skewed, and slow fading dominates it under multipath,
    so the paper's Gaussian rule gives several times the false alarms asked for. Use an empirical or
    tail-fitted threshold.
    Weak by design on I alone: a CW in antiphase with the peak hides behind it.
    Cost: two real K/2 x N/2 matrix products per epoch, about 0.1 us at 35 taps.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    kind: Literal["FFT"] = "FFT"
    input: Literal["I", "IQ"] = "IQ"
    """Transform the in-phase taps alone, or both components."""
    n_fft: int | None = Field(None, ge=2, le=4096)  # None: the number of taps
    window: Literal["none", "hann"] = "none"
    """Window over the taps."""

    def start(self, taps_chips, integration_s, signal="L1CA", prn=1, waveform=None):
        """-> FftRun. Needs an odd number of equally spaced taps about zero."""
        return FftRun(self, np.asarray(taps_chips, float), integration_s)


class FftRun:
    """See ``FftMonitor``."""

    def __init__(self, spec, taps_chips, integration_s):
        self.spec, self.integration_s = spec, integration_s
        K = len(taps_chips)
        step = np.diff(taps_chips)
        if (
            K < 3
            or K % 2 == 0
            or not np.allclose(step, step[0])
            or not np.allclose(taps_chips, -taps_chips[::-1])
        ):
            raise ValueError(
                "the FFT monitor needs an odd number (3 or more) of equally spaced taps about zero"
            )
        N = spec.n_fft or K
        if N < K:
            raise ValueError(f"n_fft = {N} is shorter than the {K} taps: use at least {K}")
        n, k = np.arange(K // 2 + 1), np.arange(N // 2 + 1)
        weight = 0.5 + 0.5 * np.cos(np.pi * n / (K // 2 + 1)) if spec.window == "hann" else np.ones(len(n))
        angle = 2 * np.pi * np.outer(k, n) / N
        self._cos = (np.cos(angle) * weight).astype(np.float32)
        self._sin = np.ascontiguousarray((np.sin(angle) * weight)[:, 1:]).astype(np.float32)
        # With the project's sign (d > 0 early) a CW at +f turns as exp(-2 pi i f d / fc) over the taps.
        self.bin_hz = -CHIP_RATE_HZ / (N * step[0])
        self.n_taps = K
        self.count, self.mean, self._m2 = 0, 0.0, 0.0
        self.least_spread = 0.0  # of std / mean: a short training may have met too few fades
        self.epoch = 0
        self._buffers(_BLOCK)

    @property
    def spread(self):
        """Standard deviation of the maximum in training over its mean."""
        return math.sqrt(self._m2 / (self.count - 1)) / self.mean if self.count > 1 else math.nan

    @property
    def std(self):
        """Standard deviation of the maximum that standardises."""
        return self.mean * max(self.spread, self.least_spread)

    def _buffers(self, n):
        h = self.n_taps // 2
        self._even, self._odd = np.empty((h + 1, 2 * n), np.float32), np.empty((h, 2 * n), np.float32)
        self._c, self._s = (np.empty((len(self._cos), 2 * n), np.float32) for _ in range(2))
        self._z = np.empty((self.n_taps, 2 * n), np.float32)
        self._best, self._where = np.empty(n, np.float32), np.empty(n, np.int32)

    def block(self, z):
        """Maximum |DFT| of each epoch of ``z`` float32 (K, 2 E), in-phase | quadrature -> float32 (E,).

        Bins of the maxima are left in ``peak_hz``.
        """
        if z.shape[1] != 2 * len(self._best):
            self._buffers(z.shape[1] // 2)
        _fold(z, self._even, self._odd)
        np.matmul(self._cos, self._even, out=self._c)
        np.matmul(self._sin, self._odd, out=self._s)
        (_peak_real if self.spec.input == "I" else _peak_complex)(self._c, self._s, self._best, self._where)
        return np.sqrt(self._best)

    @property
    def peak_hz(self):
        """Frequency of the last block's maxima, relative to the carrier."""
        return self._where * self.bin_hz

    def maxima(self, corr):
        """Maximum |DFT| of each epoch and its frequency, float64 (n,) each; ``corr`` complex64 (n, K)."""
        corr = checked_corr(corr, self.n_taps)
        value, hz = np.empty(len(corr)), np.empty(len(corr))
        width = block_width(len(corr), _BLOCK)
        for lo in range(0, len(corr), width):
            if len(self._best) != width:
                self._buffers(width)
            to_columns(corr, lo, self._z)
            m = min(width, len(corr) - lo)
            value[lo : lo + m] = self.block(self._z)[:m]
            hz[lo : lo + m] = self.peak_hz[:m]
        return value, hz

    def train(self, corr):
        """Add quiet epochs, complex64 (n, K): mean and standard deviation of the maximum."""
        self.train_maxima(self.maxima(corr)[0])

    def train_maxima(self, values):
        """The same from maxima already computed; counts merge (Chan et al. 1979)."""
        n = len(values)
        if n == 0:
            return
        values = np.asarray(values, float)
        mean, total = values.mean(), self.count + n
        delta = mean - self.mean
        self._m2 += ((values - mean) ** 2).sum() + delta * delta * self.count * n / total
        self.mean += delta * n / total
        self.count = total

    def fresh(self):
        """A copy that keeps the training and begins at epoch 0."""
        run = copy.copy(self)
        run.epoch = 0
        run._buffers(_BLOCK)
        return run

    def __call__(self, corr, sample_index=None):
        """STATISTIC (n,) of complex64 (n, K)."""
        if self.count < 2:
            raise ValueError("the FFT monitor is not trained: call train with quiet epochs first")
        value, hz = self.maxima(corr)
        epochs = self.epoch + np.arange(len(value))
        self.epoch += len(value)
        return statistics((value - self.mean) / self.std, epochs, self.integration_s, hz, sample_index)


DETECTORS = (FftMonitor,)
