"""Whether the spectrum is upright, told by the tracked signals themselves: code must slide as the carrier does.

Code and carrier come from one clock: at Doppler f_d the code gains f_d / 1540 chips per second. In an inverted
spectrum the Doppler has the other sign and the code still slides its own way. Satellites of little Doppler are
tracked all the same, decode, and would yield a position that is wrong by tens of kilometres.
"""

import numpy as np

from signals.constants import CHIP_RATE_HZ, CYCLES_PER_CHIP
from signals.modulation import SIGNALS
from tracking.channel import STATE_LOCKED

LEAST_CHIPS = 3.0
"""A satellite is judged from this slide on: the code loop itself errs by tenths of a chip."""
LIKE = 0.15
"""The slide must be the one expected, or its opposite, within this part of it; else the code was not held."""


class CodeDrift:
    """Run that compares how far the code of each satellite slid with what its Doppler says."""

    def __init__(self, fs_hz: float) -> None:
        self.fs_hz = fs_hz
        self._chips: dict[tuple[str, int], np.ndarray] = {}

    def hear(self, signal: str, epochs: np.ndarray) -> None:
        """EPOCH rows of one channel over one slab, which is too short for half a code period of slide."""
        first, last = epochs[0], epochs[-1]
        if len(epochs) < 2 or first["state"] != STATE_LOCKED or last["state"] != STATE_LOCKED:
            return
        t_s = float(int(last["sample_index"]) - int(first["sample_index"])) / self.fs_hz
        seen = float(last["code_phase_chips"] - first["code_phase_chips"]) - CHIP_RATE_HZ * t_s
        length = SIGNALS[signal].code_length_chips
        expected = 0.5 * float(first["doppler_hz"] + last["doppler_hz"]) / CYCLES_PER_CHIP * t_s
        chips = self._chips.setdefault((signal, int(first["prn"])), np.zeros(2))
        chips += seen - length * round(seen / length), expected

    @property
    def inverted(self) -> bool:
        """Whether the codes slide against their Dopplers: of two satellites at least, and of more than do not."""
        seen, expected = (
            np.array([c for c in self._chips.values() if abs(c[1]) > LEAST_CHIPS]).reshape(-1, 2).T
        )
        like = [int(np.sum(np.abs(seen - sign * expected) < LIKE * np.abs(expected))) for sign in (-1, 1)]
        return like[0] >= 2 and like[0] > like[1]
