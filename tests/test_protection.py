"""Protection levels bound what they promise, and no more; innovation tests and the Stanford diagram."""

import math

import numpy as np
import pytest
from scipy.stats import chi2, norm

from monitors.protection import Protection, innovation_chi2, protection_levels, solution, stanford
from nav import eskf
from nav.errormodels import unit_vectors_enu
from sdr.reproduce import highdynamics as hd


def geometry() -> np.ndarray:
    u = unit_vectors_enu(hd.AZIMUTH_DEG, hd.ELEVATION_DEG)
    return np.column_stack([-u, np.ones(7)])


VAR = np.array([1.0, 4.0, 1.0, 2.0, 1.0, 5.0, 0.5])


def test_solution_identities():
    h = geometry()
    s, cov, parity = solution(h, VAR)
    np.testing.assert_allclose(s @ h, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(parity @ h, 0, atol=1e-12)
    np.testing.assert_allclose(s @ np.diag(VAR) @ s.T, cov, atol=1e-12)
    # Estimate and parity residual are uncorrelated: the product of probabilities is exact.
    np.testing.assert_allclose(s @ np.diag(VAR) @ parity, 0, atol=1e-12)


def test_vertical_level_is_met_exactly_at_the_worst_bias():
    """Full Monte Carlo at the deciding bias: P(|e| > VPL and no alarm) equals the conditional allocation, z = 5."""
    h = geometry()
    spec = Protection(p_hmi=0.016, p_fault=0.1, p_false_alarm=1e-2)
    levels = protection_levels(h, VAR, spec)
    s, _, parity = solution(h, VAR)
    allowed = 0.5 * spec.p_hmi / 8 / spec.p_fault
    runs = 400_000
    v = np.random.default_rng(0).normal(size=(runs, 7)) * np.sqrt(VAR)
    v[:, levels.worst] += levels.worst_bias_m
    quiet = np.einsum("ri,ij,rj->r", v, parity, v) < levels.threshold
    hit = (np.abs(v @ s[2]) > levels.vpl_m) & quiet
    assert abs(hit.mean() - allowed) < 5 * math.sqrt(allowed / runs) + 0.02 * allowed


@pytest.mark.parametrize("sat", range(7))
def test_no_single_bias_breaks_either_level(sat):
    h = geometry()
    spec = Protection(p_hmi=0.016, p_fault=0.1, p_false_alarm=1e-2)
    levels = protection_levels(h, VAR, spec)
    s, _, parity = solution(h, VAR)
    allowed = 0.5 * spec.p_hmi / 8 / spec.p_fault
    runs = 40_000
    noise = np.random.default_rng(sat).normal(size=(runs, 7)) * np.sqrt(VAR)
    for bias in np.linspace(0, 6 / math.sqrt(parity[sat, sat]), 7):
        v = noise.copy()
        v[:, sat] += bias
        quiet = np.einsum("ri,ij,rj->r", v, parity, v) < levels.threshold
        e = v @ s.T
        for large in (np.abs(e[:, 2]) > levels.vpl_m, np.hypot(e[:, 0], e[:, 1]) > levels.hpl_m):
            assert (large & quiet).mean() < allowed + 5 * math.sqrt(allowed / runs)


def test_fault_free_part_is_the_gaussian_quantile():
    """A fault rarer than its share of the risk needs no protection of its own."""
    spec = Protection(p_hmi=1e-2, p_fault=1e-9)
    levels = protection_levels(geometry(), VAR, spec)
    assert levels.vpl_m == pytest.approx(-norm.ppf(0.5e-2 / 8 / 2) * levels.sigma_enu_m[2], rel=1e-6)


def test_levels_scale_and_order():
    base = protection_levels(geometry(), VAR, Protection())
    twice = protection_levels(geometry(), 4 * VAR, Protection())
    assert twice.vpl_m == pytest.approx(2 * base.vpl_m, rel=1e-3)
    assert twice.hpl_m == pytest.approx(2 * base.hpl_m, rel=1e-3)
    longer = protection_levels(geometry(), VAR, Protection(independent_epochs=100))
    fewer = protection_levels(geometry()[:6], VAR[:6], Protection())
    assert longer.vpl_m > base.vpl_m and fewer.vpl_m > base.vpl_m


def test_innovation_test_has_its_false_alarm_rate():
    problem = hd.problem(10.0, 200)
    log = hd.filter_log(problem, np.full(7, 4.0))
    r, _ = eskf.replay(log, problem.p0, np.full(7, 4.0), 40, np.random.default_rng(1))
    hits = n = 0
    for i in range(40):
        ratio, limit = innovation_chi2(log._replace(r=np.ascontiguousarray(r[:, i])), 1e-2)
        hits, n = hits + int((ratio > limit).sum()), n + ratio.size
    assert limit == pytest.approx(chi2.isf(1e-2, 1))
    # Rows of one epoch are correlated: at most 7 times the binomial variance.
    assert abs(hits / n - 1e-2) < 5 * math.sqrt(7 * 1e-2 / n)


def test_stanford_regions():
    error = np.array([1.0, 6.0, 1.0, 60.0, 45.0])
    level = np.array([5.0, 5.0, 50.0, 50.0, 30.0])
    assert list(stanford(error, level, 40.0).values()) == [1, 1, 1, 1, 1]
    assert sum(stanford(error, level, 100.0).values()) == 5
    with pytest.raises(ValueError, match="as many"):
        stanford(error, level[:3], 40.0)


@pytest.mark.parametrize(
    ("h", "var", "message"),
    [
        (geometry()[:4], VAR[:4], "need 5 satellites"),
        (np.tile(geometry()[:2], (3, 1)), np.ones(6), "singular"),
        (geometry(), np.r_[-1.0, VAR[1:]], "above zero"),
    ],
)
def test_refusals(h, var, message):
    with pytest.raises(ValueError, match=message):
        protection_levels(h, var, Protection())
