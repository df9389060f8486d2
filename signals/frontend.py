"""Front end: what happens to the signal between the antenna port and the sample file.

In this order: local oscillator (offset, phase noise), band-pass filter, I/Q imbalance, spurs and DC, gain control,
quantiser. All but the last two are off by default. Stages with memory work on the samples in order, on a grid of
absolute indices, so that any chunking gives the same bits. Levels are relative to the thermal noise at the antenna,
of unit variance per component.
"""

import math
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from signals.frontend_kernels import control, fir, mix
from signals.jammer_kernels import add_tone
from signals.kernels import quantise_bits, quantise_int8, quantise_int16
from signals.modulation import BLOCK

__all__ = ["OPTIMAL_STEP", "AgcSpec", "FilterSpec", "FrontEnd", "FrontEndSpec", "ImpairmentSpec", "SpurSpec"]

MAIN_LOBE_HZ = 1.1e6
"""Lowest complex rate that leaves most of the main lobe of a 1.023 Mcps code; real sampling needs twice that."""
OPTIMAL_STEP = {1: 1.596, 2: 0.9957, 3: 0.5860, 4: 0.3352, 5: 0.1881, 6: 0.1041, 7: 0.0569}
"""Step / rms of the uniform mid-rise quantiser of least error for a Gaussian (Max 1960, table II; 7: assumed)."""
RMS_LSB = {8: 20.0, 16: 2000.0}
"""Default rms level per component: clipping at 6.3 and 16 sigma, quantisation noise 1e-3 dB and less."""


class FilterSpec(BaseModel):
    """Band-pass FIR filter about the intermediate frequency: Kaiser-windowed (beta 6, stop band -63 dB).

    In the band, amplitude 10^(ripple_db / 20 cos u) and group delay ``group_delay_ripple_s`` cos u, with
    u = 2 pi ripples f / B. ``delay``: that of the taps, (taps - 1) / 2 samples, is "removed" (truth then holds at the
    antenna) or "kept".
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    bandwidth_hz: float = Field(gt=0.0, le=200e6)
    """Two-sided bandwidth."""
    taps: int = Field(default=65, ge=9, le=1025)
    """Length of the filter."""
    ripple_db: float = Field(default=0.0, ge=0.0, le=6.0)
    """Amplitude ripple."""
    group_delay_ripple_s: float = Field(default=0.0, ge=-1e-6, le=1e-6)
    """Ripple of the group delay."""
    ripples: float = Field(default=2.0, gt=0.0, le=20.0)
    """Periods of the ripple across the band."""
    delay: Literal["removed", "kept"] = "removed"
    """Whether the delay of the taps stays in the samples."""

    @model_validator(mode="after")
    def _odd(self):
        if self.taps % 2 == 0:
            raise ValueError(
                f"taps = {self.taps}: use an odd number, so that the delay is a whole number of samples"
            )
        return self

    def design(self, fs_hz: float, if_hz: float = 0.0) -> np.ndarray:
        """Complex taps (T,), centred at T // 2."""
        n = 16 * max(1024, 1 << self.taps.bit_length())
        f = np.fft.fftfreq(n, 1 / fs_hz)
        u = 2 * math.pi * self.ripples * f / self.bandwidth_hz
        gain = 10 ** (self.ripple_db / 20 * np.cos(u)) * (np.abs(f) <= self.bandwidth_hz / 2)
        phase = -self.group_delay_ripple_s * self.bandwidth_hz / self.ripples * np.sin(u)
        half = self.taps // 2
        # Amplitude even and phase odd about the band's middle: real taps there.
        h = np.roll(np.fft.ifft(gain * np.exp(1j * phase)).real, half)[: self.taps] * np.kaiser(
            self.taps, 6.0
        )
        return h * np.exp(2j * math.pi * if_hz / fs_hz * (np.arange(self.taps) - half))


class AgcSpec(BaseModel):
    """Gain control as a loop: the logarithm of the gain approaches its target with this time constant.

    The power is measured over blocks of BLOCK samples, during which the gain holds. Without this section the gain
    is ideal: fixed by the known mean power of all that arrives.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    time_constant_s: float = Field(default=1e-2, ge=1e-5, le=100.0)
    """Time constant of the gain loop."""


class SpurSpec(BaseModel):
    """A tone that the front end makes itself, ``power_db`` over the thermal noise of the whole band."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    freq_hz: float
    """Offset from the carrier."""
    power_db: float = Field(ge=-100.0, le=40.0)
    """Power over the thermal noise of the whole band."""


class ImpairmentSpec(BaseModel):
    """What a real front end adds to ideal mixing and sampling.

    The oscillator is ``lo_offset_hz`` too high (the signal appears so much lower) and its phase wanders: a
    Gaussian process of ``phase_noise_rad`` rms and corner ``phase_noise_bw_hz`` (first order). Imbalance:
    Q' = g (Q cos p + I sin p). DC in units of the noise per component.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    lo_offset_hz: float = Field(default=0.0, ge=-1e6, le=1e6)
    """The oscillator is this much too high."""
    phase_noise_rad: float = Field(default=0.0, ge=0.0, le=3.0)
    """Phase noise, rms."""
    phase_noise_bw_hz: float = Field(default=100.0, gt=0.0, le=1e3)
    """Its corner frequency."""
    iq_gain_db: float = Field(default=0.0, ge=-10.0, le=10.0)
    """Gain of Q over I."""
    iq_phase_deg: float = Field(default=0.0, ge=-45.0, le=45.0)
    """Quadrature error."""
    dc: tuple[float, float] = (0.0, 0.0)
    """Offset of I and Q in units of the noise."""
    spurs: tuple[SpurSpec, ...] = ()


class FrontEndSpec(BaseModel):
    """Sampling and quantisation.

    ``bits`` 1 to 7: mid-rise levels +-1, +-3, .. at the optimal loading; 8 and 16: mid-tread integers at
    ``rms_lsb``; 32: float32 with noise of unit variance, not quantised. The gain is ideal: fixed by the known mean
    power of all that arrives.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    fs_hz: float = Field(default=4.096e6, gt=0.0, le=200e6)
    """Sample rate. With whole samples per chip (or few on few), where a code with sharp edges hides its delay, codes and
    their replicas are limited to the band that is sampled, at the cost of what lies beyond (0.45 dB at 2.046 MHz)."""
    if_hz: float = Field(default=0.0, ge=-100e6, le=100e6)
    """Intermediate frequency."""
    complex: bool = True
    """I/Q samples, or real ones."""
    bits: Literal[1, 2, 3, 4, 5, 6, 7, 8, 16, 32] = 8
    """Bits of a sample component; 32: float."""
    rms_lsb: float | None = Field(default=None, gt=0.1, le=10_000.0)
    """Noise level in steps of the converter (8 and 16 bits)."""
    filter: FilterSpec | None = None
    agc: AgcSpec | None = None
    impairments: ImpairmentSpec | None = None

    @model_validator(mode="after")
    def _sampling(self):
        check_sampling(self.fs_hz, self.if_hz, self.complex)
        self._check_stages()
        if self.rms_lsb is not None and self.bits not in RMS_LSB:
            raise ValueError(f"rms_lsb applies to 8 and 16 bits, not to {self.bits}: leave it out")
        if self.rms_lsb is not None and self.bits == 8 and self.rms_lsb > 60.0:
            raise ValueError(
                f"rms_lsb = {self.rms_lsb:g} would clip 8-bit samples at 2 sigma: use at most 60"
            )
        return self

    def _check_stages(self):
        if self.filter is not None and abs(self.if_hz) + self.filter.bandwidth_hz / 2 > self.fs_hz / 2:
            raise ValueError(
                f"filter.bandwidth_hz = {self.filter.bandwidth_hz:g} about if_hz = {self.if_hz:g} reaches beyond"
                f" fs_hz / 2 = {self.fs_hz / 2:g}: narrow it or raise the rate"
            )
        if self.agc is not None and self.bits == 32:
            raise ValueError("agc needs a quantiser to work for: choose bits of 16 or less")
        for spur in self.impairments.spurs if self.impairments else ():
            if abs(spur.freq_hz + self.if_hz) > self.fs_hz / 2:
                raise ValueError(
                    f"spur at freq_hz = {spur.freq_hz:g} lies beyond fs_hz / 2 = {self.fs_hz / 2:g}: leave it out"
                )
        if (
            self.impairments
            and not self.complex
            and (self.impairments.iq_gain_db or self.impairments.iq_phase_deg)
        ):
            raise ValueError("iq_gain_db and iq_phase_deg need complex samples: leave them out")

    @property
    def dtype(self) -> np.dtype:
        """Type of the samples."""
        return np.dtype(np.float32 if self.bits == 32 else np.int16 if self.bits == 16 else np.int8)

    def start(self, rms: float, seed=0) -> "FrontEnd":
        """Run for an input of this rms per component (thermal noise = 1); ``seed`` is for the phase noise."""
        return FrontEnd(self, rms, seed)


class FrontEnd:
    """Run of a front end: called, it quantises whatever comes; ``push`` takes the samples in order through all."""

    def __init__(self, spec: FrontEndSpec, rms: float, seed=0):
        self.spec = spec
        self.dtype = spec.dtype
        self.streaming = any(s is not None for s in (spec.filter, spec.agc, spec.impairments))
        taps = spec.filter.design(spec.fs_hz, spec.if_hz) if spec.filter else np.ones(1, complex)
        # White noise keeps sum |h|^2; the rest is taken to lie in the band.
        if spec.filter:
            rms = math.sqrt(np.sum(np.abs(taps) ** 2) + max(rms**2 - 1.0, 0.0))
        if spec.bits == 32:
            gain = 1.0
        elif spec.bits in RMS_LSB:
            gain = (spec.rms_lsb or RMS_LSB[spec.bits]) / rms
        else:
            gain = 1.0 / (OPTIMAL_STEP[spec.bits] * rms)
        self.gain = np.float32(gain)
        self._delay = (len(taps) - 1) // 2
        self._skip = self._delay if spec.filter and spec.filter.delay == "removed" else 0
        taps = np.append(taps, np.zeros(-len(taps) % 4))
        self._taps = taps.real.astype(np.float32), taps.imag.astype(np.float32)
        self._past = np.zeros((2, len(taps) - 1), np.float32)
        self._agc = np.array([gain, 0.0, 0.0])
        self._agc_trace: list[tuple[int, float]] = []
        self._target = gain * rms
        self._in = self._out = 0
        self._wander = _Wander(spec.impairments, spec.fs_hz, seed)

    @property
    def agc_gain_db(self) -> float:
        """Gain of the loop now, relative to the ideal one."""
        return float(20 * math.log10(self._agc[0] / self.gain))

    def agc_trace_db(self, sample_index) -> np.ndarray:
        """Gain of the loop at these samples, float64, as it was at the end of the push before; none without a loop."""
        at, gain_db = (np.array(part) for part in zip(*[(-1, 0.0), *self._agc_trace]))
        return gain_db[np.searchsorted(at, np.atleast_1d(sample_index).astype(np.int64), "right") - 1]

    def __call__(self, iq: np.ndarray) -> np.ndarray:
        """Float32 (2, n) -> samples (2, n) of ``dtype``."""
        return self._quantise(iq, self.gain)

    def push(self, iq: np.ndarray, last: bool = False) -> np.ndarray:
        """The next float32 (2, n), which is used up -> the samples that are ready; ``last``: all that are left."""
        imp = self.spec.impairments
        if imp is not None and (imp.lo_offset_hz or imp.phase_noise_rad):
            mix(iq, self._in, imp.lo_offset_hz / self.spec.fs_hz, self._wander(self._in, iq.shape[1]))
        self._in += iq.shape[1]
        if self.spec.filter is not None:
            iq = self._filter(iq, last and self.spec.filter.delay == "removed")
        if imp is not None:
            self._impair(imp, iq)
        if not self.spec.complex:
            iq[1] = 0.0
        self._out += iq.shape[1]
        if self.spec.agc is None:
            return self._quantise(iq, self.gain)
        share = 1.0 - math.exp(-BLOCK / self.spec.fs_hz / self.spec.agc.time_constant_s)
        control(iq, float(BLOCK), share, self._target, self._agc, 2 if self.spec.complex else 1)
        self._agc_trace.append((self._out, self.agc_gain_db))
        return self._quantise(iq, np.float32(1.0))

    def _quantise(self, iq: np.ndarray, gain: np.float32) -> np.ndarray:
        if self.spec.bits == 32:
            return iq
        out = np.empty(iq.shape, self.dtype)
        if self.spec.bits == 8:
            quantise_int8(iq, out, gain)
        elif self.spec.bits == 16:
            quantise_int16(iq, out, gain)
        else:
            quantise_bits(iq, out, gain, self.spec.bits)
        if not self.spec.complex:
            out[1] = 0
        return out

    def _filter(self, iq: np.ndarray, drain: bool) -> np.ndarray:
        if drain:
            iq = np.concatenate([iq, np.zeros((2, self._delay), np.float32)], axis=1)
        x = np.concatenate([self._past, iq], axis=1)
        self._past = x[:, x.shape[1] - self._past.shape[1] :].copy()
        out = np.empty((2, iq.shape[1]), np.float32)
        fir(x[0], x[1], self._taps[0], self._taps[1], out[0], out[1])
        drop = min(self._skip, out.shape[1])
        self._skip -= drop
        return np.ascontiguousarray(out[:, drop:])

    def _impair(self, imp: ImpairmentSpec, iq: np.ndarray) -> None:
        """Spurs, imbalance and DC, in place."""
        fs_hz, n0 = self.spec.fs_hz, self._out
        for spur in imp.spurs:
            freq_hz = spur.freq_hz + self.spec.if_hz
            add_tone(iq, n0, freq_hz / fs_hz, np.float32(math.sqrt(2.0) * 10 ** (spur.power_db / 20)))
        if imp.iq_gain_db or imp.iq_phase_deg:
            g, p = 10 ** (imp.iq_gain_db / 20), math.radians(imp.iq_phase_deg)
            iq[1] = np.float32(g * math.cos(p)) * iq[1] + np.float32(g * math.sin(p)) * iq[0]
        iq += np.array(imp.dc, np.float32)[:, None]


class _Wander:
    """Phase noise of first order on a grid of BLOCK samples, lines between; asked in order."""

    def __init__(self, spec: ImpairmentSpec | None, fs_hz: float, seed):
        self.rms = spec.phase_noise_rad if spec else 0.0
        self._keep = math.exp(-2 * math.pi * (spec.phase_noise_bw_hz if spec else 1.0) * BLOCK / fs_hz)
        self._rng = np.random.default_rng(seed)
        self._first, self._nodes = 0, np.array([self.rms * self._rng.standard_normal()])

    def __call__(self, n0: int, n: int) -> np.ndarray:
        """Phases (rad) at the beginning of the block of sample n0 and of those after it, the one after n0 + n included."""
        nodes = list(self._nodes)
        while self._first + len(nodes) <= (n0 + n) // BLOCK + 1:
            draw = self._rng.standard_normal() * self.rms * math.sqrt(1 - self._keep**2)
            nodes.append(self._keep * nodes[-1] + draw)
        drop = n0 // BLOCK - self._first
        self._first, self._nodes = self._first + drop, np.array(nodes[drop:])
        return self._nodes


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
