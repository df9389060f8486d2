"""A recording with IMU, odometer and barometer beside it, from the files that ``simulate`` wrote, end to end."""

import json

import h5py
import numpy as np
import pytest

from sdr import jobs
from sdr.__main__ import app
from sdr.options import Recording

SET = ["duration_s=24.0", "jammer=[]", "front_end.fs_hz=2.5e6", "sensors.barometer={}", "receiver.steering.compare=[]",
       'receiver.steering.mode="ultra_tight"', "receiver.steering.start_after_s=0.5"]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("drive")
    jobs.simulate("drive-jam", path / "rec", overrides=SET, quiet=True)
    return path


def receive(folder, *overrides, **files):
    given = {name: folder / f"rec.{suffix}.csv" for name, suffix in files.items()}
    return jobs.receive(
        folder / "rec.sigmf-meta", Recording(), "drive-jam", output=folder / "out.h5", overrides=[*SET, *overrides],
        quiet=True, **given,
    )  # fmt: skip


def test_files_give_the_bits_of_the_run_that_made_them(folder):
    result = receive(folder, imu="imu", odometer="odo")
    steering = result["steering"]
    assert steering["mode"] == "ultra_tight"
    assert steering["first_s"] < 22.0
    assert steering["released"] == 0
    assert steering["steered_s"] > 2.0
    jobs.run("drive-jam", output=folder / "run.h5", overrides=SET, quiet=True)
    with h5py.File(folder / "out.h5") as one, h5py.File(folder / "run.h5") as two:
        for name in ("navigation/solution", "navigation/steering", "navigation/observations"):
            assert one[name][:].tobytes() == two[name][:].tobytes(), name
        rows, true = two["navigation/solution"][:], two["truth/receiver"][:]
    last = rows[(rows["t_s"] > steering["first_s"] + 0.5) & (rows["t_s"] < 23.95)]
    at = np.searchsorted(true["sample_index"], last["sample_index"])
    assert np.array_equal(true["sample_index"][at], last["sample_index"])
    assert np.abs(last["pos_ecef_m"] - true["pos_ecef_m"][at]).max() < 3.0


def test_a_barometer_carries_the_pinson_model(folder):
    result = receive(
        folder, 'receiver.steering.model="pinson13"', 'sensors.imu.grade="navigation"', imu="imu", barometer="baro"
    )  # fmt: skip
    assert result["steering"]["model"] == "pinson13"
    assert result["steering"]["steered_s"] > 2.0


def test_sensors_of_a_receiver_without_use_for_them_are_refused(folder):
    with pytest.raises(ValueError, match='--imu serves the ultra-tight receiver; this one is "scalar"'):
        receive(folder, 'receiver.steering.mode="scalar"', imu="imu", odometer="odo")
    with pytest.raises(ValueError, match="--barometer needs --imu"):
        receive(folder, barometer="baro")
    with pytest.raises(ValueError, match="needs an IMU and a barometer"):
        receive(folder, 'receiver.steering.model="pinson13"', imu="imu", odometer="odo")


def test_command_line_takes_the_files(folder, capsys):
    args = [
        "receive",
        str(folder / "rec.sigmf-meta"),
        "--scenario",
        "drive-jam",
        "--imu",
        str(folder / "rec.imu.csv"),
    ]
    args += [
        "--odometer",
        str(folder / "rec.odo.csv"),
        "-o",
        str(folder / "cli.h5"),
        "--json",
        "--duration-s",
        "0.5",
    ]
    for one in SET:
        args += ["--set", one]
    app(args, exit_on_error=False, result_action="return_value")
    said = json.loads(capsys.readouterr().out)
    assert said["steering"]["first_s"] is None
    assert "fix" in said["steering"]["reason"]
