"""Mitigation ahead of the correlators: notch, blanking, excision, and cancellation of characterised tones.

A mitigation stands between the source and the receiver and reads ahead, so that it delays nothing; it works on
frames that start at multiples of their length, so that slabs of any length give the same samples. Off by default.
"""

import math
from collections import deque
from typing import Annotated, Any, Literal

import numpy as np
from numba import njit
from pydantic import BaseModel, ConfigDict, Field

__all__ = [
    "TONE",
    "Blanking",
    "Cancellation",
    "Excision",
    "Mitigated",
    "MitigationSpec",
    "Notch",
    "estimate_tone",
]

_FROZEN = ConfigDict(frozen=True, extra="forbid")
_CHUNK = 1 << 16
_PARTS = 64
"""Parts of a frame whose phases are fitted: a bin beside the tone costs each 4e-4 of its power."""

TONE = np.dtype(
    [
        ("sample_index", "u8"),  # first sample of the frame that it was estimated in
        ("n_samples", "i4"),
        ("freq_hz", "f8"),  # offset from the carrier, in the middle of the frame
        ("rate_hz_s", "f8"),  # of the frequency
        ("amplitude", "f8"),  # in ADC levels
        ("phase_cycles", "f8"),  # at sample_index, in [0, 1)
        ("energy_db", "f8"),  # energy in the frame over the noise density
    ]
)
"""A tone that a mitigation found."""


class Blanking(BaseModel):
    """Samples are zeroed where their power exceeds ``threshold_db`` over the noise power, and ``guard`` beside them.

    Noise power: median / ln 2 of |x|^2 over frames of 16,384 samples, right as long as pulses fill less than half.
    10 dB blank exp(-10) = 5e-5 of pure noise.
    """

    model_config = _FROZEN
    kind: Literal["Blanking"] = "Blanking"
    threshold_db: float = Field(10.0, ge=6.0, le=40.0)
    """Power over the noise from which samples are zeroed."""
    guard: int = Field(2, ge=0, le=1000)
    """Samples zeroed on either side too."""

    def start(self, source: Any) -> "Mitigated":
        """Source of the mitigated samples."""
        return Mitigated(source, 16_384, self._frame)

    def _frame(self, n0: int, x: np.ndarray) -> tuple[np.ndarray, list]:
        power = x[0].astype(np.float32) ** 2 + x[1].astype(np.float32) ** 2
        hit = power > 10 ** (self.threshold_db / 10) * np.median(power) / math.log(2)
        if hit.any():
            hit = np.convolve(hit, np.ones(2 * self.guard + 1), "same") > 0.5
            x = np.where(hit, x.dtype.type(0), x)
        return x, []


class Excision(BaseModel):
    """Bins of a short-time spectrum that exceed what noise can do are zeroed.

    Frames of ``length`` with half overlap and a square-root Hann window before and after, which add up to one. A bin
    goes when its power exceeds ln(length / p_fa) times the noise floor there: ``p_fa`` per frame of noise. The floor's
    shape over frequency is the mean spectrum of some 65,536 samples under a median of an eighth of the band (it
    follows the front end's filter and ignores what is narrower than half of that), its level the median / ln 2 of
    each frame.
    """

    model_config = _FROZEN
    kind: Literal["Excision"] = "Excision"
    length: Literal[256, 512, 1024, 2048, 4096, 8192] = 1024
    """Samples of a frame."""
    p_fa: float = Field(1e-2, gt=0.0, le=0.5)
    """False-alarm probability per frame."""

    def start(self, source: Any) -> "Mitigated":
        """Source of the mitigated samples."""
        return Mitigated(source, self.length // 2, self._pair, overlapping=True)

    def _pair(self, n0: int, x: np.ndarray) -> tuple[np.ndarray, list]:
        """Windowed frames, all at once: x (2, (k + 1) hop) -> what each adds to both of its halves."""
        from scipy.fft import fft, ifft

        n, hop = self.length, self.length // 2
        window = np.sqrt(np.hanning(n + 1)[:n]).astype(np.float32)
        z = (x[0].astype(np.float32) + 1j * x[1].astype(np.float32)).astype(np.complex64).reshape(-1, hop)
        frames = np.concatenate([z[:-1], z[1:]], axis=1) * window
        spectrum = fft(frames, axis=1)
        power = spectrum.real**2 + spectrum.imag**2
        shape = _floor(np.mean(power, axis=0))
        level = np.median(power / shape, axis=1, keepdims=True)
        spectrum[power > math.log(n / self.p_fa) / math.log(2) * level * shape] = 0.0
        return ifft(spectrum, axis=1) * window, []


def _floor(power: np.ndarray) -> np.ndarray:
    """Mean power (n,) of FFT bins -> its median over an eighth of the band about each bin; never zero."""
    from scipy.ndimage import median_filter

    floor = median_filter(power, len(power) // 8 + 1, mode="wrap")
    return np.maximum(floor, 1e-12 * max(float(floor.max()), 1e-30))


class Notch(BaseModel):
    """Adaptive notch of one pole: H(z) = (1 - z0 / z) / (1 - k z0 / z), z0 by gradient descent on the output power.

    z0 <- z0 + mu y conj(r) / E|r|^2, r the output of the pole (Borio, Camoriano, Lo Presti 2008, eqs. 6 to 12). It
    cuts only while |z0| exceeds ``engage``, that is while there is something narrow to follow.
    """

    model_config = _FROZEN
    kind: Literal["Notch"] = "Notch"
    contraction: float = Field(0.98, ge=0.5, lt=1.0)
    """Radius of the pole: nearer to 1 is narrower."""
    step: float = Field(2e-4, gt=0.0, le=0.1)
    """Step of the adaptation."""
    engage: float = Field(0.8, gt=0.0, lt=1.0)
    """Radius of the zero from which the notch cuts."""

    def start(self, source: Any) -> "Mitigated":
        """Source of the mitigated samples."""
        state = np.zeros(4, np.complex128)
        length = max(round(0.01 * source.fs_hz), 1)

        def frame(n0: int, x: np.ndarray) -> tuple[np.ndarray, list]:
            y = x.astype(np.float32)
            notch(y, state, self.contraction, self.step, self.engage)
            z0 = state[0]
            if abs(z0) <= self.engage:
                return y, []
            freq_hz = np.angle(z0) / (2 * math.pi) * source.fs_hz - source.if_hz
            return y, [(n0, x.shape[1], freq_hz, np.nan, np.nan, np.nan, np.nan)]

        return Mitigated(source, length, frame)


@njit(cache=True, nogil=True)
def notch(iq, state, contraction, step, engage):
    """The notch in place over float32 (2, n); ``state`` complex128 (4,): z0, r of the sample before, its mean power."""
    z0, before, power = state[0], state[1], state[2].real
    for k in range(iq.shape[1]):
        x = complex(iq[0, k], iq[1, k])
        r = x + contraction * z0 * before
        y = r - z0 * before
        power += 1e-3 * (before.real**2 + before.imag**2 - power)
        if power > 0.0:
            z0 += step * y * np.conj(before) / power
            size = abs(z0)
            if size > 1.0:
                z0 /= size
        if abs(z0) > engage:
            iq[0, k], iq[1, k] = y.real, y.imag
        before = r
    state[0], state[1], state[2] = z0, before, complex(power, 0.0)


class Cancellation(BaseModel):
    """Tones are characterised frame by frame, frequency and its rate, amplitude and phase, and subtracted.

    Sweeps of up to fs / frame are followed (4e8 Hz/s at 4 Msps and 10 ms) while the rate holds within the frame and the
    tone is not lost in the noise (`estimate_tone`); a chirp's turns need frames shorter than its sweep. ``p_fa``: that a
    frame of noise alone has a tone, over all its bins.
    """

    model_config = _FROZEN
    kind: Literal["Cancellation"] = "Cancellation"
    frame_ms: float = Field(10.0, ge=0.5, le=100.0)
    """Length of a frame."""
    max_tones: int = Field(3, ge=1, le=20)
    """Tones looked for in a frame."""
    p_fa: float = Field(1e-4, gt=0.0, le=0.1)
    """Probability that a frame of noise alone has a tone."""

    def start(self, source: Any) -> "Mitigated":
        """Source of the mitigated samples."""
        length = max(round(self.frame_ms * 1e-3 * source.fs_hz), _PARTS)

        def frame(n0: int, x: np.ndarray) -> tuple[np.ndarray, list]:
            z = x[0] + 1j * x[1].astype(np.float64)
            rows = []
            for _ in range(self.max_tones):
                found = estimate_tone(z, math.log(len(z) / self.p_fa))
                if found is None:
                    break
                turns, rate, gain, energy = found
                tone = gain * _sweep(len(z), turns, rate)
                z = z - tone
                freq_hz, phase = turns * source.fs_hz - source.if_hz, np.angle(tone[0]) / (2 * math.pi) % 1.0
                rate_hz_s = rate * source.fs_hz**2
                rows.append((n0, len(z), freq_hz, rate_hz_s, abs(gain), phase, 10 * math.log10(energy)))
            return np.stack([z.real, z.imag]).astype(np.float32), rows

        return Mitigated(source, length, frame)


def estimate_tone(z: np.ndarray, threshold: float) -> tuple[float, float, complex, float] | None:
    """The strongest tone in complex samples (n,): frequency (cycles per sample) and complex amplitude in their middle,
    its rate (cycles per sample^2), and energy over noise density; None below ``threshold``
    or under _PARTS samples.

    The largest bin of the FFT, of z as it is or with the sweep taken out that shows as the largest bin of z[k + n/2]
    conj(z[k]) (Peleg and Porat, IEEE Trans. AES 27(4), 1991), which needs n/2 rho^2 / (1 + 2 rho) > ``threshold``, rho = A^2 /
    (noise power). Then Gauss-Newton on the phases of the first two Legendre moments to the least squares, whose
    variances are the Cramer-Rao bounds 6 / ((2 pi)^2 rho n^3) and 90 / (pi^2 rho n^5). Noise: median / ln 2 of the bins.
    """
    n, lag = len(z), len(z) // 2
    if n < _PARTS:
        return None
    rates = [0.0]
    energy, turns, _ = _peak(z[lag:] * np.conj(z[: n - lag]), 2)
    if energy > threshold:
        rates.append(turns / lag)
    tones = []
    for rate in rates:
        energy, turns, density = _peak(z * np.conj(_sweep(n, 0.0, rate)) if rate else z)
        if energy > threshold:
            tones.append((_least_squares(z, turns, rate), density))
    if not tones:
        return None
    (turns, rate, gain), density = max(tones, key=lambda tone: abs(tone[0][2]))
    return (turns + 0.5) % 1.0 - 0.5, rate, gain, abs(gain) ** 2 * n / density


def _least_squares(z: np.ndarray, turns: float, rate: float) -> tuple[float, float, complex]:
    """Frequency and rate near the given ones whose tone leaves least of z, and its complex amplitude."""
    n = len(z)
    first = np.arange(_PARTS) * n // _PARTS
    parts = np.add.reduceat(z * np.conj(_sweep(n, turns, rate)), first)
    u = 0.5 * (first + np.append(first[1:], n)) / n - 0.5
    for _ in range(6):
        moments = np.array([np.sum(parts), u @ parts, (u * u - 1 / 12) @ parts])
        slope, bend = np.imag(moments[1:] / moments[0]) * (12.0, 180.0)
        parts = parts * np.exp(-1j * (slope + bend * u) * u)
        turns += slope / (2 * math.pi * n)
        rate += bend / (math.pi * n * n)
    return turns, rate, complex(np.vdot(_sweep(n, turns, rate), z) / n)


def _sweep(n: int, turns: float, rate: float) -> np.ndarray:
    """exp(2 pi i (turns k + rate k^2 / 2)), k from the middle of n samples."""
    k = np.arange(n) - 0.5 * (n - 1)
    return np.exp(2j * np.pi * (turns + 0.5 * rate * k) * k)


def _peak(z: np.ndarray, bins: int = 1) -> tuple[float, float, float]:
    """Largest of ``bins`` len(z) bins of the FFT: energy over noise density, frequency in cycles per sample; that density."""
    from scipy.fft import fft

    spectrum = fft(z, bins * len(z))
    power = spectrum.real**2 + spectrum.imag**2
    density = max(float(np.median(power)) / math.log(2) / len(z), 1e-300)
    k = int(np.argmax(power))
    return float(power[k]) / (density * len(z)), k / len(power) - (2 * k >= len(power)), density


class Mitigated:
    """Run: a source like the one that it wraps, with mitigated samples.

    ``frame(n0, x)`` gets whole frames (the last may be short) and returns samples and TONE rows; ``overlapping``:
    it gets many frames of two hops and returns what they add up to.
    """

    def __init__(self, source: Any, length: int, frame: Any, overlapping: bool = False):
        if not getattr(source, "complex", True):
            raise ValueError("receiver.mitigation works on complex samples: leave it out for real ones")
        self.source, self.fs_hz, self.if_hz = source, source.fs_hz, source.if_hz
        self.n_samples, self.complex = source.n_samples, True
        self._length, self._frame = length, frame
        self._advance = self._overlapped if overlapping else self._framed
        self._ready: deque[np.ndarray] = deque()
        self._held = self._position = 0
        self._ended = False
        self._carry: np.ndarray | None = None
        self._tail = np.zeros(length, np.complex64)
        self._tones: list[tuple] = []

    def read(self, n: int) -> tuple[int, np.ndarray]:
        """Next n samples, or what is left."""
        n0 = self._position
        while self._held < n and not self._ended:
            for part in self._advance():
                self._ready.append(part)
                self._held += part.shape[1]
        parts, left = [], min(n, self._held)
        while left:
            head = self._ready.popleft()
            if head.shape[1] > left:
                self._ready.appendleft(head[:, left:])
                head = head[:, :left]
            parts.append(head)
            left -= head.shape[1]
        out = np.concatenate(parts, axis=1) if parts else np.zeros((2, 0), np.float32)
        self._position, self._held = n0 + out.shape[1], self._held - out.shape[1]
        return n0, np.ascontiguousarray(out)

    def tones(self) -> np.ndarray:
        """TONE rows found since the last call."""
        rows, self._tones = np.array(self._tones, TONE), []
        return rows

    def _framed(self) -> list[np.ndarray]:
        n0, x = self.source.read(self._length)
        self._ended = x.shape[1] < self._length
        if x.shape[1] == 0:
            return []
        y, rows = self._frame(n0, x)
        self._tones += rows
        return [y]

    def _overlapped(self) -> list[np.ndarray]:
        """Overlap-add of frames of two hops; a hop is ready when both of its frames are done."""
        hop = self._length
        count = max(_CHUNK // hop, 1)
        n0, x = self.source.read(count * hop)
        n = x.shape[1]
        self._ended = n < count * hop
        x = np.concatenate([x, np.zeros((2, -n % hop + (hop if self._ended else 0)), x.dtype)], axis=1)
        if self._carry is None:  # a hop of zeros stands before the first sample
            self._carry = np.zeros((2, hop), x.dtype)
            self._skip = hop
        frames, _ = self._frame(n0, np.concatenate([self._carry, x], axis=1))
        self._carry = x[:, x.shape[1] - hop :]
        done = np.empty(len(frames) * hop, np.complex64)
        if len(frames):
            done[:hop] = self._tail + frames[0, :hop]
            done[hop:] = (frames[:-1, hop:] + frames[1:, :hop]).ravel()
            self._tail = frames[-1, hop:].astype(np.complex64)
        done = done[self._skip :]
        self._skip = 0
        left = self.n_samples - self._position - self._held
        done = done[:left]
        return [np.stack([done.real, done.imag])]


MitigationSpec = Annotated[Blanking | Excision | Notch | Cancellation, Field(discriminator="kind")]
"""Section ``[receiver.mitigation]``."""
