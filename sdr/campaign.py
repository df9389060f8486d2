"""Campaigns: a grid of settings times many trials of the twin, counted into P_MD, P_FA and tracking error.

A campaign file is the CampaignSpec below as TOML: one base ``[twin]``, one ``[jammer]``, the monitors, and
``[grid]``, whose keys are dotted paths into them and whose values are lists. A trial is a pure function of
``SeedSequence(root, spawn_key=(point, trial))``; training, threshold and evaluation have roots of their own.
Stop rules are evaluated in the order of the trials, so the result does not depend on who computed what when.
"""

import hashlib
import itertools
import json
import math
import tomllib
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from monitors.batch import line_offset_hz, start_monitors, sum_dumps, trial_seed
from monitors.detection import (
    HIT_LIMIT,
    Rate,
    clopper_pearson,
    cluster_rate,
    p_md_event,
    p_md_hazard,
    rate,
)
from monitors.fft import FftMonitor
from monitors.glrt import GlrtMonitor
from monitors.multichannel_ar import MultichannelAr
from monitors.threshold import AnalyticNull, EmpiricalNull, GaussianNull, ParetoNull, per_epoch, requirement
from sdr.scenario import validate
from sdr.watch import Detector, one_blas_thread
from signals.constants import METRES_PER_CHIP, WAVELENGTH_M
from signals.modulation import SIGNALS
from tracking.correlator_model import Twin, TwinCW, TwinNBI, code_spectrum
from tracking.twin_kernels import hatch_smooth

MAX_POINTS = 20_000
MAX_FILE_BYTES = 1 << 20
CURVE_BINS = 20
"""Bins of P_MD against |df| T, from 0 to 1."""
CURVE_EDGES = np.linspace(0.0, 1.0, CURVE_BINS + 1)

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
    ]
)
"""Threshold of one monitor for points that differ in their jammers alone, with the training's 95 % interval."""

_COUNTED = {"hit": "hit", "all": "on", "event": "event", "hazard": "hazard"}


class _Spec(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Seeds(_Spec):
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


class Length(_Spec):
    """How many trials of how many integrations."""

    trials: int = Field(20, ge=1, le=100_000)
    """Number of trials."""
    epochs: int = Field(20_000, ge=100, le=10_000_000)
    """Integrations per trial."""


class TrialSpec(_Spec):
    """One trial of the evaluation."""

    epochs: int = Field(25_000, ge=1, le=10_000_000)
    """Integrations per trial."""
    settle_epochs: int = Field(500, ge=0, le=1_000_000)  # tracked, not tested; t = 0 is at their start
    smooth_s: float = Field(100.0, gt=0)
    """Carrier smoothing of the range error."""
    hazard_m: float = Field(15.0, gt=0)  # on the smoothed range error


class StopSpec(_Spec):
    """When a point is finished: whichever comes first, in trial order."""

    max_trials: int = Field(20, ge=1, le=10_000_000)
    """A point ends after so many trials."""
    errors: int | None = Field(None, ge=1)  # misses (quiet points: false alarms) of every monitor
    relative_error: float | None = Field(None, gt=0, lt=1)  # standard error / rate, of every monitor
    definition: Literal["hit", "all", "event", "hazard"] = "hit"
    """Which misses count: with the line near (hit), all, per event, or hazardous ones."""
    min_trials: int = Field(2, ge=1)
    """No point ends before so many trials."""


class MonitorSpec(_Spec):
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


class CampaignSpec(_Spec):
    """A whole campaign file."""

    schema_: Annotated[int, Field(alias="schema", ge=1, le=1)] = 1
    """Version of this file's layout."""
    name: str = Field(min_length=1, max_length=100)
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
    twin: dict[str, Any]
    """Base settings of the correlator-domain twin."""
    jammer: dict[str, Any] = {}
    """The jammer (kind "CW" or "NBI") with its settings."""
    monitor: tuple[MonitorSpec, ...] = Field(min_length=1, max_length=32)
    grid: dict[str, Any] = {}
    """Dotted key -> list of values; the points are all combinations."""
    trial: TrialSpec = TrialSpec()
    training: Length = Length()
    threshold: Length = Length(trials=40, epochs=25_000)
    stop: StopSpec = StopSpec()

    @model_validator(mode="after")
    def _check(self):
        names = [m.name for m in self.monitor]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ValueError(f"two monitors are called '{twice[0]}': names must differ")
        if "jammers" in self.twin:
            raise ValueError("twin.jammers: a campaign has its jammer in [jammer]")
        requirement(self.requirement, self.p_fa)
        return self

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


def _axes(table: dict[str, Any], path: str = "") -> dict[str, list[Any]]:
    """Dotted path -> values; nested tables are paths too."""
    axes: dict[str, list[Any]] = {}
    for key, value in table.items():
        name = f"{path}.{key}" if path else key
        if isinstance(value, dict):
            axes |= _axes(value, name)
        elif isinstance(value, list) and value:
            axes[name] = value
        else:
            raise ValueError(
                f"grid.{name}: an axis is a list of one value or more, not {json.dumps(value, default=str)}"
            )
    return axes


def _set(tables: dict[str, Any], path: str, value: Any) -> None:
    *parents, last = path.split(".")
    node = tables
    for part in parents:
        node = node.setdefault(part, {})
        if not isinstance(node, dict):
            raise ValueError(f"grid.{path}: '{part}' is not a section")
    node[last] = value


class Campaign:
    """A CampaignSpec with its grid laid out: points, and groups of points that share their thresholds."""

    def __init__(self, spec: CampaignSpec, text: str) -> None:
        self.spec, self.text = spec, text
        self.axes = _axes(spec.grid)
        foreign = [p for p in self.axes if p.split(".")[0] not in ("twin", "jammer")]
        if foreign:
            raise ValueError(
                f"grid.{foreign[0]}: an axis starts with twin. or jammer. (several monitors are several [[monitor]])"
            )
        total = math.prod(map(len, self.axes.values()))
        if total > MAX_POINTS:
            raise ValueError(f"the grid has {total} points; at most {MAX_POINTS} are allowed")
        self.settings = [
            dict(zip(self.axes, values)) for values in itertools.product(*self.axes.values())
        ]  # fmt: skip
        self.points = [self._twin(i, s) for i, s in enumerate(self.settings)]
        self._check_points()
        keys = [p.model_copy(update={"jammers": ()}).model_dump_json() for p in self.points]
        unique = list(dict.fromkeys(keys))
        self.group = [unique.index(k) for k in keys]
        self.quiet = [Twin.model_validate_json(k) for k in unique]
        plain = json.dumps(spec.model_dump(mode="json"), sort_keys=True)
        self.fingerprint = hashlib.sha256(plain.encode()).hexdigest()[:32]

    def _twin(self, index: int, setting: dict[str, Any]) -> Twin:
        tables = json.loads(json.dumps({"twin": self.spec.twin, "jammer": self.spec.jammer}))
        for path, value in setting.items():
            _set(tables, path, value)
        label = _label(setting) or "the only point"
        where = f"{self.spec.name}, point {index} ({label})"
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
                    f"{spec.name}: point {i} ({_label(self.settings[i])}) repeats an earlier one"
                )
            seen.add(key)
            if spec.loop == "open" and point.dynamics.model_dump() != type(point.dynamics)().model_dump():
                raise ValueError(f"{spec.name}: an open loop has no dynamics; set loop = 'closed'")
        for twin in {p.model_copy(update={"jammers": ()}).model_dump_json(): p for p in self.points}.values():
            start_monitors(twin, detectors, spec.dumps)

    @property
    def detectors(self) -> dict[str, Any]:
        """{name: monitor Spec}."""
        return {m.name: m.detector for m in self.spec.monitor}


def _label(setting: dict[str, Any]) -> str:
    return ", ".join(f"{k} = {v}" for k, v in setting.items())


def load(name_or_path: str, overrides: tuple[str, ...] = ()) -> Campaign:
    """Read a campaign by built-in name or by path; ValueError with one sentence for anything not valid."""
    from sdr.scenario import _apply

    text = _text(name_or_path)
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as err:
        raise ValueError(f"{name_or_path} is not valid TOML: {err}") from None
    _apply(table, overrides)
    return from_table(table, name_or_path)


def _text(name_or_path: str) -> str:
    path = Path(name_or_path)
    if path.suffix != ".toml" and name_or_path in built_in():
        return (_directory() / f"{name_or_path}.toml").read_text(encoding="utf-8")
    if not path.is_file():
        raise ValueError(
            f"campaign '{name_or_path}' is neither a file nor a built-in name; built in are: {', '.join(built_in())}"
        )
    if path.stat().st_size > MAX_FILE_BYTES:
        raise ValueError(
            f"campaign '{path}' is larger than {MAX_FILE_BYTES} bytes; a campaign is a short TOML text"
        )
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise ValueError(f"campaign '{path}' is not UTF-8 text; a campaign is a TOML file") from None


def _directory() -> Any:
    from importlib.resources import files

    return files("sdr") / "campaigns"


def built_in() -> list[str]:
    """Names of the campaigns that come with the package."""
    return sorted(p.name.removesuffix(".toml") for p in _directory().iterdir() if p.name.endswith(".toml"))


def from_table(table: dict[str, Any], origin: str = "campaign") -> Campaign:
    """Campaign of a parsed table; its text is canonical JSON, so that workers can rebuild it."""
    spec = validate(CampaignSpec, table, origin)
    return Campaign(spec, json.dumps(spec.model_dump(mode="json", by_alias=True), sort_keys=True))


@lru_cache(maxsize=4)
def _campaign(text: str) -> Campaign:
    return from_table(json.loads(text))


# -- trials -------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=16)
def _trained(text: str, group: int) -> dict[str, Any]:
    """Monitors trained on the quiet channel of a group: many realisations, seeds of the training set."""
    campaign = _campaign(text)
    spec, quiet = campaign.spec, campaign.quiet[group]
    runs = start_monitors(quiet, campaign.detectors, spec.dumps)
    for trial in range(spec.training.trials):
        corr = _quiet_corr(campaign, group, spec.seeds.training, trial, spec.training.epochs)
        for run in runs.values():
            run.train(corr)
    return runs


def _quiet_corr(campaign: Campaign, group: int, root: int, trial: int, n_epochs: int) -> np.ndarray:
    spec, quiet = campaign.spec, campaign.quiet[group]
    seed = trial_seed(root, group, trial)
    if spec.loop == "open":
        return sum_dumps(quiet.start_open(seed)(n_epochs), spec.dumps)
    twin = quiet.start(seed)
    twin(spec.trial.settle_epochs)
    return sum_dumps(twin(n_epochs)[1], spec.dumps)


def quiet_statistics(text: str, group: int, first: int, count: int) -> list[list[np.ndarray]]:
    """Values of every monitor on trials of the threshold set: one list of arrays per trial."""
    campaign = _campaign(text)
    spec = campaign.spec
    out = []
    with one_blas_thread():
        runs = _trained(text, group)
        for trial in range(first, first + count):
            corr = _quiet_corr(campaign, group, spec.seeds.threshold, trial, spec.threshold.epochs)
            out.append([run.fresh()(corr)["value"].astype(np.float32) for run in runs.values()])
    return out


def fit_thresholds(campaign: Campaign, group: int, values: list[list[np.ndarray]]) -> np.ndarray:
    """THRESHOLD rows of a group from the values of its trials; refuses a P_FA beyond what they support."""
    p_fa = campaign.spec.p_fa_test
    rows = np.zeros(len(campaign.spec.monitor), THRESHOLD)
    for i, (row, monitor) in enumerate(zip(rows, campaign.spec.monitor)):
        row["group"], row["monitor"], row["p_fa"] = group, i, p_fa
        if monitor.threshold is not None:
            row["rule"], row["threshold"] = b"given", monitor.threshold
            row["low"] = row["high"] = monitor.threshold
            continue
        series = [trial[i] for trial in values]
        x = np.concatenate(series)
        try:
            null, n = _fit_null(monitor, x, p_fa)
            row["threshold"] = null.isf(p_fa)
            row["low"], row["high"] = null.interval(p_fa)
        except ValueError as err:
            raise ValueError(
                f"monitor '{monitor.name}': {err} (threshold.trials x threshold.epochs, or a larger p_fa)"
            ) from None
        row["rule"], row["n"], row["n_effective"] = null.rule.encode(), len(x), _effective(series, n)
    return rows


def _fit_null(monitor: MonitorSpec, x: np.ndarray, p_fa: float) -> tuple[Any, float]:
    """Null model by the monitor's rule; overlapping windows count once."""
    detector = monitor.detector
    n = float(len(x))
    if isinstance(detector, MultichannelAr):
        n *= min(1.0, detector.hop_s / detector.window_s)
    if monitor.rule == "gaussian":
        return GaussianNull.fit(x, n_effective=n), n
    if monitor.rule == "empirical":
        return EmpiricalNull.fit(x, n_effective=n), n
    if monitor.rule == "analytic":
        return AnalyticNull.fit(x, tail=max(1e-3, min(20 / n, 0.05)), n_effective=n), n
    return ParetoNull.fit(x, tail=max(0.01, min(0.1, 220 / len(x))), n_effective=n), n


def _effective(series: list[np.ndarray], n: float) -> float:
    """Independent values at the 99 % quantile, from the scatter between trials."""
    if len(series) < 2:
        return n
    u = np.quantile(np.concatenate(series), 0.99)
    k = [int(np.count_nonzero(v > u)) for v in series]
    return min(n, cluster_rate(k, [len(v) for v in series], 0, n_boot=2).n_effective)


def evaluate_trials(
    text: str, point: int, first: int, count: int, thresholds: tuple[float, ...]
) -> np.ndarray:
    """TRIAL rows (count x monitors) of the evaluation set; a pure function of its arguments."""
    campaign = _campaign(text)
    one = _open_trial if campaign.spec.loop == "open" else _closed_trial
    with one_blas_thread():
        runs = _trained(text, campaign.group[point])
        parts = [one(campaign, runs, point, trial, thresholds) for trial in range(first, first + count)]
    return np.concatenate(parts)


def warm_up(text: str, point: int) -> None:
    """Train what a point needs, in this process."""
    with one_blas_thread():
        _trained(text, _campaign(text).group[point])


class _World:
    """What is true during a trial, on the epochs of the twin that are tested."""

    def __init__(self, twin: Twin, t_s: np.ndarray) -> None:
        self.t_s, self.T = t_s, twin.integration_s
        jammer = twin.jammers[0] if twin.jammers else None
        self.jammed = jammer is not None
        self.cw = isinstance(jammer, TwinCW)
        self.on = np.zeros(len(t_s), bool)
        if jammer is not None:
            self.on = (t_s >= jammer.start_s) & (t_s < jammer.end_s)
        self.df_hz = _line_offset_hz(twin, t_s) if self.cw else np.full(len(t_s), np.nan)


def _line_offset_hz(twin: Twin, t_s: np.ndarray) -> np.ndarray:
    """Offset of the CW from its code line as the signal's Doppler moves: the nearest one, or under dynamics, which
    sweep over many lines, the one it was aimed at."""
    speed = twin.dynamics.at(t_s)[1]
    if not speed.any() or twin.jammers[0].line is None:
        return line_offset_hz(twin, t_s)
    cw = twin.jammers[0]
    assert isinstance(cw, TwinCW)
    return cw.offset_hz + cw.rate_hz_s * t_s + speed / WAVELENGTH_M


def _closed_trial(campaign: Campaign, runs: dict, point: int, trial: int, thresholds: tuple) -> np.ndarray:
    spec, twin = campaign.spec, campaign.points[point]
    run = twin.start(trial_seed(spec.seeds.evaluation, point, trial))
    settle = spec.trial.settle_epochs
    run(settle)
    epochs, corr = run(spec.trial.epochs)
    world = _World(twin, epochs["t_s"])
    summed = sum_dumps(corr, spec.dumps)
    code_m = epochs["code_error_chips"] * METRES_PER_CHIP
    smoothed = np.empty(len(code_m))
    n_smooth = max(1, round(spec.trial.smooth_s / twin.integration_s))
    hatch_smooth(code_m, epochs["phase_error_cycles"] * WAVELENGTH_M, n_smooth, n_smooth, smoothed)
    rows = np.zeros(len(runs), TRIAL)
    rows["cn0_dbhz"], rows["lost"] = _carrier_health(epochs, twin.integration_s, spec.dumps)
    for i, (row, name) in enumerate(zip(rows, runs)):
        s = runs[name].fresh()(summed)
        row["point"], row["trial"], row["monitor"] = point, trial, i
        _count(row, s["value"], thresholds[i], s["epoch"], _span(runs[name]), world, spec)
        _count_errors(row, s["value"] >= thresholds[i], s["epoch"], code_m, smoothed, world, spec)
    return rows


def _carrier_health(epochs: np.ndarray, T: float, dumps: int) -> tuple[float, bool]:
    """C/N0 = mean(|I|)^2 / (2 T var(|I|)) and whether the carrier was lost."""
    i = np.abs(epochs["prompt_i"])
    cn0 = 10 * math.log10(max(i.mean() ** 2 / (2 * T * max(i.var(), 1e-30)), 1e-3))
    phase = epochs["phase_error_cycles"]
    tail = phase[-max(1, len(phase) // 4) :]
    drift = np.ptp(np.convolve(phase, np.ones(16) / 16, "valid")) if len(phase) >= 16 else np.ptp(phase)
    return cn0, bool(drift > 0.5 or np.mean(np.cos(4 * np.pi * tail)) < 0.4)


def _open_trial(campaign: Campaign, runs: dict, point: int, trial: int, thresholds: tuple) -> np.ndarray:
    spec, twin = campaign.spec, campaign.points[point]
    seed = trial_seed(spec.seeds.evaluation, point, trial)
    n = spec.trial.epochs
    world = _World(twin, (np.arange(n) + 0.5) * twin.integration_s)
    rows = np.zeros(len(runs), TRIAL)
    rows["cn0_dbhz"] = np.nan
    fast = spec.dumps == 1 and all(_by_blocks(run) for run in runs.values())
    series = _by_block_values(twin, seed, runs, n) if fast else None
    corr = None if fast else sum_dumps(twin.start_open(seed)(n), spec.dumps)
    for i, (row, name) in enumerate(zip(rows, runs)):
        row["point"], row["trial"], row["monitor"] = point, trial, i
        if series is not None:
            value, epoch = series[i], np.arange(n)
        else:
            s = runs[name].fresh()(corr)
            value, epoch = s["value"], s["epoch"]
        _count(row, value, thresholds[i], epoch, _span(runs[name]), world, spec)
        for field in ("max_code_error_m", "max_smoothed_error_m", "undetected_code_error_m"):
            row[field] = np.nan
        row["undetected_smoothed_error_m"] = np.nan
    return rows


def _by_blocks(run: Any) -> bool:
    detector = run.spec if hasattr(run, "spec") else None
    return isinstance(detector, FftMonitor) or (
        isinstance(detector, GlrtMonitor) and detector.accumulate_epochs == 1
    )


def _by_block_values(twin: Twin, seed: Any, runs: dict, n: int) -> np.ndarray:
    """Statistic of every epoch and monitor straight from the blocks of the open loop, float32 (M, n)."""
    source = twin.start_open(seed)
    mine = [run.fresh() for run in runs.values()]
    out = np.empty((len(runs), n), np.float32)
    size = source.block_epochs
    for lo in range(0, n, size):
        z = source.block(lo // size)
        m = min(size, n - lo)
        for values, run in zip(out, mine):
            if isinstance(run.spec, FftMonitor):
                values[lo : lo + m] = (run.block(z)[:m] - run.mean) / run.std
            else:
                values[lo : lo + m] = run.block(z)[0][:m]
    return out


def _span(run: Any) -> int:
    """Epochs that one value of a monitor rests on."""
    spec = getattr(run, "spec", None)
    return int(
        getattr(run, "window", 0) or getattr(run, "length", 0) or getattr(spec, "accumulate_epochs", 1)
    )


def _count(row: Any, value: np.ndarray, threshold: float, epoch: np.ndarray, span: int, world: _World, spec: CampaignSpec) -> None:  # fmt: skip
    """Fill the counts of one row; a window belongs to the epoch in its middle."""
    alarm = value >= threshold
    row["tests"], row["alarms"] = len(value), np.count_nonzero(alarm)
    row["peak"] = value.max() if len(value) else np.nan
    row["first_alarm_s"] = np.nan
    if not world.jammed or not len(value):
        return
    end = (epoch + 1) * spec.dumps - 1
    middle = np.maximum(end - span * spec.dumps // 2, 0)
    on = world.on[middle]
    missed = ~alarm
    row["on_n"], row["on_missed"] = np.count_nonzero(on), np.count_nonzero(on & missed)
    row["hit_n"], row["hit_missed"] = row["on_n"], row["on_missed"]
    entered = on
    if world.cw:
        df_t = np.abs(world.df_hz[middle]) * world.T * spec.dumps
        hit = df_t <= HIT_LIMIT
        row["hit_n"], row["hit_missed"] = np.count_nonzero(hit), np.count_nonzero(hit & missed)
        entered = df_t < 1.0
        near = df_t[entered]
        bins = np.minimum((near * CURVE_BINS).astype(np.int64), CURVE_BINS - 1)
        row["curve_n"] = np.bincount(bins, minlength=CURVE_BINS)
        row["curve_missed"] = np.bincount(bins[missed[entered]], minlength=CURVE_BINS)
        row["event_missed"], row["event_n"] = p_md_event(df_t, alarm, world.t_s[end], spec.time_to_alert_s)
    start = np.flatnonzero(entered)
    if len(start):
        hits = np.flatnonzero(alarm[start[0] :])
        if len(hits):
            row["first_alarm_s"] = world.t_s[end[start[0] + hits[0]]] - world.t_s[middle[start[0]]]


def _count_errors(row: Any, alarm: np.ndarray, epoch: np.ndarray, code_m: np.ndarray, smoothed: np.ndarray, world: _World, spec: CampaignSpec) -> None:  # fmt: skip
    """Largest errors, with and without an alarm standing; hazards that no alarm met in time."""
    standing = np.zeros(len(code_m), bool)
    end = (epoch + 1) * spec.dumps - 1
    # A decision stands until the next one.
    for_epoch = np.searchsorted(end, np.arange(len(code_m)), "right") - 1
    known = for_epoch >= 0
    standing[known] = alarm[for_epoch[known]]
    at = np.zeros(len(code_m), bool)
    at[end] = alarm
    code, smooth = np.abs(code_m), np.abs(smoothed)
    row["max_code_error_m"], row["max_smoothed_error_m"] = code.max(), smooth.max()
    quiet = ~standing
    row["undetected_code_error_m"] = code[quiet].max() if quiet.any() else 0.0
    row["undetected_smoothed_error_m"] = smooth[quiet].max() if quiet.any() else 0.0
    k, n = p_md_hazard(smoothed, at, world.t_s, spec.time_to_alert_s, spec.trial.hazard_m)
    row["hazard_missed"], row["hazard_n"] = k, n


# -- counting in trial order --------------------------------------------------------------------------------------


class PointCount:
    """Trials of one point as they come in; counts only the unbroken run from trial 0 to where it stops."""

    def __init__(self, campaign: Campaign, index: int) -> None:
        self.spec, self.index = campaign.spec, index
        self.jammed = bool(campaign.points[index].jammers)
        self._ahead: dict[int, np.ndarray] = {}
        self.rows: list[np.ndarray] = []
        self.reason: str | None = None
        self._sums = np.zeros((len(campaign.spec.monitor), 5))

    @property
    def done(self) -> int:
        """Trials counted."""
        return len(self.rows)

    def has(self, trial: int) -> bool:
        """Whether a trial's result is here already."""
        return trial < self.done or trial in self._ahead

    def add(self, rows: np.ndarray) -> None:
        """TRIAL rows of one trial, one per monitor; a trial that is known already is ignored."""
        trial = int(rows["trial"][0])
        if self.has(trial):
            return
        self._ahead[trial] = rows
        while self.reason is None and self.done in self._ahead:
            new = self._ahead.pop(self.done)
            self.rows.append(new)
            self._sum(new)
            self.reason = self._stopped()
        if self.reason is not None:
            self._ahead.clear()

    def _sum(self, rows: np.ndarray) -> None:
        k, n = counted(rows, self.jammed, self.spec.stop.definition)
        self._sums += np.stack([k, n, k * k, k * n, n * n], axis=1).astype(float)

    def _stopped(self) -> str | None:
        stop = self.spec.stop
        k = self._sums[:, 0]
        if self.done >= stop.min_trials:
            if stop.errors is not None and np.all(k >= stop.errors):
                return "errors"
            if stop.relative_error is not None and np.all(self._relative_error() <= stop.relative_error):
                return "precision"
        return "max_trials" if self.done >= stop.max_trials else None

    def _relative_error(self) -> np.ndarray:
        """Standard error of sum k / sum n over its value, trials being the independent units."""
        k, n, kk, kn, nn = self._sums.T
        m = self.done
        if m < 5:
            return np.full(len(k), np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            p = k / n
            variance = np.maximum(kk - 2 * p * kn + p * p * nn, 0.0) / n**2 * m / (m - 1)
            # Never less than what independent tests would have.
            variance = np.maximum(variance, p * (1 - p) / n)
            return np.where(k >= 10, np.sqrt(variance) / p, np.inf)


def counted(rows: np.ndarray, jammed: bool, definition: str) -> tuple[np.ndarray, np.ndarray]:
    """(k, n) of each row: misses by a definition of P_MD, or false alarms where there is no jammer."""
    if not jammed:
        return rows["alarms"], rows["tests"]
    name = _COUNTED[definition]
    return rows[f"{name}_missed"], rows[f"{name}_n"]


def point_rate(k: np.ndarray, n: np.ndarray, seed: int) -> Any:
    """Rate over independent trials: exact where a trial has one test, else a cluster bootstrap over trials.

    Thousands of trials are pooled by neighbours first, which costs next to nothing in precision.
    """
    k, n = k[n > 0], n[n > 0]
    if len(n) == 0:
        return rate(0, 0)
    if n.max() == 1 or len(n) == 1:
        return rate(int(k.sum()), int(n.sum()))
    if np.count_nonzero(k) < 5 or np.count_nonzero(k < n) < 5:
        # Too few trials of either kind to resample: as if each trial were a single test.
        p, m = k.sum() / n.sum(), len(n)
        low, high = clopper_pearson(p * m, m)
        return Rate(int(k.sum()), int(n.sum()), float(p), low, high, float(m))
    size = -(-len(n) // 1000)
    edges = np.arange(0, len(n), size)
    return cluster_rate(np.add.reduceat(k, edges), np.add.reduceat(n, edges), seed)


def summarise(campaign: Campaign, counts: list[PointCount], thresholds: np.ndarray) -> list[dict[str, Any]]:
    """One plain row per point and monitor: counts, rate with its interval, thresholds, errors, why it stopped."""
    out = []
    for c in counts:
        if not c.rows:
            continue
        group = campaign.group[c.index]
        for i, monitor in enumerate(campaign.spec.monitor):
            rows = np.array([r[i] for r in c.rows])
            limit = thresholds[(thresholds["group"] == group) & (thresholds["monitor"] == i)][0]
            out.append(_summary_row(campaign, c, monitor.name, rows, limit))
    return out


def _summary_row(
    campaign: Campaign, c: PointCount, name: str, rows: np.ndarray, limit: Any
) -> dict[str, Any]:
    definition = campaign.spec.stop.definition if c.jammed else "false_alarm"
    r = point_rate(
        *counted(rows, c.jammed, definition if c.jammed else "all"), campaign.spec.seeds.evaluation
    )
    row: dict[str, Any] = {
        "point": c.index, "axes": campaign.settings[c.index], "monitor": name, "definition": definition,
        "k": r.k, "n": r.n, "rate": _number(r.p), "ci_low": r.low, "ci_high": r.high,
        "n_effective": r.n_effective, "trials": c.done, "stop_reason": c.reason,
        "threshold": float(limit["threshold"]), "threshold_low": float(limit["low"]),
        "threshold_high": float(limit["high"]), "rule": limit["rule"].decode(), "p_fa": float(limit["p_fa"]),
    }  # fmt: skip
    for other in _COUNTED.values():
        row[f"{other}_k"], row[f"{other}_n"] = (
            int(rows[f"{other}_missed"].sum()),
            int(rows[f"{other}_n"].sum()),
        )
    row["curve_k"] = rows["curve_missed"].sum(axis=0).tolist()
    row["curve_n"] = rows["curve_n"].sum(axis=0).tolist()
    heard = rows["first_alarm_s"][np.isfinite(rows["first_alarm_s"])]
    row["alarmed_trials"] = len(heard)
    row["first_alarm_median_s"] = float(np.median(heard)) if len(heard) else None
    for field in ("max_code_error_m", "max_smoothed_error_m", "undetected_code_error_m", "undetected_smoothed_error_m"):  # fmt: skip
        row[field] = _number(np.max(rows[field]))
    row["cn0_dbhz"] = _number(np.mean(rows["cn0_dbhz"]))
    row["lost_trials"] = int(rows["lost"].sum())
    return row


def _number(x: float) -> float | None:
    return float(x) if np.isfinite(x) else None


def noise_jammed(twin: Twin) -> bool:
    """Whether the jammer is noise, which has no offset from a line."""
    return bool(twin.jammers) and isinstance(twin.jammers[0], TwinNBI)
