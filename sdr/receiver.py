"""The receiver: the one place where the stages meet, and where what comes out goes back in.

For each slab of samples: acquisition looks for what is not tracked, the channels correlate and steer themselves, the
telemetry decodes, and at navigation epochs the channels' states at one common sample become a position. No truth, no
start time and no almanac enters: everything known of the sky was decoded from the samples.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from nav.measurements import transmit_rows
from nav.records import SOLUTION
from sdr.scenario import ReceiverSpec
from signals.modulation import SIGNALS
from tracking.acquisition import acquire, slab_samples
from tracking.channel import STATE_IDLE, STATE_LOCKED, STATE_LOST
from tracking.records import ACQUISITION
from tracking.telemetry import Telemetry

SEARCHED = {"G": "L1CA", "E": "E1C"}
"""Signal that is searched for each system; it also names the component that carries the loops."""
REACQUIRE_HZ = 500.0
"""Half width of the Doppler search for a satellite that was tracked a moment ago."""


class Source(Protocol):
    """What delivers samples: a scenario's synthesis or a recording."""

    fs_hz: float
    if_hz: float
    n_samples: int

    def read(self, n: int) -> tuple[int, np.ndarray]:
        """The next slab of at most ``n`` samples, (n0, iq); an empty one at the end."""


@dataclass
class Outcome:
    """What one slab brought."""

    n0: int
    n_end: int
    found: np.ndarray
    """ACQUISITION rows of satellites that a channel was started for."""
    epochs: list[tuple[int, np.ndarray, np.ndarray]]
    """(channel, EPOCH rows, corr (n, K)) of every channel that finished integrations."""
    observations: list[np.ndarray] = field(default_factory=list)
    solutions: list[np.ndarray] = field(default_factory=list)


class Receiver:
    """Run of a ReceiverSpec on samples of one source."""

    def __init__(self, spec: ReceiverSpec, source: Source) -> None:
        self.spec = spec
        self.source = source
        self.fs_hz = float(source.fs_hz)
        self.tracker = spec.tracking.start(source.fs_hz, source.if_hz)
        self.telemetry = Telemetry(self.tracker)
        self.navigator = spec.navigation.start(source.fs_hz)
        self.channel_of: dict[tuple[str, int], int] = {}
        self.last_doppler_hz: dict[tuple[str, int], float] = {}
        self.searched: list[str] = []
        self.position = 0
        self._recent: list[tuple[int, np.ndarray]] = []
        self._next_search = 0
        self._wanted = self._dwell_samples()

    def __iter__(self) -> Iterator[Outcome]:
        # Whole navigation epochs fit into slabs: a position is taken at the slab's last sample.
        slab = round(self.spec.slab_ms * 1e-3 * self.fs_hz)
        every = max(1, round(1.0 / (self.spec.navigation.rate_hz * self.spec.slab_ms * 1e-3)))
        k = 0
        while True:
            n0, iq = self.source.read(slab)
            if iq.shape[1] == 0:
                return
            k += 1
            yield self._advance(n0, iq, navigate=k % every == 0)

    def _advance(self, n0: int, iq: np.ndarray, navigate: bool) -> Outcome:
        n_end = n0 + iq.shape[1]
        epochs, counts, corr = self.tracker.process(n0, iq)
        self.telemetry.update()
        self.position = n_end
        out = Outcome(
            n0,
            n_end,
            np.empty(0, ACQUISITION),
            [(c, epochs[c, :n], corr[c, :n]) for c, n in enumerate(counts) if n],
        )
        if navigate:
            self._navigate(n_end, out)
        # Searching comes last: a new channel starts at the next slab's first sample.
        out.found = self._search(n0, iq)
        return out

    # -- acquisition ------------------------------------------------------------------------------------------------

    def _dwell_samples(self) -> int:
        spec = self.spec.acquisition
        wanted = 0
        for system in spec.systems:
            wanted = max(wanted, slab_samples(SEARCHED[system], self.fs_hz, spec))
        return wanted

    def _search(self, n0: int, iq: np.ndarray) -> np.ndarray:
        """Look for satellites that are not tracked, when enough samples are at hand and the time has come."""
        lost = [
            (key, c) for key, c in self.channel_of.items() if self.tracker.channels["state"][c] == STATE_LOST
        ]
        for key, c in lost:
            self.tracker.release(c)
            del self.channel_of[key]
        if n0 + iq.shape[1] < self._next_search and not lost:
            self._recent.clear()
            return np.empty(0, ACQUISITION)
        self._recent.append((n0, iq))
        held = sum(s.shape[1] for _, s in self._recent)
        at_end = n0 + iq.shape[1] >= self.source.n_samples
        if held < self._wanted and not at_end:
            return np.empty(0, ACQUISITION)
        first, samples = self._recent[0][0], np.concatenate([s for _, s in self._recent], axis=1)
        self._recent.clear()
        self._next_search = n0 + iq.shape[1] + round(self.spec.search_every_s * self.fs_hz)
        return self._acquire_missing(first, samples)

    def _acquire_missing(self, first: int, samples: np.ndarray) -> np.ndarray:
        spec = self.spec.acquisition
        found = []
        self.searched = []
        for system in spec.systems:
            signal = SEARCHED[system]
            prns = [
                p
                for p in (spec.gps_prns if system == "G" else spec.galileo_prns)
                if (signal, p) not in self.channel_of
            ]
            if (
                samples.shape[1] < 2 * SIGNALS[signal].code_period_s * self.fs_hz
                or not prns
                or not samples.any()
            ):
                continue
            self.searched.append(
                f"{signal} PRN {_ranges(prns)} within {spec.doppler_center_hz:+.0f} ± {spec.doppler_range_hz:.0f} Hz"
            )
            rows = acquire(samples, first, self.fs_hz, self.source.if_hz, signal, prns, spec)
            for row in rows[rows["acquired"]]:
                self.channel_of[signal, int(row["prn"])] = self.tracker.add(row)
                self.telemetry.start(self.channel_of[signal, int(row["prn"])])
                found.append(row)
        return np.array(found, ACQUISITION)

    # -- navigation -------------------------------------------------------------------------------------------------

    def _navigate(self, sample: int, out: Outcome) -> None:
        rows = self.transmit(sample)
        solution = self.navigator.update(
            rows, self.telemetry.ephemerides(), self.telemetry.iono_utc("G"), self.telemetry.iono_utc("E")
        )
        if len(self.navigator.observations):
            out.observations.append(self.navigator.observations)
        if solution is not None:
            out.solutions.append(np.atleast_1d(np.asarray(solution, SOLUTION)))

    def transmit(self, sample: int) -> np.ndarray:
        """TRANSMIT rows of the locked channels at one receiver sample."""
        replica = self.tracker.snapshot(sample)
        locked = np.flatnonzero((replica["state"] == STATE_LOCKED) & replica["phase_locked"])
        r = replica[locked]
        reference = [self.telemetry.reference(int(c)) for c in locked]
        slips = self.telemetry.slipped(locked, r["slips"])
        return transmit_rows(
            sample, r["signal"], r["prn"], r["code_period"], [p for p, _ in reference], [t for _, t in reference],
            r["code_phase_chips"], r["doppler_hz"], r["carrier_phase_cycles"], r["cn0_dbhz"], r["lock_s"], slips,
        )  # fmt: skip

    # -- report -----------------------------------------------------------------------------------------------------

    def satellites(self, locked_s: dict[tuple[str, int], float]) -> list[dict[str, Any]]:
        """One row per satellite that was ever acquired, as it stands at the last processed sample."""
        replica = self.tracker.snapshot(self.position)
        rows = []
        for signal, prn in sorted(locked_s, key=lambda key: (SIGNALS[key[0]].system != "G", key)):
            c = self.channel_of.get((signal, prn))
            row: dict[str, Any] = {
                "signal": signal,
                "prn": prn,
                "acquired": True,
                "locked_s": locked_s[signal, prn],
            }
            alive = c is not None and replica["state"][c] not in (STATE_IDLE, STATE_LOST)
            for name in ("doppler_hz", "code_phase_chips", "cn0_dbhz"):
                row[name] = float(replica[name][c]) if alive else None
            row["ephemeris"] = self.telemetry.has_ephemeris(signal, prn)
            row["healthy"] = self.telemetry.healthy(signal, prn)
            rows.append(row)
        return rows


def _ranges(prns: list[int]) -> str:
    """Numbers as ranges: 1-5, 7."""
    parts: list[list[int]] = []
    for p in sorted(prns):
        if parts and p == parts[-1][1] + 1:
            parts[-1][1] = p
        else:
            parts.append([p, p])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in parts)
