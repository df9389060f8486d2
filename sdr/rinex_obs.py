"""RINEX 3.05 observation files from a results file.

RINEX wants code, phase and time tag of an epoch to belong to one receiver clock, and a phase that grows with range
(RINEX 3.05, 5.2 and 5.4). Ours is the accumulated phase of the replica against the sample count, and grows with
Doppler. With T the receiver time (which the position stage steers) and n / fs the time that the samples count,

    P = c (T - t_tx),    L = -phi + f_L1 (T - n / fs) + N,

so that a steering step moves both alike. N is a whole number per arc that puts the phase near the code.
"""

from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from signals.constants import C_MPS, F_L1_HZ, SECONDS_PER_WEEK, WAVELENGTH_M
from signals.timescale import calendar

WEEK_MS = SECONDS_PER_WEEK * 1000
TICKS_PER_MS = 10_000
"""Time tags have seven decimals."""
OBSERVABLES = {
    b"L1CA": ("C1C", "L1C", "D1C", "S1C"),
    b"E1C": ("C1C", "L1C", "D1C", "S1C"),
    b"E1B": ("C1B", "L1B", "D1B", "S1B"),
}
"""RINEX 3.05, tables 5 and 7: channel C of GPS is C/A, of Galileo E1 the pilot; B is Galileo's data component."""
HALF_CYCLE = (b"L1CA", b"E1B")
"""Signals whose carrier is found up to half a cycle, because data modulate it: bit 1 of the loss-of-lock flag."""


class Epoch(NamedTuple):
    """One epoch: receiver time of week in ticks of 100 ns, its week, and the epoch's rows."""

    week: int
    ticks: int
    rows: np.ndarray
    shift_s: float
    """Time tag minus the receiver time in which the pseudoranges of ``rows`` are."""


def lines(observations: np.ndarray, solution: np.ndarray, fs_hz: float, program: str) -> Iterator[str]:
    """Lines of the file.

    Parameters
    ----------
    observations : OBSERVATION rows, epochs ascending
    solution : SOLUTION rows that are valid; they say the week, and the millisecond of the receiver time
    fs_hz : sample rate
    program : name and version for the header
    """
    epochs = list(_epochs(observations, solution, fs_hz))
    yield from _header(observations, solution, epochs, program)
    yield from _body(epochs, fs_hz)


def _epochs(observations: np.ndarray, solution: np.ndarray, fs_hz: float) -> Iterator[Epoch]:
    """Rows of each epoch with their time tag; a tag further than 0.5 ms from GPS time moves by whole ms."""
    starts = np.flatnonzero(np.diff(observations["sample_index"], prepend=-1, append=-1))
    for begin, end in pairwise(starts):
        rows = observations[begin:end]
        sample = int(rows["sample_index"][0])
        near = solution[np.argmin(np.abs(solution["sample_index"].astype(np.int64) - sample))]
        gps_ms = (float(near["tow_s"]) + (sample - int(near["sample_index"])) / fs_hz) * 1e3
        rest_s = float(rows["tow_tx_frac_s"][0]) + float(rows["pseudorange_m"][0]) / C_MPS
        off_ms = int(rows["tow_tx_ms"][0]) + rest_s * 1e3 - gps_ms
        off_ms -= round(off_ms / WEEK_MS) * WEEK_MS
        step_ms = -round(off_ms)
        ticks = round(rest_s * 1e3 * TICKS_PER_MS)
        shift_s = step_ms * 1e-3 + (ticks / (1e3 * TICKS_PER_MS) - rest_s)
        ticks += (int(rows["tow_tx_ms"][0]) + step_ms) * TICKS_PER_MS
        week = int(near["week"]) + round((gps_ms - ticks / TICKS_PER_MS) / WEEK_MS)
        yield Epoch(week, ticks, rows, shift_s)


def _header(
    observations: np.ndarray, solution: np.ndarray, epochs: list[Epoch], program: str
) -> Iterator[str]:
    signals = {s: OBSERVABLES[s] for s in sorted(set(observations["signal"].tolist()))}
    by_system: dict[str, list[str]] = {}
    for signal, codes in signals.items():
        by_system.setdefault("G" if signal == b"L1CA" else "E", []).extend(codes)
    mixed = "M" if len(by_system) > 1 else next(iter(by_system))
    yield _label(f"{3.05:9.2f}{'':11}{'OBSERVATION DATA':20}{mixed:20}", "RINEX VERSION / TYPE")
    now = datetime.now(UTC)
    yield _label(f"{program[:20]:20}{'':20}{now:%Y%m%d %H%M%S} UTC", "PGM / RUN BY / DATE")
    yield _label("", "MARKER NAME")
    yield _label("", "OBSERVER / AGENCY")
    yield _label(f"{'':20}{'software receiver':20}{program[-20:]:20}", "REC # / TYPE / VERS")
    yield _label("", "ANT # / TYPE")
    x, y, z = solution["pos_ecef_m"].mean(axis=0)
    yield _label(f"{x:14.4f}{y:14.4f}{z:14.4f}", "APPROX POSITION XYZ")
    yield _label(f"{0:14.4f}{0:14.4f}{0:14.4f}", "ANTENNA: DELTA H/E/N")
    for system, types in sorted(by_system.items(), reverse=True):
        yield _label(f"{system}  {len(types):3d}" + "".join(f" {c}" for c in types), "SYS / # / OBS TYPES")
    yield _label("DBHZ", "SIGNAL STRENGTH UNIT")
    yield _label(_first(epochs[0]), "TIME OF FIRST OBS")
    # GPS C/A is the reference; Galileo's phase is not aligned to E1-B (system alone: not known).
    for system in sorted(by_system, reverse=True):
        yield _label("G L1C" if system == "G" else system, "SYS / PHASE SHIFT")
    yield _label("", "END OF HEADER")


def _label(content: str, label: str) -> str:
    return f"{content:60.60}{label:20}".rstrip()


def _moment(epoch: Epoch) -> tuple[datetime, float]:
    """The whole minute in calendar GPS time, and the seconds in it, rounded to nothing."""
    tow_s, ticks = divmod(epoch.ticks, 1000 * TICKS_PER_MS)
    minutes, second = divmod(tow_s, 60)
    return calendar(epoch.week, minutes * 60.0), second + ticks / (1000 * TICKS_PER_MS)


def _first(epoch: Epoch) -> str:
    at, second_s = _moment(epoch)
    return f"{at.year:6d}{at.month:6d}{at.day:6d}{at.hour:6d}{at.minute:6d}{second_s:13.7f}     GPS"


def _body(epochs: list[Epoch], fs_hz: float) -> Iterator[str]:
    arcs: dict[tuple[bytes, int], tuple[int, float]] = {}  # satellite -> (last sample, N)
    first = epochs[0]
    both = {b"E1B", b"E1C"} <= {s for e in epochs for s in e.rows["signal"].tolist()}  # two groups of columns
    for epoch in epochs:
        at, second_s = _moment(epoch)
        sample = int(epoch.rows["sample_index"][0])
        weeks_s = (epoch.week - first.week) * SECONDS_PER_WEEK
        elapsed_s = (epoch.ticks - first.ticks) / (1e3 * TICKS_PER_MS) + weeks_s
        clock_s = elapsed_s - (sample - int(first.rows["sample_index"][0])) / fs_hz
        yield f"> {at:%Y %m %d %H %M}{second_s:11.7f}  0{len(epoch.rows):3d}"
        for row in epoch.rows:
            blank = " " * 64 if both and row["signal"] == b"E1C" else ""
            yield _satellite(row, blank, epoch.shift_s, clock_s, sample, fs_hz, arcs)


def _satellite(
    row: np.void, blank: str, shift_s: float, clock_s: float, sample: int, fs_hz: float, arcs: dict
) -> str:
    key = (row["signal"], int(row["prn"]))
    code_m = float(row["pseudorange_m"]) + C_MPS * shift_s
    phase = -float(row["carrier_phase_cycles"]) + F_L1_HZ * clock_s
    last, whole = arcs.get(key, (-1, 0.0))
    lost = last < 0 or bool(row["cycle_slip"]) or float(row["lock_s"]) < (sample - last) / fs_hz
    if lost:
        whole = float(round(code_m / WAVELENGTH_M - phase))
    arcs[key] = (sample, whole)
    flag = int(lost) + 2 * (row["signal"] in HALF_CYCLE)
    strength = min(max(int(row["cn0_dbhz"] / 6.0), 1), 9) if np.isfinite(row["cn0_dbhz"]) else 0
    fields = [_field(code_m, 0, strength), _field(phase + whole, flag, strength)]
    fields += [_field(float(row["doppler_hz"])), _field(float(row["cn0_dbhz"]))]
    return f"{row['system'].decode()}{int(row['prn']):02d}{blank}{''.join(fields)}".rstrip()


def _field(value: float, flag: int = 0, strength: int = 0) -> str:
    if not np.isfinite(value) or abs(value) >= 1e9:
        return " " * 16
    return f"{value:14.3f}{flag or ' '}{strength or ' '}"
