"""Measurement-noise variance from redundant measurements (Vanek 1999, section 3.4): differences cancel all but noise.

Two channels with independent noise: d = v - v', R = E[d^2] / 2 (eq. 37-41). On shared IF samples two identical channels
have *identical* noise and d = 0, so the live form uses interleaved halves (even and odd code periods, alternate codes
for 4 ms codes): each half has 2 R, so R = E[d^2] / 4, as long as the squaring loss of a half is negligible (above about
35 dB-Hz). A CW within a few hundred hertz is common to both halves and largely invisible here: C/N0 and ALS cover it.
"""

import math
from typing import Any, Literal

import numpy as np
from numba import njit
from pydantic import BaseModel, ConfigDict, Field

from nav.ultratight import discriminator_table
from nav.ultratight_kernels import look_up
from signals.constants import METRES_PER_CHIP
from tracking.lock import STATE_LOCKED

PRINTED, UNBIASED, AGE_WEIGHTED = 0, 1, 2
SCHEMES = {"printed": PRINTED, "unbiased": UNBIASED, "age_weighted": AGE_WEIGHTED}


@njit(cache=True, nogil=True)
def window_variance(ring, count, scheme, decay):
    """Mean square of the last min(count, N) differences in ``ring`` (N,), newest at (count - 1) mod N.

    printed: / (n - 1), though the mean is known to be zero (Vanek 1999, eq. 39); unbiased: / n; age-weighted: weights
    decay^age (Vanek 1999, section 5.2.1).
    """
    n = min(count, ring.size)
    acc = 0.0
    if scheme == AGE_WEIGHTED:
        norm, weight = 0.0, 1.0
        for age in range(n):
            d = ring[(count - 1 - age) % ring.size]
            acc += weight * d * d
            norm += weight
            weight *= decay
    else:
        for i in range(n):
            acc += ring[i] * ring[i]
        norm = n - 1.0 if scheme == PRINTED else float(n)
    return acc / norm if norm > 0.0 else math.nan


@njit(cache=True, nogil=True)
def tuned_variance(ring, count, scheme, decay, divisor, r0, short, ratio):
    """R_f = R-hat + R0 (Vanek 1999, eq. 56); with ``short`` > 0 R0 follows a rise that the long window lags behind.

    The last ``short`` differences raise R0 by R_short - R-hat when R_short > ratio R-hat.
    """
    r_hat = window_variance(ring, count, scheme, decay) / divisor
    extra = 0.0
    if short > 0 and count >= short:
        acc = 0.0
        for age in range(short):
            d = ring[(count - 1 - age) % ring.size]
            acc += d * d
        r_short = acc / short / divisor
        if r_short > ratio * r_hat:
            extra = r_short - r_hat
    return r_hat + r0 + extra


class NoiseRmd(BaseModel):
    """Scenario section of the redundant-measurement estimator; variances in m^2."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    kind: Literal["noise_rmd"] = "noise_rmd"
    window: int = Field(50, ge=2, le=100_000)
    """Measurements per variance estimate."""
    scheme: Literal["printed", "unbiased", "age_weighted"] = "unbiased"
    """Weights of the estimate: as printed in the source, unbiased, or by age."""
    pairing: Literal["interleaved", "two_channel"] = "interleaved"
    """Where the redundant measurement comes from: every other epoch, or two channels."""
    age_half_life: float = Field(10.0, gt=0, description="samples, for age_weighted")
    """Measurements after which a weight is halved (scheme "age_weighted")."""
    r0_m2: float = Field(0.0, ge=0)
    """Variance assumed besides the estimated one."""
    adaptive_short: int = Field(0, ge=0, le=1000, description="samples of the short window; 0 = R0 fixed")
    """Length of the short window that takes over when the noise changes; 0: never."""
    adaptive_ratio: float = Field(2.5, gt=1)
    """Ratio of short to long estimate from which the short one is believed."""

    @property
    def divisor(self) -> float:
        """E[d^2] = divisor x R."""
        return 4.0 if self.pairing == "interleaved" else 2.0

    @property
    def decay(self) -> float:
        """Weight ratio of one sample of age."""
        return 0.5 ** (1.0 / self.age_half_life)

    def start(self, m: int) -> "NoiseRmdRun":
        """Start on m satellite slots."""
        return NoiseRmdRun(self, m)


class NoiseRmdRun:
    """Call once per epoch with the differences (m,) of the redundant pairs, metres; NaN where there is none.

    Returns (m,) variances R_f = R-hat + R0; NaN until two differences have been seen. ``clear(i)`` forgets a slot.
    """

    def __init__(self, spec: NoiseRmd, m: int):
        self.spec = spec
        self._ring = np.zeros((m, spec.window))
        self._count = np.zeros(m, dtype=np.int64)

    def clear(self, i: int) -> None:
        """Forget slot i (another satellite took it)."""
        self._count[i] = 0

    def __call__(self, d_m: np.ndarray) -> np.ndarray:
        """One epoch; see the class."""
        s = self.spec
        out = np.full(d_m.size, np.nan)
        for i in range(d_m.size):
            if np.isfinite(d_m[i]):
                self._ring[i, self._count[i] % s.window] = d_m[i]
                self._count[i] += 1
            if self._count[i] > 1:
                scheme, short = SCHEMES[s.scheme], min(s.adaptive_short, s.window)
                args = scheme, s.decay, s.divisor, s.r0_m2, short, s.adaptive_ratio
                out[i] = tuned_variance(self._ring[i], self._count[i], *args)
        return out


@njit(cache=True, nogil=True)
def follow(epochs, counts, slot, ring, done, last):
    """Differences of successive code discriminators of all channels of a slab, in chips, into ``ring`` (S, N).

    ``epochs`` (C, n) EPOCH, ``counts`` (C,) of them valid; ``slot`` (C,) row of each channel, -1: none. ``done`` (S,) differences
    so far; ``last`` (S, 6): sample after the last integration in lock (-1: none), its discriminator, and of the newest
    integration its samples, C/N0 (dB-Hz), loop bandwidth (Hz) and whether it was in lock (-1: nothing new).
    """
    for c in range(counts.size):
        s = slot[c]
        if s < 0 or counts[c] == 0:
            continue
        for k in range(counts[c]):
            e = epochs[c, k]
            if e.state != STATE_LOCKED:
                last[s, 0] = -1.0
                continue
            if last[s, 0] == e.sample_index:
                ring[s, done[s] % ring.shape[1]] = e.code_error_chips - last[s, 1]
                done[s] += 1
            last[s, 0], last[s, 1] = e.sample_index + e.n_samples, e.code_error_chips
        e = epochs[c, counts[c] - 1]
        last[s, 2], last[s, 3], last[s, 4] = e.n_samples, e.cn0_dbhz, e.dll_bw_hz
        last[s, 5] = 1.0 if e.state == STATE_LOCKED else 0.0


@njit(cache=True, nogil=True)
def loop_share(dll_bw_hz: float, integration_s: float, gain: float = 1.0) -> float:
    """Variance of the replica's code phase over E[(e_{k+1} - e_k)^2] of successive discriminators e.

    First-order loop x' = x - a e, e = g x + n, a = 4 B T / (1 + 2 B T), g the discriminator's gain in noise: the range
    carries x, E[x^2] = a / (g (2 - g a)) E[n^2], and E[d^2] = (g^2 a)^2 E[x^2] + ((1 + g a)^2 + 1) E[n^2]. Without a loop
    (B = 0: steered from outside) the measurement is n / g itself.
    """
    if dll_bw_hz == 0.0:
        return 0.5 / gain**2
    bt = dll_bw_hz * integration_s
    a = 4.0 * bt / (1.0 + 2.0 * bt)
    x = a / (gain * (2.0 - gain * a))
    return x / ((gain * gain * a) ** 2 * x + (1.0 + gain * a) ** 2 + 1.0)


@njit(cache=True, nogil=True)
def range_variances(ring, done, last, own_bw, tables, fs_hz, steered, scheme, decay, r0_m2, out):
    """Range variances, m^2, of the rows of ``ring`` (S, N) that are full and were heard since the last call into ``out`` (S,), else NaN.

    ``own_bw`` (S,) loop bandwidths where the integrations tell none; ``steered``: there is no loop. ``tables`` (S, ..): the
    discriminators' (``nav.ultratight.discriminator_table``), whose first column is the gain in noise.
    """
    row = np.empty(4)
    for s in range(out.size):
        out[s] = math.nan
        if last[s, 5] > 0.0 and done[s] >= ring.shape[1]:
            t_s = last[s, 2] / fs_hz
            bw_hz = 0.0 if steered else (last[s, 4] if last[s, 4] != 0.0 else own_bw[s])
            look_up(tables[s], 10.0 ** (0.1 * np.rint(last[s, 3])) * t_s, row)
            share = loop_share(bw_hz, t_s, row[0])
            out[s] = window_variance(ring[s], done[s], scheme, decay) * METRES_PER_CHIP**2 * share + r0_m2
        last[s, 5] = -1.0


class DiscriminatorNoise:
    """Range variance of channels from differences of their successive code discriminators, without a second channel.

    ``hear`` every slab; ``estimate`` gives the variances of the satellites whose window is full.
    """

    def __init__(self, spec: NoiseRmd, fs_hz: float):
        self.spec, self.fs_hz = spec, fs_hz
        self._channels: dict[tuple[str, int], int] = {}
        self._slot = np.zeros(0, np.int64)
        self._names: list[str] = []
        self._loops = np.zeros(0), np.zeros((0, 2, 4))
        self._ring = np.zeros((0, spec.window))
        self._done, self._last = np.zeros(0, np.int64), np.zeros((0, 6))

    def hear(self, channels: dict[tuple[str, int], int], epochs: np.ndarray, counts: np.ndarray, loops: Any):
        """``epochs`` (C, n): EPOCH rows of a slab, ``counts`` (C,) of them valid; ``channels``: channel of (signal, PRN);
        ``loops``: the TrackingSpec."""
        if channels != self._channels or len(counts) != len(self._slot):
            self._seat(channels, len(counts), loops)
        follow(epochs, counts, self._slot, self._ring, self._done, self._last)

    def _seat(self, channels, n_channels, loops) -> None:
        """A row for every satellite that has none, and the row of each channel."""
        self._channels, self._slot = dict(channels), np.full(n_channels, -1)
        for (signal, prn), c in channels.items():
            name = f"{'G' if signal == 'L1CA' else 'E'}{prn:02d}"
            if name not in self._names:
                spec = loops.l1ca if signal == "L1CA" else loops.e1
                self._names.append(name)
                table = discriminator_table("L1CA" if signal == "L1CA" else "E1", spec.early_late_space_chips)
                bw, tables = self._loops
                self._loops = np.append(bw, spec.dll_bw_hz), np.array([*tables, table])
            self._slot[c] = self._names.index(name)
        more = len(self._names) - len(self._done)
        self._ring = np.pad(self._ring, ((0, more), (0, 0)))
        self._done = np.pad(self._done, (0, more))
        self._last = np.pad(self._last, ((0, more), (0, 0)), constant_values=-1.0)

    def estimate(self, steered: bool = False) -> dict[str, float]:
        """Variances, m^2, by satellite, of those heard since the last call; ``steered``: from outside."""
        var = np.empty(len(self._names))
        range_variances(
            self._ring, self._done, self._last, self._loops[0], self._loops[1], self.fs_hz, steered, SCHEMES[self.spec.scheme],
            self.spec.decay, self.spec.r0_m2, var,
        )  # fmt: skip
        return {n: v for n, v in zip(self._names, var.tolist()) if v == v}
