"""Inertial sensors, odometer and barometer: one Spec both simulates them and tells the filter their noise.

Units in the Specs are those of data sheets; ``*_si`` properties are SI. Sensor axes are forward, right, down.
measured = (I + M + diag(scale)) true + bias + noise, then quantised increments (IEEE Std 952, annex B;
Groves 2013, section 4.4). Every random constant and process is drawn from the generator handed in.
"""

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from nav.errormodels import Ecef17, Pinson13
from nav.frames import geodetic_from_ecef, gravity_ecef
from nav.records import BAROMETER, IMU, ODOMETER
from signals.attitude import attitude, specific_force_ecef
from signals.constants import EARTH_RATE_RAD_S

G0_MPS2 = 9.80665
DEG_H = math.radians(1.0) / 3600.0
DEG_RTH = math.radians(1.0) / 60.0
MG = 1e-3 * G0_MPS2
MPS_RTH = 1.0 / 60.0

GRADES = {
    "ideal": {},
    "navigation": {
        "gyro_bias_deg_h": 0.01, "gyro_instability_deg_h": 0.003, "gyro_walk_deg_rth": 0.002,
        "accel_bias_mg": 0.03, "accel_instability_mg": 0.005, "accel_walk_mps_rth": 0.01,
        "scale_ppm": 10.0, "misalignment_mrad": 0.02,
    },
    "tactical": {
        "gyro_bias_deg_h": 3.0, "gyro_instability_deg_h": 1.0, "gyro_walk_deg_rth": 0.1,
        "accel_bias_mg": 1.0, "accel_instability_mg": 0.1, "accel_walk_mps_rth": 0.06,
        "scale_ppm": 300.0, "misalignment_mrad": 0.3,
    },
    "consumer": {
        "gyro_bias_deg_h": 720.0, "gyro_instability_deg_h": 20.0, "gyro_walk_deg_rth": 0.6,
        "accel_bias_mg": 20.0, "accel_instability_mg": 0.5, "accel_walk_mps_rth": 0.12,
        "scale_ppm": 3000.0, "misalignment_mrad": 5.0,
        "gyro_lsb_rad": 1.3e-6, "accel_lsb_mps": 5.9e-6,
    },
    "karaim2020": {
        "gyro_instability_deg_h": 10.0, "gyro_walk_deg_rth": 1.0,
        "accel_instability_mg": 1.0, "accel_walk_mps_rth": 0.05,
    },
}  # fmt: skip
"""Grades of IMU. navigation, tactical, consumer: typical of Groves 2013, table 4.1 and data sheets of the
class; consumer is quantised to 16 bits (+-500 deg/s, +-6 g at 100 Hz). karaim2020: table 1 of Karaim 2020,
whose accelerometer bias "1 deg/h" is read as 1 mg; scale, misalignment and turn-on biases are not stated
there."""


class ImuSpec(BaseModel):
    """Section ``[imu]``: three gyros and three accelerometers. ``grade`` sets what the other keys leave
    unset."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    grade: Literal["ideal", "navigation", "tactical", "consumer", "karaim2020"] = "tactical"
    """Quality class, which sets what the other keys leave unset."""
    rate_hz: Annotated[float, Field(ge=10, le=1000)] = 100.0
    """Output rate."""
    gyro_bias_deg_h: Annotated[float, Field(ge=0)] = 0.0
    """Turn-on bias, standard deviation; constant through a run."""
    gyro_instability_deg_h: Annotated[float, Field(ge=0)] = 0.0
    """Standard deviation of the first-order Gauss-Markov part."""
    gyro_tau_s: Annotated[float, Field(gt=0)] = 3600.0
    """Correlation time of the gyros' bias instability."""
    gyro_walk_deg_rth: Annotated[float, Field(ge=0)] = 0.0
    """Angular random walk (white rate noise)."""
    accel_bias_mg: Annotated[float, Field(ge=0)] = 0.0
    """Turn-on bias of the accelerometers, one sigma."""
    accel_instability_mg: Annotated[float, Field(ge=0)] = 0.0
    """Bias instability of the accelerometers."""
    accel_tau_s: Annotated[float, Field(gt=0)] = 3600.0
    """Correlation time of that instability."""
    accel_walk_mps_rth: Annotated[float, Field(ge=0)] = 0.0
    """Velocity random walk (white specific-force noise)."""
    scale_ppm: Annotated[float, Field(ge=0, le=1e5)] = 0.0
    """Scale factor error of each axis, standard deviation, gyros and accelerometers."""
    misalignment_mrad: Annotated[float, Field(ge=0, le=100)] = 0.0
    """Misalignment of the axes, one sigma."""
    gyro_lsb_rad: Annotated[float, Field(ge=0)] = 0.0
    """Quantum of an angle increment; 0: not quantised."""
    accel_lsb_mps: Annotated[float, Field(ge=0)] = 0.0
    """Quantum of a velocity increment."""
    attitude: Literal["land", "aircraft"] = "land"
    """How the body is turned while it moves: along the track without roll, or as in coordinated turns."""
    heading_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    """Heading of a vehicle that never moves."""

    @model_validator(mode="before")
    @classmethod
    def _fill_grade(cls, data):
        if isinstance(data, dict):
            return {**GRADES.get(data.get("grade", "tactical"), {}), **data}
        return data

    @property
    def gyro_noise_si(self) -> float:
        """White rate noise, rad/s/sqrt(Hz) = rad/sqrt(s)."""
        return self.gyro_walk_deg_rth * DEG_RTH

    @property
    def accel_noise_si(self) -> float:
        """White specific-force noise, m/s^2/sqrt(Hz)."""
        return self.accel_walk_mps_rth * MPS_RTH

    @property
    def gyro_bias_si(self) -> tuple[float, float]:
        """(turn-on, Gauss-Markov) standard deviations, rad/s."""
        return self.gyro_bias_deg_h * DEG_H, self.gyro_instability_deg_h * DEG_H

    @property
    def accel_bias_si(self) -> tuple[float, float]:
        """(turn-on, Gauss-Markov) standard deviations, m/s^2."""
        return self.accel_bias_mg * MG, self.accel_instability_mg * MG


class OdometerSpec(BaseModel):
    """Section ``[odometer]``: wheel speed = true speed / (1 - scale) + noise, scale a Gauss-Markov process.

    Rate, noise and correlation time are those of Karaim 2020; it does not state the size of the scale factor error.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    rate_hz: Annotated[float, Field(ge=1, le=1000)] = 100.0
    """Output rate."""
    noise_mps: Annotated[float, Field(ge=0, le=10)] = 0.01
    """White noise of the speed, one sigma."""
    scale_sigma: Annotated[float, Field(ge=0, le=0.2)] = 0.01
    """Standard deviation of the scale factor error."""
    scale_tau_s: Annotated[float, Field(gt=0)] = 3600.0
    """Its correlation time."""


class BarometerSpec(BaseModel):
    """Section ``[sensors.barometer]``: height + Gauss-Markov bias (the weather) + white noise.

    Size and correlation time of the bias are Vanek's (100 ft, 600 s; appendix A.2).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    rate_hz: Annotated[float, Field(ge=1, le=1000)] = 10.0
    """Output rate."""
    bias_sigma_m: Annotated[float, Field(ge=0, le=1000)] = 30.0
    """Standard deviation of the bias."""
    bias_tau_s: Annotated[float, Field(gt=0)] = 600.0
    """Its correlation time."""
    noise_m: Annotated[float, Field(gt=0, le=100)] = 0.3
    """White noise of a height, one sigma."""


BIAS_MEMORY_S = 10.0
"""A sensor bias for which a model has no state is taken as white noise that acts for this long in one direction."""


def pinson13_of(
    imu: ImuSpec, barometer: BarometerSpec, clock_phase_noise_m2_s, clock_freq_noise_m2_s3
) -> Pinson13:
    """The 13-state error model whose noise is that of an IMU and a barometer, as feedback filter.

    It has no states for sensor biases: sigma^2 ``BIAS_MEMORY_S`` of both their parts stands in, which is honest for
    navigation grade and coarse below. The barometer's noise comes in again through the height loop, k^2 sigma^2 / rate.
    """
    gyro, accel = math.hypot(*imu.gyro_bias_si), math.hypot(*imu.accel_bias_si)
    gain = Pinson13().baro_gain_per_s
    return Pinson13(
        q_gyro_rad2_s=imu.gyro_noise_si**2 + gyro**2 * BIAS_MEMORY_S,
        q_accel_m2_s3=imu.accel_noise_si**2 + accel**2 * BIAS_MEMORY_S,
        q_height_m2_s=(gain * barometer.noise_m) ** 2 / barometer.rate_hz,
        q_clock_m2_s=clock_phase_noise_m2_s, q_drift_m2_s3=clock_freq_noise_m2_s3,
        baro_sigma_m=barometer.bias_sigma_m, baro_rate_per_s=1.0 / barometer.bias_tau_s,
    )  # fmt: skip


def ecef17_of(imu: ImuSpec, **other) -> Ecef17:
    """The 17-state error model whose noise is that of an IMU; ``other`` sets the clock's densities.

    Gauss-Markov biases: driving noise sqrt(2/tau) sigma. With a turn-on bias beside it the sum neither
    decays nor forgets, so it is modelled as a random walk of that noise and its turn-on size belongs in
    P0. Scale factor and misalignment go with them.
    """
    values = {
        "accel_noise_mps2_rthz": imu.accel_noise_si,
        "gyro_noise_rad_s_rthz": imu.gyro_noise_si,
        "accel_bias_walk_mps2_rts": math.sqrt(2.0 / imu.accel_tau_s) * imu.accel_bias_si[1],
        "gyro_bias_walk_rad_s_rts": math.sqrt(2.0 / imu.gyro_tau_s) * imu.gyro_bias_si[1],
        "accel_bias_tau_s": imu.accel_tau_s if imu.accel_bias_mg == 0.0 else math.inf,
        "gyro_bias_tau_s": imu.gyro_tau_s if imu.gyro_bias_deg_h == 0.0 else math.inf,
        "scale_sigma": imu.scale_ppm * 1e-6,
        "misalignment_sigma_rad": imu.misalignment_mrad * 1e-3,
    }
    return Ecef17(**(values | other))


def gauss_markov(rng, sigma, tau_s, dt_s, shape):
    """First-order Gauss-Markov sequence along axis 0, stationary from the start.

    b_{k+1} = phi b_k + sqrt(sigma^2 (1 - phi^2)) w_k, phi = exp(-dt/tau) (Brown & Hwang 1992, first-order
    Gauss-Markov).
    """
    from scipy.signal import lfilter

    phi = math.exp(-dt_s / tau_s)
    w = rng.standard_normal(shape) * sigma
    w[1:] *= math.sqrt(1.0 - phi * phi)
    return lfilter([1.0], [1.0, -phi], w, axis=0)


def _times(duration_s, rate_hz):
    if not duration_s > 0.0:
        raise ValueError(f"sensor duration {duration_s:g} s is not positive.")
    return np.arange(1, math.floor(duration_s * rate_hz + 1e-9) + 1) / rate_hz


def _turn_ecef(angle_rad):
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _rotation_vectors(c):
    """Rotation vectors (m, 3) of rotation matrices (m, 3, 3), angles below 3 rad."""
    axis = np.stack([c[:, 2, 1] - c[:, 1, 2], c[:, 0, 2] - c[:, 2, 0], c[:, 1, 0] - c[:, 0, 1]], axis=1)
    sin2 = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sin2, np.trace(c, axis1=1, axis2=2) - 1.0)
    small = sin2 < 1e-9
    factor = np.where(small, 0.5, angle / np.where(small, 1.0, sin2))
    return axis * factor[:, None]


def _gravity(pos):
    out = np.empty_like(pos)
    for k in range(pos.shape[0]):
        gravity_ecef(pos[k], out[k])
    return out


def true_attitude(motion, t_s, kind="land", heading_rad=0.0):
    """C_be (m, 3, 3) and the specific force in ECEF (m, 3) of a motion at rising times t_s (m,)."""
    s = motion(np.asarray(t_s, float))
    pos = np.ascontiguousarray(s.pos_ecef_m)
    force = specific_force_ecef(s.vel_ecef_mps, s.acc_ecef_mps2, _gravity(pos))
    return attitude(pos, s.vel_ecef_mps, force, kind, heading_rad), force


def true_imu(motion, spec: ImuSpec, duration_s, fs_hz=1.0):
    """Error-free IMU rows of a motion from t = 0 on.

    gyro: rotation vector of C_bi(t0)^T C_bi(t1) over the interval, divided by it; accel: Simpson's mean of
    C_be^T f^e. ``sample_index`` = round(t_s fs_hz).
    """
    t1 = _times(duration_s, spec.rate_hz)
    dt = 1.0 / spec.rate_hz
    grid = np.arange(2 * t1.size + 1) * (0.5 * dt)
    c, force = true_attitude(motion, grid, spec.attitude, math.radians(spec.heading_deg))
    body = np.einsum("kji,kj->ki", c, force)
    turned = np.einsum("ij,kjl->kil", _turn_ecef(EARTH_RATE_RAD_S * dt), c[2::2])
    rows = np.zeros(t1.size, IMU)
    rows["t_s"], rows["sample_index"] = t1, np.round(t1 * fs_hz)
    rows["gyro_rad_s"] = _rotation_vectors(np.einsum("kji,kjl->kil", c[:-2:2], turned)) / dt
    rows["accel_mps2"] = (body[:-2:2] + 4.0 * body[1::2] + body[2::2]) / 6.0
    return rows


def _triad(rng, true, dt_s, bias, tau_s, noise, scale, misalignment, lsb):
    """Measured means (m, 3) of one triad; see the module's equation."""
    m = true.shape[0]
    matrix = np.eye(3) + rng.standard_normal((3, 3)) * misalignment * (1.0 - np.eye(3))
    matrix += np.diag(rng.standard_normal(3) * scale)
    offset = rng.standard_normal(3) * bias[0]
    wander = gauss_markov(rng, bias[1], tau_s, dt_s, (m, 3))
    white = rng.standard_normal((m, 3)) * (noise / math.sqrt(dt_s))
    measured = true @ matrix.T + offset + wander + white
    if lsb > 0.0:  # the remainder of each increment is carried to the next, as counters do
        total = np.round(np.cumsum(measured * dt_s, axis=0) / lsb) * lsb
        measured = np.diff(total, axis=0, prepend=0.0) / dt_s
    return measured, offset + wander


def simulate_imu(motion, spec: ImuSpec, seed, duration_s, fs_hz=1.0):
    """IMU rows with errors, and their true biases.

    Parameters
    ----------
    motion : callable t_s (m,) -> MotionState (``signals.trajectory``)
    seed : int, SeedSequence or Generator

    Returns
    -------
    IMU rows (m,), gyro bias (m, 3) rad/s, accelerometer bias (m, 3) m/s^2 (turn-on + Gauss-Markov).
    """
    rng, dt = np.random.default_rng(seed), 1.0 / spec.rate_hz
    rows = true_imu(motion, spec, duration_s, fs_hz)
    scale, tilt = spec.scale_ppm * 1e-6, spec.misalignment_mrad * 1e-3
    rows["gyro_rad_s"], gyro_bias = _triad(
        rng, rows["gyro_rad_s"], dt, spec.gyro_bias_si, spec.gyro_tau_s, spec.gyro_noise_si, scale, tilt,
        spec.gyro_lsb_rad,
    )  # fmt: skip
    rows["accel_mps2"], accel_bias = _triad(
        rng, rows["accel_mps2"], dt, spec.accel_bias_si, spec.accel_tau_s, spec.accel_noise_si, scale, tilt,
        spec.accel_lsb_mps,
    )  # fmt: skip
    return rows, gyro_bias, accel_bias


def simulate_odometer(motion, spec: OdometerSpec, seed, duration_s, fs_hz=1.0):
    """ODOMETER rows and the true scale factor error (m,): v_true = speed (1 - scale) without noise."""
    rng = np.random.default_rng(seed)
    t = _times(duration_s, spec.rate_hz)
    rows = np.zeros(t.size, ODOMETER)
    scale = gauss_markov(rng, spec.scale_sigma, spec.scale_tau_s, 1.0 / spec.rate_hz, t.size)
    true = np.linalg.norm(motion(t).vel_ecef_mps, axis=1)
    rows["t_s"], rows["sample_index"] = t, np.round(t * fs_hz)
    rows["speed_mps"] = true / (1.0 - scale) + spec.noise_mps * rng.standard_normal(t.size)
    return rows, scale


def simulate_barometer(motion, spec: BarometerSpec, seed, duration_s, fs_hz=1.0):
    """BAROMETER rows and the true bias (m,): height = true height + bias + noise."""
    rng = np.random.default_rng(seed)
    t = _times(duration_s, spec.rate_hz)
    rows = np.zeros(t.size, BAROMETER)
    bias = gauss_markov(rng, spec.bias_sigma_m, spec.bias_tau_s, 1.0 / spec.rate_hz, t.size)
    height = np.array([geodetic_from_ecef(p)[2] for p in np.ascontiguousarray(motion(t).pos_ecef_m)])
    rows["t_s"], rows["sample_index"] = t, np.round(t * fs_hz)
    rows["height_m"] = height + bias + spec.noise_m * rng.standard_normal(t.size)
    return rows, bias
