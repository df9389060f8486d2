"""The twin and plain correlators on samples give the same statistics: at least 5000 integrations of each."""

import math

import naive_twin
import numpy as np
import pytest
from scipy import fft as sp_fft
from scipy import stats

from monitors.fft import FftMonitor
from monitors.glrt import GlrtMonitor
from monitors.multichannel_ar import MultichannelAr
from signals.modulation import autocorrelation
from signals.multipath import Echoes
from tracking.correlator_model import Twin, TwinCW, TwinNBI, code_spectrum, noise_sigma
from tracking.twin_kernels import normals_columns

Z = 5.0
# C/N0 raised so that one code period has the noise of the note's 20 ms and 100 ms.
CASES = {
    "GPS": (
        {"signal": "L1CA", "prn": 6, "waveform": "BPSK", "cn0_dbhz": 53.5, "integration_s": 1e-3},
        16.384e6,
        4.0,
    ),
    "GAL": (
        {"signal": "E1B", "prn": 38, "waveform": "BOC11", "cn0_dbhz": 48.8, "integration_s": 4e-3},
        8.192e6,
        8.0,
    ),
}
N_BATCH, BATCH = 20, 256


def integrate_samples(spec, fs_hz, cw, echo, seed):
    """Correlator outputs (N_BATCH * BATCH, K) from samples, one code phase per batch."""
    n = round(fs_hz * spec.integration_s)
    taps = spec.tap_array_chips
    sigma = noise_sigma(spec.cn0_dbhz, spec.integration_s) * math.sqrt(n)
    noise = np.empty((n // 1024, 2048), np.float32)
    hashes = np.empty(1024, np.int32), np.empty(1024, np.int32)
    x = np.empty((2 * BATCH, n), np.float32)
    t = np.arange(n) / fs_hz
    out = []
    for batch in range(N_BATCH):
        # Phases spread over a sample, so that the staircase of the sampled autocorrelation averages out.
        first = (batch + 0.5) / N_BATCH * 1.023e6 / fs_hz
        phase = first + 1.023e6 * t
        replicas = np.stack(
            [naive_twin.code_at(spec.signal, spec.prn, spec.waveform, phase + d) for d in taps]
        )
        direct = naive_twin.code_at(spec.signal, spec.prn, spec.waveform, phase)
        if echo:
            late = naive_twin.code_at(spec.signal, spec.prn, spec.waveform, phase - echo[1])
            direct = direct + echo[0] * late
        for e in range(BATCH):
            epoch = batch * BATCH + e
            normals_columns(np.uint64(seed), epoch, *hashes, noise)
            signal = direct
            if cw:
                amplitude, f, rate = cw
                u = t + epoch * spec.integration_s
                turn = np.mod((f + 0.5 * rate * epoch * spec.integration_s) * u, 1.0)
                signal = direct + amplitude * np.exp(2j * np.pi * turn)
            x[e] = sigma * noise[:, :1024].ravel() + np.real(signal)
            x[BATCH + e] = sigma * noise[:, 1024:].ravel() + np.imag(signal)
        z = x @ replicas.astype(np.float32).T / n
        out.append(z[:BATCH] + 1j * z[BATCH:])
    return np.concatenate(out).astype(np.complex64)


@pytest.fixture(scope="module", params=["GPS", "GAL"])
def quiet(request):
    settings, fs_hz, js_db = CASES[request.param]
    spec = Twin(**settings)
    n = N_BATCH * BATCH
    return spec, fs_hz, js_db, integrate_samples(spec, fs_hz, None, None, 1), spec.start_open(2)(n)


def test_noise_variance_and_covariance(quiet):
    spec, _, _, samples, twin = quiet
    s2 = noise_sigma(spec.cn0_dbhz, spec.integration_s) ** 2
    d = spec.tap_array_chips
    R = autocorrelation(spec.signal, spec.prn, d[:, None] - d[None, :], spec.waveform)
    n = len(samples)
    for z, slack in ((samples, 0.01), (twin, 0.0)):  # 0.01: the staircase left by twenty phases
        z = np.concatenate([part - part.mean(axis=0) for part in np.split(z, N_BATCH)])
        C = z.T @ z.conj() / (n - N_BATCH) / (2 * s2)
        variance = np.mean(np.diag(C).real)
        # Equal diagonal entries of correlated taps: no worse than one tap's sqrt(1 / n).
        assert variance == pytest.approx(1.0, abs=Z / math.sqrt(n))
        assert math.sqrt(np.mean(np.abs(C - R) ** 2)) == pytest.approx(
            1 / math.sqrt(n), rel=0.15, abs=slack / 2
        )


def statistics_of(runs, z):
    return {
        "FFT I+jQ": runs["C"].maxima(z)[0],
        "FFT I": runs["I"].maxima(z)[0],
        "GLRT": runs["G"].fresh()(z)["value"],
        "AR": runs["A"].energies(z)[::2],  # every second residual: neighbours share a vector
    }


def trained(spec, twin):
    args = spec.tap_array_chips, spec.integration_s, spec.signal, spec.prn, spec.waveform
    runs = {"C": FftMonitor().start(*args), "I": FftMonitor(input="I").start(*args)}
    runs["G"] = GlrtMonitor(noise_variance=noise_sigma(spec.cn0_dbhz, spec.integration_s) ** 2).start(*args)
    runs["A"] = MultichannelAr(window_s=1000 * spec.integration_s, wipe_sign=False).start(*args)
    runs["A"].train(spec.start_open(77)(8192))
    return runs


@pytest.mark.parametrize("jammed", [False, True])
def test_raw_statistics_have_one_distribution(quiet, jammed):
    spec, fs_hz, js_db, samples, twin = quiet
    runs = trained(spec, twin)
    if jammed:
        k = 227 if spec.signal == "L1CA" else 2694
        f = k / spec.integration_s + 0.3 / spec.integration_s + 3.7  # 3.7 Hz: the phase goes round
        samples = integrate_samples(spec, fs_hz, (10 ** (js_db / 20), f, 0.0), None, 3)
        jam = TwinCW(js_db=js_db, line=k, offset_hz=f - k / spec.integration_s, phase_rad=0.3)
        twin = spec.model_copy(update={"jammers": (jam,)}).start_open(4)(len(samples))
    a, b = statistics_of(runs, samples), statistics_of(runs, twin)
    for name in a:
        # 8 tests a file: the 1e-4 level keeps the family below 1e-3. The sampled peak is a staircase of 1/16 or
        # 1/8 chip, which twenty phases blur: up to 0.1 sd on top of the pure sampling error.
        p = stats.ks_2samp(a[name], b[name]).pvalue
        shift = (a[name].mean() - b[name].mean()) / b[name].std()
        assert abs(shift) < Z * math.sqrt(2 / len(a[name])), (name, shift)
        assert p > 1e-4, (name, p, shift)


def test_multipath_distortion_of_the_taps(quiet):
    spec, fs_hz, _, _, _ = quiet
    chips = 0.4
    samples = integrate_samples(spec, fs_hz, None, (0.5, chips), 5).mean(axis=0)
    echo = {"delay_s": chips / 1.023e6, "power_db": 20 * math.log10(0.5), "phase_rad": 0.0}
    twin = spec.model_copy(update={"multipath": Echoes(echoes=(echo,))}).start_open(6)(4096).mean(axis=0)
    error = Z * noise_sigma(spec.cn0_dbhz, spec.integration_s) * math.sqrt(1 / 5120 + 1 / 4096)
    step = 1.023e6 / fs_hz  # staircase: slope 3 of BOC times half a sample, blurred by the phases
    assert np.max(np.abs(samples - twin)) < error + 0.5 * step
    assert abs(code_spectrum(spec.signal, spec.prn, 0, spec.waveform)) < 0.01


@pytest.mark.parametrize("bandwidth_hz", [1e3, 1e4, 1e5, 1e6])
@pytest.mark.parametrize("signal", ["L1CA", "E1B"])
def test_narrow_band_noise_power(signal, bandwidth_hz):
    """Mean tap power of flat Gaussian noise around the line, 1 kHz to 1 MHz, from samples and from the twin."""
    prn, waveform, integration_s, line_hz, fs_hz, n_epochs = {
        "L1CA": (6, "BPSK", 1e-3, 227e3, 4.096e6, 2048),
        "E1B": (38, "BOC11", 4e-3, 673.5e3, 8.192e6, 256),
    }[signal]
    settings = {
        "signal": signal,
        "prn": prn,
        "waveform": waveform,
        "cn0_dbhz": 80.0,
        "integration_s": integration_s,
    }
    twin = Twin(**settings, jammers=(TwinNBI(js_db=20.0, bandwidth_hz=bandwidth_hz),))
    d = twin.tap_array_chips
    z = twin.start_open(1)(n_epochs) - autocorrelation(signal, prn, d, waveform)
    length = round(integration_s * fs_hz)
    n = length * n_epochs
    step_hz = fs_hz / n
    band = np.arange(
        math.ceil((line_hz - bandwidth_hz / 2) / step_hz), math.floor((line_hz + bandwidth_hz / 2) / step_hz)
    )
    rng = np.random.default_rng(2)
    spectrum = np.zeros(n, np.complex64)
    g = rng.standard_normal((2, len(band)), np.float32)
    spectrum[band % n] = (g[0] + 1j * g[1]) * np.float32(10.0 / math.sqrt(2 * len(band)) * n)
    x = sp_fft.ifft(spectrum, overwrite_x=True).reshape(n_epochs, length)
    t = np.arange(length) / fs_hz
    replicas = np.stack([naive_twin.code_at(signal, prn, waveform, 1.023e6 * t + tap) for tap in d])
    y = x @ (replicas.T / length).astype(np.complex64)
    power = [np.mean(np.abs(v) ** 2) for v in (y, z)]
    # Independent values of the mean: epochs times what the band holds of 1 / T, taps counted once. The lines of a code
    # sampled at one phase differ by up to 5 % from the ideal ones (interference note).
    independent = n_epochs * min(1.0, bandwidth_hz * integration_s)
    assert power[0] == pytest.approx(power[1], rel=Z * math.sqrt(2 / independent) + 0.05)
    # Epoch-to-epoch correlation agrees too: it is real below 1 / T, and none is left above.
    lag = [np.mean(v[1:] * v[:-1].conj()) / p for v, p in zip((y, z), power)]
    assert abs(lag[0] - lag[1]) < Z * math.sqrt(2 / independent)
