"""Parts of the synthesis: thermal noise, satellites and the quantiser; `signals.synthesis_kernels` joins them.

Samples have an absolute index n and are made in blocks of BLOCK that start at multiples of BLOCK, always whole,
so that every sample has the same bits whatever the chunking or the number of threads. Over a *cell* of time
(20 ms, `signals.source.CELLS_PER_S`) code phase, carrier phase and amplitude of every component are polynomials in x, which
runs from 0 to 1; a block belongs to the cell that holds its middle.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic as _intrinsic

from signals.modulation import BLOCK

intrinsic: Any = _intrinsic  # its stub does not know that the typing context is passed by Numba

__all__ = [
    "COMPONENT",
    "add_noise",
    "noise_block",
    "quantise_bits",
    "quantise_int8",
    "quantise_int16",
]

SUB = 256
LOCALITY = 1
"""Prefetch into the outer caches: 1.1 times faster than into the first level, which the carrier tables fill."""
"""Samples that share one rotation of the carrier base table."""

COMPONENT = np.dtype(
    [
        ("code1", "i8"),  # offset of the code table in the flat int8 buffer
        ("code2", "i8"),  # a second code with the same delay and carrier (E1-C beside E1-B), or -1
        ("n_cols", "i8"),
        ("phase_bits", "i8"),  # log2 of the rows of the table
        ("samples_per_chip", "f8"),
        ("code_length_chips", "f8"),
        ("weight1", "f4"),  # table scale x share of the amplitude x sign
        ("weight2", "f4"),
        ("symbols1", "i8"),  # offset in the flat int8 symbol buffer
        ("symbols2", "i8"),
        ("n_symbols1", "i8"),
        ("n_symbols2", "i8"),
        ("first_period1", "i8"),  # code period at which the first symbol begins
        ("first_period2", "i8"),
        ("periods_per_symbol1", "i8"),
        ("periods_per_symbol2", "i8"),
    ]
)
"""What is constant about a component: one delay and one carrier under one code or two (cyclic symbols)."""

_FAST = {"contract", "nsz", "nnan", "ninf", "arcp", "reassoc", "afn"}
_F = np.float32
_I = np.int32
_U = np.uint32
_Q = np.uint64
_GOLDEN = 0x9E3779B97F4A7C15


@intrinsic
def _bits(typingctx, x):
    """Bits of a float32 as int32."""
    return types.int32(types.float32), lambda ctx, b, sig, args: b.bitcast(args[0], ir.IntType(32))


@intrinsic
def _float(typingctx, x):
    """Float32 from its bits."""
    return types.float32(types.int32), lambda ctx, b, sig, args: b.bitcast(args[0], ir.FloatType())


@intrinsic
def _mix(typingctx, x, key, shift, factor):
    """y = x ^ key, then (y ^ y >> shift) factor modulo 2^32.

    Numba itself would promote to 64 bits, which halves the width of the vectors.
    """

    def codegen(ctx, b, sig, args):
        x, key, shift, factor = args
        y = b.xor(x, key)
        return b.mul(b.xor(y, b.lshr(y, shift)), factor)

    return types.uint32(types.uint32, types.uint32, types.uint32, types.uint32), codegen


@intrinsic
def _held(typingctx, x):
    """A float32 that the compiler takes for a variable: a loop then keeps it as a vector, in a register or on the stack,
    instead of fetching the constant anew every time."""

    def codegen(ctx, b, sig, args):
        i32 = ir.IntType(32)
        bits = b.asm(ir.FunctionType(i32, [i32]), "", "=r,0", [b.bitcast(args[0], i32)], False)
        return b.bitcast(bits, ir.FloatType())

    return types.float32(types.float32), codegen


@intrinsic
def _prefetch(typingctx, array, index):
    """Hint that ``array[index]`` will be read."""

    def codegen(ctx, b, sig, args):
        data = ctx.make_array(sig.args[0])(ctx, b, args[0]).data
        pointer = b.bitcast(b.gep(data, [args[1]]), ir.IntType(8).as_pointer())
        i32 = ir.IntType(32)
        signature = ir.FunctionType(ir.VoidType(), [pointer.type, i32, i32, i32])
        name = "llvm.prefetch.p0" if str(pointer.type) == "ptr" else "llvm.prefetch.p0i8"
        function = cgutils.get_or_insert_function(b.module, signature, name)
        b.call(function, [pointer, i32(0), i32(LOCALITY), i32(1)])
        return ctx.get_dummy_value()

    return types.void(array, index), codegen


@intrinsic
def borrowed(typingctx, array):
    """The same array without its reference counter, whose atomic changes cost more than a jammer.

    Whoever owns the memory has to be kept (`keep`) until the last use.
    """

    def codegen(ctx, b, sig, args):
        view = ctx.make_array(sig.args[0])(ctx, b, args[0])
        view.meminfo = cgutils.get_null_value(view.meminfo.type)
        return view._getvalue()

    return array(array), codegen


@intrinsic
def keep(typingctx, array):
    """A last use of an array that is borrowed from."""
    return types.void(array), lambda ctx, b, sig, args: ctx.get_dummy_value()


@njit(cache=True, nogil=True)
def _splitmix64(z):
    """Finaliser of splitmix64 (Steele, Lea, Flood, OOPSLA 2014, fig. 17)."""
    z = (z ^ (z >> _Q(30))) * _Q(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> _Q(27))) * _Q(0x94D049BB133111EB)
    return z ^ (z >> _Q(31))


@njit(cache=True, nogil=True)
def _block_key(seed, block):
    """64-bit key of a block: splitmix64 of seed and index."""
    return _splitmix64(_splitmix64(seed + _Q(_GOLDEN)) + (block + _Q(1)) * _Q(_GOLDEN))


@njit(cache=True, nogil=True, fastmath=_FAST)
def _hashes(hash1, hash2, seed, block):
    """Two 32-bit hashes of every place in a block, under the block's key.

    They are triple32 (C. Wellons, "Prospecting for hash
    functions", 2018) and the finaliser of MurmurHash3 (A. Appleby) upon it.
    """
    key = _block_key(seed, block)
    key1 = _U(key >> _Q(32))
    key2 = _U(key & _Q(0xFFFFFFFF))
    for k in range(BLOCK):
        x = _mix(_U(k), key1, _U(17), _U(0xED5AD4BB))
        x = _mix(x, _U(0), _U(11), _U(0xAC4C1B51))
        x = _mix(x, _U(0), _U(15), _U(0x31848BAB))
        x = _mix(x, _U(0), _U(14), _U(1))
        y = _mix(x, key2, _U(16), _U(0x85EBCA6B))
        y = _mix(y, _U(0), _U(13), _U(0xC2B2AE35))
        hash1[k] = x
        hash2[k] = _mix(y, _U(0), _U(16), _U(1))


UNIT = _F(-1.3862943611)
"""-2 ln 2: Box and Muller's r^2 over log2 u."""


@njit(cache=True, nogil=True, forceinline=True)
def _held5(a, b, c, d, e):
    return _held(_F(a)), _held(_F(b)), _held(_F(c)), _held(_F(d)), _held(_F(e))


@njit(cache=True, nogil=True, forceinline=True)
def _polynomials():
    """Minimax coefficients: of log2 (error below 3e-6), of sine and of cosine over half a turn (below 7e-7)."""
    return (
        _held5(0.44254493, -0.27560019, 0.18194844, -0.095955811, 0.025841132),
        _held5(3.14158203, -5.16714292, 2.5419, -0.554638688, 0.0),
        _held5(0.999999953, -4.93479286, 4.05841194, -1.33188034, 0.219697149),
    )


@njit(cache=True, nogil=True, fastmath=_FAST, forceinline=True)
def _half_turns(a, p, q):
    """(sin, cos) of pi a, -0.5 <= a <= 0.5."""
    a2 = a * a
    s = a * (p[0] + a2 * (p[1] + a2 * (p[2] + a2 * p[3])))
    return s, q[0] + a2 * (q[1] + a2 * (q[2] + a2 * (q[3] + a2 * q[4])))


@njit(cache=True, nogil=True, fastmath=_FAST)
def _gaussian(h, g, scale, polynomials):
    """Two Gaussian numbers of variance scale / UNIT from two hashes (Box and Muller): r = sqrt(-2 ln u), angle in half
    a turn and a random sign. Range +-6.5.
    """
    p, sine, cosine = polynomials
    bits = _bits(_F(_I(_I(_I(h >> _I(1)) & _I(0x7FFFFFFF)) | _I(1))))
    w = _float(_I(_I(bits & _I(0x007FFFFF)) | _I(0x3F800000))) - _F(1)
    # log2 u = exponent + w + w (1 - w) q(w): exact at both ends, so that r is right near u = 1
    q = p[0] + w * (p[1] + w * (p[2] + w * (p[3] + w * p[4])))
    log2u = _F(_I(bits - _I(0x4F000000))) * _F(2.0**-23) + w * (_F(1) - w) * q
    r = np.sqrt(max(scale * log2u, _F(0)))
    s, c = _half_turns(_F(g) * _F(2.0**-32), sine, cosine)
    return r * s, _float(_I(_bits(r) ^ _I(_I(h & _I(1)) << _I(31)))) * c


@njit(cache=True, nogil=True, fastmath=_FAST)
def noise_block(out_i, out_q, hash1, hash2, seed, block, sigma):
    """Write BLOCK complex Gaussian samples that depend on (seed, block) alone; sigma^2 is the variance of I and of Q."""
    _hashes(hash1, hash2, seed, block)
    p = _polynomials()
    for k in range(BLOCK):
        x, y = _gaussian(hash1[k], hash2[k], UNIT, p)
        out_i[k] = sigma * x
        out_q[k] = sigma * y


@njit(cache=True, nogil=True, fastmath=_FAST)
def add_noise(out_i, out_q, hash1, hash2, seed, block, level, at):
    """Add a block of white noise of power level^2 in I and Q together: one value, or from ``at`` on one per SUB samples."""
    _hashes(hash1, hash2, seed, block)
    p = _polynomials()
    for sub in range(BLOCK // SUB):
        a = level[min(at + sub, len(level) - 1)]
        scale = _F(0.5) * UNIT * a * a
        for m in range(SUB):
            k = _Q(sub * SUB) + _Q(m)
            x, y = _gaussian(hash1[k], hash2[k], scale, p)
            out_i[k] += x
            out_q[k] += y


@njit(cache=True, nogil=True, fastmath=_FAST)
def _cis(cycles):
    """(cos, sin) of 2 pi ``cycles``; error below 4e-9."""
    r = cycles - np.floor(cycles + 0.5)
    r2 = r * r
    s = r * (3.14159258 + r2 * (-5.16770688 + r2 * (2.55003138 + r2 * (-0.598045187 + r2 * 0.0772201373))))
    c = 1.0 + r2 * (
        -4.93480214 + r2 * (4.05870916 + r2 * (-1.33521206 + r2 * (0.234937551 + r2 * -0.0243966987)))
    )
    return 1.0 - 2.0 * s * s, 2.0 * s * c


@njit(cache=True, nogil=True, fastmath=_FAST)
def _carrier_bases(base, carrier, n_cell):
    """exp(j 2 pi f (k - SUB/2)), k < SUB, f = mid-cell frequency of each component -> ``base`` (C x 2 SUB)."""
    for c in range(len(carrier)):
        f = (carrier[c, 1] + carrier[c, 2] + 0.75 * carrier[c, 3]) / n_cell
        for k in range(SUB):
            x, y = _cis(f * (k - SUB // 2))
            base[2 * SUB * c + k] = _F(x)
            base[2 * SUB * c + SUB + k] = _F(y)


@njit(cache=True, nogil=True, fastmath=_FAST)
def _rotations(rot_i, rot_q, carrier, amplitude, n_start, n_cell):
    """amplitude exp(j carrier phase) in the middle of every sub-block, component after component."""
    n_sub = len(rot_i) // max(len(carrier), 1)
    for c in range(len(carrier)):
        p0, p1, p2, p3 = carrier[c, 0], carrier[c, 1], carrier[c, 2], carrier[c, 3]
        a0, a1, b0, b1 = amplitude[c, 0], amplitude[c, 1], amplitude[c, 2], amplitude[c, 3]
        for j in range(n_sub):
            x = (n_start + SUB // 2 + SUB * j) / n_cell
            re, im = _cis(p0 + x * (p1 + x * (p2 + x * p3)))
            a, b = a0 + x * a1, b0 + x * b1
            rot_i[c * n_sub + j] = _F(a * re - b * im)
            rot_q[c * n_sub + j] = _F(a * im + b * re)


@njit(cache=True, nogil=True, fastmath=_FAST)
def _add_one(out_i, out_q, base, at_base, codes, at, roll, rot_i, rot_q, at_rot, w, next_w):
    """out += w rot base code over a block; from the first sub-block that starts at or after ``roll`` on, next_w."""
    b = _Q(at_base)
    for sub in range(BLOCK // SUB):
        p, r = _Q(sub * SUB), _Q(at_rot + sub)
        c = _Q(at) + p
        u = w if sub * SUB < roll else next_w
        re, im = rot_i[r] * u, rot_q[r] * u
        for kk in range(SUB):
            k = _Q(kk)
            chip = _F(codes[c + k])
            x = base[b + k]
            y = base[b + k + _Q(SUB)]
            out_i[p + k] += chip * (re * x - im * y)
            out_q[p + k] += chip * (re * y + im * x)


@njit(cache=True, nogil=True, fastmath=_FAST)
def _add_pair(
    out_i,
    out_q,
    base,
    codes,
    rot_i,
    rot_q,
    at_base,
    at_rot,
    next_rot,
    at1,
    at2,
    roll1,
    roll2,
    w1,
    w2,
    next1,
    next2,
):
    """`_add_one` for two components that follow each other: the sums are read and written once."""
    b, d = _Q(at_base), _Q(at_base + 2 * SUB)
    for sub in range(BLOCK // SUB):
        p, r, t = _Q(sub * SUB), _Q(at_rot + sub), _Q(next_rot + sub)
        c, e = _Q(at1) + p, _Q(at2) + p
        u = w1 if sub * SUB < roll1 else next1
        v = w2 if sub * SUB < roll2 else next2
        re1, im1 = rot_i[r] * u, rot_q[r] * u
        re2, im2 = rot_i[t] * v, rot_q[t] * v
        for kk in range(SUB):
            k = _Q(kk)
            chip1, chip2 = _F(codes[c + k]), _F(codes[e + k])
            x1, y1 = base[b + k], base[b + k + _Q(SUB)]
            x2, y2 = base[d + k], base[d + k + _Q(SUB)]
            out_i[p + k] += chip1 * (re1 * x1 - im1 * y1) + chip2 * (re2 * x2 - im2 * y2)
            out_q[p + k] += chip1 * (re1 * y1 + im1 * x1) + chip2 * (re2 * y2 + im2 * x2)


@njit(cache=True, nogil=True, fastmath=_FAST)
def _add_two(
    out_i, out_q, base, at_base, codes, at1, at2, roll, rot_i, rot_q, at_rot, w1, w2, next_w1, next_w2
):
    """The same for two codes under one carrier."""
    b = _Q(at_base)
    for sub in range(BLOCK // SUB):
        p, r = _Q(sub * SUB), _Q(at_rot + sub)
        c, d = _Q(at1) + p, _Q(at2) + p
        u1, u2 = (w1, w2) if sub * SUB < roll else (next_w1, next_w2)
        re, im = rot_i[r], rot_q[r]
        for kk in range(SUB):
            k = _Q(kk)
            chip = u1 * _F(codes[c + k]) + u2 * _F(codes[d + k])
            x = base[b + k]
            y = base[b + k + _Q(SUB)]
            out_i[p + k] += chip * (re * x - im * y)
            out_q[p + k] += chip * (re * y + im * x)


@njit(cache=True, nogil=True, fastmath=_FAST)
def _add_rest(out_i, out_q, base, at_base, codes, at1, at2, roll, re, im, w1, w2):
    """The same from ``roll`` to the end of its sub-block: what a symbol that changes there adds to its predecessor."""
    for k in range(roll, (roll // SUB + 1) * SUB):
        chip = w1 * _F(codes[at1 + k])
        if w2 != 0:
            chip += w2 * _F(codes[at2 + k])
        x = base[at_base + k % SUB]
        y = base[at_base + SUB + k % SUB]
        out_i[k] += chip * (re * x - im * y)
        out_q[k] += chip * (re * y + im * x)


@njit(cache=True, nogil=True)
def _symbol(symbols, offset, n_symbols, first_period, periods_per_symbol, period):
    return _F(symbols[offset + ((period - first_period) // periods_per_symbol) % n_symbols])


@njit(cache=True, nogil=True)
def _symbol1(comp, symbols, period):
    return comp.weight1 * _symbol(
        symbols, comp.symbols1, comp.n_symbols1, comp.first_period1, comp.periods_per_symbol1, period
    )


@njit(cache=True, nogil=True)
def _symbol2(comp, symbols, period):
    if comp.code2 < 0:
        return _F(0)
    return comp.weight2 * _symbol(
        symbols, comp.symbols2, comp.n_symbols2, comp.first_period2, comp.periods_per_symbol2, period
    )


@njit(cache=True, nogil=True)
def _place(comp, code, period, x):
    """Code period, table index and first sample of the next period for the block whose middle is at ``x``."""
    phase = code[0] + x * (code[1] + x * (code[2] + x * code[3])) - (BLOCK // 2) / comp.samples_per_chip
    turns = np.floor(phase / comp.code_length_chips)
    phase -= turns * comp.code_length_chips
    q = np.int64(phase * comp.samples_per_chip * (1 << comp.phase_bits) + 0.5)
    column, row = q >> comp.phase_bits, q & ((1 << comp.phase_bits) - 1)
    roll = np.ceil(comp.code_length_chips * comp.samples_per_chip - q / (1 << comp.phase_bits))
    return period + np.int64(turns), row * comp.n_cols + column, np.int64(roll)


@njit(cache=True, nogil=True)
def _plan(where, weight, components, code, period, symbols, n_start, n_cell):
    """What every block needs of every component: table indices and roll-over; weights before and after it."""
    for c in range(len(components)):
        comp = components[c]
        for b in range(where.shape[0]):
            x = (n_start + b * BLOCK + BLOCK // 2) / n_cell
            n, at, roll = _place(comp, code[c], period[c], x)
            where[b, c, 0], where[b, c, 1] = comp.code1 + at, comp.code2 + at if comp.code2 >= 0 else -1
            where[b, c, 2] = roll
            weight[b, c, 0] = weight[b, c, 2] = _symbol1(comp, symbols, n)
            weight[b, c, 1] = weight[b, c, 3] = _symbol2(comp, symbols, n)
            if roll < BLOCK:
                weight[b, c, 2], weight[b, c, 3] = (
                    _symbol1(comp, symbols, n + 1),
                    _symbol2(comp, symbols, n + 1),
                )


@njit(cache=True, nogil=True)
def _fetch_ahead(where, b, codes):
    """Ask for the code rows of a block while the one before it is worked on: rows change with the code Doppler."""
    for c in range(where.shape[1]):
        for k in range(2):
            if where[b, c, k] >= 0:
                for line in range(0, BLOCK, 64):
                    _prefetch(codes, where[b, c, k] + line)


@njit(cache=True, nogil=True, fastmath=_FAST)
def _add_block(out_i, out_q, b, base, rot_i, rot_q, where, weight, codes):
    """Add every component to block ``b`` of the call."""
    n_components, n_sub = where.shape[1], where.shape[0] * (BLOCK // SUB)
    paired = False
    for c in range(n_components):
        at1, at2, roll = where[b, c, 0], where[b, c, 1], where[b, c, 2]
        w1, w2, next1, next2 = weight[b, c, 0], weight[b, c, 1], weight[b, c, 2], weight[b, c, 3]
        at_base, at_rot = 2 * SUB * c, n_sub * c + b * (BLOCK // SUB)
        if at2 >= 0:
            _add_two(
                out_i, out_q, base, at_base, codes, at1, at2, roll, rot_i, rot_q, at_rot, w1, w2, next1, next2
            )
        elif paired:
            paired = False  # added with the one before
        elif c + 1 < n_components and where[b, c + 1, 1] < 0:
            paired = True
            _add_pair(
                out_i, out_q, base, codes, rot_i, rot_q, at_base, at_rot, at_rot + n_sub, at1, where[b, c + 1, 0],
                roll, where[b, c + 1, 2], w1, weight[b, c + 1, 0], next1, weight[b, c + 1, 2],
            )  # fmt: skip
        else:
            _add_one(out_i, out_q, base, at_base, codes, at1, roll, rot_i, rot_q, at_rot, w1, next1)
        if roll < BLOCK and roll % SUB > 0 and (next1 != w1 or next2 != w2):
            re, im = rot_i[at_rot + roll // SUB], rot_q[at_rot + roll // SUB]
            _add_rest(out_i, out_q, base, at_base, codes, at1, at2, roll, re, im, next1 - w1, next2 - w2)


@njit(cache=True, nogil=True, fastmath=_FAST)
def _round(x, gain, limit):
    """round(gain x), clipped to +-limit, in the low 16 bits: adding 1.5 x 2^23 shifts the integer there."""
    return _bits(min(max(gain * x, -limit), limit) + _F(12582912))


@njit(cache=True, nogil=True, fastmath=_FAST)
def _quantise_block(buf_i, buf_q, out, at, gain):
    for k in range(BLOCK):
        out[0, _Q(at + k)] = np.int8(_round(buf_i[k], gain, _F(127)))
    for k in range(BLOCK):
        out[1, _Q(at + k)] = np.int8(_round(buf_q[k], gain, _F(127)))


@njit(cache=True, nogil=True, fastmath=_FAST)
def quantise_int8(x, out, gain):
    """Mid-tread: round(gain x), clipped to +-127. x float32 (2, n) -> out int8 (2, n)."""
    for r in range(2):
        for k in range(x.shape[1]):
            out[r, k] = np.int8(_round(x[r, k], gain, _F(127)))


@njit(cache=True, nogil=True, fastmath=_FAST)
def quantise_int16(x, out, gain):
    """Mid-tread: round(gain x), clipped to +-32767. x float32 (2, n) -> out int16 (2, n)."""
    for r in range(2):
        for k in range(x.shape[1]):
            out[r, k] = np.int16(_round(x[r, k], gain, _F(32767)))


@njit(cache=True, nogil=True, fastmath=_FAST)
def quantise_bits(x, out, gain, bits):
    """Mid-rise with 2^bits levels, the odd integers: 2 floor(gain x) + 1, clipped. float32 (2, n) -> int8 (2, n)."""
    top = _F(1 << (bits - 1))
    for r in range(2):
        for k in range(x.shape[1]):
            level = np.floor(min(max(gain * x[r, k], -top), top - _F(0.5)))
            out[r, k] = np.int8(_I(_F(2) * level + _F(1)))
