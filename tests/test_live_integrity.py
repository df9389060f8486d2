"""Integrity monitors on the live navigation stage: theory of each statistic, faults found, answers, and silence when off.

Ranges are exact geometry plus white noise of known sigma (``naive_pvt``), so that every null distribution is known.
"""

import numpy as np
import pytest
from naive_pvt import FS_HZ, ephemerides, make_sky, transmit
from pydantic import ValidationError

from monitors.protection import SLOPE_STEP, protection_levels, quick_levels
from nav.navigator import NavigationSpec
from nav.navlog import REMEDY, Remedy
from sdr.integrity import IntegritySpec, Limits
from sdr.respond import RespondSpec
from sdr.scenario import ReceiverSpec
from sdr.watch.post import report_lines
from signals.constants import METRES_PER_CHIP
from tracking.lock import STATE_LOCKED
from tracking.records import EPOCH

Z = 5.0
SIGMA_M = 1.5
RATE_HZ = 5.0
T0 = 30.0
# The clock of the sky is perfect and the antenna at rest: the filter's process noise only has to be larger.
FILTER = {"accel_psd_m2_s3": 0.01, "clock_f_m2_s": 1e-3, "clock_g_m2_s3": 1e-3, "gate_sigma": 50.0}
EKF = {"kind": "ekf", "rate_hz": RATE_HZ, "iono": "none", "sigma_code_m": SIGMA_M, "sigma_atmosphere_m": 1e-3,
       "sigma_doppler_mps": 0.05, "filter": FILTER}  # fmt: skip
LEAST_SQUARES = {
    "iono": "none",
    "smoothing_s": 0.0,
    "sigma_code_m": SIGMA_M,
    "sigma_atmosphere_m": 1e-3,
    "raim": False,
}
GRID = {"grid_m": [-20, -15, -10, -5, 0, 5, 10, 15, 20]}
ALL = {
    "als": {"window_epochs": 60, "settle_epochs": 15},
    "bias_bank": GRID,
    "parallel_filters": {"threshold": 90.0},
    "bank_every": 5,
    "protection": {},
}


@pytest.fixture(scope="module")
def sky():
    return make_sky(duration_s=400.0, max_satellites=10, ionosphere="none")


def fly(sky, navigation, monitors=None, respond=None, n=150, fault=None, sigma_m=SIGMA_M, seed=1):
    """Solutions (n,), position errors (n,), the live monitors, their rows by name."""
    nav = NavigationSpec(**navigation).start(FS_HZ)
    run = None
    if monitors is not None:
        run = IntegritySpec(**monitors).start(RespondSpec(**(respond or {})), FS_HZ)
        run.watch(nav)
    rng, eph = np.random.default_rng(seed), ephemerides(sky)
    solutions, rows = [], {}
    for k in range(n):
        t = T0 + k / RATE_HZ
        observed = transmit(sky, t, sigma_m, 0.05, rng, fault(t) if fault else None)
        row = nav.update(observed, eph, sky.iono_utc, sky.iono_utc, remedy=run.remedy if run else None)
        if row is not None:  # ranges ten times noisier than is believed may look like an error of time
            solutions.append(np.array(row))
        if run is not None:
            for name, part in run(int(observed["sample_index"][0])).items():
                rows.setdefault(name, []).append(part)
    solutions = np.array(solutions)
    error = solutions["pos_ecef_m"] - sky.receiver(solutions["t_s"])["pos_ecef_m"]
    return solutions, np.linalg.norm(error, axis=1), run, {k: np.concatenate(v) for k, v in rows.items()}, nav


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


def found(run, monitor):
    """{satellite: first alarm} of a monitor."""
    return {
        f"{key[0].decode()}{key[1]:02d}": alarms[0]["start_s"]
        for key, alarms in run.alarms[monitor].found.items()
    }


# ------------------------------------------------------------------------------------------------------ bit identity


@pytest.mark.parametrize("navigation", [EKF, LEAST_SQUARES])
def test_listening_monitors_change_no_bit(sky, navigation):
    """All monitors on, respond off, a fault in the air: solutions equal those without monitors, bit for bit."""
    name = sky.satellites[1].name
    fault = lambda t: {name: 12.0 * (t > 40)}  # noqa: E731
    with_none = fly(sky, navigation, fault=fault, n=100)[0]
    solutions, _, run, rows, _ = fly(sky, navigation, ALL, fault=fault, n=100)
    np.testing.assert_array_equal(with_none, solutions)
    assert run.remedy is None and "response" not in rows
    assert name in found(run, "bias_bank")


def test_an_empty_remedy_is_no_remedy(sky):
    """Zero rows, and rows of satellites that are not there, leave the bits alone."""
    a, b = NavigationSpec(**EKF).start(FS_HZ), NavigationSpec(**EKF).start(FS_HZ)
    stranger = np.zeros(1, REMEDY)
    stranger["system"], stranger["prn"], stranger["variance_m2"], stranger["exclude"] = b"G", 63, 1.0, True
    rng = np.random.default_rng(2)
    for k in range(10):
        rows = transmit(sky, T0 + k, 1.0, 0.05, rng)
        one = a.update(rows, ephemerides(sky), sky.iono_utc, sky.iono_utc)
        remedy = Remedy(stranger if k % 2 else np.zeros(0, REMEDY))
        two = b.update(rows, ephemerides(sky), sky.iono_utc, sky.iono_utc, remedy=remedy)
        assert one.tobytes() == two.tobytes()


# ------------------------------------------------------------------------------------------------------ the epoch log


def test_log_reproduces_the_filter(sky):
    """dx = K r of the log, and P+ = (I - K H) P, are those of the navigator's own kernel."""
    _, _, _, _, nav = fly(sky, EKF, {"als": None}, n=40)
    log = nav.log.log(1)
    k, h, p = log.k[0], log.h[0], log.p[0]
    scale = np.sqrt(np.diag(p))
    np.testing.assert_allclose(k @ log.r[0] / scale, nav.log.dx / scale, atol=1e-9)
    np.testing.assert_allclose(
        ((np.eye(9) - k @ h) @ p) / np.outer(scale, scale), nav._p / np.outer(scale, scale), atol=1e-9
    )
    used = log.used[0]
    assert used.sum() == 20 and used[:10].all() and used[nav.log.slots : nav.log.slots + 10].all()


# ------------------------------------------------------------------------------------- each statistic against its theory


def test_null_statistics_are_what_their_thresholds_assume(sky):
    """Innovations chi-square_1, RAIM chi-square_dof over its quantile, no alarm at 1e-6 in 150 epochs of 10 satellites."""
    _, _, run, rows, _ = fly(sky, EKF, ALL, n=150)
    values = rows["innovation"]["value"][100:]
    # Mean of chi-square_1: variance 2; the filter is slightly timid (process noise above the truth's): H P H' is a few
    # per cent of R.
    assert abs(values.mean() - 1) < Z * np.sqrt(2 / len(values)) + 0.05
    from scipy.stats import chi2

    raim = rows["raim"]["value"] * chi2.isf(1e-6, 5)
    # 10 ranges, 5 unknowns.
    assert abs(raim.mean() - 5) < Z * np.sqrt(2 * 5 / len(raim)) + 0.05
    assert not any(found(run, m) for m in ("innovation", "raim", "bias_bank", "parallel_filters"))


def test_als_finds_the_noise_it_was_not_told(sky):
    """True sigma four times the claimed: estimated within 5 / sqrt(2 N) each, and reported as alarm; nothing changes."""
    _, _, run, rows, _ = fly(
        sky, EKF, {"als": {"window_epochs": 100, "settle_epochs": 15}}, n=120, sigma_m=4 * SIGMA_M
    )
    sigma = rows["als"]["estimate_m"]
    assert sigma.size == 10
    # The diagonal is estimated jointly from the innovations: a little wider than 1/sqrt(2N) of a lone satellite.
    assert np.all(np.abs(sigma / (4 * SIGMA_M) - 1) < 1.3 * Z / np.sqrt(200))
    assert abs(sigma.mean() / (4 * SIGMA_M) - 1) < Z / np.sqrt(200 * 10) + 0.02
    assert len(found(run, "als")) == 10


def test_redundant_measurements_tell_the_noise_of_a_first_order_loop():
    """A simulated loop: variance of the replica's phase from the differences of its discriminators, no truth needed."""
    rng, bt_hz, t_s, n = np.random.default_rng(4), 5.0, 0.02, 20_000
    a = 4 * bt_hz * t_s / (1 + 2 * bt_hz * t_s)
    noise = rng.standard_normal(n)
    x, error, state = np.empty(n), np.empty(n), 0.0
    for k in range(n):
        x[k] = state
        error[k] = -state + noise[k]
        state += a * error[k]
    run = IntegritySpec(noise_rmd={"window": n - 1, "pairing": "two_channel"}).start(RespondSpec(), 1e6)
    epochs = np.zeros(n, EPOCH)
    epochs["sample_index"], epochs["n_samples"] = np.arange(n) * 20_000, 20_000
    epochs["state"], epochs["code_error_chips"], epochs["cn0_dbhz"] = STATE_LOCKED, error, 60.0
    spec = ReceiverSpec(tracking={"l1ca": {"dll_bw_hz": bt_hz}})
    for part in np.array_split(epochs, 3):
        run.hear(
            {("L1CA", 1): 2}, np.tile(part, (4, 1)), np.array([0, len(part), len(part), 0]), spec.tracking
        )
    got = run._noise.estimate()["G01"] / METRES_PER_CHIP**2
    # Relative standard error of both mean squares below sqrt(2/n) times a correlation factor of 2.
    assert abs(got / x.var() - 1) < Z * 2 * np.sqrt(2 / n)
    assert abs(x.var() - a / (2 - a)) < Z * 2 * np.sqrt(2 / n) * a / (2 - a)


def test_levels_from_the_table_bound_the_exact_ones():
    """Never below the exact level, at most one step of the table (1 %) and the bisection's 1e-4 above."""
    az, el = np.radians([20, 75, 140, 200, 255, 310, 0]), np.radians([35, 18, 42, 25, 55, 15, 80])
    h = np.column_stack([-np.cos(el) * np.sin(az), -np.cos(el) * np.cos(az), -np.sin(el), np.ones(7)])
    var = np.linspace(1.0, 9.0, 7)
    exact, got = protection_levels(h, var, Limits()), quick_levels(h, var, Limits())
    for mine, theirs in zip(got, (exact.hpl_m, exact.vpl_m)):
        assert theirs * (1 - 2e-4) < mine < theirs * (SLOPE_STEP + 2e-4)


# --------------------------------------------------------------------------------------------------- faults and answers


@pytest.mark.parametrize("navigation", [EKF, LEAST_SQUARES])
def test_bias_of_ten_metres_is_named_and_removed(sky, navigation):
    name = sky.satellites[1].name
    fault = lambda t: {name: 10.0 * (t >= 40)}  # noqa: E731
    clean = fly(sky, navigation)[0]
    solutions, _, run, rows, _ = fly(sky, navigation, {"bias_bank": GRID}, {"bias": True}, fault=fault)
    assert list(found(run, "bias_bank")) == [name] and found(run, "bias_bank")[name] < 45.0
    answered = rows["response"][rows["response"]["t_s"] > 46]
    assert np.all(answered["prn"] == int(name[1:]))
    if navigation is LEAST_SQUARES:
        assert np.all(answered["bias_m"] == 10.0)
    # A filter's is estimated: 90 ranges of 1.5 m or more, a third of each at least to tell it from the position.
    sigma = SIGMA_M / np.sqrt(90 / 3)
    assert abs(answered["bias_m"][-1] - 10.0) < Z * sigma
    moved = np.linalg.norm(solutions["pos_ecef_m"] - clean["pos_ecef_m"], axis=1)
    declared = solutions["t_s"] > found(run, "bias_bank")[name] + 0.1
    # The same noise with and without fault: least squares with the very bias of the grid is as if there were none; a filter
    # keeps what its estimate is wrong by.
    assert moved[declared][-50:].max() < (1e-4 if navigation is LEAST_SQUARES else Z * sigma)
    assert moved[~declared].max() > 0.3
    late = solutions["t_s"] > 50
    chi2, dof = solutions["chi2"][late].sum(), solutions["dof"][late].sum()
    # The filter claims a little too much noise: 5 %.
    assert abs(chi2 / dof - 1) < Z * np.sqrt(2 / dof) + 0.05


def test_ramp_is_named_excluded_and_undone(sky):
    """1 ft/s on one satellite: parallel filters and innovations accuse it alone; navigation returns to its accuracy."""
    name = "G27"
    fault = lambda t: {name: 0.3048 * max(t - 40, 0.0)}  # noqa: E731
    monitors = {"parallel_filters": {"threshold": 90.0}, "bank_every": 5}
    respond = {"exclude": ["parallel_filters", "innovation"], "reset": True}
    _, off, _, _, _ = fly(sky, EKF, monitors, fault=fault, n=300)
    solutions, on, run, rows, _ = fly(sky, EKF, monitors, respond, fault=fault, n=300)
    accused = found(run, "parallel_filters")
    # Among its equals: of these ten satellites, G20 and E01 are alike to 0.84 and are confused at this size.
    assert min(accused, key=accused.get) == name
    assert set(rows["response"]["prn"][rows["response"]["exclude"]]) == {int(name[1:])}
    late = solutions["t_s"] > 80
    assert rms(on[late]) < 0.5 * rms(off[late])
    assert np.all(solutions["n_used"][late] == 9)


def test_noise_goes_into_the_filter(sky):
    """Ranges noisier by 10: with ALS acting the mean NIS is within 20 % of its degrees of freedom, without it 50 or more."""
    monitors = {"als": {"window_epochs": 60, "settle_epochs": 15}}
    a, off, _, _, _ = fly(sky, EKF, monitors, n=300, sigma_m=15.0)
    b, on, _, _, _ = fly(sky, EKF, monitors, {"noise": "als"}, n=300, sigma_m=15.0)
    late = a["t_s"] > T0 + 35
    ratio = [x["chi2"][late].sum() / x["dof"][late].sum() for x in (a, b)]
    # Half of the rows are rates, which stay as they are: (100 + 1) / 2.
    assert ratio[0] > 35 and 0.8 < ratio[1] < 1.2
    assert rms(on[late]) < rms(off[late])
    claimed = np.sqrt(np.trace(b["cov_ecef_m2"][late], axis1=1, axis2=2).mean())
    assert 0.4 < rms(on[late]) / claimed < 2.0


def test_an_excluded_satellite_stays_under_test_and_comes_back(sky):
    name = sky.satellites[2].name
    fault = lambda t: {name: 30.0 * (40 <= t < 45)}  # noqa: E731
    solutions, _, run, rows, _ = fly(
        sky, EKF, {}, {"exclude": ["innovation"], "hold_s": 4.0}, n=150, fault=fault
    )
    n_used = solutions["n_used"][1:]
    t = solutions["t_s"][1:]
    assert np.all(n_used[(t > 40.5) & (t < 45)] == 9) and np.all(n_used[t > 50] == 10)
    mine = rows["innovation"][rows["innovation"]["prn"] == int(name[1:])]
    assert np.any(np.isclose(mine["t_s"], 44.8)) and list(found(run, "innovation")) == [name]


def test_fallback_to_the_constellation_that_agrees(sky):
    """Two GPS satellites of five lie: too many to name within GPS, so Galileo alone navigates."""
    sky = make_sky(duration_s=100.0, max_satellites=13, ionosphere="none")
    gps = [s.name for s in sky.satellites if s.system == "G"]
    galileo = [s.name for s in sky.satellites if s.system == "E"]
    assert len(galileo) >= 6
    fault = lambda t: {n: 60.0 * (1 + k) * (t >= 40) for k, n in enumerate(gps[:3])}  # noqa: E731
    _, off, _, _, _ = fly(sky, LEAST_SQUARES, {}, fault=fault, n=100)
    solutions, on, _, _, nav = fly(sky, LEAST_SQUARES, {}, {"fallback": True}, fault=fault, n=100)
    late = solutions["t_s"] > 42
    assert rms(on[late]) < 0.2 * rms(off[late])
    assert np.all(solutions["n_used"][late] == len(galileo)) and set(nav.used) == set(galileo)


# --------------------------------------------------------------------------------------------- unavailable, never broken


def test_too_few_satellites_are_said_and_the_receiver_goes_on():
    sky = make_sky(duration_s=60.0, signals=("L1CA",), max_satellites=5, ionosphere="none")
    solutions, _, run, rows, _ = fly(sky, LEAST_SQUARES, ALL, n=5)
    assert len(solutions) == 5 and np.all(solutions["valid"])
    report = {m["name"]: m for m in run.report()}
    assert (
        "6 satellites" in report["raim"]["unavailable"]
        and "6 satellites" in report["bias_bank"]["unavailable"]
    )
    for name in ("innovation", "als", "parallel_filters"):
        assert "Kalman" in report[name]["unavailable"] and report[name]["tests"] == 0
    assert np.all(np.isfinite(rows["protection"]["hpl_m"])) and "protection" not in report


def test_an_infinite_protection_level_is_said_once():
    """Four satellites of one constellation: no level, one row and one line that say why; with a fifth it is gone."""
    sky = make_sky(duration_s=60.0, signals=("L1CA",), max_satellites=4, ionosphere="none")
    _, _, run, rows, _ = fly(sky, LEAST_SQUARES, {"raim": None, "protection": {}}, n=15)
    assert len(rows["protection"]) == 3 and np.all(np.isinf(rows["protection"]["vpl_m"]))
    (said,) = [m for m in run.report() if m["name"] == "protection"]
    assert "5 satellites" in said["unavailable"] and said["unavailable_epochs"] == 3
    assert sum("protection" in line for line in report_lines(run.report(), [])) == 1
    snap, far = run._navigator.snapshot, np.array([[0.6, 0.0, 0.8]])
    more = snap._replace(
        names=[*snap.names, "G99"], los=np.vstack([snap.los, far]), second=np.zeros(5), residual_m=np.zeros(5),
        variance_m2=np.ones(5), own_m2=np.ones(5), use=np.ones(5, bool),
    )  # fmt: skip
    run._ranges(more, 0, 60.0, out := {})
    assert np.isfinite(out["protection"]["vpl_m"][0]) and run.alarms["protection"].reason is None


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("own", -1.0, "above zero"),
        ("own", 0.0, "above zero"),
        ("own", np.nan, "above zero"),
        ("z", np.nan, "finite"),
        ("z", np.inf, "finite"),
        ("los", None, "singular"),
    ],
)
def test_numbers_that_are_no_good_are_said_and_the_monitors_go_on(sky, field, value, words):
    """One row, for twenty epochs, in what the monitors read: a sentence each, no warning, and as before afterwards."""
    nav = NavigationSpec(**EKF).start(FS_HZ)
    run = IntegritySpec(**ALL).start(RespondSpec(bias=True, exclude=["raim"]), FS_HZ)
    run.watch(nav)
    rng, eph, said = np.random.default_rng(1), ephemerides(sky), set()
    for k in range(60):
        observed = transmit(sky, T0 + k / RATE_HZ, SIGMA_M, 0.05, rng)
        nav.update(observed, eph, sky.iono_utc, sky.iono_utc)
        snap, bad = nav.snapshot, 20 <= k < 40
        if bad and field == "los":
            nav.snapshot = snap._replace(los=np.tile(snap.los[:1], (len(snap.los), 1)))
        elif bad:
            array = getattr(nav.log, field)
            array[0] = value
            mine = np.where(
                np.arange(len(snap.names)) == 0, value, snap.own_m2 if field == "own" else snap.residual_m
            )
            nav.snapshot = snap._replace(**{"own_m2" if field == "own" else "residual_m": mine})
        rows = run(int(observed["sample_index"][0]))
        if bad:
            said |= {a.reason for a in run.alarms.values() if a.reason}
            assert "raim" not in rows and "bias_bank" not in rows
    assert any(words in reason for reason in said)
    assert (
        np.isfinite(rows["bias_bank"]["value"][0])
        and rows["raim"]["value"][0] < 1.0
        and len(rows["innovation"]) == 10
    )


def test_no_position_is_said(sky):
    nav = NavigationSpec(**EKF).start(FS_HZ)
    run = IntegritySpec(**ALL).start(RespondSpec(bias=True), FS_HZ)
    run.watch(nav)
    rows = transmit(sky, T0)[:2]
    assert nav.update(rows, ephemerides(sky), remedy=run.remedy) is None
    assert run(int(T0 * FS_HZ)) == {}
    assert all(m["unavailable"] for m in run.report() if m["name"] != "noise_rmd")


@pytest.mark.parametrize(
    ("receiver", "words"),
    [
        ({"respond": {"noise": "als"}}, ["als", "receiver.integrity.als"]),
        ({"integrity": {}, "respond": {"bias": True}}, ["bias_bank"]),
        ({"integrity": {}, "respond": {"exclude": ["magic"]}}, ["innovation"]),
        ({"integrity": {"bias_bank": {"grid_m": [1, 2]}}}, ["0 (no bias)"]),
        ({"integrity": {"raim": {"p_false_alarm": 2}}}, ["p_false_alarm"]),
    ],
)
def test_refusals(receiver, words):
    with pytest.raises(ValidationError) as error:
        ReceiverSpec.model_validate(receiver)
    assert all(w in str(error.value) for w in words)


def test_a_weakened_satellite_counts_less_and_a_factor_below_one_changes_no_bit(sky):
    nav = NavigationSpec(**LEAST_SQUARES)
    eph, rng = ephemerides(sky), np.random.default_rng(3)
    observed = transmit(sky, T0, SIGMA_M, 0.05, rng, None)
    bad = observed.copy()
    bad["tow_tx_frac_s"][0] -= 30.0 / 299_792_458.0
    rows = np.zeros(1, REMEDY)
    rows["system"], rows["prn"], rows["variance_m2"] = observed["system"][0], observed["prn"][0], np.nan

    def fix(transmitted, remedy=None):
        run = nav.start(FS_HZ)
        run.update(transmitted, eph, sky.iono_utc, sky.iono_utc)  # the first fix sets the clock
        return run.update(transmitted, eph, sky.iono_utc, sky.iono_utc, remedy=remedy)["pos_ecef_m"]

    assert np.array_equal(fix(bad), fix(bad, Remedy(rows)))
    moved = np.linalg.norm(fix(bad) - fix(observed))
    rows["weaken"] = 1e6
    assert np.linalg.norm(fix(bad, Remedy(rows)) - fix(observed, Remedy(rows))) < 0.01 * moved


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["receiver.integrity.bias_bank.grid_m=[5, 10]"], ["bias_bank", "contain 0 (no bias)"]),
        (["receiver.integrity.bias_bank.grid_m=[0, 5, 5]"], ["no value twice"]),
        (["receiver.integrity.als.window_epochs=20", "receiver.integrity.als.n_lags=20"], ["20 lags"]),
        (["receiver.integrity.parallel_filters.r0_m2=-1"], ["r0_m2", "greater than or equal to 0"]),
        (["receiver.integrity.parallel_filters.period_epochs=17"], ["multiple of the 3"]),
        (["receiver.integrity.noise_rmd.r0_m2=-1"], ["r0_m2"]),
        (["receiver.steering.code_noise_m=0"], ["code_noise_m", "greater than 0"]),
        (["receiver.navigation={kind='least_squares'}"], ["smoothing_s = 0"]),
        (["receiver.integrity={}"], ["receiver.respond", "add [receiver.integrity."]),
    ],
)
def test_bad_settings_are_one_sentence_on_the_command_line(overrides, words, capsys, monkeypatch):
    """Exit code 2, one line that says what is wrong, where, and what is allowed."""
    from sdr.__main__ import main

    arguments = [part for item in overrides for part in ("--set", item)]
    monkeypatch.setattr("sys.argv", ["gnssbb", "run", "integrity-ut-ramp", *arguments])
    with pytest.raises(SystemExit) as end:
        main()
    said = capsys.readouterr().err.strip()
    assert end.value.code == 2 and "\n" not in said and all(w in said for w in words), said
