"""Slow errors of code ranges as first-order Gauss-Markov processes: the truth-model option of Vanek 1999, appendix B.

Each process has variance s^2 and correlation time tau, so its driving noise is q = 2 s^2 / tau. Two printed strengths
contradict their own variances and are corrected so: multipath (eq. 75: 0.2, must be 0.8 ft^2/s) and ephemeris (eq. 81:
0.4, must be 0.04 ft^2/s); the printed unit ft^2/s^2 of all of them is ft^2/s.
"""

from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

_FT2 = 0.3048**2


class RangeErrors(BaseModel):
    """Variances (m^2) and correlation times (s); defaults are Vanek 1999, eq. 65-82, converted from feet.

    ``multipath_positive`` folds the multipath error to delays only (section B.6).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    kind: Literal["range_errors"] = "range_errors"
    satellite_clock_m2: float = Field(25.0 * _FT2, ge=0)
    ionosphere_m2: float = Field(3.0 * _FT2, ge=0)
    ionosphere_tau_s: float = Field(1500.0, gt=0)
    troposphere_m2: float = Field(1.0 * _FT2, ge=0)
    troposphere_tau_s: float = Field(500.0, gt=0)
    multipath_m2: float = Field(4.0 * _FT2, ge=0)
    multipath_tau_s: float = Field(10.0, gt=0)
    multipath_positive: bool = True
    code_loop_m2: float = Field(1.0 * _FT2, ge=0)
    code_loop_tau_s: float = Field(1.0, gt=0)
    ephemeris_m2: float = Field(30.0 * _FT2, ge=0, description="per axis")
    ephemeris_tau_s: float = Field(1500.0, gt=0)

    def simulate(self, u: np.ndarray, n_epochs: int, dt_s: float, rng: np.random.Generator) -> np.ndarray:
        """Sum of all errors (n_epochs, m), metres, stationary from the start; ``u`` (m, 3) lines of sight."""
        m = u.shape[0]
        total = np.sqrt(self.satellite_clock_m2) * np.broadcast_to(rng.standard_normal(m), (n_epochs, m))
        total = total + gauss_markov(self.ionosphere_m2, self.ionosphere_tau_s, (n_epochs, m), dt_s, rng)
        total += gauss_markov(self.troposphere_m2, self.troposphere_tau_s, (n_epochs, m), dt_s, rng)
        multipath = gauss_markov(self.multipath_m2, self.multipath_tau_s, (n_epochs, m), dt_s, rng)
        total += np.abs(multipath) if self.multipath_positive else multipath
        total += gauss_markov(self.code_loop_m2, self.code_loop_tau_s, (n_epochs, m), dt_s, rng)
        orbit = gauss_markov(self.ephemeris_m2, self.ephemeris_tau_s, (n_epochs, m, 3), dt_s, rng)
        # r = r_hat + dr (eq. 82): the range predicted from the ephemeris is short by u . dr.
        return total + np.einsum("tma,ma->tm", orbit, u)


def gauss_markov(
    variance: float, tau_s: float, shape: tuple, dt_s: float, rng: np.random.Generator
) -> np.ndarray:
    """Stationary first-order Gauss-Markov process along axis 0, sampled exactly: x' = a x + sqrt(1 - a^2) s w."""
    if variance < 0 or tau_s <= 0 or dt_s <= 0:
        raise ValueError("A Gauss-Markov process needs a variance of at least 0, and tau and step above 0.")
    a = np.exp(-dt_s / tau_s)
    w = rng.standard_normal(shape) * np.sqrt(variance)
    w[1:] *= np.sqrt(1.0 - a * a)
    for t in range(1, shape[0]):
        w[t] += a * w[t - 1]
    return w
