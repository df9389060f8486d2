"""Measurement-noise variance from redundant measurements (seed 001, section 3.4): differences cancel all but noise.

Two channels with independent noise: d = v - v', R = E[d^2] / 2 (eq. 37-41). On shared IF samples two identical channels
have *identical* noise and d = 0, so the live form uses interleaved halves (even and odd code periods, alternate codes
for 4 ms codes): each half has 2 R, so R = E[d^2] / 4, as long as the squaring loss of a half is negligible (above about
35 dB-Hz). A CW within a few hundred hertz is common to both halves and largely invisible here: C/N0 and ALS cover it.
"""

import math
from functools import lru_cache
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

    printed: / (n - 1), though the mean is known to be zero (seed 001, eq. 39); unbiased: / n; age-weighted: weights
    decay^age (seed 001, section 5.2.1).
    """
    n = min(count, ring.size)
    acc = 0.0
    norm = 0.0
    weight = 1.0
    for age in range(n):
        d = ring[(count - 1 - age) % ring.size]
        acc += weight * d * d
        norm += weight
        if scheme == AGE_WEIGHTED:
            weight *= decay
    if scheme == PRINTED:
        norm = n - 1.0
    return acc / norm if norm > 0.0 else math.nan


@njit(cache=True, nogil=True)
def tuned_variance(ring, count, scheme, decay, divisor, r0, short, ratio):
    """R_f = R-hat + R0 (seed 001, eq. 56); with ``short`` > 0 R0 follows a rise that the long window lags behind.

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
def follow(epochs, ring, state):
    """Differences of successive code discriminators of one channel, in chips, into ``ring`` (N,).

    ``state`` (3,): differences so far, sample after the last integration in lock (-1: none), its discriminator.
    """
    for e in epochs:
        if e.state != STATE_LOCKED:
            state[1] = -1.0
            continue
        if state[1] == e.sample_index:
            ring[np.int64(state[0]) % ring.size] = e.code_error_chips - state[2]
            state[0] += 1.0
        state[1], state[2] = e.sample_index + e.n_samples, e.code_error_chips


class DiscriminatorNoise:
    """Range variance of channels from differences of their successive code discriminators, without a second channel.

    ``hear`` every channel's new integrations; ``estimate`` gives the variances of those whose window is full.
    """

    def __init__(self, spec: NoiseRmd, fs_hz: float):
        self.spec, self.fs_hz = spec, fs_hz
        self._held: dict[str, tuple[list[np.ndarray], Any]] = {}
        self._rings: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def hear(self, name: str, epochs: np.ndarray, loops: Any) -> None:
        """``epochs``: EPOCH rows of satellite ``name``; ``loops``: its tracking Spec."""
        self._held.setdefault(name, ([], loops))[0].append(epochs.copy())

    def estimate(self, steered: bool = False) -> dict[str, float]:
        """Variances, m^2, by satellite, of those heard since the last call; ``steered``: from outside."""
        out = {}
        for name, (parts, loops) in self._held.items():
            epochs = np.concatenate(parts)
            ring, state = self._rings.setdefault(
                name, (np.zeros(self.spec.window), np.array([0.0, -1.0, 0.0]))
            )
            follow(epochs, ring, state)
            last = epochs[-1]
            if state[0] < self.spec.window or last["state"] != STATE_LOCKED:
                continue
            args = SCHEMES[self.spec.scheme], self.spec.decay
            mean = window_variance(ring, int(state[0]), *args) * METRES_PER_CHIP**2
            t_s = float(last["n_samples"]) / self.fs_hz
            gain = code_gain(name[0], loops.early_late_space_chips, round(float(last["cn0_dbhz"])), t_s)
            out[name] = mean * loop_share(0.0 if steered else loops.dll_bw_hz, t_s, gain) + self.spec.r0_m2
        self._held.clear()
        return out


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


@lru_cache(maxsize=512)
def code_gain(signal: str, spacing_chips: float, cn0_dbhz: float, integration_s: float) -> float:
    """Gain of the normalised code discriminator in noise (``nav.ultratight.discriminator_table``)."""
    row = np.empty(4)
    table = discriminator_table("L1CA" if signal == "G" else "E1", spacing_chips)
    look_up(table, 10.0 ** (0.1 * cn0_dbhz) * integration_s, row)
    return float(row[0])
