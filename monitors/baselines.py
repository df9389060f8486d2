"""The monitors every receiver has: C/N0, noise floor, AGC gain, ADC histogram, signal-quality metrics.

All standardise their quantity by its training, (x - mean) / std, signed so that interference raises it,
except the histogram's chi-square.
"""

import copy
import math
from typing import Any, Literal

import numpy as np
from numba import njit
from pydantic import BaseModel, ConfigDict, Field

from monitors.records import checked_corr, statistics

__all__ = ["AdcHistogram", "AgcGain", "Cn0Drop", "NoiseFloor", "SignalQuality", "count_levels"]


@njit(cache=True, nogil=True)
def count_levels(x, counts):
    """Add the int8 samples ``x`` to ``counts`` int64 (256,), level -128 first."""
    for k in range(x.shape[0]):
        counts[np.int64(x[k]) + 128] += 1


class _Spec(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class _Moments:
    """Mean and standard deviation of a trained scalar; merges calls."""

    def __init__(self, name):
        self.name, self.count, self.mean, self._m2 = name, 0, 0.0, 0.0
        self.least_spread = 0.0

    @property
    def spread(self):
        """Standard deviation in training."""
        return math.sqrt(self._m2 / (self.count - 1)) if self.count > 1 else math.nan

    def add(self, x):
        x = np.asarray(x, float)
        if len(x) == 0:
            return
        total, delta = self.count + len(x), x.mean() - self.mean
        self._m2 += ((x - x.mean()) ** 2).sum() + delta**2 * self.count * len(x) / total
        self.mean += delta * len(x) / total
        self.count = total

    def standardise(self, x):
        if self.count < 2:
            raise ValueError(f"the {self.name} monitor is not trained: call train with quiet data first")
        return (x - self.mean) / max(self.spread, self.least_spread)


class _Restart:
    """``fresh``: a copy that keeps the training and begins at epoch 0."""

    epoch: int
    _rest: np.ndarray

    def fresh(self):
        """A copy that keeps the training and begins at epoch 0."""
        run = copy.copy(self)
        run.epoch = 0
        run._rest = np.zeros((0, getattr(self, "n_taps", 0)), np.complex64)
        return run


class _WindowRun(_Restart):
    """A scalar of each window of ``length`` epochs, standardised; windows do not overlap."""

    def __init__(self, name, quantity, n_taps, length, integration_s):
        self.quantity, self.n_taps, self.length = quantity, n_taps, max(1, length)
        self.integration_s = integration_s
        self.moments = _Moments(name)
        self.epoch = 0
        self._rest = np.zeros((0, n_taps), np.complex64)

    @property
    def spread(self):
        """Standard deviation of the quantity in training, in its own unit."""
        return self.moments.spread

    @property
    def least_spread(self):
        """Least standard deviation that standardises: a short training may have met too few fades."""
        return self.moments.least_spread

    @least_spread.setter
    def least_spread(self, value):
        self.moments.least_spread = value

    def values(self, corr):
        """Quantity of each whole window of complex64 (n, K), float64."""
        m = len(corr) // self.length
        return self.quantity(corr[: m * self.length].reshape(m, self.length, self.n_taps))

    def train(self, corr):
        """Add quiet epochs, complex64 (n, K)."""
        self.moments.add(self.values(checked_corr(corr, self.n_taps)))

    def __call__(self, corr, sample_index=None):
        """STATISTIC, one per whole window; ``corr`` complex64 (n, K)."""
        corr = np.concatenate([self._rest, checked_corr(corr, self.n_taps)])
        first = self.epoch - len(self._rest)
        value = self.moments.standardise(self.values(corr))
        ends = first + self.length * np.arange(1, len(value) + 1) - 1
        index = None if sample_index is None else np.asarray(sample_index)[ends - self.epoch]
        self._rest = corr[len(value) * self.length :]
        self.epoch = first + len(corr)
        return statistics(value, ends, self.integration_s, np.nan, index)


class Cn0Drop(_Spec):
    """Fall of C/N0 below its trained level.

    C/N0 = mean(|I|)^2 / (2 T var(|I|)) over a window (the paper's mean^2 / std has the wrong dimension); the
    modulus removes data signs, without bias well above 30 dB-Hz. Null model: Gaussian in dB for windows of
    50 epochs or more. Cost: one tap.
    """

    kind: Literal["CN0"] = "CN0"
    window_s: float = Field(1.0, gt=0)
    """Length of the window over which C/N0 is measured."""

    def start(self, taps_chips, integration_s, signal="L1CA", prn=1, waveform=None):
        """-> Run."""
        taps_chips = np.asarray(taps_chips, float)
        prompt = int(np.argmin(np.abs(taps_chips)))
        length = _window(self.window_s, integration_s, 8)

        def drop_db(z):
            i = np.abs(z[:, :, prompt].real.astype(float))
            cn0 = i.mean(axis=1) ** 2 / (2 * integration_s * i.var(axis=1, ddof=1))
            return -10 * np.log10(cn0)

        return _WindowRun("C/N0", drop_db, len(taps_chips), length, integration_s)


class NoiseFloor(_Spec):
    """Power of the taps beyond ``beyond_chips``, dB.

    Null model: chi-square of the window's outer taps about the code's side lobes; Gaussian for long windows.
    Cost: one sum over the outer taps.
    """

    kind: Literal["NOISE_FLOOR"] = "NOISE_FLOOR"
    window_s: float = Field(1.0, gt=0)
    """Length of the window over which the power is averaged."""
    beyond_chips: float = Field(2.0, ge=0)
    """Taps further out than this count as noise floor."""

    def start(self, taps_chips, integration_s, signal="L1CA", prn=1, waveform=None):
        """-> Run."""
        outer = np.abs(np.asarray(taps_chips, float)) > self.beyond_chips
        if not outer.any():
            raise ValueError(f"no tap lies beyond {self.beyond_chips:g} chips: widen the array")

        def power_db(z):
            z = z[:, :, outer]
            return 10 * np.log10(np.mean(z.real.astype(float) ** 2 + z.imag.astype(float) ** 2, axis=(1, 2)))

        length = _window(self.window_s, integration_s, 1)
        return _WindowRun("noise-floor", power_db, len(outer), length, integration_s)


class SignalQuality(_Spec):
    """Shape of the peak: delta (I_E - I_L) / (2 I_P) or ratio (I_E + I_L) / (2 I_P), modulus of the
    deviation, weighted with the prompt's amplitude (``_QualityRun``).

    Taps: those nearest to +-``offset_chips``. Null model: Gaussian deviation, so the statistic is half-normal
    (Phelps, Akos et al. 2000s SQM metrics; Irsigler & Hein, ION GNSS 2005). Cost: three taps.
    """

    kind: Literal["SQM"] = "SQM"
    metric: Literal["delta", "ratio"] = "delta"
    """"delta": (E - L) / 2P, or "ratio": (E + L) / 2P."""
    offset_chips: float = Field(0.65, gt=0)
    """Taps nearest to plus and minus this offset are used."""
    window_s: float = Field(1.0, gt=0)
    """Length of the window over which the metric is averaged."""

    def start(self, taps_chips, integration_s, signal="L1CA", prn=1, waveform=None):
        """-> Run."""
        taps_chips = np.asarray(taps_chips, float)
        e, p, late = (
            int(np.argmin(np.abs(taps_chips - d))) for d in (self.offset_chips, 0.0, -self.offset_chips)
        )
        if len({e, p, late}) < 3:
            raise ValueError(
                f"offset_chips = {self.offset_chips:g}: the array has no early, prompt and late tap there"
            )
        sign = -1.0 if self.metric == "delta" else 1.0

        def metric(z):
            i = z.real.astype(float)
            total = (i[:, :, e] + sign * i[:, :, late]) * np.sign(i[:, :, p])
            return total.sum(axis=1) / (2 * np.abs(i[:, :, p]).sum(axis=1))

        length = _window(self.window_s, integration_s, 1)
        return _QualityRun(f"SQM {self.metric}", metric, p, len(taps_chips), length, integration_s)


class _QualityRun(_WindowRun):
    """Two-sided: modulus of the deviation, weighted with the prompt over its trained mean, standardised.

    The noise of a ratio grows as its denominator fades; the weight undoes that.
    """

    def __init__(self, name, quantity, prompt, n_taps, length, integration_s):
        super().__init__(name, quantity, n_taps, length, integration_s)
        self.prompt, self.metrics, self.prompts = prompt, _Moments(name), _Moments(name)

    def values(self, corr):
        """Weighted deviation of each whole window, float64."""
        metric, weight = self._parts(corr)
        return (metric - self.metrics.mean) * weight / self.prompts.mean

    def _parts(self, corr):
        m = len(corr) // self.length
        z = corr[: m * self.length].reshape(m, self.length, self.n_taps)
        return self.quantity(z), np.abs(z[:, :, self.prompt].real.astype(float)).mean(axis=1)

    def train(self, corr):
        """Add quiet epochs, complex64 (n, K)."""
        corr = checked_corr(corr, self.n_taps)
        metric, weight = self._parts(corr)
        self.metrics.add(metric)
        self.prompts.add(weight)
        self.moments.add(self.values(corr))

    def __call__(self, corr, sample_index=None):
        out = super().__call__(corr, sample_index)
        out["value"] = np.abs(out["value"])
        return out


class AgcGain(_Spec):
    """Fall of the AGC gain (dB) below its trained level: input ``gain_db`` float (n,), one per epoch.

    Null model: Gaussian about the trained gain, of the training's variance and that of the slow changes which
    a short training does not show (``monitors.short_training.WanderNull``). Cost: none.
    """

    kind: Literal["AGC"] = "AGC"
    wander_db: float = Field(0.1, gt=0, le=10)
    """Standard deviation of slow changes of the gain that are no interference: temperature, fading (assumed)."""
    window_s: float = Field(0.1, ge=0.02, le=10)
    """The receiver reads the gain this often."""

    def start(self, taps_chips, integration_s, signal="L1CA", prn=1, waveform=None):
        """-> Run; ``integration_s`` is the interval of the gains."""
        return _AgcRun(integration_s)


class _AgcRun(_Restart):
    def __init__(self, integration_s):
        self.integration_s, self.moments, self.epoch = integration_s, _Moments("AGC"), 0

    def train(self, gain_db):
        """Add quiet gains, dB."""
        self.moments.add(-np.asarray(gain_db, float))

    def __call__(self, gain_db, sample_index=None):
        """STATISTIC (n,) of gains in dB."""
        value = self.moments.standardise(-np.asarray(gain_db, float))
        epochs = self.epoch + np.arange(len(value))
        self.epoch += len(value)
        return statistics(value, epochs, self.integration_s, np.nan, sample_index)


class AdcHistogram(_Spec):
    """Chi-square of ADC level counts against the trained proportions: input ``counts`` int (n, levels).

    Neighbouring levels are pooled to at most ``groups`` of about the same probability: no cell is empty, and a
    change of power is not lost among hundreds of degrees.
    Statistic: sum (O - E)^2 / E. Null model: chi2 of (groups - 1) degrees for independent samples (Bastide et al.,
    ION GNSS 2003); oversampled data are correlated, so take the threshold from training.
    Cost: a histogram.
    """

    kind: Literal["ADC"] = "ADC"
    groups: int = Field(16, ge=2, le=256)
    """Largest number of groups of levels."""
    samples: int = Field(50_000, ge=1000, le=1_000_000)
    """Samples that the receiver puts into each histogram (I and Q count both)."""
    window_s: float = Field(0.1, ge=0.02, le=10)
    """The receiver takes a histogram this often."""

    def start(self, taps_chips, integration_s, signal="L1CA", prn=1, waveform=None):
        """-> Run; ``integration_s`` is the interval of the histograms."""
        return _AdcRun(integration_s, self.groups)


class _AdcRun(_Restart):
    totals: Any  # float (levels,); None before training

    def __init__(self, integration_s, groups):
        self.integration_s, self.groups, self.totals, self.epoch = integration_s, groups, None, 0

    def train(self, counts):
        """Add quiet histograms, int (n, levels)."""
        total = np.asarray(counts, float).sum(axis=0)
        self.totals = total if self.totals is None else self.totals + total
        self._group = _pool(self.totals / self.totals.sum(), self.groups)
        self._share = np.bincount(self._group, self.totals) / self.totals.sum()

    @property
    def degrees(self):
        """Degrees of freedom of the null chi-square."""
        return len(self._share) - 1

    def __call__(self, counts, sample_index=None):
        """STATISTIC (n,) of histograms, int (n, levels)."""
        if self.totals is None:
            raise ValueError("the ADC monitor is not trained: call train with quiet histograms first")
        counts = np.asarray(counts, float)
        if counts.ndim != 2 or counts.shape[1] != len(self.totals):
            raise ValueError(f"histograms have shape {counts.shape}, training had {len(self.totals)} levels")
        pooled = np.stack([np.bincount(self._group, row, len(self._share)) for row in counts])
        expected = counts.sum(axis=1, keepdims=True) * self._share
        value = ((pooled - expected) ** 2 / expected).sum(axis=1)
        epochs = self.epoch + np.arange(len(value))
        self.epoch += len(value)
        return statistics(value, epochs, self.integration_s, np.nan, sample_index)


def _pool(share, groups):
    """Group of each level, 0 ..: neighbours share one, every group has been seen; at most ``groups``."""
    middle = np.cumsum(share) - 0.5 * share
    group = np.minimum((groups * middle).astype(int), groups - 1)
    seen = np.unique(group[share > 0])
    return np.maximum(np.searchsorted(seen, group, "right") - 1, 0)


def _window(window_s, integration_s, least):
    n = round(window_s / integration_s)
    if n < least:
        raise ValueError(
            f"window_s = {window_s:g} holds {n} integrations of {integration_s:g} s, at least {least} are needed"
        )
    return n


DETECTORS = (Cn0Drop, NoiseFloor, SignalQuality, AgcGain, AdcHistogram)
