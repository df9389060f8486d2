"""Rare events: splitting and importance sampling against plain counting, their intervals, their seeds."""

import math

import numpy as np
import pytest

from monitors.rare import Splitting, repeated_rate
from sdr.campaign import tally, trials
from sdr.campaign.load import from_table
from sdr.campaign.spec import THRESHOLD

Z = 5.0
# Three taps and a tone far below the noise: the code error is that of thermal noise in the loop.
TABLE = {
    "name": "rare",
    "signal_dbw": -164.0,
    "p_fa": 1.6e-5,
    "twin": {
        "signal": "L1CA", "prn": 6, "cn0_dbhz": 40.5, "integration_s": 0.02, "early_late_space_chips": 1.0,
        "taps_chips": [-0.65, 0.0, 0.65],
    },
    "jammer": {"kind": "CW", "power_dbw": -190.0},
    "monitor": [
        {"name": "glrt", "threshold": 12.0, "detector": {"kind": "GLRT", "guard_chips": [0.0], "noise_variance": 0.00223}}
    ],
    "trial": {"epochs": 150, "settle_epochs": 50, "excess_m": 7.0},
    "training": {"trials": 1, "epochs": 100},
    "stop": {"definition": "excess"},
}  # fmt: skip


def rows(n, threshold=12.0, **changes):
    """TRIAL rows of the first n trials of the only point."""
    c = from_table(TABLE | changes)
    limits = np.zeros(1, THRESHOLD)
    limits["threshold"] = threshold
    return c, trials.evaluate_trials(c.text, 0, 0, n, limits)


def agree(counted, estimates):
    """Difference of a counted rate and a mean of estimates in standard errors."""
    k, n = counted
    p = k / n
    x = np.asarray(estimates)
    error = math.hypot(math.sqrt(p * (1 - p) / n), x.std(ddof=1) / math.sqrt(len(x)))
    return abs(p - x.mean()) / error


def test_splitting_is_unbiased_for_large_errors():
    """The largest of 3 s of code errors with a deviation of 1.96 m: 7 m is rare, but can be counted."""
    c, plain = rows(2000)
    k, n = tally.counted(plain, True, c.spec)
    _, fast = rows(24, method={"kind": "splitting", "particles": 60, "levels": [0.65, 0.8, 0.9]})
    assert 10 < k.sum() < 400
    assert agree((k.sum(), n.sum()), fast["estimate"]) < Z
    # Levels of the pilot change the variance, not the mean.
    _, found = rows(12, method={"kind": "splitting", "particles": 60})
    assert agree((k.sum(), n.sum()), found["estimate"]) < Z
    # 60 paths a repetition, hence with one level P would be known to 1 / sqrt(60 P).
    p = fast["estimate"].mean()
    assert fast["estimate"].std() < math.sqrt(p / 60)


def test_splitting_is_unbiased_for_missed_passes():
    """A pass without an alarm: every epoch must be missed, which no single level would see."""
    event = {
        "jammer": {"kind": "CW", "power_dbw": -165.0, "offset_hz": -80.0, "rate_hz_s": 40.0},
        "p_fa": 1.6e-5, "requirement": "APV-II",
        "trial": {"epochs": 520, "settle_epochs": 50}, "stop": {"definition": "event"},
    }  # fmt: skip
    # Three taps are a weak monitor, and the time to alert of 6 s is part of the event.
    c, plain = rows(1000, threshold=8.4, **event)
    k, n = tally.counted(plain, True, c.spec)
    _, fast = rows(20, threshold=8.4, **event, method={"kind": "splitting", "particles": 40})
    assert n.sum() == 1000 and 10 < k.sum() < 300
    assert agree((k.sum(), n.sum()), fast["estimate"]) < Z
    levels = trials._levels(
        from_table(TABLE | event | {"method": {"kind": "splitting", "particles": 40}}).text, 0, 0, 8.4
    )
    assert np.all(np.diff(levels) > 0) and levels[-1] == 1.0


def test_undetected_errors_are_counted_and_split_alike():
    both = {"stop": {"definition": "undetected"}, "trial": TABLE["trial"] | {"excess_m": 6.0}}
    # A low threshold alarms on a third of the epochs, whatever their error.
    c, plain = rows(1000, threshold=1.1, **both)
    k, n = tally.counted(plain, True, c.spec)
    _, fast = rows(16, threshold=1.1, **both, method={"kind": "splitting", "particles": 60})
    everything, _ = tally.counted(plain, True, from_table(TABLE | {"trial": both["trial"]}).spec)
    assert k.sum() < everything.sum()
    assert agree((k.sum(), n.sum()), fast["estimate"]) < Z


def test_a_repetition_is_a_function_of_its_seed():
    method = {"kind": "splitting", "particles": 20, "levels": [0.7]}
    _, a = rows(4, method=method)
    _, b = rows(2, method=method)
    assert a[:2].tobytes() == b.tobytes()
    assert len(set(a["estimate"].tolist())) > 1
    _, other = rows(4, method=method, seeds={"evaluation": 9})
    assert not np.array_equal(a["estimate"], other["estimate"])


def test_importance_sampling_in_a_campaign_is_what_open_loops_count():
    change = {
        "loop": "open", "stop": {"definition": "all"}, "trial": {"epochs": 20_000},
        "twin": {k: v for k, v in TABLE["twin"].items() if k != "taps_chips"},
        "jammer": {"kind": "CW", "power_dbw": -162.5, "offset_hz": 15.0},
        "monitor": [{"name": "glrt", "detector": {"kind": "GLRT", "noise_variance": 0.00223}}],
    }  # fmt: skip
    c, plain = rows(4, threshold=15.4, **change)
    k, n = tally.counted(plain, True, c.spec)
    _, fast = rows(6, threshold=15.4, **change, method={"kind": "importance", "draws": 4000})
    assert 100 < k.sum() < 1000  # a few per thousand
    assert agree((k.sum(), n.sum()), fast["estimate"]) < Z


def test_intervals_of_repetitions_cover():
    """Log-normal estimates, as products of many factors are: the interval holds the mean in 95 of 100."""
    rng = np.random.default_rng(3)
    for m, sigma in ((10, 0.3), (20, 0.8)):
        inside = 0
        for _ in range(500):
            x = 1e-6 * rng.lognormal(-0.5 * sigma**2, sigma, m)
            _, low, high, _ = repeated_rate(x)
            inside += low <= 1e-6 <= high
        # Skewness of the mean costs a little: less than 3 % of the 95.
        assert inside >= 500 * 0.92 - Z * math.sqrt(500 * 0.92 * 0.08)
    p, low, high, n_eff = repeated_rate([2e-6, 4e-6])
    assert p == pytest.approx(3e-6) and low < p < high
    assert n_eff == pytest.approx(3e-6 / 1e-12, rel=1e-5)
    assert repeated_rate([0.0, 0.0])[1:3] == (0.0, 1.0)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"method": {"kind": "importance"}}, "set loop = 'open'"),
        ({"method": {"kind": "splitting"}, "loop": "open"}, "set loop = 'closed'"),
        ({"method": {"kind": "splitting"}, "stop": {"definition": "hit"}}, "event, excess and undetected"),
        ({"method": {"kind": "splitting", "levels": [0.5, 0.4]}}, "levels must ascend"),
        ({"loop": "open"}, "needs tracking errors"),
        (
            {"method": {"kind": "splitting"}, "stop": {"definition": "event"}, "jammer": {"kind": "NBI", "bandwidth_hz": 1e3, "js_db": 0}},
            "a pass of a CW",
        ),
        (
            {"method": {"kind": "importance"}, "loop": "open", "stop": {"definition": "hit"},
             "jammer": {"kind": "CW", "js_db": 0.0, "rate_hz_s": 2.0}},
            "constant frequency",
        ),
        (
            {"method": {"kind": "splitting"}, "stop": {"definition": "undetected"},
             "monitor": [{"name": "sum", "rule": "gaussian", "detector": {"kind": "GLRT", "guard_chips": [0.0], "accumulate_epochs": 5}}]},
            "single epochs",
        ),
    ],
)  # fmt: skip
def test_what_a_method_cannot_do_is_refused(change, sentence):
    with pytest.raises(ValueError, match=sentence) as err:
        from_table(TABLE | change)
    assert "\n" not in str(err.value)


def test_a_hopeless_pilot_says_what_to_do():
    with pytest.raises(ValueError, match="one whole pass"):
        rows(1, method={"kind": "splitting"}, stop={"definition": "event"})
    assert Splitting(levels=(0.2, 0.5)).levels == (0.2, 0.5)
