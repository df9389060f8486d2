"""A spectrum of the samples ten times a second, taken as they pass."""

from typing import Any

import numpy as np

BINS = 512
FRAMES = 16
EVERY_S = 0.1


class Watched:
    """A source that keeps the spectrum of the first samples of every 0.1 s; everything else is the source's own."""

    def __init__(self, source: Any) -> None:
        self.source = source
        self._every = max(round(EVERY_S * source.fs_hz), BINS * FRAMES)
        self._next = 0
        self._part = np.zeros((2, 0), np.float32)
        self._rows: list[np.ndarray] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self.source, name)

    def read(self, n: int) -> tuple[int, np.ndarray]:
        """Next samples of the source."""
        n0, iq = self.source.read(n)
        at = 0 if self._part.shape[1] else max(self._next - n0, 0)
        while at < iq.shape[1]:  # a slab may hold several, or only a part of one
            part = iq[:, at : at + BINS * FRAMES - self._part.shape[1]]
            self._part = np.concatenate([self._part, part], axis=1)
            if self._part.shape[1] < BINS * FRAMES:
                break
            self._rows.append(spectrum_db(self._part))
            self._part = self._part[:, :0]
            self._next += self._every
            at = max(self._next - n0, 0)
        return n0, iq

    def rows(self) -> np.ndarray:
        """Spectra since the last call: float32 (m, BINS), dB of one squared ADC level per bin, from -fs/2 on."""
        rows, self._rows = self._rows, []
        return np.array(rows, np.float32).reshape(-1, BINS)


def spectrum_db(iq: np.ndarray) -> np.ndarray:
    """Mean power spectrum of planar samples (2, BINS m), Hann window: dB, (BINS,), from -fs/2 on."""
    window = np.hanning(BINS)
    z = (iq[0] + 1j * iq[1].astype(np.float32)).reshape(-1, BINS) * window
    power = np.mean(np.abs(np.fft.fft(z, axis=1)) ** 2, axis=0) / np.sum(window**2)
    return np.fft.fftshift(10 * np.log10(np.maximum(power, 1e-12)))
