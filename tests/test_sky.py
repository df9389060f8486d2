from datetime import datetime

import naive_orbit as naive
import numpy as np
import pytest
from pydantic import ValidationError

from signals.clock import ClockSpec
from signals.geodesy import ecef_to_geodetic, elevation_azimuth
from signals.rinex import write_rinex_nav
from signals.sky import SkySpec
from signals.trajectory import HighDynamics, Line, Static

C = naive.C
STILL = Static(lat_deg=48.0, lon_deg=11.0, height_m=500.0).start()
STEADY = ClockSpec(bias_s=3e-4, drift_s_s=5e-7)


def sky_of(motion=STILL, clock=STEADY, duration=60.0, seed=0, **spec):
    return SkySpec(**spec).start(motion, clock.start(1, duration), duration, seed)


def textbook_delay(sky, sat, t, position, bias):
    """Total code delay in s, term by term: fixed point in the inertial frame, naive orbit and ionosphere."""
    from signals.atmosphere import saastamoinen

    eph = sat.ephemeris
    age = (sky.week - eph["week"]) * 604_800 + sky.tow_s
    tau = 0.08
    for _ in range(8):
        pos, clock = naive.satellite(eph, age - eph["toe_s"] + t - tau, age - eph["toc_s"] + t - tau)
        pos = naive.rot_z(-naive.OMEGA_E * tau) @ pos
        lat, lon, height = ecef_to_geodetic(position)
        el, az = elevation_azimuth(position, pos)
        iono = naive.klobuchar_m(
            *np.degrees([lat, lon, az, el]), sky.tow_s + t, sky.iono_utc["alpha"], sky.iono_utc["beta"]
        )
        tropo = float(saastamoinen(lat, height, el))
        tau = (np.linalg.norm(pos - position) + iono + tropo) / C
    ggto = float(sky.iono_utc["a0g_s"]) if sat.system == "E" else 0.0
    return bias + tau - clock + float(eph["tgd_s"]) - ggto, iono / C


def test_delay_is_the_textbook_sum_within_micrometres():
    motion = Line(height_m=3_000.0, vel_ned_mps=(200.0, 100.0, -20.0)).start()
    sky = sky_of(motion)
    t_r = np.array([0.0, 17.3, 59.0])
    got = sky.propagate(t_r)
    for row, sat in enumerate(sky.satellites):
        for k, reading in enumerate(t_r):
            bias = 3e-4 + 5e-7 * reading
            position = motion(reading - bias).pos_ecef_m[0]
            delay, iono = textbook_delay(sky, sat, reading - bias, position, bias)
            # Orbits agree to 1e-6 m, relativity to 1e-16 s.
            assert abs(got.delay_s[row, k] - delay) * C < 2e-6
            assert abs(got.delay_s[row, k] - got.phase_delay_s[row, k] - 2 * iono) * C < 2e-6
    assert len(sky.satellites) > 12


def least_squares(sky, pseudorange, t_r, row):
    """Gauss-Newton as a receiver does it: code time -> satellite clock -> position, Sagnac, atmosphere."""
    from signals.atmosphere import KLOBUCHAR_X_CONTINUOUS, klobuchar, saastamoinen
    from signals.orbits import satellite_state

    x, bias = np.array([4.1e6, 0.8e6, 4.7e6]), 0.0
    for _ in range(8):
        h, r = [], []
        lat, lon, height = ecef_to_geodetic(x)
        for sat, p in zip([sky.satellites[i] for i in row], pseudorange):
            code_time = t_r - p / C
            tgd = float(sat.ephemeris["tgd_s"])
            ggto = float(sky.iono_utc["a0g_s"]) if sat.system == "E" else 0.0
            t_tx = code_time
            for _ in range(3):
                pos, _, clock, _ = satellite_state(sat.ephemeris, sky.week, sky.tow_s, t_tx)
                t_tx = code_time - (clock[0] - tgd + ggto)
            t_rx = t_r - bias / C
            pos = naive.rot_z(-naive.OMEGA_E * (t_rx - t_tx)) @ pos[0]
            el, az = elevation_azimuth(x, pos)
            model = np.linalg.norm(pos - x) + saastamoinen(lat, height, max(el, 0.1))
            model += C * klobuchar(
                lat, lon, az, max(el, 0.1), sky.tow_s + t_rx, *(sky.iono_utc[k] for k in ("alpha", "beta")),
                KLOBUCHAR_X_CONTINUOUS,
            )  # fmt: skip
            r.append(C * (t_rx - t_tx) - model)
            h.append(np.append((x - pos) / np.linalg.norm(x - pos), 1.0))
        step = np.linalg.lstsq(np.array(h), np.array(r), rcond=None)[0]
        x, bias = x + step[:3], bias + step[3]
    return x, bias / C


@pytest.mark.parametrize("signals", [("L1CA",), ("E1",), ("L1CA", "E1")])
def test_least_squares_with_every_correction_recovers_position_and_bias(signals):
    motion = HighDynamics(acc_ned_mps2=(98.0, 80.0, 50.0)).start()
    sky = sky_of(motion, signals=signals, elevation_mask_deg=10.0)
    for t_r in (0.0, 41.23):
        got = sky.propagate(t_r)
        row = np.flatnonzero(got.visible[:, 0])
        x, bias = least_squares(sky, C * got.delay_s[row, 0], t_r, row)
        truth = sky.receiver(t_r)[0]
        # Micrometres of range times a DOP below 10.
        assert np.linalg.norm(x - truth["pos_ecef_m"]) < 1e-4
        assert abs(bias - truth["clock_bias_s"]) * C < 1e-4


@pytest.mark.parametrize(
    "clock, h, limit",
    [
        # Truncation: jerk 98 * 0.3 h^2 / 6 = 5e-6 m/s; rounding: some 1e-8 m of orbit over 2 h.
        (STEADY, 1e-3, 5e-5),
        # Steps of sqrt(h0 / 2 * 20 ms) = 3e-11 s: third derivative 6 * 1.2 steps / (20 ms)^3, h^2 / 6 of it at
        # z = 5: 7e-5 m/s; rounding, some 2e-8 m over 2 h: 1e-4.
        (ClockSpec(drift_s_s=-2e-6, noise="OCXO"), 1e-4, 3e-4),
    ],
)
def test_rates_are_the_derivatives(clock, h, limit):
    motion = HighDynamics(acc_ned_mps2=(98.0, 80.0, 50.0)).start()
    sky = sky_of(motion, clock, elevation_mask_deg=5.0)
    t = np.arange(1.003, 59.0, 1.7)
    ahead, here, back = sky.propagate(t + h), sky.propagate(t), sky.propagate(t - h)
    seen = np.broadcast_to(here.visible, here.delay_s.shape)
    for name in ("delay", "phase_delay"):
        rate = getattr(here, f"{name}_rate_s_s")
        difference = (getattr(ahead, f"{name}_s") - getattr(back, f"{name}_s")) / (2 * h)
        assert np.abs((difference - rate)[seen]).max() * C < limit


def test_hermite_through_nodes_20_ms_apart_reproduces_the_delay_under_10_g():
    motion = HighDynamics(acc_ned_mps2=(98.0, 80.0, 50.0)).start()
    sky = sky_of(motion, ClockSpec(bias_s=1e-5, drift_s_s=1e-6, noise="TCXO"))
    step = 0.02
    nodes = np.arange(0, 501) * step
    p = sky.propagate(nodes)
    u = np.array([0.21, 0.5, 0.83])
    q = sky.propagate((nodes[:-1, None] + u * step).ravel())
    for name in ("delay", "phase_delay"):
        y, v = getattr(p, f"{name}_s"), getattr(p, f"{name}_rate_s_s") * step
        y0, y1, v0, v1 = y[:, :-1, None], y[:, 1:, None], v[:, :-1, None], v[:, 1:, None]
        cubic = y0 + u * (v0 + u * (3 * (y1 - y0) - 2 * v0 - v1 + u * (2 * (y0 - y1) + v0 + v1)))
        error = cubic.reshape(y.shape[0], -1) - getattr(q, f"{name}_s")
        # h^4/384 x'''' = 4e-10 * 98 w^2 = 4e-8 m of motion; the clock's own cubic coincides with ours.
        assert np.abs(error).max() * C < 1e-4 / 10


def test_any_chunking_gives_the_same_bits():
    sky = sky_of(clock=ClockSpec(noise="TCXO"))
    t = np.arange(0.0, 10.0, 0.033)
    whole = sky.propagate(t)
    parts = [sky.propagate(part) for part in np.array_split(t, 5)]
    for name in ("delay_s", "delay_rate_s_s", "phase_delay_s", "elevation_rad", "cn0_dbhz"):
        assert np.array_equal(getattr(whole, name), np.concatenate([getattr(p, name) for p in parts], axis=1))


def test_ionosphere_delays_the_code_and_advances_the_phase_by_the_same():
    t = np.arange(0.0, 60.0, 5.0)
    with_it, without = (sky_of(ionosphere=k).propagate(t) for k in ("klobuchar", "none"))
    code = (with_it.delay_s - without.delay_s) * C
    phase = (with_it.phase_delay_s - without.phase_delay_s) * C
    # 5 ns is the least; light time moves the satellite by less than 1e-3 m meanwhile.
    assert code.min() > 1.4 and np.abs(code + phase).max() < 1e-3


def test_group_delay_delays_and_satellite_clock_advances():
    sky = sky_of(ionosphere="none", troposphere="none", clock=ClockSpec())
    t = np.array([0.0])
    base = sky.propagate(t).delay_s
    for field, sign in (("tgd_s", 1.0), ("af0_s", -1.0)):
        rows = [s.ephemeris.copy() for s in sky.satellites]
        for row in rows:
            row[field] += 2.0**-20
        other = type(sky)(
            sky.spec, sky.motion, sky.clock, sky.week, sky.tow_s, sky.iono_utc,
            tuple(type(s)(s.system, s.prn, s.signal, r, s.cn0_dbhz) for s, r in zip(sky.satellites, rows)), {},
        )  # fmt: skip
        assert np.allclose(other.propagate(t).delay_s - base, sign * 2.0**-20, atol=1e-12)


def test_receiver_clock_enters_once_and_slows_true_time():
    t = np.array([0.0, 30.0])
    slow, fast = sky_of(clock=ClockSpec()).propagate(t), sky_of(clock=ClockSpec(bias_s=1e-3)).propagate(t)
    # True time is 1 ms earlier: the delay differs from it by the range rate only.
    expected = 1e-3 - 1e-3 * slow.delay_rate_s_s
    assert np.abs(fast.delay_s - slow.delay_s - expected).max() * C < 1e-6


def test_mask_prns_maximum_health_and_powers():
    sky = sky_of(elevation_mask_deg=20.0, duration=7_200.0)
    t = np.linspace(0.0, 7_200.0, 241)
    p = sky.propagate(t)
    assert np.array_equal(p.visible, p.elevation_rad >= np.radians(20.0)) and p.visible.any(axis=1).all()
    assert not p.visible.all()
    few = sky_of(max_satellites=5)
    assert len(few.satellites) == 5
    highest = sorted(sky_of().propagate(0.0).elevation_rad[:, 0])[-4:]
    assert np.all(few.propagate(0.0).elevation_rad.min() <= highest)
    names = tuple(s.name for s in few.satellites)
    own = sky_of(
        prns=names,
        unhealthy=(names[0],),
        cn0_dbhz=44.0,
        satellite=({"system": names[1][0], "prn": int(names[1][1:]), "cn0_dbhz": 31.0, "health": 1},),
    )
    assert [s.name for s in own.satellites] == list(names)
    assert [int(s.ephemeris["health"] != 0) for s in own.satellites] == [1, 1, 0, 0, 0]
    assert np.array_equal(own.propagate(0.0).cn0_dbhz[:, 0], [44.0, 31.0, 44.0, 44.0, 44.0])
    by_elevation = sky_of(cn0_model="elevation", cn0_dbhz=48.0, cn0_drop_db=12.0).propagate(0.0)
    expected = 48.0 - 12.0 * (1 - np.sin(by_elevation.elevation_rad)) ** 2
    assert np.allclose(by_elevation.cn0_dbhz, expected)


def test_scripted_satellites_follow_their_script():
    sky = sky_of(
        source="none",
        clock=ClockSpec(),
        scripted=(
            {"prn": 6, "doppler_hz": 1_234.0, "doppler_rate_hz_s": -3.0, "delay_s": 0.07, "cn0_dbhz": 40.5},
            {"signal": "E1", "prn": 38, "doppler_hz": "random", "manoeuvre": "normal"},
        ),
    )
    assert [(s.name, s.signal) for s in sky.satellites] == [("G06", "L1CA"), ("E38", "E1")]
    t = np.array([0.0, 10.0])
    p = sky.propagate(t)
    assert np.allclose(-p.delay_rate_s_s[0] * 1575.42e6, [1_234.0, 1_204.0], atol=1e-6)
    assert np.allclose(p.delay_s[0], 0.07 - (1_234.0 * t - 1.5 * t**2) / 1575.42e6, atol=1e-17)
    assert p.visible.all() and np.array_equal(p.delay_s, p.phase_delay_s)
    assert p.cn0_dbhz[:, 0].tolist() == [40.5, 45.0]
    again = sky_of(source="none", clock=ClockSpec(), scripted=sky.spec.scripted[::-1], seed=4)
    assert not np.array_equal(again.propagate(t).delay_s[0], p.delay_s[1])


def test_rinex_sky_equals_the_nominal_sky_it_was_written_from(tmp_path):
    pytest.importorskip("georinex")
    nominal = sky_of()
    path = tmp_path / "nav.rnx"
    write_rinex_nav(path, np.array([s.ephemeris for s in nominal.satellites]), nominal.iono_utc)
    read = sky_of(source="rinex", path=str(path))
    assert [s.ephemeris for s in read.satellites] == [s.ephemeris for s in nominal.satellites]
    t = np.array([0.0, 50.0])
    assert np.array_equal(read.propagate(t).delay_s, nominal.propagate(t).delay_s)
    with pytest.raises(ValueError, match="reference times are 2024-03-01"):
        sky_of(source="rinex", path=str(path), start=datetime(2024, 3, 2))


@pytest.mark.parametrize(
    "spec, match",
    [
        ({"prns": ("G40",)}, "G40 is not in the nominal sky"),
        ({"elevation_mask_deg": 89.9}, "rises above 89.9 deg"),
        ({"source": "rinex"}, "sky.path is missing"),
        ({"scripted": ({"signal": "E1", "prn": 55},)}, "PRN 55 has no E1 code"),
        ({"prns": ("G06",), "elevation_mask_deg": 0.0, "scripted": ({"prn": 6},)}, "G06 appears twice"),
    ],
)
def test_impossible_skies_are_refused(spec, match):
    with pytest.raises(ValueError, match=match):
        sky_of(**spec)


@pytest.mark.parametrize(
    "spec, match",
    [
        ({"start": "2024-03-01T12:00:00.5"}, "whole second"),
        ({"start": "2024-03-01T12:00:00Z"}, "time zone"),
        ({"start": "1970-01-01T00:00:00"}, "precedes"),
        ({"prns": ("G6",)}, "pattern"),
        ({"signal": "L1CA"}, "Extra inputs"),
    ],
)
def test_malformed_keys_are_refused(spec, match):
    with pytest.raises(ValidationError, match=match):
        SkySpec(**spec)
