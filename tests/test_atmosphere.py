import naive_orbit as naive
import numpy as np
import pytest

from signals.atmosphere import KLOBUCHAR_X_CONTINUOUS, klobuchar, saastamoinen

ALPHA, BETA = (0.382e-7, 0.149e-7, -0.179e-6, 0.0), (0.143e6, 0.0, -0.328e6, 0.113e6)


def test_published_example():
    # Worked example that circulates with the Klobuchar model: 40 N, 100 W, azimuth 210, elevation 20: 23.784 m.
    delay = klobuchar(
        np.radians(40), np.radians(-100), np.radians(210), np.radians(20), 593_100.0, ALPHA, BETA
    )
    assert abs(delay * naive.C - 23.784) < 5e-4


def test_klobuchar_against_the_twin_in_degrees():
    rng = np.random.default_rng(3)
    lat, lon = rng.uniform(-90, 90, 500), rng.uniform(-180, 180, 500)
    az, el, tow = rng.uniform(0, 360, 500), rng.uniform(2, 90, 500), rng.uniform(0, 604_800, 500)
    ours = naive.C * klobuchar(*np.radians([lat, lon, az, el]), tow, ALPHA, BETA)
    twin = [naive.klobuchar_m(*row, ALPHA, BETA) for row in zip(lat, lon, az, el, tow)]
    # GNSS_PI differs from pi by 7e-15; conditions of max() and the clip are continuous.
    assert np.abs(ours - twin).max() < 1e-7


def test_klobuchar_floor_at_night_and_slant():
    night = klobuchar(0.8, 0.0, 0.0, np.pi / 2, 0.0, ALPHA, BETA)
    assert np.isclose(night, 5e-9 * (1 + 16 * (0.53 - 0.5) ** 3), rtol=1e-9)


def test_continuous_limit_removes_the_step_at_dusk_and_nothing_else():
    tow = np.arange(0.0, 86_400.0, 1.0)
    icd = klobuchar(0.8, 0.2, 1.0, 0.5, tow, ALPHA, BETA)
    smooth = klobuchar(0.8, 0.2, 1.0, 0.5, tow, ALPHA, BETA, KLOBUCHAR_X_CONTINUOUS)
    # The series at 1.57 is 0.0207 of the amplitude; its slope at its zero 0.92 per rad, 2 pi / 72000 rad/s.
    amplitude = (icd.max() - icd.min()) * 1.001
    assert np.abs(np.diff(icd)).max() > 0.02 * amplitude
    assert np.abs(np.diff(smooth)).max() < 1.1 * 2 * np.pi / 72_000 * amplitude
    different = icd != smooth
    assert np.abs(icd - smooth).max() < 0.021 * amplitude
    assert different.sum() < 2 * 0.024 * 143_000 / (2 * np.pi)


def test_saastamoinen_zenith_is_2_3_m_dry_and_decimetres_wet():
    dry = saastamoinen(np.radians(45.0), 0.0, np.pi / 2, 0.0)
    assert np.isclose(dry, 0.0022768 * 1013.25, rtol=1e-6)
    # 15 deg C, 70 %: e = 0.7 * 17.04 hPa (Magnus, within 1 %), wet = 0.002277 (1255 / 288.16 + 0.05) e.
    wet = saastamoinen(np.radians(45.0), 0.0, np.pi / 2) - dry
    assert abs(wet / (0.002277 * (1255 / 288.16 + 0.05) * 0.7 * 17.04) - 1) < 0.01


def test_saastamoinen_falls_with_height_and_grows_with_the_cosecant():
    heights = np.arange(0.0, 20_000.0, 100.0)
    delay = saastamoinen(0.8, heights, np.pi / 2)
    assert np.all(np.diff(delay) < 0) and np.abs(np.diff(delay)).max() < 0.06
    # Barometric: half the air is below about 5.5 km.
    assert 0.4 < saastamoinen(0.8, 5_500.0, np.pi / 2, 0.0) / saastamoinen(0.8, 0.0, np.pi / 2, 0.0) < 0.55
    assert np.isclose(saastamoinen(0.8, 0.0, np.radians(30)), 2 * saastamoinen(0.8, 0.0, np.pi / 2))
    assert saastamoinen(0.8, 60_000.0, 1.0) == pytest.approx(0.0)
