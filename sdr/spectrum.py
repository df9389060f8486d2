"""A spectrum of the samples ten times a second, taken as they pass."""

from typing import Any

import numpy as np

BINS = 512
FRAMES = 16
EVERY_S = 0.1
STRONG_DB = -10.0
"""Power of narrow lines over that of the noise of the whole band from which they are worth a word."""
LINE_DB = 10.0
"""A bin that stands so far above the median of those about it belongs to a line."""


class Spectrogram:
    """A source that keeps the spectrum of the first samples of every 0.1 s; everything else is the source's own."""

    def __init__(self, source: Any) -> None:
        self.source = source
        self._every = max(round(EVERY_S * source.fs_hz), BINS * FRAMES)
        self._next = 0
        self._part = np.zeros((2, 0), np.float32)
        self._rows: list[np.ndarray] = []
        self._power, self._count = np.zeros(BINS), 0

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
            self._power += 10 ** (self._rows[-1] / 10)
            self._count += 1
            self._part = self._part[:, :0]
            self._next += self._every
            at = max(self._next - n0, 0)
        return n0, iq

    def rows(self) -> np.ndarray:
        """Spectra since the last call: float32 (m, BINS), dB of one squared ADC level per bin, from -fs/2 on."""
        rows, self._rows = self._rows, []
        return np.array(rows, np.float32).reshape(-1, BINS)

    def lines(self) -> tuple[list[float], float]:
        """Frequencies of the narrow lines in the mean of all spectra, Hz from the carrier, strongest first, and their power
        together over that of the noise of the band, dB (-inf without any)."""
        from scipy.ndimage import label, median_filter

        power = self._power / max(self._count, 1)
        floor = np.maximum(median_filter(power, BINS // 8 + 1, mode="wrap"), 1e-30)
        freq_hz = np.arange(-BINS // 2, BINS // 2) * self.source.fs_hz / BINS - self.source.if_hz
        if not getattr(self.source, "complex", True):  # the mirror of real samples says the same
            power = np.where(np.sign(freq_hz + self.source.if_hz) == np.sign(self.source.if_hz), power, floor)
        over = power > 10 ** (LINE_DB / 10) * floor
        parts, n = label(over)
        peaks = [max(np.flatnonzero(parts == k + 1), key=lambda i: power[i]) for k in range(n)]
        peaks.sort(key=lambda i: -power[i])
        with np.errstate(divide="ignore"):
            jn_db = float(10 * np.log10(np.sum(np.where(over, power - floor, 0.0)) / np.sum(floor)))
        return [float(freq_hz[i]) for i in peaks], jn_db


def spectrum_db(iq: np.ndarray) -> np.ndarray:
    """Mean power spectrum of planar samples (2, BINS m), Hann window: dB, (BINS,), from -fs/2 on."""
    window = np.hanning(BINS)
    z = (iq[0] + 1j * iq[1].astype(np.float32)).reshape(-1, BINS) * window
    power = np.mean(np.abs(np.fft.fft(z, axis=1)) ** 2, axis=0) / np.sum(window**2)
    return np.fft.fftshift(10 * np.log10(np.maximum(power, 1e-12)))
