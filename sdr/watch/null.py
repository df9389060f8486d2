"""Thresholds of the live monitors: null models of statistics that a training of seconds has standardised.

A P_FA of 1e-5 needs a million quiet epochs, a channel has twenty quiet seconds. The GLRT's null is analytic. For
monitors without ``values`` (FFT, AR), and for every other one on the channels that is told which echoes to expect, the twin
*rehearses*: it lives through the same training many times over, each time with another satellite, at the channel's own
C/N0 and under those echoes; what it shows afterwards, the errors of a short training included, is the null. Its seeds
are no scenario's. Without echoes the others take the tail that theory gives to the few windows of their training:
Student's t, Fisher's F.

Fades of 0.1 Hz leave two or three independent values in twenty seconds. A standard deviation of so few has the tail of
Student's t: one channel in twenty would get a threshold far too low. So what the rehearsals spread by on average is the
least that a statistic is standardised by (``least_spread``); the training finds the level, and can only widen it.
"""

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from monitors.baselines import Cn0Drop, NoiseFloor, SignalQuality
from monitors.glrt import GlrtMonitor
from monitors.multichannel_ar import MultichannelAr
from monitors.short_training import StudentNull
from monitors.threshold import ParetoNull
from tracking.correlator_model import Twin

REHEARSALS, REHEARSALS_AR = 240, 120
"""Trainings that the twin goes through for one threshold; the AR model costs most and standardises nothing."""
TEST_S = 100.0
"""Quiet time after each training: a fade has to come and go, and an aircraft to sink until the echoes have changed."""
TAIL, TAIL_AR = 0.01, 0.05
"""Share of the rehearsed values that the tail is fitted to, or more where a fit needs it; the AR model's windows overlap."""
WINDOW_STEPS = 5
"""Steps that a window of the AR monitor is moved by its own length in; windows further apart count as independent."""
CN0_STEP_DB = 2
"""Rehearsals are shared between channels of about the same C/N0."""
PRNS = (1, 8, 20, 27)
"""Satellites that take turns: the side lobes of the code differ."""
SEED = 0x72656865
"""Spawn key of the rehearsals' random numbers, which no scenario has."""


def null_of(channel: Any, corr: np.ndarray) -> Any:
    """Null model of a trained monitor: ``isf(p_fa)`` is its threshold, ``rule`` says where that comes from.

    ``channel``: its ``spec``, ``run``, ``taps``, ``epoch_s``, ``signal``, ``prn``, ``waveform``, ``cn0_dbhz``; ``corr``
    complex64 (n, K), the epochs it was trained on.
    """
    detector = channel.spec.detector
    rise = 10 ** (channel.spec.noise_rise_db / 10)
    if isinstance(detector, GlrtMonitor):
        bins = _effective_bins(detector, tuple(channel.taps), channel.epoch_s, channel.signal, channel.prn)
        return GlrtNull(channel.run, bins, rise)
    if channel.spec.expect_multipath is not None or not hasattr(channel.run, "values"):
        return _rehearsed(channel, len(corr))
    if isinstance(detector, SignalQuality):
        return StudentNull.fit(channel.run.values(corr), two_sided=True)
    return StudentNull.fit(channel.run.values(corr), rise=channel.spec.noise_rise_db)


def _rehearsed(channel: Any, n_train: int) -> "RehearsedNull":
    """Null of rehearsals; tells the run the spread that they had."""
    spec, run = channel.spec, channel.run
    detector = spec.detector
    cn0 = min(max(CN0_STEP_DB * round(channel.cn0_dbhz / CN0_STEP_DB), 20), 70)
    n_train = -(-n_train // 50) * 50  # so that channels share what they can
    tail, least_spread = _rehearse(
        detector, tuple(channel.taps), channel.epoch_s, channel.signal, channel.waveform, cn0, n_train,
        spec.expect_multipath,
    )  # fmt: skip
    if isinstance(detector, MultichannelAr):
        return RehearsedNull(tail, 0.1 * math.log(10) * spec.noise_rise_db)
    run.least_spread = least_spread
    in_db = isinstance(detector, Cn0Drop | NoiseFloor)
    return RehearsedNull(tail, spec.noise_rise_db / max(run.spread, least_spread) if in_db else 0.0)


@dataclass(frozen=True)
class GlrtNull:
    """The GLRT's own, ``GlrtRun.threshold``, times the rise of the noise that is allowed for."""

    run: Any
    bins: float
    rise: float
    rule: str = "analytic"

    def isf(self, p_fa: float) -> float:
        """Threshold."""
        return self.run.threshold(p_fa, self.bins) * self.rise


@dataclass(frozen=True)
class RehearsedNull:
    """A Pareto tail as far as the rehearsals reach (1 / n_effective), an exponential one of its mean excess beyond.

    The tail of every statistic here is shorter than that: what is extrapolated is on the safe side.
    """

    tail: ParetoNull
    shift: float = 0.0
    """Of the statistic, for the rise of the noise that is allowed for."""
    rule: str = "rehearsed"

    def isf(self, p_fa: float) -> float:
        """Threshold."""
        reach = 1.0 / self.tail.n_effective
        if p_fa >= reach:
            return self.tail.isf(p_fa) + self.shift
        mean_excess = self.tail.sigma / (1 - self.tail.xi)
        return self.tail.isf(reach) + mean_excess * math.log(reach / p_fa) + self.shift


@lru_cache(maxsize=64)
def _effective_bins(detector: Any, taps: tuple, epoch_s: float, signal: str, prn: int) -> float:
    run = detector.start(np.array(taps), epoch_s, signal, prn, None)
    run.noise_variance = 1.0
    with one_blas_thread():
        return run.effective_bins(100_000)


@lru_cache(maxsize=64)
def _rehearse(
    detector: Any, taps: tuple, epoch_s: float, signal: str, waveform: str | None, cn0_dbhz: float, n_train: int,
    multipath: Any,
) -> tuple[ParetoNull, float]:  # fmt: skip
    """Null of a statistic after a training of ``n_train`` epochs, and the spread that standardised it at least.

    Many quiet twins, each trained and then tested.
    """
    overlap, rehearsals, tail, is_ar = 1.0, REHEARSALS, TAIL, isinstance(detector, MultichannelAr)
    if is_ar:
        overlap, rehearsals, tail = 1 / WINDOW_STEPS, REHEARSALS_AR, TAIL_AR
        detector = detector.model_copy(update={"hop_s": detector.window_s * overlap})
    n_test = max(round(TEST_S / epoch_s), n_train)
    values, spreads = [], []
    with one_blas_thread():
        for trial in range(rehearsals):
            prn = PRNS[trial % len(PRNS)]
            twin = Twin(
                signal=signal, prn=prn, waveform=waveform, cn0_dbhz=cn0_dbhz, integration_s=epoch_s,
                taps_chips=taps, multipath=multipath,
            )  # fmt: skip
            corr = twin.start_open(np.random.SeedSequence(0, spawn_key=(SEED, trial)))(n_train + n_test)
            run = detector.start(np.array(taps), epoch_s, signal, prn, waveform)
            run.train(corr[:n_train])
            values.append(run(corr[n_train:])["value"])
            spreads.append(getattr(run, "spread", 1.0))
    least_spread = 0.0
    if not is_ar:
        least_spread = math.sqrt(np.mean([np.mean(v**2) * s**2 for v, s in zip(values, spreads)]))
        values = [v * (s / max(s, least_spread)) for v, s in zip(values, spreads)]
    pooled = np.concatenate(values)
    tail = max(tail, min(0.1, 220 / len(pooled)))
    return ParetoNull.fit(pooled, tail, n_effective=overlap * len(pooled)), least_spread


@lru_cache(maxsize=1)
def _blas() -> list[Any]:
    import scipy.linalg  # noqa: F401  (brings a BLAS of its own, which must be loaded to be limited)
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().select(user_api="blas").lib_controllers


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """Context in which one BLAS thread works: on small matrices several are slower, and change the last bit.

    What ``threadpoolctl.limit`` does, without its account of every library, which takes longer than a batch.
    """
    before = [(lib, lib.get_num_threads()) for lib in _blas()]
    changed = [(lib, n) for lib, n in before if n != 1]
    for lib, _ in changed:
        lib.set_num_threads(1)
    try:
        yield
    finally:
        for lib, n in changed:
            lib.set_num_threads(n)
