"""Live monitors: thresholds, alarms on a jammed channel, and no influence on the receiver."""

import json
import math
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from monitors.detection import cluster_rate
from nav.navlog import REMEDY, Remedy
from sdr import jobs, scenario, toml
from sdr.scenario import ReceiverSpec
from sdr.watch.channels import Flags, WatchSpec
from sdr.watch.front import Overheard
from sdr.watch.null import REHEARSALS, null_of
from sdr.watch.post import MONITOR, poisson_interval, report_lines, totals
from signals.modulation import SIGNALS
from tracking.channel import STATE_LOCKED
from tracking.correlator_model import Twin, TwinCW
from tracking.records import EPOCH

FS_HZ = 1e6


def channel(jammers, seconds, T, seed=1):
    """Correlator outputs of the twin as a channel gives them: corr, EPOCH rows, taps; from sample 0 on."""
    taps = 0.65 * (np.arange(35) - 17)
    twin = Twin(
        signal="L1CA",
        prn=6,
        cn0_dbhz=42.0,
        integration_s=T,
        taps_chips=tuple(taps),
        jammers=jammers,
        data=True,
    )
    corr = twin.start(seed)(round(seconds / T))[1] * np.complex64(13.0)
    epochs = np.zeros(len(corr), EPOCH)
    epochs["n_samples"] = round(T * FS_HZ)
    epochs["sample_index"] = np.arange(len(corr)) * round(T * FS_HZ)
    epochs["state"], epochs["cn0_dbhz"] = STATE_LOCKED, 42.0
    return corr, epochs, taps


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


def test_a_training_that_met_few_fades_delivers_its_p_fa():
    """Fades of 0.1 Hz: 20 s hold two or three. The rate over many channels is P_FA, within five deviations of trials
    that hang together by channel, in the test and in the rehearsals. Without the least spread there would be twice as many.
    """
    p_fa, n_train, n_test, channels = 5e-3, 1000, 1000, 240
    taps = 0.65 * (np.arange(35) - 17)
    spec = WatchSpec(name="w", detector={"kind": "FFT"}, expect_multipath={"kind": "Aeronautical"})
    hits, plain = np.zeros(channels, int), np.zeros(channels, int)
    for i in range(channels):
        twin = Twin(
            signal="L1CA", prn=6, cn0_dbhz=42.0, integration_s=0.02, taps_chips=tuple(taps),
            multipath=spec.expect_multipath,
        )  # fmt: skip
        corr = twin.start_open(np.random.SeedSequence(4, spawn_key=(i,)))(n_train + n_test)
        run = spec.detector.start(taps, 0.02)
        run.train(corr[:n_train])
        post = SimpleNamespace(
            spec=spec, run=run, taps=taps, epoch_s=0.02, signal="L1CA", prn=6, waveform=None, cn0_dbhz=42.0
        )
        limit = null_of(post, corr[:n_train]).isf(p_fa)
        assert run.std >= run.least_spread * run.mean > 0
        hits[i] = np.count_nonzero(run(corr[n_train:])["value"] >= limit)
        run.least_spread = 0.0
        plain[i] = np.count_nonzero(run(corr[n_train:])["value"] >= limit)
    n = np.full(channels, n_test)
    told = cluster_rate(hits, n, 0)
    sigma = math.sqrt(p_fa / told.n_effective * (1 + channels / REHEARSALS))
    assert abs(told.p - p_fa) < 5 * sigma < 2 * p_fa, (told, sigma)
    assert plain.sum() > 2 * told.k, plain.sum()


def test_expected_echoes_need_no_independent_training_values():
    """A window of 10 s has two values in its training: too few by theory, enough with what the twin rehearsed."""
    settings = {"seconds": 60.0, "expect_multipath": {"kind": "Aeronautical"}}
    watch, rows = watched({"kind": "CN0", "window_s": 10.0}, **settings)
    (report,) = watch.report(math.inf)
    assert report["rule"] == "rehearsed" and len(rows) == 3 and not report["alarms"]


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
        toml.validate(ReceiverSpec, {"monitor": [{"name": "a", "detector": {"kind": "FFT"}}]}, "receiver")
    one = {"name": "a", "detector": {"kind": "FFT"}}
    with pytest.raises(ValueError, match="names must differ"):
        toml.validate(ReceiverSpec, {"monitor": [one, one]}, "receiver")


def test_a_monitor_without_enough_training_says_so_and_the_run_goes_on():
    watch, rows = watched({"kind": "CN0", "window_s": 10.0}, seconds=40.0)
    (report,) = watch.report(math.inf)
    assert not len(rows)
    assert report["threshold"] is None
    assert "2.0 independent training values are too few" in report["unavailable"]
    watch, rows = watched({"kind": "GLRT"}, seconds=10.0)
    (report,) = watch.report(math.inf)
    assert "it needs 3 s to settle and 20 s of lock and had 10.0 s" in report["unavailable"]


@pytest.mark.parametrize("integration_s", [0.02, 0.004])
def test_an_alarm_that_stands_when_lock_is_lost_is_held_until_tests_go_on(integration_s):
    """A tone, then no lock for 7 s, then quiet: one alarm over the whole; without the tone the gap is told all the same."""
    for js_db in (15.0, -60.0):
        jam = TwinCW(js_db=js_db, offset_hz=5.0, start_s=14.0)
        corr, epochs, taps = channel((jam,), 15.0, integration_s)
        quiet, later, _ = channel((), 5.0, integration_s, seed=2)
        later["sample_index"] += round(22.0 * FS_HZ)
        spec = {"name": "w", "detector": {"kind": "GLRT"}, "settle_s": 1.0, "training_s": 8.0}
        watch = WatchSpec.model_validate(spec).start(FS_HZ)
        watch("L1CA", 6, epochs, corr, (taps, taps), "BPSK")
        watch("L1CA", 6, later, quiet, (taps, taps), "BPSK")
        watch.flush(round(30.0 * FS_HZ))
        (report,) = watch.report(14.0)
        first, last = report["unwatched"]
        assert first["start_s"] == pytest.approx(15.0)
        assert 22.0 <= first["end_s"] < 22.6
        assert last == {"start_s": 27.0, "end_s": 30.0, "alarm": False}
        assert first["alarm"] == (js_db > 0)
        spans = [(a["start_s"], a["end_s"]) for a in report["alarms"]]
        assert spans == ([(pytest.approx(14.02, abs=0.03), first["end_s"])] if js_db > 0 else [])
        assert report["quiet_alarms"] == 0
        assert report["quiet_tests"] == pytest.approx(5.0 / 0.02, abs=2)


class Samples:
    """A source of int8 noise, 2 dB stronger from ``loud`` on, with a gain trace that shows it or none."""

    fs_hz, complex = 1e6, True

    def __init__(self, dtype, loud, gain=True):
        rng = np.random.default_rng(7)
        x = 20 * rng.standard_normal((2, 8_000_000))
        x[:, loud:] *= 10 ** (2 / 20)
        scale = {np.int8: 1, np.int16: 100, np.float32: 0.01}[dtype]
        self.iq = (np.rint(x * scale) if dtype != np.float32 else x * scale).astype(dtype)
        self.loud, self.at = loud, 0
        if not gain:
            self.agc_gain_db = lambda sample: None

    def agc_gain_db(self, sample):
        rng = np.random.default_rng(sample)
        return np.array([0.02 * rng.standard_normal() - 2.0 * (sample >= self.loud)])

    def read(self, n):
        n0 = self.at
        self.at = min(n0 + n, self.iq.shape[1])
        return n0, self.iq[:, n0 : self.at]


@pytest.mark.parametrize("dtype", [np.int8, np.int16, np.float32])
def test_the_front_end_is_watched_in_the_samples_and_in_the_gain(dtype):
    rows = {}
    for cut in (200_000, 73_000):
        watches = [
            WatchSpec.model_validate(
                {"name": d["kind"], "detector": d, "settle_s": 0.5, "training_s": 4.0}
            ).start(1e6)
            for d in ({"kind": "ADC", "samples": 60_000}, {"kind": "AGC"})
        ]
        source = Overheard(Samples(dtype, 6_000_000), watches)
        while source.read(cut)[1].shape[1]:
            pass
        rows[cut] = [np.concatenate([r for n, r in source.take() if n == "ADC"])]
        for watch in watches:
            (report,) = watch.report(6.0)
            (alarm,) = report["alarms"]
            assert 6.0 <= alarm["start_s"] <= 6.11
            assert alarm["end_s"] > 7.8
            assert (report["signal"], report["prn"], report["quiet_alarms"]) == ("", 0, 0)
            assert report["trained_s"] == pytest.approx(4.5, abs=0.1)
    assert rows[200_000][0].tobytes() == rows[73_000][0].tobytes()


def test_a_gain_that_nobody_tells_is_unavailable():
    watch = WatchSpec.model_validate({"name": "agc", "detector": {"kind": "AGC"}, "settle_s": 0.0}).start(1e6)
    source = Overheard(Samples(np.int8, 0, gain=False), [watch])
    source.read(1_000_000)
    (report,) = watch.report(math.inf)
    assert report["threshold"] is None
    assert "front_end.agc" in report["unavailable"]
    (line,) = report_lines([report], totals([report]))
    assert line.startswith("agc on front end: these samples come without a gain trace")


def check_approach(result, prn, start_s, silent=()):
    """Every monitor alarms on the jammed satellite or the front end, none before; counts as their P_FA has them."""
    json.dumps(result, allow_nan=False)
    alarmed = {
        m["name"]
        for m in result["monitors"]
        for a in m["alarms"]
        if m["prn"] in (prn, 0) and a["start_s"] >= start_s
    }
    assert alarmed | set(silent) == {m["name"] for m in result["monitors"]}
    due = found = 0.0
    for m in result["monitors"]:
        assert {"name", "signal", "prn", "threshold", "p_fa", "alarms"} <= set(m)
        if m["threshold"] is not None:
            due += m["p_fa"] * m["quiet_tests"]
            found += sum(a["start_s"] < start_s for a in m["alarms"])
            assert m["quiet_approach_alarms"] == 0
    low, high = poisson_interval(due)
    assert low <= found <= high, (found, due)
    for total in result["monitor_totals"]:
        assert total["quiet_alarms_due"][0] <= total["quiet_alarms"] <= total["quiet_alarms_due"][1], total


def test_a_short_jammed_approach(tmp_path):
    """Two satellites and 15 s: the monitors of the built-in approach with less training."""
    text = scenario.load("demo-approach")[1]
    for old, new in (
        ("duration_s = 75.0", "duration_s = 15.0"), ("max_satellites = 8", "max_satellites = 2"),
        ("start_s = 45.0", "start_s = 11.0"), ("js_db = 9.0", "js_db = 20.0"), ("offset_hz = -25.0", "offset_hz = -5.0"),
        ("[[receiver.monitor]]", "[[receiver.monitor]]\nsettle_s = 1.5\ntraining_s = 6.0"), ('"G20"', '"G27"'),
        ("prn = 20", "prn = 27"),
    ):  # fmt: skip
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "short.toml").write_text(text)
    result = jobs.run(str(tmp_path / "short.toml"), output=tmp_path / "a.h5", quiet=True)
    names = {m["name"]: m for m in result["monitor_totals"]}
    assert {"fft", "glrt", "ar", "agc", "adc"} <= set(names)
    for name in ("fft", "glrt", "ar", "agc", "adc"):
        assert names[name]["alarms"] >= 1
        assert names[name]["quiet_alarms"] == 0
    assert "95 % of cases" in result["text"]


@pytest.mark.slow
def test_a_jammed_approach(tmp_path):
    """The built-in approach to its end, every monitor on 8 channels."""
    result = jobs.run("demo-approach", output=tmp_path / "a.h5", quiet=True, plots=True)
    assert len(result["satellites"]) >= 8
    check_approach(result, 20, 45.0, silent=("sqm-delta",))  # 45 kHz off the carrier E and L are alike
    assert {"monitors.png", "alarms.png"} <= {path.rsplit("/", 1)[1] for path in result["figures"]}
    with h5py.File(tmp_path / "a.h5") as h5:
        assert "monitors/glrt" in h5 and "monitors/agc" in h5 and "monitors/thresholds" in h5


@pytest.mark.slow
def test_monitors_leave_the_receiver_alone(tmp_path):
    """Tracking and position bit for bit as without monitors."""
    short = ("duration_s=40", "sky.max_satellites=5", "jammer=[]")
    jobs.run("demo-approach", output=tmp_path / "a.h5", overrides=short, quiet=True)
    bare = [*short, "receiver.monitor=[]"]
    jobs.run("demo-approach", output=tmp_path / "b.h5", overrides=bare, quiet=True)
    with h5py.File(tmp_path / "a.h5") as a, h5py.File(tmp_path / "b.h5") as b:
        assert "monitors/glrt" in a and "monitors" not in b
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
