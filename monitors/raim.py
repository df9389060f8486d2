"""Receiver autonomous integrity monitoring on the ranges of one epoch: parity chi-square, and who must be left out.

T^2 = r'W r with W of ``monitors.bias_bank`` is chi-square of m - rank H degrees without fault (Parkinson and Axelrad 1988,
Navigation 35(2), 255-274, in weighted form). Above its quantile the satellite with the largest w-test (W r)_i^2 / W_ii
(Baarda 1968) is left out, and what remains is tested again.
"""

from functools import lru_cache

import numpy as np
from numba import njit

from monitors.bias_bank import chi2_limit, enough, parity_weight, whitened_parity


@lru_cache(maxsize=64)
def limits(most: int, p: float) -> np.ndarray:
    """``chi2_limit`` of 0 .. ``most`` degrees of freedom, infinite for none; not to be written to."""
    return np.array([np.inf] + [chi2_limit(dof, p) for dof in range(1, most + 1)])


@njit(cache=True, nogil=True)
def exclude(residual, h, var, limit, accused):
    """Leave out suspects in turn, their rows into ``accused`` (m,); ``limit`` (m + 1,) of T^2 by degrees of freedom.

    Returns (how many, T^2 over its limit and suspect with everybody in, -1 if untestable, whether it ended for want of rows).
    """
    keep = np.arange(residual.size)
    count, ratio, first = 0, np.nan, -1
    while True:
        k = keep.size
        w, wr = np.empty((k, k)), np.zeros(k)
        part, r = var[keep], residual[keep]
        rank, columns = whitened_parity(h[keep], part, w)
        if not enough(rank, k, columns):
            return count, ratio, first, True
        chi2, suspect, worst = 0.0, 0, -1.0
        for a in range(k):
            for b in range(k):
                wr[a] += w[a, b] * r[b]
            chi2 += r[a] * wr[a]
            test = wr[a] * wr[a] / max(w[a, a], 1e-12 / part[a])
            if test > worst:
                suspect, worst = a, test
        if first < 0:
            ratio, first = chi2 / limit[k - rank], keep[suspect]
        if chi2 < limit[k - rank]:
            return count, ratio, first, False
        accused[count] = keep[suspect]
        count += 1
        for a in range(suspect, k - 1):
            keep[a] = keep[a + 1]
        keep = keep[: k - 1]


def isolate(
    residual: np.ndarray, h: np.ndarray, var: np.ndarray, p_false_alarm: float
) -> tuple[list[int], tuple[float, int] | None, str]:
    """RAIM with exclusion of one epoch: ``residual`` (m,) m, ``h`` (m, q), ``var`` (m,) m^2.

    Returns (suspects in the order in which they were left out, (T^2 / limit, first suspect) or None, why it ended early).
    """
    accused = np.empty(len(residual), np.int64)
    limit = limits(len(residual), p_false_alarm)
    count, ratio, first, ended = exclude(residual, h, var, limit, accused)
    suspects, reason = accused[:count].tolist(), ""
    if ended:
        rest = np.delete(np.arange(len(residual)), suspects)
        try:
            parity_weight(h[rest], var[rest])
        except ValueError as error:
            reason = str(error).replace("The bias bank needs", "RAIM needs")
    return suspects, (float(ratio), int(first)) if first >= 0 else None, reason
