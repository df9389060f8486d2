"""True attitude of the vehicle that carries the antenna, derived from its motion.

``C_be`` rotates body (forward, right, down) into ECEF. A land vehicle points along its track with no roll; an
aircraft turns coordinated, so that the specific force has no sideways part. Sideslip, suspension and angle of
attack are left out: the body's forward axis is the velocity's direction.
"""

from typing import Literal

import numpy as np

from signals.constants import EARTH_RATE_RAD_S
from signals.geodesy import ecef_to_geodetic

Attitude = Literal["land", "aircraft"]
STANDSTILL_MPS = 1e-6
"""Below this speed the velocity has no direction and the heading is held."""


def _unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _down(pos_ecef_m):
    lat, lon, _ = ecef_to_geodetic(pos_ecef_m)
    return -np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)


def _forward(vel_ecef_mps, down, heading_rad):
    """Directions of motion; standstill holds the last direction, before the first motion the next one."""
    moving = np.linalg.norm(vel_ecef_mps, axis=1) > STANDSTILL_MPS
    if not moving.any():
        east = _unit(np.cross(np.array([0.0, 0.0, 1.0]), -down))
        north = np.cross(-down, east)
        return np.cos(heading_rad) * north + np.sin(heading_rad) * east
    index = np.where(moving, np.arange(moving.size), -1)
    index = np.maximum.accumulate(index)
    index[index < 0] = np.argmax(moving)
    return _unit(vel_ecef_mps[index])


def attitude(
    pos_ecef_m, vel_ecef_mps, specific_force_ecef_mps2=None, kind: Attitude = "land", heading_rad=0.0
):
    """C_be (m, 3, 3) of motion sampled at m rising instants.

    Parameters
    ----------
    pos_ecef_m, vel_ecef_mps : (m, 3)
    specific_force_ecef_mps2 : (m, 3), needed for ``kind = "aircraft"`` alone
    heading_rad : float
        Azimuth of the forward axis of a vehicle that never moves (then also level).

    Raises
    ------
    ValueError
        Vertical motion, whose heading and roll are undefined.
    """
    pos = np.atleast_2d(np.asarray(pos_ecef_m, float))
    down = _down(pos)
    forward = _forward(np.atleast_2d(np.asarray(vel_ecef_mps, float)), down, heading_rad)
    if kind == "aircraft":
        force = np.atleast_2d(np.asarray(specific_force_ecef_mps2, float))
        down = -_unit(force)
    right = np.cross(down, forward)
    length = np.linalg.norm(right, axis=1, keepdims=True)
    if np.any(length < 1e-3):
        at = int(np.argmin(length))
        raise ValueError(
            f"attitude is undefined at sample {at}: the motion is vertical there; give it a course."
        )
    right = right / length
    return np.stack([forward, right, np.cross(forward, right)], axis=-1)


def specific_force_ecef(vel_ecef_mps, acc_ecef_mps2, gravity_ecef_mps2):
    """f^e = a^e - g^e + 2 w_ie x v^e, (m, 3): what accelerometers feel (Abdel-Hafez, both papers, eq. 2)."""
    w = np.array([0.0, 0.0, EARTH_RATE_RAD_S])
    return acc_ecef_mps2 - gravity_ecef_mps2 + 2.0 * np.cross(w, vel_ecef_mps)
