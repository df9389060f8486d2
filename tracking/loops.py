"""Digital loop filters: gains whose discrete noise bandwidth is exactly what was asked for, and thermal
jitter.

Carrier loop (rate-only NCO, mid-interval phase; Stephens & Thomas, IEEE Trans. AES 31(1), 1995). With the
error e_k (cycles) of integration k, T its length,

    a += K3 e_k / T^2,   v += K2 e_k / T + a T,   f_{k+1} = v + K1 e_k / T

and the phase at mid-interval advances by (f_k + f_{k+1}) T / 2. Third order: a triple real pole at p; the
fourth pole r follows from the characteristic polynomial at w = z^-1 = -1: (1 + p)^3 (1 + r) = 8. Second
order: K2 = K1^2 / 2 (damping 1/sqrt(2) in the continuous limit), because a double pole cannot reach B T =
0.3.

All of v, a and f are in units of time, not of integrations: gains may change from one integration to the next and
the NCO goes on without a step.
"""

import math
from functools import lru_cache

import numpy as np

from signals.constants import METRES_PER_CHIP, WAVELENGTH_M

__all__ = [
    "ADAPT_LOW_DBHZ",
    "MAX_BT",
    "adapted_dll_bw_hz",
    "adapted_gains",
    "adapted_pll_bw_hz",
    "dll_gains",
    "dll_jitter_chips",
    "fll_gain",
    "pll_gains",
    "pll_jitter_cycles",
    "pll_noise_bandwidth_t",
]

MAX_BT = 0.3
"""Largest noise bandwidth times integration time that is accepted; poles go beyond control above about 0.4.
"""


def _triple_pole(p):
    """K1, K2, K3 of the third-order loop with a triple pole at p."""
    r = 8.0 / (1.0 + p) ** 3 - 1.0
    # (1-w)^3 + (w + w^2)/2 (a0 + a1 w + a2 w^2) = (1 - p w)^3 (1 - r w), compared power by power.
    a2 = 2.0 * p**3 * r
    a0 = 2.0 * (3.0 - 3.0 * p - r)
    a1 = 2.0 * (3.0 * p * p + 3.0 * p * r - 3.0) - a0
    return a2, -a1 - 2.0 * a2, a0 + a1 + a2


def pll_noise_bandwidth_t(gains):
    """B T of the carrier loop with (K1, K2, K3): half the energy of its closed-loop impulse response.

    2 B T = sum h_k^2 = (1 / 2 pi j) contour |H(z)|^2 dz / z, h the response of the mid-interval phase.
    """
    k1, k2, k3 = gains
    # State before integration k: mid-interval phase th, its rate f (per T), v, a. e = u - th.
    A = np.array(
        [
            [1.0 - 0.5 * (k1 + k2 + k3), 0.5, 0.5, 0.5],
            [-(k1 + k2 + k3), 0.0, 1.0, 1.0],
            [-(k2 + k3), 0.0, 1.0, 1.0],
            [-k3, 0.0, 0.0, 1.0],
        ]
    )
    b = np.array([0.5 * (k1 + k2 + k3), k1 + k2 + k3, k2 + k3, k3])
    if k3 == 0.0:
        A, b = A[:3, :3], b[:3]
    n = len(b)
    if np.max(np.abs(np.linalg.eigvals(A))) >= 1.0:
        return math.inf
    P = np.linalg.solve(np.eye(n * n) - np.kron(A, A), np.outer(b, b).ravel()).reshape(n, n)
    return 0.5 * P[0, 0]


@lru_cache(maxsize=256)
def pll_gains(order, bw_hz, T_s):
    """(K1, K2, K3) of the carrier loop of ``order`` 2 or 3 with noise bandwidth ``bw_hz`` at interval
    ``T_s``.

    Raises
    ------
    ValueError
        B T above MAX_BT, or not positive, or another order.
    """
    if order not in (2, 3):
        raise ValueError(f"PLL order {order}: use 2 or 3")
    _check_bt("PLL", bw_hz, T_s)
    design = _triple_pole if order == 3 else lambda x: (1.0 - x, 0.5 * (1.0 - x) ** 2, 0.0)
    low, high = 0.7 if order == 3 else 0.4, 1.0 - 1e-9  # here the bandwidth falls as the parameter grows
    for _ in range(80):
        x = 0.5 * (low + high)
        if pll_noise_bandwidth_t(design(x)) > bw_hz * T_s:
            low = x
        else:
            high = x
    return design(high)


@lru_cache(maxsize=256)
def dll_gains(order, bw_hz, T_s):
    """(K1, K2) of the code loop: phase += K1 e + T rate, rate += K2 e / T, noise bandwidth ``bw_hz``.

    Order 1: K1 = 4 B T / (1 + 2 B T), from 2 B T = K1 / (2 - K1). Order 2: double pole p, K1 = 1 - p^2,
    K2 = (1 - p)^2, the rate updated before it is used.
    """
    if order not in (1, 2):
        raise ValueError(f"DLL order {order}: use 1 or 2")
    _check_bt("DLL", bw_hz, T_s)
    bt = bw_hz * T_s
    if order == 1:
        return 4.0 * bt / (1.0 + 2.0 * bt), 0.0
    low, high = 0.0, 1.0
    for _ in range(80):
        p = 0.5 * (low + high)
        if _dll2_bandwidth_t(1.0 - p * p, (1.0 - p) ** 2) > bt:
            low = p
        else:
            high = p
    return 1.0 - high * high, (1.0 - high) ** 2


def _dll2_bandwidth_t(k1, k2):
    A = np.array([[1.0 - k1 - k2, 1.0], [-k2, 1.0]])
    b = np.array([k1 + k2, k2])
    P = np.linalg.solve(np.eye(4) - np.kron(A, A), np.outer(b, b).ravel()).reshape(2, 2)
    return 0.5 * P[0, 0]


def fll_gain(bw_hz, T_s):
    """Gain of the first-order frequency assistance v += K e_f, K = 4 B T / (1 + 2 B T); 0 switches it off."""
    if bw_hz == 0.0:
        return 0.0
    _check_bt("FLL", bw_hz, T_s)
    return 4.0 * bw_hz * T_s / (1.0 + 2.0 * bw_hz * T_s)


ADAPT_LOW_DBHZ, ADAPT_ROWS = 5, 61
"""Grid of ``adapted_gains``: C/N0 from 5 to 65 dB-Hz, 1 dB apart."""
_TRIPLE_POLE_BW = 33.0 / 32.0


def adapted_pll_bw_hz(cn0_dbhz, T_s, jerk_mps3, costas=True):
    """Noise bandwidth of the third-order carrier loop with the least sum of noise variance and squared dynamic stress.

    sigma^2(B) + theta^2(B) = a B + (j (33/32)^3 / B^3)^2, a from ``pll_jitter_cycles``, theta = j / w^3 the lag under a
    jerk of j cycles/s^3 of a loop with a triple pole at w = 32/33 B; so B = (6 c^2 / a)^(1/7) with c = j (33/32)^3. The
    criterion is that of Jaffe & Rechtin (IRE Trans. Inf. Theory 1(1), 1955, noise plus weighted squared transient), the
    terms are Kaplan & Hegarty's (section 5.6).
    """
    a = pll_jitter_cycles(cn0_dbhz, 1.0, T_s, costas) ** 2
    c = jerk_mps3 / WAVELENGTH_M * _TRIPLE_POLE_BW**3
    return (6.0 * c * c / a) ** (1.0 / 7.0)


def adapted_dll_bw_hz(jitter_chips, drift_mps):
    """The same for the first-order code loop: a B + (v / 4 B)^2 is least at B = (v^2 / (8 a))^(1/3).

    ``jitter_chips``: ``dll_jitter_chips`` of 1 Hz; ``drift_mps``: rate v at which the code leaves the carrier that aids it.
    """
    v = drift_mps / METRES_PER_CHIP
    return (v * v / (8.0 * jitter_chips**2)) ** (1.0 / 3.0)


@lru_cache(maxsize=64)
def adapted_gains(pll_hz, dll_hz, fll_hz, T_s, costas, slope, spacing_chips, jerk_mps3, drift_mps):
    """Gains of the loops against C/N0, (ADAPT_ROWS, 7): K1, K2, K3, of the code loop, of the frequency aid, and both B.

    ``pll_hz``, ``dll_hz``: (least, greatest) noise bandwidth, between which the laws above choose; the frequency aid, of
    ``fll_hz`` at the greatest, keeps its share of the carrier loop's.
    """
    cn0 = ADAPT_LOW_DBHZ + np.arange(float(ADAPT_ROWS))
    jitter = dll_jitter_chips(cn0, 1.0, T_s, spacing_chips, slope, 1.0 - slope * spacing_chips)
    pll = np.clip(adapted_pll_bw_hz(cn0, T_s, jerk_mps3, costas), *pll_hz)
    dll = np.clip(adapted_dll_bw_hz(jitter, drift_mps), *dll_hz)
    rows = [
        (*pll_gains(3, p, T_s), dll_gains(1, d, T_s)[0], fll_gain(fll_hz * p / pll_hz[1], T_s), p, d)
        for p, d in zip(pll.tolist(), dll.tolist())
    ]
    return np.array(rows)


def _check_bt(name, bw_hz, T_s):
    if not (bw_hz > 0.0 and T_s > 0.0):
        raise ValueError(f"{name} bandwidth {bw_hz:g} Hz at T = {T_s * 1e3:g} ms: both must be positive")
    if bw_hz * T_s > MAX_BT * (1.0 + 1e-9):
        raise ValueError(
            f"{name} bandwidth {bw_hz:g} Hz at T = {T_s * 1e3:g} ms gives B_L T = {bw_hz * T_s:.3g}, above "
            f"{MAX_BT:g} where a digital loop is no longer stable; use at most {MAX_BT / T_s:.3g} Hz or a "
            "shorter integration"
        )


def pll_jitter_cycles(cn0_dbhz, bw_hz, T_s, costas=True):
    """Thermal phase jitter, sigma^2 = B / (C/N0) (1 + 1 / (2 T C/N0)) rad^2 (Kaplan & Hegarty, eq. 5.7).

    The squaring-loss term belongs to Costas discriminators; a pure PLL has none.
    """
    cn0 = 10.0 ** (np.asarray(cn0_dbhz, float) / 10.0)
    return np.sqrt(bw_hz / cn0 * (1.0 + (0.5 / (T_s * cn0) if costas else 0.0))) / (2.0 * np.pi)


def dll_jitter_chips(cn0_dbhz, bw_hz, T_s, spacing_chips, slope=1.0, r_d=None, coherent=False):
    """Thermal code jitter of an early-late loop, in chips.

    sigma^2 = B (1 - R(d)) / (2 slope^2 C/N0) [1 + (1 + R(d)) / (2 R(d/2)^2 T C/N0) ]; for BPSK, R(d) = 1 - d
    and slope 1 it is B d / (2 C/N0) (1 + 2 / ((2 - d) T C/N0)) (Kaplan & Hegarty, eq. 5.13 with a wide front
    end; derived from the noise covariance s^2 R(d_i - d_j) of the taps).

    Parameters
    ----------
    slope : float
        |R'(d/2)|, 1 / chips. ``r_d``: R(d), default BPSK. ``coherent`` drops the squaring loss.
    """
    cn0 = 10.0 ** (np.asarray(cn0_dbhz, float) / 10.0)
    r_d = 1.0 - spacing_chips if r_d is None else r_d
    r_half_sq = (1.0 - 0.5 * spacing_chips * slope) ** 2
    loss = 0.0 if coherent else (1.0 + r_d) / (2.0 * r_half_sq * T_s * cn0)
    return np.sqrt(bw_hz * (1.0 - r_d) / (2.0 * slope**2 * cn0) * (1.0 + loss))
