"""The 17-state filter on the strapdown's nominal state with simulated sensors: consistency and drift in an
outage."""

import numpy as np
import pytest
from naive_riss import SATELLITES

from nav import ultratight_kernels as kernels
from nav.errormodels import EcefState, measurement_rows
from nav.eskf import Eskf, discretise
from nav.frames import geodetic_from_ecef, rotation_enu_to_ecef
from nav.imu import DEG_H, MG, ImuSpec, ecef17_of, simulate_imu, true_attitude
from nav.strapdown import strapdown_step
from nav.ultratight import extended_q, model_rates
from signals.trajectory import HighDynamics, Segment, Segments

Z = 5.0
DT = 0.01
SIGMA_RANGE_M, SIGMA_RATE_MPS = 1.0, 0.05


def rotation_error(c_true, c_est):
    """psi with C_true = (I + [psi x]) C_est, small angles."""
    d = c_true @ c_est.T
    return 0.5 * np.array([d[2, 1] - d[1, 2], d[0, 2] - d[2, 0], d[1, 0] - d[0, 1]])


def run(motion, spec, seed, duration_s, aid_until_s, p0_diag, kind):
    """Errors (17,) and P at the end: range and rate updates at 10 Hz until aid_until_s, IMU at 100 Hz."""
    rng, model = np.random.default_rng([seed, 1]), ecef17_of(spec)
    rows, gyro_bias, accel_bias = simulate_imu(motion, spec, seed, duration_s)
    c_true, _ = true_attitude(motion, np.concatenate([[0.0], rows["t_s"]]), kind)
    truth, start = motion(rows["t_s"]), motion([0.0])
    e0 = np.sqrt(p0_diag) * rng.standard_normal(17)
    e0[9:12], e0[12:15] = accel_bias[0], gyro_bias[0]  # the estimates start at zero
    clock = e0[15:17].copy()
    state = EcefState(
        start.pos_ecef_m[0].copy(),
        start.vel_ecef_mps[0].copy(),
        c_true[0].copy(),
        e0[9:12] * 1,
        e0[12:15] * 1,
        0.0,
        0.0,
    )
    dx = e0.copy()
    dx[15:17] = 0.0
    state = model.inject(state, -dx)
    kf = Eskf(np.diag(p0_diag), 2 * len(SATELLITES))
    lat, lon, _ = geodetic_from_ecef(state.pos_ecef_m)
    u = SATELLITES @ rotation_enu_to_ecef(lat, lon).T
    var = np.repeat([SIGMA_RANGE_M**2, SIGMA_RATE_MPS**2], len(SATELLITES))
    sf, sg = model.clock_phase_noise_m2_s, model.clock_freq_noise_m2_s3
    low = np.linalg.cholesky(
        sg * np.array([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]]) + np.diag([sf * DT, 0.0])
    )
    keep_a, keep_g = np.exp(-DT / model.accel_bias_tau_s), np.exp(-DT / model.gyro_bias_tau_s)
    q = model.q_diag()
    for k in range(rows.size):
        pos, vel, c = state.pos_ecef_m.copy(), state.vel_ecef_mps.copy(), np.ascontiguousarray(state.c_be)
        force = rows["accel_mps2"][k] - state.accel_bias_mps2
        kf.predict(*discretise(model.f_matrix(state, force), q, DT))
        strapdown_step(pos, vel, c, rows["gyro_rad_s"][k] - state.gyro_bias_rad_s, force, DT)
        clock = np.array([clock[0] + clock[1] * DT, clock[1]]) + low @ rng.standard_normal(2)
        state = EcefState(
            pos, vel, c, state.accel_bias_mps2 * keep_a, state.gyro_bias_rad_s * keep_g,
            state.clock_bias_m + state.clock_drift_mps * DT, state.clock_drift_mps,
        )  # fmt: skip
        if (k + 1) % 10 == 0 and (k + 1) * DT <= aid_until_s:
            z = np.concatenate(
                [
                    -u @ (truth.pos_ecef_m[k] - pos) + clock[0] - state.clock_bias_m,
                    -u @ (truth.vel_ecef_mps[k] - vel) + clock[1] - state.clock_drift_mps,
                ]
            ) + np.sqrt(var) * rng.standard_normal(var.size)
            h = np.vstack([measurement_rows(model, state, u), measurement_rows(model, state, u, rate=True)])
            state = model.inject(state, kf.update(z, h, var))
    error = np.concatenate(
        [
            truth.pos_ecef_m[-1] - state.pos_ecef_m,
            truth.vel_ecef_mps[-1] - state.vel_ecef_mps,
            rotation_error(c_true[-1], state.c_be),
            accel_bias[-1] - state.accel_bias_mps2,
            gyro_bias[-1] - state.gyro_bias_rad_s,
            clock - [state.clock_bias_m, state.clock_drift_mps],
        ]
    )
    return error, kf.p.copy()


def p0_of(spec, level_rad=5e-3, position_m=5.0, velocity_mps=0.5):
    accel, gyro = np.hypot(*spec.accel_bias_si), np.hypot(*spec.gyro_bias_si)
    sigma = [position_m] * 3 + [velocity_mps] * 3 + [level_rad] * 3 + [accel] * 3 + [gyro] * 3 + [10.0, 1.0]
    return np.array(sigma) ** 2


def car(duration_s):
    legs = [
        Segment(duration_s=6.0),
        Segment(duration_s=8.0, turn_rate_deg_s=11.25),
        Segment(duration_s=5.0, speed_mps=15.0),
    ]
    return Segments(speed_mps=10.0, heading_deg=30.0, segment=tuple(legs * 3)).start(duration_s)


@pytest.mark.parametrize("profile", ["car", "high dynamics"])
def test_nees_of_all_17_states(profile):
    """e' P^-1 e is chi2_17 at the end of 30 s of aiding: mean over runs within z sqrt(2 x 17 / runs)."""
    kind = "land" if profile == "car" else "aircraft"
    spec = ImuSpec(
        grade="tactical", scale_ppm=0.0, misalignment_mrad=0.0, attitude=kind, accel_tau_s=100, gyro_tau_s=100
    )
    motion = car(31.0) if profile == "car" else HighDynamics().start(31.0)
    runs, nees = 16, []
    for seed in range(runs):
        error, p = run(motion, spec, seed, 30.0, 30.0, p0_of(spec), kind)
        nees.append(error @ np.linalg.solve(p, error))
    assert np.mean(nees) == pytest.approx(17.0, abs=Z * np.sqrt(2 * 17 / runs))


def test_outage_drift_is_what_the_covariance_predicts():
    """30 s without measurements: the position error over its predicted sigma is chi2_3 in the mean."""
    spec = ImuSpec(grade="tactical", scale_ppm=0.0, misalignment_mrad=0.0)
    motion, runs, nees, size = car(61.0), 10, [], []
    for seed in range(runs):
        error, p = run(motion, spec, seed, 60.0, 30.0, p0_of(spec), "land")
        nees.append(error[:3] @ np.linalg.solve(p[:3, :3], error[:3]))
        size.append(np.linalg.norm(error[:3]))
    assert np.mean(nees) == pytest.approx(3.0, abs=Z * np.sqrt(6.0 / runs))
    assert 0.05 < np.sqrt(np.mean(np.square(size))) < 20.0


def test_compiled_epoch_is_the_python_one():
    """Two IMU intervals in one step of the covariance: nominal state the same, P to the force's change in
    10 ms."""
    spec = ImuSpec(grade="tactical")
    model, motion = ecef17_of(spec), car(10.0)
    rows = simulate_imu(motion, spec, 3, 1.0)[0][:2]
    start, (c0,) = motion([0.0]), true_attitude(motion, [0.0], "land")[0]
    bias = np.array([1e-2, -2e-2, 1e-2, 1e-5, 2e-5, -1e-5])
    pos, vel, c = start.pos_ecef_m[0].copy(), start.vel_ecef_mps[0].copy(), c0.copy()
    n = 18  # and the inter-system bias
    x, p, sensors = np.zeros(kernels.N_X), np.diag([*p0_of(spec), 1.0]), np.zeros((2, kernels.N_SENSOR))
    x[:3], x[3:6], x[6:15], x[15:21], x[21:23] = pos, vel, c.ravel(), bias, (5.0, 0.3)
    x[kernels.USUAL : kernels.USUAL + 6] = np.nan
    sensors[:, :3], sensors[:, 3:6] = rows["gyro_rad_s"], rows["accel_mps2"]
    expected, (f, phi, qd) = p[:17, :17].copy(), (np.zeros((n, n)) for _ in range(3))
    kernels.predict(
        kernels.ECEF17, x, p, sensors, DT, 1.0, model_rates(model), extended_q(model, x), f, phi, qd
    )  # fmt: skip
    for k in range(2):
        state = EcefState(pos, vel, c, bias[:3], bias[3:], 5.0, 0.3)
        a, g = rows["accel_mps2"][k] - bias[:3], rows["gyro_rad_s"][k] - bias[3:]
        one, q = discretise(model.f_matrix(state, a), model.q_diag(), DT)
        expected = one @ expected @ one.T + q
        strapdown_step(pos, vel, c, g, a, DT)
    np.testing.assert_array_equal(x[:3], pos)
    np.testing.assert_array_equal(x[6:15], c.ravel())
    assert x[21] == pytest.approx(5.0 + 0.3 * 2 * DT)
    np.testing.assert_allclose(np.diag(p)[:17], np.diag(expected), rtol=1e-4)


def test_model_of_an_imu_has_its_noise():
    spec = ImuSpec(grade="karaim2020", gyro_tau_s=50.0)
    model = ecef17_of(spec, clock_phase_noise_m2_s=0.5)
    assert model.gyro_bias_walk_rad_s_rts == pytest.approx(10 * DEG_H * np.sqrt(2 / 50))
    assert model.accel_bias_walk_mps2_rts == pytest.approx(MG * np.sqrt(2 / 3600))
    assert model.accel_noise_mps2_rthz == pytest.approx(0.05 / 60) and model.clock_phase_noise_m2_s == 0.5
