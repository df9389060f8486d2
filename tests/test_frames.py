"""Frames: round trips, numerical derivatives, an independent library, gravity's two forms compared."""

import numpy as np
import pytest

from nav import frames

POINTS = [
    (0.0, 0.0, 0.0),
    (0.7, -2.1, 123.0),
    (-1.2, 3.0, 9000.0),
    (1.5707, 0.3, -50.0),
    (0.83, 0.2, 2.0e7),
]


@pytest.mark.parametrize("point", POINTS)
def test_geodetic_round_trip_and_peer(point):
    xyz = frames.ecef_from_geodetic(*point)
    lat, lon, h = frames.geodetic_from_ecef(xyz)
    np.testing.assert_allclose([lat, lon], point[:2], atol=2e-15)
    assert abs(h - point[2]) < 1e-8 * max(1.0, point[2] / 1e6)
    pymap3d = pytest.importorskip("pymap3d")
    np.testing.assert_allclose(xyz, pymap3d.geodetic2ecef(*point, deg=False), atol=2e-8)


@pytest.mark.parametrize("point", POINTS[:4])
def test_position_map_is_the_derivative(point):
    t = frames.position_map_geodetic(*point)
    for k, step in enumerate((1e-6, 1e-6, 1.0)):
        hi, lo = list(point), list(point)
        hi[k] += step
        lo[k] -= step
        numeric = (frames.ecef_from_geodetic(*hi) - frames.ecef_from_geodetic(*lo)) / (2 * step)
        np.testing.assert_allclose(t[:, k], numeric, atol=1e-5 if k < 2 else 1e-8, rtol=1e-9)


def test_local_frames_are_rotations_and_agree():
    for lat, lon, _ in POINTS:
        r, c = frames.rotation_enu_to_ecef(lat, lon), frames.rotation_ned_to_ecef(lat, lon)
        np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-15)
        np.testing.assert_allclose(c, np.column_stack([r[:, 1], r[:, 0], -r[:, 2]]), atol=0)
        assert np.linalg.det(r) == pytest.approx(1.0) and np.linalg.det(c) == pytest.approx(1.0)


def test_euler_round_trip():
    for euler in [(0.3, -0.2, 1.1), (-3.0, 1.2, -2.9), (2.0, 0.0, 0.0)]:
        c_bn = frames.rotation_body_to_ned(*euler)
        np.testing.assert_allclose(frames.euler_from_rotation(c_bn), euler, atol=1e-14)
    yaw, pitch, roll = frames.euler_from_rotation(frames.rotation_body_to_ned(0.7, np.pi / 2, 0.0))
    assert (yaw, pitch, roll) == (pytest.approx(0.7), pytest.approx(np.pi / 2, abs=1e-6), 0.0)


def test_gravity_forms_agree_and_point_down():
    """J2 + centrifugal leaves out J4 = -2.4e-6 and higher: a few times |J4| g = 2.3e-5 m/s^2, bound 2e-4."""
    for lat, lon, h in POINTS[:4]:
        g = np.empty(3)
        frames.gravity_ecef(frames.ecef_from_geodetic(lat, lon, h), g)
        down = frames.rotation_ned_to_ecef(lat, lon)[:, 2]
        assert np.linalg.norm(g) == pytest.approx(frames.normal_gravity(lat, h), abs=2e-4)
        horizontal = g - down * (g @ down)
        assert np.linalg.norm(horizontal) < 1e-4 + 2e-9 * 9.8 * abs(h)
