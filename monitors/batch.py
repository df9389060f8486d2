"""Batches: many twins under one setting through a set of monitors, each trial from its own seed.

A trial's seed is ``SeedSequence(root, spawn_key=(point, trial))``: it replays alone and does not depend on
how trials are shared out. Use different roots for training, threshold and evaluation.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from monitors.baselines import AdcHistogram, AgcGain, Cn0Drop, NoiseFloor, SignalQuality
from monitors.fft import FftMonitor
from monitors.glrt import GlrtMonitor
from monitors.multichannel_ar import MultichannelAr
from signals.constants import METRES_PER_CHIP, WAVELENGTH_M
from signals.modulation import SIGNALS
from tracking.correlator_model import TwinCW, jammer_hz
from tracking.twin_kernels import hatch_smooth

_PART = 16_384  # monitor epochs at a time: bounds the memory of a long trial
__all__ = [
    "MonitorSpec",
    "TrialResult",
    "simulate_points",
    "simulate_trial",
    "sum_dumps",
    "train_monitors",
    "trial_seed",
]


MonitorSpec = Annotated[
    FftMonitor | GlrtMonitor | MultichannelAr | Cn0Drop | NoiseFloor | SignalQuality | AgcGain | AdcHistogram,
    Field(discriminator="kind"),
]
"""A section ``monitors`` of a scenario: any interference monitor. ``kind`` names it."""


@dataclass(frozen=True)
class TrialResult:
    """One trial: ``epochs`` TWIN_EPOCH (n,), ``statistics`` {monitor name: STATISTIC}, errors in metres (n,).

    ``df_hz``: offset of the first CW from its nearest code line at mid-interval, NaN without one.
    """

    point: int
    trial: int
    epochs: np.ndarray
    statistics: dict
    code_error_m: np.ndarray
    smoothed_error_m: np.ndarray
    df_hz: np.ndarray


def trial_seed(root, point, trial):
    """SeedSequence of a trial."""
    return np.random.SeedSequence(root, spawn_key=(point, trial))


def sum_dumps(corr, n):
    """Mean of each ``n`` consecutive dumps, complex64 (m, K): 25 of 4 ms make the 100 ms of a monitor.

    Data signs must be wiped.
    """
    if n == 1:
        return corr
    m = len(corr) // n
    return corr[: m * n].reshape(m, n, corr.shape[1]).mean(axis=1)


def train_monitors(spec, monitors, root, n_trials, n_epochs, settle_epochs=500, dumps=1, point=0):
    """Start every monitor on ``spec`` without its jammers and train it on ``n_trials`` realisations of the
    channel.

    Parameters
    ----------
    monitors : dict
        {name: monitor Spec}.
    dumps : int
        Twin epochs summed to one monitor epoch.

    Returns
    -------
    dict
        {name: trained Run}.
    """
    quiet = spec.model_copy(update={"jammers": ()})
    runs = start_monitors(quiet, monitors, dumps)
    for trial in range(n_trials):
        twin = quiet.start(trial_seed(root, point, trial))
        twin(settle_epochs)
        corr = sum_dumps(twin(n_epochs)[1], dumps)
        for run in runs.values():
            run.train(corr)
    return runs


def start_monitors(spec, monitors, dumps=1):
    """Runs of monitor Specs for the taps, code and front-end filter of a twin, untrained."""
    args = spec.tap_array_chips, spec.integration_s * dumps, spec.signal, spec.prn, spec.waveform
    return {name: _behind_filter(monitor, spec).start(*args) for name, monitor in monitors.items()}


def _behind_filter(monitor, spec):
    if spec.bandwidth_hz is None or not isinstance(monitor, GlrtMonitor) or monitor.bandwidth_hz is not None:
        return monitor
    return monitor.model_copy(update={"bandwidth_hz": spec.bandwidth_hz})


def simulate_trial(spec, runs, root, point, trial, n_epochs, settle_epochs=500, dumps=1, smooth_s=100.0):
    """One trial -> TrialResult.

    ``runs`` are trained; they are restarted for the trial, their training kept. The first ``settle_epochs``
    belong to the trial (time zero is at their start) but are not tested; jammers should start after them.
    """
    twin = spec.start(trial_seed(root, point, trial))
    twin(settle_epochs)
    fresh = {name: run.fresh() for name, run in runs.items()}
    parts: list[np.ndarray] = []
    values: dict[str, list[np.ndarray]] = {name: [] for name in runs}
    for lo in range(0, n_epochs, _PART * dumps):
        epochs, corr = twin(min(_PART * dumps, n_epochs - lo))
        parts.append(epochs)
        summed = sum_dumps(corr, dumps)
        for name, run in fresh.items():
            values[name].append(run(summed))
    epochs = np.concatenate(parts)
    statistics = {name: np.concatenate(v) for name, v in values.items()}
    code_m = epochs["code_error_chips"] * METRES_PER_CHIP
    smoothed = np.empty(len(code_m))
    n_smooth = max(1, round(smooth_s / spec.integration_s))
    # A filter long in use: it starts as if n_smooth epochs had gone before.
    hatch_smooth(code_m, epochs["phase_error_cycles"] * WAVELENGTH_M, n_smooth, n_smooth, smoothed)
    return TrialResult(
        point, trial, epochs, statistics, code_m, smoothed, line_offset_hz(spec, epochs["t_s"])
    )


def line_offset_hz(spec, t_s):
    """Offset of the first CW from its nearest code line, Hz; NaN where there is none."""
    cw = next((j for j in spec.jammers if isinstance(j, TwinCW)), None)
    if cw is None:
        return np.full(len(t_s), np.nan)
    line_hz = 1.0 / SIGNALS[spec.signal].code_period_s
    f = jammer_hz(spec, cw) + cw.rate_hz_s * t_s
    off = f - np.round(f / line_hz) * line_hz
    return np.where((t_s >= cw.start_s) & (t_s < cw.end_s), off, np.nan)


def simulate_points(points, runs, root, n_trials, n_epochs, settle_epochs=500, dumps=1, first_trial=0):
    """All trials of a list of points, in order: yields TrialResult.

    Parameters
    ----------
    points : list of Twin
        Point i has index i in the seeds.
    runs : dict
        Trained monitors that fit every point (``train_monitors``), or one dict per point.
    """
    for point, spec in enumerate(points):
        mine = runs[point] if isinstance(runs, (list, tuple)) else runs
        for trial in range(first_trial, first_trial + n_trials):
            yield simulate_trial(spec, mine, root, point, trial, n_epochs, settle_epochs, dumps)
