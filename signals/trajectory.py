"""Motion of the antenna: Specs of a scenario's ``[motion]`` section, each started into t_s -> `MotionState`.

Adding a motion touches this file: a Spec with a ``kind``, its ``start``, and its name in `MotionSpec`.
Every motion has a continuous acceleration, so that Doppler and its rate are continuous (Line and Approach are
straight; Segments, HighDynamics, Circle and Recorded are smooth).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numba import njit
from pydantic import BaseModel, ConfigDict, Field, model_validator

from signals.constants import C_MPS, F_L1_HZ, WGS84_A_M, WGS84_E2
from signals.geodesy import ecef_to_geodetic, geodetic_to_ecef, ned_matrix
from signals.geometry_kernels import geodetic_kernel

__all__ = [
    "Approach",
    "Circle",
    "HighDynamics",
    "Line",
    "Motion",
    "MotionSpec",
    "MotionState",
    "Range",
    "Recorded",
    "Segment",
    "Segments",
    "Static",
    "read_track",
]


@dataclass(frozen=True)
class MotionState:
    """True motion of the antenna at (m,) instants, Earth-fixed, with the derivatives of its position."""

    pos_ecef_m: np.ndarray
    vel_ecef_mps: np.ndarray
    acc_ecef_mps2: np.ndarray


Motion = Callable[[np.ndarray], MotionState]
"""True time since the start epoch (m,) -> `MotionState` with arrays (m, 3)."""

_FROZEN = ConfigDict(frozen=True, extra="forbid")
_Vector = tuple[float, float, float]
_Period = Annotated[float, Field(gt=0.1, le=1e4)]
_MARGIN_S = 0.25
"""Motions answer this long before 0 and after their end: a receiver clock may be fast or slow by 0.1 s."""


class _Place(BaseModel):
    """Geodetic anchor on WGS 84 shared by the motions."""

    model_config = _FROZEN
    lat_deg: float = Field(default=48.0, ge=-90.0, le=90.0)
    """Latitude of the anchor."""
    lon_deg: float = Field(default=11.0, ge=-180.0, le=360.0)
    """Longitude of the anchor."""
    height_m: float = Field(default=500.0, ge=-500.0, le=100_000.0)
    """Height of the anchor above the WGS 84 ellipsoid."""

    def anchor(self) -> tuple[np.ndarray, np.ndarray]:
        """ECEF position (3,) and rotation C_ne (3, 3), ECEF to north-east-down, of the anchor."""
        lat, lon = math.radians(self.lat_deg), math.radians(self.lon_deg)
        return geodetic_to_ecef(lat, lon, self.height_m), ned_matrix(lat, lon)

    def _local(self, pos_ned, vel_ned, acc_ned) -> MotionState:
        """State from (m, 3) arrays in the fixed north-east-down axes of the anchor."""
        origin, c_ne = self.anchor()
        return MotionState(origin + pos_ned @ c_ne, vel_ned @ c_ne, acc_ned @ c_ne)


def _times(t_s) -> np.ndarray:
    return np.atleast_1d(np.asarray(t_s, float))


def _check_span(t: np.ndarray, end_s: float, what: str) -> None:
    if t.size and (t.min() < -_MARGIN_S or t.max() > end_s + _MARGIN_S):
        raise ValueError(f"{what} covers 0 to {end_s:g} s, but {t.min():g} to {t.max():g} s was asked for")


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
    """A straight line, p = p0 + v t + a t^2 / 2, in the fixed north-east-down axes of the anchor."""

    kind: Literal["Line"] = "Line"
    vel_ned_mps: _Vector = (0.0, 0.0, 0.0)
    """Velocity at the start."""
    acc_ned_mps2: _Vector = (0.0, 0.0, 0.0)
    """Constant acceleration."""

    def start(self, duration_s: float | None = None) -> Motion:
        """Run of the motion; any duration."""
        vel, acc = np.array(self.vel_ned_mps), np.array(self.acc_ned_mps2)

        def at(t_s) -> MotionState:
            t = _times(t_s)[:, None]
            return self._local(t * (vel + 0.5 * t * acc), vel + t * acc, np.tile(acc, (t.size, 1)))

        return at


class Circle(_Place):
    """A circle about the anchor in its level plane, clockwise from north for positive speed."""

    kind: Literal["Circle"] = "Circle"
    radius_m: float = Field(default=500.0, gt=0.0, le=1e6)
    """Radius."""
    speed_mps: float = Field(default=20.0, ge=-5_000.0, le=5_000.0)
    """Speed; negative: counter-clockwise."""
    start_azimuth_deg: float = Field(default=0.0, ge=-360.0, le=360.0)
    """Where on the circle it begins."""

    def start(self, duration_s: float | None = None) -> Motion:
        """Run of the motion; any duration."""
        r, w = self.radius_m, self.speed_mps / self.radius_m

        def at(t_s) -> MotionState:
            angle = math.radians(self.start_azimuth_deg) + w * _times(t_s)
            out = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
            along = np.stack([-out[:, 1], out[:, 0], out[:, 2]], axis=1)
            return self._local(r * out, r * w * along, -r * w * w * out)

        return at


class Approach(_Place):
    """A precision approach: a straight beam that meets the threshold (the anchor) at the glide angle.

    57.3 m/s at 3 deg sink at 3 m/s; from ``start_height_m`` above the threshold the run may last
    start_height / sink.
    """

    kind: Literal["Approach"] = "Approach"
    course_deg: float = Field(default=90.0, ge=-360.0, le=360.0)
    """Course over ground."""
    glide_deg: float = Field(default=3.0, gt=0.0, le=20.0)
    """Glide angle."""
    ground_speed_mps: float = Field(default=57.3, gt=0.0, le=300.0)
    """Speed over ground."""
    start_height_m: float = Field(default=914.0, gt=0.0, le=10_000.0)
    """Height above the threshold at the start."""

    def start(self, duration_s: float | None = None) -> Motion:
        """Run of the motion; refused where it would go below the threshold."""
        slope = math.tan(math.radians(self.glide_deg))
        course = math.radians(self.course_deg)
        along = np.array([math.cos(course), math.sin(course), slope])
        start = -self.start_height_m / slope * along
        touchdown_s = self.start_height_m / (slope * self.ground_speed_mps)
        if duration_s is not None and duration_s > touchdown_s:
            raise ValueError(
                f"approach reaches the threshold after {touchdown_s:.1f} s, but the run lasts {duration_s:g}:"
                " raise start_height_m or shorten the run"
            )

        def at(t_s) -> MotionState:
            t = _times(t_s)[:, None]
            vel = np.tile(self.ground_speed_mps * along, (t.size, 1))
            return self._local(start + t * vel, vel, np.zeros_like(vel))

        return at


class HighDynamics(_Place):
    """Sinusoidal accelerations a_i = A_i sin(2 pi t / P_i) north, east, down about a mean velocity.

    The defaults are a dynamic flight for ultra-tight tracking (assumed); raise acc_ned_mps2 for 10 g.
    """

    kind: Literal["HighDynamics"] = "HighDynamics"
    height_m: float = Field(default=5_000.0, ge=-500.0, le=100_000.0)
    acc_ned_mps2: _Vector = (10.0, 8.0, 5.0)
    """Amplitudes north, east, down."""
    period_s: tuple[_Period, _Period, _Period] = (20.0, 14.0, 9.0)
    """Periods north, east, down."""
    vel_ned_mps: _Vector = (150.0, 0.0, 0.0)
    """Mean velocity."""

    def start(self, duration_s: float | None = None) -> Motion:
        """Run of the motion; any duration."""
        amp, mean = np.array(self.acc_ned_mps2), np.array(self.vel_ned_mps)
        w = 2.0 * np.pi / np.array(self.period_s)

        def at(t_s) -> MotionState:
            t = _times(t_s)[:, None]
            s, c = np.sin(w * t), np.cos(w * t)
            return self._local(mean * t - amp / w**2 * s, mean - amp / w * c, amp * s)

        return at


# --- segments --------------------------------------------------------------------------------------------


class Segment(BaseModel):
    """One stretch of a drive or flight; what it changes, it changes smoothly and completes at its end.

    ``speed_mps`` (ground speed) or ``acceleration_mps2`` (its mean), ``climb_mps`` (vertical speed) and
    ``turn_rate_deg_s`` (mean, clockwise). A speed left out stays.
    """

    model_config = _FROZEN
    duration_s: float = Field(gt=0.0, le=86_400.0)
    """Length of the segment."""
    speed_mps: float | None = Field(default=None, ge=0.0, le=3_000.0)
    """Ground speed at its end; unset: it stays."""
    acceleration_mps2: float | None = Field(default=None, ge=-500.0, le=500.0)
    """Mean acceleration, instead of a speed."""
    climb_mps: float | None = Field(default=None, ge=-1_000.0, le=1_000.0)
    """Vertical speed at its end; unset: it stays."""
    turn_rate_deg_s: float = Field(default=0.0, ge=-360.0, le=360.0)
    """Mean turn rate, clockwise."""

    @model_validator(mode="after")
    def _one_way(self):
        if self.speed_mps is not None and self.acceleration_mps2 is not None:
            raise ValueError("a segment gives speed_mps and acceleration_mps2: give one of them")
        return self


class Segments(_Place):
    """A land vehicle or an aircraft: speed, heading and climb over the ellipsoid, segment by segment.

    Within a segment of length D each of them goes from y0 to y1 as y0 + (y1 - y0) S(t), where the rate S'
    rises over ``ramp_s`` (at most D / 2) by the cubic 3 x^2 - 2 x^3, stays and falls again; so a plateau is
    D / (D - ramp) times the mean. After the last segment the motion goes on unchanged.
    """

    kind: Literal["Segments"] = "Segments"
    heading_deg: float = Field(default=0.0, ge=-360.0, le=360.0)
    """Heading at the start, clockwise from north."""
    speed_mps: float = Field(default=0.0, ge=0.0, le=3_000.0)
    """Ground speed at the start."""
    climb_mps: float = Field(default=0.0, ge=-1_000.0, le=1_000.0)
    """Vertical speed at the start."""
    ramp_s: float = Field(default=2.0, gt=0.0, le=60.0)
    """How long a rate takes to build up within a segment."""
    segment: tuple[Segment, ...] = Field(min_length=1, max_length=10_000)

    def start(self, duration_s: float | None = None) -> Motion:
        """Integrate over the ellipsoid (RK4, 0.05 s), interpolate by quintic Hermite; covers ``duration_s``.

        Raises
        ------
        ValueError
            If a speed becomes negative or the path comes within 0.1 deg of a pole.
        """
        table = self._table()
        length = float(table[-1, 0]) if duration_s is None else float(duration_s)
        n = math.ceil((length + _MARGIN_S) / _STEP_S) + 1
        lead = math.ceil(_MARGIN_S / _STEP_S)
        origin, _ = self.anchor()
        back, ahead = np.empty((lead + 1, 9)), np.empty((n + 1, 9))
        _drive_kernel(table, self.ramp_s, origin, -_STEP_S, back)
        _drive_kernel(table, self.ramp_s, origin, _STEP_S, ahead)
        nodes = np.concatenate([back[:0:-1], ahead])
        if not np.all(np.isfinite(nodes)):
            raise ValueError("the segments lead to a pole, where heading has no meaning: turn earlier")

        def at(t_s) -> MotionState:
            t = _times(t_s)
            _check_span(t, length, "the motion of the segments")
            return _quintic(nodes, t + lead * _STEP_S, origin)

        return at

    def _table(self) -> np.ndarray:
        """Rows (end time, duration, speed0, speed1, heading0, heading1, climb0, climb1), heading in rad."""
        rows, t, v, psi, climb = [], 0.0, self.speed_mps, math.radians(self.heading_deg), self.climb_mps
        for i, s in enumerate(self.segment):
            v1 = v if s.speed_mps is None else s.speed_mps
            v1 = v1 if s.acceleration_mps2 is None else v + s.acceleration_mps2 * s.duration_s
            if v1 < 0.0:
                raise ValueError(
                    f"segment {i + 1} ends at {v1:g} m/s: brake less, a speed cannot be negative"
                )
            psi1 = psi + math.radians(s.turn_rate_deg_s) * s.duration_s
            climb1 = climb if s.climb_mps is None else s.climb_mps
            t += s.duration_s
            rows.append((t, s.duration_s, v, v1, psi, psi1, climb, climb1))
            v, psi, climb = v1, psi1, climb1
        return np.array(rows)


_STEP_S = 0.05


@njit(cache=True, nogil=True)
def _smooth(tau, d, ramp):
    """S(tau) and S'(tau) of a segment of length d (see `Segments`)."""
    r = min(ramp, 0.5 * d)
    if tau <= 0.0:
        return 0.0, 0.0
    if tau >= d:
        return 1.0, 0.0
    if tau < r:
        x = tau / r
        return r * x**3 * (1.0 - 0.5 * x) / (d - r), x * x * (3.0 - 2.0 * x) / (d - r)
    if tau > d - r:
        x = (d - tau) / r
        return 1.0 - r * x**3 * (1.0 - 0.5 * x) / (d - r), x * x * (3.0 - 2.0 * x) / (d - r)
    return (tau - 0.5 * r) / (d - r), 1.0 / (d - r)


@njit(cache=True, nogil=True)
def _drive(table, ramp, t, origin, dx, dy, dz):
    """ECEF velocity and acceleration at displacement (dx, dy, dz) and time t, as the table commands."""
    row = 0
    while row < table.shape[0] - 1 and t > table[row, 0]:
        row += 1
    d = table[row, 1]
    s, s_dot = _smooth(t - (table[row, 0] - d), d, ramp)
    dv, dpsi, dclimb = (
        table[row, 3] - table[row, 2],
        table[row, 5] - table[row, 4],
        table[row, 7] - table[row, 6],
    )
    speed, psi, climb = table[row, 2] + s * dv, table[row, 4] + s * dpsi, table[row, 6] + s * dclimb
    accel, turn, lift = s_dot * dv, s_dot * dpsi, s_dot * dclimb
    lat, lon, h = geodetic_kernel(origin[0] + dx, origin[1] + dy, origin[2] + dz)
    sl, cl, so, co = math.sin(lat), math.cos(lat), math.sin(lon), math.cos(lon)
    if cl < 1.75e-3:
        nan = math.nan
        return nan, nan, nan, nan, nan, nan
    cp, sp = math.cos(psi), math.sin(psi)
    vn, ve, vd = speed * cp, speed * sp, -climb
    q = 1.0 - WGS84_E2 * sl * sl
    prime = WGS84_A_M / math.sqrt(q)
    lat_dot, lon_dot = vn / (prime * (1.0 - WGS84_E2) / q + h), ve / ((prime + h) * cl)
    # v' in the turning local axes: commanded part plus omega_en x v.
    an = accel * cp - turn * ve - lat_dot * vd + lon_dot * sl * ve
    ae = accel * sp + turn * vn - lon_dot * sl * vn - lon_dot * cl * vd
    ad = -lift + lon_dot * cl * ve + lat_dot * vn
    return (
        -sl * co * vn - so * ve - cl * co * vd,
        -sl * so * vn + co * ve - cl * so * vd,
        cl * vn - sl * vd,
        -sl * co * an - so * ae - cl * co * ad,
        -sl * so * an + co * ae - cl * so * ad,
        cl * an - sl * ad,
    )


@njit(cache=True, nogil=True)
def _drive_kernel(table, ramp, origin, step, out):
    """RK4 from t = 0 in steps of ``step``; out (n, 9): displacement, velocity, acceleration."""
    x = y = z = 0.0
    for j in range(out.shape[0]):
        t = j * step
        k1 = _drive(table, ramp, t, origin, x, y, z)
        out[j, 0], out[j, 1], out[j, 2] = x, y, z
        for c in range(6):
            out[j, 3 + c] = k1[c]
        h = 0.5 * step
        k2 = _drive(table, ramp, t + h, origin, x + h * k1[0], y + h * k1[1], z + h * k1[2])
        k3 = _drive(table, ramp, t + h, origin, x + h * k2[0], y + h * k2[1], z + h * k2[2])
        k4 = _drive(table, ramp, t + step, origin, x + step * k3[0], y + step * k3[1], z + step * k3[2])
        x += step / 6.0 * (k1[0] + 2.0 * k2[0] + 2.0 * k3[0] + k4[0])
        y += step / 6.0 * (k1[1] + 2.0 * k2[1] + 2.0 * k3[1] + k4[1])
        z += step / 6.0 * (k1[2] + 2.0 * k2[2] + 2.0 * k3[2] + k4[2])


def _quintic(nodes: np.ndarray, t: np.ndarray, origin: np.ndarray) -> MotionState:
    """Quintic Hermite through (n, 9) nodes _STEP_S apart, the first at t = 0; C2."""
    h = _STEP_S
    k = np.clip((t / h).astype(np.int64), 0, nodes.shape[0] - 2)
    u = (t / h - k)[:, None]
    p0, v0, a0 = nodes[k, :3], nodes[k, 3:6] * h, nodes[k, 6:] * h * h
    p1, v1, a1 = nodes[k + 1, :3], nodes[k + 1, 3:6] * h, nodes[k + 1, 6:] * h * h
    # Remainder of the Taylor step from the left node, in position, velocity, acceleration at the right one.
    e, f, g = p1 - p0 - v0 - 0.5 * a0, v1 - v0 - a0, a1 - a0
    c3, c4, c5 = 10.0 * e - 4.0 * f + 0.5 * g, -15.0 * e + 7.0 * f - g, 6.0 * e - 3.0 * f + 0.5 * g
    pos = p0 + u * (v0 + u * (0.5 * a0 + u * (c3 + u * (c4 + u * c5))))
    vel = v0 + u * (a0 + u * (3.0 * c3 + u * (4.0 * c4 + 5.0 * u * c5)))
    acc = a0 + u * (6.0 * c3 + u * (12.0 * c4 + 20.0 * u * c5))
    return MotionState(origin + pos, vel / h, acc / (h * h))


# --- recorded --------------------------------------------------------------------------------------------

_MAX_TRACK_BYTES = 64 << 20
_MAX_TRACK_ROWS = 1_000_000
_COLUMNS = {"ecef": ("t_s", "x_m", "y_m", "z_m"), "geodetic": ("t_s", "lat_deg", "lon_deg", "height_m")}


class Recorded(BaseModel):
    """A track from a file: CSV (header ``t_s,x_m,y_m,z_m`` or ``t_s,lat_deg,lon_deg,height_m``) or NMEA GGA.

    Scenario time 0 is the first row plus ``skip_s``. A cubic spline (C2) runs through the rows, so that
    Doppler and acceleration are continuous.
    Heights are above the ellipsoid (NMEA: altitude plus geoid separation).
    """

    model_config = _FROZEN
    kind: Literal["Recorded"] = "Recorded"
    path: str = Field(min_length=1)
    """File with the track."""
    skip_s: float = Field(default=0.0, ge=0.0)
    """Leave out the first seconds of the track."""
    max_speed_mps: float = Field(default=600.0, gt=0.0, le=20_000.0)
    """A faster track is refused."""
    max_acceleration_mps2: float = Field(default=200.0, gt=0.0, le=5_000.0)
    """A rougher track is refused."""

    def start(self, duration_s: float | None = None) -> Motion:
        """Read and check the file; refused where the track jumps, repeats a time or ends before the run."""
        from scipy.interpolate import CubicSpline

        t, pos = read_track(self.path)
        self._check(t, pos)
        t = t - t[0] - self.skip_s
        if t[-1] <= 0.0 or (duration_s is not None and duration_s > t[-1]):
            raise ValueError(
                f"track {self.path} lasts {t[-1]:g} s after skip_s, the scenario {duration_s or 0:g} s:"
                " shorten the run or bring a longer track"
            )
        spline, end_s = CubicSpline(t, pos, axis=0), float(t[-1])

        def at(t_s) -> MotionState:
            when = _times(t_s)
            _check_span(when, end_s, f"track {self.path}")
            return MotionState(spline(when), spline(when, 1), spline(when, 2))

        return at

    def _check(self, t: np.ndarray, pos: np.ndarray) -> None:
        dt = np.diff(t)
        if np.any(dt <= 0.0):
            row = int(np.argmax(dt <= 0.0)) + 2
            raise ValueError(
                f"track {self.path}: the time of row {row}, {t[row - 1]:g} s, repeats or goes back; it must rise"
            )
        vel = np.diff(pos, axis=0) / dt[:, None]
        speed = np.linalg.norm(vel, axis=1)
        acc = np.linalg.norm(np.diff(vel, axis=0), axis=1) / (0.5 * (dt[1:] + dt[:-1]))
        checks = (
            ("speed_mps", speed, self.max_speed_mps),
            ("acceleration_mps2", acc, self.max_acceleration_mps2),
        )
        for name, value, limit in checks:
            if np.any(value > limit):
                row = int(np.argmax(value > limit)) + 2
                raise ValueError(
                    f"track {self.path} jumps at row {row}: {value[row - 2]:.4g} > max_{name} = {limit:g};"
                    " mend the track or raise the limit"
                )


def read_track(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) in s and ECEF positions (n, 3) in m of a CSV or NMEA file (told apart by the first ``$``).

    Raises
    ------
    ValueError
        File missing, too large, of neither form, with fewer than 4 rows, or with a row that is not numbers.
    """
    file = Path(path)
    if not file.is_file():
        raise ValueError(f"track {path} does not exist: give a CSV or NMEA file")
    if file.stat().st_size > _MAX_TRACK_BYTES:
        raise ValueError(f"track {path} is larger than {_MAX_TRACK_BYTES >> 20} MiB: cut it")
    lines = file.read_text(encoding="ascii", errors="replace").splitlines()
    lines = [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if len(lines) > _MAX_TRACK_ROWS:
        raise ValueError(f"track {path} has more than {_MAX_TRACK_ROWS} rows: cut it")
    t, pos = _read_nmea(path, lines) if lines and lines[0].startswith("$") else _read_csv(path, lines)
    if t.size < 4:
        raise ValueError(f"track {path} has {t.size} positions: at least 4 are needed")
    if not (np.all(np.isfinite(t)) and np.all(np.isfinite(pos))):
        raise ValueError(f"track {path} holds a value that is not finite: mend or remove the row")
    return t, pos


def _read_csv(path, lines: list[str]) -> tuple[np.ndarray, np.ndarray]:
    header = tuple(name.strip() for name in lines[0].split(",")) if lines else ()
    form = next((key for key, names in _COLUMNS.items() if names == header), None)
    if form is None:
        allowed = " or ".join(",".join(names) for names in _COLUMNS.values())
        raise ValueError(f"track {path} must begin with the header {allowed}")
    table = np.empty((len(lines) - 1, 4))
    for row, line in enumerate(lines[1:]):
        try:
            table[row] = [float(cell) for cell in line.split(",")]
        except ValueError:
            raise ValueError(f"track {path}: row {row + 1} is not four numbers: {line[:60]!r}") from None
    return _positions(path, form, table)


def _positions(path, form: str, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    t, columns = table[:, 0], table[:, 1:]
    if form == "ecef":
        height = ecef_to_geodetic(columns)[2] if columns.size else np.zeros(0)
        if np.any(np.abs(height) > 1e6):
            raise ValueError(
                f"track {path}: a position is more than 1000 km from the ellipsoid: are x, y, z in m?"
            )
        return t, columns
    if np.any(np.abs(columns[:, 0]) > 90.0) or np.any(np.abs(columns[:, 1]) > 360.0):
        raise ValueError(f"track {path}: a latitude or longitude is out of range: degrees are expected")
    return t, geodetic_to_ecef(np.radians(columns[:, 0]), np.radians(columns[:, 1]), columns[:, 2])


def _read_nmea(path, lines: list[str]) -> tuple[np.ndarray, np.ndarray]:
    rows: list[tuple[float, ...]] = []
    day_s = 0.0
    for number, line in enumerate(lines, 1):
        if line[3:7] != "GGA,":
            continue
        try:
            row = _gga(line)
        except (ValueError, IndexError):
            raise ValueError(
                f"track {path}: line {number} is not a valid GGA sentence: {line[:60]!r}"
            ) from None
        if row is None:
            continue
        if rows and row[0] + day_s < rows[-1][0] - 43_200.0:
            day_s += 86_400.0
        rows.append((row[0] + day_s, *row[1:]))
    return _positions(path, "geodetic", np.array(rows, dtype=float).reshape(-1, 4))


def _gga(line: str) -> tuple[float, float, float, float] | None:
    """Time of day, latitude, longitude (deg) and ellipsoidal height of a GGA sentence; None without a fix."""
    body, _, checksum = line[1:].partition("*")
    if checksum:
        total = 0
        for char in body.encode("ascii"):
            total ^= char
        if total != int(checksum[:2], 16):
            raise ValueError("checksum")
    f = body.split(",")
    if int(f[6]) == 0:
        return None
    t = 3600.0 * int(f[1][:2]) + 60.0 * int(f[1][2:4]) + float(f[1][4:])
    lat = (int(f[2][:2]) + float(f[2][2:]) / 60.0) * {"N": 1, "S": -1}.get(f[3], math.nan)
    lon = (int(f[4][:3]) + float(f[4][3:]) / 60.0) * {"E": 1, "W": -1}.get(f[5], math.nan)
    return t, lat, lon, float(f[9]) + float(f[11] or 0.0)


MotionSpec = Annotated[
    Static | Line | Segments | Circle | Approach | HighDynamics | Recorded, Field(discriminator="kind")
]
"""Any of the motions; ``kind`` names it."""


# --- range domain ----------------------------------------------------------------------------------------

_G_MPS2 = 9.81
_KNOT_MPS = 1852.0 / 3600.0
_TABLE_4 = {  # acceleration (horizontal and vertical in quadrature), jerk
    "none": (0.0, 0.0),
    "normal": (math.hypot(0.58, 0.5) * _G_MPS2, 0.25 * _G_MPS2),
    "abnormal": (math.hypot(2.0, 1.5) * _G_MPS2, 0.74 * _G_MPS2),
}
_MAX_SPEED_MPS = 800.0 * _KNOT_MPS

RangeRun = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""Time (m,) -> delay_s, its rate (s/s) and its second derivative (1/s), each (m,)."""


class Range(BaseModel):
    """The range of one satellite without geometry, with the manoeuvres of Ouzeau et al. 2008, table 4.

    delay = delay_s - doppler t / F_L1 - doppler_rate t^2 / (2 F_L1) + manoeuvre / c.
    ``profile = "cubic"`` is the paper's tau = a0 + a1 t + a2 t^2 / 2 + a3 t^3 / 6 with a2 the largest
    acceleration and a3 the largest jerk *all the time*, for short runs: its Doppler leaves every receiver's
    range within minutes. ``"bounded"`` alternates them so that the speed stays within +-800 kt: jerk-limited
    accelerations of either sign, repeated.
    """

    model_config = _FROZEN
    delay_s: float = Field(default=0.075, ge=0.0, le=10.0)
    """Delay at the start."""
    doppler_hz: float | Literal["random"] = 0.0
    """Doppler at the start, or "random"."""
    max_doppler_hz: float = Field(default=10e3, ge=0.0, le=50e3)
    """Range of the random Doppler."""
    doppler_rate_hz_s: float = Field(default=0.0, ge=-2_000.0, le=2_000.0)
    """Its rate."""
    manoeuvre: Literal["none", "normal", "abnormal"] = "none"
    """How strongly the receiver manoeuvres along the line of sight."""
    profile: Literal["bounded", "cubic"] = "bounded"
    """Manoeuvres that stay within a speed, or the paper's cubic."""

    @model_validator(mode="after")
    def _doppler_allowed(self):
        if self.doppler_hz != "random" and not abs(self.doppler_hz) <= 50e3:
            raise ValueError(f'doppler_hz = {self.doppler_hz:g} is beyond +-50000 Hz: give less, or "random"')
        return self

    def start_range(self, seed=0) -> RangeRun:
        """Run of the range; ``seed`` (int, SeedSequence or Generator) draws a random Doppler."""
        doppler = self.doppler_hz
        if doppler == "random":
            doppler = np.random.default_rng(seed).uniform(-self.max_doppler_hz, self.max_doppler_hz)
        acc, jerk = _TABLE_4[self.manoeuvre]
        knots = _manoeuvre_knots(acc, jerk)

        def at(t_s) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            t = _times(t_s)
            if self.manoeuvre == "none":
                p = v = a = np.zeros_like(t)
            elif self.profile == "cubic":
                p, v, a = t * t * (acc / 2.0 + jerk * t / 6.0), t * (acc + jerk * t / 2.0), acc + jerk * t
            else:
                p, v, a = _piecewise_cubic(knots, t)
            rate = self.doppler_rate_hz_s
            delay = self.delay_s - t * (doppler + 0.5 * t * rate) / F_L1_HZ + p / C_MPS
            return delay, v / C_MPS - (doppler + t * rate) / F_L1_HZ, a / C_MPS - rate / F_L1_HZ

        return at


def _manoeuvre_knots(acc: float, jerk: float) -> np.ndarray:
    """One period as rows (start time, position, velocity, acceleration, jerk); the last row is its end.

    Acceleration rises to +acc, stays, falls through zero to -acc, stays, returns: velocity goes from -V to +V
    and back, V = 800 kt, mean zero.
    """
    if acc == 0.0:
        return np.zeros((2, 5))
    rise = acc / jerk
    hold = 2.0 * _MAX_SPEED_MPS / acc - rise
    rows, t, p, v, a = [], 0.0, 0.0, -_MAX_SPEED_MPS, 0.0
    for length, j in ((rise, jerk), (hold, 0.0), (2.0 * rise, -jerk), (hold, 0.0), (rise, jerk)):
        rows.append((t, p, v, a, j))
        p += length * (v + length * (a / 2.0 + length * j / 6.0))
        v += length * (a + length * j / 2.0)
        a, t = a + length * j, t + length
    rows.append((t, 0.0, 0.0, 0.0, 0.0))
    return np.array(rows)


def _piecewise_cubic(knots: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    phase = np.mod(t, knots[-1, 0])
    row = np.searchsorted(knots[1:-1, 0], phase, side="right")
    t0, p, v, a, j = knots[row].T
    u = phase - t0
    return p + u * (v + u * (a / 2.0 + u * j / 6.0)), v + u * (a + u * j / 2.0), a + u * j
