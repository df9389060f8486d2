"""Counterfactual replay and injection: differences add up, the same noise, exact J/N, truth and refusals."""

import json
import math

import numpy as np
import pytest

from sdr import counterfactual, iffile, inject, jobs, scenario

Z = 5.0
TEXT = """
name = "t"
duration_s = 4.0
seed = 3
[sky]
source = "none"
cn0_dbhz = 47.0
scripted = [{ prn = 6, doppler_hz = 1250.0, doppler_rate_hz_s = 1.0 }]
[front_end]
fs_hz = 2.5e6
bits = 8
[[jammer]]
kind = "CW"
js_db = 18.0
against = "G06"
start_s = 2.0
line = { signal = "L1CA", prn = 6, offset_hz = 3.0 }
[multipath]
kind = "Echoes"
echoes = [{ delay_s = 2e-7, power_db = -10.0, phase_rad = 0.5 }]
[receiver.acquisition]
systems = ["G"]
gps_prns = [6]
"""


@pytest.fixture(scope="module")
def replay(tmp_path_factory):
    directory = tmp_path_factory.mktemp("replay")
    (directory / "t.toml").write_text(TEXT)
    return counterfactual.counterfactual(
        str(directory / "t.toml"),
        ["jammer", "multipath", "quantisation"],
        output=directory / "out",
        quiet=True,
    )


def test_parts_add_up_and_are_where_they_belong(replay):
    series = {k: np.array(v, float) for k, v in replay["satellites"]["G06_L1CA"]["code_m"]["series"].items()}
    parts = sum(series[k] for k in ("jammer", "multipath", "quantisation", "interaction"))
    np.testing.assert_allclose(parts, series["all"] - series["none"], atol=1e-5)  # rounded to 1e-6
    before = np.nan_to_num(series["jammer"][:19])
    # The same noise: before the jammer begins only the rounding differs, as the ideal gain knows of the power to come.
    assert np.max(np.abs(before)) < 0.1
    assert np.nanmax(np.abs(series["jammer"][22:])) > 1.0
    # The echo draws the replica late by a' tau / (1 + a'), a' = 0.316 cos 0.5 in phase: 13.0 m of 60 m; 10 % of that for
    # the part in quadrature and the phase that the loop finds, thermal noise of 0.5 m cancels.
    assert np.nanmean(series["multipath"][12:19]) == pytest.approx(-13.0, abs=1.3)
    assert np.nanmax(np.abs(series["quantisation"][12:19])) < 0.5
    assert json.dumps(replay["satellites"]) and len(replay["figures"]) == 1


def test_factors_are_checked():
    with pytest.raises(ValueError, match="not known; allowed: jammer"):
        counterfactual.counterfactual("demo", ["weather"])
    with pytest.raises(ValueError, match="has no jammer"):
        counterfactual.counterfactual("demo", ["jammer"])


class Options:
    format = fs_hz = if_hz = duration_s = None
    conjugate, skip_s = False, 0.0


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    directory = tmp_path_factory.mktemp("recording")
    (directory / "t.toml").write_text(TEXT)
    clean = [
        "jammer=[]",
        "duration_s=1.0",
        'multipath={kind="Echoes",echoes=[{delay_s=0.0,power_db=-100.0}]}',
    ]
    jobs.simulate(str(directory / "t.toml"), directory / "clean", overrides=clean, quiet=True)
    return directory / "clean.sigmf-data"


def add(recording, tmp_path, text, **kw):
    (tmp_path / "i.toml").write_text('name = "i"\nduration_s = 1.0\n' + text)
    return inject.inject(recording, Options, str(tmp_path / "i.toml"), tmp_path / "out", quiet=True, **kw)


def samples(path):
    source = iffile.open_recording(path, iffile.declaration(path))
    iq = source.read(10**9)[1].astype(float)
    return iq[0] + 1j * iq[1]


def test_injected_power_is_exact(recording, tmp_path):
    """The ideal gain is 20 levels over the known rms; the tone, found by least squares beside the recording, is that times
    sqrt(2 J/N0 / fs) to z sigma / sqrt(n); the recording's own levels, rounded again, keep to 1e-3 of the gain."""
    text = '[[jammer]]\nkind = "CW"\nfreq_hz = 1.25e5\njn0_dbhz = 74.0\nphase_rad = 0.0\nstart_s = 0.5'
    result = add(recording, tmp_path, text)
    z, clean = samples(tmp_path / "out.sigmf-data"), samples(recording)
    fs = 2.5e6
    n = np.arange(len(z))
    on = n >= 1_250_000
    tone = np.exp(2j * np.pi * 1.25e5 * (n / fs - 0.5))
    scale, level = np.linalg.lstsq(np.stack([clean[on], tone[on]], axis=1), z[on], rcond=None)[0]
    amplitude = math.sqrt(2 * 10**7.4 / fs)
    gain = 20.0 / math.sqrt(1.0 + 0.5 * amplitude**2 / 2)
    assert level == pytest.approx(
        gain * amplitude, abs=Z * 0.5 / math.sqrt(on.sum()) + 2e-4 * gain * amplitude
    )
    assert scale == pytest.approx(gain / result["noise_rms_lsb"], rel=1.5e-3)
    assert result["noise_rms_lsb"] == pytest.approx(math.sqrt(np.mean(np.abs(clean) ** 2) / 2), rel=1e-6)
    row = result["jammers"][0]
    assert row["jn_db"] == pytest.approx(74.0 - 10 * math.log10(fs), abs=1e-9) and row["js_db"] is None
    (note,) = json.loads((tmp_path / "out.sigmf-meta").read_text())["annotations"]
    assert note["core:sample_start"] == 1_250_000


def test_js_against_a_satellite_has_an_interval(recording, tmp_path):
    """The true C/N0 is 47 dB-Hz: J/S of 20 dB lies in five of the sigmas that are reported (0.5 dB more: acquisition loses
    by its grid)."""
    result = add(recording, tmp_path, '[[jammer]]\nkind = "Wideband"\njs_db = 20.0\nagainst = "G06"')
    row = result["jammers"][0]
    low, high = row["js_db_95"]
    assert low < 20.0 < high
    assert row["jn0_dbhz"] == pytest.approx(67.0, abs=0.5 + Z * (high - low) / 3.92)


def test_injected_echo_is_the_recording_later(recording, tmp_path):
    text = '[multipath]\nkind = "Echoes"\nechoes = [{ delay_s = 1.2e-6, power_db = -6.0, phase_rad = 0.7 }]'
    add(recording, tmp_path, text)
    z, clean = samples(tmp_path / "out.sigmf-data"), samples(recording)
    delayed = np.concatenate([np.zeros(3), clean[:-3]])  # 1.2 us are three samples
    design = np.stack([clean, delayed], axis=1)
    a, b = np.linalg.lstsq(design, z, rcond=None)[0]
    # White noise in both columns: z sigma / sqrt(n) = 3e-3 with a rounding error of 1/20 sigma far below that
    assert b / a == pytest.approx(10 ** (-6 / 20) * np.exp(0.7j), abs=3e-3)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "nothing to inject"),
        ('[[jammer]]\nkind = "CW"\njs_db = 20\nagainst = "G31"', "not found"),
        ('[[jammer]]\nkind = "CW"\njn0_dbhz = 60\nfreq_hz = 1.3e6', "beyond the band"),
        (
            '[[jammer]]\nkind = "CW"\njn0_dbhz = 60\nline = { signal = "L1CA", prn = 6 }',
            "follow_doppler = false",
        ),
    ],
)
def test_refusals(recording, tmp_path, text, words):
    with pytest.raises(ValueError, match=words):
        add(recording, tmp_path, text)


def test_the_recording_is_not_overwritten(recording, tmp_path):
    (tmp_path / "i.toml").write_text('name = "i"\nduration_s = 1.0\n[[jammer]]\nkind = "CW"\njn0_dbhz = 60')
    with pytest.raises(ValueError, match="recording itself"):
        inject.inject(recording, Options, str(tmp_path / "i.toml"), recording, quiet=True)
    assert scenario.built_in()
