"""RISS: closed forms, Jacobians of both error models, coasting against truth, consistency of the
covariance."""

import numpy as np
import pytest
from naive_riss import aided_run, drive, sensors

from nav import riss
from nav import ultratight_kernels as kernels
from nav.errormodels import measurement_rows
from nav.eskf import discretise
from nav.frames import earth_radii, ecef_from_geodetic, normal_gravity, rotation_enu_to_ecef
from nav.imu import ImuSpec, OdometerSpec
from nav.records import ODOMETER
from nav.ultratight import extended_q, model_code, model_rates
from signals.constants import EARTH_RATE_RAD_S

Z = 5.0
LAT, LON, H = 0.84, 0.2, 300.0
MODELS = [riss.Riss11(), riss.RissSf()]


def nominal(azimuth=0.7, speed=10.0, pitch=0.03):
    r = rotation_enu_to_ecef(LAT, LON)
    enu = speed * np.array([np.sin(azimuth) * np.cos(pitch), np.cos(azimuth) * np.cos(pitch), np.sin(pitch)])
    return riss.riss_nominal(ecef_from_geodetic(LAT, LON, H), r @ enu, speed_mps=speed)


@pytest.mark.parametrize("form", [riss.PAPER, riss.SCALE])
def test_along_a_parallel_the_closed_form_holds(form):
    """Due east: wz = we sin(lat) + ve tan(lat)/(RN+h) keeps the azimuth, lon' = v/((RN+h) cos lat), for an
    hour."""
    x, v = nominal(np.pi / 2, 20.0, 0.0), 20.0
    _, rn = earth_radii(LAT)
    m, dt = 36_000, 0.1
    wz = np.full(m, EARTH_RATE_RAD_S * np.sin(LAT) + v * np.tan(LAT) / (rn + H))
    fx = np.full(m, -v * wz[0])  # the centripetal force of the turning level frame: no roll
    out = np.empty((m, riss.N_NOMINAL))
    riss.riss_run(x, form, wz, np.zeros(m), fx, np.full(m, v), dt, 1.0, out)
    assert out[-1, riss.AZIMUTH] == pytest.approx(np.pi / 2, abs=1e-9)
    assert out[-1, riss.LAT] == pytest.approx(LAT, abs=1e-11)
    assert out[-1, riss.LON] == pytest.approx(LON + v * m * dt / ((rn + H) * np.cos(LAT)), abs=1e-11)
    assert out[-1, riss.HEIGHT] == pytest.approx(H) and abs(out[-1, riss.ROLL]) < 1e-12


def test_pitch_and_roll_from_the_accelerometers():
    x = nominal()
    g, wz, v = normal_gravity(LAT, H), -0.1, 10.0
    for _ in range(3):
        riss.riss_step(
            x, riss.SCALE, wz, g * np.sin(0.03), -g * np.sin(0.05) * np.cos(0.03) - v * wz, v, 0.01, 1.0
        )
    assert x[riss.PITCH] == pytest.approx(0.03, abs=1e-6) and x[riss.ROLL] == pytest.approx(0.05, abs=1e-6)


STEPS = {"dlat_rad": 1e-5, "dlon_rad": 1e-5, "dh_m": 300.0, "b_m": 1.0, "d_mps": 1.0}


def _numeric_phi(model, x, dt):
    """d(state after two steps)/d(state after one), by central differences through ``inject``.

    The first step lets the pitch settle to the gravity of the perturbed place.
    """
    wz, fy = -0.08, normal_gravity(x[riss.LAT], x[riss.HEIGHT]) * np.sin(0.03) + x[riss.ACCEL_MEAN]
    speed = x[riss.SPEED] + 1.5 * dt

    def after(dx):
        y = model.inject(x, dx)
        model.step(y, wz, fy, 0.0, speed, dt)
        one = y[model.state_columns].copy()
        model.step(y, wz, fy, 0.0, speed + 1.5 * dt, dt)
        return one, y[model.state_columns].copy()

    first, second = [], []
    for j, name in enumerate(model.names):
        e = np.zeros(model.n)
        e[j] = STEPS.get(name, 1e-3)
        hi, lo = after(e), after(-e)
        first.append((hi[0] - lo[0]) / (2 * e[j]))
        second.append((hi[1] - lo[1]) / (2 * e[j]))
    y = x.copy()
    for k in (1, 2):
        model.step(y, wz, fy, 0.0, x[riss.SPEED] + 1.5 * k * dt, dt)
    return np.column_stack(second) @ np.linalg.inv(np.column_stack(first)), model.f_matrix(y, wz)


@pytest.mark.parametrize("model", MODELS, ids=lambda m: m.kind)
def test_f_is_the_jacobian_of_the_mechanisation(model):
    """(Phi - I)/dt against F within 0.35 % of each entry's row-column scale; correlation times are not
    mechanised."""
    x = nominal()
    x[riss.ACCEL_MEAN] = 1.5  # the low pass has settled on the acceleration of the two steps
    x[riss.FORCE_MEAN] = normal_gravity(LAT, H) * np.sin(0.03) + 1.5
    x[riss.PITCH] = 0.03
    x[riss.GYRO_BIAS], x[riss.SCALE_FACTOR] = 1e-4, 0.0 if model.form_code == riss.PAPER else 0.01
    x = model.inject(x, np.zeros(model.n))
    dt = 1e-3
    phi, f = _numeric_phi(model, x, dt)
    numeric = (phi - np.eye(model.n)) / dt - 0.5 * dt * f @ f
    for name in ("dao_mps2", "dbz_rad_s", "ds", "dp_rad"):
        if name in model.names:
            k = model.names.index(name)
            f[k, k] = 0.0
    unit = np.ones(model.n)
    unit[:2] = 1.5e-7  # 1 m in rad: compare what a metre, m/s, rad does per second
    scaled, difference = f * unit / unit[:, None], (numeric - f) * unit / unit[:, None]
    # Rounding of a latitude (a few 1e-16 rad) over step and interval; the paper leaves v/R dh out of F.
    step = np.array([STEPS.get(name, 1e-3) for name in model.names])
    rounding = 4e-16 / (2 * step * dt) * unit / 1.5e-7
    allowed = 2e-7 + 0.0035 * np.abs(scaled)
    allowed[:2] += rounding + (1.7e-6 * (np.arange(model.n) == 2) if model.form_code == riss.PAPER else 0.0)
    turned = [i for i, name in enumerate(model.names) if name in ("dve_mps", "dvn_mps", "da_rad")]
    # Tiny per metre, yet their signs count.
    allowed[turned, :2] = (0.0035 * np.abs(f[turned, :2]) + 8e-6) * unit[:2]
    worst = np.unravel_index(np.argmax(np.abs(difference) / allowed), allowed.shape)
    assert abs(difference[worst]) <= allowed[worst], (
        model.names[worst[0]],
        model.names[worst[1]],
        scaled[worst],
    )


@pytest.mark.parametrize("model", MODELS, ids=lambda m: m.kind)
def test_measurement_rows_are_the_jacobian_of_range_and_rate(model):
    x = nominal()
    x[riss.PITCH] = 0.03
    x = model.inject(x, np.zeros(model.n))
    u = np.array([[0.6, 0.0, 0.8], [0.0, -0.8, 0.6]])
    pos, vel = np.zeros(3), np.zeros(3)

    def predicted(dx, rate):
        y = model.inject(x, dx)
        riss.riss_pos_vel(y, pos, vel)
        return -u @ (vel if rate else pos) + y[riss.CLOCK_DRIFT if rate else riss.CLOCK_BIAS]

    for rate in (False, True):
        rows = measurement_rows(model, x, u, rate)
        for j, name in enumerate(model.names):
            e = np.zeros(model.n)
            e[j] = 1e-7 if name.startswith(("dlat", "dlon")) else 1e-4
            numeric = (predicted(e, rate) - predicted(-e, rate)) / (2 * e[j])
            # R_l^e turns with position: v per rad (10 m/s) is left out of the rate rows, as in the paper.
            atol = (
                10.5 if rate and name.startswith(("dlat", "dlon")) else 1e-5 + 1e-6 * np.abs(rows[:, j]).max()
            )
            np.testing.assert_allclose(rows[:, j], numeric, atol=atol)


def test_ideal_sensors_follow_the_drive():
    """What is left is the model's: pitch 1 s late at slope changes, level gyro. Bounds: slope change 0.04
    rad x 1 s x 10 m/s per change in height; horizontally cos(pitch) of it."""
    motion = drive(120.0)
    inputs = sensors(motion, ImuSpec(grade="ideal"), OdometerSpec(noise_mps=0.0, scale_sigma=0.0), 0, 119.0)
    start = motion([0.0])
    for form in (riss.PAPER, riss.SCALE):
        x = riss.riss_nominal(start.pos_ecef_m[0], start.vel_ecef_mps[0], speed_mps=10.0)
        out = np.empty((inputs[0].size, riss.N_NOMINAL))
        riss.riss_run(x, form, *inputs, 0.01, 1.0, out)
        pos, vel = np.zeros(3), np.zeros(3)
        riss.riss_pos_vel(out[-1], pos, vel)
        error = rotation_enu_to_ecef(LAT, LON).T @ (motion([119.0]).pos_ecef_m[0] - pos)
        assert np.hypot(*error[:2]) < 0.3 and abs(error[2]) < 0.5


P0_SF = np.diag([1e-6, 1e-6, 5.0, 0.02, 0.01, 10 * riss.DEG_H, 2e-3, 10.0, 1.0]) ** 2
P0_PAPER = np.diag([1e-6, 1e-6, 5.0, 0.5, 0.5, 0.3, 0.02, 2e-3, 10 * riss.DEG_H, 10.0, 1.0]) ** 2


def coast(model, p0, runs, duration_s=210.0, aid_s=120.0, odometer=None, seed=7):
    imu, odometer = ImuSpec(grade="karaim2020"), odometer or OdometerSpec()
    motion, errors, claims, nees = drive(duration_s + 1.0), [], [], []
    for i in range(runs):
        inputs = sensors(motion, imu, odometer, [seed, i], duration_s)
        rng = np.random.default_rng([seed, i, 1])
        t, e, s, n = aided_run(model, motion, inputs, duration_s, aid_s, rng, p0)
        errors.append(e), claims.append(s), nees.append(n)
    after = t > aid_s + 1e-6
    e = np.array(errors)[:, :, :2]
    rms = float(np.sqrt(np.mean(np.sum(e[:, after] ** 2, axis=2))))
    end = float(np.sqrt(np.mean(np.sum(e[:, -1] ** 2, axis=1))))
    claimed = float(np.sqrt(np.mean([s[-1, 0, 0] + s[-1, 1, 1] for s in claims])))
    return rms, end, claimed, np.array(nees)[:, (t > 60) & ~after]


def test_coasting_90_s_after_120_s_of_aiding():
    """Karaim's sensors (10 deg/h, 1 deg/rt-h, odometer 1 cm/s and 1 h): 0.5 to 2 m RMS, and the claim is
    honest.

    The end error of 8 runs has 2 x 8 degrees of freedom, so that its RMS is within a factor 1 +-
    5/sqrt(32) of the claim where the claim is true.
    """
    model = riss.RissSf.from_sensors(ImuSpec(grade="karaim2020"), OdometerSpec())
    rms, end, claimed, nees = coast(model, P0_SF, 8)
    assert 0.4 < rms < 2.0
    assert end < claimed * (1 + Z / np.sqrt(32))
    # 60 s of aiding, correlated over the filter's memory of about 10 s: 6 independent ones per run.
    assert np.mean(nees) == pytest.approx(3.0, abs=Z * np.sqrt(6.0 / (8 * 6)))


def test_paper_form_coasts_worse_and_claims_worse():
    """The 11 states as printed: a few metres, a claim that exceeds the error; reported as they are."""
    rms, _, claimed, _ = coast(riss.Riss11(), P0_PAPER, 4)
    assert 0.4 < rms < 6.0 and claimed > 2.0


@pytest.mark.parametrize("model", MODELS, ids=lambda m: m.kind)
def test_compiled_epoch_is_the_python_one(model):
    n = model.n + 1  # and the inter-system bias
    x, p = np.zeros(kernels.N_X), np.diag(np.linspace(1, 2, n)) * 1e-6
    x[:19] = nominal()
    sensors = np.zeros((2, kernels.N_SENSOR))
    sensors[:, 2], sensors[:, 3], sensors[:, 6] = [0.1, 0.12], [0.3, 0.31], [10.0, 10.01]
    y, q = x[:19].copy(), p[:-1, :-1].copy()
    f, phi, qd = (np.zeros((n, n)) for _ in range(3))
    kernels.predict(
        model_code(model), x, p, sensors, 0.01, model.pitch_filter_s, model_rates(model), extended_q(model, x), f, phi, qd
    )  # fmt: skip
    for row in sensors:
        model.step(y, -row[2], row[3], row[4], row[6], 0.01)
    expected_phi, expected_qd = discretise(model.f_matrix(y, -0.11), model.q_diag(y), 0.02)
    np.testing.assert_allclose(x[:19], y, rtol=1e-14)
    np.testing.assert_allclose(phi[:-1, :-1], expected_phi, atol=1e-14)
    # Q's position terms follow the latitude within the epoch: 1e-7 of them.
    after = expected_phi @ q @ expected_phi.T + expected_qd
    np.testing.assert_allclose(p[:-1, :-1], after, rtol=1e-6, atol=1e-20)


def test_from_sensors_takes_the_specs_noise():
    model = riss.RissSf.from_sensors(
        ImuSpec(grade="karaim2020"), OdometerSpec(noise_mps=0.1, rate_hz=50), scale_sigma=0.03
    )
    assert model.gyro_sigma_deg_h == pytest.approx(10.0) and model.heading_noise_deg_rth == 1.0
    assert model.odometer_noise_m2_s == pytest.approx(0.01 / 50) and model.scale_sigma == 0.03


def test_refusals():
    with pytest.raises(ValueError, match="start moving"):
        riss.riss_nominal(ecef_from_geodetic(LAT, LON, H), np.zeros(3))
    odo = np.zeros(3, ODOMETER)
    odo["t_s"] = [0.0, 1.0, 2.0]
    with pytest.raises(ValueError, match="do not cover"):
        riss.speed_at(odo, np.array([5.0, 6.0]))
