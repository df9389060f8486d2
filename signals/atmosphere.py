"""Ionosphere and troposphere as group delays: the code arrives late by them, the carrier early by the first.

The models are those that GNSS-SDR and RTKLIB apply as iono_model = Broadcast and trop_model = Saastamoinen,
so that their fixes agree with ours. Galileo satellites use Klobuchar too, in scenario and receiver: NeQuick
is not modelled, its ai0..ai2 only travel in the message.
"""

import numpy as np
from numba import njit

from signals.geometry_kernels import (
    KLOBUCHAR_X_CONTINUOUS,
    KLOBUCHAR_X_ICD,
    klobuchar_kernel,
    saastamoinen_kernel,
)

RELATIVE_HUMIDITY = 0.7
"""RTKLIB's REL_HUMI."""

__all__ = [
    "KLOBUCHAR_X_CONTINUOUS",
    "KLOBUCHAR_X_ICD",
    "RELATIVE_HUMIDITY",
    "klobuchar",
    "klobuchar_kernel",
    "saastamoinen",
    "saastamoinen_kernel",
]


@njit(cache=True, nogil=True)
def _klobuchar_array(lat, lon, az, el, tow, alpha, beta, x_limit, out):
    for j in range(out.size):
        out[j] = klobuchar_kernel(lat[j], lon[j], az[j], el[j], tow[j], alpha, beta, x_limit)


@njit(cache=True, nogil=True)
def _saastamoinen_array(lat, height, el, humidity, out):
    for j in range(out.size):
        out[j] = saastamoinen_kernel(lat[j], height[j], el[j], humidity)


def _flat(*values) -> tuple[list[np.ndarray], tuple[int, ...]]:
    arrays = np.broadcast_arrays(*[np.asarray(value, float) for value in values])
    return [np.ascontiguousarray(array).ravel() for array in arrays], arrays[0].shape


def klobuchar(
    lat_rad, lon_rad, azimuth_rad, elevation_rad, tow_s, alpha, beta, x_limit: float = KLOBUCHAR_X_ICD
) -> np.ndarray:
    """Ionospheric group delay on L1 in s, broadcast over the inputs (IS-GPS-200, 20.3.3.5.2.5).

    ``tow_s`` is GPS time of week or of day; ``alpha``, ``beta`` hold four coefficients each, s/semicircle^n.
    """
    (lat, lon, az, el, tow), shape = _flat(lat_rad, lon_rad, azimuth_rad, elevation_rad, tow_s)
    out = np.empty(lat.size)
    a, b = (np.ascontiguousarray(c, dtype=float) for c in (alpha, beta))
    _klobuchar_array(lat, lon, az, el, tow, a, b, float(x_limit), out)
    return out.reshape(shape)


def saastamoinen(lat_rad, height_m, elevation_rad, humidity: float = RELATIVE_HUMIDITY) -> np.ndarray:
    """Tropospheric slant delay in m, broadcast over the inputs; standard atmosphere at the height."""
    (lat, height, el), shape = _flat(lat_rad, height_m, elevation_rad)
    out = np.empty(lat.size)
    _saastamoinen_array(lat, height, el, float(humidity), out)
    return out.reshape(shape)
