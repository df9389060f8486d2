"""Null models after a training of seconds deliver their P_FA, the training's errors included."""

import math

import numpy as np
import pytest

from monitors.baselines import AdcHistogram, count_levels
from monitors.glrt import GlrtMonitor
from monitors.multichannel_ar import first_order_energy, fit
from monitors.short_training import FisherNull, StudentNull, WanderNull, independent_values

Z = 5.0
P_FA = 1e-2


def within_binomial(hits, trials, p):
    return abs(hits - p * trials) < Z * math.sqrt(p * (1 - p) * trials)


@pytest.mark.parametrize("two_sided", [False, True])
def test_student_after_twenty_values(two_sided):
    rng = np.random.default_rng(1)
    x = 3 + 0.5 * rng.standard_normal((20_000, 21))
    train, test = x[:, :20], x[:, 20]
    value = (test - train.mean(axis=1)) / train.std(axis=1, ddof=1)
    hits = np.count_nonzero((abs(value) if two_sided else value) >= StudentNull(20, two_sided).isf(P_FA))
    assert within_binomial(hits, len(x), P_FA)
    # The Gaussian quantile would not do.
    assert not within_binomial(np.count_nonzero(value >= 2.326), len(x), P_FA)


def test_independent_values_of_a_first_order_process():
    """Variance of the mean of n values is sigma^2 / n_eff: theory says n (1 - r) / (1 + r)."""
    rng = np.random.default_rng(2)
    n, r = 4000, 0.8
    e = rng.standard_normal(n) * math.sqrt(1 - r * r)
    x = np.empty(n)
    x[0] = rng.standard_normal()
    for k in range(1, n):
        x[k] = r * x[k - 1] + e[k]
    # r is known to sqrt((1 - r^2) / n) = 0.0095; n_eff changes by 2 n dr / (1 + r)^2.
    assert independent_values(x) == pytest.approx(n / 9, abs=Z * 2 * n * 0.0095 / 1.8**2)
    assert independent_values(rng.standard_normal(20)) == 20
    with pytest.raises(ValueError, match="too few"):
        StudentNull.fit(np.arange(30.0))


def test_fisher_of_histograms_white_and_correlated():
    """Independent samples, and samples repeated four times, whose chi-square is four times as large."""
    rng = np.random.default_rng(3)
    for repeat in (1, 4):
        hits = trials = 0
        for _ in range(30):
            counts = np.zeros((600, 256), np.int64)
            for row in counts:
                x = np.clip(np.rint(20 * rng.standard_normal(2000 // repeat)), -128, 127).astype(np.int8)
                count_levels(np.repeat(x, repeat), row)
            run = AdcHistogram().start((), 0.1)
            run.train(counts[:200])
            null = FisherNull.fit(run(counts[:200])["value"], run.degrees)
            value = run.fresh()(counts[200:])["value"]
            hits += np.count_nonzero(value >= null.isf(P_FA))
            trials += len(value)
        assert run.degrees == 15
        # The 30 trainings differ in their variance by sqrt(2 / 200), which moves the tail by about a quarter.
        assert abs(hits - P_FA * trials) < Z * math.sqrt(P_FA * trials * (1 + P_FA * 400 * 0.25**2))


def test_levels_are_pooled_to_groups_of_like_probability():
    run = AdcHistogram(groups=4).start((), 0.1)
    train = np.zeros((1, 256), np.int64)
    train[0, 100:108] = 100
    run.train(train)
    assert run._share.tolist() == [0.25] * 4
    strange = np.zeros((1, 256), np.int64)
    strange[0, 250] = 800  # never seen in training: the outermost group
    # 800 in one of four groups of 200 expected: (600^2 + 3 * 200^2) / 200
    assert run(strange)["value"][0] == pytest.approx(2400)


def test_wander_needs_to_be_larger_than_the_training_showed():
    rng = np.random.default_rng(4)
    quiet = 0.01 * rng.standard_normal(200)
    null = WanderNull.fit(quiet, 0.1)
    assert null.isf(1e-3) == pytest.approx(3.09 * math.hypot(1, 10), rel=Z / math.sqrt(2 * 200))
    assert null.sf(null.isf(1e-3)) == pytest.approx(1e-3)
    with pytest.raises(ValueError, match="varied by"):
        WanderNull.fit(quiet, 0.001)


@pytest.mark.parametrize("accumulate", [1, 10])
def test_glrt_threshold_after_a_short_training(accumulate):
    """One frequency, noise variance from a few epochs: T / M is F distributed."""
    rng = np.random.default_rng(5)
    taps = 0.65 * np.arange(-5, 6)
    spec = GlrtMonitor(grid_hz=227e3, max_hz=228e3, accumulate_epochs=accumulate)
    run = spec.start(taps, 0.02, "L1CA", 6)
    n_train, trials = 4, 4000
    root = np.linalg.inv(run.whitener)
    g = rng.standard_normal((2, trials, n_train + accumulate, 11))
    z = ((g[0] + 1j * g[1]) @ root.T).astype(np.complex64)
    y = z @ run.operator.T
    power = np.sum(np.abs(y[:, :n_train]) ** 2, axis=(1, 2)) / (2 * run.rank * n_train)
    t = np.sum(np.abs(y[:, n_train:] @ run.directions[:, 1].conj()) ** 2, axis=1) / (2 * power)
    run.train(z[0, :n_train])
    assert run.noise_variance == pytest.approx(power[0], rel=1e-5)
    assert within_binomial(np.count_nonzero(t >= run.threshold(P_FA, 1.0)), trials, P_FA)


@pytest.mark.parametrize("shape", [(150, 35), (40, 5), (200, 1)])
def test_first_order_energy_is_the_fit(shape):
    rng = np.random.default_rng(6)
    x = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)
    x[1:] += 0.5 * x[:-1]
    want = np.trace(fit(x.astype(complex), 1).covariance).real
    # Single precision over N products.
    assert first_order_energy(x) == pytest.approx(want, rel=2e-6 * math.sqrt(shape[0]))
    assert first_order_energy(x.real.astype(np.complex64)) == pytest.approx(
        np.trace(fit(x.real.astype(complex), 1).covariance).real, rel=2e-6 * math.sqrt(shape[0])
    )
    with pytest.raises(ValueError, match="linearly dependent"):
        first_order_energy(np.zeros(shape, np.complex64))
