"""The comparison tables, and the quick form of the three estimation reproductions."""

import csv
import json

import pytest

from monitors.detection import clopper_pearson
from sdr import reproduce


def test_rows_go_to_csv_and_json_unchanged(tmp_path):
    rows = [
        reproduce.row("a", 1, 2.5, 2, 3, "reproduced", "n, with comma"),
        reproduce.row("b", "no", 0.1),
    ]
    path = reproduce.write_table(rows, tmp_path / "new", "t")
    assert json.loads((tmp_path / "new" / "t.json").read_text()) == rows
    with path.open(newline="") as handle:
        read = list(csv.DictReader(handle))
    assert (
        read[0]["note"] == "n, with comma" and read[1]["ci_low"] == "" and read[1]["verdict"] == "not stated"
    )
    assert "reproduced" in reproduce.format_table(rows)


def test_unknown_verdict_is_refused():
    with pytest.raises(ValueError, match="verdict"):
        reproduce.row("a", 1, 1, verdict="maybe")


def test_clopper_pearson_against_its_definition():
    from scipy.stats import binom

    low, high = clopper_pearson(3, 20)
    assert binom.sf(2, 20, low) == pytest.approx(0.025, rel=1e-6)
    assert binom.cdf(3, 20, high) == pytest.approx(0.025, rel=1e-6)
    assert clopper_pearson(0, 10) == (0.0, pytest.approx(1 - 0.025 ** (1 / 10)))
    with pytest.raises(ValueError, match="events"):
        clopper_pearson(3, 2)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "figures"), [("als", 10), ("bias", 10), ("vanek", 17)])
def test_quick_reproduction_writes_everything(tmp_path, name, figures):
    import importlib

    rows = importlib.import_module(f"sdr.reproduce.{name}").run(tmp_path, quick=True, seed=3)
    assert all(set(r) == set(reproduce.COLUMNS) and r["verdict"] in reproduce.VERDICTS for r in rows)
    assert len(list(tmp_path.glob("fig*.png"))) >= figures - 1
    assert (tmp_path / f"{name}.csv").exists() and (tmp_path / f"{name}.json").exists()
