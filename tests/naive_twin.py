"""Textbook twins: correlators from samples, the closed loop one epoch at a time, Nuttall-Strand by least squares."""

import math

import numpy as np

from signals.codes import primary_code
from signals.modulation import autocorrelation, chip_waveform


def code_at(signal, prn, waveform, phase_chips):
    """Code waveform at any code phase."""
    chips = primary_code(signal, prn).astype(float)
    slots = chip_waveform(waveform)
    wave = np.outer(chips, slots).ravel()
    return wave[np.floor(np.mod(phase_chips, len(chips)) * len(slots)).astype(int) % len(wave)]


def correlate_samples(x, signal, prn, waveform, fs_hz, taps_chips, n_epochs, code_phase_chips=0.0):
    """Plain correlators of zero-Doppler samples x: (n_epochs, K)."""
    n = len(x) // n_epochs
    phase = code_phase_chips + 1.023e6 * np.arange(len(x)) / fs_hz
    out = np.empty((n_epochs, len(taps_chips)), complex)
    for k, d in enumerate(taps_chips):
        replica = code_at(signal, prn, waveform, phase + d)
        out[:, k] = (x * replica)[: n * n_epochs].reshape(n_epochs, n).mean(axis=1)
    return out


def closed_loop(spec, taps, noise, signs, echoes, cws, lines, gains, code_gain, scale, truth, ramp=0.0):
    """One channel with loops, complex128, the exact sum over the given code lines.

    ``noise`` complex (n, K); ``echoes`` (gain, chips) each (m, n); ``cws`` rows (f, rate, phase, amplitude);
    ``lines`` {k: c_k}; returns correlator outputs and (code error, phase error).
    """
    T = spec.integration_s
    chips = len(primary_code(spec.signal, spec.prn))
    line_hz = 1.023e6 / chips
    i_e, i_p, i_l = (
        int(np.argmin(np.abs(taps - d)))
        for d in (spec.early_late_space_chips / 2, 0, -spec.early_late_space_chips / 2)
    )
    R = lambda d: autocorrelation(spec.signal, spec.prn, d, spec.waveform)  # noqa: E731
    theta, _, tau = truth[0]
    rate = v = truth[0, 1] * T
    a = ramp
    corr, errors = [], []
    for n in range(len(noise)):
        eps, th_e, f_e = truth[n, 2] - tau, truth[n, 0] - theta, truth[n, 1] - rate / T
        direct = signs[n] * np.sinc(f_e * T) * np.exp(2j * np.pi * th_e)
        z = direct * R(taps - eps)
        for g, d in zip(*echoes):
            z = z + direct * g[n] * R(taps - eps + d[n])
        t = (n + 0.5) * T
        t -= tau / 1.023e6  # integrations follow the replica's code: N / 2 codes at mid-interval
        periods = round(T * line_hz)
        for f, chirp, phase, amplitude in cws:
            for k, c in lines.items():
                psi = phase + f * t + 0.5 * chirp * t * t - theta
                gain = amplitude * np.sinc((f + chirp * t - rate / T - k * line_hz) * T)
                z = z + gain * np.conj(c) * np.exp(2j * np.pi * (psi - k * (periods / 2 + taps / chips)))
        z = z + noise[n]
        corr.append(z)
        errors.append((eps, th_e))
        p = z[i_p]
        code = scale * ((z[i_e] - z[i_l]) * np.conj(p)).real / abs(p) ** 2
        phase = math.atan(p.imag / p.real) / (2 * np.pi)
        a += gains[2] * phase
        v += gains[1] * phase + a
        new = v + gains[0] * phase
        step = 0.5 * (rate + new)
        rate, theta, tau = new, theta + step, tau + step / 1540 + code_gain * code
    return np.array(corr), np.array(errors)


def ar_least_squares(x, order):
    """Forward least-squares prediction: coefficients (p, K, K)."""
    K = x.shape[1]
    past = np.concatenate([x[order - i : len(x) - i] for i in range(1, order + 1)], axis=1)
    solution = np.linalg.lstsq(past, x[order:], rcond=None)[0]
    return -solution.T.reshape(K, order, K).transpose(1, 0, 2)
