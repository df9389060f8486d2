"""What a campaign tells: dB between monitors, ROC, real P_FA of quiet points, times and errors with intervals."""

import json
import math

import numpy as np
import pytest

from monitors.detection import clopper_pearson
from sdr import store
from sdr.campaign import figures, results, run, tally
from sdr.campaign.load import from_table
from sdr.campaign.spec import ROC_P_FA, TRIAL
from sdr.campaign.tally import PointCount

TABLE = {
    "name": "told",
    "p_fa": 1e-2,
    "signal_dbw": -164.0,
    "twin": {"signal": "L1CA", "prn": 6, "cn0_dbhz": 40.5, "integration_s": 0.02},
    "jammer": {"kind": "CW", "offset_hz": -22.0, "rate_hz_s": 4.0},
    "monitor": [
        {"name": "fft", "detector": {"kind": "FFT"}},
        {"name": "glrt", "rule": "analytic", "detector": {"kind": "GLRT"}},
    ],
    "grid": {"jammer.power_dbw": [-170.0, -165.0, -160.0, -155.0]},
    "trial": {"epochs": 500, "settle_epochs": 50},
    "training": {"trials": 3, "epochs": 3000},
    "threshold": {"trials": 10, "epochs": 2500},
    "stop": {"max_trials": 12},
    "quiet": {"trials": 15, "epochs": 1000},
    "compare_p_md": 0.2,
}


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    out = tmp_path_factory.mktemp("told") / "told.h5"
    return run.execute(from_table(TABLE), out, workers=1), out


def test_the_real_p_fa_is_counted_on_trials_of_its_own(told):
    result, _ = told
    quiet = [p for p in result["points"] if p["definition"] == "false_alarm"]
    assert [p["monitor"] for p in quiet] == ["fft", "glrt"]
    assert {p["point"] for p in quiet} == {4} and quiet[0]["axes"] == {"jammer.kind": "none"}
    for p in quiet:
        assert p["n"] == 15 * 1000 and p["trials"] == 15
        # 1 % of 15000, fast-fading noise alone: binomial, and the threshold's own 10 % of 25000 quiet values.
        assert p["rate"] == pytest.approx(1e-2, abs=5 * math.sqrt(1e-2 / 15_000 + 1e-2 / 25_000))
        assert 0 < p["p_fa_approach"] <= 1 and p["p_fa_approach_nominal"] == pytest.approx(1.0)
    assert result["epochs"] == sum(p["trials"] * (1000 if p in quiet else 500) for p in result["points"]) / 2


def test_the_roc_passes_through_what_was_counted(told):
    result, _ = told
    for p in result["points"]:
        at = ROC_P_FA.tolist().index(1e-2)
        known = [k for k in p["roc_k"] if k is not None]
        quiet = p["definition"] == "false_alarm"
        assert known == sorted(known, reverse=quiet)  # a smaller P_FA misses more and alarms less
        # The threshold at the campaign's own P_FA: the same rule, or the quiet values' quantile.
        assert p["roc_threshold"][at] == pytest.approx(p["threshold"], rel=0.03)
        assert p["roc_k"][at] == pytest.approx(p["k"], abs=10 + 0.25 * p["k"])


def test_monitors_are_compared_in_db(told):
    result, out = told
    fft, glrt = result["advantages"]
    assert fft["gain_db"] == 0.0 and fft["against"] == glrt["against"] == "fft"
    assert glrt["gain_db"] == pytest.approx(fft["power_db"] - glrt["power_db"])
    low, high = glrt["gain_ci_db"]
    assert 2.0 < low < glrt["gain_db"] < high < 12.0
    with store.read(out) as h5:
        stored = h5["campaign/advantages"][:]
    assert stored["gain_db"].tolist() == [0.0, glrt["gain_db"]]
    text = result["text"].splitlines()
    assert sum("dB against fft" in line for line in text) == 1
    json.dumps(result, allow_nan=False)


def _line(rates, trials=100, n=100, seed=1, definition="all"):
    """Counts of two monitors at four powers with independent tests."""
    c = from_table(TABLE | {"stop": {"max_trials": trials, "definition": definition}, "quiet": None})
    rng = np.random.default_rng(seed)
    counts = [PointCount(c, i) for i in range(4)]
    for point, count in enumerate(counts):
        for t in range(trials):
            r = np.zeros(2, TRIAL)
            r["trial"], r["on_n"] = t, n
            r["on_missed"] = rng.binomial(n, [rates[m][point] for m in range(2)])
            count.add(r)
    return c, counts


def test_interpolated_powers_and_their_interval_cover():
    """Log-odds that are straight lines: the crossing is known, the interval holds it in 95 of 100."""
    x = np.array([-170.0, -165.0, -160.0, -155.0])

    def logistic(centre):
        return 1 / (1 + np.exp(0.6 * (x - centre)))

    # P_MD = 0.2 lies ln(4) / 0.6 beyond the middle; 4 dB between the monitors.
    inside = 0
    for seed in range(60):
        c, counts = _line([logistic(-163.0), logistic(-167.0)], trials=30, seed=seed)
        first, second = tally.advantages(c, counts)
        low, high = second["gain_ci_db"]
        inside += low <= 4.0 <= high
    assert second["power_db"] == pytest.approx(-167 + math.log(4) / 0.6, abs=0.5)
    assert first["power_db"] == pytest.approx(-163 + math.log(4) / 0.6, abs=0.5)
    assert inside >= 57 - 5 * math.sqrt(60 * 0.05 * 0.95)


def test_a_crossing_without_counts_is_not_told():
    c, counts = _line([[1.0, 0.9, 0.7, 0.5], [0.9, 0.5, 0.0, 0.0]])
    first, second = tally.advantages(c, counts)
    assert first["power_db"] is None and second["power_db"] is None and second["gain_db"] is None
    c, counts = _line([[1.0, 0.9, 0.5, 0.1], [0.9, 0.5, 0.1, 0.0]])
    assert tally.advantages(c, counts)[1]["gain_db"] == pytest.approx(5.0, abs=0.5)


def test_medians_by_order_statistics():
    assert tally.median(np.arange(5.0)) == [None, 2.0, None]
    low, middle, high = tally.median(np.arange(100.0))
    assert (low, middle, high) == (39.0, 49.5, 60.0)  # P(Bin(100, 1/2) <= 39) = 0.0176, <= 40: 0.028
    assert tally.median(np.array([1.0] * 4 + [np.inf] * 6))[1] is None
    assert tally.point_rate(np.array([3]), np.array([10]), 0).high == clopper_pearson(0.3, 1)[1]


def test_times_and_errors_have_intervals(told):
    result, out = told
    strong = [p for p in result["points"] if p["axes"].get("jammer.power_dbw") == -155.0]
    for p in strong:
        low, high = p["first_alarm_ci_s"]
        assert low <= p["first_alarm_median_s"] <= high <= p["first_alarm_max_s"]
        for kind in ("code", "smoothed"):
            a, b, c = p[f"undetected_{kind}_error_median_ci_m"]
            assert a <= b <= c <= p[f"undetected_{kind}_error_m"] <= p[f"max_{kind}_error_m"]
    names = {f.stem for f in figures.plot(out)}
    assert {"rates", "p_md_curve", "roc", "first_alarm", "errors"} <= names


def test_a_lost_carrier_is_left_out_of_the_errors_that_were_held(told):
    """Its range error says how long it was lost; what is told of the others is their largest."""
    result, out = told
    c = from_table(TABLE)
    with results.Results(c, out) as kept:
        point = kept.counts[0]
    for trial in point.rows[:-1]:
        trial["lost"], trial["max_code_error_m"] = True, 1e6
    (row, *_) = tally.summarise(c, [point], kept.thresholds)
    assert row["max_code_error_m"] == 1e6 and row["lost_trials"] == len(point.rows) - 1
    assert row["held_max_code_error_m"] == pytest.approx(float(point.rows[-1]["max_code_error_m"][0]))
    assert result["points"][0]["held_max_code_error_m"] < 1e6


def test_a_mask_scan_finds_the_worst_line_by_itself(tmp_path):
    """The published worst line of PRN 6, 227 kHz at -21.29 dB, from lobes of 100 kHz; its powers are those of its lobe."""
    scan = {
        "name": "scan", "p_fa": 1e-2, "signal_dbw": -164.0,
        "twin": {"signal": "L1CA", "prn": 6, "cn0_dbhz": 40.5, "integration_s": 0.02},
        "jammer": {"kind": "NBI", "freq_hz": 0.0, "search_hz": 1e5, "cross_hz_s": 2.0},
        "monitor": [{"name": "fft", "detector": {"kind": "FFT"}}, {"name": "glrt", "detector": {"kind": "GLRT"}}],
        "grid": {"jammer": {"bandwidth_hz": [0.0, 1e4], "offset_hz": [50e3, 250e3, 950e3],
                            "power_dbw": [-175.0, -165.0, -160.0]}},
        "trial": {"epochs": 500, "settle_epochs": 100}, "training": {"trials": 2, "epochs": 3000},
        "threshold": {"trials": 4, "epochs": 6000}, "stop": {"max_trials": 2, "definition": "all"},
    }  # fmt: skip
    result = run.execute(from_table(scan), tmp_path / "scan.h5", workers=1, plots=True)
    assert [(r["bandwidth_hz"], r["monitor"]) for r in result["mask"]] == [
        (0.0, "fft"), (0.0, "glrt"), (1e4, "fft"), (1e4, "glrt"),
    ]  # fmt: skip
    tone, _, noise, _ = result["mask"]
    assert tone["worst_offset_hz"] == 250e3 and tone["worst_line_hz"] == 227e3
    assert tone["worst_line_db"] == pytest.approx(-21.29, abs=0.01)
    assert noise["worst_line_hz"] is None
    assert tone["mask_dbw"] == -150.5 and noise["mask_dbw"] == pytest.approx(-143.57, abs=0.01)
    at = [p for p in result["points"] if p["monitor"] == "fft" and p["axes"]["jammer.offset_hz"] == 250e3]
    at = [p for p in at if p["axes"]["jammer.bandwidth_hz"] == 0.0]
    assert tone["loss_1db_dbw"] == min(
        p["axes"]["jammer.power_dbw"] for p in at if 40.5 - p["cn0_dbhz"] >= 1.0
    )
    assert tone["detected_dbw"] == min(p["axes"]["jammer.power_dbw"] for p in at if p["rate"] < 0.5)
    assert "line 227 kHz (-21.29 dB)" in result["text"]
    with store.read(tmp_path / "scan.h5") as h5:
        rows = h5["campaign/mask"][:]
    assert rows["worst_line_hz"][0] == 227e3 and np.isnan(rows["worst_line_hz"][2])
    assert (tmp_path / "scan" / "mask.png").exists()
