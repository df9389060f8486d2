"""Figures of a campaign: P_MD against each axis, and the interference mask of a scan."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from sdr import farm
from sdr.campaign import CURVE_EDGES
from sdr.reproduce import new_figure, save_figure


def mask_dbw(bandwidth_hz: Any) -> np.ndarray:
    """Tolerable in-band power against bandwidth, after the steady-state mask of RTCA DO-229D, appendix C.

    -150.5 dBW up to 700 Hz, then 6 dB a decade to 10 kHz, 3 dB a decade to 100 kHz, flat to 1 MHz. The corner
    values are assumed (not checked against the document).
    """
    b = np.asarray(bandwidth_hz, float)
    rise = 6.0 * np.log10(np.clip(b, 700.0, 1e4) / 700.0) + 3.0 * np.log10(np.clip(b, 1e4, 1e5) / 1e4)
    return -150.5 + rise


def plot(path: Path | str, directory: Path | None = None) -> list[Path]:
    """Draw the figures of a campaign's results; returns their paths."""
    out = directory or Path(path).with_suffix("")
    with farm.read_rates(path) as h5:
        rates, trials = h5["campaign/rates"][:], h5["campaign/trials"][:]
        axes = json.loads(h5["campaign/points"].attrs["axes"])
        cn0_dbhz = float(json.loads(h5.attrs["scenario"])["twin"]["cn0_dbhz"])
    drawn = [_rates(rates, axes, out), _curves(rates, trials, axes, out)]
    if {"jammer.bandwidth_hz", "jammer.offset_hz", "jammer.power_dbw"} <= set(axes[0]):
        drawn.append(_mask(rates, trials, axes, cn0_dbhz, out))
    return [p for p in drawn if p is not None]


def _numeric_axes(axes: list[dict]) -> list[str]:
    return [
        k
        for k in axes[0]
        if all(isinstance(a[k], int | float) for a in axes) and len({a[k] for a in axes}) > 1
    ]


def _rates(rates: np.ndarray, axes: list[dict], out: Path) -> Path | None:
    """Rate with its interval against the last numeric axis, a line per monitor and other setting (the first ten)."""
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


def mask_table(
    rates: np.ndarray, trials: np.ndarray, axes: list[dict], cn0_dbhz: float
) -> list[dict[str, Any]]:
    """Per bandwidth: the worst offset, and the least power that costs 1 dB, loses lock, and is first detected.

    "Worst" is the offset with the largest C/N0 loss summed over the powers, each counted up to 10 dB (lost: 10).
    """
    out = []
    first = trials[trials["monitor"] == 0]
    monitors = list(dict.fromkeys(r["monitor"].decode() for r in rates))
    for bandwidth in sorted({a["jammer.bandwidth_hz"] for a in axes}):
        cells: dict[float, list] = {}
        for p in np.unique(first["point"]):
            a, rows = axes[p], first[first["point"] == p]
            if a["jammer.bandwidth_hz"] == bandwidth:
                missed = {r["monitor"].decode(): float(r["rate"]) for r in rates if r["point"] == p}
                entry = (
                    a["jammer.power_dbw"],
                    cn0_dbhz - float(np.mean(rows["cn0_dbhz"])),
                    float(np.mean(rows["lost"])),
                    missed,
                )
                cells.setdefault(a["jammer.offset_hz"], []).append(entry)
        least = lambda rows, test: min((r[0] for r in rows if test(r)), default=None)  # noqa: E731
        worst = max(cells, key=lambda o: sum(10.0 if r[2] > 0.5 else min(r[1], 10.0) for r in cells[o]))
        rows = sorted(cells[worst], key=lambda r: r[0])
        out.append({
            "bandwidth_hz": bandwidth, "worst_offset_hz": worst, "mask_dbw": float(mask_dbw(bandwidth)),
            "loss_1db_dbw": least(rows, lambda r: r[1] >= 1.0), "loss_of_lock_dbw": least(rows, lambda r: r[2] > 0.5),
            "detected_dbw": {m: least(rows, lambda r, m=m: r[3][m] < 0.5) for m in monitors},
        })  # fmt: skip
    return out


def _mask(rates: np.ndarray, trials: np.ndarray, axes: list[dict], cn0_dbhz: float, out: Path) -> Path:
    table = mask_table(rates, trials, axes, cn0_dbhz)
    first = trials[trials["monitor"] == 0]
    fig, panels = new_figure(1, 2, size=(12, 5))
    width = [max(t["bandwidth_hz"], 30.0) for t in table]
    number = lambda key: [np.nan if t[key] is None else t[key] for t in table]  # noqa: E731
    grid = np.logspace(1.5, 6, 200)
    panels[0].semilogx(grid, mask_dbw(grid), "k", label="mask (assumed)")
    panels[0].semilogx(width, number("loss_1db_dbw"), "o-", label="1 dB of C/N0 lost")
    panels[0].semilogx(width, number("loss_of_lock_dbw"), "s-", label="lock lost")
    for name in table[0]["detected_dbw"]:
        detected = [np.nan if t["detected_dbw"][name] is None else t["detected_dbw"][name] for t in table]
        panels[0].semilogx(width, detected, "^--", label=f"{name}: P_MD < 0.5")
    panels[0].set(xlabel="bandwidth (Hz); leftmost: tone", ylabel="least power (dBW), worst offset")
    panels[0].legend(fontsize=7)
    strongest = sorted({a["jammer.power_dbw"] for a in axes})
    power = strongest[len(strongest) // 2]
    for t in table:
        points = [
            p
            for p in np.unique(first["point"])
            if axes[p]["jammer.bandwidth_hz"] == t["bandwidth_hz"] and axes[p]["jammer.power_dbw"] == power
        ]
        x = [axes[p]["jammer.offset_hz"] / 1e3 for p in points]
        y = [cn0_dbhz - np.mean(first["cn0_dbhz"][first["point"] == p]) for p in points]
        panels[1].plot(x, y, ".-", label=f"{t['bandwidth_hz']:g} Hz")
    panels[1].set(xlabel="offset (kHz)", ylabel="C/N0 loss (dB)", title=f"{power:g} dBW")
    panels[1].legend(fontsize=7)
    for panel in panels:
        panel.grid(alpha=0.3)
    return save_figure(fig, out, "mask")
