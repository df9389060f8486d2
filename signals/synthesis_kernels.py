"""Kernel of the synthesis: noise, satellites, jammers and the quantiser, block by block in the first-level cache."""

import numpy as np
from numba import njit

from signals.jammer_kernels import WORK, add_jammers, carriers
from signals.kernels import (
    _FAST,
    SUB,
    _add_block,
    _carrier_bases,
    _fetch_ahead,
    _plan,
    _quantise_block,
    _rotations,
    borrowed,
    keep,
    noise_block,
)
from signals.modulation import BLOCK

__all__ = ["synthesise"]

_Q = np.uint64


@njit(cache=True, nogil=True, fastmath=_FAST)
def _start_block(buf_i, buf_q, hash1, hash2, seed, block, sigma):
    """Thermal noise, or silence."""
    if sigma > 0:
        noise_block(buf_i, buf_q, hash1, hash2, seed, block, sigma)
    else:
        buf_i[:] = 0
        buf_q[:] = 0


@njit(cache=True, nogil=True, fastmath=_FAST)
def _copy_block(buf_i, buf_q, out, at):
    for k in range(BLOCK):
        out[0, _Q(at + k)] = buf_i[k]
    for k in range(BLOCK):
        out[1, _Q(at + k)] = buf_q[k]


@njit(cache=True, nogil=True, fastmath=_FAST)
def synthesise(
    out, out8, gain, seed, sigma, n_first, n_start, n_cell,
    components, code, carrier, amplitude, period, codes, symbols,
    jammers, jammer_carrier, level, jammer_codes, waves, taps,
):  # fmt: skip
    """Noise, components and jammers of whole blocks of one cell: float32, or int8 by ``quantise_int8``'s rule.

    Parameters
    ----------
    out, out8 : float32, int8 (2, n), n a multiple of BLOCK
        One of them is written, the other is (2, 0).
    gain : float32
        Of the quantiser.
    seed : uint64
    sigma : float32
        Standard deviation of the thermal noise per component; 0 = none.
    n_first : int
        Absolute index of the first sample, a multiple of BLOCK.
    n_start, n_cell : float
        Samples from the cell's beginning to it, and in the cell.
    components : COMPONENT (C,)
    code, carrier : float64 (C, 4)
        Code phase in chips and carrier phase in cycles (IF included): polynomials in x, 0 <= x < 1 over the cell.
    amplitude : float64 (C, 4)
        Complex amplitude (re0 + x re1) + i (im0 + x im1).
    period : int64 (C,)
        Code period to which ``code[:, 0]`` belongs.
    codes, symbols : int8
        Flat buffers of code tables and symbols.
    jammers : JAMMER (J,)
    jammer_carrier : float64 (J, 4)
        Carrier phases of the jammers, as those of the components.
    level : float32 (J, 1) or (J, n / SUB)
        Their amplitudes over the sub-blocks of the call.
    jammer_codes, waves, taps : int8, int16, float32
        Flat buffers of what the jammers' tables hold.
    """
    components, code, carrier, amplitude = (
        borrowed(components),
        borrowed(code),
        borrowed(carrier),
        borrowed(amplitude),
    )
    period, codes, symbols, jammers = borrowed(period), borrowed(codes), borrowed(symbols), borrowed(jammers)
    jammer_carrier, level, jammer_codes = borrowed(jammer_carrier), borrowed(level), borrowed(jammer_codes)
    waves, taps, out, out8 = borrowed(waves), borrowed(taps), borrowed(out), borrowed(out8)
    n_blocks = max(out.shape[1], out8.shape[1]) // BLOCK
    n_components, n_jammers, n_sub = len(components), len(jammers), n_blocks * (BLOCK // SUB)
    bases = np.empty((n_components + n_jammers) * 2 * SUB, np.float32)
    base, tone_base = borrowed(bases[: n_components * 2 * SUB]), borrowed(bases[n_components * 2 * SUB :])
    turns = np.empty((2, (n_components + n_jammers) * n_sub), np.float32)
    rot_i, rot_q = borrowed(turns[0, : n_components * n_sub]), borrowed(turns[1, : n_components * n_sub])
    tone_i, tone_q = borrowed(turns[0, n_components * n_sub :]), borrowed(turns[1, n_components * n_sub :])
    places, weights = (
        np.empty((n_blocks, n_components, 3), np.int64),
        np.empty((n_blocks, n_components, 4), np.float32),
    )
    where, weight = borrowed(places), borrowed(weights)
    scratch = np.empty(WORK if n_jammers else (0, 0), np.float32)
    work = borrowed(scratch)
    buffers, hash1s, hash2s = (
        np.empty((2, BLOCK), np.float32),
        np.empty(BLOCK, np.uint32),
        np.empty(BLOCK, np.int32),
    )
    buf_i, buf_q, hash1, hash2 = (
        borrowed(buffers[0]),
        borrowed(buffers[1]),
        borrowed(hash1s),
        borrowed(hash2s),
    )
    _carrier_bases(base, carrier, n_cell)
    _rotations(rot_i, rot_q, carrier, amplitude, n_start, n_cell)
    _plan(where, weight, components, code, period, symbols, n_start, n_cell)
    carriers(tone_base, tone_i, tone_q, jammer_carrier, level, n_start, n_cell)
    for b in range(n_blocks):
        _start_block(buf_i, buf_q, hash1, hash2, seed, _Q(n_first // BLOCK + b), sigma)
        if b + 1 < n_blocks:
            _fetch_ahead(where, b + 1, codes)
        _add_block(buf_i, buf_q, b, base, rot_i, rot_q, where, weight, codes)
        add_jammers(
            buf_i, buf_q, b, n_first, jammers, tone_base, tone_i, tone_q, jammer_carrier, level, n_start, n_cell,
            jammer_codes, waves, taps, work, hash1, hash2,
        )  # fmt: skip
        if out8.shape[1]:
            _quantise_block(buf_i, buf_q, out8, b * BLOCK, gain)
        else:
            _copy_block(buf_i, buf_q, out, b * BLOCK)
    keep(bases)
    keep(turns)
    keep(places)
    keep(scratch)
    keep(hash1s)
    keep(hash2s)
    keep(buffers)
    keep(weights)
