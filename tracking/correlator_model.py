"""Correlator-domain twin: the outputs of a K-tap array drawn directly, without samples.

What an ideal front end, a wipe-off and an integration of T seconds would give, normalised to a prompt of one:
true periodic autocorrelation with its side lobes, noise with the covariance of the taps, CW and narrow-band
noise through the lines of the replica's spectrum, echoes, data signs. Loops are those of ``tracking.loops``
and the discriminators those of ``tracking.discriminators``. About a thousand times faster than samples.

Frame. Carrier phases, frequencies and code phases are deviations from a nominal signal of constant Doppler
``doppler_hz``; jammer frequencies are relative to that signal's carrier. Phases hold at mid-interval.

Left out: the other component of E1, satellites of other codes, and changes of frequency within one
integration (refused where they matter).
"""

import copy
import itertools
import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from signals.codes import primary_code, secondary_code
from signals.constants import CHIP_RATE_HZ, CYCLES_PER_CHIP, WAVELENGTH_M
from signals.modulation import SIGNALS, autocorrelation, chip_waveform
from signals.multipath import MultipathSpec
from tracking.discriminators import (
    CARRIER_DISCRIMINATORS,
    CODE_DISCRIMINATORS,
    CarrierDiscriminator,
    EarlyLateDiscriminator,
    code_scale_chips,
)
from tracking.loops import dll_gains, pll_gains
from tracking.twin_kernels import (
    BLOCK_EPOCHS,
    TWIN_COLUMNS,
    bit_signs,
    closed_loop,
    cw_sequences,
    normals_columns,
)

__all__ = [
    "TWIN_EPOCH",
    "Dynamics",
    "OpenLoopRun",
    "Twin",
    "TwinCW",
    "TwinNBI",
    "TwinRun",
    "code_spectrum",
    "cw_taps",
    "default_taps_chips",
    "filtered_autocorrelation",
    "jammer_hz",
    "noise_sigma",
    "worst_line",
]

TWIN_EPOCH = np.dtype(
    [
        ("t_s", "f8"),  # mid-interval
        ("code_error_chips", "f8"),  # truth - replica
        ("phase_error_cycles", "f8"),  # truth - replica, not wrapped
        ("freq_error_hz", "f8"),
        ("code_discriminator_chips", "f8"),
        ("phase_discriminator_cycles", "f8"),
        ("prompt_i", "f8"),
        ("prompt_q", "f8"),
        ("code_phase_chips", "f8"),  # replica, deviation from nominal
        ("carrier_phase_cycles", "f8"),  # replica, deviation from nominal
        ("doppler_hz", "f8"),  # replica, deviation from nominal
        ("data_sign", "f8"),
    ]
)
"""One integration of the twin."""

_NEAR = 1024  # code lines kept on each side of a jammer, divided by (code periods in T)^2; see _near
_LEAST = 3e-7  # of singular values and Chebyshev terms of tap vectors, over the largest singular value
_MARGIN = 0.5  # how far the loops' frequency may leave the truth, in units of 1 / T, before a CW is held
_MAX_TAPS = 512
_MAX_TERMS = 512
_SLOW_BT = 8.0  # up to this B T, narrow-band noise keeps its exact correlation in time and over the taps
_NBI_BLOCK = 4096  # epochs; overlapped by half
_FILTERED_PER_CHIP = 64
_TABLE_CHIPS = {"BPSK": 1, "BOC11": 2, "CBOC+": 12, "CBOC-": 12}


class _Spec(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class _Interferer(_Spec):
    js_db: float = Field(ge=-100, le=100)  # against the power of this signal component
    line: int | Literal["worst"] | None = "worst"  # code line k at k / code period
    freq_hz: float | None = None  # instead of a line: relative to the nominal L1 carrier
    offset_hz: float = Field(0.0, ge=-2e6, le=2e6)
    start_s: float = Field(0.0, ge=0)
    end_s: float = Field(math.inf, gt=0)

    @model_validator(mode="after")
    def _check(self):
        if self.freq_hz is not None and self.line != "worst":
            raise ValueError("give either line or freq_hz, not both")
        if self.end_s <= self.start_s:
            raise ValueError(f"end_s = {self.end_s:g} must be later than start_s = {self.start_s:g}")
        return self


class TwinCW(_Interferer):
    """Continuous wave, optionally sweeping: f(t) = f_line + offset + rate t."""

    kind: Literal["CW"] = "CW"
    rate_hz_s: float = Field(0.0, ge=-1e5, le=1e5)
    phase_rad: float | None = None  # at t = 0; None: drawn per trial


class TwinNBI(_Interferer):
    """Gaussian noise, flat over ``bandwidth_hz`` around f_line + offset."""

    kind: Literal["NBI"] = "NBI"
    bandwidth_hz: float = Field(gt=0, le=4e6)


class Dynamics(_Spec):
    """Range along the line of sight: speed and acceleration at t = 0 and steps of jerk (cubic pieces).

    tau(t) = a0 + a1 t + a2 t^2 / 2 + a3 t^3 / 6 (Ouzeau et al. 2008, section VI), positive = receding.
    """

    speed_mps: float = Field(0.0, ge=-2e3, le=2e3)
    accel_mps2: float = Field(0.0, ge=-1e3, le=1e3)
    jerk_mps3: tuple[tuple[float, float], ...] = ()  # (from t_s, jerk), times ascending

    @model_validator(mode="after")
    def _check(self):
        times = [t for t, _ in self.jerk_mps3]
        if any(t < 0 for t in times) or any(b <= a for a, b in pairwise(times)):
            raise ValueError("jerk_mps3: start times must be >= 0 and ascending")
        return self

    def at(self, t_s):
        """Range (m), range rate, acceleration at ``t_s``, three float64 arrays."""
        t = np.asarray(t_s, float)
        out = np.stack(
            [self.speed_mps * t + 0.5 * self.accel_mps2 * t * t, self.speed_mps + self.accel_mps2 * t]
        )
        accel = np.full_like(t, self.accel_mps2)
        previous = 0.0
        for start, jerk in self.jerk_mps3:
            u = np.maximum(t - start, 0.0)
            step, previous = jerk - previous, jerk
            out[0] += step * u**3 / 6
            out[1] += step * u**2 / 2
            accel += step * u
        return out[0], out[1], accel


Interferer = Annotated[TwinCW | TwinNBI, Field(discriminator="kind")]


class Twin(_Spec):
    """One tracked signal component, its interference and its loops, in the correlator domain.

    Start it with ``start`` (loops, or steered from outside) or ``start_open`` (no loops, fastest).
    """

    kind: Literal["Twin"] = "Twin"
    signal: Literal["L1CA", "E1B", "E1C"]
    prn: int
    waveform: Literal["BPSK", "BOC11", "CBOC+", "CBOC-"] | None = None  # None: the transmitted one
    cn0_dbhz: float = Field(ge=10, le=80)  # of this component
    integration_s: float = Field(gt=0, le=0.2)
    taps_chips: tuple[float, ...] | None = None  # None: default_taps_chips
    early_late_space_chips: float = Field(0.5, gt=0, le=2)
    dll_bandwidth_hz: float = Field(1.0, gt=0)
    pll_bandwidth_hz: float = Field(10.0, gt=0)
    pll_order: Literal[2, 3] = 3
    carrier_discriminator: CarrierDiscriminator = "costas_atan"
    code_discriminator: EarlyLateDiscriminator = "dot_product"
    data: bool = False  # random symbols (L1CA 20 ms, E1B 4 ms); E1C: the secondary code
    wiped: bool = False  # the channel removes the signs again
    doppler_hz: float = Field(0.0, ge=-1e5, le=1e5)
    code_phase_chips: float = Field(0.0, ge=0)  # nominal, at t = 0
    fs_hz: float | None = Field(None, gt=1e5)  # jammer lines of the sampled replica, aliases included
    alias_orders: int = Field(8, ge=1, le=64)
    loss_db: float = Field(0.0, ge=0, le=20)  # of the quantiser: raises the noise
    bandwidth_hz: float | None = Field(
        None, ge=2e5, le=60e6
    )  # front-end filter, brick wall, both sides of L1
    jammers: tuple[Interferer, ...] = ()
    multipath: MultipathSpec | None = None
    dynamics: Dynamics = Dynamics()

    @model_validator(mode="after")
    def _check(self):
        primary_code(self.signal, self.prn)
        periods = self.integration_s / SIGNALS[self.signal].code_period_s
        if abs(periods - round(periods)) > 1e-9 or round(periods) < 1:
            raise ValueError(
                f"integration_s = {self.integration_s:g} must be a whole number of code periods of "
                f"{SIGNALS[self.signal].code_period_s:g} s"
            )
        self._check_symbol()
        taps = self.taps_chips
        if taps is not None and not 1 <= len(taps) <= _MAX_TAPS:
            raise ValueError(f"taps_chips: {len(taps)} taps; give 1 to {_MAX_TAPS}")
        if taps is not None and len({round(d, 9) for d in taps}) < len(taps):
            raise ValueError("taps_chips: two taps coincide")
        for j in self.jammers:
            rate = getattr(j, "rate_hz_s", 0.0)
            if abs(rate) * self.integration_s**2 > 0.1:
                raise ValueError(
                    f"rate_hz_s = {rate:g} changes the frequency by more than 0.1 / T within one "
                    f"integration of "
                    f"{self.integration_s:g} s; use samples instead of the twin"
                )
        return self

    def _check_symbol(self):
        if self.data and self.integration_s > _symbol_s(self.signal) * (1 + 1e-9):
            raise ValueError(
                f"integration_s = {self.integration_s:g} spans more than one symbol of "
                f"{_symbol_s(self.signal):g} s of {self.signal}: shorten it or set data = false"
            )

    def autocorrelation(self, delay_chips):
        """R(d) after the front-end filter: correlation of the signal, and covariance of the noise, over the
        taps.
        """
        return filtered_autocorrelation(self.signal, self.prn, delay_chips, self.waveform, self.bandwidth_hz)

    @property
    def tap_array_chips(self):
        """The monitored taps, float64 (K,)."""
        return default_taps_chips(self.signal) if self.taps_chips is None else np.array(self.taps_chips)

    def start(self, seed, steered=False):
        """One channel with its own loops -> TwinRun; ``steered``: the NCO follows the ``steer`` of each call.

        ``seed``: SeedSequence or int; it alone decides noise, phases, symbols and echoes.
        """
        return TwinRun(self, seed, steered)

    def start_open(self, seed):
        """No loops, no tracking error -> OpenLoopRun."""
        return OpenLoopRun(self, seed)


def _symbol_s(signal):
    s = SIGNALS[signal]
    return s.code_period_s * (s.symbol_periods or 1)


def default_taps_chips(signal):
    """Taps of Ouzeau et al. 2008, section III: 35 of 0.65 chip (L1CA), 37 of 0.25 chip (E1)."""
    return 0.65 * np.arange(-17, 18) if signal == "L1CA" else 0.25 * np.arange(-18, 19)


def noise_sigma(cn0_dbhz, integration_s):
    """Standard deviation per component of a tap when the prompt is one: sqrt(1 / (2 T C/N0))."""
    return math.sqrt(0.5 / (integration_s * 10 ** (cn0_dbhz / 10)))


def code_spectrum(signal, prn, k, waveform=None):
    """Fourier coefficients of the code waveform, c(p) = sum_k c_k exp(2 pi i k p / L), complex128, shape of
    k.

    c_k = DFT(chips)_k / L times the transform of one chip at k / L cycles per chip.
    """
    chips = primary_code(signal, prn).astype(float)
    slots = chip_waveform(waveform or SIGNALS[signal].waveform)
    k = np.asarray(k)
    nu = k / len(chips)
    centre = (np.arange(len(slots)) + 0.5) / len(slots)
    chip = np.exp(-2j * np.pi * nu[..., None] * centre) @ slots / len(slots) * np.sinc(nu / len(slots))
    return _chip_dft(signal, prn)[k % len(chips)] * chip


@lru_cache(maxsize=64)
def _chip_dft(signal, prn):
    chips = primary_code(signal, prn).astype(float)
    return np.fft.fft(chips) / len(chips)


@lru_cache(maxsize=256)
def worst_line(signal, prn, waveform=None):
    """Index k > 0 of the strongest line of a code's spectrum."""
    k = np.arange(1, 2 * SIGNALS[signal].code_length_chips)
    return int(k[np.argmax(np.abs(code_spectrum(signal, prn, k, waveform)))])


@lru_cache(maxsize=64)
def _acf_table(signal, prn, waveform, bandwidth_hz=None):
    """One period of R and its points per chip; R is linear between them.

    Behind a filter R(d) = sum of |c_k|^2 e^{2 pi i k d / L} over the lines that pass; 64 points per chip
    leave 1e-3.
    """
    waveform = waveform or SIGNALS[signal].waveform
    length = SIGNALS[signal].code_length_chips
    per_chip = _TABLE_CHIPS[waveform] if bandwidth_hz is None else _FILTERED_PER_CHIP
    n = length * per_chip
    if bandwidth_hz is None:
        table = autocorrelation(signal, prn, np.arange(n) / per_chip, waveform)
    else:
        k = np.arange(math.floor(0.5 * bandwidth_hz * SIGNALS[signal].code_period_s) + 1)
        power = np.zeros(n // 2 + 1)
        power[k] = np.abs(code_spectrum(signal, prn, k, waveform)) ** 2
        table = np.fft.irfft(power, n) * n
    table.flags.writeable = False
    return table, per_chip


def filtered_autocorrelation(signal, prn, delay_chips, waveform=None, bandwidth_hz=None):
    """R(d) of a code behind a brick-wall filter of ``bandwidth_hz`` about the carrier (None: no filter), float64."""
    if bandwidth_hz is None:
        return autocorrelation(signal, prn, delay_chips, waveform)
    table, per_chip = _acf_table(signal, prn, waveform, bandwidth_hz)
    y = np.mod(np.asarray(delay_chips, float) * per_chip, len(table))
    i = np.floor(y).astype(np.int64)
    return table[i % len(table)] + (y - i) * (table[(i + 1) % len(table)] - table[i % len(table)])


@lru_cache(maxsize=64)
def _noise_factor(signal, prn, waveform, bandwidth_hz, taps):
    """F with F F^T = R(d_i - d_j), float64 (K, K): Cholesky, or the symmetric root where R is singular."""
    d = np.array(taps)
    R = filtered_autocorrelation(signal, prn, d[:, None] - d[None, :], waveform, bandwidth_hz)
    R = 0.5 * (R + R.T)
    try:
        return np.linalg.cholesky(R)
    except np.linalg.LinAlgError:
        value, vector = np.linalg.eigh(R)
        return vector * np.sqrt(np.maximum(value, 0.0))


def _passed(spec, jammer):
    """What of a jammer passes the front-end filter: the jammer with a smaller band or a shorter time, or
    None.
    """
    if spec.bandwidth_hz is None:
        return jammer
    edge = 0.5 * spec.bandwidth_hz
    f = jammer_hz(spec, jammer) + spec.doppler_hz
    if isinstance(jammer, TwinNBI):
        low, high = max(f - 0.5 * jammer.bandwidth_hz, -edge), min(f + 0.5 * jammer.bandwidth_hz, edge)
        if high <= low:
            return None
        change = {
            "js_db": jammer.js_db + 10 * math.log10((high - low) / jammer.bandwidth_hz),
            "bandwidth_hz": high - low,
            "offset_hz": jammer.offset_hz + 0.5 * (low + high) - f,
        }
        return jammer.model_copy(update=change)
    if jammer.rate_hz_s == 0.0:
        return jammer if abs(f) <= edge else None
    enter, leave = sorted((x - f) / jammer.rate_hz_s for x in (-edge, edge))
    start, end = max(jammer.start_s, enter), min(jammer.end_s, leave)
    return jammer.model_copy(update={"start_s": start, "end_s": end}) if start < end else None


def _near(periods):
    """Lines on each side that keep the truncated sum within 0.014 of a typical line: 2 / (pi N eps)^2."""
    return max(16, math.ceil(_NEAR / periods**2))


def _line_vectors(signal, prn, waveform, k, taps):
    """conj(c_k) e^{-2 pi i k d / L}, complex128 (n, K)."""
    k = np.asarray(k)
    length = SIGNALS[signal].code_length_chips
    c = np.conj(code_spectrum(signal, prn, k, waveform))
    turns = np.mod(k[:, None] * (taps[None, :] / length), 1.0)
    return c[:, None] * np.exp(-2j * np.pi * turns)


def _tap_vectors(signal, prn, waveform, integration_s, x, taps):
    """Taps of a unit CW of frequency x / T whose phase is zero at mid-interval, complex128 (n, K).

    sum_k conj(c_k) sinc(x - k N) e^{-2 pi i k (N / 2 + d / L)}, N code periods in T.
    """
    N = round(integration_s / SIGNALS[signal].code_period_s)
    near = _near(N)
    k = np.arange(math.floor(x.min() / N) - near, math.ceil(x.max() / N) + near + 1)
    sign = np.where(k * N % 2 == 0, 1.0, -1.0)
    return (np.sinc(x[:, None] - k * N) * sign) @ _line_vectors(signal, prn, waveform, k, taps)


def _chebyshev(spec, low, high, taps):
    """Chebyshev coefficients of the tap vectors over f T in [low, high] -> (centre, half width), complex64
    (J, K).
    """
    span, series = _span(spec, low, high, taps)
    return span, _series(*series)


def _span(spec, low, high, taps):
    """(centre, half width) and the arguments of `_series`.

    The sinc has exponential type pi: terms fall like (pi w / 2)^j / j!.
    """
    half = max(0.5 * (high - low), 1e-9)
    n = 1 if half < 1e-6 else math.ceil(math.pi * half) + 8
    if n > _MAX_TERMS:
        raise ValueError(
            f"a jammer sweeps {2 * half:.0f} / T within {BLOCK_EPOCHS} integrations: lower rate_hz_s or "
            "use samples instead of the twin"
        )
    centre = 0.5 * (low + high)
    code = spec.signal, spec.prn, spec.waveform
    return (centre, half), (*code, spec.integration_s, centre, half, n, taps)


@lru_cache(maxsize=256)
def _series(signal, prn, waveform, integration_s, centre, half, n, taps):
    """The coefficients, kept: every trial of a campaign meets the same sweep."""
    angle = np.pi * (np.arange(n) + 0.5) / n
    x = centre + half * np.cos(angle)
    values = _tap_vectors(signal, prn, waveform, integration_s, x, np.array(taps))
    basis = np.cos(np.outer(np.arange(n), angle)) * (2.0 / n)
    basis[0] *= 0.5
    out = (basis @ values).astype(np.complex64)
    out.flags.writeable = False
    return out


@lru_cache(maxsize=256)
def _singular(*series):
    """`_series` as a product, complex64 (J, R) and (R, K): about one code line the tap vectors are almost
    proportional, and two or three singular vectors hold what float32 does.
    """
    u, size, v = np.linalg.svd(_series(*series), full_matrices=False)
    rank = max(int(np.sum(size > _LEAST * size[0])), 1)
    weights = u[:, :rank] * size[:rank]
    terms = np.flatnonzero(np.abs(weights).max(axis=1) > _LEAST * size[0])[-1] + 1
    return np.ascontiguousarray(weights[:terms]), v[:rank]


def jammer_hz(spec, jammer):
    """Frequency at t = 0 relative to the nominal signal."""
    if jammer.freq_hz is not None:
        return jammer.freq_hz - spec.doppler_hz + jammer.offset_hz
    k = worst_line(spec.signal, spec.prn, spec.waveform) if jammer.line == "worst" else jammer.line
    return (k or 0) / SIGNALS[spec.signal].code_period_s + jammer.offset_hz


def cw_taps(spec, cw):
    """Taps of a CW at its frequency of t = 0, phase zero at mid-interval, complex128 (K,); prompt of the signal = 1."""
    x = np.array([jammer_hz(spec, cw) * spec.integration_s])
    code = spec.signal, spec.prn, spec.waveform
    return 10 ** (cw.js_db / 20) * _tap_vectors(*code, spec.integration_s, x, spec.tap_array_chips)[0]


def _keys(seed):
    """Independent random streams of one trial: noise key, symbol key, NBI key, Generator, echo seed, NBI
    seed.
    """
    seq = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    # Children by number, not by spawn(), which would remember earlier calls.
    child = [
        np.random.SeedSequence(seq.entropy, spawn_key=(*seq.spawn_key, i), pool_size=seq.pool_size)
        for i in range(4)
    ]
    noise, symbol, wide = child[0].generate_state(3, np.uint64)
    return noise, symbol, wide, np.random.Generator(np.random.Philox(child[1])), child[2], child[3]


def _cw_rows(spec, rng):
    """CW jammers as rows (f, rate, phase, amplitude, start, end), aliases of a sampled replica included."""
    rows = []
    for j in spec.jammers:
        phase = rng.random()  # drawn for every jammer: leaving one out does not move the others
        j = _passed(spec, j)
        if not isinstance(j, TwinCW):
            continue
        phase = phase if j.phase_rad is None else j.phase_rad / (2 * math.pi)
        base = [jammer_hz(spec, j), j.rate_hz_s, phase, 10 ** (j.js_db / 20), j.start_s, j.end_s]
        rows.append(base)
        if spec.fs_hz is None:
            continue
        # A product that is sampled at t = i / fs sees the jammer repeated at every fs.
        for m in range(-spec.alias_orders, spec.alias_orders + 1):
            if m:
                rows.append([base[0] + m * spec.fs_hz, *base[1:]])
    return np.array(rows, float).reshape(len(rows), 6)


class _Stage:
    """What closed and open loop share: code, taps, noise, signs, echoes and interference of one trial."""

    def __init__(self, spec, seed, taps):
        self.spec, self.taps, self.tap_key = spec, taps, tuple(taps.tolist())
        code = SIGNALS[spec.signal]
        self.length = code.code_length_chips
        self.line_hz = 1.0 / code.code_period_s
        self.acf, self.per_chip = _acf_table(spec.signal, spec.prn, spec.waveform, spec.bandwidth_hz)
        self.sigma = noise_sigma(spec.cn0_dbhz - spec.loss_db, spec.integration_s)
        factor = self.sigma * _noise_factor(
            spec.signal, spec.prn, spec.waveform, spec.bandwidth_hz, self.tap_key
        )
        self.factor = factor.astype(np.float32)
        self.key, self.symbol_key, self.wide_key, rng, echo_seed, self.nbi_seed = _keys(seed)
        self.cws = _cw_rows(spec, rng)
        self.echoes = spec.multipath.start(echo_seed) if spec.multipath else None
        passed = [(i, _passed(spec, j)) for i, j in enumerate(spec.jammers)]
        self.nbis = [_nbi(self, i, j) for i, j in passed if isinstance(j, TwinNBI)]
        self.hash = np.empty(BLOCK_EPOCHS, np.int32), np.empty(BLOCK_EPOCHS, np.int32)
        self.secondary = secondary_code().astype(np.float32)

    def signs(self, block):
        out = np.empty(BLOCK_EPOCHS, np.float32)
        per_symbol = max(1, round(_symbol_s(self.spec.signal) / self.spec.integration_s))
        mode = 0 if not self.spec.data else 2 if self.spec.signal == "E1C" else 1
        bit_signs(self.symbol_key, block * BLOCK_EPOCHS, per_symbol, mode, self.secondary, out)
        return out

    def normals(self, key, block, out):
        normals_columns(key, block, *self.hash, out)

    def echo_block(self, block):
        """Gains complex64 (n, E) and delays in chips, float64 (n, E)."""
        if self.echoes is None or self.echoes.n_echo == 0:
            return np.zeros((0, BLOCK_EPOCHS), np.complex64), np.zeros((0, BLOCK_EPOCHS))
        T = self.spec.integration_s
        gain, delay_s = self.echoes.series((block * BLOCK_EPOCHS + 0.5) * T, T, BLOCK_EPOCHS)
        return gain, delay_s * CHIP_RATE_HZ

    def mid_s(self, block):
        """Mid-interval times of a block."""
        return (block * BLOCK_EPOCHS + 0.5 + np.arange(BLOCK_EPOCHS)) * self.spec.integration_s

    def ends_s(self, block):
        """The first and the last of them."""
        first = block * BLOCK_EPOCHS + 0.5
        return first * self.spec.integration_s, (first + BLOCK_EPOCHS - 1) * self.spec.integration_s


class _SlowNBI:
    """Noise of small B T: exact in time and over the taps, made in overlapped FFT blocks.

    A sum of many Gaussian tones; the tap vector of each by the Chebyshev series over the band, so that J
    sequences of epochs times J tap vectors make the whole.
    """

    def __init__(self, stage, number, jammer):
        spec = stage.spec
        self.T, self.jammer = spec.integration_s, jammer
        self.seed = np.random.SeedSequence(
            stage.nbi_seed.entropy, spawn_key=(*stage.nbi_seed.spawn_key, number)
        )
        self.centre_hz = jammer_hz(spec, jammer)
        grid = 1.0 / (_NBI_BLOCK * self.T)
        low, high = (self.centre_hz + s * 0.5 * jammer.bandwidth_hz for s in (-1, 1))
        self.bins = np.arange(math.ceil(low / grid), math.floor(high / grid) + 1)
        if len(self.bins) < 4:
            raise ValueError(
                f"bandwidth_hz = {jammer.bandwidth_hz:g} is below {4 * grid:.3g}, the least the twin resolves "
                f"at T = {self.T:g} s; use a CW jammer"
            )
        (centre, half), self.vectors = _chebyshev(spec, low * self.T, high * self.T, stage.tap_key)
        u = np.clip((self.bins * grid * self.T - centre) / half, -1.0, 1.0)
        turn = 0.5 * self.bins * grid * self.T  # block start to mid-interval
        terms = np.cos(np.outer(np.arange(len(self.vectors)), np.arccos(u)))
        self.gain = 10 ** (jammer.js_db / 20) * terms * np.exp(2j * np.pi * turn)
        self.window = np.sin(np.pi * (np.arange(_NBI_BLOCK) + 0.5) / _NBI_BLOCK)
        self.cache = {}

    def _half_blocks(self, index):
        """One windowed block, complex128 (J, _NBI_BLOCK), that starts at epoch (index - 1) _NBI_BLOCK /
        2.
        """
        if index not in self.cache:
            seed = np.random.SeedSequence(self.seed.entropy, spawn_key=(*self.seed.spawn_key, index))
            rng = np.random.Generator(np.random.Philox(seed))
            g = rng.standard_normal((2, len(self.bins))).T.copy().view(complex)[:, 0]
            g /= math.sqrt(2 * len(self.bins))
            spectrum = np.zeros((len(self.gain), _NBI_BLOCK), complex)
            for row, gain in zip(spectrum, self.gain):
                np.add.at(row, self.bins % _NBI_BLOCK, g * gain)
            x = np.fft.ifft(spectrum, axis=1) * _NBI_BLOCK
            self.cache = {i: v for i, v in self.cache.items() if i >= index - 2}
            self.cache[index] = x * self.window
        return self.cache[index]

    def sequence(self, block, mid_s):
        """Time sequence of each Chebyshev term, complex64 (J, E)."""
        half = _NBI_BLOCK // 2
        index, start = divmod(block * BLOCK_EPOCHS, half)
        old, new = self._half_blocks(index), self._half_blocks(index + 1)
        x = old[:, half + start : half + start + BLOCK_EPOCHS] + new[:, start : start + BLOCK_EPOCHS]
        on = (mid_s >= self.jammer.start_s) & (mid_s < self.jammer.end_s)
        return (x * on).astype(np.complex64)


class _WideNBI:
    """Narrow-band noise through many lines: white between epochs, with its covariance over the taps."""

    def __init__(self, stage, number, jammer):
        self.jammer, self.key = jammer, np.uint64((int(stage.wide_key) + number) % 2**64)
        centre = jammer_hz(stage.spec, jammer)
        k = _nbi_lines(stage, centre, jammer.bandwidth_hz)
        spec = stage.spec
        vectors = _line_vectors(spec.signal, spec.prn, spec.waveform, k, stage.taps)
        power = _sinc2_mean(k * stage.line_hz - centre, jammer.bandwidth_hz, stage.spec.integration_s)
        C = (vectors.T * (power * 10 ** (jammer.js_db / 10))) @ vectors.conj()
        value, vector = np.linalg.eigh(0.5 * (C + C.conj().T))
        keep = value > 1e-9 * value[-1]
        factor = vector[:, keep] * np.sqrt(0.5 * value[keep])
        # Real form on stacked columns (in-phase | quadrature) of unit normals.
        self.re, self.im = factor.real.astype(np.float32), factor.imag.astype(np.float32)

    def columns(self, stage, block, mid_s):
        """Contribution to the taps, float32 (K, 2 E)."""
        n = BLOCK_EPOCHS
        g = np.empty((self.re.shape[1], 2 * n), np.float32)
        stage.normals(self.key, block, g)
        on = ((mid_s >= self.jammer.start_s) & (mid_s < self.jammer.end_s)).astype(np.float32)
        g *= np.concatenate([on, on])
        swapped = np.concatenate([-g[:, n:], g[:, :n]], axis=1)
        return self.re @ g + self.im @ swapped


def _nbi(stage, number, jammer):
    slow = jammer.bandwidth_hz * stage.spec.integration_s <= _SLOW_BT
    return (_SlowNBI if slow else _WideNBI)(stage, number, jammer)


def _nbi_lines(stage, centre_hz, bandwidth_hz):
    """Indices of the lines that the band reaches."""
    near = min(32, _near(round(stage.spec.integration_s * stage.line_hz)))
    low = round((centre_hz - 0.5 * bandwidth_hz) / stage.line_hz) - near
    high = round((centre_hz + 0.5 * bandwidth_hz) / stage.line_hz) + near
    return np.arange(low, high + 1)


def _sinc2_mean(offset_hz, bandwidth_hz, T):
    """Mean of sinc^2((f - offset) T) over the band, by its integral [Si(2 y) - sin(y)^2 / y] / pi, y = pi
    x.
    """
    from scipy.special import sici

    def integral(x):
        y = np.pi * np.where(x == 0.0, 1e-12, x)
        return (sici(2 * y)[0] - np.sin(y) ** 2 / y) / np.pi

    upper, lower = (0.5 * bandwidth_hz - offset_hz) * T, (-0.5 * bandwidth_hz - offset_hz) * T
    return (integral(upper) - integral(lower)) / (bandwidth_hz * T)


@dataclass
class _Block:
    index: int
    signs: np.ndarray
    rows: np.ndarray
    gain: np.ndarray
    chips: np.ndarray
    slow: np.ndarray
    truth: np.ndarray
    wanted: np.ndarray
    out: np.ndarray
    corr: np.ndarray


class TwinRun:
    """One channel with loops: call it with a number of epochs. Cutting a run into calls does not change a
    bit.
    """

    def __init__(self, spec, seed, steered=False):
        self.spec, self.steered = spec, steered
        taps = spec.tap_array_chips
        self.n_taps = len(taps)
        taps, (e, p, late) = _with_taps(taps, spec.early_late_space_chips)
        self.stage = _Stage(spec, seed, taps)
        T = spec.integration_s
        scale = code_scale_chips(
            spec.code_discriminator,
            spec.autocorrelation,
            spec.early_late_space_chips,
        )
        gains = pll_gains(spec.pll_order, spec.pll_bandwidth_hz, T)
        code_gain = dll_gains(1, spec.dll_bandwidth_hz, T)[0]
        carrier, code = (
            CARRIER_DISCRIMINATORS[spec.carrier_discriminator],
            CODE_DISCRIMINATORS[spec.code_discriminator],
        )
        self.loop = np.array([*gains, code_gain, scale, e, p, late, carrier, code])
        s = self.stage
        self.geometry = np.array(
            [T, CHIP_RATE_HZ, s.length, spec.code_phase_chips, s.per_chip, CYCLES_PER_CHIP], float
        )
        first = self.truth(np.array([0.5 * T]))[0]
        _, _, accel = spec.dynamics.at(np.array([0.5 * T]))
        rate, ramp = first[1] * T, -accel[0] / WAVELENGTH_M * T * T
        self.state = np.array([first[0], rate, rate, ramp, first[2]])
        self.epoch = 0
        self._block = None
        self._spans: Any = None  # (spans, vectors) of the CW, once known
        slow = [n for n in s.nbis if isinstance(n, _SlowNBI)]
        self._slow = slow
        self._slow_hz = np.array([n.centre_hz for n in slow for _ in n.vectors], float)
        self._slow_vectors = np.concatenate(
            [np.zeros((0, len(taps)), np.complex64), *(n.vectors for n in slow)]
        )

    def truth(self, t_s):
        """Carrier phase (cycles), frequency (Hz), code phase (chips) of the signal, float64 (n, 3),
        deviations.
        """
        distance, speed, _ = self.spec.dynamics.at(t_s)
        cycles = -distance / WAVELENGTH_M
        return np.stack([cycles, -speed / WAVELENGTH_M, cycles / CYCLES_PER_CHIP], axis=1)

    def __call__(self, n_epochs, steer=None, truth=None):
        """Advance by ``n_epochs``.

        Parameters
        ----------
        steer : float64 (n_epochs, 3), for a steered run
            Replica's carrier phase (cycles), frequency (Hz), code phase (chips) at mid-interval.
        truth : float64 (n_epochs, 3), optional
            The signal's, in place of ``dynamics``.

        Returns
        -------
        epochs : TWIN_EPOCH (n_epochs,)
        corr : complex64 (n_epochs, K)
        """
        if self.steered != (steer is not None):
            raise ValueError("a steered run needs steer for every call, a run with loops must have none")
        for name, table in (("steer", steer), ("truth", truth)):
            if table is not None and np.shape(table) != (n_epochs, 3):
                raise ValueError(f"{name} has shape {np.shape(table)}, it must be ({n_epochs}, 3)")
        columns = np.empty((n_epochs, TWIN_COLUMNS))
        corr = np.empty((n_epochs, self.n_taps), np.complex64)
        done = 0
        while done < n_epochs:
            block, lo = divmod(self.epoch, BLOCK_EPOCHS)
            hi = min(BLOCK_EPOCHS, lo + n_epochs - done)
            part = slice(done, done + hi - lo)
            out, taps = self._advance(
                block, lo, hi, None if steer is None else steer[part], None if truth is None else truth[part]
            )
            columns[part], corr[part] = out[lo:hi], taps[lo:hi, : self.n_taps]
            done += hi - lo
            self.epoch += hi - lo
        return _records(columns, self.epoch - n_epochs, self.spec.integration_s), corr

    def branch(self, noise_key):
        """A copy in this very state whose receiver noise is drawn anew from here on, by a key of 64 bits.

        Jammers, their noise included, symbols and echoes stay those of this run.
        """
        run = copy.copy(self)
        run.state = self.state.copy()
        run.stage = copy.copy(self.stage)
        run.stage.key = np.uint64(noise_key)
        run.rest()
        return run

    def rest(self):
        """Let go of the block at hand, which is made again when it is needed."""
        self._block = None

    def _advance(self, index, lo, hi, steer, truth):
        b = self._prepare(index)
        if steer is not None:
            b.wanted[lo:hi] = steer
        if truth is not None:
            b.truth[lo:hi] = truth
            self._vectors(index, b.truth[lo:hi, 1])
        spans, vectors = self._spans
        closed_loop(
            self.state,
            index * BLOCK_EPOCHS,
            lo,
            hi,
            self.steered,
            b.wanted,
            b.truth,
            b.signs,
            self.spec.wiped,
            b.rows,
            self.stage.acf,
            self.stage.taps,
            b.gain,
            b.chips,
            self.stage.cws,
            spans,
            vectors,
            self._slow_hz,
            self._slow_vectors,
            b.slow,
            self.geometry,
            self.loop,
            b.out,
            b.corr,
        )
        return b.out, b.corr

    def _prepare(self, index):
        """Everything about a block that does not depend on the loops."""
        if self._block is not None and self._block.index == index:
            return self._block
        s = self.stage
        mid_s = s.mid_s(index)
        g = np.empty((len(s.taps), 2 * BLOCK_EPOCHS), np.float32)
        s.normals(s.key, index, g)
        rows = g.T @ s.factor.T
        slow = [n.sequence(index, mid_s) for n in self._slow]
        for n in s.nbis:
            if isinstance(n, _WideNBI):
                rows += n.columns(s, index, mid_s).T
        gain, chips = s.echo_block(index)
        self._block = _Block(
            index,
            s.signs(index),
            np.ascontiguousarray(rows),
            gain,
            chips,
            np.concatenate(slow) if slow else np.zeros((0, BLOCK_EPOCHS), np.complex64),
            self.truth(mid_s),
            np.zeros((BLOCK_EPOCHS, 3)),
            np.empty((BLOCK_EPOCHS, TWIN_COLUMNS)),
            np.empty((BLOCK_EPOCHS, len(s.taps)), np.complex64),
        )
        self._vectors(index, self._block.truth[:, 1])
        return self._block

    def _vectors(self, index, freq_hz):
        """Chebyshev tables over where the jammers go within a block; the old ones stay while they suffice.

        Asked for the whole block where the truth is the twin's own, so that cutting a run changes nothing.
        """
        s = self.stage
        low_hz, high_hz = freq_hz.min(), freq_hz.max()
        ranges = _reach(s.cws, s.ends_s(index), low_hz, high_hz, self.spec.integration_s)
        if self._spans is not None and _covers(self._spans[0], ranges):
            return
        spans, vectors, row = [], [np.zeros((0, len(s.taps)), np.complex64)], 0
        for low, high in ranges:
            span, v = _chebyshev(self.spec, low - _MARGIN, high + _MARGIN, s.tap_key)
            spans.append([*span, row, len(v)])
            vectors.append(v)
            row += len(v)
        self._spans = np.array(spans, float).reshape(-1, 4), np.concatenate(vectors)


def _reach(cws, ends_s, low_hz, high_hz, T):
    """f T of each CW relative to a signal between two frequencies over a block, list of (low, high)."""
    out = []
    for f, rate, *_ in cws.tolist():
        ends = f + rate * ends_s[0], f + rate * ends_s[1]
        out.append(((min(ends) - high_hz) * T, (max(ends) - low_hz) * T))
    return out


def _covers(spans, ranges):
    """Whether the tables still leave half the margin on both sides."""
    spare = 0.5 * _MARGIN
    return all(
        c - h + spare <= low and high <= c + h - spare for (c, h, *_), (low, high) in zip(spans, ranges)
    )


def _with_taps(taps, spacing_chips):
    """Append E, P and L where no tap is there already -> taps, their three indices."""
    taps = list(taps)
    index = []
    for d in (0.5 * spacing_chips, 0.0, -0.5 * spacing_chips):
        near = [i for i, tap in enumerate(taps) if abs(tap - d) < 1e-9]
        if not near:
            taps.append(d)
        index.append(near[0] if near else len(taps) - 1)
    return np.array(taps), index


def _records(columns, epoch0, T):
    out = np.empty(len(columns), TWIN_EPOCH)
    out["t_s"] = (epoch0 + 0.5 + np.arange(len(columns))) * T
    for name, column in zip((TWIN_EPOCH.names or ())[1:], columns.T):
        out[name] = column
    return out


class OpenLoopRun:
    """No loops and no tracking error: ``block(i)`` is a pure function of the seed and i.

    All terms but the noise are rank one, (taps) x (time), so a block is a matrix product; the delay of an
    echo is held at its middle for that (``start`` moves it every epoch).
    Z = [R | echoes | lines | F] [time sequences ; normals], with columns in-phase then quadrature. F is lower
    triangular where R has a Cholesky factor: the upper half of the taps then needs half of the normals.
    """

    def __init__(self, spec, seed):
        self.spec = spec
        self.stage = _Stage(spec, seed, spec.tap_array_chips)
        self.n_taps = len(self.stage.taps)
        self.R = spec.autocorrelation(self.stage.taps).astype(np.float32)
        triangular = not np.triu(self.stage.factor, 1).any()
        self._upper = self.n_taps // 2 if triangular else 0
        self._slow = [n for n in self.stage.nbis if isinstance(n, _SlowNBI)]
        self._wide = [n for n in self.stage.nbis if isinstance(n, _WideNBI)]
        self._key, self._series = None, {}
        self.inner = np.empty((0, 2 * BLOCK_EPOCHS), np.float32)
        self.out = np.empty((self.n_taps, 2 * BLOCK_EPOCHS), np.float32)
        self.block_epochs = BLOCK_EPOCHS

    def block(self, index):
        """Correlator outputs of epochs index E .. index E + E - 1: float32 (K, 2 E), in-phase | quadrature.

        The array is reused by the next call.
        """
        s, upper = self.stage, self._upper
        lines = self._lines(index) if len(s.cws) else ()
        gain, chips = s.echo_block(index)
        self._buffers(lines, len(gain))
        terms = len(self.inner) - self.n_taps
        self._sequences(index, lines, gain, chips)
        s.normals(s.key, index, self.inner[terms:])
        if upper:
            np.matmul(self.left[:upper, : terms + upper], self.inner[: terms + upper], out=self.out[:upper])
        np.matmul(self.left[upper:], self.inner, out=self.out[upper:])
        for nbi in self._wide:
            self.out += nbi.columns(s, index, s.mid_s(index))
        return self.out

    def _sequences(self, index, lines, gain, chips):
        """The time sequences of a block: direct path, echoes, lines of CW and of narrow-band noise."""
        s, n = self.stage, BLOCK_EPOCHS
        signs = s.signs(index)
        one = np.ones(n, np.float32)
        direct, jam = (one, signs) if self.spec.wiped else (signs, one)
        self.inner[0, :n], self.inner[0, n:] = direct, 0.0
        row = 1
        for g, d in zip(gain, chips):
            self.left[:, row] = self.spec.autocorrelation(s.taps + d[n // 2])
            self.inner[row, :n], self.inner[row, n:] = direct * g.real, direct * g.imag
            row += 1
        shift_s = self.spec.code_phase_chips / CHIP_RATE_HZ
        for j, (centre, half), terms in lines:
            part, weights = self.inner[row : row + 2 * terms], self._series[j][2]
            cw_sequences(
                s.cws[j], centre, half, index * n, self.spec.integration_s, shift_s, jam, weights, part
            )
            row += 2 * terms
        for nbi in self._slow:
            for x in nbi.sequence(index, s.mid_s(index)):
                self.inner[row, :n], self.inner[row, n:] = jam * x.real, jam * x.imag
                row = self._quadrature(row)

    def __call__(self, n_epochs, epoch0=0):
        """Epochs from ``epoch0`` as complex64 (n_epochs, K)."""
        corr = np.empty((n_epochs, self.n_taps), np.complex64)
        done = 0
        while done < n_epochs:
            index, lo = divmod(epoch0 + done, BLOCK_EPOCHS)
            m = min(BLOCK_EPOCHS - lo, n_epochs - done)
            z = self.block(index)
            corr.real[done : done + m] = z[:, lo : lo + m].T
            corr.imag[done : done + m] = z[:, BLOCK_EPOCHS + lo : BLOCK_EPOCHS + lo + m].T
            done += m
        return corr

    def _quadrature(self, row):
        """The row below holds j times the sequence, for the imaginary part of the line's vector."""
        n = BLOCK_EPOCHS
        self.inner[row + 1, :n] = -self.inner[row, n:]
        self.inner[row + 1, n:] = self.inner[row, :n]
        return row + 2

    def _lines(self, index):
        """(jammer, span, number of terms) of each CW that is on in a block; fills their tap vectors."""
        s, T = self.stage, self.spec.integration_s
        first_s, last_s = ends_s = s.ends_s(index)
        out = []
        for j, (low, high) in enumerate(_reach(s.cws, ends_s, 0.0, 0.0, T)):
            if s.cws[j, 4] > last_s or s.cws[j, 5] <= first_s:
                continue
            if j not in self._series or self._series[j][0] != (low, high):
                span, series = _span(self.spec, low, high, s.tap_key)
                self._series[j] = (low, high), span, *_singular(*series)
            _, span, _, vectors = self._series[j]
            out.append((j, span, len(vectors)))
        return tuple(out)

    def _buffers(self, lines, n_echo):
        if self._key == (lines, n_echo):
            return
        self._key = lines, n_echo
        vectors = [self._series[j][3] for j, *_ in lines] + [n.vectors for n in self._slow]
        K, first = self.n_taps, 1 + n_echo
        terms = first + 2 * sum(map(len, vectors))
        if self.inner.shape[0] != terms + K:
            self.left = np.zeros((K, terms + K), np.float32)
            self.left[:, 0], self.left[:, terms:] = self.R, self.stage.factor
            self.inner = np.empty((terms + K, 2 * BLOCK_EPOCHS), np.float32)
        for vector, row in zip(itertools.chain(*vectors), range(first, terms, 2)):
            self.left[:, row], self.left[:, row + 1] = vector.real, vector.imag
