"""A run over a change of data sets: the messages change their issue, the position does not jump."""

import numpy as np
import pytest

from sdr import scenario
from sdr.receiver import Receiver
from signals.constants import SECONDS_PER_WEEK
from signals.orbits import broadcast_sets, nominal_constellation, satellite_state

WEEK = 2303


@pytest.mark.parametrize("system, step_s", [("G", 7200), ("E", 600)])
@pytest.mark.parametrize("tow_s", [475_300, 604_790])  # in the week, and over its end
def test_sets_are_one_orbit_under_new_issues(system, step_s, tow_s):
    """Half a bit of 2^-31 semicircle of M0, Omega0 and i0 is 0.02 m each; half a bit of af0, and of af1 over the time."""
    af0_s, af1_s_s = (2.0**-31, 2.0**-43) if system == "G" else (2.0**-34, 2.0**-46)
    for eph in nominal_constellation(system, WEEK, tow_s)[:6]:
        eph = eph.copy()
        eph["af2_s_s2"] = 2.0**-55 if system == "G" else 2.0**-59
        sets = broadcast_sets(eph.reshape(()), WEEK, tow_s, 0, 2 * step_s)
        assert len(sets) == 3 and sets[0] == eph
        assert [int(s["iode"] - eph["iode"]) for s in sets] == [0, 1, 2]
        pos, _, clock, _ = satellite_state(sets[0], WEEK, tow_s, np.linspace(0.0, 2 * step_s, 7))
        for other in sets[1:]:
            seen, _, dt, _ = satellite_state(other, WEEK, tow_s, np.linspace(0.0, 2 * step_s, 7))
            assert np.linalg.norm(seen - pos, axis=1).max() < 0.1
            age_s = abs((other["week"] - WEEK) * SECONDS_PER_WEEK + other["toe_s"] - tow_s) + 2 * step_s
            assert np.abs(dt - clock).max() < 0.51 * (af0_s + af1_s_s * age_s)
            on_air_s = other["week"] * SECONDS_PER_WEEK + other["toe_s"] - (7200 if system == "G" else 0)
            assert on_air_s % step_s == 0
    # A later segment knows the sets by the same issue.
    late = broadcast_sets(eph.reshape(()), WEEK, tow_s, 2 * step_s, 2 * step_s + 5)
    assert late[-1] == sets[-1]


def test_the_receiver_changes_over_and_the_position_stays():
    """GPS and Galileo over 14:00:00; a set is whole at most 30 s later, and no fix of the run stands out."""
    over = ["sky.start=2024-03-01T13:59:28", "duration_s=65", "sky.max_satellites=9", "front_end.fs_hz=2.6e6"]
    over += ['sky.signals=["L1CA","E1"]', 'receiver.acquisition.systems=["G","E"]']
    spec, _ = scenario.load("demo-e1", over)
    source = scenario.source(spec)
    receiver = Receiver(spec.receiver, source)
    issues, fixes = {}, []
    for outcome in receiver:
        for e in receiver.telemetry.ephemerides():
            issues.setdefault((e["system"], int(e["prn"])), {})[int(e["iode"])] = outcome.n_end / source.fs_hz
        fixes += outcome.solutions
    first = {(s.system.encode(), s.prn): int(s.ephemeris["iode"]) for s in source.sky.satellites}
    assert len(issues) == 9
    for key, seen in issues.items():
        assert list(seen)[-1] == first[key] + 1 and set(seen) <= {first[key], first[key] + 1}
    assert sum(len(seen) == 2 for seen in issues.values()) >= 5
    rows = np.concatenate(fixes)
    error_m = rows["pos_ecef_m"] - source.sky.receiver(rows["t_s"])["pos_ecef_m"]
    settled = error_m[rows["t_s"] > rows["t_s"][0] + 3.0]
    assert np.linalg.norm(settled, axis=1).max() < 5.0
    assert np.linalg.norm(np.diff(settled, axis=0), axis=1).max() < 1.5
