import numpy as np
import pytest

from signals.geodesy import ecef_to_geodetic, elevation_azimuth, geodetic_to_ecef, ned_matrix
from signals.geometry_kernels import geodetic_kernel

rng = np.random.default_rng(7)
LAT = np.concatenate([rng.uniform(-1.57, 1.57, 200), [0.0, np.pi / 2, -np.pi / 2]])
LON = np.concatenate([rng.uniform(-np.pi, np.pi, 200), [0.0, 0.5, -0.5]])
HEIGHT = np.concatenate([rng.uniform(-1e3, 2e5, 100), rng.uniform(2e5, 2.5e7, 100), [0.0, 10.0, 10.0]])
# Float64 resolves a coordinate of 3e7 m to 4e-9 m; a few roundings of it bound every identity here.
TOL_M = 5e-8


def test_round_trip_from_the_surface_to_the_satellites():
    pos = geodetic_to_ecef(LAT, LON, HEIGHT)
    lat, lon, height = ecef_to_geodetic(pos)
    assert np.abs(geodetic_to_ecef(lat, lon, height) - pos).max() < TOL_M
    assert np.abs(height - HEIGHT).max() < TOL_M
    assert np.abs((lat - LAT) * 6.4e6).max() < TOL_M


def test_agrees_with_pymap3d():
    pymap3d = pytest.importorskip("pymap3d")
    pos = geodetic_to_ecef(LAT, LON, HEIGHT)
    other = np.stack(pymap3d.geodetic2ecef(np.degrees(LAT), np.degrees(LON), HEIGHT), axis=-1)
    assert np.abs(pos - other).max() < TOL_M
    here = geodetic_to_ecef(0.83, 0.19, 500.0)
    far = geodetic_to_ecef(LAT, LON, 2.02e7)
    az, el, _ = pymap3d.ecef2aer(*far.T, np.degrees(0.83), np.degrees(0.19), 500.0)
    elevation, azimuth = elevation_azimuth(here, far)
    assert np.abs(elevation - np.radians(el)).max() < 1e-12
    assert np.abs(np.angle(np.exp(1j * (azimuth - np.radians(az))))).max() < 1e-9


def test_ned_matrix_is_a_rotation_along_the_gradient_of_latitude_longitude_and_depth():
    lat, lon, height = 0.7, -2.1, 300.0
    c = ned_matrix(lat, lon)
    assert np.allclose(c @ c.T, np.eye(3), atol=1e-15) and np.isclose(np.linalg.det(c), 1.0)
    step = 1e-6
    north = geodetic_to_ecef(lat + step, lon, height) - geodetic_to_ecef(lat - step, lon, height)
    east = geodetic_to_ecef(lat, lon + step, height) - geodetic_to_ecef(lat, lon - step, height)
    down = geodetic_to_ecef(lat, lon, height - 1.0) - geodetic_to_ecef(lat, lon, height + 1.0)
    for row, line in zip(c, (north, east, down)):
        assert np.allclose(row, line / np.linalg.norm(line), atol=1e-8)


def test_scalar_kernel_is_the_same_function():
    pos = geodetic_to_ecef(LAT, LON, HEIGHT)
    other = np.array([geodetic_kernel(*p) for p in pos])
    lat, lon, height = ecef_to_geodetic(pos)
    assert (
        np.abs(np.stack([lat * 6.4e6, lon * 6.4e6, height], axis=1) - other * [6.4e6, 6.4e6, 1]).max() < TOL_M
    )
