import math

import numpy as np
import pytest
from scipy import stats

from monitors import detection, threshold
from monitors.threshold import AnalyticNull, EmpiricalNull, GaussianNull, ParetoNull

Z = 5.0


def test_gaussian_rule_on_gaussian_values_and_its_interval():
    rng = np.random.default_rng(1)
    null = GaussianNull.fit(rng.standard_normal(200_000))
    assert null.isf(1.6e-5) == pytest.approx(4.313, abs=Z * math.sqrt((1 + 0.5 * 4.313**2) / 200_000))
    assert null.sf(null.isf(1e-3)) == pytest.approx(1e-3)
    assert GaussianNull(0, 1, 1e6, two_sided=False).isf(1e-3) == pytest.approx(stats.norm.isf(1e-3))
    inside = 0
    for seed in range(300):
        low, high = GaussianNull.fit(np.random.default_rng(seed).standard_normal(500)).interval(1e-3)
        inside += low < stats.norm.isf(5e-4) < high
    assert 285 - Z * math.sqrt(300 * 0.05 * 0.95) < inside


def test_empirical_and_pareto_thresholds_cover_the_truth():
    """Gumbel-like maxima, whose Gaussian rule fails: thresholds, coverage, real P_FA."""
    law = stats.gumbel_r()
    p, n = 1e-3, 40_000
    hits = {"empirical": 0, "pareto": 0}
    for seed in range(40):
        x = law.rvs(n, random_state=seed)
        for name, null in (("empirical", EmpiricalNull.fit(x)), ("pareto", ParetoNull.fit(x))):
            low, high = null.interval(p)
            assert low < null.isf(p) < high
            hits[name] += low <= law.isf(p) <= high
    for count in hits.values():
        assert count >= 38 - Z * math.sqrt(40 * 0.05 * 0.95) - 2
    x = law.rvs(1_000_000, random_state=99)
    null = ParetoNull.fit(x)
    assert abs(null.xi) < 0.06
    assert null.isf(1.6e-5) == pytest.approx(law.isf(1.6e-5), abs=0.6)
    assert null.sf(null.isf(1e-4)) == pytest.approx(1e-4)
    assert null.sf(law.isf(0.3)) == pytest.approx(0.3, abs=0.003)
    gauss = GaussianNull.fit(x)
    assert threshold.real_p_fa(law.rvs(1_000_000, random_state=7), gauss.isf(1.6e-5)).low > 10 * 1.6e-5


def test_pareto_moments_on_a_pareto():
    for xi in (-0.2, 0.0, 0.2):
        x = stats.genpareto(xi, scale=2.0).rvs(1_000_000, random_state=3)
        null = ParetoNull.fit(x, tail=0.05)
        # A Pareto's tail is Pareto with scale sigma + xi u. sd of PWM shape about sqrt(1.5 / m), m = 50000.
        assert null.xi == pytest.approx(xi, abs=Z * math.sqrt(1.7 / 50_000))
        assert null.sigma == pytest.approx(2.0 + xi * null.u, rel=Z * 2 / math.sqrt(50_000))


def test_training_that_cannot_support_the_p_fa_is_refused():
    x = np.random.default_rng(2).standard_normal(50_000)
    with pytest.raises(ValueError, match=r"625000 independent training epochs.*50000"):
        EmpiricalNull.fit(x).isf(1.6e-5)
    with pytest.raises(ValueError, match=r"62500 independent training epochs"):
        ParetoNull.fit(x).isf(1.6e-5)
    with pytest.raises(ValueError, match="there are 900"):
        EmpiricalNull.fit(x, n_effective=900).isf(1e-3)
    with pytest.raises(ValueError, match="200 values beyond"):
        ParetoNull.fit(x[:5000])
    with pytest.raises(ValueError, match="train on 10000"):
        AnalyticNull.fit(x[:5000])
    for bad in (x[:50], np.array([np.nan] * 200)):
        with pytest.raises(ValueError, match="at least 100"):
            GaussianNull.fit(bad)
    with pytest.raises(ValueError, match="between 0"):
        GaussianNull.fit(x).isf(0.0)


def test_analytic_null_finds_the_number_of_bins():
    rng = np.random.default_rng(4)
    x = rng.exponential(size=(400_000, 40)).max(axis=1)
    null = AnalyticNull.fit(x)
    assert null.n_bins_low < 40 * (1 - 0.5e-3) < null.n_bins_high
    assert null.isf(1e-5) == pytest.approx(math.log(40 / 1e-5), abs=Z / math.sqrt(400))
    low, high = null.interval(1e-5)
    assert low < null.isf(1e-5) < high


def test_requirements_and_rates_over_time():
    assert threshold.requirement("NPA").p_fa == 3.33e-7
    assert threshold.requirement("APV-I").time_to_alert_s == 10.0
    assert threshold.requirement("APV-II", 1e-5) == threshold.Requirement("APV-II", 1e-5, 6.0)
    with pytest.raises(ValueError, match="to be determined"):
        threshold.requirement("APV-II")
    with pytest.raises(ValueError, match="APV-I"):
        threshold.requirement("CAT-III")
    # 150 s of 20 ms tests on 8 channels at 1.6e-5 each: 0.62 of the approaches have a false alarm.
    p = threshold.per_approach(1.6e-5, 0.02, 8)
    assert p == pytest.approx(1 - (1 - 1.6e-5) ** 60_000, rel=1e-9)
    assert threshold.per_epoch(p, 0.02, 8) == pytest.approx(1.6e-5, rel=1e-9)
    assert threshold.per_hour(1e-6, 0.02, 8) == pytest.approx(1.44)


def test_clopper_pearson():
    assert detection.clopper_pearson(0, 50_000)[1] == pytest.approx(1 - 0.025 ** (1 / 50_000), rel=1e-9)
    low, high = detection.clopper_pearson(10, 150_000)  # the paper's 6.7e-5
    assert (low, high) == (pytest.approx(3.2e-5, rel=0.01), pytest.approx(1.23e-4, rel=0.01))
    assert detection.clopper_pearson(5, 5)[1] == 1.0
    # Exactness: never less than the confidence, for any p.
    for p in (0.01, 0.2, 0.5):
        n = 40
        cover = sum(
            stats.binom.pmf(k, n, p)
            for k in range(n + 1)
            if np.prod(
                [
                    detection.clopper_pearson(k, n)[i] <= p
                    if i == 0
                    else p <= detection.clopper_pearson(k, n)[i]
                    for i in (0, 1)
                ]
            )
        )
        assert cover >= 0.95
    with pytest.raises(ValueError, match="between 0"):
        detection.clopper_pearson(3, 2)


def test_cluster_bootstrap_sees_the_correlation():
    """Runs with a common random level: the interval covers, the plain binomial one does not."""
    rng = np.random.default_rng(5)
    runs, n, truth = 40, 500, 0.2
    cover = plain = 0
    for seed in range(120):
        level = rng.beta(2, 8, runs)  # mean 0.2, sd 0.12
        k = rng.binomial(n, level)
        r = detection.cluster_rate(k, np.full(runs, n), seed, n_boot=400)
        cover += r.low <= truth <= r.high
        b = detection.rate(k.sum(), runs * n)
        plain += b.low <= truth <= b.high
        assert r.p == b.p
    assert cover >= 114 - Z * math.sqrt(120 * 0.05 * 0.95)
    assert plain < 80
    # Design effect: 1 + (n - 1) rho, rho = var(level) / (p (1 - p)) = 1 / 11.
    assert r.n_effective == pytest.approx(runs * n / (1 + 499 / 11), rel=0.6)
    independent = detection.cluster_rate(rng.binomial(n, 0.2, 400), np.full(400, n), 1)
    assert independent.n_effective == pytest.approx(200_000, rel=Z * math.sqrt(2 / 400))
    nothing = detection.cluster_rate(np.zeros(20, int), np.full(20, 1000), 1)
    assert nothing.high == pytest.approx(detection.clopper_pearson(0, 20)[1])
    assert nothing.n_effective == 20
    more = detection.cluster_rate(np.zeros(20, int), np.full(20, 1000), 1, per_run=50)
    assert more.high == pytest.approx(detection.clopper_pearson(0, 1000)[1])
    with pytest.raises(ValueError, match="at least two"):
        detection.cluster_rate([1], [10], 1)


@pytest.mark.parametrize("hit_runs", [1, 3, 6, 15])
@pytest.mark.parametrize("law", ["constant", "heavy", "small"])
def test_intervals_of_few_runs_with_events_cover(hit_runs, law):
    """Runs of which a few have events, of sizes from alike to heavy-tailed: 95 % of intervals hold the truth.

    With 10 runs with events and more the bootstrap is asymptotic; a heavy tail costs it up to 4 %.
    """
    rng = np.random.default_rng(hit_runs)
    runs, n, repeats = 60, 200, 200

    def level(m):
        return {
            "constant": lambda: np.full(m, 0.3),
            "heavy": lambda: rng.beta(0.3, 3, m),
            "small": lambda: rng.beta(1, 200, m),
        }[law]()

    truth = hit_runs / runs * np.mean(level(200_000))
    cover = 0
    for seed in range(repeats):
        k = rng.binomial(n, np.where(rng.random(runs) < hit_runs / runs, level(runs), 0.0))
        r = detection.cluster_rate(k, np.full(runs, n), seed, n_boot=300)
        cover += r.low <= truth <= r.high
        other = detection.cluster_rate(n - k, np.full(runs, n), seed, n_boot=300)  # misses and hits exchanged
        assert (other.low, other.high) == (pytest.approx(1 - r.high), pytest.approx(1 - r.low))
    promised = 0.95 if hit_runs < 10 else 0.91
    assert cover >= repeats * promised - 2 * math.sqrt(repeats * promised * (1 - promised))


def test_four_definitions_on_a_hand_made_pass():
    t = np.arange(0.0, 100.0, 0.5)
    df_t = (t - 50.0) / 10.0  # |df T| < 1 from 40.5 to 59.5
    alarm = np.zeros(len(t), bool)
    alarm[(t >= 45) & (t <= 55)] = True
    k, n = detection.p_md_curve(df_t, ~alarm, [0.0, 0.5, 1.0, 2.0])
    assert k.tolist() == [0, 18, 40]
    assert n.tolist() == [19, 20, 40]
    assert detection.p_md_hit(df_t, ~alarm) == (0, 17)
    assert detection.HIT_LIMIT == pytest.approx(0.443, abs=1e-3)
    assert np.sinc(detection.HIT_LIMIT) ** 2 == pytest.approx(0.5, abs=2e-3)
    assert detection.p_md_event(df_t, alarm, t, 10.0) == (0, 1)
    late = np.zeros_like(alarm)
    late[t >= 69.6] = True  # leaves at 59.5, ten seconds on is 69.5
    assert detection.p_md_event(df_t, late, t, 10.0) == (1, 1)
    assert detection.p_md_event(df_t, late, t, 11.0) == (0, 1)
    assert detection.p_md_event(df_t[t < 65], late[t < 65], t[t < 65], 10.0) == (0, 0)
    error = np.where((t > 47) & (t < 52), 20.0, 1.0)
    assert detection.p_md_hazard(error, alarm, t, 10.0, 15.0) == (0, 1)
    assert detection.p_md_hazard(error, late, t, 10.0, 15.0) == (1, 1)
    assert detection.p_md_hazard(-error, late, t, 30.0, 15.0) == (0, 1)
    assert detection.p_md_hazard(error, late, t, 30.0, 25.0) == (0, 0)
    assert detection.first_alarm_s(alarm, t, 40.5) == 4.5
    assert math.isnan(detection.first_alarm_s(alarm, t, 56.0))


def test_roc_is_monotone_and_right():
    rng = np.random.default_rng(6)
    quiet, jammed = rng.standard_normal(20_000), rng.standard_normal(20_000) + 2
    t, p_fa, p_md = detection.roc(quiet, jammed)
    assert np.all(np.diff(p_fa) <= 0)
    assert np.all(np.diff(p_md) >= 0)
    i = np.searchsorted(t, 1.0)
    assert p_fa[i] == pytest.approx(stats.norm.sf(1), abs=Z * 0.0026)
    assert p_md[i] == pytest.approx(stats.norm.cdf(-1), abs=Z * 0.0026)
    assert detection.roc(quiet, jammed, [1.0])[1][0] == pytest.approx(p_fa[i], abs=1e-4)
