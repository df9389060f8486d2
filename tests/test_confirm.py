"""Sample-level confirmation: points of the twin once more on IF samples, and a twin that is wrong is found out."""

import json

import pytest

from sdr.campaign import confirm

TABLE = {
    "name": "confirmed",
    "p_fa": 1e-2,
    "twin": {"signal": "L1CA", "prn": 6, "cn0_dbhz": 45.0, "integration_s": 0.02},
    "jammer": {"kind": "CW", "offset_hz": 15.0, "js_db": 3.0},
    "monitor": [
        {"name": "glrt", "rule": "analytic", "detector": {"kind": "GLRT"}},
        {"name": "fft", "rule": "gaussian", "detector": {"kind": "FFT"}},
    ],
    "trial": {"epochs": 350, "settle_epochs": 50},
    "training": {"trials": 4, "epochs": 3000},
    "threshold": {"trials": 4, "epochs": 5000},
}
GALILEO = {
    "dumps": 25,
    "twin": {"signal": "E1B", "prn": 38, "waveform": "BOC11", "cn0_dbhz": 40.0, "integration_s": 0.004},
    "jammer": {"kind": "CW", "offset_hz": 2.0, "js_db": 8.0},
    "trial": {"epochs": 1750, "settle_epochs": 250},
    "training": {"trials": 4, "epochs": 25_000},
    "threshold": {"trials": 4, "epochs": 60_000},
}


def run(tmp_path, **changes):
    path = tmp_path / "c.toml"
    lines = []
    for key, value in (TABLE | changes).items():
        lines.append(f"{key} = {_toml(value)}")
    path.write_text("\n".join(lines), encoding="utf-8")
    return confirm.confirm(str(path), 0, quiet=True)


def _toml(v):
    if isinstance(v, dict):
        return "{" + ", ".join(f"{k} = {_toml(x)}" for k, x in v.items()) + "}"
    return "[" + ", ".join(map(_toml, v)) + "]" if isinstance(v, list) else json.dumps(v)


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"jammer": {"kind": "NBI", "bandwidth_hz": 400.0, "js_db": 10.0}},
        pytest.param(
            {"jammer": {"kind": "NBI", "bandwidth_hz": 50e3, "js_db": 20.0}}, marks=pytest.mark.slow
        ),
        pytest.param(GALILEO, marks=pytest.mark.slow),
        GALILEO
        | {"twin": GALILEO["twin"] | {"data": True, "wiped": True}, "jammer": {"kind": "CW", "js_db": 20.0}},
    ],
    ids=["cw", "narrow noise", "wide noise", "galileo", "galileo with data"],
)
def test_samples_agree_with_the_twin(tmp_path, change):
    result = run(tmp_path, **change)
    for r in result["monitors"]:
        assert r["seconds"] >= 5 and abs(r["statistic_z"]) < confirm.Z_AGREE, r
    assert result["agree"]
    # The jammer is what is compared: its statistic stands far above the quiet one's.
    assert result["monitors"][0]["statistic_twin"] > 8.0
    json.dumps(result, allow_nan=False)


def test_a_wrong_twin_is_found_out(tmp_path, monkeypatch):
    """Samples with 3 dB less of the jammer."""
    monkeypatch.setattr(
        confirm, "_cw_rows", lambda spec, rng, real=confirm._cw_rows: real(spec, rng) * [1, 1, 1, 0.7, 1, 1]
    )
    result = run(tmp_path)
    assert not result["agree"] and "DISAGREE" in result["text"]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"twin": GALILEO["twin"] | {"waveform": "CBOC+"}, "dumps": 25}, "E1B with waveform"),
        ({"twin": TABLE["twin"] | {"bandwidth_hz": 4e6}}, "without a front-end filter"),
        ({"dumps": 5}, "sums of dumps"),
    ],
)
def test_what_is_not_made_on_samples(tmp_path, change, sentence):
    with pytest.raises(ValueError, match=sentence):
        run(tmp_path, **change)
