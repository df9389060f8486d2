"""The tracking kernel: correlate, discriminate, filter and steer, channel by channel, one code period at a
time.

One call of ``track_slab`` takes every listed channel through all whole code periods of the samples given. The
unit of work is the code period of the channel's own replica, so results do not depend on where slabs are cut.

Correlator. Blocks of at most 1024 samples; per block one row and column of the code table per tap (all taps
share the rounding of the replica's phase, whose mean is removed from the code error), one carrier table per
frequency, the phase of a block applied to its sums. Up to 7 taps are wiped and correlated in one pass; more
go through a wiped buffer in L1.

The functions of ``discriminators`` and ``lock`` are compiled into this file's cache entry: clear
``__pycache__`` after editing them.
"""

import math

import numpy as np
from numba import njit

from signals.constants import CHIP_RATE_HZ, F_L1_HZ
from tracking.correlator_kernels import carrier_table, correlate_period, scratch
from tracking.discriminators import (
    COHERENT,
    FOUR_QUADRANT,
    carrier_error_cycles,
    code_error,
    frequency_error_hz,
)
from tracking.lock import (
    STATE_BIT_SYNC,
    STATE_IDLE,
    STATE_LOCKED,
    STATE_LOST,
    STATE_PULL_IN,
    carrier_lock,
    cn0_moments_dbhz,
    cn0_noise_reference_dbhz,
    code_lock,
)
from tracking.loops import ADAPT_LOW_DBHZ, ADAPT_ROWS

__all__ = ["CHANNEL", "HISTORY", "SYMBOL", "survey", "track_slab"]

HISTORY = 200
"""Prompts kept for the open-loop search: 200 ms of 1 ms (C/A), or 50 periods of 4 ms in halves (E1)."""
KIND_CA, KIND_PILOT, KIND_DATA = 0, 1, 2

SYMBOL = np.dtype(
    [
        ("sample_index", "u8"),  # first sample of the symbol
        ("code_period", "i8"),  # code periods since the channel started, at the symbol's start
        ("soft", "f4"),  # in-phase sum / samples; sign not resolved
        ("soft_q", "f4"),
    ]
)
"""One data symbol: 20 ms of C/A, 4 ms of E1-B."""

CHANNEL = np.dtype(
    [
        # What does not change while the channel runs.
        ("signal", "S4"),
        ("prn", "i4"),
        ("kind", "i4"),
        ("code_length_chips", "f8"),
        ("period_s", "f8"),
        ("samples_per_chip", "f8"),
        ("n_phase", "i8"),
        ("phase_shift", "i8"),  # log2(n_phase)
        ("wrap_q", "i8"),  # code period in 1/P samples, rounded
        ("wrap_error_q", "f8"),  # rounded minus exact
        ("table_start", "i8"),
        ("data_table_start", "i8"),
        ("table_columns", "i8"),
        ("longest_block", "i8"),
        ("scale", "f8"),
        ("data_scale", "f8"),
        ("n_taps", "i4"),
        ("n_sums", "i4"),  # taps + noise reference (+ data prompt)
        ("very_early", "i4"),  # -1: none
        ("early", "i4"),
        ("prompt", "i4"),
        ("late", "i4"),
        ("very_late", "i4"),
        ("very_offset_chips", "f8"),
        ("carrier_code", "i4"),
        ("code_code", "i4"),
        ("code_scale_chips", "f8"),
        ("pull_scale_chips", "f8"),  # of the power discriminator
        ("r_half", "f8"),  # R(d/2) / R(0)
        ("m_settle", "i4"),  # code periods per integration
        ("m_track", "i4"),
        ("n_stages", "i4"),  # of settling, each with half the carrier bandwidth of the one before
        ("pll_stages", "f8", (8, 3)),
        ("stage_s", "f8", 8),
        ("pll_track", "f8", 3),
        ("dll_pull", "f8"),
        ("dll_settle", "f8"),
        ("dll_track", "f8", 2),
        ("fll_settle", "f8"),
        ("fll_track", "f8"),
        ("adapt_s", "f8"),  # time constant of the C/N0 that the bandwidths follow; 0: they are fixed
        ("adapted", "f8", (ADAPT_ROWS, 7)),  # their gains against C/N0 (tracking.loops.adapted_gains)
        ("cn0_window_s", "f8"),
        ("cn0_min_dbhz", "f8"),
        ("lock_in", "f8"),
        ("lock_out", "f8"),
        ("lost_after_s", "f8"),
        # NCOs, at next_sample.
        ("state", "i4"),
        ("next_sample", "i8"),
        ("code_phase_chips", "f8"),
        ("code_period", "i8"),
        ("carrier_cycles", "f8"),
        ("doppler_hz", "f8"),
        ("doppler_rate_hz_s", "f8"),
        ("steered", "i4"),
        # Loop filters.
        ("rate_hz", "f8"),
        ("rate_hz_s", "f8"),
        ("code_rate_chips_s", "f8"),
        ("pll_bw_hz", "f8"),  # noise bandwidths now
        ("dll_bw_hz", "f8"),
        ("fast_prompt", "f8"),  # powers over the last adapt_s, and for how long
        ("fast_noise", "f8"),
        ("fast_s", "f8"),
        ("weaken", "f8"),
        # The integration that is running.
        ("m_done", "i4"),
        ("m_total", "i4"),
        ("n_acc", "i8"),
        ("start_sample", "i8"),
        ("start_period", "i8"),
        ("start_code_chips", "f8"),
        ("start_carrier_cycles", "f8"),
        ("start_doppler_hz", "f8"),
        ("rounding_sum", "f8"),
        ("noise_sum", "f8"),  # |noise tap|^2 per sample, of each of its code periods
        ("second_i", "f8"),
        ("second_q", "f8"),
        ("data_i", "f8"),
        ("data_q", "f8"),
        # Moments over the last one half to one window.
        ("noise_sums", "f8", (2, 2)),  # |noise tap|^2 per sample, count: previous and present half window
        ("moments", "f8", (2, 4)),  # I^2, Q^2, I^4, count
        ("lock_sums", "f8", (2, 4)),  # I^2 - Q^2, I^2 + Q^2, |E|^2 + |L|^2, count
        ("el_ema", "f8"),
        ("el_n", "f8"),
        ("half_i", "f8"),
        ("half_q", "f8"),
        ("half_p", "f8"),
        ("half_n", "f8"),
        ("bump_ve", "f8"),
        ("bump_p", "f8"),
        ("bump_vl", "f8"),
        ("bump_n", "f8"),
        # Synchronisation and lock.
        ("hist_n", "i4"),
        ("hist_period", "i8"),
        ("hist_sample", "i8"),
        ("attempts", "i4"),
        ("bit_energy", "f8", 20),
        # Products of successive prompts of 1 ms by code period mod 20: least where bits change.
        ("edges", "f8", 20),
        ("edge_i", "f8"),
        ("edge_q", "f8"),
        ("edge_n", "i8"),
        (
            "symbol_phase",
            "i8",
        ),  # C/A: code period modulo 20 at which bits start; E1-C: chip of CS25_1 at period 0
        ("symbol_i", "f8"),
        ("symbol_q", "f8"),
        ("symbol_n", "i8"),
        ("symbol_start", "i8"),
        ("symbol_period", "i8"),
        ("symbol_m", "i4"),
        ("settling", "i4"),
        ("stage", "i4"),
        ("stage_time_s", "f8"),
        ("marks", "i4"),
        ("mark_sample", "i8", 2),
        ("mark_cycles", "f8", 2),
        ("phase_locked", "i4"),
        ("lock_start_sample", "i8"),
        ("bad_s", "f8"),
        ("slips", "i8"),
        ("jumps", "i8"),
        ("cn0_dbhz", "f8"),
        ("cn0_prompt_dbhz", "f8"),
        ("carrier_lock", "f8"),
        ("code_lock", "f8"),
    ],
    align=True,
)
"""One channel: what is constant, its NCOs, filters, smoothed moments and lock state."""

_TWO_PI = 2.0 * math.pi
_TILE_BYTES = 1 << 18  # of I and Q together: a few of them fit the second-level cache


# -------------------------------------------------------------------------------------------- synchronisation
@njit(nogil=True)
def _peak_offset(left, mid, right):
    """Vertex of the parabola through three equidistant values, in steps, within +-1/2."""
    bend = left - 2.0 * mid + right
    if bend >= 0.0:
        return 0.0
    return min(0.5, max(-0.5, 0.5 * (left - right) / bend))


@njit(nogil=True)
def _turn_back(hist, n, dt, f, r, out):
    """hist[k] exp(-2 pi i (f t + r t^2 / 2)), t = (k + 1/2) dt from the middle of the n values."""
    dc, ds = 1.0, 0.0
    t = (0.5 - 0.5 * n) * dt
    w = _TWO_PI * (f * t + 0.5 * r * t * t)
    c, s = math.cos(w), math.sin(w)
    w = _TWO_PI * ((f + r * t) * dt + 0.5 * r * dt * dt)
    dc, ds = math.cos(w), math.sin(w)
    w = _TWO_PI * r * dt * dt
    ec, es = math.cos(w), math.sin(w)
    for k in range(n):
        out[k, 0] = hist[k, 0] * c + hist[k, 1] * s
        out[k, 1] = hist[k, 1] * c - hist[k, 0] * s
        c, s = c * dc - s * ds, c * ds + s * dc
        dc, ds = dc * ec - ds * es, dc * es + ds * ec


@njit(nogil=True)
def _angle_cycles(z):
    return math.atan2(z.imag, z.real) / _TWO_PI


@njit(nogil=True)
def _bit_energies(z, energy):
    """Energy of 9 sums of 20 prompts for each of 20 bit edges; returns the largest and its edge."""
    best, edge = -1.0, 0
    for e in range(20):
        total = 0.0
        for m in range(9):
            re = im = 0.0
            for k in range(e + 20 * m, e + 20 * m + 20):
                re += z[k, 0]
                im += z[k, 1]
            total += re * re + im * im
        energy[e] = total
        if total > best:
            best, edge = total, e
    return best, edge


@njit(nogil=True)
def _search_ca(hist, noise, energy):
    """Joint search over frequency (+-250 Hz), its rate (+-600 Hz/s) and bit edge: energies of 9 sums of 20 ms.

    hist: (200, 2) prompts of 1 ms with a fixed NCO. A rate is believed only where it brings more energy than noise
    would (20 times the noise of one sum). ``energy`` (20,): per bit edge at the best frequency. Returns (frequency
    error and its rate, phase in cycles, best energy); frequency and phase at the middle of the history.
    """
    step, dt = 10.0, 1e-3
    z, trial = np.empty((HISTORY, 2)), np.empty(20)
    best, f0 = -1.0, 0.0
    for k in range(-25, 26):
        _turn_back(hist, HISTORY, dt, k * step, 0.0, z)
        total, _ = _bit_energies(z, trial)
        if total > best:
            best, f0 = total, k * step
    still, f, r = best, f0, 0.0
    for m in range(-10, 11):
        for k in range(-5, 6):
            _turn_back(hist, HISTORY, dt, f0 + k * step, 60.0 * m, z)
            total, _ = _bit_energies(z, trial)
            if total > best and total > still + 20.0 * 20.0 * noise:
                best, f, r = total, f0 + k * step, 60.0 * m
    _turn_back(hist, HISTORY, dt, f, r, z)
    best, edge = _bit_energies(z, energy)
    _turn_back(hist, HISTORY, dt, f - step, r, z)
    _bit_energies(z, trial)
    left = trial[edge]
    _turn_back(hist, HISTORY, dt, f + step, r, z)
    _bit_energies(z, trial)
    f += step * _peak_offset(left, best, trial[edge])
    _turn_back(hist, HISTORY, dt, f, r, z)
    square = 0.0 + 0.0j
    for m in range(9):
        total = 0.0 + 0.0j
        for k in range(edge + 20 * m, edge + 20 * m + 20):
            total += complex(z[k, 0], z[k, 1])
        square += total * total
    return f, r, _angle_cycles(square) * 0.5, best


@njit(nogil=True)
def _pilot_energies(z, secondary, energy):
    """Energy of two sums of 25 periods (pairs of halves) for each of 25 chips of the secondary code."""
    best, chip = -1.0, 0
    for shift in range(25):
        total = 0.0
        for m in range(2):
            re = im = 0.0
            for k in range(25):
                sign = secondary[(shift + k) % 25]
                j = 50 * m + 2 * k
                re += sign * (z[j, 0] + z[j + 1, 0])
                im += sign * (z[j, 1] + z[j + 1, 1])
            total += re * re + im * im
        energy[shift] = total
        if total > best:
            best, chip = total, shift
    return best, chip


@njit(nogil=True)
def _search_pilot(hist, secondary, noise):
    """Joint search over frequency, its rate (+-300 Hz/s) and secondary-code phase: energies of 2 sums of 25 periods.

    hist: (100, 2) prompts of 2 ms (halves of a period). The phase between the halves gives the frequency within
    +-50 Hz first. Returns (frequency error and its rate, phase in cycles, chip at the first period, best energy, best
    energy of any other chip); frequency and phase at the middle.
    """
    step, dt, n = 2.5, 2e-3, HISTORY // 2
    z, trial, energy = np.empty((n, 2)), np.empty(25), np.zeros(25)
    f0, _ = _search_data(hist)
    best, still, f, r, chip = -1.0, 0.0, 0.0, 0.0, 0
    for m in range(21):
        rate = 30.0 * ((m + 1) // 2) * (1 if m & 1 else -1)  # 0, 30, -30, 60, ..
        for k in range(-20, 21):
            _turn_back(hist, n, dt, f0 + k * step, rate, z)
            total, shift = _pilot_energies(z, secondary, trial)
            for i in range(25):
                energy[i] = max(energy[i], trial[i])
            if total > best and (m == 0 or total > still + 20.0 * 25.0 * noise):
                best, f, r, chip = total, f0 + k * step, rate, shift
        if m == 0:
            still = best
    second = 0.0
    for i in range(25):
        if i != chip:
            second = max(second, energy[i])
    _turn_back(hist, n, dt, f - step, r, z)
    _pilot_energies(z, secondary, trial)
    left = trial[chip]
    _turn_back(hist, n, dt, f + step, r, z)
    _pilot_energies(z, secondary, trial)
    f += step * _peak_offset(left, best, trial[chip])
    _turn_back(hist, n, dt, f, r, z)
    total = 0.0 + 0.0j
    for k in range(50):
        total += secondary[(chip + k) % 25] * complex(
            z[2 * k, 0] + z[2 * k + 1, 0], z[2 * k, 1] + z[2 * k + 1, 1]
        )
    return f, r, _angle_cycles(total), chip, best, second


@njit(nogil=True)
def _search_data(hist):
    """Frequency from the phase between the halves of each 4 ms symbol (+-250 Hz): arg of sum h2 conj(h1).

    Returns (frequency error, |sum|).
    """
    re = im = 0.0
    for k in range(50):
        i1, q1, i2, q2 = hist[2 * k, 0], hist[2 * k, 1], hist[2 * k + 1, 0], hist[2 * k + 1, 1]
        re += i1 * i2 + q1 * q2
        im += i1 * q2 - i2 * q1
    return math.atan2(im, re) / (_TWO_PI * 2e-3), math.hypot(re, im)


@njit(nogil=True)
def _reset_moments(st):
    st.moments[:] = 0.0
    st.lock_sums[:] = 0.0
    st.half_i = st.half_q = st.half_p = st.half_n = 0.0
    st.bump_ve = st.bump_p = st.bump_vl = st.bump_n = 0.0


@njit(nogil=True)
def _shift_window(sums, half):
    """When the present half window is full, it becomes the previous one: nothing older than a window counts."""
    last = sums.shape[1] - 1
    if sums[1, last] >= half:
        for k in range(last + 1):
            sums[0, k] = sums[1, k]
            sums[1, k] = 0.0


@njit(nogil=True)
def _noise_power(st):
    """Noise power of one sample from the reference tap, and the number of code periods it rests on."""
    n = st.noise_sums[0, 1] + st.noise_sums[1, 1]
    return (st.noise_sums[0, 0] + st.noise_sums[1, 0]) / max(n, 1.0), n


@njit(nogil=True)
def _close_loops(st):
    """Symbols are aligned: from here on the loops run at the settling bandwidths."""
    st.state = STATE_LOCKED
    st.settling, st.stage, st.stage_time_s, st.marks = 1, 0, 0.0, 0
    st.phase_locked = 0
    st.bad_s = 0.0
    st.code_rate_chips_s = 0.0
    st.symbol_m, st.symbol_n = 0, 0
    st.symbol_i = st.symbol_q = 0.0
    st.edges[:] = 0.0
    st.edge_i = st.edge_q = 0.0
    st.edge_n = 0
    _reset_moments(st)


@njit(nogil=True)
def _retry(st, limit):
    st.attempts += 1
    if st.attempts > limit and st.steered == 0:
        st.state = STATE_LOST


@njit(nogil=True)
def _set_carrier(st, f, r, cycles):
    """Move the NCO to the carrier found: f, its rate r and phase hold at the middle of the history of 0.2 s."""
    if st.steered == 0:
        t = 0.1
        st.doppler_hz += f + r * t
        st.rate_hz, st.rate_hz_s = st.doppler_hz, r
        st.carrier_cycles += cycles + f * t + 0.5 * r * t * t


@njit(nogil=True)
def _past_symbols(st, hist, secondary, f, r, chip, symbols, count):
    """E1-B symbols of the history, once its frequency, rate and secondary-code phase are known.

    Each 25 periods are turned upright by the phase of their pilot sum, so that data begin where samples begin.
    """
    n = HISTORY // 2
    z = np.empty((n, 2))
    _turn_back(hist, n, 2e-3, f, r, z)
    data, upright = np.empty((n // 2, 2)), np.empty((n // 2, 2))
    for k in range(n // 2):
        data[k, 0], data[k, 1] = hist[n + k, 0], hist[n + k, 1]
    _turn_back(data, n // 2, 4e-3, f, r, upright)
    for m in range(2):
        re = im = 0.0
        for k in range(25):
            sign = secondary[(chip + k) % 25]
            re += sign * (z[50 * m + 2 * k, 0] + z[50 * m + 2 * k + 1, 0])
            im += sign * (z[50 * m + 2 * k, 1] + z[50 * m + 2 * k + 1, 1])
        norm = math.hypot(re, im)
        for k in range(25 * m, 25 * m + 25):
            if count < len(symbols):
                row = symbols[count]
                row.code_period = st.hist_period + k
                row.sample_index = st.hist_sample + np.int64(k * st.samples_per_chip * st.code_length_chips)
                row.soft = (upright[k, 0] * re + upright[k, 1] * im) / norm
                row.soft_q = (upright[k, 1] * re - upright[k, 0] * im) / norm
                count += 1
    return count


@njit(nogil=True)
def _synchronise(st, hist, secondary, noise, symbols, count):
    """Use a full history: find the frequency and the symbol (or secondary-code) edge, or try again.

    noise: power of a prompt of one code period. Thresholds: the sums of noise alone exceed them with less
    than 1e-5 (chi-square of 18 degrees of freedom, about 150 independent cells; of 4, about 4000; the mean of
    50 products).
    """
    st.hist_n = 0
    if _bump_decision(st, 1.5):
        return count
    if st.kind == KIND_CA:
        energy = np.empty(20)
        f, rate, cycles, best = _search_ca(hist, noise, energy)
        if best < 4.0 * 180.0 * noise:
            st.state = STATE_PULL_IN
            st.bit_energy[:] = 0.0
            _retry(st, 5)
            return count
        st.state = STATE_BIT_SYNC
        _set_carrier(st, f, rate, cycles)
        top, second, edge = -1.0, -1.0, 0
        for e in range(20):
            k = (st.hist_period + e) % 20
            st.bit_energy[k] += energy[e]
        for k in range(20):
            x = st.bit_energy[k]
            if x > top:
                second, top, edge = top, x, k
            elif x > second:
                second = x
        # Neighbouring edges share 19 of 20 prompts per sum; the noise of their difference has variance
        # 4 |S|^2 noise per sum. Four standard deviations between the first and the second decide.
        if top - second > 4.0 * math.sqrt(4.0 * top * noise):
            st.symbol_phase = edge
            _close_loops(st)
        else:
            _retry(st, 20)
    elif st.kind == KIND_PILOT:
        f, rate, cycles, chip, best, second = _search_pilot(hist, secondary, noise)
        if best < 25.0 * 25.0 * noise or best < 1.5 * second:
            _retry(st, 5)
            return count
        count = _past_symbols(st, hist, secondary, f, rate, chip, symbols, count)
        _set_carrier(st, f, rate, cycles)
        st.symbol_phase = (chip - st.hist_period) % 25
        _close_loops(st)
    else:
        f, magnitude = _search_data(hist)
        # Products of halves: variance of the mean of 50, each half with power 2 noise.
        if magnitude < 4.0 * math.sqrt(50.0) * 2.0 * noise:
            _retry(st, 5)
            return count
        _set_carrier(st, f, 0.0, 0.0)
        st.symbol_phase = 0
        _close_loops(st)
    return count


@njit(nogil=True)
def _bump_decision(st, ratio):
    """Jump to the very-early or very-late tap where it holds ``ratio`` times the prompt's power.

    The side peaks of BOC(1,1) are half a chip from the main one with a quarter of its power and the opposite
    sign (bump jumping: Fine & Wilson, ION NTM 1999).
    """
    if st.very_early < 0 or st.steered != 0:
        return False
    jump = 0.0
    if st.bump_ve > ratio * st.bump_p and st.bump_ve > st.bump_vl:
        jump = st.very_offset_chips
    elif st.bump_vl > ratio * st.bump_p:
        jump = -st.very_offset_chips
    st.bump_ve = st.bump_p = st.bump_vl = st.bump_n = 0.0
    if jump == 0.0:
        return False
    st.code_phase_chips += jump
    st.jumps += 1
    if st.carrier_code == FOUR_QUADRANT:
        st.carrier_cycles += 0.5
    _reset_moments(st)
    return True


# ------------------------------------------------------------------------------------------------------ loops
@njit(nogil=True)
def _begin(st, command, fs_hz):
    """Start an integration: apply steering, choose the number of code periods."""
    early = st.next_sample < np.int64(command.sample_index)
    if command.steered != 0 and early and st.steered != 0:
        pass  # the command before this one still holds: the NCO runs on with its rate
    elif command.steered != 0 and not early:
        dt = (st.next_sample - np.int64(command.sample_index)) / fs_hz
        rate = command.doppler_rate_hz_s
        mean_doppler = command.doppler_hz + 0.5 * rate * dt
        phase = command.code_phase_chips + dt * CHIP_RATE_HZ * (1.0 + mean_doppler / F_L1_HZ)
        length = st.code_length_chips
        shift = phase - st.code_phase_chips
        shift -= math.floor(shift / length + 0.5) * length
        st.code_phase_chips += shift
        st.doppler_hz = command.doppler_hz + rate * dt
        st.doppler_rate_hz_s = rate
        st.rate_hz, st.rate_hz_s, st.code_rate_chips_s = st.doppler_hz, 0.0, 0.0
        st.steered = 1
    else:
        st.doppler_rate_hz_s = 0.0
        st.steered = 0
    st.weaken = max(command.weaken, 1.0)
    m = 1
    if st.state == STATE_LOCKED:
        m = st.m_settle if st.settling else st.m_track
        if st.kind == KIND_CA:
            m -= (st.code_period - st.symbol_phase) % m
    st.m_total, st.m_done, st.n_acc = m, 0, 0
    st.start_sample, st.start_period = st.next_sample, st.code_period
    st.start_code_chips, st.start_carrier_cycles = st.code_phase_chips, st.carrier_cycles
    st.start_doppler_hz = st.doppler_hz
    st.rounding_sum = st.noise_sum = st.second_i = st.second_q = st.data_i = st.data_q = 0.0


@njit(nogil=True)
def _pull_in_code(st, e, late, noise):
    """DLL of one code period before synchronisation: power discriminator over a smoothed, noise-free norm."""
    e2, l2 = e.real * e.real + e.imag * e.imag, late.real * late.real + late.imag * late.imag
    st.el_n = min(st.el_n + 1.0, 20.0)
    st.el_ema += (e2 + l2 - st.el_ema) / st.el_n
    norm = max(st.el_ema - 2.0 * noise, 0.3 * st.el_ema)
    if norm <= 0.0:
        return 0.0
    return min(0.3, max(-0.3, (e2 - l2) / norm * st.pull_scale_chips))


@njit(nogil=True)
def _smooth(st, p, e2l2, ve2, vl2, T_s):
    """Collect the moments of one integration."""
    i2, q2 = p.real * p.real, p.imag * p.imag
    _shift_window(st.moments, max(4.0, 0.5 * st.cn0_window_s / T_s))
    m = st.moments[1]
    m[0] += i2
    m[1] += q2
    m[2] += i2 * i2
    m[3] += 1.0
    _shift_window(st.lock_sums, max(3.0, 0.125 / T_s))
    m = st.lock_sums[1]
    m[0] += i2 - q2
    m[1] += i2 + q2
    m[2] += e2l2
    m[3] += 1.0
    st.bump_ve += ve2
    st.bump_p += i2 + q2
    st.bump_vl += vl2
    st.bump_n += 1.0


@njit(nogil=True)
def _estimate_cn0(st, T_s, fs_hz):
    m = st.moments
    n = m[0, 3] + m[1, 3]
    i2, q2, i4 = (m[0, 0] + m[1, 0]) / n, (m[0, 1] + m[1, 1]) / n, (m[0, 2] + m[1, 2]) / n
    noise, n_noise = _noise_power(st)
    st.cn0_dbhz = cn0_noise_reference_dbhz(i2 + q2, st.n_acc, noise, n_noise, fs_hz)
    st.cn0_prompt_dbhz = cn0_moments_dbhz(i2, i4, n, T_s)


@njit(nogil=True)
def _update_lock(st, noise, T_s, fs_hz, phase_error):
    """C/N0, lock indicators with hysteresis, cycle-slip flag. Returns the flag."""
    _estimate_cn0(st, T_s, fs_hz)
    m = st.lock_sums
    n = m[0, 3] + m[1, 3]
    power = (m[0, 1] + m[1, 1]) / n
    st.carrier_lock = carrier_lock((m[0, 0] + m[1, 0]) / n, power, noise)
    st.code_lock = code_lock((m[0, 2] + m[1, 2]) / n, power, noise, st.r_half)
    slip = 0
    if st.phase_locked:
        if st.carrier_lock < st.lock_out:
            st.phase_locked = 0
            slip = 1
        elif abs(phase_error) > (0.4 if st.carrier_code == FOUR_QUADRANT else 0.2):
            slip = 1
    elif st.carrier_lock > st.lock_in and n * T_s >= 0.1 and n >= 4.0:
        st.phase_locked = 1
        st.lock_start_sample = st.next_sample
    if n >= 4.0:  # young averages do not count either way
        bad = st.carrier_lock < st.lock_out or st.cn0_dbhz < st.cn0_min_dbhz
        st.bad_s = st.bad_s + T_s if bad else max(0.0, st.bad_s - T_s)
    if st.bad_s > st.lost_after_s and st.steered == 0:
        st.state = STATE_LOST
        st.phase_locked = 0
    st.slips += slip
    return slip


@njit(nogil=True)
def _false_frequency(st, i1, q1, i2, q2, T_s):
    """A Costas loop also settles at fractions and multiples of 1 / (2 T): the halves show it; jump back.

    The mean product of halves must hold 0.6 of what a noise-free signal at that alias gives, over 0.3 s.
    """
    st.half_i += i1 * i2 + q1 * q2
    st.half_q += i1 * q2 - i2 * q1
    st.half_p += i1 * i1 + q1 * q1 + i2 * i2 + q2 * q2
    st.half_n += 1.0
    if st.half_n < max(10.0, 0.3 / T_s):
        return False
    re, im, whole = st.half_i, st.half_q, st.half_p
    st.half_i = st.half_q = st.half_p = st.half_n = 0.0
    f = math.atan2(im, re) / (_TWO_PI * 0.5 * T_s)
    if st.steered != 0 or abs(f) < 0.15 / T_s or math.hypot(re, im) < 0.3 * whole:
        return False
    st.rate_hz += f
    st.doppler_hz = st.rate_hz
    st.settling, st.stage, st.stage_time_s, st.marks = 1, 0, 0.0, 0
    _reset_moments(st)
    return True


@njit(nogil=True)
def _steer(st, phase_error, freq_error, code_err, T_s):
    """Loop filters of one integration (equations in ``loops.py``)."""
    k1, k2, k3, fll = st.pll_track[0], st.pll_track[1], st.pll_track[2], st.fll_track
    if st.settling:
        k = st.pll_stages[st.stage]
        k1, k2, k3 = k[0], k[1], k[2]
        fll = st.fll_settle if st.stage == 0 else 0.0
    st.rate_hz_s += k3 * phase_error / (T_s * T_s)
    st.rate_hz += k2 * phase_error / T_s + st.rate_hz_s * T_s + fll * freq_error
    st.doppler_hz = st.rate_hz + k1 * phase_error / T_s
    if st.settling:
        st.code_phase_chips += st.dll_settle * code_err
    else:
        st.code_rate_chips_s += st.dll_track[1] * code_err / T_s
        st.code_phase_chips += st.dll_track[0] * code_err


@njit(nogil=True)
def _adapt(st, prompt_power, T_s):
    """Loop gains of the C/N0 of the last ``adapt_s``, so much lower as monitors ask (``loops.adapted_gains``).

    A strong signal that is gone, and noise five deviations above its mean, count at once.
    """
    st.fast_s += T_s
    k = T_s / min(st.fast_s, st.adapt_s + T_s)
    noise = st.noise_sum / (st.m_total * st.n_acc)
    if prompt_power < 0.1 * st.fast_prompt and st.fast_prompt > 10.0 * st.fast_noise:
        st.fast_prompt = prompt_power
    if noise > (1.0 + 5.0 / math.sqrt(st.m_total)) * st.fast_noise:
        st.fast_noise = noise
    st.fast_prompt += k * (prompt_power - st.fast_prompt)
    st.fast_noise += k * (noise - st.fast_noise)
    snr = st.fast_prompt / max(st.fast_noise, 1e-30) - 1.0
    y = 10.0 * math.log10(max(snr, 1e-9) / (T_s * st.weaken)) - ADAPT_LOW_DBHZ
    y = min(max(y, 0.0), ADAPT_ROWS - 1.000001)
    i = int(y)
    w = y - i
    low, high = st.adapted[i], st.adapted[i + 1]
    for c in range(3):
        st.pll_track[c] = (1.0 - w) * low[c] + w * high[c]
    st.dll_track[0] = (1.0 - w) * low[3] + w * high[3]
    st.fll_track = (1.0 - w) * low[4] + w * high[4]
    st.pll_bw_hz = (1.0 - w) * low[5] + w * high[5]
    st.dll_bw_hz = (1.0 - w) * low[6] + w * high[6]


@njit(nogil=True)
def _settle(st, T_s, fs_hz):
    """Narrow the carrier loop in stages, each with half the bandwidth of the one before.

    The filter's rate is noisy after a wide stage and a narrow loop would take seconds to forget it, so frequency and
    rate are set anew from the NCO's phase at the last three thirds of the stage (parabola through three points).
    """
    st.stage_time_s += T_s
    third = st.stage_s[st.stage] / 3.0
    if st.phase_locked == 0:
        st.marks = 0
        return
    since = st.stage_time_s if st.marks == 0 else (st.next_sample - st.mark_sample[st.marks - 1]) / fs_hz
    if since < third:
        return
    if st.marks < 2:
        st.mark_sample[st.marks], st.mark_cycles[st.marks] = st.next_sample, st.carrier_cycles
        st.marks += 1
        return
    t01, t12 = (st.mark_sample[1] - st.mark_sample[0]) / fs_hz, since
    d01 = (st.mark_cycles[1] - st.mark_cycles[0]) / t01
    d12 = (st.carrier_cycles - st.mark_cycles[1]) / t12
    a = 2.0 * (d12 - d01) / (t01 + t12)
    st.rate_hz = d12 + 0.5 * a * t12
    st.rate_hz_s = a if st.pll_track[2] != 0.0 else 0.0
    st.stage += 1
    st.stage_time_s, st.marks = 0.0, 0
    if st.stage >= st.n_stages:
        st.settling = 0
        if st.m_settle != st.m_track:
            _reset_moments(st)


@njit(nogil=True)
def _tap(acc, t, norm):
    return complex(acc[2 * t] * norm, acc[2 * t + 1] * norm)


@njit(nogil=True)
def _finish(st, acc, hist, secondary, fs_hz, epoch, corr, symbols, count):
    """End of an integration: discriminators, loops, lock; fills the EPOCH record and its correlator row.

    Returns the number of ``symbols``, which grows where synchronisation reveals those of the past.
    """
    n = st.n_acc
    norm = st.scale / n
    T_s = st.m_total * st.period_s
    p, e, late = _tap(acc, st.prompt, norm), _tap(acc, st.early, norm), _tap(acc, st.late, norm)
    ve = vl = complex(0.0, 0.0)
    if st.very_early >= 0:
        ve, vl = _tap(acc, st.very_early, norm), _tap(acc, st.very_late, norm)
    i2, q2 = st.second_i * norm, st.second_q * norm
    i1, q1 = p.real - i2, p.imag - q2
    rounding = st.rounding_sum / n
    noise = _noise_power(st)[0] / n
    state = st.state
    phase_error = carrier_error_cycles(st.carrier_code, p.real, p.imag)
    freq_error = frequency_error_hz(i1, q1, i2, q2, 0.5 * T_s)
    slip = 0
    doppler_used, rate_used = st.start_doppler_hz, st.doppler_rate_hz_s
    _smooth(
        st,
        p,
        e.real**2 + e.imag**2 + late.real**2 + late.imag**2,
        ve.real**2 + ve.imag**2,
        vl.real**2 + vl.imag**2,
        T_s,
    )
    if state == STATE_LOCKED:
        code = st.code_code
        if code == COHERENT and st.phase_locked == 0:
            code = 0
        code_err = code_error(code, ve, e, p, late, vl) * st.code_scale_chips + rounding
        slip = _update_lock(st, noise, T_s, fs_hz, phase_error)
        whole = st.m_total == (
            st.m_settle if st.settling else st.m_track
        )  # not one cut short to meet a bit edge
        if st.steered == 0 and st.state == STATE_LOCKED and not whole:
            st.rate_hz += st.rate_hz_s * T_s
            st.doppler_hz = st.rate_hz
        elif st.steered == 0 and st.state == STATE_LOCKED:
            if st.adapt_s > 0.0:
                _adapt(st, p.real**2 + p.imag**2, T_s)
            _steer(st, phase_error, freq_error, code_err, T_s)
            _false_frequency(st, i1, q1, i2, q2, T_s)
            if st.bump_n * T_s >= 0.1 and st.bump_n >= 4.0 and _bump_decision(st, 1.5):
                slip = 1
        if st.settling and st.steered == 0:
            _settle(st, T_s, fs_hz)
    else:
        code_err = _pull_in_code(st, e, late, noise) + rounding
        if st.steered == 0:
            st.code_phase_chips += st.dll_pull * code_err
        _estimate_cn0(st, T_s, fs_hz)
        if st.hist_n == 0:
            st.hist_period, st.hist_sample = st.start_period, st.start_sample
        if st.kind == KIND_CA:
            hist[st.hist_n, 0], hist[st.hist_n, 1] = p.real, p.imag
            st.hist_n += 1
        else:
            hist[st.hist_n, 0], hist[st.hist_n, 1] = i1, q1
            hist[st.hist_n + 1, 0], hist[st.hist_n + 1, 1] = i2, q2
            past = HISTORY // 2 + st.hist_n // 2
            hist[past, 0], hist[past, 1] = st.data_i * st.data_scale / n, st.data_q * st.data_scale / n
            st.hist_n += 2
        if st.hist_n >= (HISTORY if st.kind == KIND_CA else HISTORY // 2):
            count = _synchronise(st, hist, secondary, noise, symbols, count)
    for t in range(st.n_taps):
        corr[t] = np.complex64(_tap(acc, t, norm))
    epoch.sample_index = st.start_sample
    epoch.n_samples = n
    epoch.prn = st.prn
    epoch.state = state
    epoch.symbol_index = st.start_period
    epoch.tow_s = math.nan
    epoch.code_phase_chips = st.start_code_chips
    epoch.carrier_phase_cycles = st.start_carrier_cycles
    epoch.doppler_hz = doppler_used
    epoch.doppler_rate_hz_s = rate_used
    epoch.code_rate_hz = CHIP_RATE_HZ * (1.0 + doppler_used / F_L1_HZ) + st.code_rate_chips_s
    epoch.prompt_i, epoch.prompt_q = p.real, p.imag
    epoch.prompt2_i, epoch.prompt2_q = i2, q2
    epoch.data_i, epoch.data_q = st.data_i * st.data_scale / n, st.data_q * st.data_scale / n
    noise_tap = _tap(acc, st.n_taps, norm)
    epoch.noise_i, epoch.noise_q = noise_tap.real, noise_tap.imag
    epoch.noise_power = noise
    epoch.code_error_chips = code_err
    epoch.phase_error_cycles = phase_error
    epoch.freq_error_hz = freq_error
    epoch.cn0_dbhz = st.cn0_dbhz
    epoch.cn0_prompt_dbhz = st.cn0_prompt_dbhz
    epoch.carrier_lock = st.carrier_lock
    epoch.code_lock = st.code_lock
    epoch.cycle_slip = slip
    if state == STATE_LOCKED and st.steered == 0 and st.settling == 0:
        epoch.pll_bw_hz, epoch.dll_bw_hz = st.pll_bw_hz, st.dll_bw_hz
    return count


@njit(nogil=True)
def _watch_edges(st, i, q):
    """Give a C/A channel up whose bits change at another code period than it believes: samples are missing.

    The mean product of successive prompts is A^2 (1 - 2 p) where bits change, with p near 1/2, and A^2 elsewhere. Over
    100 bits the least must be the expected one, but for half of A^2 and seven standard deviations of the others.
    """
    st.edges[st.code_period % 20] += i * st.edge_i + q * st.edge_q
    st.edge_i, st.edge_q = i, q
    st.edge_n += 1
    if st.edge_n < 2000:
        return
    own, least, total, squares = st.edges[st.symbol_phase % 20], math.inf, 0.0, 0.0
    for k in range(20):
        least = min(least, st.edges[k])
        total += st.edges[k]
        squares += st.edges[k] * st.edges[k]
    mean = (total - least) / 19.0
    spread = math.sqrt(max((squares - least * least) / 19.0 - mean * mean, 0.0))
    if own - least > 0.5 * mean + 7.0 * spread and st.steered == 0:
        st.state = STATE_LOST
        st.phase_locked = 0
    st.edges[:] = 0.0
    st.edge_n = 0


@njit(nogil=True)
def _symbols(st, sums, n, start_sample, out, count):
    """Collect data symbols from one code period; returns the new count."""
    if st.state != STATE_LOCKED:
        return count
    if st.kind == KIND_CA:
        _watch_edges(st, sums[2 * st.prompt], sums[2 * st.prompt + 1])
    t = st.n_taps + 1 if st.kind == KIND_PILOT else st.prompt
    scale = st.data_scale if st.kind == KIND_PILOT else st.scale
    length = 20 if st.kind == KIND_CA else 1
    if st.kind == KIND_CA and (st.code_period - st.symbol_phase) % 20 == 0:
        st.symbol_m = 0
        st.symbol_i = st.symbol_q = 0.0
        st.symbol_n = 0
        st.symbol_start, st.symbol_period = start_sample, st.code_period
    elif st.kind == KIND_CA and st.symbol_n == 0:
        return count  # joined in the middle of a bit
    if st.kind != KIND_CA:
        st.symbol_m, st.symbol_n = 0, 0
        st.symbol_i = st.symbol_q = 0.0
        st.symbol_start, st.symbol_period = start_sample, st.code_period
    st.symbol_i += sums[2 * t]
    st.symbol_q += sums[2 * t + 1]
    st.symbol_n += n
    st.symbol_m += 1
    if st.symbol_m < length or count >= len(out):
        return count
    row = out[count]
    row.sample_index = st.symbol_start
    row.code_period = st.symbol_period
    row.soft = st.symbol_i * scale / st.symbol_n
    row.soft_q = st.symbol_q * scale / st.symbol_n
    st.symbol_n = 0
    return count + 1


@njit(nogil=True)
def _accumulate(st, acc, sums, n, sign):
    """Add one code period to the integration and to the noise estimate."""
    n_sums = st.n_sums
    for k in range(2 * st.n_taps + 2):
        acc[k] += sign * sums[k]
    if n_sums > st.n_taps + 1:
        st.data_i += sums[2 * st.n_taps + 2]
        st.data_q += sums[2 * st.n_taps + 3]
    noise_i, noise_q = sums[2 * st.n_taps] * st.scale, sums[2 * st.n_taps + 1] * st.scale
    _shift_window(st.noise_sums, max(4.0, 0.5 * st.cn0_window_s / st.period_s))
    power = (noise_i * noise_i + noise_q * noise_q) / n
    st.noise_sum += power
    st.noise_sums[1, 0] += power
    st.noise_sums[1, 1] += 1.0
    if 2 * st.m_done + 1 == st.m_total:
        st.second_i += sign * sums[2 * n_sums]
        st.second_q += sign * sums[2 * n_sums + 1]
    elif 2 * st.m_done >= st.m_total:
        st.second_i += sign * sums[2 * st.prompt]
        st.second_q += sign * sums[2 * st.prompt + 1]


@njit(nogil=True, error_model="numpy")
def _run_channel(st, until, integer, xi, xq, first, fs_hz, if_hz, pool, tap_q, secondary, acc, hist, command,
                 epochs, k, corr, symbols, n_symbols, work, sums):  # fmt: skip
    """Take one channel through the code periods that begin before sample ``until`` -> (epochs, symbols) filled."""
    end = first + len(xi)
    if_step = if_hz / fs_hz
    table_hz = math.nan
    work[3][:] = np.uint64(st.table_start)
    while STATE_PULL_IN <= st.state <= STATE_LOCKED and first <= st.next_sample < until and k < len(epochs):
        if st.m_done == 0 and st.n_acc == 0:
            _begin(st, command, fs_hz)
            acc[:] = 0.0
        rough = st.doppler_hz
        if st.doppler_rate_hz_s != 0.0:
            rough += st.doppler_rate_hz_s * ((st.next_sample - st.start_sample) / fs_hz + 0.5 * st.period_s)
        rate = (CHIP_RATE_HZ * (1.0 + rough / F_L1_HZ) + st.code_rate_chips_s) / fs_hz
        n = np.int64(math.ceil((st.code_length_chips - st.code_phase_chips) / rate))
        if st.next_sample + n > end:
            break
        if rough != table_hz:
            carrier_table((if_hz + rough) / fs_hz, work[0], work[1])
            table_hz = rough
        turns = if_step * st.next_sample
        theta = turns - math.floor(turns) + st.carrier_cycles
        theta -= math.floor(theta)
        sign = 1.0
        if st.kind == KIND_PILOT and st.state == STATE_LOCKED:
            sign = secondary[(st.code_period + st.symbol_phase) % 25]
        st.rounding_sum += correlate_period(
            st, integer, xi, xq, st.next_sample - first, n, theta, (if_hz + rough) / fs_hz, rate, pool, tap_q, work,
            sums,
        )  # fmt: skip
        _accumulate(st, acc, sums, n, sign)
        n_symbols = _symbols(st, sums, n, st.next_sample, symbols, n_symbols)
        st.m_done += 1
        st.n_acc += n
        st.next_sample += n
        st.code_period += 1
        st.code_phase_chips += n * rate - st.code_length_chips
        st.carrier_cycles += rough * n / fs_hz
        if st.m_done >= st.m_total:
            if st.doppler_rate_hz_s != 0.0:
                st.doppler_hz += st.doppler_rate_hz_s * st.n_acc / fs_hz
            n_symbols = _finish(st, acc, hist, secondary, fs_hz, epochs[k], corr[k], symbols, n_symbols)
            st.m_done, st.n_acc = 0, 0
            k += 1
    return k, n_symbols


@njit(cache=True, nogil=True)
def survey(ch, which):
    """Channels that take samples into ``which`` (C,) -> (their number, the oldest sample they need; -1: none)."""
    count, oldest = 0, np.int64(-1)
    for c in range(len(ch)):
        st = ch[c]
        if st.state != STATE_IDLE and st.state != STATE_LOST:
            which[count] = c
            oldest = st.next_sample if count == 0 else min(oldest, st.next_sample)
            count += 1
    return count, oldest


@njit(cache=True, nogil=True)
def track_slab(which, integer, xi, xq, first, fs_hz, if_hz, pool, tap_q, secondary, ch, acc, hist,
               commands, epochs, counts, corr, symbols, symbol_counts):  # fmt: skip
    """Take the channels ``which`` through every whole code period that begins within the samples.

    Channels take turns in tiles that stay in the cache.

    Parameters
    ----------
    which : int64 (W,)
        Channels to run.
    integer : int
        1: 16-bit integer loops (int8 samples where ``vector_ir.HAS_INTEGER_PATH``); 0: single precision.
    xi, xq : int8 | int16 | float32 (n,)
        Samples from ``first`` on.
    pool : int8 (n,)
        All code tables, row after row.
    tap_q : int64 (C, K + 2)
        Tap offsets in 1/P samples: taps, noise reference, data prompt.
    secondary : float64 (25,)
        CS25_1, +-1.
    ch : CHANNEL (C,)
        State, changed in place; with ``acc`` float64 (C, 2 K + 4) and ``hist`` float64 (C, HISTORY, 2).
    commands : AIDING (C,)
    epochs : EPOCH (C, n_max); corr : complex64 (C, n_max, K); symbols : SYMBOL (C, n_max + HISTORY / 4)
        Outputs; ``counts`` and ``symbol_counts`` int64 (C,) say how many rows are filled, before and after.
    """
    work = scratch(tap_q.shape[1])
    sums = np.zeros(2 * tap_q.shape[1] + 4)
    tile = _TILE_BYTES // (2 * xi.itemsize)
    for begin in range(first, first + len(xi), tile):
        for c in which:
            counts[c], symbol_counts[c] = _run_channel(
                ch[c], begin + tile, integer, xi, xq, first, fs_hz, if_hz, pool,
                tap_q[c], secondary, acc[c], hist[c], commands[c], epochs[c], counts[c], corr[c], symbols[c],
                symbol_counts[c], work, sums,
            )  # fmt: skip
