import numpy as np
import pytest

from signals.clock import CLOCK_STEP_S, ClockSpec, random_walk
from signals.geodesy import ned_matrix
from signals.trajectory import HighDynamics

C = 299_792_458.0


def test_steady_clock():
    bias, drift = ClockSpec(bias_s=1e-4, drift_s_s=-2e-6).start(0, 10.0)(np.array([0.0, 5.0]))
    assert np.allclose(bias, [1e-4, 9e-5], atol=1e-18) and np.all(drift == -2e-6)


def test_noise_is_the_same_for_any_chunking_and_any_longer_run():
    spec = ClockSpec(noise="TCXO")
    t = np.arange(0.0, 30.0, 0.013)
    whole = spec.start(5, 30.0)(t)
    parts = [spec.start(5, 300.0)(part) for part in np.array_split(t, 7)]
    assert np.array_equal(whole[0], np.concatenate([p[0] for p in parts]))
    assert np.array_equal(whole[1], np.concatenate([p[1] for p in parts]))
    assert not np.array_equal(whole[0], spec.start(6, 30.0)(t)[0])
    assert spec.start(5, 30.0)(0.0)[0][0] == 0.0


def test_drift_is_the_derivative_of_the_bias_and_continuous():
    at = ClockSpec(noise="TCXO", drift_s_s=1e-6).start(2, 20.0)
    t, h = np.arange(0.00037, 20.0, 0.0101), 1e-6
    difference = (at(t + h)[0] - at(t - h)[0]) / (2 * h)
    # Biases of 2e-5 s resolve 3e-21 s; 3e-21 / 2e-6 = 2e-15.
    assert np.abs(difference - at(t)[1]).max() < 5e-15
    edges = np.arange(1, 900) * CLOCK_STEP_S
    assert np.abs(at(edges + 1e-9)[1] - at(edges - 1e-9)[1]).max() < 1e-14


@pytest.mark.parametrize(
    "h0, h2, tau_steps", [(2e-19, 2e-20, 1), (2e-19, 2e-20, 100), (0.0, 2e-20, 1), (0.0, 2e-20, 10)]
)
def test_allan_variance_is_that_of_h0_and_h_minus_2(h0, h2, tau_steps):
    n = 300_000
    x = random_walk(h0, h2, np.random.default_rng(1), n * CLOCK_STEP_S)
    tau = tau_steps * CLOCK_STEP_S
    second = x[2 * tau_steps :] - 2 * x[tau_steps:-tau_steps] + x[: -2 * tau_steps]
    second = second[:: 2 * tau_steps]
    measured = np.mean(second**2) / (2 * tau**2)
    # sigma_y^2 = h0 / (2 tau) + 2 pi^2 tau h-2 / 3 (Brown and Hwang 1997, chapter 10; IEEE 1139).
    expected = h0 / (2 * tau) + 2 * np.pi**2 * tau * h2 / 3
    assert abs(measured / expected - 1) < 5 * np.sqrt(2 / second.size)


def test_acceleration_shifts_the_frequency():
    motion = HighDynamics().start()
    spec = ClockSpec(g_sensitivity_ned_per_g=(1e-9, 0.0, 0.0))
    at = spec.start(0, 30.0, motion)
    t = np.linspace(0.0, 30.0, 301)
    # 10 m/s^2 sin(2 pi t / 20 s) along north.
    assert np.allclose(at(t)[1], 1e-9 * 10 / 9.80665 * np.sin(2 * np.pi * t / 20), atol=1e-15)
    assert at(0.0)[0][0] == 0.0
    north = ned_matrix(np.radians(48.0), np.radians(11.0))[0]
    gained = (motion(10.0).vel_ecef_mps - motion(0.0).vel_ecef_mps) @ north
    assert np.allclose(at(10.0)[0], 1e-9 * gained / 9.80665, atol=1e-18)
    with pytest.raises(ValueError, match="needs the motion"):
        spec.start(0, 1.0)


def test_asking_outside_the_duration_is_refused():
    with pytest.raises(ValueError, match="outside the duration"):
        ClockSpec(noise="CSAC").start(0, 1.0)(5.0)
