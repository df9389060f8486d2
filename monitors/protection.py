"""Protection levels, innovation tests and the Stanford diagram: what a claimed position error is worth.

Least squares with weights W = R^-1: the position error and the residual statistic T^2 = r' P r (P the parity weight of
``monitors.bias_bank``) are independent; a bias b on satellite i moves the first by S_i b and makes the second
non-central chi-square with non-centrality P_ii b^2. The protection level of satellite i is therefore the smallest L with

    max_b  P(|e| > L | b) P(T^2 < threshold | b)  p_fault  <=  its share of P_HMI ,

solved here without the usual slope-times-bias approximation (Brown and Chin 1998 drop the noise of e). With the fault-free
term added, P_HMI is bounded for at most one faulty satellite and Gaussian errors of the variances given.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numba import njit
from pydantic import BaseModel, ConfigDict, Field

from monitors.bias_bank import SINGULAR, chi2_limit, whitened_parity
from nav.eskf import EpochLog

STANFORD = ("available", "misleading", "unavailable", "unavailable misleading", "hazardous")


class Protection(BaseModel):
    """Scenario section: allocation of the integrity risk.

    ``p_hmi`` per approach (2e-7 for APV), shared equally by vertical and horizontal, and in each by the fault-free case
    and every satellite; ``p_fault`` prior probability of a fault of one satellite per approach; ``p_false_alarm`` of the
    residual test per epoch; ``independent_epochs`` in one approach.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    kind: Literal["protection"] = "protection"
    p_hmi: float = Field(2e-7, gt=0, lt=1)
    """Integrity risk per approach."""
    p_fault: float = Field(1e-4, gt=0, lt=1)
    """Prior probability of a fault of one satellite per approach."""
    p_false_alarm: float = Field(1.6e-5, gt=0, lt=1)
    """False-alarm probability of the residual test per epoch."""
    independent_epochs: int = Field(1, ge=1, le=100_000)
    """Independent epochs in one approach."""


@dataclass(frozen=True)
class Levels:
    """``hpl_m``, ``vpl_m``; ``threshold`` of T^2 on ``dof``; ``sigma_enu_m`` of the solution; ``worst`` satellite
    (vertical) and the bias on it that decides, m.
    """

    hpl_m: float
    vpl_m: float
    threshold: float
    dof: int
    sigma_enu_m: np.ndarray
    worst: int
    worst_bias_m: float


def solution(h_enu: np.ndarray, var: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weighted least squares: (S (q, m), covariance (q, q), parity weight P (m, m)); columns 0-2 are east, north, up."""
    m, q = h_enu.shape
    if not np.all(np.asarray(var) > 0):
        raise ValueError("Protection levels need measurement variances above zero.")
    value = np.linalg.svd(h_enu / np.sqrt(var)[:, None], compute_uv=False) if m else np.zeros(1)
    if m < q + 1:
        raise ValueError(f"Protection levels need {q + 1} satellites to see a fault, {m} are in use.")
    if value[-1] <= SINGULAR * value[0]:
        raise ValueError("The satellite geometry is singular: no position, hence no protection level.")
    w = np.diag(1.0 / np.asarray(var, dtype=np.float64))
    cov = np.linalg.inv(h_enu.T @ w @ h_enu)
    s = cov @ h_enu.T @ w
    return s, cov, w - w @ h_enu @ s


def _vertical_tail(level, shift, sigma):
    from scipy.special import ndtr

    return ndtr((shift - level) / sigma) + ndtr((-shift - level) / sigma)


def _horizontal_tail(level, shift, sigma):
    """P(|e_h| > level) <= that of an isotropic error of the larger standard deviation, moved by ``shift``."""
    from scipy.stats import ncx2

    return ncx2.sf((level / sigma) ** 2, 2, np.maximum((shift / sigma) ** 2, 1e-12))


def _risk(tail, level, slope, parity, sigma, threshold, dof, bias):
    """Probability of a missed and large error for each bias of the grid."""
    from scipy.stats import ncx2

    missed = ncx2.cdf(threshold, dof, np.maximum(parity * bias**2, 1e-12))
    return tail(level, slope * bias, sigma) * missed


def _level(tail, allowed, slope, parity, sigma, threshold, dof) -> tuple[float, float]:
    """Smallest level with risk <= ``allowed`` at every bias, and the deciding bias; bisection to 1e-4 of the level."""
    from scipy.special import ndtri

    if parity <= SINGULAR / sigma**2:
        return np.inf, np.nan
    reach = (np.sqrt(threshold) + 8.0) / np.sqrt(parity)
    bias = np.linspace(0.0, reach, 400)
    low, high = 0.0, slope * reach + (4.0 - ndtri(min(allowed, 0.5) / 4)) * sigma
    while high - low > 1e-4 * high:
        middle = 0.5 * (low + high)
        risk = _risk(tail, middle, slope, parity, sigma, threshold, dof, bias)
        low, high = (low, middle) if risk.max() <= allowed else (middle, high)
    return high, float(bias[np.argmax(_risk(tail, high, slope, parity, sigma, threshold, dof, bias))])


def protection_levels(h_enu: np.ndarray, var: np.ndarray, spec: Protection) -> Levels:
    """Horizontal and vertical protection level of one epoch.

    Parameters
    ----------
    h_enu : (m, q)
        Geometry: east, north, up, then one column of ones per clock.
    var : (m,)
        Variances, m^2.
    spec : Protection
        The allocation.

    Raises
    ------
    ValueError
        Fewer than q + 1 satellites, singular geometry, or a variance that is not positive.
    """
    from scipy.stats import chi2

    s, cov, parity = solution(h_enu, var)
    m, q = h_enu.shape
    dof = m - q
    threshold = float(chi2.isf(spec.p_false_alarm, dof))
    part = 0.5 * spec.p_hmi / spec.independent_epochs / (m + 1)
    sigma = np.sqrt(np.diag(cov)[:3])
    major = float(np.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1]))
    # A conditional risk above 1 needs no protection: the fault itself is rarer than its share.
    allowed = min(part / spec.p_fault, 1.0)
    vertical = [
        _level(_vertical_tail, allowed, abs(s[2, i]), parity[i, i], sigma[2], threshold, dof)
        for i in range(m)
    ]
    slope = np.hypot(s[0], s[1])
    horizontal = [
        _level(_horizontal_tail, allowed, slope[i], parity[i, i], major, threshold, dof) for i in range(m)
    ]
    free_v = float(chi2.isf(part, 1) ** 0.5 * sigma[2])
    free_h = float(chi2.isf(part, 2) ** 0.5 * major)
    worst = int(np.argmax([v for v, _ in vertical]))
    hpl, vpl = max(free_h, *(v for v, _ in horizontal)), max(free_v, *(v for v, _ in vertical))
    return Levels(hpl, vpl, threshold, dof, sigma, worst, vertical[worst][1])


LEAST_SEEN = 10**-4.5
"""Least sqrt(P_ii) sigma of a satellite whose fault the test may see."""
SLOPE_STEP = 1.03
"""Slopes are rounded up to this ratio, so that a level is computed once and not every epoch."""


@lru_cache(maxsize=32)
def _missed(threshold: float, dof: int) -> tuple[np.ndarray, np.ndarray]:
    """Biases of unit non-centrality, and the probability that the test misses each."""
    from scipy.special import chndtr

    bias = np.linspace(0.0, math.sqrt(threshold) + 8.0, 400)
    return bias, chndtr(threshold, dof, np.maximum(bias**2, 1e-12))


def _unit_tail(vertical: bool):
    """``_vertical_tail`` or ``_horizontal_tail`` of unit sigma, a function of level and shift."""
    from scipy.special import chndtr, ndtr

    if vertical:
        return lambda level, shift: ndtr(shift - level) + ndtr(-shift - level)
    return lambda level, shift: 1.0 - chndtr(level**2, 2, np.maximum(shift**2, 1e-12))


@lru_cache(maxsize=4096)
def _unit_level(vertical: bool, k: int, allowed: float, threshold: float, dof: int) -> float:
    """Level of unit sigma for the slope SLOPE_STEP^k per unit of sqrt(non-centrality); as ``_level``, to 1e-4.

    The bias that seems to ask most, by one side of one dimension, is bisected alone; those that its level does not satisfy
    are left, if any, and so on.
    """
    from scipy.special import ndtri

    bias, missed = _missed(threshold, dof)
    live = missed > allowed
    shift, may = SLOPE_STEP**k * bias[live], allowed / missed[live]
    tail, low, high = _unit_tail(vertical), 0.0, 0.0
    worst = int(np.argmax(shift - ndtri(may))) if shift.size else 0
    while shift.size:
        high = float(shift[worst] + 4.0 - ndtri(may[worst] / 4))
        while high - low > 1e-4 * high:
            middle = 0.5 * (low + high)
            over = tail(middle, shift[worst]) > may[worst]
            low, high = (middle, high) if over else (low, middle)
        # Either tail is at most exp(-(level - shift)^2 / 2) above the shift (Simon and Alouini 2000, IEEE Trans. Commun. 48, 359).
        may_be = np.exp(-0.5 * np.maximum(high - shift, 0.0) ** 2) > may
        shift, may = shift[may_be], may[may_be]
        ratio = tail(high, shift) / may
        low, left = high, ratio > 1.0
        shift, may, ratio = shift[left], may[left], ratio[left]
        worst = int(np.argmax(ratio)) if ratio.size else 0
    return high


@njit(cache=True, nogil=True)
def steepest(h_enu, var):
    """(rank, horizontal sigma along its major axis, vertical sigma, and of either the largest slope of a satellite).

    Slope: S_i / sqrt(P_ii) over sigma, infinite where no test sees the satellite; see ``solution``. All is 0 below full rank.
    """
    m, q = h_enu.shape
    parity = np.empty((m, m))
    rank, _ = whitened_parity(h_enu, var, parity)
    if rank < q or m <= q:
        return rank, 0.0, 0.0, 0.0, 0.0
    weighted = np.ascontiguousarray(h_enu.T) / var
    cov = np.linalg.inv(np.dot(weighted, h_enu))
    s = np.dot(cov, weighted)
    half = 0.5 * (cov[0, 0] - cov[1, 1])
    major = math.sqrt(0.5 * (cov[0, 0] + cov[1, 1]) + math.hypot(half, cov[0, 1]))
    up = math.sqrt(cov[2, 2])
    across, along = 0.0, 0.0
    for i in range(m):
        seen = math.sqrt(parity[i, i]) if parity[i, i] > 0.0 else 0.0
        across = max(
            across, math.hypot(s[0, i], s[1, i]) / (seen * major) if seen * major > LEAST_SEEN else math.inf
        )
        along = max(along, abs(s[2, i]) / (seen * up) if seen * up > LEAST_SEEN else math.inf)
    return rank, major, up, across, along


def quick_levels(h_enu: np.ndarray, var: np.ndarray, spec: Protection) -> tuple[float, float]:
    """(HPL, VPL) as ``protection_levels``, at most ``SLOPE_STEP`` larger, from a table that fills itself.

    With b' = b sqrt(P_ii) the risk of satellite i depends on its slope S_i / sqrt(P_ii) over sigma alone, and grows with it.
    """
    m, q = h_enu.shape
    rank, major, up, *slopes = steepest(np.ascontiguousarray(h_enu), np.ascontiguousarray(var))
    if rank < q or m <= q:
        solution(h_enu, var)
        return math.inf, math.inf
    if math.inf in slopes:
        return math.inf, math.inf
    threshold = chi2_limit(m - q, spec.p_false_alarm)
    part = 0.5 * spec.p_hmi / spec.independent_epochs / (m + 1)
    allowed = min(part / spec.p_fault, 1.0)
    levels = []
    for vertical, slope in enumerate(slopes):
        k = math.ceil(math.log(max(slope, 1e-3)) / math.log(SLOPE_STEP))
        free = math.sqrt(chi2_limit(2 - vertical, part))
        levels.append(max(free, _unit_level(bool(vertical), k, allowed, threshold, m - q)))
    return levels[0] * major, levels[1] * up


@njit(cache=True, nogil=True)
def all_positive(var, seen):
    """Whether the variances of all rows i < ``var.size`` that were ``seen`` are above zero."""
    for i in range(var.size):
        if seen[i] and not var[i] > 0.0:
            return False
    return True


@njit(cache=True, nogil=True)
def innovation_ratios(h, p, z, var, seen, out):
    """z_i^2 / (h_i P h_i' + R_i) of the rows i < ``var.size`` that were ``seen``, in a row into ``out``."""
    k = 0
    for i in range(var.size):
        if not seen[i]:
            continue
        s = var[i]
        for a in range(p.shape[0]):
            if h[i, a] != 0.0:
                for b in range(p.shape[0]):
                    s += h[i, a] * p[a, b] * h[i, b]
        out[k] = z[i] * z[i] / s
        k += 1


def innovation_chi2(log: EpochLog, p_false_alarm: float) -> tuple[np.ndarray, float]:
    """Per-row innovation test: r_i^2 / S_ii (E, m), NaN where not used, and its chi-square_1 threshold."""
    from scipy.stats import chi2

    if not 0 < p_false_alarm < 1:
        raise ValueError(f"The false-alarm probability must lie between 0 and 1, not {p_false_alarm}.")
    variance = np.diagonal(log.s, axis1=1, axis2=2)
    ratio = np.where(log.used, log.r**2 / np.where(log.used, variance, 1.0), np.nan)
    return ratio, float(chi2.isf(p_false_alarm, 1))


def stanford(error_m: np.ndarray, level_m: np.ndarray, alert_limit_m: float) -> dict[str, int]:
    """Counts of the Stanford diagram's regions over epochs.

    available: error <= level <= limit; misleading: level < error <= limit or limit < both with level < error
    ("unavailable misleading"); unavailable: level > limit; hazardous: level <= limit < error (HMI).
    """
    error, level = np.abs(np.asarray(error_m)), np.asarray(level_m)
    if error.shape != level.shape or not alert_limit_m > 0:
        raise ValueError(
            "The Stanford diagram needs as many errors as levels, and an alert limit above zero."
        )
    out = level > alert_limit_m
    wrong = error > level
    hazardous = ~out & (error > alert_limit_m)
    counts = (~out & ~wrong, ~out & wrong & ~hazardous, out & ~wrong, out & wrong, hazardous)
    return dict(zip(STANFORD, (int(c.sum()) for c in counts)))
