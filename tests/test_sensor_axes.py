"""Axes of an IMU against the odometer, or what satellites say of the speed: exchanged or reversed ones are refused, what cannot be seen is said to be so."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from nav.imu import ImuSpec, OdometerSpec, simulate_imu, simulate_odometer
from nav.sensor_files import check_axes
from nav.steering import Sensors, Steering
from nav.ultratight import SteeringSpec
from signals.trajectory import Segment, Segments

PLACE = {"lat_deg": 44.23, "lon_deg": -76.48, "height_m": 100.0, "heading_deg": 20.0}
TURNS = (Segment(duration_s=25.0), Segment(duration_s=10.0, turn_rate_deg_s=7.5), Segment(duration_s=25.0))
SPEEDS = (Segment(duration_s=25.0), Segment(duration_s=10.0, acceleration_mps2=1.0), Segment(duration_s=25.0))
STRAIGHT = (Segment(duration_s=60.0),)
SPACING = {"L1CA": 0.5, "E1": 0.25}


def sensors(segments, speed_mps=10.0, imu=ImuSpec(grade="karaim2020"), seed=1):  # noqa: B008
    motion = Segments(speed_mps=speed_mps, segment=segments, **PLACE).start(60.0)
    odometer = OdometerSpec()
    rows, speeds = (
        simulate_imu(motion, imu, seed, 60.0)[0],
        simulate_odometer(motion, odometer, seed + 1, 60.0)[0],
    )
    rows["sample_index"] = np.round(rows["t_s"] * 4e6)
    return Sensors(imu, odometer, rows, speeds)


def said(s):
    table = s.table()
    return check_axes(table[:, 3:5], table[:, 2], table[:, 6], 0.01)


@pytest.mark.parametrize("grade", ["consumer", "karaim2020", "navigation"])
@pytest.mark.parametrize("segments", [TURNS, SPEEDS])
def test_good_axes_are_found_good(grade, segments):
    assert said(sensors(segments, imu=ImuSpec(grade=grade))) == "as they should be"


@pytest.mark.parametrize(
    ("segments", "axis"), [(TURNS, "turning stands in accel_x"), (SPEEDS, "speeding up stands in accel_y")]
)
def test_exchanged_axes_are_refused(segments, axis):
    s = sensors(segments)
    s.imu["accel_mps2"][:, :2] = s.imu["accel_mps2"][:, 1::-1].copy()
    with pytest.raises(ValueError, match=f"{axis}.*exchanged"):
        said(s)
    # The receiver refuses the files as a whole, before any sample is read.
    with pytest.raises(ValueError, match="x and y are exchanged; the axes must be forward, right, down"):
        Steering(SteeringSpec(mode="ultra_tight"), 4e6, s, SPACING)


@pytest.mark.parametrize(
    ("segments", "axis", "word"), [(SPEEDS, 0, "accel_x.*forward"), (TURNS, 1, "accel_y.*right")]
)
def test_axes_that_point_backwards_are_refused(segments, axis, word):
    s = sensors(segments)
    s.imu["accel_mps2"][:, axis] *= -1
    with pytest.raises(ValueError, match=word):
        said(s)


@pytest.mark.parametrize("speed_mps", [0.0, 10.0])
def test_without_moves_nothing_is_known(speed_mps):
    s = sensors(STRAIGHT, speed_mps)
    s.imu["accel_mps2"][:, :2] = s.imu["accel_mps2"][:, 1::-1].copy()
    assert said(s) == "not observable"
    run = Steering(SteeringSpec(mode="ultra_tight"), 4e6, s, SPACING)
    assert run.summary()["axes"] == "not observable"


def test_banked_turns_are_not_taken_for_exchanged_axes():
    # An aircraft leans into its turns: no axis but down shows them.
    assert said(sensors(TURNS, imu=ImuSpec(grade="tactical", attitude="aircraft"))) == "not confirmed"


def test_a_slope_does_not_look_like_speeding_up():
    # Half of the road rises by 5 %: 0.5 m/s^2 more in x, at constant speed.
    s = sensors(TURNS)
    s.imu["accel_mps2"][3000:, 0] += 0.5
    assert said(s) == "as they should be"


# -- without an odometer: the satellites' Doppler ---------------------------------------------------------------------


def steered(s, speed_mps):
    """A 17-state run that has seen a whole recording: ``speed_mps`` (0.1 s apart) is what its filter makes of the satellites."""
    run = Steering(SteeringSpec(mode="ultra_tight", model="ecef17"), 4e6, s, SPACING)
    run.usable = 8
    for k, v in enumerate(speed_mps):
        run.filter = SimpleNamespace(epochs=5 * k, position=lambda v=v: (None, np.array([v, 0.0, 0.0])))
        run._watch_axes(round((k + 1) * 0.1 * 4e6))
    return run


def doppler_speeds(s):
    return s.odometer["speed_mps"][9::10] + 0.03 * np.random.default_rng(5).standard_normal(600)


@pytest.mark.parametrize("segments", [TURNS, SPEEDS])
def test_satellites_show_good_axes_and_refuse_exchanged_ones(segments):
    s = sensors(segments)
    without = replace(s, odometer_spec=None, odometer=None)
    assert steered(without, doppler_speeds(s)).summary()["axes"] == "as they should be"
    s.imu["accel_mps2"][:, :2] = s.imu["accel_mps2"][:, 1::-1].copy()
    with pytest.raises(ValueError, match=r"what the satellites' Doppler says of .*exchanged"):
        steered(without, doppler_speeds(s))


@pytest.mark.parametrize(("segments", "axis"), [(SPEEDS, 0), (TURNS, 1)])
def test_satellites_refuse_axes_that_point_backwards(segments, axis):
    s = sensors(segments)
    s.imu["accel_mps2"][:, axis] *= -1
    with pytest.raises(ValueError, match=f"accel_{'xy'[axis]} says the opposite of what the satellites"):
        steered(replace(s, odometer_spec=None, odometer=None), doppler_speeds(s))


def test_satellites_say_nothing_of_axes_on_a_straight_road_in_the_dark_or_in_the_air():
    for segments, imu in (
        (TURNS, ImuSpec(grade="karaim2020", attitude="aircraft")),
        (STRAIGHT, ImuSpec(grade="karaim2020")),
    ):
        s = sensors(segments, imu=imu)
        s.imu["accel_mps2"][:, :2] = s.imu["accel_mps2"][:, 1::-1].copy()
        run = steered(replace(s, odometer_spec=None, odometer=None), doppler_speeds(s))
        assert run.summary()["axes"] == "not observable"
    run.usable = 3
    run._watch_axes(4_000_000)
    assert not run._moves
