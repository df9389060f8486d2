"""The position stage against exact geometry: closure, covariance, smoothing, integrity, reasons for no
fix."""

import numpy as np
import pytest
from naive_pvt import FS_HZ, ephemerides, make_sky, transmit

from nav import kernels, pvt
from nav.measurements import WEEK_MS, Hatch, ReceiverClock, observables, transmit_rows
from nav.navigator import FilterSpec, NavigationSpec
from nav.records import OBSERVATION, TRANSMIT
from signals.clock import ClockSpec
from signals.constants import C_MPS, EARTH_RATE_RAD_S, WAVELENGTH_M
from signals.sky import SkySpec
from signals.trajectory import Line

Z = 5.0


def _fix(sky, spec, times, **kw):
    nav = spec.start(FS_HZ)
    rows = [nav.update(transmit(sky, t, **kw), ephemerides(sky), sky.iono_utc, sky.iono_utc) for t in times]
    return nav, rows


def _error(sky, row):
    truth = sky.receiver([row["t_s"]])[0]
    return row["pos_ecef_m"] - truth["pos_ecef_m"], row["vel_ecef_mps"] - truth["vel_ecef_mps"]


@pytest.mark.parametrize("signals", [("L1CA",), ("E1",), ("L1CA", "E1")])
@pytest.mark.parametrize("kind", ["least_squares", "ekf"])
def test_noise_free_ranges_give_the_position(signals, kind):
    """Below 1 cm and 1 mm/s: what remains is the ICD's Klobuchar step against the truth's continuous form."""
    motion = Line(lat_deg=48.1, lon_deg=11.6, height_m=500.0, vel_ned_mps=(20.0, -10.0, 1.0))
    clock = ClockSpec(bias_s=3e-3, drift_s_s=1e-7)
    sky = make_sky(motion=motion, clock=clock, signals=signals)
    nav, rows = _fix(sky, NavigationSpec(kind=kind, smoothing_s=0), [30.0, 31.0, 32.0])
    for row in rows:
        pos, vel = _error(sky, row)
        assert np.linalg.norm(pos) < 0.01 and np.linalg.norm(vel) < 1e-3, nav.reason
        ggto_s = 0.0 if "L1CA" in signals else sky.iono_utc["a0g_s"]
        truth = sky.receiver([row["t_s"]])[0]
        gps_s = sky.tow_s + row["t_s"] - truth["clock_bias_s"]
        assert row["tow_s"] == pytest.approx(gps_s + ggto_s, abs=3e-10)
        assert row["clock_drift_mps"] == pytest.approx(C_MPS * 1e-7, abs=2e-3)
        assert row["week"] == sky.week and row["valid"]
        if len(signals) == 2:
            assert row["isb_m"] == pytest.approx(-C_MPS * sky.iono_utc["a0g_s"], abs=0.01)
    step = rows[2]["clock_bias_m"] - rows[1]["clock_bias_m"]
    assert step == pytest.approx(C_MPS * 1e-7, abs=0.02)


def test_broadcast_ggto_replaces_the_estimated_bias():
    sky = make_sky()
    for systems in (("G", "E"), ("E",)):
        spec = NavigationSpec(isb="ggto", smoothing_s=0, systems=systems)
        _, (row,) = _fix(sky, spec, [30.0])
        assert np.linalg.norm(_error(sky, row)[0]) < 0.01
        assert row["tow_s"] == pytest.approx(sky.tow_s + 30.0, abs=3e-10) and np.isnan(row["isb_m"])


def test_parameters_not_decoded_are_left_out_and_said():
    sky = make_sky()
    empty = np.zeros((), sky.iono_utc.dtype)
    for iono in (None, empty):
        nav = NavigationSpec(isb="ggto").start(FS_HZ)
        row = nav.update(transmit(sky, 30.0), ephemerides(sky), iono, iono)
        assert len(nav.notes) == 2 and "ionosphere" in nav.notes[1] and "GGTO" in nav.notes[0]
        assert 0.5 < np.linalg.norm(_error(sky, row)[0]) < 30.0 and row["isb_m"] == pytest.approx(
            -1.5, abs=1.0
        )


def test_predicted_range_is_the_inertial_light_time():
    """Independent twin: put satellite and receiver in an inertial frame and iterate the light time there."""
    rng = np.random.default_rng(3)
    sat, sat_vel = rng.standard_normal((6, 3)) * 1.5e7, rng.standard_normal((6, 3)) * 2e3
    rx, rx_vel = np.array([4.2e6, 0.8e6, 4.7e6]), np.array([30.0, -200.0, 100.0])

    def inertial(pos, t):
        a = EARTH_RATE_RAD_S * t
        return np.array(
            [np.cos(a) * pos[0] - np.sin(a) * pos[1], np.sin(a) * pos[0] + np.cos(a) * pos[1], pos[2]]
        )

    def range_at(t_rx, s, v, tau0):
        tau = tau0  # satellite's ECEF position is s at its transmission for t_rx = 0
        for _ in range(8):
            t_tx = t_rx - tau
            tau = (
                np.linalg.norm(inertial(s + v * (t_tx + tau0), t_tx) - inertial(rx + rx_vel * t_rx, t_rx))
                / C_MPS
            )
        return C_MPS * tau

    n = sat.shape[0]
    r, rate, los = np.empty(n), np.empty(n), np.empty((n, 3))
    kernels.predict_ranges(sat, sat_vel, rx, rx_vel, r, rate, los)
    for i in range(n):
        tau0 = r[i] / C_MPS
        assert range_at(0.0, sat[i], sat_vel[i], tau0) == pytest.approx(r[i], abs=1e-6)
        h = 0.5
        slope = (range_at(h, sat[i], sat_vel[i], tau0) - range_at(-h, sat[i], sat_vel[i], tau0)) / (2 * h)
        # third derivative of the range: |v|^3 / r^2 h^2 / 6 < 3e-6 m/s
        assert rate[i] == pytest.approx(slope, abs=1e-5)


def test_week_end_is_crossed():
    """Saturday midnight between transmission and reception: 604799.93 -> 0.00."""
    sky = make_sky(start_time="2024-03-02T23:59:59")
    _, rows = _fix(sky, NavigationSpec(smoothing_s=0), [0.5, 1.03, 1.5])
    for row, t in zip(rows, (0.5, 1.03, 1.5)):
        assert np.linalg.norm(_error(sky, row)[0]) < 0.02
        total = (row["week"] - sky.week) * 604_800 + row["tow_s"] - sky.tow_s
        assert total == pytest.approx(t, abs=1e-9)


@pytest.mark.parametrize("signals", [("L1CA",), ("L1CA", "E1")])
def test_covariance_and_residuals_are_what_they_claim(signals):
    """NEES of the position is chi2_3, the residual sum chi2_(n-m): means within z sqrt(2 k / runs)."""
    sky = make_sky(signals=signals, ionosphere="none", troposphere="none")
    spec = NavigationSpec(iono="none", tropo="none", smoothing_s=0, raim=False, sigma_code_m=2.0)
    rng, runs = np.random.default_rng(11), 400
    clean = transmit(sky, 30.0)
    nav, _ = _fix(sky, spec, [29.0])
    sigma_s = np.sqrt(nav._variance(nav.observations, nav.satellites)) / C_MPS
    eph, nees, chi2, truth = ephemerides(sky), [], [], sky.receiver([30.0])[0]
    for _ in range(runs):
        rows = clean.copy()
        rows["tow_tx_frac_s"] += sigma_s * rng.standard_normal(rows.size)
        row = nav.update(rows, eph)
        e = row["pos_ecef_m"] - truth["pos_ecef_m"]
        nees.append(e @ np.linalg.solve(row["cov_ecef_m2"], e))
        chi2.append(row["chi2"])
    dof = int(row["dof"])
    assert dof == clean.size - (4 if len(signals) == 1 else 5)
    assert np.mean(nees) == pytest.approx(3.0, abs=Z * np.sqrt(6.0 / runs))
    assert np.mean(chi2) == pytest.approx(dof, abs=Z * np.sqrt(2.0 * dof / runs))


def test_dilution_of_precision_is_the_textbook_form():
    sky = make_sky(signals=("L1CA",))
    nav, (row,) = _fix(sky, NavigationSpec(smoothing_s=0), [30.0])
    az, el = nav.satellites["azimuth_rad"], nav.satellites["elevation_rad"]
    h = np.column_stack([-np.cos(el) * np.sin(az), -np.cos(el) * np.cos(az), -np.sin(el), np.ones(az.size)])
    q = np.diag(np.linalg.inv(h.T @ h))
    expected = np.sqrt([q.sum(), q[:3].sum(), q[:2].sum(), q[2]])
    got = [row[name] for name in ("gdop", "pdop", "hdop", "vdop")]
    np.testing.assert_allclose(got, expected, rtol=1e-4)  # Earth rotation in flight turns u by 5e-6


def test_exclusion_identity_equals_solving_without_the_satellite():
    """chi2(all) - chi2(without i) = r_i^2 / (var_i - h_i cov h_i'), exact for the linear problem."""
    rng = np.random.default_rng(5)
    n, m = 9, 5
    los = rng.standard_normal((n, 3))
    los /= np.linalg.norm(los, axis=1, keepdims=True)
    second = (np.arange(n) % 3 == 0).astype(float)
    var, y = rng.uniform(0.5, 4.0, n), rng.standard_normal(n) * 3
    h = np.column_stack([-los, np.ones(n), second])

    def solve(keep):
        w = 1.0 / var[keep]
        cov = np.linalg.inv((h[keep].T * w) @ h[keep])
        x = cov @ (h[keep].T * w) @ y[keep]
        return cov, y - h @ x, float(np.sum(w * (y - h @ x)[keep] ** 2))

    cov, residual, chi2 = solve(np.arange(n))
    drop, use = np.zeros(n), np.ones(n, np.uint8)
    total = kernels.exclusion_drop(los, second, var, residual, use, m, cov, drop)
    assert total == pytest.approx(chi2)
    for i in range(n):
        assert chi2 - drop[i] == pytest.approx(solve(np.delete(np.arange(n), i))[2], abs=1e-9)


def test_raim_keeps_its_false_alarm_rate_and_finds_the_fault():
    sky = make_sky(signals=("L1CA",), ionosphere="none", troposphere="none")
    p_fa, runs, rng = 0.05, 800, np.random.default_rng(2)
    spec = NavigationSpec(iono="none", tropo="none", smoothing_s=0, raim_p_fa=p_fa)
    nav, _ = _fix(sky, spec, [29.0])
    sigma_s = np.sqrt(nav._variance(nav.observations, nav.satellites)) / C_MPS
    clean, eph, alarms = transmit(sky, 30.0), ephemerides(sky), 0
    for _ in range(runs):
        rows = clean.copy()
        rows["tow_tx_frac_s"] += sigma_s * rng.standard_normal(rows.size)
        row = nav.update(rows, eph)
        alarms += row is None or bool(nav.excluded)
    assert alarms / runs == pytest.approx(p_fa, abs=Z * np.sqrt(p_fa * (1 - p_fa) / runs))
    for name in ("G01", "G08"):
        nav, (row,) = _fix(sky, NavigationSpec(iono="none", tropo="none"), [30.0], fault_m={name: 60.0})
        assert nav.excluded == [name] and name not in nav.used
        assert np.linalg.norm(_error(sky, row)[0]) < 0.01


def test_raim_removes_two_faults_even_gross_ones():
    sky = make_sky()
    fault = {"G01": 4e5, "E02": -80.0}
    nav, (row,) = _fix(sky, NavigationSpec(), [30.0], fault_m=fault)
    assert sorted(nav.excluded + [n for n in fault if n not in nav.used + nav.excluded]) == ["E02", "G01"]
    assert np.linalg.norm(_error(sky, row)[0]) < 0.02


def test_five_satellites_detect_but_do_not_name_and_say_so():
    sky = make_sky(prns=("G01", "G04", "G06", "G20", "G31"), signals=("L1CA",))
    nav, (row,) = _fix(sky, NavigationSpec(), [30.0], fault_m={"G04": 500.0})
    assert row is None and "too few to name the faulty one" in nav.reason


def test_without_enough_satellites_the_reason_names_what_is_missing():
    sky = make_sky(prns=("G01", "G04", "G06", "G20"), signals=("L1CA",))
    rows, eph = transmit(sky, 30.0), ephemerides(sky)

    def reason(rows, eph, **spec):
        nav = NavigationSpec(**spec).start(FS_HZ)
        assert nav.update(rows, eph) is None
        return nav.reason

    assert reason(rows[:0], eph) == "no satellite is tracked."
    assert "3 of the 4" in reason(rows, eph[1:]) and "G01 has no ephemeris yet" in reason(rows, eph[1:])
    late = rows.copy()
    late["tow_tx_ms"][2] = -1
    assert "G06 has no transmit time yet" in reason(late, eph)
    sick = eph.copy()
    sick["health"][3] = 1
    assert "G20 is marked unhealthy" in reason(rows, sick)
    assert NavigationSpec(use_unhealthy=True).start(FS_HZ).update(rows, sick) is not None
    old = eph.copy()
    old["toe_s"] = (old["toe_s"] + 6 * 3600) % 604_800
    assert "h old" in reason(rows, old)
    weak = rows.copy()
    weak["cn0_dbhz"][0] = 15.0
    assert "G01 is weaker than 20 dB-Hz" in reason(weak, eph)
    assert "GDOP" in reason(rows, eph, gdop_max=1.01)
    assert "mask" in reason(rows, eph, elevation_mask_deg=60)


def test_degenerate_geometry_is_refused_not_solved():
    """Satellites on one cone around the receiver: the clock cannot be told from the axis."""
    az = np.arange(6) * 1.0
    los = np.column_stack([0.6 * np.cos(az), 0.6 * np.sin(az), np.full(6, 0.8)])
    sats = np.zeros(6, pvt.SATELLITE)
    sats["pos_ecef_m"] = los * 2e7 + np.array([0.0, 0.0, 6.4e6])
    # Earth rotation in flight moves satellites by 100 m: keep the cone exact by removing it from the model.
    start = np.array([0.0, 0.0, 6.4e6, 0.0, 0.0])
    normal, inverse = np.zeros((5, 5)), np.zeros((5, 5))
    use, one = np.ones(6, np.uint8), np.ones(6)
    kernels.normal_equations(los, one, one, one, use, 4, normal, np.zeros(5))
    assert not kernels.invert_symmetric(normal, inverse, 4)
    assert pvt.dilution(los, one, use, 4, start[:3])[0] == np.inf


def test_held_bias_lets_two_and_two_satellites_fix():
    sky = make_sky()
    nav = NavigationSpec(smoothing_s=0, gdop_max=1e4).start(FS_HZ)
    eph = ephemerides(sky)
    nav.update(transmit(sky, 30.0), eph, sky.iono_utc)
    rows = transmit(sky, 31.0)
    four = np.concatenate([rows[rows["system"] == b"G"][[0, 4]], rows[rows["system"] == b"E"][[0, 5]]])
    row = nav.update(four, eph, sky.iono_utc)
    assert row is not None and row["n_used"] == 4, nav.reason
    assert np.linalg.norm(_error(sky, row)[0]) < 0.02 * row["gdop"]


def test_hatch_noise_and_slip():
    """White noise of sigma s after k epochs: s/sqrt(k); at k >> window s sqrt(w/(2-w)), w = dt/window."""
    sigma, dt, window, runs = 1.5, 1.0, 20.0, 2000
    rng = np.random.default_rng(4)
    obs = np.zeros(runs, OBSERVATION)
    obs["prn"], obs["signal"], obs["lock_s"] = np.arange(runs), b"L1CA", 1e3
    hatch = Hatch(window, FS_HZ)
    velocity = -300.0

    def epoch(k, noise=sigma, jump=0.0):
        obs["sample_index"] = round(k * dt * FS_HZ)
        obs["carrier_phase_cycles"] = -velocity * k * dt / WAVELENGTH_M + jump
        obs["pseudorange_m"] = 2.2e7 + velocity * k * dt + noise * rng.standard_normal(runs)
        ratio = hatch.smooth(obs)
        return ratio, obs["pseudorange_smoothed_m"] - (2.2e7 + velocity * k * dt)

    def check(epoch, expected):
        ratio, error = epoch
        np.testing.assert_allclose(ratio, (expected / sigma) ** 2, rtol=1e-3)
        assert np.std(error) == pytest.approx(expected, rel=Z / np.sqrt(2 * runs))
        assert abs(np.mean(error)) < Z * expected / np.sqrt(runs)

    for k in range(1, 11):
        error = epoch(k)
    check(error, sigma / np.sqrt(10))
    for k in range(11, 201):
        error = epoch(k)
    w = dt / window
    check(error, sigma * np.sqrt(w / (2 - w)))
    hatch.shift(1234.5)
    obs["pseudorange_m"] += 1234.5
    obs["cycle_slip"] = True
    check(epoch(201, jump=77.0), sigma)  # restarted
    obs["cycle_slip"] = False
    check(epoch(202, jump=77.0), sigma / np.sqrt(2))


def test_smoothing_survives_the_steering_of_the_receiver_time():
    sky = make_sky(ionosphere="none", clock=ClockSpec(drift_s_s=3e-5))  # 9 km/s: steered every 4 epochs
    _, rows = _fix(sky, NavigationSpec(iono="none", smoothing_s=100), np.arange(30.0, 45.0))
    bias = np.array([r["clock_bias_m"] for r in rows])
    assert np.ptp(np.diff(bias)) < 0.05
    for row in rows:
        assert np.linalg.norm(_error(sky, row)[0]) < 0.02


def test_ionosphere_divergence_of_smoothing_is_what_the_docstring_says():
    """Ramp I' in the code, -I' in the carrier: bias -2 I' (window - dt) once settled."""
    hatch, rate, window = Hatch(50.0, FS_HZ), 0.01, 50.0
    obs = np.zeros(1, OBSERVATION)
    obs["lock_s"] = 1e4
    for k in range(1000):
        obs["sample_index"] = round(k * FS_HZ)
        obs["pseudorange_m"], obs["carrier_phase_cycles"] = 2e7 + rate * k, rate * k / WAVELENGTH_M
        hatch.smooth(obs)
    assert obs["pseudorange_smoothed_m"][0] - obs["pseudorange_m"][0] == pytest.approx(
        -2 * rate * (window - 1), rel=1e-3
    )


def test_observables_are_exact_and_want_one_epoch():
    rows = transmit_rows(
        4_000_000, [b"L1CA", b"E1C"], [3, 7], [1000, 250], [0, 0], [5000, 5000],
        [511.5, 2046.0 + 511.5], [0.0, 0.0], [0.0, 0.0], [45.0, 45.0], [1.0, 1.0], [False, False],
    )  # fmt: skip
    np.testing.assert_array_equal(rows["tow_tx_ms"], [6000, 6002])
    np.testing.assert_allclose(rows["tow_tx_frac_s"], 0.5e-3, atol=1e-18)
    clock = ReceiverClock(FS_HZ)
    with pytest.raises(ValueError, match="transmit time"):
        clock.set_from_transmit(rows[:0])
    clock.set_from_transmit(rows)
    obs = observables(rows, clock)
    np.testing.assert_allclose(obs["pseudorange_m"], C_MPS * np.array([0.072, 0.070]), rtol=1e-13)
    rows["sample_index"][1] += 1
    with pytest.raises(ValueError, match="one sample index"):
        observables(rows, clock)
    late = np.zeros(1, TRANSMIT)
    late["tow_tx_ms"], late["sample_index"] = WEEK_MS - 1, 4_000_000
    start = ReceiverClock(FS_HZ)
    start.set_from_transmit(late)
    for n in (4_000_000, 4_000_001, 10**11 + 7):
        ms, frac = start.read(n)
        exact = (n - 4_000_000) / FS_HZ + 0.070
        assert 0 <= frac < 1e-3 and (ms - WEEK_MS + 1) * 1e-3 + frac == pytest.approx(exact, abs=1e-11)


def test_joseph_update_is_the_textbook_one():
    rng = np.random.default_rng(8)
    a = rng.standard_normal((9, 9))
    p, h, r, x = a @ a.T + np.eye(9), rng.standard_normal(9), 0.7, rng.standard_normal(9)
    k = p @ h / (h @ p @ h + r)
    expected = (np.eye(9) - np.outer(k, h)) @ p @ (np.eye(9) - np.outer(k, h)).T + r * np.outer(k, k)
    x2, p2, gain = x.copy(), p.copy(), np.zeros(9)
    s = kernels.joseph_scalar(x2, p2, h, 0.3, r, gain)
    np.testing.assert_allclose(p2, expected, atol=1e-12)
    np.testing.assert_allclose(x2, x + 0.3 * k, atol=1e-14)
    assert s == pytest.approx(h @ p @ h + r)


def test_filter_is_consistent_under_its_own_model():
    """Simulated white acceleration and clock noise: position NEES chi2_3 at the end, mean over runs within
    z."""
    sky = make_sky(ionosphere="none", troposphere="none", signals=("L1CA",))
    spec = NavigationSpec(
        kind="ekf", iono="none", tropo="none", sigma_code_m=1.0, filter=FilterSpec(accel_psd_m2_s3=0.5)
    )
    runs, epochs, rng, nees = 60, 25, np.random.default_rng(9), []
    eph, truth = ephemerides(sky), sky.receiver([30.0])[0]["pos_ecef_m"]
    times = 30.0 + np.arange(epochs)
    clean = [transmit(sky, t) for t in times]
    look = NavigationSpec(iono="none", tropo="none").start(FS_HZ)
    look.update(clean[0], eph)
    los = look.satellites["pos_ecef_m"] - truth
    los /= np.linalg.norm(los, axis=1, keepdims=True)
    f = spec.filter
    q = np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
    low = np.linalg.cholesky(q * f.accel_psd_m2_s3)
    low_clock = np.linalg.cholesky(q * f.clock_g_m2_s3 + np.diag([f.clock_f_m2_s, 0.0]))
    var_r = look._variance(look.observations, look.satellites)
    var_d = pvt.rate_variance(clean[0]["cn0_dbhz"], spec.sigma_doppler_mps, 0.02)
    for _ in range(runs):
        nav, s, b = spec.start(FS_HZ), np.zeros((2, 3)), np.zeros(2)
        for k in range(epochs):
            rows = clean[k].copy()
            dr = -los @ s[0] + b[0] + np.sqrt(var_r) * rng.standard_normal(rows.size)
            dd = -los @ s[1] + b[1] + np.sqrt(var_d) * rng.standard_normal(rows.size)
            delay = rows["tow_tx_frac_s"] - dr / C_MPS
            rows["tow_tx_frac_s"] = delay
            rows["doppler_hz"] -= dd / WAVELENGTH_M
            row = nav.update(rows, eph)
            e = row["pos_ecef_m"] - truth - s[0]
            s = np.array([s[0] + s[1], s[1]]) + low @ rng.standard_normal((2, 3))
            b = np.array([b[0] + b[1], b[1]]) + low_clock @ rng.standard_normal(2)
        nees.append(e @ np.linalg.solve(row["cov_ecef_m2"], e))
    assert np.mean(nees) == pytest.approx(3.0, abs=Z * np.sqrt(6.0 / runs))


def test_filter_gates_a_fault_coasts_through_an_outage_and_marks_it():
    sky = make_sky()
    spec = NavigationSpec(kind="ekf", filter=FilterSpec(coast_s=3.0, accel_psd_m2_s3=0.1))
    nav, _ = _fix(sky, spec, np.arange(30.0, 36.0))
    eph = ephemerides(sky)
    row = nav.update(transmit(sky, 36.0, fault_m={"G08": 100.0}), eph, sky.iono_utc)
    assert nav.excluded == ["G08"] and np.linalg.norm(_error(sky, row)[0]) < 0.05
    lost = transmit(sky, 38.0)
    lost["cn0_dbhz"] = 5.0
    row = nav.update(lost, eph, sky.iono_utc)
    assert row["valid"] and row["n_used"] == 0 and nav.reason
    lost["sample_index"] = round(41.0 * FS_HZ)
    row = nav.update(lost, eph, sky.iono_utc)
    assert not row["valid"]
    row = nav.update(transmit(sky, 42.0), eph, sky.iono_utc)
    assert row["valid"] and np.linalg.norm(_error(sky, row)[0]) < 0.1


def test_filter_restarts_when_it_refuses_everything():
    """A receiver that jumps by a kilometre without notice: three epochs refused, then least squares again."""
    sky, moved = make_sky(), make_sky(motion=Line(lat_deg=48.11, lon_deg=11.6, height_m=520.0))
    nav, _ = _fix(sky, NavigationSpec(kind="ekf"), np.arange(30.0, 36.0))
    rows = [nav.update(transmit(moved, t), ephemerides(moved), moved.iono_utc) for t in np.arange(36.0, 40.0)]
    assert rows[2] is None
    assert np.linalg.norm(_error(moved, rows[3])[0]) < 0.1


def test_spec_refuses_what_it_would_ignore():
    with pytest.raises(ValueError, match="belongs to kind"):
        NavigationSpec(filter=FilterSpec())
    with pytest.raises(ValueError, match="smooths by itself"):
        NavigationSpec(kind="ekf", smoothing_s=100)
    with pytest.raises(ValueError, match="twice"):
        NavigationSpec(systems=("G", "G"))
    assert (
        NavigationSpec().smoothing_window_s == 100.0 and NavigationSpec(kind="ekf").smoothing_window_s == 0.0
    )


@pytest.mark.parametrize("height_m", [-400.0, 99_999.0, 100_000.0])
@pytest.mark.parametrize("lat_deg, lon_deg", [(0.0, 180.0), (48.1, 11.6)])
def test_sky_and_receiver_have_the_same_atmosphere_up_to_100_km(height_m, lat_deg, lon_deg):
    """Noise-free ranges at any height, on the equator and the date line too, as in the first test."""
    sky = make_sky(motion=Line(lat_deg=lat_deg, lon_deg=lon_deg, height_m=height_m))
    nav, (row,) = _fix(sky, NavigationSpec(smoothing_s=0), [30.0])
    assert row is not None, nav.reason
    assert np.linalg.norm(_error(sky, row)[0]) < 0.01
    # Klobuchar's least is 5 ns.
    assert nav.satellites["iono_m"].min() > 4e-9 * C_MPS


def test_sky_default_is_what_the_receiver_models():
    assert SkySpec().ionosphere == NavigationSpec().iono and SkySpec().troposphere == NavigationSpec().tropo
