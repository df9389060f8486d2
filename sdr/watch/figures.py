"""Figures of the live monitors: every statistic about its threshold, and who alarmed when beside truth and error."""

import math
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sdr.errors import satellite_truth, tracking_errors
from sdr.figure import attacks, canvas, figure
from signals.modulation import SIGNALS

FRONT = "front end"
COLUMNS = 3


def monitors(h5: h5py.File, channels: dict[str, h5py.Group], directory: Path) -> Path | None:
    """One panel per monitor: (statistic - quiet median) / (threshold - quiet median), the jammer shaded."""
    names, limits = _watched(h5)
    if not names:
        return None
    colors = _colors(h5)
    rows = math.ceil(len(names) / COLUMNS)
    fig = canvas((4.2 * min(COLUMNS, len(names)), 0.8 + 2.2 * rows))
    fig.suptitle(
        "Monitors: 0 is the quiet median, 1 the threshold; shaded: a jammer is on; grey: never alarmed"
    )
    axes = fig.subplots(rows, min(COLUMNS, len(names)), sharex=True, squeeze=False)
    for ax, name in zip(axes.flat, names):
        _statistic(ax, h5[f"monitors/{name}"][:], limits[limits["monitor"] == name.encode()], name, colors)
        _shade(ax, h5)
        ax.set_title(name, fontsize=9)
        ax.grid(alpha=0.3)
    for ax in axes.flat[len(names) :]:
        ax.set_visible(False)
    for ax in axes[-1]:
        ax.set_xlabel("time (s)")
    handles = [h for ax in axes.flat for h in ax.get_legend_handles_labels()[0]]
    named = {h.get_label(): h for h in handles}
    if named:
        fig.legend(named.values(), named.keys(), loc="outside lower center", ncol=8, fontsize=8)
    path = directory / "monitors.png"
    fig.savefig(path, dpi=130)
    return path


def _statistic(ax: Any, rows: np.ndarray, limits: np.ndarray, name: str, colors: dict[Any, str]) -> None:
    for limit in limits:
        mine = rows[(rows["signal"] == limit["signal"]) & (rows["prn"] == limit["prn"])]
        key = name, _label(limit)
        middle = float(np.median(mine["value"][: max(5, len(mine) // 5)]))
        y = (mine["value"] - middle) / max(float(limit["threshold"]) - middle, 1e-9)
        hit = key in colors
        style = "." if len(mine) < 150 else "-"
        ax.plot(
            mine["t_s"], y, style, ms=3, lw=0.6, color=colors.get(key, "0.7"), zorder=2 + hit,
            label=key[1] if hit else None,
        )  # fmt: skip
    ax.axhline(1.0, color="k", lw=0.8, ls="--", zorder=4)
    ax.set_yscale("symlog", linthresh=2.0)
    ax.set_ylim(bottom=-1.5)
    ax.set_yticks([y for y in (-1, 0, 1, 10, 100, 1000) if y <= ax.get_ylim()[1]])
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_formatter("")


def alarms(h5: h5py.File, channels: dict[str, h5py.Group], directory: Path) -> Path | None:
    """Alarms of every monitor as bars over time, between the truth about the jammers and the code error."""
    names, limits = _watched(h5)
    if not names:
        return None
    colors = _colors(h5)
    path = directory / "alarms.png"
    with figure(path, "Alarms, truth and tracking error", rows=3, size=(10, 4.5 + 0.32 * len(names))) as axes:
        truth, lanes, error = axes
        truth.figure.set_layout_engine("constrained")
        truth.get_gridspec().set_height_ratios([1, 0.25 * len(names), 1.2])
        hit = [label for (_, label), c in colors.items() if c == "C3" and label != FRONT]
        _jammers(truth, h5, hit[0] if hit else None)
        _lanes(lanes, h5, names, limits, colors)
        _code_errors(error, h5, channels, {label: c for (_, label), c in colors.items()})
        for ax in (lanes, error):
            _shade(ax, h5)
        error.set_xlabel("time (s)")
    return path


def _lanes(ax: Any, h5: h5py.File, names: list[str], limits: np.ndarray, colors: dict[Any, str]) -> None:
    rows = h5["monitors/alarms"][:] if "monitors/alarms" in h5 else []
    seen: set[str] = set()
    for lane, name in enumerate(names):
        mine = limits[limits["monitor"] == name.encode()]
        begin = "tests begin" if lane == 0 else None
        ax.plot([mine["trained_s"].min()] * 2, [lane - 0.4, lane + 0.4], color="0.4", lw=1.2, label=begin)
        raised = [a for a in rows if a["monitor"] == name.encode()]
        order = list(dict.fromkeys(_label(a) for a in sorted(raised, key=lambda a: a["prn"])))
        for alarm in raised:
            label = _label(alarm)
            height = 0.8 / len(order)
            y = lane - 0.4 + order.index(label) * height
            # An alarm of one epoch still has to be seen.
            width = max(float(alarm["end_s"] - alarm["start_s"]), 0.15)
            tag = None if label in seen else label
            seen.add(label)
            ax.broken_barh(
                [(float(alarm["start_s"]), width)], (y, height), color=colors[name, label], label=tag
            )
    ax.set_yticks(range(len(names)), labels=names, fontsize=8)
    ax.set_ylim(len(names) - 0.5, -0.5)
    ax.legend(loc="upper left", fontsize=7, title="alarm on", title_fontsize=7)


def _jammers(ax: Any, h5: h5py.File, hit: str | None) -> None:
    """J/S; of tones, how far they are from the nearest code line of the channel that is hit most."""
    rows: Any = h5["truth/jammers"][:] if "truth/jammers" in h5 else np.empty(0)
    lines = ax.twinx()
    for k in np.unique(rows["jammer"]) if len(rows) else ():
        mine = rows[(rows["jammer"] == k) & (rows["on"] != 0)]
        if not len(mine):
            continue
        kind = mine["kind"][0].decode()
        ax.plot(mine["t_s"], mine["js_db"], lw=1.4, color=f"C{k}", label=f"{kind}: J/S")
        if kind == "CW" and hit:
            t_s, hz = _off_line(h5, mine, hit)
            lines.plot(t_s, hz, ".", ms=2, color="k", label=f"tone to nearest code line of {hit}")
    ax.set_ylabel("truth: J/S (dB)")
    lines.set_ylabel("Hz")
    lines.set_visible(bool(lines.lines))
    drawn = [*ax.lines, *lines.lines]
    if drawn:
        ax.legend(drawn, [line.get_label() for line in drawn], fontsize=7, loc="upper left")


def _off_line(h5: h5py.File, jammer: np.ndarray, hit: str) -> tuple[np.ndarray, np.ndarray]:
    """Frequency of a tone less the nearest line of a satellite's code; lines are a code period's rate apart."""
    signal, prn = hit.split()
    truth = satellite_truth(h5, b"G" if signal == "L1CA" else b"E", int(prn))
    rate_hz = 1.0 / SIGNALS[signal].code_period_s
    off = jammer["freq_hz"] - np.interp(jammer["t_s"], truth["t_s"], truth["doppler_hz"])
    return jammer["t_s"], (off + rate_hz / 2) % rate_hz - rate_hz / 2


def _code_errors(ax: Any, h5: h5py.File, channels: dict[str, h5py.Group], colors: dict[str, str]) -> None:
    errors = []
    for group in channels.values():
        attrs = group["epochs"].attrs
        truth = satellite_truth(h5, b"G" if attrs["signal"] == "L1CA" else b"E", attrs["prn"])
        if len(truth) < 2:
            continue
        one = tracking_errors(group["epochs"][:], truth, attrs["fs_hz"], attrs["signal"])
        late = one["t_s"] > one["t_s"][0] + 5.0
        label = f"{attrs['signal']} {attrs['prn']}"
        hit = label in colors
        ax.plot(
            one["t_s"][late], one["code_m"][late], lw=0.6, color=colors.get(label, "0.7"), zorder=2 + hit
        )  # fmt: skip
        errors.append(np.abs(one["code_m"][late]))
    if errors and len(worst := np.concatenate(errors)):
        limit = max(1.2 * float(np.nanquantile(worst, 0.999)), 1.0)
        ax.set_ylim(-limit, limit)
    ax.set_ylabel("code error (m)")


def _watched(h5: h5py.File) -> tuple[list[str], np.ndarray]:
    if "monitors/thresholds" not in h5:
        return [], np.empty(0)
    limits = h5["monitors/thresholds"][:]
    names = dict.fromkeys(r["monitor"].decode() for r in limits)
    return [n for n in names if f"monitors/{n}" in h5], limits


def _label(row: Any) -> str:
    signal = row["signal"].decode()
    return f"{signal} {row['prn']}" if signal else FRONT


def _colors(h5: h5py.File) -> dict[tuple[str, str], str]:
    """(monitor, channel) -> colour of the channel, where that monitor alarmed on it."""
    rows = h5["monitors/alarms"][:] if "monitors/alarms" in h5 else []
    total: dict[str, float] = {}
    for r in rows:
        total[_label(r)] = total.get(_label(r), 0.0) + float(r["end_s"] - r["start_s"])
    # The channel that is alarmed longest is red.
    order = ["C3", "C0", "C2", "C1", "C4", "C5", "C6", "C8", "C9"]
    color = {
        c: order[k % len(order)] for k, c in enumerate(sorted(total, key=lambda c: (c == FRONT, -total[c])))
    }
    return {(r["monitor"].decode(), _label(r)): color[_label(r)] for r in rows}


def _shade(ax: Any, h5: h5py.File) -> None:
    for begin, end in attacks(h5):
        ax.axvspan(begin, end, color="C3", alpha=0.08, lw=0)
