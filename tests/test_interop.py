"""GNSS-SDR reads our files: static and moving, GPS, Galileo and both."""

import numpy as np
import pytest
from gnss_sdr import positions

from sdr import jobs, scenario
from signals.geodesy import geodetic_to_ecef

pytestmark = [pytest.mark.interop, pytest.mark.timeout(900)]
LIMIT_M = 5.0
RUNS = 2
"""GNSS-SDR's threads race: of 15 runs on the drive, one and the same file, 14 came out at 3.4 to 4.2 m and one at 12.3 m.
A file that is wrong fails every run, so a second run is granted; both are shown when both fail."""
LEAP_S = 18  # GPS - UTC since 2017


def _judge(tmp_path, name, overrides, n_gps, n_galileo):
    overrides = [*overrides, "duration_s=75"]
    made = jobs.simulate(name, tmp_path / "sky", overrides=overrides, threads=2, quiet=True)
    data = next(f for f in made["files"] if f.endswith(".sigmf-data"))
    spec, _ = scenario.load(name, overrides)
    start = spec.sky.start_time
    motion = spec.motion.start(spec.duration_s)
    found = []
    for _ in range(RUNS):
        fixes = positions(data, tmp_path, n_gps, n_galileo)
        t_s = fixes[:, 0] + LEAP_S - (start.hour * 3600 + start.minute * 60 + start.second)
        ecef_m = geodetic_to_ecef(np.radians(fixes[:, 1]), np.radians(fixes[:, 2]), fixes[:, 3])
        error_m = np.linalg.norm(ecef_m - motion(t_s).pos_ecef_m, axis=1)
        found.append((float(np.sqrt(np.mean(error_m**2))), len(fixes)))
        if found[-1][0] < LIMIT_M and found[-1][1] >= 5:
            break
    return found


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
    runs = _judge(tmp_path, name, overrides, n_gps, n_galileo)
    rms_m, n = runs[-1]
    assert n >= 5, runs
    assert rms_m < LIMIT_M, f"(rms in m, fixes) of every run: {runs}"
