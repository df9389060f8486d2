"""Live monitors: thresholds, alarms on a jammed channel, and no influence on the receiver."""

import json
import math
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from nav.navlog import REMEDY, Remedy
from sdr import jobs, scenario
from sdr.scenario import ReceiverSpec
from sdr.watch import MONITOR, Flags, WatchSpec
from signals.modulation import SIGNALS
from tracking.channel import STATE_LOCKED
from tracking.correlator_model import Twin, TwinCW
from tracking.records import EPOCH

FS_HZ = 1e6


def watched(detector, jammers=(), seconds=60.0, cut=(0.2,), seed=1, signal="L1CA", prn=6, **settings):
    """A Watch fed from the twin in ADC levels, in slabs of the given lengths in turn."""
    step = 0.65 if signal == "L1CA" else 0.25
    T = 0.02 if signal == "L1CA" else 0.004
    taps = step * (np.arange(35) - 17)
    twin = Twin(
        signal=signal,
        prn=prn,
        cn0_dbhz=42.0,
        integration_s=T,
        taps_chips=tuple(taps),
        jammers=jammers,
        data=signal == "L1CA",
    )
    corr = twin.start(seed)(round(seconds / T))[1] * np.complex64(13.0)
    epochs = np.zeros(len(corr), EPOCH)
    epochs["n_samples"] = round(T * FS_HZ)
    epochs["sample_index"] = np.arange(len(corr)) * round(T * FS_HZ)
    epochs["state"], epochs["cn0_dbhz"] = STATE_LOCKED, 42.0
    watch = WatchSpec(name="w", detector=detector, **settings).start(FS_HZ)
    rows, i, k = [], 0, 0
    while i < len(corr):
        n = round(cut[k % len(cut)] / T)
        rows.append(
            watch(signal, prn, epochs[i : i + n], corr[i : i + n], (taps, taps), SIGNALS[signal].waveform)
        )
        i, k = i + n, k + 1
    return watch, np.concatenate(
        rows + watch.flush(int(epochs[-1]["sample_index"] + epochs[-1]["n_samples"]))
    )


@pytest.mark.parametrize(
    "detector", [{"kind": "FFT"}, {"kind": "GLRT"}, {"kind": "AR"}, {"kind": "CN0"}, {"kind": "SQM"}]
)
def test_quiet_channel_does_not_alarm_and_a_tone_does(detector):
    jam = TwinCW(js_db=12.0, offset_hz=-80.0, rate_hz_s=2.0, start_s=40.0)
    watch, rows = watched(detector, (jam,))
    assert rows.dtype == MONITOR
    alarms = watch.posts[0].alarms()
    assert len(alarms)
    assert alarms["start_s"].min() > 40.0
    (row,) = watch.posts[0].watched()
    assert 23.0 <= row["trained_s"] <= 24.1
    assert row["tests"] == len(rows)
    assert alarms["peak"].max() >= row["threshold"] == alarms["threshold"][0]
    quiet = rows["t_s"] < 40.0
    assert rows["value"][quiet].max() < row["threshold"]


def test_thresholds_deliver_their_p_fa():
    """At P_FA 1e-3, false alarms within five Poisson deviations of what is due, training errors included."""
    for detector in ({"kind": "GLRT"}, {"kind": "FFT"}):
        tests = hits = 0
        for seed in range(6):
            watch, rows = watched(detector, seconds=150.0, seed=seed, p_fa=1e-3)
            tests += len(rows)
            hits += np.count_nonzero(rows["value"] >= watch.posts[0].threshold)
        due = 1e-3 * tests
        assert abs(hits - due) < 5 * np.sqrt(due) + 1, (detector, hits, due)


def test_slabs_do_not_matter():
    a = watched({"kind": "GLRT"}, seconds=40.0)[1]
    b = watched({"kind": "GLRT"}, seconds=40.0, cut=(0.1, 0.06, 0.2))[1]
    assert a.tobytes() == b.tobytes()


def test_galileo_dumps_are_summed_to_100_ms():
    watch, rows = watched({"kind": "GLRT"}, signal="E1C", prn=11, seconds=40.0)
    assert np.allclose(np.diff(rows["t_s"]), 0.1)
    assert not len(watch.posts[0].alarms())


def test_a_gap_restarts_the_monitor_but_keeps_its_training():
    watch, _ = watched({"kind": "AR"}, seconds=40.0)
    channel = next(iter(watch.channels.values()))
    before = channel.threshold
    e = np.zeros(200, EPOCH)
    e["n_samples"], e["sample_index"], e["state"] = 20_000, 10**9 + 20_000 * np.arange(200), STATE_LOCKED
    z = np.ones((200, 35), np.complex64)
    rows = channel.advance(e, z)
    assert channel.threshold == before
    assert rows["sample_index"].min() >= 10**9 + 149 * 20_000  # a whole window lies behind the gap


def test_refusals():
    with pytest.raises(ValueError, match="a window of taps"):
        scenario.validate(ReceiverSpec, {"monitor": [{"name": "a", "detector": {"kind": "FFT"}}]}, "receiver")
    one = {"name": "a", "detector": {"kind": "FFT"}}
    with pytest.raises(ValueError, match="names must differ"):
        scenario.validate(ReceiverSpec, {"monitor": [one, one]}, "receiver")


def test_a_monitor_without_enough_training_says_so_and_the_run_goes_on():
    watch, rows = watched({"kind": "CN0", "window_s": 10.0}, seconds=40.0)
    (report,) = watch.report(math.inf)
    assert not len(rows)
    assert report["threshold"] is None
    assert "2.0 independent training values are too few" in report["unavailable"]
    watch, rows = watched({"kind": "GLRT"}, seconds=10.0)
    (report,) = watch.report(math.inf)
    assert "it needs 3 s to settle and 20 s of L1CA 6 and had 7 s" in report["unavailable"]


@pytest.mark.slow
def test_a_jammed_approach(tmp_path):
    """The built-in approach: alarms on the jammed satellite after the jammer starts, and tracking bit for bit as without."""
    short = ("duration_s=49", "sky.max_satellites=5")
    result = jobs.run("demo-approach", output=tmp_path / "a.h5", overrides=short, quiet=True)
    bare = [*short, "receiver.monitor=[]"]
    jobs.run("demo-approach", output=tmp_path / "b.h5", overrides=bare, quiet=True)
    json.dumps(result["monitors"], allow_nan=False)
    tests = early = 0
    for m in result["monitors"]:
        assert {"name", "signal", "prn", "threshold", "p_fa", "alarms"} <= set(m)
        tests += m["tests"] * m["p_fa"]
        early += sum(a["start_s"] < 45.0 for a in m["alarms"])
        if m["prn"] == 20 and m["name"] != "cn0":
            assert any(45.0 <= a["start_s"] < 47.0 for a in m["alarms"])
        if m["name"] == "glrt":
            assert all(a["start_s"] >= 45.0 for a in m["alarms"])
    assert early <= 2  # 97.5 % of a Poisson count of 0.1
    with h5py.File(tmp_path / "a.h5") as a, h5py.File(tmp_path / "b.h5") as b:
        assert "monitors/glrt" in a and "monitors/thresholds" in a and "monitors" not in b
        for name, group in b["tracking"].items():
            for part in ("epochs", "corr"):
                assert a[f"tracking/{name}/{part}"][:].tobytes() == group[part][:].tobytes()
        if "navigation/solution" in b:
            assert a["navigation/solution"][:].tobytes() == b["navigation/solution"][:].tobytes()


def test_an_alarm_weakens_its_satellite_until_the_hold_is_over():
    spec = WatchSpec.model_validate({"name": "fast", "detector": {"kind": "CN0"}})
    watch = spec.start(1000.0)
    watch.channels["L1CA", 7] = SimpleNamespace(threshold=5.0)
    watch.channels["E1C", 11] = SimpleNamespace(threshold=None)  # still in training
    flags = Flags(("fast",), 50.0, 2.0, 1000.0)
    rows = np.zeros(3, MONITOR)
    rows["signal"], rows["prn"], rows["value"] = [b"L1CA", b"L1CA", b"E1C"], [7, 7, 11], [4.9, 5.0, 99.0]
    rows["sample_index"] = [9_000, 10_000, 10_000]
    assert flags.join(None, 0) is None
    flags.note(watch, rows)
    weak = flags.join(None, 12_000).rows
    assert [(r["system"], r["prn"], r["weaken"]) for r in weak] == [(b"G", 7, 50.0)]
    assert np.isnan(weak["variance_m2"][0])
    assert flags.join(None, 12_001) is None
    # On top of what the integrity monitors ask, row by row.
    asked = np.zeros(2, REMEDY)
    asked["system"], asked["prn"], asked["bias_m"], asked["variance_m2"] = b"G", [3, 7], 4.0, np.nan
    both = flags.join(Remedy(asked, dx=np.ones(9)), 12_000)
    assert both.rows["weaken"].tolist() == [0.0, 50.0]
    assert both.rows["bias_m"].tolist() == [4.0, 4.0]
    assert both.dx.tolist() == [1.0] * 9
    assert asked["weaken"].tolist() == [0.0, 0.0]
    # Other monitors have no say.
    quiet = Flags((), 50.0, 2.0, 1000.0)
    quiet.note(watch, rows)
    assert quiet.join(None, 10_000) is None


def test_an_answer_of_a_monitor_that_is_off_is_refused():
    with pytest.raises(ValueError, match="wants an answer of 'fft', which is off"):
        ReceiverSpec.model_validate({"respond": {"weaken": ["fft"]}})
