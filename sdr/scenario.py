"""The scenario: one typed TOML file that says what is in the air, what the receiver does and what is watched.

A scenario is the union of the Specs that the packages own; there is no second schema. A misspelt, missing or
out-of-range key is refused with the key, the value and what is allowed.
"""

import threading
from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from nav.imu import (
    BarometerSpec,
    ImuSpec,
    OdometerSpec,
    simulate_barometer,
    simulate_imu,
    simulate_odometer,
)
from nav.navigator import NavigationSpec
from nav.sensor_files import read_barometer, read_imu, read_odometer
from nav.steering import Sensors
from nav.ultratight import SteeringSpec
from sdr import toml
from sdr.integrity import IntegritySpec
from sdr.respond import RespondSpec
from sdr.watch.channels import WatchSpec
from signals.clock import ClockSpec
from signals.faults import FaultSpec, faulty
from signals.frontend import FrontEndSpec
from signals.jammers import JammerRun, JammerSpec
from signals.modulation import SIGNALS
from signals.multipath import EchoRun, MultipathSpec
from signals.sky import Sky, SkySpec
from signals.source import CELLS_PER_S, SyntheticSource
from signals.trajectory import MotionSpec, Recorded, Static
from tracking.acquisition import AcquisitionSpec
from tracking.channel import TrackingSpec
from tracking.mitigation import MitigationSpec

SCHEMA = 1


class ReceiverSpec(BaseModel):
    """Section ``[receiver]``: everything between the samples and the position."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    acquisition: AcquisitionSpec = AcquisitionSpec()
    tracking: TrackingSpec = TrackingSpec()
    navigation: NavigationSpec = NavigationSpec()
    mitigation: MitigationSpec | None = None
    steering: SteeringSpec = SteeringSpec()
    codes_path: str | None = None
    """Another table of the Galileo E1 primary codes (CSV, or the directory that holds it) than the one shipped."""
    slab_ms: Annotated[int, Field(ge=20, le=1000, multiple_of=20)] = 200
    """Longest slab of samples that passes through the loop at once; the results hardly depend on it."""
    search_every_s: Annotated[float, Field(gt=0)] = 5.0
    """All satellites are searched again this often while too few are tracked."""
    search_one_every_s: Annotated[float, Field(gt=0)] = 10.0
    """Later, one satellite in turn is searched this often."""
    monitor: tuple[WatchSpec, ...] = ()
    """Monitors on the live correlator outputs."""
    integrity: IntegritySpec | None = None
    """Monitors on the ranges and on the filter's innovations."""
    respond: RespondSpec = RespondSpec()
    """What the integrity monitors may do."""

    @model_validator(mode="after")
    def _monitors(self) -> "ReceiverSpec":
        self.respond.check(self.integrity, self.navigation.smoothing_window_s)
        names = [m.name for m in self.monitor]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ValueError(f"two monitors are called '{twice[0]}': names must differ")
        missing = [n for n in self.respond.weaken if n not in names]
        if missing:
            raise ValueError(
                f"receiver.respond.weaken wants an answer of '{missing[0]}', which is off: add [[receiver.monitor]] of that name"
            )
        loops = {"G": ("l1ca", self.tracking.l1ca), "E": ("e1", self.tracking.e1)}
        watched = {SIGNALS[s].system for m in self.monitor if not m.of_front_end for s in m.signals}
        for system in self.acquisition.systems:
            section, spec = loops[system]
            if system in watched and spec.taps is None:
                raise ValueError(
                    f"monitors need a window of taps: give receiver.tracking.{section}.taps = {{ count = 35, "
                    "spacing_chips = 0.65 } or the like, or name the signals they watch"
                )
        return self


class SensorsSpec(BaseModel):
    """Section ``[sensors]``: what is mounted beside the antenna; simulated from the motion, or read from CSV files."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    imu: ImuSpec = ImuSpec()
    odometer: OdometerSpec | None = None
    barometer: BarometerSpec | None = None


class Scenario(BaseModel):
    """A whole scenario file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_: Annotated[int, Field(alias="schema", ge=SCHEMA, le=SCHEMA)] = SCHEMA
    """Version of this file's layout."""
    name: Annotated[str, Field(min_length=1, max_length=100)]
    """Name of the scenario and of its results file."""
    description: str = ""
    """One sentence for lists."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
    """Root of every random number; each part has a child of it."""
    duration_s: Annotated[float, Field(gt=0, le=86_400)]
    """Length of the run."""
    sky: SkySpec = SkySpec()
    motion: Annotated[MotionSpec, Field(discriminator="kind")] = Static()
    clock: ClockSpec = ClockSpec()
    front_end: FrontEndSpec = FrontEndSpec()
    jammer: tuple[JammerSpec, ...] = ()
    multipath: MultipathSpec | None = None
    fault: tuple[FaultSpec, ...] = ()
    sensors: SensorsSpec | None = None
    receiver: ReceiverSpec = ReceiverSpec()


NOISE, CLOCK, SKY, JAMMERS, MULTIPATH, SENSORS = range(6)
"""Every random part of a scenario has a child seed of its own: changing one part leaves the others' bits alone."""


def source(spec: Scenario, threads: int = 1) -> SyntheticSource:
    """The samples of a scenario."""
    motion = spec.motion.start(spec.duration_s)
    clock = spec.clock.start(_child(spec, CLOCK), spec.duration_s, motion)
    sky = spec.sky.start(motion, clock, spec.duration_s, _child(spec, SKY))
    return SyntheticSource(
        faulty(sky, spec.fault, spec.duration_s), spec.front_end, spec.duration_s, _child(spec, NOISE),
        jammers=jammers(spec, spec.front_end.fs_hz, spec.front_end.if_hz, spec.front_end.complex, sky),
        echoes=echoes(spec, [s.name for s in sky.satellites]), threads=threads, code_path=spec.sky.codes_path,
    )  # fmt: skip


def sensors(spec: Scenario) -> Sensors | None:
    """The scenario's IMU and odometer, simulated from its motion; None where it has no ``[sensors]``."""
    if spec.sensors is None:
        return None
    motion = spec.motion.start(spec.duration_s)
    fs_hz, span_s = spec.front_end.fs_hz, spec.duration_s
    imu = simulate_imu(motion, spec.sensors.imu, _child(spec, SENSORS, 0), span_s, fs_hz)[0]
    odometer = None
    if spec.sensors.odometer is not None:
        odometer, _ = simulate_odometer(
            motion, spec.sensors.odometer, _child(spec, SENSORS, 1), span_s, fs_hz
        )
    barometer = None
    if spec.sensors.barometer is not None:
        barometer, _ = simulate_barometer(
            motion, spec.sensors.barometer, _child(spec, SENSORS, 2), span_s, fs_hz
        )
    return Sensors(spec.sensors.imu, spec.sensors.odometer, imu, odometer, spec.sensors.barometer, barometer)


def read_sensors(
    name: str | None,
    overrides: Sequence[str],
    imu: Path | None,
    odometer: Path | None,
    barometer: Path | None,
    source: Any,
) -> Sensors | None:
    """Recorded sensors of a recording; their noise is that of the scenario's ``[sensors]``, or the default grades."""
    if imu is None:
        if odometer is not None:
            raise ValueError("--odometer needs --imu as well: the reduced system takes its turns from a gyro")
        if barometer is not None:
            raise ValueError("--barometer needs --imu as well: it carries the height of an inertial system")
        return None
    spec = load(name, overrides)[0].sensors if name is not None else None
    spec = spec or SensorsSpec()
    duration_s = source.n_samples / source.fs_hz
    rows = read_imu(imu, source.fs_hz, duration_s)
    speeds = None if odometer is None else read_odometer(odometer, source.fs_hz, duration_s)
    heights = None if barometer is None else read_barometer(barometer, source.fs_hz, duration_s)
    return Sensors(
        spec.imu,
        None if speeds is None else spec.odometer or OdometerSpec(),
        rows,
        speeds,
        None if heights is None else spec.barometer or BarometerSpec(),
        heights,
    )


def jammers(spec: Scenario, fs_hz: float, if_hz: float, is_complex: bool, sky: Sky | None) -> list[JammerRun]:
    """The scenario's jammers, each with its own seed, in samples of this rate."""
    runs = []
    for k, one in enumerate(spec.jammer):
        if one.start_s >= spec.duration_s:
            raise ValueError(
                f"jammer {k + 1} ({one.kind}): start_s = {one.start_s:g} is not before the end at {spec.duration_s:g} s:"
                " start it earlier, make the run longer, or leave it out"
            )
        try:
            seed = _child(spec, JAMMERS, k)
            runs.append(
                one.start(fs_hz, if_hz, spec.duration_s, seed, sky, is_complex, open_recording=_interferer)
            )
        except ValueError as err:
            raise ValueError(f"jammer {k + 1} ({one.kind}): {err}") from None
    return runs


def echoes(spec: Scenario, names: Sequence[str]) -> dict[str, EchoRun]:
    """The echoes of the satellites, by name; each satellite has its own seed."""
    if spec.multipath is None:
        return {}
    wanted = names if spec.multipath.satellites is None else spec.multipath.satellites
    missing = [n for n in wanted if n not in names]
    if missing:
        raise ValueError(
            f"multipath.satellites: {missing[0]} is not in the sky; there are {', '.join(names)}"
        )
    runs = {n: spec.multipath.start(_child(spec, MULTIPATH, ord(n[0]), int(n[1:]))) for n in wanted}
    for run in runs.values():
        run.check(spec.duration_s, 1.0 / CELLS_PER_S)
    return runs


def _interferer(path: str, fs_hz: float) -> tuple[Callable[[int, int], np.ndarray], int]:
    """Random access to a recording as interferer: reader(n0, n) -> float32 (2, n) at zero frequency, and its length."""
    from sdr import iffile

    path = _shipped(path)
    file = iffile.open_recording(path, iffile.declaration(path))
    if abs(file.fs_hz - fs_hz) > 1e-9 * fs_hz:
        raise ValueError(
            f"'{path}' has a rate of {file.fs_hz:g} Hz and the scenario one of {fs_hz:g}: an interferer must have the"
            " same rate; resample it"
        )
    if not file.complex:
        raise ValueError(f"'{path}' holds real samples: an interferer must be complex")
    lock = threading.Lock()

    def read(n0: int, n: int) -> np.ndarray:
        with lock:
            x = file.read_at(n0, n)[1].astype(np.float32)
        if not file.if_hz:
            return x
        turns = np.mod(np.arange(n0, n0 + n) * (file.if_hz / fs_hz), 1.0)
        z = (x[0] + 1j * x[1]) * np.exp(-2j * np.pi * turns)
        return np.stack([z.real, z.imag]).astype(np.float32)

    return read, file.n_samples


def _shipped(path: str) -> str:
    """The file of that name that comes with the built-in scenarios, unless there is one here."""
    shipped = Path(str(files("sdr") / "scenarios")) / Path(path).name
    return str(shipped) if not Path(path).exists() and path == shipped.name and shipped.exists() else path


def _child(spec: Scenario, *part: int) -> np.random.SeedSequence:
    return np.random.SeedSequence(spec.seed, spawn_key=part)


def load(name_or_path: str, overrides: Sequence[str] = ()) -> tuple[Scenario, str]:
    """Read a scenario by built-in name or by path; return it with its text.

    ``overrides`` are ``key=value`` with the dotted path of the key; they are appended to the text as comments, so that
    a stored scenario says how it was run. Raises ValueError with one sentence for anything that is not valid.
    """
    text = toml.read(name_or_path, "scenario")
    return parse(text, name_or_path, overrides), _with_overrides(text, overrides)


def receiver_only(overrides: Sequence[str] = ()) -> tuple[ReceiverSpec, str]:
    """The default receiver with ``receiver.*`` overrides, for recordings; and its text."""
    table: dict[str, Any] = {}
    toml.override(table, overrides)
    foreign = sorted(set(table) - {"receiver"})
    if foreign:
        raise ValueError(
            f"--set {foreign[0]}...: a recording is received with [receiver] alone; allowed: receiver.*"
        )
    return toml.validate(ReceiverSpec, table.get("receiver", {}), "receiver"), _with_overrides("", overrides)


def _with_overrides(text: str, overrides: Sequence[str]) -> str:
    return text + "".join(f"\n# --set {o}" for o in overrides)


def parse(text: str, origin: str = "scenario", overrides: Sequence[str] = ()) -> Scenario:
    """Build a :class:`Scenario` from TOML text; ``origin`` names it in errors."""
    spec = toml.validate(Scenario, toml.table(text, origin, overrides), origin)
    if isinstance(spec.motion, Recorded):
        motion = spec.motion.model_copy(update={"path": _shipped(spec.motion.path)})
        return spec.model_copy(update={"motion": motion})
    return spec
