"""Front end: what happens to the signal between the antenna port and the sample file.

The quantiser with an ideal gain control lives here; every stage is a Spec whose ``start`` gives its Run.
"""

import math
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from signals.kernels import quantise_bits, quantise_int8, quantise_int16

__all__ = ["OPTIMAL_STEP", "FrontEnd", "FrontEndSpec"]

MAIN_LOBE_HZ = 1.1e6
"""Lowest complex rate that leaves most of the main lobe of a 1.023 Mcps code; real sampling needs twice that."""
OPTIMAL_STEP = {1: 1.596, 2: 0.9957, 3: 0.5860, 4: 0.3352, 5: 0.1881, 6: 0.1041, 7: 0.0569}
"""Step / rms of the uniform mid-rise quantiser of least error for a Gaussian (Max 1960, table II; 7: assumed)."""
RMS_LSB = {8: 20.0, 16: 2000.0}
"""Default rms level per component: clipping at 6.3 and 16 sigma, quantisation noise 1e-3 dB and less."""


class FrontEndSpec(BaseModel):
    """Sampling and quantisation.

    ``bits`` 1 to 7: mid-rise levels +-1, +-3, .. at the optimal loading; 8 and 16: mid-tread integers at
    ``rms_lsb``; 32: float32 with noise of unit variance, not quantised. The gain is ideal: fixed by the known mean
    power of all that arrives.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    fs_hz: float = Field(default=4.096e6, gt=0.0, le=200e6)
    if_hz: float = Field(default=0.0, ge=-100e6, le=100e6)
    complex: bool = True
    bits: Literal[1, 2, 3, 4, 5, 6, 7, 8, 16, 32] = 8
    rms_lsb: float | None = Field(default=None, gt=0.1, le=10_000.0)

    @model_validator(mode="after")
    def _sampling(self):
        check_sampling(self.fs_hz, self.if_hz, self.complex)
        if self.rms_lsb is not None and self.bits not in RMS_LSB:
            raise ValueError(f"rms_lsb applies to 8 and 16 bits, not to {self.bits}: leave it out")
        if self.rms_lsb is not None and self.bits == 8 and self.rms_lsb > 60.0:
            raise ValueError(
                f"rms_lsb = {self.rms_lsb:g} would clip 8-bit samples at 2 sigma: use at most 60"
            )
        return self

    @property
    def dtype(self) -> np.dtype:
        """Type of the samples."""
        return np.dtype(np.float32 if self.bits == 32 else np.int16 if self.bits == 16 else np.int8)

    def start(self, rms: float) -> "FrontEnd":
        """Run for an input of this rms per component (thermal noise = 1)."""
        return FrontEnd(self, rms)


class FrontEnd:
    """Run of a front end; without memory so far, so slabs may come in any order."""

    def __init__(self, spec: FrontEndSpec, rms: float):
        self.spec = spec
        self.dtype = spec.dtype
        if spec.bits == 32:
            gain = 1.0
        elif spec.bits in RMS_LSB:
            gain = (spec.rms_lsb or RMS_LSB[spec.bits]) / rms
        else:
            gain = 1.0 / (OPTIMAL_STEP[spec.bits] * rms)
        self.gain = np.float32(gain)

    def __call__(self, iq: np.ndarray) -> np.ndarray:
        """Float32 (2, n) -> samples (2, n) of ``dtype``."""
        if self.spec.bits == 32:
            return iq
        out = np.empty(iq.shape, self.dtype)
        if self.spec.bits == 8:
            quantise_int8(iq, out, self.gain)
        elif self.spec.bits == 16:
            quantise_int16(iq, out, self.gain)
        else:
            quantise_bits(iq, out, self.gain, self.spec.bits)
        if not self.spec.complex:
            out[1] = 0
        return out


def check_sampling(fs_hz: float, if_hz: float, is_complex: bool) -> None:
    """Refuse a rate that loses the main lobe of the code and an intermediate frequency that does not fit."""
    if not (math.isfinite(fs_hz) and math.isfinite(if_hz)):
        raise ValueError(f"fs_hz = {fs_hz} and if_hz = {if_hz} must be finite")
    kind, lowest = ("complex", MAIN_LOBE_HZ) if is_complex else ("real", 2 * MAIN_LOBE_HZ)
    if fs_hz < lowest:
        raise ValueError(
            f"fs_hz = {fs_hz:g} is too low for {kind} samples: the main lobe of the code needs {lowest:g} Hz or more"
        )
    if is_complex and abs(if_hz) >= fs_hz / 2:
        raise ValueError(
            f"if_hz = {if_hz:g} lies beyond fs_hz / 2 = {fs_hz / 2:g}: check the rate and the IF"
        )
    if not is_complex and not 0 < if_hz < fs_hz / 2:
        raise ValueError(
            f"if_hz = {if_hz:g} must lie between 0 and fs_hz / 2 = {fs_hz / 2:g} for real samples:"
            " check the rate and the IF"
        )
