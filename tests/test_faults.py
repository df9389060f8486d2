"""Faults in the air: code, carrier and level against the clean sky, and in the samples of a tracked signal."""

import numpy as np
import pytest
from pydantic import ValidationError

from sdr import scenario
from signals.clock import ClockSpec
from signals.constants import C_MPS, F_L1_HZ, WAVELENGTH_M
from signals.faults import ClockDrift, CodeDelay, PowerDrop, Ramp, Spoofer, Step, faulty
from signals.sky import SkySpec
from signals.trajectory import Static

DURATION_S = 60.0
T = np.linspace(0.0, 59.0, 119)


@pytest.fixture(scope="module")
def sky():
    motion = Static().start()
    clock = ClockSpec(bias_s=1e-4, drift_s_s=1e-7).start(1, DURATION_S, motion)
    return SkySpec(max_satellites=8).start(motion, clock, DURATION_S, 1)


def change(sky, *faults):
    """(code m, carrier m, level dB) of every genuine row against the clean sky."""
    clean, out = sky.propagate(T), faulty(sky, faults, DURATION_S).propagate(T)
    n = len(sky.satellites)
    return (
        C_MPS * (out.delay_s[:n] - clean.delay_s),
        C_MPS * (out.phase_delay_s[:n] - clean.phase_delay_s),
        out.cn0_dbhz[:n] - clean.cn0_dbhz,
    )


# Delays are about 0.08 s: a difference of two doubles carries 2 x 1.4e-17 s x c = 8e-9 m.
ROUND_M = 2e-8


@pytest.mark.parametrize(
    ("fault", "code", "carrier", "level"),
    [
        (Step(satellite="G01", step_m=10, start_s=20), 10.0, 0.0, 0.0),
        (Step(satellite="G01", step_m=-7, start_s=20, carrier=True), -7.0, -7.0, 0.0),
        (Ramp(satellite="G01", rate_mps=0.3048, start_s=20), 0.3048 * (T - 20), 0.0, 0.0),
        (
            CodeDelay(satellite="G01", delay_m=15, onset_s=10, start_s=20),
            np.minimum(1.5 * (T - 20), 15),
            0.0,
            0.0,
        ),
        (
            ClockDrift(satellite="G01", rate_mps=0.5, accel_mps2=0.1, start_s=20),
            0.5 * (T - 20) + 0.05 * (T - 20) ** 2,
            0.5 * (T - 20) + 0.05 * (T - 20) ** 2,
            0.0,
        ),
        (PowerDrop(satellite="G01", drop_db=13, start_s=20), 0.0, 0.0, -13.0),
    ],
)
def test_each_fault_moves_one_satellite_exactly(sky, fault, code, carrier, level):
    row = 3
    fault = fault.model_copy(update={"satellite": sky.satellites[row].name, "stop_s": 40.0})
    got = change(sky, fault)
    on = (T >= 20) & (T < 40)
    for values, want, tol in zip(got, (code, carrier, level), (ROUND_M, ROUND_M, 1e-12)):
        np.testing.assert_allclose(values[row], np.where(on, want, 0.0), rtol=0, atol=tol)
        assert not np.delete(values, row, axis=0).any()


def test_rates_are_the_derivatives(sky):
    """Central differences of delays against the rates, on a parabola (exact but for rounding)."""
    name = sky.satellites[0].name
    bad = faulty(sky, [ClockDrift(satellite=name, rate_mps=2, accel_mps2=3, start_s=10)], DURATION_S)
    h = 0.5
    t = np.array([12.0, 30.0])
    clean_slope = (sky.propagate(t + h).delay_s - sky.propagate(t - h).delay_s)[0] / (2 * h)
    for delay, rate in (("delay_s", "delay_rate_s_s"), ("phase_delay_s", "phase_delay_rate_s_s")):
        slope = (getattr(bad.propagate(t + h), delay) - getattr(bad.propagate(t - h), delay))[0] / (2 * h)
        added = getattr(bad.propagate(t), rate)[0] - getattr(sky.propagate(t), rate)[0]
        if delay == "delay_s":
            np.testing.assert_allclose(slope - clean_slope, added, rtol=0, atol=1e-15)
        np.testing.assert_allclose(C_MPS * added, 2 + 3 * (t - 10), rtol=1e-6)


def test_several_at_once_add_up(sky):
    a, b = sky.satellites[1].name, sky.satellites[2].name
    code, carrier, level = change(
        sky,
        Step(satellite=a, step_m=5),
        Ramp(satellite=a, rate_mps=1.0),
        ClockDrift(satellite=b, rate_mps=2.0),
        PowerDrop(drop_db=6),
    )
    np.testing.assert_allclose(code[1], 5 + T, atol=ROUND_M)
    np.testing.assert_allclose(carrier[2], 2 * T, atol=ROUND_M)
    assert not carrier[1].any()
    np.testing.assert_allclose(level, -6.0)


def test_spoofer_is_one_more_signal_of_the_same_satellite(sky):
    name = sky.satellites[4].name
    spoof = Spoofer(
        satellite=name, start_s=10, advantage_db=4, rise_s=5, hold_s=8, drift_mps=3, phase_cycles=0.25
    )
    bad = faulty(sky, [spoof], DURATION_S)
    out, clean = bad.propagate(T), sky.propagate(T)
    n = len(sky.satellites)
    assert len(bad.satellites) == n + 1 == len(out.delay_s) and bad.genuine == n
    assert (bad.satellites[n].prn, bad.satellites[n].system) == (
        sky.satellites[4].prn,
        sky.satellites[4].system,
    )
    np.testing.assert_array_equal(out.delay_s[:n], clean.delay_s)
    on = T >= 10
    np.testing.assert_array_equal(out.visible[n], on)
    offset = C_MPS * (out.delay_s[n] - clean.delay_s[4])[on]
    np.testing.assert_allclose(offset, 3 * np.maximum(T[on] - 18, 0), atol=ROUND_M)
    carrier = (out.phase_delay_s[n] - clean.phase_delay_s[4])[on]
    np.testing.assert_allclose(carrier * F_L1_HZ, offset / WAVELENGTH_M - 0.25, atol=2e-7)
    level = (out.cn0_dbhz[n] - clean.cn0_dbhz[4])[on]
    np.testing.assert_allclose(level, 4 - 40 * (1 - np.minimum((T[on] - 10) / 5, 1)), atol=1e-12)


def test_no_fault_is_the_sky_itself(sky):
    assert faulty(sky, (), DURATION_S) is sky


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (Step(satellite="G63", step_m=1), ["fault 1", "Step", "G63", "not in the sky"]),
        (PowerDrop(drop_db=3, start_s=70), ["fault 1", "start_s", "70", "60"]),
    ],
)
def test_refusals(sky, fault, words):
    with pytest.raises(ValueError) as error:
        faulty(sky, [fault], DURATION_S)
    assert all(w in str(error.value) for w in words)


def test_a_fault_cannot_end_before_it_begins():
    with pytest.raises(ValidationError, match="later than start_s"):
        Step(satellite="G01", step_m=1, start_s=5, stop_s=4)


TEXT = """
name = "f"
duration_s = 1.6
[sky]
signals = ["L1CA"]
max_satellites = 5
cn0_dbhz = 50.0
ionosphere = "none"
[front_end]
fs_hz = 4.0e6
"""


def test_samples_carry_the_fault_and_truth_tells():
    """Correlate the samples of one satellite around its true phase: the code arrives late by what was asked.

    The error of a noise-free code estimate here is the table's rounding, below 0.15 m, and what the other satellites
    leak in 100 ms: their C/A cross-correlation of -24 dB averages over 100 periods of different Dopplers.
    """
    spec = scenario.parse(TEXT)
    name = scenario.source(spec).sky.satellites[0].name
    faults = f'[[fault]]\nkind = "CodeDelay"\nsatellite = "{name}"\ndelay_m = 60.0\nstart_s = 1.0\n'
    bad = scenario.source(scenario.parse(TEXT + faults))
    clean = scenario.source(spec)
    a, b = clean.read(clean.n_samples)[1], bad.read(bad.n_samples)[1]
    np.testing.assert_array_equal(a[:, : int(0.97 * 4e6)], b[:, : int(0.97 * 4e6)])
    late = _code_offset_m(b[:, 4_800_000:5_200_000], clean, 4_800_000) - _code_offset_m(
        a[:, 4_800_000:5_200_000], clean, 4_800_000
    )
    # Thermal: d / (4 C/N0 T) chips^2 of early minus late with d = 1, C/N0 T = 1e4: 0.005 chip = 1.5 m, common to both.
    assert abs(late - 60.0) < 2.0
    rows = bad.fault_truth(bad.truth_index())
    np.testing.assert_array_equal(rows["on"], rows["t_s"] >= 1.0)
    np.testing.assert_array_equal(rows["code_m"], 60.0 * rows["on"])
    truth = bad.truth(np.array([5_000_000]))
    first = truth[truth["prn"] == int(name[1:])]
    wanted = clean.truth(np.array([5_000_000]))
    wanted = wanted[wanted["prn"] == int(name[1:])]
    assert abs(C_MPS * (first["delay_s"] - wanted["delay_s"])[0] - 60.0) < ROUND_M


def _code_offset_m(iq, source, n0):
    """Early-minus-late-power code offset of satellite 0 about its clean delay, m (positive = late)."""
    from signals.codes import primary_code

    n = np.arange(iq.shape[1])
    t = (n0 + n) / source.fs_hz
    ends = source.sky.propagate(np.array([t[0], t[-1]]))
    slope = np.diff(ends.delay_s[0])[0] / (t[-1] - t[0])
    delay = ends.delay_s[0, 0] + slope * (t - t[0])
    phase = ends.phase_delay_s[0, 0] + ends.phase_delay_rate_s_s[0].mean() * (t - t[0])
    z = (iq[0] + 1j * iq[1]) * np.exp(2j * np.pi * F_L1_HZ * phase)
    chips = primary_code("L1CA", source.sky.satellites[0].prn)
    sums = []
    for shift in (-0.5, 0.0, 0.5):
        replica = chips[np.floor(1.023e6 * (t - delay) - shift).astype(np.int64) % 1023]
        sums.append((z * replica)[: 4000 * (len(n) // 4000)].reshape(-1, 4000).sum(axis=1))
    # The prompt of each period takes data and phase off, so that noise does not add power.
    early, late = (np.sum(s * np.conj(sums[1] / np.abs(sums[1]))).real for s in (sums[0], sums[2]))
    # |R| = 0.5 -+ x on both sides: (L - E) / (L + E) = 2 x.
    return 293.05 * 0.5 * (late - early) / (late + early)
