"""Figures of the integrity monitors: statistics with thresholds, faults and answers; the Stanford diagram."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sdr.errors import hermite, levels_and_errors, position_errors
from sdr.figure import figure
from signals.geodesy import ecef_to_geodetic, ned_matrix

TAIL_S = 20.0
"""Error and claim are compared over the last so many seconds."""
LABELS = {
    "innovation": "innovation²/S",
    "raim": "RAIM / limit",
    "bias_bank": "P(bias)",
    "als": "ALS σ / claimed",
    "noise_rmd": "RMD σ / claimed",
    "parallel_filters": "parallel filters Σ",
}


def integrity(h5: h5py.File, channels: dict[str, h5py.Group], directory: Path) -> Path | None:
    """Every monitor's statistic by satellite, its threshold, the faults shaded, and the position error beneath."""
    names = [n for n in LABELS if f"monitors/{n}" in h5]
    if not names:
        return None
    path = directory / "integrity.png"
    with figure(path, "Integrity monitors", rows=len(names) + 1, size=(9, 2 + 1.7 * len(names))) as axes:
        for ax, name in zip(axes, names):
            rows = h5[f"monitors/{name}"][:]
            for system, prn in sorted({(r["system"], r["prn"]) for r in rows}):
                one = rows[(rows["system"] == system) & (rows["prn"] == prn)]
                style = "o-" if len(one) < 20 else "."
                ax.plot(one["t_s"], one["value"], style, ms=2, lw=0.7, label=f"{system.decode()}{prn:02d}")
            ax.axhline(np.median(rows["threshold"]), color="k", lw=0.8, ls="--")
            ax.set_ylabel(LABELS[name], fontsize=8)
            if name in ("innovation", "parallel_filters"):
                ax.set_yscale("symlog", linthresh=float(rows["threshold"][0]))
        axes[0].legend(ncol=10, fontsize=6, loc="upper left")
        _errors(h5, axes[-1])
        _answers(h5, axes[-1])
        for ax in axes:
            _faults(h5, ax)
        axes[-1].set_xlabel("time (s)")
    return path


def _errors(h5: h5py.File, ax: Any) -> None:
    solution: Any = h5["navigation/solution"][:] if "navigation/solution" in h5 else np.empty(0)
    if not len(solution):
        return
    solution = solution[solution["valid"]]
    claimed = np.sqrt(np.trace(solution["cov_ecef_m2"], axis1=1, axis2=2))
    ax.plot(solution["t_s"], claimed, color="0.5", lw=0.8, label="claimed σ, 3D")
    if "truth/receiver" in h5:
        error = position_errors(solution, h5["truth/receiver"][:], h5["navigation/solution"].attrs["fs_hz"])
        ax.plot(solution["t_s"], np.linalg.norm(error, axis=1), lw=0.9, label="error, 3D")
        ax.set_title(_honesty(solution, error), fontsize=8)
    ax.set_ylabel("m")
    ax.legend(fontsize=7, loc="upper left")


def _honesty(solution: Any, error: np.ndarray) -> str:
    """Error against claim at the end, where faults stand and answers hold."""
    late = solution["t_s"] > solution["t_s"][-1] - TAIL_S
    lat_rad, lon_rad, _ = ecef_to_geodetic(solution["pos_ecef_m"][-1:])
    enu = ned_matrix(lat_rad[0], lon_rad[0])[[1, 0, 2]] * [[1.0], [1.0], [-1.0]]
    cov, e = enu @ solution["cov_ecef_m2"][late] @ enu.T, error[late]
    nees = np.einsum("ei,eij,ej->e", e, np.linalg.inv(cov), e).mean()
    size, claimed = (np.sqrt(x.mean()) for x in (np.sum(e**2, axis=1), np.trace(cov, axis1=1, axis2=2)))
    return f"last {TAIL_S:g} s: error {size:.2f} m rms, claimed {claimed:.2f} m, NEES {nees:.1f} of 3"


def _answers(h5: h5py.File, ax: Any) -> None:
    """Times at which a satellite was excluded or its bias removed, along the bottom."""
    if "monitors/response" not in h5:
        return
    rows = h5["monitors/response"][:]
    for mark, part, label in (("x", rows["exclude"], "excluded"), ("|", rows["bias_m"] != 0, "bias removed")):
        if part.any():
            ax.plot(rows["t_s"][part], np.zeros(part.sum()), mark, ms=4, label=label)
    ax.legend(fontsize=7, loc="upper left")


def _faults(h5: h5py.File, ax: Any) -> None:
    if "truth/faults" not in h5:
        return
    rows = h5["truth/faults"][:]
    for k in np.unique(rows["fault"]):
        on = rows[(rows["fault"] == k) & rows["on"]]
        if len(on):
            ax.axvspan(on["t_s"][0], on["t_s"][-1], color=f"C{3 + k}", alpha=0.08)


def stanford(h5: h5py.File, channels: dict[str, h5py.Group], directory: Path) -> Path | None:
    """Protection level against error, horizontal and vertical, with the alert limits."""
    if any(n not in h5 for n in ("monitors/protection", "truth/receiver", "navigation/solution")):
        return None
    solution, truth, level = (
        h5["navigation/solution"][:],
        h5["truth/receiver"][:],
        h5["monitors/protection"][:],
    )
    solution = solution[solution["valid"]]
    fs_hz = h5["navigation/solution"].attrs["fs_hz"]
    t, t_k = solution["sample_index"] / fs_hz, truth["sample_index"] / fs_hz
    true = np.stack(
        [hermite(t, t_k, truth["pos_ecef_m"][:, i], truth["vel_ecef_mps"][:, i]) for i in range(3)], axis=1
    )
    if not len(np.intersect1d(solution["sample_index"], level["sample_index"])):
        return None
    path = directory / "stanford.png"
    parts = levels_and_errors(solution, true, level)
    top = max(max(limit, *error, *bound[np.isfinite(bound)]) for error, bound, limit in parts.values())
    reach = min(1.1 * top, 4 * max(limit for _, _, limit in parts.values()))
    with figure(path, "Stanford diagram: protection level against error", rows=2, size=(6, 9)) as axes:
        for ax, (name, (error, bound, limit)) in zip(axes, parts.items()):
            ax.plot(error, np.minimum(bound, reach), ".", ms=3)
            ax.plot([0, reach], [0, reach], "k", lw=0.8)
            ax.axhline(limit, color="C3", lw=0.8)
            ax.axvline(limit, color="C3", lw=0.8)
            ax.fill([0, reach, reach], [0, reach, 0], color="C3", alpha=0.08)
            hmi = int(np.sum((error > limit) & (bound <= limit)))
            misled = int(np.sum(error > bound))
            ax.set(xlim=(0, reach), ylim=(0, reach), ylabel=f"{name} protection level (m)")
            ax.set_title(f"{len(error)} epochs, {misled} with error above level, {hmi} hazardous", fontsize=8)
        axes[-1].set_xlabel("error (m)")
    return path
