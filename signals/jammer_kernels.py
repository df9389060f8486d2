"""Kernels of the jammers: every waveform is evaluated on whole blocks that start at multiples of BLOCK.

Nothing is carried from block to block, so that any chunking and any number of threads give the same bits. Phases
are 32-bit turns, p + f j + h j^2 modulo 1 with j the sample of the block: exact wrap-around, no recurrence, and the
same code for a steady tone and for a chirp.
"""

import math

import numpy as np
from numba import njit

from signals.kernels import _FAST, _cis, _splitmix64, noise_block
from signals.modulation import BLOCK

__all__ = ["MAX_PHASES", "N_TAPS", "add_code", "add_narrowband", "add_pulses", "add_tone", "add_wideband"]

N_TAPS = 16
"""Lattice points under the interpolation filter of narrow-band noise."""
MAX_PHASES = 16
"""Phases of that filter; finer steps are linear between them."""
SUB = 256
"""Samples under one turn of a carrier's base table."""
GROUP = 16
"""Blocks that share a base table."""
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

    Polynomials of sine and cosine of half the angle: those of ``signals.kernels.noise_block``.
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
def _carrier(n, cell0, n_cell, carrier):
    """Phase (cycles), frequency (per sample) and half its rate at sample n, from the cubics of the cells."""
    cell = np.int64(np.floor(n / n_cell))
    x = (n - cell * n_cell) / n_cell
    r = min(max(cell - cell0, 0), carrier.shape[0] - 1)
    p0, p1, p2, p3 = carrier[r, 0], carrier[r, 1], carrier[r, 2], carrier[r, 3]
    p = p0 + x * (p1 + x * (p2 + x * p3))
    f = (p1 + x * (2.0 * p2 + 3.0 * x * p3)) / n_cell
    return p, f, (p2 + 3.0 * x * p3) / (n_cell * n_cell)


@njit(cache=True, nogil=True, fastmath=_FAST)
def _add_row(out, at, buf, k0, n, a0, slope):
    """out[at + m] += (a0 + slope m) buf[k0 + m], m < n."""
    o, b = _Q(at), _Q(k0)
    if slope == 0:
        for m in range(n):
            k = _Q(m)
            out[o + k] += a0 * buf[b + k]
        return
    for m in range(n):
        k = _Q(m)
        out[o + k] += (a0 + slope * _F(_I(m))) * buf[b + k]


@njit(cache=True, nogil=True)
def _add(iq, n0, lo, hi, block, buf_i, buf_q, level, b):
    """iq += level buf over the part of the block inside [lo, hi); the level is a line from edge to edge."""
    first = block * BLOCK
    k0, k1 = max(lo - first, 0), min(hi - first, BLOCK)
    a0, a1 = level[min(b, len(level) - 1)], level[min(b + 1, len(level) - 1)]
    slope = (a1 - a0) * _F(1.0 / BLOCK)
    a0 += slope * _F(k0)
    _add_row(iq[0], first + k0 - n0, buf_i, k0, k1 - k0, a0, slope)
    _add_row(iq[1], first + k0 - n0, buf_q, k0, k1 - k0, a0, slope)


@njit(cache=True, nogil=True, fastmath=_FAST)
def _turn_base(out_i, out_q, base_i, base_q, sub, re, im):
    o = _Q(sub * SUB)
    for m in range(SUB):
        k = _Q(m)
        x, y = base_i[k], base_q[k]
        out_i[o + k] = re * x - im * y
        out_q[o + k] = re * y + im * x


@njit(cache=True, nogil=True)
def _steady(out_i, out_q, block, cell0, n_cell, carrier, base_i, base_q, based):
    """The carrier over a block; ``based``: the group of blocks for which the base was made, which is returned.

    A base table exp(2 pi i f k) turned every SUB samples, f that of the middle of a group of GROUP blocks. Where the
    frequency moves too fast for that, the quadratic `tone`.
    """
    group = block // GROUP
    p, f, h = _carrier((group * GROUP + GROUP // 2) * BLOCK, cell0, n_cell, carrier)
    if abs(h) * (GROUP * BLOCK * SUB) > 4e-7:
        p, f, h = _carrier(block * BLOCK, cell0, n_cell, carrier)
        tone(out_i, out_q, 0, BLOCK, p, f, h)
        return np.int64(-1)
    if based != group:
        tone(base_i, base_q, 0, SUB, -f * (SUB // 2), f, 0.0)
    for sub in range(BLOCK // SUB):
        p, f, h = _carrier(block * BLOCK + sub * SUB + SUB // 2, cell0, n_cell, carrier)
        re, im = _cis(p)
        _turn_base(out_i, out_q, base_i, base_q, sub, _F(re), _F(im))
    return group


@njit(cache=True, nogil=True)
def _sweep(out_i, out_q, first, fs_hz, p, f, h, sweep_s, sweep_hz, triangular):
    """Saw-tooth or triangle about the carrier: -B/2 .. B/2 in ``sweep_s``, the phase continuous."""
    k = 0
    while k < BLOCK:
        n = first + k
        turn = np.floor(n / (sweep_s * fs_hz))
        last = np.int64(np.ceil((turn + 1.0) * sweep_s * fs_hz))
        if last <= n:
            turn += 1.0
            last = np.int64(np.ceil((turn + 1.0) * sweep_s * fs_hz))
        end = min(last - first, BLOCK)
        tau_s = max(n / fs_hz - turn * sweep_s, 0.0)
        sign = -1.0 if triangular and np.int64(turn) % 2 == 1 else 1.0
        rate = sign * sweep_hz / sweep_s
        dev_hz = rate * tau_s - 0.5 * sign * sweep_hz
        psi = tau_s * (0.5 * rate * tau_s - 0.5 * sign * sweep_hz)
        here = p + k * (f + h * k) + psi
        tone(out_i, out_q, k, end, here, f + 2.0 * h * k + dev_hz / fs_hz, h + 0.5 * rate / fs_hz**2)
        k = end


@njit(cache=True, nogil=True)
def add_tone(
    iq, n0, lo, hi, level, cell0, n_cell, carrier, fs_hz, sweep_s, sweep_hz, triangular
):  # fmt: skip
    """A tone, steady or (``sweep_hz`` > 0) swept, added to samples lo .. hi - 1.

    Parameters
    ----------
    iq : float32 (2, n)
        Samples n0, n0 + 1, ..
    level : float32 (1,) or (blocks + 1,)
        Amplitude at the edges of the blocks from the one that holds ``lo`` on.
    cell0, n_cell, carrier
        Phase in cycles: cubics (cells, 4) in x over cells of ``n_cell`` samples, the first one ``cell0``.
    """
    buf_i, buf_q = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    base_i, base_q = np.empty(SUB, np.float32), np.empty(SUB, np.float32)
    b0, based = lo // BLOCK, np.int64(-1)
    for block in range(b0, (hi - 1) // BLOCK + 1):
        if sweep_hz > 0.0:
            p, f, h = _carrier(block * BLOCK, cell0, n_cell, carrier)
            _sweep(buf_i, buf_q, block * BLOCK, fs_hz, p, f, h, sweep_s, sweep_hz, triangular)
        else:
            based = _steady(buf_i, buf_q, block, cell0, n_cell, carrier, base_i, base_q, based)
        _add(iq, n0, lo, hi, block, buf_i, buf_q, level, block - b0)


@njit(cache=True, nogil=True)
def _uniform(seed, index):
    """A number in [0, 1) that belongs to (seed, index)."""
    z = _splitmix64(seed + (_Q(index) + _Q(1)) * _Q(_GOLDEN))
    return np.float64(z >> _Q(11)) * 2.0**-53


@njit(cache=True, nogil=True)
def add_pulses(
    iq, n0, lo, hi, level, cell0, n_cell, carrier, fs_hz, seed, slot_s, width_s, pair_s, gaussian, random
):  # fmt: skip
    """One pulse or pulse pair in every slot: rectangles of ``width_s``, or exp(-t^2 / (2 width^2)) twice, ``pair_s``
    apart, anywhere in the slot if ``random``.
    """
    buf_i, buf_q = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    window = np.empty(BLOCK, np.float32)
    reach_s = 5.0 * width_s if gaussian else 0.0
    span_s = pair_s + (2.0 * reach_s if gaussian else width_s)
    b0 = lo // BLOCK
    for block in range(b0, (hi - 1) // BLOCK + 1):
        first = block * BLOCK
        p, f, h = _carrier(first, cell0, n_cell, carrier)
        slot, end = np.int64(first / fs_hz / slot_s) - 1, (first + BLOCK) / fs_hz
        window[:] = 0
        used = False
        while slot * slot_s < end:
            free_s = slot_s - span_s
            t0 = slot * slot_s + (free_s * _uniform(seed, slot + 1) if random else 0.0)
            for pulse in range(2 if pair_s > 0.0 else 1):
                begin = t0 + pulse * pair_s
                stop = begin + (2.0 * reach_s if gaussian else width_s)
                k0 = max(np.int64(np.ceil(begin * fs_hz - 1e-6)) - first, 0)
                k1 = min(np.int64(np.ceil(stop * fs_hz - 1e-6)) - first, BLOCK)
                for k in range(k0, k1):
                    if gaussian:
                        u = ((first + k) / fs_hz - begin - reach_s) / width_s
                        window[k] += _F(math.exp(-0.5 * u * u))
                    else:
                        window[k] = _F(1)
                used = used or k1 > k0
            slot += 1
        if used:
            tone(buf_i, buf_q, 0, BLOCK, p, f, h)
            for k in range(BLOCK):
                buf_i[k] *= window[k]
                buf_q[k] *= window[k]
            _add(iq, n0, lo, hi, block, buf_i, buf_q, level, block - b0)


@njit(cache=True, nogil=True)
def add_wideband(iq, n0, lo, hi, level, seed):
    """White complex Gaussian noise of power level^2 (in I and Q together)."""
    buf_i, buf_q = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    hash1, hash2 = np.empty(BLOCK, np.uint32), np.empty(BLOCK, np.int32)
    b0 = lo // BLOCK
    for block in range(b0, (hi - 1) // BLOCK + 1):
        noise_block(buf_i, buf_q, hash1, hash2, seed, _Q(block), _F(math.sqrt(0.5)))
        _add(iq, n0, lo, hi, block, buf_i, buf_q, level, block - b0)


@njit(cache=True, nogil=True, fastmath=_FAST)
def _interpolate(out, n, spread, taps, width, step):
    """out[k] = sum over t of taps[t width + k mod width] spread[k + t step], k < n; I or Q alone.

    Few arrays at a time: the vectoriser gives up where too many could overlap.
    """
    for k0 in range(0, n, width):
        for t in range(0, N_TAPS, 8):
            h, g = _Q(t * width), _Q(k0 + t * step)
            w, d, o = _Q(width), _Q(step), _Q(k0)
            keep = _F(0) if t == 0 else _F(1)
            for m in range(width):
                k = _Q(m)
                out[o + k] = (
                    keep * out[o + k]
                    + taps[h + k] * spread[g + k]
                    + taps[h + w + k] * spread[g + d + k]
                    + taps[h + _Q(2) * w + k] * spread[g + _Q(2) * d + k]
                    + taps[h + _Q(3) * w + k] * spread[g + _Q(3) * d + k]
                    + taps[h + _Q(4) * w + k] * spread[g + _Q(4) * d + k]
                    + taps[h + _Q(5) * w + k] * spread[g + _Q(5) * d + k]
                    + taps[h + _Q(6) * w + k] * spread[g + _Q(6) * d + k]
                    + taps[h + _Q(7) * w + k] * spread[g + _Q(7) * d + k]
                )


@njit(cache=True, nogil=True)
def _spread(out, lattice, at, n, phases):
    """out[k] = lattice[at + k // phases]."""
    for r in range(phases):
        for m in range(n):
            out[_Q(m) * _Q(phases) + _Q(r)] = lattice[_Q(at) + _Q(m)]


@njit(cache=True, nogil=True, fastmath=_FAST)
def _linear(out, coarse, at, shift, step, wide):
    """out[k] on the line between coarse points; the first output is ``shift`` samples after coarse[at]."""
    if step == 1:
        for m in range(BLOCK):
            k = _Q(m)
            out[k] = coarse[_Q(at) + k]
        return
    inverse = _F(1.0 / step)
    if step < 16:
        # Many short lines: point by point over all of them.
        n = (shift + BLOCK - 1) // step + 1
        for r in range(step):
            w, v = _F(1) - _F(r) * inverse, _F(r) * inverse
            for m in range(n):
                j = _Q(at) + _Q(m)
                wide[_Q(m) * _Q(step) + _Q(r)] = w * coarse[j] + v * coarse[j + _Q(1)]
        for m in range(BLOCK):
            out[_Q(m)] = wide[_Q(m) + _Q(shift)]
        return
    k, j, begin = 0, at, shift
    while k < BLOCK:
        n = min(step - begin, BLOCK - k)
        x0 = coarse[j]
        slope = (coarse[j + 1] - x0) * inverse
        x0 += slope * _F(begin)
        for m in range(n):
            out[_Q(k) + _Q(m)] = x0 + slope * _F(_I(m))
        k, j, begin = k + n, j + 1, 0


@njit(cache=True, nogil=True, fastmath=_FAST)
def _rotate(buf_i, buf_q, c, s):
    for m in range(BLOCK):
        k = _Q(m)
        x, y = buf_i[k], buf_q[k]
        buf_i[k] = x * c[k] - y * s[k]
        buf_q[k] = x * s[k] + y * c[k]


@njit(cache=True, nogil=True)
def add_narrowband(
    iq, n0, lo, hi, level, cell0, n_cell, carrier, seed, taps, phases, step, still
):  # fmt: skip
    """Noise of a lattice of white Gaussian points, one every phases x step samples, interpolated and shifted.

    A polyphase filter (``taps`` float32 (N_TAPS, width), width a multiple of ``phases``) gives the points every
    ``step`` samples, lines join them. ``still``: the carrier does not move, nothing is shifted.
    """
    width, flat = taps.shape[1], taps.ravel()
    n_spread = BLOCK + 2 * width + N_TAPS * phases
    lattice_i, lattice_q = np.empty(3 * BLOCK, np.float32), np.empty(3 * BLOCK, np.float32)
    hash1, hash2 = np.empty(BLOCK, np.uint32), np.empty(BLOCK, np.int32)
    spread_i, spread_q = np.empty(n_spread, np.float32), np.empty(n_spread, np.float32)
    coarse_i, coarse_q = np.zeros(BLOCK + 2 * width, np.float32), np.zeros(BLOCK + 2 * width, np.float32)
    buf_i, buf_q = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    c, s, wide = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK + 64, np.float32)
    base_i, base_q, based = np.empty(SUB, np.float32), np.empty(SUB, np.float32), np.int64(-1)
    held, count, b0 = np.int64(-9), 0, lo // BLOCK
    for block in range(b0, (hi - 1) // BLOCK + 1):
        first = block * BLOCK
        j0 = first // step
        m0 = j0 // phases
        n_coarse = (first + BLOCK - 1) // step + 2 - m0 * phases
        wanted = m0 // BLOCK
        if held >= 0 and 0 < wanted - held < 3:
            move = (wanted - held) * BLOCK
            for k in range(3 * BLOCK - move):
                lattice_i[k], lattice_q[k] = lattice_i[k + move], lattice_q[k + move]
            count = max(count - (wanted - held), 0)
        elif wanted != held:
            count = 0
        held = wanted
        while held + count <= (m0 + (n_coarse + width) // phases + N_TAPS) // BLOCK:
            x, y = (
                lattice_i[count * BLOCK : (count + 1) * BLOCK],
                lattice_q[count * BLOCK : (count + 1) * BLOCK],
            )
            noise_block(x, y, hash1, hash2, seed, _Q(held + count), _F(math.sqrt(0.5)))
            count += 1
        at = m0 - wanted * BLOCK
        n_points = (n_coarse + width) // phases + N_TAPS
        if phases == 1:
            spread_i[:n_points] = lattice_i[at : at + n_points]
            spread_q[:n_points] = lattice_q[at : at + n_points]
        else:
            _spread(spread_i, lattice_i, at, min(n_points, n_spread // phases), phases)
            _spread(spread_q, lattice_q, at, min(n_points, n_spread // phases), phases)
        _interpolate(coarse_i, n_coarse, spread_i, flat, width, phases)
        _interpolate(coarse_q, n_coarse, spread_q, flat, width, phases)
        _linear(buf_i, coarse_i, j0 - m0 * phases, first - j0 * step, step, wide)
        _linear(buf_q, coarse_q, j0 - m0 * phases, first - j0 * step, step, wide)
        if not still:
            based = _steady(c, s, block, cell0, n_cell, carrier, base_i, base_q, based)
            _rotate(buf_i, buf_q, c, s)
        _add(iq, n0, lo, hi, block, buf_i, buf_q, level, block - b0)


@njit(cache=True, nogil=True, fastmath=_FAST)
def _times_code(buf_i, buf_q, row, k0, k1, sign):
    for m in range(k1 - k0):
        k = _Q(m) + _Q(k0)
        chip = sign * _F(row[k])
        buf_i[k] *= chip
        buf_q[k] *= chip


@njit(cache=True, nogil=True)
def add_code(
    iq, n0, lo, hi, level, cell0, n_cell, carrier, seed, table, samples_per_period
):  # fmt: skip
    """A carrier under a long code, ``table`` int8 (P, n): rows 1/P sample apart; a random sign every period."""
    buf_i, buf_q = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    base_i, base_q = np.empty(SUB, np.float32), np.empty(SUB, np.float32)
    n_rows = table.shape[0]
    b0, based = lo // BLOCK, np.int64(-1)
    for block in range(b0, (hi - 1) // BLOCK + 1):
        first = block * BLOCK
        based = _steady(buf_i, buf_q, block, cell0, n_cell, carrier, base_i, base_q, based)
        turn = np.floor(first / samples_per_period)
        q = np.int64((first - turn * samples_per_period) * n_rows + 0.5)
        roll = min(max(np.int64(np.ceil(samples_per_period - q / n_rows)), 0), BLOCK)
        row = table[q % n_rows, q // n_rows :]
        for part in range(2):
            sign = _F(1) if _uniform(seed, np.int64(turn) + part) < 0.5 else _F(-1)
            _times_code(buf_i, buf_q, row, roll if part else 0, BLOCK if part else roll, sign)
        _add(iq, n0, lo, hi, block, buf_i, buf_q, level, block - b0)
