"""The high-acceleration profile of Abdel-Hafez's papers as a linear filter problem (phi, Qd, H), without IF samples.

The papers give a figure of the acceleration and "small angular velocity" only; amplitudes, periods, IMU grade, geometry
and initial covariance are assumptions of this project, named here once.
"""

from typing import NamedTuple

import numpy as np

from nav import eskf
from nav.errormodels import Ecef17, EcefState, measurement_rows, unit_vectors_enu
from nav.frames import ecef_from_geodetic, gravity_ecef, rotation_enu_to_ecef
from signals.constants import EARTH_RATE_RAD_S

ACCEL_MPS2 = np.array([10.0, 8.0, 5.0])
PERIOD_S = np.array([20.0, 14.0, 9.0])
YAW_RATE_RAD_S = 0.02
AZIMUTH_DEG = (20.0, 75.0, 140.0, 200.0, 255.0, 310.0, 0.0)
ELEVATION_DEG = (35.0, 18.0, 42.0, 25.0, 55.0, 15.0, 80.0)
LAT_RAD, LON_RAD, HEIGHT_M = np.radians(25.3), np.radians(55.5), 1000.0
P0_SIGMA = np.r_[[10.0] * 3, [1.0] * 3, [0.01] * 3, [0.05] * 3, [1e-4] * 3, 30.0, 3.0]
"""m, m/s, rad, m/s^2, rad/s, m, m/s."""


class Problem(NamedTuple):
    """A linear filter problem at a fixed measurement rate."""

    t_s: np.ndarray
    phi: np.ndarray
    qd: np.ndarray
    h: np.ndarray
    p0: np.ndarray
    dt_s: float


def acceleration_enu(t_s: np.ndarray | float) -> np.ndarray:
    """Acceleration (..., 3): sinusoids that start and end every period with zero mean velocity."""
    return ACCEL_MPS2 * np.cos(2 * np.pi * np.asarray(t_s)[..., None] / PERIOD_S)


def nominal(t_s: float) -> tuple[EcefState, np.ndarray]:
    """Nominal state and specific force in the body frame (level, turning slowly) at one time."""
    w = 2 * np.pi / PERIOD_S
    axes = rotation_enu_to_ecef(LAT_RAD, LON_RAD)
    offset, speed = ACCEL_MPS2 * (1 - np.cos(w * t_s)) / w**2, ACCEL_MPS2 * np.sin(w * t_s) / w
    pos = ecef_from_geodetic(LAT_RAD, LON_RAD, HEIGHT_M) + axes @ offset
    vel = axes @ speed
    yaw = YAW_RATE_RAD_S * t_s
    c_enu_body = np.array([[np.sin(yaw), np.cos(yaw), 0], [np.cos(yaw), -np.sin(yaw), 0], [0, 0, -1.0]])
    c_be = axes @ c_enu_body
    gravity = np.empty(3)
    gravity_ecef(pos, gravity)
    rate = np.array([0.0, 0.0, EARTH_RATE_RAD_S])
    f_e = axes @ acceleration_enu(t_s) + 2 * np.cross(rate, vel) - gravity
    return EcefState(pos, vel, c_be, np.zeros(3), np.zeros(3), 0.0, 0.0), c_be.T @ f_e


def range_rows() -> np.ndarray:
    """H (7, 17) of the assumed satellites, far enough away to be constant."""
    u = unit_vectors_enu(AZIMUTH_DEG, ELEVATION_DEG) @ rotation_enu_to_ecef(LAT_RAD, LON_RAD).T
    return measurement_rows(Ecef17(), None, u)


def problem(rate_hz: float, n_epochs: int, model: Ecef17 | None = None) -> Problem:
    """phi[e], qd[e] lead to epoch e (epoch 0: identity); steps of at most 0.1 s are chained."""
    model = Ecef17() if model is None else model
    steps = max(1, round(10.0 / rate_hz))
    dt = 1.0 / rate_hz / steps
    phi, qd = np.tile(np.eye(17), (n_epochs, 1, 1)), np.zeros((n_epochs, 17, 17))
    q = model.q_diag()
    for e in range(1, n_epochs):
        for i in range(steps):
            state, force = nominal(((e - 1) * steps + i + 0.5) * dt)
            one, noise = eskf.discretise(model.f_matrix(state, force), q, dt)
            phi[e] = one @ phi[e]
            qd[e] = one @ qd[e] @ one.T + noise
    h = np.tile(range_rows(), (n_epochs, 1, 1))
    return Problem(np.arange(n_epochs) / rate_hz, phi, qd, h, np.diag(P0_SIGMA**2), 1.0 / rate_hz)


def filter_log(p: Problem, var_m2: np.ndarray) -> eskf.EpochLog:
    """Epoch log of a filter that believes R = diag(var_m2)."""
    return eskf.linear_log(p.phi, p.qd, p.h, var_m2, p.p0, p.dt_s)
