"""Runs a campaign on processes or on a cluster: thresholds first, then trials until every point has stopped."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sdr.campaign.crew import each, hire
from sdr.campaign.load import load
from sdr.campaign.results import MASK, Results
from sdr.campaign.spec import Campaign, setting_text
from sdr.campaign.trials import evaluate_trials, fit_thresholds, quiet_statistics, warm_up
from sdr.progress import progress

CHUNK_S = 1.0
"""Chunks of trials last about this long, so that handing them out costs nothing."""


def run(
    name: str,
    *,
    output: Path | str | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    overrides: Sequence[str] = (),
    plots: bool = False,
    quiet: bool = False,
) -> dict[str, Any]:
    """Run (or go on with) the campaign ``name`` until every point has stopped."""
    campaign = load(name, tuple(overrides))
    path = Path(output) if output else Path(f"{campaign.spec.name}.h5")
    return execute(campaign, path, workers=workers, scheduler=scheduler, plots=plots, quiet=quiet)


def execute(
    campaign: Campaign,
    path: Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    plots: bool = False,
    quiet: bool = True,
) -> dict[str, Any]:
    """Run (or go on with) a campaign into ``path``; returns the command's JSON object."""
    begin = time.perf_counter()
    with Results(campaign, path) as results:
        if not results.complete:
            with hire(workers, scheduler, path) as crew:
                _thresholds(campaign, results, crew, quiet)
                _evaluate(campaign, results, crew, quiet)
            results.write(complete=True)
    out = results.summary()
    out["elapsed_s"] = time.perf_counter() - begin
    if plots:
        from sdr.campaign.figures import plot

        out["figures"] = [str(p) for p in plot(path)]
    out["text"] = _text(out)
    return out


def _thresholds(campaign: Any, results: Results, crew: Any, quiet: bool) -> None:
    """Thresholds of every group that has none yet."""
    missing = [g for g in range(len(campaign.quiet)) if g not in results.thresholds["group"]]
    if campaign.live:
        for _ in missing:
            results.keep_thresholds(campaign.live_thresholds())
        return
    if all(m.threshold is not None for m in campaign.spec.monitor):
        for g in missing:
            results.keep_thresholds(fit_thresholds(campaign, g, []))
        return
    n = campaign.spec.threshold.trials
    size = max(1, n // (4 * crew.workers))
    values: dict[int, list] = {g: [None] * n for g in missing}
    tasks = (
        ((g, first), quiet_statistics, (campaign.text, g, first, min(size, n - first)))
        for g in missing
        for first in range(0, n, size)
    )
    with progress(f"{campaign.spec.name}: thresholds", n * len(missing), quiet) as advance:
        done = 0
        for (g, first), part in each(crew, tasks, lambda: 2 * crew.workers):
            values[g][first : first + len(part)] = part
            done += len(part)
            if all(v is not None for v in values[g]):
                results.keep_thresholds(fit_thresholds(campaign, g, values.pop(g)))
            advance(done)


class _Planner:
    """Chunks of trials, point after point; sized to last about CHUNK_S."""

    def __init__(self, campaign: Campaign, results: Results, crew: Any) -> None:
        self.campaign, self.counts, self.crew = campaign, results.counts, crew
        self.limits = results.thresholds
        self.next = [0] * len(self.counts)
        self.trial_s: float | None = None

    def __iter__(self) -> "_Planner":
        return self

    def __next__(self) -> tuple[Any, Callable, tuple]:
        for c in self.counts:
            i, most = c.index, c.max_trials
            while c.reason is None and self.next[i] < most and c.has(self.next[i]):
                self.next[i] += 1
            if c.reason is not None or self.next[i] >= most:
                continue
            first = self.next[i]
            last = first + 1
            stop = min(most, first + self._size(most - first))
            while last < stop and not c.has(last):
                last += 1
            self.next[i] = last
            return (
                (i, last - first),
                _timed_trials,
                (self.campaign.text, i, first, last - first, self._limits(i)),
            )
        raise StopIteration

    def _size(self, left: int) -> int:
        if self.trial_s is None:
            return 1
        return max(1, min(int(CHUNK_S / self.trial_s), -(-left // (2 * self.crew.workers))))

    def _limits(self, point: int) -> np.ndarray:
        rows = self.limits[self.limits["group"] == self.campaign.group[point]]
        return rows[np.argsort(rows["monitor"])]


def _timed_trials(
    text: str, point: int, first: int, count: int, limits: np.ndarray
) -> tuple[np.ndarray, float]:
    warm_up(text, point)
    begin = time.perf_counter()
    rows = evaluate_trials(text, point, first, count, limits)
    return rows, time.perf_counter() - begin


def _evaluate(campaign: Campaign, results: Results, crew: Any, quiet: bool) -> None:
    planner = _Planner(campaign, results, crew)
    total = sum(c.max_trials for c in results.counts)
    with progress(campaign.spec.name, total, quiet) as advance:
        for (_, size), (rows, elapsed_s) in each(crew, planner, lambda: 2 * crew.workers):
            planner.trial_s = max(elapsed_s / size, 1e-6)
            results.keep(rows)
            finished = sum(c.reason is not None for c in results.counts)
            done = sum(c.max_trials if c.reason is not None else c.done for c in results.counts)
            advance(done, f"{finished} of {len(results.counts)} points")


def _text(out: dict[str, Any]) -> str:
    rows = [
        f"{out['name']}: {out['trials']} trials in {out['elapsed_s']:.1f} s, P_FA {out['p_fa']:.3g} per test"
    ]
    if out["resumed_trials"]:
        rows[0] += f" ({out['resumed_trials']} trials were there already)"
    rows += [_point_text(r) for r in out["points"]]
    rows += [_advantage_text(r) for r in out["advantages"]]
    rows += [_mask_text(r) for r in out["mask"]]
    rows.append(f"results in {out['output']}")
    return "\n".join(rows + [f"  {p}" for p in out.get("figures", [])])


def _point_text(r: dict[str, Any]) -> str:
    rate = "none" if r["rate"] is None else f"{r['rate']:.3g}"
    what = "P_FA" if r["definition"] == "false_alarm" else "P" if r["definition"] == "excess" else "P_MD"
    counts = f"{r['k']}/{r['n']}" if r["method"] == "count" else f"{r['method']}, {r['n']} repetitions"
    effective = "" if r["n_effective"] is None else f", n_eff {r['n_effective']:.3g}"
    more = []
    if r["first_alarm_median_s"] is not None:
        more.append(f"first alarm {r['first_alarm_median_s']:.1f} s")
    if r["lost_trials"]:
        more.append(f"carrier lost in {r['lost_trials']} trials, left out of the errors")
    if r["held_undetected_code_error_m"] is not None and r["definition"] != "false_alarm":
        more.append(f"undetected {r['held_undetected_code_error_m']:.1f} m raw, {r['held_undetected_smoothed_error_m']:.2f} m smoothed")  # fmt: skip
    if "p_fa_approach" in r:
        low, high = r["p_fa_approach_ci"]
        more.append(f"per approach {r['p_fa_approach']:.2g} [{low:.2g}, {high:.2g}]")
    return (
        f"  {r['point']:4d}  {r['monitor']:16} {what:4} {rate:>9} [{r['ci_low']:.2g}, {r['ci_high']:.2g}]  {counts}{effective}, "
        f"{r['trials']} trials ({r['stop_reason']})  " + "; ".join([setting_text(r["axes"]), *more])
    )


def _advantage_text(r: dict[str, Any]) -> str:
    def told(value: float | None, ci: list[float | None], sign: str) -> str:
        bounds = "" if ci[0] is None else f" [{ci[0]:{sign}.2f}, {ci[1]:{sign}.2f}]"
        return "not crossed by counted points" if value is None else f"{value:{sign}.2f}{bounds}"

    unit = "dBW" if r["axis"].endswith("dbw") else "dB J/S"
    text = f"  P_MD {r['p_md']:g} ({r['definition']}) of {r['monitor']:16} at {told(r['power_db'], r['power_ci_db'], '')} {unit}"
    if r["monitor"] != r["against"]:
        text += f"; {told(r['gain_db'], r['gain_ci_db'], '+')} dB against {r['against']}"
    return f"{text}  {setting_text(r['axes'])}"


def _mask_text(r: dict[str, Any]) -> str:
    told = {
        k: "not in the grid" if r[k] is None else f"{r[k]:g}" for k in MASK.names or () if k.endswith("dbw")
    }
    what = f"{r['bandwidth_hz']:g} Hz" if r["bandwidth_hz"] else "tone"
    line = (
        ""
        if r["worst_line_hz"] is None
        else f", line {r['worst_line_hz'] / 1e3:g} kHz ({r['worst_line_db']:.2f} dB)"
    )
    return (
        f"  mask, {what}: worst at {r['worst_offset_hz'] / 1e3:g} kHz{line}; 1 dB lost from {told['loss_1db_dbw']}, lock from "
        f"{told['loss_of_lock_dbw']}, {r['monitor']} detects from {told['detected_dbw']} dBW (mask {told['mask_dbw']})"
    )
