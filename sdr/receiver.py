"""The receiver: the one place where the stages meet, and where what comes out goes back in.

For each slab of samples: acquisition looks for what is not tracked, the channels correlate and steer themselves, the
telemetry decodes, and at navigation epochs the channels' states at one common sample become a position. No truth, no
start time and no almanac enters: everything known of the sky was decoded from the samples.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from typing import Any, Protocol

import numpy as np

from nav.measurements import transmit_rows
from nav.navlog import Remedy
from nav.records import SOLUTION
from nav.steering import Sensors, Steering
from sdr.drift import CodeDrift
from sdr.holes import Holes
from sdr.scenario import ReceiverSpec
from sdr.watch.channels import Flags, Watch
from sdr.watch.front import FrontWatch, Overheard
from signals.modulation import SIGNALS
from tracking.acquisition import acquire, lowest_rate_hz, slab_samples
from tracking.channel import STATE_IDLE, STATE_LOCKED, STATE_LOST
from tracking.records import ACQUISITION, AIDING
from tracking.telemetry import Telemetry

SEARCHED = {"G": "L1CA", "E": "E1C"}
"""Signal that is searched for each system; it also names the component that carries the loops."""
ENOUGH = 4
"""Satellites tracked below which everything is searched again and again."""
SOLUTION_S = 0.1
"""Steered positions are reported this often."""
DECODE_EVERY = 10
"""Most slabs whose symbols are decoded together; at navigation epochs all are."""
TAKE_S = 0.5
"""New channels are put under command this often."""
SECOND_LOOK = 8
"""Satellites that came nearest their thresholds in the first search and are searched once more."""
WIDEST = 4.0
"""The Doppler range is doubled, up to so many times the one asked for, while too few satellites are found."""
RETRY_S = 1.0
"""A satellite that was lost is looked for again this soon."""


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
    epochs: list[tuple[int, np.ndarray, np.ndarray]] = field(default_factory=list)
    """(channel, EPOCH rows, corr (n, K)) of every channel that finished integrations."""
    observations: list[np.ndarray] = field(default_factory=list)
    solutions: list[np.ndarray] = field(default_factory=list)
    holes: list[np.ndarray] = field(default_factory=list)
    """HOLE rows: samples that are missing before, as the new time of a position tells."""
    views: list[np.ndarray] = field(default_factory=list)
    """VIEW rows: where the satellites of a position stood."""
    statistics: list[tuple[str, np.ndarray]] = field(default_factory=list)
    """(monitor, MONITOR rows) of what the monitors made of the correlator outputs."""
    integrity: list[dict[str, np.ndarray]] = field(default_factory=list)
    """Rows of the integrity monitors by dataset name, one item per navigation epoch."""
    steering: list[np.ndarray] = field(default_factory=list)
    """STEERING rows, one per update of the filter that steers the channels."""


class Receiver:
    """Run of a ReceiverSpec on samples of one source."""

    def __init__(self, spec: ReceiverSpec, source: Source, sensors: Sensors | None = None) -> None:
        self.spec = spec
        self.monitors = [m.start(source.fs_hz) for m in spec.monitor]
        self.front = Overheard(source, [m for m in self.monitors if isinstance(m, FrontWatch)])
        self.mitigation = spec.mitigation.start(self.front) if spec.mitigation else None
        self.source: Source = self.mitigation or self.front
        self.fs_hz = float(source.fs_hz)
        self.tracker = spec.tracking.start(source.fs_hz, source.if_hz, spec.codes_path)
        self.telemetry = Telemetry(self.tracker)
        self.drift = CodeDrift(self.fs_hz)
        self.holes = Holes(self.fs_hz)
        self.navigator = spec.navigation.start(source.fs_hz)
        self.steering = self._start_steering(sensors)
        self._aiding: np.ndarray | None = None
        self._adapts = any(loops.adapt is not None for loops in (spec.tracking.l1ca, spec.tracking.e1))
        respond = spec.respond
        self.flags = Flags(respond.weaken, respond.weaken_by, respond.hold_s, self.fs_hz)
        self.integrity = spec.integrity.start(spec.respond, self.fs_hz) if spec.integrity else None
        if self.integrity is not None:
            self.integrity.watch(self.navigator, self.steering)
        # A rate too low for one system still serves the other.
        systems = spec.acquisition.systems
        self._systems = [s for s in systems if self.fs_hz >= lowest_rate_hz(SEARCHED[s])] or systems
        self.channel_of: dict[tuple[str, int], int] = {}
        self.searched: dict[str, list[int]] = {}
        self._search_spec = spec.acquisition
        self.position = 0
        self._week: int | None = None
        self._undecoded = 0
        self._recent: list[tuple[int, np.ndarray]] = []
        self._lost: list[tuple[str, int]] = []
        self._nearness: dict[tuple[str, int], float] = {}
        self._next_search = self._next_retry = self._full_searches = self._turn = 0
        self._wanted = self._dwell_samples()

    def __iter__(self) -> Iterator[Outcome]:
        # The first slab is what one search takes; after it, slabs divide the time between positions.
        period_s = 1.0 / self.spec.navigation.rate_hz
        per_period = math.ceil(period_s / (self.spec.slab_ms * 1e-3) - 1e-9)
        if self.flags.names and self.steering is not None:
            # The monitors' flags are to hold at the filter's next update, not a slab later.
            per_period = max(per_period, round(self.spec.steering.update_hz * period_s))
        ends = (round(k * period_s / per_period * self.fs_hz) for k in count(1))
        for k, end in enumerate(ends, 1):
            if self.position == 0 and self._wanted < end:
                yield from self._read(self._wanted, navigate=False)
            n = end - self.position
            outcome = list(self._read(n, navigate=k % per_period == 0))
            yield from outcome
            if not outcome or outcome[0].n_end - outcome[0].n0 < n:
                return

    def _read(self, n: int, navigate: bool) -> Iterator[Outcome]:
        n0, iq = self.source.read(n)
        if iq.shape[1]:
            yield self._advance(n0, iq, navigate)

    def _advance(self, n0: int, iq: np.ndarray, navigate: bool) -> Outcome:
        n_end = n0 + iq.shape[1]
        # Searching comes first: a new channel starts with this slab, so that nothing of a short file is lost.
        out = Outcome(n0, n_end, self._search(n0, iq))
        stops = self._updates(n0, n_end)
        epochs, counts, corr = self.tracker.process(
            n0, iq, self._commands(n0), [s for s in stops if s < n_end], partial(self._steer, out)
        )
        self.telemetry.hear()
        self._undecoded += 1
        if navigate or self._undecoded >= DECODE_EVERY or n_end >= self.source.n_samples:
            self._decode()
        self.position = n_end
        out.epochs = rows = [(c, epochs[c, :n], corr[c, :n]) for c, n in enumerate(counts) if n]
        if not stops:  # a steered replica says nothing of its own
            for c, mine, _ in rows:
                self.drift.hear(self.tracker.channels["signal"][c].decode(), mine)
            if self.holes.hear(rows):
                self._doubt()
        if self.integrity is not None:
            self.integrity.hear(self.channel_of, epochs, counts, self.spec.tracking)
        if n_end in stops:
            self._steer(out, n_end, epochs, counts)
        if navigate:
            self._navigate(n_end, out)
            self._hand_over(n_end, out)
        self._watch(out)
        return out

    # -- acquisition ------------------------------------------------------------------------------------------------

    def _dwell_samples(self) -> int:
        spec = self.spec.acquisition
        wanted = 0
        for system in self._systems:
            wanted = max(wanted, slab_samples(SEARCHED[system], self.fs_hz, spec))
        return wanted

    def _search(self, n0: int, iq: np.ndarray) -> np.ndarray:
        """Look for satellites that are not tracked, when the time has come and enough samples are at hand.

        A search of everything costs as much as tracking for ten seconds or more. So all is searched at the start, and
        every ``search_every_s`` while fewer than ``ENOUGH`` satellites are tracked; else the ``SECOND_LOOK`` that came
        nearest their thresholds once more a little later, then one satellite in turn every ``search_one_every_s``.
        Those lost a moment ago come first.
        """
        n_end = n0 + iq.shape[1]
        self._drop_lost()
        if n_end < self._next_search and not (self._lost and n_end >= self._next_retry):
            self._recent.clear()
            return np.empty(0, ACQUISITION)
        self._recent.append((n0, iq))
        if sum(s.shape[1] for _, s in self._recent) < self._wanted and n_end < self.source.n_samples:
            return np.empty(0, ACQUISITION)
        first, samples = (
            self._recent[0][0],
            np.concatenate([s[:, : self._wanted] for _, s in self._recent], axis=1),
        )
        samples = samples[:, : self._wanted]
        self._recent.clear()
        if not samples.any():  # padding: the search waits for samples
            return np.empty(0, ACQUISITION)
        self._next_retry = n_end + round(RETRY_S * self.fs_hz)
        return self._acquire(first, samples, self._due(n_end))

    def _drop_lost(self) -> None:
        lost = self.tracker.channels["state"] == STATE_LOST
        if not lost.any():
            return
        for key, c in list(self.channel_of.items()):
            if lost[c]:
                self.tracker.release(c)
                del self.channel_of[key]
                self._lost.append(key)

    def _due(self, n_end: int) -> list[tuple[str, int]]:
        """Satellites to search now."""
        spec = self.spec.acquisition
        prns = {"G": spec.gps_prns, "E": spec.galileo_prns}
        missing = [
            (SEARCHED[system], p)
            for system in self._systems
            for p in prns[system]
            if (SEARCHED[system], p) not in self.channel_of
        ]
        lost, self._lost = [key for key in self._lost if key in missing], []
        if n_end < self._next_search:
            return lost
        self._full_searches += 1
        if self._full_searches <= 2 or len(self.channel_of) < ENOUGH:
            self._next_search = n_end + round(self.spec.search_every_s * self.fs_hz)
            if self._full_searches == 2 and len(self.channel_of) >= ENOUGH:
                rest = sorted(set(missing) - set(lost), key=lambda key: (-self._nearness.get(key, 0.0), key))
                return lost + rest[:SECOND_LOOK]
            return missing
        self._next_search = n_end + round(self.spec.search_one_every_s * self.fs_hz)
        self._turn += 1
        return lost + ([missing[self._turn % len(missing)]] if missing else [])

    def _acquire(self, first: int, samples: np.ndarray, due: list[tuple[str, int]]) -> np.ndarray:
        spec = self._search_spec
        if len(self.channel_of) < ENOUGH and self._full_searches > 1:
            # Too few: the recorder's oscillator may be further off than was thought.
            wider_hz = min(2 * spec.doppler_range_hz, WIDEST * self.spec.acquisition.doppler_range_hz)
            spec = self._search_spec = spec.model_copy(update={"doppler_range_hz": wider_hz})
        found = []
        for signal in dict.fromkeys(s for s, _ in due):
            prns = [p for s, p in due if s == signal]
            if samples.shape[1] < 2 * SIGNALS[signal].code_period_s * self.fs_hz:
                continue
            self.searched[signal] = sorted({*self.searched.get(signal, ()), *prns})
            rows = acquire(
                samples, first, self.fs_hz, self.source.if_hz, signal, prns, spec, self.spec.codes_path
            )
            self._nearness.update(
                zip(((signal, p) for p in prns), (rows["statistic"] / rows["threshold"]).tolist())
            )
            for row in rows[rows["acquired"]]:
                self._decode()  # before a channel changes hands
                c = self.tracker.add(row)
                self.channel_of[signal, int(row["prn"])] = c
                self.telemetry.start(c)
                found.append(row)
        return np.array(found, ACQUISITION)

    def searched_text(self) -> str:
        """What has been searched, for people."""
        spec = self._search_spec
        span = f"within {spec.doppler_center_hz:+.0f} ± {spec.doppler_range_hz:.0f} Hz"
        return "; ".join(f"{s} PRN {_ranges(p)} {span}" for s, p in self.searched.items())

    # -- navigation -------------------------------------------------------------------------------------------------

    def _navigate(self, sample: int, out: Outcome) -> None:
        if self.drift.inverted:
            return
        self._drop_images(sample)
        rows = self.transmit(sample)
        solution = self.navigator.update(
            rows, self.telemetry.ephemerides(), self.telemetry.iono_utc("G"), self.telemetry.iono_utc("E"),
            remedy=self._remedy(sample), doubted=self.telemetry.doubted(),
        )  # fmt: skip
        if self.navigator.late and not self.telemetry.doubted():
            self._doubt()
        seen = self.navigator.observations
        if len(seen) and seen["sample_index"][0] == sample:
            out.observations.append(seen)
            if solution is not None:
                out.views.append(self.navigator.view())
        if solution is not None and not self._steered:
            out.solutions.append(np.atleast_1d(np.asarray(solution, SOLUTION)))
            if solution["valid"]:
                out.holes.append(self.holes.fix(solution))
        if not self.telemetry.doubted():
            self.holes.settle()
        if self.integrity is not None:
            # What it asks for holds from the next epoch on: the hand-over to navigation, one epoch later.
            out.integrity.append(self.integrity(sample))

    def _drop_images(self, sample: int) -> None:
        """Give up channels that follow a stronger satellite through its code's cross-correlation with theirs."""
        for group in self.telemetry.shared_orbits():
            cn0 = self.tracker.snapshot(sample)["cn0_dbhz"]
            tracked = {
                prn: self.channel_of["L1CA", prn] for _, prn in group if ("L1CA", prn) in self.channel_of
            }
            own = max(tracked, key=lambda prn: cn0[tracked[prn]], default=None)
            for _, prn in group if own is not None else ():
                if prn == own:
                    continue
                self.telemetry.forget("G", prn)
                if prn in tracked:
                    self.tracker.release(tracked[prn])
                    del self.channel_of["L1CA", prn]

    def _remedy(self, sample: int) -> Remedy | None:
        """What the monitors ask of the epoch that ends at ``sample``; None unless ``[receiver.respond]`` wants it."""
        return self.flags.join(None if self.integrity is None else self.integrity.remedy, sample)

    def transmit(self, sample: int) -> np.ndarray:
        """TRANSMIT rows of the locked channels at one receiver sample; steered ones need no phase lock."""
        replica = self.tracker.snapshot(sample)
        followed = replica["phase_locked"] | (self._steered & (self.tracker.channels["steered"] != 0))
        locked = np.flatnonzero((replica["state"] == STATE_LOCKED) & followed)
        r = replica[locked]
        reference = [self.telemetry.reference(int(c)) for c in locked]
        slips = self.telemetry.slipped(locked, r["slips"])
        rows = transmit_rows(
            sample, r["signal"], r["prn"], r["code_period"], [p for p, _ in reference], [t for _, t in reference],
            r["code_phase_chips"], r["doppler_hz"], r["carrier_phase_cycles"], r["cn0_dbhz"], r["lock_s"], slips,
        )  # fmt: skip
        if self.steering is not None and self._steered:
            self.steering.measure(rows, locked)
        return rows

    @property
    def _steered(self) -> bool:
        """Whether a filter steers the channels now."""
        return self.steering is not None and self.steering.filter is not None

    def _doubt(self) -> None:
        """Samples may be missing: transmit times wait for the messages to confirm them."""
        self._decode()
        self.telemetry.doubt()

    def _decode(self) -> None:
        self.telemetry.decode()
        self._undecoded = 0

    # -- steering: the hand-over back to tracking, one slab later -----------------------------------------------------

    def _start_steering(self, sensors: Sensors | None) -> Steering | None:
        spec = self.spec.steering
        if spec.mode == "scalar":
            return None
        per_fix = spec.update_hz / self.spec.navigation.rate_hz
        if per_fix < 1 or abs(per_fix - round(per_fix)) > 1e-9:
            raise ValueError(
                f"receiver.steering.update_hz = {spec.update_hz:g} is not a multiple of receiver.navigation.rate_hz = "
                f"{self.spec.navigation.rate_hz:g}: positions must fall on updates"
            )
        tracking = self.spec.tracking
        if tracking.l1ca.integration_ms * 1e-3 > 1.001 / spec.update_hz:
            raise ValueError(
                f"receiver.steering.update_hz = {spec.update_hz:g} is faster than the integrations of "
                f"{tracking.l1ca.integration_ms} ms: lower it"
            )
        spacing = {"L1CA": tracking.l1ca.early_late_space_chips, "E1": tracking.e1.early_late_space_chips}
        mask_rad = math.radians(self.spec.navigation.elevation_mask_deg)
        return Steering(spec, self.fs_hz, sensors, spacing, mask_rad)

    def _commands(self, sample: int) -> np.ndarray | None:
        """AIDING from ``sample`` on: what navigation left at the last update, for new channels nothing."""
        heeds = self._adapts and (not self.spec.respond.off or bool(self.flags.names))
        if not heeds and (self._aiding is None or len(self._aiding) == len(self.tracker.channels)):
            return self._aiding
        commands = np.zeros(len(self.tracker.channels), AIDING)
        if self._aiding is not None:
            commands[: len(self._aiding)] = self._aiding
        if heeds:
            self._weaken(commands, sample)
        return commands

    def _weaken(self, commands: np.ndarray, sample: int) -> None:
        """Tell the loops whose bandwidths follow the noise what the monitors ask for."""
        remedy, snap = self._remedy(sample), self.navigator.snapshot
        own = {} if snap is None else dict(zip(snap.names, snap.own_m2))
        for row in () if remedy is None else remedy.rows:
            system, prn = row["system"].decode(), int(row["prn"])
            c, own_m2 = self.channel_of.get((SEARCHED[system], prn)), own.get(f"{system}{prn:02d}", np.nan)
            if c is not None:
                noisier = row["variance_m2"] / own_m2
                commands["weaken"][c] = max(row["weaken"], 1.0) * (noisier if noisier > 1.0 else 1.0)

    def _updates(self, n0: int, n_end: int) -> list[int]:
        """Samples in (n0, n_end] at which the filter updates and commands anew; they divide the time between positions."""
        if not self._steered:
            return []
        rate_hz, update_hz = self.spec.navigation.rate_hz, self.spec.steering.update_hz
        step_s = 1.0 / rate_hz / round(update_hz / rate_hz)
        first, last = (math.floor(n / (step_s * self.fs_hz)) for n in (n0, n_end))
        ends = (round(k * step_s * self.fs_hz) for k in range(first, last + 2))
        return [s for s in ends if n0 < s <= n_end]

    def _steer(self, out: Outcome, sample: int, epochs: np.ndarray, counts: np.ndarray) -> np.ndarray | None:
        """One update of the filter -> AIDING from ``sample`` on; None once it has let go."""
        steering = self.steering
        if steering is None or steering.filter is None:
            return None
        if not self.spec.respond.off or self.flags.names:
            watched = None if self.integrity is None else self.integrity.steered
            steering.heed(self._remedy(sample), {} if watched is None else watched.own_m2())
        self._aiding = steering.advance(
            sample, epochs, counts, self.tracker.channels["state"], self.telemetry.ephemerides
        )
        out.steering.append(steering.record.copy())
        if self.integrity is not None:
            self.integrity.gather(steering)
        if self._steered and self._week is not None and steering.due(SOLUTION_S):
            out.solutions.append(steering.solution(self._week))
            out.holes.append(self.holes.fix(out.solutions[-1][0]))
        if self._steered and steering.due(TAKE_S):
            steering.meet(self.navigator.handover()[2])
            steering.take(self._phase_locked(sample), self.telemetry.ephemerides())
        return self._commands(sample)

    def _hand_over(self, sample: int, out: Outcome) -> None:
        """Let the filter take the channels over from a scalar fix."""
        if self.steering is None or self._steered or not out.solutions:
            return
        row = out.solutions[-1][0]
        self._week = int(row["week"])
        klobuchar = (
            self.navigator.klobuchar(self.telemetry.iono_utc("G")),
            self.navigator.spec.tropo != "none",
        )
        self.steering.try_start(
            sample, row, self.navigator, self._phase_locked(sample), self.telemetry.ephemerides(), klobuchar
        )
        self._aiding = None

    def _phase_locked(self, sample: int) -> list[tuple[int, str, int, float]]:
        replica = self.tracker.snapshot(sample)
        rows = []
        for (signal, prn), c in self.channel_of.items():
            if (
                replica["state"][c] == STATE_LOCKED
                and replica["phase_locked"][c]
                and replica["lock_s"][c] > 0.5
            ):
                rows.append((c, signal, prn, float(replica["cn0_dbhz"][c])))
        return rows

    # -- monitors ---------------------------------------------------------------------------------------------------

    def _watch(self, out: Outcome) -> None:
        """Let every monitor see the windows of taps; what comes back are flags, for the next epoch."""
        out.statistics += self.front.take()
        watches = [m for m in self.monitors if isinstance(m, Watch)]
        channels, heard = self.tracker.channels, []
        for c, epochs, corr in out.epochs if watches else ():
            signal, prn, k = channels["signal"][c].decode(), int(channels["prn"][c]), self.tracker.window(c)
            taps = self._nominal_taps(signal), self.tracker.taps_chips(c)[:k]
            heard.append((signal, prn, epochs, corr[:, :k], taps, self.waveform(signal)))
        for monitor in watches:
            for channel in heard:
                rows = monitor(*channel)
                if len(rows):
                    self.flags.note(monitor, rows)
                    out.statistics.append((monitor.spec.name, rows))

    def _nominal_taps(self, signal: str) -> np.ndarray:
        window = (self.spec.tracking.l1ca if signal == "L1CA" else self.spec.tracking.e1).taps
        assert window is not None
        return window.spacing_chips * (np.arange(window.count) - window.count // 2)

    def waveform(self, signal: str) -> str:
        """Waveform of the replica of a signal."""
        if signal == "L1CA":
            return "BPSK"
        return "BOC11" if self.spec.tracking.e1.replica == "BOC11" else SIGNALS[signal].waveform

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
            if signal == "E1C":
                row |= self._pilot(c, prn)
            rows.append(row)
        return rows

    def _pilot(self, c: int | None, prn: int) -> dict[str, Any]:
        """What Galileo's pilot showed: CS25_1 aligned, and I/NAV sync patterns on E1-B by sign."""
        upright, inverted = self.telemetry.sync_patterns("E1C", prn)
        aligned = c is not None and bool(self.tracker.channels["state"][c] == STATE_LOCKED)
        return {"secondary_code": aligned, "sync_patterns": {"upright": upright, "inverted": inverted}}


def _ranges(prns: list[int]) -> str:
    """Numbers as ranges: 1-5, 7."""
    parts: list[list[int]] = []
    for p in sorted(prns):
        if parts and p == parts[-1][1] + 1:
            parts[-1][1] = p
        else:
            parts.append([p, p])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in parts)
