"""Broadcast orbits and clocks, and the constellations that are built in.

Time is given as ``(week, tow_s, t_s)``: an epoch at a whole second and small seconds from it, so that nothing
is lost to the float64 grid of an absolute time (1e-10 s, 3 cm of range, at a time of week).
"""

import math

import numpy as np

from signals import inav, lnav
from signals.almanac import elements
from signals.constants import (
    EARTH_RATE_RAD_S,
    F_REL_GALILEO_S_SQRT_M,
    F_REL_GPS_S_SQRT_M,
    GNSS_PI,
    MU_GALILEO_M3_S2,
    MU_GPS_M3_S2,
    SECONDS_PER_WEEK,
)
from signals.geometry_kernels import ORBIT_FIELDS, orbit_kernel, orbits_kernel
from signals.records import EPHEMERIS, IONO_UTC
from signals.timescale import week_tow

__all__ = [
    "ORBIT_FIELDS",
    "broadcast_sets",
    "check_ephemeris",
    "default_iono_utc",
    "nominal_constellation",
    "orbit_coefficients",
    "orbit_kernel",
    "quantise_ephemeris",
    "satellite_state",
    "seconds_from",
]

_HALF_WEEK = SECONDS_PER_WEEK // 2


def seconds_from(ephemeris: np.ndarray, field: str, week: int, tow_s: float) -> np.ndarray:
    """Seconds from ``field`` ("toe_s" or "toc_s") to (week, tow_s), wrapped to +-302400 (table 20-IV)."""
    dt = (week - ephemeris["week"].astype(float)) * SECONDS_PER_WEEK + (tow_s - ephemeris[field])
    return np.mod(dt + _HALF_WEEK, SECONDS_PER_WEEK) - _HALF_WEEK


def orbit_coefficients(ephemeris: np.ndarray) -> np.ndarray:
    """Flat float64 (n, 19) form of EPHEMERIS records for `orbit_kernel`, columns ORBIT_FIELDS."""
    eph = np.atleast_1d(ephemeris)
    galileo = eph["system"] == b"E"
    root_a = eph["sqrt_a_sqrt_m"]
    a = root_a**2
    columns = {
        "mean_motion_rad_s": np.sqrt(np.where(galileo, MU_GALILEO_M3_S2, MU_GPS_M3_S2) / a**3)
        + eph["delta_n_rad_s"],
        "a_m": a,
        "omega_node_rad": eph["omega0_rad"] - EARTH_RATE_RAD_S * eph["toe_s"],
        "omega_dot_rel_rad_s": eph["omega_dot_rad_s"] - EARTH_RATE_RAD_S,
        "rel_s": np.where(galileo, F_REL_GALILEO_S_SQRT_M, F_REL_GPS_S_SQRT_M) * eph["e"] * root_a,
    }
    return np.stack([columns[f] if f in columns else eph[f] for f in ORBIT_FIELDS], axis=1).astype(float)


def satellite_state(
    ephemeris, week: int, tow_s: float, t_s=0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Satellite position, velocity and clock at system times ``(week, tow_s) + t_s``.

    Parameters
    ----------
    ephemeris : EPHEMERIS record
        One satellite.
    week, tow_s
        Epoch, continuous week and preferably whole second.
    t_s : float or (n,) array
        Seconds from the epoch.

    Returns
    -------
    pos_ecef_m, vel_ecef_mps : (n, 3)
        In the Earth-fixed frame of the same instant (turn it by the flight time before differencing).
    clock_s, clock_rate_s_s : (n,)
        af0 + af1 dt + af2 dt^2 + F e sqrt(A) sin E and its derivative; TGD or BGD is *not* in it.

    Notes
    -----
    IS-GPS-200, table 20-IV and 20.3.3.3.3.1; Galileo OS SIS ICD, 5.1.1 and 5.1.4.
    """
    eph = np.atleast_1d(ephemeris)
    t = np.atleast_1d(np.asarray(t_s, float))
    out = np.empty((t.size, 8))
    toe0, toc0 = (seconds_from(eph, field, week, tow_s)[0] for field in ("toe_s", "toc_s"))
    orbits_kernel(orbit_coefficients(eph)[0], toe0 + t, toc0 + t, out)
    return out[:, :3], out[:, 3:6], out[:, 6], out[:, 7]


def check_ephemeris(ephemeris: np.ndarray) -> None:
    """Raise ValueError for elements outside what the messages can hold; the satellite is named."""
    for eph in np.atleast_1d(ephemeris):
        name = f"{eph['system'].decode()}{int(eph['prn']):02d}"
        values = [eph[f] for f in EPHEMERIS.names or () if EPHEMERIS[f].kind == "f"]
        if not np.all(np.isfinite(values)):
            raise ValueError(f"ephemeris of {name} holds a value that is not a number: leave it out")
        if not 0.0 <= eph["e"] < 0.5:
            raise ValueError(
                f"ephemeris of {name} has eccentricity {eph['e']:g}: the message allows 0 to 0.5"
            )
        if not 2_000.0 <= eph["sqrt_a_sqrt_m"] < 8_192.0:
            raise ValueError(
                f"ephemeris of {name} has sqrt(A) = {eph['sqrt_a_sqrt_m']:g} m^0.5: allowed are 2000 to 8192"
            )
        for field in ("toe_s", "toc_s"):
            if not 0.0 <= eph[field] < SECONDS_PER_WEEK:
                raise ValueError(
                    f"ephemeris of {name} has {field} = {eph[field]:g}: allowed are 0 to 604800 s"
                )


def quantise_ephemeris(ephemeris: np.ndarray) -> np.ndarray:
    """Round every element to the resolution of its message, so that truth is what a receiver can decode.

    Angles are first brought into [-pi, pi). Raises ValueError naming the field that does not fit.
    """
    out = np.array(np.atleast_1d(ephemeris))
    for field in ("m0_rad", "omega0_rad", "omega_rad"):
        out[field] = np.mod(out[field] + GNSS_PI, 2.0 * GNSS_PI) - GNSS_PI
    return np.array([(lnav if e["system"] == b"G" else inav).quantised(e) for e in out], dtype=EPHEMERIS)


# --- change-over ---------------------------------------------------------------------------------------------

_CHANGE_S = {b"G": 7200, b"E": 600}
"""New data sets go on air this often (IS-GPS-200, 20.3.4.4; Galileo sends a new batch every ten minutes or more)."""
_LEAD_S = {b"G": 7200, b"E": 0}
"""How long before its toe a set goes on air: GPS in the middle of its fit interval of 4 h, Galileo at toe."""


def broadcast_sets(ephemeris: np.ndarray, week: int, tow_s: int, first_s: int, last_s: int) -> np.ndarray:
    """Data sets that a satellite sends from ``first_s`` to ``last_s`` after the start (week, tow_s), EPHEMERIS (n,).

    ``ephemeris`` until the next change-over (GPS: every even hour, Galileo: every ten minutes), then the same orbit and
    clock at a new reference time under the next issue, so that a receiver sees a new set and no step beyond the
    resolution of the message (some centimetres).
    """
    sets = [np.atleast_1d(ephemeris).copy()]
    step_s = _CHANGE_S[bytes(ephemeris["system"])]
    start_s = week * SECONDS_PER_WEEK + tow_s
    begin, end = start_s // step_s, (start_s + last_s) // step_s
    for count in range(max(begin + 1, (start_s + first_s) // step_s), end + 1):
        moved = _moved(ephemeris, count * step_s + _LEAD_S[bytes(ephemeris["system"])])
        modulus = 256 if moved["system"][0] == b"G" else 1024
        moved["iode"] = (int(ephemeris["iode"]) + count - begin) % modulus
        moved["iodc"] = int(ephemeris["iodc"]) // modulus * modulus + moved["iode"]
        moved["tow_s"] = count * step_s % SECONDS_PER_WEEK
        sets.append(quantise_ephemeris(moved))
    return np.concatenate(sets)


def _moved(ephemeris: np.ndarray, toe_abs_s: int) -> np.ndarray:
    """The same orbit and clock with toe = toc = ``toe_abs_s``, seconds since week 0; EPHEMERIS (1,)."""
    out = np.atleast_1d(ephemeris).copy()
    week, toe_s = divmod(toe_abs_s, SECONDS_PER_WEEK)
    for name, value in elements(out[0].copy(), week, toe_s).items():
        out[name] = value
    dt_s = toe_abs_s - int(ephemeris["week"]) * SECONDS_PER_WEEK - float(ephemeris["toc_s"])
    out["af0_s"] += ephemeris["af2_s_s2"] * dt_s**2
    out["af1_s_s"] += 2.0 * ephemeris["af2_s_s2"] * dt_s
    out["week"], out["toe_s"], out["toc_s"] = week, toe_s, toe_s
    return out


# --- nominal constellations ------------------------------------------------------------------------------

# Reference slots of the GPS SPS Performance Standard (2020), table 3.2-1: argument of latitude in deg per
# plane at 1993-07-01 00:00 UTC; the nodes are 60 deg apart from 272.847 deg.
_GPS_SLOTS_DEG = (
    (268.126, 161.786, 11.676, 41.806),
    (80.956, 173.336, 309.976, 204.376),
    (111.876, 11.796, 339.666, 241.556),
    (135.226, 265.446, 35.156, 167.356),
    (197.046, 302.596, 66.066, 333.686),
    (238.886, 345.226, 105.206, 135.346),
)
# Seven spares in the widest gaps bring 24 slots to the 31 satellites in service (our choice).
_GPS_SPARES_DEG = ((100.0, 325.0), (20.0,), (175.0,), (310.0,), (130.0,), (55.0,))
_GPS_EPOCH_S = (704 * 7 + 4) * 86_400.0  # 1993-07-01 after 1980-01-06
_GPS_NODE_DEG = 272.847
# Galileo reference constellation (European GNSS Service Centre, orbital and technical parameters): Walker
# 24/3/1 at 2016-11-21 00:00 UTC.
_GALILEO_EPOCH_S = (1924 * 7 + 1) * 86_400.0
_GALILEO_NODE_DEG = 317.632
_GALILEO_U_DEG = 225.153
_GMST_EPOCH_RAD = math.radians(104.7420)  # mean sidereal time at 1980-01-06 00:00 UT1
_REFRESH_S = 1200


def _slots(system: str) -> list[tuple[float, float]]:
    """Node and argument of latitude in deg at the reference epoch, in PRN order."""
    if system == "G":
        planes = [base + spare for base, spare in zip(_GPS_SLOTS_DEG, _GPS_SPARES_DEG)]
        pairs = [
            (_GPS_NODE_DEG + 60.0 * p, plane[s])
            for s in range(6)
            for p, plane in enumerate(planes)
            if s < len(plane)
        ]
        return pairs
    return [
        (_GALILEO_NODE_DEG + 120.0 * p, _GALILEO_U_DEG + 45.0 * s + 15.0 * p)
        for s in range(8)
        for p in range(3)
    ]


def _spread(prn: np.ndarray, index: int) -> np.ndarray:
    """Numbers in [-1, 1) that differ by satellite and field: a Weyl sequence, the same on every machine."""
    return 2.0 * np.mod(prn * 0.6180339887498949 + index * 0.7548776662466927, 1.0) - 1.0


# a_m, i_deg, e_max, node drift rad/s, mean-motion correction rad/s (oblateness), af0 s, TGD or BGD s
_SECULAR = {
    "G": (26_559_710.0, 55.0, 0.015, -8.0e-9, 4.6e-9, 4.0e-4, (-2.0e-9, 1.0e-8)),
    "E": (29_600_000.0, 56.0, 0.0005, -5.5e-9, 2.8e-9, 6.0e-4, (0.0, 6.0e-9)),
}


def nominal_constellation(system: str, week: int, tow_s: int) -> np.ndarray:
    """Healthy, deterministic EPHEMERIS records, toe within the last 20 min before the epoch.

    GPS: the 24 reference slots and seven spares, PRN 1-31. Galileo: Walker 24/3/1, a = 29600 km, i = 56
    deg, PRN 1-24. Eccentricities, harmonics, clocks and group delays are of realistic size, differ by
    satellite and are multiples of the message resolution.

    Sources: GPS SPS Performance Standard (2020), table 3.2-1; European GNSS Service Centre, constellation
    parameters. Shapes and clocks are assumed.

    Raises
    ------
    ValueError
        For a system other than "G" and "E".
    """
    if system not in _SECULAR:
        raise ValueError(f"system {system!r} has no nominal constellation: use 'G' or 'E'")
    a_m, incl_deg, e_max, node_dot, delta_n, af0_s, (tgd_mid, tgd_half) = _SECULAR[system]
    toe_abs = ((week * SECONDS_PER_WEEK + int(tow_s) - 1) // _REFRESH_S) * _REFRESH_S
    week_oe, toe_s = divmod(toe_abs, SECONDS_PER_WEEK)
    node_deg, lat_deg = np.array(_slots(system)).T
    eph = np.zeros(node_deg.size, EPHEMERIS)
    prn = np.arange(1, eph.size + 1)
    eph["system"], eph["prn"], eph["week"] = system.encode(), prn, week_oe
    eph["toe_s"] = eph["toc_s"] = eph["tow_s"] = toe_s
    age_s = toe_abs - (_GPS_EPOCH_S if system == "G" else _GALILEO_EPOCH_S)
    n = math.sqrt((MU_GPS_M3_S2 if system == "G" else MU_GALILEO_M3_S2) / a_m**3) + delta_n
    eph["sqrt_a_sqrt_m"] = math.sqrt(a_m) + 1e-3 * _spread(prn, 0)
    eph["e"] = e_max * (0.55 + 0.45 * _spread(prn, 1))
    eph["omega_rad"] = np.pi * _spread(prn, 2)
    eph["m0_rad"] = np.radians(lat_deg) + math.fmod(n * age_s, 2.0 * math.pi) - eph["omega_rad"]
    eph["omega0_rad"] = np.radians(node_deg) + node_dot * age_s - _sidereal_rad(week_oe * SECONDS_PER_WEEK)
    eph["i0_rad"] = math.radians(incl_deg) + math.radians(0.6) * _spread(prn, 3)
    eph["delta_n_rad_s"] = delta_n * (1.0 + 0.08 * _spread(prn, 4))
    eph["omega_dot_rad_s"] = node_dot * (1.0 + 0.03 * _spread(prn, 5))
    _fill_perturbations(eph, prn)
    _fill_clocks(eph, prn, af0_s, tgd_mid, tgd_half)
    count = toe_abs // _REFRESH_S
    eph["iode"] = 1 + count % (240 if system == "G" else 1000)
    eph["iodc"] = eph["iode"]
    eph["accuracy_index"] = 0 if system == "G" else 107
    return quantise_ephemeris(eph)


def _sidereal_rad(gps_s: float) -> float:
    """Angle from the vernal equinox to Greenwich, mean, good to 0.1 deg (UT1 and precession left out)."""
    return math.fmod(_GMST_EPOCH_RAD + EARTH_RATE_RAD_S * gps_s, 2.0 * math.pi)


def _fill_perturbations(eph: np.ndarray, prn: np.ndarray) -> None:
    """Harmonics of the size that broadcast ephemerides show (read off a real navigation file)."""
    galileo = eph["system"] == b"E"
    eph["idot_rad_s"] = 4e-10 * _spread(prn, 6)
    eph["cuc_rad"] = 4e-6 * _spread(prn, 7)
    eph["cus_rad"] = 8e-6 + 3e-6 * _spread(prn, 8)
    eph["crc_m"] = np.where(galileo, 160.0, 230.0) + 90.0 * _spread(prn, 9)
    eph["crs_m"] = 90.0 * _spread(prn, 10)
    eph["cic_rad"] = 1.5e-7 * _spread(prn, 11)
    eph["cis_rad"] = 1.5e-7 * _spread(prn, 12)


def _fill_clocks(eph: np.ndarray, prn: np.ndarray, af0_s: float, tgd_mid: float, tgd_half: float) -> None:
    eph["af0_s"] = af0_s * _spread(prn, 13)
    eph["af1_s_s"] = 5e-12 * _spread(prn, 14)
    eph["tgd_s"] = tgd_mid + tgd_half * _spread(prn, 15)
    eph["bgd_e5a_s"] = np.where(eph["system"] == b"E", 0.9 * eph["tgd_s"], 0.0)


def default_iono_utc(week: int, tow_s: int = 0) -> np.ndarray:
    """IONO_UTC record (shape ()): a quiet solar day, 18 leap seconds, a GGTO of about 5 ns.

    Every value is a multiple of its resolution in *both* messages (IS-GPS-200, 20.3.3.5.1.7 and 20.3.3.5.2.4;
    Galileo OS SIS ICD, words 5, 6, 10); tot and t0g are 0, the only time that 4096 s and 3600 s share in a
    week. The last leap second was inserted at the end of 2016-12-31 (day 7 of week 1929, in days 1-7). Before
    that date the count of the time itself is used.
    """
    out = np.zeros((), IONO_UTC)
    out["alpha"] = (12 * 2.0**-30, 2 * 2.0**-27, -1 * 2.0**-24, -2 * 2.0**-24)
    out["beta"] = (44 * 2.0**11, 2 * 2.0**14, -1 * 2.0**16, -3 * 2.0**16)
    out["ai"] = (34 * 2.0**0, 30 * 2.0**-8, 421 * 2.0**-15)
    out["a0_utc_s"], out["a1_utc_s_s"] = 2.0**-30, 4 * 2.0**-50
    out["tot_s"], out["week_t"] = 0.0, week
    out["week_lsf"], out["dn"], out["dt_lsf_s"] = 1929, 7, 18
    out["dt_ls_s"] = _leap_seconds(week, tow_s)
    out["a0g_s"], out["a1g_s_s"], out["t0g_s"], out["week_0g"] = 172 * 2.0**-35, 0.0, 0.0, week
    return out


# First day of each new value of GPS - UTC since 1999 (IERS bulletin C).
_LEAPS = [((1999, 1, 1), 13), ((2006, 1, 1), 14), ((2009, 1, 1), 15), ((2012, 7, 1), 16)]
_LEAPS += [((2015, 7, 1), 17), ((2017, 1, 1), 18)]


def _leap_seconds(week: int, tow_s: int) -> int:
    from datetime import datetime

    now = (week, tow_s)
    return max([value for day, value in _LEAPS if now >= week_tow(datetime(*day))], default=13)
