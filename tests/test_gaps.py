"""Samples that are missing in the middle of a recording: the receiver's time must not stay off."""

import numpy as np
import pytest

from sdr import scenario
from sdr.receiver import Receiver

FS_HZ = 2.6e6
GAP_AT_S = {"G": 23.35, "E": 31.35}


class Dropping:
    """A source of which ``n`` samples from ``at`` on never arrive."""

    def __init__(self, source, at, n):
        self.source, self.at, self.n = source, at, n
        self.fs_hz, self.if_hz, self.n_samples = source.fs_hz, source.if_hz, source.n_samples - n
        self.position = 0

    def read(self, n):
        n0, first = self.position, max(self.at - self.position, 0)
        n = min(n, self.n_samples - n0)
        iq = self.source.read(min(n, first))[1]
        if n > first:
            if n0 <= self.at:
                self.source.read(self.n)
            iq = np.concatenate([iq, self.source.read(n - first)[1]], axis=1)
        self.position += n
        return n0, iq


@pytest.mark.parametrize(
    "system, gap_s",
    # Less than a bit, a whole bit, and both; part of a code period, and a whole CS25_1.
    [("G", 1e-3), ("G", 20e-3), ("G", 137e-3), ("E", 7e-3), ("E", 100e-3)],
)
def test_time_is_right_again_after_a_gap(system, gap_s):
    """Lost channels are back within 2 s, bit edges are compared every 2 s; then comes a header (6 s) or time word (10 s)."""
    right_s = {"G": 11.0, "E": 14.0}[system]
    over = [
        f"front_end.fs_hz={FS_HZ}",
        "sky.start=2024-03-01T12:00:58",  # an ephemeris begins within 2 s
        f"duration_s={GAP_AT_S[system] + right_s + 4.0}",
        "sky.max_satellites=6",
        f'sky.signals=["{"L1CA" if system == "G" else "E1"}"]',
        f'receiver.acquisition.systems=["{system}"]',
        "clock={bias_s=2e-4, drift_s_s=3e-7}",
    ]
    spec, _ = scenario.load("demo-e1", over)
    source = scenario.source(spec)
    at, n = round(GAP_AT_S[system] * FS_HZ), round(gap_s * FS_HZ)
    receiver = Receiver(spec.receiver, Dropping(source, at, n))
    rows = np.concatenate([s for outcome in receiver for s in outcome.solutions])
    t_s = (rows["sample_index"] + np.where(rows["sample_index"] > at, n, 0)) / FS_HZ
    true = source.sky.receiver(t_s)
    late_s = rows["tow_s"] - (source.sky.tow_s + t_s - true["clock_bias_s"])
    before, after = rows["sample_index"] <= at, t_s > GAP_AT_S[system] + right_s
    assert before.sum() > 0 and after.sum() > 3
    # A Galileo receiver alone keeps Galileo's time, which GGTO (below 20 ns) parts from GPS time.
    assert np.all(np.abs(late_s[before | after]) < 1e-7)
    error_m = np.linalg.norm(rows["pos_ecef_m"] - true["pos_ecef_m"], axis=1)
    # Six satellites whose smoothing began a few seconds ago.
    assert np.all(error_m[before | after] < 8.0)
