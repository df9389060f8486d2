"""Acquisition on exact synthetic signals, on noise (false-alarm rate) and on a real capture."""

import math
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.special import gammaincc
from scipy.stats import binom

from signals.codes import primary_code, secondary_code
from signals.constants import CHIP_RATE_HZ, F_L1_HZ
from signals.modulation import chip_waveform
from tracking.acquisition import (
    AcquisitionSpec,
    acquire,
    search_threshold,
    slab_samples,
    to_working_rate,
    working_rate,
)
from tracking.fft import fast_length, row_fft

CAPTURE = Path(__file__).resolve().parents[2] / "shared" / "data" / "real" / "L1_20211202_084700_4MHz_IQ.bin"


def satellite(signal, prn, fs_hz, n, doppler_hz, code_phase_chips, cn0_dbhz, rng, if_hz=0.0, symbols=True):
    """Exact samples, complex128, for noise of unit variance per complex sample (N0 = 1 / fs)."""
    t = np.arange(n) / fs_hz
    chips_now = code_phase_chips + CHIP_RATE_HZ * (1 + doppler_hz / F_L1_HZ) * t
    carrier = np.exp(2j * np.pi * ((if_hz + doppler_hz) * t + rng.uniform()))
    amplitude = math.sqrt(10 ** (cn0_dbhz / 10) / fs_hz)

    def component(name, waveform):
        code, slots = primary_code(name, prn), chip_waveform(waveform)
        x = chips_now % len(code)
        k = np.minimum(x.astype(int), len(code) - 1)
        return code[k] * slots[np.minimum(((x - k) * len(slots)).astype(int), len(slots) - 1)]

    period = np.floor(chips_now / (1023 if signal == "L1CA" else 4092)).astype(int)
    bits = rng.choice([-1, 1], n // 1000 + 100)
    if signal == "L1CA":
        data = bits[(period + int(rng.integers(20))) // 20] if symbols else 1
        return amplitude * data * component("L1CA", "BPSK") * carrier
    pilot = secondary_code()[(period + int(rng.integers(25))) % 25]
    parts = bits[period] * component("E1B", "CBOC+") - pilot * component("E1C", "CBOC-")
    return amplitude / math.sqrt(2) * parts * carrier


def slab(parts, n, rng, dtype=np.float32, level=20.0, real=False):
    """Sum of satellites and unit noise -> planar slab."""
    x = sum(parts, np.zeros(n, complex)) + (rng.standard_normal(n) + 1j * rng.standard_normal(n)) / math.sqrt(
        2
    )
    iq = level * np.array([x.real, np.zeros(n) if real else x.imag])
    return np.rint(iq).astype(dtype) if np.issubdtype(dtype, np.integer) else iq.astype(dtype)


def apart(a, b, length):
    return (a - b + length / 2) % length - length / 2


def assert_found(row, prn, doppler_hz, code_phase_chips, cn0_dbhz, length=1023, code_chips=0.1, cn0_db=2.0):
    assert row["prn"] == prn and row["acquired"]
    assert row["statistic"] > row["threshold"]
    assert abs(row["doppler_hz"] - doppler_hz) < 20
    assert abs(apart(row["code_phase_chips"], code_phase_chips, length)) < code_chips
    assert abs(row["cn0_dbhz"] - cn0_dbhz) < cn0_db


@pytest.mark.parametrize("library", ["fftw", "scipy"])
@pytest.mark.parametrize("n", [1, 12, 4000, 4096])
def test_row_transforms_against_numpy(n, library):
    if library == "fftw":
        pytest.importorskip("pyfftw")
    rng = np.random.default_rng(n)
    x = (rng.standard_normal(n) + 1j * rng.standard_normal(n)).astype(np.complex64)
    for inverse, reference in ((False, np.fft.fft(x)), (True, np.fft.ifft(x) * n)):
        source, result, run = row_fft(n, inverse, library)
        for _ in range(2):
            source[:] = x
            run()
            assert result.dtype == np.complex64
            assert result == pytest.approx(reference, abs=2e-6 * math.sqrt(n) * (1 + math.log2(n)))


def test_fast_lengths():
    def smooth(n):
        for p in (2, 3, 5):
            while n % p == 0:
                n //= p
        return n == 1

    for n in (*range(1, 300), 4092, 4095, 16368):
        assert fast_length(n) == max(k for k in range(1, n + 1) if smooth(k))
    with pytest.raises(ValueError):
        fast_length(0)


def test_working_rates_are_quick_and_keep_what_they_can():
    assert working_rate("L1CA", 4.096e6) == 4.096e6 and working_rate("L1CA", 4e6) == 4e6
    assert working_rate("L1CA", 4.092e6) == 4.096e6  # 4092 has the factors 11 and 31
    assert working_rate("L1CA", 25e6) == 4.096e6 and working_rate("E1C", 25e6) == 4e6
    for fs_hz in (1.1e6, 2.046e6, 2.6e6, 5.456e6, 16.368e6):
        n = working_rate("L1CA", fs_hz) * 1e-3
        assert round(n) == pytest.approx(n, abs=1e-9) and fast_length(round(n)) == round(n)
        assert n <= 1.0011e-3 * fs_hz


def test_resampling_keeps_instants_and_stops_what_does_not_fit():
    fs_hz, fs_work = 10e6, 4.096e6
    t = np.arange(100_000) / fs_hz
    inside, outside = np.exp(2j * np.pi * 1.1e6 * t), np.exp(2j * np.pi * 3.2e6 * t)
    for z, gain in ((inside, 1.0), (outside, 0.0)):
        # With a reference tone of known power the scaling to rms 1 is undone.
        z = z + 2 * np.exp(-2j * np.pi * 0.3e6 * t)
        x = to_working_rate(np.array([z.real, z.imag], np.float32), fs_hz, 0.0, fs_work)
        got = (x[0] + 1j * x[1])[100:-100]
        tw = np.arange(x.shape[1])[100:-100] / fs_work
        low = np.mean(got * np.exp(2j * np.pi * 0.3e6 * tw)) / 2
        f_hz = 1.1e6 if gain else 3.2e6
        assert np.mean(got * np.exp(-2j * np.pi * f_hz * tw)) / low == pytest.approx(gain, abs=0.01)


@pytest.mark.parametrize(
    "fs_hz, if_hz, dtype, real",
    [
        (4.096e6, 0.0, np.int8, False),
        (4.0e6, 0.0, np.int16, False),
        (4.092e6, 0.0, np.float32, False),
        (2.6e6, 0.2e6, np.int8, False),
        (5.456e6, 1.364e6, np.int8, True),
        (16.368e6, 4.092e6, np.int8, True),
        (10e6, -2.5e6, np.float32, False),
    ],
)
def test_ca_is_found_at_any_rate_and_intermediate_frequency(fs_hz, if_hz, dtype, real):
    rng = np.random.default_rng(11)
    n = slab_samples("L1CA", fs_hz)
    truth = [(5, -3333.0, 700.3, 45.0), (17, 1234.0, 12.9, 42.0), (30, 4810.0, 1022.9, 47.0)]
    # The real part has a quarter of the signal's power at +IF and half of the noise density: 3 dB less C/N0.
    sent_db = 3.0 if real else 0.0
    parts = [satellite("L1CA", p, fs_hz, n, d, c, cn0 + sent_db, rng, if_hz) for p, d, c, cn0 in truth]
    found = acquire(slab(parts, n, rng, dtype, real=real), 77, fs_hz, if_hz, "L1CA", [5, 6, 17, 18, 30])
    assert list(found["prn"][found["acquired"]]) == [5, 17, 30]
    assert np.all(found["sample_index"] == 77) and np.all(found["signal"] == b"L1CA")
    for row, sat in zip(found[found["acquired"]], truth):
        assert_found(row, *sat)
    assert np.all(np.isnan(found["cn0_dbhz"][~found["acquired"]]))


def test_e1_is_found_whatever_changes_inside_the_code_period():
    # Code starts in the middle of the blocks; symbols and secondary code change there. A search that takes 4 ms from
    # anywhere puts half of these 125 Hz off.
    fs_hz, rng = 4.096e6, np.random.default_rng(12)
    n = slab_samples("E1C", fs_hz)
    prns = [2, 9, 14, 21, 30, 36]
    truth = [(p, rng.uniform(-4900, 4900), rng.uniform(1300, 2800), 42.0) for p in prns]
    parts = [satellite("E1C", p, fs_hz, n, d, c, cn0, rng) for p, d, c, cn0 in truth]
    iq = slab(parts, n, rng, np.int8)
    for row, sat in zip(acquire(iq, 0, fs_hz, 0.0, "E1C", prns), truth):
        # C/N0 of one of two components: -3 dB; BOC(1,1) replica on CBOC -0.4 dB, edges beyond +-2 MHz -1.3 dB.
        assert_found(row, *sat[:3], sat[3] - 3.0 - 1.7, length=4092, code_chips=0.08)
    for row, sat in zip(acquire(iq, 0, fs_hz, 0.0, "E1B", prns[:2]), truth):
        assert row["signal"] == b"E1B"
        assert_found(row, *sat[:3], sat[3] - 3.0 - 1.7, length=4092)


@pytest.mark.parametrize("doppler_hz", [9600.0, -9600.0])
def test_code_doppler_is_followed_over_a_long_sum(doppler_hz):
    # 9.6 kHz for 100 ms move the code by 0.62 chip; a search that stands still loses a third of the amplitude.
    fs_hz, rng = 4.096e6, np.random.default_rng(13)
    n = round(0.101 * fs_hz)
    iq = slab([satellite("L1CA", 8, fs_hz, n, doppler_hz, 333.3, 38.0, rng)], n, rng, np.int8)
    spec = AcquisitionSpec(doppler_range_hz=10e3, non_coherent=100)
    (row,) = acquire(iq, 0, fs_hz, 0.0, "L1CA", [8], spec)
    assert_found(row, 8, doppler_hz, 333.3, 38.0)
    # 1 + C/N0 T, less at most half a sample (0.125 chip) and half a bin (sinc 1/4) off, 5 sigma of the sum of 100.
    snr = 10**3.8 * 1e-3
    assert row["statistic"] > 1 + 0.8 * (1 - 0.125) ** 2 * snr - 5 * (1 + snr) / 10


def test_longer_coherent_integration():
    fs_hz, rng = 4.0e6, np.random.default_rng(14)
    n = round(0.041 * fs_hz)
    iq = slab([satellite("L1CA", 3, fs_hz, n, -2210.0, 50.5, 36.0, rng, symbols=False)], n, rng, np.int8)
    spec = AcquisitionSpec(coherent_ms=10, non_coherent=4)
    (row,) = acquire(iq, 0, fs_hz, 0.0, "L1CA", [3], spec)
    assert_found(row, 3, -2210.0, 50.5, 36.0)
    # Four terms 1 + C/N0 10 ms each, half a sample and half a bin off at worst, minus 5 sigma.
    snr = 10**3.6 * 10e-3
    assert row["statistic"] > 1 + 0.8 * 0.875**2 * snr - 5 * math.sqrt(1 + 2 * snr) / 2


def test_weak_signals_are_found_by_the_second_look():
    fs_hz, rng = 4.096e6, np.random.default_rng(15)
    n = slab_samples("L1CA", fs_hz)
    truth = [(4, 2020.0, 900.1, 36.0), (22, -4400.0, 111.1, 36.0), (27, 650.0, 444.4, 36.0)]
    iq = slab([satellite("L1CA", p, fs_hz, n, d, c, cn0, rng) for p, d, c, cn0 in truth], n, rng, np.int8)
    both = acquire(iq, 0, fs_hz, 0.0, "L1CA", [4, 22, 27])
    for row, sat in zip(both, truth):
        assert_found(row, *sat, code_chips=0.2)
    first = acquire(iq, 0, fs_hz, 0.0, "L1CA", [4, 22, 27], AcquisitionSpec(non_coherent=10))
    assert np.count_nonzero(first["acquired"]) < 3


def test_strong_satellites_do_not_raise_others():
    # Two at 54 dB-Hz: their cross-correlations (-21 to -24 dB) are signals of 30 to 33 dB-Hz in a search for others.
    fs_hz, rng = 4.096e6, np.random.default_rng(16)
    n = round(0.101 * fs_hz)
    truth = [(1, 500.0, 100.0, 54.0), (2, -1500.0, 800.0, 54.0)]
    iq = slab([satellite("L1CA", p, fs_hz, n, d, c, cn0, rng) for p, d, c, cn0 in truth], n, rng, np.int8)
    for spec in (AcquisitionSpec(), AcquisitionSpec(non_coherent=60)):
        found = acquire(iq, 0, fs_hz, 0.0, "L1CA", range(1, 33), spec)
        assert list(found["prn"][found["acquired"]]) == [1, 2]
        for row, sat in zip(found, truth):
            # Each is noise to the other: 54 dB-Hz spread over the chips, 10 log10(1 + 10^5.4 / 1.023e6 2/3) = 0.7 dB,
            # and more at the few code phases that the floor is taken from.
            assert_found(row, *sat[:3], sat[3] - 1.5)


def test_tones_neither_hide_a_satellite_nor_make_one():
    fs_hz, rng = 4.096e6, np.random.default_rng(17)
    n = slab_samples("L1CA", fs_hz)
    t = np.arange(n) / fs_hz
    tones = sum(a * np.exp(2j * np.pi * f * t) for a, f in ((2.0, 227e3), (1.5, 580e3), (1.0, -1.42e6)))
    sat = (6, 0.0, 321.0, 45.0)  # zero Doppler: the first tone falls on its strongest line
    iq = slab([satellite("L1CA", sat[0], fs_hz, n, *sat[1:], rng), tones], n, rng, np.int8)
    found = acquire(iq, 0, fs_hz, 0.0, "L1CA")
    assert list(found["prn"][found["acquired"]]) == [6]
    assert_found(found[5], *sat)
    raw = acquire(iq, 0, fs_hz, 0.0, "L1CA", spec=AcquisitionSpec(excise_tones=False))
    assert set(raw["prn"][raw["acquired"]]) <= {6}


def test_a_signal_without_noise_is_found():
    fs_hz, rng = 4.0e6, np.random.default_rng(18)
    n = slab_samples("L1CA", fs_hz)
    x = satellite("L1CA", 12, fs_hz, n, 1010.0, 5.5, 40.0, rng, symbols=False)
    x *= 1 / np.std(x)
    found = acquire(np.array([x.real, x.imag], np.float32), 0, fs_hz, 0.0, "L1CA", [12])
    assert found["acquired"][0] and abs(found["doppler_hz"][0] - 1010) < 20
    assert abs(apart(found["code_phase_chips"][0], 5.5, 1023)) < 0.1


@pytest.mark.parametrize("zeros", [slice(0, 200_000), slice(60_000, None), slice(1, None), slice(None, -1)])
def test_padding_is_no_signal_and_no_crash(zeros):
    fs_hz, rng = 4.096e6, np.random.default_rng(23)
    n = slab_samples("L1CA", fs_hz)
    iq = slab([satellite("L1CA", 7, fs_hz, n, -810.0, 640.0, 47.0, rng)], n, rng, np.int8)
    iq[:, zeros] = 0
    with np.errstate(all="raise"):
        found = acquire(iq, 0, fs_hz, 0.0, "L1CA", range(6, 9))
    assert not found["acquired"][[0, 2]].any()


def test_threads_do_not_change_a_bit():
    fs_hz, rng = 4.096e6, np.random.default_rng(19)
    n = slab_samples("L1CA", fs_hz)
    iq = slab([satellite("L1CA", 7, fs_hz, n, -810.0, 640.0, 44.0, rng)], n, rng, np.int8)
    one = acquire(iq, 0, fs_hz, 0.0, "L1CA", range(1, 9))
    three = acquire(iq, 0, fs_hz, 0.0, "L1CA", range(1, 9), AcquisitionSpec(workers=3))
    assert one.tobytes() == three.tobytes()


def test_threshold_of_independent_cells_and_of_copies():
    # No correlation: 1 - (1 - Q)^M. Neighbours that copy each other count once.
    for terms in (1, 10, 40):
        u = terms * search_threshold(1e-3, 100_000, terms, 0.0, 0.0)
        assert -math.expm1(100_000 * math.log1p(-gammaincc(terms, u))) == pytest.approx(1e-3, rel=1e-2)
        assert search_threshold(1e-3, 100_000, terms, 0.75, 0.6) < u / terms


FALSE_ALARMS = [
    # signal, fs, spec, milliseconds, slabs: 360 to 1000 searches each
    ("L1CA", 4.096e6, {"non_coherent": 1}, 1.01, 31),
    ("L1CA", 4.096e6, {"non_coherent": 10, "doppler_range_hz": 2000.0}, 10.01, 31),
    ("L1CA", 10e6, {"non_coherent": 4, "coherent_ms": 2, "doppler_range_hz": 1000.0}, 8.01, 31),
    ("L1CA", 2.6e6, {"doppler_range_hz": 1000.0}, 35.0, 16),
    ("E1C", 4.0e6, {"non_coherent": 2, "doppler_range_hz": 500.0}, 12.01, 10),
]


@pytest.mark.parametrize("signal, fs_hz, spec, ms, slabs", FALSE_ALARMS)
def test_false_alarm_rate_is_the_one_set(signal, fs_hz, spec, ms, slabs):
    # Count of false alarms among all searches of noise, against the binomial at the rate set. First-order declumping
    # is good to some 20 %: the interval is that of rates between 0.75 and 1.2 times p, at z = 3.5 (two-sided 5e-4).
    p_fa, rng = 0.1, np.random.default_rng(20)
    prns = range(1, 33) if signal == "L1CA" else range(1, 37)
    spec = AcquisitionSpec(p_fa=p_fa, **spec)
    n, false, searches = math.ceil(ms * 1e-3 * fs_hz), 0, 0
    for _ in range(slabs):
        found = acquire(rng.standard_normal((2, n), dtype=np.float32), 0, fs_hz, 0.0, signal, prns, spec)
        false, searches = false + np.count_nonzero(found["acquired"]), searches + len(found)
    print(f"{signal} {spec}: {false} of {searches} = {false / searches:.3f}")
    assert binom.ppf(2.5e-4, searches, 0.75 * p_fa) <= false <= binom.ppf(1 - 2.5e-4, searches, 1.2 * p_fa)


def detection_probability(cn0_dbhz, threshold, terms, lag, doppler_bins, per_chip, draws=20_000):
    """P(the largest of 3 x 3 cells about the signal exceeds): (1 / K) sum |s + n|^2 of jointly Gaussian cells.

    Cells correlate as 1 - |code| and sinc(Doppler T) exp(i pi Doppler T), and the signal with a cell as a cell at its
    own place would. Off-peak correlation of the code, 1/1023 of the power, adds to the floor. ``lag`` in samples,
    ``doppler_bins`` in bins of 1 / (2 T): the losses between cells are in it.
    """
    rng = np.random.default_rng(5)
    k, d = (g.ravel() for g in np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]))
    k, d = np.append(k, lag), np.append(d, doppler_bins)
    turns = 0.5 * np.subtract.outer(d, d)
    cov = (1 - np.abs(np.subtract.outer(k, k)) / per_chip) * np.sinc(turns) * np.exp(1j * np.pi * turns)
    root = np.linalg.cholesky(cov[:9, :9] + 1e-12 * np.eye(9))
    snr = 10 ** (cn0_dbhz / 10) * 1e-3
    noise = (
        rng.standard_normal((draws, terms, 9)) + 1j * rng.standard_normal((draws, terms, 9))
    ) / math.sqrt(2)
    cells = noise @ root.T + math.sqrt(snr) * cov[:9, 9]
    statistic = np.mean(np.abs(cells) ** 2, axis=1) / (1 + snr / 1023)
    return float(np.mean(statistic.max(axis=1) > threshold))


@pytest.mark.parametrize("terms, levels_dbhz", [(1, (41.0, 43.0, 45.0)), (10, (33.0, 35.0, 37.0))])
@pytest.mark.parametrize("lag, doppler_bins", [(0.0, 0.0), (0.5, 0.5)])
def test_detection_probability_is_that_of_theory(terms, levels_dbhz, lag, doppler_bins):
    """On a cell and in the middle between cells, where code and Doppler cost 1.1 and 0.9 dB; exact to z = 5."""
    fs_hz, trials, rng = 4.096e6, 150, np.random.default_rng(22)
    n = round(terms * 1e-3 * fs_hz)
    spec = AcquisitionSpec(non_coherent=terms, doppler_range_hz=1000.0)
    chips, doppler_hz = -(700 + lag) * CHIP_RATE_HZ / fs_hz, 500.0 * doppler_bins
    for cn0_dbhz in levels_dbhz:
        found = 0
        for _ in range(trials):
            sat = satellite("L1CA", 9, fs_hz, n, doppler_hz, chips % 1023, cn0_dbhz, rng, symbols=False)
            row = acquire(slab([sat], n, rng), 0, fs_hz, 0.0, "L1CA", [9], spec)[0]
            found += bool(row["acquired"])
        p = detection_probability(
            cn0_dbhz, float(row["threshold"]), terms, lag, doppler_bins, fs_hz / CHIP_RATE_HZ
        )
        print(f"{cn0_dbhz} dB-Hz, {terms} blocks: {found} of {trials}, theory {p:.3f}")
        # The floor is estimated from a bin's own 4096 cells: 1 / sqrt(4096 K / 4) of the statistic at z = 1.
        assert abs(found / trials - p) < 5 * math.sqrt(max(p * (1 - p), 1 / trials) / trials) + 0.02


def test_bad_input_is_refused_in_one_sentence():
    noise = np.random.default_rng(21).standard_normal((2, 60_000)).astype(np.float32)
    broken = noise.copy()
    broken[1, 500] = np.nan
    cases = [
        ((noise, 0, 4e6, 0.0, "L5"), "unknown signal"),
        ((noise, 0, 1.0e6, 0.0, "L1CA"), "cannot carry L1CA"),
        ((noise, 0, 2.0e6, 0.0, "E1C"), "cannot carry E1C"),
        ((noise, 0, math.nan, 0.0, "L1CA"), "cannot carry"),
        ((noise, 0, 4e6, 2.1e6, "L1CA"), "beyond fs_hz / 2"),
        ((noise[:, :3000], 0, 4e6, 0.0, "L1CA"), "too short to acquire L1CA: give at least 1 ms"),
        ((noise[:, :20_000], 0, 4e6, 0.0, "E1C"), "too short to acquire E1C: give at least 8 ms"),
        ((broken, 0, 4e6, 0.0, "L1CA"), "NaN or infinity"),
        ((0 * noise, 0, 4e6, 0.0, "L1CA"), "all zero"),
        ((noise[0], 0, 4e6, 0.0, "L1CA"), "shape"),
        ((noise, 0, 4e6, 0.0, "L1CA", [64]), "PRN 64"),
        ((noise, 0, 4e6, 0.0, "L1CA", [1], AcquisitionSpec(non_coherent=50)), "give at least 50 ms"),
    ]
    for arguments, words in cases:
        with pytest.raises(ValueError, match=words) as error:
            acquire(*arguments)
        assert "\n" not in str(error.value)
    for wrong in (
        {"p_fa": 0.0},
        {"gps_prns": (64,)},
        {"galileo_prns": (51,)},
        {"dopler": 1},
        {"coherent_ms": 21},
    ):
        with pytest.raises(ValidationError):
            AcquisitionSpec(**wrong)


def _capture():
    if not CAPTURE.exists():
        pytest.skip("no shared capture beside the checkout")
    raw = np.fromfile(CAPTURE, np.int8).reshape(-1, 2)
    return np.ascontiguousarray(raw.T * np.array([[1], [-1]], np.int8))  # its spectrum is inverted


def test_real_capture_gps():
    iq, fs_hz = _capture(), 4e6
    n = slab_samples("L1CA", fs_hz)
    a, b = (acquire(iq[:, o : o + n], o, fs_hz, 0.0, "L1CA") for o in (0, 1_000_000))
    both = a["acquired"] & b["acquired"]
    # The study's five; 4, 18 and 25 are weaker (35-38 dB-Hz) and stay with their Doppler and code phase.
    assert set(a["prn"][both]) >= {16, 26, 29, 31, 32}
    assert set(a["prn"][a["acquired"]]) <= {16, 26, 29, 31, 32, 4, 18, 25}
    for x, y in zip(a[both], b[both]):
        assert abs(x["doppler_hz"] - y["doppler_hz"]) < 25
        expected = x["code_phase_chips"] + CHIP_RATE_HZ * (1 + x["doppler_hz"] / F_L1_HZ) * 0.25
        assert abs(apart(y["code_phase_chips"], expected, 1023)) < 0.15


@pytest.mark.slow
def test_real_capture_galileo():
    iq, fs_hz = _capture(), 4e6
    n = slab_samples("E1C", fs_hz)
    a = acquire(iq[:, :n], 0, fs_hz, 0.0, "E1C", spec=AcquisitionSpec(workers=2))
    assert set(a["prn"][a["acquired"]]) == {27, 30, 7, 15, 21, 19, 20}


def test_real_capture_galileo_satellites_present():
    iq, fs_hz = _capture(), 4e6
    prns = [27, 30, 7, 15, 21, 19, 20, 1, 2]
    n = slab_samples("E1C", fs_hz)
    a, b = (acquire(iq[:, o : o + n], o, fs_hz, 0.0, "E1C", prns) for o in (0, 1_000_000))
    for found in (a, b):
        assert list(found["acquired"]) == [True] * 7 + [False] * 2
    for x, y in zip(a[:7], b[:7]):
        assert abs(x["doppler_hz"] - y["doppler_hz"]) < 20
        expected = x["code_phase_chips"] + CHIP_RATE_HZ * (1 + x["doppler_hz"] / F_L1_HZ) * 0.25
        assert abs(apart(y["code_phase_chips"], expected, 4092)) < 0.15
