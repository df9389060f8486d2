"""Jammers: frozen Specs (section ``[[jammer]]``), each started into a run that adds its samples.

Power. ``js_db``: over the power of satellite ``against`` at the moment the jammer starts; ``power_dbw`` over a noise
density of ``n0_dbw_hz`` (default -203 dBW/Hz: the value of Ouzeau et al. 2008, table 1); ``jn0_dbhz``: over the noise
density itself. It is the power of the complex envelope, before the front end; of a `Pulsed` jammer the power while
a pulse lasts. ``profile`` adds dB, a line between its points (t_s, db).

Frequency. ``freq_hz`` from the carrier, moving by ``rate_hz_s`` from the start on; or a line of a code spectrum.
A jammer is a carrier times an `Envelope`; both depend on the absolute sample index alone, so that any chunking gives
the same bits. Envelopes that the kernels know are added inside the synthesis; any other is a function of the sample
index (``Envelope.samples``), as that of `Interferer`.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from signals import jammer_kernels as kernels
from signals.constants import CHIP_RATE_HZ, F_L1_HZ
from signals.kernels import COMPONENT, SUB
from signals.modulation import BLOCK, SIGNALS, chip_waveform, code_lines
from signals.records import JAMMER_TRUTH
from signals.sky import Sky
from signals.source import CELLS_PER_S, Cells, amplitude, hermite_cells, jammer_tables
from signals.synthesis_kernels import synthesise

__all__ = [
    "CW",
    "Chirp",
    "CodeLine",
    "Envelope",
    "Interferer",
    "JammerRun",
    "JammerSpec",
    "MatchedSpectrum",
    "Narrowband",
    "Pulsed",
    "Wideband",
]

_FROZEN = ConfigDict(frozen=True, extra="forbid")
_MAX_LINE = 8
"""Lines are looked up to this many times the chip rate."""
_PULSE_S = 1.0 / math.sqrt(4.5e11)
"""Width of a DME pulse exp(-alpha t^2 / 2), alpha = 4.5e11 / s^2 (RTCA DO-292; 3.5 us between half-amplitude
points)."""
_SHORT_SWEEP = 1 << 15
"""Samples up to which a sweep comes from a table: beyond, blocks with a turn, which cost twice, are rare."""
_SWEEP_TABLE = 1 << 20
"""Values in the table of a short sweep: 4 MB."""
_CODE_CHIPS = 40_920
"""Length of the noise-like code of `MatchedSpectrum`: 40 ms, longer than the integrations."""

Opener = Callable[[str, float], tuple[Callable[[int, int], np.ndarray], int]]
"""(path, fs_hz) -> (reader(n0, n) -> planar float32 (2, n), length of the file); refuses a file of another rate."""


@dataclass(frozen=True, eq=False)
class Envelope:
    """What a jammer is but for its carrier, its power and its times: amplitude 1 while it is on."""

    kind: int = kernels.TONE
    duty: float = 1.0
    """Mean power."""
    fields: dict[str, Any] = field(default_factory=dict)
    """Of its JAMMER row."""
    codes: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int8))
    waves: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int16))
    taps: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))
    samples: Callable[[int, int], np.ndarray] | None = None
    """(n0, n) -> planar (2, n): an envelope that the kernels do not know (``kind`` stays TONE)."""


class CodeLine(BaseModel):
    """A line k / code period of a code's spectrum, as it is received.

    ``line``: "worst" or the index k (negative: the mirror). ``follow_doppler``: the line of the *received* code, at
    Doppler + k f_R (1 + Doppler / F_L1), phase and all, so that ``offset_hz`` stays what it is as the satellite
    moves; else k f_R alone.
    """

    model_config = _FROZEN
    signal: Literal["L1CA", "E1B", "E1C"]
    """Signal whose code line is hit."""
    prn: int = Field(ge=1, le=63)
    """Satellite whose code line is hit."""
    line: Literal["worst"] | int = "worst"
    """The strongest line, or its index."""
    waveform: Literal["BPSK", "BOC11", "CBOC+", "CBOC-"] | None = None
    """Waveform that decides which line is strongest; unset: as transmitted."""
    offset_hz: float = Field(0.0, ge=-5e6, le=5e6)
    """Distance from the line."""
    rate_hz_s: float = Field(0.0, ge=-1e6, le=1e6)
    """Rate of that distance."""
    follow_doppler: bool = True
    """Follow the line as it is received."""

    def freq_hz(self, code_path=None) -> float:
        """k f_R; ValueError if the code has no such line."""
        waveform = self.waveform or ("BPSK" if self.signal == "L1CA" else "BOC11")
        span_hz = 2 * CHIP_RATE_HZ if self.line == "worst" else _MAX_LINE * CHIP_RATE_HZ
        freq_hz, level_db = code_lines(self.signal, self.prn, waveform, max_hz=span_hz, path=code_path)
        if self.line == "worst":
            return float(freq_hz[np.argmax(level_db)])
        k = abs(self.line)
        if k >= len(freq_hz) or level_db[k] < -100.0:
            raise ValueError(
                f"line {self.line} of {self.signal} PRN {self.prn} does not exist: the spectrum of its code ({waveform})"
                f' has no power there; use an index up to {len(freq_hz) - 1} that `gnssbb lines` lists, or "worst"'
            )
        return math.copysign(float(freq_hz[k]), self.line)


class _Jammer(BaseModel):
    """What all jammers have: power, times and place in the spectrum."""

    model_config = _FROZEN
    js_db: float | None = Field(None, ge=-60.0, le=120.0)
    """Power over that of the satellite ``against`` at the moment the jammer starts."""
    against: str | None = Field(None, pattern=r"^[GE]\d\d$")
    """The satellite that js_db refers to, e.g. "G05"."""
    power_dbw: float | None = Field(None, ge=-250.0, le=-50.0)
    """Power at the antenna port, instead of js_db."""
    jn0_dbhz: float | None = Field(None, ge=-20.0, le=160.0)
    """Power over the noise density, instead of js_db."""
    n0_dbw_hz: float = Field(-203.0, ge=-215.0, le=-180.0)
    """Noise density that power_dbw is compared with, dBW/Hz."""
    start_s: float = Field(0.0, ge=0.0)
    """When it is switched on."""
    stop_s: float | None = Field(None, gt=0.0)
    """When it is switched off; unset: never."""
    profile: tuple[tuple[float, float], ...] = ()
    """Pairs of time (s) and dB added to the power, linear between."""
    freq_hz: float = Field(0.0, ge=-50e6, le=50e6)
    """Centre, offset from the carrier."""
    rate_hz_s: float = Field(0.0, ge=-1e9, le=1e9)
    """Rate of the centre."""
    line: CodeLine | None = None
    phase_rad: float | None = None
    """Phase at the start; unset: random."""

    @model_validator(mode="after")
    def _power_and_times(self):
        given = [n for n in ("js_db", "power_dbw", "jn0_dbhz") if getattr(self, n) is not None]
        if len(given) != 1:
            raise ValueError(
                f"the power is given {len(given)} times: give one of js_db (with against), power_dbw, jn0_dbhz"
            )
        if (self.js_db is None) != (self.against is None):
            raise ValueError('js_db and against belong together, e.g. js_db = 20 and against = "G06"')
        if self.stop_s is not None and self.stop_s <= self.start_s:
            raise ValueError(f"stop_s = {self.stop_s:g} must be later than start_s = {self.start_s:g}")
        times = [t for t, _ in self.profile]
        if any(b <= a for a, b in itertools.pairwise(times)) or any(abs(d) > 200 for _, d in self.profile):
            raise ValueError("profile must be pairs (t_s, db) with growing times and at most 200 dB")
        if self.line is not None and (self.freq_hz or self.rate_hz_s):
            raise ValueError(
                "freq_hz and rate_hz_s belong to a jammer without line: use line.offset_hz and .rate_hz_s"
            )
        return self

    @property
    def width_hz(self) -> float:
        """Bandwidth that it occupies about its centre."""
        return 0.0

    def envelope(self, fs_hz: float, seed: np.uint64, context: dict[str, Any]) -> Envelope:
        """What a new jammer has to say. ``context``: "carrier_hz" of its centre in the samples, None if that
        moves; "open_recording".
        """
        raise NotImplementedError

    def start(
        self,
        fs_hz: float,
        if_hz: float,
        duration_s: float,
        seed=0,
        sky: Sky | None = None,
        is_complex: bool = True,
        code_path=None,
        open_recording: Opener | None = None,
    ) -> "JammerRun":
        """Run of the jammer in samples of this rate.

        ``sky`` is needed for ``js_db`` and for a line that follows a Doppler. Raises ValueError for a band beyond
        Nyquist, a line that does not exist, a satellite that is not there, a file of another rate.
        """
        seed = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
        key, phase = seed.generate_state(2, np.uint64)
        phase_cycles = phase / 2.0**64 if self.phase_rad is None else self.phase_rad / (2 * math.pi)
        line_hz = 0.0 if self.line is None else self.line.freq_hz(code_path)
        jn0_dbhz = self._jn0_dbhz(sky, fs_hz)
        moves = self.rate_hz_s != 0.0 or (
            self.line is not None and (self.line.rate_hz_s or self.line.follow_doppler)
        )
        offset_hz = self.freq_hz if self.line is None else self.line.offset_hz
        carrier_hz = None if moves else if_hz + line_hz + offset_hz
        envelope = self.envelope(fs_hz, key, {"open_recording": open_recording, "carrier_hz": carrier_hz})
        run = JammerRun(
            self, fs_hz, if_hz, jn0_dbhz, float(amplitude(jn0_dbhz, fs_hz, is_complex)),
            math.ceil(self.start_s * fs_hz - 1e-6),
            2**62 if self.stop_s is None else math.ceil(self.stop_s * fs_hz - 1e-6),
            line_hz, phase_cycles, self._follow(sky), duration_s, envelope, key,
        )  # fmt: skip
        run.rms = math.sqrt(0.5 * envelope.duty * run.mean_power(duration_s))
        run.check(duration_s, is_complex)
        return run

    def _jn0_dbhz(self, sky: Sky | None, fs_hz: float) -> float:
        if self.jn0_dbhz is not None:
            return self.jn0_dbhz
        if self.power_dbw is not None:
            return self.power_dbw - self.n0_dbw_hz
        if self.js_db is None or self.against is None:
            raise ValueError("the power is missing: give js_db with against, power_dbw or jn0_dbhz")
        sky, k = _row(sky, self.against, "against")
        return self.js_db + float(sky.only([k]).propagate(np.array([self.start_s])).cn0_dbhz[0, 0])

    def _follow(self, sky: Sky | None) -> Sky | None:
        if self.line is None or not self.line.follow_doppler:
            return None
        name = f"{SIGNALS[self.line.signal].system}{self.line.prn:02d}"
        sky, k = _row(sky, name, "line")
        return sky.only([k])


def _row(sky: Sky | None, name: str, key: str) -> tuple[Sky, int]:
    """The sky and the row of this satellite in it."""
    names = [] if sky is None else [s.name for s in sky.satellites]
    if sky is None or name not in names:
        raise ValueError(
            f"{key}: satellite {name} is not in the sky; there are {', '.join(names) or 'none'}"
            + ("; or set line.follow_doppler = false" if key == "line" else "")
        )
    return sky, names.index(name)


class CW(_Jammer):
    """A tone; with ``rate_hz_s`` a slow sweep."""

    kind: Literal["CW"] = "CW"

    def envelope(self, fs_hz, seed, context):
        """See `_Jammer.envelope`."""
        return Envelope()


class Chirp(_Jammer):
    """A tone swept over ``sweep_hz`` about its centre in ``sweep_s``: up and again (sawtooth), or up and down.

    Sweeps of up to 32,768 samples come from a table whose rows begin 1/P of a sample apart, with P (M + 1032) up to 2^20
    and P up to 256: an error of 2e-3 to 6e-3 rad at most, -44 dB. Longer ones are exact.
    """

    kind: Literal["Chirp"] = "Chirp"
    sweep_hz: float = Field(gt=0.0, le=100e6)
    """Width of the sweep."""
    sweep_s: float = Field(ge=1e-6, le=10.0)
    """Time of one sweep."""
    shape: Literal["sawtooth", "triangular"] = "sawtooth"
    """Up and again, or up and down."""

    @property
    def width_hz(self):
        """The sweep."""
        return self.sweep_hz

    def envelope(self, fs_hz, seed, context):
        """See `_Jammer.envelope`."""
        length, sweep, two = self.sweep_s * fs_hz, self.sweep_hz / fs_hz, self.shape == "triangular"
        fields = {"period": length, "sweep": sweep, "triangular": two}
        if length > _SHORT_SWEEP:
            return Envelope(kernels.SWEEP, fields=fields)
        held = context["carrier_hz"] is not None
        carrier = context["carrier_hz"] / fs_hz if held else 0.0
        wave = _sweep_table(length, sweep, two, carrier)
        fields |= {"held": held, "carrier": carrier, "rows": wave.shape[1], "columns": wave.shape[2]}
        return Envelope(kernels.CHIRP, fields=fields, waves=wave.ravel())


def _sweep_table(length: float, sweep: float, triangular: bool, carrier: float) -> np.ndarray:
    """Short sweeps of so many samples and cycles per sample, carrier included: int16 (2, P, columns)."""
    columns = math.ceil(length * (2 if triangular else 1)) + BLOCK + 8
    rows = int(2 ** min(math.floor(math.log2(_SWEEP_TABLE / columns)), 8))
    place = np.arange(columns) + np.arange(rows)[:, None] / rows
    turn, tau = np.divmod(place, length)
    sign = np.where(turn % 2 == 1, -1.0, 1.0) if triangular else 1.0
    turns = 0.5 * sign * sweep * tau * (tau / length - 1.0) + carrier * place
    angle = 2 * math.pi * np.mod(turns, 1.0)
    return np.round(kernels.WAVE_SCALE * np.stack([np.cos(angle), np.sin(angle)])).astype(np.int16)


class Pulsed(_Jammer):
    """Pulses of a carrier, ``rate_hz`` of them a second: rectangles of this duty cycle, or DME pulse pairs.

    DME: Gaussian pulses exp(-alpha t^2 / 2) ``pair_spacing_s`` apart (12 us: channel X). ``random``: each at a random
    place in its slot of 1 / rate_hz.
    """

    kind: Literal["Pulsed"] = "Pulsed"
    rate_hz: float = Field(gt=0.0, le=1e5)
    """Pulses (DME: pairs) per second."""
    shape: Literal["rectangular", "dme"] = "rectangular"
    """Rectangles, or DME pairs."""
    duty: float | None = Field(None, gt=0.0, lt=1.0)
    """Part of the time that a rectangle fills."""
    pair_spacing_s: float = Field(12e-6, ge=0.0, le=1e-3)
    """Distance of the two pulses of a DME pair."""
    random: bool = False
    """Place each pulse at random in its slot."""

    @model_validator(mode="after")
    def _fits(self):
        if (self.duty is None) != (self.shape == "dme"):
            raise ValueError(
                "duty belongs to rectangular pulses, which need it; dme pulses have their own width"
            )
        span_s = self.pair_spacing_s + 10 * _PULSE_S
        if self.shape == "dme" and span_s > 1.0 / self.rate_hz:
            raise ValueError(
                f"rate_hz = {self.rate_hz:g} leaves {1e6 / self.rate_hz:.1f} us for a pulse pair of {span_s * 1e6:.1f} us:"
                " lower it"
            )
        return self

    @property
    def width_hz(self):
        """Between the -20 dB points of a DME pulse; first nulls of a rectangle."""
        return 0.68 / _PULSE_S if self.duty is None else 2.0 * self.rate_hz / self.duty

    def envelope(self, fs_hz, seed, context):
        """See `_Jammer.envelope`."""
        fields = {"period": fs_hz / self.rate_hz, "random": self.random}
        if self.duty is not None:
            fields |= {"width": self.duty * fs_hz / self.rate_hz}
            return Envelope(kernels.PULSES, self.duty, fields)
        # Mean of (g(t) + g(t - D))^2: two pulses of energy sqrt(pi) w, and the overlap.
        pulses = (
            1.0
            if self.pair_spacing_s == 0
            else 2.0 + 2.0 * math.exp(-((self.pair_spacing_s / _PULSE_S) ** 2) / 4)
        )
        duty = pulses * math.sqrt(math.pi) * _PULSE_S * self.rate_hz
        fields |= {"width": _PULSE_S * fs_hz, "pair": self.pair_spacing_s * fs_hz, "gaussian": True}
        return Envelope(kernels.PULSES, duty, fields)


class Narrowband(_Jammer):
    """Circular Gaussian noise, flat over ``bandwidth_hz``: its noise bandwidth, power over density at the centre.

    White points on a lattice of fs / D >= 1.2 B, D = 2^k or 3 2^k, under a 9-point Kaiser-windowed sinc (stop band
    -50 dB; edges of +-0.17 fs / D), keyed by their absolute index; finer by doublings and cubics where D > 3 (images -50 dB).
    The points are Gaussian and uncorrelated, but sums of numbers from a table under fresh signs: their moduli are not
    all new, and the energy of 1024 of them varies by 3 % less than that of true noise.
    """

    kind: Literal["Narrowband"] = "Narrowband"
    bandwidth_hz: float = Field(gt=0.01, le=100e6)
    """Two-sided bandwidth."""

    @property
    def width_hz(self):
        """The bandwidth."""
        return self.bandwidth_hz

    def lattice(self, fs_hz: float) -> tuple[int, int]:
        """(phases of the filter, samples between its outputs); their product is D."""
        spacing = max(fs_hz / (1.2 * self.bandwidth_hz), 1.0)
        octave = int(math.log2(spacing))
        if octave and spacing >= 1.5 * 2**octave:
            return 3, 2 ** (octave - 1)
        return 2 ** min(octave, 1), 2 ** max(octave - 1, 0)

    def response(self, fs_hz: float) -> np.ndarray:
        """Impulse response on the grid of the filter's outputs, N_TAPS * phases: unit mean power after the cubics."""
        phases, step = self.lattice(fs_hz)
        n = kernels.N_TAPS * phases
        u = (np.arange(n) - 0.5 * (n - 1)) / phases
        wanted = cut = self.bandwidth_hz / fs_hz * phases * step
        for _ in range(
            4
        ):  # the window's skirts take power from the band: widen it until its noise bandwidth is right
            h = np.sinc(cut * u) * np.kaiser(n, 4.5)
            cut = min(cut * wanted * np.sum(h) ** 2 / (np.sum(h**2) * phases), 1.0)
        fine, steps = finer(h, step)
        return h * math.sqrt(phases * steps / np.sum(fine**2))

    def envelope(self, fs_hz, seed, context):
        """See `_Jammer.envelope`."""
        phases, step = self.lattice(fs_hz)
        # An output u after a point c weighs the point c + j by h(u - j), that at -u its mirror image.
        h, half = self.response(fs_hz).reshape(kernels.N_TAPS, phases), kernels.N_TAPS // 2
        after, before = h[half:, -1], h[half::-1, -1]
        taps = np.stack([(before + after) / 2, (before - after) / 2, h[half:, phases // 2]])
        fields = {"phases": phases, "step": step}
        return Envelope(kernels.NARROW, fields=fields, taps=taps.ravel().astype(np.float32))


def finer(h: np.ndarray, step: int) -> tuple[np.ndarray, int]:
    """Impulse response after the doublings, 64-fold at most, and how much finer its grid is."""
    a, b, c = kernels.HALFWAY
    steps, between = 1, np.array([c, 0, b, 0, a, 1, a, 0, b, 0, c])
    while steps < min(step, 64):
        up = np.zeros(2 * len(h))
        up[::2] = h
        h, steps = np.convolve(up, between), 2 * steps
    return h, steps


class Wideband(_Jammer):
    """White circular Gaussian noise over everything that is sampled."""

    kind: Literal["Wideband"] = "Wideband"

    def envelope(self, fs_hz, seed, context):
        """See `_Jammer.envelope`."""
        return Envelope(kernels.WIDE)


class MatchedSpectrum(_Jammer):
    """A carrier under a random code of 1.023 Mchip/s: the spectrum of the satellites, correlated with none."""

    kind: Literal["MatchedSpectrum"] = "MatchedSpectrum"
    waveform: Literal["BPSK", "BOC11"] = "BPSK"
    """Waveform of the random code."""

    @property
    def width_hz(self):
        """The main lobe, or both of them."""
        return (2.0 if self.waveform == "BPSK" else 4.0) * CHIP_RATE_HZ

    def envelope(self, fs_hz, seed, context):
        """See `_Jammer.envelope`."""
        table, period = _random_code(int(seed), fs_hz, self.waveform)
        fields = {"period": period, "rows": table.shape[0], "columns": table.shape[1]}
        return Envelope(kernels.CODE, fields=fields, codes=table.ravel())


def _random_code(seed: int, fs_hz: float, waveform: str) -> tuple[np.ndarray, float]:
    """Table of the code, rows 1/P sample apart, and samples per period."""
    slots = chip_waveform(waveform)
    chips = np.random.default_rng(seed).integers(0, 2, _CODE_CHIPS) * 2 - 1
    levels = np.outer(chips, slots).ravel().astype(np.int8)
    per_period = _CODE_CHIPS / CHIP_RATE_HZ * fs_hz
    rows = int(2 ** np.clip(math.ceil(math.log2(128e6 / fs_hz)), 1, 6))
    n = math.ceil(per_period) + BLOCK + 8
    place = (np.arange(n)[None, :] + np.arange(rows)[:, None] / rows) * (len(levels) / per_period)
    return levels[place.astype(np.int64) % len(levels)], per_period


class Interferer(_Jammer):
    """A recording of the same rate as interferer, its mean power over ``power_window_s`` brought to the wanted one.

    Its samples lie at ``freq_hz`` from the carrier (its own intermediate frequency is removed); after its end it
    begins anew if ``repeat``.
    """

    kind: Literal["Interferer"] = "Interferer"
    path: str = Field(min_length=1)
    """Recording to add; it needs the scenario's sample rate."""
    repeat: bool = True
    """Begin anew after its end."""
    power_window_s: float = Field(1.0, gt=0.0, le=60.0)
    """Length over which its power is measured."""

    def envelope(self, fs_hz, seed, context):
        """See `_Jammer.envelope`."""
        if context["open_recording"] is None:
            raise ValueError(f"interferer '{self.path}' cannot be opened here: run it from a scenario")
        read, n_file = context["open_recording"](self.path, fs_hz)
        power = _mean_power(read, min(n_file, max(int(self.power_window_s * fs_hz), 1)))
        if power == 0.0:
            raise ValueError(
                f"interferer '{self.path}' begins with {self.power_window_s:g} s of zeros: it has no power"
            )
        return Envelope(samples=_from_file(read, n_file, self.repeat, power, int(self.start_s * fs_hz)))


def _mean_power(read, n: int) -> float:
    total, step = 0.0, 1 << 20
    for at in range(0, n, step):
        total += float(np.sum(read(at, min(step, n - at)).astype(np.float64) ** 2))
    return total / n


def _from_file(read, n_file: int, repeat: bool, power: float, first: int):
    """Envelope of a file that begins at sample ``first``; zeros before it, and after it unless it repeats."""

    def samples(n0: int, n: int) -> np.ndarray:
        out = np.zeros((2, n), np.float32)
        at = max(n0, first)
        while at < n0 + n and (repeat or at - first < n_file):
            place = (at - first) % n_file
            take = min(n0 + n - at, n_file - place)
            out[:, at - n0 : at - n0 + take] = read(place, take) / np.float32(math.sqrt(power))
            at += take
        return out

    return samples


@dataclass(eq=False)
class JammerRun:
    """Run of a jammer: ``add`` depends on the sample index alone and may be called from several threads."""

    spec: Any
    fs_hz: float
    if_hz: float
    jn0_dbhz: float
    amplitude: float
    """Of the complex envelope, thermal noise having unit variance per component."""
    n_on: int
    n_off: int
    line_hz: float
    phase_cycles: float
    sky: Sky | None
    """The one satellite whose Doppler is followed."""
    duration_s: float
    envelope: Envelope
    seed: np.uint64
    rms: float = 0.0
    """Root of the mean power per component over the run."""

    def __post_init__(self) -> None:
        self.row = np.zeros(1, kernels.JAMMER)
        for name, value in self.envelope.fields.items():
            self.row[name] = value
        self.row["kind"], self.row["seed"] = self.envelope.kind, self.seed
        self.row["n_on"], self.row["n_off"] = self.n_on, self.n_off
        self.fused = self.envelope.samples is None
        """True where the synthesis adds it itself (``row``, ``carrier``, ``level``)."""
        self._grid = Cells(self.fs_hz)
        self.carrier = lru_cache(maxsize=8)(self._carrier)
        """Phase in cycles over the cells of a second."""
        self._wave = lru_cache(maxsize=4)(self._make)

    def add(self, iq: np.ndarray, n0: int) -> None:
        """Add the samples n0, n0 + 1, .. to float32 (2, n); cells are made whole and kept."""
        at, end = n0, n0 + iq.shape[1]
        while at < end:
            first, wave = self._wave(self._grid.holding(at))
            to = min(end, first + wave.shape[1])
            if to > self.n_on and at < self.n_off:
                iq[:, at - n0 : to - n0] += wave[:, at - first : to - first]
            at = to

    def _make(self, cell: int) -> tuple[int, np.ndarray]:
        """First sample of a cell and its samples, float32 (2, n)."""
        b0, b1, n_start = self._grid.place(cell)
        first, n = b0 * BLOCK, (b1 - b0) * BLOCK
        out, no = np.zeros((2, n), np.float32), np.zeros((0, 4))
        if first >= self.n_off or first + n <= self.n_on:
            return first, out
        second, k = divmod(cell, CELLS_PER_S)
        rows, *tables = jammer_tables([self])
        synthesise(
            out, np.zeros((2, 0), np.int8), np.float32(1), np.uint64(0), np.float32(0), first, n_start, self._grid.n_cell,
            np.zeros(0, COMPONENT), no, no, no, np.zeros(0, np.int64), np.zeros(0, np.int8), np.zeros(0, np.int8),
            rows, self.carrier(second)[k : k + 1], self.level(b0, b1)[None, :], *tables,
        )  # fmt: skip
        if self.envelope.samples is None:
            return first, out
        x, y = self.envelope.samples(first, n)
        return first, np.stack([out[0] * x - out[1] * y, out[0] * y + out[1] * x])

    def level(self, b0: int, b1: int) -> np.ndarray:
        """Amplitude over blocks b0 .. b1 - 1: float32, one value or one per SUB samples."""
        if not self.spec.profile:
            return np.array([self.amplitude], np.float32)
        t_s = (np.arange(b0 * BLOCK, b1 * BLOCK, SUB) + SUB / 2) / self.fs_hz
        return (self.amplitude * 10 ** (self.profile_db(t_s) / 20)).astype(np.float32)

    def profile_db(self, t_s) -> np.ndarray:
        """Power profile at times (m,)."""
        t_s = np.asarray(t_s, float)
        if not self.spec.profile:
            return np.zeros(t_s.shape)
        at, db = np.array(self.spec.profile).T
        return np.interp(t_s, at, db)

    def _motion(self) -> tuple[float, float]:
        """Frequency at the start beside the line and its rate."""
        line = self.spec.line
        return (self.spec.freq_hz, self.spec.rate_hz_s) if line is None else (line.offset_hz, line.rate_hz_s)

    def _carrier(self, second: int) -> np.ndarray:
        """Phase in cycles over the 50 cells of a second: cubics (50, 4) in x."""
        begin = second + np.arange(CELLS_PER_S) / CELLS_PER_S
        since, d = begin - self.spec.start_s, 1.0 / CELLS_PER_S
        freq_hz, rate_hz_s = self._motion()
        steady_hz = self.if_hz + (self.line_hz if self.sky is None or self.line_hz == 0 else 0.0)
        out = np.zeros((CELLS_PER_S, 4))
        # Whole cycles of whole seconds are dropped before they cost digits.
        out[:, 0] = math.fmod(steady_hz * second, 1.0) + steady_hz * (begin - second)
        out[:, 0] += since * (freq_hz + 0.5 * rate_hz_s * since) + self.phase_cycles
        out[:, 1] = (steady_hz + freq_hz + rate_hz_s * since) * d
        out[:, 2] = 0.5 * rate_hz_s * d * d
        if self.sky is not None:
            # Cells beyond the run's end are not used, and the clock is not known there.
            nodes = second + np.arange(CELLS_PER_S + 1) / CELLS_PER_S
            now = self.sky.propagate(np.minimum(nodes, self.duration_s + 0.08))
            out -= F_L1_HZ * hermite_cells(now.phase_delay_s, now.phase_delay_rate_s_s)[:, 0]
            if self.line_hz:
                out -= self.line_hz * hermite_cells(now.delay_s, now.delay_rate_s_s)[:, 0]
                out[:, 0] += math.fmod(self.line_hz * second, 1.0) + self.line_hz * (begin - second)
                out[:, 1] += self.line_hz * d
        out[:, 0] -= np.floor(out[:, 0])
        return out

    def freq_hz(self, t_s) -> np.ndarray:
        """Centre frequency at times (m,), offset from the carrier."""
        t_s = np.atleast_1d(np.asarray(t_s, float))
        freq_hz, rate_hz_s = self._motion()
        out = self.line_hz + freq_hz + rate_hz_s * (t_s - self.spec.start_s)
        if self.sky is not None:
            now = self.sky.propagate(t_s)
            out = out - F_L1_HZ * now.phase_delay_rate_s_s[0] - self.line_hz * now.delay_rate_s_s[0]
        return out

    def mean_power(self, duration_s: float) -> float:
        """Mean of the squared envelope over the run, gaps between pulses not counted."""
        end_s = min(duration_s, self.n_off / self.fs_hz)
        begin_s = min(self.n_on / self.fs_hz, end_s)
        t_s = begin_s + (np.arange(4096) + 0.5) / 4096 * (end_s - begin_s)
        level = np.mean(10 ** (self.profile_db(t_s) / 10))
        return float(self.amplitude**2 * level * (end_s - begin_s) / duration_s)

    def check(self, duration_s: float, is_complex: bool) -> None:
        """ValueError if any of it lies beyond the band that is sampled."""
        if self.spec.kind == "Wideband":
            return
        end_s = max(min(duration_s, self.n_off / self.fs_hz), self.spec.start_s)
        ends_hz = self.freq_hz([self.spec.start_s, end_s]) + self.if_hz
        soft = self.spec.kind in ("Pulsed", "MatchedSpectrum")
        half = 0.0 if soft else self.spec.width_hz / 2
        low, high = float(ends_hz.min()) - half, float(ends_hz.max()) + half
        floor = -self.fs_hz / 2 if is_complex else 0.0
        if low < floor or high > self.fs_hz / 2:
            raise ValueError(
                f"{self.spec.kind} from {low - self.if_hz:.6g} to {high - self.if_hz:.6g} Hz lies beyond the band"
                f" {floor - self.if_hz:.6g} to {self.fs_hz / 2 - self.if_hz:.6g} Hz that is sampled: lower its frequency"
                " or bandwidth, or raise front_end.fs_hz"
            )

    def truth(self, sample_index, place: int = 0) -> np.ndarray:
        """JAMMER_TRUTH rows at these samples; ``place`` in the scenario's list."""
        index = np.atleast_1d(np.asarray(sample_index, np.uint64))
        out = np.zeros(len(index), JAMMER_TRUTH)
        out["sample_index"], out["t_s"], out["jammer"] = index, index / self.fs_hz, place
        out["kind"], out["bandwidth_hz"] = self.spec.kind.encode(), self._width_hz()
        out["on"] = (index >= self.n_on) & (index < self.n_off)
        out["freq_hz"] = self.freq_hz(out["t_s"])
        profile_db = self.profile_db(out["t_s"])
        out["jn0_dbhz"] = np.where(out["on"], self.jn0_dbhz + profile_db, -np.inf)
        out["js_db"] = (
            np.where(out["on"], self.spec.js_db + profile_db, -np.inf) if self.spec.against else np.nan
        )
        return out

    def _width_hz(self) -> float:
        return self.fs_hz if self.spec.kind == "Wideband" else min(self.spec.width_hz, self.fs_hz)

    def annotations(self, fs_hz: float, n_samples: int | None = None) -> list[dict[str, Any]]:
        """SigMF annotation of what it does in the recording, edges in Hz at the antenna."""
        n_off = self.n_off if n_samples is None else min(self.n_off, n_samples)
        if n_off <= self.n_on:
            return []
        out: dict[str, Any] = {"core:sample_start": self.n_on, "core:label": self.spec.kind}
        begin_s, half = self.n_on / fs_hz, self._width_hz() / 2
        freq_hz = self.freq_hz([begin_s])
        if n_off < 2**62:
            out["core:sample_count"] = n_off - self.n_on
            freq_hz = self.freq_hz(np.linspace(begin_s, n_off / fs_hz, 64))
        js = f", J/S {self.spec.js_db:g} dB against {self.spec.against}" if self.spec.against else ""
        return [
            out
            | {
                "core:freq_lower_edge": F_L1_HZ + float(freq_hz.min()) - half,
                "core:freq_upper_edge": F_L1_HZ + float(freq_hz.max()) + half,
                "core:comment": f"{self.spec.kind} jammer, J/N0 {self.jn0_dbhz:.2f} dB-Hz{js}",
                "core:generator": "gnss-baseband",
            }
        ]


JammerSpec = Annotated[
    CW | Chirp | Pulsed | Narrowband | Wideband | MatchedSpectrum | Interferer, Field(discriminator="kind")
]
"""Section ``[[jammer]]`` of a scenario. A new jammer is a class above with its ``kind``, added here."""
