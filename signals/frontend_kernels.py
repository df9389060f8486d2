"""Kernels of the front end's stages that look at more than one sample."""

import numpy as np
from numba import njit

from signals.kernels import _FAST

_F = np.float32
_Q = np.uint64


@njit(cache=True, nogil=True, fastmath=_FAST)
def _accumulate(out, x, gain, at, n):
    for m in range(n):
        k = _Q(m)
        out[k] += gain * x[_Q(at) + k]


@njit(cache=True, nogil=True)
def fir(x_i, x_q, taps_i, taps_q, out_i, out_q):
    """out[k] = sum over t of taps[t] x[k + T - 1 - t], complex; x float32 (n + T - 1,), out float32 (n,)."""
    step, n = 1024, len(out_i)
    sum_i, sum_q = np.empty(step, np.float32), np.empty(step, np.float32)
    for begin in range(0, n, step):
        m = min(step, n - begin)
        sum_i[:], sum_q[:] = 0, 0
        for t in range(len(taps_i)):
            at = begin + len(taps_i) - 1 - t
            _accumulate(sum_i, x_i, taps_i[t], at, m)
            _accumulate(sum_q, x_q, taps_i[t], at, m)
            if taps_q[t] != 0:
                _accumulate(sum_i, x_q, -taps_q[t], at, m)
                _accumulate(sum_q, x_i, taps_q[t], at, m)
        out_i[begin : begin + m] = sum_i[:m]
        out_q[begin : begin + m] = sum_q[:m]


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
