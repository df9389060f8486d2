"""Monitors of the front end: the gain of its control loop, and how often the converter gives each of its levels.

They look at the samples as they arrive, before any mitigation, and need no satellite: they go on when every channel is
lost. A loop faster than a jammer's onset takes the change of power out of the samples and shows it in its gain; a
fixed gain leaves it in the samples.
"""

import math
from typing import Any

import numpy as np

from monitors.baselines import AdcHistogram, count_levels
from monitors.short_training import FisherNull, WanderNull
from sdr.watch.post import Post, joined

RMS_LEVELS = 20.0
"""Samples of more than 8 bits are counted on a grid that puts the rms of their beginning here."""


class FrontWatch:
    """Run of a WatchSpec on the samples, window by window."""

    def __init__(self, spec: Any, fs_hz: float) -> None:
        self.spec, self.fs_hz = spec, fs_hz
        window_s = spec.detector.window_s
        run: Any = spec.detector.start((), window_s)
        self.post = Post(spec, fs_hz, run, window_s, window_s, self._null)
        self.posts = [self.post]
        self.channels = {("", 0): self.post}
        self._adc = isinstance(spec.detector, AdcHistogram)
        self._length = min(spec.detector.samples, math.floor(window_s * fs_hz)) if self._adc else 1
        self._window = math.ceil(spec.settle_s / window_s)
        self._parts: list[np.ndarray] = []
        self._scale = 0.0

    def hear(self, n0: int, iq: np.ndarray, source: Any) -> np.ndarray:
        """MONITOR rows of the windows that the samples n0 .. complete."""
        rows: list[np.ndarray] = []
        if not self._adc and self._gain(n0, source) is None:
            return joined(rows)
        self.post.seen_s = (n0 + iq.shape[1]) / self.fs_hz
        while (first := self._first()) < n0 + iq.shape[1]:
            value = self._histogram(first - n0, iq, source) if self._adc else self._gain(first, source)
            if value is None:
                break
            rows.append(self.post.take(np.array([value]), np.array([first + self._length])))
            self._window += 1
        return joined(rows)

    def report(self, quiet_until_s: float) -> list[dict[str, Any]]:
        """Its row for JSON."""
        return [self.post.report(quiet_until_s)]

    def flush(self, sample: int) -> list[np.ndarray]:
        """Nothing waits here."""
        return []

    def _first(self) -> int:
        return round(self._window * self.spec.detector.window_s * self.fs_hz)

    def _histogram(self, at: int, iq: np.ndarray, source: Any) -> np.ndarray | None:
        """Counts of the window that begins at ``at`` in this slab; None while it is not whole."""
        self._parts.append(iq[:, max(at, 0) : at + self._length])
        if at + self._length > iq.shape[1]:
            return None
        part, counts = np.concatenate(self._parts, axis=1), np.zeros(256, np.int64)
        self._parts = []
        if part.dtype != np.int8:
            part = self._levels(part)
        for component in part if getattr(source, "complex", True) else part[:1]:
            count_levels(component, counts)
        return counts

    def _levels(self, part: np.ndarray) -> np.ndarray:
        if not self._scale:
            rms = math.sqrt(float(np.mean(part.astype(np.float64) ** 2))) or 1.0
            # Integers that fit stay what they are: a grid of its own would beat with theirs.
            self._scale = RMS_LEVELS / rms if part.dtype.kind == "f" or rms > 2 * RMS_LEVELS else 1.0
        return np.clip(np.rint(part * self._scale), -128, 127).astype(np.int8)

    def _gain(self, sample: int, source: Any) -> float | None:
        gain_db = getattr(source, "agc_gain_db", None)
        value = None if gain_db is None else gain_db(sample)
        if value is None:
            self.post.unavailable = (
                "these samples come without a gain trace: it needs a scenario with [front_end.agc]"
            )
            return None
        return float(value[0])

    def _null(self, x: np.ndarray) -> Any:
        if self._adc:
            return FisherNull.fit(self.post.run(x)["value"], self.post.run.degrees)
        return WanderNull.fit(x, self.spec.detector.wander_db)


class Overheard:
    """A source whose samples the front end's monitors see as they pass; everything else is the source's own."""

    def __init__(self, source: Any, watches: list[FrontWatch]) -> None:
        self.source, self.watches = source, watches
        self._rows: list[tuple[str, np.ndarray]] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self.source, name)

    def read(self, n: int) -> tuple[int, np.ndarray]:
        """Next samples of the source."""
        n0, iq = self.source.read(n)
        for watch in self.watches:
            rows = watch.hear(n0, iq, self.source)
            if len(rows):
                self._rows.append((watch.spec.name, rows))
        return n0, iq

    def take(self) -> list[tuple[str, np.ndarray]]:
        """(monitor, MONITOR rows) since the last call."""
        rows, self._rows = self._rows, []
        return rows
