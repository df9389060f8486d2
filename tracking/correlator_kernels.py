"""The correlator of one code period, on plain arrays: blocks of at most 1024 samples, all taps in one pass.

Per block one row and column of the code table per tap (all taps share the rounding of the replica's phase, whose mean
is removed from the code error), one carrier table per frequency, the phase of a block applied to its sums. Samples of
int8 go through the integer loops of ``vector_ir`` where the processor has them, others through single precision.

These functions are compiled into the cache entry of ``kernels``: clear ``__pycache__`` after editing them.
"""

import math

import numpy as np
from numba import njit

from tracking.vector_ir import (
    HAS_INTEGER_PATH,
    INTEGER_SCALE,
    TABLE_ONE,
    WIDTH,
    dot3,
    dot4,
    dot5,
    dot6,
    fused4,
    wipe,
)

__all__ = ["carrier_table", "correlate_period", "scratch"]

_BLOCK = 1024
_ROW = _BLOCK + 32  # two rows 4096 bytes apart would hinder each other in the cache
_FAST = {"reassoc", "contract", "nsz", "arcp"}
_TWO_PI = 2.0 * math.pi
_F = np.float32
_U = np.uint64


@njit(nogil=True)
def scratch(n_columns):
    """Work arrays for up to ``n_columns`` sums: carrier as float32 and int16, wiped samples, block starts and sums."""
    wide = 2 * n_columns + 16
    return (
        np.empty((2, _ROW), np.float32),
        np.empty((2, _ROW), np.int16),
        np.empty((2, _ROW), np.float32),
        np.zeros(n_columns + 8, np.uint64),
        np.zeros(wide, np.int32),
        np.zeros(wide, np.float32),
    )


@njit(nogil=True)
def carrier_table(step_cycles, turns, turns16):
    """exp(2 pi i step j), j < 1024, as 32 x 32 products of rotations built in double precision."""
    bc, bs = np.empty(32, np.float32), np.empty(32, np.float32)
    c1, s1 = math.cos(_TWO_PI * step_cycles), math.sin(_TWO_PI * step_cycles)
    c, s = 1.0, 0.0
    for j in range(32):
        bc[j], bs[j] = c, s
        c, s = c * c1 - s * s1, c * s1 + s * c1
    c32, s32 = c, s
    c, s = 1.0, 0.0
    for m in range(_U(32)):
        fc, fs = _F(c), _F(s)
        at = _U(32) * m
        for j in range(_U(32)):
            turns[0, at + j] = bc[j] * fc - bs[j] * fs
            turns[1, at + j] = bc[j] * fs + bs[j] * fc
        c, s = c * c32 - s * s32, c * s32 + s * c32
    for j in range(_U(_BLOCK)):
        turns16[0, j] = np.int16(np.int32(np.floor(turns[0, j] * _F(TABLE_ONE) + _F(0.5))))
        turns16[1, j] = np.int16(np.int32(np.floor(turns[1, j] * _F(TABLE_ONE) + _F(0.5))))


@njit(fastmath=_FAST, nogil=True)
def _wipe(xi, xq, a, n, turns, first, wiped):
    """Take the carrier off samples a .. a + n - 1; the carrier table is read from ``first`` on."""
    for j in range(n):
        x, y, c, s = _F(xi[a + j]), _F(xq[a + j]), turns[0, first + j], turns[1, first + j]
        wiped[0, j] = x * c + y * s
        wiped[1, j] = y * c - x * s


@njit(fastmath=_FAST, nogil=True)
def _dot4(wiped, n, pool, s0, s1, s2, s3, out, o):
    """Correlate four taps."""
    a0 = a1 = a2 = a3 = b0 = b1 = b2 = b3 = _F(0.0)
    for j in range(n):
        u, v = wiped[0, j], wiped[1, j]
        p = _F(pool[s0 + j])
        a0 += p * u
        b0 += p * v
        p = _F(pool[s1 + j])
        a1 += p * u
        b1 += p * v
        p = _F(pool[s2 + j])
        a2 += p * u
        b2 += p * v
        p = _F(pool[s3 + j])
        a3 += p * u
        b3 += p * v
    out[o], out[o + 1], out[o + 2], out[o + 3] = a0, b0, a1, b1
    out[o + 4], out[o + 5], out[o + 6], out[o + 7] = a2, b2, a3, b3


@njit(nogil=True)
def _float_block(xi, xq, a, n, first, turns, wiped, pool, starts, n_sums, out):
    """Sums of ``n`` samples from the ``first`` of a block on into ``out`` (I, Q interleaved); ``starts`` is padded."""
    f = _U(first)
    _wipe(xi, xq, _U(a) + f, _U(n), turns, f, wiped)
    for t in range(0, n_sums, 4):
        _dot4(
            wiped, _U(n), pool, starts[t] + f, starts[t + 1] + f, starts[t + 2] + f, starts[t + 3] + f, out, 2 * t
        )  # fmt: skip


if HAS_INTEGER_PATH:

    @njit(nogil=True)
    def _integer_block(x, y, c, s, table, starts, steps, n_sums, u, v, to):
        """int32 sums of 16 ``steps`` samples (``vector_ir``); all arguments but the counts are addresses."""
        if n_sums <= 4:
            fused4(x, y, c, s, table, starts, steps, to)
            return
        wipe(x, y, c, s, steps, u, v)
        left = n_sums
        while left > 0:
            if left > 10 or left == 6:
                dot6(u, v, table, starts, steps, to)
                k = 6
            elif left == 5 or left > 8:
                dot5(u, v, table, starts, steps, to)
                k = 5
            elif left == 4 or left > 6:
                dot4(u, v, table, starts, steps, to)
                k = 4
            else:
                dot3(u, v, table, starts, steps, to)
                k = 3
            starts, to, left = starts + 8 * k, to + 8 * k, left - k

else:

    @njit(nogil=True)
    def _integer_block(x, y, c, s, table, starts, steps, n_sums, u, v, to):
        pass


@njit(nogil=True)
def _place_taps(st, q0, tap_q, starts):
    """Where each tap's code values of a block start in the pool, for a replica phase of ``q0`` in 1/P samples.

    Returns by how much E and L are off on average because the period is no whole number of 1/P samples, in 1/P samples.
    """
    n_sums, shift, mask = st.n_sums, st.phase_shift, st.n_phase - 1
    wrap, columns, start = st.wrap_q, st.table_columns, st.table_start
    while q0 >= wrap:
        q0 -= wrap
    while q0 < 0:
        q0 += wrap
    for t in range(n_sums):
        q = q0 + tap_q[t]
        if q < 0:
            q += wrap
        elif q >= wrap:
            q -= wrap
        starts[t] = _U(start + (q & mask) * columns + (q >> shift))
    if n_sums > st.n_taps + 1:
        starts[n_sums - 1] += _U(st.data_table_start - start)
    if st.wrap_error_q == 0.0:
        return 0.0
    wraps = 0.0
    for t in (st.early, st.late):
        wraps += 1.0 if q0 + tap_q[t] < 0 else 0.0
        wraps -= 1.0 if q0 + tap_q[t] >= wrap else 0.0
    return 0.5 * wraps * st.wrap_error_q


@njit(nogil=True)
def _turn_and_add(block, n_sums, c, s, sums):
    """sums += block exp(-i angle), (c, s) = cos and sin of the angle."""
    for t in range(n_sums):
        re, im = np.float64(block[2 * t]), np.float64(block[2 * t + 1])
        sums[2 * t] += re * c + im * s
        sums[2 * t + 1] += im * c - re * s


@njit(nogil=True, error_model="numpy")
def correlate_period(st, integer, xi, xq, a0, n, theta, step, rate, pool, tap_q, work, sums):
    """One code period: ``sums`` (n_sums + 1 complex as pairs; the last is the prompt's second half).

    theta, step: carrier phase at the first sample and its advance per sample, cycles. Returns the sum over samples of
    (replica's phase - nominal phase), chips, at the mean of E and L.
    """
    turns, turns16, wiped, starts, whole, out = work
    n_sums, n_phase, per_chip, phase = st.n_sums, st.n_phase, st.samples_per_chip, st.code_phase_chips
    second, half_i, half_q = 2 * st.prompt, 0.0, 0.0
    x, y = xi.ctypes.data + a0, xq.ctypes.data + a0
    c_at, u_at = turns16.ctypes.data, wiped.ctypes.data
    longest = st.longest_block
    blocks = 2 * ((n + 2 * longest - 1) // (2 * longest))
    block = min(longest, ((n + blocks - 1) // blocks + 31) // 32 * 32)
    n_blocks = (n + block - 1) // block
    for k in range(2 * n_sums + 2):
        sums[k] = 0.0
    c, s = math.cos(_TWO_PI * theta), math.sin(_TWO_PI * theta)
    dc, ds = math.cos(_TWO_PI * step * block), math.sin(_TWO_PI * step * block)
    rounding = 0.0
    for b in range(n_blocks):
        a = b * block
        nb = min(block, n - a)
        middle = phase + (a + 0.5 * nb) * rate
        q0 = math.floor((middle * per_chip - 0.5 * nb) * n_phase + 0.5)
        wraps = _place_taps(st, np.int64(q0), tap_q, starts)
        rounding += (((q0 + wraps) / n_phase + 0.5 * nb) / per_chip - middle) * nb
        if 2 * b == n_blocks or 2 * b == n_blocks + 1:
            half_i, half_q = sums[second], sums[second + 1]
        done = 0
        if integer:
            done = nb // WIDTH * WIDTH
            _integer_block(
                x + a, y + a, c_at, c_at + 2 * _ROW, pool.ctypes.data, starts.ctypes.data, nb // WIDTH, n_sums,
                u_at, u_at + 4 * _ROW, whole.ctypes.data,
            )  # fmt: skip
            _turn_and_add(whole, n_sums, c / INTEGER_SCALE, s / INTEGER_SCALE, sums)
        if done < nb:
            _float_block(xi, xq, a0 + a, nb - done, done, turns, wiped, pool, starts, n_sums, out)
            _turn_and_add(out, n_sums, c, s, sums)
        c, s = c * dc - s * ds, c * ds + s * dc
    sums[2 * n_sums], sums[2 * n_sums + 1] = sums[second] - half_i, sums[second + 1] - half_q
    return rounding
