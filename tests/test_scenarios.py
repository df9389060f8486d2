"""Every built-in scenario loads, starts and delivers samples; the schema refuses what it does not know."""

import pytest

from sdr import scenario


@pytest.mark.parametrize("name", scenario.built_in())
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
