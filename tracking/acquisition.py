"""Acquisition: parallel code-phase search, threshold from a set false-alarm rate, refinement.

Search. Samples are brought to a working rate whose code period is an FFT-friendly number N of samples. For every
Doppler bin and block b, y_b = IFFT(X_b shifted by the bin x conj(C)) holds all code phases at once. L1 C/A: circular,
over ``coherent_ms`` code periods. E1: blocks of two periods against one period of code and N zeros, so that every
output spans exactly one whole code period and no symbol or secondary chip changes inside it (a change inside the
4 ms moves the peak by up to 125 Hz); the powers of E1-B and E1-C are added for the pilot.

Statistic. S = sum over K = blocks x components of |y|^2, divided by K times the mean over the code phases of the same
Doppler bin, its own peak left out: a tone raises its bin's floor together with its bin's cells. Where the code phases
of a bin are spread wider than noise spreads them (several tones, other satellites' cross-correlations), what exceeds
one is divided by that excess. On noise K times the statistic is Gamma(K, 1), and a search over M cells has P_FA = 1 - exp(-M theta Q(K, u)), where theta is the share of
exceedances whose neighbours stay below (``search_threshold``).

Verification. What stays below its threshold has a second chance: the best code phases of the best Doppler bins are
looked at again, over longer integrations, in later samples that the search has not seen and where few cells are in
play. It is allowed a hundredth of the false-alarm rate: long integrations also gather what is not noise.

Strong satellites are taken out of the samples before a verification, and before a weak detection is believed.
"""

import math
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator
from scipy.special import chndtr, fdtri, gammaincc, gammainccinv, gammaln

from signals.codes import prns_of
from signals.constants import CHIP_RATE_HZ, F_L1_HZ
from signals.modulation import SIGNALS, chip_acf, code_table
from tracking import acquisition_kernels as kernels
from tracking.fft import fast_length, row_fft
from tracking.records import ACQUISITION

__all__ = [
    "AcquisitionSpec",
    "acquire",
    "search_threshold",
    "slab_samples",
    "to_working_rate",
    "working_rate",
]

_COMPONENTS = {"L1CA": ("L1CA",), "E1B": ("E1B",), "E1C": ("E1B", "E1C")}
_REPLICA = {"L1CA": "BPSK", "E1B": "BOC11", "E1C": "BOC11"}
_BEST_HZ = {"L1CA": 4.096e6, "E1B": 4.0e6, "E1C": 4.0e6}  # 4096 and 2 x 16000 samples: quick transforms
_BLOCKS = {"L1CA": 10, "E1B": 6, "E1C": 3}  # default search: 10 ms, 28 ms, 16 ms
_WINDOW_PERIODS = {"L1CA": 4, "E1B": 1, "E1C": 1}  # 4 ms: verification, refinement of the Doppler
_PIECES_PER_MS = 4
_WEAK_DB = (
    12.0  # so much below the strongest, a cross-correlation (C/A -21 dB and up) can pass for a satellite
)
_FOLLOW_MS = 40  # samples used for verification, and for refinement
_CANDIDATES = 8
_REFERENCES = 32
_WIDEST_HZ = 170e3  # a clock 1e-4 off makes 157.5 kHz, satellite and receiver up to 12 kHz more


class AcquisitionSpec(BaseModel):
    """What is searched for, where, and with which false-alarm rate."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    systems: tuple[Literal["G", "E"], ...] = ("G", "E")
    """Constellations that are searched."""
    gps_prns: tuple[int, ...] = tuple(range(1, 33))
    """GPS satellites that are searched."""
    galileo_prns: tuple[int, ...] = tuple(range(1, 37))
    """Galileo satellites that are searched."""
    doppler_range_hz: float = Field(default=5000.0, gt=0, le=_WIDEST_HZ)
    """Half width of the search."""
    doppler_center_hz: float = Field(default=0.0, ge=-_WIDEST_HZ, le=_WIDEST_HZ)
    """Middle of the search: the Doppler of a known receiver clock drift."""
    doppler_step_hz: float | None = Field(default=None, ge=5.0, le=1000.0)
    """At most this; default half the inverse of the coherent integration."""
    coherent_ms: int | None = Field(default=None, ge=1, le=20)
    """Of L1CA, default 1 (a data bit changes every 20 ms at most); E1 always takes its code period, 4."""
    non_coherent: int | None = Field(default=None, ge=1, le=1000)
    """Blocks summed in power. Default: 10 ms (L1CA), 28 ms (E1B) or 16 ms (E1C), then verification in 40 ms more."""
    p_fa: float = Field(default=1e-4, gt=0, lt=1)
    """Probability that the search of one PRN without a signal reports one, over the whole search space."""
    excise_tones: bool = True
    """Leave out spectral lines that stand 12 dB above their surroundings: two tones can pass for a satellite."""
    workers: int = Field(default=1, ge=1, le=64)
    """Threads of the search; the results do not depend on it."""

    @model_validator(mode="after")
    def _known_prns(self):
        for signal, prns in (("L1CA", self.gps_prns), ("E1C", self.galileo_prns)):
            unknown = sorted(set(prns) - set(prns_of(signal)))
            if unknown:
                raise ValueError(f"{signal} has no PRN {unknown[0]}: take it out of the list")
        return self


class _Plan(NamedTuple):
    """One search: N samples per code period, m periods coherent, Doppler bins in units of the finest shift."""

    signal: str
    fs_hz: float
    n: int
    m: int
    pad: int  # 2: blocks of two code periods against one (E1)
    halves: int  # spectra per block, to step finer than the inverse of the block
    bins: np.ndarray  # int
    doppler_hz: np.ndarray
    step_hz: float
    blocks: int

    @property
    def window(self):
        return self.n * self.pad * self.m

    @property
    def hop(self):
        return self.n * self.m

    @property
    def searched(self):
        """Samples that the search takes."""
        return self.hop * self.blocks + self.n * (self.pad - 1)


def lowest_rate_hz(signal):
    """Sample rate below which a signal is not searched: its chips, or the half chips of a BOC."""
    return CHIP_RATE_HZ * (1 if signal == "L1CA" else 2)


def working_rate(signal, fs_hz):
    """Rate of the search: the input's own if it is low and FFT-friendly, else near 4 Msps, never far above it."""
    lowest = lowest_rate_hz(signal)
    if not (math.isfinite(fs_hz) and fs_hz >= lowest):
        raise ValueError(f"fs_hz = {fs_hz:g} cannot carry {signal}: at least {lowest:g} is needed")
    period_s = SIGNALS[signal].code_period_s
    own = fs_hz * period_s
    if (
        fs_hz <= _BEST_HZ[signal]
        and abs(own - round(own)) < 1e-9 * own
        and fast_length(round(own)) == round(own)
    ):
        return fs_hz
    # A tenth of a per cent more than there is (4.092 -> 4.096) costs nothing.
    return fast_length(math.floor(min(1.001 * own, _BEST_HZ[signal] * period_s + 0.5))) / period_s


def slab_samples(signal, fs_hz, spec=None):
    """Samples that ``acquire`` makes best use of: the search, then what verification and refinement take."""
    spec = spec or AcquisitionSpec()
    plan = _plan(signal, working_rate(signal, fs_hz), spec, None)
    return math.ceil((plan.searched / plan.fs_hz + 1e-3 * _FOLLOW_MS) * fs_hz) + 1


def _plan(signal, fs_hz, spec, n_samples):
    """Lay out the search for what the slab holds (``n_samples`` None: for what the spec wants)."""
    period_s = SIGNALS[signal].code_period_s
    n, pad = round(fs_hz * period_s), 1 if signal == "L1CA" else 2
    coherent_ms = (spec.coherent_ms or 1) if pad == 1 else round(1e3 * period_s)
    m = round(coherent_ms * 1e-3 / period_s)
    resolution_hz = fs_hz / (n * m * pad)
    halves = math.ceil(resolution_hz / (spec.doppler_step_hz or 500.0 / coherent_ms) - 1e-9)
    step_hz = resolution_hz / halves
    low, high = (spec.doppler_center_hz + s * spec.doppler_range_hz for s in (-1, 1))
    bins = np.arange(math.floor(low / step_hz + 0.5), math.ceil(high / step_hz - 0.5) + 1)
    wanted = spec.non_coherent or max(1, _BLOCKS[signal] // m)
    plan = _Plan(signal, fs_hz, n, m, pad, halves, bins, bins * step_hz, step_hz, wanted)
    if n_samples is None:
        return plan
    possible = (n_samples - n * (pad - 1)) // plan.hop
    if possible < (spec.non_coherent or 1):
        need_ms = 1e3 * plan._replace(blocks=spec.non_coherent or 1).searched / fs_hz
        raise ValueError(
            f"{1e3 * n_samples / fs_hz:.3g} ms of samples are too short to acquire {signal}: "
            f"give at least {need_ms:.3g} ms"
        )
    return plan._replace(blocks=min(wanted, possible))


def to_working_rate(iq, fs_hz, if_hz, fs_work_hz):
    """Planar slab -> planar float32 (2, n) at zero IF and the working rate, rms 1; instant 0 is kept.

    Windowed-sinc interpolation, low-pass at the lower of the two rates.
    """
    if iq.ndim != 2 or iq.shape[0] != 2:
        raise ValueError(f"a slab has shape (2, n), not {iq.shape}")
    if abs(if_hz) > fs_hz / 2:
        raise ValueError(f"if_hz = {if_hz:g} lies beyond fs_hz / 2 = {fs_hz / 2:g}")
    x = np.ascontiguousarray(iq, np.float32)
    mean_square = np.mean(x.astype(np.float64) ** 2) * 2
    if not (math.isfinite(mean_square) and mean_square > 0):
        fault = "are all zero" if mean_square == 0 else "hold NaN or infinity"
        raise ValueError(f"the samples {fault}: nothing can be acquired")
    if if_hz:
        mixed = np.empty_like(x)
        kernels.rotate(x, if_hz / fs_hz, mixed)
        x = mixed
    ratio = fs_hz / fs_work_hz
    if ratio != 1.0:
        out = np.empty((2, math.floor(x.shape[1] / ratio)), np.float32)
        kernels.resample(x[0], x[1], _interpolator(min(1.0, 1 / ratio)), ratio, out)
        x = out
    return x / np.float32(math.sqrt(np.mean(x.astype(np.float64) ** 2) * 2))


def _without_tones(x, share=0.003):
    """The slab without the bins of its spectrum that exceed 16 times the mean of their surroundings.

    Noise exceeds that once in e^16 bins. If more than ``share`` of the bins do, it is not a matter of a few tones
    (a signal without noise has nothing but lines) and x comes back as it is.
    """
    n = fast_length(x.shape[1])
    source, spectrum, run = row_fft(n)
    source.real, source.imag = x[:, :n]
    run()
    width = max(256, n // 512)
    power, suspects = np.empty(n, np.float32), np.empty(n // width, np.bool_)
    kernels.spectral_power(spectrum, width, 16 / math.log(2), power, suspects)
    found = [np.empty(0, np.int64)]
    for r in np.flatnonzero(suspects):
        median = np.median(power[r * width : (r + 1) * width])
        end = (r + 1) * width if r < len(suspects) - 1 else n
        found.append(r * width + np.flatnonzero(power[r * width : end] > 16 / math.log(2) * median))
    lines = np.concatenate(found)
    if len(lines) == 0 or len(lines) > share * n:
        return x
    back, tones, run = row_fft(n, inverse=True)
    back[:] = 0
    back[lines] = spectrum[lines] / n
    run()
    out = x.copy()
    out[0, :n] -= tones.real
    out[1, :n] -= tones.imag
    return out


@lru_cache(maxsize=8)
def _interpolator(cutoff, n_phase=256):
    """Hann-windowed sinc, rows of a fraction 0..1 of a sample: float32 (n_phase + 1, taps), each of sum one."""
    half = math.ceil(8 / cutoff)
    t = np.arange(2 * half) - (half - 1) - np.arange(n_phase + 1)[:, None] / n_phase
    taps = np.sinc(cutoff * t) * np.cos(np.pi * np.clip(t / (2 * half), -0.5, 0.5)) ** 2
    return (taps / taps.sum(axis=1, keepdims=True)).astype(np.float32)


def _spectra(x, plan):
    """Spectra of all blocks, complex64 (blocks, halves, m, N pad), split by remainder of the bin index mod m."""
    source, result, run = row_fft(plan.window)
    out = np.empty((plan.blocks, plan.halves, plan.m, plan.n * plan.pad), np.complex64)
    n = np.arange(plan.window)
    for h in range(plan.halves):
        turn = np.exp(-2j * np.pi * h * n / (plan.halves * plan.window)).astype(np.complex64)
        for b in range(plan.blocks):
            part = x[:, b * plan.hop : b * plan.hop + plan.window]
            source[:] = (part[0] + 1j * part[1]) * turn
            run()
            out[b, h] = result.reshape(-1, plan.m).T
    return out


def _template(table, plan):
    """Conjugate spectrum of one period of code, zero-padded."""
    source, result, run = row_fft(plan.n * plan.pad)
    source[:] = 0
    source[: plan.n] = table.table[0, : plan.n] * np.float32(table.scale)
    run()
    return np.conj(result)


class _Rows(NamedTuple):
    """Best code phase of every Doppler bin."""

    statistic: np.ndarray
    lag: np.ndarray  # samples: where the code starts


def _search(spectra, templates, plan):
    """All code phases of all Doppler bins of one PRN."""
    source, result, run = row_fft(plan.n * plan.pad, inverse=True)
    acc = np.empty(plan.n, np.float32)
    guard = math.ceil(1.5 * plan.fs_hz / CHIP_RATE_HZ)
    terms = plan.blocks * len(templates)
    # The spread over the code phases, 1 / sqrt(K) of the mean on noise, as it is estimated from N / 4 free cells.
    widest = 1 + 2.5 * math.sqrt((2 + 6 / terms) / (plan.n / 4))
    statistic, lag = np.empty(len(plan.bins)), np.empty(len(plan.bins), np.int64)
    for i, d in enumerate(plan.bins.tolist()):
        whole, h = divmod(d, plan.halves)
        shift, p = divmod(whole, plan.m)
        shift %= plan.n * plan.pad
        # Code Doppler: with positive Doppler the code starts earlier in every block.
        drift = plan.hop * plan.doppler_hz[i] / F_L1_HZ
        acc[:] = 0
        for b in range(plan.blocks):
            moved = round(b * drift) % plan.n
            for template in templates:
                kernels.shifted_product(spectra[b, h, p], shift, template, source)
                run()
                kernels.add_power(result, moved, acc)
        peak, lag[i], mean, spread = kernels.row_peak(acc, guard)
        if mean <= 0.0:  # zeros
            statistic[i] = 0.0
            continue
        excess = spread / mean * math.sqrt(terms)
        statistic[i] = 1 + (peak / mean - 1) / (excess if excess > widest else 1.0)
    return _Rows(statistic, lag), terms


def search_threshold(p_fa, cells, terms, rho_code, rho_doppler):
    """Threshold of the statistic over a search of ``cells`` correlated cells.

    Solves 1 - exp(-cells theta Q(K, u)) = p_fa for u and returns u / K, with theta = (1 - P(S' > u | S > u)) for the
    next code phase times the same for the next Doppler bin (first-order declumping of a Markov field; S' given S is
    a scaled noncentral chi-square of 2 K degrees of freedom and noncentrality 2 rho^2 S / (1 - rho^2)).

    Parameters
    ----------
    cells, terms : int
        Code phases x Doppler bins; K = blocks x components.
    rho_code, rho_doppler : float
        Correlation of the complex outputs of neighbouring cells.
    """
    wanted, theta = -math.log1p(-p_fa), 1.0
    for _ in range(4):
        u = float(gammainccinv(terms, min(0.5, wanted / (cells * theta))))
        theta = _lonely(u, terms, rho_code) * _lonely(u, terms, rho_doppler)
    return u / terms


def _lonely(u, terms, rho):
    """P(S' < u | S > u) of neighbouring cells whose outputs have correlation rho."""
    rest = 1 - rho**2
    if rest < 1e-6:
        return 1e-3
    x = np.linspace(0, 30 + 4 * math.sqrt(terms), 4001)
    log_density = (terms - 1) * np.log(u + x) - (u + x) - gammaln(terms)
    below = chndtr(2 * u / rest, 2 * terms, 2 * rho**2 * (u + x) / rest)
    return float(np.trapezoid(np.exp(log_density) * below, x) / gammaincc(terms, u))


@lru_cache(maxsize=32)
def _cached_threshold(*arguments):
    return search_threshold(*arguments)


@lru_cache(maxsize=4)
def _one_turn(n):
    return np.cos(2 * np.pi * np.arange(n) / n)


def _plan_threshold(plan, templates, terms, p_fa):
    """Threshold of a search; the correlation of neighbouring code phases is that of the sampled code."""
    power = np.abs(templates[0]).astype(float) ** 2
    rho_code = round(float(power @ _one_turn(len(power)) / np.sum(power)), 3)
    rho_doppler = round(float(np.sinc(plan.step_hz * plan.hop / plan.fs_hz)), 3)
    return _cached_threshold(p_fa, plan.n * len(plan.bins), terms, rho_code, rho_doppler)


class _Follower:
    """Correlates one satellite directly: pieces of 1/4 ms along its code, at any Doppler and code phase.

    ``x`` begins ``origin`` samples into the slab; lags and code phases are those of the slab.
    """

    def __init__(self, x, tables, plan, origin=0):
        self.x, self.tables, self.plan, self.origin = x, tables, plan, origin
        self.rotated, self.rotated_hz = np.empty_like(x), None
        self.per_period = round(_PIECES_PER_MS * 1e3 * SIGNALS[plan.signal].code_period_s)

    def rotate(self, doppler_hz):
        """Take the Doppler off; kept for further code phases."""
        if self.rotated_hz != doppler_hz:
            kernels.rotate(self.x, doppler_hz / self.plan.fs_hz, self.rotated)
            self.rotated_hz = doppler_hz

    def layout(self, doppler_hz, lag, stop=None):
        """(chips per sample, start of the first whole code period in x, its length in samples, whole periods)."""
        rate = CHIP_RATE_HZ * (1 + doppler_hz / F_L1_HZ) / self.plan.fs_hz
        period = self.tables[0].code_length_chips / rate
        first = lag - self.origin
        first += max(0, math.ceil(-first / period)) * period
        end = self.x.shape[1] if stop is None else min(stop - self.origin, self.x.shape[1])
        return rate, first, period, max(0, math.floor((end - 1 - first) / period))

    def pieces(self, doppler_hz, lag, offset_chips=0.0, stop=None):
        """Complex (components, periods, pieces per period) of the code that starts at ``lag`` + whole periods.

        ``offset_chips`` > 0: replica advanced. Only whole code periods before sample ``stop`` of the slab.
        """
        self.rotate(doppler_hz)
        rate, first, period, periods = self.layout(doppler_hz, lag, stop)
        out = np.zeros((len(self.tables), periods * self.per_period), complex)
        for row, t in zip(out, self.tables):
            kernels.piece_sums(
                self.rotated, t.table, t.samples_per_chip, t.code_length_chips,
                offset_chips - first * rate, rate, first, period / self.per_period, row,
            )  # fmt: skip
        return out.reshape(len(self.tables), periods, self.per_period)

    def cancel(self, doppler_hz, phase_chips):
        """Take the satellite out of x, with its amplitude as measured in every code period."""
        lag = -phase_chips * self.plan.fs_hz / (CHIP_RATE_HZ * (1 + doppler_hz / F_L1_HZ))
        lag -= self.plan.n  # so that the period under way at the start is among them
        rate, first, period, _ = self.layout(doppler_hz, lag)
        edges = np.concatenate(
            [[0.0], first + period * np.arange(math.ceil((self.x.shape[1] - first) / period))]
        )
        self.rotate(doppler_hz)
        for t in self.tables:
            kernels.subtract_code(
                self.rotated, t.table, t.samples_per_chip, t.code_length_chips, -first * rate, rate,
                np.append(edges, self.x.shape[1]),
            )  # fmt: skip
        kernels.rotate(self.rotated, -doppler_hz / self.plan.fs_hz, self.x)
        self.rotated_hz = None


def _window_power(pieces, periods, residual_hz, hop=1):
    """Sum over windows of |sum over the window|^2 at each residual Doppler -> (n_hz,), and the count of windows.

    Windows of ``periods`` code periods, one starting at every ``hop`` periods.
    """
    n_comp, _, per = pieces.shape
    residual_hz = np.atleast_1d(np.asarray(residual_hz, float))
    power = np.zeros(len(residual_hz))
    piece_s = 1e-3 / _PIECES_PER_MS
    count = kernels.window_power(
        pieces.reshape(n_comp, -1), periods * per, hop * per, piece_s, residual_hz, power
    )
    return power, count


def _noise_powers(follower, doppler_hz, lag, periods, count, stop=None, residual_hz=0.0):
    """Mean window power at each of ``count`` code phases, spread over the code away from the signal, and windows."""
    length = follower.tables[0].code_length_chips
    powers = np.empty(count)
    for j in range(count):
        pieces = follower.pieces(doppler_hz, lag, length * (j + 1) / (count + 1), stop)
        power, n = _window_power(pieces, periods, residual_hz, periods)
        powers[j] = power[0] / n
    return powers, n


def _verify(follower, rows, p_fa):
    """Second look at the best Doppler bins in fresh samples -> (bin index, statistic, threshold) or None.

    Windows of 4 ms. Ratio of the mean window power to that at other code phases: F(2 K, 2 K_ref) on noise.
    """
    plan, periods = follower.plan, _WINDOW_PERIODS[follower.plan.signal]
    if follower.x.shape[1] < 2.2 * periods * plan.n:
        return None
    residual_hz = np.linspace(-0.5, 0.5, 2 + math.ceil(8e-3 * plan.step_hz)) * plan.step_hz
    offsets = [s * 0.25 * CHIP_RATE_HZ / plan.fs_hz for s in (-1, 1)]
    order = np.argsort(-rows.statistic, kind="stable")[:_CANDIDATES].tolist()
    best = (-1.0, 0, 0.0, 0.0, 0)
    for i in order:
        for offset in offsets:
            pieces = follower.pieces(plan.doppler_hz[i], rows.lag[i], offset)
            power, count = _window_power(pieces, periods, residual_hz, periods)
            k = int(np.argmax(power))
            total = np.sum(np.abs(pieces[:, : count * periods // len(pieces)]) ** 2)
            if total > 0:
                best = max(
                    best, (float(power[k] / total), i, float(power[k]) / count, float(residual_hz[k]), count)
                )
    rough, i, power, residual, count = best
    if count == 0:  # the later samples are zeros
        return None
    cells = len(order) * len(offsets) * len(residual_hz)
    threshold = _fresh_threshold(p_fa, cells, count)
    if rough < 0.7 * threshold:
        return None
    noise, _ = _noise_powers(follower, plan.doppler_hz[i], rows.lag[i], periods, _REFERENCES, None, residual)
    excess = np.std(noise) / np.mean(noise) * math.sqrt(count)
    widest = 1 + 2.5 * math.sqrt((2 + 6 / count) / _REFERENCES) / 2
    statistic = 1 + (power / np.mean(noise) - 1) / (excess if excess > widest else 1.0)
    return i, float(statistic), threshold


@lru_cache(maxsize=32)
def _fresh_threshold(p_fa, cells, count):
    """Threshold of the ratio of ``count`` window powers to those of the reference code phases."""
    return float(fdtri(2 * count, 2 * count * _REFERENCES, math.exp(math.log1p(-p_fa) / cells)))


def _recheck(follower, doppler_hz, lag):
    """Statistic of a found signal over the samples of the search, after stronger ones were taken out."""
    plan = follower.plan
    stop = max(plan.searched, round(lag) + 2 + plan.hop)
    power, count = _window_power(follower.pieces(doppler_hz, lag, stop=stop), plan.m, 0.0, plan.m)
    noise, _ = _noise_powers(follower, doppler_hz, lag, plan.m, 12, stop)
    return float(power[0] / count / np.mean(noise))


def _refine(follower, doppler_hz, lag):
    """(doppler_hz, code phase at sample 0 in chips, C/N0 in dB-Hz) from up to 40 ms; None if no period is whole.

    Doppler: peak of the power of 4 ms windows. Code phase: least-squares fit of the ideal correlation function.
    """
    plan = follower.plan
    stop = lag + round((_FOLLOW_MS + 8) * 1e-3 * plan.fs_hz)
    periods = min(_WINDOW_PERIODS[plan.signal], follower.layout(doppler_hz, lag, stop)[3])
    if periods == 0:
        return None
    offset = 0.0
    for _ in range(2):
        doppler_hz = _refine_doppler(follower, doppler_hz, lag, offset, periods, stop)
        offset = _refine_code(follower, doppler_hz, lag, periods, stop)
    if plan.pad == 2:
        doppler_hz += _across_periods_hz(follower.pieces(doppler_hz, lag, offset, stop))
    noise, _ = _noise_powers(follower, doppler_hz, lag, 1, 8, stop)
    one, n_one = _window_power(follower.pieces(doppler_hz, lag, offset, stop), 1, 0.0)
    snr = one[0] / n_one / np.mean(noise) - 1
    rate = CHIP_RATE_HZ * (1 + doppler_hz / F_L1_HZ) / plan.fs_hz
    phase = (offset - lag * rate) % follower.tables[0].code_length_chips
    return doppler_hz, phase, _cn0_dbhz(snr, SIGNALS[plan.signal].code_period_s)


def _cn0_dbhz(snr, coherent_s):
    """C/N0 of one component from its mean power over noise."""
    return 10 * math.log10(max(snr / coherent_s, 1.0))


def _refine_doppler(follower, doppler_hz, lag, offset, periods, stop):
    pieces = follower.pieces(doppler_hz, lag, offset, stop=stop)
    step = min(20.0, follower.plan.step_hz / 8)
    residual_hz = np.arange(-8, 9) * (follower.plan.step_hz * 0.75 / 8)
    if residual_hz[1] - residual_hz[0] > step:
        n = math.ceil(0.75 * follower.plan.step_hz / step)
        residual_hz = np.arange(-n, n + 1) * step
    power, _ = _window_power(pieces, periods, residual_hz)
    return doppler_hz + _vertex(residual_hz, power)


def _across_periods_hz(pieces):
    """Residual Doppler from the phase between code periods, squared to remove symbols; within +-1 / (4 T) = 62 Hz."""
    z = pieces.sum(axis=2)
    squared = np.sum((z[:, 1:] * np.conj(z[:, :-1])) ** 2)
    return float(np.angle(squared)) / (4 * np.pi * 4e-3) if squared != 0 else 0.0


def _refine_code(follower, doppler_hz, lag, periods, stop):
    """Offset in chips that the replica needs."""
    plan = follower.plan
    reach, step = (0.75, 1 / 8) if plan.signal == "L1CA" else (0.5, 1 / 16)
    offsets = np.arange(-round(reach / step), round(reach / step) + 1) * step
    powers = []
    for offset in offsets:
        power, windows = _window_power(follower.pieces(doppler_hz, lag, offset, stop), periods, 0.0)
        powers.append(power[0] / windows)
    noise, _ = _noise_powers(follower, doppler_hz, lag, periods, 4, stop)
    amplitude = np.sqrt(np.maximum(np.array(powers) - np.mean(noise), 0.0))
    trial = np.arange(-64, 65) / 64 * 0.75 * max(0.25, CHIP_RATE_HZ / plan.fs_hz)
    shape = np.abs(chip_acf(offsets - trial[:, None], _REPLICA[plan.signal]))
    fit = (shape @ amplitude) ** 2 / np.sum(shape**2, axis=1)
    return _vertex(trial, fit)


def _vertex(x, y):
    """Abscissa of the maximum of y, by the parabola through its three best neighbours."""
    k = int(np.clip(np.argmax(y), 1, len(y) - 2))
    a, b, c = y[k - 1], y[k], y[k + 1]
    curvature = a - 2 * b + c
    move = 0.5 * (a - c) / curvature if curvature < 0 else 0.0
    return x[k] + float(np.clip(move, -1, 1)) * (x[k + 1] - x[k])


def acquire(slab_iq, n0, fs_hz, if_hz, signal, prns=None, spec=None, path=None):
    """Search a slab for satellites.

    Parameters
    ----------
    slab_iq : ndarray (2, n), int8, int16 or float32
        Planar I/Q. ``slab_samples`` tells how much is useful; at least one block (1 ms, E1 8 ms) is needed.
    n0 : int
        Index of its first sample.
    fs_hz, if_hz : float
    signal : str
        "L1CA", "E1B" (data component alone) or "E1C" (pilot and data, powers added).
    prns : sequence of int, optional
        Default: the spec's list of the system.
    spec : AcquisitionSpec, optional
    path : path-like, optional
        Another table of E1 codes.

    Returns
    -------
    ndarray ACQUISITION (len(prns),)
        In the order of ``prns``. ``statistic``, ``threshold`` and ``acquired`` of the stage that decided. Code phase
        holds at n0. ``cn0_dbhz`` is that of the component named (half an E1 signal's power; reads
        0.6 to 1.8 dB low, BOC(1,1) replica in 4 MHz), as in tracking. Doppler, code phase
        and C/N0 are refined where ``acquired``, else the best cell's (C/N0 NaN). Independent of ``spec.workers``.

    Raises
    ------
    ValueError
        Unknown signal or PRN; rate too low; IF beyond fs/2; slab too short; samples all zero or not finite.
    """
    spec = spec or AcquisitionSpec()
    if signal not in SIGNALS:
        raise ValueError(f"unknown signal {signal!r}: use one of {', '.join(SIGNALS)}")
    if prns is None:
        prns = spec.gps_prns if signal == "L1CA" else spec.galileo_prns
    fs_work = working_rate(signal, fs_hz)
    x = to_working_rate(slab_iq, fs_hz, if_hz, fs_work)
    if spec.excise_tones:
        x = _without_tones(x)
    plan = _plan(signal, fs_work, spec, x.shape[1])
    with ThreadPoolExecutor(spec.workers) as pool:
        return _acquire(x, plan, spec, [int(prn) for prn in prns], int(n0), path, pool.map)


class _Found(NamedTuple):
    """What is known of one PRN; ``refined`` (Doppler, code phase, C/N0) once it is acquired."""

    tables: list
    rows: _Rows
    best: int
    statistic: float
    threshold: float
    refined: tuple | None = None


def _acquire(x, plan, spec, prns, n0, path, over):
    """Search all, take out the strong, look again for the weak and the missing; ``over``: map or a pool's."""
    two_stages = spec.non_coherent is None
    spectra = _spectra(x, plan)
    found = list(over(lambda prn: _first_look(x, spectra, plan, prn, spec.p_fa, path), prns))
    strongest = max((f.refined[2] for f in found if f.refined), default=0.0)
    strong = [f.refined is not None and f.refined[2] > strongest - _WEAK_DB for f in found]
    cleaned = x.copy() if any(strong) else x
    for f, is_strong in zip(found, strong):
        if is_strong:
            _Follower(cleaned, f.tables, plan).cancel(*f.refined[:2])
    follow = plan.searched + round(_FOLLOW_MS * 1e-3 * plan.fs_hz)
    fresh = np.ascontiguousarray(cleaned[:, plan.searched : follow])

    def again(f):
        if f.refined:
            return _weak_look(cleaned, f, plan)
        return _second_look(x, fresh, f, plan, 0.01 * spec.p_fa) if two_stages else f

    found = list(over(lambda pair: pair[0] if pair[1] else again(pair[0]), zip(found, strong)))
    out = np.zeros(len(prns), ACQUISITION)
    for i, (prn, f) in enumerate(zip(prns, found)):
        phase = -f.rows.lag[f.best] * CHIP_RATE_HZ / plan.fs_hz % f.tables[0].code_length_chips
        values = f.refined or (plan.doppler_hz[f.best], phase, math.nan)
        acquired = f.refined is not None
        out[i] = (plan.signal.encode(), prn, n0, *values, f.statistic, f.threshold, acquired)
    return out


def _first_look(x, spectra, plan, prn, p_fa, path):
    """Search, and refinement if the threshold is passed."""
    names, waveform = _COMPONENTS[plan.signal], _REPLICA[plan.signal]
    tables = [code_table(name, prn, plan.fs_hz, 16, waveform, path=path) for name in names]
    templates = [_template(table, plan) for table in tables]
    rows, terms = _search(spectra, templates, plan)
    best = int(np.argmax(rows.statistic))
    threshold = _plan_threshold(plan, templates, terms, p_fa)
    found = _Found(tables, rows, best, float(rows.statistic[best]), threshold)
    return _accept(x, found, plan) if found.statistic > threshold else found


def _accept(x, found, plan):
    """Refine; a slab without one whole code period leaves the best cell as it is."""
    doppler_hz, lag = float(plan.doppler_hz[found.best]), int(found.rows.lag[found.best])
    refined = _refine(_Follower(x, found.tables, plan), doppler_hz, lag)
    if refined is None:
        phase = -lag * CHIP_RATE_HZ / plan.fs_hz % found.tables[0].code_length_chips
        refined = doppler_hz, phase, _cn0_dbhz(found.statistic - 1, plan.hop / plan.fs_hz)
    return found._replace(refined=refined)


def _weak_look(cleaned, found, plan):
    """Keep a weak detection only if it stands after the strong satellites were taken out."""
    statistic = _recheck(
        _Follower(cleaned, found.tables, plan), plan.doppler_hz[found.best], found.rows.lag[found.best]
    )
    return found if statistic > found.threshold else found._replace(statistic=statistic, refined=None)


def _second_look(x, fresh, found, plan, p_fa):
    """Verification in fresh samples; the statistic stays that of the search where it fails."""
    second = _verify(_Follower(fresh, found.tables, plan, plan.searched), found.rows, p_fa)
    if second is None or second[1] <= second[2]:
        return found
    best, statistic, threshold = second
    return _accept(x, found._replace(best=best, statistic=statistic, threshold=threshold), plan)
