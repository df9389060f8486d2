import math

import naive_twin
import numpy as np
import pytest
from pydantic import ValidationError

from signals.constants import METRES_PER_CHIP, WAVELENGTH_M
from signals.modulation import autocorrelation
from signals.multipath import Aeronautical, Echoes, echo_gain
from tracking.correlator_model import (
    Dynamics,
    Twin,
    TwinCW,
    TwinNBI,
    code_spectrum,
    noise_sigma,
    worst_line,
)
from tracking.loops import dll_gains, pll_gains
from tracking.twin_kernels import hatch_smooth

Z = 5.0
GPS = {"signal": "L1CA", "prn": 6, "cn0_dbhz": 40.5, "integration_s": 0.02, "early_late_space_chips": 1.0}
GAL = {"signal": "E1B", "prn": 38, "waveform": "BOC11", "cn0_dbhz": 34.8, "integration_s": 0.004}


@pytest.mark.parametrize(
    ("signal", "prn", "waveform", "khz", "db"),
    [
        ("L1CA", 6, "BPSK", 227.0, -21.29),
        ("E1B", 38, "BOC11", 673.5, -28.81),
        ("E1B", 38, "CBOC+", 673.5, -28.94),
    ],
)
def test_worst_lines_are_the_published_ones(signal, prn, waveform, khz, db):
    k = worst_line(signal, prn, waveform)
    assert k * 1.023e3 / (1023 if signal == "L1CA" else 4092) == pytest.approx(khz)
    assert 20 * np.log10(abs(code_spectrum(signal, prn, k, waveform))) == pytest.approx(db, abs=0.01)


def test_code_spectrum_is_that_of_the_autocorrelation():
    # Wiener-Khinchin: |c_k|^2 are the Fourier coefficients of R; lines beyond the sum are O(1/k^2).
    k = np.arange(-40_000, 40_001)
    power = np.abs(code_spectrum("L1CA", 6, k)) ** 2
    d = np.array([0.0, 0.3, 1.0, 7.65])
    R = (power * np.exp(2j * np.pi * k * d[:, None] / 1023)).sum(axis=1).real
    tail = 1 / (np.pi**2 * (40_000 / 1023))
    assert np.max(np.abs(R - autocorrelation("L1CA", 6, d))) < 1.5 * tail


@pytest.mark.parametrize("base", [GPS, GAL])
def test_open_loop_noise_has_the_covariance_of_the_taps(base):
    spec = Twin(**base)
    n = 30_000
    z = spec.start_open(1)(n)
    d = spec.tap_array_chips
    s2 = noise_sigma(spec.cn0_dbhz, spec.integration_s) ** 2
    assert s2 == pytest.approx(0.5 / (spec.integration_s * 10 ** (spec.cn0_dbhz / 10)))
    R0 = autocorrelation(spec.signal, spec.prn, d, spec.waveform)
    assert np.max(np.abs(z.mean(axis=0) - R0)) < Z * math.sqrt(2 * s2 / n)
    z = z - R0
    R = autocorrelation(spec.signal, spec.prn, d[:, None] - d[None, :], spec.waveform)
    C = z.T @ z.conj() / n / (2 * s2)
    # Entry variance of a complex sample covariance: R_ii R_jj / n; I/Q cross terms are the imaginary part.
    assert np.max(np.abs(C - R)) < Z * math.sqrt(1.0 / n)
    rms = math.sqrt(np.mean(np.abs(C - R) ** 2))
    assert rms == pytest.approx(math.sqrt(1 / n), rel=0.15)
    pseudo = z.T @ z / n / (2 * s2)
    assert np.max(np.abs(pseudo)) < Z * math.sqrt(2.0 / n)


def test_closed_loop_equals_the_textbook_loop():
    """Signal, two CW over five lines each, echoes, data, dynamics, both loops: every epoch agrees."""
    spec = Twin(
        **GPS | {"cn0_dbhz": 48.0, "early_late_space_chips": 1.3},  # E and L are taps of the array here
        data=True,
        jammers=(
            TwinCW(js_db=6.0, offset_hz=13.0, rate_hz_s=2.0, phase_rad=0.4),
            TwinCW(js_db=3.0, line=-66, offset_hz=-4.0, phase_rad=2.0),
        ),
        multipath=Aeronautical(),
        dynamics=Dynamics(speed_mps=-3.0, accel_mps2=2.0, jerk_mps3=((1.0, 1.5),)),
    )
    n = 400
    run = spec.start(3)
    epochs, corr = run(n)
    b = run._block
    k = [*range(210, 245), *range(-83, -48)]  # the lines that the twin keeps
    z, errors = naive_twin.closed_loop(
        spec,
        run.stage.taps,
        b.rows[:n] + 1j * b.rows[1024 : 1024 + n],
        b.signs,
        (b.gain[:, :n], b.chips[:, :n]),
        run.stage.cws[:, :4],
        dict(zip(k, code_spectrum("L1CA", 6, np.array(k)))),
        pll_gains(3, 10.0, 0.02),
        dll_gains(1, 1.0, 0.02)[0],
        0.5,
        b.truth[:n],
        -2.0 / WAVELENGTH_M * 0.02**2,
    )
    # Lines beyond the sixteen that both keep: A |c| / (pi 20 16), A = 2, |c| < 0.09.
    assert np.max(np.abs(corr - z[:, : run.n_taps])) < 1.8e-4
    assert np.max(np.abs(epochs["code_error_chips"] - errors[:, 0])) < 1e-4
    assert np.max(np.abs(epochs["phase_error_cycles"] - errors[:, 1])) < 1e-4


def test_open_loop_equals_a_steered_channel_on_the_truth():
    spec = Twin(
        **GPS,
        jammers=(
            TwinCW(js_db=9.0, offset_hz=15.0, rate_hz_s=1.0),
            TwinCW(js_db=3.0, freq_hz=-66.3e3, start_s=5.0, end_s=12.0),
            TwinNBI(js_db=10.0, bandwidth_hz=5.0),
        ),
        multipath=Echoes(echoes=({"delay_s": 5e-7, "power_db": -6.0, "bandwidth_hz": 1.0},)),
        data=True,
        code_phase_chips=100.3,
    )
    n = 2500
    steered = spec.start(9, steered=True)
    _, corr = steered(n, steer=np.zeros((n, 3)))
    z = spec.start_open(9)(n)
    # Both keep 16 lines on each side of slightly different spans: A |c| / (pi 20 16), |c| < 0.09, A = 2.8.
    assert np.max(np.abs(corr - z)) < 2.5e-4
    # ... also from the middle
    assert np.array_equal(spec.start_open(9)(300, epoch0=1500), z[1500:1800])


def test_cutting_a_run_does_not_change_a_bit():
    spec = Twin(
        **GPS,
        jammers=(TwinCW(js_db=9.0, offset_hz=-300.0, rate_hz_s=20.0), TwinNBI(js_db=3.0, bandwidth_hz=2.0)),
        multipath=Aeronautical(visible_s=4.0, hidden_s=3.0),
        data=True,
    )
    whole, corr = spec.start(np.random.SeedSequence(4, spawn_key=(1, 2)))(3000)
    run = spec.start(np.random.SeedSequence(4, spawn_key=(1, 2)))
    parts = [run(m) for m in (1, 700, 1024, 275, 1000)]
    assert np.array_equal(np.concatenate([p[0] for p in parts]), whole)
    assert np.array_equal(np.concatenate([p[1] for p in parts]), corr)
    other = spec.start(np.random.SeedSequence(4, spawn_key=(1, 3)))(100)[1]
    assert not np.array_equal(other, corr[:100])


@pytest.mark.parametrize("fs_hz", [4.0e6, 4.096e6, 5.0037e6])
@pytest.mark.parametrize("first_chips", [0.0, 0.11, 0.17])
def test_cw_on_samples_and_in_the_twin(fs_hz, first_chips):
    """Amplitude and phase, on and beside the line, with the lines of the *sampled* replica (aliases)."""
    taps = (-1.3, -0.65, 0.0, 0.65, 1.3, 4.0)
    n = round(fs_hz * 20e-3)
    t = np.arange(n) / fs_hz
    line = abs(code_spectrum("L1CA", 6, 227))
    for df in (0.0, 20.0, 37.5):
        f = 227e3 + df
        x = np.exp(2j * np.pi * (f * t + 0.1))
        direct = naive_twin.correlate_samples(x, "L1CA", 6, "BPSK", fs_hz, taps, 1, first_chips)[0]
        z = _cw_alone(
            {**GPS, "taps_chips": taps, "fs_hz": fs_hz, "alias_orders": 64, "code_phase_chips": first_chips},
            TwinCW(js_db=0.0, line=227, offset_hz=df, phase_rad=0.2 * np.pi),
        )
        assert np.max(np.abs(z - direct)) < 0.015 * line
        ideal = _cw_alone(
            {**GPS, "taps_chips": taps, "code_phase_chips": first_chips},
            TwinCW(js_db=0.0, line=227, offset_hz=df, phase_rad=0.2 * np.pi),
        )
        assert np.abs(ideal) == pytest.approx(line * np.sinc(df * 0.02), abs=0.015 * line)


def _cw_alone(settings, jammer):
    """Taps of a CW in one steered epoch, without signal and noise."""
    spec = Twin(**settings)
    steer = np.zeros((1, 3))
    with_cw = spec.model_copy(update={"jammers": (jammer,)}).start(1, steered=True)(1, steer=steer)[1][0]
    return with_cw - spec.start(1, steered=True)(1, steer=steer)[1][0]


def test_cw_beside_the_lines_when_t_is_one_code():
    """Lines then lie 1 / T apart and all of them count: the twin keeps a thousand on each side."""
    taps = (-0.5, -0.25, 0.0, 0.25, 0.5)
    fs_hz = 98.2e6  # so far above the code's lobes that aliases are faint
    t = np.arange(round(fs_hz * 4e-3)) / fs_hz
    line = abs(code_spectrum("E1B", 38, 2694, "BOC11"))
    for df in (0.0, 100.0, 187.5):
        x = np.exp(2j * np.pi * (673.5e3 + df) * t)
        direct = naive_twin.correlate_samples(x, "E1B", 38, "BOC11", fs_hz, taps, 1)[0]
        z = _cw_alone({**GAL, "taps_chips": taps}, TwinCW(js_db=0.0, offset_hz=df, phase_rad=0.0))
        assert np.max(np.abs(z - direct)) < 0.015 * line


@pytest.mark.parametrize("bandwidth_hz", [1e3, 1e4, 1e5, 1e6])
def test_narrow_band_noise_power_over_the_taps(bandwidth_hz):
    spec = Twin(**GPS | {"cn0_dbhz": 80.0}, jammers=(TwinNBI(js_db=20.0, bandwidth_hz=bandwidth_hz),))
    n = 8192
    z = spec.start_open(2)(n) - autocorrelation("L1CA", 6, spec.tap_array_chips)
    power = np.mean(np.abs(z) ** 2)
    f = 227e3 + np.linspace(-0.5, 0.5, 400_001) * bandwidth_hz
    k = np.arange(math.floor(f[0] / 1e3) - 6, math.ceil(f[-1] / 1e3) + 7)
    c2 = np.abs(code_spectrum("L1CA", 6, k)) ** 2
    near = np.round(f / 1e3)
    total = np.zeros_like(f)
    for shift in range(-6, 7):
        index = np.clip((near + shift - k[0]).astype(int), 0, len(k) - 1)
        total += c2[index] * np.sinc((f - (near + shift) * 1e3) * 0.02) ** 2
    expected = 100.0 * total.mean()
    # A single line sees 1 / (B T): a 1 kHz jammer is 13 dB below a CW on the line, not 0; 10 kHz 23 dB, not 40.
    assert power == pytest.approx(expected, rel=Z * math.sqrt(1 / n) + 0.03)
    if bandwidth_hz == 1e4:
        on_line = 100.0 * np.abs(code_spectrum("L1CA", 6, 227)) ** 2
        assert 10 * np.log10(on_line / (bandwidth_hz * 0.02) / on_line) == pytest.approx(-23.0, abs=0.1)


def test_narrow_band_noise_is_correlated_between_epochs_below_one_over_t():
    spec = Twin(**GPS | {"cn0_dbhz": 80.0}, jammers=(TwinNBI(js_db=20.0, bandwidth_hz=10.0),))
    n = 40_000
    z = spec.start_open(5)(n)[:, 17] - 1.0
    z = z / np.sqrt(np.mean(np.abs(z) ** 2))
    lag = np.arange(8)
    measured = np.array([np.mean(z[m:] * z[: n - m].conj()) for m in lag])
    # Flat band of 10 Hz, sinc^2(f T) nearly flat inside it: correlation sinc(B m T); about B n T independent values.
    expected = np.sinc(10.0 * 0.02 * lag)
    assert np.max(np.abs(measured - expected)) < Z / math.sqrt(10.0 * 0.02 * n) + 0.01
    kurtosis = np.mean(np.abs(z) ** 4)  # 2 for circular Gaussian
    assert kurtosis == pytest.approx(2.0, abs=Z * math.sqrt(20 / (10.0 * 0.02 * n)))


def test_wide_noise_covariance_between_taps():
    spec = Twin(**GPS | {"cn0_dbhz": 80.0}, jammers=(TwinNBI(js_db=20.0, line=300, bandwidth_hz=1e5),))
    n = 20_000
    d = spec.tap_array_chips
    z = spec.start_open(6)(n) - autocorrelation("L1CA", 6, d)
    C = z.T @ z.conj() / n
    k = np.arange(250, 351)
    c2 = np.abs(code_spectrum("L1CA", 6, k)) ** 2
    shape = np.exp(-2j * np.pi * (d[:, None] - d[None, :])[..., None] * k / 1023) @ c2
    expected = 100.0 / (1e5 * 0.02) * shape
    p = expected[0, 0].real
    # Edge lines count half in the band, whole here: 1 line in 100.
    assert np.max(np.abs(C - expected)) < p * (Z / math.sqrt(n) + 0.03)


@pytest.mark.parametrize(("base", "tolerance"), [(GPS, 0.03), (GAL | {"early_late_space_chips": 0.25}, 0.03)])
def test_loop_jitter_is_theory(base, tolerance):
    spec = Twin(**base)
    n = 600_000
    T, cn0 = spec.integration_s, 10 ** (spec.cn0_dbhz / 10)
    epochs, _ = Twin(**base, taps_chips=(0.0,)).start(8)(n)
    epochs = epochs[5000:]
    d = spec.early_late_space_chips
    R = lambda x: float(autocorrelation(spec.signal, spec.prn, x, spec.waveform))  # noqa: E731
    slope = (R(d / 2 - 1e-3) - R(d / 2 + 1e-3)) / 2e-3
    # Dot product: variance of (E - L) is 4 s2 (1 - R(d)) per unit, times 1 / (2 slope)^2, and the squaring loss.
    variance = 1.0 * (1 - R(d)) / (2 * slope**2 * cn0) * (1 + 1 / (T * cn0))
    assert epochs["code_error_chips"].std() == pytest.approx(math.sqrt(variance), rel=tolerance)
    jitter = math.sqrt(10.0 / cn0 * (1 + 0.5 / (T * cn0)))
    measured = 2 * np.pi * epochs["phase_error_cycles"].std()
    # atan is linear only for small angles: at 34.8 dB-Hz and 4 ms the single-epoch angle has 0.2 rad.
    assert measured == pytest.approx(jitter, rel=tolerance + 0.5 * (0.5 / (T * cn0)))
    if base is GPS:
        assert METRES_PER_CHIP * epochs["code_error_chips"].std() == pytest.approx(1.956, rel=0.03)
        assert measured == pytest.approx(0.02989, rel=0.03)


def test_echo_is_late_and_pulls_the_code_later():
    """A late echo in phase: at d = -tau (replica late) the taps rise; the loop settles behind the truth."""
    echo = {"delay_s": 0.5 / 1.023e6, "power_db": -6.0, "phase_rad": 0.0}
    spec = Twin(**GPS | {"cn0_dbhz": 80.0}, taps_chips=(-0.5, 0.0, 0.5), multipath=Echoes(echoes=(echo,)))
    z = spec.start_open(1)(100).mean(axis=0)
    R = lambda d: autocorrelation("L1CA", 6, np.asarray(d))  # noqa: E731
    expected = R([-0.5, 0, 0.5]) + 10**-0.3 * R([0.0, 0.5, 1.0])
    assert np.max(np.abs(z - expected)) < 1e-3
    epochs, _ = spec.start(1)(4000)
    assert epochs["code_error_chips"][-1] > 0.05  # truth ahead of the replica: range measured too long


def test_third_order_loop_and_dynamics():
    calm = GPS | {"cn0_dbhz": 70.0}
    epochs, _ = Twin(**calm, dynamics=Dynamics(accel_mps2=5.7)).start(1)(3000)
    tail = epochs[1000:]
    sigma = math.sqrt(10.0 / 1e7) / (2 * np.pi)
    assert abs(tail["phase_error_cycles"].mean()) < Z * sigma / math.sqrt(50)
    assert tail["doppler_hz"][-1] == pytest.approx(-5.7 * tail["t_s"][-1] / WAVELENGTH_M, abs=0.2)
    # Jerk: steady error = jerk T^3 / K3 (a grows by K3 e per epoch).
    jerk = 0.25 * 9.81
    epochs, _ = Twin(**calm, dynamics=Dynamics(jerk_mps3=((1.0, jerk),))).start(1)(1500)
    error = -(jerk / WAVELENGTH_M) * 0.02**3 / pll_gains(3, 10.0, 0.02)[2]
    assert epochs["phase_error_cycles"][500:].mean() == pytest.approx(error, rel=0.05)


def test_steered_channel_sees_what_it_is_given():
    spec = Twin(**GPS | {"cn0_dbhz": 80.0})
    n = 50
    steer = np.tile([0.1, 3.0, -0.2], (n, 1))
    truth = np.tile([0.2, 8.0, 0.1], (n, 1))
    epochs, corr = spec.start(1, steered=True)(n, steer=steer, truth=truth)
    z = corr.mean(axis=0)
    expected = (
        np.sinc(5.0 * 0.02)
        * np.exp(2j * np.pi * 0.1)
        * autocorrelation("L1CA", 6, spec.tap_array_chips - 0.3)
    )
    assert np.max(np.abs(z - expected)) < Z * noise_sigma(80.0, 0.02)
    assert np.allclose(epochs["code_error_chips"], 0.3)


def test_signs_turn_the_signal_or_after_wiping_the_jammer():
    base = GAL | {"cn0_dbhz": 80.0, "taps_chips": (-1.0, 0.0, 1.0)}
    jam = (TwinCW(js_db=20.0, phase_rad=0.0),)
    n = 200
    plain = Twin(**base, data=True, jammers=jam).start_open(4)(n)
    wiped = Twin(**base, data=True, wiped=True, jammers=jam).start_open(4)(n)
    signs = Twin(**base, data=True).start(4)(n)[0]["data_sign"]
    assert 60 < np.count_nonzero(signs > 0) < 140
    assert np.max(np.abs(wiped - signs[:, None] * plain)) < Z * 2 * noise_sigma(80.0, 0.004) * 1.5
    pilot = Twin(**base | {"signal": "E1C"}, data=True).start(4)(50)[0]["data_sign"]
    assert np.array_equal(pilot[:25], pilot[25:])


def test_hatch_filter():
    n = 4000
    rng = np.random.default_rng(1)
    code = 3.0 + rng.standard_normal(n)
    out = np.empty(n)
    hatch_smooth(code, np.zeros(n), 100, 0, out)
    assert np.allclose(out[:100], np.cumsum(code[:100]) / np.arange(1, 101))
    # Exponential memory of N: variance 1 / (2 N - 1).
    assert out[1000:].std() == pytest.approx(1 / math.sqrt(199), rel=0.35)
    carrier = np.linspace(0, 50, n)
    hatch_smooth(carrier, carrier, 100, 100, out)
    assert np.allclose(out, carrier)


def test_fading_echo_is_stateless_and_has_its_power():
    run = Aeronautical(fuselage_bandwidth_hz=5.0).start(3)
    gain, delay_s = run.series(0.01, 0.02, 4096)
    one = echo_gain(
        0.01 + 0.02 * 777, run.amplitude[1], run.doppler_hz[1], run.tone_hz[1], run.tone_cycles[1]
    )
    assert abs(gain[1, 777] - one) < 1e-6
    late, _ = run.series(0.01 + 0.02 * 777, 0.02, 10)
    assert np.max(np.abs(late - gain[:, 777:787])) < 1e-6
    power = np.mean([np.abs(Aeronautical().start(s).series(0.0, 1.0, 1)[0][0]) ** 2 for s in range(4000)])
    # |n|^2 of a Gaussian process has relative standard deviation 1.
    assert power == pytest.approx(10**-1.42, rel=Z / math.sqrt(4000))
    # Ground: 3000 ft at 10 degrees is 317 m late, its Doppler +5.5 Hz at 3 m/s.
    assert delay_s[1, 0] * 299792458.0 == pytest.approx(317.4, abs=0.2)
    assert run.doppler_hz[1] == pytest.approx(5.5, abs=0.05)
    assert np.all(np.diff(delay_s[1]) < 0)


@pytest.mark.parametrize("base", [GPS, GAL])
def test_front_end_filter_shapes_signal_and_noise_alike(base):
    """Brick wall on samples by FFT: mean taps and noise covariance; prompt and floor fall by the power cut off."""
    band_hz, fs_hz = 4e6, 16.368e6
    d = (-1.0, -0.5, -0.25, 0.0, 0.25, 0.5, 1.0)
    settings = {**base, "cn0_dbhz": 45.0, "taps_chips": d, "bandwidth_hz": band_hz}
    spec = Twin(**settings)
    waveform = "BPSK" if base is GPS else "BOC11"
    n = round(fs_hz * (1e-3 if base is GPS else 4e-3))
    t = np.arange(n) / fs_hz
    shift = 0.5 * 1.023e6 / fs_hz  # half a sample: the staircase's middle
    replicas = np.stack(
        [naive_twin.code_at(base["signal"], base["prn"], waveform, 1.023e6 * t + x + shift) for x in d]
    )
    spectrum = np.fft.fft(replicas[3])
    spectrum[np.abs(np.fft.fftfreq(n, 1 / fs_hz)) > band_hz / 2] = 0
    direct = replicas @ np.fft.ifft(spectrum).real / n
    R = spec.autocorrelation(np.array(d))
    assert np.max(np.abs(direct - R)) < 0.02  # aliases of the sampled code inside the band: sinc at 14 MHz
    assert R[3] < 0.99
    z = spec.start_open(1)(20_000)
    s2 = noise_sigma(45.0, base["integration_s"]) ** 2
    C = (z - R).T @ (z - R).conj() / len(z) / (2 * s2)
    expected = spec.autocorrelation(np.subtract.outer(d, d))
    assert np.max(np.abs(C - expected)) < Z / math.sqrt(len(z))
    assert np.max(np.abs(z.mean(axis=0) - R)) < Z * math.sqrt(2 * s2 / len(z)) + 1e-6
    loop, _ = spec.start(1)(3000)
    assert abs(loop["code_error_chips"][500:].mean()) < 0.01
    # Infinite band: the table of lines is the piecewise linear function.
    wide = Twin(**settings | {"bandwidth_hz": 60e6})
    ideal = Twin(**settings | {"bandwidth_hz": None})
    assert np.max(np.abs(wide.autocorrelation(d) - ideal.autocorrelation(d))) < 0.02


def test_front_end_filter_removes_jammers_outside():
    base = GPS | {"cn0_dbhz": 80.0, "bandwidth_hz": 2e6}
    plain = Twin(**base).start_open(3)(2000)

    def added(jammer):
        return Twin(**base, jammers=(jammer,)).start_open(3)(2000) - plain

    assert np.all(added(TwinCW(js_db=20, freq_hz=1.1e6)) == 0)
    assert np.all(added(TwinNBI(js_db=20, freq_hz=1.6e6, line="worst", bandwidth_hz=1e6)) == 0)
    assert np.any(added(TwinCW(js_db=20, freq_hz=0.9e6)) != 0)
    sweep = np.abs(added(TwinCW(js_db=20, freq_hz=1.0e6 - 100, rate_hz_s=10))).max(axis=1)
    assert np.max(sweep[501:]) < 1e-6  # another product shape: rounding
    assert np.max(sweep[450:500]) > 1e-3
    half = np.mean(np.abs(added(TwinNBI(js_db=20, freq_hz=1e6, bandwidth_hz=4e5))) ** 2)
    inside = np.mean(np.abs(added(TwinNBI(js_db=20, freq_hz=0.9e6, bandwidth_hz=2e5))) ** 2)
    assert half == pytest.approx(0.5 * inside, rel=1e-3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"prn": 77}, "PRN"),
        ({"integration_s": 0.0205}, "whole number of code periods"),
        ({"integration_s": 0.1, "data": True}, "more than one symbol"),
        ({"taps_chips": (0.0, 0.0)}, "coincide"),
        ({"jammers": (TwinCW(js_db=0, rate_hz_s=1e3),)}, "use samples"),
    ],
)
def test_bad_twins_are_refused(change, words):
    with pytest.raises(ValidationError, match=words):
        Twin(**GPS | change)


def test_other_bad_input():
    with pytest.raises(ValidationError, match="later than"):
        TwinCW(js_db=0, start_s=3, end_s=2)
    with pytest.raises(ValidationError, match="not both"):
        TwinCW(js_db=0, freq_hz=1e3, line=3)
    with pytest.raises(ValidationError, match="below height_m"):
        Aeronautical(height_m=50)
    with pytest.raises(ValidationError):
        Echoes(echoes=({"delay_s": -1e-7, "power_db": -3},))
    with pytest.raises(ValueError, match="least the twin resolves"):
        Twin(**GPS, jammers=(TwinNBI(js_db=0, bandwidth_hz=0.01),)).start(1)
    with pytest.raises(ValueError, match="needs steer"):
        Twin(**GPS).start(1, steered=True)(10)
    with pytest.raises(ValueError, match="shape"):
        Twin(**GPS).start(1)(10, truth=np.zeros((3, 3)))
