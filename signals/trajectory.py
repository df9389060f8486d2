"""Motion of the antenna: Specs of a scenario's ``[motion]`` section, each started into ``t_s -> MotionState``.

Adding a motion touches this file: a Spec with a ``kind``, its ``start``, and its name in `MotionSpec`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from signals.geodesy import geodetic_to_ecef, ned_to_ecef_matrix

G0_MPS2 = 9.80665
"""Standard gravity (ISO 80000-3)."""


@dataclass(frozen=True)
class MotionState:
    """True motion of the antenna at (m,) instants, Earth-fixed; acceleration is the second time derivative."""

    pos_ecef_m: np.ndarray
    vel_ecef_mps: np.ndarray
    acc_ecef_mps2: np.ndarray


Motion = Callable[[np.ndarray], MotionState]
"""True time since the start epoch (m,) -> `MotionState` with arrays (m, 3)."""

_FROZEN = ConfigDict(frozen=True, extra="forbid")
_Vector = tuple[float, float, float]


class _Place(BaseModel):
    """Geodetic anchor on WGS 84 shared by the motions."""

    model_config = _FROZEN
    lat_deg: float = Field(default=48.0, ge=-90.0, le=90.0)
    lon_deg: float = Field(default=11.0, ge=-180.0, le=360.0)
    height_m: float = Field(default=500.0, ge=-500.0, le=100_000.0)

    def anchor(self) -> tuple[np.ndarray, np.ndarray]:
        """ECEF position (3,) and rotation C_en (3, 3) of the anchor."""
        lat, lon = np.radians(self.lat_deg), np.radians(self.lon_deg)
        return geodetic_to_ecef(lat, lon, self.height_m), ned_to_ecef_matrix(lat, lon)


def _times(t_s) -> np.ndarray:
    return np.atleast_1d(np.asarray(t_s, float))


class Static(_Place):
    """An antenna that stands still."""

    kind: Literal["Static"] = "Static"

    def start(self, duration_s: float | None = None) -> Motion:
        """Run of the motion; any duration."""
        pos, _ = self.anchor()

        def at(t_s) -> MotionState:
            m = _times(t_s).size
            return MotionState(np.tile(pos, (m, 1)), np.zeros((m, 3)), np.zeros((m, 3)))

        return at


class Line(_Place):
    """A straight line in the local level frame of the anchor, p = p0 + v t + a t^2 / 2."""

    kind: Literal["Line"] = "Line"
    vel_ned_mps: _Vector = (0.0, 0.0, 0.0)
    acc_ned_mps2: _Vector = (0.0, 0.0, 0.0)

    def start(self, duration_s: float | None = None) -> Motion:
        """Run of the motion; any duration."""
        pos, c_en = self.anchor()
        vel, acc = c_en @ np.array(self.vel_ned_mps), c_en @ np.array(self.acc_ned_mps2)

        def at(t_s) -> MotionState:
            t = _times(t_s)[:, None]
            return MotionState(pos + t * (vel + 0.5 * t * acc), vel + t * acc, np.tile(acc, (t.size, 1)))

        return at


MotionSpec = Annotated[Static | Line, Field(discriminator="kind")]
"""Any of the motions; ``kind`` names it."""
