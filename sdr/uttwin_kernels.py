"""Kernels of the multi-satellite twin: correlators of N channels drawn directly, steered by the filter or by own loops."""

import math

import numpy as np
from numba import njit

from nav.kernels import solve_position, solve_velocity
from nav.ultratight_kernels import (
    CN0_HZ,
    N_CN0,
    clock_columns,
    clock_states,
    cn0_from_powers,
    filter_update,
    maps,
    position_velocity,
    predict,
    pseudoranges,
    rows,
    watch_power,
    weigh,
)
from signals.constants import METRES_PER_CHIP, WAVELENGTH_M

N_OUT = 14
"""Columns per output epoch: position error ENU (3), velocity error ENU (3), clock bias and drift error, NEES of those five
(position, bias, drift), NIS, its rows, channels in lock, median C/N0 estimate (Hz), Doppler of one channel (Hz)."""
_TWO_PI = 2.0 * math.pi


@njit(cache=True, nogil=True)
def _tap(x):
    return max(0.0, 1.0 - abs(x))


@njit(cache=True, nogil=True)
def correlate(rng, code_error, freq_error, T, noise, amplitude, half_space, r1, r2, out):
    """One integration of E, P, L, two half prompts and a noise tap, with the taps' covariance; BPSK, triangle of 1 chip.

    code_error (chips): incoming ahead of the replica; freq_error (Hz): incoming minus replica; ``noise`` = E|n|^2 when
    the prompt is one. ``out`` (4,): code discriminator (chips), frequency discriminator (Hz), |P|^2, |noise tap|^2.
    """
    x = math.pi * freq_error * 0.5 * T
    sinc = 1.0 if abs(x) < 1e-6 else math.sin(x) / x
    phase = _TWO_PI * rng.random()
    sigma = math.sqrt(0.25 * noise)
    b = math.sqrt(1.0 - r1 * r1)
    # Cholesky factor of [[1, r1, r2], [r1, 1, r1], [r2, r1, 1]] in the order P, E, L.
    c1 = (r2 - r1 * r1) / b
    c2 = math.sqrt(max(1.0 - r1 * r1 - c1 * c1, 0.0))
    ei = eq = li = lq = 0.0
    hi, hq = np.empty(2), np.empty(2)
    e_tap, p_tap, l_tap = _tap(half_space - code_error), _tap(code_error), _tap(half_space + code_error)
    for k in range(2):
        angle = phase + (x if k == 1 else -x)
        c, s = 0.5 * amplitude * sinc * math.cos(angle), 0.5 * amplitude * sinc * math.sin(angle)
        n0, n1 = rng.standard_normal(), rng.standard_normal()
        n2, n3 = rng.standard_normal(), rng.standard_normal()
        n4, n5 = rng.standard_normal(), rng.standard_normal()
        hi[k], hq[k] = c * p_tap + sigma * n0, s * p_tap + sigma * n1
        ei += c * e_tap + sigma * (r1 * n0 + b * n2)
        eq += s * e_tap + sigma * (r1 * n1 + b * n3)
        li += c * l_tap + sigma * (r1 * n0 + c1 * n2 + c2 * n4)
        lq += s * l_tap + sigma * (r1 * n1 + c1 * n3 + c2 * n5)
    e, late = math.sqrt(ei * ei + eq * eq), math.sqrt(li * li + lq * lq)
    out[0] = (1.0 - half_space) * (e - late) / (e + late)
    cross, dot = hi[0] * hq[1] - hq[0] * hi[1], hi[0] * hi[1] + hq[0] * hq[1]
    out[1] = math.atan2(cross, dot) / (math.pi * T)
    pi, pq = hi[0] + hi[1], hq[0] + hq[1]
    out[2] = pi * pi + pq * pq
    out[3] = -noise * math.log(1.0 - rng.random())


@njit(cache=True, nogil=True)
def _draw(rng, e, T, rho_nco, rate_nco, rho_true, rate_true, bias, drift, cn0_hz, jam, q_rc, amplitude, half_space, meas,
          truth):  # fmt: skip
    """Discriminators of all channels in epoch e: ``meas`` (C, 4), true NCO errors ``truth`` (C, 2) in chips and Hz."""
    r1, r2 = 1.0 - half_space, max(0.0, 1.0 - 2.0 * half_space)
    for c in range(cn0_hz.size):
        noise = (1.0 / cn0_hz[c] + jam / q_rc[c]) / T
        err = -(rho_true[e, c] + bias - rho_nco[c]) / METRES_PER_CHIP
        df = -(rate_true[e, c] + drift - rate_nco[c]) / WAVELENGTH_M
        truth[c, 0], truth[c, 1] = err, df
        correlate(rng, err, df, T, noise, amplitude, half_space, r1, r2, meas[c])


@njit(cache=True, nogil=True)
def _nees(model, x, p, err, work):
    """Normalised squared error of ECEF position, clock bias and drift: err (5,)."""
    n = p.shape[0]
    tp, tv = np.empty((3, n)), np.empty((3, n))
    maps(model, x, tp, tv)
    h = np.zeros((5, n))
    h[:3] = tp
    ib, idr = clock_states(model)
    h[3, ib], h[4, idr] = 1.0, 1.0
    cov = h @ p @ h.T
    return np.dot(err, np.linalg.solve(cov, err))


@njit(cache=True, nogil=True)
def _locked(truth):
    count = 0
    for c in range(truth.shape[0]):
        count += abs(truth[c, 0]) < 1.0 and abs(truth[c, 1]) < 30.0
    return count


@njit(cache=True, nogil=True)
def aided_run(rng, model, x, p, sensors, per_epoch, dt_s, filter_s, rates, q_diag, limit, fast_s, slow_s, floor_m,
              floor_mps, tables, sign, fixed_hz, use_gain, min_cn0_hz, T, half_space, sat_pos, sat_vel, sat_acc, rho_true,
              rate_true, pos_true, vel_true, bias, drift, cn0_hz, jam, q_rc, amplitude, gain, r_le, every, watch, out):  # fmt: skip
    """One trial steered by the filter.

    Epoch e covers [e T, (e + 1) T]; ``sat_*`` (E + 1, C, 3), ``pos_true``, ``vel_true`` (E + 1, 3) at its ends,
    ``rho_true``, ``rate_true`` (E, C) at its middle without clock; ``bias``, ``drift`` (2 E + 1,) at ends and middles.
    ``fixed_hz`` > 0: R of that C/N0 for ever; ``use_gain`` False: gain 1; ``min_cn0_hz``: weaker channels are skipped.
    ``gain`` (E,): power gain of the front end. ``sign`` -1 steers the wrong way (for tests).
    """
    count, n = cn0_hz.size, p.shape[0]
    active, second = np.ones(count, np.bool_), np.zeros(count)
    zeros, which = np.zeros(count), np.zeros(count, np.int64)
    rho, rate, accel, los = np.zeros(count), np.zeros(count), np.zeros(count), np.zeros((count, 3))
    span_s, seen, inflate = np.full(count, T), np.ones(count, np.int64), np.ones(2 * count)
    power, cn0 = np.zeros((count, N_CN0)), np.full(count, 1e4)
    code_m, rate_mps, off_m, off_mps = np.zeros(count), np.zeros(count), np.zeros(count), np.zeros(count)
    gain_code, gain_rate = np.ones(count), np.ones(count)
    rho_nco, rate_nco = np.zeros(count), np.zeros(count)
    meas, truth = np.zeros((count, 4)), np.zeros((count, 2))
    m = 2 * count
    h, z, var, used = np.zeros((m, n)), np.zeros(m), np.ones(m), np.zeros(m, np.bool_)
    k, s, p_prior, dx = np.zeros((n, m)), np.zeros((m, m)), np.zeros((n, n)), np.zeros(n)
    f, phi, qd = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n))
    tp, tv = np.empty((3, n)), np.empty((3, n))
    pos, vel, err = np.empty(3), np.empty(3), np.empty(5)
    cb, cd = clock_columns(model)
    pseudoranges(
        model,
        x,
        active,
        second,
        sat_pos[0],
        sat_vel[0],
        sat_acc[0],
        zeros,
        zeros,
        zeros,
        zeros,
        rho,
        rate,
        accel,
        los,
    )
    for e in range(rho_true.shape[0]):
        for c in range(count):
            rho_nco[c] = rho[c] + 0.5 * T * (rate[c] + 0.25 * T * accel[c])
            rate_nco[c] = rate[c] + 0.5 * T * accel[c]
        _draw(
            rng, e, T, rho_nco, rate_nco, rho_true, rate_true, bias[2 * e + 1], drift[2 * e + 1], cn0_hz, jam[e], q_rc,
            amplitude[e], half_space, meas, truth,
        )  # fmt: skip
        predict(
            model,
            x,
            p,
            sensors[e * per_epoch : (e + 1) * per_epoch],
            dt_s,
            filter_s,
            rates,
            q_diag,
            f,
            phi,
            qd,
        )
        pseudoranges(
            model, x, active, second, sat_pos[e + 1], sat_vel[e + 1], sat_acc[e + 1], zeros, zeros, zeros, zeros, rho, rate,
            accel, los,
        )  # fmt: skip
        for c in range(count):
            code_m[c] = -sign * meas[c, 0] * METRES_PER_CHIP
            rate_mps[c] = -sign * meas[c, 1] * WAVELENGTH_M
            off_m[c] = rho_nco[c] - (rho[c] - 0.5 * T * (rate[c] - 0.25 * T * accel[c]))
            off_mps[c] = rate_nco[c] - (rate[c] - 0.5 * T * accel[c])
            watch_power(power[c], gain[e] * meas[c, 2], gain[e] * meas[c, 3], T, fast_s, slow_s)
        cn0_from_powers(power, active, span_s, slow_s, cn0)
        for c in range(count):
            seen[c] = 1 if cn0[c] >= min_cn0_hz else 0
            if fixed_hz > 0.0:
                cn0[c] = fixed_hz
        weigh(
            code_m, rate_mps, off_m, off_mps, span_s, seen, cn0, inflate, tables, which, floor_m, floor_mps, z, var, used,
            gain_code, gain_rate,
        )  # fmt: skip
        if not use_gain:
            for c in range(count):
                z[c], z[count + c] = code_m[c] + off_m[c], rate_mps[c] + off_mps[c]
                gain_code[c] = gain_rate[c] = 1.0
        rows(model, x, n, los, second, gain_code, gain_rate, tp, tv, h)
        p -= 0.5 * qd
        nis, n_rows = filter_update(model, x, p, h, z, var, used, power, limit, k, s, p_prior, dx)
        p += 0.5 * qd
        pseudoranges(
            model, x, active, second, sat_pos[e + 1], sat_vel[e + 1], sat_acc[e + 1], zeros, zeros, zeros, zeros, rho, rate,
            accel, los,
        )  # fmt: skip
        if (e + 1) % every == 0:
            o = out[(e + 1) // every - 1]
            position_velocity(model, x, pos, vel)
            for i in range(3):
                err[i] = pos_true[e + 1, i] - pos[i]
            err[3], err[4] = bias[2 * e + 2] - x[cb], drift[2 * e + 2] - x[cd]
            for i in range(3):
                o[i] = o[3 + i] = 0.0
                for j in range(3):
                    o[i] -= r_le[j, i] * err[j]
                    o[3 + i] += r_le[j, i] * (vel[j] - vel_true[e + 1, j])
            o[6], o[7], o[8] = -err[3], -err[4], _nees(model, x, p, err, h)
            o[9], o[10], o[11] = nis, n_rows, _locked(truth)
            o[12], o[13] = np.median(power[:, CN0_HZ]), -rate_nco[watch] / WAVELENGTH_M


@njit(cache=True, nogil=True)
def scalar_run(rng, pos0, T, half_space, sat_pos, sat_vel, rho_true, rate_true, pos_true, vel_true, bias, drift, cn0_hz,
               jam, q_rc, amplitude, aid, gains, min_cn0_hz, lost_s, guarded, r_le, every, watch, out):  # fmt: skip
    """One trial of independent channels: second-order FLL (gains[0], gains[1]), carrier-aided DLL (gains[2]), then LS.

    ``aid`` (E, C): change of each range rate over the epoch as inertial sensors have it, m/s; zeros: loops of their own.
    A channel is dropped when its C/N0 (1 s) stays below ``min_cn0_hz`` for ``lost_s``; with ``guarded`` it leaves the
    solution for ever (no acquisition here), else all channels are used always, as a receiver without detectors would.
    """
    count = cn0_hz.size
    rho_nco, rate_nco, ramp = np.zeros(count), np.zeros(count), np.zeros(count)
    power, bad_s = np.zeros((count, N_CN0)), np.zeros(count)
    lost = np.zeros(count, np.bool_)
    meas, truth = np.zeros((count, 4)), np.zeros((count, 2))
    state, cov, residual, los = np.zeros(5), np.zeros((5, 5)), np.zeros(count), np.zeros((count, 3))
    use, second, var = np.ones(count, np.uint8), np.zeros(count), np.ones(count)
    vel, clock, rate_now = np.zeros(3), np.zeros(1), np.zeros(count)
    for c in range(count):
        rho_nco[c], rate_nco[c] = rho_true[0, c] + bias[1], rate_true[0, c] + drift[1]
    state[:3] = pos0
    for e in range(rho_true.shape[0]):
        _draw(
            rng, e, T, rho_nco, rate_nco, rho_true, rate_true, bias[2 * e + 1], drift[2 * e + 1], cn0_hz, jam[e], q_rc,
            amplitude[e], half_space, meas, truth,
        )  # fmt: skip
        for c in range(count):
            watch_power(power[c], meas[c, 2], meas[c, 3], T, 1.0, 1.0)
            value = (power[c, 0] / max(power[c, 2], 1e-30) - 1.0) / T
            bad_s[c] = bad_s[c] + T if value < min_cn0_hz else max(0.0, bad_s[c] - T)
            lost[c] = lost[c] or bad_s[c] > lost_s
            err = -WAVELENGTH_M * meas[c, 1]
            ramp[c] += gains[1] * err / T
            step = ramp[c] * T + gains[0] * err + aid[e, c]
            rho_nco[c] += rate_nco[c] * T + 0.5 * step * T - gains[2] * METRES_PER_CHIP * meas[c, 0]
            rate_nco[c] += step
        if (e + 1) % every == 0:
            o = out[(e + 1) // every - 1]
            left = 0
            for c in range(count):
                use[c] = 0 if guarded and lost[c] else 1
                left += use[c]
            o[:] = np.nan
            o[11], o[13] = _locked(truth), -rate_nco[watch] / WAVELENGTH_M
            o[10] = left
            if left < 4:
                continue
            # NCO states hold at the middle of the next epoch: take them back by half of one.
            for c in range(count):
                rate_now[c] = rate_nco[c] - 0.5 * (ramp[c] * T + aid[e, c])
            ok, _ = solve_position(
                sat_pos[e + 1],
                rho_nco - 0.5 * T * rate_now,
                var,
                second,
                use,
                4,
                state,
                cov,
                residual,
                los,
                25,
            )
            if ok != 0:
                state[:3] = pos0
                state[3] = 0.0
                continue
            solve_velocity(
                sat_pos[e + 1],
                sat_vel[e + 1],
                rate_now,
                var,
                use,
                state[:3].copy(),
                vel,
                clock,
                cov,
                residual,
            )
            for i in range(3):
                o[i] = o[3 + i] = 0.0
                for j in range(3):
                    o[i] += r_le[j, i] * (state[j] - pos_true[e + 1, j])
                    o[3 + i] += r_le[j, i] * (vel[j] - vel_true[e + 1, j])
            o[6], o[7] = state[3] - bias[2 * e + 2], clock[0] - drift[2 * e + 2]
