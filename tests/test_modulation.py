"""Code tables against exact waveforms, correlation functions, code spectrum lines."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest

from signals.codes import primary_code, secondary_code
from signals.constants import CHIP_RATE_HZ
from signals.modulation import (
    BLOCK,
    SIGNALS,
    autocorrelation,
    chip_acf,
    chip_waveform,
    code_lines,
    code_table,
    sampled_band_hz,
    worst_lines,
)

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


def exact(signal, prn, waveform, phase_chips):
    """The waveform at any code phase, from its definition."""
    chips, slots = primary_code(signal, prn), chip_waveform(waveform)
    x = np.mod(phase_chips, len(chips))
    k = np.minimum(np.floor(x).astype(int), len(chips) - 1)
    return chips[k] * slots[np.minimum((len(slots) * (x - k)).astype(int), len(slots) - 1)]


def test_signal_definitions():
    for name, signal in SIGNALS.items():
        assert signal.name == name
        assert signal.code_length_chips / signal.code_period_s == pytest.approx(CHIP_RATE_HZ, rel=1e-12)
        assert len(primary_code(name, 1)) == signal.code_length_chips
    assert (SIGNALS["L1CA"].symbol_periods, SIGNALS["E1B"].symbol_periods) == (20, 1)
    assert SIGNALS["E1C"].symbol_periods == 0 and SIGNALS["E1C"].secondary == "CS25_1"


def test_chip_waveforms_have_unit_power_and_cboc_its_split():
    for waveform in ("BPSK", "BOC11", "BOC61", "CBOC+", "CBOC-"):
        assert np.mean(chip_waveform(waveform) ** 2) == pytest.approx(1, abs=1e-15)
    for waveform, sign in (("CBOC+", 1), ("CBOC-", -1)):
        slots = chip_waveform(waveform)
        assert np.mean(slots * np.repeat([1, -1], 6)) == pytest.approx(math.sqrt(10 / 11))
        assert np.mean(slots * chip_waveform("BOC61")) == pytest.approx(sign * math.sqrt(1 / 11))


@pytest.mark.parametrize(
    "signal, waveform, fs_hz",
    [(s, w, fs) for s, w in (("L1CA", "BPSK"), ("E1B", "BOC11")) for fs in (4.0e6, 4.096e6, 5.5e6, 25e6)]
    + [("E1C", "CBOC-", 25e6), ("E1B", "CBOC+", 16.368e6 + 1e3)],
)
def test_every_entry_is_the_waveform_at_its_phase(signal, waveform, fs_hz):
    t = code_table(signal, 7, fs_hz, 16, waveform)
    n_phase, n_cols = t.table.shape
    assert n_cols == math.ceil(t.code_length_chips * fs_hz / CHIP_RATE_HZ) + BLOCK + 8
    assert t.table.dtype == np.int8 and t.table.flags.c_contiguous
    if not waveform.startswith("CBOC"):
        assert t.scale == 1 and set(np.unique(t.table)) == {-1, 1}
    phase = (np.arange(n_cols) + np.arange(n_phase)[:, None] / n_phase) / t.samples_per_chip
    # At a slot's edge the last bit of the phase decides: an entry may belong to either side of it.
    edge = np.abs(phase * 12 - np.rint(phase * 12)) < 1e-7
    error = np.abs(t.table * t.scale - exact(signal, 7, waveform, phase))
    assert np.max(error[~edge]) <= t.scale / 2 * 1.0001
    assert np.mean(edge) < 0.05


@pytest.mark.parametrize(
    "fs_hz, n_phase, limit_db", [(4.096e6, 64, -50), (4.096e6, 256, -56), (10e6, 64, -53)]
)
def test_taps_read_from_a_table_are_exact_at_their_snapped_delay(fs_hz, n_phase, limit_db):
    # A strong signal of exact edges, correlated at every tap of a window of +-1 chip. What is left is the rounding of
    # edges to 1/P sample: each of 511 edges per period moves by at most 1/(2 P) sample, rms 1/(sqrt(12) P), so that
    # the relative error is near 2 sqrt(511) / (sqrt(12) P N); the worst of the taps and phases stays 4 sigma below.
    n = round(fs_hz * 1e-3)
    rng = np.random.default_rng(5)
    t = code_table("L1CA", 24, fs_hz, n_phase)
    sigma = 2 * math.sqrt(511) / (math.sqrt(12) * n_phase * n)
    worst = 0.0
    for phase in rng.uniform(0, 1023, 6):
        x = exact("L1CA", 24, "BPSK", phase + np.arange(n) * CHIP_RATE_HZ / fs_hz)
        for tap in np.arange(-8, 9) / 8:
            q = round((phase + tap) % 1023 * t.samples_per_chip * n_phase)
            got = exact_got = 0.0
            for first in range(0, n, BLOCK):
                m = min(BLOCK, n - first)
                qb = (q + first * n_phase) % round(1023 * t.samples_per_chip * n_phase)
                got += np.dot(x[first : first + m], t.table[qb % n_phase, qb // n_phase :][:m])
            snapped = q / n_phase / t.samples_per_chip
            replica = exact("L1CA", 24, "BPSK", snapped + np.arange(n) * CHIP_RATE_HZ / fs_hz)
            exact_got = np.dot(x, replica)
            worst = max(worst, abs(got - exact_got) / n)
    assert 20 * math.log10(max(worst, 1e-9)) <= limit_db
    assert worst <= max(8 * sigma, 4 / n)


def test_bad_requests_are_refused():
    for kwargs, words in (
        ({"n_phase": 48}, "power of two"),
        ({"fs_hz": math.nan}, "fs_hz"),
        ({"fs_hz": 0}, "fs_hz"),
        ({"waveform": "BOC"}, "unknown waveform"),
        ({"bandlimit_hz": -1.0}, "bandlimit_hz"),
        ({"prn": 99}, "PRN 99"),
        ({"signal": "L2C"}, "L2C"),
    ):
        with pytest.raises(ValueError, match=words):
            code_table(**{"signal": "E1B", "prn": 3, "fs_hz": 4e6} | kwargs)


def _line_powers(t, signal):
    """Power of one code period of the table at multiples of the code rate, sampled at fs P: (k, power)."""
    flat = t.table.T.ravel()[: round(t.code_length_chips * t.samples_per_chip * t.table.shape[0])]
    return np.abs(np.fft.rfft(flat * t.scale) / len(flat)) ** 2


@pytest.mark.parametrize("signal, waveform", [("E1B", "CBOC+"), ("E1C", "CBOC-")])
def test_cboc_at_low_rates_keeps_its_spectrum_and_loses_what_does_not_fit(signal, waveform):
    fs_hz, band_line = 4.096e6, 8192  # fs/2 at k = 8192; the table is a whole number of entries per period
    t = code_table(signal, 11, fs_hz, 64)
    got = _line_powers(t, signal)
    chips, L = np.fft.fft(primary_code(signal, 11)), 4092
    k = np.arange(1, 6 * band_line)
    nu = k / L
    sinc = np.sinc(nu / 12) / 12

    def transform(slots):
        return sinc * (np.exp(-2j * np.pi * np.outer(nu, (np.arange(12) + 0.5) / 12)) @ slots)

    sign = 1 if waveform == "CBOC+" else -1
    boc61 = np.where(k <= band_line, transform(chip_waveform("BOC61")), 0)
    wanted = math.sqrt(10 / 11) * transform(np.repeat([1.0, -1.0], 6)) + sign * math.sqrt(1 / 11) * boc61
    wanted = np.abs(chips[k % L] / L * wanted) ** 2
    # int8 levels: rounding noise scale^2 / 12 spread over all lines; interpolation errs 2 % of limited components; 1.5
    # sharp edges per chip, up to half a step of 1/256 chip early or late: a quarter on average, of power 4.
    noise = t.scale**2 / 12
    assert np.sum(np.abs(got[1 : 6 * band_line] - wanted)) < 2 * noise + 0.002 + 1.5 * 4 * 0.25 / 256
    assert got[k][k > 5.5 * 4092].sum() < 0.1 * np.sum(
        np.abs(chips[k % L] / L * transform(chip_waveform("BOC61"))) ** 2
    )


@pytest.mark.parametrize("signal, waveform", [("L1CA", "BPSK"), ("E1B", "BOC11"), ("E1C", "CBOC-")])
def test_band_limit_is_a_brick_wall(signal, waveform):
    limit_hz = 1.8e6
    t = code_table(signal, 3, 8.184e6, 16, waveform, bandlimit_hz=limit_hz)
    power = _line_powers(t, signal)
    freq_hz = np.arange(len(power)) / SIGNALS[signal].code_period_s
    lines_hz, level_db = code_lines(signal, 3, waveform, max_hz=limit_hz)
    inside = 10 ** (level_db / 10)
    assert power[: len(lines_hz)] == pytest.approx(inside, abs=0.03 * inside.max())
    assert power[freq_hz > limit_hz].sum() < 2 * t.scale**2 / 12 + 1e-3


def test_rates_that_stand_still_against_the_chips():
    for places, fs_hz in ((2, 2.046e6), (5, 2.5575e6), (4, 4.092e6), (16, 16.368e6), (63, 63 * 1.023e6)):
        assert sampled_band_hz(fs_hz) == fs_hz / 2, places
    # 2048 places on 1023 chips, 4000 on 1023, 100 on 31, 64 on 1; and a clock 1 ppm off slides by a chip a second.
    for fs_hz in (2.048e6, 4e6, 3.3e6, 65.472e6, 4.092e6 * (1 + 1e-6)):
        assert sampled_band_hz(fs_hz) is None


@pytest.mark.parametrize("signal, fs_hz", [("L1CA", 2.046e6), ("L1CA", 4.092e6), ("E1B", 4.092e6)])
def test_delays_between_samples_are_seen_at_whole_samples_per_chip(signal, fs_hz):
    """Early minus late of a replica vanishes at the delay of the code, wherever between samples that lies."""
    per_chip, n_tx, n_rx = round(fs_hz / CHIP_RATE_HZ), 256, 64
    n = SIGNALS[signal].code_length_chips * per_chip

    def samples(table, chips):
        q = round(chips * per_chip * table.table.shape[0])
        return table.table[q % table.table.shape[0], (q // table.table.shape[0] + np.arange(n)) % n] * 1.0

    sent = code_table(signal, 3, fs_hz, n_tx)
    replica = code_table(signal, 3, fs_hz, n_rx, "BPSK" if signal == "L1CA" else "BOC11")
    spacing, step = 0.25, 1 / (n_rx * per_chip)
    for delay in (np.arange(5) + 0.3) / 5 / per_chip:
        x = samples(sent, 10 + delay)
        early, late = (
            np.array([x @ samples(replica, 10 + k * step + side) for k in range(-n_rx, n_rx)])
            for side in (spacing / 2, -spacing / 2)
        )
        crossing = np.flatnonzero(np.diff(np.sign(early - late)))
        near = crossing[np.argmin(np.abs(crossing - n_rx - delay / step))]
        # Half a step of each grid, and the place of the crossing between two steps.
        assert abs((near + 0.5 - n_rx) * step - delay) <= (1 / n_rx + 0.5 / n_rx + 0.5 / n_tx) / per_chip


def test_chip_correlation_in_a_band():
    d = np.linspace(-1.2, 1.2, 25)
    for tx, rx in (("BPSK", "BPSK"), ("CBOC-", "BOC11")):
        # What lies beyond B carries less than 12 slopes / (2 pi^2 B/fc) of the power (edges of p: 1 / (pi nu)^2 each).
        assert chip_acf(d, tx, rx, 1e9) == pytest.approx(
            chip_acf(d, tx, rx), abs=12 / (np.pi**2 * 1e9 / CHIP_RATE_HZ)
        )
    # The main lobe of sinc^2 holds 90.28 %.
    assert chip_acf(0.0, bandlimit_hz=CHIP_RATE_HZ) == pytest.approx(0.9028, abs=5e-5)


@pytest.mark.parametrize("waveform", ["BPSK", "BOC11", "CBOC+", "CBOC-"])
def test_autocorrelation_by_brute_force(waveform):
    signal = "L1CA" if waveform == "BPSK" else "E1C"
    length = SIGNALS[signal].code_length_chips
    fine = 48  # samples per chip, at slot centres of a multiple of 12: the sum is the integral
    x = (np.arange(length * fine) + 0.5) / fine
    tx = exact(signal, 9, waveform, x)
    for shift in (0, 1, 5, 24, 48, 61, 48 * 7 + 11, -13):
        for rx in (waveform, "BOC11"):
            brute = np.mean(tx * exact(signal, 9, rx, x + shift / fine))
            assert autocorrelation(signal, 9, shift / fine, waveform, rx) == pytest.approx(brute, abs=1e-12)


def test_chip_correlation_functions():
    d = np.linspace(-1.5, 1.5, 301)
    triangle = np.maximum(1 - np.abs(d), 0)
    assert chip_acf(d) == pytest.approx(triangle, abs=1e-12)
    boc = np.where(np.abs(d) <= 0.5, 1 - 3 * np.abs(d), np.where(np.abs(d) <= 1, np.abs(d) - 1, 0))
    assert chip_acf(d, "BOC11") == pytest.approx(boc, abs=1e-12)
    assert chip_acf(0.0, "CBOC+", "BOC11") == pytest.approx(math.sqrt(10 / 11))
    assert chip_acf(d, "CBOC-") == pytest.approx(chip_acf(-d, "CBOC-"), abs=1e-12)
    # Sum over the code: R(d) = sum over m of the chips' correlation at m times the chip function at d - m.
    chips = primary_code("E1B", 21)
    acf = np.rint(np.fft.irfft(np.abs(np.fft.rfft(chips)) ** 2, 4092)) / 4092
    total = sum(acf[m % 4092] * chip_acf(d - m, "CBOC+", "BOC11") for m in range(-3, 4))
    assert autocorrelation("E1B", 21, d, "CBOC+", "BOC11") == pytest.approx(total, abs=1e-12)


def test_all_lines_sum_to_one():
    # Both sides, k = 0 once; beyond F the spectrum of BPSK falls as 1 / (pi^2 nu^2): 1 / (pi^2 F) is missing, at most
    # 1 / (pi^2 F) times 2 (BOC 1,1) or 2 (10/11) + 12 / 11 (CBOC).
    for signal, waveform, edges in (("L1CA", "BPSK", 1), ("E1B", "BOC11", 3), ("E1B", "CBOC+", 6)):
        _, level_db = code_lines(signal, 5, waveform, max_hz=100 * CHIP_RATE_HZ)
        power = 10 ** (level_db / 10)
        total = power[0] + 2 * power[1:].sum()
        assert 1 - 2 * edges / (math.pi**2 * 100) < total < 1


def test_worst_lines_of_the_design_study():
    ca = worst_lines("L1CA", prns=range(1, 33))
    six = ca[5]
    assert six["freq_hz"] == 227e3 and six["level_db"] == pytest.approx(-21.29, abs=0.01)
    order = ca["prn"][np.argsort(-ca["level_db"])][:5]
    assert list(order) == [24, 6, 18, 8, 5]
    assert ca[23]["freq_hz"] == 123e3 and ca[23]["level_db"] == pytest.approx(-21.263, abs=0.001)
    facts = {
        ("E1B", "BOC11"): [(38, 673.5, -28.81), (26, 808.0, -29.43), (40, 617.75, -29.50)],
        ("E1B", "CBOC+"): [(38, 673.5, -28.94), (40, 617.75, -29.61), (26, 808.0, -29.65)],
        ("E1C", "BOC11"): [(16, 839.0, -28.26), (11, 695.25, -29.12), (20, 707.0, -29.38)],
        ("E1C", "CBOC-"): [(16, 839.0, -28.85), (11, 695.25, -29.81), (17, 949.5, -29.97)],
    }
    for (signal, waveform), top in facts.items():
        lines = worst_lines(signal, waveform)
        lines = lines[np.argsort(-lines["level_db"])]
        for line, (prn, khz, level_db) in zip(lines, top):
            assert (line["prn"], line["freq_hz"] / 1e3) == (prn, khz)
            assert line["level_db"] == pytest.approx(level_db, abs=0.006)


def test_secondary_code_spreads_the_lines_of_the_pilot():
    tiered = worst_lines("E1C", "BOC11", tiered=True)
    worst = tiered[np.argmax(tiered["level_db"])]
    assert (worst["prn"], worst["freq_hz"]) == (16, 838.98e3)
    assert worst["level_db"] == pytest.approx(-39.61, abs=0.006)
    lines = 20 * np.log10(np.abs(np.fft.fft(secondary_code())) / 25)
    assert lines.max() == pytest.approx(-11.35, abs=0.01) and lines[0] == pytest.approx(-13.98, abs=0.01)
    with pytest.raises(ValueError, match="no secondary code"):
        code_lines("L1CA", 1, tiered=True)


@pytest.mark.skipif(
    not (SHARED / "galileo_e1_worst_lines.csv").exists(), reason="no shared tables beside the checkout"
)
def test_worst_line_of_every_code_against_the_shared_tables():
    for name, signal in (("gps_l1ca_worst_lines.csv", "L1CA"), ("galileo_e1_worst_lines.csv", None)):
        with (SHARED / name).open() as file:
            rows = list(csv.DictReader(file))
        lines = {
            (s, w): worst_lines(s, w)
            for s, w in {(r.get("signal", signal), r.get("waveform", "BPSK")) for r in rows}
        }
        for row in rows:
            table = lines[row.get("signal", signal), row.get("waveform", "BPSK")]
            line = table[table["prn"] == int(row["prn"])][0]
            assert line["freq_hz"] == float(row["worst_khz"]) * 1e3
            assert line["level_db"] == pytest.approx(float(row["level_db"]), abs=0.0051)
