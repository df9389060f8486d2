"""Front end: every stage against its definition, the same bits for any chunks, quantiser losses and capture."""

import itertools
import math

import numpy as np
import pytest
from scipy.special import erf, ndtr

from signals.clock import ClockSpec
from signals.frontend import OPTIMAL_STEP, FrontEndSpec
from signals.modulation import BLOCK
from signals.sky import ScriptedSpec, SkySpec
from signals.source import SyntheticSource
from signals.trajectory import Static

Z = 5.0
FS_HZ = 4.0e6


def noise(n, seed=1):
    return np.random.default_rng(seed).standard_normal((2, n)).astype(np.float32)


def run(iq, cuts=(), rms=1.0, **spec):
    """All samples through a front end, in pieces."""
    front_end = FrontEndSpec(fs_hz=FS_HZ, **spec).start(rms, seed=5)
    edges = [0, *cuts, iq.shape[1]]
    parts = [front_end.push(iq[:, a:b].copy(), last=b == iq.shape[1]) for a, b in itertools.pairwise(edges)]
    return np.concatenate(parts, axis=1)


ALL = {
    "filter": {"bandwidth_hz": 2.2e6, "ripple_db": 1.0, "group_delay_ripple_s": 5e-8},
    "agc": {"time_constant_s": 1e-3},
    "impairments": {
        "lo_offset_hz": 120.0, "phase_noise_rad": 0.2, "iq_gain_db": 0.5, "iq_phase_deg": 3.0, "dc": (0.1, -0.2),
        "spurs": [{"freq_hz": 3e5, "power_db": -10.0}],
    },
}  # fmt: skip


def test_any_chunking_gives_the_same_bits():
    iq = noise(50_000)
    whole = run(iq, bits=8, **ALL)
    assert whole.shape == iq.shape
    for cuts in ([1, 2, 40], [1024, 20_000], [777, 33_333, 49_999]):
        np.testing.assert_array_equal(run(iq, cuts, bits=8, **ALL), whole)


def test_a_source_with_every_stage_does_not_depend_on_threads_or_chunks():
    sky = SkySpec(source="none", scripted=(ScriptedSpec(prn=1),)).start(
        Static(lat_deg=47.0, lon_deg=15.0, height_m=400.0).start(), ClockSpec().start(3, 0.1), 0.1
    )
    spec = FrontEndSpec(fs_hz=2.6e6, bits=2, **ALL)
    whole = SyntheticSource(sky, spec, 0.1, 7).read(10**9)[1]
    assert whole.shape == (2, 260_000)
    other = SyntheticSource(sky, spec, 0.1, 7, threads=2)
    parts = [other.read(33_331)[1] for _ in range(8)]
    other.close()
    np.testing.assert_array_equal(np.concatenate(parts, axis=1), whole)


@pytest.mark.parametrize("if_hz", [0.0, 0.4e6])
def test_filter_has_its_response(if_hz):
    """Tones: amplitude 10^(r/20 cos u) and delay g cos u; window method leaves 1 % at 257 taps inside 90 % of B."""
    b, ripple_db, g_s = 2.4e6, 0.5, 4e-8
    spec = FrontEndSpec(
        fs_hz=FS_HZ, if_hz=if_hz, bits=32,
        filter={"bandwidth_hz": b, "taps": 257, "ripple_db": ripple_db, "group_delay_ripple_s": g_s, "ripples": 1.0},
    )  # fmt: skip
    h = spec.filter.design(FS_HZ, if_hz)
    n = np.arange(20_000)
    for f in (-0.4 * b, -0.1 * b, 0.0, 0.3 * b, 0.7 * b):
        x = np.exp(2j * np.pi * (f + if_hz) / FS_HZ * n)
        out = spec.start(1.0).push(np.array([x.real, x.imag], np.float32), last=True).astype(float)
        y = (out[0] + 1j * out[1])[300:-300] / x[300:-300]
        u = 2 * np.pi * f / b
        if abs(f) > b / 2:
            assert np.abs(y).max() < 2e-3
            continue
        wanted = 10 ** (ripple_db / 20 * math.cos(u)) * np.exp(-1j * g_s * b * math.sin(u))
        np.testing.assert_allclose(y, wanted, atol=0.01)
        assert np.std(y) < 1e-5  # float32
    kept = FrontEndSpec(
        fs_hz=FS_HZ, if_hz=if_hz, bits=32, filter=spec.filter.model_copy(update={"delay": "kept"})
    )
    pulse = np.zeros((2, 600), np.float32)
    pulse[0, 100] = 1.0
    out = kept.start(1.0).push(pulse, last=True)
    np.testing.assert_allclose(out[0, 100:357] + 1j * out[1, 100:357], h, atol=1e-7)


def test_gain_loop_has_its_time_constant():
    """A step of 20 dB: ln gain falls by 1 - 1/e in one time constant; the power of a block of BLOCK complex samples is
    known to 1 / sqrt(BLOCK), its logarithm moves the gain by half of that, averaged over tau / block."""
    tau_s = 5e-3
    n = int(12 * tau_s * FS_HZ) // BLOCK * BLOCK
    iq = noise(n)
    step = n // 3 // BLOCK * BLOCK
    iq[:, step:] *= 10.0
    front_end = FrontEndSpec(fs_hz=FS_HZ, bits=16, agc={"time_constant_s": tau_s}).start(1.0)
    gains = []
    for at in range(0, n, BLOCK):
        front_end.push(iq[:, at : at + BLOCK].copy())
        gains.append(front_end.agc_gain_db)
    gains = np.array(gains)
    # One block later: a gain is what the block before it asked for.
    at = step // BLOCK + np.array([1, 2, 4]) * tau_s * FS_HZ / BLOCK - 1
    seen = np.interp(at, np.arange(len(gains)), gains)
    sigma_db = 8.686 * 0.5 / math.sqrt(BLOCK) * math.sqrt(BLOCK / FS_HZ / (2 * tau_s))
    np.testing.assert_allclose(seen, -20 * (1 - np.exp(-np.array([1.0, 2.0, 4.0]))), atol=Z * sigma_db + 1e-3)


def test_ideal_gain_allows_for_the_filter():
    out = run(noise(200_000), bits=8, filter={"bandwidth_hz": 1.0e6})
    # sum |h|^2 = B / fs makes n_eff = n / 4
    assert np.std(out[:, 1000:-1000].astype(float)) == pytest.approx(
        20.0, rel=Z / math.sqrt(2 * 200_000 / 4) + 1e-3
    )


def test_impairments():
    n = 400_000
    iq = noise(n)
    out = run(iq, bits=32, impairments={"iq_gain_db": 1.0, "iq_phase_deg": 5.0, "dc": (0.3, -0.1)}).astype(
        float
    )
    g, p = 10 ** (1 / 20), math.radians(5)
    np.testing.assert_allclose(out[0], iq[0] + 0.3, atol=1e-6)
    np.testing.assert_allclose(out[1], g * (iq[1] * math.cos(p) + iq[0] * math.sin(p)) - 0.1, atol=1e-5)
    tone = run(
        np.zeros((2, n), np.float32), bits=32, impairments={"spurs": [{"freq_hz": 1e5, "power_db": 6.0}]}
    )
    z = (tone[0] + 1j * tone[1]) * np.exp(-2j * np.pi * 1e5 / FS_HZ * np.arange(n))
    assert np.std(z) < 1e-4 and abs(np.mean(z)) ** 2 / 2 == pytest.approx(10**0.6, rel=1e-4)
    moved = run(
        np.stack([np.ones(n), np.zeros(n)]).astype(np.float32), bits=32, impairments={"lo_offset_hz": 250.0}
    )
    np.testing.assert_allclose(
        moved[0] + 1j * moved[1], np.exp(-2j * np.pi * 250.0 / FS_HZ * np.arange(n)), atol=1e-6
    )


def test_the_oscillator_turns_every_sample_by_its_phase():
    """Both components turn alike: a product of two float32 rotations errs by some units of 2^-24 each."""
    n, cuts = 30_000, [1, 65, 1023, 1024, 5000, 17_001]
    impairments = {"lo_offset_hz": -12_345.6, "phase_noise_rad": 0.7, "phase_noise_bw_hz": 900.0}
    iq, one = noise(n), np.stack([np.ones(n), np.zeros(n)]).astype(np.float32)
    x, turn = (run(part, cuts, bits=32, impairments=impairments).astype(float) for part in (iq, one))
    wanted = (iq[0] + 1j * iq[1]) * (turn[0] + 1j * turn[1])
    np.testing.assert_allclose(x[0] + 1j * x[1], wanted, atol=10 * 2**-24 * np.abs(iq).max())
    steps = np.diff(np.unwrap(np.angle(turn[0] + 1j * turn[1])))
    mean = 2 * math.pi * 12_345.6 / FS_HZ
    # A node moves by 0.7 sqrt(2 x 2 pi 900 BLOCK / fs) = 1.2 rad rms, in BLOCK steps; the phase never jumps.
    assert np.abs(steps - mean).max() < 5 * 1.2 / BLOCK


def test_phase_noise_has_its_power_and_corner():
    """First order: autocorrelation rms^2 exp(-2 pi B tau); n_eff = pi B T independent values over T."""
    n, rms, corner_hz = 8_000_000, 0.1, 200.0
    one = np.stack([np.ones(n), np.zeros(n)]).astype(np.float32)
    out = run(one, bits=32, impairments={"phase_noise_rad": rms, "phase_noise_bw_hz": corner_hz})
    phase = np.arctan2(out[1], out[0])[::BLOCK].astype(float)
    n_eff = math.pi * corner_hz * n / FS_HZ
    assert np.mean(phase**2) == pytest.approx(rms**2, rel=Z * math.sqrt(2 / n_eff))
    lag = round(1e-3 * FS_HZ / BLOCK)
    wanted = math.exp(-2 * math.pi * corner_hz * lag * BLOCK / FS_HZ)
    assert np.mean(phase[lag:] * phase[:-lag]) / rms**2 == pytest.approx(wanted, abs=Z * math.sqrt(2 / n_eff))


def correlation_loss(bits, n=4_000_000, amplitude=0.05, jammer=0.0, loading=None):
    """Output C/N0 over input C/N0 of a weak constant, 32-bit samples apart from the quantiser."""
    x = noise(n, seed=bits)
    theta = 2 * np.pi * np.random.default_rng(3).random(n)
    tone = jammer * np.array([np.cos(theta), np.sin(theta)])
    rms = math.sqrt(1.0 + jammer**2 / 2) if loading is None else loading
    front_end = FrontEndSpec(fs_hz=FS_HZ, bits=bits).start(rms)
    up, down = (front_end((x + tone + s * amplitude).astype(np.float32)).astype(float) for s in (1, -1))
    gain = np.mean(up - down) / (2 * amplitude)
    return gain, up, theta


@pytest.mark.parametrize(("bits", "loss_db"), [(1, 1.96), (2, 0.55), (3, 0.17)])
def test_quantiser_loss(bits, loss_db):
    """White noise at the Nyquist rate, weak signal, optimal loading: g^2 / var; the gain by differences is known to
    sqrt(P(level changes)) / ..: 1e-3 with these numbers, so 0.03 dB."""
    gain, out, _ = correlation_loss(bits)
    assert -20 * math.log10(gain / np.std(out)) == pytest.approx(loss_db, abs=0.04)


def test_one_bit_is_captured_by_a_strong_tone():
    """Given the tone's phase the output noise is independent from sample to sample: variance 1 - E[m^2] per
    component, with m = erf(A cos / sqrt 2) what the tone alone makes of it and slope m' = 2 phi(A cos)."""
    a = 8.0
    theta = np.linspace(0, 2 * np.pi, 20_001)[:-1]
    mean = erf(a * np.cos(theta) / math.sqrt(2))
    slope = 2 * np.exp(-((a * np.cos(theta)) ** 2) / 2) / math.sqrt(2 * math.pi)
    wanted = np.mean(slope) ** 2 / (1 - np.mean(mean**2))
    gain, out, phase = correlation_loss(1, jammer=a, amplitude=0.2)
    residual = out[0] - erf(a * np.cos(phase) / math.sqrt(2))
    seen = gain**2 / np.var(residual)
    # +-0.2 sigma reaches over the slope's curvature: below 1 %; the gain's own noise 1 %.
    assert seen == pytest.approx(wanted, rel=0.06)
    assert -10 * math.log10(wanted) > 9.0  # against 1.96 dB without the tone; 8 bits lose nothing
    assert ndtr(a) > 0.999


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"filter": {"bandwidth_hz": 5e6}}, "beyond"),
        ({"filter": {"bandwidth_hz": 2e6, "taps": 64}}, "odd"),
        ({"bits": 32, "agc": {}}, "quantiser"),
        ({"impairments": {"spurs": [{"freq_hz": 3e6, "power_db": 0}]}}, "spur"),
        ({"complex": False, "if_hz": 1e6, "impairments": {"iq_gain_db": 1.0}}, "complex"),
    ],
)
def test_bad_settings_are_refused(bad, words):
    with pytest.raises(ValueError, match=words):
        FrontEndSpec(**({"fs_hz": FS_HZ} | bad))


def test_optimal_step_is_known_for_every_number_of_bits():
    assert sorted(OPTIMAL_STEP) == [1, 2, 3, 4, 5, 6, 7]
