"""From decisions to probabilities: intervals, P_MD in four definitions, ROC, time to alarm.

Intervals. Clopper-Pearson is exact for independent trials. Epochs of one run share loop noise and fading:
resample whole runs (``cluster_rate``) and print the effective number. Zero misses is an upper bound, never
zero.
"""

import math
from dataclasses import dataclass

import numpy as np

__all__ = [
    "HIT_LIMIT",
    "Rate",
    "clopper_pearson",
    "cluster_rate",
    "first_alarm_s",
    "p_md_curve",
    "p_md_event",
    "p_md_hazard",
    "p_md_hit",
    "rate",
    "roc",
]

HIT_LIMIT = 0.443
"""|df| T up to which a CW hits its line: half power of sinc^2, fixed beforehand."""
_FEW_RUNS = 10


@dataclass(frozen=True)
class Rate:
    """k events in n trials, with an interval; ``n_effective`` independent trials carry the same
    information.
    """

    k: int
    n: int
    p: float
    low: float
    high: float
    n_effective: float
    confidence: float = 0.95

    def __str__(self):
        return f"{self.k}/{self.n} = {self.p:.3g} [{self.low:.3g}, {self.high:.3g}], n_eff {self.n_effective:.0f}"


def clopper_pearson(k, n, confidence=0.95):
    """Exact two-sided interval of a binomial probability (Clopper & Pearson, Biometrika 26, 1934) -> (low,
    high).

    ``k`` and ``n`` may be effective, hence not whole, numbers: less than one event has no lower limit, less than one
    other no upper one.
    """
    from scipy.special import betaincinv

    if not (n >= 0 and 0 <= k <= n):
        raise ValueError(f"{k} events in {n} trials: events must lie between 0 and the number of trials")
    alpha = 0.5 * (1 - confidence)
    low = 0.0 if k < 1 else float(betaincinv(k, n - k + 1, alpha))
    high = 1.0 if k > n - 1 else float(betaincinv(k + 1, n - k, 1 - alpha))
    return low, high


def rate(k, n, confidence=0.95):
    """Rate of k events in n independent trials."""
    low, high = clopper_pearson(k, n, confidence)
    return Rate(int(k), int(n), k / n if n else math.nan, low, high, float(n), confidence)


def cluster_rate(k, n, seed, confidence=0.95, n_boot=2000, per_run=1.0):
    """Rate from runs whose epochs depend on one another.

    Parameters
    ----------
    k, n : int (runs,)
        Events and trials of each run.
    seed : int or SeedSequence
    per_run : float
        Independent trials that every run certainly holds (its length over the correlation time); used
        without events.

    Notes
    -----
    n_effective = p (1 - p) / variance of sum k / sum n, at most n; the variance is that between runs. The interval is
    the wider of a percentile bootstrap over runs and of Clopper-Pearson on n_effective (z / t)^2 trials (Korn &
    Graubard, Survey Methodology 24, 1998), which holds where the bootstrap has few events to draw from. With fewer
    than 10 runs that have events (or that have others) neither holds: then every run counts as a single trial, with p
    times the number of runs as its events; without events, as ``per_run`` trials.
    """
    k, n = np.asarray(k), np.asarray(n)
    if len(k) != len(n) or len(k) < 2:
        raise ValueError(
            f"{len(k)} runs: a cluster bootstrap needs at least two, with events and trials for each"
        )
    total_k, total_n, runs = int(k.sum()), int(n.sum()), len(k)
    p = total_k / total_n
    if min(np.count_nonzero(k), np.count_nonzero(k < n)) < _FEW_RUNS:
        effective = min(float(total_n), runs * per_run) if total_k in (0, total_n) else float(runs)
        low, high = clopper_pearson(p * effective, effective, confidence)
        return Rate(total_k, total_n, p, low, high, effective, confidence)
    # Linearised variance of the ratio, not the bootstrap's own, which has Monte Carlo noise.
    variance = np.sum((k - p * n) ** 2) / total_n**2 * runs / (runs - 1)
    effective = min(float(total_n), p * (1 - p) / variance) if variance > 0 else float(total_n)
    low, high = _survey_interval(p, effective, runs, confidence)
    rng = np.random.Generator(np.random.Philox(seed))
    pick = rng.integers(0, runs, (n_boot, runs))
    boot = k[pick].sum(axis=1) / n[pick].sum(axis=1)
    alpha = 0.5 * (1 - confidence)
    left, right = np.quantile(boot, [alpha, 1 - alpha])
    return Rate(total_k, total_n, p, min(low, float(left)), max(high, float(right)), effective, confidence)


def _survey_interval(p, effective, runs, confidence):
    """Clopper-Pearson on the effective number, reduced for a variance that ``runs`` runs estimate."""
    from scipy.special import ndtri, stdtrit

    upper = 0.5 + 0.5 * confidence
    m = effective * (ndtri(upper) / stdtrit(runs - 1, upper)) ** 2
    return clopper_pearson(p * m, m, confidence)


def p_md_curve(df_t, missed, edges):
    """Definition 1: P_MD against |df| T -> (k, n) per bin, int arrays (len(edges) - 1,).

    ``df_t`` (n,) offset from the line times T, ``missed`` bool (n,).
    """
    index = np.digitize(np.abs(df_t), edges) - 1
    inside = (index >= 0) & (index < len(edges) - 1)
    n = np.bincount(index[inside], minlength=len(edges) - 1)
    k = np.bincount(index[inside], weights=np.asarray(missed, float)[inside], minlength=len(edges) - 1)
    return k.astype(int), n


def p_md_hit(df_t, missed, limit=HIT_LIMIT):
    """Definition 2: epochs with |df| T <= ``limit`` -> (k, n)."""
    inside = np.abs(df_t) <= limit
    return int(np.count_nonzero(np.asarray(missed)[inside])), int(np.count_nonzero(inside))


def p_md_event(df_t, alarm, t_s, time_to_alert_s, limit=1.0):
    """Definition 3: passes without an alarm from entering |df| T < limit to time-to-alert after leaving ->
    (k, n).

    A pass still running at the end of the series is not counted unless it has alarmed.
    """
    inside = np.abs(df_t) < limit
    edge = np.flatnonzero(np.diff(np.concatenate([[0], inside.view(np.int8), [0]])))
    k = n = 0
    for a, b in edge.reshape(-1, 2):
        last = t_s[b - 1] + time_to_alert_s
        stop = np.searchsorted(t_s, last, "right")
        caught = bool(np.any(alarm[a:stop]))
        if not caught and t_s[-1] < last:
            continue
        n += 1
        k += not caught
    return k, n


def p_md_hazard(error_m, alarm, t_s, time_to_alert_s, limit_m):
    """Definition 4: hazards without an alarm within the time to alert of the error passing ``limit_m`` ->
    (k, n).

    A hazard starts where |error| rises above the limit. It is caught by an alarm that stands at its start or
    comes within the time to alert.
    """
    above = np.abs(error_m) > limit_m
    starts = np.flatnonzero(above & ~np.concatenate([[False], above[:-1]]))
    k = 0
    for a in starts:
        stop = np.searchsorted(t_s, t_s[a] + time_to_alert_s, "right")
        k += not np.any(alarm[a:stop])
    return k, len(starts)


def first_alarm_s(alarm, t_s, start_s):
    """Time from ``start_s`` to the first alarm at or after it; NaN without one."""
    hits = np.flatnonzero(np.asarray(alarm) & (np.asarray(t_s) >= start_s))
    return float(t_s[hits[0]] - start_s) if len(hits) else math.nan


def roc(quiet, jammed, thresholds=None):
    """Receiver operating characteristic -> thresholds, P_FA, P_MD; alarm when the statistic is >= threshold.

    ``thresholds``: default, all distinct values of both samples.
    """
    quiet, jammed = np.sort(quiet), np.sort(jammed)
    t = np.unique(np.concatenate([quiet, jammed])) if thresholds is None else np.asarray(thresholds, float)
    p_fa = 1 - np.searchsorted(quiet, t, "left") / len(quiet)
    p_md = np.searchsorted(jammed, t, "left") / len(jammed)
    return t, p_fa, p_md
