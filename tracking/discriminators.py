"""Carrier, frequency and code discriminators: pure functions of correlator outputs, each with its integer
code.

``kernels.py`` compiles these functions into its own cache entry; numba does not notice a change in *this*
file, so clear ``tracking/__pycache__`` after editing it. To add one: write the function, give it a code, add
a branch to the selecting function below it (a code discriminator: and to ``code_scale_chips``), and name it in
the type that the scenario's keys have and in ``CARRIER_DISCRIMINATORS`` or ``CODE_DISCRIMINATORS``.

Signs (``tracking.records``): phase, frequency and code errors are positive where the incoming signal is ahead
of the replica. E is the replica advanced by half the early-late spacing, so an incoming code that is ahead
favours E.
"""

import math
from typing import Literal

from numba import njit

__all__ = [
    "CARRIER_DISCRIMINATORS",
    "CODE_DISCRIMINATORS",
    "CarrierDiscriminator",
    "CodeDiscriminator",
    "CostasDiscriminator",
    "EarlyLateDiscriminator",
    "carrier_error_cycles",
    "code_error",
    "coherent",
    "costas_atan",
    "costas_product",
    "dot_product",
    "envelope",
    "four_quadrant",
    "frequency_error_hz",
    "power",
    "very_early_late",
]

CostasDiscriminator = Literal["costas_atan", "costas_product"]
"""Carrier discriminators of signals with data."""
CarrierDiscriminator = Literal[CostasDiscriminator, "four_quadrant"]
EarlyLateDiscriminator = Literal["envelope", "power", "dot_product", "coherent"]
CodeDiscriminator = Literal[EarlyLateDiscriminator, "very_early_late"]
COSTAS_ATAN, COSTAS_PRODUCT, FOUR_QUADRANT = 0, 1, 2
CARRIER_DISCRIMINATORS = {
    "costas_atan": COSTAS_ATAN,
    "costas_product": COSTAS_PRODUCT,
    "four_quadrant": FOUR_QUADRANT,
}
ENVELOPE, POWER, DOT_PRODUCT, COHERENT, VERY_EARLY_LATE = 0, 1, 2, 3, 4
CODE_DISCRIMINATORS = {
    "envelope": ENVELOPE,
    "power": POWER,
    "dot_product": DOT_PRODUCT,
    "coherent": COHERENT,
    "very_early_late": VERY_EARLY_LATE,
}
_TWO_PI = 2.0 * math.pi


@njit(cache=True)
def costas_atan(prompt_i, prompt_q):
    """Maximum-likelihood Costas discriminator, atan(Q / I) in (-pi/2, pi/2] -> cycles.

    Insensitive to data signs (Kaplan & Hegarty, Understanding GPS, 2nd ed., table 5.2).
    """
    if prompt_i == 0.0:
        return 0.0 if prompt_q == 0.0 else 0.25
    return math.atan(prompt_q / prompt_i) / _TWO_PI


@njit(cache=True)
def costas_product(prompt_i, prompt_q):
    """Q I / (I^2 + Q^2) = sin(2 phi) / 2, in cycles of phi for small errors (ibid., table 5.2, normalised)."""
    p = prompt_i * prompt_i + prompt_q * prompt_q
    return 0.0 if p == 0.0 else prompt_i * prompt_q / p / _TWO_PI


@njit(cache=True)
def four_quadrant(prompt_i, prompt_q):
    """atan2(Q, I) in (-pi, pi] -> cycles; for pilots whose secondary code is removed (ibid., table 5.3)."""
    return math.atan2(prompt_q, prompt_i) / _TWO_PI


@njit(cache=True)
def carrier_error_cycles(code, prompt_i, prompt_q):
    """The carrier discriminator of integer code ``code``, in cycles."""
    if code == FOUR_QUADRANT:
        return four_quadrant(prompt_i, prompt_q)
    if code == COSTAS_PRODUCT:
        return costas_product(prompt_i, prompt_q)
    return costas_atan(prompt_i, prompt_q)


@njit(cache=True)
def frequency_error_hz(i1, q1, i2, q2, separation_s):
    """atan2(cross, dot) / (2 pi dt) between the two halves of one integration, in Hz.

    cross = I1 Q2 - I2 Q1, dot = I1 I2 + Q1 Q2 (Kaplan & Hegarty, table 5.4). Both halves lie within one data
    symbol, so no sign can turn between them; unambiguous for |df| < 1 / (2 dt), dt = ``separation_s`` = T /
    2.
    """
    cross, dot = i1 * q2 - i2 * q1, i1 * i2 + q1 * q2
    if cross == 0.0 and dot == 0.0:
        return 0.0
    return math.atan2(cross, dot) / (_TWO_PI * separation_s)


@njit(cache=True)
def envelope(ei, eq, li, lq):
    """(|E| - |L|) / (|E| + |L|), without unit; in chips times R(d/2) / |R'(d/2)| (ibid., table 5.5)."""
    e, late = math.sqrt(ei * ei + eq * eq), math.sqrt(li * li + lq * lq)
    return 0.0 if e + late == 0.0 else (e - late) / (e + late)


@njit(cache=True)
def power(ei, eq, li, lq):
    """(|E|^2 - |L|^2) / (|E|^2 + |L|^2), without unit; in chips times R / (2 |R'|) at d/2."""
    e, late = ei * ei + eq * eq, li * li + lq * lq
    return 0.0 if e + late == 0.0 else (e - late) / (e + late)


@njit(cache=True)
def dot_product(ei, eq, pi, pq, li, lq):
    """Re((E - L) conj(P)) / |P|^2, without unit; in chips times R(0) / (2 |R'(d/2)|) (ibid., table 5.5)."""
    p = pi * pi + pq * pq
    return 0.0 if p == 0.0 else ((ei - li) * pi + (eq - lq) * pq) / p


@njit(cache=True)
def coherent(ei, pi, li):
    """(I_E - I_L) / I_P, without unit; in chips times R(0) / (2 |R'(d/2)|). Needs phase lock."""
    return 0.0 if pi == 0.0 else (ei - li) / pi


@njit(cache=True)
def very_early_late(vei, veq, ei, eq, li, lq, vli, vlq):
    """(A - B) / (A + B), A^2 = |VE|^2 + |E|^2, B^2 = |VL|^2 + |L|^2: a BOC discriminator without side zeros.

    In chips times (R_E^2 + R_VE^2) / |R_E R'_E + R_VE R'_VE| (Navarro-Gallardo et al., ION GNSS 2013, eq. 5,
    normalised by the sum).
    """
    a = math.sqrt(vei * vei + veq * veq + ei * ei + eq * eq)
    b = math.sqrt(vli * vli + vlq * vlq + li * li + lq * lq)
    return 0.0 if a + b == 0.0 else (a - b) / (a + b)


@njit(cache=True)
def code_error(code, ve, e, p, late, vl):
    """The code discriminator of integer code ``code`` on complex taps; multiply by its scale to have chips."""
    if code == POWER:
        return power(e.real, e.imag, late.real, late.imag)
    if code == DOT_PRODUCT:
        return dot_product(e.real, e.imag, p.real, p.imag, late.real, late.imag)
    if code == COHERENT:
        return coherent(e.real, p.real, late.real)
    if code == VERY_EARLY_LATE:
        return very_early_late(ve.real, ve.imag, e.real, e.imag, late.real, late.imag, vl.real, vl.imag)
    return envelope(e.real, e.imag, late.real, late.imag)


def code_scale_chips(name, acf, spacing_chips, very_spacing_chips=1.0):
    """Chips per unit of the code discriminator ``name`` for small errors.

    Parameters
    ----------
    acf : callable
        Correlation of the incoming waveform with the replica, R(d), d in chips
        (``signals.modulation.chip_acf``).
    spacing_chips, very_spacing_chips : float
        Early-late and very-early-very-late spacing d (E at +d/2, L at -d/2).

    Raises
    ------
    ValueError
        Where the slope has the wrong sign: E and L do not straddle the main peak.
    """
    h = 1e-3  # chips; averages the two sides of a corner of R
    r = lambda d: float(acf(d))  # noqa: E731
    half, very = 0.5 * spacing_chips, 0.5 * very_spacing_chips
    slope = (r(half - h) - r(half + h)) / (2 * h)
    if slope <= 0.0 or r(half) <= 0.0:
        raise ValueError(
            f"early_late_space_chips = {spacing_chips:g}: E and L do not lie on the slopes of the main peak; "
            "use a smaller spacing"
        )
    if name == "envelope":
        return r(half) / slope
    if name == "power":
        return r(half) / (2 * slope)
    if name in ("dot_product", "coherent"):
        return r(0.0) / (2 * slope)
    if name == "very_early_late":
        slope_very = (abs(r(very - h)) - abs(r(very + h))) / (2 * h)
        combined = r(half) * slope + abs(r(very)) * slope_very
        if combined <= 0.0:
            raise ValueError(
                f"very_early_late_space_chips = {very_spacing_chips:g} cancels the slope of E and L; "
                "use another spacing"
            )
        return (r(half) ** 2 + r(very) ** 2) / combined
    raise ValueError(f"unknown code discriminator {name!r}: use one of {', '.join(CODE_DISCRIMINATORS)}")
