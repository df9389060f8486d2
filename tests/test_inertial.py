"""Sensors and strapdown: closed forms, an independent integrator, noise statistics, files from strangers."""

import numpy as np
import pytest

from nav import frames, sensor_files, strapdown
from nav.imu import (
    DEG_H,
    GRADES,
    BarometerSpec,
    ImuSpec,
    OdometerSpec,
    gauss_markov,
    simulate_barometer,
    simulate_imu,
    simulate_odometer,
    true_attitude,
    true_imu,
)  # fmt: skip
from nav.records import IMU
from signals.attitude import attitude
from signals.constants import EARTH_RATE_RAD_S
from signals.trajectory import MotionState

Z = 5.0
LAT, LON, H = 0.84, 0.2, 400.0
IDEAL = ImuSpec(grade="ideal")


def weave(amplitude_m=40.0, period_s=20.0, speed_mps=15.0, climb_m=5.0):
    """Closed-form motion: steady course with sinusoidal side and height, in the level axes of the start."""
    origin, r = frames.ecef_from_geodetic(LAT, LON, H), frames.rotation_ned_to_ecef(LAT, LON)
    w = 2 * np.pi / period_s

    def at(t_s):
        t = np.atleast_1d(np.asarray(t_s, float))
        n, e, d = speed_mps * t, amplitude_m * np.sin(w * t), -climb_m * np.sin(0.7 * w * t)
        vn, ve, vd = (
            np.full_like(t, speed_mps),
            amplitude_m * w * np.cos(w * t),
            -0.7 * w * climb_m * np.cos(0.7 * w * t),
        )
        an, ae, ad = (
            0 * t,
            -amplitude_m * w**2 * np.sin(w * t),
            (0.7 * w) ** 2 * climb_m * np.sin(0.7 * w * t),
        )
        p, v, a = (np.stack(x, axis=1) @ r.T for x in ((n, e, d), (vn, ve, vd), (an, ae, ad)))
        return MotionState(origin + p, v, a)

    return at


def still(t_s):
    t = np.atleast_1d(np.asarray(t_s, float))
    pos = frames.ecef_from_geodetic(LAT, LON, H)
    return MotionState(np.tile(pos, (t.size, 1)), np.zeros((t.size, 3)), np.zeros((t.size, 3)))


def test_land_attitude_points_along_the_track_without_roll():
    s = weave()(np.linspace(0, 40, 50))
    c = attitude(s.pos_ecef_m, s.vel_ecef_mps)
    for k in range(50):
        np.testing.assert_allclose(c[k] @ c[k].T, np.eye(3), atol=1e-14)
        np.testing.assert_allclose(
            c[k][:, 0], s.vel_ecef_mps[k] / np.linalg.norm(s.vel_ecef_mps[k]), atol=1e-14
        )
        lat, lon, _ = frames.geodetic_from_ecef(s.pos_ecef_m[k])
        yaw, pitch, roll = frames.euler_from_rotation(frames.rotation_ned_to_ecef(lat, lon).T @ c[k])
        ned = frames.rotation_ned_to_ecef(lat, lon).T @ s.vel_ecef_mps[k]
        assert abs(roll) < 1e-12
        assert yaw == pytest.approx(np.arctan2(ned[1], ned[0])) and pitch == pytest.approx(
            np.arcsin(-ned[2] / np.linalg.norm(ned))
        )


def test_aircraft_turn_is_coordinated_and_standstill_holds_the_heading():
    c, force = true_attitude(weave(300.0, 30.0, 60.0), np.linspace(0, 30, 40), "aircraft")
    side = np.einsum("ki,ki->k", c[:, :, 1], force)
    assert np.abs(side).max() < 1e-9 * 10 and np.all(np.einsum("ki,ki->k", c[:, :, 2], force) < -9)
    c, _ = true_attitude(still, [0.0, 1.0], "land", 0.3)
    yaw = frames.euler_from_rotation(frames.rotation_ned_to_ecef(LAT, LON).T @ c[1])[0]
    assert yaw == pytest.approx(0.3)
    stop = weave()([0.0, 1.0, 2.0])
    vel = stop.vel_ecef_mps.copy()
    vel[2] = 0.0
    held = attitude(stop.pos_ecef_m, vel)
    assert held[2][:, 0] @ held[1][:, 0] == pytest.approx(1.0)
    up = np.tile(stop.pos_ecef_m[0] / np.linalg.norm(stop.pos_ecef_m[0]), (1, 1))
    with pytest.raises(ValueError, match="vertical"):
        attitude(stop.pos_ecef_m[:1], 5 * frames.rotation_ned_to_ecef(LAT, LON)[:, 2][None])
    assert up.shape == (1, 3)


def test_imu_at_rest_reads_gravity_and_earth_rate():
    rows = true_imu(still, IDEAL, 1.0)
    g = frames.normal_gravity(LAT, H)
    np.testing.assert_allclose(
        rows["accel_mps2"][5], [0, 0, -g], atol=3e-4
    )  # J2 against the full normal field
    ned = EARTH_RATE_RAD_S * np.array([np.cos(LAT), 0.0, -np.sin(LAT)])
    np.testing.assert_allclose(rows["gyro_rad_s"][5], ned, atol=1e-13)


def test_strapdown_stays_at_rest():
    rows = true_imu(still, IDEAL, 600.0)
    pos, vel, c = strapdown.mechanise(
        still(0).pos_ecef_m[0], np.zeros(3), true_attitude(still, [0.0])[0][0], rows, 0.0
    )
    assert np.linalg.norm(pos[-1] - pos[0]) < 1e-5 and np.linalg.norm(vel[-1]) < 1e-7
    np.testing.assert_allclose(c[-1] @ c[-1].T, np.eye(3), atol=1e-11)


@pytest.mark.parametrize("kind", ["land", "aircraft"])
def test_strapdown_returns_the_motion_and_improves_as_the_square_of_the_rate(kind):
    """Ideal sensors, exact start. What is left is coning and the constant-rate assumption, both of order
    dt^2."""
    motion, errors = weave(), []
    for rate in (50.0, 100.0):
        rows = true_imu(motion, ImuSpec(grade="ideal", rate_hz=rate, attitude=kind), 60.0)
        start, c0 = motion(0.0), true_attitude(motion, [0.0], kind)[0][0]
        pos, _, _ = strapdown.mechanise(start.pos_ecef_m[0], start.vel_ecef_mps[0], c0, rows, 0.0)
        end = motion(rows["t_s"][-1])
        errors.append(np.linalg.norm(pos[-1] - end.pos_ecef_m[0]))
    assert errors[1] < 0.05 and errors[1] < errors[0] / 3.0


def test_free_fall_against_an_independent_integrator():
    """No specific force, spinning body: scipy's DOP853 in the inertial frame is the judge."""
    from scipy.integrate import solve_ivp
    from scipy.spatial.transform import Rotation

    pos0, vel0 = frames.ecef_from_geodetic(0.3, 1.0, 20_000.0), np.array([100.0, 700.0, 400.0])
    spin, dt, m = np.array([0.4, -0.2, 0.9]), 0.005, 8000
    rows = np.zeros(m, IMU)
    rows["t_s"], rows["gyro_rad_s"] = dt * np.arange(1, m + 1), spin
    pos, vel, c = strapdown.mechanise(pos0, vel0, np.eye(3), rows, 0.0)
    w = np.array([0.0, 0.0, EARTH_RATE_RAD_S])

    def rhs(t, y):
        turn = Rotation.from_rotvec(w * t)
        ecef, g = turn.inv().apply(y[:3]), np.empty(3)
        frames.gravity_ecef(ecef, g)
        gravitation = g - EARTH_RATE_RAD_S**2 * np.array([ecef[0], ecef[1], 0.0])
        return np.concatenate([y[3:], turn.apply(gravitation)])

    end = solve_ivp(
        rhs, (0, m * dt), np.concatenate([pos0, vel0 + np.cross(w, pos0)]), "DOP853", rtol=1e-12, atol=1e-6
    )
    turn = Rotation.from_rotvec(w * m * dt)
    np.testing.assert_allclose(pos[-1], turn.inv().apply(end.y[:3, -1]), atol=2e-3)
    np.testing.assert_allclose(
        vel[-1], turn.inv().apply(end.y[3:, -1] - np.cross(w, end.y[:3, -1])), atol=1e-4
    )
    expected = (turn.inv() * Rotation.from_rotvec(spin * m * dt)).as_matrix()
    np.testing.assert_allclose(c[-1], expected, atol=1e-9)


def test_rotation_average_is_the_integral():
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(0)
    x, nodes = rng.standard_normal(3), np.polynomial.legendre.leggauss(20)
    for scale in (1e-5, 0.03, 1.5):
        v, out, r = rng.standard_normal(3) * scale, np.empty(3), np.empty((3, 3))
        strapdown._rotation_average(v, x, out)
        u, wt = 0.5 * (nodes[0] + 1), 0.5 * nodes[1]
        expected = sum(b * Rotation.from_rotvec(v * a).apply(x) for a, b in zip(u, wt))
        np.testing.assert_allclose(out, expected, atol=1e-13)
        strapdown.rotation_matrix(v, r)
        np.testing.assert_allclose(r, Rotation.from_rotvec(v).as_matrix(), atol=1e-15)


def test_alignment():
    c_bn = frames.rotation_body_to_ned(0.8, 0.05, -0.03)
    rest = c_bn.T @ np.array([0, 0, -9.81])
    assert strapdown.level_from_rest(rest) == (pytest.approx(0.05), pytest.approx(-0.03))
    rate = c_bn.T @ (EARTH_RATE_RAD_S * np.array([np.cos(LAT), 0, -np.sin(LAT)]))
    assert strapdown.heading_from_gyro(rate, 0.05, -0.03) == pytest.approx(0.8)
    with pytest.raises(ValueError, match="within 10 %"):
        strapdown.level_from_rest([0.0, 0.0, -1.0])
    vel = frames.rotation_ned_to_ecef(LAT, LON) @ np.array([3.0, 4.0, -0.5])
    c = strapdown.attitude_from_velocity(LAT, LON, vel)
    np.testing.assert_allclose(c[:, 0], vel / np.linalg.norm(vel), atol=1e-14)
    with pytest.raises(ValueError, match="move faster"):
        strapdown.attitude_from_velocity(LAT, LON, vel * 0.1)


def test_gauss_markov_is_stationary_with_its_time_constant():
    rng, n, tau, dt, sigma = np.random.default_rng(3), 4000, 10.0, 0.5, 2.0
    x = gauss_markov(rng, sigma, tau, dt, (60, n))
    for k in (0, 1, 59):
        assert np.var(x[k]) == pytest.approx(sigma**2, rel=Z * np.sqrt(2 / n))
    rho = np.mean(x[20] * x[40]) / sigma**2
    assert rho == pytest.approx(np.exp(-20 * dt / tau), abs=Z / np.sqrt(n))


@pytest.mark.parametrize("grade", sorted(GRADES))
def test_imu_noise_is_what_the_grade_says(grade):
    """White noise from 0.01-s differences, bias from its own record; seeds give the same bits again."""
    spec = ImuSpec(grade=grade, gyro_lsb_rad=0.0, accel_lsb_mps=0.0)
    rows, gyro_bias, accel_bias = simulate_imu(still, spec, 5, 100.0)
    again = simulate_imu(still, spec, 5, 100.0)[0]
    other = simulate_imu(still, spec, 6, 100.0)[0]
    assert rows.tobytes() == again.tobytes()
    assert (rows.tobytes() == other.tobytes()) == (grade == "ideal")
    truth = true_imu(still, spec, 100.0)
    for name, bias, noise in (
        ("gyro_rad_s", gyro_bias, spec.gyro_noise_si),
        ("accel_mps2", accel_bias, spec.accel_noise_si),
    ):
        residual = rows[name] - truth[name] - bias
        residual = residual - residual.mean(axis=0)  # scale and misalignment of a constant input
        n = residual.size
        assert np.std(residual) == pytest.approx(noise * 10.0, rel=Z / np.sqrt(2 * n), abs=1e-12)
    if grade == "karaim2020":
        assert spec.gyro_bias_si == (0.0, pytest.approx(10 * DEG_H)) and spec.gyro_noise_si == pytest.approx(
            np.pi / 180 / 60
        )


def test_scale_misalignment_and_quantisation_act_on_the_input():
    motion = weave()
    spec = ImuSpec(grade="ideal", scale_ppm=1e4, misalignment_mrad=5.0)
    rows, truth = simulate_imu(motion, spec, 1, 30.0)[0], true_imu(motion, spec, 30.0)
    matrix = np.linalg.lstsq(truth["accel_mps2"], rows["accel_mps2"], rcond=None)[0].T
    assert np.all(np.abs(np.diag(matrix) - 1) < Z * 1e-2) and np.any(np.abs(np.diag(matrix) - 1) > 1e-3)
    np.testing.assert_allclose(rows["accel_mps2"], truth["accel_mps2"] @ matrix.T, atol=1e-9)
    lsb = 1e-4
    coarse = simulate_imu(motion, ImuSpec(grade="ideal", gyro_lsb_rad=lsb), 1, 30.0)[0]
    total = np.cumsum(coarse["gyro_rad_s"] - truth["gyro_rad_s"], axis=0) * 0.01
    assert np.abs(total).max() <= lsb / 2 * 1.0001 and np.abs(total).max() > lsb / 4


def test_odometer_scale_and_noise():
    motion = weave(climb_m=0.0)
    rows, scale = simulate_odometer(motion, OdometerSpec(noise_mps=0.05), 4, 60.0)
    true = np.linalg.norm(motion(rows["t_s"]).vel_ecef_mps, axis=1)
    residual = rows["speed_mps"] - true / (1 - scale)
    assert np.std(residual) == pytest.approx(0.05, rel=Z / np.sqrt(2 * rows.size))
    assert 0 < np.abs(scale).max() < Z * 0.01


def test_barometer_bias_and_noise():
    motion, spec = weave(), BarometerSpec(rate_hz=50.0, bias_sigma_m=4.0, bias_tau_s=20.0, noise_m=0.2)
    rows, bias = simulate_barometer(motion, spec, 4, 60.0)
    true = np.array([frames.geodetic_from_ecef(p)[2] for p in motion(rows["t_s"]).pos_ecef_m])
    assert np.std(rows["height_m"] - true - bias) == pytest.approx(0.2, rel=Z / np.sqrt(2 * rows.size))
    ends = np.array([simulate_barometer(motion, spec, seed, 1.0)[1][-1] for seed in range(200)])
    assert np.std(ends) == pytest.approx(4.0, rel=Z / np.sqrt(2 * ends.size))


def test_files_round_trip_and_align_to_samples(tmp_path):
    motion = weave()
    baro = simulate_barometer(motion, BarometerSpec(), 1, 5.0, 4e6)[0]
    sensor_files.write_barometer(tmp_path / "baro.csv", baro)
    assert sensor_files.read_barometer(tmp_path / "baro.csv", 4e6, 5.0).tobytes() == baro.tobytes()
    imu, odo = (
        simulate_imu(motion, ImuSpec(), 1, 5.0, 4e6)[0],
        simulate_odometer(motion, OdometerSpec(), 1, 5.0, 4e6)[0],
    )
    sensor_files.write_imu(tmp_path / "imu.csv", imu)
    sensor_files.write_odometer(tmp_path / "odo.csv", odo)
    assert sensor_files.read_imu(tmp_path / "imu.csv", 4e6, 5.0).tobytes() == imu.tobytes()
    assert sensor_files.read_odometer(tmp_path / "odo.csv", 4e6, 5.0).tobytes() == odo.tobytes()
    assert imu["sample_index"][99] == 4_000_000


def _bad(change):
    t = np.arange(1, 501) * 0.01
    table = np.column_stack([t, np.zeros((500, 5)), np.full(500, -9.81)])
    return change(table)


def _g_units(a):
    a[:, 6] = -1.0
    return a


def _z_up(a):
    a[:, 6] = 9.81
    return a


def _fast(a):
    a[7, 2] = 300.0
    return a


def _nan(a):
    a[3, 1] = np.nan
    return a


@pytest.mark.parametrize(
    "change, message",
    [
        (_g_units, "not g"),
        (_z_up, "forward, right, down"),
        (_fast, "not deg/s"),
        (_nan, "row 4 holds a value that is not finite"),
        (lambda a: a[:300], "before the samples do"),
        (lambda a: np.delete(a, slice(100, 150), axis=0), "jump by 0.51"),
        (lambda a: a[::-1], "do not rise"),
        (lambda a: a[100:], "begin at"),
        (lambda a: a[:2], "three at least"),
        (lambda a: a[:, :5], "5 values"),
    ],
)
def test_bad_imu_files_are_refused_in_one_sentence(tmp_path, change, message):
    path = tmp_path / "imu.csv"
    np.savetxt(path, _bad(change), delimiter=",", header=",".join(sensor_files.IMU_COLUMNS), comments="")
    with pytest.raises(ValueError, match=message) as error:
        sensor_files.read_imu(path, 4e6, 5.0)
    assert "\n" not in str(error.value)


def test_files_that_are_no_tables_are_refused(tmp_path):
    path = tmp_path / "x.csv"
    with pytest.raises(ValueError, match="does not exist"):
        sensor_files.read_imu(path, 4e6)
    path.write_bytes(b"\x89PNG\x00\xff" * 50)
    with pytest.raises(ValueError, match="must name the columns"):
        sensor_files.read_imu(path, 4e6)
    path.write_text("t_s,speed_mps\n0.1,fast\n")
    with pytest.raises(ValueError, match="fast"):
        sensor_files.read_odometer(path, 4e6)
    path.write_text("t_s,height_m\n0.1,1013.2\n0.2,101325\n0.3,101325\n")
    with pytest.raises(ValueError, match="not a pressure"):
        sensor_files.read_barometer(path, 4e6)
    path.write_text("t_s,speed_mps\n")
    with pytest.raises(ValueError, match="no data"):
        sensor_files.read_odometer(path, 4e6)
