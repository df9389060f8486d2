"""Chip waveforms, sampled code tables, ideal correlation functions and code spectrum lines."""

import math
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache

import numba as nb
import numpy as np

from signals.codes import primary_code, prns_of, secondary_code
from signals.constants import CHIP_RATE_HZ
from signals.records import CODE_LINE

__all__ = [
    "BLOCK",
    "SIGNALS",
    "CodeTable",
    "SignalDef",
    "autocorrelation",
    "chip_acf",
    "chip_waveform",
    "code_lines",
    "code_table",
    "sampled_band_hz",
    "worst_lines",
]

BLOCK = 1024
"""Most samples that are read from a row of a code table before the row is chosen again."""
_MIN_FS_BOC61_HZ = 15e6  # below it the lobes of BOC(6,1) at +-6.138 MHz do not fit between -fs/2 and fs/2
_FEW_PLACES = 64
_SLOTS = {"BPSK": 1, "BOC11": 2, "BOC61": 12, "CBOC+": 12, "CBOC-": 12}


@dataclass(frozen=True)
class SignalDef:
    """What defines a signal component; ``waveform`` is the one transmitted."""

    name: str
    system: str  # "G" or "E"
    code_length_chips: int
    code_period_s: float
    waveform: str
    symbol_periods: int  # code periods per data symbol; 0: no data (pilot)
    secondary: str | None = None


SIGNALS = {
    "L1CA": SignalDef("L1CA", "G", 1023, 1e-3, "BPSK", 20),
    "E1B": SignalDef("E1B", "E", 4092, 4e-3, "CBOC+", 1),
    "E1C": SignalDef("E1C", "E", 4092, 4e-3, "CBOC-", 0, "CS25_1"),
}
"""The three components (IS-GPS-200, 3.3; Galileo OS SIS ICD, 2.3)."""


@dataclass(frozen=True, eq=False)
class CodeTable:
    """Code waveform sampled at every 1/P of a sample.

    ``table[r, m] * scale`` is the waveform at code phase ``((m + r / P) / samples_per_chip) mod L`` chips. To
    read n <= BLOCK samples from code phase phi in [0, L): q = round(phi * samples_per_chip * P), row q % P,
    columns from q // P.
    """

    table: np.ndarray  # int8 (P, ceil(L * samples_per_chip) + BLOCK + 8), C-contiguous
    scale: float
    samples_per_chip: float
    code_length_chips: int


def chip_waveform(waveform):
    """One chip as equal slots: float64 (1,) BPSK, (2,) BOC11, (12,) BOC61, CBOC+ and CBOC-; mean square 1.

    CBOC+- = sqrt(10/11) BOC(1,1) +- sqrt(1/11) BOC(6,1), both sine-phased (Galileo OS SIS ICD, 2.3.3). The
    composite signal is eB CBOC+ - eC CBOC-: the minus sign of E1-C is not part of the waveform.
    """
    if waveform not in _SLOTS:
        raise ValueError(f"unknown waveform {waveform!r}: use one of BPSK, BOC11, CBOC+, CBOC-")
    if waveform == "BPSK":
        return np.ones(1)
    boc11, boc61 = np.array([1.0, -1.0]), np.tile([1.0, -1.0], 6)
    if waveform == "BOC11":
        return boc11
    if waveform == "BOC61":
        return boc61
    sign = 1.0 if waveform == "CBOC+" else -1.0
    return math.sqrt(10 / 11) * np.repeat(boc11, 6) + sign * math.sqrt(1 / 11) * boc61


def _chip_transform(waveform, nu):
    """Transform of one chip, integral over [0, 1] of p(x) exp(-2 pi i nu x), nu in cycles per chip."""
    slots = chip_waveform(waveform)
    n = len(slots)
    out = np.zeros(len(nu), complex)
    for s, level in enumerate(slots):
        out += level * np.exp(-2j * np.pi * nu * ((s + 0.5) / n))
    return out * np.sinc(nu / n) / n


def sampled_band_hz(fs_hz):
    """Band to which codes are limited at a sampling rate that stands still against their chips; None elsewhere.

    With p samples on q chips, p and q small, samples fall on p places of a chip and no others: a code with sharp edges
    looks the same wherever between two of them it begins, and its delay is lost to half a place (72 m at two samples
    per chip). What tells it is the band limit of the front end, which rounds the edges: fs/2, in the code sent and in
    its replica.
    """
    ratio = fs_hz / CHIP_RATE_HZ
    near = Fraction(ratio).limit_denominator(_FEW_PLACES)
    # 1e-7: the places wander by less than 0.1 chip per second.
    still = abs(float(near) / ratio - 1.0) < 1e-7
    return fs_hz / 2 if still and near.numerator < _FEW_PLACES else None


def code_table(signal, prn, fs_hz, n_phase=64, waveform=None, bandlimit_hz=None, path=None):
    """Sampled replica of one code, for synthesis and for correlation.

    Parameters
    ----------
    signal, prn, path
        As ``signals.codes.primary_code``.
    fs_hz : float
        Sampling rate.
    n_phase : int
        P, rows per sample; a power of two.
    waveform : str, optional
        "BPSK", "BOC11", "CBOC+", "CBOC-"; default the transmitted one.
    bandlimit_hz : float, optional
        Remove everything beyond min(bandlimit_hz, fs/2) from the waveform (brick wall, both sides). Default:
        ``sampled_band_hz``.

    Returns
    -------
    CodeTable
        BPSK and BOC(1,1): +-1 and scale 1. CBOC and band-limited waveforms: up to +-127 and their scale.

    Notes
    -----
    Below 15 Msps the BOC(6,1) part of CBOC (1/11 of the power, lobes at +-6.138 MHz) does not fit into the
    band; it is limited to fs/2 by its Fourier series, as a front-end filter would, and never aliased. The mean
    square of the table is then less than one.
    """
    waveform = waveform or SIGNALS[signal].waveform if signal in SIGNALS else waveform
    chips = primary_code(signal, prn, path)
    chip_waveform(waveform)
    if not (n_phase >= 1 and n_phase & (n_phase - 1) == 0):
        raise ValueError(f"n_phase = {n_phase} is not a power of two")
    if not (math.isfinite(fs_hz) and fs_hz >= 1e5):
        raise ValueError(f"fs_hz = {fs_hz:g}: a code table needs a rate of at least 1e5")
    if bandlimit_hz is not None and not bandlimit_hz > 0:
        raise ValueError(f"bandlimit_hz = {bandlimit_hz:g} must be positive")
    bandlimit_hz = bandlimit_hz or sampled_band_hz(fs_hz)
    length = len(chips)
    per_chip = fs_hz / CHIP_RATE_HZ
    table = np.empty((n_phase, math.ceil(length * per_chip) + BLOCK + 8), np.int8)
    limited = bandlimit_hz is not None or (waveform.startswith("CBOC") and fs_hz < _MIN_FS_BOC61_HZ)
    slots, fine = _parts(chips, waveform, fs_hz, bandlimit_hz) if limited else (chip_waveform(waveform), None)
    levels = np.outer(chips, slots).ravel()
    peak = float(np.max(np.abs(levels)) + (0.0 if fine is None else np.max(np.abs(fine))))
    scale = 1.0 if waveform in ("BPSK", "BOC11") and fine is None else peak / 127
    if fine is None:
        _sample_slots(np.round(levels / scale).astype(np.int8), table, len(slots) / per_chip)
    else:
        fine_per_sample = len(fine) / length / per_chip
        levels, fine = (levels / scale).astype(np.float32), (fine / scale).astype(np.float32)
        _sample_parts(levels, fine, table, len(slots) / per_chip, fine_per_sample)
    return CodeTable(table, scale, per_chip, length)


def _parts(chips, waveform, fs_hz, bandlimit_hz):
    """Slots that keep their sharp edges, and one period on a fine grid of what is limited in band.

    With ``bandlimit_hz`` everything is limited (and the slots are zero); else only the BOC(6,1) part of CBOC.
    """
    band_hz = min(fs_hz / 2, math.inf if bandlimit_hz is None else bandlimit_hz)
    # 16 points per period of the highest component: linear interpolation errs by at most 2 % of it.
    n = 2 ** max(3, math.ceil(math.log2(16 * band_hz / CHIP_RATE_HZ))) * len(chips)
    if bandlimit_hz is not None:
        return np.zeros(1), _series(chips, waveform, band_hz, n)
    slots = math.sqrt(10 / 11) * chip_waveform("BOC11")
    sign = 1.0 if waveform == "CBOC+" else -1.0
    return slots, sign * math.sqrt(1 / 11) * _series(chips, "BOC61", band_hz, n)


def _series(chips, waveform, band_hz, n):
    """Fourier series of the periodic waveform up to ``band_hz``, evaluated at n points of a period."""
    from scipy.fft import irfft

    length = len(chips)
    k = np.arange(min(math.floor(band_hz / CHIP_RATE_HZ * length), n // 2 - 1) + 1)
    spectrum = np.zeros(n // 2 + 1, complex)
    spectrum[k] = np.fft.fft(chips)[k % length] / length * _chip_transform(waveform, k / length)
    return irfft(spectrum, n) * n


@nb.njit(cache=True, nogil=True)
def _sample_slots(levels, table, slots_per_sample):
    n_phase, n_cols = table.shape
    n = len(levels)
    for r in range(n_phase):
        row = table[r]
        for m in range(n_cols):
            # A single rounding: q is exact, so that equal phases in different rows give equal values.
            s = int((m * n_phase + r) * slots_per_sample / n_phase)
            row[m] = levels[s - n if s >= n else s]


@nb.njit(cache=True, nogil=True)
def _sample_parts(levels, fine, table, slots_per_sample, fine_per_sample):
    """Sharp slots plus the fine grid by linear interpolation, rounded to int8."""
    n_phase, n_cols = table.shape
    n, n_slots = len(fine), len(levels)
    half = np.float32(0.5)
    for r in range(n_phase):
        row = table[r]
        for m in range(n_cols):
            q = m * n_phase + r
            k = int(q * slots_per_sample / n_phase)
            x = q * fine_per_sample / n_phase
            s = int(x)
            frac = np.float32(x - s)
            s = s - n if s >= n else s
            t = s + 1 if s + 1 < n else 0
            value = levels[k - n_slots if k >= n_slots else k] + fine[s] + frac * (fine[t] - fine[s])
            row[m] = np.int8(np.floor(value + half))


@lru_cache(maxsize=64)
def _acf_slots(signal, prn, waveform_tx, waveform_rx, path):
    """Circular correlation of two waveforms of one code at every 1/12 chip, (12 L,)."""
    chips = primary_code(signal, prn, path)
    tx, rx = (
        np.repeat(np.outer(chips, slots).ravel(), 12 // len(slots))
        for slots in (chip_waveform(waveform_tx), chip_waveform(waveform_rx))
    )
    return np.fft.irfft(np.conj(np.fft.rfft(tx)) * np.fft.rfft(rx), len(tx)) / len(tx)


def autocorrelation(signal, prn, delay_chips, waveform_tx=None, waveform_rx=None, path=None):
    """Circular correlation of the transmitted code with the replica, exact (side lobes included).

    R(d) = mean over the code of s_tx(x) s_rx(x + d): d > 0 = replica advanced = early. Piecewise linear
    between multiples of 1/12 chip, where it is computed from the chips.

    Parameters
    ----------
    delay_chips : array-like
        d, any shape, taken modulo the code length.
    waveform_tx, waveform_rx : str, optional
        Default: transmitted waveform; the replica's is ``waveform_tx``.

    Returns
    -------
    ndarray float64, shape of ``delay_chips``
    """
    tx = waveform_tx or SIGNALS[signal].waveform
    slots = _acf_slots(signal, int(prn), tx, waveform_rx or tx, None if path is None else str(path))
    n = len(slots)
    x = np.mod(np.asarray(delay_chips, float) * 12, n)
    k = np.floor(x).astype(np.int64)
    return slots[k % n] + (x - k) * (slots[(k + 1) % n] - slots[k % n])


def chip_acf(delay_chips, waveform_tx="BPSK", waveform_rx=None, bandlimit_hz=None):
    """Correlation of one chip with one chip of the replica: ``autocorrelation`` of an ideal code.

    R(d) = integral of p_tx(x) p_rx(x + d), zero beyond +-1 chip; BPSK: 1 - |d|. With ``bandlimit_hz`` B the integral
    of conj(P_tx) P_rx exp(2 pi i nu d) over |nu| <= B / f_c, P the transforms of the chips.
    """
    if bandlimit_hz is not None:
        nu, step = np.linspace(0.0, bandlimit_hz / CHIP_RATE_HZ, 4001, retstep=True)
        cross = np.conj(_chip_transform(waveform_tx, nu)) * _chip_transform(waveform_rx or waveform_tx, nu)
        cross *= 2.0 * step * np.where((nu == 0.0) | (nu == nu[-1]), 0.5, 1.0)
        return np.real(np.exp(2j * np.pi * np.multiply.outer(delay_chips, nu)) @ cross)
    tx, rx = (
        np.repeat(p, 12 // len(p))
        for p in (chip_waveform(waveform_tx), chip_waveform(waveform_rx or waveform_tx))
    )
    values = np.concatenate([[0.0], np.correlate(rx, tx, "full") / 12, [0.0]])
    return np.interp(np.asarray(delay_chips, float), np.arange(-12, 13) / 12, values)


def code_lines(signal, prn, waveform=None, tiered=False, max_hz=8.184e6, path=None):
    """Lines of the code spectrum at k * f_R, f_R = 1 / code period, for k = 0, 1, .. up to ``max_hz``.

    L_k = 20 log10 |DFT(c)_k / N P(k f_R)|, P the transform of the chip: power of one line (its mirror at -f
    counted apart) relative to the whole component's power, so that all lines from -inf to inf sum to one.

    Parameters
    ----------
    tiered : bool
        E1C: with the secondary code (period 100 ms, spacing 10 Hz).

    Returns
    -------
    freq_hz, level_db : ndarray float64 (K,)
        A line without power has -inf.
    """
    waveform = waveform or SIGNALS[signal].waveform
    chips = primary_code(signal, prn, path).astype(float)
    if tiered and SIGNALS[signal].secondary is None:
        raise ValueError(f"{signal} has no secondary code: ask for its lines with tiered=False")
    if tiered:
        chips = np.outer(secondary_code(), chips).ravel()
    n = len(chips)
    k = np.arange(math.floor(max_hz / CHIP_RATE_HZ * n) + 1)
    periods = n // SIGNALS[signal].code_length_chips
    amplitude = np.abs(np.fft.fft(chips)[k % n] / n * _chip_transform(waveform, k / n))
    # E1 codes are balanced and C/A lines are of order 0.03: what is below 1e-12 is rounding, not power.
    amplitude[amplitude < 1e-12] = 0.0
    with np.errstate(divide="ignore"):
        return k / (SIGNALS[signal].code_period_s * periods), 20 * np.log10(amplitude)


def worst_lines(signal, waveform=None, prns=None, tiered=False, path=None):
    """The strongest spectrum line of each code -> CODE_LINE (n,), in the order of ``prns`` (default: all)."""
    waveform = waveform or SIGNALS[signal].waveform
    prns = prns_of(signal) if prns is None else prns
    out = np.zeros(len(prns), CODE_LINE)
    for i, prn in enumerate(prns):
        freq_hz, level_db = code_lines(signal, prn, waveform, tiered, 2 * CHIP_RATE_HZ, path)
        best = int(np.argmax(level_db))
        out[i] = (signal.encode(), waveform.encode(), prn, freq_hz[best], level_db[best])
    return out
