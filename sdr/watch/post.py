"""One monitor at its post: it is trained on the first seconds of one stream, then tests what follows and keeps alarms."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from monitors.records import ALARM, STATISTIC, alarms
from monitors.threshold import per_epoch

MONITOR = np.dtype([("signal", "S4"), ("prn", "i4"), *((n, STATISTIC[n]) for n in STATISTIC.names or ())])
"""STATISTIC of one channel; ``t_s`` is scenario time at the end of its last epoch. Without signal: of the front end."""
WATCHED = np.dtype(
    [
        ("monitor", "S16"),
        ("signal", "S4"),
        ("prn", "i4"),
        ("threshold", "f8"),
        ("p_fa", "f8"),  # per test
        ("approach_threshold", "f8"),  # for the same P_FA once per approach over all channels
        ("rule", "S10"),  # where the thresholds come from
        ("trained_s", "f8"),  # scenario time from which it tests
        ("tests", "i8"),
    ]
)
"""One monitor on one channel."""
UNWATCHED = np.dtype(
    [
        ("monitor", "S16"),
        ("signal", "S4"),
        ("prn", "i4"),
        ("start_s", "f8"),  # lock was lost
        ("end_s", "f8"),  # tests went on, or the run ended
        ("alarm", "?"),  # an alarm stood when lock was lost, and was held
    ]
)
"""A time without tests after the training: the channel had no lock."""


FAILING_S = 3.0
"""A channel that is lost has been failing for up to so long: an alarm in that time is held."""


class Post:
    """A trained test on one stream of epochs.

    ``run``: a monitor's Run; ``null``: called after the training with what it was trained on, gives the null model;
    ``epoch_s``: length of an epoch; ``test_s``: time between tests.
    """

    def __init__(
        self, spec: Any, fs_hz: float, run: Any, epoch_s: float, test_s: float, null: Callable[[np.ndarray], Any],
        signal: str = "", prn: int = 0,
    ) -> None:  # fmt: skip
        self.spec, self.fs_hz, self.run, self.epoch_s, self.test_s = spec, fs_hz, run, epoch_s, test_s
        self.signal, self.prn = signal, prn
        self._null = null
        self.threshold: float | None = None
        self.approach_threshold: float | None = None
        self.rule = self.unavailable = ""
        self.trained_s = math.nan
        self.quiet_s = 0.0
        self.seen_s = 0.0  # of lock, or of samples
        self.tests: list[np.ndarray] = []
        self._quiet: list[np.ndarray] = []
        self._above: list[np.ndarray] = []
        self._breaks: list[tuple[float, float]] = []

    @property
    def p_fa(self) -> float:
        """Per test."""
        return self._per_approach if self.spec.p_fa_per == "approach" else self.spec.p_fa

    @property
    def _per_approach(self) -> float:
        channels = self.spec.channels if self.signal else 1
        return per_epoch(self.spec.p_fa, self.test_s, channels, self.spec.approach_s)

    def take(self, x: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Train on, or test, the next epochs, which end before the samples ``ends`` -> MONITOR rows."""
        if self.unavailable:
            return np.empty(0, MONITOR)
        if self.threshold is None:
            n = min(len(x), math.ceil((self.spec.training_s - self.quiet_s) / self.epoch_s - 1e-6))
            self._quiet.append(x[:n])
            self.quiet_s += n * self.epoch_s
            if self.quiet_s < self.spec.training_s - 1e-6:
                return np.empty(0, MONITOR)
            self._train(np.concatenate(self._quiet))
            self.trained_s = float(ends[n - 1]) / self.fs_hz
            return self.take(x[n:], ends[n:]) if n < len(x) else np.empty(0, MONITOR)
        s = self.run(x, ends)
        s["t_s"] = s["sample_index"] / self.fs_hz
        self.tests.append(s["t_s"])
        above = s[s["value"] >= self.threshold]
        if len(above):
            self._above.append(above)
        rows = np.empty(len(s), MONITOR)
        rows["signal"], rows["prn"] = self.signal.encode(), self.prn
        for name in STATISTIC.names or ():
            rows[name] = s[name]
        return rows

    def _train(self, x: np.ndarray) -> None:
        self._quiet = []
        given = self.spec.threshold
        try:
            self.run.train(x)
            null = self._null(x) if given is None else None
        except ValueError as err:
            self.unavailable = str(err)
            return
        self.rule = "given" if null is None else null.rule
        self.threshold = given if null is None else null.isf(self.p_fa)
        self.approach_threshold = given if null is None else null.isf(self._per_approach)
        self.run = self.run.fresh()

    def rest(self, start_s: float, end_s: float) -> None:
        """There was nothing to test from ``start_s`` to ``end_s``: what the run had begun is dropped."""
        if self.threshold is not None:
            self._breaks.append((start_s, end_s))
            self.run = self.run.fresh()

    # -- report ---------------------------------------------------------------------------------------------------

    def alarms(self) -> np.ndarray:
        """ALARM rows so far; one that stands when the channel is lost is held until tests go on."""
        return self._alarms(self.threshold)

    def _alarms(self, threshold: float | None) -> np.ndarray:
        above = np.concatenate(self._above) if self._above else np.zeros(0, STATISTIC)
        above = above[above["value"] >= threshold] if threshold is not None else above[:0]
        if not len(above):
            return np.zeros(0, ALARM)
        # Exceedances further apart than the gap are parted by a value below, so that they are alarms of their own.
        cut = np.flatnonzero(np.diff(above["t_s"]) > self._gap_s) + 1
        rows = [
            alarms(p, threshold, self.spec.name, self.signal, self.prn, self._gap_s)
            for p in np.split(above, cut)
        ]
        return self._held(np.concatenate(rows))

    @property
    def _gap_s(self) -> float:
        return max(self.spec.gap_s, 1.5 * self.test_s)

    def _held(self, rows: np.ndarray) -> np.ndarray:
        """Alarms that stood at the begin of a break last until its end, and join the next that begins there."""
        for start_s, end_s in self._breaks:
            stood = (rows["start_s"] <= start_s) & (rows["end_s"] >= start_s - max(FAILING_S, self._gap_s))
            rows["end_s"][stood] = np.maximum(rows["end_s"][stood], end_s)
        joined = [rows[:1]]
        for k in range(1, len(rows)):
            last, row = joined[-1], rows[k : k + 1]
            if row["start_s"][0] > last["end_s"][0] + self._gap_s:
                joined.append(row)
                continue
            if row["peak"][0] > last["peak"][0]:
                last["peak"], last["frequency_hz"] = row["peak"], row["frequency_hz"]
            last["end_s"] = np.maximum(last["end_s"], row["end_s"])
        return np.concatenate(joined)

    def watched(self) -> np.ndarray:
        """WATCHED row; none before the training is complete."""
        if self.threshold is None:
            return np.zeros(0, WATCHED)
        row = (
            self.spec.name.encode(), self.signal.encode(), self.prn, self.threshold, self.p_fa,
            self.approach_threshold, self.rule.encode(), self.trained_s, sum(map(len, self.tests)),
        )  # fmt: skip
        return np.array([row], WATCHED)

    def unwatched(self) -> np.ndarray:
        """UNWATCHED rows."""
        rows, stand = np.zeros(len(self._breaks), UNWATCHED), self.alarms()
        rows["monitor"], rows["signal"], rows["prn"] = self.spec.name.encode(), self.signal.encode(), self.prn
        for row, (start_s, end_s) in zip(rows, self._breaks):
            row["start_s"], row["end_s"] = start_s, end_s
            row["alarm"] = np.any((stand["start_s"] <= start_s) & (stand["end_s"] >= end_s))
        return rows

    def report(self, quiet_until_s: float) -> dict[str, Any]:
        """What the JSON says; ``quiet_until_s``: when the first jammer starts, inf if that is not known."""
        head: dict[str, Any] = {"name": self.spec.name, "signal": self.signal, "prn": self.prn}
        if self.threshold is None:
            return head | {
                "threshold": None,
                "p_fa": self.p_fa,
                "tests": 0,
                "alarms": [],
                "unavailable": self.unavailable or self._wants(),
            }
        t_s = np.concatenate(self.tests) if self.tests else np.zeros(0)
        quiet = int(np.count_nonzero(t_s < quiet_until_s))
        false, approach = (
            sum(float(a["start_s"]) < quiet_until_s for a in self._alarms(limit))
            for limit in (self.threshold, max(self.threshold, self.approach_threshold or 0.0))
        )
        return head | {
            "threshold": self.threshold,
            "p_fa": self.p_fa,
            "rule": self.rule,
            "approach_threshold": self.approach_threshold,
            "trained_s": self.trained_s,
            "tests": len(t_s),
            "alarms": [{k: float(a[k]) for k in ("start_s", "end_s", "peak")} for a in self.alarms()],
            "quiet_tests": quiet,
            "quiet_alarms": false,
            "quiet_alarms_due": poisson_interval(self.p_fa * quiet),
            "quiet_approach_alarms": approach,
            "unwatched": [
                {"start_s": float(r["start_s"]), "end_s": float(r["end_s"]), "alarm": bool(r["alarm"])}
                for r in self.unwatched()
            ],
        }

    def _wants(self) -> str:
        wait = f"{self.spec.settle_s:g} s to settle and "
        of = "lock" if self.signal else "samples"
        return (
            f"not trained: it needs {wait}{self.spec.training_s:g} s of {of} and had {self.seen_s:.1f} s; lengthen the "
            "recording or shorten settle_s and training_s"
        )


def joined(rows: list[np.ndarray]) -> np.ndarray:
    """MONITOR rows in one array; numpy takes its time over joining structured ones, and mostly there is one."""
    rows = [r for r in rows if len(r)]
    return rows[0] if len(rows) == 1 else np.concatenate([np.empty(0, MONITOR), *rows])


def poisson_interval(expected: float) -> list[int]:
    """Counts between the 2.5 and 97.5 % quantiles of a Poisson law."""
    from scipy.stats import poisson

    return [int(poisson.ppf(q, expected)) if expected > 0 else 0 for q in (0.025, 0.975)]


def totals(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Reports of all channels added up, one row per monitor."""
    out = []
    for name in dict.fromkeys(r["name"] for r in rows):
        mine = [r for r in rows if r["name"] == name and r["threshold"] is not None and "quiet_tests" in r]
        if mine:
            due = sum(r["p_fa"] * r["quiet_tests"] for r in mine)
            sums = {
                k: sum(r[k] for r in mine)
                for k in ("tests", "quiet_tests", "quiet_alarms", "quiet_approach_alarms")
            }
            alarmed = sum(len(r["alarms"]) for r in mine)
            out.append(
                {
                    "name": name,
                    "channels": len(mine),
                    "alarms": alarmed,
                    "quiet_alarms_due": poisson_interval(due),
                }
                | sums
            )
    return out


def report_lines(rows: list[dict[str, Any]], added: list[dict[str, Any]]) -> list[str]:
    """Reports as text: each monitor's tests and alarms, then who alarmed when, then who could not watch."""
    lines = []
    for m in added:
        low, high = m["quiet_alarms_due"]
        lines.append(
            f"{m['name']}: {m['alarms']} alarms in {m['tests']} tests; {m['quiet_alarms']} in {m['quiet_tests']} tests "
            f"without jammer (95 % of cases {low} to {high}), {m['quiet_approach_alarms']} at the threshold per approach"
        )
        for r in (r for r in rows if r["name"] == m["name"]):
            lines += [f"  {where(r)} {text}" for text in _events(r)]
    idle: dict[tuple[str, str], list[str]] = {}
    for r in rows:
        if r["threshold"] is None and r.get("unavailable"):
            idle.setdefault((r["name"], r["unavailable"]), []).append(where(r))
    lines += [f"{name} on {', '.join(channels)}: {why}" for (name, why), channels in idle.items()]
    return lines


def where(row: dict[str, Any]) -> str:
    """Channel of a report."""
    return f"{row['signal']} {row['prn']}" if row["signal"] else "front end"


def _events(row: dict[str, Any]) -> list[str]:
    alarms = row.get("alarms", [])
    out = []
    if alarms:
        peak = max(a["peak"] for a in alarms)
        out.append(
            f"{len(alarms)} alarms from {alarms[0]['start_s']:.1f} to {alarms[-1]['end_s']:.1f} s, up to {peak:.4g} "
            f"(threshold {row['threshold']:.4g})"
        )
    for gap in row.get("unwatched", ()):
        held = "an alarm stood and is held" if gap["alarm"] else "no alarm stood"
        out.append(f"without lock from {gap['start_s']:.1f} to {gap['end_s']:.1f} s: {held}")
    return out
