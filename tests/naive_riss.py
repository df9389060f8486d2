"""A land drive with RISS sensors, aided by linear range and rate measurements of a fixed satellite
geometry."""

import numpy as np

from nav import riss
from nav.errormodels import measurement_rows, unit_vectors_enu
from nav.eskf import Eskf, discretise
from nav.frames import rotation_enu_to_ecef
from nav.imu import ImuSpec, OdometerSpec, simulate_imu, simulate_odometer
from signals.trajectory import Segment, Segments

SATELLITES = unit_vectors_enu([20, 75, 140, 200, 255, 310, 0, 100], [35, 18, 42, 25, 55, 15, 80, 60])
RATE = 100


def drive(duration_s, speed_mps=10.0, climb=True):
    """36 km/h with 90 deg turns every half minute and gentle slopes (Karaim's drive, its course
    assumed)."""
    legs = []
    for k in range(int(duration_s // 30) + 2):
        legs.append(Segment(duration_s=22.0, climb_mps=(0.2 if k % 2 else -0.2) if climb else 0.0))
        legs.append(Segment(duration_s=8.0, turn_rate_deg_s=(90.0 if k % 3 else -90.0) / 8.0))
    return Segments(speed_mps=speed_mps, heading_deg=30.0, segment=tuple(legs)).start(duration_s)


def sensors(motion, imu: ImuSpec, odometer: OdometerSpec, seed, duration_s):
    """(wz, fy, fx, speed) arrays at 100 Hz."""
    s = np.random.SeedSequence(seed).spawn(2)
    rows, _, _ = simulate_imu(motion, imu, s[0], duration_s)
    odo, _ = simulate_odometer(motion, odometer, s[1], duration_s)
    return (*riss.riss_inputs(rows), riss.speed_at(odo, rows["t_s"]))


def aided_run(
    model, motion, inputs, duration_s, aid_until_s, rng, p0, sigma_range_m=1.0, sigma_rate_mps=0.05, every=10
):
    """Errors (m, n) true - estimate in ECEF pos/vel, P of position, NEES: filter aided every ``every``
    intervals."""
    wz, fy, fx, speed = inputs
    dt = 1.0 / RATE
    start = motion([0.0])
    x = riss.riss_nominal(start.pos_ecef_m[0], start.vel_ecef_mps[0], speed_mps=speed[0])
    truth = motion(np.arange(1, wz.size + 1) * dt)
    # Start errors from P0; the clock is simulated from its two-state model.
    e0 = np.linalg.cholesky(p0) @ rng.standard_normal(model.n)
    clock = np.array([e0[model.idx_b], e0[model.idx_d]])
    e0[[model.idx_b, model.idx_d]] = 0.0
    x = model.inject(x, -e0)
    kf = Eskf(p0, 2 * len(SATELLITES))
    low = np.linalg.cholesky(
        model.clock_freq_noise_m2_s3 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        + np.diag([model.clock_phase_noise_m2_s * dt, 0.0])
    )
    r = rotation_enu_to_ecef(x[riss.LAT], x[riss.LON])
    u = SATELLITES @ r.T
    var = np.repeat([sigma_range_m**2, sigma_rate_mps**2], len(SATELLITES))
    out_t, error, sigma, nees = [], [], [], []
    pos, vel = np.zeros(3), np.zeros(3)
    for k in range(wz.size):
        model.step(x, wz[k], fy[k], fx[k], speed[k], dt)
        clock = np.array([clock[0] + clock[1] * dt, clock[1]]) + low @ rng.standard_normal(2)
        if (k + 1) % every:
            continue
        kf.predict(*discretise(model.f_matrix(x, wz[k]), model.q_diag(x), dt * every))
        riss.riss_pos_vel(x, pos, vel)
        if (k + 1) * dt <= aid_until_s:
            dp, dv = truth.pos_ecef_m[k] - pos, truth.vel_ecef_mps[k] - vel
            z = np.concatenate(
                [-u @ dp + clock[0] - x[riss.CLOCK_BIAS], -u @ dv + clock[1] - x[riss.CLOCK_DRIFT]]
            )
            z += np.sqrt(var) * rng.standard_normal(z.size)
            h = np.vstack([measurement_rows(model, x, u), measurement_rows(model, x, u, rate=True)])
            x = model.inject(x, kf.update(z, h, var))
            riss.riss_pos_vel(x, pos, vel)
        e = np.concatenate([truth.pos_ecef_m[k] - pos, truth.vel_ecef_mps[k] - vel])
        cov = model.pos_map(x) @ kf.p @ model.pos_map(x).T
        out_t.append((k + 1) * dt)
        error.append(r.T @ e[:3])
        sigma.append(r.T @ cov @ r)
        nees.append(e[:3] @ np.linalg.solve(cov, e[:3]))
    return np.array(out_t), np.array(error), np.array(sigma), np.array(nees)
