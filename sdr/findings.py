"""What the integrity monitors find: rows for the results, and alarms by satellite."""

from functools import lru_cache
from typing import Any

import numpy as np

INTEGRITY = np.dtype(
    [
        ("system", "S1"),
        ("prn", "i4"),
        ("sample_index", "u8"),
        ("t_s", "f8"),
        ("value", "f8"),
        ("threshold", "f8"),
        ("estimate_m", "f8"),  # bias (bias_bank) or range sigma (als, noise_rmd); NaN elsewhere
        ("rivals", "S23"),  # satellites that the ranges do not tell from this one, where it is accused
    ]
)
"""One value of one monitor on one satellite."""
PROTECTION = np.dtype(
    [
        ("sample_index", "u8"),
        ("t_s", "f8"),
        ("hpl_m", "f8"),
        ("vpl_m", "f8"),
        ("hal_m", "f8"),
        ("val_m", "f8"),
    ]
)
"""Protection levels of one position and the alert limits."""


def split(name: str) -> tuple[bytes, int]:
    """G07 -> (b"G", 7)."""
    return name[:1].encode(), int(name[1:])


@lru_cache(maxsize=256)
def _blank(names: tuple[str, ...]) -> np.ndarray:
    """Rows with the satellites alone."""
    rows = np.zeros(len(names), INTEGRITY)
    rows["estimate_m"] = np.nan
    for row, name in zip(rows, names):
        row["system"], row["prn"] = split(name)
    return rows


def found(names, sample: int, t_s: float, value, threshold, estimate_m=None, rivals=b"") -> np.ndarray:
    """INTEGRITY rows of satellites ``names``; the rest are columns or scalars."""
    rows = _blank(tuple(names)).copy()
    rows["sample_index"], rows["t_s"] = sample, t_s
    rows["value"], rows["threshold"] = value, threshold
    if estimate_m is not None:
        rows["estimate_m"] = estimate_m
    if rivals:
        rows["rivals"] = rivals
    return rows


class Alarms:
    """Tests and alarms of one monitor by satellite; exceedances within ``gap_s`` are one alarm."""

    def __init__(self, gap_s: float) -> None:
        self.gap_s = gap_s
        self.found: dict[tuple[bytes, int], list[dict[str, Any]]] = {}
        self.unavailable_epochs = 0
        self.reason: str | None = None
        self._tested: dict[tuple[bytes, bytes], tuple[int, np.ndarray]] = {}

    def add(self, rows: np.ndarray) -> None:
        """Rows of one epoch."""
        self.reason = None
        # Of the same satellites as before, mostly: they are counted together and named in the report.
        who = rows["system"].tobytes(), rows["prn"].tobytes()
        count, _ = self._tested.pop(who, (0, rows))
        self._tested[who] = count + 1, rows["threshold"]
        over = rows["value"] >= rows["threshold"]
        for row in rows[over] if np.count_nonzero(over) else ():
            key = bytes(row["system"]), int(row["prn"])
            mine, t, value = self.found.setdefault(key, []), float(row["t_s"]), float(row["value"])
            if mine and t - mine[-1]["end_s"] <= self.gap_s:
                mine[-1]["end_s"], mine[-1]["peak"] = t, max(mine[-1]["peak"], value)
                mine[-1]["rivals"] = row["rivals"].decode().split()
            else:
                rivals = row["rivals"].decode().split()
                mine.append({"start_s": t, "end_s": t, "peak": value, "rivals": rivals})

    def lack(self, reason: str | None) -> None:
        """The monitor could not work this epoch, if there is a reason."""
        if reason:
            self.unavailable_epochs += 1
            self.reason = reason

    def report(self, name: str, p_fa: float | None) -> list[dict[str, Any]]:
        """One row per satellite that was tested; a monitor that never could gives one row with the reason."""
        head = {"name": name, "unavailable": self.reason, "unavailable_epochs": self.unavailable_epochs}
        tested = self._tests()
        if not tested:
            none = {"signal": "", "prn": 0, "threshold": None, "p_fa": p_fa, "tests": 0, "alarms": []}
            return [head | none]
        out = []
        for (system, prn), (tests, threshold) in sorted(
            tested.items(), key=lambda item: (item[0][0] != b"G", item[0])
        ):
            row = {"signal": "L1CA" if system == b"G" else "E1C", "prn": prn, "threshold": threshold}
            counts = {"tests": tests, "alarms": self.found.get((system, prn), [])}
            out.append(head | row | {"p_fa": p_fa} | counts)
        return out

    def _tests(self) -> dict[tuple[bytes, int], tuple[int, float]]:
        """(tests, last threshold) by satellite."""
        out: dict[tuple[bytes, int], tuple[int, float]] = {}
        for (systems, prns), (count, threshold) in self._tested.items():
            for system, prn, limit in zip(
                np.frombuffer(systems, "S1"), np.frombuffer(prns, np.int32), threshold
            ):
                key = bytes(system), int(prn)
                out[key] = out.get(key, (0, 0.0))[0] + count, float(limit)
        return out
