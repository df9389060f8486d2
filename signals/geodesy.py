"""Earth-fixed Cartesian, geodetic and local-level coordinates on WGS 84, vectorised over leading axes."""

import numpy as np

from signals.constants import WGS84_A_M, WGS84_E2, WGS84_F

_B_M = WGS84_A_M * (1.0 - WGS84_F)
_EP2 = WGS84_E2 / (1.0 - WGS84_E2)


def geodetic_to_ecef(lat_rad, lon_rad, height_m) -> np.ndarray:
    """Cartesian position (..., 3) in m of geodetic latitude, longitude and ellipsoidal height.

    N = a / sqrt(1 - e^2 sin^2 lat) (Hofmann-Wellenhof, GNSS, eq. 8.9 and 8.10).
    """
    lat, lon, height = np.broadcast_arrays(lat_rad, lon_rad, height_m)
    n = WGS84_A_M / np.sqrt(1.0 - WGS84_E2 * np.sin(lat) ** 2)
    horizontal = (n + height) * np.cos(lat)
    z = (n * (1.0 - WGS84_E2) + height) * np.sin(lat)
    return np.stack([horizontal * np.cos(lon), horizontal * np.sin(lon), z], axis=-1)


def ecef_to_geodetic(pos_ecef_m) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Geodetic latitude (rad), longitude (rad) and height (m) of Cartesian positions (..., 3).

    Bowring's iteration on the parametric latitude, three rounds: better than 1e-9 m of height and 1e-14 rad
    from the Earth's surface to beyond the GNSS orbits (Bowring 1976, Survey Review 23, eq. 6).
    """
    x, y, z = np.moveaxis(np.asarray(pos_ecef_m, float), -1, 0)
    p = np.hypot(x, y)
    beta = np.arctan2(z * WGS84_A_M, p * _B_M)
    for _ in range(3):
        lat = np.arctan2(z + _EP2 * _B_M * np.sin(beta) ** 3, p - WGS84_E2 * WGS84_A_M * np.cos(beta) ** 3)
        beta = np.arctan2((1.0 - WGS84_F) * np.sin(lat), np.cos(lat))
    # p cos + z sin - a sqrt(1 - e2 sin^2) has no singularity at the poles (Hofmann-Wellenhof's p / cos has).
    sin_lat = np.sin(lat)
    height = p * np.cos(lat) + z * sin_lat - WGS84_A_M * np.sqrt(1.0 - WGS84_E2 * sin_lat**2)
    return lat, np.arctan2(y, x), height


def ned_matrix(lat_rad, lon_rad) -> np.ndarray:
    """Rotation C_ne (..., 3, 3) from ECEF into north-east-down; its rows are the unit vectors in ECEF."""
    lat, lon = np.broadcast_arrays(np.asarray(lat_rad, float), np.asarray(lon_rad, float))
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    rows = [
        [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
        [-sin_lon, cos_lon, np.zeros_like(lat)],
        [-cos_lat * cos_lon, -cos_lat * sin_lon, -sin_lat],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def elevation_azimuth(pos_ecef_m, target_ecef_m) -> tuple[np.ndarray, np.ndarray]:
    """Elevation and azimuth (rad, azimuth from north through east in [0, 2 pi)) of targets (..., 3)."""
    lat, lon, _ = ecef_to_geodetic(pos_ecef_m)
    line = np.asarray(target_ecef_m, float) - np.asarray(pos_ecef_m, float)
    ned = np.einsum("...ij,...j->...i", ned_matrix(lat, lon), line)
    north, east, down = np.moveaxis(ned, -1, 0)
    return np.arctan2(-down, np.hypot(north, east)), np.mod(np.arctan2(east, north), 2.0 * np.pi)
