"""Every built-in scenario loads, starts and delivers samples; the schema refuses what it does not know."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from sdr import __main__ as command_line
from sdr import jobs, scenario, toml


@pytest.mark.parametrize("name", toml.built_in("scenario"))
def test_built_in_scenario_delivers_samples(name):
    spec, text = scenario.load(name)
    assert spec.name == name
    assert spec.description
    assert scenario.parse(text) == spec
    source = scenario.source(spec)
    n0, iq = source.read(20_000)
    assert n0 == 0
    assert iq.shape == (2, 20_000)
    assert iq.any()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["name", "missing"]),
        ("name = 3", ["name"]),
        ('name = "x"\nduration_s = 1\nschema = 9', ["schema"]),
        ('name = "x"\nduration_s = 1\n[sky]\ncn0_dbhzz = 3', ["sky.cn0_dbhzz", "cn0_dbhz"]),
        ('name = "x"\nduration_s = 1\n[motion]\nkind = "Teleport"', ["motion", "Teleport", "Static"]),
        ("name = ", ["TOML"]),
    ],
)
def test_refusals_name_key_value_and_what_is_allowed(text, words):
    with pytest.raises(ValueError) as error:
        scenario.parse(text, "x.toml")
    for word in ["x.toml", *words]:
        assert word in str(error.value)
    assert "\n" not in str(error.value).replace("TOML: ", "")


@pytest.mark.parametrize(
    ("name", "more", "figures"),
    [
        ("echoes", [], {"echoes"}),
        ("manoeuvres", [], {"motion"}),
        (
            "cw-cancel",
            ['jammer=[{kind="CW", jn0_dbhz=80.0, freq_hz=3e5, start_s=1.0}]'],
            {"spectrum", "attack"},
        ),
    ],
)
def test_figures_show_what_a_scenario_has(tmp_path, name, more, figures):
    """And the spectrum after a mitigation lacks the tone, 80 dB-Hz in a bin of 5 kHz over noise of 37, that it took out."""
    path = tmp_path / "a.h5"
    over = ["duration_s=3", "front_end.fs_hz=2.6e6", *more]
    drawn = jobs.run(name, output=path, overrides=over, plots=True, quiet=True)["figures"]
    assert figures <= {Path(f).stem for f in drawn}
    with h5py.File(path) as h5:
        if "mitigation/spectrum" in h5:
            before, after = (h5[f"{part}/spectrum"][15:].mean(axis=0) for part in ("samples", "mitigation"))
            assert before.max() - np.median(before) > 30.0
            assert after.max() - np.median(after) < 6.0


def test_scenarios_and_campaigns_are_listed(capsys):
    command_line.scenarios(json=True)
    told = json.loads(capsys.readouterr().out)
    for kind in ("scenario", "campaign"):
        assert [r["name"] for r in told[f"{kind}s"]] == toml.built_in(kind)
        assert all(r["description"] for r in told[f"{kind}s"])
