"""Counts of a campaign in the order of its trials: when a point stops, and what is then told of it.

Rates carry their counts and 95 % intervals over independent trials. Where the jammer's power is an axis, the powers at
which the monitors reach one P_MD are compared in dB, with a bootstrap over trials.
"""

import math
from typing import Any

import numpy as np

from monitors.detection import Rate, clopper_pearson, cluster_rate, rate
from monitors.rare import repeated_rate
from monitors.threshold import per_approach
from sdr.campaign.spec import ROC_P_FA, Campaign, CampaignSpec
from signals.modulation import SIGNALS
from tracking.correlator_model import code_spectrum

_COUNTED = {"hit": "hit", "all": "on", "event": "event", "hazard": "hazard"}
_ERRORS = (
    "max_code_error_m",
    "max_smoothed_error_m",
    "undetected_code_error_m",
    "undetected_smoothed_error_m",
)
_LEAST_MISSES = 10
"""A curve is not interpolated to points with fewer misses than these."""
_BOOT = 1000
APPROACH_S = 150.0


class PointCount:
    """Trials of one point as they come in; counts only the unbroken run from trial 0 to where it stops."""

    def __init__(self, campaign: Campaign, index: int) -> None:
        self.spec, self.index = campaign.spec, index
        self.jammed = bool(campaign.points[index].jammers)
        self.max_trials = campaign.length(index).trials
        self.verifies = index >= campaign.total
        self.estimated = self.jammed and campaign.spec.method.kind != "count"
        self._ahead: dict[int, np.ndarray] = {}
        self.rows: list[np.ndarray] = []
        self.reason: str | None = None
        self._sums = np.zeros((len(campaign.spec.monitor), 5))

    @property
    def done(self) -> int:
        """Trials counted."""
        return len(self.rows)

    @property
    def kept(self) -> int:
        """Trials that need not be run again: those counted, and those that wait for an earlier one."""
        return self.done + len(self._ahead)

    def has(self, trial: int) -> bool:
        """Whether a trial's result is here already."""
        return trial < self.done or trial in self._ahead

    def add(self, rows: np.ndarray) -> None:
        """TRIAL rows of one trial, one per monitor; a trial that is known already is ignored."""
        trial = int(rows["trial"][0])
        if self.has(trial):
            return
        self._ahead[trial] = rows
        while self.reason is None and self.done in self._ahead:
            new = self._ahead.pop(self.done)
            self.rows.append(new)
            self._sum(new)
            self.reason = self._stopped()
        if self.reason is not None:
            self._ahead.clear()

    def counted(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(k, n) of each row by the campaign's definition; an estimate counts as that share of one trial."""
        if self.estimated:
            return rows["estimate"], np.ones(len(rows))
        return counted(rows, self.jammed, self.spec)

    def _sum(self, rows: np.ndarray) -> None:
        k, n = self.counted(rows)
        self._sums += np.stack([k, n, k * k, k * n, n * n], axis=1).astype(float)

    def _stopped(self) -> str | None:
        stop = self.spec.stop
        k = self._sums[:, 0]
        if self.done >= stop.min_trials and not self.verifies:
            if stop.errors is not None and not self.estimated and np.all(k >= stop.errors):
                return "errors"
            if stop.relative_error is not None and np.all(self._relative_error() <= stop.relative_error):
                return "precision"
        return "max_trials" if self.done >= self.max_trials else None

    def _relative_error(self) -> np.ndarray:
        """Standard error of sum k / sum n over its value, trials being the independent units."""
        k, n, kk, kn, nn = self._sums.T
        m = self.done
        if m < 5:
            return np.full(len(k), np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            p = k / n
            variance = np.maximum(kk - 2 * p * kn + p * p * nn, 0.0) / n**2 * m / (m - 1)
            if self.estimated:
                return np.where(p > 0, np.sqrt(variance) / p, np.inf)
            # Never less than what independent tests would have.
            variance = np.maximum(variance, p * (1 - p) / n)
            return np.where(k >= 10, np.sqrt(variance) / p, np.inf)


def counted(rows: np.ndarray, jammed: bool, spec: CampaignSpec) -> tuple[np.ndarray, np.ndarray]:
    """(k, n) of each row: misses by the definition of P_MD, or false alarms where there is no jammer."""
    definition = spec.stop.definition
    if not jammed:
        return rows["alarms"], rows["tests"]
    if definition in ("excess", "undetected"):
        error = rows["max_code_error_m" if definition == "excess" else "undetected_code_error_m"]
        return (error >= spec.trial.excess_m).astype(np.int64), np.ones(len(rows), np.int64)
    name = _COUNTED[definition]
    return rows[f"{name}_missed"], rows[f"{name}_n"]


def point_rate(k: np.ndarray, n: np.ndarray, seed: int) -> Rate:
    """Rate over independent trials: exact where a trial has one test, else over trials as clusters.

    Thousands of trials are pooled by neighbours first, which costs next to nothing in precision.
    """
    k, n = k[n > 0], n[n > 0]
    if len(n) == 0:
        return rate(0, 0)
    if n.max() == 1:
        return rate(int(k.sum()), int(n.sum()))
    if len(n) == 1:
        p = k[0] / n[0]
        low, high = clopper_pearson(p, 1)
        return Rate(int(k[0]), int(n[0]), float(p), low, high, 1.0)
    size = -(-len(n) // 1000)
    edges = np.arange(0, len(n), size)
    return cluster_rate(np.add.reduceat(k, edges), np.add.reduceat(n, edges), seed)


def estimated_rate(estimates: np.ndarray) -> Rate:
    """Rate of repetitions of an unbiased estimate; k: those that saw the event at all."""
    p, low, high, effective = repeated_rate(estimates)
    return Rate(int(np.count_nonzero(estimates)), len(estimates), p, low, high, effective)


# -- what is told of a point --------------------------------------------------------------------------------------


def summarise(campaign: Campaign, counts: list[PointCount], thresholds: np.ndarray) -> list[dict[str, Any]]:
    """One plain row per point and monitor: counts, rate with its interval, thresholds, errors, why it stopped."""
    out = []
    for c in counts:
        if not c.rows:
            continue
        group = campaign.group[c.index]
        for i, monitor in enumerate(campaign.spec.monitor):
            rows = np.array([r[i] for r in c.rows])
            limit = thresholds[(thresholds["group"] == group) & (thresholds["monitor"] == i)][0]
            out.append(_summary_row(campaign, c, monitor.name, rows, limit))
    return out


def _summary_row(
    campaign: Campaign, c: PointCount, name: str, rows: np.ndarray, limit: Any
) -> dict[str, Any]:
    spec = campaign.spec
    k, n = c.counted(rows)
    r = estimated_rate(k) if c.estimated else point_rate(k, n, spec.seeds.evaluation)
    row: dict[str, Any] = {
        "point": c.index, "axes": campaign.settings[c.index], "monitor": name,
        "definition": spec.stop.definition if c.jammed else "false_alarm",
        "method": spec.method.kind if c.estimated else "count",
        "k": r.k, "n": r.n, "rate": _number(r.p), "ci_low": r.low, "ci_high": r.high,
        "n_effective": _number(r.n_effective), "trials": c.done, "stop_reason": c.reason,
        "threshold": _number(limit["threshold"]), "threshold_low": _number(limit["low"]),
        "threshold_high": _number(limit["high"]), "rule": limit["rule"].decode(), "p_fa": float(limit["p_fa"]),
    }  # fmt: skip
    for other in _COUNTED.values():
        row[f"{other}_k"] = int(rows[f"{other}_missed"].sum())
        row[f"{other}_n"] = int(rows[f"{other}_n"].sum())
        other_rate = point_rate(rows[f"{other}_missed"], rows[f"{other}_n"], spec.seeds.evaluation)
        row[f"{other}_ci"] = [other_rate.low, other_rate.high]
    row["curve_k"] = rows["curve_missed"].sum(axis=0).tolist()
    row["curve_n"] = rows["curve_n"].sum(axis=0).tolist()
    row |= _roc(rows, limit, c.jammed) | _first_alarm(rows, c.jammed)
    if not c.jammed and not campaign.live:
        row |= _approach(rows, campaign, c.index)
    held = rows[
        ~rows["lost"]
    ]  # a lost carrier's range error says how long it was lost, not what a monitor missed
    for field in _ERRORS:
        row[field] = _number(np.max(rows[field]))
        row[f"held_{field}"] = _number(np.max(held[field])) if len(held) else None
        row[f"{field[:-2]}_median_ci_m"] = median(rows[field])
    row["cn0_dbhz"] = _number(np.mean(rows["cn0_dbhz"]))
    row["lost_trials"] = int(rows["lost"].sum())
    return row


def _roc(rows: np.ndarray, limit: Any, jammed: bool) -> dict[str, Any]:
    """Misses (quiet points: alarms) at each threshold of ROC_P_FA; null where the threshold is not known."""
    known = np.isfinite(limit["roc"])
    n = int(rows["hit_n" if jammed else "tests"].sum())
    missed = rows["roc_missed"].sum(axis=0)
    k = missed if jammed else n - missed
    return {
        "roc_p_fa": ROC_P_FA.tolist(), "roc_threshold": [_number(x) for x in limit["roc"]],
        "roc_k": [int(x) if ok else None for x, ok in zip(k, known)], "roc_n": n,
    }  # fmt: skip


def _first_alarm(rows: np.ndarray, jammed: bool) -> dict[str, Any]:
    """Median time to the first alarm with its interval; trials without an alarm are later than any (null)."""
    t = rows["first_alarm_s"]
    heard = t[np.isfinite(t)]
    late = np.where(np.isfinite(t), t, np.inf)
    low, middle, high = median(late) if jammed else (None, None, None)
    alarmed = len(heard) if jammed else int(np.count_nonzero(rows["alarms"]))
    return {
        "alarmed_trials": alarmed, "first_alarm_median_s": middle, "first_alarm_ci_s": [low, high],
        "first_alarm_max_s": _number(heard.max()) if len(heard) and len(heard) == len(t) else None,
    }  # fmt: skip


def _approach(rows: np.ndarray, campaign: Campaign, point: int) -> dict[str, Any]:
    """Real P_FA of 150 s on all channels from the share of quiet trials with any alarm, channels independent."""
    spec = campaign.spec
    length_s = campaign.length(point).epochs * campaign.points[point].integration_s
    power = spec.channels * APPROACH_S / length_s
    k = int(np.count_nonzero(rows["alarms"]))
    values = (k / len(rows), *clopper_pearson(k, len(rows)))
    p, low, high = (-math.expm1(power * math.log1p(-min(x, 1.0 - 1e-12))) for x in values)
    told = per_approach(spec.p_fa_test, spec.dumps * campaign.points[point].integration_s, spec.channels)
    return {"p_fa_approach": p, "p_fa_approach_ci": [low, high], "p_fa_approach_nominal": told}


def median(x: np.ndarray) -> list[float | None]:
    """Median of trials and its 95 % interval by order statistics -> [low, median, high]; null: beyond all trials.

    P(X_(i) <= median) is binomial (n, 1/2) whatever the distribution.
    """
    from scipy.special import bdtrik

    x = np.sort(x)
    n = len(x)
    i = math.floor(bdtrik(0.025, n, 0.5)) if n >= 6 else -1
    with np.errstate(invalid="ignore"):
        middle = 0.5 * (x[(n - 1) // 2] + x[n // 2])
    low, high = (x[i], x[n - 1 - i]) if i >= 0 else (math.nan, math.nan)
    return [_number(low), _number(middle), _number(high)]


def _number(x: float) -> float | None:
    return float(x) if np.isfinite(x) else None


# -- monitors against one another ---------------------------------------------------------------------------------


def advantages(campaign: Campaign, counts: list[PointCount]) -> list[dict[str, Any]]:
    """Jammer power (dB) at which each monitor's P_MD is ``compare_p_md``, and how much less than the first monitor's.

    Between powers log-odds of P_MD are linear. Interval: percentiles of a bootstrap over trials, the same ones for all
    monitors, which saw the same signals. A monitor whose P_MD is not crossed between two points with 10 misses or more
    has none.
    """
    axis = next((a for a in ("jammer.power_dbw", "jammer.js_db") if len(campaign.axes.get(a, [])) > 1), None)
    spec = campaign.spec
    if axis is None or spec.method.kind != "count":
        return []
    lines: dict[tuple, list[PointCount]] = {}
    for c in counts[: campaign.total]:
        rest = {k: v for k, v in campaign.settings[c.index].items() if k != axis}
        if c.rows and c.jammed:
            lines.setdefault((str(rest),), []).append(c)
    out = []
    for line in lines.values():
        line.sort(key=lambda c: campaign.settings[c.index][axis])
        rest = {k: v for k, v in campaign.settings[line[0].index].items() if k != axis}
        x = np.array([campaign.settings[c.index][axis] for c in line], float)
        if len(line) > 1:
            out += _compare(spec, axis, rest, x, line)
    return out


def _compare(spec: CampaignSpec, axis: str, rest: dict[str, Any], x: np.ndarray, line: list[PointCount]) -> list[dict[str, Any]]:  # fmt: skip
    """Rows of one line of points, a monitor each."""
    rng = np.random.Generator(np.random.Philox(spec.seeds.evaluation))
    monitors = range(len(spec.monitor))
    at = np.full((_BOOT + 1, len(spec.monitor)), np.nan)
    sums = [_resampled(c, rng) for c in line]  # each (k, n) of (boot + 1, monitors)
    for i in monitors:
        k, n = (np.stack([s[j][:, i] for s in sums], axis=1) for j in (0, 1))
        at[:, i] = _crossing(x, k, n, spec.compare_p_md)
    out = []
    for i in monitors:
        gain = at[:, 0] - at[:, i]
        out.append({
            "axes": rest, "axis": axis, "monitor": spec.monitor[i].name, "p_md": spec.compare_p_md,
            "definition": spec.stop.definition, "power_db": _number(at[0, i]), "power_ci_db": _percentiles(at[:, i]),
            "against": spec.monitor[0].name, "gain_db": _number(gain[0]), "gain_ci_db": _percentiles(gain),
        })  # fmt: skip
    return out


def _resampled(c: PointCount, rng: Any) -> tuple[np.ndarray, np.ndarray]:
    """Summed misses and tests of a point, first as counted, then of bootstrap samples of its trials."""
    k, n = (np.array(v, float) for v in zip(*(c.counted(r) for r in c.rows)))
    weight = rng.multinomial(c.done, np.full(c.done, 1 / c.done), _BOOT)
    weight = np.concatenate([np.ones((1, c.done)), weight])
    return weight @ k, weight @ n


def _crossing(x: np.ndarray, k: np.ndarray, n: np.ndarray, p_md: float) -> np.ndarray:
    """Highest power at which interpolated P_MD falls to ``p_md``; NaN where it does not; k, n (samples, powers)."""
    odds = np.log((k + 0.5) / (n - k + 0.5)) - math.log(p_md / (1 - p_md))
    out = np.full(len(k), np.nan)
    for j in range(len(x) - 1):
        down = (odds[:, j] > 0) & (odds[:, j + 1] <= 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            here = x[j] + (x[j + 1] - x[j]) * odds[:, j] / (odds[:, j] - odds[:, j + 1])
        out[down] = here[down]
    j = int(np.searchsorted(x, out[0])) if np.isfinite(out[0]) else 0
    if j and k[0, j] < _LEAST_MISSES:
        out[:] = np.nan
    return out


def _percentiles(x: np.ndarray) -> list[float | None]:
    """95 % of the bootstrap samples; null unless nearly all of them have a value."""
    good = x[1:][np.isfinite(x[1:])]
    if not np.isfinite(x[0]) or len(good) < 0.99 * (len(x) - 1):
        return [None, None]
    return [float(v) for v in np.quantile(good, [0.025, 0.975])]


# -- the mask of a scan -------------------------------------------------------------------------------------------

SCAN = {"jammer.bandwidth_hz", "jammer.offset_hz", "jammer.power_dbw"}
"""Axes that make a campaign a mask scan."""


def mask_dbw(bandwidth_hz: Any) -> np.ndarray:
    """Tolerable in-band power against bandwidth, after the steady-state mask of RTCA DO-229D, appendix C.

    -150.5 dBW up to 700 Hz, then 6 dB a decade to 10 kHz, 3 dB a decade to 100 kHz, flat to 1 MHz. The corner
    values are assumed (not checked against the document).
    """
    b = np.asarray(bandwidth_hz, float)
    rise = 6.0 * np.log10(np.clip(b, 700.0, 1e4) / 700.0) + 3.0 * np.log10(np.clip(b, 1e4, 1e5) / 1e4)
    return -150.5 + rise


def mask(campaign: Any, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Per bandwidth and monitor: the worst lobe, for a tone its line, and the least power there that costs 1 dB of C/N0,
    loses lock (more than half of the trials) and is detected (P_MD below 1/2); null: none of the grid does.

    "Worst" is the offset with the largest C/N0 loss summed over the powers, each counted up to 10 dB (lost: 10).
    ``rows``: summary rows of the points that have trials.
    """
    if campaign.live or not set(campaign.axes) >= SCAN:
        return []
    jammed = [r for r in rows if r["point"] < campaign.total]
    out = []
    for bandwidth in sorted(campaign.axes["jammer.bandwidth_hz"]):
        wide = [r for r in jammed if r["axes"]["jammer.bandwidth_hz"] == bandwidth]
        for name in dict.fromkeys(r["monitor"] for r in wide):
            mine = [r for r in wide if r["monitor"] == name]
            out.append({"bandwidth_hz": bandwidth, "monitor": name, **_worst_lobe(campaign, mine)})
    return out


def _worst_lobe(campaign: Any, rows: list[dict[str, Any]]) -> dict[str, Any]:
    lobes: dict[float, list[tuple[float, float, bool, bool]]] = {}
    for r in rows:
        loss_db = campaign.points[r["point"]].cn0_dbhz - (r["cn0_dbhz"] or 0.0)
        entry = r["axes"]["jammer.power_dbw"], loss_db, r["lost_trials"] > 0.5 * r["trials"], r["rate"] < 0.5
        lobes.setdefault(r["axes"]["jammer.offset_hz"], []).append(entry)
    worst = max(lobes, key=lambda o: sum(10.0 if lost else min(db, 10.0) for _, db, lost, _ in lobes[o]))
    at = next(r["point"] for r in rows if r["axes"]["jammer.offset_hz"] == worst)
    twin, jammer = campaign.points[at], campaign.points[at].jammers[0]
    line = jammer.line if jammer.kind == "CW" and isinstance(jammer.line, int) else None
    least = lambda test: min((e[0] for e in lobes[worst] if test(e)), default=None)  # noqa: E731
    return {
        "worst_offset_hz": worst,
        "worst_line_hz": None if line is None else line / SIGNALS[twin.signal].code_period_s,
        "worst_line_db": None if line is None else 20 * math.log10(abs(code_spectrum(twin.signal, twin.prn, line, twin.waveform))),
        "mask_dbw": float(mask_dbw(rows[0]["axes"]["jammer.bandwidth_hz"])),
        "loss_1db_dbw": least(lambda e: e[1] >= 1.0), "loss_of_lock_dbw": least(lambda e: e[2]),
        "detected_dbw": least(lambda e: e[3]),
    }  # fmt: skip
