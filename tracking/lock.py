"""Lock detectors and C/N0 estimators: pure functions of smoothed moments, compiled into ``kernels.py``.

(As for the discriminators: clear ``tracking/__pycache__`` after editing this file.)
"""

import math

from numba import njit

__all__ = [
    "STATE_BIT_SYNC",
    "STATE_IDLE",
    "STATE_LOCKED",
    "STATE_LOST",
    "STATE_PULL_IN",
    "carrier_lock",
    "cn0_moments_dbhz",
    "cn0_noise_reference_dbhz",
    "code_lock",
]

STATE_IDLE, STATE_PULL_IN, STATE_BIT_SYNC, STATE_LOCKED, STATE_LOST = 0, 1, 2, 3, 4


@njit(cache=True)
def cn0_noise_reference_dbhz(prompt_power, n_samples, sample_noise_power, n_noise, fs_hz):
    """C/N0 = fs (mean |P|^2 / s^2 - 1 / n), s^2 the noise power of one sample from the reference tap.

    The mean of 1 / s^2 estimated from ``n_noise`` exponential variables is n / (n - 1) too large: removed.
    Returns 0 dB-Hz where the estimate is below 1 Hz (no signal seen).
    """
    if sample_noise_power <= 0.0:
        return 0.0
    bias = (n_noise - 1.0) / n_noise if n_noise > 1.0 else 1.0
    cn0 = fs_hz * (prompt_power / sample_noise_power * bias - 1.0 / n_samples)
    return 10.0 * math.log10(cn0) if cn0 > 1.0 else 0.0


@njit(cache=True)
def cn0_moments_dbhz(m2, m4, n, T_s):
    """C/N0 = A^2 / (2 T v) from the in-phase prompt alone: A^4 = (3 M2^2 - M4) / 2, noise variance v = M2 - A^2.

    M2, M4: means of I^2 and I^4 over ``n`` integrations. For I = +-A + noise, M2 = A^2 + v and M4 = A^4 + 6
    A^2 v + 3 v^2, so the data sign does not matter (the real-valued form of Pauluzzi & Beaulieu, IEEE Trans.
    Commun. 48(10), 2000, eq. 30). The factor (n - 3) / n removes the bias of
    the inverse of a sample variance.
    """
    a4 = 0.5 * (3.0 * m2 * m2 - m4)
    if a4 <= 0.0 or n < 5.0:
        return 0.0
    a2 = math.sqrt(a4)
    var = m2 - a2
    if var <= 0.0:
        return 0.0
    cn0 = a2 / (2.0 * T_s * var) * (n - 3.0) / n
    return 10.0 * math.log10(cn0) if cn0 > 1.0 else 0.0


@njit(cache=True)
def carrier_lock(i2_minus_q2, i2_plus_q2, noise_power):
    """Mean cos(2 phi) = <I^2 - Q^2> / (<I^2 + Q^2> - noise) (Van Dierendonck 1996, eq. 120, noise removed)."""
    if i2_plus_q2 <= 0.0:
        return 0.0
    signal = max(i2_plus_q2 - noise_power, 0.2 * i2_plus_q2)
    return i2_minus_q2 / signal


@njit(cache=True)
def code_lock(early_late_power, prompt_power, noise_power, r_half):
    """1 on the peak, 0 where E, P and L are alike: (1 - (|E|^2 + |L|^2) / (2 |P|^2)) / (1 - R(d/2)^2).

    All powers smoothed; ``noise_power`` of one tap is removed from each.
    """
    p = prompt_power - noise_power
    if p <= 0.0 or r_half >= 1.0:
        return 0.0
    return (1.0 - 0.5 * (early_late_power - 2.0 * noise_power) / p) / (1.0 - r_half * r_half)
