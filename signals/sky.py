"""The sky of a scenario: which satellites, and the delay of each at every reading of the receiver's clock."""

from dataclasses import dataclass, field
from datetime import datetime
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

from signals.atmosphere import RELATIVE_HUMIDITY
from signals.clock import Clock
from signals.constants import C_MPS
from signals.geometry_kernels import propagate_kernel
from signals.orbits import (
    check_ephemeris,
    default_iono_utc,
    nominal_constellation,
    orbit_coefficients,
    quantise_ephemeris,
    seconds_from,
)
from signals.records import EPHEMERIS, PVT_TRUTH
from signals.rinex import read_rinex_nav, select
from signals.timescale import calendar, week_tow
from signals.trajectory import Motion, Range, RangeRun

SIGNAL_SYSTEM = {"L1CA": "G", "E1": "E"}
_MAX_PRN = {"L1CA": 63, "E1": 50}
_FROZEN = ConfigDict(
    frozen=True, extra="forbid", validate_by_name=True, validate_by_alias=True, serialize_by_alias=True
)
_SELECT_STEP_S = 30.0
_SatId = Annotated[str, Field(pattern=r"^[GE]\d\d$")]


class ScriptedSpec(Range):
    """A satellite without an orbit: its delay follows `Range` (+ receiver clock), code and carrier alike."""

    model_config = _FROZEN
    signal: Literal["L1CA", "E1"] = "L1CA"
    """Signal that it transmits."""
    prn: int = Field(ge=1, le=63)
    """Satellite number."""
    cn0_dbhz: float | None = Field(default=None, ge=0.0, le=80.0)
    """C/N0; unset: the sky's."""
    elevation_deg: float = Field(default=45.0, ge=0.0, le=90.0)
    """Elevation in the truth."""
    azimuth_deg: float = Field(default=0.0, ge=0.0, le=360.0)
    """Azimuth in the truth."""


class SatelliteSpec(BaseModel):
    """What differs for one satellite of the constellation."""

    model_config = _FROZEN
    system: Literal["G", "E"]
    """Constellation."""
    prn: int = Field(ge=1, le=63)
    """Satellite number."""
    cn0_dbhz: float | None = Field(default=None, ge=0.0, le=80.0)
    """C/N0 of this satellite; unset: the sky's."""
    health: int | None = Field(default=None, ge=0, le=63)
    """Health in its message; unset: healthy."""


@dataclass(frozen=True)
class Satellite:
    """One row of `Propagation`."""

    system: str
    prn: int
    signal: str
    ephemeris: np.ndarray | None
    """EPHEMERIS record of shape (), None for a scripted satellite."""
    cn0_dbhz: float

    @property
    def name(self) -> str:
        """Identifier such as G05 or E11."""
        return f"{self.system}{self.prn:02d}"


@dataclass(frozen=True)
class Propagation:
    """Truth of S satellites at m readings of the receiver clock; all arrays (S, m) float64 but ``visible``.

    ``delay_s`` is reading minus satellite code time, so the pseudorange is c delay and the chips sent are
    CHIP_RATE (t_r - delay); the carrier phase is -F_L1 phase_delay cycles. Rates are per second of reading.
    """

    delay_s: np.ndarray
    delay_rate_s_s: np.ndarray
    phase_delay_s: np.ndarray
    phase_delay_rate_s_s: np.ndarray
    elevation_rad: np.ndarray
    azimuth_rad: np.ndarray
    range_m: np.ndarray
    cn0_dbhz: np.ndarray
    visible: np.ndarray


class SkySpec(BaseModel):
    """Satellites, their orbits and powers, and the atmosphere of a scenario."""

    model_config = _FROZEN
    start_time: datetime = Field(default=datetime(2024, 3, 1, 12, 0, 0), alias="start")
    """GPS time of the first sample, a whole second, without zone or leap seconds."""
    source: Literal["nominal", "rinex", "none"] = "nominal"
    """Built-in nominal constellations, a RINEX navigation file, or none."""
    path: str | None = None
    """RINEX navigation file (source "rinex"). Of each satellite the record valid at the start counts: later data sets on
    air are its orbit under new issues."""
    signals: tuple[Literal["L1CA", "E1"], ...] = ("L1CA", "E1")
    """Signals in the air."""
    elevation_mask_deg: float = Field(default=5.0, ge=0.0, lt=90.0)
    """Satellites below this elevation are left out."""
    max_satellites: int | None = Field(default=None, ge=1, le=128)
    """The highest so many are taken; unset: all."""
    prns: tuple[_SatId, ...] | None = None
    """Only these satellites, e.g. ["G05", "E11"]; unset: all."""
    unhealthy: tuple[_SatId, ...] = ()
    """Satellites whose message says unhealthy."""
    cn0_dbhz: float = Field(default=45.0, ge=0.0, le=80.0)
    """C/N0 of the whole signal at the antenna port."""
    cn0_model: Literal["constant", "elevation"] = "constant"
    """The same for all, or falling with elevation."""
    cn0_drop_db: float = Field(default=10.0, ge=0.0, le=40.0)
    """Loss at the horizon (cn0_model "elevation")."""
    satellite: tuple[SatelliteSpec, ...] = ()
    scripted: tuple[ScriptedSpec, ...] = ()
    ionosphere: Literal["klobuchar", "none"] = "klobuchar"
    """Ionosphere of the truth."""
    troposphere: Literal["saastamoinen", "none"] = "saastamoinen"
    """Troposphere of the truth."""
    codes_path: str | None = None
    """Another table of the Galileo E1 primary codes (CSV, or the directory that holds it) than the one shipped."""

    @field_validator("start_time")
    @classmethod
    def _whole_second(cls, value: datetime) -> datetime:
        week_tow(value)
        return value

    def start(self, motion: Motion, clock: Clock, duration_s: float, seed=0) -> "Sky":
        """Choose the satellites that rise above the mask within [0, duration_s] and make their `Sky`.

        ``seed`` (int or SeedSequence) is used for the random Dopplers of scripted satellites only.

        Raises
        ------
        ValueError
            No satellite left, a satellite named that the source does not hold, or a PRN without a code.
        """
        week, tow_s = week_tow(self.start_time)
        ephemerides, iono_utc = self._load(week, tow_s)
        ephemerides = self._named(ephemerides)
        check_ephemeris(ephemerides)
        scripts = self._scripts(np.random.SeedSequence(seed) if isinstance(seed, int) else seed)
        sky = Sky(self, motion, clock, week, tow_s, iono_utc, self._rows(ephemerides), scripts)
        sky = sky.only(self._chosen(sky, duration_s))
        if not sky.satellites:
            raise ValueError(
                f"no satellite of {', '.join(self.signals)} rises above {self.elevation_mask_deg:g} deg:"
                " lower elevation_mask_deg, or allow more signals or prns"
            )
        return sky

    def _scripts(self, seeds: np.random.SeedSequence) -> dict[str, tuple[ScriptedSpec, RangeRun]]:
        """Started ranges by satellite name; each satellite has its own child seed."""
        out = {}
        for i, s in enumerate(self.scripted):
            child = np.random.SeedSequence(seeds.entropy, spawn_key=(*seeds.spawn_key, i))
            out[f"{SIGNAL_SYSTEM[s.signal]}{s.prn:02d}"] = (s, s.start_range(child))
        return out

    def _load(self, week: int, tow_s: int) -> tuple[np.ndarray, np.ndarray]:
        """Ephemerides of the wanted systems at the start, and the IONO_UTC record."""
        systems = [s for s in "GE" if s in {SIGNAL_SYSTEM[signal] for signal in self.signals}]
        if self.source == "rinex":
            return self._load_rinex(systems, week, tow_s)
        parts = [nominal_constellation(s, week, tow_s) for s in systems if self.source == "nominal"]
        return np.concatenate([np.zeros(0, EPHEMERIS), *parts]), default_iono_utc(week, tow_s)

    def _load_rinex(self, systems: list[str], week: int, tow_s: int) -> tuple[np.ndarray, np.ndarray]:
        if self.path is None:
            raise ValueError('sky.path is missing: source = "rinex" needs the path of a navigation file')
        records, iono_utc = read_rinex_nav(self.path)
        prns = sorted({int(prn) for prn in records["prn"]})
        found = [select(records, s, prn, week, tow_s) for s in systems for prn in prns]
        rows = [record for record in found if record is not None]
        if not rows:
            toe = [calendar(r["week"], r["toe_s"]) for r in records]
            raise ValueError(
                f"{self.path} has no ephemeris of {', '.join(self.signals)} valid at"
                f" {self.start_time.isoformat()}: its reference times are {min(toe)} to {max(toe)}"
            )
        return quantise_ephemeris(np.array(rows)), iono_utc

    def _named(self, ephemerides: np.ndarray) -> np.ndarray:
        """Keep ``prns``, apply the healths, refuse names that are not there."""
        out = ephemerides.copy()
        names = np.array([f"{e['system'].decode()}{e['prn']:02d}" for e in out], dtype="U3")
        asked = [*(self.prns or ()), *self.unhealthy, *(f"{s.system}{s.prn:02d}" for s in self.satellite)]
        for name in asked:
            if name not in names:
                raise ValueError(
                    f"satellite {name} is not in the {self.source} sky at the start: leave it out"
                )
        for name in self.unhealthy:
            out["health"][names == name] = 63 if name[0] == "G" else 2
        for spec in self.satellite:
            if spec.health is not None:
                out["health"][names == f"{spec.system}{spec.prn:02d}"] = spec.health
        return out if self.prns is None else out[np.isin(names, self.prns)]

    def _rows(self, ephemerides: np.ndarray) -> tuple[Satellite, ...]:
        own = {(s.system, s.prn): s.cn0_dbhz for s in self.satellite if s.cn0_dbhz is not None}
        signal = {SIGNAL_SYSTEM[s]: s for s in self.signals}
        rows = []
        for eph in ephemerides:
            system, prn = eph["system"].decode(), int(eph["prn"])
            if not 1 <= prn <= _MAX_PRN[signal[system]]:
                raise ValueError(
                    f"PRN {prn} has no {signal[system]} code: allowed are 1 to {_MAX_PRN[signal[system]]}"
                )
            rows.append(
                Satellite(system, prn, signal[system], eph.reshape(()), own.get((system, prn), self.cn0_dbhz))
            )
        for s in self.scripted:
            if s.prn > _MAX_PRN[s.signal]:
                raise ValueError(f"PRN {s.prn} has no {s.signal} code: allowed are 1 to {_MAX_PRN[s.signal]}")
            cn0 = self.cn0_dbhz if s.cn0_dbhz is None else s.cn0_dbhz
            rows.append(Satellite(SIGNAL_SYSTEM[s.signal], s.prn, s.signal, None, cn0))
        names = [row.name for row in rows]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"satellite {name} appears twice: leave it out of prns or of scripted")
        return tuple(rows)

    def _chosen(self, sky: "Sky", duration_s: float) -> np.ndarray:
        """Indices of the satellites seen at any time; the highest ones where ``max_satellites`` is set."""
        t = np.linspace(0.0, duration_s, max(2, int(np.ceil(duration_s / _SELECT_STEP_S)) + 1))
        seen = sky.propagate(t)
        highest = np.where(seen.visible, seen.elevation_rad, -np.inf).max(axis=1)
        index = np.flatnonzero(highest > -np.inf)
        if self.max_satellites is not None:
            index = np.sort(index[np.argsort(-highest[index], kind="stable")[: self.max_satellites]])
        return index


@dataclass(frozen=True)
class Sky:
    """Run of a sky; `propagate` is a pure function, so any chunking gives the same bits."""

    spec: SkySpec
    motion: Motion
    clock: Clock
    week: int
    tow_s: int
    iono_utc: np.ndarray
    """IONO_UTC record of shape (), one for both constellations."""
    satellites: tuple[Satellite, ...]
    """Those with an orbit first, then the scripted ones."""
    scripts: dict[str, tuple[ScriptedSpec, RangeRun]]
    _orbits: dict[str, Any] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        with_orbit = [s.ephemeris for s in self.satellites if s.ephemeris is not None]
        eph = np.array(with_orbit, dtype=EPHEMERIS)
        # GST - GPS: a Galileo satellite's clock is set to GST, which reads GPS time + GGTO.
        ggto = np.where(eph["system"] == b"E", self.iono_utc["a0g_s"], 0.0)
        orbits = {
            "k": orbit_coefficients(eph) if eph.size else np.zeros((0, 19)),
            "toe": seconds_from(eph, "toe_s", self.week, self.tow_s),
            "toc": seconds_from(eph, "toc_s", self.week, self.tow_s),
            "offset": eph["tgd_s"] - ggto,
        }
        object.__setattr__(self, "_orbits", orbits)

    def only(self, index) -> "Sky":
        """The same sky with the satellites of ``index`` alone."""
        rows = tuple(self.satellites[i] for i in index)
        return Sky(
            self.spec, self.motion, self.clock, self.week, self.tow_s, self.iono_utc, rows, self.scripts
        )

    def propagate(self, t_s) -> Propagation:
        """Delays at readings ``t_s`` (m,) of the receiver's clock, seconds since the start epoch.

        delay = bias + rho / c + I + T - dt_sv + TGD - GGTO (phase_delay: -I): a receiver that applies the
        broadcast clock, dt_sv - TGD, is left with none of it. rho is the light-time solution in the inertial
        frame. Sagnac, clock, relativity included; < 1e-6 m numerically.
        """
        t_r = np.atleast_1d(np.asarray(t_s, float))
        bias, drift = self.clock(t_r)
        t = t_r - bias
        out = np.concatenate([self._from_orbits(t), self._from_scripts(t)], axis=1)
        delay, rate, iono, iono_rate, elevation, azimuth, range_m, _ = out
        # True time runs at 1 - drift of the reading.
        slow = 1.0 - drift
        delay, rate, iono_rate = delay + bias, rate * slow + drift, iono_rate * slow
        cn0 = self._cn0_dbhz(elevation)
        visible = elevation >= np.radians(self.spec.elevation_mask_deg)
        visible[self._orbits["k"].shape[0] :] = True
        return Propagation(
            delay, rate, delay - 2.0 * iono, rate - 2.0 * iono_rate, elevation, azimuth, range_m, cn0, visible
        )

    def receiver(self, t_s) -> np.ndarray:
        """PVT_TRUTH (m,) at readings ``t_s`` of the receiver's clock; sample_index is left 0."""
        t_r = np.atleast_1d(np.asarray(t_s, float))
        bias, drift = self.clock(t_r)
        state = self.motion(t_r - bias)
        out = np.zeros(t_r.size, PVT_TRUTH)
        out["t_s"], out["clock_bias_s"], out["clock_drift_s_s"] = t_r, bias, drift
        out["pos_ecef_m"], out["vel_ecef_mps"] = state.pos_ecef_m, state.vel_ecef_mps
        return out

    def _from_orbits(self, t: np.ndarray) -> np.ndarray:
        o, iono = self._orbits, self.iono_utc
        out = np.zeros((8, o["k"].shape[0], t.size))
        if out.size == 0:
            return out
        state = self.motion(t)
        propagate_kernel(
            o["k"], o["toe"], o["toc"], o["offset"], t,
            np.ascontiguousarray(state.pos_ecef_m), np.ascontiguousarray(state.vel_ecef_mps),
            float(self.tow_s),
            self.spec.ionosphere == "klobuchar",
            np.array(iono["alpha"], dtype=float), np.array(iono["beta"], dtype=float),
            self.spec.troposphere == "saastamoinen", RELATIVE_HUMIDITY, out,
        )  # fmt: skip
        return out

    def _from_scripts(self, t: np.ndarray) -> np.ndarray:
        rows = [i for i, s in enumerate(self.satellites) if s.ephemeris is None]
        out = np.zeros((8, len(rows), t.size))
        for row, i in enumerate(rows):
            spec, run = self.scripts[self.satellites[i].name]
            out[0, row], out[1, row], _ = run(t)
            out[4, row], out[5, row] = np.radians(spec.elevation_deg), np.radians(spec.azimuth_deg)
            out[6, row] = C_MPS * out[0, row]
        return out

    def _cn0_dbhz(self, elevation: np.ndarray) -> np.ndarray:
        """Constant, or falling from the zenith: cn0 - drop (1 - sin el)^2 (assumed antenna pattern)."""
        level = np.array([s.cn0_dbhz for s in self.satellites])[:, None]
        if self.spec.cn0_model == "constant":
            return np.broadcast_to(level, elevation.shape).copy()
        return level - self.spec.cn0_drop_db * (1.0 - np.sin(np.maximum(elevation, 0.0))) ** 2
