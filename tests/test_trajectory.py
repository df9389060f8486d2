import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from signals.geodesy import ecef_to_geodetic, geodetic_to_ecef, ned_matrix
from signals.trajectory import (
    Approach,
    Circle,
    HighDynamics,
    Line,
    MotionSpec,
    Range,
    Recorded,
    Segment,
    Segments,
    Static,
)

DRIVE = Segments(
    lat_deg=47.0,
    lon_deg=8.0,
    height_m=400.0,
    heading_deg=45.0,
    speed_mps=10.0,
    segment=(
        Segment(duration_s=10.0, speed_mps=20.0),
        Segment(duration_s=12.0, turn_rate_deg_s=7.5),
        Segment(duration_s=20.0, climb_mps=3.0, acceleration_mps2=-0.5),
        Segment(duration_s=8.0),
    ),
)
MOTIONS = [
    Static(),
    Line(vel_ned_mps=(10, -3, 1), acc_ned_mps2=(0.5, 2, -0.1)),
    Circle(speed_mps=30.0, radius_m=100.0),
    Approach(),
    HighDynamics(acc_ned_mps2=(98.1, 80.0, 50.0)),
    DRIVE,
    # Fast and steep: the turning of the local axes matters (2500 m/s over the Earth's radius times 900 m/s: 0.4 m/s2).
    Segments(
        heading_deg=30.0,
        speed_mps=2_500.0,
        climb_mps=900.0,
        segment=(Segment(duration_s=50.0, turn_rate_deg_s=1.0),),
    ),
]


def ids(spec):
    return spec.kind


@pytest.mark.parametrize("spec", MOTIONS, ids=ids)
def test_velocity_and_acceleration_are_the_derivatives(spec):
    at = spec.start(50.0)
    t, h = np.arange(0.013, 49.0, 0.37), 1e-3
    ahead, here, back = at(t + h), at(t), at(t - h)
    # Rounding: 1e-9 m and, after the origin is added, half a grid step of 9e-10 m: 2e-9 / 2e-3 = 1e-6 m/s.
    # Truncation h^2 / 6 a w^2 = 1e-7 * 100 * 0.5.
    assert np.abs((ahead.pos_ecef_m - back.pos_ecef_m) / (2 * h) - here.vel_ecef_mps).max() < 1.5e-5
    # Velocities are smooth to 1e-13 (closed forms) or 5e-8 m/s (interpolated): 5e-8 / 2e-3.
    assert np.abs((ahead.vel_ecef_mps - back.vel_ecef_mps) / (2 * h) - here.acc_ecef_mps2).max() < 1e-4


def test_segments_end_at_the_commanded_speed_heading_and_climb():
    at = DRIVE.start(60.0)
    t = np.array([0.0, 10.0, 22.0, 42.0, 50.0, 60.0])
    state = at(t)
    lat, lon, height = ecef_to_geodetic(state.pos_ecef_m)
    vel = np.einsum("mij,mj->mi", ned_matrix(lat, lon), state.vel_ecef_mps)
    ground = np.hypot(vel[:, 0], vel[:, 1])
    assert np.allclose(ground, [10, 20, 20, 10, 10, 10], atol=1e-6)
    assert np.allclose(np.degrees(np.arctan2(vel[:, 1], vel[:, 0])), [45, 45, 135, 135, 135, 135], atol=1e-6)
    assert np.allclose(-vel[:, 2], [0, 0, 0, 3, 3, 3], atol=1e-6)
    # Level until 22 s; then the mean climb of a symmetric ramp is half its end.
    assert np.allclose(height[:3], 400.0, atol=1e-6)
    assert np.allclose(height[3:5], [400.0 + 0.5 * 3.0 * 20.0, 400.0 + 30.0 + 24.0], atol=1e-6)


def test_segments_path_length_is_the_integral_of_the_speed_on_the_ellipsoid():
    # Along a meridian the arc length of the ellipsoid is known: M(lat) d(lat), integrated finely.
    spec = Segments(
        lat_deg=10.0, lon_deg=0.0, height_m=0.0, speed_mps=250.0, segment=(Segment(duration_s=600.0),)
    )
    end = spec.start(600.0)(600.0).pos_ecef_m[0]
    lat, lon, height = ecef_to_geodetic(end)
    grid = np.linspace(np.radians(10.0), lat, 20_001)
    e2 = 0.0066943799901413165
    radius = 6_378_137.0 * (1 - e2) / (1 - e2 * np.sin(grid) ** 2) ** 1.5
    length = np.sum(0.5 * (radius[1:] + radius[:-1]) * np.diff(grid))
    assert abs(length - 150_000.0) < 1e-4 and abs(lon) < 1e-12 and abs(height) < 1e-5


def test_segments_acceleration_is_continuous():
    at = DRIVE.start(50.0)
    t = np.arange(0.0, 50.0, 1e-3)
    step = np.diff(at(t).acc_ecef_mps2, axis=0)
    # Steepest: 1.5 / ramp of a plateau: turn 7.5 deg/s * 1.2 at 20 m/s = 3.1 m/s2, 1.5 / 2 s -> 2.4 m/s3.
    assert np.abs(step).max() < 5e-3


def test_approach_meets_the_threshold_at_the_glide_angle_and_not_below():
    spec = Approach(lat_deg=47.0, lon_deg=15.0, height_m=340.0)
    touch = 914.0 / (np.tan(np.radians(3.0)) * 57.3)
    at = spec.start(touch)
    threshold = geodetic_to_ecef(np.radians(47), np.radians(15), 340.0)
    assert np.linalg.norm(at(touch).pos_ecef_m[0] - threshold) < 1e-6
    sink = (ned_matrix(np.radians(47), np.radians(15)) @ at(0.0).vel_ecef_mps[0])[2]
    assert abs(sink - 3.0) < 0.01
    with pytest.raises(ValueError, match="threshold after 304"):
        spec.start(320.0)


def test_high_dynamics_reaches_its_accelerations_and_mean_velocity():
    spec = HighDynamics()
    c = ned_matrix(np.radians(spec.lat_deg), np.radians(spec.lon_deg))
    state = spec.start()(np.arange(0.0, 1_260.0, 0.05))  # 1260 s: common period of 20, 14 and 9 s
    assert np.allclose(np.abs(state.acc_ecef_mps2 @ c.T).max(axis=0), (10, 8, 5), rtol=1e-3)
    assert np.allclose((state.vel_ecef_mps @ c.T).mean(axis=0), spec.vel_ned_mps, atol=1e-6)


def test_motion_spec_is_told_apart_by_kind():
    adapter = TypeAdapter(MotionSpec)
    assert isinstance(adapter.validate_python({"kind": "Circle", "radius_m": 10.0}), Circle)
    with pytest.raises(ValidationError):
        adapter.validate_python({"kind": "Circle", "radius": 10.0})
    with pytest.raises(ValidationError):
        adapter.validate_python({"kind": "Static", "lat_deg": 91.0})


def test_segments_refuse_two_speeds_negative_speeds_and_poles():
    with pytest.raises(ValidationError, match="give one"):
        Segment(duration_s=1.0, speed_mps=1.0, acceleration_mps2=1.0)
    with pytest.raises(ValueError, match="segment 1 ends at -5"):
        Segments(speed_mps=5.0, segment=(Segment(duration_s=10.0, acceleration_mps2=-1.0),)).start(1.0)
    with pytest.raises(ValueError, match="pole"):
        Segments(lat_deg=89.85, speed_mps=1_000.0, segment=(Segment(duration_s=60.0),)).start(60.0)


# --- recorded -----------------------------------------------------------------------------------------------


def write_track(path, t, pos, header="t_s,x_m,y_m,z_m"):
    rows = [",".join(f"{x:.9f}" for x in row) for row in np.column_stack([t, pos])]
    path.write_text("\n".join(["# a comment", header, *rows]) + "\n")
    return str(path)


def test_recorded_csv_reproduces_a_smooth_motion(tmp_path):
    t = np.arange(0.0, 30.01, 0.1)
    spec = HighDynamics()
    truth = spec.start()
    path = write_track(tmp_path / "track.csv", 100.0 + t, truth(t).pos_ecef_m)
    at = Recorded(path=path).start(29.0)
    inner = np.linspace(2.0, 27.0, 501)
    error = at(inner).pos_ecef_m - truth(inner).pos_ecef_m
    # Cubic spline: 5/384 h^4 x'''' = 1.3e-6 * a w^2 (5 * 0.49, 10 * 0.1, ...), plus the file's 1e-9.
    assert np.abs(error).max() < 1e-5
    assert np.abs(at(inner).vel_ecef_mps - truth(inner).vel_ecef_mps).max() < 1e-3
    lat, lon, height = ecef_to_geodetic(truth(t).pos_ecef_m)
    path = write_track(
        tmp_path / "geo.csv",
        t,
        np.column_stack([np.degrees(lat), np.degrees(lon), height]),
        "t_s,lat_deg,lon_deg,height_m",
    )
    # 1e-9 deg is 0.1 mm.
    assert np.abs(Recorded(path=path).start(29.0)(inner).pos_ecef_m - truth(inner).pos_ecef_m).max() < 5e-4


def gga(t, lat_deg, lon_deg, altitude, separation):
    def dm(x, width):
        return f"{int(x):0{width}d}{(x % 1) * 60:09.6f}"

    clock = f"{int(t // 3600) % 24:02d}{int(t // 60) % 60:02d}{t % 60:05.2f}"
    body = (
        f"GPGGA,{clock},{dm(abs(lat_deg), 2)},{'NS'[lat_deg < 0]},{dm(abs(lon_deg), 3)},{'EW'[lon_deg < 0]}"
        f",1,08,1.0,{altitude:.3f},M,{separation:.3f},M,,"
    )
    return f"${body}*{np.bitwise_xor.reduce(np.frombuffer(body.encode(), np.uint8)):02X}"


def test_recorded_nmea_goes_over_midnight_and_south_west(tmp_path):
    t = 86_395.0 + np.arange(12)
    lines = [gga(x, -33.5 + 1e-5 * k, -70.5, 500.0, 25.5) for k, x in enumerate(t)]
    path = tmp_path / "track.nmea"
    path.write_text("\r\n".join(["$GPRMC,,,*00", *lines]) + "\r\n")
    state = Recorded(path=str(path)).start(11.0)(np.array([0.0, 11.0]))
    lat, lon, height = ecef_to_geodetic(state.pos_ecef_m)
    assert np.allclose(np.degrees(lat), [-33.5, -33.5 + 11e-5], atol=2e-8)
    assert np.allclose(np.degrees(lon), -70.5, atol=2e-8) and np.allclose(height, 525.5, atol=1e-3)


def test_recorded_refuses_what_is_not_a_track(tmp_path):
    t = np.arange(10.0)
    pos = geodetic_to_ecef(0.8, 0.2, 100.0) + np.outer(t, [5.0, 0.0, 0.0])

    def refused(match, spec=None, t=t, pos=pos, **kw):
        path = write_track(tmp_path / "bad.csv", t, pos, **kw)
        with pytest.raises(ValueError, match=match):
            Recorded(path=path, **(spec or {})).start(5.0)

    again = t.copy()
    again[4] = again[3]
    refused("row 5.*repeats", t=again)
    jump = pos.copy()
    jump[6] += 5_000.0
    refused("jumps at row 7.*speed", pos=jump)
    kink = pos.copy()
    kink[6] += 250.0
    refused("jumps at row .*acceleration", pos=kink)
    refused("lasts 3 s", spec={"skip_s": 6.0})
    refused("header", header="time,x,y,z")
    refused("not finite", pos=np.where(t[:, None] == 3, np.nan, pos))
    refused("1000 km", pos=pos * 1e-3)
    refused("at least 4", t=t[:3], pos=pos[:3])
    with pytest.raises(ValueError, match="does not exist"):
        Recorded(path=str(tmp_path / "none.csv")).start()
    (tmp_path / "bad.csv").write_text("t_s,x_m,y_m,z_m\n1,2,3\n")
    with pytest.raises(ValueError, match="row 1 is not four numbers"):
        Recorded(path=str(tmp_path / "bad.csv")).start()
    line = gga(0.0, 10.0, 10.0, 1.0, 0.0)
    (tmp_path / "bad.csv").write_text(line.replace(",08,", ",09,"))
    with pytest.raises(ValueError, match="line 1 is not a valid GGA"):
        Recorded(path=str(tmp_path / "bad.csv")).start()
    with pytest.raises(ValueError, match="covers 0 to 9"):
        Recorded(path=write_track(tmp_path / "good.csv", t, pos)).start(9.0)(20.0)


# --- range domain -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("manoeuvre, acc, jerk", [("normal", 0.7658, 0.25), ("abnormal", 2.5, 0.74)])
def test_range_manoeuvres_keep_the_limits_of_table_4(manoeuvre, acc, jerk):
    at = Range(manoeuvre=manoeuvre).start_range()
    t = np.arange(0.0, 700.0, 0.01)
    delay, rate, second = at(t)
    c = 299_792_458.0
    assert abs(np.abs(second).max() * c / 9.81 / acc - 1) < 1e-4
    assert abs(np.abs(np.diff(second)).max() / 0.01 * c / 9.81 / jerk - 1) < 1e-3
    assert abs(np.abs(rate).max() * c / (800 * 1852 / 3600) - 1) < 1e-4
    # Central difference over h = 0.01 s: h^2 / 6 of the jerk.
    assert np.abs(np.gradient(delay, t)[1:-1] - rate[1:-1]).max() * c < 1.1 * 1e-4 / 6 * 9.81 * jerk + 1e-6
    assert np.abs(np.gradient(rate, t)[1:-1] - second[1:-1]).max() * c < 0.02 * 9.81 * jerk


def test_range_cubic_is_the_formula_of_the_paper():
    at = Range(delay_s=0.07, doppler_hz=1_000.0, manoeuvre="normal", profile="cubic").start_range()
    t, c = 20.0, 299_792_458.0
    a2, a3 = 9.81 * np.hypot(0.58, 0.5), 9.81 * 0.25
    expected = 0.07 - 1_000.0 / 1575.42e6 * t + (a2 / 2 * t**2 + a3 / 6 * t**3) / c
    assert np.isclose(at(t)[0][0], expected, rtol=0, atol=1e-15)


def test_range_random_doppler_is_seeded_and_within_its_limit():
    spec = Range(doppler_hz="random")
    doppler = np.array([-spec.start_range(seed)(0.0)[1][0] * 1575.42e6 for seed in range(200)])
    assert np.abs(doppler).max() <= 10e3 and doppler.std() > 4_000.0
    assert spec.start_range(5)(1.0)[0] == spec.start_range(5)(1.0)[0]
    with pytest.raises(ValidationError, match="random"):
        Range(doppler_hz=1e6)
