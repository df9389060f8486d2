"""Monitors on the receiver's live correlator outputs and on its front end: section ``[[receiver.monitor]]``.

Each locked channel is trained on its own first seconds and then watched. Correlator outputs reach a monitor as
means over 20 ms (L1CA) or 100 ms (E1) with the data signs wiped. Nothing flows back into the receiver but ``Flags``.
When lock is lost an alarm that stands is held until tests go on: interference that kills a channel does not end in
silence. ``sdr.watch.null`` says where the thresholds come from, ``sdr.watch.front`` what the gain and the samples' levels show.
"""

import math
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from monitors import detectors
from monitors.baselines import AdcHistogram, AgcGain
from monitors.glrt import GlrtMonitor
from monitors.multichannel_ar import MultichannelAr
from nav.navlog import REMEDY, Remedy
from sdr.watch.front import FrontWatch
from sdr.watch.null import null_of, one_blas_thread
from sdr.watch.post import MONITOR, Post, joined
from signals.multipath import MultipathSpec
from tracking.channel import STATE_LOCKED

if TYPE_CHECKING:
    Detector = Any
else:
    Detector = Annotated[Union[detectors()], Field(discriminator="kind")]  # noqa: UP007
EPOCH_S = {"L1CA": 0.02, "E1B": 0.1, "E1C": 0.1}
"""Length of a monitor's epoch; the AR model needs more vectors than 100 ms give and takes 20 ms of E1 too."""
RESETTLE_S = 0.5
"""After a loss of lock a monitor goes on this much after lock is back."""
LOST_S = 0.5
"""A channel that gave no integration for so long at the end of a run was lost."""


class WatchSpec(BaseModel):
    """One monitor on the live channels."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    name: str = Field(min_length=1, max_length=16, pattern=r"^[A-Za-z0-9_-]+$")
    """Name in the results."""
    detector: Detector
    signals: tuple[Literal["L1CA", "E1B", "E1C"], ...] = ("L1CA", "E1B", "E1C")
    """Channels that are watched."""
    p_fa: float = Field(1.6e-5, gt=0, lt=0.5)
    """False-alarm probability that sets the threshold."""
    p_fa_per: Literal["epoch", "approach"] = "epoch"
    """Whether it is meant per epoch or per approach."""
    approach_s: float = Field(150.0, gt=0)
    """Length of an approach."""
    channels: int = Field(8, ge=1, le=100)
    """Channels tested in parallel, for the P_FA per approach."""
    threshold: float | None = None
    """Threshold given outright, instead of by ``p_fa``."""
    expect_multipath: MultipathSpec | None = None
    """Echoes that must not alarm, of all satellites; not needed for the GLRT, which is blind to them."""
    noise_rise_db: float = Field(0.3, ge=0, le=10)
    """Rise of the correlators' noise that must not alarm (GLRT, AR, noise floor, C/N0): other satellites' codes that come
    into step."""
    settle_s: float = Field(3.0, ge=0, le=3600)
    """Time from lock to training."""
    training_s: float = Field(20.0, ge=0.1, le=3600)
    """Seconds of each channel that train its monitor."""
    batch_s: float = Field(1.0, ge=0.02, le=10)
    """Statistics are computed this often: a call costs more than an epoch, and an answer cannot come sooner."""
    gap_s: float = Field(1.0, ge=0)
    """Exceedances closer than this are one alarm."""

    @property
    def of_front_end(self) -> bool:
        """Whether it watches the front end, not the channels."""
        return isinstance(self.detector, AgcGain | AdcHistogram)

    def start(self, fs_hz: float) -> "Watch | FrontWatch":
        """-> Watch of the channels, or FrontWatch of the samples."""
        return FrontWatch(self, fs_hz) if self.of_front_end else Watch(self, fs_hz)


class Watch:
    """Run of a WatchSpec on the channels: every channel's monitor, its training and its statistics."""

    def __init__(self, spec: WatchSpec, fs_hz: float) -> None:
        self.spec, self.fs_hz = spec, fs_hz
        self.channels: dict[tuple[str, int], _Channel] = {}

    def __call__(
        self, signal: str, prn: int, epochs: np.ndarray, corr: np.ndarray, taps: tuple, waveform: str | None
    ) -> np.ndarray:
        """MONITOR rows that one channel's new integrations complete.

        Parameters: ``epochs`` EPOCH (n,), ``corr`` complex64 (n, K) of the window, ``taps`` its nominal and true
        offsets in chips, float64 (K,) each.
        """
        if signal not in self.spec.signals:
            return np.empty(0, MONITOR)
        key = signal, prn
        if key not in self.channels:
            self.channels[key] = _Channel(self.spec, self.fs_hz, signal, prn, taps, waveform)
        return self.channels[key].advance(epochs, corr)

    @property
    def posts(self) -> list[Post]:
        """The monitor of each channel."""
        return [c.post for c in self.channels.values()]

    def report(self, quiet_until_s: float) -> list[dict[str, Any]]:
        """Rows for JSON, one per channel; one that says why if there was none to watch."""
        if not self.channels:
            why = "there was no channel to watch: nothing with a window of taps was tracked"
            return [{"name": self.spec.name, "signal": "", "prn": 0, "threshold": None, "p_fa": self.spec.p_fa,
                     "tests": 0, "alarms": [], "unavailable": why}]  # fmt: skip
        return [post.report(quiet_until_s) for post in self.posts]

    def flush(self, sample: int) -> list[np.ndarray]:
        """MONITOR rows of what still waits for a batch when the run ends at ``sample``."""
        return [c.finish(sample) for c in self.channels.values()]


class Flags:
    """Satellites that the alarms of ``names`` weaken by ``factor``, each until ``hold_s`` after its last exceedance."""

    def __init__(self, names: tuple[str, ...], factor: float, hold_s: float, fs_hz: float) -> None:
        self.names, self.factor, self.hold = names, factor, round(hold_s * fs_hz)
        self._until: dict[tuple[bytes, int], int] = {}

    def note(self, watch: Watch, rows: np.ndarray) -> None:
        """Look at the MONITOR rows that a monitor just gave."""
        if watch.spec.name not in self.names:
            return
        for row in rows:
            threshold = watch.channels[row["signal"].decode(), int(row["prn"])].threshold
            if threshold is not None and row["value"] >= threshold:
                key = (b"G" if row["signal"] == b"L1CA" else b"E"), int(row["prn"])
                self._until[key] = int(row["sample_index"]) + self.hold

    def join(self, remedy: Remedy | None, sample: int) -> Remedy | None:
        """What the integrity monitors ask for, and what is flagged at ``sample`` on top."""
        flagged = [key for key, until in sorted(self._until.items()) if sample <= until]
        if not flagged:
            return remedy
        rows = np.zeros(0, REMEDY) if remedy is None else remedy.rows.copy()
        at = Remedy(rows).find([s for s, _ in flagged], [n for _, n in flagged])
        rows["weaken"][at[at >= 0]] = self.factor
        new = np.zeros(int(np.sum(at < 0)), REMEDY)
        for row, (system, prn) in zip(new, [key for key, i in zip(flagged, at) if i < 0]):
            row["system"], row["prn"], row["variance_m2"], row["weaken"] = system, prn, np.nan, self.factor
        rows = np.concatenate([rows, new])
        return Remedy(rows) if remedy is None else remedy._replace(rows=rows)


class _Channel:
    """A channel's integrations, cut into stretches of lock and summed to epochs, on their way to its monitor."""

    def __init__(
        self, spec: WatchSpec, fs_hz: float, signal: str, prn: int, taps: tuple, waveform: str | None
    ) -> None:
        self.spec, self.fs_hz, self.signal, self.prn, self.waveform = spec, fs_hz, signal, prn, waveform
        self.epoch_s = 0.02 if isinstance(spec.detector, MultichannelAr) else EPOCH_S[signal]
        # The GLRT knows the true offsets; the others want an even spacing, from which these differ by 1/128 sample.
        self.taps = taps[1] if isinstance(spec.detector, GlrtMonitor) else taps[0]
        run: Any = spec.detector.start(self.taps, self.epoch_s, signal, prn, waveform)
        hop = getattr(run, "hop", 0) or getattr(run, "length", 0)
        test_s = self.epoch_s * (hop or getattr(spec.detector, "accumulate_epochs", 1))
        self.post = Post(spec, fs_hz, run, self.epoch_s, test_s, self._null, signal, prn)
        self.prompt = int(np.argmin(np.abs(self.taps)))
        self._cn0: list[float] = []
        self._heard: list[tuple[np.ndarray, np.ndarray]] = []
        self._heard_n = 0  # samples that wait, about
        self._due = (spec.batch_s - 0.5 * self.epoch_s) * fs_hz
        self._settled: float = math.nan  # sample from which it counts
        self._next = -1
        self._lost: int | None = None  # end of the last stretch
        self._drop()

    @property
    def threshold(self) -> float | None:
        """Of the monitor; None during training."""
        return self.post.threshold

    @property
    def run(self) -> Any:
        """The monitor."""
        return self.post.run

    def _null(self, corr: np.ndarray) -> Any:
        self.cn0_dbhz = float(np.mean(self._cn0))
        return null_of(self, corr)

    def advance(self, epochs: np.ndarray, corr: np.ndarray) -> np.ndarray:
        """Take in integrations; every ``batch_s`` they are worked on, for a call costs more than an epoch."""
        self._heard.append((epochs, corr))
        self._heard_n += len(epochs) * int(epochs["n_samples"][0])
        return self._work() if self._heard_n >= self._due else np.empty(0, MONITOR)

    def finish(self, sample: int) -> np.ndarray:
        """MONITOR rows of what waits; a channel that is not locked at the end has been so since it was lost."""
        rows = [self._work(), self._batch()]
        if self._next >= 0 and sample - self._next > LOST_S * self.fs_hz:
            self._lose()
        if self._lost is not None:
            self.post.rest(self._lost / self.fs_hz, sample / self.fs_hz)
        return joined(rows)

    def _work(self) -> np.ndarray:
        if not self._heard:
            return np.empty(0, MONITOR)
        # Column by column: numpy takes long over joining rows.
        index, n, state, cn0 = (
            np.concatenate([e[name] for e, _ in self._heard])
            for name in ("sample_index", "n_samples", "state", "cn0_dbhz")
        )
        corr = np.concatenate([c for _, c in self._heard])
        self._heard, self._heard_n = [], 0
        index = index.astype(np.int64)
        ends = index + n
        cut = np.flatnonzero((index[1:] != ends[:-1]) | (state[1:] != state[:-1])) + 1
        out: list[np.ndarray] = []
        with one_blas_thread():
            for a, b in pairwise([0, *cut.tolist(), len(index)]):
                part = slice(a, b)
                out += self._stretch(state[a] == STATE_LOCKED, index[part], ends[part], cn0[part], corr[part])
        return joined(out)

    def _stretch(
        self, locked: bool, index: np.ndarray, ends: np.ndarray, cn0: np.ndarray, corr: np.ndarray
    ) -> list[np.ndarray]:
        """MONITOR rows of consecutive integrations in one state."""
        out, first = [], int(index[0])
        if first != self._next or not locked:
            out.append(self._lose())
        if not locked:
            return out
        self._next = int(ends[-1])
        self.post.seen_s += (self._next - first) / self.fs_hz
        self._resume(first)
        settled = int(np.searchsorted(index, self._settled))
        if self.threshold is None:
            self._cn0 += cn0[settled:].tolist()
        self._take(ends[settled:], ends[-1] - index[-1], corr[settled:])
        # Always the same batches, however the samples were cut into slabs.
        n = max(1, round(self.spec.batch_s / self.epoch_s))
        while sum(map(len, self._waiting)) >= n:
            out.append(self._batch(n))
        return out

    def _lose(self) -> np.ndarray:
        """Lock ends: test what is whole, drop the rest."""
        if self._next < 0:
            return np.empty(0, MONITOR)
        rows = self._batch()
        self._lost, self._next = self._next, -1
        self._drop()
        return rows

    def _resume(self, sample: int) -> None:
        """Lock is back at ``sample``, or the run ends there: what was not watched ends."""
        if math.isnan(self._settled):
            self._settled = sample + self.spec.settle_s * self.fs_hz
        elif self._lost is not None:
            self._settled = max(self._settled, sample + RESETTLE_S * self.fs_hz)
            self.post.rest(self._lost / self.fs_hz, self._settled / self.fs_hz)
        self._lost = None

    def _drop(self) -> None:
        self._dumps = np.empty((0, len(self.taps)), np.complex64)
        self._dump_ends = np.empty(0, np.int64)
        self._waiting: list[np.ndarray] = []
        self._ends: list[np.ndarray] = []

    def _take(self, ends: np.ndarray, n_samples: int, corr: np.ndarray) -> None:
        """Sum integrations to monitor epochs, their signs wiped by the prompt's."""
        dumps = max(1, round(self.epoch_s * self.fs_hz / float(n_samples)))
        if dumps > 1:
            corr = corr * np.where(corr[:, self.prompt].real < 0, -1, 1).astype(np.float32)[:, None]
            corr, ends = np.concatenate([self._dumps, corr]), np.concatenate([self._dump_ends, ends])
            m = len(corr) // dumps * dumps
            self._dumps, self._dump_ends = corr[m:], ends[m:]
            corr = corr[:m].reshape(-1, dumps, corr.shape[1]).mean(axis=1)
            ends = ends[dumps - 1 : m : dumps]
        if len(corr):
            self._waiting.append(corr)
            self._ends.append(ends)

    def _batch(self, n: int | None = None) -> np.ndarray:
        """Hand the first ``n`` (all) of what has come together to the monitor -> MONITOR rows."""
        if not self._waiting:
            return np.empty(0, MONITOR)
        corr, ends = np.concatenate(self._waiting), np.concatenate(self._ends)
        n = len(corr) if n is None else n
        self._waiting, self._ends = ([corr[n:]], [ends[n:]]) if n < len(corr) else ([], [])
        return self.post.take(corr[:n], ends[:n]) if len(corr) else np.empty(0, MONITOR)
