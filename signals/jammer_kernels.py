"""Kernels of the jammers: a carrier times an envelope, added to blocks of the synthesis while they are in the cache.

Like satellites, jammers are evaluated on whole blocks that start at multiples of BLOCK, and nothing is carried from
block to block. Over a cell of time the carrier phase is a cubic; its base table turns every SUB samples. Where the
frequency moves too fast for that, and over long sweeps, phases are quadratic (`_quadratic`).
"""

import math

import numpy as np
from numba import njit

from signals.kernels import (
    _FAST,
    SUB,
    _add_one,
    _add_rest,
    _carrier_bases,
    _cis,
    _float,
    _prefetch,
    _splitmix64,
    add_noise,
    noise_span,
)
from signals.modulation import BLOCK

__all__ = [
    "CHIRP",
    "CODE",
    "DOUBLINGS",
    "JAMMER",
    "NARROW",
    "N_TAPS",
    "PULSES",
    "SWEEP",
    "TONE",
    "WAVE_SCALE",
    "WIDE",
    "WORK",
    "add_jammers",
    "add_tone",
    "carriers",
    "tone",
]

TONE, SWEEP, CHIRP, PULSES, CODE, WIDE, NARROW = range(7)
"""Kinds of envelopes: 1; a long sweep; a short sweep from a table; pulses; a code; white noise; a band of noise."""

JAMMER = np.dtype(
    [
        ("kind", "i8"),
        ("n_on", "i8"),  # first sample at which it is on, and the first at which it is off again
        ("n_off", "i8"),
        ("seed", "u8"),
        ("period", "f8"),  # samples: of a sweep, of the slot of a pulse, of the code
        ("sweep", "f8"),  # width of the sweep, cycles per sample
        ("triangular", "i8"),
        ("carrier", "f8"),  # CHIRP: the carrier in the table, cycles per sample
        ("width", "f8"),  # samples: of a rectangle; standard deviation of a Gaussian pulse
        ("pair", "f8"),  # samples between the pulses of a pair; 0: single pulses
        ("gaussian", "i8"),
        ("random", "i8"),
        ("table", "i8"),  # offset in the flat buffer of codes (CODE), waves (CHIRP) or taps (NARROW)
        ("rows", "i8"),
        ("columns", "i8"),
        ("phases", "i8"),  # NARROW: outputs of the filter per lattice point, 1 or 2
        ("step", "i8"),  # samples between these, a power of two
    ]
)
"""What is constant about a jammer."""

N_TAPS = 12
"""Lattice points under the interpolation filter of narrow-band noise."""
LANES = 64
"""Samples under one table of a quadratic phase."""
STEADY = 1e-5
"""Cycles by which a base table may miss the carrier at its edges."""
WAVE_SCALE = 32767.0
"""Unit amplitude in the int16 tables of waves."""
WORK = 16, BLOCK + 64
"""Shape of the scratch rows that the caller provides."""
DOUBLINGS = 64
"""Steps up to this are crossed by doubling, longer ones by one doubling and cubics."""
HALFWAY = (0.599704, -0.120899, 0.021921)
"""Half-way interpolator of least error up to 0.222 of the rate: images below -62 dB."""
_F = np.float32
_I = np.int32
_U = np.uint32
_Q = np.uint64
_TURN = 4294967296.0
_GOLDEN = 0x9E3779B97F4A7C15


@njit(cache=True, nogil=True)
def _turns(cycles):
    """Cycles as a 32-bit fraction of a turn."""
    return _U(np.int64(np.floor((cycles - np.floor(cycles)) * _TURN + 0.5)) & 0xFFFFFFFF)


@njit(cache=True, nogil=True, fastmath=_FAST)
def _piece(out_i, out_q, k0, n, p32, f32, h32):
    """exp(2 pi i (p + f j + h j^2)), j < n, into out[k0 + j].

    Polynomials of sine and cosine of half the angle: those of ``signals.kernels.noise_span``.
    """
    for m in range(n):
        j, k = _U(m), _Q(m) + _Q(k0)
        phase = _U(p32 + j * _U(f32 + _U(j * h32)))
        a = _F(_I(phase)) * _F(2.0**-32)
        a2 = a * a
        s = a * (_F(3.14158203) + a2 * (_F(-5.16714292) + a2 * (_F(2.5419) + a2 * _F(-0.554638688))))
        c = _F(0.999999953) + a2 * (
            _F(-4.93479286) + a2 * (_F(4.05841194) + a2 * (_F(-1.33188034) + a2 * _F(0.219697149)))
        )
        out_i[k] = _F(1) - _F(2) * s * s
        out_q[k] = _F(2) * s * c


@njit(cache=True, nogil=True)
def tone(out_i, out_q, k0, k1, p, f, h):
    """exp(2 pi i (p + f j + h j^2)), j = k - k0, for k0 <= k < k1; error below 6e-5.

    In pieces of SUB, over which the rounding of h to 2^-32 moves the phase by 8e-6 cycles at most.
    """
    for begin in range(0, k1 - k0, SUB):
        n = min(SUB, k1 - k0 - begin)
        here = p + begin * (f + h * begin)
        _piece(out_i, out_q, k0 + begin, n, _turns(here), _turns(f + 2.0 * h * begin), _turns(h))


@njit(cache=True, nogil=True)
def add_tone(iq, n0, freq, level):
    """iq += level exp(2 pi i freq n), n = n0, n0 + 1, ..: float32 (2, n), ``freq`` in cycles per sample."""
    c, s = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    n1 = n0 + iq.shape[1]
    for block in range(n0 // BLOCK, (n1 - 1) // BLOCK + 1):
        first = block * BLOCK
        tone(c, s, 0, BLOCK, freq * first, freq, 0.0)
        for n in range(max(n0, first), min(n1, first + BLOCK)):
            iq[0, n - n0] += level * c[n - first]
            iq[1, n - n0] += level * s[n - first]


# -- carriers --------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True, fastmath=_FAST)
def _rotations(rot_i, rot_q, carrier, level, n_start, n_cell):
    """level exp(j carrier phase) in the middle of every sub-block; level (J, 1) or one column per sub-block."""
    n_sub = len(rot_i) // max(len(carrier), 1)
    last = level.shape[1] - 1
    for c in range(len(carrier)):
        p0, p1, p2, p3 = carrier[c, 0], carrier[c, 1], carrier[c, 2], carrier[c, 3]
        for j in range(n_sub):
            x = (n_start + SUB // 2 + SUB * j) / n_cell
            re, im = _cis(p0 + x * (p1 + x * (p2 + x * p3)))
            a = level[c, min(j, last)]
            rot_i[c * n_sub + j] = a * _F(re)
            rot_q[c * n_sub + j] = a * _F(im)


@njit(cache=True, nogil=True, forceinline=True)
def _at(carrier, c, x, n_cell):
    """Phase (cycles), frequency (per sample) and half its rate at place x of the cell."""
    p0, p1, p2, p3 = carrier[c, 0], carrier[c, 1], carrier[c, 2], carrier[c, 3]
    p = p0 + x * (p1 + x * (p2 + x * p3))
    f = (p1 + x * (2.0 * p2 + 3.0 * x * p3)) / n_cell
    return p, f, (p2 + 3.0 * x * p3) / (n_cell * n_cell)


@njit(cache=True, nogil=True, forceinline=True)
def _moves(carrier, c, n_cell):
    """True where the frequency moves too far in the cell for one base table."""
    return (abs(carrier[c, 2]) + 1.5 * abs(carrier[c, 3])) * (SUB / 2) > STEADY * n_cell


@njit(cache=True, nogil=True, fastmath=_FAST)
def _add_steady(out_i, out_q, base, at_base, rot_i, rot_q, at_rot, begin, end):
    """out[begin .. end) += rot base."""
    b = _Q(at_base)
    for sub in range(begin // SUB, (end - 1) // SUB + 1):
        re, im = rot_i[at_rot + sub], rot_q[at_rot + sub]
        k0, k1 = max(begin, sub * SUB), min(end, (sub + 1) * SUB)
        o, c = _Q(k0), b + _Q(k0 - sub * SUB)
        for m in range(k1 - k0):
            k = _Q(m)
            x = base[c + k]
            y = base[c + k + _Q(SUB)]
            out_i[o + k] += re * x - im * y
            out_q[o + k] += re * y + im * x


@njit(cache=True, nogil=True, fastmath=_FAST)
def _add_turned(out_i, out_q, x_i, x_q, at, base, at_base, rot_i, rot_q, at_rot):
    """out += rot base x over a block, x complex and from ``at`` on."""
    b = _Q(at_base)
    for sub in range(BLOCK // SUB):
        o, re, im = _Q(sub * SUB), rot_i[at_rot + sub], rot_q[at_rot + sub]
        for m in range(SUB):
            k = _Q(m)
            x = base[b + k]
            y = base[b + k + _Q(SUB)]
            c, s = re * x - im * y, re * y + im * x
            u, v = x_i[_Q(at) + o + k], x_q[_Q(at) + o + k]
            out_i[o + k] += u * c - v * s
            out_q[o + k] += u * s + v * c


# -- sweeps ----------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True, fastmath=_FAST)
def _turn_on(out_i, out_q, k0, n, w_i, w_q, e_i, e_q, re, im):
    """out[k0 + j] += (re + i im) w[j], then w[j] *= e[j], j < n."""
    o = _Q(k0)
    for m in range(n):
        k = _Q(m)
        x, y, c, s = w_i[k], w_q[k], e_i[k], e_q[k]
        out_i[o + k] += re * x - im * y
        out_q[o + k] += re * y + im * x
        w_i[k] = x * c - y * s
        w_q[k] = x * s + y * c


@njit(cache=True, nogil=True, fastmath=_FAST)
def _turn_four(out_i, out_q, k0, w_i, w_q, e_i, e_q, r_i, r_q, a, level):
    """Four turns of it at once, which read and write the table once."""
    o = _Q(k0)
    c0, c1, c2, c3 = level * r_i[a], level * r_i[a + 1], level * r_i[a + 2], level * r_i[a + 3]
    s0, s1, s2, s3 = level * r_q[a], level * r_q[a + 1], level * r_q[a + 2], level * r_q[a + 3]
    for m in range(LANES):
        k = _Q(m)
        x, y, c, s = w_i[k], w_q[k], e_i[k], e_q[k]
        out_i[o + k] += c0 * x - s0 * y
        out_q[o + k] += c0 * y + s0 * x
        x, y = x * c - y * s, x * s + y * c
        out_i[o + k + _Q(LANES)] += c1 * x - s1 * y
        out_q[o + k + _Q(LANES)] += c1 * y + s1 * x
        x, y = x * c - y * s, x * s + y * c
        out_i[o + k + _Q(2 * LANES)] += c2 * x - s2 * y
        out_q[o + k + _Q(2 * LANES)] += c2 * y + s2 * x
        x, y = x * c - y * s, x * s + y * c
        out_i[o + k + _Q(3 * LANES)] += c3 * x - s3 * y
        out_q[o + k + _Q(3 * LANES)] += c3 * y + s3 * x
        w_i[k] = x * c - y * s
        w_q[k] = x * s + y * c


@njit(cache=True, nogil=True)
def _quadratic(out_i, out_q, k0, k1, p, f, h, level, at_level, work):
    """out[k0 + j] += level exp(2 pi i (p + f j + h j^2)), k0 + j < k1 <= k0 + BLOCK.

    With j = LANES a + b the phase is (p + LANES f a + LANES^2 h a^2) + (f b + h b^2) + 2 LANES h a b: a scalar per a, a
    table over b, and a factor that turns the table from a to a + 1.
    """
    w_i, w_q, e_i, e_q, r_i, r_q = work[0], work[1], work[2], work[3], work[4], work[5]
    n, last = k1 - k0, len(level) - 1
    _piece(w_i, w_q, 0, min(LANES, n), _U(0), _turns(f), _turns(h))
    _piece(e_i, e_q, 0, min(LANES, n), _U(0), _turns(2.0 * LANES * h), _U(0))
    _piece(r_i, r_q, 0, 16, _turns(p), _turns(LANES * f), _turns(LANES * LANES * h))
    a = 0
    while a * LANES < n:
        k = k0 + a * LANES
        now = level[min(at_level + k // SUB, last)]
        if n - a * LANES >= SUB:
            _turn_four(out_i, out_q, k, w_i, w_q, e_i, e_q, r_i, r_q, a, now)
            a += SUB // LANES
        else:
            here = min(LANES, n - a * LANES)
            _turn_on(out_i, out_q, k, here, w_i, w_q, e_i, e_q, now * r_i[a], now * r_q[a])
            a += 1


@njit(cache=True, nogil=True, forceinline=True)
def _sweep(out_i, out_q, first, jammer, p, f, h, level, at_level, work):
    """Saw-tooth or triangle about the carrier: -B/2 .. B/2 in a period, the phase continuous."""
    k, period = 0, jammer.period
    while k < BLOCK:
        n = first + k
        turn = np.floor(n / period)
        last = np.int64(np.ceil((turn + 1.0) * period))
        if last <= n:
            turn += 1.0
            last = np.int64(np.ceil((turn + 1.0) * period))
        end = min(last - first, BLOCK)
        tau = max(n - turn * period, 0.0)
        sign = -1.0 if jammer.triangular and np.int64(turn) % 2 == 1 else 1.0
        rate, edge = sign * jammer.sweep / period, 0.5 * sign * jammer.sweep
        here = p + k * (f + h * k) + tau * (0.5 * rate * tau - edge)
        freq = f + 2.0 * h * k + rate * tau - edge
        _quadratic(out_i, out_q, k, end, here, freq, h + 0.5 * rate, level, at_level, work)
        k = end


@njit(cache=True, nogil=True, fastmath=_FAST)
def _add_wave(out_i, out_q, waves, at, size, level, at_level, re, im):
    """out += level (re + i im) wave, whose imaginary part lies ``size`` values further on; level per sub-block."""
    for sub in range(BLOCK // SUB):
        o, w, v = _Q(sub * SUB), _Q(at + sub * SUB), _Q(at + size + sub * SUB)
        a = level[min(at_level + sub, len(level) - 1)] * _F(1.0 / WAVE_SCALE)
        c, s = a * re, a * im
        for m in range(SUB):
            k = _Q(m)
            x, y = _F(waves[w + k]), _F(waves[v + k])
            out_i[o + k] += c * x - s * y
            out_q[o + k] += c * y + s * x


@njit(cache=True, nogil=True, forceinline=True)
def _chirp(out_i, out_q, first, jammer, p, level, at_level, waves):
    """Sweeps from a table whose rows begin 1 / rows of a sample apart and hold the carrier as well.

    In the middle of the block the phase is exact where the sweeps are longer than a block.
    """
    period = jammer.period * (2.0 if jammer.triangular else 1.0)
    since = first - np.floor(first / period) * period
    q = np.int64(since * jammer.rows + 0.5)
    column, row = q // jammer.rows, q % jammer.rows
    late = since - q / jammer.rows
    turn = np.floor((since + BLOCK // 2) / jammer.period)
    freq = jammer.sweep * ((since + BLOCK // 2) / jammer.period - turn - 0.5)
    sign = -1.0 if jammer.triangular and turn == 1.0 else 1.0
    shift = late * sign * freq if jammer.period > BLOCK else 0.0
    re, im = _cis(p - jammer.carrier * (q / jammer.rows) + shift)
    size = jammer.rows * jammer.columns
    at = jammer.table + row * jammer.columns + column
    _add_wave(out_i, out_q, waves, at, size, level, at_level, _F(re), _F(im))
    since = first + BLOCK - np.floor((first + BLOCK) / period) * period
    q = np.int64(since * jammer.rows + 0.5)
    at = jammer.table + (q % jammer.rows) * jammer.columns + q // jammer.rows
    for line in range(0, BLOCK, 32):
        _prefetch(waves, at + line)
        _prefetch(waves, at + size + line)


# -- pulses and codes ------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _uniform(seed, index):
    """A number in [0, 1) that belongs to (seed, index)."""
    z = _splitmix64(seed + (_Q(index) + _Q(1)) * _Q(_GOLDEN))
    return np.float64(z >> _Q(11)) * 2.0**-53


@njit(cache=True, nogil=True, fastmath=_FAST)
def _bell(out, n, begin, slope):
    """exp(-u^2 / 2), u = begin + slope k, k < n, |u| < 12: 2^y = 2^floor(y) times a polynomial, error 3e-6."""
    for m in range(n):
        u = begin + slope * _F(_I(m))
        y = _F(-0.72134752) * u * u
        whole = np.floor(y)
        x = y - whole
        power = _F(1) + x * (
            _F(0.69315169)
            + x * (_F(0.24015036) + x * (_F(0.055871698) + x * (_F(0.0089369) + x * _F(0.0018894))))
        )
        out[m] = power * _float(_I((_I(whole) + _I(127)) << _I(23)))


@njit(cache=True, nogil=True, fastmath=_FAST)
def _add_bell(out_i, out_q, bell, k0, k1, base, at_base, rot_i, rot_q, at_rot):
    """out[k0 + j] += bell[j] rot base."""
    for sub in range(k0 // SUB, (k1 - 1) // SUB + 1):
        re, im = rot_i[at_rot + sub], rot_q[at_rot + sub]
        begin, end = max(k0, sub * SUB), min(k1, (sub + 1) * SUB)
        o, b, c = _Q(begin), _Q(begin - k0), _Q(at_base + begin - sub * SUB)
        for m in range(end - begin):
            k = _Q(m)
            x = base[c + k]
            y = base[c + k + _Q(SUB)]
            out_i[o + k] += bell[b + k] * (re * x - im * y)
            out_q[o + k] += bell[b + k] * (re * y + im * x)


@njit(cache=True, nogil=True, forceinline=True)
def _pulses(out_i, out_q, first, jammer, base, at_base, rot_i, rot_q, at_rot, work):
    """One pulse or pulse pair in every slot; only its samples are touched."""
    reach = 5.0 * jammer.width if jammer.gaussian else 0.0
    length = 2.0 * reach if jammer.gaussian else jammer.width
    slot = np.int64(first / jammer.period) - 1
    while slot * jammer.period < first + BLOCK:
        begin = slot * jammer.period
        if jammer.random:
            begin += (jammer.period - jammer.pair - length) * _uniform(jammer.seed, slot + 1)
        for _ in range(2 if jammer.pair > 0.0 else 1):
            k0 = max(np.int64(np.ceil(begin - 1e-6)) - first, 0)
            k1 = min(np.int64(np.ceil(begin + length - 1e-6)) - first, BLOCK)
            if k1 > k0 and jammer.gaussian:
                slope = 1.0 / jammer.width
                _bell(work[0], k1 - k0, _F((first + k0 - begin - reach) * slope), _F(slope))
                _add_bell(out_i, out_q, work[0], k0, k1, base, at_base, rot_i, rot_q, at_rot)
            elif k1 > k0:
                _add_steady(out_i, out_q, base, at_base, rot_i, rot_q, at_rot, k0, k1)
            begin += jammer.pair
        slot += 1


@njit(cache=True, nogil=True, forceinline=True)
def _code(out_i, out_q, first, jammer, base, at_base, rot_i, rot_q, at_rot, codes):
    """A long code, rows 1 / rows of a sample apart; a random sign every period."""
    turn = np.floor(first / jammer.period)
    q = np.int64((first - turn * jammer.period) * jammer.rows + 0.5)
    roll = np.int64(np.ceil(jammer.period - q / jammer.rows))
    at = jammer.table + (q % jammer.rows) * jammer.columns + q // jammer.rows
    sign = _F(1) if _uniform(jammer.seed, np.int64(turn)) < 0.5 else _F(-1)
    after = _F(1) if _uniform(jammer.seed, np.int64(turn) + 1) < 0.5 else _F(-1)
    _add_one(out_i, out_q, base, at_base, codes, at, roll, rot_i, rot_q, at_rot, sign, after)
    if roll < BLOCK and roll % SUB > 0 and after != sign:
        re, im = rot_i[at_rot + roll // SUB], rot_q[at_rot + roll // SUB]
        _add_rest(out_i, out_q, base, at_base, codes, at, -1, roll, re, im, after - sign, _F(0))


# -- noise -----------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True, forceinline=True)
def _white(out_i, out_q, first, jammer, level, at_level, hash1, hash2):
    """White Gaussian noise of power level^2, in I and Q together."""
    block, half, end = _Q(first // BLOCK), _F(math.sqrt(0.5)), BLOCK if len(level) == 1 else SUB
    for begin in range(0, BLOCK, end):
        a = half * level[min(at_level + begin // SUB, len(level) - 1)]
        add_noise(out_i, out_q, hash1, hash2, jammer.seed, block, a, begin, begin + end)


@njit(cache=True, nogil=True)
def _lattice(out_i, out_q, begin, n, hash1, hash2, seed):
    """Points begin .. begin + n - 1 of an endless row of white Gaussian numbers of unit power, n <= BLOCK + 64."""
    done = 0
    while done < n:
        block, k = (begin + done) // BLOCK, (begin + done) % BLOCK
        here = min(n - done, BLOCK - k)
        noise_span(out_i, out_q, done, hash1, hash2, seed, _Q(block), k, here, _F(math.sqrt(0.5)))
        done += here


@njit(cache=True, nogil=True, fastmath=_FAST)
def _six(out, x, at, taps, tap, n):
    """out[m] += sum over t < 6 of taps[tap + t] x[at + m + t], m < n."""
    t0, t1, t2 = taps[tap], taps[tap + 1], taps[tap + 2]
    t3, t4, t5 = taps[tap + 3], taps[tap + 4], taps[tap + 5]
    for m in range(n):
        k = _Q(m)
        j = _Q(at) + k
        sums = t0 * x[j] + t1 * x[j + _Q(1)] + t2 * x[j + _Q(2)]
        sums += t3 * x[j + _Q(3)] + t4 * x[j + _Q(4)] + t5 * x[j + _Q(5)]
        out[k] += sums


@njit(cache=True, nogil=True)
def _filter(out, x, taps, tap, n):
    """out[m] = sum over t < N_TAPS of taps[tap + t] x[m + t], m < n: six at a time, which stay in registers."""
    out[:n] = 0
    for t in range(0, N_TAPS, 6):
        _six(out, x, t, taps, tap + t, n)


@njit(cache=True, nogil=True, fastmath=_FAST)
def _interleave(out, even, odd, n):
    """out[2 m] = even[m], out[2 m + 1] = odd[m], m < n."""
    for m in range(n):
        k = _Q(m)
        out[_Q(2) * k] = even[k]
        out[_Q(2) * k + _Q(1)] = odd[k]


@njit(cache=True, nogil=True, fastmath=_FAST)
def _double(out, x, at, n):
    """Twice as many points: x[at + 2 ..] and, half-way between them, sums of six; 2 (n - 5) outputs."""
    for m in range(n - 5):
        k = _Q(m)
        j = _Q(at) + k
        c, d = x[j + _Q(2)], x[j + _Q(3)]
        out[_Q(2) * k] = c
        out[_Q(2) * k + _Q(1)] = (
            _F(HALFWAY[0]) * (c + d)
            + _F(HALFWAY[1]) * (x[j + _Q(1)] + x[j + _Q(4)])
            + _F(HALFWAY[2]) * (x[j] + x[j + _Q(5)])
        )


@njit(cache=True, nogil=True, fastmath=_FAST)
def _cubics(out, x, at, shift, step):
    """BLOCK points on the cubics through points ``step`` apart; the first lies ``shift`` after x[at + 1]."""
    k, j, inverse = 0, at, _F(1.0 / step)
    while k < BLOCK:
        n = min(step - shift, BLOCK - k)
        a, b, c, d = x[j], x[j + 1], x[j + 2], x[j + 3]
        # Lagrange through -1, 0, 1, 2
        c1 = c - b * _F(0.5) - a * _F(1.0 / 3.0) - d * _F(1.0 / 6.0)
        c2 = (a + c) * _F(0.5) - b
        c3 = (d - a) * _F(1.0 / 6.0) + (b - c) * _F(0.5)
        for m in range(n):
            u = _F(_I(_I(shift) + _I(m))) * inverse
            out[_Q(k) + _Q(m)] = b + u * (c1 + u * (c2 + u * c3))
        k, j, shift = k + n, j + 1, 0


@njit(cache=True, nogil=True, forceinline=True)
def _finer(work, x, a, jammer, first, at, n, taps):
    """Lattice points in row x -> the block's samples: the row (a or a + 1) and the place where they begin."""
    step = jammer.step
    if jammer.phases == 1:
        _filter(work[a], work[x], taps, jammer.table, n)
        return a, 0
    _filter(work[2], work[x], taps, jammer.table, n)
    _filter(work[3], work[x], taps, jammer.table + N_TAPS, n)
    _interleave(work[a], work[2], work[3], n)
    if step == 1:
        return a, 0
    if step > DOUBLINGS:
        _double(work[a + 1], work[a], at, BLOCK // step + 12)
        fine = step // 2
        _cubics(work[a], work[a + 1], first // fine - 2 * (first // step) + 3, first % fine, fine)
        return a, 0
    b, n = a + 1, BLOCK // step + 10
    while step > 1:
        _double(work[b], work[a], at, n)
        a, b, at, n, step = b, a, 0, 2 * (n - 5), step // 2
    return a, 4


@njit(cache=True, nogil=True, forceinline=True)
def _narrow(out_i, out_q, first, jammer, taps, base, at_base, rot_i, rot_q, at_rot, work, hash1, hash2):
    """A band of noise about the carrier: lattice, polyphase filter, doublings, and cubics where that is not enough."""
    phases, step = jammer.phases, jammer.step
    m0, at, n = first // phases, 0, BLOCK // phases
    if step > 1:  # four outputs of the filter before the block's own and eight after them
        j0 = first // step
        m0, at = j0 // 2 - 2, j0 % 2
        n = (at + BLOCK // step + 14) // 2
        n = (n + 7) // 8 * 8
    _lattice(work[0], work[1], m0 - N_TAPS // 2 + 1, n + N_TAPS, hash1, hash2, jammer.seed)
    i, at_i = _finer(work, 0, 4, jammer, first, at, n, taps)
    q, _ = _finer(work, 1, 6, jammer, first, at, n, taps)
    _add_turned(out_i, out_q, work[i], work[q], at_i, base, at_base, rot_i, rot_q, at_rot)


# -- all of them -----------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def carriers(base, rot_i, rot_q, carrier, level, n_start, n_cell):
    """Base tables and rotations of all jammers; of one whose frequency moves fast, those of no carrier."""
    still = carrier.copy()
    for c in range(len(carrier)):
        if _moves(carrier, c, n_cell):
            still[c] = 0.0
    _carrier_bases(base, still, n_cell)
    _rotations(rot_i, rot_q, still, level, n_start, n_cell)


@njit(cache=True, nogil=True, forceinline=True)
def _envelope(
    out_i, out_q, first, jammer, base, at_base, rot_i, rot_q, at_rot, codes, taps, work, hash1, hash2
):
    """What stands on a base table."""
    if jammer.kind == TONE:
        _add_steady(out_i, out_q, base, at_base, rot_i, rot_q, at_rot, 0, BLOCK)
    elif jammer.kind == PULSES:
        _pulses(out_i, out_q, first, jammer, base, at_base, rot_i, rot_q, at_rot, work)
    elif jammer.kind == CODE:
        _code(out_i, out_q, first, jammer, base, at_base, rot_i, rot_q, at_rot, codes)
    else:
        _narrow(out_i, out_q, first, jammer, taps, base, at_base, rot_i, rot_q, at_rot, work, hash1, hash2)


@njit(cache=True, nogil=True, forceinline=True)
def _moving(
    out_i, out_q, first, jammer, base, at_base, rot_i, rot_q, at_rot, codes, taps, p, f, h, work, hash1, hash2
):
    """An envelope under a carrier whose frequency moves fast."""
    x_i, x_q, c, s = work[10], work[11], work[12], work[13]
    x_i[:BLOCK] = 0
    x_q[:BLOCK] = 0
    _envelope(x_i, x_q, first, jammer, base, at_base, rot_i, rot_q, at_rot, codes, taps, work, hash1, hash2)
    tone(c, s, 0, BLOCK, p, f, h)
    for k in range(BLOCK):
        out_i[k] += x_i[k] * c[k] - x_q[k] * s[k]
        out_q[k] += x_i[k] * s[k] + x_q[k] * c[k]


@njit(cache=True, nogil=True, forceinline=True)
def _jammer(
    out_i,
    out_q,
    b,
    first,
    j,
    jammers,
    base,
    rot_i,
    rot_q,
    carrier,
    level,
    x,
    n_cell,
    codes,
    waves,
    taps,
    work,
    hash1,
    hash2,
):
    """One jammer over one block."""
    jammer, sub = jammers[j], b * (BLOCK // SUB)
    at_base, at_rot = 2 * SUB * j, len(rot_i) // len(jammers) * j + sub
    if jammer.kind == WIDE:
        _white(out_i, out_q, first, jammer, level[j], sub, hash1, hash2)
        return
    moves = _moves(carrier, j, n_cell)
    if not moves and jammer.kind != SWEEP and jammer.kind != CHIRP:
        _envelope(
            out_i, out_q, first, jammer, base, at_base, rot_i, rot_q, at_rot, codes, taps, work, hash1, hash2
        )
        return
    p, f, h = _at(carrier, j, x, n_cell)
    if jammer.kind == SWEEP:
        _sweep(out_i, out_q, first, jammer, p, f, h, level[j], sub, work)
    elif jammer.kind == CHIRP:
        _chirp(out_i, out_q, first, jammer, p, level[j], sub, waves)
    elif jammer.kind == TONE:
        _quadratic(out_i, out_q, 0, BLOCK, p, f, h, level[j], sub, work)
    else:
        _moving(
            out_i, out_q, first, jammer, base, at_base, rot_i, rot_q, at_rot, codes, taps, p, f, h, work, hash1, hash2
        )  # fmt: skip


@njit(cache=True, nogil=True, forceinline=True)
def add_jammers(
    buf_i, buf_q, b, n_first, jammers, base, rot_i, rot_q, carrier, level, n_start, n_cell, codes, waves, taps, work, hash1, hash2
):  # fmt: skip
    """Add all jammers to block ``b`` of a call that begins at sample ``n_first``, each where it is on."""
    first = n_first + b * BLOCK
    x = (n_start + b * BLOCK) / n_cell
    for j in range(len(jammers)):
        lo, hi = max(jammers[j].n_on - first, 0), min(jammers[j].n_off - first, BLOCK)
        if lo >= hi:
            continue
        whole = hi - lo == BLOCK
        to_i, to_q = (buf_i, buf_q) if whole else (work[14], work[15])
        if not whole:
            to_i[:BLOCK] = 0
            to_q[:BLOCK] = 0
        _jammer(
            to_i, to_q, b, first, j, jammers, base, rot_i, rot_q, carrier, level, x, n_cell, codes, waves, taps, work, hash1, hash2
        )  # fmt: skip
        if not whole:
            for k in range(lo, hi):
                buf_i[k] += to_i[k]
                buf_q[k] += to_q[k]
