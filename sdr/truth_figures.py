"""Figures of what is only known of a simulation: how antenna, satellites and clock moved, and the echoes."""

import tomllib
from pathlib import Path

import h5py
import numpy as np

from sdr.errors import satellite_truth, tracking_errors
from sdr.figure import channel_name, figure
from signals.clock import G0_MPS2
from signals.constants import C_MPS, F_L1_HZ, WAVELENGTH_M
from signals.geodesy import ecef_to_geodetic, ned_matrix

FASTEST_STANDING_MPS = 1.0
ORBIT_MPS2 = 1.0
"""Accelerations along the line of sight that come of the orbits alone are smaller."""


def motion(h5: h5py.File, channels: dict[str, h5py.Group], directory: Path) -> Path | None:
    """Speed, acceleration along the lines of sight, Doppler and clock of a run in which something moves."""
    if "truth/receiver" not in h5 or "truth/satellites" not in h5 or len(h5["truth/receiver"]) < 2:
        return None
    receiver, satellites = h5["truth/receiver"][:], h5["truth/satellites"][:]
    speed = np.linalg.norm(receiver["vel_ecef_mps"], axis=1)
    lines = {name: _line_of_sight(one, receiver) for name, one in _by_satellite(satellites).items()}
    fastest = max(float(np.abs(acceleration).max()) for _, _, acceleration in lines.values())
    if speed.max() < FASTEST_STANDING_MPS and fastest < ORBIT_MPS2:
        return None
    path = directory / "motion.png"
    with figure(path, "Motion and clock: truth", rows=4, size=(9, 9)) as axes:
        axes[0].plot(receiver["t_s"], speed, "k", lw=0.9)
        for k, (name, (t_s, doppler_hz, acceleration)) in enumerate(lines.items()):
            axes[1].plot(t_s, acceleration, lw=0.9, color=f"C{k}", label=name)
            axes[2].plot(t_s, doppler_hz * 1e-3, lw=0.9, color=f"C{k}")
        clock_hz = receiver["clock_drift_s_s"] * F_L1_HZ
        axes[3].plot(receiver["t_s"], clock_hz - clock_hz.mean(), "k", lw=0.9, label="all")
        felt_hz = _felt_hz(h5, receiver)
        if felt_hz.any():
            axes[3].plot(receiver["t_s"], felt_hz - felt_hz.mean(), "C3--", lw=0.9, label="of acceleration")
            axes[3].legend(fontsize=7)
        labels = (
            "antenna (m/s)",
            "away from the\nsatellite (m/s²)",
            "Doppler (kHz)",
            f"clock (Hz at L1)\nless {clock_hz.mean():.1f}",
        )
        for ax, label in zip(axes, labels, strict=True):
            ax.set_ylabel(label)
        axes[1].legend(ncol=10, fontsize=7, loc="lower center", bbox_to_anchor=(0.5, 1.0))
        axes[-1].set_xlabel("time (s)")
    return path


def _felt_hz(h5: h5py.File, receiver: np.ndarray) -> np.ndarray:
    """What the oscillator's g-sensitivity makes of the antenna's acceleration, Hz at L1."""
    clock = tomllib.loads(h5.attrs["scenario"]).get("clock", {})
    lat, lon, _ = ecef_to_geodetic(receiver["pos_ecef_m"][:1])
    axis = np.array(clock.get("g_sensitivity_ned_per_g", (0.0, 0.0, 0.0))) @ ned_matrix(lat[0], lon[0])
    acceleration = np.gradient(receiver["vel_ecef_mps"], receiver["t_s"], axis=0)
    return F_L1_HZ * (acceleration @ axis) / G0_MPS2


def _by_satellite(rows: np.ndarray) -> dict[str, np.ndarray]:
    """Rows of each satellite that is there at more than one time."""
    names = sorted({(system, prn) for system, prn in zip(rows["system"].tolist(), rows["prn"].tolist())})
    parts = {f"{s.decode()}{p:02d}": rows[(rows["system"] == s) & (rows["prn"] == p)] for s, p in names}
    return {name: part for name, part in parts.items() if len(part) > 1}


def _line_of_sight(rows: np.ndarray, receiver: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, Doppler, and acceleration away from the satellite, the clock's taken out."""
    drift = np.interp(rows["t_s"], receiver["t_s"], receiver["clock_drift_s_s"])
    speed_mps = -WAVELENGTH_M * (rows["doppler_hz"] + F_L1_HZ * drift)
    return rows["t_s"], rows["doppler_hz"], np.gradient(speed_mps, rows["t_s"])


def echoes(h5: h5py.File, channels: dict[str, h5py.Group], directory: Path) -> Path | None:
    """The echoes of the satellite whose code errs most for them: power, delay, phase, and the errors they make."""
    if "truth/echoes" not in h5 or not len(h5["truth/echoes"]):
        return None
    rows = h5["truth/echoes"][:]
    errors = {}
    for group in channels.values():
        attrs = group["epochs"].attrs
        system = b"G" if attrs["signal"] == "L1CA" else b"E"
        truth = satellite_truth(h5, system, attrs["prn"])
        if len(truth) > 1 and np.any((rows["system"] == system) & (rows["prn"] == attrs["prn"])):
            errors[channel_name(group)] = tracking_errors(
                group["epochs"][:], truth, attrs["fs_hz"], attrs["signal"]
            )
    errors = {n: {k: v[e["t_s"] > e["t_s"][:1] + 1.0] for k, v in e.items()} for n, e in errors.items()}
    errors = {n: e for n, e in errors.items() if len(e["t_s"])}
    if not errors:
        return None
    name = max(errors, key=lambda n: float(np.std(errors[n]["code_m"])))
    error = errors[name]
    own = rows[(rows["system"] == name[:1].encode()) & (rows["prn"] == int(name[1:]))]
    path = directory / "echoes.png"
    with figure(
        path, f"Echoes of {name}: truth, and the errors of its tracking", rows=5, size=(9, 10)
    ) as axes:
        for k in np.unique(own["echo"]):
            one = own[own["echo"] == k]
            power_db = np.where(np.isfinite(one["power_db"]), one["power_db"], np.nan)
            axes[0].plot(one["t_s"], power_db, lw=0.9, color=f"C{k}", label=f"echo {k + 1}")
            axes[1].plot(one["t_s"], one["delay_s"] * C_MPS, lw=0.9, color=f"C{k}")
            axes[2].plot(one["t_s"], one["phase_rad"] / (2 * np.pi), ".", ms=2, color=f"C{k}")
        axes[3].plot(error["t_s"], error["code_m"], "k", lw=0.7)
        axes[4].plot(error["t_s"], error["phase_cycles"], "k", lw=0.7)
        for ax, label in zip(
            axes, ("power (dB)", "delay (m)", "phase (cycle)", "code (m)", "carrier (cycle)"), strict=True
        ):
            ax.set_ylabel(label)
        axes[0].legend(ncol=8, fontsize=7)
        axes[-1].set_xlabel("time (s)")
    return path
