"""Kernels of the correlator-domain twin (``tracking.correlator_model``): noise, line sequences, closed loops.

Noise is a pure function of (key, block of epochs, tap). Blocks have ``BLOCK_EPOCHS`` epochs and start at
multiples of it, so results do not depend on how a run is cut.
"""

import math

import numpy as np
from numba import njit

from signals.kernels import noise_block
from signals.modulation import BLOCK
from tracking.discriminators import carrier_error_cycles, code_error

__all__ = [
    "BLOCK_EPOCHS",
    "TWIN_COLUMNS",
    "acf_at",
    "bit_signs",
    "closed_loop",
    "cw_sequences",
    "hatch_smooth",
    "normals_columns",
]

BLOCK_EPOCHS = BLOCK
"""Epochs per block; fixes the grouping of all sums."""
TWIN_COLUMNS = 11
"""Columns of the closed-loop kernel's output, see ``closed_loop``."""

_U = np.uint64
_F = np.float32
_GAMMA = _U(0x9E3779B97F4A7C15)
_M1 = _U(0xBF58476D1CE4E5B9)
_M2 = _U(0x94D049BB133111EB)
_STRIDE = _U(4096)  # noise blocks per block of epochs: more than any number of taps
_TWO_PI = 2.0 * math.pi
_PIECE = 64  # epochs


@njit(error_model="numpy")
def mix64(x):
    """Output function of splitmix64 (Steele, Lea, Flood 2014, section 4)."""
    x = (x ^ (x >> _U(30))) * _M1
    x = (x ^ (x >> _U(27))) * _M2
    return x ^ (x >> _U(31))


@njit(cache=True, nogil=True, error_model="numpy")
def normals_columns(key, block, hash1, hash2, out):
    """Fill ``out`` float32 (K, 2 E) with N(0, 1): columns 0..E-1 in-phase, E..2E-1 quadrature."""
    n = out.shape[1] // 2
    for k in range(out.shape[0]):
        noise_block(out[k, :n], out[k, n:], hash1, hash2, key, _U(block) * _STRIDE + _U(k), _F(1.0))


@njit(error_model="numpy")
def acf_at(table, per_chip, x_chips):
    """Periodic autocorrelation at ``x_chips``, linear between the points of ``table`` (``per_chip`` a
    chip).
    """
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
def cw_sequences(cw, centre, half_width, epoch0, integration_s, shift_s, signs, weights, out):
    """Open-loop time sequences of a CW, one for each of its tap vectors.

    Number r: s_e A p_r(u) e^{2 pi i psi(t)}, p_r = sum_j weights[j, r] T_j, u = (f T - centre) / half_width, t mid-interval -
    ``shift_s``; by rotation and recurrence from the first epoch. ``cw`` = (f_hz, rate_hz_s, phase_cycles, amplitude,
    start_s, end_s); ``weights`` complex64 (J, R); ``out`` float32 (2 R, 2 E): row 2 r in-phase | quadrature, row 2 r + 1 the
    same times i.
    """
    n = signs.shape[0]
    terms, ranks = weights.shape
    t = (epoch0 + 0.5) * integration_s - shift_s
    step_t2 = cw[1] * integration_s * integration_s
    z = _cycles(cw[2] + (cw[0] + 0.5 * cw[1] * t) * t)
    w = _cycles((cw[0] + cw[1] * t) * integration_s + 0.5 * step_t2)
    w2 = _cycles(step_t2)
    u = ((cw[0] + cw[1] * t) * integration_s - centre) / half_width
    du = step_t2 / half_width
    # In pieces: rows are then written in line, and the recurrence over the terms runs in vectors.
    work, sums = np.empty((5, _PIECE), np.float32), np.empty((2, ranks, _PIECE), np.float32)
    re, im, us, older, now = work[0], work[1], work[2], work[3], work[4]
    for begin in range(0, n, _PIECE):
        m = min(_PIECE, n - begin)
        for e in range(m):
            t = (epoch0 + begin + e + 0.5) * integration_s
            a = cw[3] * signs[begin + e] if cw[4] <= t < cw[5] else 0.0
            re[e], im[e], us[e], older[e], now[e] = z.real, z.imag, u, a * u, a  # T_-1 = T_1
            z *= w
            w *= w2
            u += du
        sums[:] = 0.0
        for j in range(terms):
            _add_term(sums, weights, j, work)
        for r in range(ranks):
            _turned(out, 2 * r, begin, m, sums, r, work)


@njit(error_model="numpy", fastmath={"contract"})
def _add_term(sums, weights, j, work):
    """Every sum with its share of T_j; then T_j+1 = 2 u T_j - T_j-1."""
    for r in range(weights.shape[1]):
        x, y = weights[j, r].real, weights[j, r].imag
        for e in range(_PIECE):
            i = _U(e)
            sums[0, r, i] += x * work[4, i]
            sums[1, r, i] += y * work[4, i]
    for e in range(_PIECE):
        i = _U(e)
        following = _F(2) * work[2, i] * work[4, i] - work[3, i]
        work[3, i] = work[4, i]
        work[4, i] = following


@njit(error_model="numpy", fastmath={"contract"})
def _turned(out, row, begin, m, sums, r, work):
    """A piece of a sequence under its carrier, and times i in the row below."""
    n = out.shape[1] // 2
    o, q = _U(begin), _U(n + begin)
    for e in range(m):
        i = _U(e)
        a, b, c, d = sums[0, r, i], sums[1, r, i], work[0, i], work[1, i]
        x, y = a * c - b * d, a * d + b * c
        out[row, o + i], out[row, q + i], out[row + 1, o + i], out[row + 1, q + i] = x, y, -y, x


@njit(error_model="numpy")
def _add_cw(z, cw, span, vectors, geometry, half, theta, freq, tau, sign):
    """Add one CW to the taps: phase at mid-interval, tap vector by its Chebyshev series in f T."""
    integration_s = geometry[0]
    t = half * integration_s - (tau + geometry[3]) / geometry[1]
    f = cw[0] + cw[1] * t
    u = (f - freq) * integration_s - span[0]
    u = min(max(u / span[1], -1.0), 1.0)
    a = sign * cw[3] * _cycles(cw[2] + (cw[0] + 0.5 * cw[1] * t) * t - theta)
    row, last = int(span[2]), int(span[2] + span[3])
    previous, now = u, 1.0
    while row < last:
        b = np.complex64(a * now)
        for i in range(z.shape[0]):
            z[i] += b * vectors[row, i]
        previous, now = now, 2.0 * u * now - previous
        row += 1


@njit(cache=True, nogil=True, error_model="numpy")
def closed_loop(
    state,
    epoch0,
    lo,
    hi,
    steered,
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
    spans,
    vectors,
    slow_hz,
    slow_vectors,
    slow,
    geometry,
    loop,
    out,
    corr,
):
    """Epochs lo..hi-1 of one block of one channel: correlator outputs, discriminators, loops.

    z_d = D sinc(f_e T) e^{2 pi i th_e} [R(d - eps) + sum_i g_i R(d - eps + tau_i)] + CW, NBI + noise, with
    eps = tau - tau^, th_e = theta - theta^ at mid-interval; R the periodic autocorrelation; d > 0 early.
    CW: A e^{2 pi i (psi(t) - theta^)} sum_k conj(c_k) sinc((f_J - f^) T - k N) e^{-2 pi i k (N / 2 + d / L)},
    N code periods in T, t = mid-interval - (tau^ + p0) / fc: integrations follow the replica's code.
    Loops as ``tracking.loops``: a += K3 e, v += K2 e + a, rate = v + K1 e; the phase advances by the mean of
    old and new rate, the code by the carrier's advance and K_code times its error.

    Parameters
    ----------
    state : float64 (5,)
        theta^ (cycles), rate (cycles per epoch), v, a, tau^ (chips).
    epoch0 : int
        First epoch of the block; arrays below are those of the whole block of E epochs.
    steered, steer : bool, float64 (E, 3)
        Where true, theta^ (cycles), f^ (Hz), tau^ (chips) of every epoch replace the loops.
    truth : float64 (E, 3)
        theta (cycles), f (Hz), tau (chips) at mid-interval, deviations from nominal.
    signs, wiped : float32 (E,), bool
        Data signs; wiped: the channel removes them again (then jammers carry them).
    noise : float32 (2 E, K)
        Rows in-phase, then quadrature.
    acf : float64 (n,)
        One period.
    echo_gain, echo_chips : complex64, float64 (n_echo, E)
        Gain relative to the direct path, excess delay >= 0.
    cws, spans : float64 (n_cw, 6), float64 (n_cw, 4)
        As ``cw_sequences``; centre and half width of f T, first row and number of rows of ``vectors``.
    vectors : complex64 (rows, K)
        Chebyshev coefficients of each CW's tap vector, f T beyond the span is held at its edge.
    slow_hz, slow_vectors, slow : float64 (n,), complex64 (n, K), complex64 (n, E)
        Components with given open-loop sequences around a frequency (narrow-band noise).
    geometry : float64 (6,)
        T (s), fc (Hz), L (chips), code phase at t = 0 (chips), table points per chip, cycles per chip.
    loop : float64 (10,)
        K1, K2, K3, K_code, chips per unit of the code discriminator, index of E, P, L, codes of the carrier
        and code discriminators.
    out : float64 (E, TWIN_COLUMNS)
        eps (chips), th_e (cycles), f_e (Hz), code (chips) and carrier (cycles) discriminator, prompt I and Q,
        tau^, theta^, f^, sign.
    corr : complex64 (E, K)
    """
    n, n_taps = corr.shape
    integration_s, per_chip = geometry[0], geometry[4]
    i_e, i_p, i_l = int(loop[5]), int(loop[6]), int(loop[7])
    zero = complex(0.0, 0.0)
    for e in range(lo, hi):
        if steered:
            state[0], state[1], state[4] = steer[e, 0], steer[e, 1] * integration_s, steer[e, 2]
        z = corr[e]
        theta, tau = state[0], state[4]
        freq = state[1] / integration_s
        eps, th_e, f_e = truth[e, 2] - tau, truth[e, 0] - theta, truth[e, 1] - freq
        sign = signs[e]
        direct = _sinc(f_e * integration_s) * _cycles(th_e) * (1.0 if wiped else sign)
        _add_signal(z, direct, eps, acf, per_chip, taps, echo_gain, echo_chips, e)
        for i in range(n_taps):
            z[i] += complex(noise[e, i], noise[n + e, i])
        half = epoch0 + e + 0.5
        jam_sign = sign if wiped else 1.0
        for j in range(cws.shape[0]):
            if cws[j, 4] <= half * integration_s < cws[j, 5]:
                _add_cw(z, cws[j], spans[j], vectors, geometry, half, theta, freq, tau, jam_sign)
        for j in range(slow_hz.shape[0]):
            a = np.complex64(jam_sign * slow[j, e] * _cycles(-theta - slow_hz[j] * tau / geometry[1]))
            for i in range(n_taps):
                z[i] += a * slow_vectors[j, i]
        p = z[i_p]
        code = loop[4] * code_error(int(loop[9]), zero, complex(z[i_e]), complex(p), complex(z[i_l]), zero)
        phase = carrier_error_cycles(int(loop[8]), float(p.real), float(p.imag))
        out[e, 0], out[e, 1], out[e, 2], out[e, 3], out[e, 4] = eps, th_e, f_e, code, phase
        out[e, 5], out[e, 6], out[e, 7], out[e, 8] = p.real, p.imag, tau, theta
        out[e, 9], out[e, 10] = freq, sign
        _advance(state, phase, code, loop, geometry[5])


@njit(error_model="numpy")
def _add_signal(z, direct, eps, acf, per_chip, taps, echo_gain, echo_chips, e):
    """Direct path and echoes of one epoch into the taps ``z`` (overwritten)."""
    for i in range(z.shape[0]):
        z[i] = direct * acf_at(acf, per_chip, taps[i] - eps)
    for m in range(echo_gain.shape[0]):
        a = direct * echo_gain[m, e]
        for i in range(z.shape[0]):
            z[i] += a * acf_at(acf, per_chip, taps[i] - eps + echo_chips[m, e])


@njit(error_model="numpy")
def _advance(state, phase, code, loop, cycles_per_chip):
    """Loop filters and NCOs of ``closed_loop``, one epoch on."""
    state[3] += loop[2] * phase
    state[2] += loop[1] * phase + state[3]
    rate = state[2] + loop[0] * phase
    step = 0.5 * (state[1] + rate)
    state[0] += step
    state[1] = rate
    state[4] += step / cycles_per_chip + loop[3] * code


@njit(cache=True, nogil=True, error_model="numpy")
def hatch_smooth(code_m, carrier_m, n_max, start, out):
    """Carrier smoothing of code: s_i = c_i / N + (N - 1) / N (s_{i-1} + phi_i - phi_{i-1}), N = min(i + 1,
    n_max).

    ``start`` > 0 continues as if that many epochs without error had gone before (Hatch 1982; RTCA DO-229D,
    2.1.2.2). All float64 (n,), metres.
    """
    s = 0.0
    for i in range(code_m.shape[0]):
        n = min(i + 1 + start, n_max)
        previous = s + carrier_m[i] - (carrier_m[i - 1] if i else 0.0)
        s = code_m[i] / n + (n - 1) / n * previous if n > 1 else code_m[i]
        out[i] = s
