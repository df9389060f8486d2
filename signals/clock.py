"""Receiver clock: bias and drift of its reading, with the frequency noise of common oscillators.

The bias is a function of the *reading* t_r = sample index / fs: true time = t_r - bias(t_r). So the truth at
a sample needs no iteration, and it is what a receiver's solution at that sample estimates.
"""

import math
from collections.abc import Callable
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from signals.geodesy import ecef_to_geodetic, ned_matrix
from signals.trajectory import Motion

G0_MPS2 = 9.80665
"""Standard gravity (ISO 80000-3)."""

OSCILLATORS = {
    "TCXO": (1e-21, 2e-20),
    "OCXO": (2.51e-26, 2.51e-22),
    "CSAC": (1.8e-19, 1e-27),
}
"""h0 (s) and h-2 (1/s) of the one-sided fractional-frequency spectrum S_y(f) = h0 + h-2 / f^2.

TCXO and OCXO: Irsigler and Eissfeller, PLL Tracking Performance in the Presence of Oscillator Phase Noise, GPS
Solutions 5(4), 2002, table 1 (its flicker term h-1 is left out). The values of Brown and Hwang (1997), table 10.2,
describe steps of a second in a navigation filter: their h0 of 2e-19 would move the carrier by 0.07 cycle in every
20 ms, which no 10 Hz loop survives. CSAC: h0 = 2 tau ADEV^2 from 3e-10 at 1 s (data sheet); its h-2 is assumed. It
is that noisy: a carrier loop behind a CSAC needs 25 Hz or more.
"""
CLOCK_STEP_S = 0.02
"""Grid of the noise. Nodes at multiples of it reproduce the interpolated bias exactly."""

Clock = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Receiver reading since the start (m,) -> bias_s (m,), drift_s_s (m,)."""


class ClockSpec(BaseModel):
    """Receiver clock: reading minus true time = bias_s + drift_s_s t + noise. Positive drift = runs fast."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    bias_s: float = Field(default=0.0, ge=-0.1, le=0.1)
    """Reading minus true time at the start."""
    drift_s_s: float = Field(default=0.0, ge=-1e-4, le=1e-4)
    """Its rate; positive runs fast."""
    noise: Literal["none", "TCXO", "OCXO", "CSAC"] = "none"
    """Oscillator class, which sets both noise coefficients."""
    h0_s: float | None = Field(default=None, ge=0.0, le=1e-15)
    """White frequency noise, instead of the class's."""
    h_m2_hz: float | None = Field(default=None, ge=0.0, le=1e-15)
    """Random-walk frequency noise, instead of the class's."""
    g_sensitivity_ned_per_g: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Fractional frequency per g of acceleration, along north, east, down of the place where the run begins."""

    def start(self, seed, duration_s: float, motion: Motion | None = None) -> Clock:
        """Run of the clock over readings [-0.1 s, duration_s + 0.1 s]; bias(0) = bias_s.

        ``seed`` is an int, SeedSequence or Generator and is used only where there is noise; ``motion`` is needed
        for the acceleration sensitivity, which adds s.(v(t) - v(0)) / g to the bias.
        """
        clock = self._noisy(seed, duration_s)
        if not any(self.g_sensitivity_ned_per_g):
            return clock
        if motion is None:
            raise ValueError(
                "clock.g_sensitivity_ned_per_g needs the motion of the receiver: start it with one"
            )
        return _accelerated(clock, motion, np.array(self.g_sensitivity_ned_per_g))

    def _noisy(self, seed, duration_s: float) -> Clock:
        h0, h_m2 = OSCILLATORS.get(self.noise, (0.0, 0.0))
        h0 = h0 if self.h0_s is None else self.h0_s
        h_m2 = h_m2 if self.h_m2_hz is None else self.h_m2_hz
        if h0 == 0.0 and h_m2 == 0.0:
            return self._steady
        noise = random_walk(h0, h_m2, np.random.default_rng(seed), duration_s)

        def at(t_s) -> tuple[np.ndarray, np.ndarray]:
            bias, drift = self._steady(t_s)
            extra, rate = interpolate(noise, np.atleast_1d(np.asarray(t_s, float)))
            return bias + extra, drift + rate

        return at

    def _steady(self, t_s) -> tuple[np.ndarray, np.ndarray]:
        t = np.atleast_1d(np.asarray(t_s, float))
        return self.bias_s + self.drift_s_s * t, np.full(t.size, self.drift_s_s)


def _accelerated(clock: Clock, motion: Motion, per_g: np.ndarray) -> Clock:
    """The clock with its frequency shifted by the acceleration along a direction that is fixed to the Earth."""
    begin = motion(np.zeros(1))
    lat, lon, _ = ecef_to_geodetic(begin.pos_ecef_m[0])
    axis = per_g @ ned_matrix(lat, lon) / G0_MPS2

    def at(t_s) -> tuple[np.ndarray, np.ndarray]:
        bias, drift = clock(t_s)
        state = motion(t_s)
        return bias + (state.vel_ecef_mps - begin.vel_ecef_mps) @ axis, drift + state.acc_ecef_mps2 @ axis

    return at


_LEAD = 8  # grid nodes before t = 0


def random_walk(h0_s: float, h_m2_hz: float, rng: np.random.Generator, duration_s: float) -> np.ndarray:
    """Two-state clock noise on the grid CLOCK_STEP_S, bias in s, zero at t = 0.

    Increments (bias, drift) ~ N(0, [[Sf D + Sg D^3/3, Sg D^2/2], [Sg D^2/2, Sg D]]), Sf = h0 / 2,
    Sg = 2 pi^2 h-2 (Brown and Hwang 1997, eq. 10.3.5). A longer run has the shorter one as its beginning.
    """
    d, sf, sg = CLOCK_STEP_S, 0.5 * h0_s, 2.0 * math.pi**2 * h_m2_hz
    n = _LEAD + math.ceil((duration_s + 0.1) / d) + 4
    draw = rng.standard_normal((n, 2))
    drift_step = math.sqrt(sg * d) * draw[:, 0]
    # Given the drift step q, the bias step has mean q D/2 and variance Sf D + Sg D^3/12.
    bias_step = 0.5 * d * drift_step + math.sqrt(sf * d + sg * d**3 / 12.0) * draw[:, 1]
    drift = np.concatenate([[0.0], np.cumsum(drift_step)])
    drift -= drift[_LEAD]
    bias = np.concatenate([[0.0], np.cumsum(bias_step + d * drift[:-1])])
    return bias - bias[_LEAD]


def interpolate(grid: np.ndarray, t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Value and derivative of the C1 cubic through a CLOCK_STEP_S grid, slopes by central difference.

    Raises
    ------
    ValueError
        Outside the grid.
    """
    x = t_s / CLOCK_STEP_S + _LEAD
    k = np.floor(x).astype(np.int64)
    if k.size and (k.min() < 1 or k.max() > grid.size - 3):
        raise ValueError(
            f"clock asked at {t_s.min():g} to {t_s.max():g} s, outside the duration it started for"
        )
    u = x - k
    p0, p1, p2, p3 = grid[k - 1], grid[k], grid[k + 1], grid[k + 2]
    s1, s2 = 0.5 * (p2 - p0), 0.5 * (p3 - p1)
    a, b = 2.0 * (p1 - p2) + s1 + s2, 3.0 * (p2 - p1) - 2.0 * s1 - s2
    value = p1 + u * (s1 + u * (b + u * a))
    return value, (s1 + u * (2.0 * b + 3.0 * u * a)) / CLOCK_STEP_S
