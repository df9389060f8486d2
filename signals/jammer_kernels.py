"""Kernels of the jammers: a carrier times an envelope, added to blocks of the synthesis while they are in the cache.

Like satellites, jammers are evaluated on whole blocks that start at multiples of BLOCK, and nothing is carried from
block to block. Over a cell of time the carrier phase is a cubic; its base table turns every SUB samples. Where the
frequency moves too fast for that, and over long sweeps, phases are quadratic (`_quadratic`).
"""

from functools import lru_cache
from statistics import NormalDist

import numpy as np
from llvmlite import ir
from numba import njit, types

from signals.kernels import (
    _FAST,
    _GOLDEN,
    SUB,
    _add_one,
    _add_rest,
    _block_key,
    _carrier_bases,
    _cis,
    _float,
    _half_turns,
    _polynomials,
    _prefetch,
    _splitmix64,
    add_noise,
    intrinsic,
)
from signals.modulation import BLOCK

__all__ = [
    "CHIRP",
    "CODE",
    "DOUBLINGS",
    "JAMMER",
    "NARROW",
    "NORMALS",
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
    "normals",
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
        ("held", "i8"),  # CHIRP: 1 if the table holds the carrier, and that, cycles per sample
        ("carrier", "f8"),
        ("width", "f8"),  # samples: of a rectangle; standard deviation of a Gaussian pulse
        ("pair", "f8"),  # samples between the pulses of a pair; 0: single pulses
        ("gaussian", "i8"),
        ("random", "i8"),
        ("table", "i8"),  # offset in the flat buffer of codes (CODE), waves (CHIRP) or taps (NARROW)
        ("rows", "i8"),
        ("columns", "i8"),
        ("phases", "i8"),  # NARROW: outputs of the filter per lattice point, 1 to 3
        ("step", "i8"),  # samples between these, a power of two
    ]
)
"""What is constant about a jammer."""

N_TAPS = 9
"""Lattice points under the interpolation filter of narrow-band noise."""
NORMALS = 1 << 14
"""Gaussian numbers of variance 1/4 at the head of the taps, and BLOCK of them again, where there is narrow-band noise."""
LANES = 32
"""Samples under one table of a quadratic phase, which is a row of a block; lattice points whose signs share a word."""
STEADY = 1e-5
"""Cycles by which a base table may miss the carrier at its edges."""
WAVE_SCALE = 32767.0
"""Unit amplitude in the int16 tables of waves."""
WORK = 16, BLOCK + 128
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


@lru_cache(maxsize=1)
def normals() -> np.ndarray:
    """The head of the taps: NORMALS quantiles of N(0, 1/4) in random order, power exact, and BLOCK of them again."""
    quantile = np.array([NormalDist().inv_cdf((k + 0.5) / NORMALS) for k in range(NORMALS)])
    quantile *= 0.5 / np.sqrt(np.mean(quantile**2))
    table = np.random.default_rng(4).permutation(quantile).astype(np.float32)
    return np.concatenate([table, table[:BLOCK]])


@njit(cache=True, nogil=True)
def _turns(cycles):
    """Cycles as a 32-bit fraction of a turn."""
    return _U(np.int64(np.floor((cycles - np.floor(cycles)) * _TURN + 0.5)) & 0xFFFFFFFF)


# -- phases that are quadratic over a block --------------------------------------------------------------------------

# With j = LANES a + b, and (a', b') = (LANES a - BLOCK / 2, b - (LANES - 1) / 2), the phase p + f j + h j^2 is a sum of one
# of a, one of b and 2 h a' b': a scalar per a times a table over b, which turns from a to a + 1 where the product counts.
# Tables lie in one flat array: W over b, the W before it, 2 cos of its turn, and the scalars.
_W, _BEFORE, _SPIN, _ROW = 0, 2 * LANES, 4 * LANES, 6 * LANES


@njit(cache=True, nogil=True, fastmath=_FAST)
def _piece(t, at, n, p, f, h):
    """cos and sin of 2 pi (p + f j + h j^2), j < n, into t[at + j] and t[at + n + j]; error below 6e-5 for n <= 64."""
    p32, f32, h32, o = _turns(p), _turns(f), _turns(h), _Q(at)
    _, sine, cosine = _polynomials()
    for m in range(n):
        j, k = _U(m), _Q(m)
        phase = _U(p32 + j * _U(f32 + _U(j * h32)))
        s, c = _half_turns(_F(_I(phase)) * _F(2.0**-32), sine, cosine)
        t[o + k] = _F(1) - _F(2) * s * s
        t[o + k + _Q(n)] = _F(2) * s * c


@njit(cache=True, nogil=True, fastmath=_FAST)
def _add_part(out_i, out_q, x_i, x_q, begin, end):
    """out[begin .. end) += x."""
    for m in range(end - begin):
        k = _Q(begin) + _Q(m)
        out_i[k] += x_i[k]
        out_q[k] += x_q[k]


@njit(cache=True, nogil=True, fastmath=_FAST)
def _turning(t):
    """W of the row before from W and its turn; of the turn 2 cos is kept: W' = 2 cos W - W''."""
    for m in range(LANES):
        k = _Q(m)
        x, y, c, s = t[k], t[k + _Q(LANES)], t[k + _Q(_SPIN)], t[k + _Q(_SPIN + LANES)]
        t[k + _Q(_BEFORE)] = x * c + y * s
        t[k + _Q(_BEFORE + LANES)] = y * c - x * s
        t[k + _Q(_SPIN)] = c + c


@njit(cache=True, nogil=True, forceinline=True)
def _rows(t, a, level):
    """The scalars of four rows from a on."""
    re, im = _ROW + a, _ROW + BLOCK // LANES + a
    return (
        (level * t[re], level * t[re + 1], level * t[re + 2], level * t[re + 3]),
        (level * t[im], level * t[im + 1], level * t[im + 2], level * t[im + 3]),
    )


@njit(cache=True, nogil=True, fastmath=_FAST, forceinline=True)
def _put(out_i, out_q, k, re, im, x, y):
    out_i[k] += re * x - im * y
    out_q[k] += re * y + im * x


@njit(cache=True, nogil=True, fastmath=_FAST)
def _add_still(out_i, out_q, t, a, level):
    """Add four rows of a W that does not turn."""
    o = _Q(a * LANES)
    re, im = _rows(t, a, level)
    for m in range(LANES):
        k = _Q(m)
        x, y = t[k], t[k + _Q(LANES)]
        _put(out_i, out_q, o + k, re[0], im[0], x, y)
        _put(out_i, out_q, o + k + _Q(LANES), re[1], im[1], x, y)
        _put(out_i, out_q, o + k + _Q(2 * LANES), re[2], im[2], x, y)
        _put(out_i, out_q, o + k + _Q(3 * LANES), re[3], im[3], x, y)


@njit(cache=True, nogil=True, fastmath=_FAST)
def _add_turning(out_i, out_q, t, a, level):
    """Add four rows and turn W past them."""
    o = _Q(a * LANES)
    re, im = _rows(t, a, level)
    for m in range(LANES):
        k = _Q(m)
        x, y, f = t[k], t[k + _Q(LANES)], t[k + _Q(_SPIN)]
        u, v = t[k + _Q(_BEFORE)], t[k + _Q(_BEFORE + LANES)]
        _put(out_i, out_q, o + k, re[0], im[0], x, y)
        u, v = f * x - u, f * y - v
        _put(out_i, out_q, o + k + _Q(LANES), re[1], im[1], u, v)
        x, y = f * u - x, f * v - y
        _put(out_i, out_q, o + k + _Q(2 * LANES), re[2], im[2], x, y)
        u, v = f * x - u, f * y - v
        _put(out_i, out_q, o + k + _Q(3 * LANES), re[3], im[3], u, v)
        t[k + _Q(_BEFORE)], t[k + _Q(_BEFORE + LANES)] = u, v
        t[k], t[k + _Q(LANES)] = f * u - x, f * v - y


@njit(cache=True, nogil=True)
def _quadratic(out_i, out_q, p, f, h, level, at_level, t):
    """out[j] += level exp(2 pi i (p + f j + h j^2)), j < BLOCK; error below 7e-5 for h up to 1e-4."""
    still = abs(h) * (BLOCK * LANES // 2) < STEADY
    tilt, last = BLOCK * h if still else 0.0, len(level) - 1
    _piece(t, _W, LANES, 0.0, f + tilt, h)
    row = BLOCK // LANES
    _piece(t, _ROW, row, p - 0.5 * (LANES - 1) * tilt, LANES * (f + (LANES - 1) * h), LANES * LANES * h)
    if not still:
        _piece(t, _SPIN, LANES, -LANES * (LANES - 1) * h, 2.0 * LANES * h, 0.0)
        _turning(t)
    for a in range(0, row, 4):
        now = level[min(at_level + a * LANES // SUB, last)]
        if still:
            _add_still(out_i, out_q, t, a, now)
        else:
            _add_turning(out_i, out_q, t, a, now)


@njit(cache=True, nogil=True)
def add_tone(iq, n0, freq, level):
    """iq += level exp(2 pi i freq n), n = n0, n0 + 1, ..: float32 (2, n), ``freq`` in cycles per sample."""
    work, one = np.empty((3, BLOCK), np.float32), np.ones(1, np.float32)
    n1 = n0 + iq.shape[1]
    for block in range(n0 // BLOCK, (n1 - 1) // BLOCK + 1):
        first = block * BLOCK
        work[:2] = 0
        _quadratic(work[0], work[1], freq * first, freq, 0.0, one, 0, work[2])
        for n in range(max(n0, first), min(n1, first + BLOCK)):
            iq[0, n - n0] += level * work[0, n - first]
            iq[1, n - n0] += level * work[1, n - first]


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


@njit(cache=True, nogil=True, forceinline=True)
def _carrier(base, at, re, im):
    """Cosine and sine of rot base at one point."""
    x, y = base[at], base[at + _Q(SUB)]
    return re * x - im * y, re * y + im * x


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
            cosine, sine = _carrier(base, c + k, re, im)
            out_i[o + k] += cosine
            out_q[o + k] += sine


@njit(cache=True, nogil=True, fastmath=_FAST)
def _add_turned(out_i, out_q, x_i, x_q, at, base, at_base, rot_i, rot_q, at_rot):
    """out += rot base x over a block, x complex and from ``at`` on."""
    b = _Q(at_base)
    for sub in range(BLOCK // SUB):
        o, re, im = _Q(sub * SUB), rot_i[at_rot + sub], rot_q[at_rot + sub]
        for m in range(SUB):
            k = _Q(m)
            c, s = _carrier(base, b + k, re, im)
            u, v = x_i[_Q(at) + o + k], x_q[_Q(at) + o + k]
            out_i[o + k] += u * c - v * s
            out_q[o + k] += u * s + v * c


# -- sweeps ----------------------------------------------------------------------------------------------------------


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
        tau = first - turn * period
        sign = -1.0 if jammer.triangular and np.int64(turn) % 2 == 1 else 1.0
        rate, edge = sign * jammer.sweep / period, 0.5 * sign * jammer.sweep
        here, freq, bend = p + tau * (0.5 * rate * tau - edge), f + rate * tau - edge, h + 0.5 * rate
        if end - k == BLOCK:
            _quadratic(out_i, out_q, here, freq, bend, level, at_level, work[0])
        else:
            work[1:3] = 0
            _quadratic(work[1], work[2], here, freq, bend, level, at_level, work[0])
            _add_part(out_i, out_q, work[1], work[2], k, end)
        k = end


@njit(cache=True, nogil=True, fastmath=_FAST)
def _add_wave(out_i, out_q, waves, at, size, level, at_level, re, im):
    """out += level (re + i im) wave, whose imaginary part lies ``size`` values further on; level per sub-block."""
    step = SUB if len(level) > 1 else BLOCK
    for begin in range(0, BLOCK, step):
        o, w, v = _Q(begin), _Q(at + begin), _Q(at + size + begin)
        a = level[min(at_level + begin // SUB, len(level) - 1)] * _F(1.0 / WAVE_SCALE)
        c, s = a * re, a * im
        for m in range(step):
            k = _Q(m)
            x, y = _F(waves[w + k]), _F(waves[v + k])
            out_i[o + k] += c * x - s * y
            out_q[o + k] += c * y + s * x


@njit(cache=True, nogil=True, forceinline=True)
def _chirp(out_i, out_q, first, jammer, p, level, at_level, waves):
    """Sweeps from a table whose rows begin 1 / rows of a sample apart and may hold the carrier as well.

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
            cosine, sine = _carrier(base, c + k, re, im)
            out_i[o + k] += bell[b + k] * cosine
            out_q[o + k] += bell[b + k] * sine


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


@intrinsic
def _flipped(typingctx, x, word, place):
    """``x`` with its sign changed where bit 31 - place of ``word`` is set."""

    def codegen(ctx, b, sig, args):
        x, word, place = args
        i32 = ir.IntType(32)
        sign = b.and_(b.shl(word, place), i32(0x80000000))
        return b.bitcast(b.xor(b.bitcast(x, i32), sign), ir.FloatType())

    return types.float32(types.float32, types.uint32, types.uint32), codegen


@njit(cache=True, nogil=True, fastmath=_FAST)
def _sums(out, at, normals, one, two, key, shift, begin, n):
    """out[at + j] = +-(normals[one + k] + normals[two + k]), k = begin + j, j < n: the signs are fresh bits of k."""
    for group in range(begin // LANES, (begin + n) // LANES):
        word = _U(_splitmix64(key + _Q(group + 1) * _Q(_GOLDEN)) >> shift)
        k, o = _Q(group * LANES), _Q(at + group * LANES - begin)
        for j in range(LANES):
            m = _Q(j)
            out[o + m] = _flipped(normals[one + k + m] + normals[two + k + m], word, _U(j))


@njit(cache=True, nogil=True)
def _lattice(out_i, out_q, begin, n, normals, seed):
    """Points begin .. begin + n - 1, n <= BLOCK, of an endless row of white Gaussian numbers of unit power; where they
    begin in ``out``: whole groups of LANES points are made.

    I and Q are sums of two stretches of a table of NORMALS Gaussian numbers, at places that belong to the block, with a
    random sign each: any two of them are uncorrelated, and their power is exact. A quarter of the time of Box and Muller.
    """
    lead = begin % LANES
    at, done, n = begin - lead, 0, (n + lead + LANES - 1) // LANES * LANES
    mask = _Q(NORMALS - 1)
    while done < n:
        block, k = (at + done) // BLOCK, (at + done) % BLOCK
        here = min(n - done, BLOCK - k)
        key = _block_key(seed, _Q(block))
        p = _splitmix64(key)
        _sums(out_i, done, normals, p & mask, (p >> _Q(16)) & mask, key, _Q(0), k, here)
        _sums(out_q, done, normals, (p >> _Q(32)) & mask, (p >> _Q(48)) & mask, key, _Q(32), k, here)
        done += here
    return lead


@njit(cache=True, nogil=True, fastmath=_FAST, forceinline=True)
def _folded(x, k):
    """The middle of N_TAPS points with the sums of the pairs about it, inner ones first, and their differences."""
    c = x[k + _Q(4)]
    a1, a2, a3, a4 = x[k + _Q(3)], x[k + _Q(2)], x[k + _Q(1)], x[k]
    b1, b2, b3, b4 = x[k + _Q(5)], x[k + _Q(6)], x[k + _Q(7)], x[k + _Q(8)]
    return (c, a1 + b1, a2 + b2, a3 + b3, a4 + b4), (b1 - a1, b2 - a2, b3 - a3, b4 - a4)


@njit(cache=True, nogil=True, fastmath=_FAST, forceinline=True)
def _even(e, s):
    return e[0] * s[0] + e[1] * s[1] + e[2] * s[2] + e[3] * s[3] + e[4] * s[4]


@njit(cache=True, nogil=True, fastmath=_FAST, forceinline=True)
def _odd(o, d):
    return o[0] * d[0] + o[1] * d[1] + o[2] * d[2] + o[3] * d[3]


@njit(cache=True, nogil=True, fastmath=_FAST, forceinline=True)
def _taps(taps, t):
    """Those of `_even` and of `_odd`, which begin at t and t + 6."""
    even = taps[t], taps[t + 1], taps[t + 2], taps[t + 3], taps[t + 4]
    return even, (taps[t + 6], taps[t + 7], taps[t + 8], taps[t + 9])


@njit(cache=True, nogil=True, fastmath=_FAST)
def _add_filtered(out_i, out_q, x_i, x_q, at, taps, t, base, at_base, rot_i, rot_q, at_rot):
    """One output at every point, turned and added as by `_add_turned`."""
    e, _ = _taps(taps, t)
    b = _Q(at_base)
    for sub in range(BLOCK // SUB):
        o, re, im = _Q(sub * SUB), rot_i[at_rot + sub], rot_q[at_rot + sub]
        for m in range(SUB):
            k = _Q(m)
            c, s = _carrier(base, b + k, re, im)
            j, _ = _folded(x_i, _Q(at) + o + k)
            r, _ = _folded(x_q, _Q(at) + o + k)
            u, v = _even(e, j), _even(e, r)
            out_i[o + k] += u * c - v * s
            out_q[o + k] += u * s + v * c


@njit(cache=True, nogil=True, fastmath=_FAST)
def _two(out, x, at, taps, t, n):
    """Outputs a quarter before and after every point, by filters that are each other's mirror images."""
    e, o = _taps(taps, t)
    for m in range(n):
        s, d = _folded(x, _Q(at) + _Q(m))
        u, v = _even(e, s), _odd(o, d)
        out[_Q(2) * _Q(m)] = u - v
        out[_Q(2) * _Q(m) + _Q(1)] = u + v


@njit(cache=True, nogil=True, fastmath=_FAST)
def _three(out, x, at, taps, t, n):
    """Outputs a third before, at and a third after every point."""
    e, o = _taps(taps, t)
    c = taps[t + 10], taps[t + 11], taps[t + 12], taps[t + 13], taps[t + 14]
    for m in range(n):
        s, d = _folded(x, _Q(at) + _Q(m))
        u, v = _even(e, s), _odd(o, d)
        out[_Q(3) * _Q(m)] = u - v
        out[_Q(3) * _Q(m) + _Q(1)] = _even(c, s)
        out[_Q(3) * _Q(m) + _Q(2)] = u + v


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
def _finer(work, x, at_x, a, jammer, first, at, n, taps):
    """Lattice points in row x -> the block's samples: the row (a or a + 1) and the place where they begin."""
    step = jammer.step
    if jammer.phases == 2:
        _two(work[a], work[x], at_x, taps, jammer.table, n)
    else:
        _three(work[a], work[x], at_x, taps, jammer.table, n)
    if step == 1:
        return a, at
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
def _narrow(out_i, out_q, first, jammer, taps, base, at_base, rot_i, rot_q, at_rot, work):
    """A band of noise about the carrier: lattice, polyphase filter, doublings, and cubics where that is not enough."""
    phases, begin, n = jammer.phases, first, BLOCK
    if jammer.step > 1:  # four outputs of the filter before the block's own and eight after them
        begin, n = first // jammer.step - 4, BLOCK // jammer.step + 14
    m0, at = begin // phases, begin % phases
    n = (n + at + 8 * phases - 1) // (8 * phases) * 8
    at_x = _lattice(work[0], work[1], m0 - N_TAPS // 2, n + N_TAPS - 1, taps, jammer.seed)
    if phases == 1:
        _add_filtered(
            out_i, out_q, work[0], work[1], at_x, taps, jammer.table, base, at_base, rot_i, rot_q, at_rot
        )
        return
    i, at_i = _finer(work, 0, at_x, 2, jammer, first, at, n, taps)
    q, _ = _finer(work, 1, at_x, 4, jammer, first, at, n, taps)
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
def _envelope(out_i, out_q, first, jammer, base, at_base, rot_i, rot_q, at_rot, codes, taps, work):
    """What stands on a base table."""
    if jammer.kind == TONE:
        _add_steady(out_i, out_q, base, at_base, rot_i, rot_q, at_rot, 0, BLOCK)
    elif jammer.kind == PULSES:
        _pulses(out_i, out_q, first, jammer, base, at_base, rot_i, rot_q, at_rot, work)
    elif jammer.kind == CODE:
        _code(out_i, out_q, first, jammer, base, at_base, rot_i, rot_q, at_rot, codes)
    else:
        _narrow(out_i, out_q, first, jammer, taps, base, at_base, rot_i, rot_q, at_rot, work)


@njit(cache=True, nogil=True, fastmath=_FAST)
def _add_product(out_i, out_q, x_i, x_q, c, s):
    """out += x (c + i s) over a block."""
    for m in range(BLOCK):
        k = _Q(m)
        out_i[k] += x_i[k] * c[k] - x_q[k] * s[k]
        out_q[k] += x_i[k] * s[k] + x_q[k] * c[k]


@njit(cache=True, nogil=True, forceinline=True)
def _moving(
    out_i, out_q, first, jammer, base, at_base, rot_i, rot_q, at_rot, codes, waves, taps, p, f, h, level, sub, work
):  # fmt: skip
    """An envelope under a carrier whose frequency moves fast, or that its table does not hold."""
    work[8:13] = 0
    x_i, x_q, c, s, one = work[8], work[9], work[10], work[11], work[12, :1]
    one[0] = 1
    if jammer.kind == CHIRP:
        _chirp(x_i, x_q, first, jammer, 0.0, level, sub, waves)
    else:
        _envelope(x_i, x_q, first, jammer, base, at_base, rot_i, rot_q, at_rot, codes, taps, work)
    _quadratic(c, s, p, f, h, one, 0, work[13])
    _add_product(out_i, out_q, x_i, x_q, c, s)


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
        add_noise(out_i, out_q, hash1, hash2, jammer.seed, _Q(first // BLOCK), level[j], sub)
        return
    moves = _moves(carrier, j, n_cell)
    if not moves and jammer.kind != SWEEP and jammer.kind != CHIRP:
        _envelope(out_i, out_q, first, jammer, base, at_base, rot_i, rot_q, at_rot, codes, taps, work)
        return
    p, f, h = _at(carrier, j, x, n_cell)
    if jammer.kind == SWEEP:
        _sweep(out_i, out_q, first, jammer, p, f, h, level[j], sub, work)
    elif jammer.kind == CHIRP and jammer.held:
        _chirp(out_i, out_q, first, jammer, p, level[j], sub, waves)
    elif jammer.kind == TONE:
        _quadratic(out_i, out_q, p, f, h, level[j], sub, work[0])
    else:
        _moving(
            out_i, out_q, first, jammer, base, at_base, rot_i, rot_q, at_rot, codes, waves, taps, p, f, h, level[j], sub, work
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
            _add_part(buf_i, buf_q, to_i, to_q, lo, hi)
