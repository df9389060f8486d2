"""One trial of a campaign: quiet ones that train and set thresholds, jammed ones that are counted or estimated.

Everything here is a pure function of the campaign's text, a point and the number of a trial: workers keep the trained
monitors of a group of points and nothing else.
"""

import math
from functools import lru_cache
from typing import Any

import numpy as np

from monitors.batch import line_offset_hz, start_monitors, sum_dumps, trial_seed
from monitors.detection import HIT_LIMIT, cluster_rate, p_md_event, p_md_hazard
from monitors.fft import FftMonitor
from monitors.glrt import GlrtMonitor
from monitors.multichannel_ar import MultichannelAr
from monitors.rare import Course, Importance, Splitting, find_levels, importance_miss_rate, split
from monitors.threshold import AnalyticNull, EmpiricalNull, GaussianNull, ParetoNull
from sdr.campaign import recorded
from sdr.campaign.load import from_text
from sdr.campaign.spec import (
    CURVE_BINS,
    ROC_P_FA,
    THRESHOLD,
    Campaign,
    CampaignSpec,
    MonitorSpec,
    empty_trial,
)
from sdr.watch.null import one_blas_thread
from signals.constants import METRES_PER_CHIP, WAVELENGTH_M
from tracking.correlator_model import Twin, TwinCW, cw_taps
from tracking.twin_kernels import hatch_smooth

# -- quiet trials -------------------------------------------------------------------------------------------------


@lru_cache(maxsize=16)
def trained(text: str, group: int) -> dict[str, Any]:
    """Monitors trained on the quiet channel of a group: many realisations, seeds of the training set."""
    campaign = from_text(text)
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
    campaign = from_text(text)
    spec = campaign.spec
    out = []
    with one_blas_thread():
        runs = trained(text, group)
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
            row["roc"] = np.nan
            continue
        series = [trial[i] for trial in values]
        x = np.concatenate(series)
        try:
            null, n = _fit_null(monitor, x)
            row["threshold"] = null.isf(p_fa)
            row["low"], row["high"] = null.interval(p_fa)
            row["roc"] = [_roc_threshold(null, x, n, p) for p in ROC_P_FA]
        except ValueError as err:
            raise ValueError(
                f"monitor '{monitor.name}': {err} (threshold.trials x threshold.epochs, or a larger p_fa)"
            ) from None
        row["rule"], row["n"], row["n_effective"] = null.rule.encode(), len(x), _effective(series, n)
    return rows


def _fit_null(monitor: MonitorSpec, x: np.ndarray) -> tuple[Any, float]:
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


def _roc_threshold(null: Any, x: np.ndarray, n: float, p_fa: float) -> float:
    """Quantile of the quiet values where they hold enough of them, else the null model's, else NaN."""
    if n * p_fa >= 100:
        return float(np.quantile(x, 1 - p_fa))
    try:
        return float(null.isf(p_fa))
    except ValueError:
        return math.nan


def _effective(series: list[np.ndarray], n: float) -> float:
    """Independent values at the 99 % quantile, from the scatter between trials."""
    if len(series) < 2:
        return n
    u = np.quantile(np.concatenate(series), 0.99)
    k = [int(np.count_nonzero(v > u)) for v in series]
    return min(n, cluster_rate(k, [len(v) for v in series], 0, n_boot=2).n_effective)


def evaluate_trials(text: str, point: int, first: int, count: int, limits: np.ndarray) -> np.ndarray:
    """TRIAL rows (count x monitors) of the evaluation set; ``limits``: THRESHOLD rows of the point's group."""
    campaign = from_text(text)
    if campaign.live:
        return _received(campaign, point, range(first, first + count))
    one = _open_trial if campaign.spec.loop == "open" else _closed_trial
    if campaign.points[point].jammers:
        one = {"splitting": _splitting_trial, "importance": _importance_trial}.get(
            campaign.spec.method.kind, one
        )
    with one_blas_thread():
        runs = trained(text, campaign.group[point])
        parts = [one(campaign, runs, point, trial, limits) for trial in range(first, first + count)]
    return np.concatenate(parts)


def _received(campaign: Any, point: int, numbers: range) -> np.ndarray:
    seeds = [trial_seed(campaign.spec.seeds.evaluation, point, n) for n in numbers]
    return np.concatenate([recorded.trial(campaign, point, n, s) for n, s in zip(numbers, seeds)])


def warm_up(text: str, point: int) -> None:
    """Train what a point needs, in this process."""
    campaign = from_text(text)
    if campaign.live:
        return
    with one_blas_thread():
        trained(text, campaign.group[point])


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
        self.df_hz = offset_from_line_hz(twin, t_s) if self.cw else np.full(len(t_s), np.nan)


def offset_from_line_hz(twin: Twin, t_s: np.ndarray) -> np.ndarray:
    """Offset of the CW from its code line as the signal's Doppler moves: the nearest one, or under dynamics, which
    sweep over many lines, the one it was aimed at."""
    speed = twin.dynamics.at(t_s)[1]
    if not speed.any() or twin.jammers[0].line is None:
        return line_offset_hz(twin, t_s)
    cw = twin.jammers[0]
    assert isinstance(cw, TwinCW)
    return cw.offset_hz + cw.rate_hz_s * t_s + speed / WAVELENGTH_M


def _closed_trial(campaign: Campaign, runs: dict, point: int, trial: int, limits: np.ndarray) -> np.ndarray:
    spec, twin = campaign.spec, campaign.points[point]
    run = twin.start(trial_seed(spec.seeds.evaluation, point, trial))
    settle = spec.trial.settle_epochs
    run(settle)
    epochs, corr = run(campaign.length(point).epochs)
    world = _World(twin, epochs["t_s"])
    summed = sum_dumps(corr, spec.dumps)
    code_m = epochs["code_error_chips"] * METRES_PER_CHIP
    smoothed = np.empty(len(code_m))
    n_smooth = max(1, round(spec.trial.smooth_s / twin.integration_s))
    hatch_smooth(code_m, epochs["phase_error_cycles"] * WAVELENGTH_M, n_smooth, n_smooth, smoothed)
    rows = empty_trial(len(runs), point, trial)
    rows["cn0_dbhz"], rows["lost"] = _carrier_health(epochs, twin.integration_s)
    for i, (row, name) in enumerate(zip(rows, runs)):
        s = runs[name].fresh()(summed)
        _count(row, s["value"], limits[i], s["epoch"], span(runs[name]), world, spec)
        _count_errors(row, s["value"] >= limits["threshold"][i], s["epoch"], code_m, smoothed, world, spec)
    return rows


def _carrier_health(epochs: np.ndarray, T: float) -> tuple[float, bool]:
    """C/N0 = mean(|I|)^2 / (2 T var(|I|)) and whether the carrier was lost."""
    i = np.abs(epochs["prompt_i"])
    cn0 = 10 * math.log10(max(i.mean() ** 2 / (2 * T * max(i.var(), 1e-30)), 1e-3))
    phase = epochs["phase_error_cycles"]
    tail = phase[-max(1, len(phase) // 4) :]
    drift = np.ptp(np.convolve(phase, np.ones(16) / 16, "valid")) if len(phase) >= 16 else np.ptp(phase)
    return cn0, bool(drift > 0.5 or np.mean(np.cos(4 * np.pi * tail)) < 0.4)


def _open_trial(campaign: Campaign, runs: dict, point: int, trial: int, limits: np.ndarray) -> np.ndarray:
    spec, twin = campaign.spec, campaign.points[point]
    seed = trial_seed(spec.seeds.evaluation, point, trial)
    n = campaign.length(point).epochs
    world = _World(twin, (np.arange(n) + 0.5) * twin.integration_s)
    rows = empty_trial(len(runs), point, trial)
    fast = spec.dumps == 1 and all(_by_blocks(run) for run in runs.values())
    series = _by_block_values(twin, seed, runs, n) if fast else None
    corr = None if fast else sum_dumps(twin.start_open(seed)(n), spec.dumps)
    for i, (row, name) in enumerate(zip(rows, runs)):
        if series is not None:
            value, epoch = series[i], np.arange(n)
        else:
            s = runs[name].fresh()(corr)
            value, epoch = s["value"], s["epoch"]
        _count(row, value, limits[i], epoch, span(runs[name]), world, spec)
    return rows


def _importance_trial(
    campaign: Campaign, runs: dict, point: int, trial: int, limits: np.ndarray
) -> np.ndarray:
    """One repetition of importance sampling for each monitor."""
    twin, method = campaign.points[point], _method(campaign, Importance)
    seed = trial_seed(campaign.spec.seeds.evaluation, point, trial)
    rows = empty_trial(len(runs), point, trial)
    for row, limit, run in zip(rows, limits, runs.values()):
        row["estimate"] = importance_miss_rate(
            run, cw_taps(twin, twin.jammers[0]), limit["threshold"], method.draws, seed
        )[0]
    return rows


def _splitting_trial(
    campaign: Campaign, runs: dict, point: int, trial: int, limits: np.ndarray
) -> np.ndarray:
    """One repetition of splitting for each monitor; what no monitor changes is done once."""
    spec, twin = campaign.spec, campaign.points[point]
    rows = empty_trial(len(runs), point, trial)
    for i, row in enumerate(rows):
        if i and spec.stop.definition == "excess":
            row["estimate"] = rows["estimate"][0]
            continue
        limit = float(limits["threshold"][i])
        levels = _levels(campaign.text, point, i, limit)
        root = trial_seed(spec.seeds.evaluation, point, trial)
        seed = np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, i))
        row["estimate"] = split(
            twin, _course(campaign, point, i, limit), levels, _method(campaign, Splitting).particles, seed
        )[0]
    return rows


def _method(campaign: Campaign, kind: type) -> Any:
    method = campaign.spec.method
    assert isinstance(method, kind)
    return method


@lru_cache(maxsize=64)
def _levels(text: str, point: int, monitor: int, limit: float) -> np.ndarray:
    """Levels as given, or from a pilot with the training seed."""
    campaign = from_text(text)
    method = _method(campaign, Splitting)
    if method.levels is not None:
        return np.array([*method.levels, 1.0])
    root = trial_seed(campaign.spec.seeds.training, point, monitor)
    course = _course(campaign, point, monitor, limit)
    return find_levels(campaign.points[point], course, method.particles, method.success, root)


def _course(campaign: Campaign, point: int, monitor: int, limit: float) -> Course:
    """What the paths of a point are watched for; times are those of a trial that is counted."""
    spec, twin = campaign.spec, campaign.points[point]
    d, first = spec.dumps, spec.trial.settle_epochs // spec.dumps
    n = spec.trial.epochs // d
    stop = first + n
    if spec.stop.definition == "event":
        end = (first + np.arange(n) + 1) * d - 1
        df_t = (
            np.abs(offset_from_line_hz(twin, (end - d // 2 + 0.5) * twin.integration_s))
            * twin.integration_s
            * d
        )
        inside = np.flatnonzero(df_t < 1.0)
        stop_at = (
            inside[-1] + round(spec.time_to_alert_s / (twin.integration_s * d)) + 1 if len(inside) else n + 1
        )
        if stop_at > n or np.any(np.diff(inside) > 1):
            raise ValueError(
                f"{spec.name}, point {point}: the trial must hold one whole pass over the line and the time to alert"
            )
        first, stop = first + int(inside[0]), first + int(stop_at)
    run = list(trained(campaign.text, campaign.group[point]).values())[monitor]
    return Course(spec.stop.definition, first, stop, spec.trial.excess_m, run, limit, d)


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


def span(run: Any) -> int:
    """Epochs that one value of a monitor rests on."""
    spec = getattr(run, "spec", None)
    return int(
        getattr(run, "window", 0) or getattr(run, "length", 0) or getattr(spec, "accumulate_epochs", 1)
    )


def _count(row: Any, value: np.ndarray, limit: Any, epoch: np.ndarray, span: int, world: _World, spec: CampaignSpec) -> None:  # fmt: skip
    """Fill the counts of one row; a window belongs to the epoch in its middle."""
    alarm = value >= limit["threshold"]
    row["tests"], row["alarms"] = len(value), np.count_nonzero(alarm)
    row["peak"] = value.max() if len(value) else np.nan
    if not world.jammed or not len(value):
        row["roc_missed"] = np.searchsorted(np.sort(value), limit["roc"].astype(value.dtype), "left")
        return
    end = (epoch + 1) * spec.dumps - 1
    middle = np.maximum(end - span * spec.dumps // 2, 0)
    on = world.on[middle]
    missed = ~alarm
    row["on_n"], row["on_missed"] = np.count_nonzero(on), np.count_nonzero(on & missed)
    row["hit_n"], row["hit_missed"] = row["on_n"], row["on_missed"]
    entered = hit = on
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
    row["roc_missed"] = np.searchsorted(np.sort(value[hit]), limit["roc"].astype(value.dtype), "left")
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
