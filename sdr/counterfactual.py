"""Counterfactual replay: the same noise with and without each factor, so that an error has its causes.

The scenario runs once as it is, once without each factor, and once without all. For factor i the difference
D_i = e(all) - e(all but i) is what i does in the presence of the others; the remainder e(all) - e(none) - sum D_i is what
cannot be given to any of them alone: their interaction, and the receiver's own non-linearity.
"""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from sdr import jobs, scenario, store
from sdr.errors import satellite_truth, tracking_errors
from sdr.scenario import Scenario
from signals.sky import ScriptedSpec
from signals.trajectory import Static

STEP_S = 0.1
MEASURES = ("code_m", "doppler_hz", "cn0_dbhz")


def without(spec: Scenario, factor: str) -> Scenario:
    """The scenario without one factor: jammer, multipath, dynamics or quantisation; seeds stay."""
    change: dict[str, Any]
    if factor == "jammer":
        change = {"jammer": ()}
    elif factor == "multipath":
        change = {"multipath": None}
    elif factor == "quantisation":
        change = {"front_end": spec.front_end.model_copy(update={"bits": 32, "rms_lsb": None, "agc": None})}
    elif factor == "dynamics":
        change = {"motion": _standing(spec), "sky": spec.sky.model_copy(update={"scripted": _steady(spec)})}
    else:
        raise ValueError(f"factor '{factor}' is not known; allowed: {', '.join(FACTORS)}")
    return spec.model_copy(update=change)


FACTORS = ("jammer", "multipath", "dynamics", "quantisation")


def _standing(spec: Scenario) -> Any:
    """An antenna that stays where the motion begins."""
    if isinstance(spec.motion, Static):
        return spec.motion
    from signals.geodesy import ecef_to_geodetic

    begin = spec.motion.start()(np.zeros(1)).pos_ecef_m
    lat_rad, lon_rad, height_m = ecef_to_geodetic(begin)
    return Static(
        lat_deg=float(np.degrees(lat_rad[0])),
        lon_deg=float(np.degrees(lon_rad[0])),
        height_m=float(height_m[0]),
    )


def _steady(spec: Scenario) -> tuple[ScriptedSpec, ...]:
    return tuple(
        s.model_copy(update={"doppler_rate_hz_s": 0.0, "manoeuvre": "none"}) for s in spec.sky.scripted
    )


def counterfactual(
    name: str,
    factors: Sequence[str],
    *,
    output: Path | None = None,
    overrides: Sequence[str] = (),
    threads: int = 1,
    quiet: bool = False,
) -> dict[str, Any]:
    """Run scenario ``name`` with and without ``factors`` -> JSON object and figure.

    Errors are means over 0.1 s of the satellites that all runs track; series are in the results, rms in the text.
    """
    spec, _ = scenario.load(name, overrides)
    factors = list(dict.fromkeys(factors))
    present = [f for f in factors if without(spec, f) != spec]
    absent = [f for f in factors if f not in present]
    if absent:
        raise ValueError(f"scenario '{spec.name}' has no {absent[0]} to be left out; it has {_having(spec)}")
    variants = {"all": spec} | {f: without(spec, f) for f in present}
    none = spec
    for f in present:
        none = without(none, f)
    variants["none"] = none
    runs = {key: _errors(one, threads, quiet, f"{spec.name} {key}") for key, one in variants.items()}
    satellites = sorted(set.intersection(*(set(r) for r in runs.values())))
    if not satellites:
        raise ValueError("no satellite was tracked in every run: nothing can be compared")
    table = {s: {m: _split(runs, s, m, present) for m in MEASURES} for s in satellites}
    result: dict[str, Any] = {"factors": present, "step_s": STEP_S, "satellites": table}
    if output is not None:
        output.mkdir(parents=True, exist_ok=True)
        result["figures"] = [str(_draw(output / "counterfactual.png", spec.name, table, present))]
    result["text"] = _text(spec.name, table, present)
    return result


def _having(spec: Scenario) -> str:
    return ", ".join(f for f in FACTORS if without(spec, f) != spec) or "none of them"


def _errors(spec: Scenario, threads: int, quiet: bool, label: str) -> dict[str, dict[str, np.ndarray]]:
    """Per satellite, means over STEP_S of errors and C/N0, NaN where it was not tracked."""
    source = scenario.source(spec, threads)
    n = int(spec.duration_s / STEP_S)
    with TemporaryDirectory() as directory:
        path = Path(directory) / "run.h5"
        with store.Store(path, command="counterfactual", scenario="", seed=spec.seed) as results:
            jobs._receive(spec.receiver, source, results, label, quiet)
        with store.read(path) as h5:
            return {
                key: _binned(h5, group, n)
                for key, group in h5.get("tracking", {}).items()
                if len(group["epochs"]) > 1 and len(_truth(h5, group)) > 1
            }


def _truth(h5: Any, group: Any) -> np.ndarray:
    attrs = group["epochs"].attrs
    return satellite_truth(h5, b"G" if attrs["signal"] == "L1CA" else b"E", attrs["prn"])


def _binned(h5: Any, group: Any, n: int) -> dict[str, np.ndarray]:
    data = group["epochs"]
    epochs, truth = data[:], _truth(h5, group)
    errors = tracking_errors(epochs, truth, data.attrs["fs_hz"], data.attrs["signal"])
    inside = (epochs["sample_index"] >= truth["sample_index"][0]) & (
        epochs["sample_index"] <= truth["sample_index"][-1]
    )
    values = {
        "code_m": errors["code_m"],
        "doppler_hz": errors["doppler_hz"],
        "cn0_dbhz": epochs["cn0_dbhz"][inside],
    }
    # Half a microstep forward: an epoch on the border of a bin belongs to the bin that it begins.
    bins = np.minimum((errors["t_s"] / STEP_S + 1e-6).astype(int), n - 1)
    count = np.bincount(bins, minlength=n).astype(float)
    count[count == 0] = np.nan
    return {m: np.bincount(bins, values[m], minlength=n) / count for m in MEASURES}


def _split(runs: dict[str, Any], satellite: str, measure: str, factors: Sequence[str]) -> dict[str, Any]:
    """Differences of one measure of one satellite: series with None where a run has no value, and their rms."""
    value = {key: run[satellite][measure] for key, run in runs.items()}
    parts = {f: value["all"] - value[f] for f in factors}
    total = value["all"] - value["none"]
    parts["interaction"] = total - np.sum([parts[f] for f in factors], axis=0)
    series = {"all": value["all"], "none": value["none"], "total": total} | parts
    return {
        "rms": {k: _rms(v) for k, v in series.items()},
        "series": {
            k: [None if not np.isfinite(x) else round(float(x), 6) for x in v] for k, v in series.items()
        },
    }


def _rms(values: np.ndarray) -> float | None:
    good = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(good**2))) if len(good) else None


def _text(name: str, table: dict[str, Any], factors: Sequence[str]) -> str:
    keys = ["all", "none", *factors, "interaction"]
    rows = [
        f"{name}: rms of the code error (m) and what each factor adds to it",
        " " * 12 + "".join(f"{k:>14}" for k in keys),
    ]
    for satellite, measures in table.items():
        rms = measures["code_m"]["rms"]
        rows.append(
            f"{satellite:12}" + "".join(f"{'-' if rms[k] is None else f'{rms[k]:.3f}':>14}" for k in keys)
        )
    return "\n".join(rows)


def _draw(path: Path, name: str, table: dict[str, Any], factors: Sequence[str]) -> Path:
    from sdr.figure import figure

    satellite = max(table, key=lambda s: table[s]["code_m"]["rms"]["total"] or 0.0)
    title = f"{name}, {satellite}: what each factor does, and their interaction"
    with figure(path, title, rows=2, size=(9, 7)) as axes:
        for ax, measure, label in zip(axes, MEASURES, ("code error (m)", "Doppler error (Hz)"), strict=False):
            series = table[satellite][measure]["series"]
            for key in ["total", *factors, "interaction"]:
                y = np.array([np.nan if v is None else v for v in series[key]])
                style = {"lw": 4.0, "color": "0.8"} if key == "total" else {"lw": 0.9}
                ax.plot(np.arange(len(y)) * STEP_S, y, label=key, **style)
            ax.set_ylabel(label)
        axes[0].legend(fontsize=8)
        axes[-1].set_xlabel("time (s)")
    return path
