"""The reference pages are those of the present Specs and Records, and they explain every key."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from sdr import reference
from sdr.campaign.spec import CampaignSpec
from sdr.scenario import Scenario

DOCS = Path(__file__).resolve().parents[1] / "docs"


@pytest.mark.parametrize("name", reference.PAGES)
def test_page_is_current(name):
    page = DOCS / name
    assert page.read_text(encoding="utf-8") == reference.render(page), "run: python -m sdr.reference"


def _below(model, seen):
    if model not in seen:
        seen.add(model)
        for field in model.model_fields.values():
            for inner in reference.models(field.annotation):
                _below(inner, seen)
    return seen


@pytest.mark.parametrize("root", [Scenario, CampaignSpec])
def test_every_key_has_a_meaning(root):
    silent = [
        f"{model.__name__}.{name}"
        for model in _below(root, set())
        for name, field in model.model_fields.items()
        if not (reference.meanings(model).get(name) or field.description or reference._obvious(name, field))
    ]
    assert not silent, "write a string below the key in its Spec"


def test_types_ranges_and_defaults_are_those_of_the_spec():
    text = "\n".join(reference.scenario_lines(Scenario))
    assert "| `duration_s` | number | s | **required** | > 0, ≤ 86400 |" in text
    assert "| `start` | date-time |  | `2024-03-01T12:00:00` |" in text
    assert '### `[motion] kind = "Static"`' in text
    assert '### `[[jammer]] kind = "CW"`' in text


def test_json_keys_of_run_are_documented(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "sdr", "run", "demo", "--json", "--set", "duration_s=1", "-o", tmp_path / "a.h5"],
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    result = json.loads(done.stdout)
    text = (DOCS / "results.md").read_text(encoding="utf-8")
    keys = set(result) | {k for s in result["satellites"] for k in s}
    assert not {k for k in keys if f"`{k}`" not in text}
