"""Campaigns over recordings: a jammer added to windows of recorded samples at its J/N0, through the whole receiver.

A trial takes a window of a recording, at a place drawn from its seed, adds the jammer and lets a receiver with its live
monitors run over it. Counted are the monitors' tests on every channel; thresholds are those that each channel's monitor
finds by itself. The recording's power per component stands for its noise (``sdr.inject``).
"""

import hashlib
import itertools
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError, model_validator

from monitors.threshold import requirement
from sdr import iffile, inject
from sdr.campaign.spec import (
    MAX_POINTS,
    NAME,
    THRESHOLD,
    Count,
    Length,
    Section,
    Seeds,
    StopSpec,
    empty_trial,
    grid_axes,
    set_key,
    setting_text,
)
from sdr.receiver import Receiver
from sdr.scenario import ReceiverSpec
from signals.frontend import FrontEndSpec
from signals.jammers import JammerSpec
from tracking.channel import STATE_LOCKED

_WINDOW, _JAMMER, _QUANTISER = 0, 1, 2
"""Children of a trial's seed."""


class RecordedFile(Section):
    """One recording; what its metadata say needs no key."""

    file: str = Field(min_length=1, max_length=1000)
    """The samples, or the SigMF base name, from the working directory."""
    format: str | None = None
    """Sample format, e.g. "ci8"."""
    fs_hz: float | None = Field(None, gt=0)
    """Sample rate."""
    if_hz: float | None = None
    """Intermediate frequency."""
    conjugate: bool = False
    """The spectrum is inverted."""
    skip_s: float = Field(0.0, ge=0)
    """Leave out the first seconds."""
    duration_s: float | None = Field(None, gt=0)
    """Use this many seconds."""


class RecordedSpec(Section):
    """A campaign file with ``[[recordings]]`` instead of ``[twin]``."""

    schema_: Annotated[int, Field(alias="schema", ge=1, le=1)] = 1
    """Version of this file's layout."""
    name: str = Field(max_length=100, pattern=NAME)
    """Name of the campaign and of its results file."""
    description: str = ""
    """One sentence for lists."""
    recordings: tuple[RecordedFile, ...] = Field(min_length=1, max_length=1000)
    """The recordings; an axis of the grid of its own."""
    window_s: float = Field(60.0, ge=1.0, le=3600.0)
    """Length of the window that a trial receives; the jammer's times count from its start."""
    jammer: dict[str, Any] = Field(default_factory=dict)
    """One jammer of a scenario, its power as jn0_dbhz or power_dbw; kind "none" for none."""
    grid: dict[str, Any] = Field(default_factory=dict)
    """Dotted key, beginning with jammer., -> list of values; jammer alone -> list of whole jammers."""
    receiver: ReceiverSpec
    """The receiver with its monitors."""
    requirement: str = "APV-I"
    """Aviation requirement whose time to alert holds for the definition event."""
    compare_p_md: float = Field(0.01, gt=0, lt=1)
    """P_MD at which the jammer powers that the monitors need are compared, where power is an axis."""
    seeds: Seeds = Seeds()
    stop: StopSpec = StopSpec(max_trials=5, definition="all")

    @model_validator(mode="after")
    def _check(self):
        if not self.receiver.monitor:
            raise ValueError("a campaign over recordings counts alarms: add [[receiver.monitor]]")
        if self.stop.definition not in ("all", "event"):
            raise ValueError("recordings have no truth: stop.definition is all or event")
        requirement(self.requirement, 0.1)
        return self

    @property
    def monitor(self) -> tuple[Any, ...]:
        """The receiver's monitors, in the place where a campaign has its own."""
        return self.receiver.monitor

    @property
    def method(self) -> Count:
        """Plain counting."""
        return Count()

    @property
    def p_fa_test(self) -> float:
        """Of the first monitor."""
        return self.receiver.monitor[0].p_fa


@dataclass(frozen=True)
class RecordedPoint:
    """A recording and what is added to it."""

    recording: RecordedFile
    jammers: tuple[Any, ...]


class RecordedCampaign:
    """A RecordedSpec with its grid laid out; as ``sdr.campaign.spec.Campaign`` to those who count."""

    live = True

    def __init__(self, spec: RecordedSpec, text: str) -> None:
        self.spec, self.text = spec, text
        axes = grid_axes(spec.grid)
        foreign = [p for p in axes if p.split(".")[0] != "jammer"]
        if foreign:
            raise ValueError(f"grid.{foreign[0]}: over recordings an axis starts with jammer.")
        self.axes = {"recording": [r.file for r in spec.recordings]} | axes
        self.total = math.prod(map(len, self.axes.values()))
        if self.total > MAX_POINTS:
            raise ValueError(f"the grid has {self.total} points; at most {MAX_POINTS} are allowed")
        self.settings = [dict(zip(self.axes, v)) for v in itertools.product(*self.axes.values())]
        every = self.total // len(spec.recordings)
        self.points = [self._point(spec.recordings[i // every], s) for i, s in enumerate(self.settings)]
        self.group, self.quiet = [0] * self.total, [None]
        sizes = [_open(r, spec.window_s).n_samples for r in spec.recordings]
        plain = json.dumps([spec.model_dump(mode="json"), sizes], sort_keys=True)
        self.fingerprint = hashlib.sha256(plain.encode()).hexdigest()[:32]

    def _point(self, recording: RecordedFile, setting: dict[str, Any]) -> RecordedPoint:
        tables = json.loads(json.dumps({"jammer": self.spec.jammer}))
        for path, value in setting.items():
            if path != "recording":
                set_key(tables, path, value)
        jammer, where = tables["jammer"], f"{self.spec.name} ({setting_text(setting)})"
        if not jammer or jammer.get("kind") == "none":
            return RecordedPoint(recording, ())
        try:
            one = TypeAdapter(JammerSpec).validate_python(jammer)
        except ValidationError as err:
            first = err.errors(include_url=False)[0]
            key = ".".join(map(str, first["loc"][1:]))
            raise ValueError(f"{where}: jammer.{key}: {first['msg'].removeprefix('Value error, ')}") from None
        if one.against or (one.line is not None and one.line.follow_doppler):
            raise ValueError(
                f"{where}: the satellites of a recording are not known beforehand: give jammer.jn0_dbhz, and"
                " line.follow_doppler = false"
            )
        return RecordedPoint(recording, (one,))

    def length(self, point: int) -> Length:
        """Trials at most."""
        return Length.model_construct(trials=self.spec.stop.max_trials, epochs=0)

    def live_thresholds(self) -> np.ndarray:
        """THRESHOLD rows that say that every channel found its own."""
        rows = np.zeros(len(self.spec.monitor), THRESHOLD)
        rows["monitor"], rows["rule"] = np.arange(len(rows)), b"live"
        rows["p_fa"] = [m.p_fa for m in self.spec.monitor]
        for name in ("threshold", "low", "high", "roc"):
            rows[name] = np.nan
        return rows


def _open(recording: RecordedFile, window_s: float) -> Any:
    path = Path(recording.file)
    source = iffile.open_recording(path, iffile.declaration(path, recording))
    if not source.complex:
        raise ValueError(f"'{path}' holds real samples: injection works on complex ones")
    if source.n_samples < window_s * source.fs_hz:
        raise ValueError(
            f"'{path}' holds {source.n_samples / source.fs_hz:.1f} s, less than window_s = {window_s:g}"
        )
    return source


class _Window:
    """Samples of a window with the jammer added, quantised to 8 bits: a source for a receiver."""

    def __init__(self, recording: RecordedFile, jammers: tuple[Any, ...], window_s: float, seed: Any) -> None:
        self._source = source = _open(recording, window_s)
        self.fs_hz, self.if_hz = source.fs_hz, source.if_hz
        self.n_samples = round(window_s * source.fs_hz)
        draw = np.random.Generator(np.random.Philox(_child(seed, _WINDOW)))
        self._first = int(draw.integers(0, source.n_samples - self.n_samples + 1))
        self._recorded = inject.Recorded(source, Path(recording.file), _child(seed, _QUANTISER))
        self._runs = [
            j.start(self.fs_hz, self.if_hz, window_s, _child(seed, _JAMMER, k)) for k, j in enumerate(jammers)
        ]
        spec = FrontEndSpec(fs_hz=self.fs_hz, if_hz=self.if_hz, bits=8)
        self._front_end = spec.start(math.sqrt(1.0 + sum(r.rms**2 for r in self._runs)))
        self._at = 0

    def read(self, n: int) -> tuple[int, np.ndarray]:
        """The next slab of at most ``n`` samples."""
        n0, n = self._at, min(n, self.n_samples - self._at)
        iq = self._recorded.read(self._first + n0, n)
        for run in self._runs:
            run.add(iq, n0)
        self._at += n
        return n0, self._front_end(iq) if n else np.zeros((2, 0), np.int8)

    def close(self) -> None:
        """Close the recording."""
        self._source.close()


def _child(seed: np.random.SeedSequence, *numbers: int) -> np.random.SeedSequence:
    return np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, *numbers))


def trial(campaign: RecordedCampaign, point: int, number: int, seed: np.random.SeedSequence) -> np.ndarray:
    """TRIAL rows of one window, a monitor each."""
    spec, p = campaign.spec, campaign.points[point]
    window = _Window(p.recording, p.jammers, spec.window_s, seed)
    receiver = Receiver(spec.receiver, window)
    values: dict[str, list[np.ndarray]] = {m.name: [] for m in spec.monitor}
    cn0: list[float] = []
    locked: dict[str, set[int]] = {"before": set(), "last": set()}
    start_s, stop_s = _times(p, spec.window_s)
    for outcome in receiver:
        for name, rows in outcome.statistics:
            values[name].append(rows)
        now_s = outcome.n_end / window.fs_hz
        for channel, epochs, _ in outcome.epochs:
            good = len(epochs) > 0 and epochs["state"][-1] == STATE_LOCKED
            for when in ("before", "last") if now_s <= start_s else ("last",):
                (locked[when].add if good else locked[when].discard)(channel)
            if start_s <= now_s <= stop_s and good:
                cn0.append(float(epochs["cn0_dbhz"].mean()))
    for monitor in receiver.monitors:
        values[monitor.spec.name] += [r for r in monitor.flush(window.n_samples) if len(r)]
    window.close()
    out = empty_trial(len(spec.monitor), point, number)
    out["cn0_dbhz"] = np.mean(cn0) if cn0 else np.nan
    out["lost"] = bool(locked["before"] - locked["last"])
    tta_s = requirement(spec.requirement, 0.1).time_to_alert_s
    for row, monitor in zip(out, receiver.monitors):
        limits = {(x.signal, x.prn): x.threshold for x in monitor.posts}
        _count(row, values[monitor.spec.name], limits, start_s, stop_s, tta_s, bool(p.jammers))
    return out


def _times(p: RecordedPoint, window_s: float) -> tuple[float, float]:
    if not p.jammers:
        return math.inf, math.inf
    stop_s = p.jammers[0].stop_s
    return p.jammers[0].start_s, window_s if stop_s is None else min(stop_s, window_s)


def _count(row: Any, parts: list[np.ndarray], limits: dict, start_s: float, stop_s: float, tta_s: float, jammed: bool) -> None:  # fmt: skip
    """Tests of every channel; an event is a channel's jam without an alarm until the time to alert after it."""
    rows = np.concatenate(parts) if parts else None
    if rows is None or not len(rows):
        return
    first = []
    row["peak"] = rows["value"].max()
    for (signal, prn), threshold in limits.items():
        mine = rows[(rows["signal"] == signal.encode()) & (rows["prn"] == prn)]
        if threshold is None or not len(mine):
            continue
        alarm = mine["value"] >= threshold
        on = (mine["t_s"] >= start_s) & (mine["t_s"] <= stop_s)
        row["tests"] += len(mine)
        row["alarms"] += np.count_nonzero(alarm)
        row["on_n"] += np.count_nonzero(on)
        row["on_missed"] += np.count_nonzero(on & ~alarm)
        if jammed and on.any():
            met = alarm & (mine["t_s"] >= start_s) & (mine["t_s"] <= stop_s + tta_s)
            row["event_n"] += 1
            row["event_missed"] += not met.any()
            first += (mine["t_s"][met][:1] - start_s).tolist()
    row["hit_n"], row["hit_missed"] = row["on_n"], row["on_missed"]
    if first:
        row["first_alarm_s"] = min(first)
