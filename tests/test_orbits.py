import naive_orbit as naive
import numpy as np
import pytest

from signals import inav, lnav
from signals.geodesy import ecef_to_geodetic, elevation_azimuth, geodetic_to_ecef
from signals.orbits import (
    check_ephemeris,
    default_iono_utc,
    nominal_constellation,
    quantise_ephemeris,
    satellite_state,
)
from signals.records import EPHEMERIS
from signals.timescale import calendar, week_tow

WEEK, TOW = 2303, 475_200
BOTH = np.concatenate([nominal_constellation("G", WEEK, TOW), nominal_constellation("E", WEEK, TOW)])


def circular(**changes):
    eph = np.zeros((), EPHEMERIS)
    eph["system"], eph["prn"], eph["week"], eph["sqrt_a_sqrt_m"] = b"G", 1, WEEK, 5153.7
    for name, value in changes.items():
        eph[name] = value
    return eph


@pytest.mark.parametrize("row", [0, 17, 35, 54])
def test_matches_a_textbook_that_uses_matrices_and_bisection(row):
    eph = BOTH[row].copy()
    # Away from the epoch every rate and harmonic matters; a second-order clock too.
    eph["af2_s_s2"], eph["toc_s"] = 2.0**-55, eph["toe_s"] - 960.0
    for t in (-7_000.0, 0.0, 5_400.0):
        pos, _, clock, _ = satellite_state(eph, int(eph["week"]), float(eph["toe_s"]), t)
        other, other_clock = naive.satellite(eph, t, t + 960.0)
        # 1e-15 rad of Kepler and 4e-9 m of grid at 3e7 m.
        assert np.abs(pos[0] - other).max() < 1e-6
        # -2 sqrt(mu)/c^2 of the ICD is rounded to ten digits: 1e-10 of at most 50 ns.
        assert abs(clock[0] - other_clock) < 1e-16


def test_velocity_and_clock_rate_are_the_derivatives():
    t, h = np.arange(0.0, 7_200.0, 300.0), 0.5
    for eph in BOTH[::7]:
        _, vel, _, rate = satellite_state(eph, WEEK, TOW, t)
        ahead, _, clock_ahead, _ = satellite_state(eph, WEEK, TOW, t + h)
        back, _, clock_back, _ = satellite_state(eph, WEEK, TOW, t - h)
        # Central difference: h^2/6 x''' = h^2/6 a n^3 = 4e-6 m/s, rounding 4e-9 / h = 1e-8 m/s.
        assert np.abs((ahead - back) / (2 * h) - vel).max() < 1e-5
        # Clocks of 5e-4 s resolve 1e-19 s.
        assert np.abs((clock_ahead - clock_back) / (2 * h) - rate).max() < 1e-17


def test_energy_and_angular_momentum_of_an_unperturbed_orbit_are_kept():
    eph = circular(e=0.2, i0_rad=0.9, omega_rad=0.4, m0_rad=1.0)
    t = np.linspace(0.0, 40_000.0, 60)
    pos, vel, _, _ = satellite_state(eph, WEEK, 0, t)
    inertial = vel + np.cross([0.0, 0.0, naive.OMEGA_E], pos)
    r = np.linalg.norm(pos, axis=1)
    energy = 0.5 * np.sum(inertial**2, axis=1) - 3.986005e14 / r
    assert np.allclose(energy, -3.986005e14 / (2 * 5153.7**2), rtol=1e-12)
    momentum = np.cross(pos, inertial)
    expected = np.sqrt(3.986005e14 * 5153.7**2 * (1 - 0.2**2))
    assert np.allclose(np.linalg.norm(momentum, axis=1), expected, rtol=1e-12)
    assert np.allclose(momentum[:, 2], expected * np.cos(0.9), rtol=1e-12)


def test_sub_satellite_point_of_an_equatorial_circle():
    # At toe = 0 the node's longitude is Omega0; the satellite moves east at n - omega_e.
    eph = circular(omega0_rad=0.3, m0_rad=0.2)
    n = np.sqrt(3.986005e14 / 5153.7**6)
    pos, _, _, _ = satellite_state(eph, WEEK, 0, [0.0, 1_000.0])
    lat, lon, height = ecef_to_geodetic(pos)
    assert np.abs(lat).max() < 1e-15
    assert np.allclose(lon, 0.5 + (n - naive.OMEGA_E) * np.array([0.0, 1_000.0]), atol=1e-14)
    assert np.allclose(height, 5153.7**2 - 6_378_137.0, atol=1e-7)


def test_epoch_split_changes_nothing_and_weeks_wrap():
    eph = BOTH[3]
    a = satellite_state(eph, WEEK, TOW, 1_000.25)
    b = satellite_state(eph, WEEK, TOW + 1_000, 0.25)
    assert np.array_equal(a[0], b[0]) and np.array_equal(a[2], b[2])
    late = nominal_constellation("G", WEEK + 1, 0)[3]
    assert (late["week"], late["toe_s"]) == (WEEK, 604_800 - 1_200)
    before, _, _, _ = satellite_state(late, WEEK, 604_800 - 1.0, 2.0)
    after, _, _, _ = satellite_state(late, WEEK + 1, 1.0)
    assert np.array_equal(before, after)


@pytest.mark.parametrize("system, count", [("G", 31), ("E", 24)])
def test_nominal_constellation_is_complete_past_valid_and_quantised(system, count):
    eph = nominal_constellation(system, WEEK, TOW)
    assert np.array_equal(eph["prn"], np.arange(1, count + 1)) and np.all(eph["health"] == 0)
    age = (WEEK - eph["week"]) * 604_800 + TOW - eph["toe_s"]
    assert np.all((age > 0) & (age <= 1_200))
    assert np.array_equal(eph, nominal_constellation(system, WEEK, TOW))
    check_ephemeris(eph)
    coder = lnav if system == "G" else inav
    for record in eph:
        assert coder.quantised(record) == record
    assert len({tuple(np.round(p[0], -5)) for p in (satellite_state(e, WEEK, TOW)[0] for e in eph)}) == count


def test_nominal_satellites_are_everywhere_in_view_and_never_meet():
    t = np.arange(0.0, 86_400.0, 3_600.0)
    for system, fewest in (("G", 6), ("E", 4)):
        pos = np.stack([satellite_state(e, WEEK, TOW, t)[0] for e in BOTH[BOTH["system"] == system.encode()]])
        apart = np.linalg.norm(pos[:, None] - pos[None], axis=-1) + 1e9 * np.eye(len(pos))[:, :, None]
        assert apart.min() > 5e5
        for lat in (-80.0, -35.0, 0.0, 48.0, 90.0):
            el, _ = elevation_azimuth(geodetic_to_ecef(np.radians(lat), 0.2, 0.0), pos)
            assert np.sum(el > np.radians(5.0), axis=0).min() >= fewest


def test_relativity_of_galileo_and_gps_uses_their_own_constants():
    for system, f in ((b"G", -4.442807633e-10), (b"E", -4.442807309e-10)):
        eph = circular(system=system, e=0.01, m0_rad=np.pi / 2)
        _, _, clock, _ = satellite_state(eph, WEEK, 0, 0.0)
        ea = np.pi / 2 + 0.01 * np.cos(0.01)  # E = M + e sin E to third order about M = pi / 2
        assert abs(clock[0] - f * 0.01 * 5153.7 * np.sin(ea)) < 1e-14


def test_default_iono_utc_passes_both_messages_unchanged():
    iono = default_iono_utc(WEEK, TOW)
    eph = BOTH[0], BOTH[40]
    bits = lnav.encode(eph[0], iono, None, WEEK, TOW, 60)
    symbols = inav.encode(eph[1], iono, None, WEEK, TOW, 500)
    assert bits.size == 60 and symbols.size == 500
    assert iono["dt_ls_s"] == 18
    assert default_iono_utc(1800)["dt_ls_s"] == 16  # 2014-07-06
    scale = {"alpha": 2.0 ** np.array([-30, -27, -24, -24]), "beta": 2.0 ** np.array([11, 14, 16, 16])}
    for name, lsb in scale.items():
        assert np.all(iono[name] / lsb == np.rint(iono[name] / lsb)) and np.abs(iono[name] / lsb).max() < 128


@pytest.mark.parametrize(
    "field, value, word",
    [
        ("e", 0.5, "eccentricity"),
        ("sqrt_a_sqrt_m", 100.0, "sqrt"),
        ("m0_rad", np.nan, "number"),
        ("toe_s", 7e5, "toe"),
    ],
)
def test_impossible_elements_are_refused_by_name(field, value, word):
    eph = BOTH[4].copy()
    eph[field] = value
    with pytest.raises(ValueError, match=rf"G05.*{word}"):
        check_ephemeris(eph)


def test_quantise_wraps_angles():
    eph = BOTH[:1].copy()
    eph["m0_rad"] += 4 * np.pi
    # 32-bit angles: half a last bit of 1.5e-9 rad.
    assert abs(quantise_ephemeris(eph)["m0_rad"][0] - BOTH["m0_rad"][0]) < 1.5e-9


def test_week_and_calendar_are_inverse():
    assert week_tow(calendar(WEEK, TOW)) == (WEEK, TOW)
    assert calendar(2048, 0.0).isoformat() == "2019-04-07T00:00:00"
