"""Null models of a statistic and the thresholds they give, each with its interval.

A null model behaves like a frozen distribution: ``sf(x)`` is the probability of a false alarm at threshold x,
``isf(p_fa)`` the threshold, ``interval(p_fa)`` what the training leaves open about it. Train on many
realisations of the channel, never on one; ``n_effective`` says how many independent values the training
holds.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from monitors.detection import rate

__all__ = [
    "REQUIREMENTS",
    "AnalyticNull",
    "EmpiricalNull",
    "GaussianNull",
    "ParetoNull",
    "Requirement",
    "per_approach",
    "per_epoch",
    "per_hour",
    "real_p_fa",
    "requirement",
]

_LEAST_EVENTS = 10  # exceedances an empirical threshold must rest on
_LEAST_EXCESSES = 200  # exceedances of u a tail fit must rest on


@dataclass(frozen=True)
class Requirement:
    """False-alarm probability per test and time to alert of a phase of flight."""

    name: str
    p_fa: float | None
    time_to_alert_s: float


REQUIREMENTS = {
    r.name: r
    for r in (
        Requirement("NPA", 3.33e-7, 10.0),
        Requirement("APV-I", 1.6e-5, 10.0),
        Requirement("APV-II", None, 6.0),
    )
}
"""Ouzeau et al. 2008, table 5 (DO-229D); the P_FA of APV-II is "to be determined" there."""


def requirement(name, p_fa=None):
    """Requirement by name; ``p_fa`` completes or replaces the table's."""
    if name not in REQUIREMENTS:
        raise ValueError(f"unknown requirement set {name!r}: use one of {', '.join(REQUIREMENTS)}")
    r = REQUIREMENTS[name]
    if r.p_fa is None and p_fa is None:
        raise ValueError(f"{name} has no published P_FA (table 5 says to be determined): give p_fa")
    return r if p_fa is None else Requirement(name, p_fa, r.time_to_alert_s)


def per_approach(p_epoch, test_interval_s, channels, approach_s=150.0):
    """P(at least one false alarm) over an approach and all channels, tests independent."""
    return -math.expm1(channels * (approach_s / test_interval_s) * math.log1p(-p_epoch))


def per_epoch(p_approach, test_interval_s, channels, approach_s=150.0):
    """Inverse of ``per_approach``."""
    return -math.expm1(math.log1p(-p_approach) * test_interval_s / (channels * approach_s))


def per_hour(p_epoch, test_interval_s, channels):
    """Expected false alarms an hour."""
    return p_epoch * channels * 3600.0 / test_interval_s


def real_p_fa(values, threshold):
    """False-alarm rate of a threshold on quiet values it was not made from -> ``detection.Rate``."""
    values = np.asarray(values)
    return rate(np.count_nonzero(values >= threshold), len(values))


def _checked(values, n_effective):
    values = np.sort(np.asarray(values, float).ravel())
    if len(values) < 100 or not np.isfinite(values).all():
        raise ValueError(f"{len(values)} training values: at least 100 finite ones are needed")
    return values, float(len(values) if n_effective is None else min(n_effective, len(values)))


def _check_p(p_fa):
    if not 0 < p_fa < 0.5:
        raise ValueError(f"p_fa = {p_fa:g} must lie between 0 and 0.5")


@dataclass(frozen=True)
class GaussianNull:
    """The paper's rule: mean + q sd, q the Gaussian quantile (two-sided: of P_FA / 2).

    Its real P_FA on right-skewed maxima is several times the nominal one.
    """

    mean: float
    sd: float
    n_effective: float
    two_sided: bool = True
    rule: str = "gaussian"

    @classmethod
    def fit(cls, values, two_sided=True, n_effective=None):
        """From quiet values."""
        values, n = _checked(values, n_effective)
        return cls(float(values.mean()), float(values.std(ddof=1)), n, two_sided)

    def sf(self, x):
        """P(false alarm) at threshold x, if the model were true."""
        from scipy.special import ndtr

        return (2 if self.two_sided else 1) * ndtr(-(np.asarray(x) - self.mean) / self.sd)

    def isf(self, p_fa):
        """Threshold."""
        from scipy.special import ndtri

        _check_p(p_fa)
        return float(self.mean - self.sd * ndtri(p_fa / (2 if self.two_sided else 1)))

    def interval(self, p_fa, confidence=0.95):
        """Interval of the threshold: var = sd^2 (1 + q^2 / 2) / n."""
        from scipy.special import ndtri

        q = (self.isf(p_fa) - self.mean) / self.sd
        half = -ndtri(0.5 * (1 - confidence)) * self.sd * math.sqrt((1 + 0.5 * q * q) / self.n_effective)
        return self.isf(p_fa) - half, self.isf(p_fa) + half


@dataclass(frozen=True)
class EmpiricalNull:
    """Quantile of the training values themselves; refuses a P_FA below 10 / n_effective."""

    values: np.ndarray = field(repr=False)  # ascending
    n_effective: float
    rule: str = "empirical"

    @classmethod
    def fit(cls, values, n_effective=None):
        """From quiet values."""
        return cls(*_checked(values, n_effective))

    def sf(self, x):
        """Share of the training at or above x."""
        return 1 - np.searchsorted(self.values, x, "left") / len(self.values)

    def isf(self, p_fa):
        """Threshold: the (1 - P_FA) quantile."""
        _check_p(p_fa)
        need = math.ceil(_LEAST_EVENTS / p_fa)
        if self.n_effective * p_fa < _LEAST_EVENTS * (1 - 1e-9):
            raise ValueError(
                f"p_fa = {p_fa:g} needs at least {need} independent training epochs for an empirical threshold, "
                f"there are {self.n_effective:.0f}"
            )
        return float(np.quantile(self.values, 1 - p_fa))

    def interval(self, p_fa, confidence=0.95):
        """Order statistics whose exceedance probabilities bracket P_FA (binomial, normal approximation)."""
        from scipy.special import ndtri

        self.isf(p_fa)
        half = -ndtri(0.5 * (1 - confidence)) * math.sqrt(p_fa * (1 - p_fa) / self.n_effective)
        return tuple(float(np.quantile(self.values, 1 - p)) for p in (p_fa + half, max(p_fa - half, 0.0)))


@dataclass(frozen=True)
class ParetoNull:
    """Peaks over threshold: P(X > x) = share (1 + xi (x - u) / sigma)^(-1/xi) beyond u.

    Generalised Pareto tail by probability-weighted moments (Hosking & Wallis, Technometrics 29, 1987): with
    a0 the mean excess and a1 = mean (1 - F) excess, xi = 2 - a0 / (a0 - 2 a1), sigma = 2 a0 a1 / (a0 - 2
    a1). Refuses P_FA beyond one expected exceedance in the training.
    """

    body: np.ndarray = field(repr=False)  # ascending training values
    u: float
    share: float
    xi: float
    sigma: float
    n_effective: float
    rule: str = "pareto"

    @classmethod
    def fit(cls, values, tail=0.01, n_effective=None):
        """From quiet values; ``tail``: share of them that the fit uses."""
        values, n = _checked(values, n_effective)
        m = math.floor(tail * len(values))
        if m < _LEAST_EXCESSES:
            raise ValueError(
                f"a tail fit needs at least {_LEAST_EXCESSES} values beyond u, {m} of {len(values)} are: train on "
                f"{math.ceil(_LEAST_EXCESSES / tail)} epochs or widen the tail"
            )
        u = float(values[-m - 1])
        xi, sigma = _pareto_moments(values[-m:] - u)
        return cls(values, u, m / len(values), xi, sigma, n)

    def sf(self, x):
        """P(false alarm) at threshold x; the training's own share below u."""
        x = np.asarray(x, float)
        y = np.maximum(x - self.u, 0.0) / self.sigma
        with np.errstate(divide="ignore", invalid="ignore"):
            tail = np.exp(-y) if abs(self.xi) < 1e-9 else np.maximum(1 + self.xi * y, 0.0) ** (-1 / self.xi)
        below = 1 - np.searchsorted(self.body, x, "left") / len(self.body)
        return np.where(x > self.u, self.share * tail, below)

    def isf(self, p_fa):
        """Threshold."""
        _check_p(p_fa)
        if self.n_effective * p_fa < 1 - 1e-9:
            raise ValueError(
                f"p_fa = {p_fa:g} needs at least {math.ceil(1 / p_fa)} independent training epochs for a tail fit, "
                f"there are {self.n_effective:.0f}"
            )
        if p_fa >= self.share:
            return float(np.quantile(self.body, 1 - p_fa))
        return self.u + _pareto_quantile(self.xi, self.sigma, p_fa / self.share)

    def interval(self, p_fa, confidence=0.95, seed=0, n_boot=300):
        """Bootstrap of the excesses, as many as the effective number holds."""
        self.isf(p_fa)
        excess = self.body[self.body > self.u] - self.u
        m = max(50, round(len(excess) * self.n_effective / len(self.body)))
        rng = np.random.Generator(np.random.Philox(seed))
        n = round(m / self.share)
        out = []
        for _ in range(n_boot):
            xi, sigma = _pareto_moments(np.sort(excess[rng.integers(0, len(excess), m)]))
            share = rng.binomial(n, self.share) / n
            out.append(self.u + _pareto_quantile(xi, sigma, min(p_fa / share, 1.0)))
        alpha = 0.5 * (1 - confidence)
        return tuple(float(x) for x in np.quantile(out, [alpha, 1 - alpha]))


def _pareto_moments(excess):
    """(xi, sigma) of ascending excesses; xi is kept below 1/2, where the method has variance."""
    m = len(excess)
    a0 = excess.mean()
    a1 = np.mean((1 - (np.arange(1, m + 1) - 0.35) / m) * excess)
    xi = min(2 - a0 / (a0 - 2 * a1), 0.49)
    return float(xi), float(a0 * (1 - xi))


def _pareto_quantile(xi, sigma, p):
    return sigma * (-math.log(p) if abs(xi) < 1e-9 else (p**-xi - 1) / xi)


@dataclass(frozen=True)
class AnalyticNull:
    """Maximum of N_eff independent Exp(1) bins, far out: sf = N_eff e^-x (the GLRT of ``monitors.glrt``)."""

    n_bins: float
    n_bins_low: float
    n_bins_high: float
    rule: str = "analytic"

    @classmethod
    def fit(cls, values, tail=1e-3, n_effective=None):
        """N_eff = e^t P(X > t) at the ``tail`` quantile t of quiet values, with its binomial interval."""
        values, n = _checked(values, n_effective)
        if n * tail < _LEAST_EVENTS:
            raise ValueError(
                f"{n:.0f} independent values hold too few beyond the {tail:g} tail: train on "
                f"{math.ceil(_LEAST_EVENTS / tail)} epochs"
            )
        t = float(np.quantile(values, 1 - tail))
        half = 1.96 * math.sqrt(tail / n)
        return cls(*(math.exp(t) * p for p in (tail, max(tail - half, 0.0), tail + half)))

    def sf(self, x):
        """P(false alarm) at threshold x."""
        return np.minimum(self.n_bins * np.exp(-np.asarray(x, float)), 1.0)

    def isf(self, p_fa):
        """Threshold ln(N_eff / P_FA)."""
        _check_p(p_fa)
        return math.log(self.n_bins / p_fa)

    def interval(self, p_fa):
        """From the interval of N_eff."""
        return math.log(self.n_bins_low / p_fa), math.log(self.n_bins_high / p_fa)
