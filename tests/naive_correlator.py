"""Textbook twin of the tracking correlator: double precision, one sample after the other, the same replica table."""

import math

import numpy as np

from signals.constants import CHIP_RATE_HZ, F_L1_HZ


def periods(epoch, length, fs_hz):
    """First sample, samples, code phase of each code period of one integration (NCO constant)."""
    rate = CHIP_RATE_HZ * (1.0 + epoch["doppler_hz"] / F_L1_HZ) / fs_hz
    start, phase, left = int(epoch["sample_index"]), float(epoch["code_phase_chips"]), int(epoch["n_samples"])
    while left > 0:
        n = math.ceil((length - phase) / rate)
        yield start, n, phase, rate
        start, phase, left = start + n, phase + n * rate - length, left - n


def replica(table, taps_q, n, phase, rate):
    """Rows of the code table for one code period as the kernel's contract says: (taps, n) int, blocks <= 1024 (704)."""
    per_chip, n_phase = table.samples_per_chip, len(table.table)
    wrap = round(table.code_length_chips * per_chip * n_phase)
    longest = 1024 if table.scale == 1.0 else 704
    blocks = 2 * math.ceil(n / (2 * longest))
    block = min(longest, math.ceil(math.ceil(n / blocks) / 32) * 32)
    out = np.zeros((len(taps_q), n))
    for a in range(0, n, block):
        nb = min(block, n - a)
        middle = (phase + (a + nb / 2) * rate) * per_chip
        q0 = math.floor((middle - nb / 2) * n_phase + 0.5)
        for t, dq in enumerate(taps_q):
            q = (q0 + dq) % wrap
            out[t, a : a + nb] = table.table[q % n_phase, q // n_phase : q // n_phase + nb]
    return out * table.scale


def carrier(epoch, start, n, fs_hz, if_hz):
    """exp(-j phase) of the NCO for n samples from ``start``."""
    k = start + np.arange(n)
    cycles = epoch["carrier_phase_cycles"] + epoch["doppler_hz"] * (k - int(epoch["sample_index"])) / fs_hz
    return np.exp(-2j * np.pi * (cycles + np.mod(k * (if_hz / fs_hz), 1.0)))


def correlate(epoch, iq, table, taps_q, fs_hz, if_hz, signs=None):
    """All taps of one integration of samples ``iq`` (2, n) that begin at sample 0."""
    total = np.zeros(len(taps_q), complex)
    for k, (start, n, phase, rate) in enumerate(periods(epoch, table.code_length_chips, fs_hz)):
        z = (iq[0, start : start + n] + 1j * iq[1, start : start + n]) * carrier(
            epoch, start, n, fs_hz, if_hz
        )
        total += (1.0 if signs is None else signs[k]) * (replica(table, taps_q, n, phase, rate) @ z)
    return total / int(epoch["n_samples"])


def rounding_chips(epoch, table, fs_hz):
    """Mean over the integration of (phase the table was read at - nominal phase), chips."""
    per_chip, n_phase = table.samples_per_chip, len(table.table)
    total = 0.0
    for _, n, phase, rate in periods(epoch, table.code_length_chips, fs_hz):
        block = min(1024, math.ceil(math.ceil(n / (2 * math.ceil(n / 2048))) / 32) * 32)
        for a in range(0, n, block):
            nb = min(block, n - a)
            for_sample = np.arange(nb)
            first = math.floor(((phase + (a + nb / 2) * rate) * per_chip - nb / 2) * n_phase + 0.5) / n_phase
            total += np.sum((first + for_sample) / per_chip - (phase + (a + for_sample) * rate))
    return total / int(epoch["n_samples"])
