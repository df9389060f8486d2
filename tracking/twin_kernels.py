"""Kernels of the correlator-domain twin (``tracking.correlator_model``): noise, line sequences, closed loops.

Complex noise is a pure function of (key, epoch, tap): splitmix64 of a counter, then Box-Muller. Every kernel works on
whole blocks of ``BLOCK_EPOCHS`` epochs that start at multiples of it, so results do not depend on how a run is cut.
"""

import math

import numpy as np
from numba import njit

__all__ = [
    "BLOCK_EPOCHS",
    "TWIN_COLUMNS",
    "acf_at",
    "bit_signs",
    "closed_loop",
    "hatch_smooth",
    "line_sequence",
    "normals_columns",
    "normals_rows",
]

BLOCK_EPOCHS = 512
"""Epochs per block; fixes the grouping of all sums."""
TWIN_COLUMNS = 11
"""Columns of the closed-loop kernel's output, see ``closed_loop``."""

_U = np.uint64
_F = np.float32
_GAMMA = _U(0x9E3779B97F4A7C15)
_M1 = _U(0xBF58476D1CE4E5B9)
_M2 = _U(0x94D049BB133111EB)
_LN2 = _F(0.6931471805599453)
_SQRT2 = _F(1.4142135623730951)
_TWO_M32 = _F(2.0**-32)
_PI = _F(math.pi)
_STRIDE = _U(4096)  # counters per epoch: more than any number of taps
_TWO_PI = 2.0 * math.pi


@njit(error_model="numpy")
def mix64(x):
    """Output function of splitmix64 (Steele, Lea, Flood 2014, section 4)."""
    x = (x ^ (x >> _U(30))) * _M1
    x = (x ^ (x >> _U(27))) * _M2
    return x ^ (x >> _U(31))


@njit(error_model="numpy")
def _radius(word):
    """sqrt(-2 ln u), u = (word + 1/2) / 2^31; ln by exponent split and the atanh series (error < 1e-7)."""
    bits = np.float32(_F(word) + _F(0.5)).view(np.int32)
    exponent = np.int32(np.int32(bits >> np.int32(23)) - np.int32(127))
    m = np.int32((bits & np.int32(0x007FFFFF)) | np.int32(0x3F800000)).view(np.float32)
    high = m > _SQRT2
    m = m * _F(0.5) if high else m
    e = _F(exponent) + (_F(1.0) if high else _F(0.0)) - _F(31.0)
    s = (m - _F(1.0)) / (m + _F(1.0))
    s2 = s * s
    ln = _F(2.0) * s * (_F(1.0) + s2 * (_F(1 / 3) + s2 * (_F(1 / 5) + s2 * (_F(1 / 7) + s2 * _F(1 / 9)))))
    return math.sqrt(max(_F(-2.0) * (ln + e * _LN2), _F(0.0)))


@njit(error_model="numpy")
def _half_sin(x):
    """sin x for abs(x) <= pi / 2, Taylor to x^11 (error < 6e-8)."""
    y = x * x
    p = _F(1 / 362880) - y * _F(1 / 39916800)
    return x * (_F(1.0) - y * (_F(1 / 6) - y * (_F(1 / 120) - y * (_F(1 / 5040) - y * p))))


@njit(error_model="numpy")
def _half_cos(x):
    """cos x for abs(x) <= pi / 2, Taylor to x^12 (error < 7e-9)."""
    y = x * x
    p = _F(1 / 3628800) - y * _F(1 / 479001600)
    p = _F(1 / 40320) - y * p
    return _F(1.0) - y * (_F(1 / 2) - y * (_F(1 / 24) - y * (_F(1 / 720) - y * p)))


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def normals_columns(key, epoch0, out):
    """Fill ``out`` float32 (K, 2 E) with N(0, 1): columns 0..E-1 in-phase, E..2E-1 quadrature."""
    n_taps = out.shape[0]
    n = out.shape[1] // 2
    for k in range(n_taps):
        start = _U(key) + (_U(epoch0) * _STRIDE + _U(k)) * _GAMMA
        step = _STRIDE * _GAMMA
        re = out[k, :n]
        im = out[k, n:]
        for e in range(n):
            w = mix64(start + _U(e) * step)
            r = _radius(np.int32(w >> _U(33)))
            x = _F(np.int32(w)) * (_PI * _TWO_M32)
            s = _half_sin(x)
            c = _half_cos(x)
            re[e] = r * (_F(1.0) - _F(2.0) * s * s)
            im[e] = r * (_F(2.0) * s * c)


@njit(cache=True, nogil=True, error_model="numpy")
def normals_rows(key, epoch0, columns, out):
    """The numbers of ``normals_columns``, transposed: ``out`` float32 (2 E, K); ``columns`` (K, 2 E) is scratch."""
    normals_columns(key, epoch0, columns)
    n_taps, n = columns.shape
    for e in range(n):
        for k in range(n_taps):
            out[e, k] = columns[k, e]


@njit(error_model="numpy")
def acf_at(table, per_chip, x_chips):
    """Periodic autocorrelation at ``x_chips``, linear between the points of ``table`` (``per_chip`` a chip)."""
    n = table.shape[0]
    y = x_chips * per_chip
    i = math.floor(y)
    frac = y - i
    j = int(i) % n
    k = j + 1 if j + 1 < n else 0
    return table[j] + frac * (table[k] - table[j])


@njit(cache=True, nogil=True, error_model="numpy")
def bit_signs(key, epoch0, epochs_per_symbol, mode, secondary, out):
    """Sign of each epoch: mode 0 always +1, 1 random symbols, 2 the secondary code; ``out`` float32 (E,)."""
    for e in range(out.shape[0]):
        symbol = (epoch0 + e) // epochs_per_symbol
        if mode == 0:
            out[e] = 1.0
        elif mode == 1:
            out[e] = 1.0 if mix64(_U(key) + _U(symbol) * _GAMMA) >> _U(63) else -1.0
        else:
            out[e] = secondary[symbol % secondary.shape[0]]


@njit(error_model="numpy")
def _sinc(x):
    y = math.pi * x
    return 1.0 - y * y / 6.0 if abs(y) < 1e-4 else math.sin(y) / y


@njit(error_model="numpy")
def _cycles(turn):
    angle = _TWO_PI * (turn - math.floor(turn))
    return complex(math.cos(angle), math.sin(angle))


@njit(cache=True, nogil=True, error_model="numpy")
def line_sequence(cw, k, epoch0, integration_s, line_hz, phase0_code, signs, out):
    """Open-loop amplitude of a CW through code line ``k``, per epoch, without the line's own coefficient.

    out[e] = A s_e sinc((f - k f_R) T) exp(2 pi i (psi(t) - k (f_R t + p0 / L))), t mid-interval.
    ``cw`` = (f_hz, rate_hz_s, phase_cycles, amplitude, start_s, end_s); ``out`` complex64 (E,).
    """
    periods = line_hz * integration_s
    for e in range(out.shape[0]):
        half = epoch0 + e + 0.5
        t = half * integration_s
        if t < cw[4] or t >= cw[5]:
            out[e] = 0.0
            continue
        f = cw[0] + cw[1] * t
        turn_k = periods * half
        turn = cw[2] + (cw[0] + 0.5 * cw[1] * t) * t - k * (turn_k - math.floor(turn_k) + phase0_code)
        out[e] = signs[e] * cw[3] * _sinc((f - k * line_hz) * integration_s) * _cycles(turn)


@njit(error_model="numpy")
def _code_error(z, i_e, i_p, i_l, inv_slope):
    """Dot product, normalised: Re((E - L) conj P) / (slope |P|^2), chips (Kaplan & Hegarty 2006, table 5.5)."""
    p = z[i_p]
    d = z[i_e] - z[i_l]
    power = p.real * p.real + p.imag * p.imag
    return (d.real * p.real + d.imag * p.imag) * inv_slope / power if power > 0.0 else 0.0


@njit(error_model="numpy")
def _phase_error(p, kind):
    """Costas discriminator, cycles: kind 0 atan(Q / I), kind 1 dot product Q I / |P|^2."""
    if kind == 0:
        return math.atan(p.imag / p.real) / _TWO_PI if p.real != 0.0 else 0.25
    return p.imag * p.real / (p.real * p.real + p.imag * p.imag) / _TWO_PI


@njit(error_model="numpy")
def _add_lines(z, cw, first_k, n_k, row0, vectors, geometry, half, theta, freq, tau, tau_rate, sign):
    """Add one CW to the taps: the five code lines nearest to it, phases mid-interval (see ``closed_loop``)."""
    integration_s = geometry[0]
    line_hz = geometry[1] + tau_rate / geometry[2]
    t = half * integration_s
    f = cw[0] + cw[1] * t - freq
    turn_k = geometry[1] * integration_s * half
    turn_k = turn_k - math.floor(turn_k) + (tau + geometry[3]) / geometry[2]
    turn = cw[2] + (cw[0] + 0.5 * cw[1] * t) * t - theta
    centre = int(round(f / line_hz))
    for k in range(max(centre - 2, first_k), min(centre + 3, first_k + n_k)):
        gain = sign * cw[3] * _sinc((f - k * line_hz) * integration_s)
        if abs(gain) < 1e-9:
            continue
        a = np.complex64(gain * _cycles(turn - k * turn_k))
        row = row0 + k - first_k
        for i in range(z.shape[0]):
            z[i] += a * vectors[row, i]


@njit(cache=True, nogil=True, error_model="numpy")
def closed_loop(
    state,
    epoch0,
    steer,
    truth,
    signs,
    wiped,
    noise,
    acf,
    taps,
    echo_gain,
    echo_chips,
    cws,
    cw_lines,
    vectors,
    slow_k,
    slow_row,
    slow,
    geometry,
    loop,
    out,
    corr,
):
    """One block of epochs of one channel: correlator outputs, discriminators, loops.

    z_d = D sinc(f_e T) e^{2 pi i th_e} [R(d - eps) + sum_i g_i R(d - eps + tau_i)] + CW, NBI + noise, with
    eps = tau - tau^, th_e = theta - theta^ at mid-interval; R the periodic autocorrelation; d > 0 early.
    CW: sum_k A conj(c_k) sinc((f_J - f^ - k f_R^) T) e^{2 pi i (psi - theta^ - k (f_R t + (tau^ + d) / L))}.
    Loops: rate = K1 e + K2 S e + K3 SS e, the phase advances by the mean of old and new rate (Stephens & Thomas
    1995, rate-only feedback); code: first order with carrier aiding.

    Parameters
    ----------
    state : float64 (6,)
        theta^ (cycles), rate (cycles per epoch), S e, SS e, tau^ (chips), code rate (chips per epoch).
    steer : float64 (E, 3) or (0, 3)
        theta^, f^ (Hz), tau^ of every epoch: replaces the loops.
    truth : float64 (E, 3)
        theta (cycles), f (Hz), tau (chips) at mid-interval, deviations from nominal.
    signs, wiped : float32 (E,), bool
        Data signs; wiped: the channel removes them again (then jammers carry them).
    noise : float32 (2 E, K), rows in-phase then quadrature.
    acf : float64 (n,), one period.
    echo_gain, echo_chips : complex64, float64 (n_echo, E)
        Gain relative to the direct path, excess delay >= 0.
    cws : float64 (n_cw, 6), cw_lines : int64 (n_cw, 3) first k, number of lines, first row of ``vectors``.
    vectors : complex64 (rows, K)
        conj(c_k) e^{-2 pi i k d / L}.
    slow_k, slow_row, slow : int64 (n,), int64 (n,), complex64 (n, E)
        Lines with given open-loop sequences (narrow-band noise).
    geometry : float64 (6,)
        T (s), f_R (Hz), L (chips), code phase at t = 0 (chips), table points per chip, cycles per chip.
    loop : float64 (9,)
        K1, K2, K3, K_code, 1 / slope, index of E, P, L, phase discriminator kind.
    out : float64 (E, TWIN_COLUMNS)
        eps (chips), th_e (cycles), f_e (Hz), code and phase discriminator, prompt I and Q, tau^, theta^, f^, sign.
    corr : complex64 (E, K)
    """
    n, n_taps = corr.shape
    per_chip = geometry[4]
    integration_s = geometry[0]
    i_e, i_p, i_l, kind = int(loop[5]), int(loop[6]), int(loop[7]), int(loop[8])
    z = np.empty(n_taps, np.complex64)
    for e in range(n):
        if steer.shape[0]:
            state[0], state[1], state[4] = steer[e, 0], steer[e, 1] * integration_s, steer[e, 2]
            state[5] = state[1] / geometry[5]
        theta, tau = state[0], state[4]
        freq, tau_rate = state[1] / integration_s, state[5] / integration_s
        eps, th_e, f_e = truth[e, 2] - tau, truth[e, 0] - theta, truth[e, 1] - freq
        sign = signs[e]
        direct = _sinc(f_e * integration_s) * _cycles(th_e) * (1.0 if wiped else sign)
        for i in range(n_taps):
            d = taps[i] - eps
            s = complex(acf_at(acf, per_chip, d), 0.0)
            for m in range(echo_gain.shape[0]):
                s += echo_gain[m, e] * acf_at(acf, per_chip, d + echo_chips[m, e])
            z[i] = direct * s + complex(noise[e, i], noise[n + e, i])
        half = epoch0 + e + 0.5
        t = half * integration_s
        jam_sign = sign if wiped else 1.0
        for j in range(cws.shape[0]):
            if cws[j, 4] <= t < cws[j, 5]:
                first, n_k, row0 = cw_lines[j, 0], cw_lines[j, 1], cw_lines[j, 2]
                _add_lines(
                    z, cws[j], first, n_k, row0, vectors, geometry, half, theta, freq, tau, tau_rate, jam_sign
                )
        for j in range(slow_k.shape[0]):
            a = np.complex64(jam_sign * slow[j, e] * _cycles(-theta - slow_k[j] * tau / geometry[2]))
            for i in range(n_taps):
                z[i] += a * vectors[slow_row[j], i]
        for i in range(n_taps):
            corr[e, i] = z[i]
        code = _code_error(z, i_e, i_p, i_l, loop[4])
        phase = _phase_error(z[i_p], kind)
        out[e, 0], out[e, 1], out[e, 2], out[e, 3], out[e, 4] = eps, th_e, f_e, code, phase
        out[e, 5], out[e, 6] = z[i_p].real, z[i_p].imag
        out[e, 7], out[e, 8], out[e, 9], out[e, 10] = tau, theta, freq, sign
        state[2] += phase
        state[3] += state[2]
        rate = loop[0] * phase + loop[1] * state[2] + loop[2] * state[3]
        step = 0.5 * (state[1] + rate)
        state[0] = theta + step
        state[1] = rate
        state[5] = rate / geometry[5]
        state[4] = tau + step / geometry[5] + loop[3] * code


@njit(cache=True, nogil=True, error_model="numpy")
def hatch_smooth(code_m, carrier_m, n_max, start, out):
    """Carrier smoothing of code: s_i = c_i / N + (N - 1) / N (s_{i-1} + phi_i - phi_{i-1}), N = min(i + 1, n_max).

    ``start`` > 0 continues as if that many epochs without error had gone before (Hatch 1982; RTCA DO-229D, 2.1.2.2).
    All float64 (n,), metres.
    """
    s = 0.0
    for i in range(code_m.shape[0]):
        n = min(i + 1 + start, n_max)
        previous = s + carrier_m[i] - (carrier_m[i - 1] if i else 0.0)
        s = code_m[i] / n + (n - 1) / n * previous if n > 1 else code_m[i]
        out[i] = s
