"""Reduced inertial sensor system (RISS): one gyro, two accelerometers, the odometer; error models.

Mechanisation of Karaim 2020, eq. 1-10, with the signs that our copy of it lacks:

    A'  = -[(wz - bz) - w_e sin(phi) - v_e tan(phi) / (R_N + h)]
    p   =  asin((f_y - a_o) / g),   r = -asin((f_x + v_o (wz - bz)) / (g cos p))
    v_e =  v sin(A) cos(p),  v_n = v cos(A) cos(p),  v_u = v sin(p)
    phi' = v_n / (R_M + h),  lam' = v_e / ((R_N + h) cos(phi)),  h' = v_u

A azimuth clockwise from north; wz up, f_y forward, f_x right (``riss_inputs`` takes them from body axes
forward, right, down). Errors are true - estimate.

The nominal state is one float64 array (``N_NOMINAL``,), so that kernels and Python share it; its columns
are the module's upper-case indices. Two forms:

* ``PAPER`` (``Riss11``): velocity is integrated from the odometer's acceleration a_o and the turn rate, so
  that a velocity correction survives; 11 states as printed. A scale factor error at constant speed has no state.
* ``SCALE`` (``RissSf``, default): v = v_o (1 - s), s the odometer's scale factor error; 9 states, with the
  pitch error as what feeds the vertical channel. Velocity has no state: its error is that of A, s and p.
"""

import math
from typing import Annotated, ClassVar, Literal

import numpy as np
from numba import njit
from pydantic import BaseModel, ConfigDict, Field

from nav.frames import (
    earth_radii,
    ecef_from_geodetic,
    geodetic_from_ecef,
    normal_gravity,
    position_map_geodetic,
    rotation_enu_to_ecef,
)
from signals.constants import EARTH_RATE_RAD_S

_WE = EARTH_RATE_RAD_S
PAPER, SCALE = 0, 1

LAT, LON, HEIGHT, VE, VN, VU, AZIMUTH = 0, 1, 2, 3, 4, 5, 6
ODO_ACCEL, SCALE_FACTOR, GYRO_BIAS, PITCH_ERROR, CLOCK_BIAS, CLOCK_DRIFT = 7, 8, 9, 10, 11, 12
PITCH, ROLL, FORCE_MEAN, ACCEL_MEAN, SPEED, ACCEL = 13, 14, 15, 16, 17, 18
N_NOMINAL = 19
"""Columns: geodetic position (rad, rad, m), ENU velocity, azimuth; corrections in force: odometer
acceleration m/s^2, scale factor, gyro bias rad/s (up), pitch rad, clock bias m and drift m/s; outputs
pitch, roll; memory of the mechanisation: low-passed f_y and a_o, last odometer speed, last odometer
acceleration."""

PAPER_STATES = np.array(
    [LAT, LON, HEIGHT, VE, VN, VU, AZIMUTH, ODO_ACCEL, GYRO_BIAS, CLOCK_BIAS, CLOCK_DRIFT]
)
SCALE_STATES = np.array(
    [LAT, LON, HEIGHT, AZIMUTH, SCALE_FACTOR, GYRO_BIAS, PITCH_ERROR, CLOCK_BIAS, CLOCK_DRIFT]
)
"""Nominal columns that the error states of the two forms correct, in their order."""

DEG_H = math.radians(1.0) / 3600.0
DEG_RTH = math.radians(1.0) / 60.0


def riss_inputs(imu_rows):
    """(wz, f_y, f_x) of IMU rows: gyro up, specific force forward and right, each (m,)."""
    gyro, accel = imu_rows["gyro_rad_s"], imu_rows["accel_mps2"]
    return -gyro[..., 2], accel[..., 0], accel[..., 1]


def riss_nominal(
    pos_ecef_m, vel_ecef_mps, azimuth_rad=None, speed_mps=None, clock_bias_m=0.0, clock_drift_mps=0.0
):
    """Nominal state (19,) from ECEF position and velocity; azimuth from the velocity unless given.

    Raises
    ------
    ValueError
        Slower than 2 m/s and no azimuth given: the velocity's direction is no heading.
    """
    x = np.zeros(N_NOMINAL)
    x[LAT], x[LON], x[HEIGHT] = geodetic_from_ecef(np.asarray(pos_ecef_m, float))
    east, north, up = rotation_enu_to_ecef(x[LAT], x[LON]).T @ np.asarray(vel_ecef_mps, float)
    speed = math.sqrt(east * east + north * north + up * up)
    if azimuth_rad is None:
        if speed < 2.0:
            raise ValueError(
                f"RISS cannot take a heading from {speed:.2g} m/s: give azimuth_rad, or start moving."
            )
        azimuth_rad = math.atan2(east, north)
    x[VE], x[VN], x[VU], x[AZIMUTH] = east, north, up, azimuth_rad
    x[SPEED] = speed if speed_mps is None else speed_mps
    x[PITCH] = math.asin(up / speed) if speed > 2.0 else 0.0
    x[FORCE_MEAN] = math.nan  # the first step fills the low pass
    x[CLOCK_BIAS], x[CLOCK_DRIFT] = clock_bias_m, clock_drift_mps
    return x


@njit(cache=True, nogil=True)
def riss_pos_vel(x, pos_out, vel_out):
    """ECEF position and velocity of a nominal state."""
    pos_out[:] = ecef_from_geodetic(x[LAT], x[LON], x[HEIGHT])
    r = rotation_enu_to_ecef(x[LAT], x[LON])
    for i in range(3):
        vel_out[i] = r[i, 0] * x[VE] + r[i, 1] * x[VN] + r[i, 2] * x[VU]


@njit(cache=True, nogil=True)
def _pitch_roll(x, fy, fx, wz, speed, dt_s, filter_s, first):
    """Pitch from the low-passed difference f_y - a_o (eq. 2), roll (eq. 3), into x.

    Both inputs pass the same first-order filter: differencing an odometer of 1 cm/s noise at 100 Hz gives
    1.4 m/s^2.
    """
    k = 1.0 if first else dt_s / (filter_s + dt_s)
    x[FORCE_MEAN] = fy if first else x[FORCE_MEAN] + k * (fy - x[FORCE_MEAN])
    x[ACCEL_MEAN] = 0.0 if first else x[ACCEL_MEAN] + k * (x[ACCEL] - x[ACCEL_MEAN])
    g = normal_gravity(x[LAT], x[HEIGHT])
    x[PITCH] = math.asin(max(-1.0, min(1.0, (x[FORCE_MEAN] - x[ACCEL_MEAN]) / g))) + x[PITCH_ERROR]
    side = (fx + speed * (wz - x[GYRO_BIAS])) / (g * math.cos(x[PITCH]))
    x[ROLL] = -math.asin(max(-1.0, min(1.0, side)))


@njit(cache=True, nogil=True)
def riss_step(x, form, wz, fy, fx, speed_mps, dt_s, filter_s):
    """Advance a nominal state by one sensor interval, in place.

    Parameters
    ----------
    x : (19,) nominal state;  form : PAPER or SCALE
    wz, fy, fx : means over the interval, rad/s (up), m/s^2 (forward, right)
    speed_mps : odometer at the interval's end;  filter_s : time constant of the pitch low pass
    """
    first = math.isnan(x[FORCE_MEAN])
    cp0, sp0 = math.cos(x[PITCH]), math.sin(x[PITCH])
    x[ACCEL] = 0.0 if first else (speed_mps - x[SPEED]) / dt_s
    _pitch_roll(x, fy, fx, wz, speed_mps, dt_s, filter_s, first)
    rm, rn = earth_radii(x[LAT])
    rm, rn = rm + x[HEIGHT], rn + x[HEIGHT]
    turn = -(wz - x[GYRO_BIAS] - _WE * math.sin(x[LAT]) - x[VE] * math.tan(x[LAT]) / rn)
    middle, end = x[AZIMUTH] + 0.5 * turn * dt_s, x[AZIMUTH] + turn * dt_s
    cp, sp = math.cos(x[PITCH]), math.sin(x[PITCH])
    if form == SCALE:
        v = 0.5 * (1.0 - x[SCALE_FACTOR]) * (speed_mps + (speed_mps if first else x[SPEED]))
        ve, vn, vu = v * math.sin(middle) * cp, v * math.cos(middle) * cp, v * sp
        v = (1.0 - x[SCALE_FACTOR]) * speed_mps
        x[VE], x[VN], x[VU] = v * math.sin(end) * cp, v * math.cos(end) * cp, v * sp
    else:
        ve, vn, vu = x[VE], x[VN], x[VU]
        # The increments of v_o cos p and v_o sin p hold a_o and the change of slope, left out in eq. 18.
        before = speed_mps if first else x[SPEED]
        if first:
            cp0, sp0 = cp, sp
        level = speed_mps * cp - before * cp0 + x[ODO_ACCEL] * cp * dt_s
        c, s = math.cos(turn * dt_s), math.sin(turn * dt_s)
        x[VE] = c * ve + s * vn + level * math.sin(middle)
        x[VN] = c * vn - s * ve + level * math.cos(middle)
        x[VU] = vu + speed_mps * sp - before * sp0 + x[ODO_ACCEL] * sp * dt_s
        ve, vn, vu = 0.5 * (ve + x[VE]), 0.5 * (vn + x[VN]), 0.5 * (vu + x[VU])
    x[LON] += ve * dt_s / (rn * math.cos(x[LAT]))
    x[LAT] += vn * dt_s / rm
    x[HEIGHT] += vu * dt_s
    x[AZIMUTH] = end
    x[SPEED] = speed_mps
    x[CLOCK_BIAS] += x[CLOCK_DRIFT] * dt_s


@njit(cache=True, nogil=True)
def riss_run(x, form, wz, fy, fx, speed, dt_s, filter_s, out):
    """``riss_step`` over m intervals of dt_s; out (m, 19) the state after each."""
    for k in range(wz.size):
        riss_step(x, form, wz[k], fy[k], fx[k], speed[k], dt_s, filter_s)
        out[k] = x


@njit(cache=True, nogil=True)
def riss11_f(x, wz, accel_rate, gyro_rate, f):
    """F (11, 11) of Karaim 2020, eq. 12-25, into ``f``; ``accel_rate`` and ``gyro_rate`` are 1/correlation time.

    Printed T17,7 in the vn row is T17,4 (the gyro bias); signs by numerical Jacobian.
    """
    f[:] = 0.0
    rm, rn = earth_radii(x[LAT])
    rm, rn = rm + x[HEIGHT], rn + x[HEIGHT]
    cl, tl = math.cos(x[LAT]), math.tan(x[LAT])
    ve, vn = x[VE], x[VN]
    w = wz - x[GYRO_BIAS] - _WE * math.sin(x[LAT]) - ve * tl / rn
    e = _WE * cl + ve / (cl * cl * rn)
    a = x[ACCEL] + x[ODO_ACCEL]
    sa, ca, cp, sp = math.sin(x[AZIMUTH]), math.cos(x[AZIMUTH]), math.cos(x[PITCH]), math.sin(x[PITCH])
    f[0, 4] = 1.0 / rm
    f[1, 3], f[1, 0] = 1.0 / (rn * cl), ve * tl / (rn * cl)
    f[2, 5] = 1.0
    f[3, 0], f[3, 3], f[3, 4] = vn * e, vn * tl / rn, -w
    f[3, 6], f[3, 7], f[3, 8] = a * ca * cp, sa * cp, vn
    f[4, 0], f[4, 3] = -ve * e, w - ve * tl / rn
    f[4, 6], f[4, 7], f[4, 8] = -a * sa * cp, ca * cp, -ve
    f[5, 7] = sp
    f[6, 0], f[6, 3], f[6, 8] = e, tl / rn, 1.0
    f[7, 7], f[8, 8] = -accel_rate, -gyro_rate
    f[9, 10] = 1.0


@njit(cache=True, nogil=True)
def riss_sf_velocity(x, v):
    """d(ENU velocity)/d(A, s, p) of the scale-factor form into ``v`` (3, 3)."""
    cp, sp = math.cos(x[PITCH]), math.sin(x[PITCH])
    sa, ca = math.sin(x[AZIMUTH]), math.cos(x[AZIMUTH])
    speed = (1.0 - x[SCALE_FACTOR]) * x[SPEED]
    v[0, 0], v[1, 0], v[2, 0] = speed * ca * cp, -speed * sa * cp, 0.0
    v[0, 1], v[1, 1], v[2, 1] = -x[SPEED] * sa * cp, -x[SPEED] * ca * cp, -x[SPEED] * sp
    v[0, 2], v[1, 2], v[2, 2] = -speed * sa * sp, -speed * ca * sp, speed * cp


@njit(cache=True, nogil=True)
def riss_sf_f(x, scale_rate, gyro_rate, pitch_rate, f):
    """F (9, 9) of the scale-factor form into ``f``: states lat lon h A s bz p b d; ``*_rate`` = 1/tau."""
    f[:] = 0.0
    rm, rn = earth_radii(x[LAT])
    rm, rn = rm + x[HEIGHT], rn + x[HEIGHT]
    cl, tl = math.cos(x[LAT]), math.tan(x[LAT])
    v = np.empty((3, 3))
    riss_sf_velocity(x, v)
    columns = (3, 4, 6)
    for k in range(3):
        c = columns[k]
        f[0, c] = v[1, k] / rm
        f[1, c] = v[0, k] / (rn * cl)
        f[2, c] = v[2, k]
        f[3, c] = v[0, k] * tl / rn
    f[0, 2] = -x[VN] / (rm * rm)
    f[1, 0], f[1, 2] = x[VE] * tl / (rn * cl), -x[VE] / (rn * rn * cl)
    f[3, 0] = _WE * cl + x[VE] / (cl * cl * rn)
    f[3, 5] = 1.0
    f[4, 4], f[5, 5], f[6, 6] = -scale_rate, -gyro_rate, -pitch_rate
    f[7, 8] = 1.0


class _Riss(BaseModel):
    """What both forms share."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    form_code: ClassVar[int]
    """PAPER or SCALE."""
    n: ClassVar[int]
    names: ClassVar[tuple[str, ...]]
    """State names with units."""
    state_columns: ClassVar[np.ndarray]
    """Nominal columns that the states correct."""
    idx_b: ClassVar[int]
    idx_d: ClassVar[int]
    """Indices of clock bias and drift."""

    gyro_sigma_deg_h: Annotated[float, Field(gt=0)] = 10.0
    gyro_tau_s: Annotated[float, Field(gt=0)] = 3600.0
    pitch_filter_s: Annotated[float, Field(ge=0, le=60)] = 1.0
    """Low pass on f_y - a_o."""
    clock_phase_noise_m2_s: Annotated[float, Field(ge=0)] = 0.009
    clock_freq_noise_m2_s3: Annotated[float, Field(ge=0)] = 0.035

    def step(self, x, wz, fy, fx, speed_mps, dt_s):
        """Advance the nominal state in place; see ``riss_step``."""
        riss_step(x, self.form_code, wz, fy, fx, speed_mps, dt_s, self.pitch_filter_s)

    @property
    def rates_per_s(self) -> np.ndarray:
        """1/tau of the model's Gauss-Markov states."""
        raise NotImplementedError

    def q_diag(self, x):
        """Diagonal of Qc (n,)."""
        raise NotImplementedError

    def inject(self, x, dx):
        """Nominal state corrected by dx = true - estimate (a new array)."""
        out = x.copy()
        out[self.state_columns] += dx
        if self.form_code == SCALE:
            out[PITCH] += dx[6]
            _set_velocity(out)
        return out

    def pos_map(self, x):
        """T_p (3, n) to ECEF: (R_M + h) in the latitude column, where Karaim 2020, eq. 34, has (R_N + h)."""
        t = np.zeros((3, self.n))
        t[:, :3] = position_map_geodetic(x[LAT], x[LON], x[HEIGHT])
        return t


def _set_velocity(x):
    """Velocity columns of the scale-factor form from speed, scale, azimuth and pitch."""
    v = (1.0 - x[SCALE_FACTOR]) * x[SPEED]
    horizontal = v * math.cos(x[PITCH])
    x[VE], x[VN] = horizontal * math.sin(x[AZIMUTH]), horizontal * math.cos(x[AZIMUTH])
    x[VU] = v * math.sin(x[PITCH])


class Riss11(_Riss):
    """Karaim's 11 states: dphi dlam dh dve dvn dvu dA dao dbz b d, velocity integrated (``PAPER``).

    Gyro and odometer errors as first-order Gauss-Markov processes (eq. 19, 20); white noise only there and
    on the clock drift, as printed (the expanded vector's 0 in place of sigma_d is a misprint).
    ``heading_noise_deg_rth`` adds the gyro's angular random walk, ``velocity_noise_mps2_rthz`` white
    acceleration on the three velocities; both are 0 in the paper. The sizes of the odometer process are not
    stated there: assumed.
    """

    form_code = PAPER
    n = 11
    names = (
        "dlat_rad", "dlon_rad", "dh_m", "dve_mps", "dvn_mps", "dvu_mps", "da_rad", "dao_mps2", "dbz_rad_s",
        "b_m", "d_mps",
    )  # fmt: skip
    state_columns = PAPER_STATES
    idx_b, idx_d = 9, 10

    kind: Literal["riss11"] = "riss11"
    accel_sigma_mps2: Annotated[float, Field(gt=0)] = 0.002
    accel_tau_s: Annotated[float, Field(gt=0)] = 100.0
    heading_noise_deg_rth: Annotated[float, Field(ge=0)] = 0.0
    velocity_noise_mps2_rthz: Annotated[float, Field(ge=0)] = 0.0

    @property
    def rates_per_s(self) -> np.ndarray:
        """1/tau of the odometer acceleration and the gyro bias."""
        return np.array([1.0 / self.accel_tau_s, 1.0 / self.gyro_tau_s])

    def f_matrix(self, x, wz):
        """F (11, 11) at a nominal state and the gyro reading wz (up, rad/s)."""
        f = np.empty((11, 11))
        riss11_f(x, float(wz), 1.0 / self.accel_tau_s, 1.0 / self.gyro_tau_s, f)
        return f

    def q_diag(self, x):
        """Diagonal of Qc (11,)."""
        q = np.zeros(11)
        q[3:6] = self.velocity_noise_mps2_rthz**2
        q[6] = (self.heading_noise_deg_rth * DEG_RTH) ** 2
        q[7] = 2.0 * self.accel_sigma_mps2**2 / self.accel_tau_s
        q[8] = 2.0 * (self.gyro_sigma_deg_h * DEG_H) ** 2 / self.gyro_tau_s
        q[9], q[10] = self.clock_phase_noise_m2_s, self.clock_freq_noise_m2_s3
        return q

    def vel_map(self, x):
        """T_v (3, 11) to ECEF: R_l^e on the velocity states (eq. 41-44)."""
        t = np.zeros((3, 11))
        t[:, 3:6] = rotation_enu_to_ecef(x[LAT], x[LON])
        return t


class RissSf(_Riss):
    """Scale-factor RISS: dphi dlam dh dA ds dbz dp b d (``SCALE``), the default.

    The odometer's white noise sigma at rate f enters as position noise of PSD sigma^2 / f; the pitch error
    is the accelerometer bias over g plus what the quasi-static pitch (eq. 2) leaves out.
    """

    form_code = SCALE
    n = 9
    names = ("dlat_rad", "dlon_rad", "dh_m", "da_rad", "ds", "dbz_rad_s", "dp_rad", "b_m", "d_mps")
    state_columns = SCALE_STATES
    idx_b, idx_d = 7, 8

    kind: Literal["riss_sf"] = "riss_sf"
    heading_noise_deg_rth: Annotated[float, Field(ge=0)] = 1.0
    scale_sigma: Annotated[float, Field(gt=0)] = 0.01
    scale_tau_s: Annotated[float, Field(gt=0)] = 3600.0
    pitch_sigma_mrad: Annotated[float, Field(gt=0)] = 2.0
    pitch_tau_s: Annotated[float, Field(gt=0)] = 300.0
    odometer_noise_m2_s: Annotated[float, Field(ge=0)] = 1e-6

    @classmethod
    def from_sensors(cls, imu, odometer, **other):
        """The model whose noise is that of an ImuSpec and an OdometerSpec."""
        gyro = math.hypot(*imu.gyro_bias_si) / DEG_H
        accel = math.hypot(*imu.accel_bias_si) / 9.80665 * 1e3
        values = {
            "gyro_sigma_deg_h": max(gyro, 1e-3),
            "gyro_tau_s": imu.gyro_tau_s,
            "heading_noise_deg_rth": imu.gyro_walk_deg_rth,
            "scale_sigma": max(odometer.scale_sigma, 1e-6),
            "scale_tau_s": odometer.scale_tau_s,
            "pitch_sigma_mrad": max(2.0 * accel, 0.5),
            "odometer_noise_m2_s": odometer.noise_mps**2 / odometer.rate_hz,
        }
        return cls(**(values | other))

    @property
    def rates_per_s(self) -> np.ndarray:
        """1/tau of the scale factor, the gyro bias and the pitch error."""
        return np.array([1.0 / self.scale_tau_s, 1.0 / self.gyro_tau_s, 1.0 / self.pitch_tau_s])

    def f_matrix(self, x, wz=0.0):
        """F (9, 9) at a nominal state (the gyro reading does not enter)."""
        f = np.empty((9, 9))
        riss_sf_f(x, 1.0 / self.scale_tau_s, 1.0 / self.gyro_tau_s, 1.0 / self.pitch_tau_s, f)
        return f

    def q_diag(self, x):
        """Diagonal of Qc (9,) at a nominal state (position noise in rad^2/s needs the radii)."""
        rm, rn = earth_radii(x[LAT])
        q = np.zeros(9)
        q[0] = self.odometer_noise_m2_s / (rm + x[HEIGHT]) ** 2
        q[1] = self.odometer_noise_m2_s / ((rn + x[HEIGHT]) * math.cos(x[LAT])) ** 2
        q[2] = self.odometer_noise_m2_s
        q[3] = (self.heading_noise_deg_rth * DEG_RTH) ** 2
        q[4] = 2.0 * self.scale_sigma**2 / self.scale_tau_s
        q[5] = 2.0 * (self.gyro_sigma_deg_h * DEG_H) ** 2 / self.gyro_tau_s
        q[6] = 2.0 * (self.pitch_sigma_mrad * 1e-3) ** 2 / self.pitch_tau_s
        q[7], q[8] = self.clock_phase_noise_m2_s, self.clock_freq_noise_m2_s3
        return q

    def vel_map(self, x):
        """T_v (3, 9) to ECEF: velocity errors are those of azimuth, scale factor and pitch."""
        v, t = np.empty((3, 3)), np.zeros((3, 9))
        riss_sf_velocity(x, v)
        t[:, [3, 4, 6]] = rotation_enu_to_ecef(x[LAT], x[LON]) @ v
        return t


def speed_at(odometer_rows, t_s):
    """Odometer speed at IMU times, linear between rows (a slow odometer is late by one interval).

    Raises
    ------
    ValueError
        IMU times outside the odometer's.
    """
    t = odometer_rows["t_s"]
    step = t[1] - t[0] if t.size > 1 else 0.0
    if t.size == 0 or t_s[0] < t[0] - 1.5 * step or t_s[-1] > t[-1] + 1.5 * step:
        raise ValueError(
            "the odometer data do not cover the time of the IMU data; record both over the same time."
        )
    return np.interp(t_s, t, odometer_rows["speed_mps"])
