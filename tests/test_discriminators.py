"""Discriminators against the ideal autocorrelation, loop gains against their exact noise bandwidth."""

import math

import numpy as np
import pytest

from signals.modulation import chip_acf
from tracking import discriminators as d
from tracking import loops

WAVEFORMS = [("BPSK", "BPSK", 0.5), ("BPSK", "BPSK", 1.0), ("BOC11", "BOC11", 0.25), ("CBOC-", "BOC11", 0.25),
             ("CBOC-", "CBOC-", 0.2), ("CBOC+", "BOC11", 0.1)]  # fmt: skip


@pytest.mark.parametrize("phase", [-0.4, -0.2, -0.01, 0.0, 0.1, 0.24])
def test_carrier_discriminators_give_the_phase(phase):
    p = 3.0 * np.exp(2j * np.pi * phase)
    assert d.four_quadrant(p.real, p.imag) == pytest.approx(phase, abs=1e-12)
    folded = (phase + 0.25) % 0.5 - 0.25
    assert d.costas_atan(p.real, p.imag) == pytest.approx(folded, abs=1e-12)
    assert d.costas_atan(-p.real, -p.imag) == pytest.approx(folded, abs=1e-12)
    small = np.exp(2j * np.pi * 1e-4)
    assert d.costas_product(small.real, small.imag) == pytest.approx(1e-4, rel=1e-5)


@pytest.mark.parametrize("freq_hz", [-40.0, -3.0, 0.0, 11.0, 49.0])
def test_frequency_discriminator_over_the_halves_of_20_ms(freq_hz):
    """Signal ahead in frequency turns from the first half to the second by 2 pi df T/2."""
    T = 20e-3
    a, b = np.exp(1j * 0.3), np.exp(1j * (0.3 + 2 * np.pi * freq_hz * T / 2))
    assert d.frequency_error_hz(a.real, a.imag, b.real, b.imag, T / 2) == pytest.approx(freq_hz, abs=1e-9)


@pytest.mark.parametrize("name", ["envelope", "power", "dot_product", "coherent", "very_early_late"])
@pytest.mark.parametrize("tx, rx, spacing", WAVEFORMS)
def test_code_discriminators_are_in_chips(name, tx, rx, spacing):
    """Slope one about zero for every waveform, spacing and form, the sign as in tracking.records."""
    if name == "very_early_late" and tx == "BPSK":
        pytest.skip("a BOC discriminator")
    acf = lambda x: chip_acf(x, tx, rx)  # noqa: E731
    scale = d.code_scale_chips(name, acf, spacing, 1.0)

    def output(error):
        # An incoming code ahead by `error`: the tap advanced by x sees R(x - error).
        taps = [complex(acf(x - error)) for x in (0.5, spacing / 2, 0.0, -spacing / 2, -0.5)]
        return d.code_error(d.CODE_DISCRIMINATORS[name], *taps) * scale

    h = 2e-3
    slope = (output(h) - output(-h)) / (2 * h)
    assert output(0.0) == pytest.approx(0.0, abs=1e-12)
    # The finite differences average over corners of the autocorrelation of up to 10 % within h.
    assert slope == pytest.approx(1.0, abs=0.03)


def test_a_spacing_off_the_main_peak_is_refused():
    with pytest.raises(ValueError, match="main peak"):
        d.code_scale_chips("envelope", lambda x: chip_acf(x, "BOC11"), 1.2)


def test_published_gains():
    """interference.md, section 2: triple pole, mean of old and new rate."""
    assert loops.pll_gains(3, 10.0, 0.02) == pytest.approx((0.34888, 0.056465, 0.0033984), rel=2e-5)
    assert loops.pll_gains(3, 10.0, 0.004) == pytest.approx((0.10380, 0.0038702, 4.9058e-5), rel=2e-5)
    assert loops.dll_gains(1, 1.0, 0.02)[0] == pytest.approx(4 * 0.02 / 1.04)


@pytest.mark.parametrize("order, bt", [(2, 0.01), (2, 0.3), (3, 0.01), (3, 0.1), (3, 0.2), (3, 0.3)])
def test_noise_bandwidth_is_what_was_asked(order, bt):
    """Twin: run the loop equations on white phase noise impulse by impulse; 2 B T = sum h^2."""
    T = 0.02
    k1, k2, k3 = loops.pll_gains(order, bt / T, T)
    theta = freq = rate = accel = 0.0
    energy = 0.0
    for k in range(200_000):
        energy += theta**2
        e = (1.0 if k == 0 else 0.0) - theta
        accel += k3 * e
        rate += k2 * e + accel
        new = rate + k1 * e
        theta += 0.5 * (freq + new)
        freq = new
        if k > 100 and abs(theta) + abs(freq) + abs(accel) < 1e-12:
            break
    assert energy / 2 == pytest.approx(bt, rel=1e-6)


@pytest.mark.parametrize("order", [1, 2])
def test_dll_bandwidth(order):
    T, bw = 0.02, 2.0
    k1, k2 = loops.dll_gains(order, bw, T)
    tau = rate = energy = 0.0
    for k in range(20_000):
        energy += tau**2
        e = (1.0 if k == 0 else 0.0) - tau
        rate += k2 * e
        tau += k1 * e + rate
    assert energy / 2 / T == pytest.approx(bw, rel=1e-6)


def test_third_order_loop_follows_a_frequency_ramp_without_error():
    T = 0.02
    k1, k2, k3 = loops.pll_gains(3, 10.0, T)
    theta = freq = rate = accel = 0.0
    errors = []
    for k in range(400):
        phi = 0.5 * 0.01 * k * k
        e = phi - theta
        accel += k3 * e
        rate += k2 * e + accel
        new = rate + k1 * e
        theta += 0.5 * (freq + new)
        freq = new
        errors.append(e)
    assert abs(errors[-1]) < 1e-9 < max(map(abs, errors))


@pytest.mark.parametrize(
    "call, word",
    [
        (lambda: loops.pll_gains(3, 10.0, 0.1), "B_L T = 1"),
        (lambda: loops.pll_gains(4, 1.0, 0.02), "order 4"),
        (lambda: loops.dll_gains(1, -1.0, 0.02), "positive"),
    ],
)
def test_unstable_loops_are_refused(call, word):
    with pytest.raises(ValueError, match=word):
        call()


def test_jitter_formula_is_kaplans_for_bpsk():
    cn0 = 10**4.0
    want = math.sqrt(1.0 * 0.5 / (2 * cn0) * (1 + 2 / (1.5 * 0.02 * cn0)))
    assert loops.dll_jitter_chips(40.0, 1.0, 0.02, 0.5) == pytest.approx(want, rel=1e-9)
