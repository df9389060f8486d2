"""Figures of a campaign: P_MD against power and offset, ROC, time to alarm, errors, and the mask of a scan."""

import json
from pathlib import Path

import numpy as np

from sdr.campaign import results, tally
from sdr.campaign.spec import CURVE_EDGES, ROC_P_FA, THRESHOLD, TRIAL
from sdr.figure import new_figure, save_figure

_DATASETS = {
    "rates": results.RATE, "trials": TRIAL, "thresholds": THRESHOLD, "advantages": results.ADVANTAGE, "mask": results.MASK,
}  # fmt: skip
"""What is drawn; a dataset without rows is not in the file."""


def plot(path: Path | str, directory: Path | None = None) -> list[Path]:
    """Draw the figures of a campaign's results; returns their paths."""
    out = directory or Path(path).with_suffix("")
    with results.read(path) as h5:
        kept = {
            name: h5[f"campaign/{name}"][:] if f"campaign/{name}" in h5 else np.zeros(0, dtype)
            for name, dtype in _DATASETS.items()
        }
        axes = json.loads(h5["campaign/points"].attrs["axes"])
        twin = json.loads(h5.attrs["scenario"]).get("twin", {})
    rates, trials, limits, gains, scan = kept.values()
    jammed = np.array([a.get("jammer.kind") != "none" for a in axes])
    quiet_trials = trials[~jammed[trials["point"]]]
    rates, trials = rates[jammed[rates["point"]]], trials[jammed[trials["point"]]]
    names = list(dict.fromkeys(r["monitor"].decode() for r in rates))
    axes = [a for a, ok in zip(axes, jammed) if ok]
    drawn = [
        _rates(rates, gains, axes, out), _curves(rates, trials, axes, out), _roc(trials, quiet_trials, limits, axes, names, out),
        _first_alarms(trials, axes, names, out), _errors(trials, axes, names, out),
    ]  # fmt: skip
    if len(scan):
        drawn.append(_mask(scan, trials, axes, float(twin["cn0_dbhz"]), out))
    return [p for p in drawn if p is not None]


def _numeric_axes(axes: list[dict]) -> list[str]:
    return [
        k
        for k in axes[0]
        if all(isinstance(a[k], int | float) for a in axes) and len({a[k] for a in axes}) > 1
    ]


def _rates(rates: np.ndarray, gains: np.ndarray, axes: list[dict], out: Path) -> Path | None:
    """Rate with its interval against the last numeric axis, a line per monitor and other setting (the first ten), and
    where the monitors reach the P_MD at which they are compared."""
    numeric = _numeric_axes(axes)
    if not numeric:
        return None
    x_name = numeric[-1]
    fig, ax = new_figure(1, 1, size=(9, 5))
    lines: dict[tuple, list] = {}
    for r in rates:
        a = axes[r["point"]]
        rest = ", ".join(f"{k.split('.')[-1]} {v}" for k, v in a.items() if k != x_name)
        lines.setdefault((r["monitor"].decode(), rest), []).append(
            (a[x_name], r["rate"], r["ci_low"], r["ci_high"])
        )
    for (name, rest), rows in list(lines.items())[:10]:
        x, p, low, high = np.array(sorted(rows)).T
        ax.errorbar(
            x,
            np.maximum(p, 1e-7),
            [np.maximum(p - low, 0), np.maximum(high - p, 0)],
            fmt=".-",
            capsize=2,
            label=f"{name} {rest}",
        )
    if x_name in ("jammer.power_dbw", "jammer.js_db"):
        for g in gains[np.isfinite(gains["power_db"])][:10]:
            ax.plot(g["power_db"], g["p_md"], "k|", ms=12)
            if np.isfinite(g["gain_db"]) and g["gain_db"]:
                ax.annotate(f"{g['gain_db']:+.1f} dB", (g["power_db"], g["p_md"]), fontsize=7)
    ax.set(xlabel=x_name, ylabel="rate, 95 %", yscale="log", ylim=(1e-6, 1.5))
    ax.legend(fontsize=6)
    ax.grid(alpha=0.3)
    return save_figure(fig, out, "rates")


def _curves(rates: np.ndarray, trials: np.ndarray, axes: list[dict], out: Path) -> Path | None:
    """P_MD against the offset from the line."""
    if not trials["curve_n"].any():
        return None
    fig, ax = new_figure(1, 1, size=(9, 5))
    x = 0.5 * (CURVE_EDGES[1:] + CURVE_EDGES[:-1])
    shown = 0
    for point in np.unique(trials["point"]):
        for monitor in np.unique(trials["monitor"]):
            rows = trials[(trials["point"] == point) & (trials["monitor"] == monitor)]
            n = rows["curve_n"].sum(axis=0)
            if not n.any() or shown >= 12:
                continue
            shown += 1
            name = [r["monitor"].decode() for r in rates if r["point"] == point][monitor]
            label = f"{name} " + ", ".join(f"{k.split('.')[-1]} {v}" for k, v in axes[point].items())
            ax.plot(x, np.maximum(rows["curve_missed"].sum(axis=0), 0.3) / np.maximum(n, 1), label=label)
    ax.set(xlabel="|df| T", ylabel="P_MD (none: 0.3 / n)", yscale="log")
    ax.legend(fontsize=6)
    ax.grid(alpha=0.3)
    return save_figure(fig, out, "p_md_curve")


def _roc(trials: np.ndarray, quiet: np.ndarray, limits: np.ndarray, axes: list[dict], names: list[str], out: Path) -> Path | None:  # fmt: skip
    """P_MD against P_FA, a few points of each monitor where it is neither blind nor perfect; P_FA as counted on quiet
    trials where there are any, else as the null model has it."""
    fig, ax = new_figure(1, 1, size=(8, 5))
    shown = 0
    for i, name in enumerate(names):
        share = shown + max(1, 10 // len(names))
        mine = quiet[quiet["monitor"] == i]
        for point in np.unique(trials["point"]):
            rows = trials[(trials["point"] == point) & (trials["monitor"] == i)]
            known = np.isfinite(limits[limits["monitor"] == i]["roc"]).all(axis=0)
            n = rows["hit_n"].sum()
            missed = rows["roc_missed"].sum(axis=0) / max(n, 1)
            if (
                shown >= share
                or not n
                or not known.any()
                or missed[known].max() < 1e-4
                or missed[known].min() > 0.98
            ):
                continue
            shown += 1
            tests = mine["tests"].sum()
            p_fa = 1 - mine["roc_missed"].sum(axis=0) / tests if tests else ROC_P_FA
            label = ", ".join([name, *(f"{k.split('.')[-1]} {v}" for k, v in axes[point].items())])
            ax.loglog(p_fa[known], np.maximum(missed[known], 0.3 / n), ".-", label=label)
    if not shown:
        return None
    ax.set(
        xlabel="P_FA per test" + (", counted" if len(quiet) else ", nominal"), ylabel="P_MD (none: 0.3 / n)"
    )
    ax.legend(fontsize=6)
    ax.grid(alpha=0.3)
    return save_figure(fig, out, "roc")


def _by_axis(trials: np.ndarray, axes: list[dict], monitor: int, x_name: str) -> dict[float, np.ndarray]:
    """Trials of a monitor by the value of an axis; those of other axes lie together."""
    mine = trials[trials["monitor"] == monitor]
    value = np.array([axes[p][x_name] for p in mine["point"]])
    return {x: mine[value == x] for x in np.unique(value)}


def _first_alarms(trials: np.ndarray, axes: list[dict], names: list[str], out: Path) -> Path | None:
    """Median time to the first alarm with its interval, and the share of trials without one."""
    numeric = _numeric_axes(axes)
    if not numeric or not np.isfinite(trials["first_alarm_s"]).any():
        return None
    fig, (ax, none) = new_figure(2, 1, size=(8, 6), sharex=True)
    for i, name in enumerate(names):
        cells = _by_axis(trials, axes, i, numeric[-1])
        t = [np.where(np.isfinite(r["first_alarm_s"]), r["first_alarm_s"], np.inf) for r in cells.values()]
        low, middle, high = np.array([tally.median(v) for v in t], float).T
        ax.errorbar(list(cells), middle, [middle - low, high - middle], fmt=".-", capsize=2, label=name)
        none.plot(list(cells), [np.mean(np.isinf(v)) for v in t], ".-")
    ax.set(ylabel="median time to first alarm (s), 95 %")
    none.set(xlabel=numeric[-1], ylabel="trials without an alarm")
    ax.legend(fontsize=7)
    return save_figure(fig, out, "first_alarm")


def _errors(trials: np.ndarray, axes: list[dict], names: list[str], out: Path) -> Path | None:
    """Largest raw and smoothed code error of a trial, all epochs and those without an alarm: medians with intervals,
    and the largest of all trials."""
    numeric = _numeric_axes(axes)
    if not numeric or not np.isfinite(trials["max_code_error_m"]).any():
        return None
    fig, panels = new_figure(1, 2, size=(12, 5))
    for panel, kind in zip(panels, ("code", "smoothed")):
        for i, name in enumerate(names):
            cells = _by_axis(trials, axes, i, numeric[-1])
            for field, style in ((f"max_{kind}_error_m", "k"), (f"undetected_{kind}_error_m", f"C{i}")):
                if field.startswith("max") and i:
                    continue
                low, middle, high = np.array([tally.median(r[field]) for r in cells.values()], float).T
                label = "all epochs" if field.startswith("max") else f"{name} silent"
                panel.errorbar(
                    list(cells),
                    middle,
                    [middle - low, high - middle],
                    fmt=style + ".-",
                    capsize=2,
                    label=label,
                )
                panel.plot(list(cells), [r[field].max() for r in cells.values()], style + "^:", ms=3, lw=0.6)
        panel.set(
            xlabel=numeric[-1],
            ylabel=f"{'raw' if kind == 'code' else '100-s smoothed'} code error (m)",
            yscale="log",
        )
        panel.legend(fontsize=7, title="median of trials, 95 %; dotted: largest", title_fontsize=7)
    return save_figure(fig, out, "errors")


def _mask(scan: np.ndarray, trials: np.ndarray, axes: list[dict], cn0_dbhz: float, out: Path) -> Path:
    """Least power that does harm or is detected at each bandwidth's worst lobe, and the lobes themselves."""
    first = trials[trials["monitor"] == 0]
    fig, panels = new_figure(1, 2, size=(12, 5))
    names = list(dict.fromkeys(scan["monitor"]))
    one = scan[scan["monitor"] == names[0]]
    width = np.maximum(one["bandwidth_hz"], 30.0)
    grid = np.logspace(1.5, 6, 200)
    panels[0].semilogx(grid, tally.mask_dbw(grid), "k", label="mask (assumed)")
    panels[0].semilogx(width, one["loss_1db_dbw"], "o-", label="1 dB of C/N0 lost")
    panels[0].semilogx(width, one["loss_of_lock_dbw"], "s-", label="lock lost")
    for name in names:
        detected = scan["detected_dbw"][scan["monitor"] == name]
        panels[0].semilogx(width, detected, "^--", label=f"{name.decode()}: P_MD < 0.5")
    line = one["worst_line_hz"][np.isfinite(one["worst_line_hz"])]
    title = f"worst line {line[0] / 1e3:g} kHz" if len(line) else "worst lobes"
    panels[0].set(
        xlabel="bandwidth (Hz); leftmost: tone", ylabel="least power (dBW), worst lobe", title=title
    )
    panels[0].legend(fontsize=7)
    strongest = sorted({a["jammer.power_dbw"] for a in axes})
    power = strongest[len(strongest) // 2]
    for bandwidth in one["bandwidth_hz"]:
        points = [
            p
            for p in np.unique(first["point"])
            if axes[p]["jammer.bandwidth_hz"] == bandwidth and axes[p]["jammer.power_dbw"] == power
        ]
        x = [axes[p]["jammer.offset_hz"] / 1e3 for p in points]
        y = [cn0_dbhz - np.mean(first["cn0_dbhz"][first["point"] == p]) for p in points]
        panels[1].plot(x, y, ".-", label=f"{bandwidth:g} Hz" if bandwidth else "tone")
    panels[1].set(xlabel="offset (kHz)", ylabel="C/N0 loss (dB)", title=f"{power:g} dBW")
    panels[1].legend(fontsize=7)
    for panel in panels:
        panel.grid(alpha=0.3)
    return save_figure(fig, out, "mask")
