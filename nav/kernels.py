"""Compiled navigation: range prediction, weighted least squares, fault statistics, Kalman filter.

One satellite is one row. ``second`` is 1 for the system whose receiver bias carries the inter-system bias
(ISB), else 0. Ranges are pseudoranges already corrected for satellite clock and atmosphere, so that
range = |R3(w tau) s - x| + b + second * isb  and  rate = range rate + drift.
"""

import math

import numpy as np
from numba import njit

from signals.constants import C_MPS, EARTH_RATE_RAD_S

_WE = EARTH_RATE_RAD_S
_INV_C = 1.0 / C_MPS

CONVERGED, SINGULAR, NOT_CONVERGED = 0, 1, 2
"""Status of ``solve_position``."""
N_EKF = 9
"""EKF states: ECEF position (3), velocity (3), clock bias m, drift m/s, ISB m."""


@njit(cache=True, nogil=True)
def predict_ranges(sat_pos, sat_vel, pos, vel, rng, rate, los):
    """Geometric range, its rate and unit vectors receiver -> satellite, with Earth rotation in flight.

    rho = |R3(w tau) s(t_tx) - x(t_rx)|, tau = rho / c (IS-GPS-200, 20.3.3.4.3.4), and its exact derivative
    with respect to reception time: rho' = e . (R v_s - v_r) / (1 - g/c), g = w (e_x s_y - e_y s_x) - e . R
    v_s.

    Parameters
    ----------
    sat_pos, sat_vel : (n, 3) ECEF of transmit time, m and m/s;  pos, vel : (3,) receiver
    rng, rate : (n,) out, m and m/s;  los : (n, 3) out
    """
    for i in range(sat_pos.shape[0]):
        sx, sy, dz = sat_pos[i, 0], sat_pos[i, 1], sat_pos[i, 2] - pos[2]
        tau = 0.07
        rx, ry, r = sx, sy, 0.0
        for _ in range(4):
            a = _WE * tau
            ca, sa = math.cos(a), math.sin(a)
            rx, ry = ca * sx + sa * sy, ca * sy - sa * sx
            r = math.sqrt((rx - pos[0]) ** 2 + (ry - pos[1]) ** 2 + dz * dz)
            tau = r * _INV_C
        ex, ey, ez = (rx - pos[0]) / r, (ry - pos[1]) / r, dz / r
        vx = ca * sat_vel[i, 0] + sa * sat_vel[i, 1]
        vy = ca * sat_vel[i, 1] - sa * sat_vel[i, 0]
        along_sat = ex * vx + ey * vy + ez * sat_vel[i, 2]
        g = _WE * (ex * ry - ey * rx) - along_sat
        along_rx = ex * vel[0] + ey * vel[1] + ez * vel[2]
        rng[i] = r
        rate[i] = (along_sat - along_rx) / (1.0 - g * _INV_C)
        los[i, 0], los[i, 1], los[i, 2] = ex, ey, ez


@njit(cache=True, nogil=True)
def invert_symmetric(a, inv, m):
    """Inverse of the leading m x m positive definite block of a; False where a pivot is < 1e-12 of its
    diagonal."""
    low = np.zeros((m, m))
    for j in range(m):
        d = a[j, j]
        for k in range(j):
            d -= low[j, k] * low[j, k]
        if not d > 1e-12 * a[j, j] or a[j, j] <= 0.0:
            return False
        low[j, j] = math.sqrt(d)
        for i in range(j + 1, m):
            s = a[i, j]
            for k in range(j):
                s -= low[i, k] * low[j, k]
            low[i, j] = s / low[j, j]
    for c in range(m):
        for i in range(m):
            s = 1.0 if i == c else 0.0
            for k in range(i):
                s -= low[i, k] * inv[k, c]
            inv[i, c] = s / low[i, i]
        for i in range(m - 1, -1, -1):
            s = inv[i, c]
            for k in range(i + 1, m):
                s -= low[k, i] * inv[k, c]
            inv[i, c] = s / low[i, i]
    return True


@njit(cache=True, nogil=True)
def _design_row(los, second, i, m, h):
    h[0], h[1], h[2], h[3] = -los[i, 0], -los[i, 1], -los[i, 2], 1.0
    if m == 5:
        h[4] = second[i]


@njit(cache=True, nogil=True)
def normal_equations(los, second, variance, residual, use, m, normal, right):
    """N = H^T W H and H^T W r over the rows with use[i] = 1; W = 1 / variance."""
    h = np.zeros(5)
    normal[:, :] = 0.0
    right[:] = 0.0
    for i in range(los.shape[0]):
        if use[i] == 0:
            continue
        _design_row(los, second, i, m, h)
        w = 1.0 / variance[i]
        for a in range(m):
            right[a] += h[a] * w * residual[i]
            for b in range(m):
                normal[a, b] += h[a] * w * h[b]


@njit(cache=True, nogil=True)
def time_error(los, second, variance, residual, use, m, sat_vel):
    """What ``pvt.time_error`` returns: the residual and u . v of each row, both less what the m unknowns can explain."""
    n = los.shape[0]
    slide = np.empty(n)
    for i in range(n):
        slide[i] = los[i, 0] * sat_vel[i, 0] + los[i, 1] * sat_vel[i, 1] + los[i, 2] * sat_vel[i, 2]
    h, normal, inverse, by_residual, by_slide = (
        np.zeros(5), np.zeros((5, 5)), np.zeros((5, 5)), np.zeros(5), np.zeros(5)
    )  # fmt: skip
    normal_equations(los, second, variance, slide, use, m, normal, by_slide)
    normal_equations(los, second, variance, residual, use, m, normal, by_residual)
    if not invert_symmetric(normal, inverse, m):
        return math.nan, math.nan, math.nan, math.nan, math.nan
    x, x_slide = inverse @ by_residual, inverse @ by_slide
    power = cross = chi2 = most = 0.0
    for i in range(n):
        if use[i] == 0:
            continue
        _design_row(los, second, i, m, h)
        w = 1.0 / variance[i]
        y, s, free = residual[i], slide[i], 1.0
        for a in range(m):
            y -= h[a] * x[a]
            s -= h[a] * x_slide[a]
            for b in range(m):
                free -= h[a] * inverse[a, b] * h[b] * w
        power, cross, chi2 = power + w * s * s, cross + w * s * y, chi2 + w * y * y
        if free > 1e-9:
            most = max(most, w * y * y / free)
    tau_s = cross / power
    return tau_s, 1.0 / math.sqrt(power), chi2, chi2 - tau_s * cross, chi2 - most


@njit(cache=True, nogil=True)
def solve_position(sat_pos, measured, variance, second, use, m, state, cov, residual, los, max_iterations):
    """Gauss-Newton weighted least squares for position, clock bias and (m = 5) inter-system bias.

    x <- x + (H^T W H)^-1 H^T W (measured - predicted), rows H = [-e, 1, second].

    Parameters
    ----------
    measured : (n,) corrected pseudoranges, m;  variance : (n,) m^2;  use : (n,) uint8
    state : (5,) in: start, out: position, bias, ISB (m);  cov : (5, 5) out;  residual : (n,) out, m;  los
        : (n, 3) out

    Returns
    -------
    (status, iterations)
    """
    n = sat_pos.shape[0]
    rng, rate, zero = np.empty(n), np.empty(n), np.zeros(3)
    no_velocity = np.zeros((n, 3))
    normal, right = np.zeros((5, 5)), np.zeros(5)
    for iteration in range(max_iterations):
        predict_ranges(sat_pos, no_velocity, state[:3], zero, rng, rate, los)
        for i in range(n):
            residual[i] = measured[i] - rng[i] - state[3] - second[i] * state[4]
        normal_equations(los, second, variance, residual, use, m, normal, right)
        if not invert_symmetric(normal, cov, m):
            return SINGULAR, iteration
        step2 = 0.0
        for a in range(m):
            d = 0.0
            for b in range(m):
                d += cov[a, b] * right[b]
            state[a] += d
            step2 += d * d
        if step2 < 1e-10:
            predict_ranges(sat_pos, no_velocity, state[:3], zero, rng, rate, los)
            for i in range(n):
                residual[i] = measured[i] - rng[i] - state[3] - second[i] * state[4]
            return CONVERGED, iteration + 1
        if not step2 < 1e20:
            return NOT_CONVERGED, iteration
    return NOT_CONVERGED, max_iterations


@njit(cache=True, nogil=True)
def solve_velocity(sat_pos, sat_vel, measured_rate, variance, use, pos, vel, drift, cov, residual):
    """Weighted least squares for velocity and clock drift (linear; two passes absorb the 1 - g/c factor).

    Parameters
    ----------
    measured_rate : (n,) -lambda f_d + satellite clock rate, m/s
    vel : (3,) out, m/s;  drift : (1,) out, m/s;  cov : (5, 5) out;  residual : (n,) out, m/s

    Returns
    -------
    bool, False where the geometry is singular.
    """
    n = sat_pos.shape[0]
    rng, rate, los = np.empty(n), np.empty(n), np.empty((n, 3))
    second = np.zeros(n)
    normal, right = np.zeros((5, 5)), np.zeros(5)
    for _ in range(3):
        predict_ranges(sat_pos, sat_vel, pos, vel, rng, rate, los)
        for i in range(n):
            residual[i] = measured_rate[i] - rate[i] - drift[0]
        normal_equations(los, second, variance, residual, use, 4, normal, right)
        if not invert_symmetric(normal, cov, 4):
            return False
        for a in range(4):
            d = 0.0
            for b in range(4):
                d += cov[a, b] * right[b]
            if a < 3:
                vel[a] += d
            else:
                drift[0] += d
    predict_ranges(sat_pos, sat_vel, pos, vel, rng, rate, los)
    for i in range(n):
        residual[i] = measured_rate[i] - rate[i] - drift[0]
    return True


@njit(cache=True, nogil=True)
def exclusion_drop(los, second, variance, residual, use, m, cov, drop):
    """By how much chi2 falls when row i alone is left out: r_i^2 / (var_i - h_i cov h_i^T).

    The leave-one-out identity of linear least squares, so that n sub-solutions cost one. Rows without
    redundancy (denominator < 1e-9 var) get 0: leaving them out changes nothing that could be tested.

    Returns
    -------
    float, chi2 = sum r_i^2 / var_i of the used rows.
    """
    h = np.zeros(5)
    chi2 = 0.0
    for i in range(los.shape[0]):
        drop[i] = 0.0
        if use[i] == 0:
            continue
        _design_row(los, second, i, m, h)
        chi2 += residual[i] * residual[i] / variance[i]
        s = variance[i]
        for a in range(m):
            for b in range(m):
                s -= h[a] * cov[a, b] * h[b]
        if s > 1e-9 * variance[i]:
            drop[i] = residual[i] * residual[i] / s
    return chi2


@njit(cache=True, nogil=True)
def joseph_scalar(x, p, h, innovation, r, gain):
    """One scalar Kalman update in Joseph form: P <- (I - K h) P (I - K h)^T + K r K^T (Bucy & Joseph 1968).

    x (n,), p (n, n) in place;  gain (n,) out.  Returns S = h P h^T + r.
    """
    n = x.shape[0]
    ph = np.empty(n)
    s = r
    for i in range(n):
        acc = 0.0
        for j in range(n):
            acc += p[i, j] * h[j]
        ph[i] = acc
    for i in range(n):
        s += h[i] * ph[i]
    for i in range(n):
        gain[i] = ph[i] / s
        x[i] += gain[i] * innovation
    for i in range(n):
        for j in range(i + 1):
            v = p[i, j] - gain[i] * ph[j] - ph[i] * gain[j] + gain[i] * gain[j] * s
            p[i, j] = v
            p[j, i] = v
    return s


@njit(cache=True, nogil=True)
def pvt_predict(x, p, dt_s, accel_psd, clock_f, clock_g, isb_psd):
    """Time update of the position-velocity-clock filter over dt_s > 0.

    Position' = velocity, velocity' = white acceleration (PSD accel_psd, m^2/s^3, each ECEF axis); clock
    two-state with S_f = clock_f (m^2/s) and S_g = clock_g (m^2/s^3) (Brown & Hwang 1997, section 10.3);
    ISB random walk.
    """
    f = np.eye(N_EKF)
    for i in range(3):
        f[i, 3 + i] = dt_s
    f[6, 7] = dt_s
    x[:] = f @ x
    p[:, :] = f @ p @ f.T
    q3, q2, q1 = dt_s**3 / 3.0, dt_s**2 / 2.0, dt_s
    for i in range(3):
        p[i, i] += accel_psd * q3
        p[i, 3 + i] += accel_psd * q2
        p[3 + i, i] += accel_psd * q2
        p[3 + i, 3 + i] += accel_psd * q1
    p[6, 6] += clock_f * q1 + clock_g * q3
    p[6, 7] += clock_g * q2
    p[7, 6] += clock_g * q2
    p[7, 7] += clock_g * q1
    p[8, 8] += isb_psd * q1


@njit(cache=True, nogil=True)
def pvt_update(
    x, p, sat_pos, sat_vel, second, ranges, range_var, rates, rate_var, gate, innovation, variance, used
):
    """Measurement update with n ranges and n rates: sequential scalar Joseph updates, linearised once.

    A row whose innovation squared exceeds gate x its variance is left out. Rows 0..n-1 of the outputs are
    ranges, n..2n-1 rates; the innovation and its variance S are those before any update of this epoch, so
    that NIS = innovation^T (H P H^T + R)^-1 innovation can be formed by the caller from x and p of before.
    """
    n = sat_pos.shape[0]
    rng, rate, los = np.empty(n), np.empty(n), np.empty((n, 3))
    predict_ranges(sat_pos, sat_vel, x[:3], x[3:6], rng, rate, los)
    x0, p0 = x.copy(), p.copy()
    h, gain = np.zeros(N_EKF), np.zeros(N_EKF)
    for row in range(2 * n):
        i = row % n
        h[:] = 0.0
        at = 0 if row < n else 3
        for a in range(3):
            h[at + a] = -los[i, a]
        if row < n:
            h[6], h[8] = 1.0, second[i]
            z, r = ranges[i] - rng[i] - x0[6] - second[i] * x0[8], range_var[i]
        else:
            h[7] = 1.0
            z, r = rates[i] - rate[i] - x0[7], rate_var[i]
        s0, s, z_now = r, r, z
        for a in range(N_EKF):
            if h[a] == 0.0:
                continue
            z_now -= h[a] * (x[a] - x0[a])
            for b in range(N_EKF):
                s0 += h[a] * p0[a, b] * h[b]
                s += h[a] * p[a, b] * h[b]
        innovation[row], variance[row] = z, s0
        used[row] = 1 if z * z <= gate * s0 and z_now * z_now <= gate * s else 0
        if used[row] == 1:
            joseph_scalar(x, p, h, z_now, r, gain)
