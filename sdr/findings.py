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
_CODES = 256


def split(name: str) -> tuple[bytes, int]:
    """G07 -> (b"G", 7)."""
    return name[:1].encode(), int(name[1:])


@lru_cache(maxsize=256)
def _columns(names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    return np.array([split(n)[0] for n in names], "S1"), np.array([split(n)[1] for n in names], np.int32)


def found(names, sample: int, t_s: float, value, threshold, estimate_m=np.nan, rivals=b"") -> np.ndarray:
    """INTEGRITY rows of satellites ``names``; the rest are columns or scalars."""
    rows = np.zeros(len(names), INTEGRITY)
    rows["system"], rows["prn"] = _columns(tuple(names))
    rows["sample_index"], rows["t_s"], rows["rivals"] = sample, t_s, rivals
    rows["value"], rows["threshold"], rows["estimate_m"] = value, threshold, estimate_m
    return rows


class Alarms:
    """Tests and alarms of one monitor by satellite; exceedances within ``gap_s`` are one alarm."""

    def __init__(self, gap_s: float) -> None:
        self.gap_s = gap_s
        self.found: dict[tuple[bytes, int], list[dict[str, Any]]] = {}
        self.unavailable_epochs = 0
        self.reason: str | None = None
        self._tests, self._threshold = np.zeros(_CODES, np.int64), np.zeros(_CODES)

    def add(self, rows: np.ndarray) -> None:
        """Rows of one epoch."""
        self.reason = None
        code = np.where(rows["system"] == b"G", 0, _CODES // 2) + rows["prn"]
        self._tests[code] += 1
        self._threshold[code] = rows["threshold"]
        for row in rows[rows["value"] >= rows["threshold"]]:
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
        tested = np.flatnonzero(self._tests)
        if not len(tested):
            none = {"signal": "", "prn": 0, "threshold": None, "p_fa": p_fa, "tests": 0, "alarms": []}
            return [head | none]
        out = []
        for code in tested:
            system, prn = divmod(int(code), _CODES // 2)
            row = {"signal": ("L1CA", "E1C")[system], "prn": prn, "threshold": float(self._threshold[code])}
            counts = {
                "tests": int(self._tests[code]),
                "alarms": self.found.get((b"GE"[system : system + 1], prn), []),
            }
            out.append(head | row | {"p_fa": p_fa} | counts)
        return out
