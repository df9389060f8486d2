"""Error models against numerical Jacobians of nonlinear mechanisations written independently here."""

import numpy as np
import pytest

from nav.errormodels import (
    Ecef17,
    EcefState,
    Pinson13,
    PinsonState,
    gravity_gradient_ecef,
    measurement_rows,
    pinson_state,
    rotation_vector,
    skew,
)
from signals.constants import EARTH_RATE_RAD_S, MU_EARTH_M3_S2

WE = np.array([0, 0, EARTH_RATE_RAD_S])


def log_so3(c):
    """Rotation vector of a rotation matrix near the identity."""
    a = (c - c.T) / 2
    v = np.array([a[2, 1], a[0, 2], a[1, 0]])
    sine = np.linalg.norm(v)
    return v if sine == 0 else v * np.arcsin(sine) / sine


def first_order(f, j, dt, turn_rad_s):
    """Bound of an Euler step's error: F^2 dt, and the turn of C within the step, block by block."""
    own = np.abs(f[:, j])
    block = np.concatenate([np.full(3, own[i : i + 3].max()) for i in range(0, 3 * (own.size // 3), 3)])
    return dt * (np.abs(f) @ own) + turn_rad_s * dt * np.append(block, own[block.size :])


def ecef_derivative(s: EcefState, f_meas, w_meas):
    """Time derivative in the right tangent: (p', v', angular rate of C in ECEF, 0, 0, b', 0)."""
    p, v = s.pos_ecef_m, s.vel_ecef_mps
    g = -MU_EARTH_M3_S2 * p / np.linalg.norm(p) ** 3 - np.cross(WE, np.cross(WE, p))
    f_e = s.c_be @ (f_meas - s.accel_bias_mps2)
    turn = s.c_be @ (w_meas - s.gyro_bias_rad_s) - WE  # C' = [turn x] C, since w_eb^E = C w_ib - w_ie
    return v, f_e - 2 * np.cross(WE, v) + g, turn, np.zeros(3), np.zeros(3), s.clock_drift_mps, 0.0


def ecef_step(s, f_meas, w_meas, dt):
    """Euler step: exact for a first-order Jacobian as dt -> 0."""
    d = ecef_derivative(s, f_meas, w_meas)
    return EcefState(
        s.pos_ecef_m + dt * d[0], s.vel_ecef_mps + dt * d[1], rotation_vector(dt * d[2]) @ s.c_be,
        s.accel_bias_mps2, s.gyro_bias_rad_s, s.clock_bias_m + dt * d[5], s.clock_drift_mps,
    )  # fmt: skip


def ecef_minus(a, b):
    """Error state true a - estimate b."""
    return np.concatenate(
        [a.pos_ecef_m - b.pos_ecef_m, a.vel_ecef_mps - b.vel_ecef_mps, log_so3(a.c_be @ b.c_be.T),
         a.accel_bias_mps2 - b.accel_bias_mps2, a.gyro_bias_rad_s - b.gyro_bias_rad_s,
         [a.clock_bias_m - b.clock_bias_m, a.clock_drift_mps - b.clock_drift_mps]]
    )  # fmt: skip


def test_ecef17_f_matches_the_numerical_jacobian():
    model = Ecef17()
    rng = np.random.default_rng(1)
    s = EcefState(
        np.array([3.1e6, 4.6e6, 2.6e6]), np.array([40.0, -90.0, 25.0]), rotation_vector(rng.normal(size=3)),
        rng.normal(size=3) * 1e-2, rng.normal(size=3) * 1e-4, 12.0, 3.0,
    )  # fmt: skip
    f_meas, w_meas = np.array([3.0, -4.0, -8.0]), np.array([0.02, -0.1, 0.05])
    f = model.f_matrix(s, f_meas - s.accel_bias_mps2)
    scale = np.array([10.0] * 3 + [1.0] * 3 + [1e-4] * 3 + [1e-3] * 3 + [1e-5] * 3 + [1.0, 1.0])
    dt = 1e-3
    for j in range(17):
        dx = np.zeros(17)
        dx[j] = scale[j]
        plus = ecef_step(model.inject(s, dx), f_meas, w_meas, dt)
        minus = ecef_step(model.inject(s, -dx), f_meas, w_meas, dt)
        numeric = (ecef_minus(plus, minus) / 2 - dx) / dt / scale[j]
        # Rounding: positions of 4e6 m carry 1e-9 m, rotations 1e-15, divided by dt and the step.
        floor = np.array([1e-9] * 3 + [1e-13] * 3 + [1e-15] * 3 + [1e-17] * 6 + [1e-14] * 2) / dt / scale[j]
        tol = first_order(f, j, dt, 0.15) + floor
        assert np.all(np.abs(numeric - f[:, j]) <= tol), (j, numeric - f[:, j])


def test_gravity_gradient_is_traceless_but_for_the_centrifugal_part():
    g = np.empty((3, 3))
    gravity_gradient_ecef(np.array([1e6, -5e6, 4e6]), g)
    assert np.trace(g) == pytest.approx(2 * EARTH_RATE_RAD_S**2, rel=1e-9)
    np.testing.assert_allclose(g, g.T)


def pinson_step(s, f_b, w_b, h_baro, k2, dt, radius):
    """Wander-azimuth mechanisation on a sphere, with the vertical channel slaved to the corrected barometer."""
    v, r = s.vel_n_mps, radius + s.height_m
    omega = s.c_en @ WE
    rho = np.array([-v[1] / r, v[0] / r, 0.0])
    g = np.array([0.0, 0.0, -GRAVITY * (1 - 2 * s.height_m / radius)])
    a = s.c_bn @ f_b + g - np.cross(2 * omega + rho, v)
    return PinsonState(
        rotation_vector(-rho * dt) @ s.c_en, s.height_m + dt * (v[2] + k2 * (h_baro - s.baro_error_m - s.height_m)),
        v + dt * a, rotation_vector(-(omega + rho) * dt) @ s.c_bn @ rotation_vector(w_b * dt),
        s.baro_error_m * (1 - dt * 1.6667e-3), s.clock_bias_m + dt * s.clock_drift_mps, s.clock_drift_mps,
    )  # fmt: skip


GRAVITY = 32.08744 * 0.3048


def pinson_minus(a, b):
    """True a - estimate b; C_true = (I - [d x]) C_estimate."""
    return np.concatenate(
        [-log_so3(a.c_en @ b.c_en.T), -log_so3(a.c_bn @ b.c_bn.T), a.vel_n_mps - b.vel_n_mps,
         [a.height_m - b.height_m, a.baro_error_m - b.baro_error_m,
          a.clock_bias_m - b.clock_bias_m, a.clock_drift_mps - b.clock_drift_mps]]
    )  # fmt: skip


def test_pinson13_f_matches_the_numerical_jacobian(monkeypatch):
    radius = 6_378_137.0
    monkeypatch.setattr("nav.errormodels.earth_radii", lambda lat: (radius, radius))
    model = Pinson13(form="feedback")
    s = pinson_state(0.7, 0.3, 3000.0, [150.0, 90.0, 4.0], rotation_vector(np.array([0.1, -0.2, 0.4])))
    f_b, w_b = np.array([1.0, 0.5, 9.6]), np.array([0.01, 0.02, -0.03])
    f = model.f_matrix(s, f_b)
    # rho depends on height: V/R^2 per metre; the thesis leaves these entries of column 9 out.
    vr2 = np.linalg.norm(s.vel_n_mps) / radius**2
    scale = np.array([1e-4] * 6 + [1.0] * 3 + [1.0, 1.0, 1.0, 1.0])
    dt = 1e-2
    k2 = model.baro_gain_per_s
    for j in range(13):
        dx = np.zeros(13)
        dx[j] = scale[j]
        plus = pinson_step(model.inject(s, dx), f_b, w_b, 3010.0, k2, dt, radius)
        minus = pinson_step(model.inject(s, -dx), f_b, w_b, 3010.0, k2, dt, radius)
        numeric = (pinson_minus(plus, minus) / 2 - dx) / dt / scale[j]
        floor = np.array([1e-15] * 6 + [1e-12] * 3 + [2e-12] * 4) / dt / scale[j]
        tol = first_order(f, j, dt, 0.15) + floor
        if j == 9:
            tol = tol + vr2 * np.array([1, 1, 1, 1, 1, 1, 400, 400, 400, 0, 0, 0, 0])
        assert np.all(np.abs(numeric - f[:, j]) <= tol), (j, numeric - f[:, j], tol)


@pytest.mark.parametrize("rate", [False, True])
def test_pinson_maps_match_ecef_differences(rate):
    model = Pinson13()
    s = pinson_state(0.7, 0.3, 3000.0, [150.0, 90.0, 4.0])
    from nav.frames import earth_radii, ecef_from_geodetic

    r_m, r_n = earth_radii(0.7)
    east, north, up = 30.0, -20.0, 5.0

    def ecef_velocity(state):
        return state.c_en.T @ state.vel_n_mps

    if rate:
        dx = np.zeros(13)
        dx[0:3], dx[6:9] = [3e-6, -2e-6, 4e-6], [0.1, -0.2, 0.3]
        moved = model.inject(s, dx)
        np.testing.assert_allclose(model.vel_map(s) @ dx, ecef_velocity(moved) - ecef_velocity(s), atol=2e-6)
    else:
        dx = np.zeros(13)
        dx[0], dx[1], dx[9] = -north / (r_m + 3000), east / (r_n + 3000), up
        shifted = ecef_from_geodetic(0.7 - dx[0], 0.3 + dx[1] / np.cos(0.7), 3000.0 + up)
        truth = shifted - ecef_from_geodetic(0.7, 0.3, 3000.0)
        # Second order of a 36 m step: 36^2 tan(lat) / R = 2e-4 m.
        np.testing.assert_allclose(model.pos_map(s) @ dx, truth, atol=5e-4)


def test_feedforward_row_is_equation_51():
    s = pinson_state(0.7, 0.3, 0.0, [0.0, 0.0, 0.0])
    u = np.array([[0.6, 0.0, 0.8]]) @ s.c_en
    back = measurement_rows(Pinson13(), s, u)[0]
    forward = measurement_rows(Pinson13(form="feedforward"), s, u)[0]
    np.testing.assert_allclose(forward[:11], -back[:11])
    assert forward[11] == back[11] == 1.0


def test_feedback_and_feedforward_are_one_model():
    """A sign change of the inertial states and the clock kept turns one F into the other."""
    s = pinson_state(0.5, 0.1, 100.0, [100.0, 50.0, 0.0])
    flip = np.diag([-1.0] * 10 + [1.0, 1.0, 1.0])
    f_b = np.array([0.0, 0.0, 9.8])
    np.testing.assert_allclose(
        flip @ Pinson13(form="feedforward").f_matrix(s, f_b) @ flip, Pinson13().f_matrix(s, f_b), atol=1e-18
    )
    np.testing.assert_allclose(Pinson13(form="feedforward").baro_row() @ flip, -Pinson13().baro_row())


def test_injection_needs_feedback_form():
    with pytest.raises(ValueError, match="feedback"):
        Pinson13(form="feedforward").inject(pinson_state(0.5, 0, 0, [0, 0, 0]), np.zeros(13))


def test_skew_is_the_cross_product():
    a, b = np.array([1.0, 2.0, 3.0]), np.array([-2.0, 0.5, 1.0])
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b))
