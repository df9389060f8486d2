"""Position, velocity and time of one epoch: satellites, corrections, weights, least squares, RAIM.

Everything raises ``NoFix`` with a sentence that says what is missing; ``nav.navigator`` turns it into a
reason.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from nav import kernels
from nav.frames import geodetic_from_ecef, rotation_enu_to_ecef
from nav.records import SATELLITE
from signals.constants import C_MPS, SECONDS_PER_WEEK, WAVELENGTH_M
from signals.geometry_kernels import (
    IONOSPHERE_M,
    KLOBUCHAR_X_ICD,
    klobuchar_kernel,
    orbit_kernel,
    saastamoinen_kernel,
)
from signals.orbits import orbit_coefficients

MAX_ITERATIONS = 25
HUMIDITY = 0.7
LATE_S = 1e-3
"""Errors of all transmit times below this, which cost less than a metre, are not looked for."""


class NoFix(Exception):
    """No position at this epoch; the text is one sentence for the user."""


class Late(NoFix):
    """All transmit times are off together."""


class Position(NamedTuple):
    """Least-squares result; arrays are aligned with the satellites handed in, ``use`` says which took
    part."""

    state: np.ndarray  # (5,) ECEF m, clock bias m, ISB m
    cov: np.ndarray  # (5, 5) m^2, of the first n_unknowns
    residual_m: np.ndarray  # (n,), NaN-free, of unused satellites too
    los: np.ndarray  # (n, 3)
    use: np.ndarray  # (n,) uint8
    chi2: float
    dof: int
    n_unknowns: int


class Velocity(NamedTuple):
    """Least-squares velocity and clock drift."""

    vel_ecef_mps: np.ndarray
    drift_mps: float
    cov: np.ndarray  # (4, 4)
    residual_mps: np.ndarray


@njit(cache=True, nogil=True)
def _states_kernel(k, tow_whole, tow_frac, toe, toc, tgd, pos, vel, clock, rate):
    half, week = SECONDS_PER_WEEK / 2.0, float(SECONDS_PER_WEEK)
    for i in range(k.shape[0]):
        dt_toe = (tow_whole[i] - toe[i] + half) % week - half + tow_frac[i]
        dt_toc = (tow_whole[i] - toc[i] + half) % week - half + tow_frac[i]
        dt_sv = 0.0
        for _ in range(2):
            s = orbit_kernel(k[i], dt_toe - dt_sv, dt_toc - dt_sv)
            dt_sv = s[6]
        s = orbit_kernel(k[i], dt_toe - dt_sv, dt_toc - dt_sv)
        for a in range(3):
            pos[i, a], vel[i, a] = s[a], s[3 + a]
        clock[i] = C_MPS * (s[6] - tgd[i])
        rate[i] = C_MPS * s[7]


def satellites(obs, eph):
    """SATELLITE rows (position, velocity, clock at transmission) of n observations with their n ephemerides.

    t_tx = T_tx - dt_SV(t_tx), by iteration (IS-GPS-200, 20.3.3.3.3.1); the L1 user's clock is dt_SV - TGD, or
    dt_SV - BGD(E1,E5b) for Galileo.
    """
    sats = np.zeros(obs.size, SATELLITE)
    sats["system"], sats["prn"] = obs["system"], obs["prn"]
    whole_s = np.floor_divide(obs["tow_tx_ms"], 1000)
    frac_s = (obs["tow_tx_ms"] - whole_s * 1000) * 1e-3 + obs["tow_tx_frac_s"]
    pos, vel = np.zeros((obs.size, 3)), np.zeros((obs.size, 3))
    clock, rate = np.zeros(obs.size), np.zeros(obs.size)
    toe, toc, tgd = (np.ascontiguousarray(eph[name], dtype=float) for name in ("toe_s", "toc_s", "tgd_s"))
    k = orbit_coefficients(eph)
    _states_kernel(k, whole_s.astype(float), frac_s, toe, toc, tgd, pos, vel, clock, rate)
    sats["pos_ecef_m"], sats["vel_ecef_mps"], sats["clock_m"], sats["clock_rate_mps"] = pos, vel, clock, rate
    return sats


@njit(cache=True, nogil=True)
def _line_of_sight(r, pos, sat):
    """Azimuth and elevation of one satellite; r is R_l^e of pos."""
    dx, dy, dz = sat[0] - pos[0], sat[1] - pos[1], sat[2] - pos[2]
    east = r[0, 0] * dx + r[1, 0] * dy + r[2, 0] * dz
    north = r[0, 1] * dx + r[1, 1] * dy + r[2, 1] * dz
    up = r[0, 2] * dx + r[1, 2] * dy + r[2, 2] * dz
    return math.atan2(east, north), math.atan2(up, math.hypot(east, north))


@njit(cache=True, nogil=True)
def _look_kernel(pos, vel, lat, lon, height, sat_pos, sat_vel, tow_s, iono_on, alpha, beta, tropo_on, out):
    r = rotation_enu_to_ecef(lat, lon)
    climb = r[0, 2] * vel[0] + r[1, 2] * vel[1] + r[2, 2] * vel[2]
    for i in range(sat_pos.shape[0]):
        out[i, :] = 0.0
        iono_before, tropo_before = 0.0, 0.0
        for late in range(1, -1, -1):  # one second later first: the difference is the rate
            az, el = _line_of_sight(r, pos, sat_pos[i] + late * (sat_vel[i] - vel))
            if el < 0.02:
                continue
            if iono_on:
                delay_s = klobuchar_kernel(lat, lon, az, el, tow_s + late, alpha, beta, KLOBUCHAR_X_ICD)
                out[i, 2] = C_MPS * delay_s
            if tropo_on:
                out[i, 3] = saastamoinen_kernel(lat, height + late * climb, el, HUMIDITY)
            if late == 1:
                iono_before, tropo_before = out[i, 2], out[i, 3]
        out[i, 0], out[i, 1] = az % (2.0 * math.pi), el
        out[i, 4] = (tropo_before - out[i, 3]) - (iono_before - out[i, 2])


def look(sats, pos_ecef_m, vel_ecef_mps, tow_s, klobuchar=None, troposphere=False):
    """Fill azimuth, elevation, the two delays and their rate of ``sats`` in place, seen from pos_ecef_m.

    ``klobuchar`` is (alpha (4,), beta (4,)) or None. Below 1.1 deg, below -5 km and above the ionosphere's shell
    (``IONOSPHERE_M``) the delays are zero: the models do not hold there. The velocity matters for the
    rate alone (a climb of 1 m/s lowers the zenith delay by 0.3 mm/s).
    """
    pos = np.ascontiguousarray(pos_ecef_m, dtype=float)
    lat, lon, height = geodetic_from_ecef(pos)
    near = -5e3 < height < IONOSPHERE_M
    alpha, beta = klobuchar if klobuchar is not None else (np.zeros(4), np.zeros(4))
    alpha, beta = (np.ascontiguousarray(c, dtype=float) for c in (alpha, beta))
    vel = np.ascontiguousarray(vel_ecef_mps, dtype=float)
    out = np.zeros((sats.size, 5))
    sat_pos, sat_vel = (np.ascontiguousarray(sats[f]) for f in ("pos_ecef_m", "vel_ecef_mps"))
    _look_kernel(
        pos, vel, lat, lon, height, sat_pos, sat_vel, float(tow_s),
        klobuchar is not None and near, alpha, beta, bool(troposphere and near), out,
    )  # fmt: skip
    names = ("azimuth_rad", "elevation_rad", "iono_m", "tropo_m", "atmosphere_rate_mps")
    for column, name in enumerate(names):
        sats[name] = out[:, column]


def range_variance(cn0_dbhz, elevation_rad, sigma_45_m, sigma_zenith_m, smoothing=1.0):
    """Pseudorange variance, m^2: thermal noise at C/N0 plus what is left of the atmosphere at elevation.

    smoothing sigma_45^2 10^((45 - C/N0)/10) + (sigma_zenith / sin el)^2, el at least 3 deg; ``smoothing``
    is what carrier smoothing leaves of the noise variance. Thermal code noise goes with 1/(C/N0) (Kaplan &
    Hegarty 2006, section 5.6.3, squaring loss left out); 1/sin el is the flat-Earth mapping.
    """
    sin_el = np.sin(np.maximum(elevation_rad, math.radians(3.0)))
    return (
        smoothing * sigma_45_m**2 * 10.0 ** ((45.0 - np.asarray(cn0_dbhz)) / 10.0)
        + (sigma_zenith_m / sin_el) ** 2
    )


def rate_variance(cn0_dbhz, sigma_45_mps, sigma_floor_mps):
    """Range-rate variance, (m/s)^2: sigma_45^2 10^((45 - C/N0)/10) + floor^2."""
    return sigma_45_mps**2 * 10.0 ** ((45.0 - np.asarray(cn0_dbhz)) / 10.0) + sigma_floor_mps**2


def count_unknowns(second, use, estimate_isb):
    """4, or 5 when satellites of both systems take part and the inter-system bias is estimated."""
    in_use = second[use == 1]
    return 5 if estimate_isb and in_use.size and in_use.min() != in_use.max() else 4


def solve_position(sats, corrected_m, variance, second, use, estimate_isb, start=None):
    """Weighted least squares over the satellites with use = 1; start at the Earth's centre unless told.

    Parameters
    ----------
    corrected_m : (n,) pseudorange + satellite clock - atmosphere (- c GGTO), m
    variance : (n,) m^2;  second : (n,) float, 1 for the system that carries the ISB;  use : (n,) uint8

    Raises
    ------
    NoFix
        Fewer satellites than unknowns, singular geometry, or no convergence.
    """
    m, n_use = count_unknowns(second, use, estimate_isb), int(use.sum())
    if n_use < m:
        what = (
            "three coordinates and the clock" if m == 4 else "three coordinates, clock and inter-system bias"
        )
        raise NoFix(f"{m} satellites are needed for {what}, and {n_use} can be used.")
    n = sats.size
    state = np.zeros(5) if start is None else np.array(start, dtype=float)
    if m == 4 and start is not None:
        state[4] = 0.0
    cov, residual, los = np.zeros((5, 5)), np.zeros(n), np.zeros((n, 3))
    status, _ = kernels.solve_position(
        np.ascontiguousarray(sats["pos_ecef_m"]), corrected_m, variance, second, use, m,
        state, cov, residual, los, MAX_ITERATIONS,
    )  # fmt: skip
    if status == kernels.SINGULAR:
        raise NoFix(f"the {n_use} satellites in use lie on one cone: their geometry fixes no position.")
    if status == kernels.NOT_CONVERGED:
        raise NoFix(
            f"least squares with {n_use} satellites did not converge: the ranges do not fit together."
        )
    chi2 = float(np.sum((residual**2 / variance)[use == 1]))
    return Position(state, cov, residual, los, use.copy(), chi2, n_use - m, m)


def solve_velocity(sats, rate_mps, variance, use, pos_ecef_m):
    """Weighted least squares for velocity and clock drift from range rates -lambda f_d + satellite clock
    rate."""
    vel, drift, cov, residual = np.zeros(3), np.zeros(1), np.zeros((5, 5)), np.zeros(sats.size)
    ok = kernels.solve_velocity(
        np.ascontiguousarray(sats["pos_ecef_m"]), np.ascontiguousarray(sats["vel_ecef_mps"]), rate_mps,
        variance, use, np.ascontiguousarray(pos_ecef_m), vel, drift, cov, residual,
    )  # fmt: skip
    if not ok:
        raise NoFix("the satellites in use lie on one cone: their geometry fixes no velocity.")
    return Velocity(vel, float(drift[0]), cov[:4, :4], residual)


def range_rate(obs, sats):
    """Range rate plus receiver drift, m/s: -lambda f_d + c x satellite clock rate - atmosphere rate."""
    return -WAVELENGTH_M * obs["doppler_hz"] + sats["clock_rate_mps"] - sats["atmosphere_rate_mps"]


def dilution(los, second, use, m, pos_ecef_m):
    """(GDOP, PDOP, HDOP, VDOP) from (H^T H)^-1, the position block turned to east, north, up."""
    normal, inverse, none = np.zeros((5, 5)), np.zeros((5, 5)), np.zeros(5)
    unit = np.ones(use.size)
    kernels.normal_equations(los, second, unit, np.zeros(use.size), use, m, normal, none)
    if not kernels.invert_symmetric(normal, inverse, m):
        return math.inf, math.inf, math.inf, math.inf
    lat, lon, _ = geodetic_from_ecef(np.ascontiguousarray(pos_ecef_m))
    r = rotation_enu_to_ecef(lat, lon)
    enu = np.diag(r.T @ inverse[:3, :3] @ r)
    position = float(enu.sum())
    gdop = math.sqrt(position + float(np.trace(inverse[3:m, 3:m])))
    return gdop, math.sqrt(position), math.sqrt(enu[0] + enu[1]), math.sqrt(enu[2])


def chi2_threshold(dof, p_fa):
    """Value that a chi-square variable of ``dof`` exceeds with probability p_fa (inf for dof < 1)."""
    from scipy.special import chdtri

    return float(chdtri(dof, p_fa)) if dof >= 1 else math.inf


def time_error(sats, los, variance, second, use, residual_m, m):
    """One error of all transmit times, which the ranges tell as a fifth (sixth) unknown.

    Where all transmit times are tau too early and the receiver time with them, as after a hole in the samples,
    ranges are measured as they are but expected tau earlier: residual_i = (u_i . v_i) tau (the unknown of coarse-time
    navigation: van Diggelen, A-GPS, 2009, section 4.3).

    Returns
    -------
    (tau_s, sigma_s, chi2 without this unknown, chi2 with it, chi2 with the one satellite left out that lowers it most);
    all NaN where the geometry fixes no position.
    """
    vel = np.ascontiguousarray(sats["vel_ecef_mps"])
    return kernels.time_error(los, second, variance, residual_m, use, m, vel)


def refuse_late(sats, los, variance, second, use, residual_m, m, p_fa, doubted):
    """Raise Late where one error of all transmit times explains the ranges: samples are missing.

    Without doubt of the time, the ranges must fail their test (chi-square, ``p_fa``), pass it with this unknown, gain
    more by it than by any satellite left out, and as significantly against the scatter that is left, for noise may be larger
    than is believed; in doubt (a disturbance of all channels, and no message since) it is
    enough that the unknown itself is significant, and without redundancy there is no fix.
    """
    dof = int(use.sum()) - m
    if dof < 2:
        if doubted and p_fa > 0.0:
            raise NoFix(
                "all channels were disturbed at once, as by missing samples, and no message has confirmed the time "
                f"since; {int(use.sum())} satellites are too few to test it."
            )
        return
    tau_s, sigma_s, chi2, rest, without = time_error(sats, los, variance, second, use, residual_m, m)
    if abs(tau_s) < LATE_S or rest > chi2_threshold(dof - 1, p_fa):
        return
    gain, least = chi2 - rest, chi2_threshold(1, p_fa)
    fails = chi2 > chi2_threshold(dof, p_fa) and rest < without and gain > least * max(1.0, rest / (dof - 1))
    if fails or (doubted and gain > least):
        raise Late(
            f"the ranges fit together only if time is off by {tau_s * 1e3:.0f} ± {sigma_s * 1e3:.0f} ms: samples seem "
            "to be missing, and the position waits for the time in the messages."
        )


def raim(sats, corrected_m, variance, second, use, estimate_isb, p_fa, start=None):
    """Least squares with residual test and exclusion of the faulty satellites that redundancy can name.

    The weighted residual sum of squares is chi-square with n - m degrees of freedom when nothing is wrong
    and the variances are true (Parkinson & Axelrad 1988). Above its p_fa quantile, the satellite whose
    removal lowers it most goes (largest normalised residual, Baarda's w-test), until the test passes. With
    one degree of freedom a fault is seen but not located.

    Returns
    -------
    Position and the list of row indices excluded.

    Raises
    ------
    NoFix
        When the test fails and no redundancy is left to exclude with.
    """
    use = use.copy()
    excluded: list[int] = []
    while True:
        fix = solve_position(sats, corrected_m, variance, second, use, estimate_isb, start)
        limit = chi2_threshold(fix.dof, p_fa)
        if fix.chi2 <= limit:
            return fix, excluded
        if fix.dof < 2:
            gone = [f"{s.decode()}{p:02d}" for s, p in zip(sats["system"][excluded], sats["prn"][excluded])]
            raise NoFix(
                f"the residual test fails (chi2 {fix.chi2:.1f} above {limit:.1f}) and the {int(use.sum())} "
                f"satellites left are too few to name the faulty one"
                + (f"; left out already: {', '.join(gone)}." if gone else ".")
            )
        drop = np.zeros(sats.size)
        kernels.exclusion_drop(fix.los, second, variance, fix.residual_m, use, fix.n_unknowns, fix.cov, drop)
        worst = int(np.argmax(drop))
        use[worst] = 0
        excluded.append(worst)


def ggto_m(iono_utc, tow_s, week):
    """c x (GST - GPS time) of Galileo word 10, m: A0G + A1G (TOW - t0G + 604800 (WN - WN0G mod 64)).

    Galileo OS SIS ICD, section 5.1.8.
    """
    weeks = (int(week) - int(iono_utc["week_0g"]) + 32) % 64 - 32
    dt_s = tow_s - float(iono_utc["t0g_s"]) + SECONDS_PER_WEEK * weeks
    return C_MPS * (float(iono_utc["a0g_s"]) + float(iono_utc["a1g_s_s"]) * dt_s)
