"""The campaign file and its grid: a trial, its thresholds and its stop rules; what is known of a trial.

A campaign file is the CampaignSpec below as TOML: one base ``[twin]``, one ``[jammer]``, the monitors, and
``[grid]``, whose keys are dotted paths into them and whose values are lists. A trial is a pure function of
``SeedSequence(root, spawn_key=(point, trial))``; training, threshold and evaluation have roots of their own.
Stop rules are evaluated in the order of the trials, so the result does not depend on who computed what when.
"""

import hashlib
import itertools
import json
import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from monitors.batch import start_monitors
from monitors.fft import FftMonitor
from monitors.glrt import GlrtMonitor
from monitors.rare import Importance, Splitting
from monitors.threshold import per_epoch, requirement
from sdr.toml import validate
from sdr.watch.channels import Detector
from signals.modulation import SIGNALS
from tracking.correlator_model import Twin, TwinCW, code_spectrum

MAX_POINTS = 20_000
NAME = r"^[A-Za-z0-9][A-Za-z0-9 ._+-]*$"
"""Names of campaigns become names of files in the working directory."""
CURVE_BINS = 20
"""Bins of P_MD against |df| T, from 0 to 1."""
CURVE_EDGES = np.linspace(0.0, 1.0, CURVE_BINS + 1)
ROC_P_FA = np.array([0.3, 0.1, 0.03, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5])
"""False-alarm probabilities whose thresholds make the receiver operating characteristic."""

TRIAL = np.dtype(
    [
        ("point", "i4"),
        ("trial", "i4"),
        ("monitor", "i4"),
        ("tests", "i8"),  # values of the statistic
        ("alarms", "i8"),  # of them at or above the threshold
        ("on_n", "i8"),  # tests while the jammer is on
        ("on_missed", "i8"),
        ("hit_n", "i8"),  # tests with |df| T <= HIT_LIMIT; of noise jammers all that are on
        ("hit_missed", "i8"),
        ("event_n", "i8"),
        ("event_missed", "i8"),
        ("hazard_n", "i8"),
        ("hazard_missed", "i8"),
        ("curve_n", "i8", (CURVE_BINS,)),
        ("curve_missed", "i8", (CURVE_BINS,)),
        ("roc_missed", "i8", (len(ROC_P_FA),)),  # of hit_n (quiet: of tests), at each threshold of the ROC
        ("estimate", "f8"),  # of a method other than counting
        ("first_alarm_s", "f8"),  # after |df| T < 1 is first entered (noise jammers: after the start)
        ("peak", "f8"),
        ("max_code_error_m", "f8"),
        ("max_smoothed_error_m", "f8"),
        ("undetected_code_error_m", "f8"),  # largest while the monitor was silent
        ("undetected_smoothed_error_m", "f8"),
        ("cn0_dbhz", "f8"),
        ("lost", "?"),  # a cycle slip, or a phase that does not hold
    ]
)
"""One trial as one monitor saw it."""

THRESHOLD = np.dtype(
    [
        ("group", "i4"),
        ("monitor", "i4"),
        ("rule", "S16"),
        ("p_fa", "f8"),
        ("threshold", "f8"),
        ("low", "f8"),
        ("high", "f8"),
        ("n", "i8"),
        ("n_effective", "f8"),
        ("roc", "f8", (len(ROC_P_FA),)),  # thresholds at other P_FA, of points for the ROC; NaN: not known
    ]
)
"""Threshold of one monitor for points that differ in their jammers alone, with the training's 95 % interval."""


class Section(BaseModel):
    """A section of a campaign file."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Seeds(Section):
    """Roots of the three sets of trials; they must differ."""

    training: int = Field(1, ge=0, lt=2**63)
    """Root seed of the training trials."""
    threshold: int = Field(2, ge=0, lt=2**63)
    """Root seed of the threshold trials."""
    evaluation: int = Field(3, ge=0, lt=2**63)
    """Root seed of the evaluated trials."""

    @model_validator(mode="after")
    def _check(self):
        if len({self.training, self.threshold, self.evaluation}) < 3:
            raise ValueError("training, threshold and evaluation seeds must all differ")
        return self


class Length(Section):
    """How many trials of how many integrations."""

    trials: int = Field(20, ge=1, le=100_000)
    """Number of trials."""
    epochs: int = Field(20_000, ge=100, le=10_000_000)
    """Integrations per trial."""


class TrialSpec(Section):
    """One trial of the evaluation."""

    epochs: int = Field(25_000, ge=1, le=10_000_000)
    """Integrations per trial."""
    settle_epochs: int = Field(500, ge=0, le=1_000_000)  # tracked, not tested; t = 0 is at their start
    smooth_s: float = Field(100.0, gt=0)
    """Carrier smoothing of the range error."""
    hazard_m: float = Field(15.0, gt=0)  # on the smoothed range error
    excess_m: float = Field(30.0, gt=0)  # on the raw code error, for the definitions excess and undetected


class StopSpec(Section):
    """When a point is finished: whichever comes first, in trial order."""

    max_trials: int = Field(20, ge=1, le=10_000_000)
    """A point ends after so many trials."""
    errors: int | None = Field(None, ge=1)  # misses (quiet points: false alarms) of every monitor
    relative_error: float | None = Field(None, gt=0, lt=1)  # standard error / rate, of every monitor
    definition: Literal["hit", "all", "event", "hazard", "excess", "undetected"] = "hit"
    """What counts: tests missed near the line (hit) or at all, events, hazards; or per trial a raw code error beyond
    excess_m, whatever the monitors say (excess) or at an epoch without an alarm (undetected)."""
    min_trials: int = Field(2, ge=1)
    """No point ends before so many trials."""


class MonitorSpec(Section):
    """One monitor under test and the rule for its threshold."""

    name: str = Field(min_length=1, max_length=16, pattern=r"^[A-Za-z0-9_.-]+$")
    """Name in the results."""
    detector: Detector
    rule: Literal["gaussian", "empirical", "pareto", "analytic"] = "pareto"
    """How the threshold is found from the quiet statistics."""
    threshold: float | None = None  # given outright: no threshold set is run for it

    @model_validator(mode="after")
    def _check(self):
        analytic = isinstance(self.detector, GlrtMonitor) and self.detector.accumulate_epochs == 1
        if self.rule == "analytic" and not analytic:
            raise ValueError(
                f"monitor '{self.name}': the analytic rule is for a GLRT of single epochs; use pareto"
            )
        return self


class Count(Section):
    """Plain counting."""

    kind: Literal["count"] = "count"


Method = Annotated[Count | Importance | Splitting, Field(discriminator="kind")]
"""How the probability of a point is estimated: counting, or for rare ones something quicker."""


class CampaignSpec(Section):
    """A whole campaign file."""

    schema_: Annotated[int, Field(alias="schema", ge=1, le=1)] = 1
    """Version of this file's layout."""
    name: str = Field(max_length=100, pattern=NAME)
    """Name of the campaign and of its results file."""
    description: str = ""
    """One sentence for lists."""
    loop: Literal["closed", "open"] = "closed"
    """"closed": the twin tracks what it sees; "open": the replica follows the truth."""
    requirement: Literal["NPA", "APV-I", "APV-II"] = "APV-I"
    """Aviation requirement whose probabilities hold where none is given."""
    p_fa: float | None = Field(None, gt=0, lt=0.5)  # per test (or approach); None: the requirement's
    p_fa_per: Literal["epoch", "approach"] = "epoch"
    """Whether P_FA is meant per epoch or per approach."""
    channels: int = Field(8, ge=1, le=1000)  # tested in parallel, for p_fa_per = "approach"
    signal_dbw: float | None = None  # received power, for jammer.power_dbw
    dumps: int = Field(1, ge=1, le=1000)  # integrations of the loops per test
    seeds: Seeds = Seeds()
    method: Method = Count()
    compare_p_md: float = Field(0.01, gt=0, lt=1)
    """P_MD at which the jammer powers that the monitors need are compared, where power is an axis."""
    twin: dict[str, Any]
    """Base settings of the correlator-domain twin."""
    jammer: dict[str, Any] = {}
    """The jammer (kind "CW" or "NBI") with its settings."""
    monitor: tuple[MonitorSpec, ...] = Field(min_length=1, max_length=32)
    grid: dict[str, Any] = {}
    """Dotted key -> list of values; the points are all combinations. The key jammer alone takes whole jammers, of several kinds."""
    trial: TrialSpec = TrialSpec()
    training: Length = Length()
    threshold: Length = Length(trials=40, epochs=25_000)
    stop: StopSpec = StopSpec()
    quiet: Length | None = None  # trials without the jammer that count the real P_FA of the thresholds

    @model_validator(mode="after")
    def _check(self):
        names = [m.name for m in self.monitor]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ValueError(f"two monitors are called '{twice[0]}': names must differ")
        if "jammers" in self.twin:
            raise ValueError("twin.jammers: a campaign has its jammer in [jammer]")
        requirement(self.requirement, self.p_fa)
        self._check_method()
        return self

    def _check_method(self) -> None:
        kind, definition = self.method.kind, self.stop.definition
        if kind == "importance" and self.loop != "open":
            raise ValueError(
                "method importance draws single epochs: set loop = 'open' (splitting goes through loops)"
            )
        if kind == "splitting" and self.loop != "closed":
            raise ValueError("method splitting branches what the loops remember: set loop = 'closed'")
        if kind == "splitting" and definition not in ("event", "excess", "undetected"):
            raise ValueError(
                f"method splitting is for the definitions event, excess and undetected, not {definition!r}"
            )
        if kind == "importance" and definition not in ("hit", "all"):
            raise ValueError(f"method importance is for the definitions hit and all, not {definition!r}")
        if kind == "count" and self.loop == "open" and definition in ("hazard", "excess", "undetected"):
            raise ValueError(f"definition {definition!r} needs tracking errors: set loop = 'closed'")

    @property
    def p_fa_test(self) -> float:
        """False-alarm probability of one test."""
        p_fa = requirement(self.requirement, self.p_fa).p_fa
        if self.p_fa_per == "epoch":
            return p_fa
        return per_epoch(p_fa, float(self.twin["integration_s"]) * self.dumps, self.channels)

    @property
    def time_to_alert_s(self) -> float:
        """Of the requirement set."""
        return requirement(self.requirement, self.p_fa).time_to_alert_s


# -- the grid -----------------------------------------------------------------------------------------------------


def grid_axes(table: dict[str, Any], path: str = "") -> dict[str, list[Any]]:
    """Dotted path -> values; nested tables are paths too."""
    axes: dict[str, list[Any]] = {}
    for key, value in table.items():
        name = f"{path}.{key}" if path else key
        if isinstance(value, dict):
            axes |= grid_axes(value, name)
        elif isinstance(value, list) and value:
            axes[name] = value
        else:
            raise ValueError(
                f"grid.{name}: an axis is a list of one value or more, not {json.dumps(value, default=str)}"
            )
    return axes


def set_key(tables: dict[str, Any], path: str, value: Any) -> None:
    """Set the dotted key ``path`` in nested tables; ValueError where it leads through a value."""
    *parents, last = path.split(".")
    node = tables
    for part in parents:
        node = node.setdefault(part, {})
        if not isinstance(node, dict):
            raise ValueError(f"grid.{path}: '{part}' is not a section")
    node[last] = value


class Campaign:
    """A CampaignSpec with its grid laid out: points, and groups of points that share their thresholds."""

    live = False
    """Whether thresholds are found by a receiver's own monitors (``sdr.campaign.recorded``)."""

    def __init__(self, spec: CampaignSpec, text: str) -> None:
        self.spec, self.text = spec, text
        self.axes = grid_axes(spec.grid)
        foreign = [p for p in self.axes if p.split(".")[0] not in ("twin", "jammer")]
        if foreign:
            raise ValueError(
                f"grid.{foreign[0]}: an axis starts with twin. or jammer. (several monitors are several [[monitor]])"
            )
        self.total = math.prod(map(len, self.axes.values()))
        if self.total > MAX_POINTS:
            raise ValueError(f"the grid has {self.total} points; at most {MAX_POINTS} are allowed")
        self.settings = [
            dict(zip(self.axes, values)) for values in itertools.product(*self.axes.values())
        ]  # fmt: skip
        self.points = [self._twin(i, s) for i, s in enumerate(self.settings)]
        self._check_points()
        keys = [p.model_copy(update={"jammers": ()}).model_dump_json() for p in self.points]
        unique = list(dict.fromkeys(keys))
        self.group = [unique.index(k) for k in keys]
        self.quiet = [Twin.model_validate_json(k) for k in unique]
        if spec.quiet is not None:
            self._add_quiet()
        plain = json.dumps(spec.model_dump(mode="json"), sort_keys=True)
        self.fingerprint = hashlib.sha256(plain.encode()).hexdigest()[:32]

    def _add_quiet(self) -> None:
        """Points without the jammer, one per group, that count false alarms."""
        for group, twin in enumerate(self.quiet):
            setting = self.settings[self.group.index(group)]
            plain = {k: v for k, v in setting.items() if not k.startswith("jammer.")}
            self.points.append(twin)
            self.settings.append(plain | {"jammer.kind": "none"})
            self.group.append(group)

    def length(self, point: int) -> Length:
        """Trials at most, and epochs of each."""
        spec = self.spec
        if spec.quiet is not None and point >= self.total:
            return spec.quiet
        return Length.model_construct(trials=spec.stop.max_trials, epochs=spec.trial.epochs)

    def _twin(self, index: int, setting: dict[str, Any]) -> Twin:
        tables = json.loads(json.dumps({"twin": self.spec.twin, "jammer": self.spec.jammer}))
        for path, value in setting.items():
            set_key(tables, path, value)
        where = f"{self.spec.name}, point {index} ({setting_text(setting)})"
        twin, jammer = tables["twin"], tables["jammer"]
        if twin.get("multipath") == "none":
            twin["multipath"] = None
        if jammer and jammer.get("kind") != "none":
            twin["jammers"] = [self._searched(self._power(jammer, where), twin, where)]
        return validate(Twin, twin, where)

    def _power(self, jammer: dict[str, Any], where: str) -> dict[str, Any]:
        """``power_dbw`` as a ratio to the signal."""
        if "power_dbw" not in jammer:
            return jammer
        if "js_db" in jammer:
            raise ValueError(f"{where}: give the jammer's js_db or power_dbw, not both")
        if self.spec.signal_dbw is None:
            raise ValueError(f"{where}: jammer.power_dbw needs signal_dbw, the power of the signal itself")
        rest = {k: v for k, v in jammer.items() if k != "power_dbw"}
        return rest | {"js_db": jammer["power_dbw"] - self.spec.signal_dbw}

    def _searched(self, jammer: dict[str, Any], twin: dict[str, Any], where: str) -> dict[str, Any]:
        """``bandwidth_hz`` = 0 is a CW; ``search_hz`` puts a CW on the strongest line within that span, and with
        ``cross_hz_s`` lets it cross that line at this rate in the middle of the trial."""
        jammer = dict(jammer)
        if "bandwidth_hz" in jammer and jammer["bandwidth_hz"] == 0:
            del jammer["bandwidth_hz"]
            jammer["kind"] = "CW"
        span_hz, rate_hz_s = jammer.pop("search_hz", None), jammer.pop("cross_hz_s", 0.0)
        if span_hz is None or jammer["kind"] != "CW":
            return jammer
        if jammer.get("freq_hz") is None:
            raise ValueError(f"{where}: jammer.search_hz looks about freq_hz + offset_hz; give freq_hz")
        period_s = SIGNALS[twin["signal"]].code_period_s
        low, high = (
            (jammer["freq_hz"] + jammer.get("offset_hz", 0.0) + d * span_hz) * period_s for d in (-0.5, 0.5)
        )
        k = np.arange(math.ceil(low), math.floor(high) + 1)
        if not len(k):
            raise ValueError(f"{where}: no code line within jammer.search_hz = {span_hz:g} Hz")
        level = np.abs(code_spectrum(twin["signal"], twin["prn"], k, twin.get("waveform")))
        del jammer["freq_hz"]
        middle_s = (self.spec.trial.settle_epochs + 0.5 * self.spec.trial.epochs) * twin["integration_s"]
        move = {"offset_hz": -rate_hz_s * middle_s, "rate_hz_s": rate_hz_s}
        return jammer | {"line": int(k[np.argmax(level)]), **move}

    def _check_points(self) -> None:
        spec = self.spec
        detectors = {m.name: m.detector for m in spec.monitor}
        seen: set[str] = set()
        for i, point in enumerate(self.points):
            key = point.model_dump_json()
            if key in seen:
                raise ValueError(
                    f"{spec.name}: point {i} ({setting_text(self.settings[i])}) repeats an earlier one"
                )
            seen.add(key)
            if spec.loop == "open" and point.dynamics.model_dump() != type(point.dynamics)().model_dump():
                raise ValueError(f"{spec.name}: an open loop has no dynamics; set loop = 'closed'")
            self._check_rare(point, i)
        for twin in {p.model_copy(update={"jammers": ()}).model_dump_json(): p for p in self.points}.values():
            start_monitors(twin, detectors, spec.dumps)

    def _check_rare(self, point: Twin, index: int) -> None:
        """What the quick methods cannot do."""
        spec, where = self.spec, f"{self.spec.name}, point {index} ({setting_text(self.settings[index])})"
        if spec.method.kind == "count":
            return
        memory = [m.name for m in spec.monitor if getattr(m.detector, "accumulate_epochs", 2) > 1]
        memory = [n for n in memory if not isinstance(self.detectors[n], FftMonitor)]
        if memory and spec.stop.definition != "excess":
            raise ValueError(
                f"{where}: method {spec.method.kind} is for monitors of single epochs (FFT, GLRT), not '{memory[0]}'"
            )
        if spec.method.kind == "importance":
            if any(not isinstance(d, GlrtMonitor) for d in self.detectors.values()):
                raise ValueError(f"{where}: method importance is for the GLRT; use splitting or counting")
            jam = point.jammers
            if len(jam) != 1 or not isinstance(jam[0], TwinCW) or jam[0].rate_hz_s or point.multipath:
                raise ValueError(
                    f"{where}: method importance wants one CW of constant frequency and no multipath"
                )
        elif spec.stop.definition == "event" and not any(isinstance(j, TwinCW) for j in point.jammers):
            raise ValueError(f"{where}: the definition event is a pass of a CW over its line")

    @property
    def detectors(self) -> dict[str, Any]:
        """{name: monitor Spec}."""
        return {m.name: m.detector for m in self.spec.monitor}


def empty_trial(monitors: int, point: int, trial: int) -> np.ndarray:
    """TRIAL rows of one trial with nothing known yet."""
    rows = np.zeros(monitors, TRIAL)
    rows["point"], rows["trial"], rows["monitor"] = point, trial, np.arange(monitors)
    for field in TRIAL.names or ():
        if TRIAL[field] == np.float64:
            rows[field] = np.nan
    return rows


def setting_text(setting: dict[str, Any]) -> str:
    """A point's place in the grid, in words."""
    return ", ".join(f"{k} = {v}" for k, v in setting.items()) or "the only point"
