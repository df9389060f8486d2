"""High dynamics (the profile of Abdel-Hafez's papers): loops with and without inertial aid at the same bandwidth, and ultra-tight.

The papers show the acceleration as a figure without numbers; amplitudes and periods are assumed (``signals.trajectory.
HighDynamics``, 1 g, and six times that). Twin of 8 satellites, C/N0 44 dB-Hz, T = 20 ms, tactical IMU; second-order FLL,
carrier-aided DLL. A channel is lost when its replica is off by more than one chip or 30 Hz.
"""

import math
from pathlib import Path

import numpy as np

from monitors.detection import clopper_pearson
from nav import ultratight_kernels as kernels
from nav.imu import ImuSpec
from nav.ultratight import SteeringSpec, discriminator_table
from sdr.figure import new_figure, save_figure
from sdr.reproduce import row, write_table
from sdr.uttwin import T_S, Sky, Trial, batch
from signals.constants import WAVELENGTH_M
from signals.trajectory import HighDynamics

SPAN_S, FROM_S = 60.0, 20.0
BANDWIDTHS_HZ = (0.2, 0.3, 0.5, 1.0, 2.0, 4.0)
PROFILES = {"1 g": (10.0, 8.0, 5.0), "6 g": (60.0, 50.0, 30.0)}
"""Amplitudes north, east, down (m/s^2)."""


def run(out_dir, quick=False, seed=0) -> list[dict]:
    """Table and figure of channels lost and of velocity jitter against the loops' bandwidth; returns the rows."""
    out, n_runs = Path(out_dir), 3 if quick else 20
    out.mkdir(parents=True, exist_ok=True)
    rows, drawn = [], {}
    for k, (name, amplitude) in enumerate(PROFILES.items()):
        sky = Sky(SPAN_S, HighDynamics(acc_ned_mps2=amplitude).start(SPAN_S))
        lost, jitter = {}, {}
        for b in BANDWIDTHS_HZ:
            for aided in (False, True):
                lost[b, aided], jitter[b, aided] = loops(sky, b, aided, n_runs, seed, k)
                rows += _loop_rows(
                    name, b, aided, lost[b, aided], jitter[b, aided], thermal_floor_mps(sky, b)
                )
        rows += _tight_rows(name, sky, n_runs, seed, k)
        drawn[name] = (lost, jitter, [thermal_floor_mps(sky, b) for b in BANDWIDTHS_HZ])
    _figure(out, drawn)
    write_table(rows, out, "high-dynamics")
    return rows


def trial(fll_hz: float = 4.0, aided: bool = False) -> Trial:
    """One point: no jammer, the receiver clock of the twin."""
    imu = ImuSpec(grade="tactical", attitude="aircraft")
    return Trial(jam_s=(FROM_S, SPAN_S), imu=imu, fll_hz=fll_hz, aided=aided)


def loops(sky: Sky, fll_hz: float, aided: bool, n_runs: int, seed: int, point: int):
    """Channels lost (runs,) at any time after FROM_S, and 3-D velocity rms (runs,) of all channels' solution."""
    out = batch(sky, trial(fll_hz, aided), SteeringSpec(), n_runs, seed, point, guarded=False)
    return _lost_and_rms(out)


def _lost_and_rms(out: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    late = out[:, round(FROM_S * 10) :]
    with np.errstate(all="ignore"):
        rms = np.sqrt(np.nanmean(np.sum(late[..., 3:6] ** 2, axis=2), axis=1))
    return out[:, 0, 11] - late[..., 11].min(axis=1), rms


def thermal_floor_mps(sky: Sky, fll_hz: float, cn0_dbhz: float = 44.0) -> float:
    """3-D velocity rms of least squares from FLLs of noise bandwidth B: sigma_f lambda sqrt(2 B T tr3 (G'G)^-1)."""
    look, los = np.empty(4), sky.sat_pos[0] - sky.pos[0]
    kernels.look_up(discriminator_table("L1CA", 1.0), 10 ** (cn0_dbhz / 10) * T_S, look)
    g = np.column_stack([-los / np.linalg.norm(los, axis=1)[:, None], np.ones(len(los))])
    spread = np.trace(np.linalg.inv(g.T @ g)[:3, :3])
    return WAVELENGTH_M * math.sqrt(look[3]) / (0.5 * T_S) * math.sqrt(2.0 * fll_hz * T_S * spread)


def _loop_rows(name, b, aided, lost, jitter, floor) -> list[dict]:
    kind = "told by the IMU" if aided else "on their own"
    k, n = int(lost.sum()), 8 * lost.size
    low, high = clopper_pearson(k, n)
    head = f"{name}, loops of {b:g} Hz {kind}"
    note = f"{k} of {n} channels in {lost.size} runs"
    middle = float(np.median(jitter))
    ratio = f"thermal floor {floor:.3g} m/s, {middle / floor:.2f} times that"
    return [
        row(f"{head}: channels lost", None, k / n, low, high, note=note),
        row(f"{head}: velocity rms, 3-D (m/s)", None, middle, jitter.min(), jitter.max(), note=ratio),
    ]


def _tight_rows(name, sky, n_runs, seed, point) -> list[dict]:
    out = batch(sky, trial(), SteeringSpec(mode="ultra_tight", model="ecef17"), n_runs, seed, 100 + point)
    lost, jitter = _lost_and_rms(out)
    k, n = int(lost.sum()), 8 * lost.size
    low, high = clopper_pearson(k, n)
    nees = out[:, -1, 8].mean()
    note = f"NEES {nees:.2f} of 5 at the end; NIS per row {np.mean(out[:, 200:, 9]) / np.mean(out[:, 200:, 10]):.3f}"
    return [
        row(f"{name}, ultra-tight (17 states): channels lost", None, k / n, low, high, note=f"{k} of {n} channels"),
        row(f"{name}, ultra-tight (17 states): velocity rms, 3-D (m/s)", None, np.median(jitter), jitter.min(), jitter.max(),
            note=note),
    ]  # fmt: skip


def _figure(out: Path, drawn) -> None:
    figure, axes = new_figure(2, len(drawn), size=(10, 7), sharex=True)
    for (name, (lost, jitter, floor)), (top, low) in zip(drawn.items(), axes.T):
        for aided, color, label in ((False, "C3", "own loops"), (True, "C0", "told by the IMU")):
            top.semilogx(
                BANDWIDTHS_HZ,
                [lost[b, aided].mean() / 8 for b in BANDWIDTHS_HZ],
                color,
                marker="o",
                label=label,
            )
            low.loglog(BANDWIDTHS_HZ, [np.median(jitter[b, aided]) for b in BANDWIDTHS_HZ], color, marker="o")
        low.loglog(BANDWIDTHS_HZ, floor, "k--", label="thermal floor")
        top.set(title=f"amplitude {name}", ylabel="channels lost")
        low.set(xlabel="noise bandwidth of the FLL (Hz)", ylabel="velocity rms, 3-D (m/s)")
        low.set_xticks(BANDWIDTHS_HZ, [f"{b:g}" for b in BANDWIDTHS_HZ])
        low.set_xticks([], minor=True)
        top.legend(fontsize=8)
        low.legend(fontsize=8)
    save_figure(figure, out, "aided_loops")
