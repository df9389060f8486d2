"""Symbols from the tracking kernel through the decoders to transmit times; a real capture."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from tracking_signal import Satellite, slab, track

from sdr import receiver
from sdr.scenario import ReceiverSpec
from signals import inav, lnav
from signals.modulation import SIGNALS
from signals.orbits import nominal_constellation
from tracking.channel import STATE_LOCKED, TrackingSpec
from tracking.kernels import CHANNEL, SYMBOL
from tracking.telemetry import Telemetry

WEEK, TOW_S = 2300, 345_600
CAPTURE = Path(__file__).resolve().parents[2] / "shared/data/real/L1_20211202_084700_4MHz_IQ.bin"


def transmitted(signal, prn, n):
    system = SIGNALS[signal].system
    eph = nominal_constellation(system, WEEK, TOW_S)
    eph = eph[eph["prn"] == prn]
    return (lnav if system == "G" else inav).encode(eph, None, None, WEEK, TOW_S, n)


@pytest.mark.parametrize("signal, e1, fs, first_s, seconds", [
    ("L1CA", {}, 2.048e6, 5.0, 13.5),
    ("E1C", {}, 2.6e6, 22.5, 6.5),
    ("E1C", {"integration_ms": 100, "pll_bw_hz": 2.5}, 2.6e6, 22.5, 6.5),
    ("E1B", {"component": "data", "integration_ms": 4}, 2.6e6, 22.5, 6.5),
])  # fmt: skip
def test_transmit_time_from_the_message(signal, e1, fs, first_s, seconds):
    """The replica's code phase at a sample plus the decoded time of its symbol is the true transmit time.

    Two headers that agree make the time: subframes at 6 and 12 s (C/A), words 5 and 0 at 24 and 26 s (E1).
    """
    symbols = transmitted(signal, 7, 2000 if signal == "L1CA" else 8000)
    sat = Satellite(signal, 7, fs, doppler_hz=1500.0, code_chips=first_s * 1.023e6 + 2000.25, symbols=symbols)
    spec = TrackingSpec(e1=e1)
    tracker = spec.start(fs)
    c = tracker.add(sat.acquisition(0, 40.0, -0.2))
    telemetry = Telemetry(tracker)
    telemetry.start(c)
    rng, count, events = np.random.default_rng(6), int(0.1 * fs), []
    for k in range(round(seconds * 10)):
        epochs, counts, _ = tracker.process(k * count, slab([sat], 44.0, k * count, count, rng))
        events += telemetry.update()
    telemetry.stamp(epochs, counts)
    assert events and all(event[3] for _, event in events)
    period, tow_ms = telemetry.reference(c)
    assert tow_ms >= 0
    n = (k + 1) * count
    r = tracker.snapshot(n)[0]
    assert r["state"] == STATE_LOCKED and r["phase_locked"]
    length = SIGNALS[signal].code_length_chips
    elapsed = (r["code_period"] - period) * length + r["code_phase_chips"]
    truth = TOW_S + sat.code_phase(n) / 1.023e6
    assert tow_ms * 1e-3 + elapsed / 1.023e6 == pytest.approx(truth, abs=0.05 / 1.023e6 + 1e-10)
    assert telemetry.transmit_time_ms(c, period + 5) == tow_ms + 5 * (1 if signal == "L1CA" else 4)
    e = epochs[c, : counts[c]]
    want = TOW_S + sat.code_phase(e["sample_index"]) / 1.023e6
    assert np.max(np.abs(e["tow_s"] - want)) < 1e-7
    decoder = telemetry.decoders["G" if signal == "L1CA" else "E", 7]
    if signal == "E1C":
        assert decoder.polarity == 1  # the sign of the composite signal, sky-checked


def test_a_restarted_channel_does_not_continue_the_count():
    sat = Satellite("E1C", 7, 2.6e6)
    tracker = TrackingSpec().start(2.6e6)
    c = tracker.add(sat.acquisition())
    telemetry = Telemetry(tracker)
    telemetry.start(c)
    track(tracker, [sat], 45.0, 0.8, seed=1)
    telemetry.update()
    end = telemetry._end["E", 7]
    tracker.release(c)
    assert tracker.add(sat.acquisition(tracker._end)) == c
    telemetry.start(c)
    assert telemetry.reference(c) == (0, -1)
    assert telemetry._index(c, 0) > end
    assert list(telemetry.slipped([c], [0])) == [True] and list(telemetry.slipped([c], [0])) == [False]


@pytest.mark.skipif(not CAPTURE.exists(), reason="the real capture is not beside this checkout")
def test_a_real_capture_is_tracked():
    """0.5 s of sky: 5 GPS and 7 Galileo satellites locked to the end, the E1-B sync pattern upright on all seven."""
    from tracking.acquisition import AcquisitionSpec, acquire

    fs = 4e6
    raw = np.fromfile(CAPTURE, np.int8).reshape(-1, 2)
    iq = np.ascontiguousarray(np.stack([raw[:, 0], -raw[:, 1]]).astype(np.int8))  # spectrum inverted
    tracker = TrackingSpec(settle_s=0.2).start(fs)
    spec = AcquisitionSpec()
    n = int(0.1 * fs)
    for signal, prns in (("L1CA", [26, 31, 29, 16, 32]), ("E1C", [27, 30, 7, 15, 21, 19, 20])):
        rows = acquire(iq[:, :n], 0, fs, 0.0, signal, prns, spec)
        for row in rows[rows["acquired"]]:
            tracker.add(row)
    assert len(tracker.channels) >= 10
    tracker.process(0, iq)
    assert np.all(tracker.channels["state"] == STATE_LOCKED)
    sync = np.array([1, -1, 1, -1, -1, 1, 1, 1, 1, 1.0])  # 0101100000, logic 0 -> +1
    found = 0
    for c in np.flatnonzero(tracker.channels["signal"] == b"E1C"):
        soft = -np.sign(tracker.symbols[c, : tracker.symbol_counts[c]]["soft"])
        found += np.any(np.correlate(soft, sync, "valid") == 10)
    assert found == np.count_nonzero(tracker.channels["signal"] == b"E1C") == 7


class _Channels:
    """What telemetry reads of a tracker: one C/A channel whose symbols are set by hand."""

    def __init__(self):
        self.channels = np.zeros(1, CHANNEL)
        self.channels["signal"], self.channels["prn"], self.channels["state"] = b"L1CA", 7, STATE_LOCKED
        self.channels["symbol_phase"] = 3

    def bring(self, bits, first):
        self.symbols, self.symbol_counts = np.zeros((1, len(bits)), SYMBOL), np.array([len(bits)])
        self.symbols[0]["soft"] = bits
        self.symbols[0]["code_period"] = 3 + 20 * (first + np.arange(len(bits)))


def test_slabs_decoded_together_say_the_same():
    """Also across a hole in the bits, which begins a new run."""
    bits = transmitted("L1CA", 7, 2400)
    bits = np.delete(bits, np.arange(720, 727))
    first = np.where(np.arange(len(bits)) < 720, np.arange(len(bits)), np.arange(len(bits)) + 7)
    said = []
    for together in (1, 7):
        telemetry, events = Telemetry(_Channels()), []
        telemetry.start(0)
        for k, at in enumerate(range(0, 2390, 10)):
            telemetry.tracker.bring(bits[at : at + 10], first[at])
            telemetry.hear()
            if k % together == together - 1:
                events += telemetry.decode()
        events += telemetry.decode()
        said.append((events, telemetry.reference(0), telemetry.ephemerides().tobytes()))
    assert len(said[0][0]) >= 5 and said[0][1][1] >= 0
    assert said[0] == said[1]


def test_the_second_search_takes_the_lost_and_the_nearest():
    """Those lost a moment ago first, then the ``SECOND_LOOK`` that came nearest their thresholds; all while too few."""
    spec = ReceiverSpec.model_validate({"acquisition": {"systems": ["G"]}})
    source = SimpleNamespace(fs_hz=4e6, if_hz=0.0, n_samples=4 * 10**8)
    run = receiver.Receiver(spec, source)
    run._nearness = {("L1CA", p): p / 100 for p in range(1, 33)}
    assert [p for _, p in run._due(0)] == list(range(1, 33))
    run.channel_of = {("L1CA", p): p for p in (31, 32, 30, 29)}
    run._lost = [("L1CA", 2)]
    n = run._next_search
    assert [p for _, p in run._due(n)] == [2, 28, 27, 26, 25, 24, 23, 22, 21][: 1 + receiver.SECOND_LOOK]
    assert len(run._due(run._next_search)) == 1
    run.channel_of.popitem()
    assert len(run._due(run._next_search)) == 29
