"""GNSS-SDR reads our files: static and moving, GPS, Galileo and both."""

import numpy as np
import pytest
from gnss_sdr import positions

from sdr import jobs, scenario
from signals.geodesy import geodetic_to_ecef

pytestmark = [pytest.mark.interop, pytest.mark.timeout(900)]
LEAP_S = 18  # GPS - UTC since 2017


def _judge(tmp_path, name, overrides, n_gps, n_galileo):
    overrides = [*overrides, "duration_s=75"]
    made = jobs.simulate(name, tmp_path / "sky", overrides=overrides, threads=2, quiet=True)
    data = next(f for f in made["files"] if f.endswith(".sigmf-data"))
    fixes = positions(data, tmp_path, n_gps, n_galileo)
    spec, _ = scenario.load(name, overrides)
    start = spec.sky.start_time
    t_s = fixes[:, 0] + LEAP_S - (start.hour * 3600 + start.minute * 60 + start.second)
    truth = spec.motion.start(spec.duration_s)(t_s).pos_ecef_m
    found = geodetic_to_ecef(np.radians(fixes[:, 1]), np.radians(fixes[:, 2]), fixes[:, 3])
    return np.sqrt(np.mean(np.sum((found - truth) ** 2, axis=1))), len(fixes)


@pytest.mark.parametrize(
    ("name", "overrides", "n_gps", "n_galileo"),
    [
        ("demo", [], 9, 0),
        ("demo-drive", [], 9, 0),
        ("demo-e1", ['sky.signals=["E1"]'], 0, 7),
        ("demo-e1", [], 9, 7),
    ],
    ids=["gps-static", "gps-moving", "galileo", "both"],
)
def test_gnss_sdr_fixes_within_5_m(tmp_path, name, overrides, n_gps, n_galileo):
    rms_m, n = _judge(tmp_path, name, overrides, n_gps, n_galileo)
    assert n >= 5
    assert rms_m < 5.0
