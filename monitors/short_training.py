"""Null models of a statistic that a training of seconds has standardised: Student's t, Fisher's F, a slow wander.

Like those of ``monitors.threshold`` they behave as frozen distributions (``sf``, ``isf``, ``rule``), and what the
training leaves open is in the distribution itself: its tail is longer, the shorter the training was.
"""

import math
from dataclasses import dataclass

import numpy as np

__all__ = ["FisherNull", "StudentNull", "WanderNull", "independent_values"]

LEAST_VALUES = 5
"""Independent training values below which no threshold is given."""


def independent_values(values):
    """Number of independent values in a series: n (1 - r) / (1 + r), r its correlation at lag one.

    Exact for the mean of a first-order process (Bayley & Hammersley, J. Roy. Stat. Soc. Suppl. 8, 1946). An r that
    independent values would show once in forty times, up to 2 / sqrt(n), counts as none.
    """
    x = np.asarray(values, float)
    x = x - x.mean()
    power = float(x @ x)
    r = float(x[1:] @ x[:-1]) / power if power > 0 else 0.0
    return len(x) * (1 - r) / (1 + r) if r > 2 / math.sqrt(len(x)) else float(len(x))


def _check(n, remedy):
    if n < LEAST_VALUES:
        raise ValueError(
            f"{n:.1f} independent training values are too few for a threshold, at least {LEAST_VALUES} are needed: {remedy}"
        )


@dataclass(frozen=True)
class StudentNull:
    """A Gaussian quantity less the mean of its training, over the training's standard deviation.

    P(x > t) = P(t_{n-1} > (t - shift) / sqrt(1 + 1/n)), doubled where the modulus is tested; n independent training values.
    """

    n_effective: float
    two_sided: bool = False
    shift: float = 0.0
    rule: str = "student"

    @classmethod
    def fit(cls, values, two_sided=False, rise=0.0):
        """From the training's own values, in time order; ``rise``, in their unit, is allowed for besides."""
        n = independent_values(values)
        _check(n, "lengthen training_s, or give expect_multipath where the signal fades")
        return cls(n, two_sided, rise / max(float(np.std(values, ddof=1)), 1e-12))

    def sf(self, x):
        """P(false alarm) at threshold x."""
        from scipy.stats import t

        return (2 if self.two_sided else 1) * t.sf(
            (np.asarray(x) - self.shift) / self._scale(), self.n_effective - 1
        )

    def isf(self, p_fa):
        """Threshold."""
        from scipy.stats import t

        quantile = float(t.isf(p_fa / (2 if self.two_sided else 1), self.n_effective - 1))
        return quantile * self._scale() + self.shift

    def _scale(self):
        return math.sqrt(1 + 1 / self.n_effective)


@dataclass(frozen=True)
class FisherNull:
    """A multiple of a chi-square, whose size and degrees come from the training's mean and variance.

    x ~ mean F(d, n d) with d = 2 mean^2 / variance (Satterthwaite, Biometrics Bulletin 2, 1946): samples that hang
    together, or a level that wanders, spread a chi-square more than independent ones would.
    """

    mean: float
    degrees: float
    n_effective: float
    rule: str = "fisher"

    @classmethod
    def fit(cls, values, most_degrees):
        """From the training's own values, in time order; independent data have ``most_degrees``."""
        x = np.asarray(values, float)
        n = independent_values(x)
        _check(n, "lengthen training_s")
        return cls(float(x.mean()), float(min(2 * x.mean() ** 2 / x.var(ddof=1), most_degrees)), n)

    def sf(self, x):
        """P(false alarm) at threshold x."""
        from scipy.stats import f

        return f.sf(np.asarray(x) / self.mean, self.degrees, self.degrees * self.n_effective)

    def isf(self, p_fa):
        """Threshold."""
        from scipy.stats import f

        return self.mean * float(f.isf(p_fa, self.degrees, self.degrees * self.n_effective))


@dataclass(frozen=True)
class WanderNull:
    """A Gaussian quantity that wanders slowly: variance 1 (the training's) + ``wander``^2, in training units."""

    wander: float
    rule: str = "wander"

    @classmethod
    def fit(cls, values, wander):
        """From the training's values and the standard deviation of the slow changes, both in the same unit."""
        sd = float(np.std(values, ddof=1)) if len(values) > 1 else math.inf
        if sd > wander:
            raise ValueError(
                f"it varied by {sd:.3g} in training already, more than the {wander:g} that it may wander by"
            )
        return cls(wander / max(sd, 1e-12))

    def sf(self, x):
        """P(false alarm) at threshold x."""
        from scipy.special import ndtr

        return ndtr(-np.asarray(x) / math.hypot(1.0, self.wander))

    def isf(self, p_fa):
        """Threshold."""
        from scipy.special import ndtri

        return float(-ndtri(p_fa)) * math.hypot(1.0, self.wander)
