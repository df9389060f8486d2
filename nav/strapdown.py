"""Strapdown mechanisation in ECEF, and initial alignment.

p' = v,  v' = C_be f^b - 2 w_ie x v + g(p),  C_be' = C_be [w_eb^b x]   (Abdel-Hafez, both papers, eq. 1-3; the
attitude is carried as a matrix and turned by exact rotation vectors, so that no quaternion normalisation
enters).
"""

import math

import numpy as np
from numba import njit

from nav.frames import gravity_ecef, rotation_body_to_ned, rotation_ned_to_ecef
from signals.constants import EARTH_RATE_RAD_S

_WE = EARTH_RATE_RAD_S
REST_TOLERANCE_G = 0.1
"""At rest the specific force may differ from 1 g by this part before alignment refuses it."""


@njit(cache=True, nogil=True)
def _rotate_columns_z(c, angle):
    """C <- R3(angle) C: an ECEF frame that turned by ``angle`` sees inertially fixed columns turned back."""
    ca, sa = math.cos(angle), math.sin(angle)
    for j in range(c.shape[1]):
        x, y = c[0, j], c[1, j]
        c[0, j], c[1, j] = ca * x + sa * y, ca * y - sa * x


@njit(cache=True, nogil=True)
def rotation_matrix(v, out):
    """exp([v x]) into ``out`` (3, 3): Rodrigues' formula, series below 1e-4 rad."""
    t2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    if t2 < 1e-8:
        s, c = 1.0 - t2 / 6.0, 0.5 - t2 / 24.0
    else:
        t = math.sqrt(t2)
        s, c = math.sin(t) / t, (1.0 - math.cos(t)) / t2
    for i in range(3):
        for j in range(3):
            out[i, j] = c * v[i] * v[j]
        out[i, i] += 1.0 - c * t2
    out[0, 1] -= s * v[2]
    out[1, 0] += s * v[2]
    out[0, 2] += s * v[1]
    out[2, 0] -= s * v[1]
    out[1, 2] -= s * v[0]
    out[2, 1] += s * v[0]


@njit(cache=True, nogil=True)
def _rotation_average(v, x, out):
    """Mean of exp([v x] u) x over u in 0..1 into ``out``: x + a v x x + b v x (v x x).

    The specific force of a turning body in the axes of the interval's start (Groves 2013, section 5.5).
    """
    t2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    if t2 < 1e-6:
        a, b = 0.5 - t2 / 24.0, 1.0 / 6.0 - t2 / 120.0
    else:
        t = math.sqrt(t2)
        a, b = (1.0 - math.cos(t)) / t2, (1.0 - math.sin(t) / t) / t2
    c0, c1, c2 = v[1] * x[2] - v[2] * x[1], v[2] * x[0] - v[0] * x[2], v[0] * x[1] - v[1] * x[0]
    out[0] = x[0] + a * c0 + b * (v[1] * c2 - v[2] * c1)
    out[1] = x[1] + a * c1 + b * (v[2] * c0 - v[0] * c2)
    out[2] = x[2] + a * c2 + b * (v[0] * c1 - v[1] * c0)


@njit(cache=True, nogil=True)
def strapdown_step(pos, vel, c_be, gyro, accel, dt_s):
    """Advance ECEF position (3,), velocity (3,), attitude (3, 3) in place by one IMU interval.

    gyro (3,) rad/s and accel (3,) m/s^2 are means over the interval, biases already taken out. Rate and
    specific force are taken as constant in the body over the interval (error of the attitude: coning, 1/12
    w_k x w_k+1 dt^2).
    """
    theta, dv_b, dv_0 = np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        theta[i], dv_b[i] = gyro[i] * dt_s, accel[i] * dt_s
    _rotation_average(theta, dv_b, dv_0)
    dv = np.empty((3, 1))
    for i in range(3):
        dv[i, 0] = c_be[i, 0] * dv_0[0] + c_be[i, 1] * dv_0[1] + c_be[i, 2] * dv_0[2]
    _rotate_columns_z(dv, 0.5 * _WE * dt_s)
    g, middle = np.empty(3), np.empty(3)
    for i in range(3):
        middle[i] = pos[i] + 0.5 * dt_s * vel[i]
    gravity_ecef(middle, g)
    vx = vel[0] + 0.5 * (dv[0, 0] + (g[0] + 2.0 * _WE * vel[1]) * dt_s)
    vy = vel[1] + 0.5 * (dv[1, 0] + (g[1] - 2.0 * _WE * vel[0]) * dt_s)
    new0 = vel[0] + dv[0, 0] + (g[0] + 2.0 * _WE * vy) * dt_s
    new1 = vel[1] + dv[1, 0] + (g[1] - 2.0 * _WE * vx) * dt_s
    new2 = vel[2] + dv[2, 0] + g[2] * dt_s
    pos[0] += 0.5 * dt_s * (vel[0] + new0)
    pos[1] += 0.5 * dt_s * (vel[1] + new1)
    pos[2] += 0.5 * dt_s * (vel[2] + new2)
    vel[0], vel[1], vel[2] = new0, new1, new2
    turn, old = np.empty((3, 3)), c_be.copy()
    rotation_matrix(theta, turn)
    for i in range(3):
        for j in range(3):
            c_be[i, j] = old[i, 0] * turn[0, j] + old[i, 1] * turn[1, j] + old[i, 2] * turn[2, j]
    _rotate_columns_z(c_be, _WE * dt_s)


@njit(cache=True, nogil=True)
def strapdown(pos, vel, c_be, gyro, accel, dt_s, pos_out, vel_out, c_out):
    """Run m IMU intervals: gyro, accel (m, 3), dt_s (m,); outputs (m, 3), (m, 3), (m, 3, 3) after each."""
    for k in range(gyro.shape[0]):
        strapdown_step(pos, vel, c_be, gyro[k], accel[k], dt_s[k])
        pos_out[k], vel_out[k], c_out[k] = pos, vel, c_be


def mechanise(pos_ecef_m, vel_ecef_mps, c_be, imu, start_s):
    """Free-inertial navigation through IMU rows from the state at ``start_s``.

    Returns
    -------
    pos_ecef_m (m, 3), vel_ecef_mps (m, 3), c_be (m, 3, 3) at the end of each row's interval.
    """
    m = imu.size
    dt = np.diff(imu["t_s"], prepend=start_s)
    if m and dt.min() <= 0.0:
        raise ValueError(
            "IMU times must rise from the start state's time on; sort the rows or start earlier."
        )
    pos_out, vel_out, c_out = np.empty((m, 3)), np.empty((m, 3)), np.empty((m, 3, 3))
    strapdown(
        np.array(pos_ecef_m, float), np.array(vel_ecef_mps, float), np.array(c_be, float, order="C"),
        np.ascontiguousarray(imu["gyro_rad_s"]), np.ascontiguousarray(imu["accel_mps2"]), dt,
        pos_out, vel_out, c_out,
    )  # fmt: skip
    return pos_out, vel_out, c_out


def level_from_rest(accel_mps2):
    """(pitch_rad, roll_rad) from the mean specific force (3,) at rest (Groves 2013, section 5.6.2).

    Raises
    ------
    ValueError
        The magnitude is not 1 g within 10 %: wrong units, or not at rest.
    """
    fx, fy, fz = (float(v) for v in accel_mps2)
    size = math.sqrt(fx * fx + fy * fy + fz * fz)
    if abs(size / 9.80665 - 1.0) > REST_TOLERANCE_G:
        raise ValueError(
            f"specific force at rest is {size:.3g} m/s^2, not within 10 % of 9.81: give accelerations in m/s^2, "
            "gravity left in, and align only at rest."
        )
    return math.atan2(fx, math.hypot(fy, fz)), math.atan2(-fy, -fz)


def heading_from_gyro(gyro_rad_s, pitch_rad, roll_rad):
    """Azimuth from the Earth's rate seen at rest (3,): for gyros far better than 15 deg/h."""
    level = rotation_body_to_ned(0.0, pitch_rad, roll_rad) @ np.asarray(gyro_rad_s, float)
    return math.atan2(-level[1], level[0])


def coarse_attitude(lat_rad, lon_rad, heading_rad, pitch_rad=0.0, roll_rad=0.0):
    """C_be (3, 3) from Euler angles at a place."""
    return rotation_ned_to_ecef(lat_rad, lon_rad) @ rotation_body_to_ned(heading_rad, pitch_rad, roll_rad)


def attitude_from_velocity(lat_rad, lon_rad, vel_ecef_mps, min_speed_mps=2.0):
    """C_be (3, 3) of a land vehicle that moves forward: heading and pitch from velocity, no roll.

    Raises
    ------
    ValueError
        Slower than min_speed_mps: the direction of a noisy velocity is not a heading.
    """
    vel = rotation_ned_to_ecef(lat_rad, lon_rad).T @ np.asarray(vel_ecef_mps, float)
    speed = float(np.linalg.norm(vel))
    if speed < min_speed_mps:
        raise ValueError(
            f"heading cannot be taken from a velocity of {speed:.2g} m/s: move faster than {min_speed_mps:g} m/s "
            "or give the initial heading."
        )
    heading, pitch = math.atan2(vel[1], vel[0]), math.atan2(-vel[2], math.hypot(vel[0], vel[1]))
    return coarse_attitude(lat_rad, lon_rad, heading, pitch, 0.0)
