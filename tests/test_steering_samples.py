"""Steering on IF samples: an outage bridged without acquisition, and a scalar receiver that steering leaves alone."""

import numpy as np
import pytest

from nav.ultratight import COASTING, STEERED
from sdr import scenario
from sdr.receiver import Receiver
from signals.faults import PowerDrop

OUTAGE_S = (26.0, 34.0)


def _outcomes(spec, mode, sensors):
    receiver = spec.receiver.model_copy(update={"steering": spec.receiver.steering.with_mode(mode)})
    source = scenario.source(spec)
    return source, list(Receiver(receiver, source, sensors))


@pytest.fixture(scope="module")
def outage():
    spec = scenario.load("drive-jam", ["duration_s=37.0"])[0]
    fault = PowerDrop(start_s=OUTAGE_S[0], stop_s=OUTAGE_S[1], drop_db=100.0)
    spec = spec.model_copy(update={"jammer": (), "fault": (fault,)})
    return _outcomes(spec, "ultra_tight", scenario.sensors(spec))


def test_outage_is_bridged_and_every_satellite_is_back_within_a_second(outage):
    source, outcomes = outage
    rows = np.concatenate([o.steering for o in outcomes if o.steering is not None])
    t = rows["t_s"]
    before = rows[(t > OUTAGE_S[0] - 1) & (t < OUTAGE_S[0])]
    n = before["n_steered"].max()
    assert n >= 6
    assert np.all(before["state"] == STEERED)
    inside = rows[(t > OUTAGE_S[0] + 1) & (t < OUTAGE_S[1])]
    assert np.mean(inside["state"] == COASTING) > 0.9  # the estimate of C/N0 scatters upwards now and then
    after = rows[t > OUTAGE_S[1] + 1.0]
    assert np.all(after["n_used"] == n)
    assert not any(len(o.found) for o in outcomes if o.n0 > OUTAGE_S[1] * source.fs_hz)  # without acquisition
    fixes = np.concatenate([s for o in outcomes for s in o.solutions])
    fixes = fixes[fixes["t_s"] > OUTAGE_S[1] + 1.0]
    true = source.sky.receiver(fixes["t_s"])
    assert np.abs(fixes["pos_ecef_m"] - true["pos_ecef_m"]).max() < 2.0
    assert np.all(fixes["valid"])


def test_replicas_sit_on_the_signals_while_steered(outage):
    source, outcomes = outage
    from tracking.lock import STATE_LOCKED

    row = {s.prn: i for i, s in enumerate(source.sky.satellites)}
    checked = 0
    for o in outcomes:
        if not 24.0 < o.n0 / source.fs_hz < 25.5:
            continue
        for _, epochs, _ in o.epochs:
            for e in epochs[epochs["state"] == STATE_LOCKED]:
                t = float(e["sample_index"]) / source.fs_hz
                true = source.sky.propagate(np.array([t]))
                chips = (t - true.delay_s[row[int(e["prn"])], 0]) * 1.023e6
                off = (e["code_phase_chips"] - chips + 511.5) % 1023 - 511.5
                df = e["doppler_hz"] + 1575.42e6 * true.phase_delay_rate_s_s[row[int(e["prn"])], 0]
                # 1 m of position or clock is 0.0034 chip; 0.1 m/s is 0.53 Hz. Turns of 1.3 m/s^2 change 0.14 Hz in 20 ms.
                assert abs(off) < 0.02
                assert abs(df) < 2.0
                checked += 1
    assert checked > 300


def test_scalar_mode_gives_the_bits_of_no_steering_at_all():
    spec = scenario.load("drive-jam", ["duration_s=2.0"])[0].model_copy(update={"jammer": ()})
    plain = spec.model_copy(
        update={"receiver": spec.receiver.model_copy(update={"steering": type(spec.receiver.steering)()})}
    )
    results = []
    for one, sensors in ((plain, None), (spec, scenario.sensors(spec))):
        _, outcomes = _outcomes(one, "scalar", sensors)
        results.append(
            [
                np.concatenate([e for o in outcomes for c, e, _ in o.epochs if c == k]).tobytes()
                for k in range(4)
            ]
        )
    assert results[0] == results[1]
