"""Trials of the twin through a set of monitors: seeds, sums of dumps, and monitors that fit a twin.

A trial's seed is ``SeedSequence(root, spawn_key=(point, trial))``: it replays alone and does not depend on
how trials are shared out. Use different roots for training, threshold and evaluation.
"""

import numpy as np

from monitors.glrt import GlrtMonitor
from signals.modulation import SIGNALS
from tracking.correlator_model import TwinCW, jammer_hz

__all__ = ["line_offset_hz", "start_monitors", "sum_dumps", "trial_seed"]


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


def start_monitors(spec, monitors, dumps=1):
    """Runs of monitor Specs for the taps, code and front-end filter of a twin, untrained."""
    args = spec.tap_array_chips, spec.integration_s * dumps, spec.signal, spec.prn, spec.waveform
    return {name: _behind_filter(monitor, spec).start(*args) for name, monitor in monitors.items()}


def _behind_filter(monitor, spec):
    if spec.bandwidth_hz is None or not isinstance(monitor, GlrtMonitor) or monitor.bandwidth_hz is not None:
        return monitor
    return monitor.model_copy(update={"bandwidth_hz": spec.bandwidth_hz})


def line_offset_hz(spec, t_s):
    """Offset of the first CW from its nearest code line, Hz; NaN where there is none."""
    cw = next((j for j in spec.jammers if isinstance(j, TwinCW)), None)
    if cw is None:
        return np.full(len(t_s), np.nan)
    line_hz = 1.0 / SIGNALS[spec.signal].code_period_s
    f = jammer_hz(spec, cw) + cw.rate_hz_s * t_s
    off = f - np.round(f / line_hz) * line_hz
    return np.where((t_s >= cw.start_s) & (t_s < cw.end_s), off, np.nan)
