"""Figure of an injection: spectrum and correlation function of a satellite, before and after."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sdr.figure import figure
from sdr.spectrum import BINS, FRAMES, spectrum_db
from signals.constants import CHIP_RATE_HZ
from signals.modulation import SIGNALS, code_table
from tracking.acquisition import AcquisitionSpec, acquire, slab_samples

PLACES = 40
"""Spectra are means over so many places in the time of the attack."""
CORRELATED_S = 0.04
REACH_CHIPS = 3.0
COLORS = {"before": "C0", "after": "C3"}


def injection(
    path: Path, before: Any, after: Any, span_s: tuple[float, float], title: str, names: Sequence[str]
) -> Path:
    """Draw two sources of the same samples over ``span_s``; the correlation is that of the strongest of ``names``."""
    fs_hz, if_hz = before.fs_hz, before.if_hz
    first, last = round(span_s[0] * fs_hz), min(round(span_s[1] * fs_hz), before.n_samples)
    row = _satellite(before, (first + last) // 2, names)
    freq_mhz = ((np.arange(BINS) / BINS - 0.5) * fs_hz - if_hz) * 1e-6
    path.parent.mkdir(parents=True, exist_ok=True)
    with figure(path, title, rows=2 if row is not None else 1, size=(9, 8), sharex=False) as axes:
        top, *below = np.ravel(axes)
        for name, source in (("before", before), ("after", after)):
            top.plot(freq_mhz, _mean_db(source, first, last), color=COLORS[name], lw=0.9, label=name)
            if row is not None:
                lags, correlation = _correlation(source, row, (first + last) // 2)
                below[0].plot(lags, correlation, ".-", ms=3, lw=0.8, color=COLORS[name], label=name)
        top.set(xlabel="offset from the carrier (MHz)", ylabel="power per bin (dB re ADC level²)")
        top.legend(fontsize=8)
        if row is not None:
            below[0].set(xlabel="delay from the peak (chip)", ylabel="rms correlation over its noise")
            below[0].set_title(f"{_name(row)} during the attack, {CORRELATED_S * 1e3:g} ms", fontsize=10)
            below[0].legend(fontsize=8)
    return path


def _mean_db(source: Any, first: int, last: int) -> np.ndarray:
    places = np.linspace(first, max(last - BINS * FRAMES, first), PLACES).astype(int)
    slabs = (source.read_at(int(n0), BINS * FRAMES)[1] for n0 in places)
    rows = [spectrum_db(iq) for iq in slabs if iq.shape[1] == BINS * FRAMES]
    return 10 * np.log10(np.mean(10 ** (np.array(rows) / 10), axis=0))


def _name(row: np.void) -> str:
    return f"{'G' if row['signal'] == b'L1CA' else 'E'}{row['prn']:02d}"


def _satellite(source: Any, n0: int, names: Sequence[str]) -> np.void | None:
    """Acquisition of the strongest of these satellites, of any GPS satellite without names."""
    wanted = {
        signal: [int(n[1:]) for n in names if n[0] == system]
        for signal, system in (("L1CA", "G"), ("E1C", "E"))
    }
    found = []
    for signal, prns in wanted.items():
        if prns or (not names and signal == "L1CA"):
            size = min(slab_samples(signal, source.fs_hz, AcquisitionSpec()), source.n_samples - n0)
            iq = source.read_at(n0, size)[1]
            rows = acquire(iq, n0, source.fs_hz, source.if_hz, signal, prns or None, AcquisitionSpec())
            found += [row for row in rows if row["acquired"]]
    return max(found, key=lambda row: row["cn0_dbhz"]) if found else None


def _correlation(source: Any, row: np.void, n0: int) -> tuple[np.ndarray, np.ndarray]:
    """Delays about the acquired one in chips, and the rms over code periods there over that far away."""
    signal = row["signal"].decode()
    fs_hz, n = source.fs_hz, round(SIGNALS[signal].code_period_s * source.fs_hz)
    periods = max(round(CORRELATED_S * fs_hz / n), 1)
    x, y = source.read_at(n0, n * periods)[1].astype(np.float32)
    turns = np.mod((source.if_hz + row["doppler_hz"]) / fs_hz * np.arange(len(x)), 1.0)
    z = ((x + 1j * y) * np.exp(-2j * np.pi * turns))[: len(x) // n * n].reshape(-1, n)
    code = np.fft.fft(code_table(signal, int(row["prn"]), fs_hz).table[0, :n].astype(float))
    rms = np.sqrt(np.mean(np.abs(np.fft.ifft(np.fft.fft(z, axis=1) * np.conj(code), axis=1)) ** 2, axis=0))
    per_chip = fs_hz / CHIP_RATE_HZ
    peak = -row["code_phase_chips"] * per_chip + (row["sample_index"] - n0)
    reach = math.ceil(REACH_CHIPS * per_chip)
    k = np.arange(-reach, reach + 1) + round(peak)
    return (k - peak) / per_chip, rms[k % n] / np.median(rms)
