"""Structured arrays that leave this package.

A monitor is a Spec; ``spec.start(taps_chips, integration_s, signal, prn, waveform)`` gives a Run.
``run.train(corr)`` learns the quiet state (call it as often as there is training data), ``run(corr)``
returns STATISTIC. ``corr`` is complex64 (n, K) as it leaves tracking, in any unit that is the same for
training and test. Statistics grow with interference; decisions are derived elsewhere
(``monitors.threshold``, ``monitors.detection``).
"""

import numpy as np

__all__ = ["ALARM", "STATISTIC", "alarms", "checked_corr", "statistics"]

STATISTIC = np.dtype(
    [
        ("sample_index", "u8"),  # first sample of the last epoch that entered the statistic; 0 if not told
        ("epoch", "i8"),  # index of that epoch since the monitor started
        ("t_s", "f8"),  # end of that epoch, counted from the monitor's start
        ("value", "f8"),
        ("frequency_hz", "f8"),  # where the statistic peaks, relative to the carrier; NaN without meaning
    ]
)
"""One value of one monitor on one channel."""

ALARM = np.dtype(
    [
        ("monitor", "S16"),
        ("signal", "S4"),
        ("prn", "i4"),
        ("start_s", "f8"),
        ("end_s", "f8"),
        ("peak", "f8"),
        ("threshold", "f8"),
        ("frequency_hz", "f8"),  # at the peak
    ]
)
"""A stretch of time during which a statistic was at or above its threshold."""


def statistics(values, epochs, integration_s, frequency_hz=np.nan, sample_index=None):
    """STATISTIC from columns; ``sample_index`` u8, one of each value's last epoch."""
    out = np.zeros(len(values), STATISTIC)
    out["value"], out["epoch"], out["frequency_hz"] = values, epochs, frequency_hz
    out["t_s"] = (out["epoch"] + 1) * integration_s
    if sample_index is not None:
        out["sample_index"] = sample_index
    return out


def alarms(statistic, threshold, monitor, signal="", prn=0, gap_s=0.0, t0_s=0.0):
    """Alarms of a STATISTIC series -> ALARM (m,).

    Values at or above ``threshold`` no further apart than ``gap_s`` belong to one alarm; neighbours in the
    series always do. ``t0_s`` is added to its times.
    """
    on = np.flatnonzero(statistic["value"] >= threshold)
    if len(on) == 0:
        return np.zeros(0, ALARM)
    t_s = statistic["t_s"][on]
    cut = np.flatnonzero((np.diff(on) > 1) & (np.diff(t_s) > gap_s)) + 1
    out = np.zeros(len(cut) + 1, ALARM)
    for alarm, group in zip(out, np.split(on, cut)):
        part = statistic[group]
        peak = part[np.argmax(part["value"])]
        alarm["start_s"], alarm["end_s"] = part["t_s"][0] + t0_s, part["t_s"][-1] + t0_s
        alarm["peak"], alarm["frequency_hz"] = peak["value"], peak["frequency_hz"]
    out["monitor"], out["signal"], out["prn"], out["threshold"] = (
        monitor.encode(),
        signal.encode(),
        prn,
        threshold,
    )
    return out


def checked_corr(corr, n_taps):
    """``corr`` as contiguous complex64 (n, ``n_taps``); refuses another number of taps."""
    corr = np.ascontiguousarray(corr, np.complex64)
    if corr.ndim != 2 or corr.shape[1] != n_taps:
        raise ValueError(
            f"correlator outputs have shape {corr.shape}, the monitor was started for (n, {n_taps})"
        )
    return corr
