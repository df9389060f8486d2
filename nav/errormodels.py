"""Linear error models of the strapdown filters: the 17-state ECEF model and the 13-state Pinson model with barometer.

Error state dx = true - estimate. Each model is a Spec that gives ``names``, ``f_matrix(nominal, ...)``, ``q_diag()``,
``pos_map`` T_p and ``vel_map`` T_v (error state to ECEF position, velocity), ``idx_b``, ``idx_d`` (clock bias and drift,
m and m/s) and ``inject``, so that one measurement class serves every model: range row = -u' T_p + e_b, range-rate
row = -u' T_v + e_d with u the unit vector receiver -> satellite.
"""

from typing import Literal, NamedTuple

import numpy as np
from numba import njit
from pydantic import BaseModel, ConfigDict, Field

from nav.frames import earth_radii, rotation_enu_to_ecef
from signals.constants import EARTH_RATE_RAD_S, MU_EARTH_M3_S2, WGS84_A_M

GYRO_DEG_RT_H = 1.0 / 3437.746770784939
"""1 deg/rt-h in rad/rt-s: pi/180/60."""
FOOT_M = 0.3048
EQUATORIAL_GRAVITY_MPS2 = 32.08744 * FOOT_M
"""g_o of Vanek 1999, appendix A (ft/s^2 converted)."""


@njit(cache=True, nogil=True)
def skew_into(v, out):
    """[v x] written to ``out`` (3, 3)."""
    out[0, 0] = out[1, 1] = out[2, 2] = 0.0
    out[0, 1], out[0, 2], out[1, 2] = -v[2], v[1], -v[0]
    out[1, 0], out[2, 0], out[2, 1] = v[2], -v[1], v[0]


def skew(v: np.ndarray) -> np.ndarray:
    """[v x], (3, 3)."""
    out = np.empty((3, 3))
    skew_into(np.asarray(v, dtype=np.float64), out)
    return out


def rotation_vector(v: np.ndarray) -> np.ndarray:
    """exp([v x]) by Rodrigues' formula."""
    angle = float(np.linalg.norm(v))
    k = skew(v)
    if angle < 1e-8:
        return np.eye(3) + k + 0.5 * k @ k
    return np.eye(3) + np.sin(angle) / angle * k + (1 - np.cos(angle)) / angle**2 * k @ k


# --------------------------------------------------------------------------------------------- 17 states, ECEF


class EcefState(NamedTuple):
    """Nominal state of the ECEF filter; ``c_be`` rotates body into ECEF; measured = true + bias."""

    pos_ecef_m: np.ndarray
    vel_ecef_mps: np.ndarray
    c_be: np.ndarray
    accel_bias_mps2: np.ndarray
    gyro_bias_rad_s: np.ndarray
    clock_bias_m: float
    clock_drift_mps: float


@njit(cache=True, nogil=True)
def gravity_gradient_ecef(pos_ecef_m, out):
    """Gradient of gravity, -(mu/r^3)(I - 3 u u') + we^2 diag(1, 1, 0), into ``out`` (3, 3), 1/s^2."""
    r2 = pos_ecef_m[0] ** 2 + pos_ecef_m[1] ** 2 + pos_ecef_m[2] ** 2
    a = MU_EARTH_M3_S2 / (r2 * np.sqrt(r2))
    for i in range(3):
        for j in range(3):
            out[i, j] = 3.0 * a * pos_ecef_m[i] * pos_ecef_m[j] / r2
        out[i, i] -= a
    out[0, 0] += EARTH_RATE_RAD_S**2
    out[1, 1] += EARTH_RATE_RAD_S**2


@njit(cache=True, nogil=True)
def ecef17_f(pos_ecef_m, c_be, specific_force_body_mps2, accel_rate, gyro_rate, f):
    """F of the 17-state model into ``f`` (17, 17); ``*_rate`` = 1/correlation time of the biases, 1/s.

    dp' = dv ; dv' = G dp - 2 [w_ie x] dv - [f^E x] psi - C dba ; psi' = -[w_ie x] psi - C dbg ; db' = dd,
    with C_true = (I + [psi x]) C (Wei and Schwarz 1990; signs checked by numerical Jacobian in the tests).
    """
    f[:] = 0.0
    we = EARTH_RATE_RAD_S
    for i in range(3):
        f[i, 3 + i] = 1.0
        f[9 + i, 9 + i] = -accel_rate
        f[12 + i, 12 + i] = -gyro_rate
    gravity_gradient_ecef(pos_ecef_m, f[3:6, 0:3])
    f[3, 4], f[4, 3] = 2.0 * we, -2.0 * we
    f[6, 7], f[7, 6] = we, -we
    fe = np.zeros(3)
    for i in range(3):
        for j in range(3):
            fe[i] += c_be[i, j] * specific_force_body_mps2[j]
            f[3 + i, 9 + j] = -c_be[i, j]
            f[6 + i, 12 + j] = -c_be[i, j]
    skew_into(-fe, f[3:6, 6:9])
    f[15, 16] = 1.0


class Ecef17(BaseModel):
    """17 states in ECEF: dp dv psi dba dbg b d (Abdel-Hafez, both papers, equations 1-3 linearised).

    The noise strengths are not in the papers; the defaults are a tactical-grade IMU and a TCXO-like clock. Scale factors and
    misalignments have no states: while the body manoeuvres the biases take them in (``ultratight_kernels.predict``).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    kind: Literal["ecef17"] = "ecef17"
    accel_noise_mps2_rthz: float = Field(1e-3, ge=0, le=1)
    gyro_noise_rad_s_rthz: float = Field(0.1 * GYRO_DEG_RT_H, ge=0, le=1)
    accel_bias_walk_mps2_rts: float = Field(1e-5, ge=0, le=1)
    gyro_bias_walk_rad_s_rts: float = Field(1e-7, ge=0, le=1)
    accel_bias_tau_s: float = Field(float("inf"), gt=0)
    gyro_bias_tau_s: float = Field(float("inf"), gt=0)
    scale_sigma: float = Field(0.0, ge=0, le=0.1)
    misalignment_sigma_rad: float = Field(0.0, ge=0, le=0.1)
    clock_phase_noise_m2_s: float = Field(0.009, ge=0, le=1e6)
    clock_freq_noise_m2_s3: float = Field(0.035, ge=0, le=1e6)

    @property
    def n(self) -> int:
        """Number of states."""
        return 17

    @property
    def names(self) -> tuple[str, ...]:
        """State names with units."""
        axes = "xyz"
        blocks = ("dp_{}_m", "dv_{}_mps", "psi_{}_rad", "dba_{}_mps2", "dbg_{}_rad_s")
        return (*(b.format(a) for b in blocks for a in axes), "b_m", "d_mps")

    @property
    def idx_b(self) -> int:
        """Index of the clock bias."""
        return 15

    @property
    def idx_d(self) -> int:
        """Index of the clock drift."""
        return 16

    def f_matrix(self, nominal: EcefState, specific_force_body_mps2: np.ndarray) -> np.ndarray:
        """F (17, 17) at the nominal state; the specific force is the measured one less its bias estimate."""
        f = np.empty((17, 17))
        rates = 1.0 / self.accel_bias_tau_s, 1.0 / self.gyro_bias_tau_s
        c_be = np.ascontiguousarray(nominal.c_be)
        ecef17_f(np.asarray(nominal.pos_ecef_m), c_be, np.asarray(specific_force_body_mps2), *rates, f)
        return f

    def q_diag(self) -> np.ndarray:
        """Diagonal of Qc (17,); isotropic blocks need no rotation into ECEF."""
        q = np.zeros(17)
        q[3:6] = self.accel_noise_mps2_rthz**2
        q[6:9] = self.gyro_noise_rad_s_rthz**2
        q[9:12] = self.accel_bias_walk_mps2_rts**2
        q[12:15] = self.gyro_bias_walk_rad_s_rts**2
        q[15], q[16] = self.clock_phase_noise_m2_s, self.clock_freq_noise_m2_s3
        return q

    def pos_map(self, nominal: EcefState | None = None) -> np.ndarray:
        """T_p (3, 17)."""
        return np.eye(17)[0:3]

    def vel_map(self, nominal: EcefState | None = None) -> np.ndarray:
        """T_v (3, 17)."""
        return np.eye(17)[3:6]

    def inject(self, nominal: EcefState, dx: np.ndarray) -> EcefState:
        """Nominal state corrected by dx = true - estimate."""
        return EcefState(
            nominal.pos_ecef_m + dx[0:3],
            nominal.vel_ecef_mps + dx[3:6],
            rotation_vector(dx[6:9]) @ nominal.c_be,
            nominal.accel_bias_mps2 + dx[9:12],
            nominal.gyro_bias_rad_s + dx[12:15],
            nominal.clock_bias_m + dx[15],
            nominal.clock_drift_mps + dx[16],
        )


# --------------------------------------------------------------------------------------------- 13 states, Pinson


class PinsonState(NamedTuple):
    """Nominal state of the Pinson filter; navigation frame n = east, north, up with a small wander angle.

    ``c_en`` rotates ECEF into n, ``c_bn`` body into n; ``baro_error_m``: barometer = true height + error.
    """

    c_en: np.ndarray
    height_m: float
    vel_n_mps: np.ndarray
    c_bn: np.ndarray
    baro_error_m: float
    clock_bias_m: float
    clock_drift_mps: float


def latitude_of(c_en: np.ndarray) -> float:
    """Geodetic latitude, from the up axis in ECEF (row 2 of C_en)."""
    return float(np.arcsin(np.clip(c_en[2, 2], -1.0, 1.0)))


def pinson_state(lat_rad, lon_rad, height_m, vel_enu_mps, c_bn=None) -> PinsonState:
    """A nominal state without wander, barometer or clock error."""
    c_en = np.ascontiguousarray(rotation_enu_to_ecef(lat_rad, lon_rad).T)
    return PinsonState(
        c_en, height_m, np.array(vel_enu_mps, float), np.eye(3) if c_bn is None else c_bn, 0.0, 0.0, 0.0
    )


@njit(cache=True, nogil=True)
def pinson13_f(c_en, radii_m, v, force_n, baro_rate, baro_gain, damped, coupling, f):
    """F of the Pinson model into ``f`` (13, 13), Vanek 1999, appendix A.1, wander azimuth (rho_z = 0).

    ``radii_m`` (R_M + h, R_N + h); ``v``, ``force_n`` (3,) velocity and specific force in the navigation frame; ``damped`` 1 or 0 times -gain on the height,
    ``coupling`` +-1 times gain from the barometer's error to it. The change of rho with height, V/R^2 dh, is left out as in
    the thesis.
    """
    crx, cry = 1.0 / radii_m[1], 1.0 / radii_m[0]
    omega, both, d_rho = np.empty(3), np.empty(3), np.zeros((3, 3))
    for i in range(3):
        omega[i] = c_en[i, 2] * EARTH_RATE_RAD_S
    rho = np.array([-v[1] * cry, v[0] * crx, 0.0])
    d_rho[0, 1], d_rho[1, 0] = -cry, crx
    sv, so, part = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    skew_into(v, sv)
    skew_into(omega, so)
    f[:] = 0.0
    skew_into(-rho, f[0:3, 0:3])
    f[0:3, 6:9] = d_rho
    f[3:6, 6:9] = d_rho
    f[3:6, 0:3] = so
    skew_into(-(omega + rho), f[3:6, 3:6])
    f[6:9, 0:3] = 2.0 * np.dot(sv, so)
    skew_into(force_n, f[6:9, 3:6])
    both[:] = -(2.0 * omega + rho)
    skew_into(both, part)
    f[6:9, 6:9] = part + np.dot(sv, d_rho)
    f[8, 9] = 2.0 * EQUATORIAL_GRAVITY_MPS2 / WGS84_A_M
    f[9, 8] = 1.0
    f[9, 9] = -damped * baro_gain
    f[9, 10] = coupling * baro_gain
    f[10, 10] = -baro_rate
    f[11, 12] = 1.0


class Pinson13(BaseModel):
    """13 states of Vanek 1999 (eq. 42, appendix A): dtheta(3) phi(3) dV(3) dh dhB b d, in SI units.

    Signs. ``form="feedforward"`` is the thesis's: INS error = INS - true, clock and barometer errors as they are, range
    row +u (eq. 51), barometer row [dh - dhB] for h_INS - h_baro (eq. 46). ``form="feedback"`` is the project's
    dx = true - estimate; the inertial block of F is the same (it is homogeneous), the barometer coupling changes sign.

    ``printed_baro=True`` keeps F44 = [[0, k2], [k1, -beta]] of the thesis, in which nothing pulls the height back; the
    default has -k2 on the height, as a vertical channel slaved to the barometer must.

    The thesis's PSD units "deg^2/sec^3", "ft^2/sec^3", "ft^2/sec^5" are one or two powers of a second too many; the
    defaults are its numbers read as deg^2/s, ft^2/s and ft^2/s^3 (Qa, ft^2/s^3, is right as printed), in SI.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    kind: Literal["pinson13"] = "pinson13"
    form: Literal["feedback", "feedforward"] = "feedback"
    printed_baro: bool = False
    q_theta_xy_rad2_s: float = Field(4e-15 * np.radians(1) ** 2, ge=0)
    q_theta_z_rad2_s: float = Field(1e-8 * np.radians(1) ** 2, ge=0)
    q_gyro_rad2_s: float = Field(6.25e-10 * np.radians(1) ** 2, ge=0)
    q_accel_m2_s3: float = Field(1.037e-7 * FOOT_M**2, ge=0)
    q_height_m2_s: float = Field(15.0 * FOOT_M**2, ge=0)
    q_clock_m2_s: float = Field(10.0 * FOOT_M**2, ge=0)
    q_drift_m2_s3: float = Field(5e-12 * FOOT_M**2, ge=0)
    baro_sigma_m: float = Field(100.0 * FOOT_M, ge=0)
    baro_rate_per_s: float = Field(1.6667e-3, gt=0)
    baro_gain_per_s: float = Field(0.03, ge=0, lt=1)

    @property
    def n(self) -> int:
        """Number of states."""
        return 13

    @property
    def names(self) -> tuple[str, ...]:
        """State names with units."""
        blocks = ("dtheta_{}_rad", "phi_{}_rad", "dv_{}_mps")
        return (*(b.format(a) for b in blocks for a in "xyz"), "dh_m", "dhb_m", "b_m", "d_mps")

    @property
    def idx_b(self) -> int:
        """Index of the clock bias."""
        return 11

    @property
    def idx_d(self) -> int:
        """Index of the clock drift."""
        return 12

    def f_matrix(self, nominal: PinsonState, specific_force_body_mps2: np.ndarray) -> np.ndarray:
        """F (13, 13) at the nominal state (``pinson13_f``)."""
        f = np.empty((13, 13))
        r_m, r_n = earth_radii(latitude_of(nominal.c_en))
        pinson13_f(
            np.ascontiguousarray(nominal.c_en, dtype=np.float64),
            (r_m + nominal.height_m, r_n + nominal.height_m),
            np.asarray(nominal.vel_n_mps, np.float64), nominal.c_bn @ np.asarray(specific_force_body_mps2, np.float64),
            self.baro_rate_per_s, self.baro_gain_per_s, 0.0 if self.printed_baro else 1.0,
            1.0 if self.form == "feedforward" else -1.0, f,
        )  # fmt: skip
        return f

    def q_diag(self) -> np.ndarray:
        """Diagonal of Qc (13,), Vanek 1999, appendix A.2."""
        q = np.zeros(13)
        q[0:2], q[2] = self.q_theta_xy_rad2_s, self.q_theta_z_rad2_s
        q[3:6], q[6:9] = self.q_gyro_rad2_s, self.q_accel_m2_s3
        q[9], q[10] = self.q_height_m2_s, 2.0 * self.baro_rate_per_s * self.baro_sigma_m**2
        q[11], q[12] = self.q_clock_m2_s, self.q_drift_m2_s3
        return q

    def enu_map(self, nominal: PinsonState) -> np.ndarray:
        """Position error along the navigation axes (3, 13): east = R_N dtheta_y, north = -R_M dtheta_x, up = dh."""
        r_m, r_n = earth_radii(latitude_of(nominal.c_en))
        t = np.zeros((3, 13))
        t[0, 1], t[1, 0], t[2, 9] = r_n + nominal.height_m, -(r_m + nominal.height_m), 1.0
        return t

    def pos_map(self, nominal: PinsonState) -> np.ndarray:
        """T_p (3, 13) to ECEF."""
        return nominal.c_en.T @ self.enu_map(nominal)

    def vel_map(self, nominal: PinsonState) -> np.ndarray:
        """T_v (3, 13) to ECEF: the turn of the frame counts too, d(C_ne v) = C_ne (dV - [v x] dtheta)."""
        t = np.zeros((3, 13))
        t[:, 6:9] = np.eye(3)
        t[:, 0:3] = -skew(nominal.vel_n_mps)
        return nominal.c_en.T @ t

    def baro_row(self) -> np.ndarray:
        """Row of the barometer: [dh + dhB] for h_baro - predicted (feedback), [dh - dhB] for h_INS - h_baro."""
        row = np.zeros(13)
        row[9], row[10] = 1.0, 1.0 if self.form == "feedback" else -1.0
        return row

    def inject(self, nominal: PinsonState, dx: np.ndarray) -> PinsonState:
        """Nominal state corrected by dx = true - estimate (feedback form)."""
        if self.form != "feedback":
            raise ValueError(
                "Only the feedback form of the Pinson model is injected; the feedforward form corrects outputs."
            )
        return PinsonState(
            rotation_vector(dx[0:3]).T @ nominal.c_en,
            nominal.height_m + dx[9],
            nominal.vel_n_mps + dx[6:9],
            rotation_vector(dx[3:6]).T @ nominal.c_bn,
            nominal.baro_error_m + dx[10],
            nominal.clock_bias_m + dx[11],
            nominal.clock_drift_mps + dx[12],
        )


def measurement_rows(model, nominal, u_ecef: np.ndarray, rate: bool = False) -> np.ndarray:
    """Range rows (m, n) of ``u_ecef`` (m, 3), unit vectors receiver -> satellite; with ``rate``, range-rate rows.

    row = -u' T_p + e_b, or -u' T_v + e_d, for error states true - estimate; in the Pinson feedforward form the
    inertial part changes sign (Vanek 1999, eq. 51).
    """
    t = model.vel_map(nominal) if rate else model.pos_map(nominal)
    sign = 1.0 if getattr(model, "form", "feedback") == "feedforward" else -1.0
    rows = sign * np.asarray(u_ecef, dtype=np.float64) @ t
    rows[:, model.idx_d if rate else model.idx_b] += 1.0
    return rows


def unit_vectors_enu(az_deg, el_deg) -> np.ndarray:
    """Unit vectors (m, 3) east, north, up towards azimuths and elevations."""
    az, el = np.radians(az_deg), np.radians(el_deg)
    return np.stack([np.sin(az) * np.cos(el), np.cos(az) * np.cos(el), np.sin(el)], axis=-1)
