"""Published experiments run again: every module has ``run(out_dir, quick, seed) -> list of rows`` and writes figures.

A row is ``{"item", "published", "ours", "ci_low", "ci_high", "verdict", "note"}`` with verdict "reproduced",
"not reproduced" or "not stated" (the source gives no number to compare with).
"""

import csv
import json
from pathlib import Path

__all__ = [
    "COLUMNS",
    "EXPERIMENTS",
    "VERDICTS",
    "format_table",
    "reproduce",
    "row",
    "within",
    "write_table",
]

EXPERIMENTS = {
    "ouzeau2008": "sdr.reproduce.ouzeau",
    "abdelhafez-als": "sdr.reproduce.als",
    "abdelhafez-bias": "sdr.reproduce.bias",
    "vanek1999": "sdr.reproduce.vanek",
    "karaim2020": "sdr.reproduce.karaim_report",
    "integrity-live": "sdr.reproduce.live",
    "high-dynamics": "sdr.reproduce.aided_loops",
}
"""Command-line name -> module with ``run``; imported only when asked for."""
VERDICTS = ("reproduced", "not reproduced", "not stated")
COLUMNS = ("item", "published", "ours", "ci_low", "ci_high", "verdict", "note")


def row(item, published, ours, ci_low=None, ci_high=None, verdict="not stated", note="") -> dict:
    """One line of a comparison table; numbers are plain floats so that it goes to JSON unchanged."""
    if verdict not in VERDICTS:
        raise ValueError(f"verdict must be one of {', '.join(VERDICTS)}, not {verdict!r}.")

    def plain(value):
        return value if value is None or isinstance(value, str) else float(value)

    values = (item, plain(published), plain(ours), plain(ci_low), plain(ci_high), verdict, note)
    return dict(zip(COLUMNS, values))


def within(published: float, low: float, high: float) -> str:
    """Verdict of a published number against an interval of ours (or of ours against the published one's)."""
    return "reproduced" if low <= published <= high else "not reproduced"


def write_table(rows: list[dict], out_dir: str | Path, name: str) -> Path:
    """Write ``name``.csv and ``name``.json into ``out_dir``; returns the CSV's path."""
    out = Path(out_dir)
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"{name}.csv"
    with path.open("w", newline="", encoding="utf-8") as handle:
        writer = csv.DictWriter(handle, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    (out / f"{name}.json").write_text(json.dumps(rows, indent=1), encoding="utf-8")
    return path


def format_table(rows: list[dict]) -> str:
    """The table as aligned text, for a terminal."""

    def text(value):
        return "" if value is None else value if isinstance(value, str) else f"{value:.4g}"

    table = [COLUMNS, *(tuple(text(r[c]) for c in COLUMNS) for r in rows)]
    width = [max(len(line[i]) for line in table) for i in range(len(COLUMNS) - 1)]
    return "\n".join(
        "  ".join([*(c.ljust(w) for c, w in zip(line, width)), line[-1]]).rstrip() for line in table
    )


def reproduce(name: str, out_dir: str | Path | None = None, quick: bool = False, seed: int = 1) -> dict:
    """Run one of EXPERIMENTS; returns ``items`` (the rows), the directory and the table as text."""
    import importlib

    if name not in EXPERIMENTS:
        raise ValueError(f"reproduction '{name}' is not known; allowed: {', '.join(sorted(EXPERIMENTS))}")
    out = Path(out_dir) if out_dir is not None else Path(name)
    rows = importlib.import_module(EXPERIMENTS[name]).run(out, quick=quick, seed=seed)
    count = {v: sum(r["verdict"] == v for r in rows) for v in VERDICTS}
    summary = ", ".join(f"{n} {v}" for v, n in count.items())
    return {
        "items": rows,
        "output": str(out),
        "text": f"{format_table(rows)}\n{summary}; figures and tables in {out}",
    }
