"""Textbook synthesis in double precision, sample by sample, from the definitions: no tables, no blocks, no cells."""

import numpy as np

from signals.codes import primary_code, secondary_code
from signals.constants import CHIP_RATE_HZ, F_L1_HZ
from signals.modulation import chip_waveform


def waveform_at(signal, prn, chips, waveform):
    """Code waveform at a code phase in chips (any real number)."""
    slots = chip_waveform(waveform)
    levels = np.outer(primary_code(signal, prn), slots).ravel()
    return levels[np.floor(np.mod(chips, len(levels) // len(slots)) * len(slots)).astype(int)]


def component(signal, prn, t_s, delay_s, phase_delay_s, if_hz, symbol_at, waveform):
    """s(t) = symbol x code(R (t - delay)) x exp(j 2 pi (f_if t - F_L1 phase_delay)), unit amplitude."""
    chips = CHIP_RATE_HZ * (t_s - delay_s)
    period = np.floor(chips / len(primary_code(signal, prn))).astype(int)
    carrier = np.exp(2j * np.pi * (if_hz * t_s - F_L1_HZ * phase_delay_s))
    return symbol_at(period) * waveform_at(signal, prn, chips, waveform) * carrier


def secondary_at(period):
    """CS25_1 at a code period counted from a whole second."""
    return secondary_code()[np.mod(period, 25)].astype(float)


def box_muller(u1, u2):
    """Complex Gaussian from two uniforms."""
    return np.sqrt(-2.0 * np.log(u1)) * np.exp(2j * np.pi * u2)
