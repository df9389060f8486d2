"""Synthesis: same bits however it is asked for, right noise, right amplitude, code phase and carrier phase."""

import math

import numpy as np
import pytest
from naive_synthesis import box_muller, component, secondary_at

from signals.clock import ClockSpec
from signals.constants import CHIP_RATE_HZ, F_L1_HZ
from signals.frontend import OPTIMAL_STEP, FrontEndSpec
from signals.kernels import noise_block
from signals.modulation import BLOCK
from signals.sky import ScriptedSpec, SkySpec
from signals.source import SyntheticSource, amplitude
from signals.trajectory import Line, Static

Z = 5.0


def make_sky(duration_s=1.0, clock=None, motion=None, **sky):
    motion = motion or Static(lat_deg=47.0, lon_deg=15.0, height_m=400.0)
    clock = (clock or ClockSpec()).start(3, duration_s)
    return SkySpec(**sky).start(motion.start(), clock, duration_s)


def scripted(duration_s=1.0, **values):
    return make_sky(duration_s, source="none", scripted=(ScriptedSpec(**({"prn": 1} | values)),))


def read_in(source, chunks):
    parts, k = [], 0
    while True:
        n0, iq = source.read(chunks[k % len(chunks)])
        assert n0 == sum(p.shape[1] for p in parts)
        if iq.shape[1] == 0:
            source.close()
            return np.concatenate(parts, axis=1)
        parts.append(iq)
        k += 1


def as_complex(iq):
    return iq[0].astype(float) + 1j * iq[1].astype(float)


# -- the same bits ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bits", [2, 8, 32])
def test_bits_do_not_depend_on_chunks_or_threads(bits):
    sky = make_sky(0.11, max_satellites=4)
    front_end = FrontEndSpec(fs_hz=2.6e6, if_hz=0.2e6, bits=bits)
    whole = read_in(SyntheticSource(sky, front_end, 0.11, 7), [10**9])
    assert whole.shape == (2, 286_000) and whole.dtype == front_end.dtype
    for chunks, threads in (([1, 1023, 1025, 77_777], 1), ([50_001], 2), ([4096], 3)):
        again = read_in(SyntheticSource(sky, front_end, 0.11, 7, threads=threads), chunks)
        np.testing.assert_array_equal(again, whole)


def test_a_longer_run_begins_with_the_shorter():
    front_end = FrontEndSpec(fs_hz=2.6e6, bits=32)
    runs = [SyntheticSource(make_sky(d, max_satellites=3), front_end, d, 7) for d in (0.05, 1.21)]
    short, long = (r.read(130_000)[1] for r in runs)
    np.testing.assert_array_equal(short, long)


def test_noise_is_the_same_with_and_without_satellites_and_another_with_another_seed():
    front_end = FrontEndSpec(fs_hz=4.096e6, bits=32)
    sky = scripted(0.02)
    both = SyntheticSource(sky, front_end, 0.02, 5).read(80_000)[1]
    signal = SyntheticSource(sky, front_end, 0.02, 5, noise=False).read(80_000)[1]
    other = SyntheticSource(sky, front_end, 0.02, 6).read(80_000)[1]
    silent = SyntheticSource(scripted(0.02, cn0_dbhz=0.0), front_end, 0.02, 5).read(80_000)[1]
    # cn0 = 0 dB-Hz leaves an amplitude of 7e-4; float32 sums round at 2e-7 of values up to 6
    np.testing.assert_allclose(both - signal, silent, atol=8e-4)
    # independent: correlation of 160,000 products within z / sqrt(n)
    correlation = np.mean((both - signal) * (other - signal))
    assert abs(correlation) < Z / math.sqrt(both.size)


def test_jammers_add_to_the_float_samples():
    class Tone:
        rms = 1.0

        def add(self, iq, n0):
            phase = 0.3 * (n0 + np.arange(iq.shape[1]))
            iq[0] += np.cos(phase).astype(np.float32)
            iq[1] += np.sin(phase).astype(np.float32)

    sky, front_end = scripted(0.05), FrontEndSpec(fs_hz=2.6e6, bits=32)
    clean = SyntheticSource(sky, front_end, 0.05, 5).read(130_000)[1]
    jammed = read_in(SyntheticSource(sky, front_end, 0.05, 5, jammers=[Tone()]), [999])
    wanted = np.array([np.cos(0.3 * np.arange(130_000)), np.sin(0.3 * np.arange(130_000))])
    np.testing.assert_allclose(jammed - clean, wanted, atol=2e-6)
    plain, loud = (SyntheticSource(sky, FrontEndSpec(fs_hz=2.6e6), 0.05, 5, j) for j in ((), [Tone()]))
    assert loud.front_end.gain / plain.front_end.gain == pytest.approx(1 / math.sqrt(2), rel=1e-2)


# -- noise -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def noise():
    """2^22 complex samples."""
    n_blocks = 4096
    out = np.empty((2, n_blocks * BLOCK), np.float32)
    buf = [np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)]
    scratch = np.empty(BLOCK, np.uint32), np.empty(BLOCK, np.int32)
    for b in range(n_blocks):
        noise_block(*buf, *scratch, np.uint64(11), np.uint64(b), np.float32(1.0))
        out[0, b * BLOCK : (b + 1) * BLOCK], out[1, b * BLOCK : (b + 1) * BLOCK] = buf
    return out.astype(float)


def test_noise_moments(noise):
    """Mean 0 +- 1/sqrt n, variance 1 +- sqrt(2/n), skewness 0 +- sqrt(6/n), kurtosis 3 +- sqrt(24/n)."""
    for x in noise:
        n = len(x)
        assert abs(x.mean()) < Z / math.sqrt(n)
        assert abs(np.mean(x**2) - 1) < Z * math.sqrt(2 / n)
        assert abs(np.mean(x**3)) < Z * math.sqrt(15 / n)
        assert abs(np.mean(x**4) - 3) < Z * math.sqrt(96 / n)
        assert abs(np.mean(x**6) - 15) < Z * math.sqrt((10395 - 225) / n)


def test_noise_tails_and_distribution(noise):
    """Counts beyond k sigma are Poisson; Kolmogorov's D sqrt(n) is below 2.2 with probability 1 - 1.2e-4."""
    from scipy.special import ndtr

    for x in noise:
        for k in (3.0, 4.0, 4.5, 5.0):
            for side in (x > k, x < -k):
                expected = len(x) * ndtr(-k)
                assert abs(side.sum() - expected) < Z * math.sqrt(expected) + 1
        u = ndtr(np.sort(x))
        grid = np.arange(len(x)) / len(x)
        assert np.max(np.abs(u - grid)) * math.sqrt(len(x)) < 2.2
    angle = np.sort(np.arctan2(noise[1], noise[0])) / (2 * np.pi) + 0.5
    assert np.max(np.abs(angle - np.arange(len(angle)) / len(angle))) * math.sqrt(len(angle)) < 2.2


def test_noise_is_white_and_independent(noise):
    """Correlations of I, Q and their squares at lags within and across blocks are below z / sqrt(n)."""
    i, q = noise
    n = len(i)
    for a, b in ((i, i), (q, q), (i, q), (q, i)):
        for lag in (0, 1, 2, 3, 7, 64, 512, 1023, 1024, 1025, 4096):
            if lag or a is not b:
                x, y = a[: n - lag], b[lag:]
                assert abs(np.mean(x * y)) < Z / math.sqrt(n - lag), lag
                assert abs(np.mean((x**2 - 1) * (y**2 - 1))) < Z * 2 / math.sqrt(n - lag), lag


def test_noise_spectrum_is_flat(noise):
    """Every one of 1024 bins holds 4096 exponential periodogram values: mean 1 +- 1 / 64; chi^2 over the bins."""
    blocks = (noise[0] + 1j * noise[1]).reshape(-1, BLOCK)
    power = np.mean(np.abs(np.fft.fft(blocks, axis=1)) ** 2, axis=0) / (2 * BLOCK)
    z = (power - 1) * math.sqrt(len(blocks))
    assert np.max(np.abs(z)) < Z + 0.5
    assert abs(np.sum(z**2) - BLOCK) < Z * math.sqrt(2 * BLOCK)
    # between blocks: the same place in successive blocks
    across = np.mean(blocks[1:] * np.conj(blocks[:-1]), axis=0) / 2 * math.sqrt(len(blocks) - 1)
    assert np.max(np.abs(across)) < Z + 0.5


def test_noise_is_box_muller_of_its_hashes():
    """float32 against double precision: 3e-6 in log2 u, 7e-7 in sine and cosine, 6e-8 of rounding in a few sums."""
    out = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    hash1, hash2 = np.empty(BLOCK, np.uint32), np.empty(BLOCK, np.int32)
    for b in range(200):
        noise_block(*out, hash1, hash2, np.uint64(3), np.uint64(b), np.float32(1.7))
        u1 = ((hash1 >> 1) | 1) / 2.0**31
        turns = hash2 / 2.0**33
        wanted = 1.7 * box_muller(u1, turns)
        wanted = wanted.imag + 1j * np.where(hash1 & 1, -1, 1) * wanted.real
        # d r = 1.39 d(log2 u) / (2 r): only where r is small does it exceed 2e-6
        r = np.sqrt(-2 * np.log(u1))
        tolerance = 1.7 * (1.5e-6 * r + 3e-6 / np.maximum(r, 1e-3))
        assert np.all(np.abs(out[0] + 1j * out[1] - wanted) < tolerance + 1e-6)


def test_noise_of_a_source_is_that_of_the_absolute_block():
    fs_hz = 2.6e6
    source = SyntheticSource(scripted(0.1, cn0_dbhz=0.0), FrontEndSpec(fs_hz=fs_hz, bits=32), 0.1, 21)
    made = source.read(260_000)[1]
    seed = np.random.SeedSequence(21).generate_state(1, np.uint64)[0]
    out = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    scratch = np.empty(BLOCK, np.uint32), np.empty(BLOCK, np.int32)
    for b in (0, 1, 49, 50, 51, 52, 120, 252):
        noise_block(*out, *scratch, seed, np.uint64(b), np.float32(1.0))
        at = slice(b * BLOCK, (b + 1) * BLOCK)
        # the satellite at 0 dB-Hz has an amplitude of 9e-4
        np.testing.assert_allclose(made[:, at], out, atol=1e-3)


def test_noise_of_neighbouring_seeds_and_blocks_differs():
    def block(seed, b):
        out = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
        scratch = np.empty(BLOCK, np.uint32), np.empty(BLOCK, np.int32)
        noise_block(*out, *scratch, np.uint64(seed), np.uint64(b), np.float32(1.0))
        return np.concatenate(out).astype(float)

    reference = block(1, 0)
    for seed, b in ((2, 0), (1, 1), (0, 0), (1, 2**40), (1 + 2**63, 0)):
        other = block(seed, b)
        assert abs(np.mean(reference * other)) < Z / math.sqrt(2 * BLOCK)
    np.testing.assert_array_equal(reference, block(1, 0))


# -- the signal ------------------------------------------------------------------------------------------------------

CASES = [
    ("L1CA", 4.096e6, 0.0),
    ("L1CA", 2.6e6, 300_017.3),
    ("L1CA", 10e6, -2.5e6),
    ("E1", 4.096e6, 0.0),
    ("E1", 25e6, 4.0e6),
]


def delays(sky, t_s):
    """Exact delays of the first satellite."""
    at = sky.propagate(t_s)
    return at.delay_s[0], at.phase_delay_s[0]


def textbook(sky, t_s, if_hz):
    """Sum of the components of the only satellite, each with its share of unit power."""
    from signals.source import _messages

    satellite = sky.satellites[0]
    delay, phase_delay = delays(sky, t_s)
    messages = _messages(sky, satellite, -12)

    def data(period):
        values, first, per_symbol = messages[0]
        return values[((period - first) // per_symbol) % len(values)].astype(float)

    if satellite.system == "G":
        return component("L1CA", satellite.prn, t_s, delay, phase_delay, if_hz, data, "BPSK")
    b = component("E1B", satellite.prn, t_s, delay, phase_delay, if_hz, data, "CBOC+")
    c = component("E1C", satellite.prn, t_s, delay, phase_delay, if_hz, secondary_at, "CBOC-")
    return (b - c) / math.sqrt(2)


@pytest.mark.parametrize("signal, fs_hz, if_hz", CASES)
def test_against_textbook(signal, fs_hz, if_hz):
    """Amplitude, carrier phase and code phase of a noise-free satellite against double precision.

    Per block the samples equal the textbook's but where a chip edge falls within the rounding of the code phase,
    1 / (2 P) sample and the code Doppler over half a block; and but for BOC(6,1) below 15 Msps, which is limited
    in band. So: the amplitude of the projection on the textbook's signal loses at most the share of those samples,
    and its phase is that of float32 and of one Doppler per cell.
    """
    duration = 0.25 if fs_hz < 15e6 else 0.06
    sky = scripted(duration, signal=signal, prn=11, doppler_hz=3210.5, doppler_rate_hz_s=-40.0, cn0_dbhz=50.0)
    source = SyntheticSource(sky, FrontEndSpec(fs_hz=fs_hz, if_hz=if_hz, bits=32), duration, 1, noise=False)
    n = source.n_samples
    made = as_complex(source.read(n)[1])
    wanted = textbook(sky, np.arange(n) / fs_hz, if_hz) * amplitude(50.0, fs_hz)
    limited = signal == "E1" and fs_hz < 15e6
    ratio = np.array(
        [np.vdot(w, m) / np.vdot(w, w) for w, m in zip(np.array_split(wanted, 10), np.array_split(made, 10))]
    )
    assert np.max(np.abs(np.angle(ratio))) < 2e-4
    if limited:
        # 10/11 of the power has sharp edges; the limited BOC(6,1) part correlates with what fits of it
        assert np.all((np.abs(ratio) > 10 / 11 - 2e-3) & (np.abs(ratio) < 1.0))
    else:
        edges = 1.023e6 * {"L1CA": 0.5, "E1": 12.0}[signal] / fs_hz
        wrong = edges * 2 * (1 / 128 + 2 * 512 * 2.1e-6)  # twice the share of samples nearer to an edge
        assert np.all(np.abs(np.abs(ratio) - 1) < wrong + 1e-5)
        # away from edges nothing but float32 and the carrier's curvature remains
        error = np.abs(made - wanted) / np.abs(wanted).max()
        assert np.mean(error > 1e-3) < wrong
    assert np.allclose(ratio.mean(), ratio, atol=3e-3)


def test_symbols_change_at_the_right_sample():
    """Wipe off code and carrier of the textbook: what remains is the data bit of every sample."""
    sky = scripted(0.3, prn=5, delay_s=0.0712345, doppler_hz=-2000.0, cn0_dbhz=60.0)
    fs_hz = 4.096e6
    source = SyntheticSource(sky, FrontEndSpec(fs_hz=fs_hz, bits=32), 0.3, 1, noise=False)
    t_s = np.arange(source.n_samples) / fs_hz
    made = as_complex(source.read(source.n_samples)[1])
    agreement = np.real(made * np.conj(textbook(sky, t_s, 0.0))) / amplitude(60.0, fs_hz)
    chips = CHIP_RATE_HZ * (t_s - delays(sky, t_s)[0])
    edge = np.abs(chips - np.round(chips)) < 0.01
    assert np.min(agreement[~edge]) > 0.999


def test_orbit_clock_and_motion_are_followed():
    """A real orbit, a drifting and noisy clock, a moving receiver: phase and delay at every cell's middle."""
    clock = ClockSpec(bias_s=1e-5, drift_s_s=2e-7, noise="TCXO")
    motion = Line(lat_deg=47.0, lon_deg=15.0, height_m=400.0, vel_ned_mps=(100.0, 50.0, -3.0))
    duration, fs_hz = 1.0, 4.096e6
    sky = make_sky(duration, clock, motion, signals=("L1CA",), max_satellites=1)
    source = SyntheticSource(sky, FrontEndSpec(fs_hz=fs_hz, bits=32), duration, 1, noise=False)
    made = as_complex(source.read(source.n_samples)[1])
    for middle in range(40_960, source.n_samples, 81_920):
        at = np.arange(middle - 2000, middle + 2000)
        wanted = textbook(sky, at / fs_hz, 0.0)
        ratio = np.vdot(wanted, made[at]) / len(at) / amplitude(45.0, fs_hz)
        assert abs(np.angle(ratio)) < 2 * np.pi * 1e-3
        assert abs(abs(ratio) - 1) < 0.02


def test_truth_is_what_is_in_the_samples():
    sky = scripted(0.5, prn=20, delay_s=0.08, doppler_hz=1500.0, cn0_dbhz=55.0)
    fs_hz = 4.096e6
    source = SyntheticSource(sky, FrontEndSpec(fs_hz=fs_hz, bits=32), 0.5, 1, noise=False)
    index = source.truth_index(10.0)
    np.testing.assert_array_equal(index, np.arange(5) * 409_600)
    truth = source.truth(index)
    iq = as_complex(source.read(source.n_samples)[1])
    from naive_synthesis import waveform_at

    for row in truth:
        k = np.arange(4000)
        chips = row["code_phase_chips"] + k / fs_hz * CHIP_RATE_HZ * (1 + row["doppler_hz"] / F_L1_HZ)
        replica = waveform_at("L1CA", 20, chips, "BPSK") * np.exp(
            2j * np.pi * (row["carrier_phase_cycles"] + row["doppler_hz"] * k / fs_hz)
        )
        prompt = np.mean(iq[int(row["sample_index"]) + k] * np.conj(replica)) / amplitude(55.0, fs_hz)
        assert abs(abs(prompt) - 1) < 0.02 or abs(prompt) < 1  # a data bit may change inside
        assert min(abs(np.angle(prompt)), np.pi - abs(np.angle(prompt))) < 2e-3
    assert np.all(np.isclose(truth["doppler_rate_hz_s"], 0.0, atol=1e-6))


def test_code_and_carrier_are_coherent():
    """1540 cycles per chip, with the opposite sign of the ionosphere only."""
    sky = make_sky(1.0, signals=("L1CA",), max_satellites=4, ionosphere="none")
    source = SyntheticSource(sky, FrontEndSpec(), 1.0, 1)
    truth = source.truth([0, 4_000_000])
    np.testing.assert_allclose(truth["carrier_phase_cycles"], -F_L1_HZ * truth["delay_s"], rtol=1e-15)
    np.testing.assert_allclose(truth["doppler_hz"], -F_L1_HZ * truth["delay_rate_s_s"], rtol=1e-12)


@pytest.mark.parametrize("is_complex", [True, False])
def test_cn0(is_complex):
    """C/N0 measured with a perfect replica over 100 ms: known to z sqrt(2 / (C/N0 T)) of the amplitude."""
    cn0_db, fs_hz, if_hz, duration = 45.0, 5.0037e6, 1.25e6, 0.1
    sky = scripted(duration, prn=3, doppler_hz=777.0, cn0_dbhz=cn0_db)
    front_end = FrontEndSpec(fs_hz=fs_hz, if_hz=if_hz, complex=is_complex, bits=32)
    source = SyntheticSource(sky, front_end, duration, 9)
    n = source.n_samples
    x = as_complex(source.read(n)[1])
    replica = textbook(sky, np.arange(n) / fs_hz, if_hz)
    if is_complex:
        carrier, noise_power = np.mean(x * np.conj(replica)), np.mean(np.abs(x) ** 2)
        density = noise_power / fs_hz  # over the whole band
        power = abs(carrier) ** 2
    else:
        assert not x.imag.any()
        carrier, noise_power = 2 * np.mean(x.real * np.conj(replica)), np.mean(x.real**2)
        density = noise_power / (fs_hz / 2)  # one-sided
        power = abs(carrier) ** 2 / 2
    cn0 = 10 ** (cn0_db / 10)
    measured = power / density
    # amplitude error sqrt(1 / (2 cn0 T)), plus 1 % of power: satellite in the "noise" and edge samples
    assert abs(measured / cn0 - 1) < Z * 2 * math.sqrt(1 / (2 * cn0 * duration)) + 0.02
    assert abs(np.angle(carrier)) < Z * math.sqrt(1 / (2 * cn0 * duration)) + 1e-3


def test_e1_shares_of_power_and_sign():
    """E1-B and E1-C correlate with half the power each, and the pilot with a minus sign."""
    duration, fs_hz = 0.04, 25e6
    sky = scripted(duration, signal="E1", prn=7, doppler_hz=0.0, cn0_dbhz=50.0)
    source = SyntheticSource(sky, FrontEndSpec(fs_hz=fs_hz, bits=32), duration, 1, noise=False)
    t_s = np.arange(source.n_samples) / fs_hz
    made = as_complex(source.read(source.n_samples)[1]) / amplitude(50.0, fs_hz)
    pilot = component("E1C", 7, t_s, *delays(sky, t_s), 0.0, secondary_at, "CBOC-")
    assert np.real(np.vdot(pilot, made)) / len(t_s) == pytest.approx(-math.sqrt(0.5), abs=0.02)
    assert np.mean(np.abs(made) ** 2) == pytest.approx(1.0, abs=0.02)


def test_satellites_below_the_mask_are_silent():
    sky = make_sky(0.04, signals=("L1CA",), elevation_mask_deg=10.0, max_satellites=2)
    source = SyntheticSource(sky, FrontEndSpec(bits=32), 0.04, 1, noise=False)
    hidden = make_sky(0.04, signals=("L1CA",), elevation_mask_deg=10.0, max_satellites=2)
    propagate = hidden.propagate

    def none_visible(t_s):
        out = propagate(t_s)
        out.visible[:] = False
        return out

    object.__setattr__(hidden, "propagate", none_visible)
    assert np.any(source.read(50_000)[1])
    assert not np.any(SyntheticSource(hidden, FrontEndSpec(bits=32), 0.04, 1, noise=False).read(50_000)[1])


# -- the quantiser ---------------------------------------------------------------------------------------------------


def loss_db(x, y):
    """Loss of C/N0 of a weak signal in white Gaussian noise: 1 / correlation coefficient^2 of input and output."""
    return -10 * np.log10(np.mean(x * y) ** 2 / (np.mean(x * x) * np.mean(y * y)))


@pytest.mark.parametrize(
    "bits, loss", [(1, 1.961), (2, 0.549), (3, 0.166), (4, 0.050), (8, 9e-4), (16, 1e-7)]
)
def test_quantiser_loss(noise, bits, loss):
    """1.96 / 0.55 / 0.17 dB (Max 1960: distortion D, loss 1 / (1 - D)); the estimate is known to about 1e-3 dB."""
    x = noise.astype(np.float32)
    y = FrontEndSpec(bits=bits).start(1.0)(x).astype(float)
    measured = loss_db(noise, y)
    rho2 = 10 ** (-loss / 10)
    sigma = 10 / math.log(10) * 2 * math.sqrt((1 - rho2) / (2 * noise.size))
    assert abs(measured - loss) < Z * sigma + 6e-4


@pytest.mark.parametrize("bits", range(1, 8))
def test_quantiser_levels_and_optimum(noise, bits):
    x = noise[:, :500_000].astype(np.float32)
    spec = FrontEndSpec(bits=bits)
    y = spec.start(1.0)(x)
    assert set(np.unique(y)) <= set(range(-(2**bits) + 1, 2**bits, 2))
    np.testing.assert_array_equal(y > 0, x >= 0)
    if bits > 1:
        off = [loss_db(x.astype(float), spec.start(s)(x).astype(float)) for s in (0.9, 1.1)]
        assert loss_db(x.astype(float), y.astype(float)) < min(off)
    assert set(OPTIMAL_STEP) == set(range(1, 8))


def test_quantiser_rounds_and_clips():
    for bits, top in ((8, 127), (16, 32767)):
        x = np.array(
            [[0.0, 0.4, 0.6, -0.4, -0.6, 1.5, 2.5, 1e9], [-1e9, 1.0, -1.0, 126.6, -126.6, 3.0, 4.0, 5.0]]
        )
        spec = FrontEndSpec(bits=bits, rms_lsb=10.0)
        y = spec.start(10.0)(x.astype(np.float32))
        assert y.dtype == spec.dtype
        np.testing.assert_array_equal(y, np.clip(np.round(x), -top, top))


def test_fused_int8_is_the_quantised_float():
    sky = make_sky(0.05, max_satellites=3)
    fine = SyntheticSource(sky, FrontEndSpec(bits=32), 0.05, 3).read(204_800)[1]
    source = SyntheticSource(sky, FrontEndSpec(), 0.05, 3)
    np.testing.assert_array_equal(source.read(204_800)[1], source.front_end(fine))
    assert np.std(fine) > 1 and abs(np.std(source.front_end(fine)) / 20 - 1) < 0.02


@pytest.mark.parametrize(
    "values, message",
    [
        ({"fs_hz": 1e6}, "too low for complex samples"),
        ({"fs_hz": 2e6, "complex": False, "if_hz": 5e5}, "too low for real samples"),
        ({"if_hz": 2.1e6}, "beyond fs_hz / 2"),
        ({"complex": False}, "between 0 and fs_hz / 2"),
        ({"bits": 2, "rms_lsb": 20.0}, "applies to 8 and 16 bits"),
        ({"bits": 8, "rms_lsb": 90.0}, "would clip"),
        ({"bits": 9}, "Input should be"),
        ({"fs_hz": float("nan")}, "fs_hz"),
    ],
)
def test_front_end_refuses(values, message):
    with pytest.raises(ValueError, match=message):
        FrontEndSpec(**values)


def test_source_refuses_no_samples():
    with pytest.raises(ValueError, match="holds no sample"):
        SyntheticSource(scripted(1.0), FrontEndSpec(), 1e-9, 1)
