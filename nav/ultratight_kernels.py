"""Compiled steps of the vector and ultra-tight receivers: predict, update from discriminators, steer.

One filter for five error models (integer code): the two RISS forms, the 17-state strapdown model, the Pinson model with
barometer, and position, velocity, clock alone (``KINEMATIC``, the vector receiver). Every model has one more error state at its end, the inter-system bias.
The nominal state is a flat array ``x`` (N_X,) whose layout depends on the model; columns from ``ACC`` on are common.

Innovation about the NCO. A discriminator sees e = g (true - NCO) + noise, g <= 1 its gain at this C/N0. With
off = NCO - predicted, z = e + g off has the row g [-u' T_p + e_b] and the variance of the discriminator.
"""

import math

import numpy as np
from numba import njit

from nav.errormodels import ecef17_f, pinson13_f
from nav.eskf_kernels import discretise, innovation_covariance, joseph_scalar, update
from nav.eskf_kernels import predict as predict_covariance
from nav.frames import earth_radii, geodetic_from_ecef, position_map_geodetic, rotation_enu_to_ecef
from nav.kernels import predict_ranges
from nav.riss import (
    AZIMUTH,
    CLOCK_BIAS,
    CLOCK_DRIFT,
    GYRO_BIAS,
    HEIGHT,
    LAT,
    LON,
    ODO_ACCEL,
    PAPER,
    PITCH,
    PITCH_ERROR,
    SCALE,
    SCALE_FACTOR,
    SPEED,
    VE,
    VN,
    VU,
    riss11_f,
    riss_pos_vel,
    riss_sf_f,
    riss_sf_velocity,
    riss_step,
)
from nav.strapdown import strapdown_step
from signals.constants import C_MPS, CHIP_RATE_HZ, EARTH_RATE_RAD_S, F_L1_HZ, METRES_PER_CHIP, WAVELENGTH_M
from signals.geometry_kernels import orbit_kernel
from tracking.lock import STATE_LOCKED

ECEF17, KINEMATIC, PINSON = 2, 3, 4
"""Model codes beside ``riss.PAPER`` and ``riss.SCALE``."""
BARO_ERROR, WANDER, BARO_HEIGHT = 23, 24, 25
"""Columns of the Pinson model, whose others are those of ``ECEF17``: error of the barometer (m), angle of the navigation frame
about up, from east and north (rad), and the last height read (m, NaN: none)."""
N_X, ACC, ISB, USUAL = 37, 27, 30, 31
"""Length of the nominal state; ECEF acceleration (3) of the last prediction; inter-system bias, m; of ``ECEF17`` the low-passed
angular rate (3) and specific force (3) of the body (NaN: none yet)."""
MANOEUVRE_S = 5.0
"""Correlation time of rates and specific forces in manoeuvres, and that of their low pass: assumed."""

LEFT_OUT = 1e12
"""Factor on the variances of a satellite that a monitor excludes: it weighs nothing and is still steered."""
N_CN0 = 16
"""Columns of what is kept of a channel: prompt power fast and slow, noise power fast, time watched, mean of squared range
innovations, C/N0 (Hz), signal power remembered from when it was strong; smoothed range and rate, measured minus predicted
(m, m/s), and the same measured minus NCO; of the pre-filter, weighted sums of innovations and their weights, range and
rate; noise power slow."""
P_FAST, P_SLOW, N_FAST, WEIGHT, NIS_MEAN, CN0_HZ, SIGNAL, RANGE_M, RATE_MPS, RANGE_OFF_M, RATE_OFF_MPS = (
    range(11)
)
PRE_RANGE, PRE_RANGE_WEIGHT, PRE_RATE, PRE_RATE_WEIGHT, N_SLOW = range(11, 16)
SURPRISE = 9.0
"""Most that one row counts when the filter is judged as a whole: one bad channel must not condemn it."""
OBSERVED_HZ = 1.0
"""Bandwidth in which ranges and rates are smoothed for observations: that of a scalar receiver's code loop."""
STRONG = 10.0
"""C/N0 T above which the signal's own power is learnt."""
CHANGED = 3.0
"""Standard deviations of a mean of prompt powers beyond which the signal is another than before."""

TABLE_LOW_DB, TABLE_STEP_DB = -20.0, 0.5
"""Grid of the discriminator table: C/N0 T in dB; columns code gain, code variance (chips^2), frequency gain and
variance of frequency x T / 2 (cycles^2)."""

N_SENSOR = 8
"""Sensor columns: gyro x y z rad/s, specific force x y z m/s^2 (forward, right, down), odometer m/s, barometer m (NaN: no
reading in this interval)."""


# ---------------------------------------------------------------------------------------------- the error models


@njit(cache=True, nogil=True)
def clock_states(model):
    """Indices of clock bias and drift among the error states."""
    if model == PAPER:
        return 9, 10
    if model == SCALE:
        return 7, 8
    if model == ECEF17:
        return 15, 16
    if model == PINSON:
        return 11, 12
    return 6, 7


@njit(cache=True, nogil=True)
def clock_columns(model):
    """Columns of clock bias and drift in the nominal state."""
    if model <= SCALE:
        return CLOCK_BIAS, CLOCK_DRIFT
    if model == ECEF17 or model == PINSON:
        return 21, 22
    return 6, 7


@njit(cache=True, nogil=True)
def position_velocity(model, x, pos, vel):
    """ECEF position and velocity of a nominal state into ``pos``, ``vel`` (3,)."""
    if model <= SCALE:
        riss_pos_vel(x, pos, vel)
    else:
        for i in range(3):
            pos[i], vel[i] = x[i], x[3 + i]


@njit(cache=True, nogil=True)
def maps(model, x, tp, tv):
    """T_p, T_v (3, n): error states to ECEF position and velocity."""
    tp[:] = 0.0
    tv[:] = 0.0
    if model <= SCALE:
        t = position_map_geodetic(x[LAT], x[LON], x[HEIGHT])
        r = rotation_enu_to_ecef(x[LAT], x[LON])
        for i in range(3):
            for j in range(3):
                tp[i, j] = t[i, j]
        if model == PAPER:
            for i in range(3):
                for j in range(3):
                    tv[i, 3 + j] = r[i, j]
        else:
            v = np.empty((3, 3))
            riss_sf_velocity(x, v)
            for i in range(3):
                for j in range(3):
                    acc = r[i, 0] * v[0, j] + r[i, 1] * v[1, j] + r[i, 2] * v[2, j]
                    tv[i, 3 + j if j < 2 else 6] = acc
    elif model == PINSON:
        _pinson_maps(x, tp, tv)
    else:
        for i in range(3):
            tp[i, i] = 1.0
            tv[i, 3 + i] = 1.0


@njit(cache=True, nogil=True)
def _wander_frame(x):
    """C_en (3, 3), ECEF to the Pinson model's navigation frame (east and north turned by the wander angle, up); height, m."""
    lat, lon, height = geodetic_from_ecef(x[0:3])
    r = rotation_enu_to_ecef(lat, lon)
    c, s = math.cos(x[WANDER]), math.sin(x[WANDER])
    c_en = np.empty((3, 3))
    for j in range(3):
        c_en[0, j] = c * r[j, 0] + s * r[j, 1]
        c_en[1, j] = c * r[j, 1] - s * r[j, 0]
        c_en[2, j] = r[j, 2]
    return c_en, height


@njit(cache=True, nogil=True)
def _pinson_maps(x, tp, tv):
    """T_p, T_v of the Pinson model: x = R_N dtheta_y, y = -R_M dtheta_x, z = dh; C_ne (dV - [v x] dtheta)."""
    c_en, height = _wander_frame(x)
    rm, rn = earth_radii(math.asin(min(1.0, max(-1.0, c_en[2, 2]))))
    v = np.dot(c_en, x[3:6])
    for i in range(3):
        e, n, u = c_en[0, i], c_en[1, i], c_en[2, i]
        tp[i, 0], tp[i, 1], tp[i, 9] = -(rm + height) * n, (rn + height) * e, u
        tv[i, 0] = u * v[1] - n * v[2]
        tv[i, 1] = e * v[2] - u * v[0]
        tv[i, 2] = n * v[0] - e * v[1]
        tv[i, 6], tv[i, 7], tv[i, 8] = e, n, u


@njit(cache=True, nogil=True)
def _inject_pinson(x, dx):
    """Pinson's errors into the ECEF state: position and velocity by their maps, attitude by C_ne (dtheta - phi)."""
    n = dx.size
    tp, tv = np.zeros((3, n)), np.zeros((3, n))
    _pinson_maps(x, tp, tv)
    c_en, _ = _wander_frame(x)
    psi = np.empty(3)
    for i in range(3):
        psi[i] = 0.0
        for j in range(3):
            psi[i] += c_en[j, i] * (dx[j] - dx[3 + j])
    _turn(x[6:15], psi)
    for i in range(3):
        for j in range(n):
            x[i] += tp[i, j] * dx[j]
            x[3 + i] += tv[i, j] * dx[j]
    x[WANDER] += dx[2]
    x[BARO_ERROR] += dx[10]


@njit(cache=True, nogil=True)
def _turn(c, psi):
    """C <- exp([psi x]) C, ``c`` flat (9,); second order, for the small angles of a correction."""
    for k in range(3):
        a, b, d = c[k], c[3 + k], c[6 + k]
        x1 = psi[1] * d - psi[2] * b
        y1 = psi[2] * a - psi[0] * d
        z1 = psi[0] * b - psi[1] * a
        c[k] = a + x1 + 0.5 * (psi[1] * z1 - psi[2] * y1)
        c[3 + k] = b + y1 + 0.5 * (psi[2] * x1 - psi[0] * z1)
        c[6 + k] = d + z1 + 0.5 * (psi[0] * y1 - psi[1] * x1)


@njit(cache=True, nogil=True)
def inject(model, x, dx):
    """Correct the nominal state by dx = true - estimate, in place."""
    n = dx.size
    x[ISB] += dx[n - 1]
    ib, idr = clock_states(model)
    cb, cd = clock_columns(model)
    x[cb] += dx[ib]
    x[cd] += dx[idr]
    if model == PAPER:
        x[LAT] += dx[0]
        x[LON] += dx[1]
        x[HEIGHT] += dx[2]
        x[VE] += dx[3]
        x[VN] += dx[4]
        x[VU] += dx[5]
        x[AZIMUTH] += dx[6]
        x[ODO_ACCEL] += dx[7]
        x[GYRO_BIAS] += dx[8]
    elif model == SCALE:
        x[LAT] += dx[0]
        x[LON] += dx[1]
        x[HEIGHT] += dx[2]
        x[AZIMUTH] += dx[3]
        x[SCALE_FACTOR] += dx[4]
        x[GYRO_BIAS] += dx[5]
        x[PITCH_ERROR] += dx[6]
        x[PITCH] += dx[6]
        v = (1.0 - x[SCALE_FACTOR]) * x[SPEED]
        x[VE] = v * math.cos(x[PITCH]) * math.sin(x[AZIMUTH])
        x[VN] = v * math.cos(x[PITCH]) * math.cos(x[AZIMUTH])
        x[VU] = v * math.sin(x[PITCH])
    elif model == PINSON:
        _inject_pinson(x, dx)
    else:
        for i in range(6):
            x[i] += dx[i]
        if model == ECEF17:
            _turn(x[6:15], dx[6:9])
            for i in range(6):
                x[15 + i] += dx[9 + i]


@njit(cache=True, nogil=True)
def predict(model, x, p, sensors, dt_s, filter_s, rates, q_diag, f, phi, qd):
    """One navigation epoch ahead: nominal state through m sensor intervals, then P over the whole epoch.

    Parameters
    ----------
    x (N_X,), p (n, n) : in place;  sensors (m, N_SENSOR);  dt_s : one sensor interval
    filter_s : pitch low pass of RISS;  q_diag (n,)
    rates (4,) : 1 / correlation times of the model, 1/s; of PINSON the barometer's, its loop's gain 1/s, its variance m^2; of ECEF17
        beside two of them variances of scale factor and of misalignment
    f, phi, qd (n, n) : work and outputs
    """
    m, n = sensors.shape[0], p.shape[0]
    span = m * dt_s
    pos, v0, v1 = np.empty(3), np.empty(3), np.empty(3)
    position_velocity(model, x, pos, v0)
    f[:] = 0.0
    if model <= SCALE:
        turn = 0.0
        for k in range(m):
            s = sensors[k]
            riss_step(x, model, -s[2], s[3], s[4], s[6], dt_s, filter_s)
            turn -= s[2] / m
        if model == SCALE:
            riss_sf_f(x, rates[0], rates[1], rates[2], f[: n - 1, : n - 1])
        else:
            riss11_f(x, turn, rates[0], rates[1], f[: n - 1, : n - 1])
    elif model == ECEF17:
        middle, force = _strapdown_epoch(x, sensors, dt_s, rates)
        ecef17_f(x[0:3], middle, force, rates[0], rates[1], f[: n - 1, : n - 1])
        q_diag = _manoeuvre_noise(x, sensors, span, rates[2], rates[3], q_diag)
    elif model == PINSON:
        _pinson_epoch(x, sensors, dt_s, rates, f[: n - 1, : n - 1])
    else:
        for i in range(3):
            x[i] += x[3 + i] * span
            f[i, 3 + i] = 1.0
        x[6] += x[7] * span
        f[6, 7] = 1.0
    discretise(f, q_diag, span, phi, qd)
    predict_covariance(p, phi, qd)
    if model == PINSON:
        _read_height(x, p, sensors, rates[2], phi, qd)
    position_velocity(model, x, pos, v1)
    for i in range(3):
        x[ACC + i] = (v1[i] - v0[i]) / span


@njit(cache=True, nogil=True)
def _manoeuvre_noise(x, sensors, span, scale_var, misalignment_var, q_diag):
    """Qc of this epoch: what scale factors and misalignments make of the biases while the body's rate and specific force change.

    What acts as a bias is b + M f, M a constant of the run. Of it M f- with the low-passed f- is the bias state's; the rest M f~ is
    taken as Gauss-Markov of variance sum_j E[M_ij^2] f~_j^2 and correlation time ``MANOEUVRE_S``: driving noise 2 / tau times
    that, on the bias state itself, which keeps it correlated. Steady motion adds nothing.
    """
    q = q_diag.copy()
    k = span / (MANOEUVRE_S + span)
    squares = np.empty(3)
    for triad in range(2):
        total = 0.0
        for i in range(3):
            at, mean = USUAL + 3 * triad + i, 0.0
            for s in range(sensors.shape[0]):
                mean += sensors[s, 3 * triad + i] / sensors.shape[0]
            x[at] = mean if math.isnan(x[at]) else x[at] + k * (mean - x[at])
            squares[i] = (mean - x[at]) ** 2
            total += squares[i]
        for i in range(3):
            var = scale_var * squares[i] + misalignment_var * (total - squares[i])
            q[(12 if triad == 0 else 9) + i] += 2.0 / MANOEUVRE_S * var
    return q


@njit(cache=True, nogil=True)
def _pinson_epoch(x, sensors, dt_s, rates, f):
    """Strapdown navigation over one epoch with the height slaved to the barometer, h' = v_z + k (h_baro - error - h); its F."""
    span = sensors.shape[0] * dt_s
    middle, force = _strapdown_epoch(x, sensors, dt_s, np.zeros(2))
    c_en, height = _wander_frame(x)
    v = np.dot(c_en, x[3:6])
    rm, rn = earth_radii(math.asin(c_en[2, 2]))
    # The frame does not turn about up, where east and north do: alpha' = -v_east tan(lat) / R_N.
    east = math.cos(x[WANDER]) * v[0] - math.sin(x[WANDER]) * v[1]
    x[WANDER] -= span * east * c_en[2, 2] / math.sqrt(1.0 - c_en[2, 2] ** 2) / (rn + height)
    if not math.isnan(x[BARO_HEIGHT]):
        step = rates[1] * span * (x[BARO_HEIGHT] - x[BARO_ERROR] - height)
        for i in range(3):
            x[i] += step * c_en[2, i]
    x[BARO_ERROR] *= math.exp(-rates[0] * span)
    force_n = np.dot(c_en, np.dot(middle, force))
    pinson13_f(c_en, (rm + height, rn + height), v, force_n, rates[0], rates[1], 1.0, -1.0, f)


@njit(cache=True, nogil=True)
def _read_height(x, p, sensors, var, phi, qd):
    """Update by the epoch's last barometer reading, row [dh + dhB]; the epoch's Phi and Qd take it in.

    With A = I - k h', what follows sees one transition A Phi with noise A Qd A' + k var k'.
    """
    height = math.nan
    for k in range(sensors.shape[0]):
        if not math.isnan(sensors[k, 7]):
            height = sensors[k, 7]
    if math.isnan(height):
        return
    n = p.shape[0]
    row, g, gain, a = np.zeros(n), np.zeros(n), np.zeros(n), np.eye(n)
    row[9] = row[10] = 1.0
    joseph_scalar(p, row, var, g, gain)
    _, here = _wander_frame(x)
    inject(PINSON, x, gain * (height - here - x[BARO_ERROR]))
    x[BARO_HEIGHT] = height
    for i in range(n):
        a[i, 9] -= gain[i]
        a[i, 10] -= gain[i]
    phi[:] = np.dot(a, phi)
    qd[:] = np.dot(np.dot(a, qd), a.T)
    for i in range(n):
        for j in range(n):
            qd[i, j] += gain[i] * var * gain[j]


@njit(cache=True, nogil=True)
def _strapdown_epoch(x, sensors, dt_s, rates):
    """Strapdown navigation in ECEF over one epoch; returns C_be (3, 3) in its middle and the mean specific force (3,)."""
    m = sensors.shape[0]
    pos, vel = x[0:3].copy(), x[3:6].copy()
    c = x[6:15].copy().reshape(3, 3)
    middle, force = c.copy(), np.zeros(3)
    a, g = np.empty(3), np.empty(3)
    for k in range(m):
        if k == m // 2:
            middle[:] = c
        for i in range(3):
            g[i], a[i] = sensors[k, i] - x[18 + i], sensors[k, 3 + i] - x[15 + i]
            force[i] += a[i] / m
        strapdown_step(pos, vel, c, g, a, dt_s)
    x[0:3], x[3:6] = pos, vel
    x[6:15] = c.reshape(9)
    span = m * dt_s
    for i in range(3):
        x[15 + i] *= math.exp(-rates[0] * span)
        x[18 + i] *= math.exp(-rates[1] * span)
    x[21] += x[22] * span
    return middle, force


# --------------------------------------------------------------------------------------------- powers and variance


@njit(cache=True, nogil=True)
def look_up(table, snr, out):
    """Interpolate the discriminator table at C/N0 T = ``snr`` into ``out`` (4,); its ends hold beyond it."""
    last = table.shape[0] - 1
    y = (10.0 * math.log10(max(snr, 1e-9)) - TABLE_LOW_DB) / TABLE_STEP_DB
    y = min(max(y, 0.0), last - 1e-9)
    i = int(y)
    w = y - i
    for c in range(4):
        out[c] = (1.0 - w) * table[i, c] + w * table[i + 1, c]


@njit(cache=True, nogil=True)
def scatter(prompt, noise, weight):
    """Standard deviation of an exponential mean of |P|^2, one step counting ``weight`` k, from prompt and noise powers.

    |P|^2 of a signal S in noise N has variance N^2 + 2 S N; its mean k / (2 - k) of that.
    """
    return math.sqrt(weight / (2.0 - weight) * noise * max(2.0 * prompt - noise, noise))


@njit(cache=True, nogil=True)
def watch_power(row, prompt_power, noise_power, span_s, fast_s, slow_s):
    """Fast and slow means of |P|^2 and of the noise tap's power, each per integration of the same length.

    The slow mean begins anew from the fast one that lies below it by more than scatter: a fall is followed in ``fast_s``, what
    lasts is known from ``slow_s``, and there is no bias as of the lower of two.
    """
    w = row[WEIGHT] + span_s
    if prompt_power < 0.1 * row[P_FAST] and row[P_FAST] > STRONG * row[N_FAST]:
        row[P_FAST] = row[P_SLOW] = prompt_power  # a strong signal that is gone is gone at once
        row[N_SLOW] = row[N_FAST]
        w = 2.0 * span_s
    kf, ks = span_s / min(w, fast_s + span_s), span_s / min(w, slow_s + span_s)
    row[P_FAST] += kf * (prompt_power - row[P_FAST])
    row[P_SLOW] += ks * (prompt_power - row[P_SLOW])
    row[N_FAST] += kf * (noise_power - row[N_FAST])
    row[N_SLOW] += ks * (noise_power - row[N_SLOW])
    if row[P_SLOW] - row[P_FAST] > CHANGED * scatter(row[P_SLOW], row[N_FAST], kf):
        row[P_SLOW], row[N_SLOW], w = row[P_FAST], row[N_FAST], min(w, fast_s)
    row[WEIGHT] = min(w, 1e3)


@njit(cache=True, nogil=True)
def common_gain(power, active, span_s, slow_s, density, work):
    """Factor g by which all signals together differ from the powers S remembered; 1 where it is that within its scatter.

    One front end has one gain, and where it holds the total power, a jammer makes all signals sink alike: g = sum w (P - N) /
    sum w S, w = S / var(P - N), of the channels within scatter of their median; those with a noise of their own are left
    out. Of fewer than four nothing common is known: 1. ``density``: common noise; ``work`` (C,).
    """
    count = 0
    for c in range(active.size):
        if active[c] and power[c, SIGNAL] > 0.0 and power[c, N_FAST] * span_s[c] <= 2.0 * density:
            work[count] = (power[c, P_SLOW] - power[c, N_SLOW]) / power[c, SIGNAL]
            count += 1
    if count < 4:
        return 1.0
    middle = max(np.median(work[:count]), 0.0)
    total, info = 0.0, 1e-300
    for c in range(active.size):
        if active[c] and power[c, SIGNAL] > 0.0 and power[c, N_FAST] * span_s[c] <= 2.0 * density:
            signal, noise = power[c, SIGNAL], density / span_s[c]
            k = span_s[c] / min(power[c, WEIGHT], slow_s + span_s[c])
            var = scatter(middle * signal + noise, noise, k) ** 2 + scatter(noise, noise, k) ** 2
            excess = power[c, P_SLOW] - power[c, N_SLOW]
            if (excess - middle * signal) ** 2 < CHANGED**2 * var:
                total += signal * excess / var
                info += signal * signal / var
    gain = max(total / info, 0.0)
    return 1.0 if abs(gain - 1.0) < CHANGED / math.sqrt(info) else gain


@njit(cache=True, nogil=True)
def cn0_from_powers(power, active, span_s, slow_s, cn0_out):
    """C/N0 (Hz) of every channel.

    C/N0 = (P_slow - N) / (N T), N the median of all channels' fast noise, or the own one where it is twice
    that: a jammer that rises is in the common noise at once, one that hits a single code in its own. Once the signal's own
    power S is known from when it was strong, g S / (N T) while P_slow is g S + N within scatter, g the ``common_gain``:
    among noise an estimate of its own would scatter to gains and weights that are not there. Never more than g S allows.
    """
    n = power.shape[0]
    noise = np.empty(n)
    count = 0
    for c in range(n):
        if active[c]:
            noise[count] = power[c, N_FAST] * span_s[c]
            count += 1
    if count == 0:
        return
    ordered = np.sort(noise[:count])
    common = ordered[count // 2]
    gain = common_gain(power, active, span_s, slow_s, common, noise)
    for c in range(n):
        if not active[c]:
            continue
        own = power[c, N_FAST] * span_s[c]
        density = own if own > 2.0 * common else common
        prompt, noise_power = power[c, P_SLOW], density / span_s[c]
        value = prompt / max(density, 1e-30) - 1.0 / span_s[c]
        cn0_out[c] = max(value, 0.5)
        known = gain * power[c, SIGNAL]
        if value * span_s[c] > STRONG and power[c, WEIGHT] > 0.2:
            k = 1.0 if power[c, SIGNAL] == 0.0 else 0.01
            signal = prompt - noise_power
            # What is remembered is the power at the gain of before, unless this channel alone has changed.
            signal /= gain if abs(signal - known) < 0.5 * known else 1.0
            power[c, SIGNAL] += k * (signal - power[c, SIGNAL])
        elif power[c, SIGNAL] > 0.0:
            weight = span_s[c] / min(power[c, WEIGHT], slow_s + span_s[c])
            there = known + noise_power
            if abs(prompt - there) < CHANGED * scatter(there, noise_power, weight):
                cn0_out[c] = max(known / density, 0.5)
            else:
                cn0_out[c] = max(min(cn0_out[c], known / density), 0.5)
                if power[c, SIGNAL] > STRONG * noise_power and value * span_s[c] < 1.0:
                    cn0_out[c] = 0.5  # it should stand out and does not: what is left is noise alone
        power[c, CN0_HZ] = cn0_out[c]


# ------------------------------------------------------------------------------------------------- update and steer


@njit(cache=True, nogil=True)
def rows(model, x, n, los, second, gain_code, gain_rate, tp, tv, h):
    """Range rows 0..C-1 and rate rows C..2C-1, scaled by the discriminators' gains."""
    maps(model, x, tp, tv)
    ib, idr = clock_states(model)
    count = los.shape[0]
    for c in range(count):
        for j in range(n):
            a = b = 0.0
            for i in range(3):
                a -= los[c, i] * tp[i, j]
                b -= los[c, i] * tv[i, j]
            h[c, j], h[count + c, j] = gain_code[c] * a, gain_rate[c] * b
        h[c, ib] += gain_code[c]
        h[c, n - 1] += gain_code[c] * second[c]
        h[count + c, idr] += gain_rate[c]


@njit(cache=True, nogil=True)
def filter_update(model, x, p, h, z, var, used, power, limit, k, s, p_prior, dx):
    """Update and inject; a row beyond ``limit`` sigma counts less, as much as brings it back to the limit.

    A channel whose ranges stay beyond 3 sigma for a second while most others agree is sick and left out.
    Returns (NIS over the rows before any inflation, rows used).
    """
    m = z.size
    count = m // 2
    p_prior[:] = p
    innovation_covariance(p, h, var, used, s)
    sick = trusted = 0
    for c in range(count):
        if used[c]:
            ratio = z[c] * z[c] / s[c, c]
            power[c, NIS_MEAN] += 0.02 * (min(ratio, 100.0) - power[c, NIS_MEAN])
            trusted += 1
            sick += power[c, NIS_MEAN] > 9.0
    total, n_rows = 0.0, 0
    for r in range(m):
        if not used[r]:
            continue
        ratio = z[r] * z[r] / s[r, r]
        total += ratio
        n_rows += 1
        c = r if r < count else r - count
        if 3 * sick <= trusted and power[c, NIS_MEAN] > 9.0:
            used[r] = False
        elif limit > 0.0 and ratio > limit * limit:
            extra = z[r] * z[r] / (limit * limit) - s[r, r]
            var[r] += extra
            s[r, r] += extra
    update(p, h, var, used, z, k, dx)
    inject(model, x, dx)
    return total, n_rows


@njit(cache=True, nogil=True)
def range_acceleration(los, rho, rate, rel_vel2, sat_acc_los, acc):
    """d2 rho / dt2 = (|dv|^2 - rho'^2) / rho + u . (a_sat - a_rx), m/s^2."""
    a = sat_acc_los + (rel_vel2 - rate * rate) / rho
    for i in range(3):
        a -= los[i] * acc[i]
    return a


@njit(cache=True, nogil=True)
def satellites_at(orbit, toe_toc_tgd, active, tow_whole, tow_frac, rho, pos, vel, acc, clock, rate):
    """ECEF state, acceleration and clock of each active satellite at transmission, rho (C,) its pseudorange.

    ``tow_whole + tow_frac`` is the receiver's GPS time of week; ``clock`` and ``rate`` in m and m/s, group delay
    taken off (IS-GPS-200, 20.3.3.3.3).
    """
    half, week = 302_400.0, 604_800.0
    for c in range(active.size):
        if not active[c]:
            continue
        t = tow_frac - rho[c] / C_MPS
        dt_toe = (tow_whole - toe_toc_tgd[c, 0] + half) % week - half + t
        dt_toc = (tow_whole - toe_toc_tgd[c, 1] + half) % week - half + t
        s = orbit_kernel(orbit[c], dt_toe, dt_toc)
        s = orbit_kernel(orbit[c], dt_toe - s[6], dt_toc - s[6])
        r2 = 0.0
        for i in range(3):
            pos[c, i], vel[c, i] = s[i], s[3 + i]
            r2 += s[i] * s[i]
        # Rotating frame: gravitation, Coriolis, centrifugal.
        g = -3.986004418e14 / (r2 * math.sqrt(r2))
        we = EARTH_RATE_RAD_S
        acc[c, 0] = (g + we * we) * s[0] + 2.0 * we * s[4]
        acc[c, 1] = (g + we * we) * s[1] - 2.0 * we * s[3]
        acc[c, 2] = g * s[2]
        clock[c] = C_MPS * (s[6] - toe_toc_tgd[c, 2])
        rate[c] = C_MPS * s[7]


@njit(cache=True, nogil=True)
def pseudoranges(model, x, active, second, sat_pos, sat_vel, sat_acc, clock, clock_rate, delay, delay_rate, rho, rate,
                 accel, los):  # fmt: skip
    """Predicted pseudorange, rate and acceleration of every active channel, and unit vectors to the satellites."""
    pos, vel = np.empty(3), np.empty(3)
    position_velocity(model, x, pos, vel)
    cb, cd = clock_columns(model)
    one_rho, one_rate = np.empty(1), np.empty(1)
    for c in range(active.size):
        if not active[c]:
            continue
        predict_ranges(sat_pos[c : c + 1], sat_vel[c : c + 1], pos, vel, one_rho, one_rate, los[c : c + 1])
        v2 = a = 0.0
        for i in range(3):
            v2 += (sat_vel[c, i] - vel[i]) ** 2
            a += los[c, i] * sat_acc[c, i]
        accel[c] = range_acceleration(los[c], one_rho[0], one_rate[0], v2, a, x[ACC : ACC + 3])
        rho[c] = one_rho[0] + x[cb] + second[c] * x[ISB] - clock[c] + delay[c]
        rate[c] = one_rate[0] + x[cd] - clock_rate[c] + delay_rate[c]


@njit(cache=True, nogil=True)
def read_epochs(epochs, counts, slot, active, period_s, before, sample, fs_hz, rx_frac_s, rx_ms, rho, rate, accel, tables, which,
                power, fast_s, slow_s, code_m, rate_mps, off_m, off_mps, span_s, seen):  # fmt: skip
    """Means over each channel's integrations of this epoch, those that ended after sample ``before``: discriminators, and the
    NCO's offset from the prediction.

    code_m, rate_mps : measured minus NCO;  off_m, off_mps : NCO minus predicted, both at mid-integration
    ``rx_ms``, ``rx_frac_s``: receiver time at ``sample``; whole code periods of the NCO are those nearest to it.
    """
    for c in range(active.size):
        seen[c] = 0
        if not active[c]:
            continue
        code_m[c] = rate_mps[c] = off_m[c] = off_mps[c] = 0.0
        k = slot[c]
        length = period_s[c] * CHIP_RATE_HZ
        for j in range(counts[k]):
            e = epochs[k, j]
            if e.state != STATE_LOCKED or np.int64(e.sample_index) + e.n_samples <= before:
                continue
            T = e.n_samples / fs_hz
            dt = (np.int64(e.sample_index) - sample) / fs_hz + 0.5 * T
            phase = e.code_phase_chips + 0.5 * T * CHIP_RATE_HZ * (
                1.0 + (e.doppler_hz + 0.25 * T * e.doppler_rate_hz_s) / F_L1_HZ
            )
            here = rho[c] + dt * (rate[c] + 0.5 * dt * accel[c])
            t = rx_frac_s + 1e-3 * (rx_ms % 4) + dt - here / C_MPS
            shift = phase - (t - math.floor(t / period_s[c]) * period_s[c]) * CHIP_RATE_HZ
            shift -= math.floor(shift / length + 0.5) * length
            off_m[c] -= shift * METRES_PER_CHIP
            off_mps[c] += -WAVELENGTH_M * (e.doppler_hz + 0.5 * T * e.doppler_rate_hz_s) - (
                rate[c] + dt * accel[c]
            )
            code_m[c] -= e.code_error_chips * METRES_PER_CHIP
            rate_mps[c] -= e.freq_error_hz * WAVELENGTH_M
            p2 = e.prompt_i * e.prompt_i + e.prompt_q * e.prompt_q
            n2 = e.noise_i * e.noise_i + e.noise_q * e.noise_q
            watch_power(power[c], p2, n2, T, fast_s, slow_s)
            span_s[c] = T
            seen[c] += 1
        if seen[c] > 0:
            code_m[c] /= seen[c]
            rate_mps[c] /= seen[c]
            off_m[c] /= seen[c]
            off_mps[c] /= seen[c]


@njit(cache=True, nogil=True)
def weigh(code_m, rate_mps, off_m, off_mps, span_s, seen, cn0, inflate, tables, which, floor_m, floor_mps, z, var, used,
          gain_code, gain_rate):  # fmt: skip
    """Innovations, variances and gains of all rows from the discriminators and the fast C/N0; ``inflate`` (2C,)."""
    count = seen.size
    row = np.empty(4)
    for c in range(count):
        used[c] = used[count + c] = seen[c] > 0
        if seen[c] == 0:
            continue
        look_up(tables[which[c]], cn0[c] * span_s[c], row)
        gain_code[c], gain_rate[c] = row[0], row[2]
        z[c] = code_m[c] + row[0] * off_m[c]
        z[count + c] = rate_mps[c] + row[2] * off_mps[c]
        per_hz = WAVELENGTH_M / (0.5 * span_s[c])
        var[c] = inflate[c] * (row[1] * METRES_PER_CHIP**2 / seen[c] + (row[0] * floor_m) ** 2)
        var[count + c] = inflate[count + c] * (row[3] * per_hz**2 / seen[c] + (row[2] * floor_mps) ** 2)


@njit(cache=True, nogil=True)
def prefilter(z, var, used, gain_code, gain_rate, power, last):
    """Average each channel's innovations over a block of epochs; the filter gets one at its ``last`` and none before.

    y = sum w z / g / sum w with w = g^2 / R has gain 1 and variance 1 / sum w. The filter only predicts within a block, so
    all of it refers to one error; the sums begin anew with each, which leaves the blocks' noise white.
    """
    count = gain_code.size
    for c in range(count):
        for kind in range(2):
            r, at = c + kind * count, PRE_RANGE + 2 * kind
            gain = gain_code if kind == 0 else gain_rate
            if used[r]:
                power[c, at] += gain[c] / var[r] * z[r]
                power[c, at + 1] += gain[c] * gain[c] / var[r]
            used[r] = last and power[c, at + 1] > 0.0
            if used[r]:
                z[r], var[r], gain[c] = power[c, at] / power[c, at + 1], 1.0 / power[c, at + 1], 1.0
            if last:
                power[c, at] = power[c, at + 1] = 0.0


@njit(cache=True, nogil=True)
def observe(seen, span_s, z, gain_code, gain_rate, off_m, off_mps, rho, rate, before_m, before_mps, power):
    """What each channel measured in itself, for observations: y <- y + k (z / g - y), z / g = measured - predicted.

    k = 4 B T / (1 + 2 B T), a first-order loop's; afterwards the prediction is the corrected one, so that y + rho is the
    measured range, in which the filter's correction does not show. ``before_*``: the prediction that z refers to.
    """
    count = seen.size
    for c in range(count):
        if seen[c] == 0:
            continue
        row = power[c]
        bt = OBSERVED_HZ * seen[c] * span_s[c]
        k = 4.0 * bt / (1.0 + 2.0 * bt)
        row[RANGE_M] += k * (z[c] / gain_code[c] - row[RANGE_M])
        row[RATE_MPS] += k * (z[count + c] / gain_rate[c] - row[RATE_MPS])
        row[RANGE_OFF_M], row[RATE_OFF_MPS] = row[RANGE_M] - off_m[c], row[RATE_MPS] - off_mps[c]
        row[RANGE_M] -= rho[c] - before_m[c]
        row[RATE_MPS] -= rate[c] - before_mps[c]


@njit(cache=True, nogil=True)
def steer(active, slot, period_s, sample, rx_ms, rx_frac_s, rho, rate, accel, every_s, commands):
    """NCO commands from ``sample`` on, the next ones ``every_s`` later: code phase, Doppler and its rate.

    A rate that changes the Doppler by less than 0.25 Hz in half of that time is folded into it, ``every_s``/2 + 10 ms ahead,
    where integrations of 20 ms that this command governs have their middle on average: a carrier of constant frequency is
    cheaper to correlate.
    """
    lead_s, slow_hz_s = 0.5 * every_s + 0.01, 0.5 / every_s
    for c in range(active.size):
        if not active[c]:
            continue
        cmd = commands[slot[c]]
        t = rx_frac_s + 1e-3 * (rx_ms % 4) - rho[c] / C_MPS
        cmd.sample_index = sample
        cmd.steered = 1
        cmd.code_phase_chips = (t - math.floor(t / period_s[c]) * period_s[c]) * CHIP_RATE_HZ
        cmd.doppler_hz = -rate[c] / WAVELENGTH_M
        cmd.doppler_rate_hz_s = -accel[c] / WAVELENGTH_M
        if abs(cmd.doppler_rate_hz_s) < slow_hz_s:
            cmd.doppler_hz += lead_s * cmd.doppler_rate_hz_s
            cmd.doppler_rate_hz_s = 0.0


@njit(cache=True, nogil=True)
def navigation_epoch(model, x, p, sensors, dt_s, every_s, epoch, block, filter_s, rates, q_diag, limit, fast_s, slow_s, floor_m, floor_mps,
                     before, sample, fs_hz, rx_ms, rx_frac_s, tow_whole, tow_frac, orbit, toe_toc_tgd, active, slot, second,
                     period_s, delay, delay_rate, inflate, tables, which, epochs, counts, power, cn0, rho, rate, accel,
                     los, f, phi, qd, h, z, var, own, used, k, s, p_prior, dx, commands):  # fmt: skip
    """Predict, update from every channel's discriminators and steer: one call per navigation epoch.

    The epoch leads from receiver sample ``before`` to ``sample``; commands hold from there on. ``inflate`` (2C,) multiplies the variances of ranges
    and rates, ``own`` (2C,) receives them without it, 0 where nothing was heard. Returns (NIS, rows that weigh something, mean over
    the rows taken of their normalised innovations squared, none above ``SURPRISE``).
    """
    n, count = p.shape[0], active.size
    sat_pos, sat_vel, sat_acc = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 3))
    clock, clock_rate = np.zeros(count), np.zeros(count)
    tp, tv = np.empty((3, n)), np.empty((3, n))
    code_m, rate_mps, off_m, off_mps = np.zeros(count), np.zeros(count), np.zeros(count), np.zeros(count)
    span_s, seen = np.full(count, 0.02), np.zeros(count, np.int64)
    gain_code, gain_rate = np.ones(count), np.ones(count)
    predict(model, x, p, sensors, dt_s, filter_s, rates, q_diag, f, phi, qd)
    satellites_at(
        orbit, toe_toc_tgd, active, tow_whole, tow_frac, rho, sat_pos, sat_vel, sat_acc, clock, clock_rate
    )
    pseudoranges(
        model, x, active, second, sat_pos, sat_vel, sat_acc, clock, clock_rate, delay, delay_rate, rho, rate, accel, los
    )  # fmt: skip
    read_epochs(
        epochs, counts, slot, active, period_s, before, sample, fs_hz, rx_frac_s, rx_ms, rho, rate, accel, tables, which,
        power, fast_s, slow_s, code_m, rate_mps, off_m, off_mps, span_s, seen,
    )  # fmt: skip
    cn0_from_powers(power, active, span_s, slow_s, cn0)
    h[:] = 0.0
    z[:] = 0.0
    var[:] = 1.0
    used[:] = False
    weigh(
        code_m, rate_mps, off_m, off_mps, span_s, seen, cn0, inflate, tables, which, floor_m, floor_mps, z, var, used,
        gain_code, gain_rate,
    )  # fmt: skip
    own[:] = np.where(used, var / inflate, 0.0)
    z_now, g_code, g_rate = z.copy(), gain_code.copy(), gain_rate.copy()
    if block > 1:
        prefilter(z, var, used, gain_code, gain_rate, power, epoch % block == 0)
    rows(model, x, n, los, second, gain_code, gain_rate, tp, tv, h)
    # Discriminators speak of the middle of their integrations, which the noise of the epoch's second half has not touched.
    p -= 0.5 * qd
    nis, n_rows = filter_update(model, x, p, h, z, var, used, power, limit, k, s, p_prior, dx)
    p += 0.5 * qd
    before_m, before_mps = rho.copy(), rate.copy()
    pseudoranges(
        model, x, active, second, sat_pos, sat_vel, sat_acc, clock, clock_rate, delay, delay_rate, rho, rate, accel, los
    )  # fmt: skip
    observe(seen, span_s, z_now, g_code, g_rate, off_m, off_mps, rho, rate, before_m, before_mps, power)
    steer(active, slot, period_s, sample, rx_ms, rx_frac_s, rho, rate, accel, every_s, commands)
    surprise, n_used = 0.0, 0
    for r in range(2 * count):
        if used[r]:
            surprise += min(z[r] * z[r] / s[r, r], SURPRISE)
            n_used += 1
        if own[r] > 0.0 and inflate[r] >= LEFT_OUT:
            n_rows -= 1  # no degree of freedom
    return nis, max(n_rows, 0), surprise / max(n_used, 1)


@njit(cache=True, nogil=True)
def any_unlocked(active, slot, states):
    """Whether a channel under command is no longer locked; ``states`` (C,) of all the tracker's channels."""
    for c in range(active.size):
        if active[c] and states[slot[c]] != STATE_LOCKED:
            return True
    return False


@njit(cache=True, nogil=True)
def outlook(model, x, p, los, active, power, cn0, usable_hz, sigma):
    """What the filter sees and how well it knows the next interval.

    ``sigma`` (2,): largest standard deviations of predicted range (m) and rate (m/s) over the active channels, NaN when the
    position is not finite. Returns the numbers of active channels above ``usable_hz``; of those that should stand out of the
    noise (their own strength is remembered) and do not; of those that should and do.
    """
    n = p.shape[0]
    tp, tv, pos, vel = np.empty((3, n)), np.empty((3, n)), np.empty(3), np.empty(3)
    maps(model, x, tp, tv)
    position_velocity(model, x, pos, vel)
    ib, idr = clock_states(model)
    row = np.empty(n)
    sigma[:] = 0.0
    usable = missing = heard = 0
    finite = math.isfinite(pos[0] + pos[1] + pos[2] + vel[0] + vel[1] + vel[2])
    for c in range(active.size):
        if not active[c]:
            continue
        usable += cn0[c] > usable_hz
        noise, fast = power[c, N_FAST], power[c, P_FAST]
        if power[c, SIGNAL] > STRONG * noise:
            missing += fast < 4.0 * noise
            heard += min(fast, power[c, P_SLOW]) > (1.0 + STRONG) * noise
        for kind in range(2):
            t = tp if kind == 0 else tv
            for j in range(n):
                row[j] = -(los[c, 0] * t[0, j] + los[c, 1] * t[1, j] + los[c, 2] * t[2, j])
            row[ib if kind == 0 else idr] += 1.0
            v = 0.0
            for i in range(n):
                for j in range(n):
                    v += row[i] * p[i, j] * row[j]
            sigma[kind] = max(sigma[kind], math.sqrt(max(v, 0.0)))
            finite = finite and math.isfinite(v)
    if not finite:
        sigma[:] = math.nan
    return usable, missing, heard


@njit(cache=True, nogil=True)
def horizontal_sigma(model, x, p):
    """Standard deviation of the horizontal position (m), root of the sum of both axes' variances."""
    n = p.shape[0]
    tp, tv = np.empty((3, n)), np.empty((3, n))
    maps(model, x, tp, tv)
    pos, vel = np.empty(3), np.empty(3)
    position_velocity(model, x, pos, vel)
    up = pos / math.sqrt(pos[0] ** 2 + pos[1] ** 2 + pos[2] ** 2)
    total = vertical = 0.0
    for i in range(n):
        for j in range(n):
            if p[i, j] == 0.0:
                continue
            ui = up[0] * tp[0, i] + up[1] * tp[1, i] + up[2] * tp[2, i]
            uj = up[0] * tp[0, j] + up[1] * tp[1, j] + up[2] * tp[2, j]
            total += (tp[0, i] * tp[0, j] + tp[1, i] * tp[1, j] + tp[2, i] * tp[2, j]) * p[i, j]
            vertical += ui * uj * p[i, j]
    return math.sqrt(max(total - vertical, 0.0))
