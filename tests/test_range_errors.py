"""Appendix B of Vanek 1999: stationary variances, correlation times, and the two corrected strengths."""

import numpy as np
import pytest

from signals.range_errors import RangeErrors, gauss_markov


def test_gauss_markov_is_stationary_with_the_right_correlation():
    x = gauss_markov(4.0, 10.0, (50, 20_000), 1.0, np.random.default_rng(0))
    se = 4 * np.sqrt(2 / 20_000)
    assert np.all(np.abs(x.var(axis=1) - 4) < 5 * se)
    lag = (x[40] * x[30]).mean()
    assert abs(lag - 4 * np.exp(-1)) < 5 * 4 * np.sqrt(1.2 / 20_000)


def test_sum_of_the_parts():
    """Total variance of one satellite without the folded multipath; orbit errors come in by |u| = 1."""
    spec = RangeErrors(multipath_m2=0.0)
    u = np.tile([[0.6, 0.0, 0.8]], (4000, 1))
    x = spec.simulate(u, 2, 1.0, np.random.default_rng(1))
    total = (25 + 3 + 1 + 1 + 30) * 0.3048**2
    # The orbit error is drawn per satellite, so 4000 independent columns.
    assert abs(x[1].var() - total) < 5 * total * np.sqrt(2 / 4000)


def test_multipath_only_delays():
    spec = RangeErrors(
        satellite_clock_m2=0, ionosphere_m2=0, troposphere_m2=0, code_loop_m2=0, ephemeris_m2=0
    )
    assert spec.simulate(np.eye(3), 100, 1.0, np.random.default_rng(2)).min() >= 0


def test_driving_noise_of_the_corrected_entries():
    """q = 2 s^2 / tau: 0.8 where the thesis prints 0.2, 0.04 where it prints 0.4 (ft^2/s)."""
    spec = RangeErrors()
    ft2 = 0.3048**2
    assert 2 * spec.multipath_m2 / spec.multipath_tau_s / ft2 == pytest.approx(0.8)
    assert 2 * spec.ephemeris_m2 / spec.ephemeris_tau_s / ft2 == pytest.approx(0.04)
    assert 2 * spec.ionosphere_m2 / spec.ionosphere_tau_s / ft2 == pytest.approx(0.004)


def test_refusal():
    with pytest.raises(ValueError, match="variance"):
        gauss_markov(-1.0, 1.0, (3, 2), 1.0, np.random.default_rng(0))
