"""Frames of the navigation filters: ECEF, geodetic, local level (ENU, NED), body; normal gravity.

All functions are njit functions on scalars and small arrays, so that kernels may call them; they are called
from Python as well. Angles in rad, lengths in m. Body axes are forward, right, down; local axes are east,
north, up in ``R_le`` (local -> ECEF) and north, east, down in ``C_ne`` (NED -> ECEF). Azimuth A is clockwise
from north.
"""

import math

import numpy as np
from numba import njit

from signals.constants import EARTH_RATE_RAD_S, MU_EARTH_M3_S2, WGS84_A_M, WGS84_E2, WGS84_F

J2_WGS84 = 1.082629821313e-3
"""Second zonal harmonic of WGS 84, -sqrt(5) C20 (NIMA TR8350.2, table 3.4 gives J2 = 1.08263e-3)."""
GRAVITY_EQUATOR_MPS2 = 9.7803253359
GRAVITY_SOMIGLIANA_K = 0.00193185265241
"""Somigliana's normal gravity on the WGS 84 ellipsoid (NIMA TR8350.2, eq. 4-1 and table 3.4)."""

_A = WGS84_A_M
_E2 = WGS84_E2
_B = WGS84_A_M * (1.0 - WGS84_F)
_EP2 = WGS84_E2 / (1.0 - WGS84_E2)
_WE = EARTH_RATE_RAD_S
_MU = MU_EARTH_M3_S2


@njit(cache=True, nogil=True)
def earth_radii(lat_rad):
    """Meridian and prime-vertical radii (R_M, R_N) of the WGS 84 ellipsoid, m."""
    w2 = 1.0 - _E2 * math.sin(lat_rad) ** 2
    rn = _A / math.sqrt(w2)
    return rn * (1.0 - _E2) / w2, rn


@njit(cache=True, nogil=True)
def ecef_from_geodetic(lat_rad, lon_rad, height_m):
    """ECEF position (3,) of a geodetic point (Karaim 2020, eq. 31-33)."""
    _, rn = earth_radii(lat_rad)
    out = np.empty(3)
    out[0] = (rn + height_m) * math.cos(lat_rad) * math.cos(lon_rad)
    out[1] = (rn + height_m) * math.cos(lat_rad) * math.sin(lon_rad)
    out[2] = (rn * (1.0 - _E2) + height_m) * math.sin(lat_rad)
    return out


@njit(cache=True, nogil=True)
def geodetic_from_ecef(pos_ecef_m):
    """Geodetic (lat_rad, lon_rad, height_m) of an ECEF position, |z| or radius > 0.

    Bowring's parametric-latitude iteration, three rounds: exact to rounding from the surface to 30 000 km.
    """
    x, y, z = pos_ecef_m[0], pos_ecef_m[1], pos_ecef_m[2]
    p = math.hypot(x, y)
    beta = math.atan2(z, (1.0 - WGS84_F) * p)
    lat = 0.0
    for _ in range(4):
        lat = math.atan2(z + _EP2 * _B * math.sin(beta) ** 3, p - _E2 * _A * math.cos(beta) ** 3)
        beta = math.atan2((1.0 - WGS84_F) * math.sin(lat), math.cos(lat))
    s, c = math.sin(lat), math.cos(lat)
    height = p * c + z * s - _A * math.sqrt(1.0 - _E2 * s * s)
    return lat, math.atan2(y, x), height


@njit(cache=True, nogil=True)
def rotation_enu_to_ecef(lat_rad, lon_rad):
    """R_l^e (3, 3): columns are the east, north and up unit vectors in ECEF (Karaim 2020, eq. 41)."""
    sp, cp, sl, cl = math.sin(lat_rad), math.cos(lat_rad), math.sin(lon_rad), math.cos(lon_rad)
    r = np.empty((3, 3))
    r[0, 0], r[0, 1], r[0, 2] = -sl, -sp * cl, cp * cl
    r[1, 0], r[1, 1], r[1, 2] = cl, -sp * sl, cp * sl
    r[2, 0], r[2, 1], r[2, 2] = 0.0, cp, sp
    return r


@njit(cache=True, nogil=True)
def rotation_ned_to_ecef(lat_rad, lon_rad):
    """C_ne (3, 3): columns are the north, east and down unit vectors in ECEF."""
    sp, cp, sl, cl = math.sin(lat_rad), math.cos(lat_rad), math.sin(lon_rad), math.cos(lon_rad)
    r = np.empty((3, 3))
    r[0, 0], r[0, 1], r[0, 2] = -sp * cl, -sl, -cp * cl
    r[1, 0], r[1, 1], r[1, 2] = -sp * sl, cl, -cp * sl
    r[2, 0], r[2, 1], r[2, 2] = cp, 0.0, -sp
    return r


@njit(cache=True, nogil=True)
def position_map_geodetic(lat_rad, lon_rad, height_m):
    """T (3, 3) with d(ECEF) = T d(lat, lon, height); (R_M + h) in the whole latitude column.

    Karaim 2020, eq. 34, prints (R_N + h) in the x and y rows: 0.35 % off; the derivative of eq. 31-33 has R_M.
    """
    rm, rn = earth_radii(lat_rad)
    r = rotation_enu_to_ecef(lat_rad, lon_rad)
    t = np.empty((3, 3))
    for i in range(3):
        t[i, 0] = r[i, 1] * (rm + height_m)
        t[i, 1] = r[i, 0] * (rn + height_m) * math.cos(lat_rad)
        t[i, 2] = r[i, 2]
    return t


@njit(cache=True, nogil=True)
def normal_gravity(lat_rad, height_m):
    """Magnitude of normal gravity (centrifugal part included), m/s^2.

    Somigliana on the ellipsoid, second-order free-air term in height (NIMA TR8350.2, eq. 4-1 and 4-3).
    """
    s2 = math.sin(lat_rad) ** 2
    g0 = GRAVITY_EQUATOR_MPS2 * (1.0 + GRAVITY_SOMIGLIANA_K * s2) / math.sqrt(1.0 - _E2 * s2)
    m = _WE * _WE * _A * _A * _B / _MU
    x = height_m / _A
    return g0 * (1.0 - 2.0 * (1.0 + WGS84_F + m - 2.0 * WGS84_F * s2) * x + 3.0 * x * x)


@njit(cache=True, nogil=True)
def gravity_ecef(pos_ecef_m, g_out):
    """Gravity (gravitation of the J2 field + centrifugal acceleration) in ECEF into g_out (3,), m/s^2.

    gamma = -mu/r^3 (x (1 + k (1 - 5 s^2)), y (same), z (1 + k (3 - 5 s^2))), k = 1.5 J2 (a/r)^2, s = z/r
    (Groves 2013, section 2.4.7), plus w_ie^2 (x, y, 0).
    """
    x, y, z = pos_ecef_m[0], pos_ecef_m[1], pos_ecef_m[2]
    r2 = x * x + y * y + z * z
    r = math.sqrt(r2)
    k = 1.5 * J2_WGS84 * _A * _A / r2
    s2 = 5.0 * z * z / r2
    f = -_MU / (r2 * r)
    horizontal = f * (1.0 + k * (1.0 - s2)) + _WE * _WE
    g_out[0] = horizontal * x
    g_out[1] = horizontal * y
    g_out[2] = f * (1.0 + k * (3.0 - s2)) * z


@njit(cache=True, nogil=True)
def rotation_body_to_ned(yaw_rad, pitch_rad, roll_rad):
    """C_bn (3, 3), body (forward, right, down) -> NED, from yaw, pitch, roll (3-2-1 sequence)."""
    sy, cy = math.sin(yaw_rad), math.cos(yaw_rad)
    sp, cp = math.sin(pitch_rad), math.cos(pitch_rad)
    sr, cr = math.sin(roll_rad), math.cos(roll_rad)
    c = np.empty((3, 3))
    c[0, 0], c[0, 1], c[0, 2] = cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy
    c[1, 0], c[1, 1], c[1, 2] = cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy
    c[2, 0], c[2, 1], c[2, 2] = -sp, sr * cp, cr * cp
    return c


@njit(cache=True, nogil=True)
def euler_from_rotation(c_bn):
    """(yaw, pitch, roll) of C_bn; at |pitch| = 90 deg yaw and roll are not separable and roll is set to 0."""
    pitch = math.asin(max(-1.0, min(1.0, -c_bn[2, 0])))
    if abs(c_bn[2, 0]) > 1.0 - 1e-12:
        return math.atan2(-c_bn[0, 1], c_bn[1, 1]), pitch, 0.0
    return math.atan2(c_bn[1, 0], c_bn[0, 0]), pitch, math.atan2(c_bn[2, 1], c_bn[2, 2])
