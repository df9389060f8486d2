"""Integrity monitors on the filter that steers the channels: normal points of its log, answers, silence when off.

A vector filter (position, velocity, clock) runs at 50 Hz on discriminators of known noise, without samples; the built-in
scenarios do the same on IF.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from monitors.bias_bank import parity_weight, projector
from monitors.normal_points import NormalPoints
from nav.eskf import Eskf
from nav.navlog import Remedy
from nav.steering import LEFT_OUT
from sdr import scenario
from sdr.integrity import IntegritySpec
from sdr.range_monitors import Ranges
from sdr.receiver import Receiver
from sdr.reproduce.live import FS_HZ, N, fly
from sdr.respond import RespondSpec

Z = 5.0
SIGMA_M = 5.0
GRID = {"grid_m": [-20, -15, -10, -5, 0, 5, 10, 15, 20]}
ALL = {
    "als": {"window_epochs": 500, "settle_epochs": 100},
    "bias_bank": GRID,
    "parallel_filters": {"threshold": 90.0, "r0_m2": 0.0},
    "bank_every": 5,
}


def first(run, monitor):
    """{satellite: first alarm} of a monitor."""
    return {f"{k[0].decode()}{k[1]:02d}": v[0]["start_s"] for k, v in run.alarms[monitor].found.items()}


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


def one(satellite, size):
    return size * (np.arange(N) == satellite)


# ------------------------------------------------------------------------------------------------------ normal points


def test_a_normal_point_is_the_weighted_noise_and_the_error_at_the_windows_start():
    """Whatever the filter corrected within the window: without dynamics, z' = H eps_0 + weighted mean of v / g exactly."""
    rng = np.random.default_rng(5)
    n, slots, clock, drift = 4, 6, 2, 3
    points = NormalPoints(n, slots, clock, drift)
    h = rng.standard_normal((2 * slots, n))
    h[:, clock], h[:, drift] = np.r_[np.ones(6), np.zeros(6)], np.r_[np.zeros(6), np.ones(6)]
    filt = Eskf(np.eye(n), 2 * slots)
    eps = rng.standard_normal(n)
    names = [f"G{k:02d}" for k in range(1, 7)]
    for window in range(3):
        start, v = eps.copy(), rng.standard_normal((10, 2 * slots))
        gain = rng.uniform(0.3, 1.0, (10, 2 * slots))
        p0 = filt.p.copy()
        for k in range(10):
            rows = h * gain[k][:, None]
            z = rows @ eps + v[k]
            filt.predict(np.eye(n), 1e-3 * np.eye(n))
            dx = filt.update(z, rows, np.full(2 * slots, 2.0)).copy()
            epoch = np.eye(n), 1e-3 * np.eye(n), rows, z, np.full(2 * slots, 2.0), dx
            points.add(np.zeros(1, int), *(array[None] for array in epoch))
            eps = eps - dx
        assert points.close(window * 1.0, names, np.ones(2 * slots), filt.p) == (window > 0)
        if window == 0:
            continue  # the slots got their names just now
        info = gain**2 / 2.0
        noise = np.sum(info * v / gain, axis=0) / info.sum(axis=0)
        np.testing.assert_allclose(points.z, h @ start + noise, atol=1e-12)
        np.testing.assert_allclose(points.own, 1.0 / info.sum(axis=0), rtol=1e-12)
        last = points.last()
        np.testing.assert_allclose(last.p, p0 + 1e-2 * np.eye(n), rtol=1e-12)
        np.testing.assert_allclose(start - eps, points.dx, atol=1e-12)


def test_statistics_of_normal_points_are_what_their_thresholds_assume():
    """Innovations chi-square_1, RAIM chi-square over its quantile; no alarm in 60 s of ten satellites."""
    from scipy.stats import chi2

    _, run, rows, _ = fly(ALL, seconds=60.0)
    values = rows["innovation"]["value"][10 * N :]
    assert abs(values.mean() - 1) < Z * np.sqrt(2 / len(values))
    raim = rows["raim"]["value"] * chi2.isf(1e-6, N - 5)
    assert abs(raim.mean() - (N - 5)) < Z * np.sqrt(2 * (N - 5) / len(raim))
    assert not any(first(run, m) for m in ("innovation", "raim", "bias_bank", "parallel_filters", "als"))


# ------------------------------------------------------------------------------------------------------ silence


def test_listening_changes_no_bit_of_the_steering_filter():
    fault = lambda t: one(3, 10.0 * (t > 8))  # noqa: E731
    a, _, _, sky_a = fly(None, seconds=16.0, fault=fault)
    b, run, rows, sky_b = fly(ALL, seconds=16.0, fault=fault)
    np.testing.assert_array_equal(a, b)
    assert sky_a.filter.x.tobytes() == sky_b.filter.x.tobytes()
    assert sky_a.filter.p.tobytes() == sky_b.filter.p.tobytes()
    assert run.remedy is None and "response" not in rows and "G04" in first(run, "bias_bank")


# ------------------------------------------------------------------------------------------------------ answers


def test_noise_goes_into_the_steering_filter():
    """GPS six times as noisy as believed: sigma within 5 / sqrt(2 N), NIS within 20 %, a better position."""
    true_m = np.where(np.arange(N) < N // 2, 30.0, 5.0)
    on = {"als": ALL["als"]}
    (a, a_nis, *_), _, _, _ = fly(on, seconds=40.0, sigma_m=true_m)
    (b, b_nis, *_), run, rows, _ = fly(on, {"noise": "als"}, seconds=40.0, sigma_m=true_m)
    late = slice(1300, None)
    # Three quarters of the rows are as believed: (36 + 3) / 4.
    assert a_nis[late].mean() > 8 and 0.8 < b_nis[late].mean() < 1.2
    assert rms(b[late]) < rms(a[late])
    last = rows["als"]["estimate_m"][-N:]
    assert np.all(np.abs(last / true_m - 1) < Z / np.sqrt(2 * 500))
    scale = np.array([run.response.scale[f"{'GE'[k >= N // 2]}{k + 1:02d}"] for k in range(N)])
    np.testing.assert_allclose(scale * SIGMA_M**2, last**2, rtol=1e-9)


def test_a_bias_is_named_and_removed_and_undone():
    fault = lambda t: one(3, 10.0 * (t >= 10))  # noqa: E731
    monitors = {"bias_bank": GRID}
    clean = fly(monitors, seconds=30.0)[0][0]
    off = fly(monitors, seconds=30.0, fault=fault)[0][0]
    (on, nis, *_), run, _, sky = fly(monitors, {"bias": True}, seconds=30.0, fault=fault)
    assert list(first(run, "bias_bank")) == ["G04"] and first(run, "bias_bank")["G04"] < 13.0
    # Ranges of one look, sigma^2 / 10, judged by parity alone, which knows less than the filter.
    look = np.column_stack([-sky.filter.los[:N], np.ones(N), sky.second[:N]])
    sigma_m = SIGMA_M / np.sqrt(10 * 85 * projector(look)[3, 3])
    assert abs(sky.bias[3] - 10.0) < Z * sigma_m and np.count_nonzero(sky.bias) == 1
    late = slice(750, None)
    assert rms(on[late]) < 0.5 * rms(off[late])
    # What is left of the bias reaches the position by less than itself, and is in the claim.
    assert np.abs(on[late] - clean[late]).max() < Z * sigma_m
    assert abs(nis[late].mean() - 1) < 0.1


@pytest.mark.parametrize("fault", [lambda t: 10.0 * (t >= 10), lambda t: 0.6096 * max(t - 10.0, 0.0)])
def test_after_an_answer_errors_are_as_large_as_claimed(fault):
    """10 m or 2 ft/s in 10 m of noise: normalised squared errors of six flights' ends are a chi-square of 18; without, one
    alone is none of 3."""
    from scipy.stats import chi2

    def nees(bias, seed):
        track, *_ = fly(
            {"bias_bank": GRID, "raim": None},
            {"bias": bias},
            35.0,
            10.0,
            lambda t: one(3, fault(t)),
            seed,
            10.0,
        )
        return track[2, -1]

    low, high = chi2.isf([1 - 3e-7, 3e-7], 18)
    assert low < sum(nees(True, seed) for seed in range(6)) < high
    assert nees(False, 0) > chi2.isf(3e-7, 3)


def test_a_ramp_is_named_excluded_and_undone():
    fault = lambda t: one(1, 0.6 * max(t - 10.0, 0.0))  # noqa: E731
    monitors = {"parallel_filters": ALL["parallel_filters"], "bank_every": 5, "raim": None}
    off = fly(monitors, seconds=60.0, fault=fault)[0][0]
    (on, nis, *_), run, rows, sky = fly(
        monitors, {"exclude": ["parallel_filters"], "reset": True}, seconds=60.0, fault=fault
    )
    found = first(run, "parallel_filters")
    assert min(found, key=found.get) == "G02" and set(rows["response"]["prn"]) == {2}
    assert sky.inflate[1] == LEFT_OUT and np.sum(sky.inflate >= LEFT_OUT) == 2
    assert rms(on[-500:]) < 0.3 * rms(off[-500:])
    assert abs(nis[-500:].mean() - 1) < 0.1


def test_an_excluded_satellite_is_judged_by_what_it_would_weigh():
    """Otherwise its statistic vanishes with its weight and it would look well at once."""
    fault = lambda t: one(1, 20.0 * (t >= 5.0))  # noqa: E731
    _, _, rows, _ = fly({}, {"exclude": ["innovation"]}, seconds=15.0, fault=fault)
    mine = rows["innovation"][rows["innovation"]["prn"] == 2]
    assert mine["value"][mine["t_s"] > 8.0].min() > 50.0


# ------------------------------------------------------------------------------------------------- who among the alike


def test_rivals_are_named_until_the_fault_tells_them_apart():
    """Two satellites 12 degrees apart: a small bias accuses one and names the other; a large one is alone."""
    run = IntegritySpec(bias_bank=GRID).start(RespondSpec(), FS_HZ)
    az, el = np.radians([0, 12, 100, 160, 220, 280, 330]), np.radians([30, 32, 50, 20, 60, 15, 70])
    los = np.column_stack([np.cos(el) * np.sin(az), np.cos(el) * np.cos(az), np.sin(el)])
    names, ones = [f"G{k + 1:02d}" for k in range(7)], np.ones(7)
    got = {}
    for size in (4.0, 40.0):
        ranges = run._ranges
        ranges._past.clear()
        h = np.column_stack([-los, ones, np.zeros(7)])
        for k in range(20):
            raw = np.random.default_rng(k).standard_normal(7)
            raw[0] += size * (k >= 19)
            ranges._past.append(Ranges(names, raw, h, ones))
        got[size] = ranges.rivals("G01")
    assert got[40.0] == [] and "G02" in got[4.0]


def test_rivals_are_those_of_the_likelihoods_written_out():
    """2 ln L = (sum s_k (W r)_i)^2 / sum s_k^2 W_ii over biases and ramps since every fourth epoch; a satellite comes and goes."""
    ranges, rng = IntegritySpec().start(RespondSpec(), FS_HZ)._ranges, np.random.default_rng(2)
    az, el = np.radians(45.0 * np.arange(8) + 20 * rng.random(8)), np.radians(rng.uniform(15, 70, 8))
    h = np.column_stack(
        [-np.cos(el) * np.sin(az), -np.cos(el) * np.cos(az), -np.sin(el), np.ones(8), np.zeros(8)]
    )
    names = [f"G{k + 1:02d}" for k in range(8)]
    for k in range(40):
        part = np.flatnonzero((np.arange(8) != 3) | (k % 7 > 2))
        raw = rng.standard_normal(8) + 0.02 * k * (np.arange(8) == 1)
        ranges._past.append(Ranges([names[i] for i in part], raw[part], h[part], np.ones(len(part))))
    table = np.zeros((2, 40, 8))
    for k, e in enumerate(ranges._past):
        w = parity_weight(e.h, e.var)[0]
        table[:, k, [names.index(n) for n in e.names]] = w @ e.raw, np.diag(w)
    best = np.zeros(8)
    for begin in range(0, 40, 4):
        for shape in (np.ones(40 - begin), np.arange(1.0, 41 - begin)):
            best = np.maximum(best, (shape @ table[0, begin:]) ** 2 / (shape**2 @ table[1, begin:]))
    want = [n for n, b in zip(names, best) if n != "G02" and b > best[1] - 2 * np.log(99.0)]
    assert ranges.rivals("G02") == want and 0 < len(want) < 7


def test_parallel_filters_name_whom_they_may_mean():
    """Every alarm carries the satellites that the range monitors find as likely, and they are left out while others can judge."""
    fault = lambda t: one(1, 0.6 * max(t - 10.0, 0.0))  # noqa: E731
    _, run, rows, _ = fly(
        {"parallel_filters": ALL["parallel_filters"], "bank_every": 5}, seconds=45.0, fault=fault
    )
    high = rows["parallel_filters"][rows["parallel_filters"]["value"] >= 90.0]
    assert len(high) and np.all(high["prn"] == 2)
    more = high[-1:].copy()
    for rivals, out in ((["G03", "E06"], {"G03", "E06"}), ([f"E{k:02d}" for k in range(6, 11)], set())):
        run.response = RespondSpec(exclude=["parallel_filters"]).start()
        run._ranges.rivals, run._ranges.response = lambda name, r=rivals: r, run.response
        run._name_rivals(more, 45.0)
        assert more["rivals"][0] == " ".join(rivals).encode() and run.response.out(45.0) == out
    run.response = RespondSpec().start()
    run._name_rivals(more, 45.0)
    assert not run.response.out(45.0)


# ------------------------------------------------------------------------------------------------------- on IF samples


@pytest.mark.slow
@pytest.mark.parametrize("name", ["integrity-ut-bias", "integrity-ramp"])
def test_on_samples_listening_changes_no_bit_and_the_filter_is_watched(name):
    """46 s of a built-in scenario, ultra-tight and scalar: positions and epochs with all monitors on are those without any."""
    quiet = [] if name == "integrity-ramp" else ["jammer=[]"]
    spec = scenario.load(name, ["duration_s=46.0", "fault=[]", *quiet])[0]
    results = []
    for update in ({"respond": RespondSpec()}, {"respond": RespondSpec(), "integrity": None}):
        receiver = Receiver(
            spec.receiver.model_copy(update=update), scenario.source(spec), scenario.sensors(spec)
        )
        results.append((receiver, list(Receiver.__iter__(receiver))))
    (with_all, a), (_, b) = results
    assert (with_all.integrity.steered is not None) == (spec.receiver.steering.mode == "ultra_tight")
    for one_, two in zip(a, b, strict=True):
        for x, y in zip(one_.solutions, two.solutions, strict=True):
            assert x.tobytes() == y.tobytes()
        for (_, x, _), (_, y, _) in zip(one_.epochs, two.epochs, strict=True):
            assert x.tobytes() == y.tobytes()
    judged = np.concatenate([p["innovation"] for o in a for p in o.integrity if "innovation" in p])
    assert len(judged) > 100 and judged["value"].mean() < 2.0


def test_remedies_of_a_steered_receiver_leave_state_and_covariance_with_the_filter():
    """The navigator beside it must not take them."""
    _, run, _, sky = fly({"bias_bank": GRID}, {"bias": True}, seconds=1.0)
    x = sky.filter.x.copy()
    dx = np.zeros(sky.filter.p.shape[0])
    dx[0] = 1.0
    rest = run.steered.hand(Remedy(np.zeros(0), dx, 2.0 * sky.filter.p))
    assert rest.dx is None and rest.p is None and sky.filter.x[0] - x[0] == 1.0
    assert SimpleNamespace(n=run.steered.points.count).n == 0
