"""Counterfactual replay and injection: differences add up, the same noise, exact J/N, truth and refusals."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from sdr import counterfactual, iffile, inject, inject_figure, jobs, scenario, store, toml

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
def recordings(tmp_path_factory):
    """One second without interference in 8 bits, in 2 bits packed, and with other noise."""
    directory = tmp_path_factory.mktemp("recording")
    (directory / "t.toml").write_text(TEXT)
    clean = [
        "jammer=[]",
        "duration_s=1.0",
        'multipath={kind="Echoes",echoes=[{delay_s=0.0,power_db=-100.0}]}',
    ]
    for bits in (8, 2):
        over = [*clean, f"front_end.bits={bits}"]
        jobs.simulate(str(directory / "t.toml"), directory / f"clean{bits}", overrides=over, quiet=True)
    jobs.simulate(str(directory / "t.toml"), directory / "other", overrides=[*clean, "seed=4"], quiet=True)
    return {
        8: directory / "clean8.sigmf-data",
        2: directory / "clean2.bin",
        "other": directory / "other.sigmf-data",
    }


@pytest.fixture(scope="module")
def recording(recordings):
    return recordings[8]


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


@pytest.mark.parametrize("bits", [8, 2])
def test_an_injection_is_drawn(recordings, tmp_path, bits):
    """The correlation of 40 periods at 47 dB-Hz stands sqrt(1 + C/N0 1 ms) over its noise where the acquisition says, half a
    sample away costs a fifth of it; J/N of 30 dB in the middle of the code's spectrum takes it below a half."""
    text = '[[jammer]]\nkind = "Narrowband"\nbandwidth_hz = 1e6\njs_db = 47.0\nagainst = "G06"\nstart_s = 0.2'
    recording = recordings[bits]
    result = add(recording, tmp_path, text, plots=True)
    assert result["figures"] == [str(tmp_path / "out" / "injection.png")]
    assert (tmp_path / "out" / "injection.png").stat().st_size > 10_000
    sources = [iffile.open_recording(p, iffile.declaration(p)) for p in (recording, Path(result["files"][0]))]
    row = inject_figure._satellite(sources[0], 1_000_000, ["G06"])
    (lags, before), (_, after) = (inject_figure._correlation(s, row, 1_000_000) for s in sources)
    peak = math.sqrt(1.0 + 10**4.7 * 1e-3)
    assert abs(lags[np.argmax(before)]) < 1.023 / 2.5
    assert 0.7 * peak < before.max() < 1.1 * peak and after.max() < 0.5 * before.max()


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


def test_injected_echo_has_its_doppler(recording, tmp_path):
    """Gains go in lines between nodes 1 ms apart; 400 Hz would lose half of itself there. Truth: rows of satellite 0."""
    doppler_hz = 400.0
    text = (
        '[multipath]\nkind = "Echoes"\n'
        f"echoes = [{{ delay_s = 0.8e-6, power_db = -6.0, phase_rad = 0.7, doppler_hz = {doppler_hz} }}]"
    )
    add(recording, tmp_path, text)
    z, clean = samples(tmp_path / "out.sigmf-data"), samples(recording)
    spin = np.exp(2j * np.pi * doppler_hz * np.arange(len(z)) / 2.5e6)
    delayed = np.concatenate([np.zeros(2), clean[:-2]]) * spin
    a, b = np.linalg.lstsq(np.stack([clean, delayed], axis=1), z, rcond=None)[0]
    assert b / a == pytest.approx(10 ** (-6 / 20) * np.exp(0.7j), abs=3e-3)
    # The ideal gain knows the echo's power.
    assert np.std(z.real) == pytest.approx(20.0, rel=Z / math.sqrt(2 * len(z)) + 2e-3)
    with store.read(tmp_path / "out.truth.h5") as h5:
        rows = h5["truth/echoes"][:]
    assert len(rows) == 10 and not rows["prn"].any()
    np.testing.assert_allclose(rows["power_db"], -6.0, atol=1e-4)
    turns = (rows["phase_rad"] - 0.7) / (2 * np.pi) - doppler_hz * rows["t_s"]
    np.testing.assert_allclose(turns, np.rint(turns), atol=1e-4)


KINDS = [
    'kind = "CW"\nfreq_hz = 1.5e5',
    'kind = "Chirp"\nsweep_hz = 1e6\nsweep_s = 50e-6',
    'kind = "Pulsed"\nrate_hz = 1000\nduty = 0.25\nfreq_hz = 1e5',
    'kind = "Pulsed"\nrate_hz = 2700\nshape = "dme"',
    'kind = "Narrowband"\nbandwidth_hz = 1e5',
    'kind = "Wideband"',
    'kind = "MatchedSpectrum"',
    'kind = "Interferer"\nfreq_hz = 3e5\npath = "{path}"',
]


@pytest.mark.parametrize("bits", [8, 2])
@pytest.mark.parametrize("kind", KINDS, ids=lambda text: text.split('"')[1])
def test_every_kind_is_injected_at_its_power(recordings, tmp_path, kind, bits):
    """J/N of 3 dB. What the quantiser sees is u + j: Gaussian noise u of unit variance, j of another realisation of the same
    kind. The mean square (8 bits) and the share of outer levels (2 bits: half a decibel of J moves it by 0.02) of both agree
    to the fluctuation of a noise of B T = 1e5 degrees of freedom, or of as many as there are samples."""
    fs_hz, jn0_dbhz = 2.5e6, 3.0 + 10 * math.log10(2.5e6)
    table = kind.format(path=recordings["other"]) + f"\njn0_dbhz = {jn0_dbhz}\nphase_rad = 0.3"
    result = add(recordings[bits], tmp_path, "[[jammer]]\n" + table)
    assert result["jammers"][0]["jn_db"] == pytest.approx(3.0, abs=1e-9)
    z = samples(tmp_path / ("out.sigmf-data" if bits == 8 else "out.bin"))
    clean = samples(recordings[bits])
    assert len(z) == len(clean) and result["noise_rms_lsb"] == pytest.approx(
        np.sqrt(np.mean(clean.real**2)), rel=0.01
    )
    spec = scenario.parse(f'name = "j"\nduration_s = 1.0\nseed = 9\n[[jammer]]\n{table}')
    iq = np.zeros((2, len(z)), np.float32)
    (run,) = scenario.jammers(spec, fs_hz, 0.0, True, None)
    run.add(iq, 0)
    # The mean power of the two parts is 1 + 10^0.3; its square root is where the ideal gain is set.
    mean = 1.0 + np.mean(np.abs(iq[0] + 1j * iq[1]) ** 2) / 2 if "Pulsed" in kind else 1.0 + 10**0.3
    assert run.rms**2 == pytest.approx(mean - 1.0, rel=0.02)
    level = (20.0 if bits == 8 else 1 / 0.9957) / math.sqrt(1.0 + run.rms**2)
    u = level * (np.random.default_rng(1).standard_normal(iq.shape) + iq)
    fluctuation = Z * 2 / math.sqrt(1e5 if "Narrowband" in kind else len(z))
    if bits == 8:
        seen, wanted = np.mean(np.abs(z) ** 2), 2 * np.mean(np.clip(u, -127, 127) ** 2)
        assert seen == pytest.approx(wanted, rel=fluctuation + 1e-3)
    else:
        assert set(np.unique(z.real)) == {-3.0, -1.0, 1.0, 3.0}
        seen, wanted = np.mean(np.abs(z.real) > 2), np.mean(np.abs(u[0]) >= 1)
        assert seen == pytest.approx(wanted, abs=0.5 * fluctuation + 1e-3)
    with store.read(tmp_path / "out.truth.h5") as h5:
        np.testing.assert_allclose(h5["truth/jammers"]["jn0_dbhz"], jn0_dbhz, atol=1e-4)
    if bits == 8:
        (note,) = json.loads((tmp_path / "out.sigmf-meta").read_text())["annotations"]
        assert note["core:sample_start"] == 0


def test_a_tone_below_the_steps_of_two_bits_arrives(recordings, tmp_path):
    """J/N -20 dB: 0.14 of the noise, where the nearest threshold of 2 bits is 0.45 away from every level. Gaussian noise
    carries it with the slope of the quantiser, sum of its jumps 2 phi(t) at t = 0 and +-0.9957, times J's amplitude."""
    fs_hz = 2.5e6
    text = '[[jammer]]\nkind = "CW"\nfreq_hz = 1.25e5\nphase_rad = 0.0\njn0_dbhz = '
    add(recordings[2], tmp_path, text + f"{-20 + 10 * math.log10(fs_hz)}")
    z = samples(tmp_path / "out.bin")
    level = np.mean(z * np.exp(-2j * np.pi * 1.25e5 * np.arange(len(z)) / fs_hz))
    slope = 2 * (1 + 2 * math.exp(-(0.9957**2) / 2)) / math.sqrt(2 * math.pi)
    # the small tone is linear to 1 %; noise of variance 3.5 per component
    assert abs(level - slope * math.sqrt(0.02)) < Z * math.sqrt(3.5 / len(z)) + 0.01 * slope * math.sqrt(0.02)


@pytest.mark.parametrize(("bits", "loss_db"), [(8, 0.0), (2, 2 * 0.55)])
def test_an_injected_recording_is_received(recordings, tmp_path, bits, loss_db):
    """White noise of J/N 3 dB: C/N0 falls by 10 lg(1 + 10^0.3) = 4.8 dB, and by what 2 bits lose twice; tracking's mean over
    0.8 s is good to 0.5 dB."""
    text = f'[[jammer]]\nkind = "Wideband"\njn0_dbhz = {3.0 + 10 * math.log10(2.5e6)}'
    add(recordings[bits], tmp_path, text)
    found = jobs.receive(
        tmp_path / ("out.sigmf-data" if bits == 8 else "out.bin"), Options, output=tmp_path / "r.h5", overrides=['receiver.acquisition.systems=["G"]'],
        quiet=True,
    )["satellites"]  # fmt: skip
    (satellite,) = [s for s in found if s["prn"] == 6]
    assert satellite["cn0_dbhz"] == pytest.approx(47.0 - 4.77 - loss_db, abs=0.8)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "nothing to inject"),
        ('[[jammer]]\nkind = "CW"\njn0_dbhz = 60\nstart_s = 1.0', "is not before the end at 1 s"),
        (
            '[multipath]\nkind = "Echoes"\nsatellites = ["G06"]\nechoes = [{ delay_s = 1e-7, power_db = -6.0 }]',
            "satellites are not apart",
        ),
        (
            '[multipath]\nkind = "Echoes"\nechoes = [{ delay_s = 1e-7, delay_rate_s_s = -5e-7, power_db = -6.0 }]',
            "before the direct path after 0.2 s",
        ),
        (
            '[multipath]\nkind = "Echoes"\nechoes = [{ delay_s = 1e-7, bandwidth_hz = 900.0, power_db = -6.0 }]',
            "lower its bandwidth",
        ),
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
    assert toml.built_in("scenario")
