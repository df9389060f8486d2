"""Samples that are missing in the middle of a recording: time comes right again, the hole is told, no fix is wrong."""

import numpy as np
import pytest

from nav import pvt
from nav.records import SATELLITE
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
    "system, gap_s, n_satellites",
    # Less than a bit, a whole bit, and both; part of a code period, and a whole CS25_1; nothing to test the ranges with.
    [("G", 1e-3, 6), ("G", 20e-3, 6), ("G", 137e-3, 6), ("G", 20e-3, 4), ("E", 7e-3, 6), ("E", 100e-3, 6)],
)
def test_a_gap_is_told_and_no_position_is_wrong(system, gap_s, n_satellites):
    """Lost channels are back within 2 s, bit edges are compared every 2 s; then comes a header (6 s) or time word (10 s)."""
    right_s = {"G": 11.0, "E": 14.0}[system]
    over = [
        f"front_end.fs_hz={FS_HZ}",
        "sky.start=2024-03-01T12:00:58",  # an ephemeris begins within 2 s
        f"duration_s={GAP_AT_S[system] + right_s + 4.0}",
        f"sky.max_satellites={n_satellites}",
        f'sky.signals=["{"L1CA" if system == "G" else "E1"}"]',
        f'receiver.acquisition.systems=["{system}"]',
        "clock={bias_s=2e-4, drift_s_s=3e-7}",
    ]
    spec, _ = scenario.load("demo-e1", over)
    source = scenario.source(spec)
    at, n = round(GAP_AT_S[system] * FS_HZ), round(gap_s * FS_HZ)
    receiver = Receiver(spec.receiver, Dropping(source, at, n))
    outcomes = list(receiver)
    rows = np.concatenate([s for outcome in outcomes for s in outcome.solutions])
    t_s = (rows["sample_index"] + np.where(rows["sample_index"] > at, n, 0)) / FS_HZ
    true = source.sky.receiver(t_s)
    late_s = rows["tow_s"] - (source.sky.tow_s + t_s - true["clock_bias_s"])
    before, after = rows["sample_index"] <= at, t_s > GAP_AT_S[system] + right_s
    assert before.sum() > 0 and after.sum() > 3
    # A Galileo receiver alone keeps Galileo's time, which GGTO (below 20 ns) parts from GPS time.
    assert np.all(np.abs(late_s[before | after]) < 1e-7)
    error_m = np.linalg.norm(rows["pos_ecef_m"] - true["pos_ecef_m"], axis=1)
    # Few satellites whose smoothing began a few seconds ago; a time error of a millisecond moves them by 0.8 m.
    assert np.all(error_m < (8.0 if n_satellites == 6 else 30.0))
    # Positions hold a range to metres, and the disturbance shows in the integration of 20 ms that holds it or the next.
    (hole,) = np.concatenate([h for outcome in outcomes for h in outcome.holes])
    assert abs(hole["missing_s"] - gap_s) < 1e-7
    assert abs(hole["t_s"] - GAP_AT_S[system]) < 0.045
    assert GAP_AT_S[system] < hole["seen_s"] < GAP_AT_S[system] + right_s


def eight_satellites(rng):
    """(SATELLITE rows, unit vectors, metres a second of an error of time, design rows) of a random sky."""
    sats, n = np.zeros(8, SATELLITE), 8
    los = rng.standard_normal((n, 3))
    los[:, 2] = np.abs(los[:, 2])
    los /= np.linalg.norm(los, axis=1, keepdims=True)
    sats["vel_ecef_mps"] = 3000.0 * rng.standard_normal((n, 3)) / np.sqrt(3)
    slide = np.einsum("ij,ij->i", los, sats["vel_ecef_mps"])
    return sats, los, slide, np.column_stack([-los, np.ones(n)])


def test_a_common_error_of_time_is_told_from_one_wrong_range():
    """Eight satellites, ranges of 1 m noise: 40 ms late on all is one unknown, 60 m on one is not."""
    rng, n = np.random.default_rng(5), 8
    sats, los, slide, h = eight_satellites(rng)
    state = np.array([30.0, -20.0, 10.0, 1e3])
    noise, one = rng.standard_normal(n), np.eye(n)[3]
    args = sats, los, np.ones(n), np.zeros(n), np.ones(n, np.uint8)
    for tau_s, wrong_m in ((0.0, 0.0), (40e-3, 0.0), (0.0, 60.0)):
        y = h @ state + slide * tau_s + wrong_m * one + noise
        estimate_s, sigma_s, chi2, rest, without = pvt.time_error(*args, y, 4)
        assert wrong_m or abs(estimate_s - tau_s) < 5 * sigma_s
        full = np.column_stack([h, slide])
        fit = [float(np.sum((y - m @ np.linalg.lstsq(m, y)[0]) ** 2)) for m in (h, full)]
        seven, ranges = np.delete(h, 3, 0), np.delete(y, 3)
        left_out = float(np.sum((ranges - seven @ np.linalg.lstsq(seven, ranges)[0]) ** 2))
        assert np.allclose([chi2, rest], fit) and without <= left_out * (1 + 1e-6)
        if tau_s:
            with pytest.raises(pvt.Late, match="40 ± "):
                pvt.refuse_late(*args, y, 4, 1e-5, False)
        else:
            pvt.refuse_late(*args, y, 4, 1e-5, False)


@pytest.mark.parametrize("sigma_m", [1.0, 2.0, 3.0, 5.0])
def test_noise_larger_than_believed_is_seldom_an_error_of_time(sigma_m):
    """1 m believed: the gain over the scatter left is F(1, dof - 1) whatever the noise, and must pass chi-square's quantile."""
    from scipy.stats import f

    rng, n, trials, p_fa = np.random.default_rng(11), 8, 3000, 1e-5
    late = 0
    for _ in range(trials):
        sats, los, _, _ = eight_satellites(rng)
        try:
            pvt.refuse_late(
                sats, los, np.ones(n), np.zeros(n), np.ones(n, np.uint8), sigma_m * rng.standard_normal(n), 4, p_fa, False
            )  # fmt: skip
        except pvt.Late:
            late += 1
    most = float(f.sf(pvt.chi2_threshold(1, p_fa), 1, n - 4 - 1))
    assert late <= trials * most + 5 * np.sqrt(trials * most)
