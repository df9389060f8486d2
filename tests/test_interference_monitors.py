import math

import naive_twin
import numpy as np
import pytest
from scipy import stats

from monitors.baselines import AdcHistogram, AgcGain, Cn0Drop, NoiseFloor, SignalQuality
from monitors.batch import start_monitors
from monitors.fft import FftMonitor
from monitors.glrt import GlrtMonitor
from monitors.multichannel_ar import MultichannelAr, fit
from monitors.rare import importance_miss_rate
from monitors.records import alarms
from signals.constants import CHIP_RATE_HZ
from signals.modulation import autocorrelation
from signals.multipath import Aeronautical, Echoes
from tracking.correlator_model import Twin, TwinCW, code_spectrum, cw_taps, noise_sigma

Z = 5.0
GPS = {"signal": "L1CA", "prn": 6, "cn0_dbhz": 40.5, "integration_s": 0.02, "early_late_space_chips": 1.0}
TAPS = 0.65 * np.arange(-17, 18)
S2 = noise_sigma(40.5, 0.02) ** 2


def complex_noise(n, seed, k=35):
    g = np.random.default_rng(seed).standard_normal((2, n, k))
    return (g[0] + 1j * g[1]).astype(np.complex64)


@pytest.mark.parametrize("n_fft", [None, 64, 128])
@pytest.mark.parametrize("kind", ["I", "IQ"])
@pytest.mark.parametrize("window", ["none", "hann"])
def test_fft_monitor_is_the_fft(n_fft, kind, window):
    z = complex_noise(1500, 1)
    run = FftMonitor(input=kind, n_fft=n_fft, window=window).start(TAPS, 0.02)
    value, hz = run.maxima(z)
    n = n_fft or 35
    w = 0.5 + 0.5 * np.cos(np.pi * np.arange(-17, 18) / 18) if window == "hann" else np.ones(35)
    x = (z.real if kind == "I" else z) * w
    spectrum = np.abs(np.fft.fft(x, n, axis=1))
    assert np.max(np.abs(value - spectrum.max(axis=1))) < 35 * 1e-6 * np.abs(z).max()
    step = 1.023e6 / (n * 0.65)
    bins = np.rint(-hz / step).astype(int)
    rows = np.arange(len(z))
    assert np.allclose(spectrum[rows, bins % n], value, rtol=1e-5)
    # Parseval: a max over bins is at least the mean square.
    assert np.all(value**2 >= (spectrum**2).mean(axis=1) * (1 - 1e-5))


def test_fft_finds_the_frequency_with_its_sign():
    for line in (227, -150):
        jam = TwinCW(js_db=25.0, line=line)
        z = Twin(**GPS, jammers=(jam,)).start_open(1)(200)
        _, hz = FftMonitor(n_fft=512).start(TAPS, 0.02).maxima(z)
        assert np.median(hz) == pytest.approx(line * 1e3, abs=1.023e6 / 512)
        glrt = GlrtMonitor(noise_variance=S2).start(TAPS, 0.02, "L1CA", 6)
        assert np.median(glrt(z)["frequency_hz"]) == pytest.approx(line * 1e3, abs=15e3)


def test_fft_training_merges_and_standardises():
    z = complex_noise(3000, 2)
    one, many = (FftMonitor().start(TAPS, 0.02) for _ in range(2))
    one.train(z)
    for part in np.split(z, [10, 1000, 1001]):
        many.train(part)
    assert many.mean == pytest.approx(one.mean, rel=1e-8)  # float32 products of other block layouts
    assert many.std == pytest.approx(one.std, rel=1e-6)
    out = one(z)
    assert out["value"].mean() == pytest.approx(0, abs=1e-9)
    assert out["value"].std(ddof=1) == pytest.approx(1, rel=1e-9)
    assert out["epoch"][-1] == 2999
    assert out["t_s"][-1] == pytest.approx(60.0)
    assert one(z[:10])["epoch"][0] == 3000
    assert one.fresh()(z[:10])["epoch"][0] == 0
    with pytest.raises(ValueError, match="not trained"):
        FftMonitor().start(TAPS, 0.02)(z)
    with pytest.raises(ValueError, match="equally spaced"):
        FftMonitor().start(TAPS[:-1], 0.02)
    with pytest.raises(ValueError, match="shape"):
        one(z[:, :30])


def quiet_epochs(n, seed, **more):
    return Twin(**GPS, **more).start_open(seed)(n)


def test_glrt_null_is_exponential_in_every_bin():
    """T over one frequency is Exp(1): mean and variance 1, tail e^-t; the noise is learnt within its error."""
    n = 40_000
    run = GlrtMonitor().start(TAPS, 0.02, "L1CA", 6)
    z = quiet_epochs(n, 3)
    run.train(z)
    # mean |P W z|^2 over n epochs of 2 * 30 real squares
    assert run.noise_variance == pytest.approx(S2, rel=Z * math.sqrt(2 / (60 * n)))
    y = (z @ run.operator.T) @ run.directions.conj()
    t = np.abs(y) ** 2 / (2 * S2)
    assert np.max(np.abs(t.mean(axis=0) - 1)) < Z / math.sqrt(n)
    assert np.max(np.abs((t**2).mean(axis=0) - 2)) < Z * math.sqrt(20 / n)
    p = math.exp(-6)
    assert np.max(np.abs((t > 6).mean(axis=0) - p)) < Z * math.sqrt(p / n)
    # float32 kernel against the plain product
    value = run(z)["value"]
    assert np.allclose(value, run.whitened_statistic(z @ run.whitener.T), rtol=2e-4)


def test_glrt_is_blind_to_the_peak_and_near_echoes_and_the_mirror_is_not():
    """H = [R(d + a)] with a >= 0 for late echoes: the mirrored projector leaks (interference note: 2-2.9 sigma)."""
    right = GlrtMonitor(noise_variance=S2).start(TAPS, 0.02, "L1CA", 6)
    wrong = GlrtMonitor(noise_variance=S2, guard_chips=(0.3, 0.0, -0.3, -0.65, -1.0)).start(
        TAPS, 0.02, "L1CA", 6
    )
    leaks = {}
    for name, run in (("right", right), ("wrong", wrong)):
        leaks[name] = [np.linalg.norm(run.operator @ z) / math.sqrt(S2) for z in _echo_taps((0.8, 0.9, 1.08))]
    assert max(leaks["right"]) < 0.3
    assert min(leaks["wrong"]) > 1.9
    # ... and in false alarms: the same threshold, ground echo at one chip.
    echo = Echoes(echoes=({"delay_s": 0.95 / 1.023e6, "power_db": -6.0, "bandwidth_hz": 2.0},))
    z = quiet_epochs(40_000, 4, multipath=echo)
    p_fa = 1e-3
    threshold = right.threshold(p_fa, right.effective_bins(100_000))
    sigma = math.sqrt(p_fa / len(z))
    assert np.mean(right(z)["value"] >= threshold) == pytest.approx(p_fa, abs=Z * sigma + 0.3 * p_fa)
    assert np.mean(wrong(z)["value"] >= threshold) > 2.0 * p_fa


def _echo_taps(delays_chips):
    return [10 ** (-15 / 20) * autocorrelation("L1CA", 6, TAPS + a) for a in delays_chips]


@pytest.mark.parametrize(("js_db", "df_t"), [(-1.0, 0.0), (0.0, 0.3), (4.0, 0.6)])
def test_glrt_miss_probability_is_noncentral_chi_square(js_db, df_t):
    # A grid of one frequency, on the line: no maximum, so the formula is exact.
    spec = GlrtMonitor(grid_hz=227e3, max_hz=228e3, noise_variance=S2)
    run = spec.start(TAPS, 0.02, "L1CA", 6)
    jam = TwinCW(js_db=js_db, offset_hz=df_t / 0.02)
    steer = np.zeros((1, 3))
    taps = (
        Twin(**GPS | {"cn0_dbhz": 80.0}, jammers=(j,)).start(1, steered=True)(1, steer=steer)[1][0]
        for j in (jam, jam.model_copy(update={"js_db": -100.0}))
    )
    at_line = run.directions[:, int(np.argmin(np.abs(run.frequency_hz - 227e3)))].conj()
    # With its neighbours, 0.6 % off the line's own |c_k| sinc: the exponent of P_MD feels that.
    amplitude = abs(at_line @ run.operator @ (next(taps) - next(taps))) / run.line_gain(227e3)
    single = 10 ** (js_db / 20) * abs(code_spectrum("L1CA", 6, 227)) * np.sinc(df_t)
    assert amplitude == pytest.approx(single, rel=0.015)
    n = 40_000
    y = Twin(**GPS, jammers=(jam,)).start_open(5)(n) @ run.operator.T
    t = np.abs(y @ at_line) ** 2 / (2 * S2)
    for threshold in (6.0, 12.0, 15.0):
        p = stats.ncx2.cdf(2 * threshold, 2, (amplitude * run.line_gain(227e3)) ** 2 / S2)
        assert run.miss_probability(amplitude, 227e3, threshold) == pytest.approx(p)
        if p * n > 30:
            assert np.mean(t < threshold) == pytest.approx(p, abs=Z * math.sqrt(p * (1 - p) / n) + 0.01 * p)


def test_glrt_windows_are_sums_and_do_not_depend_on_calls():
    z = quiet_epochs(3000, 6)
    single = GlrtMonitor(noise_variance=S2).start(TAPS, 0.02, "L1CA", 6)
    window = GlrtMonitor(noise_variance=S2, accumulate_epochs=50).start(TAPS, 0.02, "L1CA", 6)
    y = np.abs((z @ single.operator.T) @ single.directions.conj()) ** 2 / (2 * S2)
    expected = y.reshape(60, 50, -1).sum(axis=1).max(axis=1)
    out = window(z, np.arange(3000) * 7)
    assert np.allclose(out["value"], expected, rtol=1e-3)
    assert np.array_equal(out["epoch"], np.arange(49, 3000, 50))
    assert np.array_equal(out["sample_index"], 7 * np.arange(49, 3000, 50))
    cut = window.fresh()
    parts = np.concatenate([cut(p) for p in np.split(z, [13, 700, 701, 2000])])
    assert np.allclose(parts["value"], out["value"], rtol=1e-6)
    assert np.array_equal(parts["epoch"], out["epoch"])
    # Gamma(50) null
    assert window.threshold(1e-3, 80.0) == pytest.approx(stats.gamma.isf(1e-3 / 80, 50))
    assert single.threshold(1.6e-5, 84.0) == pytest.approx(math.log(84 / 1.6e-5))


@pytest.mark.parametrize("bandwidth_hz", [1.6e6, 2.0e6])
def test_glrt_behind_a_front_end_filter(bandwidth_hz):
    """The filter colours the noise of the taps and rounds the peak; told of it, the GLRT keeps its null."""
    spec = Twin(**GPS, bandwidth_hz=bandwidth_hz)
    run = start_monitors(spec, {"g": GlrtMonitor()})["g"]
    assert run.spec.bandwidth_hz == bandwidth_hz and run.frequency_hz.max() <= 0.5 * bandwidth_hz
    R = spec.autocorrelation(TAPS[:, None] - TAPS[None, :])
    white = run.whitener @ R @ run.whitener.T
    assert np.allclose(white, np.eye(len(white)), atol=1e-6)
    assert np.max(np.abs(run.operator @ spec.autocorrelation(TAPS))) < 1e-6
    z = spec.start_open(3)(30_000)
    run.train(z)
    passed = spec.autocorrelation(0.0)
    n = run.rank * len(z)
    assert run.noise_variance == pytest.approx(S2, rel=Z / math.sqrt(n))
    assert passed < 0.98
    p_fa = 3e-3
    threshold = run.threshold(p_fa, run.effective_bins(60_000, tail=p_fa))
    counted = np.mean(run.fresh()(z)["value"] >= threshold)
    assert counted == pytest.approx(p_fa, abs=Z * math.sqrt(p_fa / 30_000 + p_fa / 60_000))
    # A tone of the band is seen with its own gain: noncentral chi-square in its bin.
    f = float(run.frequency_hz[np.argmax(run.gain)])
    tone = Twin(**GPS, bandwidth_hz=bandwidth_hz, jammers=(TwinCW(js_db=20.0, freq_hz=f, line="worst"),))
    amplitude = abs(cw_taps(tone, tone.jammers[0])[17])
    value = run.fresh()(tone.start_open(4)(2000))["value"]
    expected = 0.5 * (amplitude * run.line_gain(f)) ** 2 / S2 + 1
    assert value.mean() == pytest.approx(expected, rel=0.05, abs=2.0)
    # Not told, it projects another peak out and the signal leaks.
    naive = GlrtMonitor(noise_variance=S2).start(TAPS, 0.02, "L1CA", 6)
    assert np.linalg.norm(naive.operator @ spec.autocorrelation(TAPS)) > 0.01


def test_importance_sampling_against_formula_and_counting():
    """The line on the grid (note: values then agree within 5 %), P_MD from 0.2 to 1e-17."""
    run = GlrtMonitor(grid_hz=227e3 / 15, noise_variance=S2).start(TAPS, 0.02, "L1CA", 6)
    threshold = 15.47
    line = abs(code_spectrum("L1CA", 6, 227))
    for js_db, df_t, plain in ((-1.0, 0.3, True), (1.5, 0.3, True), (4.0, 0.3, False), (9.0, 0.5, False)):
        amplitude = 10 ** (js_db / 20) * line * np.sinc(df_t)
        tone = amplitude * np.exp(-2j * np.pi * TAPS * 227e3 / CHIP_RATE_HZ)
        p, se, n_eff = importance_miss_rate(run, tone, threshold, 20_000, 1)
        single = run.miss_probability(amplitude, 227e3, threshold)
        assert se < 0.06
        assert n_eff > 100
        # The maximum over all frequencies misses less often than the line's own bin, by a few per cent.
        assert p == pytest.approx(single, rel=Z * se + 0.08)
        if plain:
            counted, se_counted, _ = importance_miss_rate(run, tone, threshold, 60_000, 2, shrink=0.0)
            assert p == pytest.approx(counted, rel=Z * math.hypot(se, se_counted))


def test_ar_fit_against_least_squares_and_its_truth():
    rng = np.random.default_rng(1)
    A = np.array([[[0.5, 0.1j, 0], [0, 0.3, 0.2], [0.1, 0, -0.4]], -0.2 * np.eye(3)])
    n = 20_000
    e = (rng.standard_normal((n, 3)) + 1j * rng.standard_normal((n, 3))) / math.sqrt(2)
    x = np.zeros((n, 3), complex)
    for i in range(2, n):
        x[i] = e[i] - A[0] @ x[i - 1] - A[1] @ x[i - 2]
    least = naive_twin.ar_least_squares(x, 2)
    for method in ("nuttall_strand", "vieira_morf"):
        model = fit(x, 2, method)
        # Coefficient error: sqrt(S / (n P)), P >= 1 here; forward-backward and forward agree to O(1 / n).
        assert np.max(np.abs(model.coefficients - A)) < Z * 1.2 / math.sqrt(n)
        assert np.max(np.abs(model.coefficients - least)) < 100 / n
        assert np.max(np.abs(model.covariance - np.eye(3))) < Z * math.sqrt(2 / n)
        assert np.allclose(model.residuals(x)[:, 0][:-1], e[2:-1, 0], atol=0.1)


def test_nuttall_strand_solves_its_normal_equation():
    """One step by hand: the weighted forward and backward energy is stationary at the reflection matrix."""
    x = complex_noise(400, 3, 4).astype(complex)
    x[1:] += 0.6 * x[:-1]
    model = fit(x, 1)
    f, b = x[1:], x[:-1]
    P = x.T @ x.conj() / len(x)
    Pi = np.linalg.inv(P)
    a = model.coefficients[0]
    D = -a @ P

    def energy(D):
        ef, eb = f - b @ (D @ Pi).T, b - f @ (D.conj().T @ Pi).T
        return (np.einsum("ni,ij,nj->", ef.conj(), Pi, ef) + np.einsum("ni,ij,nj->", eb.conj(), Pi, eb)).real

    base = energy(D)
    rng = np.random.default_rng(4)
    for _ in range(10):
        step = 1e-4 * (rng.standard_normal((4, 4)) + 1j * rng.standard_normal((4, 4)))
        up, down = energy(D + step), energy(D - step)
        assert abs(up - down) < 1e-3 * abs(up + down - 2 * base) + 1e-7
        assert up > base


def test_ar_null_is_chi_square():
    """White epochs, whitened form: N K exp(statistic) is chi2 / 2 of 2 N K degrees when S is known."""
    run = MultichannelAr(form="whitened", window_s=3.0, hop_s=3.0, wipe_sign=False).start(TAPS, 0.02)
    z = quiet_epochs(60_000, 7)
    run.train(z[:20_000])
    energy = run.energies(z[20_000:].astype(np.complex64))
    # Coefficients and covariance come from 20000 vectors: bias of (1 + p) K / N each.
    K, n = 35, len(energy)
    assert energy.mean() == pytest.approx(1.0, abs=Z / math.sqrt(n * K) + 4 * K / 20_000)
    assert energy.var() == pytest.approx(1 / K, rel=Z * math.sqrt(2 / n) + 0.03)
    value = run(z[20_000:])["value"]
    # The mean over a window of 150: standard deviation 1 / sqrt(N K).
    assert value.std() == pytest.approx(1 / math.sqrt(150 * K), rel=Z / math.sqrt(2 * len(value)))
    p = stats.kstest(np.exp(value) * 2 * 150 * K, stats.chi2(2 * 150 * K, scale=energy.mean()).cdf).pvalue
    assert p > 1e-4


@pytest.mark.parametrize("form", ["refit", "fixed", "whitened"])
def test_ar_windows_do_not_depend_on_calls(form):
    run = MultichannelAr(form=form, order=2, window_s=5.0, hop_s=1.7).start(TAPS, 0.02)
    z = quiet_epochs(3000, 8)
    run.train(z[:1000])
    whole = run.fresh()(z[1000:], np.arange(2000))
    cut = run.fresh()
    parts = np.concatenate(
        [cut(z[a:b], np.arange(a - 1000, b - 1000)) for a, b in ((1000, 1003), (1003, 1600), (1600, 3000))]
    )
    assert np.array_equal(parts["epoch"], whole["epoch"])
    assert np.array_equal(parts["sample_index"], whole["sample_index"])
    assert np.allclose(parts["value"], whole["value"], atol=1e-5)
    assert whole["epoch"][0] == 249
    assert np.all(np.diff(whole["epoch"]) == 85)


def test_a_cw_hides_from_a_refit_but_not_from_fixed_coefficients():
    quiet = Twin(**GPS, multipath=Aeronautical())
    jam = quiet.model_copy(update={"jammers": (TwinCW(js_db=4.0, offset_hz=10.0, start_s=40.0),)})
    shift = {}
    for form in ("refit", "fixed", "whitened"):
        run = MultichannelAr(form=form).start(TAPS, 0.02)
        for seed in range(3):
            run.train(quiet.start(seed)(3000)[1])
        value = run(jam.start(9)(4000)[1])
        before, after = (value["value"][s] for s in (value["t_s"] < 40, value["t_s"] > 43))
        shift[form] = (np.mean(after) - np.mean(before)) / np.std(before)
    assert shift["fixed"] > 10
    assert shift["whitened"] > 10
    assert shift["refit"] < 5


def test_ar_refuses_too_few_vectors():
    with pytest.raises(ValueError, match="more than 2 \\(p \\+ 1\\) K = 148"):
        MultichannelAr(window_s=3.0).start(0.25 * np.arange(-18, 19), 0.1)
    with pytest.raises(ValueError, match="12"):
        fit(complex_noise(12, 1, 3), 1)
    fit(complex_noise(13, 1, 3), 1)


def test_baselines_rise_under_a_jammer_only():
    quiet = Twin(**GPS)
    jam = Twin(**GPS, jammers=(TwinCW(js_db=15.0, offset_hz=8.0),))
    monitors = [
        Cn0Drop(),
        NoiseFloor(),
        SignalQuality(window_s=0.1),
        SignalQuality(metric="ratio", window_s=0.1),
    ]
    for monitor in monitors:
        run = monitor.start(TAPS, 0.02)
        run.train(quiet.start(1)(20_000)[1][500:])
        calm = run.fresh()(quiet.start(2)(5000)[1][500:])["value"]
        loud = run.fresh()(jam.start(2)(5000)[1][500:])["value"]
        limit = Z * calm.std() / math.sqrt(len(calm)) + 0.2
        expected = 0.0 if monitor.kind != "SQM" else math.sqrt(2 / math.pi)
        assert abs(calm.mean() - expected) < limit, monitor
        assert loud.mean() > calm.mean() + 0.5, monitor
        parts = run.fresh()
        z = quiet.start(2)(5000)[1][500:]
        assert np.allclose(np.concatenate([parts(z[:17])["value"], parts(z[17:])["value"]]), calm)


def test_cn0_estimate_is_the_setting():
    run = Cn0Drop(window_s=100.0).start(TAPS, 0.02)
    cn0 = -run.values(quiet_epochs(10_000, 9))
    # var(C/N0) in dB from var of the variance estimate: 4.34 sqrt(2 / n)
    assert np.max(np.abs(cn0 - 40.5)) < Z * 4.34 * math.sqrt(2 / 5000)


def test_adc_chi_square_and_agc():
    rng = np.random.default_rng(3)
    p = np.array([0.1, 0.4, 0.4, 0.1])
    run = AdcHistogram().start(TAPS, 0.02)
    run.train(rng.multinomial(1_000_000, p, 50))
    value = run(rng.multinomial(4096, p, 4000))["value"]
    assert run.degrees == 3
    assert value.mean() == pytest.approx(3, abs=Z * math.sqrt(6 / 4000))
    assert value.var() == pytest.approx(6, rel=0.3)
    assert run(rng.multinomial(4096, [0.25] * 4, 10))["value"].min() > 100
    with pytest.raises(ValueError, match="levels"):
        run(np.zeros((1, 3)))
    agc = AgcGain().start(TAPS, 0.02)
    agc.train(30 + 0.1 * rng.standard_normal(5000))
    assert agc(np.array([29.0]))["value"][0] == pytest.approx(10, rel=0.1)


def test_alarms_group_neighbours_and_gaps():
    out = np.zeros(10, quiet_statistic().dtype)
    out["t_s"] = np.arange(10) * 0.5
    out["value"] = [0, 5, 6, 0, 7, 0, 0, 0, 9, 1]
    got = alarms(out, 5.0, "glrt", "L1CA", 6, gap_s=1.0, t0_s=100.0)
    assert [(a["start_s"], a["end_s"], a["peak"]) for a in got] == [(100.5, 102.0, 7.0), (104.0, 104.0, 9.0)]
    assert len(alarms(out, 5.0, "glrt")) == 3
    assert len(alarms(out, 10.0, "glrt")) == 0


def quiet_statistic():
    run = GlrtMonitor(noise_variance=S2).start(TAPS, 0.02, "L1CA", 6)
    return run(quiet_epochs(10, 1))
