"""Faults of single satellites in the air: steps, ramps, clock drift, late code, blockage and counterfeit signals.

A `FaultySky` is a sky whose ``propagate`` adds what the faults do, so that synthesis needs no change. With the fault's
code delay d(t), carrier delay c(t) (both in metres) and level g(t) in dB:

    delay <- delay + d(t) / c_0,   phase_delay <- phase_delay + c(t) / c_0,   C/N0 <- C/N0 + g(t),

and the rates follow. A counterfeit signal is one more row with the code, message and delay of the satellite that it
copies. Delays are interpolated between nodes of 20 ms: a sudden step takes one such interval in the samples.
Increased noise of a satellite is a `PowerDrop`: the noise of a range has no other origin in samples.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from signals.constants import C_MPS, WAVELENGTH_M
from signals.records import FAULT_TRUTH
from signals.sky import Propagation, Satellite, Sky

__all__ = [
    "ClockDrift",
    "CodeDelay",
    "FaultSpec",
    "FaultySky",
    "PowerDrop",
    "Ramp",
    "Spoofer",
    "Step",
    "faulty",
]

_SatId = Annotated[str, Field(pattern=r"^[GE]\d\d$")]


class _Fault(BaseModel):
    """When it holds, on which satellite; ``effect`` gives code (m, m/s), carrier (m, m/s) and level (dB) after ``start_s``."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    start_s: float = Field(0.0, ge=0, le=86_400)
    """When it begins."""
    stop_s: float | None = Field(None, gt=0, le=86_400)
    """None: to the end of the scenario."""

    @model_validator(mode="after")
    def _forward(self):
        if self.stop_s is not None and self.stop_s <= self.start_s:
            raise ValueError(f"stop_s = {self.stop_s:g} must be later than start_s = {self.start_s:g}")
        return self

    def on(self, t_s: np.ndarray) -> np.ndarray:
        """Whether the fault holds at ``t_s``, bool."""
        return (t_s >= self.start_s) & (t_s < (np.inf if self.stop_s is None else self.stop_s))

    def series(self, t_s: np.ndarray) -> np.ndarray:
        """(5, n): code m, code m/s, carrier m, carrier m/s, level dB; zero while the fault does not hold."""
        t_s = np.asarray(t_s, float)
        return np.where(self.on(t_s), self.effect(np.maximum(t_s - self.start_s, 0.0)), 0.0)

    def effect(self, age_s: np.ndarray) -> np.ndarray:
        """As ``series``, by the time since ``start_s``."""
        raise NotImplementedError


def _rows(age_s, code_m=0.0, code_mps=0.0, carrier_m=0.0, carrier_mps=0.0, level_db=0.0) -> np.ndarray:
    columns = (code_m, code_mps, carrier_m, carrier_mps, level_db)
    return np.stack([np.broadcast_to(np.asarray(c, float), age_s.shape) for c in columns])


class Step(_Fault):
    """The range jumps by ``step_m``; the carrier keeps its phase unless ``carrier``."""

    kind: Literal["Step"] = "Step"
    satellite: _SatId
    """Name, e.g. "G05"."""
    step_m: float = Field(ge=-1e5, le=1e5)
    """Size of the jump."""
    carrier: bool = False
    """Whether the carrier jumps too."""

    def effect(self, age_s):
        """Constant code offset."""
        return _rows(age_s, self.step_m, carrier_m=self.step_m * self.carrier)


class Ramp(_Fault):
    """The range drifts by ``rate_mps`` (0.3048 m/s = 1 ft/s); the carrier does not show it unless ``carrier``."""

    kind: Literal["Ramp"] = "Ramp"
    satellite: _SatId
    """Name, e.g. "G05"."""
    rate_mps: float = Field(ge=-1e3, le=1e3)
    """Drift of the range."""
    carrier: bool = False
    """Whether the carrier drifts too."""

    def effect(self, age_s):
        """Code offset growing linearly."""
        ramp = self.rate_mps * age_s
        return _rows(age_s, ramp, self.rate_mps, ramp * self.carrier, self.rate_mps * self.carrier)


class CodeDelay(_Fault):
    """The code is late by ``delay_m`` without its carrier, built up linearly over ``onset_s``."""

    kind: Literal["CodeDelay"] = "CodeDelay"
    satellite: _SatId
    """Name, e.g. "G05"."""
    delay_m: float = Field(ge=-1e5, le=1e5)
    """Delay of the code at last."""
    onset_s: float = Field(0.0, ge=0, le=3600)
    """Time over which it builds up."""

    def effect(self, age_s):
        """A ramp of ``onset_s``, then constant."""
        if self.onset_s == 0.0:
            return _rows(age_s, self.delay_m)
        rising = age_s < self.onset_s
        rate = self.delay_m / self.onset_s
        return _rows(age_s, np.where(rising, rate * age_s, self.delay_m), rate * rising)


class ClockDrift(_Fault):
    """The satellite's clock runs away: code and carrier together, rate_mps t + drift_mps2 t^2 / 2."""

    kind: Literal["ClockDrift"] = "ClockDrift"
    satellite: _SatId
    """Name, e.g. "G05"."""
    rate_mps: float = Field(0.0, ge=-1e3, le=1e3)
    """Drift at the start."""
    accel_mps2: float = Field(0.0, ge=-100, le=100)
    """Growth of the drift."""

    def effect(self, age_s):
        """A parabola in code and carrier."""
        delay = (self.rate_mps + 0.5 * self.accel_mps2 * age_s) * age_s
        rate = self.rate_mps + self.accel_mps2 * age_s
        return _rows(age_s, delay, rate, delay, rate)


class PowerDrop(_Fault):
    """The signal is weaker by ``drop_db`` (80 dB and more: blocked); of one satellite or, without a name, of all."""

    kind: Literal["PowerDrop"] = "PowerDrop"
    satellite: _SatId | None = None
    """Name, e.g. "G05"; unset: all."""
    drop_db: float = Field(gt=0, le=120)
    """Loss of power."""

    def effect(self, age_s):
        """Level alone."""
        return _rows(age_s, level_db=-self.drop_db)


class Spoofer(_Fault):
    """A second signal of the same PRN and message: it rises aligned, then draws the receiver away.

    Level over the genuine signal: from ``advantage_db`` - 40 dB linearly to ``advantage_db`` within ``rise_s``; range
    offset: ``offset_m`` at first, changing by ``drift_mps`` from ``hold_s`` after the start on. Code and carrier move
    alike; ``phase_cycles`` and ``doppler_hz`` tell the carriers apart (a true spoofer cannot match the phase).
    """

    kind: Literal["Spoofer"] = "Spoofer"
    satellite: _SatId
    """Name, e.g. "G05"."""
    advantage_db: float = Field(3.0, ge=-30, le=40)
    """Level over the genuine signal."""
    rise_s: float = Field(0.0, ge=0, le=3600)
    """Time in which it gets there."""
    hold_s: float = Field(0.0, ge=0, le=3600)
    """Time after the start at which it begins to draw away."""
    offset_m: float = Field(0.0, ge=-1e5, le=1e5)
    """Range offset at first."""
    drift_mps: float = Field(2.0, ge=-1e3, le=1e3)
    """Rate of the range offset afterwards."""
    phase_cycles: float = Field(0.0, ge=-1, le=1)
    """Carrier phase against the genuine one."""
    doppler_hz: float = Field(0.0, ge=-1e4, le=1e4)
    """Doppler against the genuine one."""

    def effect(self, age_s):
        """Offset of the counterfeit signal from the genuine one."""
        away_s = np.maximum(age_s - self.hold_s, 0.0)
        rate = self.drift_mps * (age_s >= self.hold_s)
        rise = np.minimum(age_s / self.rise_s, 1.0) if self.rise_s else 1.0
        code = self.offset_m + self.drift_mps * away_s
        wave_m = -WAVELENGTH_M * (self.phase_cycles + self.doppler_hz * age_s)
        return _rows(
            age_s, code, rate, code + wave_m, rate - WAVELENGTH_M * self.doppler_hz,
            self.advantage_db - 40.0 * (1.0 - rise),
        )  # fmt: skip


FaultSpec = Annotated[Step | Ramp | CodeDelay | ClockDrift | PowerDrop | Spoofer, Field(discriminator="kind")]
"""One ``[[fault]]`` of a scenario."""


class Counterfeit(Satellite):
    """A row of a spoofer; its name differs, so that echoes of the genuine satellite are not its own."""

    @property
    def name(self) -> str:
        """Identifier such as G05-spoofed."""
        return f"{super().name}-spoofed"


@dataclass(frozen=True)
class FaultySky:
    """Run of a sky with faults: everything of the `Sky` but ``satellites`` and ``propagate`` is the sky's own.

    ``genuine`` satellites come first in ``satellites``, the spoofers' signals after them in the order of ``faults``.
    """

    sky: Sky
    faults: tuple

    def __post_init__(self) -> None:
        names = [s.name for s in self.sky.satellites]
        for k, fault in enumerate(self.faults, 1):
            if fault.satellite is not None and fault.satellite not in names:
                raise ValueError(
                    f"fault {k} ({fault.kind}): {fault.satellite} is not in the sky; there are {', '.join(names)}"
                )

    def __getattr__(self, name: str):
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.sky, name)

    @property
    def genuine(self) -> int:
        """Number of satellites that are what they seem."""
        return len(self.sky.satellites)

    @property
    def spoofers(self) -> tuple[Spoofer, ...]:
        """Those faults that add a signal."""
        return tuple(f for f in self.faults if isinstance(f, Spoofer))

    @property
    def satellites(self) -> tuple[Satellite, ...]:
        """Genuine and counterfeit."""
        real = {s.name: s for s in self.sky.satellites}
        return self.sky.satellites + tuple(
            Counterfeit(s.system, s.prn, s.signal, s.ephemeris, s.cn0_dbhz + f.advantage_db)
            for f in self.spoofers
            for s in [real[f.satellite]]
        )

    def propagate(self, t_s) -> Propagation:
        """As `Sky.propagate`, with the faults; rows as ``satellites``."""
        t = np.atleast_1d(np.asarray(t_s, float))
        clean = self.sky.propagate(t)
        names = [s.name for s in self.sky.satellites]
        copied = [names.index(f.satellite) for f in self.spoofers]
        rows = np.concatenate([np.arange(len(names)), np.array(copied, int)]).astype(int)
        out = replace(clean, **{k: np.array(v)[rows] for k, v in vars(clean).items()})
        added = len(names)
        for fault in self.faults:
            effect = fault.series(t)
            if isinstance(fault, Spoofer):
                _apply(out, added, effect)
                out.visible[added] &= fault.on(t)
                added += 1
                continue
            targets = range(len(names)) if fault.satellite is None else [names.index(fault.satellite)]
            for row in targets:
                _apply(out, row, effect)
        return out

    def fault_truth(self, sample_index, fs_hz: float) -> np.ndarray:
        """FAULT_TRUTH rows at these samples, by sample, then fault."""
        index = np.atleast_1d(np.asarray(sample_index, np.uint64))
        t = index / fs_hz
        out = np.zeros((len(index), len(self.faults)), FAULT_TRUTH)
        out["sample_index"], out["t_s"] = index[:, None], t[:, None]
        for k, fault in enumerate(self.faults):
            code, _, carrier, _, level = fault.series(t)
            out["fault"][:, k], out["kind"][:, k] = k, fault.kind.encode()
            if fault.satellite is not None:
                out["system"][:, k], out["prn"][:, k] = fault.satellite[:1].encode(), int(fault.satellite[1:])
            out["on"][:, k], out["code_m"][:, k], out["carrier_m"][:, k] = fault.on(t), code, carrier
            out["level_db"][:, k] = level
        return out.ravel()


def _apply(out: Propagation, row: int, effect: np.ndarray) -> None:
    code, code_rate, carrier, carrier_rate, level = effect
    out.delay_s[row] += code / C_MPS
    out.delay_rate_s_s[row] += code_rate / C_MPS
    out.phase_delay_s[row] += carrier / C_MPS
    out.phase_delay_rate_s_s[row] += carrier_rate / C_MPS
    out.cn0_dbhz[row] += level


def faulty(sky: Sky, faults: Sequence, duration_s: float) -> Sky | FaultySky:
    """The sky with its faults, the sky itself where there are none.

    Raises ValueError for a satellite that is not in the sky or a fault that would begin after the end.
    """
    if not faults:
        return sky
    for k, fault in enumerate(faults, 1):
        if fault.start_s >= duration_s:
            raise ValueError(
                f"fault {k} ({fault.kind}): start_s = {fault.start_s:g} is not before the scenario's end at {duration_s:g} s"
            )
    return FaultySky(sky, tuple(faults))
