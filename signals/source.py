"""Slabs of IF samples from a sky: the run that turns delays into samples."""

import math
from collections import deque
from collections.abc import Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from fractions import Fraction
from typing import Any

import numpy as np

from signals.codes import secondary_code
from signals.constants import CHIP_RATE_HZ, F_L1_HZ
from signals.faults import FaultySky
from signals.frontend import FrontEndSpec
from signals.inav import encode as encode_inav
from signals.jammer_kernels import JAMMER, NARROW, normals
from signals.kernels import COMPONENT
from signals.lnav import encode as encode_lnav
from signals.modulation import BLOCK, code_table
from signals.multipath import EchoRun
from signals.orbits import broadcast_sets
from signals.records import ECHO_TRUTH, EPHEMERIS, FAULT_TRUTH, JAMMER_TRUTH, TRUTH
from signals.sky import Propagation, Satellite, Sky
from signals.synthesis_kernels import synthesise

__all__ = ["CELLS_PER_S", "Cells", "SyntheticSource", "amplitude", "hermite_cells", "jammer_tables", "truth"]

CELLS_PER_S = 50
"""Cells of 20 ms: a whole number of code periods of every signal, and the grid of the clock noise."""
_CELL_CHIPS = CHIP_RATE_HZ / CELLS_PER_S
_SEGMENT_S = 60
"""Symbols are encoded for this long at a time, so that memory does not grow with the duration."""
_LEAD_S = 12
"""Symbols begin so much before a segment: more than any delay."""
_LENGTH_CHIPS = {"L1CA": 1023, "E1": 4092}


def amplitude(cn0_dbhz, fs_hz: float, is_complex: bool = True):
    """Amplitude of a carrier whose noise has unit variance per component.

    Complex samples: noise density 2 / fs, power A^2, so A = sqrt(2 C/N0 / fs). Real samples A cos: one-sided
    density 1 / (fs/2), power A^2 / 2, so A = sqrt(4 C/N0 / fs).
    """
    return np.sqrt((2.0 if is_complex else 4.0) * 10.0 ** (np.asarray(cn0_dbhz, float) / 10.0) / fs_hz)


def _n_phase(fs_hz: float) -> int:
    """Rows of the code tables: a rounding of at most c / (2 P fs) = 0.15 m, in at most 256 rows."""
    return int(2 ** np.clip(math.ceil(math.log2(1e9 / fs_hz)), 5, 8))


class Cells:
    """The cells of a sample rate: a block belongs to the cell that holds its middle, in exact arithmetic."""

    def __init__(self, fs_hz: float):
        self._num, self._den = Fraction(fs_hz).as_integer_ratio()
        self.n_cell = fs_hz / CELLS_PER_S

    def first_block(self, cell: int) -> int:
        """First block with its middle at or after the beginning of the cell."""
        unit = CELLS_PER_S * BLOCK * self._den
        return max(-((unit - 2 * self._num * cell) // (2 * unit)), 0)

    def place(self, cell: int) -> tuple[int, int, float]:
        """First block of the cell, first block after it, and samples from the cell's beginning to its first block."""
        first = self.first_block(cell)
        begin = first * BLOCK * CELLS_PER_S * self._den - self._num * cell
        return first, self.first_block(cell + 1), begin / (CELLS_PER_S * self._den)

    def holding(self, n: int) -> int:
        """Cell of the block that holds sample n."""
        return (2 * (n // BLOCK) + 1) * BLOCK * CELLS_PER_S * self._den // (2 * self._num)

    def count(self, n: int) -> int:
        """Cells that hold the samples 0 .. n - 1."""
        return self.holding(n - 1) + 1


class SyntheticSource:
    """Run that makes the samples of a sky, slab after slab, in constant memory.

    Parameters
    ----------
    sky : Sky
    front_end : FrontEndSpec
    duration_s : float
    seed : int or SeedSequence
        Of the thermal noise; two sources of one seed have the same noise whatever else differs.
    jammers : iterable
        Runs with ``rms`` (of the sum of I and Q halves, thermal noise = 1) and ``add(iq, n0)``, which adds the
        samples n0, n0 + 1, .. to float32 (2, n) and depends on nothing but n0.
    threads : int
        Cells made ahead in parallel; the bits do not depend on it.
    noise : bool
        False leaves the thermal noise out.
    code_path : optional
        Directory of the E1 codes (``signals.codes.primary_code``).
    echoes : mapping, optional
        Satellite name -> EchoRun; each echo is one more component of the synthesis.
    """

    def __init__(
        self,
        sky: Sky | FaultySky,
        front_end: FrontEndSpec,
        duration_s: float,
        seed,
        jammers: Iterable = (),
        threads: int = 1,
        noise: bool = True,
        code_path=None,
        echoes: Mapping[str, EchoRun] | None = None,
    ):
        self.sky, self.spec = sky, front_end
        self.fs_hz, self.if_hz, self.complex = front_end.fs_hz, front_end.if_hz, front_end.complex
        self.n_samples = math.floor(duration_s * self.fs_hz + 1e-6)
        if self.n_samples < 1:
            raise ValueError(
                f"duration_s = {duration_s:g} holds no sample at fs_hz = {self.fs_hz:g}: make it longer"
            )
        self._cells = Cells(self.fs_hz)
        self._n_cells = self._cells.count(self.n_samples)
        self.jammers = tuple(jammers)
        self._fused = [j for j in self.jammers if getattr(j, "fused", False)]
        self._added = [j for j in self.jammers if j not in self._fused]
        self._tables = jammer_tables(self._fused)
        steady = not any(j.spec.profile for j in self._fused)
        self._level = _levels(self._fused, 0, 1) if steady else None
        seed = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
        self._seed = seed.generate_state(1, np.uint64)[0]
        self._sigma = np.float32(1.0 if noise else 0.0)
        self._codes, self._components = _code_buffer(sky.satellites, self.fs_hz, code_path)
        self.echoes = {
            row: run for row, s in enumerate(sky.satellites) if (run := (echoes or {}).get(s.name))
        }
        rows = [np.full(run.n_echo, row) for row, run in self.echoes.items()]
        self._rows = np.concatenate([np.arange(len(sky.satellites)), *rows]).astype(np.int64)
        self._segment = (-1, np.zeros(0, np.int8), self._components)
        own = np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, 1))
        self.front_end = front_end.start(self._rms(duration_s), own)
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None
        self._ahead = 2 * threads if threads > 1 else 1
        self._pending: deque[Future | tuple] = deque()
        self._next_cell = 0
        self._group: tuple = (-1,)
        self._cell = np.zeros((2, 0), front_end.dtype)
        self._used = 0
        self._position = 0

    def read(self, n: int) -> tuple[int, np.ndarray]:
        """Next n samples, or what is left: (index of the first, planar (2, n))."""
        n0 = self._position
        n = max(min(int(n), self.n_samples - n0), 0)
        out = np.empty((2, n), self.front_end.dtype)
        filled = 0
        while filled < n:
            if self._used == self._cell.shape[1]:
                self._cell, self._used = self._pop(), 0
            take = min(n - filled, self._cell.shape[1] - self._used)
            out[:, filled : filled + take] = self._cell[:, self._used : self._used + take]
            filled, self._used = filled + take, self._used + take
        self._position = n0 + n
        return n0, out

    def close(self) -> None:
        """Stop the threads."""
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)

    def truth(self, sample_index) -> np.ndarray:
        """TRUTH rows of the visible satellites at these samples, by sample, then satellite."""
        return truth(self.sky, sample_index, self.fs_hz)

    def pvt_truth(self, sample_index) -> np.ndarray:
        """PVT_TRUTH rows at these samples."""
        index = np.atleast_1d(np.asarray(sample_index, np.uint64))
        out = self.sky.receiver(index / self.fs_hz)
        out["sample_index"] = index
        return out

    def jammer_truth(self, sample_index) -> np.ndarray:
        """JAMMER_TRUTH rows of the jammers at these samples, by sample."""
        rows = [j.truth(sample_index, k) for k, j in enumerate(self.jammers) if hasattr(j, "truth")]
        return np.stack(rows, axis=1).ravel() if rows else np.zeros(0, JAMMER_TRUTH)

    def echo_truth(self, sample_index) -> np.ndarray:
        """ECHO_TRUTH rows at these samples, by satellite and sample."""
        rows = [np.zeros(0, ECHO_TRUTH)]
        for row, run in self.echoes.items():
            satellite = self.sky.satellites[row]
            rows.append(run.truth(sample_index, self.fs_hz, satellite.system.encode(), satellite.prn))
        return np.concatenate(rows)

    def agc_gain_db(self, sample_index) -> np.ndarray | None:
        """Gain of the control loop at samples that have been read, float64 (n,), dB re the ideal; None without one."""
        return None if self.spec.agc is None else self.front_end.agc_trace_db(sample_index)

    def fault_truth(self, sample_index) -> np.ndarray:
        """FAULT_TRUTH rows at these samples, by sample, then fault."""
        faults = getattr(self.sky, "fault_truth", None)
        return np.zeros(0, FAULT_TRUTH) if faults is None else faults(sample_index, self.fs_hz)

    def truth_index(self, rate_hz: float = 10.0) -> np.ndarray:
        """Samples at which truth is written: every 1 / rate_hz from the first, uint64."""
        n = math.floor((self.n_samples - 1) * rate_hz / self.fs_hz) + 1
        return np.ceil(np.arange(n) * (self.fs_hz / rate_hz) - 1e-6).astype(np.uint64)

    def _rms(self, duration_s: float) -> float:
        """Root of the mean power per component that reaches the gain control."""
        t = np.linspace(0.0, duration_s, 9)
        sky = self.sky.propagate(t)
        power = np.where(sky.visible, amplitude(sky.cn0_dbhz, self.fs_hz, self.complex) ** 2 / 2, 0.0)
        jamming = sum(j.rms**2 for j in self.jammers)
        return math.sqrt(1.0 + power.sum(axis=0).mean() + jamming)

    def _pop(self) -> np.ndarray:
        while len(self._pending) < self._ahead and self._next_cell < self._n_cells:
            job = self._prepare(self._next_cell)
            self._pending.append(job if self._pool is None else self._pool.submit(self._make, *job))
            self._next_cell += 1
        head = self._pending.popleft()
        cell = self._make(*head) if isinstance(head, tuple) else head.result()
        if not self.front_end.streaming:
            return cell
        return self.front_end.push(cell, last=not self._pending and self._next_cell == self._n_cells)

    def _prepare(self, cell: int) -> tuple:
        """All that the kernel needs for one cell; what is slow and what is shared is done here, in order."""
        group, k = divmod(cell, CELLS_PER_S)
        if self._group[0] != group:
            parts: tuple[np.ndarray, ...] = self._polynomials(group * CELLS_PER_S)
            seen = np.any(parts[2], axis=2)
            whole = bool(np.all(seen == seen[0]))
            if whole and not seen.all():  # those below the horizon all this second
                parts = tuple(part[:, seen[0]] for part in parts)
            own = [j.carrier(group) for j in self._fused]
            turns = np.stack(own, axis=1) if own else np.zeros((CELLS_PER_S, 0, 4))
            self._group = (group, *parts, seen, whole, turns)
        _, code, carrier, gain, seen, whole, turns = self._group
        symbols, components = self._symbols(group // _SEGMENT_S)
        components = components if seen[k].all() else components[seen[k]]
        periods = np.rint(cell * _CELL_CHIPS / components["code_length_chips"]).astype(np.int64)
        first, last, n_start = self._cells.place(cell)
        job = components, code[k], carrier[k], gain[k], periods
        if not whole:
            job = components, code[k][seen[k]], carrier[k][seen[k]], gain[k][seen[k]], periods
        level = self._level if self._level is not None else _levels(self._fused, first, last)
        return first, last, n_start, *job, symbols, turns[k], level

    def _polynomials(self, cell: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Code chips (cells, S, 4), carrier cycles, amplitude (cells, S, 2) of the cells of a second.

        Cubics through delays and rates at both ends of a cell; the amplitude is a line.
        """
        cells = np.arange(cell, min(cell + CELLS_PER_S, self._n_cells))
        sky = self.sky.propagate(np.append(cells, cells[-1] + 1) / CELLS_PER_S)
        code = -CHIP_RATE_HZ * hermite_cells(sky.delay_s, sky.delay_rate_s_s)
        code[..., 1] += _CELL_CHIPS
        carrier = -F_L1_HZ * hermite_cells(sky.phase_delay_s, sky.phase_delay_rate_s_s)
        carrier[..., 0] += np.mod(cells * math.fmod(self.if_hz / CELLS_PER_S, 1.0), 1.0)[:, None]
        carrier[..., 0] -= np.floor(carrier[..., 0])
        carrier[..., 1] += self.if_hz / CELLS_PER_S
        ends = amplitude(sky.cn0_dbhz, self.fs_hz, self.complex).T
        seen = (sky.visible[:, :-1] & sky.visible[:, 1:]).T
        gain = np.stack([ends[:-1], ends[1:] - ends[:-1], *[np.zeros_like(ends[1:])] * 2], axis=-1)
        return self._with_echoes(cells, code, carrier, gain * seen[..., None])

    def _with_echoes(self, cells, code, carrier, gain) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The same, and after the satellites their echoes: later codes, gains on lines, Doppler in the carrier."""
        parts = [(code, carrier, gain)]
        t_s = np.append(cells, cells[-1] + 1) / CELLS_PER_S
        for row, run in self.echoes.items():
            echo, delay_s = run.series(t_s[0], 1 / CELLS_PER_S, len(t_s))
            turns = np.mod(run.doppler_hz[:, None] * t_s, 1.0)
            slow = (echo * np.exp(-2j * np.pi * turns)).T
            later = np.zeros((len(cells), run.n_echo, 4))
            later[..., 0], later[..., 1] = delay_s.T[:-1], np.diff(delay_s.T, axis=0)
            spin = np.zeros_like(later)
            spin[..., 0], spin[..., 1] = turns.T[:-1], run.doppler_hz / CELLS_PER_S
            begin = gain[:, row, :1] * slow[:-1]
            change = (gain[:, row, :1] + gain[:, row, 1:2]) * slow[1:] - begin
            parts.append((
                code[:, row, None] - CHIP_RATE_HZ * later,
                carrier[:, row, None] + spin,
                np.stack([begin.real, change.real, begin.imag, change.imag], axis=-1),
            ))  # fmt: skip
        if not self.echoes:
            return parts[0]
        code, carrier, gain = (np.concatenate(p, axis=1) for p in zip(*parts))
        return code, carrier, gain

    def _symbols(self, segment: int) -> tuple[np.ndarray, np.ndarray]:
        """Flat symbols of a segment and the components that point into them."""
        if self._segment[0] != segment:
            start_s = segment * _SEGMENT_S - _LEAD_S
            parts, components = [], self._components.copy()
            at = 0
            for row, satellite in enumerate(self.sky.satellites):
                for k, (values, first, periods) in enumerate(_messages(self.sky, satellite, start_s), 1):
                    components[f"symbols{k}"][row], components[f"n_symbols{k}"][row] = at, len(values)
                    components[f"first_period{k}"][row] = first
                    components[f"periods_per_symbol{k}"][row] = periods
                    parts.append(values)
                    at += len(values)
            self._segment = (segment, np.concatenate(parts), components[self._rows])
        return self._segment[1], self._segment[2]

    def _make(
        self, first, last, n_start, components, code, carrier, gain, periods, symbols, jammer_carrier, level
    ) -> np.ndarray:
        n = (last - first) * BLOCK
        plain = self.spec.bits == 8 and self.complex and not (self._added or self.front_end.streaming)
        iq, out = np.empty((2, 0 if plain else n), np.float32), np.empty((2, n if plain else 0), np.int8)
        synthesise(
            iq, out, self.front_end.gain, self._seed, self._sigma, first * BLOCK, n_start, self._cells.n_cell,
            components, code, carrier, gain, periods, self._codes, symbols,
            self._tables[0], jammer_carrier, level, *self._tables[1:],
        )  # fmt: skip
        if plain:
            return out
        for jammer in self._added:
            jammer.add(iq, first * BLOCK)
        if self.front_end.streaming:
            return iq
        if not self.complex:
            iq[1] = 0.0
        return self.front_end(iq)


def _levels(runs, first: int, last: int) -> np.ndarray:
    """Amplitudes of the jammers over blocks first .. last - 1: float32 (J, 1) or (J, sub-blocks)."""
    levels = [run.level(first, last) for run in runs]
    return np.stack(np.broadcast_arrays(*levels)) if levels else np.zeros((0, 1), np.float32)


def jammer_tables(runs) -> tuple[np.ndarray, ...]:
    """JAMMER rows of the jammers, and the tables into which they point, flat: codes, waves, taps; these after the
    Gaussian numbers that bands of noise share."""
    rows = np.zeros(len(runs), JAMMER)
    parts: tuple[list, list, list] = (
        [np.zeros(0, np.int8)],
        [np.zeros(0, np.int16)],
        [normals() if any(run.envelope.kind == NARROW for run in runs) else np.zeros(0, np.float32)],
    )
    for k, run in enumerate(runs):
        rows[k] = run.row[0]
        for table, part in zip(parts, (run.envelope.codes, run.envelope.waves, run.envelope.taps)):
            if len(part):
                rows[k]["table"] = sum(len(p) for p in table)
            table.append(part)
    return rows, *(np.concatenate(p) for p in parts)


def hermite_cells(value: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Cubics in x with the values and rates (per second) of (S, cells + 1) nodes -> (cells, S, 4)."""
    v0, v1 = value.T[:-1], value.T[1:]
    d0, d1 = rate.T[:-1] / CELLS_PER_S, rate.T[1:] / CELLS_PER_S
    rise = v1 - v0
    return np.stack([v0, d0, 3.0 * rise - 2.0 * d0 - d1, d0 + d1 - 2.0 * rise], axis=-1)


def _signals_of(satellite: Satellite) -> tuple[str, ...]:
    return ("L1CA",) if satellite.system == "G" else ("E1B", "E1C")


def _code_buffer(satellites, fs_hz: float, path) -> tuple[np.ndarray, np.ndarray]:
    """Code tables of all satellites in one flat buffer, and their COMPONENT rows without symbols."""
    components = np.zeros(len(satellites), COMPONENT)
    components["code2"] = -1
    parts, at = [], 0
    for row, satellite in enumerate(satellites):
        for k, signal in enumerate(_signals_of(satellite), 1):
            table = code_table(signal, satellite.prn, fs_hz, _n_phase(fs_hz), path=path)
            # Composite E1: half the power each, E1-C with a minus sign (Galileo OS SIS ICD, 2.3.3).
            share = {"L1CA": 1.0, "E1B": math.sqrt(0.5), "E1C": -math.sqrt(0.5)}[signal]
            components[f"code{k}"][row] = at
            components[f"weight{k}"][row] = share * table.scale
            components["n_cols"][row] = table.table.shape[1]
            components["phase_bits"][row] = int(math.log2(table.table.shape[0]))
            components["samples_per_chip"][row] = table.samples_per_chip
            components["code_length_chips"][row] = table.code_length_chips
            parts.append(table.table.ravel())
            at += table.table.size
    return np.concatenate(parts), components


def _messages(sky: Sky | FaultySky, satellite: Satellite, start_s: int):
    """(symbols, first code period, code periods per symbol) of each component from scenario time ``start_s`` on."""
    span_s = _SEGMENT_S + _LEAD_S + 2
    system = satellite.system
    per_s, periods = (50, 20) if system == "G" else (250, 1)
    first = start_s * per_s * periods
    if satellite.ephemeris is None:
        rng = np.random.default_rng([0x5C21, ord(system), satellite.prn])
        data = (rng.integers(0, 2, 64 * per_s) * 2 - 1).astype(np.int8)
        messages = [(data, 0, periods)]
    else:
        encode = encode_lnav if system == "G" else encode_inav
        almanac = np.array([s.ephemeris for s in sky.satellites if s.ephemeris is not None], EPHEMERIS)
        almanac = almanac[almanac["system"] == system.encode()]
        tow = sky.tow_s + start_s
        week, tow = sky.week + tow // 604_800, tow % 604_800
        iono_utc: Any = sky.iono_utc[()]  # np.void
        sets = broadcast_sets(satellite.ephemeris, sky.week, sky.tow_s, start_s, start_s + span_s)
        messages = [
            (
                encode(sets, iono_utc, almanac, week, tow, span_s * per_s),
                first,
                periods,
            )
        ]
    if system == "E":
        messages.append((secondary_code().astype(np.int8), 0, 1))
    return messages


def truth(sky: Sky | FaultySky, sample_index, fs_hz: float) -> np.ndarray:
    """TRUTH rows of the visible, genuine satellites at these samples, by sample, then satellite."""
    index = np.atleast_1d(np.asarray(sample_index, np.uint64))
    t = index / fs_hz
    now = sky.propagate(t)
    step_s = 0.01
    later, before = sky.propagate(t + step_s), sky.propagate(t - step_s)
    rate_change = (later.phase_delay_rate_s_s - before.phase_delay_rate_s_s) / (2 * step_s)
    out = np.zeros((len(index), len(sky.satellites)), TRUTH)
    out["sample_index"], out["t_s"] = index[:, None], t[:, None]
    for row, satellite in enumerate(sky.satellites):
        out["prn"][:, row], out["system"][:, row] = satellite.prn, satellite.system.encode()
        out["code_phase_chips"][:, row] = _code_phase(now, row, index, fs_hz, _LENGTH_CHIPS[satellite.signal])
    columns = {
        "delay_s": now.delay_s,
        "delay_rate_s_s": now.delay_rate_s_s,
        "carrier_phase_cycles": -F_L1_HZ * now.phase_delay_s,
        "doppler_hz": -F_L1_HZ * now.phase_delay_rate_s_s,
        "doppler_rate_hz_s": -F_L1_HZ * rate_change,
        "cn0_dbhz": now.cn0_dbhz,
        "elevation_rad": now.elevation_rad,
        "azimuth_rad": now.azimuth_rad,
        "range_m": now.range_m,
    }
    for name, values in columns.items():
        out[name] = values.T
    real = now.visible.T.copy()
    real[:, getattr(sky, "genuine", len(sky.satellites)) :] = False
    return out[real]


def _code_phase(now: Propagation, row: int, index: np.ndarray, fs_hz: float, length: int) -> np.ndarray:
    """Chips since the last code period began at the satellite; whole seconds hold whole code periods."""
    whole = np.floor(index / fs_hz)
    seconds = (index - whole * fs_hz) / fs_hz - now.delay_s[row]
    return np.mod(CHIP_RATE_HZ * seconds, length)
