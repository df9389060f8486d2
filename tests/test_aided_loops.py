"""High dynamics: loops told by an IMU against loops on their own at one bandwidth, and their jitter against theory."""

import json

import numpy as np
import pytest

from sdr.reproduce import COLUMNS, aided_loops
from sdr.uttwin import Sky
from signals.trajectory import HighDynamics, Static

N = 4


@pytest.fixture(scope="module", params=["1 g", "6 g"])
def sky(request):
    amplitude = aided_loops.PROFILES[request.param]
    return Sky(aided_loops.SPAN_S, HighDynamics(acc_ned_mps2=amplitude).start(aided_loops.SPAN_S))


def test_aided_loops_hold_at_a_bandwidth_at_which_others_do_not(sky):
    # A second-order loop lags by jerk / wn^2, wn = B / 0.53: at 0.3 Hz and 1 g with 20 s, 3.1 / 0.32 = 10 m/s or 51 Hz, beyond the
    # +-25 Hz of the discriminator; at 4 Hz 0.05 m/s.
    lost, _ = aided_loops.loops(sky, 0.3, False, N, 1, 0)
    held, _ = aided_loops.loops(sky, 0.3, True, N, 1, 0)
    wide, _ = aided_loops.loops(sky, 4.0, False, N, 1, 0)
    assert np.all(lost >= 4)
    assert not held.any()
    assert not wide.any()


def test_jitter_of_aided_loops_is_thermal(sky):
    # 40 s of noise of bandwidth 1 Hz are 80 independent values of each of three components: 5 / sqrt(2 x 80 x 3 x runs), and
    # 10 % for the IMU (0.01 m/s^2 of turn-on bias over wn^2 T, scale factor) and the discrete loop.
    _, rms = aided_loops.loops(sky, 1.0, True, N, 2, 0)
    floor = aided_loops.thermal_floor_mps(sky, 1.0)
    ratio = np.sqrt(np.mean(rms**2)) / floor
    assert abs(ratio - 1.0) < 5 / np.sqrt(2 * 80 * 3 * N) + 0.1


def test_jitter_without_motion_is_thermal_without_aid():
    sky = Sky(
        aided_loops.SPAN_S, Static(lat_deg=44.23, lon_deg=-76.48, height_m=100.0).start(aided_loops.SPAN_S)
    )
    _, rms = aided_loops.loops(sky, 1.0, False, N, 3, 0)
    ratio = np.sqrt(np.mean(rms**2)) / aided_loops.thermal_floor_mps(sky, 1.0)
    assert abs(ratio - 1.0) < 5 / np.sqrt(2 * 80 * 3 * N) + 0.1


def test_table_has_counts_and_goes_to_json(tmp_path):
    rows = aided_loops.run(tmp_path, quick=True, seed=1)
    json.dumps(rows, allow_nan=False)
    assert all(tuple(r) == COLUMNS for r in rows)
    assert (tmp_path / "aided_loops.png").stat().st_size > 0
    tight = [r for r in rows if "ultra-tight" in r["item"] and r["item"].endswith("lost")]
    assert [r["ours"] for r in tight] == [0.0, 0.0]
    assert tight[0]["note"] == "0 of 24 channels"
    assert tight[0]["ci_high"] < 0.15
