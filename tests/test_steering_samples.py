"""Steering on IF samples: an outage bridged without acquisition, and a scalar receiver that steering leaves alone."""

from dataclasses import replace

import numpy as np
import pytest

from nav import ultratight_kernels as kernels
from nav.records import SOLUTION
from nav.steering import Steering
from nav.ultratight import COASTING, STEERED
from sdr import scenario
from sdr.receiver import Receiver
from signals.faults import PowerDrop

OUTAGE_S = (26.0, 34.0)
SPACING = {"L1CA": 0.5, "E1": 0.25}


def _outcomes(spec, mode, sensors, **changes):
    update = {"steering": spec.receiver.steering.with_mode(mode), **changes}
    receiver = spec.receiver.model_copy(update=update)
    source = scenario.source(spec)
    return source, list(Receiver(receiver, source, sensors))


def _outage(**changes):
    spec = scenario.load("drive-jam", ["duration_s=37.0"])[0]
    fault = PowerDrop(start_s=OUTAGE_S[0], stop_s=OUTAGE_S[1], drop_db=100.0)
    spec = spec.model_copy(update={"jammer": (), "fault": (fault,)})
    return _outcomes(spec, "ultra_tight", scenario.sensors(spec), **changes)


@pytest.fixture(scope="module")
def outage():
    return _outage()


def test_updates_give_the_same_bits_however_many_a_slab_holds(outage):
    results = []
    for _, outcomes in (outage, _outage(slab_ms=100)):
        parts = ([row for o in outcomes for row in getattr(o, kind)] for kind in ("steering", "solutions"))
        results.append([np.concatenate(rows).tobytes() for rows in parts])
    assert results[0] == results[1]


def test_outage_is_bridged_and_every_satellite_is_back_within_a_second(outage):
    source, outcomes = outage
    rows = np.concatenate([row for o in outcomes for row in o.steering])
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


def test_steered_channels_give_observations_at_the_scalar_rate_and_noise(outage):
    source, outcomes = outage
    obs = np.concatenate([r for o in outcomes for r in o.observations])
    t = obs["sample_index"] / source.fs_hz
    row = {s.prn: i for i, s in enumerate(source.sky.satellites)}
    error = []
    for sample in np.unique(obs["sample_index"][(t > 24.5) & (t <= 25.9)]):
        o = obs[obs["sample_index"] == sample]
        true = source.sky.propagate(np.array([sample / source.fs_hz]))
        e = o["pseudorange_m"] - 299_792_458.0 * true.delay_s[[row[int(p)] for p in o["prn"]], 0]
        error.append(e - e.mean())  # the receiver's clock
    assert len(error) == 7  # 5 Hz
    # 44 dB-Hz, E-L 0.5 chip, loop of 1 Hz: sigma^2 = B d / (2 C/N0) chips^2, 0.92 m; 7 correlated epochs of 8 satellites.
    sigma_m = 293.05 * np.sqrt(1.0 * 0.5 / (2 * 10**4.4))
    assert 0.6 * sigma_m < np.std(np.concatenate(error)) < 1.5 * sigma_m
    # No phase is tracked, which the lock time says.
    assert not obs["lock_s"][(t > 24.5) & (t < 26)].any()
    dark = (t > OUTAGE_S[0] + 2) & (t < OUTAGE_S[1])
    assert dark.sum() < 8


def test_a_fault_shows_in_the_ranges_of_a_steered_channel():
    # The filter believes nothing of it and leaves its NCO on the prediction; the discriminator alone carries the 12 m, and
    # what the filter corrects meanwhile (0.3 m an epoch, in both channels) must not be counted twice.
    T, n = 0.02, 100
    power, zeros = np.zeros((2, kernels.N_CN0)), np.zeros(2)
    rho, rate, truth = (
        np.array([2.2e7, 2.3e7]),
        np.zeros(2),
        np.array([2.2e7 + 12.0 + 0.3 * n, 2.3e7 + 0.3 * n]),
    )
    gain = np.array([0.5, 1.0])
    for _ in range(n):
        z = np.concatenate([gain * (truth - rho), np.array([0.25, 0.0])])
        before, rho = rho, rho + 0.3
        kernels.observe(
            np.ones(2, np.int64), np.full(2, T), z, gain, gain, zeros, zeros, rho, rate, before, rate, power
        )
    # It began at zero, 42 m off, and forgets that by 1 - 4 B T / (1 + 2 B T) an epoch; a moving reference leaves no lag.
    left = 42.0 * (1.0 - 0.08 / 1.04) ** n
    assert rho + power[:, kernels.RANGE_M] == pytest.approx(truth, abs=1.01 * left)
    assert power[:, kernels.RATE_MPS] == pytest.approx([0.5, 0.0], abs=1e-3)
    assert power[:, kernels.RANGE_OFF_M] == pytest.approx(truth - rho + 0.3, abs=1.1 * left)


@pytest.mark.slow
def test_two_systems_are_back_at_once_after_thirty_dark_seconds():
    spec = scenario.load("drive-outage")[0]
    dark = spec.fault[0].start_s, spec.fault[0].stop_s
    assert dark[1] - dark[0] == 30.0
    source, outcomes = _outcomes(spec, "ultra_tight", scenario.sensors(spec))
    rows = np.concatenate([row for o in outcomes for row in o.steering])
    fixes = np.concatenate([s for o in outcomes if o.steering for s in o.solutions])
    fixes = fixes[fixes["t_s"] > rows["t_s"][0]]
    error = np.linalg.norm(fixes["pos_ecef_m"] - source.sky.receiver(fixes["t_s"])["pos_ecef_m"], axis=1)
    claimed = np.sqrt(np.trace(fixes["cov_ecef_m2"], axis1=1, axis2=2))
    before, t = (fixes["t_s"] > dark[0] - 5) & (fixes["t_s"] < dark[0]), fixes["t_s"]
    assert rows["n_used"][(rows["t_s"] > dark[0] - 5) & (rows["t_s"] < dark[0])].min() == 12
    # Galileo system time minus GPS's as the sky has it; the estimate's own noise is a decimetre or so.
    ggto_m = 299_792_458.0 * float(source.sky.iono_utc["a0g_s"])
    assert np.mean(fixes["isb_m"][before]) == pytest.approx(-ggto_m, abs=0.5)
    # Dead reckoning: what the filter claims at the end holds, and is what the grade gives (gyro walk 1 deg/rt-h, odometer
    # scale known to 0.2 %): below 2 m after 300 m of way.
    end = (t > dark[1] - 0.5) & (t <= dark[1])
    assert error[end].max() < 3.0 * claimed[end].max() < 6.0
    # Every satellite within a second, without acquisition, and in its place.
    assert rows["n_used"][rows["t_s"] > dark[1] + 1.0].min() == 12
    assert not any(len(o.found) for o in outcomes if o.n0 > dark[1] * source.fs_hz)
    assert error[t > dark[1] + 1.0].max() < 1.0


def test_an_odometer_in_other_units_is_not_taken_over():
    spec = scenario.load("drive-jam", ["duration_s=3.0"])[0].model_copy(update={"jammer": ()})
    sensors = scenario.sensors(spec)
    rows = sensors.odometer.copy()
    rows["speed_mps"] *= 3.6
    steering = Steering(
        spec.receiver.steering.with_mode("ultra_tight"), 4e6, replace(sensors, odometer=rows), SPACING
    )
    fix = np.zeros((), SOLUTION)
    state = scenario.source(spec).sky.receiver(np.array([2.0]))[0]
    fix["pos_ecef_m"], fix["vel_ecef_mps"] = state["pos_ecef_m"], state["vel_ecef_mps"]
    with pytest.raises(ValueError, match=r"the odometer says 3\d\.\d m/s where the fix says 10\.0"):
        steering._begin(8_000_000, fix, 0.0)
    assert steering.filter is None
