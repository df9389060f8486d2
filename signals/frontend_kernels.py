"""Kernels of the front end's stages that look at more than one sample."""

import math

import numpy as np
from numba import njit

from signals.modulation import BLOCK

_F = np.float32
_Q = np.uint64
_TWO_PI = 2.0 * math.pi
SUB = 64
"""Samples that share one rotation of the oscillator's table."""


# Not to be reassociated: a sample's sum must not depend on its place in a vector.
@njit(nogil=True, fastmath={"contract", "nsz"})
def _accumulate(out, x, at, n, g0, g1, g2, g3):
    """out[m] += g0 x[at + m] + .. + g3 x[at + m - 3]: four taps for one pass over the sums."""
    for m in range(n):
        k, j = _Q(m), _Q(at) + _Q(m)
        out[k] += g0 * x[j] + g1 * x[j - _Q(1)] + g2 * x[j - _Q(2)] + g3 * x[j - _Q(3)]


@njit(cache=True, nogil=True)
def fir(x_i, x_q, taps_i, taps_q, out_i, out_q):
    """out[k] = sum over t of taps[t] x[k + T - 1 - t], complex; x float32 (n + T - 1,), out float32 (n,).

    T is a multiple of 4.
    """
    step, n, last = 1024, len(out_i), len(taps_i) - 1
    is_complex = np.any(taps_q != 0)
    sum_i, sum_q = np.empty(step, np.float32), np.empty(step, np.float32)
    for begin in range(0, n, step):
        m = min(step, n - begin)
        sum_i[:], sum_q[:] = 0, 0
        for t in range(0, len(taps_i), 4):
            at = begin + last - t
            a, b, c, d = taps_i[t], taps_i[t + 1], taps_i[t + 2], taps_i[t + 3]
            _accumulate(sum_i, x_i, at, m, a, b, c, d)
            _accumulate(sum_q, x_q, at, m, a, b, c, d)
            if is_complex:
                a, b, c, d = taps_q[t], taps_q[t + 1], taps_q[t + 2], taps_q[t + 3]
                _accumulate(sum_i, x_q, at, m, -a, -b, -c, -d)
                _accumulate(sum_q, x_i, at, m, a, b, c, d)
        out_i[begin : begin + m] = sum_i[:m]
        out_q[begin : begin + m] = sum_q[:m]


@njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
def mix(iq, n0, turns_per_sample, nodes):
    """Turn the samples n0 .. of ``iq``, float32 (2, n), back by an oscillator, in place.

    Its phase is ``turns_per_sample`` n cycles less a line between ``nodes`` (rad), which stand at multiples of BLOCK from
    the block of n0 on: linear in a block, so that one table of SUB rotations and one rotation per SUB samples do.
    """
    table_i, table_q = np.empty(SUB, np.float32), np.empty(SUB, np.float32)
    n, first = iq.shape[1], n0 // BLOCK
    block = -1
    begin = 0
    while begin < n:
        at = n0 + begin
        b, sub, k = at // BLOCK - first, at % BLOCK // SUB, at % SUB
        if b != block:
            block = b
            slope = (nodes[b + 1] - nodes[b]) / BLOCK - _TWO_PI * turns_per_sample
            for j in range(SUB):
                table_i[j], table_q[j] = _F(math.cos(slope * j)), _F(math.sin(slope * j))
            turns = (at - at % BLOCK) * turns_per_sample
            start = nodes[b] - _TWO_PI * (turns - math.floor(turns))
        c = _F(math.cos(start + slope * (sub * SUB)))
        s = _F(math.sin(start + slope * (sub * SUB)))
        m = min(SUB - k, n - begin)
        for j in range(m):
            i, u = _Q(begin) + _Q(j), _Q(k) + _Q(j)
            re = table_i[u] * c - table_q[u] * s
            im = table_i[u] * s + table_q[u] * c
            x, y = iq[0, i], iq[1, i]
            iq[0, i] = x * re - y * im
            iq[1, i] = x * im + y * re
        begin += m


@njit(cache=True, nogil=True)
def control(iq, block, share, target, state, parts):
    """Gain control in place: the gain holds for ``block`` samples, then ln gain moves by ``share`` of what is missing.

    ``state`` float64 (3,): gain, sum of squares and samples of the block so far; ``parts`` 2, or 1 for real samples.
    Sums run in order, so that the bits do not depend on the chunks.
    """
    gain, total, count = state
    for k in range(iq.shape[1]):
        for r in range(parts):
            x = np.float64(iq[r, k])
            total += x * x
            iq[r, k] = _F(gain * x)
        count += 1.0
        if count == block:
            rms = np.sqrt(total / (parts * block))
            if rms > 0.0:
                gain *= (target / (gain * rms)) ** share
            total, count = 0.0, 0.0
    state[0], state[1], state[2] = gain, total, count
