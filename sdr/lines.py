"""The strongest code spectrum lines as a table and a figure: ``gnssbb lines``."""

from pathlib import Path
from typing import Any

import numpy as np

from signals.modulation import SIGNALS, code_lines, worst_lines

WAVEFORMS = {"L1CA": ("BPSK",), "E1B": ("BOC11", "CBOC+"), "E1C": ("BOC11", "CBOC-")}


def lines(
    signal: str | None, waveform: str | None, prn: int | None, top: int, tiered: bool, figures: Path | None
) -> dict[str, Any]:
    """Worst lines per signal and waveform (one row per PRN, strongest first), or the lines of one PRN."""
    if signal is not None and signal not in SIGNALS:
        raise ValueError(f"signal '{signal}' is not known; allowed: {', '.join(SIGNALS)}")
    if top < 1:
        raise ValueError(f"--top {top} is too small; give 1 or more")
    if tiered and signal not in (None, "E1C"):
        raise ValueError(f"--tiered is for E1C alone, which has a secondary code; {signal} has none")
    chosen = [signal] if signal else ["E1C"] if tiered else list(SIGNALS)
    table: list[dict[str, Any]] = []
    drawn: list[str] = []
    for name in chosen:
        allowed = WAVEFORMS[name]
        if waveform is not None and waveform not in allowed:
            if signal is not None:
                raise ValueError(
                    f"waveform '{waveform}' does not belong to {name}; allowed: {', '.join(allowed)}"
                )
            continue
        for wave in [waveform] if waveform else allowed:
            rows = _rows(name, wave, prn, top, tiered)
            table += rows
            if figures is not None and rows:
                drawn.append(str(_draw(figures, name, wave, rows[0]["prn"], tiered)))
    if not table:
        raise ValueError(f"waveform '{waveform}' belongs to no signal; allowed: BPSK, BOC11, CBOC+, CBOC-")
    text = [f"{'signal':6} {'waveform':8} {'PRN':>4} {'line (kHz)':>11} {'level (dB)':>11}"]
    text += [
        f"{r['signal']:6} {r['waveform']:8} {r['prn']:4d} {r['freq_hz'] / 1e3:11.2f} {r['level_db']:11.3f}"
        for r in table
    ]
    result: dict[str, Any] = {"lines": table, "text": "\n".join(text)}
    return result | ({"figures": drawn} if drawn else {})


def _rows(signal: str, waveform: str, prn: int | None, top: int, tiered: bool) -> list[dict[str, Any]]:
    if prn is None:
        worst = worst_lines(signal, waveform, tiered=tiered)
        prns, freq_hz, level_db = worst["prn"], worst["freq_hz"], worst["level_db"]
    else:
        freq_hz, level_db = code_lines(signal, prn, waveform, tiered=tiered)
        prns = np.full(freq_hz.size, prn)
    return [
        {
            "signal": signal,
            "waveform": waveform,
            "prn": int(prns[k]),
            "freq_hz": float(freq_hz[k]),
            "level_db": float(level_db[k]),
        }
        for k in np.argsort(-level_db, kind="stable")[:top]
    ]


def _draw(directory: Path, signal: str, waveform: str, prn: int, tiered: bool) -> Path:
    from sdr.figure import figure

    directory.mkdir(parents=True, exist_ok=True)
    path = (
        directory
        / f"lines_{signal}_{waveform.replace('+', 'p').replace('-', 'm')}{'_tiered' if tiered else ''}.png"
    )
    freq_hz, level_db = code_lines(signal, prn, waveform, tiered=tiered)
    worst = worst_lines(signal, waveform, tiered=tiered)
    with figure(path, f"{signal} {waveform} code spectrum lines", rows=1) as ax:
        ax.vlines(freq_hz / 1e3, -70, np.maximum(level_db, -70), lw=0.4, label=f"PRN {prn}")
        ax.plot(worst["freq_hz"] / 1e3, worst["level_db"], "r.", ms=4, label="worst line of each PRN")
        ax.set(xlabel="offset from the carrier (kHz)", ylabel="level re signal power (dB)", ylim=(-60, -15))
        ax.legend(fontsize=8)
    return path
