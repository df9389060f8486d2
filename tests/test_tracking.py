"""The tracking kernel: correlator twin, closed loops against theory, synchronisation, robustness."""

from itertools import pairwise

import numpy as np
import pytest
from naive_correlator import correlate, rounding_chips
from tracking_signal import Satellite, amplitude, mix, noise, slab, track

from signals.modulation import autocorrelation, code_table
from tracking import lock, loops
from tracking.channel import STATE_LOCKED, E1Tracking, L1caTracking, TrackingSpec
from tracking.records import AIDING

FS = 4.096e6


def spec_for(signal, arithmetic="auto", **settings):
    return TrackingSpec(arithmetic=arithmetic, **{"l1ca" if signal == "L1CA" else "e1": settings})


def component_cn0(signal, cn0_dbhz):
    """C/N0 of the component that is tracked."""
    return cn0_dbhz - (0.0 if signal == "L1CA" else 10 * np.log10(2))


# ------------------------------------------------------------------------------------------------- correlator
@pytest.mark.parametrize(
    "signal, settings, fs, if_hz",
    [
        ("L1CA", {}, FS, 0.0),
        ("L1CA", {"taps": {"count": 35, "spacing_chips": 0.65}}, 5.0037e6, 1.2e6),
        ("E1C", {}, FS, 0.0),
        ("E1C", {"taps": {"count": 37, "spacing_chips": 0.25}, "replica": "CBOC"}, 16.368e6, -4.1e5),
    ],
)
@pytest.mark.parametrize("arithmetic", ["auto", "float"])
def test_taps_equal_the_double_precision_twin(signal, settings, fs, if_hz, arithmetic):
    """Below -120 dB of the largest tap in single precision, below -90 dB in integers.

    Single precision: sums of 1024 products, 6e-8 sqrt(1024) of the noise. Integers: two products rounded to 2^-7 and a
    carrier rounded to 2^-15 make 0.0035 per sample, 0.0035 / sqrt(n) in a tap, and the prompt at 55 dB-Hz is 9.8 at
    4.096 Msps, 4.9 at 16.368 Msps: -105 dB rms, 12 dB for the worst of 38 taps times 13 integrations and for taps
    that the strong carrier table error shares.
    """
    sat = Satellite(signal, 11, fs, if_hz, doppler_hz=-2345.6, code_chips=77.7)
    tracker = spec_for(signal, arithmetic, **settings).start(fs, if_hz)
    c = tracker.add(sat.acquisition(0, 40.0, 0.2))
    gate = 1e-6 if arithmetic == "float" else 10 ** (-90 / 20)
    iq = slab([sat], 55.0, 0, int(0.05 * fs), np.random.default_rng(1))
    epochs, counts, corr = tracker.process(0, iq)
    waveform = "BPSK" if signal == "L1CA" else ("BOC11" if "replica" not in settings else None)
    st = tracker.channels[c]
    table = code_table(signal, 11, fs, int(st["n_phase"]), waveform)
    grid = int(st["n_phase"]) * fs / 1.023e6
    taps_q = np.round(tracker.taps_chips(c) * grid).astype(int)
    assert counts[c] >= 10
    for k in range(0, counts[c], 4):
        want = correlate(epochs[c, k], iq, table, taps_q, fs, if_hz)
        assert np.max(np.abs(corr[c, k, : len(want)] - want)) < gate * np.max(np.abs(want))


def test_taps_equal_the_twin_over_20_ms():
    """Twenty code periods: the carrier's phase runs through, the code's fraction of a sample is carried over."""
    sat = Satellite("L1CA", 3, FS, doppler_hz=1500.0, symbols=np.ones(1000))
    spec = TrackingSpec()
    tracker = spec.start(FS)
    tracker.add(sat.acquisition())
    iq = slab([sat], 50.0, 0, int(1.0 * FS), np.random.default_rng(5))
    # Without bit transitions nothing can be synchronised: tell the channel.
    tracker.channels["state"], tracker.channels["symbol_phase"] = STATE_LOCKED, 0
    tracker.channels["settling"] = 1
    epochs, counts, corr = tracker.process(0, iq)
    table = code_table("L1CA", 3, FS, 64)
    taps_q = np.round(tracker.taps_chips(0) * 64 * FS / 1.023e6).astype(int)
    assert epochs[0, 5]["n_samples"] == pytest.approx(0.02 * FS, abs=2)
    for k in (3, 20, int(counts[0]) - 1):
        want = correlate(epochs[0, k], iq, table, taps_q, FS, 0.0)
        assert np.max(np.abs(corr[0, k] - want)) < 10 ** (-90 / 20) * np.max(np.abs(want))


@pytest.mark.parametrize("replica", ["BOC11", "CBOC"])
def test_full_scale_samples_do_not_overflow(replica):
    """Samples at the rails in step with the code, the largest sums there can be: as in double precision."""
    fs = 16.368e6
    sat = Satellite("E1C", 30, fs, doppler_hz=0.0, phase0=0.125)
    sat.data[:] = 0.0
    tracker = spec_for("E1C", replica=replica).start(fs)
    tracker.add(sat.acquisition())
    z = sat.samples(0, int(0.03 * fs))
    iq = np.stack([np.where(z.real > 0, 127, -128), np.where(z.imag > 0, 127, -128)]).astype(np.int8)
    epochs, counts, corr = tracker.process(0, iq)
    table = code_table(
        "E1C", 30, fs, int(tracker.channels["n_phase"][0]), "BOC11" if replica == "BOC11" else None
    )
    q = np.round(tracker.taps_chips(0) * len(table.table) * fs / 1.023e6).astype(int)
    for k in range(int(counts[0])):
        want = correlate(epochs[0, k], iq, table, q, fs, 0.0)
        assert np.max(np.abs(corr[0, k] - want)) < 10 ** (-75 / 20) * np.max(np.abs(want))
    assert np.max(np.abs(want)) > 0.7 * 127 * np.sqrt(2)


def test_multicorrelator_sees_the_autocorrelation():
    """Noise-free: the window of 35 taps at 0.65 chip, lobes included, is R(d - error) of the code."""
    sat = Satellite("L1CA", 6, FS, doppler_hz=800.0, phase0=0.0)
    tracker = TrackingSpec(l1ca={"taps": {"count": 35, "spacing_chips": 0.65}}).start(FS)
    c = tracker.add(sat.acquisition())
    z = 100.0 * sat.samples(0, int(0.02 * FS))
    iq = np.stack([z.real, z.imag]).astype(np.float32)
    epochs, counts, corr = tracker.process(0, np.ascontiguousarray(iq))
    assert tracker.window(c) == 35 and counts[c] >= 10
    taps, error = tracker.taps_chips(c), sat.code_error(epochs[c, :10])
    want = [autocorrelation("L1CA", 6, taps + e) for e in error]
    # A sampled code: each of about 512 transitions is placed to 1/4 sample; 5 / sqrt(12 * 512) / 4 and rounding.
    assert np.max(np.abs(np.abs(corr[c, :10]) / 100.0 - np.abs(want))) < 0.03
    assert np.all(np.diff(taps[:35]) > 0) and taps[17] == 0.0


@pytest.mark.parametrize("signal", ["L1CA", "E1C"])
def test_same_bits_for_any_slab_size_and_threads(signal):
    """Results depend neither on where slabs are cut nor on the number of threads."""
    sats = [Satellite(signal, p, FS, doppler_hz=700.0 * p, code_chips=90.0 * p, seed=p) for p in (2, 9)]
    iq = slab(sats, 45.0, 0, int(0.9 * FS), np.random.default_rng(2))

    def run(sizes, threads):
        tracker = TrackingSpec(threads=threads).start(FS)
        for s in sats:
            tracker.add(s.acquisition(0, 20.0, 0.1))
        n0, k, out = 0, 0, [[], []]
        while n0 < iq.shape[1]:
            n = min(sizes[k % len(sizes)], iq.shape[1] - n0)
            e, counts, z = tracker.process(n0, np.ascontiguousarray(iq[:, n0 : n0 + n]))
            for c in range(2):
                out[c].append(e[c, : counts[c]].tobytes() + z[c, : counts[c]].tobytes())
            n0, k = n0 + n, k + 1
        return [b"".join(x) for x in out], [
            tracker.channels[n].tobytes() for n in ("code_phase_chips", "carrier_cycles")
        ]

    def split(out):
        return out

    sizes = [(409600,), (20011, 81920, 1000), (81920,)]
    rows = [run(s, t) for s, t in zip(sizes, (1, 1, 2))]
    assert rows[0][1] == rows[1][1] == rows[2][1]
    assert sorted(map(len, rows[0][0])) == sorted(map(len, rows[1][0]))


@pytest.mark.parametrize("dtype", [np.int16, np.float32])
def test_sample_types_agree(dtype):
    sat = Satellite("L1CA", 4, FS, doppler_hz=100.0)
    iq = slab([sat], 45.0, 0, int(0.05 * FS), np.random.default_rng(3))
    want, got = ([], [])
    for out, data in ((want, iq), (got, iq.astype(dtype))):
        tracker = TrackingSpec(arithmetic="float").start(FS)
        tracker.add(sat.acquisition())
        out.extend(tracker.process(0, data))
    assert want[1][0] == got[1][0]
    np.testing.assert_array_equal(want[2], got[2])


# ------------------------------------------------------------------------------------------------ closed loops
def closed_loop(signal, cn0s, seconds, pll_bw, dll_bw, seed):
    """Track the same signal at several C/N0; EPOCH rows after 2 s with code and phase errors -> list of dicts."""
    sat = Satellite(
        signal, 5, FS, doppler_hz=1711.3, code_chips=300.3, waveform=None if signal == "L1CA" else "BOC11"
    )
    spec = spec_for(signal, pll_bw_hz=pll_bw, dll_bw_hz=dll_bw)
    trackers = [spec.start(FS) for _ in cn0s]
    for t in trackers:
        t.add(sat.acquisition(0, 30.0, 0.1))
    rng, count, out = np.random.default_rng(seed), int(0.1 * FS), [[] for _ in cn0s]
    for k in range(round(seconds * 10)):
        s, z = sat.samples(k * count, count), noise(rng, count, 25.0)
        for i, cn0 in enumerate(cn0s):
            e, n, _ = trackers[i].process(k * count, mix(z, s, amplitude(cn0, FS, 25.0)))
            out[i].append(e[0, : n[0]])
    rows = []
    for cn0, parts in zip(cn0s, out):
        e = np.concatenate(parts)
        e = e[e["sample_index"] > 2.0 * FS]
        phase = sat.phase_error(e)
        phase -= np.round(np.mean(phase) * 2) / 2
        rows.append(
            {"cn0": component_cn0(signal, cn0), "epochs": e, "code": sat.code_error(e), "phase": phase}
        )
    return rows, trackers


def check_jitter(signal, seconds, worst):
    """Prompt amplitude, code error and phase jitter against theory.

    A loop of noise bandwidth B gives 2 B t independent values in t seconds: sigma is known to 1 / sqrt(4 B t), five of
    which are allowed. Rounding the replica to 1/64 sample adds 0.0011 chip (uniform) to the code error.
    """
    pll_bw, dll_bw, T = 10.0, 5.0, 0.02
    rows, trackers = closed_loop(signal, (35.0, 40.0, 45.0), seconds, pll_bw, dll_bw, seed=11)
    for row, tracker in zip(rows, trackers):
        cn0, e = row["cn0"], row["epochs"]
        assert np.all(e["state"] == STATE_LOCKED) and not e["cycle_slip"].any()
        st = tracker.channels[0]
        spacing = float(np.subtract(*tracker.taps_chips(0)[[st["early"], st["late"]]]))
        slope = 1.0 if signal == "L1CA" else 3.0
        # Gain of the noncoherent discriminators below one: 1 - 1 / (2 T C/N0 R(d/2)^2) and less; in the tolerance.
        code = loops.dll_jitter_chips(cn0, dll_bw, T, spacing, slope, 1 - slope * spacing)
        phase = loops.pll_jitter_cycles(cn0, pll_bw, T, costas=signal == "L1CA")
        t = seconds - 2.0
        assert np.std(row["phase"]) / phase == pytest.approx(
            1.0, abs=min(worst, 5 / np.sqrt(4 * pll_bw * t) + 0.03)
        )
        assert np.std(row["code"]) / code == pytest.approx(
            1.0, abs=min(worst, 5 / np.sqrt(4 * dll_bw * t) + 0.03)
        )
        assert abs(np.mean(row["phase"])) < 5 * phase / np.sqrt(2 * pll_bw * t)
        assert abs(np.mean(row["code"])) < 5 * code / np.sqrt(2 * dll_bw * t) + 1e-3
        # Prompt: 1 - slope E|code error| of the peak, cos of the phase error; rounding to int8 and tables 0.3 %.
        a = amplitude(cn0, FS, 25.0)
        want = (1 - slope * np.mean(np.abs(row["code"]))) * np.mean(np.cos(2 * np.pi * row["phase"]))
        standard_error = 25.0 / a / np.sqrt(t * FS)
        assert np.mean(np.abs(e["prompt_i"])) / a == pytest.approx(want, abs=5 * standard_error + 0.004)
        # Estimators see the signal after that loss.
        loss = 20 * np.log10(want)
        for name in ("cn0_dbhz", "cn0_prompt_dbhz"):
            mean = 10 * np.log10(np.mean(10 ** (e[name] / 10)))
            assert mean - loss == pytest.approx(cn0, abs=0.5)


@pytest.mark.parametrize("signal", ["L1CA", "E1C"])
def test_jitter_amplitude_and_cn0_are_what_theory_says(signal):
    check_jitter(signal, 14.0, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("signal", ["L1CA", "E1C"])
def test_jitter_within_10_percent(signal):
    check_jitter(signal, 140.0, 0.10)


def test_jitter_at_other_settings():
    """Spacings, integrations, discriminators and bandwidths on one signal of 42 dB-Hz: sigma and mean as in theory.

    3 % for the gain of the discriminators below one and for rounding, as above.
    """
    cn0, seconds = 42.0, 16.0
    settings = [{"early_late_space_chips": d} for d in (0.1, 0.25, 1.0)]
    settings += [{"integration_ms": t} for t in (1, 4, 10)]
    settings += [{"code_discriminator": d} for d in ("power", "dot_product", "coherent")]
    settings += [{"dll_bw_hz": 1.0, "pll_bw_hz": 5.0}, {"pll_bw_hz": 15.0, "integration_ms": 10}]
    sat = Satellite("L1CA", 5, FS, doppler_hz=1711.3, code_chips=300.3)
    specs = [spec_for("L1CA", **({"pll_bw_hz": 10.0, "dll_bw_hz": 5.0} | s)) for s in settings]
    trackers, rng, count = [s.start(FS) for s in specs], np.random.default_rng(3), int(0.1 * FS)
    heard = [[] for _ in trackers]
    for t in trackers:
        t.add(sat.acquisition(0, 30.0, 0.1))
    for k in range(round(seconds * 10)):
        iq = mix(noise(rng, count, 25.0), sat.samples(k * count, count), amplitude(cn0, FS, 25.0))
        for tracker, rows in zip(trackers, heard):
            e, n, _ = tracker.process(k * count, iq)
            rows.append(e[0, : n[0]])
    for setting, spec, rows in zip(settings, specs, heard):
        e, loop = np.concatenate(rows), spec.l1ca
        e = e[e["sample_index"] > 2.0 * FS]
        assert np.all(e["state"] == STATE_LOCKED), setting
        code, phase, T = sat.code_error(e), sat.phase_error(e), loop.integration_ms * 1e-3
        phase -= np.round(np.mean(phase) * 2) / 2
        coherent = loop.code_discriminator == "coherent"
        code_sigma = loops.dll_jitter_chips(
            cn0, loop.dll_bw_hz, T, loop.early_late_space_chips, coherent=coherent
        )
        phase_sigma = loops.pll_jitter_cycles(cn0, loop.pll_bw_hz, T)
        for error, sigma, bw in ((code, code_sigma, loop.dll_bw_hz), (phase, phase_sigma, loop.pll_bw_hz)):
            n = 2 * bw * (seconds - 2.0)
            assert np.std(error) / sigma == pytest.approx(1.0, abs=5 / np.sqrt(2 * n) + 0.03), setting
            assert abs(np.mean(error)) < 5 * sigma / np.sqrt(n) + 5e-4, setting


@pytest.mark.parametrize("window_s", [0.2, 1.0, 5.0])
@pytest.mark.parametrize("T_ms", [1, 4, 20])
def test_cn0_estimators_are_unbiased(T_ms, window_s):
    """Mean of the estimates, in Hz, of integrations drawn by their definition, 25 to 55 dB-Hz."""
    rng, fs = np.random.default_rng(9), 4e6
    n, n_noise, n_samples = round(window_s / T_ms * 1e3), round(window_s * 1e3), round(T_ms * 1e-3 * fs)
    trials = 1000 if n < 600 else 200
    for cn0 in (25.0, 30.0, 40.0, 55.0):
        z = rng.standard_normal((2, trials, n)) * np.sqrt(0.5 / n_samples)
        i2, q2 = (np.sqrt(10 ** (cn0 / 10) / fs) + z[0]) ** 2, z[1] ** 2
        sample_noise = rng.gamma(n_noise, 1 / n_noise, trials)
        power, m2, m4 = np.mean(i2 + q2, axis=1), np.mean(i2, axis=1), np.mean(i2**2, axis=1)
        for estimates, systematic in (
            (
                [
                    lock.cn0_noise_reference_dbhz(p, n_samples, v, n_noise, fs)
                    for p, v in zip(power, sample_noise)
                ],
                0.0,
            ),
            # A ratio of sample moments: 0.35 dB from a fifth of a second at 25 dB-Hz.
            ([lock.cn0_moments_dbhz(a, b, n, T_ms * 1e-3) for a, b in zip(m2, m4)], 0.1),
        ):
            ratio = 10 ** (np.array(estimates) / 10 - cn0 / 10)
            assert abs(np.mean(ratio) - 1) < 5 * np.std(ratio) / np.sqrt(trials) + systematic, cn0


@pytest.mark.parametrize("signal, order", [("L1CA", 3), ("L1CA", 2), ("E1C", 3)])
def test_loop_filters_follow_their_equations(signal, order):
    """From the reported errors the next NCO frequency and code phase follow by the equations of ``loops``.

    Errors are stored in single precision: 6e-8 of 0.1 cycle over T, summed over 100 integrations.
    """
    T, bw, dll_bw = 0.02, 8.0, 2.0
    sat = Satellite(signal, 14, FS, doppler_hz=650.0, ramp_hz_s=20.0 if order == 3 else 1.0)
    tracker = spec_for(signal, pll_order=order, pll_bw_hz=bw, dll_order=2, dll_bw_hz=dll_bw).start(FS)
    tracker.add(sat.acquisition())
    track(tracker, [sat], 45.0, 2.0, seed=3)
    st = tracker.channels[0].copy()
    assert st["settling"] == 0
    rate, accel, code_rate = float(st["rate_hz"]), float(st["rate_hz_s"]), float(st["code_rate_chips_s"])
    (e,), _ = track(tracker, [sat], 45.0, 2.0, seed=4, start=20 * int(0.1 * FS))
    k1, k2, k3 = loops.pll_gains(order, bw, T)
    c1, c2 = loops.dll_gains(2, dll_bw, T)
    e = e[e["sample_index"] >= st["start_sample"]]
    for now, following in pairwise(e):
        phase, code = float(now["phase_error_cycles"]), float(now["code_error_chips"])
        accel += k3 * phase / T**2
        rate += k2 * phase / T + accel * T
        assert following["doppler_hz"] == pytest.approx(rate + k1 * phase / T, abs=1e-3)
        run_hz = 1.023e6 * (1 + now["doppler_hz"] / 1575.42e6) + code_rate
        reached = now["code_phase_chips"] + run_hz / FS * now["n_samples"]
        step = (following["code_phase_chips"] - reached + sat.length / 2) % sat.length - sat.length / 2
        assert step == pytest.approx(c1 * code, abs=1e-6)
        code_rate += c2 * code / T
    assert len(e) > 90


def test_the_replicas_rounding_is_taken_out_of_the_code_error():
    sat = Satellite("L1CA", 14, FS, doppler_hz=3333.0)
    tracker = TrackingSpec(arithmetic="float").start(FS)
    tracker.add(sat.acquisition())
    track(tracker, [sat], 45.0, 1.0, seed=3)
    (e,), (z,) = track(tracker, [sat], 45.0, 0.5, seed=4, start=10 * int(0.1 * FS))
    st, table = tracker.channels[0], code_table("L1CA", 14, FS, 64)
    spacing, largest = np.subtract(*tracker.taps_chips(0)[[st["early"], st["late"]]]), 0.0
    for row, taps in zip(e[1:], z[1:]):
        early, late = np.abs(taps[st["early"]]), np.abs(taps[st["late"]])
        raw = (early - late) / (early + late) * (1 - spacing / 2)
        want = rounding_chips(row, table, FS)
        largest = max(largest, abs(want))
        assert row["code_error_chips"] - raw == pytest.approx(want, abs=1e-6)
    assert largest > 1e-5


@pytest.mark.parametrize("signal", ["L1CA", "E1C"])
def test_a_frequency_ramp_is_followed(signal):
    """5 g towards the satellite: 257 Hz/s; a third-order loop has no steady phase error."""
    sat = Satellite(signal, 8, FS, doppler_hz=300.0, ramp_hz_s=257.0, code_chips=10.0)
    tracker = spec_for(signal, pll_bw_hz=15.0).start(FS)
    tracker.add(sat.acquisition())
    (e,), _ = track(tracker, [sat], 45.0, 2.5, seed=4)
    e = e[e["sample_index"] > 1.5 * FS]
    assert np.all(e["state"] == STATE_LOCKED) and not e["cycle_slip"].any()
    phase = sat.phase_error(e)
    phase -= np.round(np.mean(phase) * 2) / 2
    sigma = loops.pll_jitter_cycles(component_cn0(signal, 45.0), 15.0, 0.02)
    # Within an integration the NCO stands still: the phase bends by ramp T^2 / 24 = 0.004 cycle about the middle.
    assert abs(np.mean(phase)) < 5 * sigma / np.sqrt(2 * 15.0) + 0.006
    assert np.max(np.abs(sat.code_error(e))) < 0.05
    assert np.mean(e["doppler_hz"] - sat.doppler(e["sample_index"] + e["n_samples"] / 2)) == pytest.approx(
        0, abs=1.5
    )


# ------------------------------------------------------------------------------------------- synchronisation
@pytest.mark.parametrize(
    "signal, cn0, doppler_error, code_error",
    [
        ("L1CA", 45.0, 150.0, 0.5),
        ("L1CA", 40.0, -100.0, -0.5),
        ("L1CA", 30.0, 60.0, 0.2),
        ("L1CA", 30.0, -100.0, -0.4),
        ("E1C", 45.0, 60.0, 0.5),
        ("E1C", 36.0, -60.0, -0.5),
        ("E1C", 36.0, -125.0, 0.25),
    ],
)
def test_pull_in_from_acquisition_errors(signal, cn0, doppler_error, code_error):
    """Right frequency (no alias of the Costas loop), right peak, right symbol edge, right symbols."""
    sat = Satellite(signal, 12, FS, doppler_hz=-1200.0, code_chips=4000.0 + 700.0, seed=5)
    tracker = TrackingSpec().start(FS)
    tracker.add(sat.acquisition(0, doppler_error, code_error))
    symbols, rng, count = [], np.random.default_rng(7), int(0.1 * FS)
    for k in range(25 if cn0 > 32 else 45):
        tracker.process(k * count, slab([sat], cn0, k * count, count, rng))
        symbols.append(tracker.symbols[0, : tracker.symbol_counts[0]].copy())
    st = tracker.channels[0]
    assert st["state"] == STATE_LOCKED and st["phase_locked"]
    assert st["rate_hz"] == pytest.approx(sat.doppler_hz, abs=4.0)
    replica = tracker.snapshot((k + 1) * count)[0]
    truth = sat.code_phase((k + 1) * count)
    assert abs((replica["code_phase_chips"] - truth + 0.5) % sat.length - 0.5) < 0.12
    rows = np.concatenate(symbols)[20 if signal == "L1CA" else 100 :]
    # Symbol 0 is sent at code phase 0; the middle of a symbol is half its length after its first sample.
    per_symbol = 20 * 1023 if signal == "L1CA" else 4092
    index = np.floor((sat.code_phase(rows["sample_index"]) + per_symbol / 2) / per_symbol).astype(int)
    want, got = sat.symbols[index], rows["soft"]
    if signal == "E1C":
        got = -got  # composite sign: no ambiguity with the pilot's secondary code upright
    elif np.sum(want * got) < 0:
        got = -got
    energy = 10 ** (component_cn0(signal, cn0) / 10) * (0.02 if signal == "L1CA" else 0.004)
    from scipy.stats import norm

    p = norm.sf(np.sqrt(2 * energy)) + 1e-9
    errors = np.count_nonzero(np.sign(got) != want)
    assert errors <= p * len(want) * 1.5 + 5 * np.sqrt(p * len(want)) + 1
    assert len(want) > 20


@pytest.mark.parametrize("side", [-0.5, 0.5])
@pytest.mark.parametrize("discriminator", ["envelope", "very_early_late"])
def test_a_channel_on_a_side_peak_returns(side, discriminator):
    """A locked BOC channel displaced to a side peak is back within 1 s; the pilot stays upright."""
    sat = Satellite("E1C", 20, FS, doppler_hz=500.0)
    tracker = TrackingSpec(e1={"code_discriminator": discriminator}).start(FS)
    tracker.add(sat.acquisition())
    track(tracker, [sat], 40.0, 1.2, seed=1)
    tracker.channels["code_phase_chips"] += side
    start = 12 * int(0.1 * FS)
    (e,), _ = track(tracker, [sat], 40.0, 1.0, seed=2, start=start)
    error = sat.code_error(e)
    assert abs(abs(error[1]) - 0.5) < 0.1  # row 0 had begun before
    back = 1 + np.flatnonzero(np.abs(error[1:]) < 0.1)[0]
    assert (e["sample_index"][back] - start) / FS < 0.3
    assert np.all(np.abs(error[-20:]) < 0.05) and np.all(e["prompt_i"][-20:] > 0)


def test_channels_without_a_signal_are_lost_and_their_index_is_used_again():
    sat = Satellite("L1CA", 2, FS)
    tracker = TrackingSpec().start(FS)
    tracker.add(sat.acquisition())
    tracker.add(Satellite("E1C", 2, FS).acquisition())
    rng = np.random.default_rng(8)
    for k in range(20):
        z = noise(rng, int(0.1 * FS), 25.0)
        tracker.process(k * int(0.1 * FS), mix(z, z, 0.0))
    assert list(tracker.lost()) == [0, 1]
    assert tracker.add(sat.acquisition()) == 0


def test_a_signal_that_ends_is_noticed():
    sat = Satellite("L1CA", 2, FS, doppler_hz=900.0)
    tracker = TrackingSpec().start(FS)
    tracker.add(sat.acquisition())
    rng, count, lost_at = np.random.default_rng(8), int(0.1 * FS), None
    for k in range(50):
        z = noise(rng, count, 25.0)
        s = sat.samples(k * count, count)
        tracker.process(k * count, mix(z, s, amplitude(45.0, FS, 25.0) if k < 20 else 0.0))
        if len(tracker.lost()) and lost_at is None:
            lost_at = k
    # 1 s of patience, the lock detector's window of 0.25 s, at most one chance recovery.
    assert lost_at is not None and 29 <= lost_at <= 40


# ------------------------------------------------------------------------------------------------- steering
def test_steered_nco_follows_the_command():
    """The NCO is where the command says, code and carrier, with its Doppler rate; discriminators still report."""
    sat = Satellite("L1CA", 17, FS, doppler_hz=400.0, ramp_hz_s=500.0)
    tracker = TrackingSpec().start(FS)
    tracker.add(sat.acquisition())
    count = int(0.1 * FS)
    rng = np.random.default_rng(9)
    errors, seen = [], []
    for k in range(20):
        command = np.zeros(1, AIDING)
        command["sample_index"], command["steered"] = k * count, k >= 10
        command["code_phase_chips"] = sat.code_phase(k * count) % 1023 + 0.05
        command["doppler_hz"], command["doppler_rate_hz_s"] = sat.doppler(k * count) + 2.0, 500.0
        e, n, _ = tracker.process(k * count, slab([sat], 50.0, k * count, count, rng), command)
        if k > 10:
            errors.append(e[0, : n[0]])
    e = np.concatenate(errors)[1:]
    seen = sat.code_error(e)
    # Commands renew every 0.1 s; 2 Hz too much Doppler moves the code by 2 / 1540 * 0.1 chip: nothing.
    assert np.max(np.abs(seen - 0.05)) < 2e-3
    assert np.allclose(e["doppler_hz"], sat.doppler(e["sample_index"]) + 2.0, atol=0.01)
    sigma = loops.dll_jitter_chips(50.0, 25.0, 0.02, 0.5) * np.sqrt(2)  # B T = 1/2: one look
    assert np.mean(e["code_error_chips"]) == pytest.approx(-0.05, abs=5 * sigma / np.sqrt(len(e)) + 0.004)
    # Phase between first and second half: 2 Hz too fast reads as -2 Hz.
    assert np.mean(e["freq_error_hz"]) == pytest.approx(-2.0, abs=0.5)
    assert np.all(e["doppler_rate_hz_s"] == 500.0)


@pytest.mark.parametrize("threads", [1, 2])
def test_commands_at_stops_give_the_bits_of_slabs_cut_there(threads):
    """Also where a stop falls into the seam of two slabs, 2.01 of the longest code periods long."""
    sats = [Satellite("L1CA", 17, FS, doppler_hz=400.0), Satellite("E1C", 6, FS, doppler_hz=-900.0, seed=2)]
    sizes = [81920, 5000, 9001, 70000, 40000, 81920, 20000, 81921, 3000, 81920]
    cuts = np.concatenate([[0], np.cumsum(sizes)])
    iq = slab(sats, 50.0, 0, int(cuts[-1]), np.random.default_rng(4))

    def command(sample):
        rows = np.zeros(2, AIDING)
        rows["sample_index"], rows["steered"] = sample, 1
        rows["code_phase_chips"] = [s.code_phase(sample) + 1e-8 * sample for s in sats]
        rows["doppler_hz"] = [s.doppler(sample) for s in sats]
        rows["doppler_rate_hz_s"] = 20.0, -1e-4 * sample
        return rows

    def run(ends):
        tracker, out = TrackingSpec(threads=threads).start(FS), [b""] * 4
        for s in sats:
            tracker.add(s.acquisition(0, 20.0, 0.1))
        for n0, end in pairwise(ends):
            stops = [int(c) for c in cuts if n0 < c < end]
            e, n, z = tracker.process(n0, iq[:, n0:end], command(n0), stops, lambda stop, e, n: command(stop))
            rows = [x[c, : n[c]].tobytes() for x in (e, z) for c in range(2)]
            out = [a + b for a, b in zip(out, rows)]
        return *out, [tracker.channels[name].tobytes() for name in tracker.channels.dtype.names]

    cut = run(cuts.tolist())
    assert cut == run(cuts[[0, 1, -1]].tolist())
    assert cut == run(cuts[::5].tolist())


def test_snapshot_is_the_replica_at_one_sample():
    sats = [
        Satellite("L1CA", 5, FS, doppler_hz=2000.0, code_chips=5.0),
        Satellite("E1C", 6, FS, code_chips=1500.0),
    ]
    tracker = TrackingSpec().start(FS)
    for s in sats:
        tracker.add(s.acquisition(0, 10.0, 0.1))
    track(tracker, sats, 45.0, 2.0, seed=3)
    n = 20 * int(0.1 * FS)
    for s, r in zip(sats, tracker.snapshot(n)):
        whole = r["code_period"] * s.length + r["code_phase_chips"]
        difference = (s.code_phase(n) - whole) / s.length
        assert abs(difference - round(difference)) * s.length < 0.03
        assert r["doppler_hz"] == pytest.approx(s.doppler_hz, abs=1.5)
        assert r["phase_locked"] and 0.5 < r["lock_s"] < 2.0
        assert (r["carrier_phase_cycles"] - s.cycles(n) - s.phase0 + 0.25) % 0.5 == pytest.approx(
            0.25, abs=0.03
        )


# ---------------------------------------------------------------------------------------------- bad input
@pytest.mark.parametrize(
    "make, word",
    [
        (lambda: L1caTracking(pll_bw_hz=20.0), "B_L T = 0.4"),
        (lambda: E1Tracking(integration_ms=100), "B_L T = 1"),
        (lambda: E1Tracking(component="data", integration_ms=20, pll_bw_hz=2.0), "every 4 ms"),
        (lambda: E1Tracking(integration_ms=10), "multiple of 4"),
        (lambda: L1caTracking(taps={"count": 4, "spacing_chips": 0.1}), "odd"),
        (lambda: L1caTracking(code_discriminator="very_early_late"), "BOC"),
        (lambda: TrackingSpec(lock_in=0.3, lock_out=0.5), "below"),
        (lambda: TrackingSpec(bogus=1), "bogus"),
        (lambda: TrackingSpec().start(1e5), "at least"),
        (lambda: TrackingSpec().start(4e6, 3e6), "half the sampling rate"),
    ],
)
def test_impossible_settings_are_refused(make, word):
    with pytest.raises(ValueError, match=word):
        make()


def test_bad_slabs_are_refused():
    tracker = TrackingSpec().start(FS)
    tracker.process(0, np.zeros((2, 1000), np.int8))
    with pytest.raises(ValueError, match="1000 was expected"):
        tracker.process(999, np.zeros((2, 1000), np.int8))
    with pytest.raises(ValueError, match="int8, int16 or float32"):
        tracker.process(1000, np.zeros((2, 1000)))
    with pytest.raises(ValueError, match="one each"):
        tracker.process(1000, np.zeros((2, 10), np.int8), np.zeros(3, AIDING))
