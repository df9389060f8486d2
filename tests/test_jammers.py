"""Jammers: exact powers, spectra, times and frequencies; any chunking gives the same bits; refusals."""

import json
import math

import numpy as np
import pytest

from sdr import iffile, scenario
from signals import jammer_kernels
from signals.clock import ClockSpec
from signals.constants import F_L1_HZ
from signals.frontend import FrontEndSpec
from signals.jammers import (
    CW,
    Chirp,
    Envelope,
    Interferer,
    MatchedSpectrum,
    Narrowband,
    Pulsed,
    Wideband,
    _Jammer,
    finer,
)
from signals.modulation import BLOCK, code_lines, code_table
from signals.multipath import Echo, Echoes
from signals.sky import ScriptedSpec, SkySpec
from signals.source import SyntheticSource, amplitude
from signals.trajectory import Static

Z = 5.0
FS_HZ = 4.0e6
JN0 = {"jn0_dbhz": 80.0}
KINDS = [
    CW(freq_hz=2e5, rate_hz_s=2.0, **JN0),
    CW(freq_hz=-2e5, rate_hz_s=1e6, **JN0),
    Chirp(sweep_hz=2e6, sweep_s=20.3e-6, **JN0),
    Chirp(sweep_hz=1e6, sweep_s=1e-3, shape="triangular", freq_hz=3e5, **JN0),
    Chirp(sweep_hz=1e6, sweep_s=50.3e-3, **JN0),
    Chirp(sweep_hz=1e6, sweep_s=77e-6, rate_hz_s=1e5, **JN0),
    Pulsed(rate_hz=1000.0, duty=0.1, freq_hz=1e5, **JN0),
    Pulsed(rate_hz=2700.0, shape="dme", random=True, **JN0),
    Pulsed(rate_hz=1000.0, duty=0.1, freq_hz=1e5, rate_hz_s=1e5, **JN0),
    Narrowband(bandwidth_hz=1e3, freq_hz=1e5, **JN0),
    Narrowband(bandwidth_hz=1e5, **JN0),
    Narrowband(bandwidth_hz=1e6, freq_hz=-5e5, **JN0),
    Narrowband(bandwidth_hz=3e6, **JN0),
    Wideband(**JN0),
    MatchedSpectrum(**JN0),
    MatchedSpectrum(waveform="BOC11", freq_hz=100.0, **JN0),
]


def make(spec, n, n0=0, duration_s=None, fs_hz=FS_HZ, **kw):
    run = spec.start(fs_hz, kw.pop("if_hz", 0.0), duration_s or (n0 + n) / fs_hz, 3, **kw)
    iq = np.zeros((2, n), np.float32)
    run.add(iq, n0)
    return run, iq[0].astype(float) + 1j * iq[1]


def static_sky(duration_s, **scripted):
    return SkySpec(source="none", scripted=(ScriptedSpec(**({"prn": 6} | scripted)),)).start(
        Static(lat_deg=47.0, lon_deg=15.0, height_m=400.0).start(),
        ClockSpec().start(3, duration_s),
        duration_s,
    )


@pytest.mark.parametrize("spec", KINDS, ids=lambda s: s.kind)
def test_same_bits_for_any_chunking(spec):
    run, whole = make(spec, 200_000, 3_950_001)
    for sizes in ([1, 1023, 1025, 7], [77_777]):
        out, at, k = np.zeros((2, 200_000), np.float32), 0, 0
        while at < out.shape[1]:
            part = np.zeros((2, min(sizes[k % len(sizes)], out.shape[1] - at)), np.float32)
            run.add(part, 3_950_001 + at)
            out[:, at : at + part.shape[1]] = part
            at, k = at + part.shape[1], k + 1
            if k == 300:
                break
        np.testing.assert_array_equal((out[0] + 1j * out[1].astype(float))[:at], whole[:at])


@pytest.mark.parametrize("spec", KINDS, ids=lambda s: s.kind)
def test_power_is_exact(spec):
    """Constant envelopes: to 1e-5. Noise of bandwidth B over T: 1 / sqrt(B T). Pulses: the edges, one sample of each."""
    n = 4_000_000
    run, z = make(spec, n)
    power = np.mean(np.abs(z) ** 2)
    assert run.amplitude == pytest.approx(float(amplitude(80.0, FS_HZ)), rel=1e-12)
    relative = {
        "Narrowband": Z / math.sqrt(max(min(spec.width_hz, FS_HZ), 1.0) * n / FS_HZ),
        "Wideband": Z / math.sqrt(n),
    }
    relative["Chirp"] = 1 / 32767  # int16 tables
    relative["Pulsed"] = 1.0 / (FS_HZ * 1e-4) if getattr(spec, "duty", None) else 1e-3
    assert power / (2 * run.rms**2) == pytest.approx(1.0, rel=relative.get(spec.kind, 1e-5))
    if spec.kind not in ("Pulsed", "Narrowband"):
        assert 2 * run.rms**2 == pytest.approx(run.amplitude**2, rel=1e-9)


def test_tone_has_its_phase():
    """phase = f t + rate t^2 / 2: 32-bit turns leave 8e-6 cycles, which is 5e-5 of the amplitude."""
    for rate in (0.0, 2.0, 1.4e4, 1e5, 2e7):
        spec = CW(freq_hz=123_456.7, rate_hz_s=rate, phase_rad=0.5, start_s=0.25, **JN0)
        run, z = make(spec, 100_000, 1_200_000)
        t = np.arange(1_200_000, 1_300_000) / FS_HZ - 0.25
        turns = 123_456.7 * t + 0.5 * rate * t * t + 0.5 / (2 * np.pi)
        np.testing.assert_allclose(z / run.amplitude, np.exp(2j * np.pi * turns), atol=6e-5)


@pytest.mark.parametrize("shape", ["sawtooth", "triangular"])
def test_chirp_has_its_frequency(shape):
    sweep_s, sweep_hz = 211e-6, 1.5e6
    _, z = make(Chirp(sweep_hz=sweep_hz, sweep_s=sweep_s, shape=shape, **JN0), 200_000)
    np.testing.assert_allclose(
        np.abs(z), np.abs(z[0]), rtol=math.sqrt(2) / 32767
    )  # both ends of int16 roundings
    freq = np.angle(z[1:] * np.conj(z[:-1])) / (2 * np.pi) * FS_HZ
    turn, x = np.divmod((np.arange(1, 200_000) - 0.5) / FS_HZ, sweep_s)
    wanted = (x / sweep_s - 0.5) * sweep_hz
    if shape == "triangular":
        wanted *= np.where(turn % 2, -1, 1)
    inside = (x > 1 / FS_HZ) & (x < sweep_s - 1 / FS_HZ)
    np.testing.assert_allclose(
        freq[inside], wanted[inside], atol=sweep_hz / sweep_s / FS_HZ
    )  # within a sample's step


@pytest.mark.parametrize("sweep_s", [20.3e-6, 211.1e-6, 5.001e-3, 50e-3])
@pytest.mark.parametrize("shape", ["sawtooth", "triangular"])
def test_chirp_against_its_textbook_form(sweep_s, shape):
    """Phase in double precision. Rows 1/P of a sample apart miss the time by 1/2P, which at the edges of the sweep
    is pi B / (2 P fs) = 4.6e-3 rad; where the sweep is longer than a block, 512 samples from where it is exact."""
    spec = Chirp(sweep_hz=3e6, sweep_s=sweep_s, shape=shape, freq_hz=2.5e5, phase_rad=0.0, **JN0)
    n0 = 1_234_567
    run, z = make(spec, 200_000, n0, duration_s=1.0)
    n, length = np.arange(n0, n0 + 200_000), sweep_s * FS_HZ
    turn, tau = np.divmod(n, length)
    sign = np.where(turn % 2 == 1, -1, 1) if shape == "triangular" else 1
    turns = 0.5 * sign * spec.sweep_hz / FS_HZ * tau * (tau / length - 1)
    wanted = np.exp(2j * np.pi * (np.mod(turns, 1) + np.mod(2.5e5 / FS_HZ * n, 1)))
    error = np.abs(z / run.amplitude - wanted)
    whole = np.abs(tau - length / 2) < length / 2 - 1024  # blocks without a turn
    bound = np.pi * spec.sweep_hz / FS_HZ / (2 * 256) + 6e-5
    assert np.max(error if length <= 1024 else error[whole]) < bound
    assert np.sqrt(np.mean(error**2)) < bound


@pytest.mark.parametrize(
    "spec",
    [
        Narrowband(bandwidth_hz=1e5, **JN0),
        MatchedSpectrum(**JN0),
        Pulsed(rate_hz=1e3, duty=0.3, **JN0),
        Chirp(sweep_hz=1e6, sweep_s=77e-6, **JN0),
    ],
)
def test_a_carrier_that_moves_fast_turns_the_same_envelope(spec):
    rate = 1e5
    still, moving = (
        make(spec.model_copy(update={"rate_hz_s": r, "phase_rad": 0.0}), 200_000, 800_000)[1]
        for r in (0, rate)
    )
    t = np.arange(800_000, 1_000_000) / FS_HZ
    turned = still * np.exp(1j * np.pi * rate * t * t)
    np.testing.assert_allclose(moving, turned, atol=2e-4 * np.max(np.abs(still)))


def test_pulses_have_their_times_and_shape():
    run, z = make(Pulsed(rate_hz=1000.0, duty=0.1, **JN0), 80_000)
    on = np.arange(80_000) % 4000 < 400
    np.testing.assert_allclose(np.abs(z), np.where(on, run.amplitude, 0.0), atol=1e-4 * run.amplitude)
    run, z = make(Pulsed(rate_hz=1000.0, shape="dme", **JN0), 80_000)
    w = 1 / math.sqrt(4.5e11)
    t = (np.arange(80_000) / FS_HZ) % 1e-3
    wanted = sum(np.exp(-(((t - 5 * w - d) / w) ** 2) / 2) for d in (0.0, 12e-6))
    np.testing.assert_allclose(np.abs(z) / run.amplitude, wanted, atol=5e-6)  # cut at 5 sigma: 4e-6
    half = np.flatnonzero(np.abs(z[:40]) > 0.5 * run.amplitude)
    assert (half[-1] - half[0] + 1) / FS_HZ == pytest.approx(3.5e-6, abs=1 / FS_HZ)


def spectrum(z, n):
    """Mean periodogram with a Hann window: frequencies and density, of unit integral for unit power."""
    window = np.hanning(n)
    frames = np.fft.fft(z[: len(z) // n * n].reshape(-1, n) * window, axis=1)
    return (
        np.fft.fftfreq(n, 1 / FS_HZ),
        np.mean(np.abs(frames) ** 2, axis=0) / (FS_HZ * np.sum(window**2)),
        len(frames),
    )


@pytest.mark.parametrize(("width_hz", "center_hz"), [(5e4, 3e5), (2e5, 0.0), (1e6, -4e5), (3e6, 0.0)])
def test_narrowband_is_flat_in_its_band(width_hz, center_hz):
    """Density |H(f)|^2 of the filter and its doublings, to z / sqrt(frames) per bin; it is flat to 2 % in the band and
    below -40 dB outside; times B it is the power at the centre, to 1 %; circular and Gaussian."""
    spec = Narrowband(bandwidth_hz=width_hz, freq_hz=center_hz, **JN0)
    run, z = make(spec, 4_000_000)
    z /= run.amplitude
    f, density, frames = spectrum(z, 2000)
    phases, step = spec.lattice(FS_HZ)
    h, steps = finer(spec.response(FS_HZ), step)
    off = f - center_hz
    turns = np.outer(off / FS_HZ, np.arange(len(h))) * (step / steps)
    theory = np.abs(np.exp(-2j * np.pi * turns) @ h) ** 2 / (phases * steps) * step / steps / FS_HZ
    edge = 0.2 * FS_HZ / (phases * step)
    inside, outside = np.abs(off) < width_hz / 2 - edge, np.abs(off) > width_hz / 2 + edge + 4000
    assert inside.sum() > 5
    near = inside & (np.abs(off) < width_hz / 2 - edge - 4000)
    np.testing.assert_allclose(density[near] / theory[near], 1.0, atol=Z / math.sqrt(frames))
    np.testing.assert_allclose(theory[inside] / theory[np.argmin(np.abs(off))], 1.0, atol=0.02)
    assert theory[np.argmin(np.abs(off))] * width_hz == pytest.approx(1.0, abs=0.01)
    if outside.any():
        assert np.max(density[outside]) * width_hz < 1e-4
    # E z^2 = 0; kurtosis of a circular Gaussian: E |z|^4 = 2 (E |z|^2)^2
    n_eff = width_hz * len(z) / FS_HZ
    assert abs(np.mean(z**2)) < Z * math.sqrt(2 / n_eff)
    assert np.mean(np.abs(z) ** 4) / np.mean(np.abs(z) ** 2) ** 2 == pytest.approx(
        2.0, abs=Z * math.sqrt(20 / n_eff)
    )


def test_lattice_of_the_noise_is_white_and_gaussian():
    """Blocks draw on the same table, and still no two of them agree at any shift: |correlation|^2 of n points is exponential
    of mean 1 / n. Power over m points: sqrt(1 / m); distribution: Kolmogorov and Smirnov's 1.95 at p = 1e-3."""
    from scipy.stats import kstest

    points = np.empty((2, 64 * BLOCK), np.float32)
    for k in range(64):
        part = np.empty((2, BLOCK), np.float32)
        assert (
            jammer_kernels._lattice(
                part[0], part[1], k * BLOCK, BLOCK, jammer_kernels.normals(), np.uint64(5)
            )
            == 0
        )
        points[:, k * BLOCK : (k + 1) * BLOCK] = part
    assert np.mean(points.astype(float) ** 2) == pytest.approx(0.5, rel=Z * math.sqrt(1 / points.size))
    for one in points:
        assert kstest(one * math.sqrt(2), "norm").statistic * math.sqrt(len(one)) < 1.95
    blocks = np.fft.fft((points[0] + 1j * points[1]).reshape(64, BLOCK), 2 * BLOCK)
    for shift in range(1, 64):
        agreement = np.abs(np.fft.ifft(blocks * np.conj(np.roll(blocks, shift, 0)))) ** 2 / BLOCK
        assert agreement.max() < math.log(63 * agreement.size / 1e-6)


def test_matched_spectrum_is_sinc_squared_and_correlates_with_no_code():
    run, z = make(MatchedSpectrum(**JN0), 4_000_000)
    z /= run.amplitude
    f, density, _ = spectrum(z, 1000)
    alias = sum(np.sinc((f + k * FS_HZ) / 1.023e6) ** 2 for k in range(-40, 41))
    near = np.abs(f) < 0.8e6
    # The code repeats after 40 ms, but for its sign: 160 different frames.
    np.testing.assert_allclose(density[near] * 1.023e6 / alias[near], 1.0, atol=Z / math.sqrt(160) + 0.02)
    code = np.resize(code_table("L1CA", 6, FS_HZ).table[0, :4000].astype(float), len(z))
    # A code-like jammer leaves a variance of about fs / chip rate per sample, never the coherent 1.
    assert abs(np.mean(z * code)) < Z * math.sqrt(FS_HZ / 1.023e6 / len(z))


def test_power_definitions_agree():
    sky = static_sky(1.0, cn0_dbhz=41.0)
    specs = (
        CW(js_db=20.0, against="G06"), CW(jn0_dbhz=61.0), CW(power_dbw=-142.0),
        CW(power_dbw=-143.0, n0_dbw_hz=-204.0),
    )  # fmt: skip
    amplitudes = [s.start(FS_HZ, 0.0, 1.0, 1, sky).amplitude for s in specs]
    np.testing.assert_allclose(amplitudes, amplitudes[0], rtol=1e-12)


def test_times_and_profile():
    spec = CW(start_s=0.01, stop_s=0.03, profile=((0.01, -10.0), (0.03, 10.0)), **JN0)
    run, z = make(spec, 200_000, duration_s=0.05)
    on = np.abs(z) > 0
    assert np.flatnonzero(on)[0] == 40_000 and np.flatnonzero(on)[-1] == 119_999
    t = np.arange(40_000, 120_000) / FS_HZ
    db = 20 * np.log10(np.abs(z[on]) / run.amplitude)
    # The amplitude holds for 256 samples and is right in their middle: half of that at 1000 dB/s.
    np.testing.assert_allclose(
        db[256:-256], (-10 + 1000 * (t - 0.01))[256:-256], atol=1000 * 128 / FS_HZ + 1e-5
    )
    # rms over the run: mean of 10^x, x from -1 to 1, over two fifths of the time
    mean = (10 - 0.1) / (2 * math.log(10)) * 0.4
    assert 2 * run.rms**2 / run.amplitude**2 == pytest.approx(mean, rel=1e-5)
    rows = run.truth([0, 40_000, 80_000, 120_000], 2)
    assert rows["on"].tolist() == [False, True, True, False] and rows["jammer"].tolist() == [2] * 4
    np.testing.assert_allclose(rows["jn0_dbhz"], [-np.inf, 70.0, 80.0, -np.inf])


@pytest.mark.parametrize(("signal", "prn", "fs_hz"), [("L1CA", 6, 4.0e6), ("L1CA", 10, 5.0037e6)])
def test_line_of_the_received_code_meets_the_correlator(signal, prn, fs_hz):
    """CW on the worst line of a moving satellite: the prompt over 20 ms is sqrt(J/S) |c_k| whatever the Doppler, with
    c_k of the *sampled* replica (aliases of the chip): DFT of the replica at that frequency; -21.3 dB within 6 %."""
    js_db, duration_s = 10.0, 0.2
    sky = static_sky(duration_s, prn=prn, cn0_dbhz=45.0, doppler_hz=2345.6, doppler_rate_hz_s=-0.7)
    line = {"signal": signal, "prn": prn}
    run = CW(js_db=js_db, against=f"G{prn:02d}", line=line).start(fs_hz, 0.0, duration_s, 3, sky)
    n0, n = round(0.1 * fs_hz), round(0.02 * fs_hz)
    iq = np.zeros((2, n), np.float32)
    run.add(iq, n0)
    from signals.source import truth

    rows = truth(sky, [n0, n0 + n], fs_hz)
    index = np.arange(n)
    chips = rows["code_phase_chips"][0] + index * (
        1.023e6 * (1 + rows["doppler_hz"].mean() / F_L1_HZ) / fs_hz
    )
    table = code_table(signal, prn, 20 * 1.023e6, 1)
    replica = table.scale * table.table[0, np.floor(chips % 1023 * 20).astype(int)]
    phase = rows["carrier_phase_cycles"][0] + index / n * np.diff(rows["carrier_phase_cycles"])[0]
    z = np.mean((iq[0] + 1j * iq[1]) * np.exp(-2j * np.pi * phase) * replica)
    seen = abs(z) / float(amplitude(45.0, fs_hz))
    freq_hz, level_db = code_lines(signal, prn, "BPSK", max_hz=2e6)
    best = int(np.argmax(level_db))
    assert run.line_hz == freq_hz[best]
    assert seen == pytest.approx(10 ** ((js_db + level_db[best]) / 20), rel=0.06)
    exact = abs(np.mean(np.exp(2j * np.pi * freq_hz[best] / 1.023e6 * chips) * replica))
    assert seen == pytest.approx(10 ** (js_db / 20) * exact, rel=1e-3)
    # The samples turn at the frequency of the truth: a line that ignored the code's Doppler would be 0.35 Hz off.
    turns = np.unwrap(np.angle(iq[0] + 1j * iq[1].astype(float))) / (2 * np.pi)
    assert (turns[-1] - turns[0]) / (n - 1) * fs_hz == pytest.approx(run.freq_hz(0.11)[0], abs=0.01)
    assert run.freq_hz(0.1)[0] == pytest.approx(freq_hz[best] * (1 + 2345.53 / F_L1_HZ) + 2345.53, abs=0.01)


def test_js_is_realised_in_samples():
    """Same noise with and without: the difference has J/S times the satellite's power, within float32 sums."""
    sky = static_sky(0.1, cn0_dbhz=45.0)
    spec = FrontEndSpec(fs_hz=FS_HZ, bits=32)
    jammer = Chirp(js_db=30.0, against="G06", sweep_hz=1e6, sweep_s=1e-4)
    runs = [jammer.start(FS_HZ, 0.0, 0.1, 3, sky)]
    clean, both = (SyntheticSource(sky, spec, 0.1, 1, j).read(400_000)[1].astype(float) for j in ((), runs))
    silent = SyntheticSource(sky, spec, 0.1, 1, noise=False).read(400_000)[1].astype(float)
    js = np.sum((both - clean) ** 2) / np.sum(silent**2)
    assert 10 * math.log10(js) == pytest.approx(30.0, abs=1e-3)


def test_echo_in_the_samples_is_the_direct_signal_later():
    """y(t) = s(t) + g s(t - tau) e^{2 pi i f t}: against a second satellite's worth of synthesis at the later delay.
    Table rows are 1/256 sample apart: transitions differ there; carrier to 1e-4."""
    tau, f, g_db = 0.6e-6, 7.0, -6.0
    sky, late = static_sky(0.1, doppler_hz=500.0), static_sky(0.1, doppler_hz=500.0, delay_s=0.075 + tau)
    spec = FrontEndSpec(fs_hz=FS_HZ, bits=32)
    echoes = Echoes(echoes=(Echo(delay_s=tau, power_db=g_db, doppler_hz=f, phase_rad=0.3),)).start(1)
    direct, both, other = (
        SyntheticSource(s, spec, 0.1, 1, noise=False, echoes=e).read(400_000)[1].astype(float)
        for s, e in ((sky, None), (sky, {"G06": echoes}), (late, None))
    )
    echo = (both - direct)[0] + 1j * (both - direct)[1]
    # The late satellite's carrier has turned by F_L1 tau more, which the echo's own phase stands for.
    turn = np.exp(2j * np.pi * (F_L1_HZ * tau + f * np.arange(400_000) / FS_HZ) + 0.3j)
    wanted = 10 ** (g_db / 20) * (other[0] + 1j * other[1]) * turn
    np.testing.assert_allclose(abs(np.vdot(wanted, echo)) / np.vdot(wanted, wanted).real, 1.0, atol=5e-3)
    assert np.angle(np.vdot(wanted, echo)) == pytest.approx(0.0, abs=5e-3)


def test_interferer_file(tmp_path):
    rng = np.random.default_rng(1)
    z = np.round(20 * rng.standard_normal((2, 30_000))).astype(np.int8)
    for name, fs in (("same", FS_HZ), ("other", 5e6)):
        with iffile.RecordingWriter(tmp_path / name, "ci8", fs) as writer:
            writer.write(z)
    spec = Interferer(path=str(tmp_path / "same.sigmf-data"), phase_rad=0.0, **JN0)
    run, out = make(spec, 70_000, open_recording=scenario._interferer)
    whole = np.tile(z[0] + 1j * z[1].astype(float), 3)[:70_000]
    scale = run.amplitude / math.sqrt(np.mean(np.abs(whole[:30_000]) ** 2))
    np.testing.assert_allclose(out, scale * whole, atol=1e-4 * run.amplitude)
    part = np.zeros((2, 500), np.float32)
    run.add(part, 29_800)
    np.testing.assert_array_equal(part[0] + 1j * part[1].astype(float), out[29_800:30_300])
    with pytest.raises(ValueError, match="same rate"):
        make(
            Interferer(path=str(tmp_path / "other.sigmf-data"), **JN0),
            10,
            open_recording=scenario._interferer,
        )


def test_annotations_go_into_the_recording(tmp_path):
    text = """
        name = "t"
        duration_s = 0.05
        [sky]
        source = "none"
        scripted = [{ prn = 6 }]
        [front_end]
        fs_hz = 4e6
        [[jammer]]
        kind = "Narrowband"
        bandwidth_hz = 1e5
        freq_hz = 2e5
        jn0_dbhz = 70
        start_s = 0.01
        stop_s = 0.02
        [[jammer]]
        kind = "CW"
        js_db = 20
        against = "G06"
    """
    spec = scenario.parse(text)
    source = scenario.source(spec)
    with iffile.create_recording(tmp_path / "x", source, spec) as writer:
        writer.write(source.read(10**9)[1])
    cw, narrow = json.loads((tmp_path / "x.sigmf-meta").read_text())["annotations"]
    assert (narrow["core:sample_start"], narrow["core:sample_count"]) == (40_000, 40_000)
    assert (
        narrow["core:freq_lower_edge"] == F_L1_HZ + 1.5e5
        and narrow["core:freq_upper_edge"] == F_L1_HZ + 2.5e5
    )
    assert cw["core:label"] == "CW" and cw["core:freq_lower_edge"] == F_L1_HZ
    rows = source.jammer_truth([0, 50_000])
    assert rows["kind"].tolist() == [b"Narrowband", b"CW"] * 2 and rows["on"].tolist() == [
        False,
        True,
        True,
        True,
    ]


BASE = 'name = "t"\nduration_s = 1.0\n[sky]\nsource = "none"\nscripted = [{ prn = 6 }]\n[front_end]\nfs_hz = 4e6\n'


@pytest.mark.parametrize(
    ("jammer", "words"),
    [
        ('kind = "CW"', "one of js_db"),
        ('kind = "CW"\njn0_dbhz = 60\npower_dbw = -150', "one of js_db"),
        ('kind = "CW"\njn0_dbhz = 900', "less than or equal to 160"),
        ('kind = "CW"\njs_db = 20', "belong together"),
        ('kind = "CW"\njs_db = 20\nagainst = "G07"', "G07 is not in the sky; there are G06"),
        ('kind = "CW"\njn0_dbhz = 60\nfreq_hz = 2.1e6', "beyond the band"),
        ('kind = "CW"\njn0_dbhz = 60\nfreq_hz = 1.9e6\nrate_hz_s = 2e5', "beyond the band"),
        ('kind = "Narrowband"\njn0_dbhz = 60\nbandwidth_hz = 5e6', "beyond the band"),
        ('kind = "Chirp"\njn0_dbhz = 60\nsweep_hz = 3e6\nsweep_s = 1e-4\nfreq_hz = 1e6', "beyond the band"),
        ('kind = "CW"\njn0_dbhz = 60\nline = { signal = "L1CA", prn = 6, line = 99999 }', "does not exist"),
        ('kind = "CW"\njn0_dbhz = 60\nline = { signal = "L1CA", prn = 7 }', "follow_doppler = false"),
        ('kind = "CW"\njn0_dbhz = 60\nstart_s = 3\nstop_s = 2', "later than"),
        ('kind = "CW"\njn0_dbhz = 60\nprofile = [[1, 0], [1, 3]]', "growing"),
        ('kind = "Pulsed"\njn0_dbhz = 60\nrate_hz = 100', "duty"),
        ('kind = "Pulsed"\njn0_dbhz = 60\nrate_hz = 9e4\nshape = "dme"', "lower it"),
        ('kind = "Interferer"\njn0_dbhz = 60\npath = "nowhere"', "does not exist"),
    ],
)
def test_bad_jammers_are_refused_in_a_sentence(jammer, words):
    with pytest.raises(ValueError, match=words) as err:
        scenario.source(scenario.parse(f"{BASE}[[jammer]]\n{jammer}\n"))
    assert "\n" not in str(err.value) and "jammer" in str(err.value)


def test_bad_multipath_is_refused():
    for text, words in (
        ('kind = "Echoes"\nechoes = [{ delay_s = -1e-7, power_db = -3 }]', "greater than or equal to 0"),
        ('kind = "Aeronautical"\nsatellites = ["G09"]', "G09 is not in the sky"),
    ):
        with pytest.raises(ValueError, match=words):
            scenario.source(scenario.parse(f"{BASE}[multipath]\n{text}\n"))


def test_a_new_jammer_is_one_class():
    """An envelope of the absolute sample index; carrier, power, times and profile come with it."""

    class Ringing(_Jammer):
        kind: str = "Ringing"

        def envelope(self, fs_hz, seed, context):
            def samples(n0, n):
                x = np.sqrt(2) * np.cos(2 * np.pi * 1e4 / fs_hz * np.arange(n0, n0 + n))
                return np.stack([x, 0 * x]).astype(np.float32)

            return Envelope(samples=samples)

    run, z = make(Ringing(freq_hz=1e5, phase_rad=0.0, start_s=0.001, **JN0), 100_000)
    t = np.arange(100_000) / FS_HZ
    wanted = np.sqrt(2) * np.cos(2 * np.pi * 1e4 * t) * np.exp(2j * np.pi * 1e5 * (t - 0.001)) * (t >= 0.001)
    np.testing.assert_allclose(z / run.amplitude, wanted, atol=2e-4)
    assert run.rms == pytest.approx(run.amplitude * math.sqrt(0.5 * 0.96), rel=1e-9)
    spec = FrontEndSpec(fs_hz=FS_HZ, bits=32)
    sky = static_sky(0.02)
    clean, both = (SyntheticSource(sky, spec, 0.02, 1, j).read(80_000)[1] for j in ((), [run]))
    np.testing.assert_allclose((both - clean)[0], z.real[:80_000], atol=1e-4 * run.amplitude + 1e-5)
