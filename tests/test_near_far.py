"""A satellite 20 dB above what codes separate: its images on other codes are not satellites."""

from types import SimpleNamespace

import numpy as np

from sdr.receiver import Receiver
from sdr.scenario import ReceiverSpec
from signals.records import EPHEMERIS
from tracking.lock import STATE_LOCKED
from tracking.records import ACQUISITION


def _receiver(cn0_dbhz: dict[int, float], orbit: dict[int, float]) -> Receiver:
    """A receiver that tracks these PRNs, each with an ephemeris of this mean anomaly."""
    receiver = Receiver(ReceiverSpec(), SimpleNamespace(fs_hz=4e6, if_hz=0.0, n_samples=0))
    for prn, cn0 in cn0_dbhz.items():
        row = np.zeros(1, ACQUISITION)[0]
        row["signal"], row["prn"], row["cn0_dbhz"] = b"L1CA", prn, cn0
        c = receiver.channel_of["L1CA", prn] = receiver.tracker.add(row)
        receiver.telemetry.start(c)
        receiver.tracker.channels["state"][c], receiver.tracker.channels["cn0_dbhz"][c] = STATE_LOCKED, cn0
        ephemeris = np.zeros(1, EPHEMERIS)[0]
        ephemeris["system"], ephemeris["prn"], ephemeris["m0_rad"] = b"G", prn, orbit[prn]
        receiver.telemetry.decoders["G", prn].ephemeris = ephemeris
    return receiver


def test_the_strongest_of_one_orbit_is_kept():
    receiver = _receiver({12: 36.0, 1: 60.0, 7: 40.0, 26: 35.0}, {12: 0.5, 1: 0.5, 7: 0.4, 26: 0.5})
    receiver._drop_images(0)
    assert set(receiver.channel_of) == {("L1CA", 1), ("L1CA", 7)}
    assert {int(e["prn"]) for e in receiver.telemetry.ephemerides()} == {1, 7}
    assert not receiver.telemetry.has_ephemeris("L1CA", 12)
