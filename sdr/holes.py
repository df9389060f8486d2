"""Samples that are missing in the middle of a recording: when, and how many, told by the signals themselves.

A hole disturbs all channels at once, for the carrier of each jumps by its own Doppler times what is missing; so do other
things, a jammer for one. That it was a hole shows when the messages have told the time anew: GPS time then runs ahead
of the count of the samples by what is missing.
"""

import numpy as np

from signals.constants import C_MPS, SECONDS_PER_WEEK
from tracking.channel import STATE_LOCKED

HOLE = np.dtype(
    [
        ("sample_index", "u8"),  # the hole lies before about this sample
        ("t_s", "f8"),  # of that sample
        ("missing_s", "f8"),  # how much; negative: samples are there twice
        ("seen_s", "f8"),  # of the first position in the new time
    ]
)
"""A hole in a recording."""
DISTURBED_CYCLES = 0.08
"""Phase error that a locked loop does not have of its own, but two of three jumps of the carrier leave."""
TOGETHER_S = 0.06
"""Channels that are disturbed within this time are so by one cause."""
CALM_S = 0.5
"""A channel counts as disturbed anew after so much calm."""
FEWEST = 3
LEAST_S = 20e-6
"""Steps of the clock below this are not called a hole: an oscillator may make them."""
WANDER = 1e-7
"""How much an oscillator may run otherwise than it did at the last position."""


class Holes:
    """Run that hears the channels and the positions of a receiver."""

    def __init__(self, fs_hz: float) -> None:
        self.fs_hz = fs_hz
        self._began: dict[int, int] = {}  # channel -> sample at which its present disturbance began
        self._last: dict[int, int] = {}  # channel -> its last disturbed sample
        self._disturbed: list[int] = []  # samples at which all were disturbed since time was sure
        self._fix: np.void | None = None

    def hear(self, heard: list[tuple[int, np.ndarray, np.ndarray]]) -> bool:
        """(channel, EPOCH rows, ..) of a slab -> whether most locked channels began to be disturbed together in it."""
        begun: list[int] = []
        for c, epochs, _ in heard:
            if not np.any(np.abs(epochs["phase_error_cycles"]) > DISTURBED_CYCLES):
                continue
            own = _followed(epochs)
            for sample in own["sample_index"][np.abs(own["phase_error_cycles"]) > DISTURBED_CYCLES].tolist():
                if sample - self._last.get(c, -(1 << 62)) > CALM_S * self.fs_hz:
                    self._began[c] = sample
                    begun.append(sample)
                self._last[c] = sample
        if not begun:
            return False
        locked = sum(len(_followed(epochs)) > 0 for _, epochs, _ in heard)
        recent = sorted(self._began.values())
        for first in begun:
            near = [s for s in recent if abs(s - first) < TOGETHER_S * self.fs_hz]
            if len(near) >= max(FEWEST, locked / 2):
                self._began.clear()
                self._disturbed.append(near[0])
                return True
        return False

    def fix(self, row: np.void) -> np.ndarray:
        """A valid SOLUTION row -> HOLE rows: one if time ran otherwise than the samples since the last position."""
        before, self._fix = self._fix, row.copy()
        if before is None:
            return np.zeros(0, HOLE)
        span_s = float(int(row["sample_index"]) - int(before["sample_index"])) / self.fs_hz
        half_s = SECONDS_PER_WEEK / 2
        passed_s = (float(row["tow_s"] - before["tow_s"]) + half_s) % SECONDS_PER_WEEK - half_s
        missing_s = passed_s - span_s * (1.0 - float(before["clock_drift_mps"]) / C_MPS)
        if abs(missing_s) < LEAST_S + WANDER * span_s:
            return np.zeros(0, HOLE)
        sample = self._disturbed[0] if self._disturbed else int(before["sample_index"])
        return np.array([(sample, sample / self.fs_hz, missing_s, float(row["t_s"]))], HOLE)

    def settle(self) -> None:
        """Messages have confirmed the time of all satellites: what was disturbed before is past."""
        self._disturbed.clear()


def _followed(epochs: np.ndarray) -> np.ndarray:
    """EPOCH rows whose carrier the channel's own loop has locked."""
    return epochs[(epochs["state"] == STATE_LOCKED) & (epochs["pll_bw_hz"] > 0)]


def told(holes: np.ndarray) -> list[dict[str, float]]:
    """HOLE rows for the summary."""
    return [
        {"t_s": float(h["t_s"]), "missing_ms": float(h["missing_s"]) * 1e3, "seen_s": float(h["seen_s"])}
        for h in holes
    ]


def sentence(hole: dict[str, float]) -> str:
    """One of these in words."""
    what = "missing" if hole["missing_ms"] > 0 else "there twice"
    return (
        f"samples {what}: {abs(hole['missing_ms']):.3f} ms at about {hole['t_s']:.2f} s; no position in doubt is given "
        f"until {hole['seen_s']:.1f} s"
    )
