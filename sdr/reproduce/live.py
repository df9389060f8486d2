"""The integrity monitors on a receiver that steers its channels: noise, biases and ramps, answered and not.

On IF samples (not ``quick``): the built-in scenarios ``integrity-ut-*``, GPS + Galileo, two receivers on the same samples, one
with ``[receiver.respond]`` and one without. For rates: a twin without samples, a steering filter on discriminators of the noise
that the scenarios have, watched and answered by the same code. Range noise is that of one output (20 ms) of GPS; Galileo's
pilots have 0.62 of it at the same C/N0.
"""

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from monitors.detection import clopper_pearson
from nav import ultratight_kernels as kernels
from nav.steering import LEFT_OUT, SLOTS, Steering
from nav.ultratight import Filter, Kinematic, SteeringSpec, extended_q, start_covariance
from sdr import scenario
from sdr.figure import new_figure, save_figure
from sdr.integrity import IntegritySpec
from sdr.modes import Tee
from sdr.receiver import Receiver
from sdr.reproduce import row, write_table
from sdr.respond import RespondSpec

FT = 0.3048
JS_DB = {10: 27.8, 30: 37.6}
"""Power of white interference over a satellite's that leaves 37.4 and 28.3 dB-Hz of 45: range noise 10 and 30 m."""
SUSPECT = "G27"
TAIL_S = 20.0
"""Errors and innovations are those of the last seconds."""
NAMES = ("innovation", "raim", "bias_bank", "parallel_filters")
NIS = 0.8, 1.2


FS_HZ, T_S, PER_LOOK, N, RATE_MPS = 1e6, 0.02, 10, 10, 0.1
"""Of the twin: clock of sample indices, epoch, epochs per look, satellites, noise of range rates."""


class Twin:
    """A steering filter under five GPS and five Galileo satellites, on discriminators of known noise, without samples.

    Position, velocity and clock at 50 Hz, wandering with the process noise that the filter believes, so that its claims are
    exact while nothing is wrong; ``step`` is one epoch as `Steering` does it. ``claimed_m`` is the range noise that the
    filter believes, ``sigma_m`` the true one, scalars or (N,).
    """

    heed: Any = Steering.heed  # the answers as they are taken on samples
    weaken: Any = Steering.weaken

    def __init__(self, sigma_m=5.0, claimed_m=5.0, seed=1):
        self.rng, self.sigma_m, self.fs_hz, self.epoch = np.random.default_rng(seed), sigma_m, FS_HZ, 0
        self.own = np.zeros(2 * SLOTS)
        self.own[:N], self.own[SLOTS : SLOTS + N] = np.square(claimed_m), RATE_MPS**2
        model = Kinematic(accel_psd_m2_s3=0.05, clock_phase_noise_m2_s=1e-3, clock_freq_noise_m2_s3=1e-3)
        x = np.zeros(kernels.N_X)
        x[:3] = 4.2e6, 0.8e6, 4.7e6
        self.filter = f = Filter(
            SteeringSpec(mode="vector"), model, x, start_covariance(model, x), SLOTS, 700
        )
        az, el = np.radians(36.0 * np.arange(N)), np.radians([70, 20, 35, 50, 15, 30, 60, 25, 40, 55])
        f.los[:N] = np.column_stack([np.cos(el) * np.sin(az), np.cos(el) * np.cos(az), np.sin(el)])
        self.truth, self.second = x.copy(), (np.arange(SLOTS) >= N // 2).astype(float)
        self.active, self.inflate, self.bias = np.arange(SLOTS) < N, np.ones(2 * SLOTS), np.zeros(SLOTS)
        self.name = [("L1CA" if k < N // 2 else "E1C", k + 1) if k < N else None for k in range(SLOTS)]
        self._q, self._f = extended_q(model, x), np.zeros_like(f.p)
        self._wind, self._spare = np.random.default_rng([seed, 1]), np.zeros((3, *f.p.shape))
        self._maps = np.empty((3, f.p.shape[0])), np.empty((3, f.p.shape[0]))

    def _wander(self, qd):
        """The truth moves on, with noise of covariance ``qd``."""
        p, phi, unused = self._spare
        kernels.predict(
            3, self.truth, p, np.zeros((1, 7)), T_S, 1.0, np.zeros(3), self._q, self._f, phi, unused
        )
        kernels.inject(3, self.truth, np.linalg.cholesky(qd) @ self._wind.standard_normal(len(qd)))

    def step(self, fault_m=None):
        """One epoch, with ``fault_m`` (N,) on the ranges."""
        self.epoch += 1
        f, log = self.filter, self.filter.slot(self.epoch * T_S)
        z, var, used, h = log.r, log.var, log.used, log.h
        ones = np.ones(SLOTS)
        kernels.predict(
            3,
            f.x,
            f.p,
            np.zeros((1, 7)),
            T_S,
            1.0,
            np.zeros(3),
            self._q,
            self._f,
            log.phi,
            log.qd,
        )
        self._wander(log.qd)
        h[:] = 0.0
        kernels.rows(3, f.x, f.p.shape[0], f.los, self.second, ones, ones, *self._maps, h)
        h[N:SLOTS] = h[SLOTS + N :] = 0.0
        off = self.truth - f.x
        z[:], used[:] = 0.0, False
        used[:N] = used[SLOTS : SLOTS + N] = True
        z[:N] = (
            -f.los[:N] @ off[:3]
            + off[6]
            + self.second[:N] * off[kernels.ISB]
            + self.sigma_m * self.rng.standard_normal(N)
            - self.bias[:N]
        )
        z[:N] += 0.0 if fault_m is None else fault_m
        z[SLOTS : SLOTS + N] = -f.los[:N] @ off[3:6] + off[7] + RATE_MPS * self.rng.standard_normal(N)
        f.own[:] = self.own
        var[:] = np.where(used, self.own, 1.0) * self.inflate
        f.nis, f.n_rows = kernels.filter_update(
            3, f.x, f.p, h, z, var, used, f.power, 0.0, log.k, log.s, log.p, f.dx
        )


def fly(monitors, respond=None, seconds=30.0, sigma_m=5.0, fault=None, seed=1, claimed_m=5.0):
    """One flight of a Twin: (position error, NIS per row, NEES of the position, its claimed sigma) at 50 Hz, the monitors, rows by
    name, the Twin.

    ``monitors``: keys of ``[receiver.integrity]`` or None; ``respond``: of ``[receiver.respond]``; ``fault(t_s)`` -> (N,) m.
    """
    sky: Any = Twin(sigma_m, claimed_m, seed)
    run = None
    if monitors is not None:
        run = IntegritySpec.model_validate(monitors).start(RespondSpec.model_validate(respond or {}), FS_HZ)
    track = np.empty((4, round(seconds / T_S)))
    rows: dict[str, list[np.ndarray]] = {}
    for k in range(track.shape[1]):
        if run is not None and not run.response.spec.off:
            sky.heed(run.remedy, {} if run.steered is None else run.steered.own_m2())
        sky.step(None if fault is None else fault(k * T_S))
        f = sky.filter
        error, cov = (sky.truth - f.x)[:3], f.covariance()
        part = f.n_rows - 2 * int(np.sum(sky.inflate[:N] >= LEFT_OUT))
        nees = error @ np.linalg.solve(cov, error)
        track[:, k] = np.linalg.norm(error), f.nis / part, nees, math.sqrt(np.trace(cov))
        if run is None:
            continue
        run.gather(sky)
        if sky.epoch % PER_LOOK == 0:
            for name, found in run(round(sky.epoch * T_S * FS_HZ)).items():
                rows.setdefault(name, []).append(found)
    return track, run, {k: np.concatenate(v) for k, v in rows.items()}, sky


class Cell(NamedTuple):
    """One noise (m) and one fault: ``bias_m`` of a step or ``ramp_fps`` in ft/s, neither for the noise alone."""

    noise_m: int
    bias_m: float = 0.0
    ramp_fps: float = 0.0

    @property
    def label(self) -> str:
        """For people."""
        if self.bias_m:
            return f"noise {self.noise_m} m, bias {self.bias_m:g} m"
        return f"noise {self.noise_m} m" + (f", ramp {self.ramp_fps:g} ft/s" if self.ramp_fps else " alone")

    @property
    def kind(self) -> str:
        """Which of the built-in scenarios it belongs to."""
        return "bias" if self.bias_m else "ramp" if self.ramp_fps else "noise"

    def load(self, seed: int) -> scenario.Scenario:
        """The built-in scenario with this cell's sizes."""
        jam = f'jammer=[{{kind="Wideband", js_db={JS_DB[self.noise_m]}, against="{SUSPECT}", start_s=45.0}}]'
        fault = ""
        if self.bias_m:
            fault = f'kind="Step", step_m={self.bias_m}'
        elif self.ramp_fps:
            fault = f'kind="Ramp", rate_mps={self.ramp_fps * FT}'
        overrides = [jam, f"seed={seed}"]
        if fault:
            overrides.append(f'fault=[{{{fault}, satellite="{SUSPECT}", start_s=50.0}}]')
        return scenario.load(f"integrity-ut-{self.kind}", overrides)[0]


CELLS = tuple(
    cell
    for noise in JS_DB
    for cell in (
        Cell(noise),
        *(Cell(noise, bias_m) for bias_m in (5.0, 8.0, 10.0, 15.0, 20.0)),
        *(Cell(noise, 0.0, ramp) for ramp in (0.5, 1.0, 2.0)),
    )
)
ON_SAMPLES = {Cell(30): 6, Cell(10, 10.0): 5, Cell(10, 0.0, 1.0): 5, Cell(30, 20.0): 1, Cell(30, 0.0, 2.0): 1}
"""Cells on samples, and of how many seeds."""
GALILEO = 0.62
BELIEVED_M = 10.0
"""Range noise that the filter believes where the noise alone is answered."""
FLIGHTS, FLIGHT_S, FAULT_S = 20, 80.0, 12.0


def fly_cell(cell: Cell, seed: int) -> dict[str, Any]:
    """The twin on one cell, as ``trial``; the suspect is the second GPS satellite. ``nees`` is that of the end: independent."""
    shape = cell.noise_m * np.where(np.arange(N) < N // 2, 1.0, GALILEO)
    suspect, alone = "G02", not (cell.bias_m or cell.ramp_fps)
    spec = scenario.load(f"integrity-ut-{cell.kind}")[0].receiver
    assert spec.integrity is not None
    monitors = spec.integrity.model_dump(exclude_unset=True)
    monitors.pop("noise_rmd", None)

    def fault(t_s: float) -> np.ndarray:
        size = cell.bias_m + cell.ramp_fps * FT * (t_s - FAULT_S)
        return np.where(np.arange(N) == 1, size if t_s >= FAULT_S else 0.0, 0.0)

    out = {}
    for name, told in (("off", None), ("on", monitors)):
        answers = spec.respond.model_dump(exclude_unset=True)
        track, run, *_ = fly(told, answers, FLIGHT_S, shape, fault, seed, BELIEVED_M if alone else shape)
        error, nis, nees, claimed = track[:, -round(TAIL_S / T_S) :]
        out[name] = {
            "error_m": float(np.sqrt(np.mean(error**2))), "claimed_m": float(np.sqrt(np.mean(claimed**2))),
            "nees": float(nees[-1]), "nis": float(nis.mean()),
        }  # fmt: skip
    return {"off": out["off"], "on": out["on"] | alarms(run, suspect, FAULT_S)}


def trial(cell: Cell, seed: int) -> dict[str, Any]:
    """Both receivers on the samples of one cell: {"off": numbers, "on": numbers}, see ``numbers``."""
    spec = cell.load(seed)
    tee = Tee(scenario.source(spec), 2)
    sensors = scenario.sensors(spec)
    quiet = spec.receiver.model_copy(update={"respond": RespondSpec()})
    runs = {
        "off": Receiver(quiet, tee.views[0], sensors),
        "on": Receiver(spec.receiver, tee.views[1], sensors),
    }
    solutions: dict[str, list[np.ndarray]] = {"off": [], "on": []}
    for pair in zip(*runs.values(), strict=False):
        for name, outcome in zip(runs, pair):
            solutions[name] += outcome.solutions
    started = 50.0 if spec.fault else 45.0
    return {
        name: numbers(run, np.concatenate(solutions[name]), tee.source.sky, started, spec.duration_s)
        for name, run in runs.items()
    }


def numbers(run: Receiver, solution: np.ndarray, sky: Any, started_s: float, end_s: float) -> dict[str, Any]:
    """Of one receiver: errors and innovations of the tail, and its alarms."""
    s = solution[solution["valid"] & (solution["t_s"] > end_s - TAIL_S)]
    if not len(s):
        raise ValueError("the receiver gave no position in the last seconds: nothing to compare")
    error = s["pos_ecef_m"] - sky.receiver(s["t_s"])["pos_ecef_m"]
    cov = s["cov_ecef_m2"]
    nees = np.einsum("ei,eij,ej->e", error, np.linalg.inv(cov), error)
    return {
        "error_m": float(np.sqrt(np.mean(np.sum(error**2, axis=1)))),
        "claimed_m": float(np.sqrt(np.trace(cov, axis1=1, axis2=2).mean())),
        "nees": float(nees.mean()), "nis": float(s["chi2"].sum() / s["dof"].sum()),
        **alarms(run.integrity, SUSPECT, started_s),
    }  # fmt: skip


def alarms(run: Any, suspect: str, started_s: float) -> dict[str, Any]:
    """By monitor: seconds to the first alarm on the suspect (None: never), and satellites accused besides."""
    out: dict[str, Any] = {"delay_s": {}, "others": {}}
    for name in NAMES:
        if name not in run.alarms:
            continue
        firsts = {
            f"{key[0].decode()}{key[1]:02d}": [a["start_s"] for a in found if a["end_s"] > started_s]
            for key, found in run.alarms[name].found.items()
        }
        mine = [t for t in firsts.pop(suspect, []) if t > started_s]
        out["delay_s"][name] = min(mine) - started_s if mine else None
        out["others"][name] = sorted(n for n, t in firsts.items() if t)
    return out


def run(out_dir: Path, quick: bool = False, seed: int = 1) -> list[dict]:
    """The twin on every cell, 20 flights each (``quick``: 1), and cells on samples, one to six runs each (not ``quick``).

    What is done is kept in ``parts``: stopped and called again, it goes on.
    """
    parts, flights = Path(out_dir) / "parts", 1 if quick else FLIGHTS
    twin = [(cell, [_kept(parts, fly_cell, cell, seed + k) for k in range(flights)]) for cell in CELLS]
    cells = [(cell.label, results) for cell, results in twin]
    for cell, runs in () if quick else ON_SAMPLES.items():
        cells.append(
            (f"on samples, {cell.label}", [_kept(parts, trial, cell, seed + k) for k in range(runs)])
        )
    rows = [line for label, results in cells for line in _rows(label, results)]
    write_table(rows, out_dir, "integrity-live")
    _figure(cells, out_dir)
    return rows


def _kept(parts: Path, work, cell: Cell, seed: int) -> dict[str, Any]:
    """``work(cell, seed)``, from its file where it has been done before."""
    path = parts / f"{work.__name__}-{cell.noise_m}-{cell.bias_m:g}-{cell.ramp_fps:g}-{seed}.json"
    if path.exists():
        return json.loads(path.read_text(encoding="utf-8"))
    result = work(cell, seed)
    parts.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(result), encoding="utf-8")
    return result


def honest(n: int) -> tuple[float, float]:
    """Between which the mean NEES of 3 of n independent ends lies in 95 % of cases when claims are true."""
    from scipy.special import chdtri

    return float(chdtri(3 * n, 0.975)) / n, float(chdtri(3 * n, 0.025)) / n


def _rows(label: str, results: list[dict[str, Any]]) -> list[dict]:
    """Lines of one cell; error and claim are root mean squares, NIS and NEES means over the flights."""

    def mean(which: str, key: str) -> float:
        values = np.array([r[which][key] for r in results])
        return float(np.sqrt(np.mean(values**2)) if key.endswith("_m") else values.mean())

    n = len(results)
    on = [r["on"] for r in results]
    low, high = honest(n)
    lines = [
        row(f"{label}: 3-D error, last 20 s (m)", None, mean("on", "error_m"),
            note=f"claimed {mean('on', 'claimed_m'):.2f}; without response {mean('off', 'error_m'):.2f}, "
            f"claimed {mean('off', 'claimed_m'):.2f}"),
        row(f"{label}: NIS over its degrees of freedom", None, mean("on", "nis"), note=f"without response {mean('off', 'nis'):.2f}"),
        row(f"{label}: NEES of 3", None, mean("on", "nees"),
            note=f"of true claims {low:.2f} to {high:.2f} (95 %); without response {mean('off', 'nees'):.1f}"),
    ]  # fmt: skip
    if "alone" in label:
        return lines
    for name in NAMES:
        delays = [r["delay_s"][name] for r in on if r["delay_s"].get(name) is not None]
        low, high = clopper_pearson(len(delays), n)
        wrong = sum(bool(r["others"].get(name)) for r in on)
        after = f"median {np.median(delays):.1f} s" if delays else "never"
        note = f"{len(delays)} of {n}, {after}; another accused in {wrong}"
        lines.append(row(f"{label}: named by {name}", None, len(delays) / n, low, high, note=note))
    return lines


def _figure(cells: list[tuple[str, list[dict[str, Any]]]], out_dir: Path) -> None:
    figure, axes = new_figure(3, 1, (11.0, 9.0), sharex=True)
    at = np.arange(len(cells))
    for key, ax, label in zip(
        ("error_m", "nees", "nis"), axes, ("3-D error, last 20 s (m)", "NEES of 3", "NIS / dof")
    ):
        for shift, name in ((-0.2, "off"), (0.2, "on")):
            values = [np.mean([r[name][key] for r in results]) for _, results in cells]
            ax.bar(at + shift, values, 0.4, label=f"response {name}")
        ax.set(ylabel=label, yscale="log")
    axes[0].legend(fontsize=8)
    low, high = np.array([honest(len(results)) for _, results in cells]).T
    axes[1].bar(at, high - low, 0.9, low, color="k", alpha=0.2, label="95 % of true claims")
    axes[1].legend(fontsize=8)
    axes[2].axhspan(*NIS, color="k", alpha=0.2)
    axes[2].set_xticks(at, [label for label, _ in cells], rotation=40, ha="right", fontsize=7)
    save_figure(figure, out_dir, "integrity-live")
