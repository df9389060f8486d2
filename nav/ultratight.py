"""Vector and ultra-tight receivers: one error-state filter fed by discriminators, which steers every channel's NCOs.

Settings of one receiver: ``scalar`` (each channel has its own loops), ``vector`` (position, velocity and clock predict all
NCOs) and ``ultra_tight`` (an inertial model predicts between updates). Innovations are taken about the NCO state, rows are
scaled by the discriminators' gains and weighted by a fast C/N0, so that a jammed channel weighs nothing instead of being
switched off. The kernels are in ``nav.ultratight_kernels``.
"""

import math
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from nav import ultratight_kernels as kernels
from nav.eskf import EpochLog, empty_log, epochs_of, newest
from nav.frames import earth_radii
from nav.imu import G0_MPS2, BarometerSpec, ecef17_of, pinson13_of
from nav.riss import DEG_H, HEIGHT, LAT, Riss11, RissSf, riss_nominal
from nav.strapdown import attitude_from_velocity, coarse_attitude
from signals.modulation import chip_acf

MODES = ("scalar", "vector", "ultra_tight")
SCALAR, STEERED, COASTING, LOST = range(4)
"""``STEERING.state``: own loops; steered and corrected by satellites; steered without any; released."""
USABLE_CN0_HZ = 10.0**1.7
"""C/N0 (17 dB-Hz) above which a channel counts as seen in reports; the filter weighs all channels."""
_DRAWS = 8192


class Kinematic(BaseModel):
    """Position, velocity and clock driven by white acceleration: the vector receiver without sensors."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    kind: Literal["kinematic"] = "kinematic"
    accel_psd_m2_s3: Annotated[float, Field(gt=0)] = 1.0
    clock_phase_noise_m2_s: Annotated[float, Field(ge=0)] = 0.009
    clock_freq_noise_m2_s3: Annotated[float, Field(ge=0)] = 0.035

    @property
    def n(self) -> int:
        """Number of states."""
        return 8

    def q_diag(self, x=None):
        """Diagonal of Qc (8,)."""
        q = np.zeros(8)
        q[3:6] = self.accel_psd_m2_s3
        q[6], q[7] = self.clock_phase_noise_m2_s, self.clock_freq_noise_m2_s3
        return q


class SteeringSpec(BaseModel):
    """Section ``[receiver.steering]``: who steers the channels' NCOs, and by which model."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    mode: Literal["scalar", "vector", "ultra_tight"] = "scalar"
    """Channels on their own loops, steered by the position filter, or by it with an IMU."""
    model: Literal["kinematic", "riss_sf", "riss11", "ecef17", "pinson13"] | None = None
    """None: kinematic for vector, riss_sf for ultra_tight. The two RISS forms need an odometer, pinson13 a barometer."""
    update_hz: Annotated[float, Field(ge=5, le=100)] = 50.0
    """Rate at which the filter commands the channels."""
    compare: tuple[Literal["scalar", "vector", "ultra_tight"], ...] = ()
    """Run these receivers side by side on the same samples."""
    start_after_s: Annotated[float, Field(ge=0, le=3600)] = 2.0
    """Scalar fixes this long before the hand-over."""
    min_satellites: Annotated[int, Field(ge=4, le=24)] = 4
    """Satellites needed to take the channels over."""
    heading_deg: Annotated[float | None, Field(ge=-360, le=360)] = None
    """Initial azimuth; None: from the velocity, once it is fast enough."""
    accel_psd_m2_s3: Annotated[float, Field(gt=0, le=1e4)] = 1.0
    """White acceleration of the vector filter."""
    clock_phase_noise_m2_s: Annotated[float, Field(ge=0)] = 0.009
    """Spectral density of the clock's phase noise."""
    clock_freq_noise_m2_s3: Annotated[float, Field(ge=0)] = 0.035
    """Spectral density of the clock's frequency noise."""
    fast_cn0_s: Annotated[float, Field(ge=0.02, le=10)] = 0.1
    """Time constant of the C/N0 that weighs measurements."""
    slow_cn0_s: Annotated[float, Field(ge=0.02, le=60)] = 1.0
    """Time constant of the C/N0 it is compared with."""
    limit_sigma: Annotated[float, Field(ge=0)] = 4.0
    """Innovations beyond it are weighed down to it; 0: never."""
    prefilter_hz: Annotated[float | None, Field(gt=0, le=100)] = None
    """Each channel averages its innovations and gives them to the filter at this rate; None: at every update."""
    code_floor_m: Annotated[float, Field(ge=0)] = 0.05
    """Least standard deviation of a range."""
    code_noise_m: Annotated[float | None, Field(gt=0, le=1000)] = None
    """Range noise of one integration that the filter believes, whatever the C/N0; None: by the C/N0, as it should be."""
    rate_floor_mps: Annotated[float, Field(ge=0)] = 0.01
    """Least standard deviation of a range rate."""
    range_sigma_m: Annotated[float, Field(gt=0)] = 3.0
    """Errors common to a satellite's ranges (orbit, atmosphere): a floor of the start covariance."""
    release_code_m: Annotated[float, Field(gt=0)] = 147.0
    """The filter lets go when it predicts some range no better than this (half a chip)."""
    release_rate_mps: Annotated[float, Field(gt=0)] = 4.0
    """... or some rate no better than this (21 Hz)."""

    @model_validator(mode="after")
    def _fits(self):
        if self.mode == "vector" and self.model not in (None, "kinematic"):
            raise ValueError(f'mode = "vector" has no sensors: its model is "kinematic", not "{self.model}"')
        if self.mode == "ultra_tight" and self.model == "kinematic":
            raise ValueError(
                'mode = "ultra_tight" needs an inertial model: "riss_sf", "riss11", "ecef17" or "pinson13"'
            )
        per_block = self.update_hz / (self.prefilter_hz or self.update_hz)
        if per_block < 1 or abs(per_block - round(per_block)) > 1e-9:
            raise ValueError(
                f"prefilter_hz = {self.prefilter_hz:g} does not divide update_hz = {self.update_hz:g}: a block is whole updates"
            )
        return self

    @property
    def block(self) -> int:
        """Updates that one block of the pre-filter takes."""
        return 1 if self.prefilter_hz is None else round(self.update_hz / self.prefilter_hz)

    def with_mode(self, mode):
        """The same settings as another receiver."""
        model = None if mode != "ultra_tight" or self.model == "kinematic" else self.model
        return self.model_copy(update={"mode": mode, "model": model, "compare": ()})


# ---------------------------------------------------------------------------------------------- discriminators


@lru_cache(maxsize=32)
def discriminator_table(signal="L1CA", spacing_chips=0.5) -> np.ndarray:
    """Gain and variance of the normalised envelope and of atan2(cross, dot) against C/N0 T, (rows, 4) float64.

    By simulation with common random numbers: z = R(tap - eps) + n, E|n|^2 = 1 / (C/N0 T), noise of E and L correlated
    by R(d). Gain: central difference at +-0.02 chip and +-0.02 cycle over its noise-free slope; variance at zero error.
    Columns: code gain, code variance (chips^2), frequency gain, variance of f T / 2 (cycles^2).
    """
    waveform = "BPSK" if signal == "L1CA" else "BOC11"
    half = 0.5 * spacing_chips
    r = lambda d: float(chip_acf(d, waveform, waveform))  # noqa: E731
    rng = np.random.Generator(np.random.Philox(20200523))
    n = rng.standard_normal((4, _DRAWS)) + 1j * rng.standard_normal((4, _DRAWS))
    n = np.concatenate([n, -n], axis=1) * math.sqrt(0.5)
    rho = r(spacing_chips)
    early, late = n[0], rho * n[0] + math.sqrt(1.0 - rho * rho) * n[1]
    h = 1e-3
    scale = r(half) / ((r(half - h) - r(half + h)) / (2 * h))
    eps, turn = 0.04 * spacing_chips, 0.02
    out = []
    for k in range(121):
        sigma = 10 ** (-0.05 * (kernels.TABLE_LOW_DB + k * kernels.TABLE_STEP_DB))

        def code(e, sigma=sigma):
            # Incoming code ahead by e: the early replica is closer.
            a, b = np.abs(r(half - e) + sigma * early), np.abs(r(half + e) + sigma * late)
            return scale * (a - b) / (a + b)

        def freq(f, sigma=sigma):
            w = np.exp(2j * np.pi * f)
            one, two = 0.5 + sigma * math.sqrt(0.5) * n[2], 0.5 * w + sigma * math.sqrt(0.5) * n[3]
            return np.angle(two * one.conj()) / (2 * np.pi)

        slope = (code(eps).mean() - code(-eps).mean()) / (2 * eps)
        clean = scale * (r(half - eps) - r(half + eps)) / (r(half - eps) + r(half + eps)) / eps
        slope_f = (freq(turn) - freq(-turn)).mean() / (2 * turn)
        out.append((slope / clean, np.mean(code(0.0) ** 2), slope_f, np.mean(freq(0.0) ** 2)))
    table = np.array(out)
    table[:, 0::2] = np.clip(table[:, 0::2], 1e-4, 1.0)
    table.flags.writeable = False
    return table


# ------------------------------------------------------------------------------------------------ the filter


def model_code(model) -> int:
    """Kernel code of an error model."""
    if hasattr(model, "form_code"):
        return model.form_code
    return {"ecef17": kernels.ECEF17, "kinematic": kernels.KINEMATIC, "pinson13": kernels.PINSON}[model.kind]


def model_rates(model, barometer=None) -> np.ndarray:
    """What ``kernels.predict`` calls rates (4,): inverse correlation times of a model's bias states; barometer or matrix errors."""
    if hasattr(model, "rates_per_s"):
        own = model.rates_per_s
    elif model.kind == "ecef17":
        own = np.array(
            [
                1.0 / model.accel_bias_tau_s, 1.0 / model.gyro_bias_tau_s, model.scale_sigma**2,
                model.misalignment_sigma_rad**2,
            ]
        )  # fmt: skip
    elif model.kind == "pinson13":
        own = np.array(
            [model.baro_rate_per_s, model.baro_gain_per_s, (barometer or BarometerSpec()).noise_m ** 2]
        )
    else:
        own = np.zeros(0)
    return np.concatenate([own, np.zeros(4 - own.size)])


def build_model(spec: SteeringSpec, imu=None, odometer=None, barometer=None):
    """The error model of a SteeringSpec with the noise of the sensors' Specs."""
    clock = {
        "clock_phase_noise_m2_s": spec.clock_phase_noise_m2_s,
        "clock_freq_noise_m2_s3": spec.clock_freq_noise_m2_s3,
    }
    if spec.mode == "vector":
        return Kinematic(accel_psd_m2_s3=spec.accel_psd_m2_s3, **clock)
    kind = spec.model or "riss_sf"
    beside = {"ecef17": None, "pinson13": "barometer"}.get(kind, "odometer")
    if imu is None or (beside and {"barometer": barometer, "odometer": odometer}[beside] is None):
        needs, options = (
            ("an IMU", "--imu")
            if beside is None
            else (f"an IMU and {'an' if beside[0] == 'o' else 'a'} {beside}", f"--imu and --{beside}")
        )
        raise ValueError(f'receiver.steering.model = "{kind}" needs {needs}: add [sensors] or give {options}')
    if kind == "ecef17":
        return ecef17_of(imu, **clock)
    if kind == "pinson13":
        return pinson13_of(imu, barometer, **clock)
    if kind == "riss_sf":
        return RissSf.from_sensors(imu, odometer, **clock)
    return Riss11(
        gyro_sigma_deg_h=max(math.hypot(*imu.gyro_bias_si) / DEG_H, 1e-3), gyro_tau_s=imu.gyro_tau_s,
        heading_noise_deg_rth=imu.gyro_walk_deg_rth, velocity_noise_mps2_rthz=0.05, **clock,
    )  # fmt: skip


def nominal_of(
    model, pos_ecef_m, vel_ecef_mps, bias_m, drift_mps, isb_m=0.0, azimuth_rad=None, speed_mps=None
):
    """Flat nominal state (N_X,) of a model; RISS and strapdown take their heading from the velocity unless given."""
    x = np.zeros(kernels.N_X)
    x[kernels.ISB] = isb_m
    code = model_code(model)
    if code <= kernels.SCALE:
        x[:19] = riss_nominal(pos_ecef_m, vel_ecef_mps, azimuth_rad, speed_mps, bias_m, drift_mps)
    else:
        x[0:3], x[3:6] = pos_ecef_m, vel_ecef_mps
        if code == kernels.KINEMATIC:
            x[6], x[7] = bias_m, drift_mps
        else:
            from nav.frames import geodetic_from_ecef

            lat, lon, _ = geodetic_from_ecef(np.asarray(pos_ecef_m, float))
            c = (
                coarse_attitude(lat, lon, azimuth_rad)
                if azimuth_rad is not None
                else attitude_from_velocity(lat, lon, vel_ecef_mps)
            )
            x[6:15] = c.ravel()
            x[21], x[22] = bias_m, drift_mps
            x[kernels.BARO_HEIGHT] = x[kernels.USUAL : kernels.USUAL + 6] = np.nan
    return x


def start_covariance(
    model,
    x,
    pos_m=5.0,
    vel_mps=0.3,
    bias_m=10.0,
    drift_mps=1.0,
    heading_rad=0.05,
    isb_m=10.0,
    imu=None,
    fix_m2=None,
):
    """Start covariance (n + 1, n + 1) of true - estimate: a scalar fix, a heading from its velocity, sensors unknown.

    ``fix_m2`` (3, 3): covariance of the fix in ECEF, in no direction below ``pos_m`` squared; None: ``pos_m`` level, twice that up.
    """
    code, n = model_code(model), model.n + 1
    s = np.zeros(n)
    ib, idr = kernels.clock_states(code)
    s[ib], s[idr], s[n - 1] = bias_m, drift_mps, isb_m
    if code <= kernels.SCALE:
        rm, rn = earth_radii(x[LAT])
        s[0], s[1], s[2] = (
            pos_m / (rm + x[HEIGHT]),
            pos_m / ((rn + x[HEIGHT]) * math.cos(x[LAT])),
            2.0 * pos_m,
        )
        if code == kernels.PAPER:
            s[3:6], s[6], s[7] = vel_mps, heading_rad, model.accel_sigma_mps2
            s[8] = model.gyro_sigma_deg_h * DEG_H
        else:
            s[3], s[4] = heading_rad, model.scale_sigma
            s[5], s[6] = model.gyro_sigma_deg_h * DEG_H, 3.0 * model.pitch_sigma_mrad * 1e-3
    elif code == kernels.PINSON:
        s[0:2] = pos_m / np.linalg.norm(x[:3])
        s[3:6], s[6:9], s[9], s[10] = heading_rad, vel_mps, 2.0 * pos_m, model.baro_sigma_m
    else:
        s[0:3], s[3:6] = 2.0 * pos_m, vel_mps
        if code == kernels.ECEF17:
            s[6:9] = heading_rad
            force = G0_MPS2 * math.hypot(model.scale_sigma, model.misalignment_sigma_rad)  # of 1 g
            s[9:12] = math.hypot(*imu.accel_bias_si, force) if imu else 0.05
            s[12:15] = math.hypot(*imu.gyro_bias_si) if imu else 1e-4
            s[9:15] = np.maximum(s[9:15], [1e-3] * 3 + [1e-6] * 3)
    p = np.diag(s * s)
    if fix_m2 is not None:
        tp, unused = np.empty((2, 3, n))
        kernels.maps(code, x, tp, unused)
        at = [0, 1, 9] if code == kernels.PINSON else [0, 1, 2]
        size, axes = np.linalg.eigh(fix_m2)
        half = np.linalg.solve(tp[:, at], axes * np.sqrt(np.maximum(size, pos_m**2)))
        p[np.ix_(at, at)] = half @ half.T
    return p


def extended_q(model, x) -> np.ndarray:
    """Diagonal of Qc with the inter-system bias at the end."""
    q = model.q_diag(x[:19]) if model_code(model) <= kernels.SCALE else model.q_diag()
    return np.append(q, 1e-6)


class Filter:
    """State and workspace of one steering filter for C channel slots.

    ``log`` is what the monitors read, and of each epoch its corrections ``dx`` and ``own`` (2C,), the variances before any answer of
    theirs, 0 where a channel was not heard; ``extra`` (n, n) is what their corrections may be wrong by, which no gain knows, or None.
    """

    def __init__(self, spec: SteeringSpec, model, x, p, n_channels, log_length=256, barometer=None):
        self.spec, self.model, self.code = spec, model, model_code(model)
        self.x, self.p = x, np.ascontiguousarray(p)
        n, m = p.shape[0], 2 * n_channels
        self.rates, self.q = model_rates(model, barometer), extended_q(model, x)
        self.filter_s = getattr(model, "pitch_filter_s", 1.0)
        self.f = np.zeros((n, n))
        self.power, self.cn0 = np.zeros((n_channels, kernels.N_CN0)), np.full(n_channels, 1e4)
        self.rho, self.rate, self.accel = (
            np.full(n_channels, 2.2e7),
            np.zeros(n_channels),
            np.zeros(n_channels),
        )
        self.los = np.zeros((n_channels, 3))
        self.extra = None
        self.nis, self.n_rows, self.epochs, self._first = math.nan, 0, 0, 0
        self._ring, self._own, self._dx = (
            empty_log(log_length, n, m),
            np.zeros((log_length, m)),
            np.zeros((log_length, n)),
        )
        self._views = epochs_of(self._ring)
        self.own, self.dx = self._own[0], self._dx[0]

    def slot(self, t_s: float) -> EpochLog:
        """Views of the log's next row, of time ``t_s``."""
        i = self.epochs % self._ring.t_s.size
        self.epochs += 1
        self.own, self.dx = self._own[i], self._dx[i]
        self._ring.t_s[i] = t_s
        return self._views[i]

    def log(self, n_epochs: int | None = None) -> EpochLog:
        """The last ``n_epochs`` epochs, oldest first (copies, ``s`` left out)."""
        ring = self._ring._replace(s=np.zeros((self._ring.n_epochs, 0, 0)))
        return newest(ring, self.epochs, n_epochs, self.epochs - self._first)

    def since(self, epoch: int) -> tuple[np.ndarray, ...]:
        """Rows of all epochs after the first ``epoch``, and the rings that they are rows of: phi, qd, h, r, own, dx."""
        ring = self._ring
        at = np.arange(epoch, self.epochs) % ring.n_epochs
        return at, ring.phi, ring.qd, ring.h, ring.r, self._own, self._dx

    def correct(self, dx: np.ndarray | None, p: np.ndarray | None) -> None:
        """Between two epochs: inject dx = true - estimate, replace the covariance; what was logged is another filter's."""
        if dx is not None:
            kernels.inject(self.code, self.x, dx)
        if p is not None:
            self.p[:] = p
            self._first = self.epochs

    def position(self) -> tuple[np.ndarray, np.ndarray]:
        """ECEF position and velocity."""
        pos, vel = np.empty(3), np.empty(3)
        kernels.position_velocity(self.code, self.x, pos, vel)
        return pos, vel

    def clock(self) -> tuple[float, float]:
        """Clock bias (m) and drift (m/s)."""
        cb, cd = kernels.clock_columns(self.code)
        return float(self.x[cb]), float(self.x[cd])

    def covariance(self) -> np.ndarray:
        """Covariance of the ECEF position (3, 3), m^2."""
        tp, tv = np.empty((3, self.p.shape[0])), np.empty((3, self.p.shape[0]))
        kernels.maps(self.code, self.x, tp, tv)
        return tp @ (self.p if self.extra is None else self.p + self.extra) @ tp.T
