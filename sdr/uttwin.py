"""Multi-satellite twin: N channels in the correlator domain, steered by the same filter as the receiver's, for Monte Carlo.

Per channel and 20 ms: early, prompt, late, two half prompts and a noise tap with their covariance, a correlation triangle of
one chip (so that loss of lock is real) and C/N0_eff = 1 / (1 / C/N0 + (J/S) / (Q R_c)) (Betz 2001). Left out: code side
lobes, atmosphere, data decoding, acquisition after loss.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from nav import ultratight_kernels as ut
from nav.frames import geodetic_from_ecef, rotation_enu_to_ecef
from nav.imu import (
    BarometerSpec,
    ImuSpec,
    OdometerSpec,
    simulate_barometer,
    simulate_imu,
    simulate_odometer,
)
from nav.kernels import predict_ranges
from nav.ultratight import (
    SteeringSpec,
    build_model,
    discriminator_table,
    extended_q,
    model_code,
    model_rates,
    nominal_of,
    start_covariance,
)
from sdr.uttwin_kernels import N_OUT, aided_run, scalar_run
from signals.constants import CHIP_RATE_HZ
from signals.orbits import nominal_constellation
from signals.trajectory import Motion, Segment, Segments

T_S = 0.02
EVERY = 5
"""Output every 0.1 s."""


def drive(duration_s=600.0, speed_mps=10.0, **place) -> Segments:
    """A land drive at constant speed (Karaim 2020: 36 km/h), straights of 30 s and right and left turns of 90 deg in 12 s."""
    turns, t = (1, 1, -1, 1, -1, -1), 0.0
    segment: list[Segment] = []
    while t < duration_s:
        segment += [
            Segment(duration_s=30.0),
            Segment(duration_s=12.0, turn_rate_deg_s=7.5 * turns[len(segment) // 2 % 6]),
        ]
        t += 42.0
    where = {"lat_deg": 44.23, "lon_deg": -76.48, "height_m": 100.0} | place
    return Segments(heading_deg=20.0, speed_mps=speed_mps, segment=tuple(segment), **where)


@dataclass(frozen=True)
class Policy:
    """How discriminators are weighed: the shipped form by default, or the variants of the published discussion."""

    use_gain: bool = True
    fixed_dbhz: float = 0.0
    """> 0: R of this C/N0 whatever happens."""
    fast_s: float = 0.1
    slow_s: float = 1.0
    skip_below_dbhz: float = 0.0
    """> 0: weaker channels are left out."""
    sign: float = 1.0


@dataclass
class Sky:
    """Geometry of one drive at 50 Hz, shared by all trials."""

    duration_s: float
    motion: Motion
    n_satellites: int = 8
    sat_pos: np.ndarray = field(init=False)

    def __post_init__(self):
        n = round(self.duration_s / T_S)
        ends, middles = np.arange(n + 1) * T_S, (np.arange(n) + 0.5) * T_S
        state = self.motion(ends)
        self.pos, self.vel = np.ascontiguousarray(state.pos_ecef_m), np.ascontiguousarray(state.vel_ecef_mps)
        lat, lon, _ = geodetic_from_ecef(self.pos[0])
        self.r_le = rotation_enu_to_ecef(lat, lon)
        all_pos, all_vel = _constellation(ends)
        up = self.r_le[:, 2]
        el = np.arcsin((all_pos[0] - self.pos[0]) @ up / np.linalg.norm(all_pos[0] - self.pos[0], axis=1))
        pick = np.sort(np.argsort(-el)[: self.n_satellites])
        self.elevation_rad = el[pick]
        self.sat_pos, self.sat_vel = (np.ascontiguousarray(a[:, pick]) for a in (all_pos, all_vel))
        self.sat_acc = np.gradient(self.sat_vel, T_S, axis=0)
        mid_pos, mid_vel = (a[:, pick] for a in _constellation(middles))
        true = self.motion(middles)
        self.rho, self.rate = np.empty((n, len(pick))), np.empty((n, len(pick)))
        los = np.empty((len(pick), 3))
        for e in range(n):
            predict_ranges(
                np.ascontiguousarray(mid_pos[e]), np.ascontiguousarray(mid_vel[e]), true.pos_ecef_m[e].copy(),
                true.vel_ecef_mps[e].copy(), self.rho[e], self.rate[e], los,
            )  # fmt: skip

    @property
    def n_epochs(self):
        """Epochs of 20 ms."""
        return self.rho.shape[0]


def _constellation(t_s):
    """Positions and velocities (m, S, 3) of the nominal GPS constellation, Hermite between 1 s nodes of the orbits."""
    from signals.geometry_kernels import orbit_kernel
    from signals.orbits import orbit_coefficients

    eph = nominal_constellation("G", 2303, 475_200)
    k = orbit_coefficients(eph)
    node = np.arange(math.floor(t_s[0]) - 1, math.ceil(t_s[-1]) + 2.0)
    p, v = np.empty((node.size, eph.size, 3)), np.empty((node.size, eph.size, 3))
    for i, t in enumerate(node):
        for j in range(eph.size):
            dt = 475_200 + t - float(eph["toe_s"][j])
            s = orbit_kernel(k[j], dt, dt)
            p[i, j], v[i, j] = s[:3], s[3:6]
    at = np.clip((t_s - node[0]).astype(int), 0, node.size - 2)
    u = (t_s - node[at])[:, None, None]
    p0, p1, v0, v1 = p[at], p[at + 1], v[at], v[at + 1]
    a, b = 3 * (p1 - p0) - 2 * v0 - v1, 2 * (p0 - p1) + v0 + v1
    return p0 + u * (v0 + u * (a + u * b)), v0 + u * (2 * a + u * 3 * b)


@dataclass(frozen=True)
class Trial:
    """What one Monte Carlo point is: signal, jam, sensors, clock."""

    cn0_dbhz: float = 44.0
    js_db: float = 0.0
    jam_s: tuple[float, float] = (60.0, 150.0)
    q_db: tuple[float, ...] = ()
    """Effective Q of each satellite, dB; empty: 0."""
    gain_control: bool = False
    """The front end's gain holds the noise density of Q = 1: signals sink when a jammer comes."""
    blocked_s: tuple[float, float] = (0.0, 0.0)
    spacing_chips: float = 1.0
    imu: ImuSpec = field(default_factory=lambda: ImuSpec(grade="karaim2020"))
    odometer: OdometerSpec = field(default_factory=OdometerSpec)
    barometer: BarometerSpec | None = None
    clock_s_f: float = 0.009
    clock_s_g: float = 0.035
    aided: bool = False
    """Scalar loops are told the change of the range rate by inertial navigation (17 states, not corrected)."""
    fll_hz: float = 4.0
    dll_hz: float = 1.0


def run(
    sky: Sky, trial: Trial, spec: SteeringSpec, seed, policy: Policy = Policy(), guarded=True, watch=0
) -> np.ndarray:
    """One trial -> (epochs / EVERY, N_OUT), see ``uttwin_kernels.N_OUT``; ``seed`` (int or SeedSequence) alone decides."""
    seq = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    children = [np.random.SeedSequence(seq.entropy, spawn_key=(*seq.spawn_key, i)) for i in range(6)]
    noise, start = (np.random.Generator(np.random.Philox(children[i])) for i in (0, 1))
    bias, drift = _clock(trial, sky.n_epochs, children[2])
    out = np.zeros((sky.n_epochs // EVERY, N_OUT))
    n_sat = sky.sat_pos.shape[1]
    t = (np.arange(sky.n_epochs) + 0.5) * T_S
    jam = np.where((t >= trial.jam_s[0]) & (t < trial.jam_s[1]), 10 ** (trial.js_db / 10), 0.0)
    if trial.js_db == 0.0:
        jam[:] = 0.0
    amplitude = np.where((t >= trial.blocked_s[0]) & (t < trial.blocked_s[1]), 0.0, 1.0)
    q_rc = CHIP_RATE_HZ * 10 ** (np.array(trial.q_db or (0.0,) * n_sat) / 10)
    cn0 = np.full(n_sat, 10 ** (trial.cn0_dbhz / 10))
    half = 0.5 * trial.spacing_chips
    if spec.mode == "scalar":
        wn = trial.fll_hz / 0.53 * T_S
        bt = trial.dll_hz * T_S
        gains = np.array([math.sqrt(2.0) * wn, wn * wn, 4 * bt / (1 + 2 * bt)])
        scalar_run(
            noise, sky.pos[0].copy(), T_S, half, sky.sat_pos, sky.sat_vel, sky.rho, sky.rate, sky.pos, sky.vel, bias, drift,
            cn0, jam, q_rc, amplitude, _aid(sky, trial, children[3], children[4], children[5]), gains, 10**2.2, 1.0, guarded, sky.r_le, EVERY, watch, out,
        )  # fmt: skip
        return out
    model = build_model(spec, trial.imu, trial.odometer, trial.barometer)
    sensors, per_epoch = _sensors(sky, trial, *children[3:])
    x, p = _start(sky, trial, model, start, bias[0], drift[0])
    gain = 1.0 / (1.0 + trial.gain_control * cn0[0] * jam / CHIP_RATE_HZ)
    table = discriminator_table("L1CA", trial.spacing_chips)[None]
    aided_run(
        noise, model_code(model), x, p, sensors, per_epoch, T_S / per_epoch, getattr(model, "pitch_filter_s", 1.0),
        model_rates(model, trial.barometer), extended_q(model, x), spec.limit_sigma, policy.fast_s, policy.slow_s, spec.code_floor_m,
        spec.rate_floor_mps, table, policy.sign, 10 ** (policy.fixed_dbhz / 10) if policy.fixed_dbhz > 0 else 0.0,
        policy.use_gain, 10 ** (policy.skip_below_dbhz / 10) if policy.skip_below_dbhz > 0 else 0.0, T_S, half, sky.sat_pos,
        sky.sat_vel, sky.sat_acc, sky.rho, sky.rate, sky.pos, sky.vel, bias, drift, cn0, jam, q_rc, amplitude, gain,
        sky.r_le, EVERY, watch, out,
    )  # fmt: skip
    return out


def _clock(trial, n_epochs, seed):
    """Receiver clock (m, m/s) at ends and middles of the epochs: two-state model (Brown & Hwang 1997, section 10.3)."""
    rng, h, n = np.random.default_rng(seed), 0.5 * T_S, 2 * n_epochs + 1
    w = rng.standard_normal((3, n))
    dd = np.sqrt(trial.clock_s_g * h) * w[0]
    drift = 30.0 + np.concatenate([[0.0], np.cumsum(dd[1:])])
    step = drift[:-1] * h + 0.5 * h * dd[1:] + np.sqrt(trial.clock_s_g * h**3 / 12) * w[1, 1:]
    step += np.sqrt(trial.clock_s_f * h) * w[2, 1:]
    return 100.0 + np.concatenate([[0.0], np.cumsum(step)]), drift


def _sensors(sky, trial, imu_seed, odometer_seed, barometer_seed):
    """Sensor rows (m, N_SENSOR) and their number per epoch."""
    per_epoch = trial.imu.rate_hz * T_S
    if abs(per_epoch - round(per_epoch)) > 1e-9 or trial.odometer.rate_hz != trial.imu.rate_hz:
        raise ValueError("the twin wants an IMU of a multiple of 50 Hz and an odometer of the same rate")
    span = sky.n_epochs * T_S
    imu = simulate_imu(sky.motion, trial.imu, imu_seed, span)[0]
    odometer = simulate_odometer(sky.motion, trial.odometer, odometer_seed, span)[0]
    height = np.full(imu.size, np.nan)
    if trial.barometer is not None:
        rows = simulate_barometer(sky.motion, trial.barometer, barometer_seed, span)[0]
        height[np.searchsorted(imu["t_s"], rows["t_s"] - 1e-6)] = rows["height_m"]
    columns = imu["gyro_rad_s"], imu["accel_mps2"], odometer["speed_mps"], height
    return np.column_stack(columns), round(per_epoch)


def _aid(sky, trial, *seeds):
    """Change of the range rates (E, C) over each epoch by free inertial navigation from the true state; zeros without."""
    aid = np.zeros(sky.rho.shape)
    if not trial.aided:
        return aid
    model = build_model(SteeringSpec(mode="ultra_tight", model="ecef17"), trial.imu)
    sensors, m = _sensors(sky, trial, *seeds)
    x = nominal_of(model, sky.pos[0], sky.vel[0], 0.0, 0.0)
    n = model.n + 1
    p, f, phi, qd = (np.zeros((n, n)) for _ in range(4))
    shape = sky.rho.shape[1]
    rho, los = np.empty(shape), np.empty((shape, 3))
    rate = np.empty((sky.n_epochs + 1, shape))
    for e in range(sky.n_epochs + 1):
        predict_ranges(sky.sat_pos[e], sky.sat_vel[e], x[0:3], x[3:6], rho, rate[e], los)
        if e < sky.n_epochs:
            ut.predict(
                model_code(model), x, p, sensors[e * m : (e + 1) * m], T_S / m, 1.0, model_rates(model),
                extended_q(model, x), f, phi, qd,
            )  # fmt: skip
    return np.diff(rate, axis=0)


def _start(sky, trial, model, rng, bias_m, drift_mps):
    """Nominal state and covariance after a scalar fix: true values plus errors of the start covariance."""
    enu = np.array([2.0, 2.0, 4.0]) * rng.standard_normal(3)
    pos = sky.pos[0] + sky.r_le @ enu
    vel = sky.vel[0] + sky.r_le @ (np.array([0.2, 0.2, 0.1]) * rng.standard_normal(3))
    bias_m, drift_mps = bias_m + 5.0 * rng.standard_normal(), drift_mps + 0.5 * rng.standard_normal()
    x = nominal_of(model, pos, vel, bias_m, drift_mps)
    size = {"pos_m": 2.0, "vel_mps": 0.2, "bias_m": 5.0, "drift_mps": 0.5, "heading_rad": 0.025}
    return x, start_covariance(model, x, **size, imu=trial.imu)


def batch(
    sky: Sky,
    trial: Trial,
    spec: SteeringSpec,
    n_runs: int,
    seed=0,
    point=0,
    policy: Policy = Policy(),
    guarded=True,
):
    """Trials 0..n_runs-1 of one point -> (runs, epochs, N_OUT); trial i has the seed (seed, spawn_key (point, i))."""
    return np.stack(
        [
            run(sky, trial, spec, np.random.SeedSequence(seed, spawn_key=(point, i)), policy, guarded)
            for i in range(n_runs)
        ]
    )


def summary(out: np.ndarray, trial: Trial) -> dict[str, np.ndarray]:
    """Per run: 2D and speed RMS and maximum, over all and over the jam; error 30 s after it (or at the end); channels lost.

    The first 10 s, in which the filter settles, are left out.
    """
    t = (np.arange(out.shape[1]) + 1) * T_S * EVERY
    whole, jam = t > 10.0, (t > trial.jam_s[0]) & (t <= trial.jam_s[1])
    after = np.argmin(np.abs(t - min(trial.jam_s[1] + 30.0, t[-1])))
    e2 = np.hypot(out[..., 0], out[..., 1])
    v2 = np.hypot(out[..., 3], out[..., 4])

    def rms(a, mask):
        with np.errstate(all="ignore"):
            return np.sqrt(np.nanmean(np.where(np.isfinite(a[:, mask]), a[:, mask], np.nan) ** 2, axis=1))

    end_of_jam = np.argmin(np.abs(t - trial.jam_s[1]))
    n_sat = out[..., 11].max()
    return {
        "rms_2d_m": rms(e2, whole), "rms_jam_2d_m": rms(e2, jam), "max_2d_m": np.nanmax(e2[:, whole], axis=1),
        "rms_speed_mps": rms(v2, whole), "rms_jam_speed_mps": rms(v2, jam), "end_2d_m": e2[:, after],
        "lost": n_sat - out[:, end_of_jam, 11], "no_fix": np.mean(~np.isfinite(e2[:, jam]), axis=1),
    }  # fmt: skip


__all__ = ["EVERY", "T_S", "Policy", "Sky", "Trial", "batch", "drive", "replace", "run", "summary", "ut"]
