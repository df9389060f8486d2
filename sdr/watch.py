"""Monitors on the receiver's live correlator outputs: section ``[[receiver.monitor]]``.

Each locked channel is trained on its own first seconds and then watched. Correlator outputs reach a monitor as
means over 20 ms (L1CA) or 100 ms (E1) with the data signs wiped; nothing flows back into the receiver.

Thresholds at a P_FA without a million quiet live epochs. The GLRT's comes from its analytic null. For the FFT and
the AR monitor the twin lives through the same training many times, at the channel's own C/N0 and under the echoes
that are to be expected: what it then shows in quiet, a short training's errors included, is the null. The others'
training holds a few windows only: Student's t.
"""

import math
from functools import lru_cache
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from monitors.baselines import Cn0Drop, NoiseFloor, SignalQuality
from monitors.fft import FftMonitor
from monitors.glrt import GlrtMonitor
from monitors.multichannel_ar import MultichannelAr
from monitors.records import STATISTIC, alarms
from monitors.threshold import ParetoNull, per_epoch
from nav.navlog import REMEDY, Remedy
from signals.multipath import MultipathSpec
from tracking.channel import STATE_LOCKED
from tracking.correlator_model import Twin

Detector = Annotated[
    FftMonitor | GlrtMonitor | MultichannelAr | Cn0Drop | NoiseFloor | SignalQuality,
    Field(discriminator="kind"),
]
EPOCH_S = {"L1CA": 0.02, "E1B": 0.1, "E1C": 0.1}
"""Length of a monitor's epoch; the AR model needs more vectors than 100 ms give and takes 20 ms of E1 too."""
NULL_EPOCHS = 102_400
"""Quiet epochs of the twin behind a threshold of the FFT or AR monitor."""
MONITOR = np.dtype([("signal", "S4"), ("prn", "i4"), *((n, STATISTIC[n]) for n in STATISTIC.names or ())])
"""STATISTIC of one channel; ``t_s`` is scenario time at the end of its last epoch."""
WATCHED = np.dtype(
    [
        ("monitor", "S16"),
        ("signal", "S4"),
        ("prn", "i4"),
        ("threshold", "f8"),
        ("p_fa", "f8"),  # per test
        ("trained_s", "f8"),  # scenario time from which it tests
        ("tests", "i8"),
    ]
)
"""One monitor on one channel."""


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
    channels: int = Field(8, ge=1, le=100)  # tested in parallel, for p_fa_per = "approach"
    threshold: float | None = None  # given outright
    expect_multipath: MultipathSpec | None = None  # echoes that must not alarm
    settle_s: float = Field(3.0, ge=0)  # after lock, before training
    training_s: float = Field(20.0, gt=1, le=3600)
    """Seconds of each channel that train its monitor."""
    batch_s: float = Field(1.0, ge=0.02, le=10)
    """Statistics are computed this often: a call costs more than an epoch, and an answer cannot come sooner."""
    gap_s: float = Field(1.0, ge=0)  # exceedances closer than this are one alarm

    def start(self, fs_hz: float) -> "Watch":
        """-> Watch."""
        return Watch(self, fs_hz)


class Watch:
    """Run of a WatchSpec: every channel's monitor, its training and its statistics."""

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

    def flush(self) -> list[np.ndarray]:
        """MONITOR rows of what still waits for a batch."""
        return [c.batch() for c in self.channels.values()]

    def watched(self) -> np.ndarray:
        """WATCHED rows of the channels whose training is complete."""
        ready = [c for c in self.channels.values() if c.threshold is not None]
        return np.array([c.row() for c in ready], WATCHED)

    def alarms(self) -> dict[tuple[str, int], np.ndarray]:
        """{(signal, prn): ALARM rows} so far, of the channels whose training is complete."""
        return {k: c.alarms() for k, c in self.channels.items() if c.threshold is not None}


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
    def __init__(
        self, spec: WatchSpec, fs_hz: float, signal: str, prn: int, taps: tuple, waveform: str | None
    ) -> None:
        self.spec, self.fs_hz, self.signal, self.prn, self.waveform = spec, fs_hz, signal, prn, waveform
        self.epoch_s = 0.02 if isinstance(spec.detector, MultichannelAr) else EPOCH_S[signal]
        # The GLRT knows the true offsets; the others want an even spacing, from which these differ by 1/128 sample.
        self.taps = taps[1] if isinstance(spec.detector, GlrtMonitor) else taps[0]
        self.run = spec.detector.start(self.taps, self.epoch_s, signal, prn, waveform)
        self.prompt = int(np.argmin(np.abs(self.taps)))
        self.threshold: float | None = None
        self.trained_s = math.nan
        self.tests = 0
        self._above: list[np.ndarray] = []
        self._cn0: list[float] = []
        self._quiet: list[np.ndarray] = []
        self._locked_at: int | None = None
        self._next = -1
        self._restart()

    def _restart(self) -> None:
        self._dumps = np.empty((0, len(self.taps)), np.complex64)
        self._dump_ends = np.empty(0, np.int64)
        self._waiting: list[np.ndarray] = []
        self._ends: list[np.ndarray] = []
        if self.threshold is not None:
            self.run = self.run.fresh()

    def advance(self, epochs: np.ndarray, corr: np.ndarray) -> np.ndarray:
        out = []
        for part in _stretches(epochs):
            e = epochs[part]
            if int(e["sample_index"][0]) != self._next:
                out.append(self.batch())
                self._restart()
            self._next = int(e["sample_index"][-1]) + int(e["n_samples"][-1])
            if e["state"][0] != STATE_LOCKED:
                self._next = -1
                continue
            if self._locked_at is None:
                self._locked_at = int(e["sample_index"][0])
            settled = e["sample_index"] >= self._locked_at + self.spec.settle_s * self.fs_hz
            self._cn0 += e["cn0_dbhz"][settled].tolist() if self.threshold is None else []
            self._take(e[settled], corr[part][settled])
            # Always the same batches, however the samples were cut into slabs.
            n = max(1, round(self.spec.batch_s / self.epoch_s))
            while sum(map(len, self._waiting)) >= n:
                out.append(self.batch(n))
        return np.concatenate(out) if out else np.empty(0, MONITOR)

    def _take(self, epochs: np.ndarray, corr: np.ndarray) -> None:
        """Sum integrations to monitor epochs, their signs wiped by the prompt's."""
        if not len(epochs):
            return
        ends = epochs["sample_index"].astype(np.int64) + epochs["n_samples"]
        dumps = max(1, round(self.epoch_s * self.fs_hz / float(epochs["n_samples"][0])))
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

    def batch(self, n: int | None = None) -> np.ndarray:
        """Train on, or test, the first ``n`` (all) of what has come together -> MONITOR rows."""
        if not self._waiting:
            return np.empty(0, MONITOR)
        corr, ends = np.concatenate(self._waiting), np.concatenate(self._ends)
        n = len(corr) if n is None else n
        self._waiting, self._ends = [corr[n:]], [ends[n:]]
        corr, ends = corr[:n], ends[:n]
        if not len(corr):
            return np.empty(0, MONITOR)
        if self.threshold is None:
            self._quiet.append(corr)
            if sum(map(len, self._quiet)) * self.epoch_s >= self.spec.training_s:
                self._train(np.concatenate(self._quiet))
                self.trained_s = float(ends[-1]) / self.fs_hz
            return np.empty(0, MONITOR)
        with one_blas_thread():
            s = self.run(corr, ends)
        s["t_s"] = s["sample_index"] / self.fs_hz
        self.tests += len(s)
        self._note(s)
        rows = np.empty(len(s), MONITOR)
        rows["signal"], rows["prn"] = self.signal.encode(), self.prn
        for name in STATISTIC.names or ():
            rows[name] = s[name]
        return rows

    def _note(self, s: np.ndarray) -> None:
        """Keep what alarms are made of: values at or above the threshold."""
        above = s[s["value"] >= self.threshold]
        if len(above):
            self._above.append(above)

    def alarms(self) -> np.ndarray:
        """ALARM rows so far."""
        above = np.concatenate(self._above) if self._above else np.zeros(0, STATISTIC)
        if not len(above):
            return alarms(above, self.threshold, self.spec.name, self.signal, self.prn)
        # Exceedances further apart than the gap are parted by a value below, so that they are alarms of their own.
        cut = np.flatnonzero(np.diff(above["t_s"]) > max(self.spec.gap_s, 1.5 * self.epoch_s)) + 1
        parts = np.split(above, cut)
        return np.concatenate(
            [alarms(p, self.threshold, self.spec.name, self.signal, self.prn) for p in parts]
        )

    def row(self) -> tuple:
        return (
            self.spec.name.encode(), self.signal.encode(), self.prn, self.threshold, self.p_fa, self.trained_s, self.tests,
        )  # fmt: skip

    # -- training ---------------------------------------------------------------------------------------------------

    @property
    def p_fa(self) -> float:
        """Per test."""
        if self.spec.p_fa_per == "epoch":
            return self.spec.p_fa
        return per_epoch(self.spec.p_fa, self._test_s(), self.spec.channels, self.spec.approach_s)

    def _test_s(self) -> float:
        """Time between tests."""
        hop = getattr(self.run, "hop", 0) or getattr(self.run, "length", 0)
        return self.epoch_s * (hop or getattr(self.spec.detector, "accumulate_epochs", 1))

    def _train(self, corr: np.ndarray) -> None:
        self._quiet = []
        detector = self.spec.detector
        with one_blas_thread():
            self.run.train(corr)
        if self.spec.threshold is not None:
            self.threshold = self.spec.threshold
        elif isinstance(detector, GlrtMonitor):
            n_eff = _effective_bins(detector, tuple(self.taps), self.epoch_s, self.signal, self.prn)
            self.threshold = self.run.threshold(self.p_fa, n_eff)
        elif isinstance(detector, FftMonitor | MultichannelAr):
            self.threshold = self._rehearsed(len(corr)).isf(self.p_fa)
        else:
            self.threshold = self._student_threshold(len(corr))
        self.run = self.run.fresh()

    def _rehearsed(self, n_train: int) -> ParetoNull:
        cn0 = min(max(round(float(np.mean(self._cn0))), 20), 70)
        # Sampled at whole numbers of epochs, so that channels share what they can.
        n_train = -(-n_train // 50) * 50
        return _rehearse(
            self.spec.detector, tuple(self.taps), self.epoch_s, self.signal, self.prn, self.waveform, cn0, n_train,
            self.spec.expect_multipath,
        )  # fmt: skip

    def _student_threshold(self, n_epochs: int) -> float:
        from scipy.stats import t

        n = n_epochs // self.run.length
        if n < 5:
            raise ValueError(
                f"monitor '{self.spec.name}': {n} training windows are too few for a threshold; lengthen training_s "
                "or shorten window_s"
            )
        two = 2 if self.spec.detector.kind == "SQM" else 1
        return float(t.isf(self.p_fa / two, n - 1)) * math.sqrt(1 + 1 / n)


@lru_cache(maxsize=1)
def _blas() -> Any:
    import scipy.linalg  # noqa: F401  (brings a BLAS of its own, which must be loaded to be limited)
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def one_blas_thread() -> Any:
    """Context in which one BLAS thread works: on small matrices several are slower, and change the last bit."""
    return _blas().limit(limits=1, user_api="blas")


def _stretches(epochs: np.ndarray) -> list[slice]:
    """Slices of consecutive integrations in one state."""
    if not len(epochs):
        return []
    follows = epochs["sample_index"][1:] == epochs["sample_index"][:-1] + epochs["n_samples"][:-1].astype(
        np.uint64
    )
    cut = np.flatnonzero(~follows | (np.diff(epochs["state"].astype(int)) != 0)) + 1
    edges = [0, *cut.tolist(), len(epochs)]
    return [slice(a, b) for a, b in pairwise(edges)]


@lru_cache(maxsize=64)
def _effective_bins(detector: Any, taps: tuple, epoch_s: float, signal: str, prn: int) -> float:
    run = detector.start(np.array(taps), epoch_s, signal, prn, None)
    run.noise_variance = 1.0
    return run.effective_bins(100_000)


@lru_cache(maxsize=64)
def _rehearse(
    detector: Any, taps: tuple, epoch_s: float, signal: str, prn: int, waveform: str | None, cn0_dbhz: float,
    n_train: int, multipath: Any,
) -> ParetoNull:  # fmt: skip
    """Null of a statistic after a training of ``n_train`` epochs: many quiet twins, each trained and then tested."""
    twin = Twin(
        signal=signal, prn=prn, waveform=waveform, cn0_dbhz=cn0_dbhz, integration_s=epoch_s, taps_chips=taps,
        multipath=multipath,
    )  # fmt: skip
    n_test = max(1024, n_train)
    out = []
    with one_blas_thread():
        for trial in range(-(-NULL_EPOCHS // n_test)):
            corr = twin.start_open(np.random.SeedSequence(0, spawn_key=(prn, trial)))(n_train + n_test)
            run = detector.start(np.array(taps), epoch_s, signal, prn, waveform)
            run.train(corr[:n_train])
            out.append(_every_value(run, corr[n_train:]))
    return ParetoNull.fit(np.concatenate(out))


def _every_value(run: Any, corr: np.ndarray) -> np.ndarray:
    """Statistic at every epoch; of the AR monitor for every window, whatever its hop."""
    if not isinstance(run.spec, MultichannelAr):
        return run(corr)["value"]
    if run.spec.form == "refit":
        return run(corr)["value"]
    total = np.concatenate([[0.0], np.cumsum(run.energies(run._prepare(corr)))])
    return np.log((total[run.window :] - total[: -run.window]) / run.window)
