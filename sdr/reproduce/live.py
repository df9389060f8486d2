"""The integrity monitors on an ultra-tight GPS + Galileo receiver, on IF samples: noise, biases and ramps, answered and not.

Each trial is one of the built-in scenarios ``integrity-ut-*`` with another size of noise or fault. Two receivers hear the same
samples, one with ``[receiver.respond]`` and one without. Range noise is that of one discriminator output (20 ms) of GPS.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sdr import scenario
from sdr.modes import Tee
from sdr.receiver import Receiver
from sdr.reproduce import clopper_pearson, new_figure, row, save_figure, write_table
from sdr.respond import RespondSpec

FT = 0.3048
JS_DB = {10: 27.8, 30: 37.6}
"""Power of white interference over a satellite's that leaves 37.4 and 28.3 dB-Hz of 45: range noise 10 and 30 m."""
SUSPECT = "G27"
TAIL_S = 20.0
"""Errors and innovations are those of the last seconds."""
NAMES = ("innovation", "raim", "bias_bank", "parallel_filters")
NIS = 0.8, 1.2
NEES = 0.0717, 12.84
"""0.5 and 99.5 % of chi-square with 3 degrees of freedom: one error, which hardly changes within the tail."""


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

    def load(self, seed: int) -> scenario.Scenario:
        """The built-in scenario with this cell's sizes."""
        jam = f'jammer=[{{kind="Wideband", js_db={JS_DB[self.noise_m]}, against="{SUSPECT}", start_s=45.0}}]'
        name, fault = "noise", ""
        if self.bias_m:
            name, fault = "bias", f'kind="Step", step_m={self.bias_m}'
        elif self.ramp_fps:
            name, fault = "ramp", f'kind="Ramp", rate_mps={self.ramp_fps * FT}'
        overrides = [jam, f"seed={seed}"]
        if fault:
            overrides.append(f'fault=[{{{fault}, satellite="{SUSPECT}", start_s=50.0}}]')
        return scenario.load(f"integrity-ut-{name}", overrides)[0]


CELLS = (
    Cell(30), Cell(10, 10.0), Cell(10, 0.0, 1.0), Cell(10, 0.0, 2.0), Cell(30, 10.0), Cell(30, 20.0), Cell(30, 0.0, 2.0),
    Cell(10), Cell(10, 20.0), Cell(10, 5.0), Cell(10, 0.0, 0.5), Cell(30, 0.0, 1.0), Cell(30, 5.0), Cell(30, 0.0, 0.5),
)  # fmt: skip


def trial(cell: Cell, seed: int) -> dict[str, Any]:
    """Both receivers on one cell: {"off": numbers, "on": numbers}, see ``numbers``."""
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
    """Of one receiver: first alarm on the suspect and satellites accused besides, by monitor; errors of the tail."""
    assert run.integrity is not None
    s = solution[solution["valid"] & (solution["t_s"] > end_s - TAIL_S)]
    error = s["pos_ecef_m"] - sky.receiver(s["t_s"])["pos_ecef_m"]
    cov = s["cov_ecef_m2"]
    nees = np.einsum("ei,eij,ej->e", error, np.linalg.inv(cov), error)
    out: dict[str, Any] = {
        "error_m": float(np.sqrt(np.mean(np.sum(error**2, axis=1)))),
        "claimed_m": float(np.sqrt(np.trace(cov, axis1=1, axis2=2).mean())),
        "nees": float(nees.mean()), "nis": float(s["chi2"].sum() / s["dof"].sum()), "delay_s": {}, "others": {},
    }  # fmt: skip
    for name in NAMES:
        firsts = {
            f"{key[0].decode()}{key[1]:02d}": [a["start_s"] for a in alarms if a["end_s"] > started_s]
            for key, alarms in run.integrity.alarms[name].found.items()
        }
        mine = [t for t in firsts.pop(SUSPECT, []) if t > started_s]
        out["delay_s"][name] = min(mine) - started_s if mine else None
        out["others"][name] = sorted(n for n, t in firsts.items() if t)
    return out


def run(out_dir: Path, quick: bool = False, seed: int = 1) -> list[dict]:
    """All cells (``quick``: the first), one trial each; rows and a figure."""
    results = [(cell, trial(cell, seed)) for cell in (CELLS[:1] if quick else CELLS)]
    rows = [line for cell, both in results for line in _rows(cell, both)]
    rows += _rates(results)
    write_table(rows, out_dir, "integrity-live")
    _figure(results, out_dir)
    return rows


def _rows(cell: Cell, both: dict[str, Any]) -> list[dict]:
    on, off = both["on"], both["off"]

    def verdict(value: float, low: float, high: float) -> str:
        return "reproduced" if low <= value <= high else "not reproduced"

    delays = ", ".join(f"{n} {on['delay_s'][n]:.1f} s" for n in NAMES if on["delay_s"][n] is not None)
    others = sorted({s for names in on["others"].values() for s in names})
    note = f"first alarms: {delays or 'none'}; others accused: {' '.join(others) or 'none'}"
    return [
        row(f"{cell.label}: error off -> on (m)", off["error_m"], on["error_m"], note=note),
        row(f"{cell.label}: claimed (m)", off["claimed_m"], on["claimed_m"], note="published = response off"),
        row(f"{cell.label}: NIS / dof", "0.8 to 1.2", on["nis"], verdict=verdict(on["nis"], *NIS),
            note=f"off {off['nis']:.2f}"),
        row(f"{cell.label}: NEES of 3", "0.07 to 12.8", on["nees"], verdict=verdict(on["nees"], *NEES),
            note=f"off {off['nees']:.1f}"),
    ]  # fmt: skip


def _rates(results: list[tuple[Cell, dict[str, Any]]]) -> list[dict]:
    """Detection of the faults by each monitor, and wrong accusations, with 95 % intervals over all trials."""
    faults = [both["off"] for cell, both in results if cell.bias_m or cell.ramp_fps]
    rows = []
    for name in NAMES:
        n = len(faults)
        for what, hits in (
            ("named the right satellite", sum(f["delay_s"][name] is not None for f in faults)),
            ("accused another", sum(bool(f["others"][name]) for f in faults)),
        ):
            low, high = clopper_pearson(hits, n) if n else (0.0, 1.0)
            rows.append(
                row(
                    f"{name}: {what}",
                    None,
                    hits / max(n, 1),
                    low,
                    high,
                    note=f"{hits} of {n} faults, response off",
                )
            )
    return rows


def _figure(results: list[tuple[Cell, dict[str, Any]]], out_dir: Path) -> None:
    figure, axes = new_figure(2, 1, (9.0, 7.0), sharex=True)
    at = np.arange(len(results))
    for key, ax, label in (("error_m", axes[0], "3-D error, last 20 s (m)"), ("nis", axes[1], "NIS / dof")):
        for shift, name in ((-0.2, "off"), (0.2, "on")):
            ax.bar(at + shift, [both[name][key] for _, both in results], 0.4, label=f"response {name}")
        ax.set(ylabel=label, yscale="log")
        ax.legend(fontsize=8)
    for bound in NIS:
        axes[1].axhline(bound, color="k", lw=0.8, ls="--")
    axes[1].set_xticks(at, [cell.label for cell, _ in results], rotation=40, ha="right", fontsize=7)
    save_figure(figure, out_dir, "integrity-live")
