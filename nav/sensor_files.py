"""Recorded inertial and odometer data as CSV: a header line, then one row per output.

IMU: ``t_s, gyro_x_rad_s, gyro_y_rad_s, gyro_z_rad_s, accel_x_mps2, accel_y_mps2, accel_z_mps2``; axes
forward, right, down; gravity left in, so that a level vehicle at rest reads accel_z = -9.8; means over the
interval that ends at t_s. Odometer: ``t_s, speed_mps`` at t_s. Barometer: ``t_s, height_m``. ``t_s`` counts from the first IF sample, so
that the row belongs to sample round(t_s fs). Lines that start with # are comments.
"""

import os
import warnings
from pathlib import Path

import numpy as np

from nav.records import BAROMETER, IMU, ODOMETER

IMU_COLUMNS = (
    "t_s", "gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s", "accel_x_mps2", "accel_y_mps2", "accel_z_mps2",
)  # fmt: skip
ODOMETER_COLUMNS = ("t_s", "speed_mps")
BAROMETER_COLUMNS = ("t_s", "height_m")
MAX_BYTES = 4 << 30
G0_MPS2 = 9.80665
MAX_GYRO_RAD_S = 100.0
MAX_SPEED_MPS = 500.0
HEIGHTS_M = (-1000.0, 30_000.0)


def write_imu(path, rows):
    """Write IMU rows as CSV (17 significant digits: read back to the same bits)."""
    table = np.column_stack([rows["t_s"], rows["gyro_rad_s"], rows["accel_mps2"]])
    _write(path, table, IMU_COLUMNS)


def write_odometer(path, rows):
    """Write ODOMETER rows as CSV."""
    _write(path, np.column_stack([rows["t_s"], rows["speed_mps"]]), ODOMETER_COLUMNS)


def write_barometer(path, rows):
    """Write BAROMETER rows as CSV."""
    _write(path, np.column_stack([rows["t_s"], rows["height_m"]]), BAROMETER_COLUMNS)


def _write(path, table, columns):
    part = Path(f"{path}.part")
    np.savetxt(part, table, fmt="%.17g", delimiter=",", header=",".join(columns), comments="")
    os.replace(part, path)


def read_imu(path, fs_hz, duration_s=None):
    """IMU rows of a CSV file; ``sample_index`` = round(t_s fs_hz).

    Raises
    ------
    ValueError
        One sentence: missing or oversized file, other columns, text or NaN among the numbers, times that
        do not rise or that jump, data shorter than ``duration_s``, units or axes that cannot be.
    """
    table = _read(path, IMU_COLUMNS, duration_s, "IMU")
    force, gyro = np.linalg.norm(table[:, 4:], axis=1), np.abs(table[:, 1:4]).max()
    typical = float(np.median(force))
    if not 0.5 * G0_MPS2 < typical < 3.0 * G0_MPS2:
        raise ValueError(
            f"{path}: the specific force is {typical:.3g} m/s^2 in the median, not near 9.8: "
            "give m/s^2 (not g) and leave gravity in."
        )
    if np.median(table[:, 6]) > 0.5 * G0_MPS2:
        raise ValueError(
            f"{path}: accel_z_mps2 is {np.median(table[:, 6]):.3g} in the median: the axes must be forward, right, "
            "down, so that it is -9.8 at rest; negate y and z if yours are forward, left, up."
        )
    if gyro > MAX_GYRO_RAD_S:
        raise ValueError(f"{path}: a rate of {gyro:.3g} rad/s cannot be; give rad/s, not deg/s.")
    rows = np.zeros(table.shape[0], IMU)
    rows["t_s"], rows["gyro_rad_s"], rows["accel_mps2"] = table[:, 0], table[:, 1:4], table[:, 4:]
    rows["sample_index"] = np.round(table[:, 0] * fs_hz)
    return rows


def read_odometer(path, fs_hz, duration_s=None):
    """ODOMETER rows of a CSV file; errors as `read_imu`."""
    table = _read(path, ODOMETER_COLUMNS, duration_s, "odometer")
    fastest = float(np.abs(table[:, 1]).max())
    if fastest > MAX_SPEED_MPS:
        raise ValueError(f"{path}: a speed of {fastest:.4g} m/s cannot be a wheel's; give m/s.")
    rows = np.zeros(table.shape[0], ODOMETER)
    rows["t_s"], rows["speed_mps"] = table.T
    rows["sample_index"] = np.round(table[:, 0] * fs_hz)
    return rows


def read_barometer(path, fs_hz, duration_s=None):
    """BAROMETER rows of a CSV file; errors as `read_imu`."""
    table = _read(path, BAROMETER_COLUMNS, duration_s, "barometer")
    low, high = float(table[:, 1].min()), float(table[:, 1].max())
    if low < HEIGHTS_M[0] or high > HEIGHTS_M[1]:
        raise ValueError(
            f"{path}: heights from {low:.5g} to {high:.5g} m cannot be; give metres, not a pressure."
        )
    rows = np.zeros(table.shape[0], BAROMETER)
    rows["t_s"], rows["height_m"] = table.T
    rows["sample_index"] = np.round(table[:, 0] * fs_hz)
    return rows


def _read(path, columns, duration_s, what):
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{what} file {path} does not exist.")
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise ValueError(f"{what} file {path} has {size} bytes, more than the {MAX_BYTES} allowed: cut it.")
    with path.open(encoding="utf-8", errors="replace") as f:
        header = f.readline(4096).strip().lstrip("\ufeff").lstrip("#").strip()
        found = tuple(name.strip() for name in header.split(","))
        if found != columns:
            raise ValueError(
                f"{path}: the first line must name the columns {','.join(columns)}; it is {header[:120]!r}."
            )
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # an empty table is refused below
                table = np.loadtxt(f, delimiter=",", ndmin=2, comments="#")
        except ValueError as error:
            raise ValueError(f"{path}: {str(error).splitlines()[0]}") from None
    if table.size == 0:
        raise ValueError(f"{path}: holds no data below its header.")
    if table.shape[1] != len(columns):
        raise ValueError(f"{path}: rows have {table.shape[1]} values, {len(columns)} are wanted.")
    bad = ~np.isfinite(table).all(axis=1)
    if bad.any():
        raise ValueError(f"{path}: data row {int(np.argmax(bad)) + 1} holds a value that is not finite.")
    check_times(table[:, 0], duration_s, f"{path}: {what} data")
    return table


def check_times(t_s, duration_s, what):
    """Refuse times that fall, jump by more than half an interval, or stop before ``duration_s``."""
    if t_s.size < 3:
        raise ValueError(f"{what} hold {t_s.size} rows; three at least are needed.")
    step = np.diff(t_s)
    usual = float(np.median(step))
    if step.min() <= 0.0:
        at = int(np.argmin(step))
        raise ValueError(
            f"{what} do not rise in time at row {at + 2} ({t_s[at]:.6f} s, then {t_s[at + 1]:.6f} s)."
        )
    if step.max() > 1.5 * usual:
        at = int(np.argmax(step))
        raise ValueError(
            f"{what} jump by {step[at]:.6g} s at {t_s[at]:.6f} s where rows come every {usual:.6g} s: fill the gap."
        )
    if t_s[0] > 1.5 * usual:
        raise ValueError(f"{what} begin at {t_s[0]:.6g} s, after the first sample; they must cover it.")
    if duration_s is not None and t_s[-1] < duration_s - 1.5 * usual:
        raise ValueError(f"{what} end at {t_s[-1]:.6g} s, before the samples do ({duration_s:.6g} s).")


BLOCK_S, EXCITED_MPS2, SURE = 1.0, 0.15, 0.1
"""Accelerations are compared as means over this long; moves weaker than this tell nothing; nor does a share of the other axis whose
standard error is larger."""


def check_axes(force_mps2, turn_rad_s, speed_mps, dt_s, witness="the odometer"):
    """Whether the accelerometer's x and y are forward and right, by the speed that ``witness`` tells and the turn rate about down.

    On level ground f_x = dv/dt and f_y = v w. Each of the two that the drive excites is looked for in both axes by least
    squares: c = cov(move, axis) / var(move), 1 in its own and 0 in the other.

    Parameters
    ----------
    force_mps2 (m, 2) : x, y;  turn_rad_s, speed_mps (m,);  dt_s : between rows

    Returns
    -------
    str : "as they should be", "not observable" (no move strong enough) or "not confirmed" (a move that no axis shows, as in
    banked turns).

    Raises
    ------
    ValueError
        The axes are exchanged, or one points the other way.
    """
    per = max(1, round(BLOCK_S / dt_s))
    blocks = lambda a: a[: len(a) // per * per].reshape(-1, per, *a.shape[1:]).mean(axis=1)  # noqa: E731
    force, speed = blocks(np.asarray(force_mps2)), blocks(np.asarray(speed_mps))
    if len(speed) < 10:
        return "not observable"
    moves = np.gradient(speed, per * dt_s), blocks(np.asarray(speed_mps) * turn_rad_s)
    said = "not observable"
    for k, (move, name) in enumerate(zip(moves, ("speeding up", "turning"))):
        excited = move - move.mean()
        energy = float(excited @ excited)
        share = excited @ (force - force.mean(axis=0)) / max(energy, 1e-30)
        rest = force - force.mean(axis=0) - np.outer(excited, share)
        error = np.sqrt((rest**2).mean(axis=0) / max(energy, 1e-30))
        if move.std() < EXCITED_MPS2 or error.max() > SURE:
            continue
        own, other = share[k], share[1 - k]
        axis, wanted = "xy"[k], ("forward", "right")[k]
        if abs(own) < 0.5 < abs(other):
            raise ValueError(
                f"what {witness} says of {name} stands in accel_{'yx'[k]} ({other:.2f} of it) and not in accel_{axis} "
                f"({own:.2f}): x and y are exchanged; the axes must be forward, right, down."
            )
        if own < -0.5:
            raise ValueError(
                f"accel_{axis} says the opposite of what {witness} says of {name} ({own:.2f} of it): it must point {wanted}."
            )
        said = "not confirmed" if own < 0.5 or said == "not confirmed" else "as they should be"
    return said
