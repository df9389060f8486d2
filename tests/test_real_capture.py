"""Half a second of real sky (PocketSDR's sample, inverted spectrum): what can be found in it is found."""

from pathlib import Path

import pytest

from sdr import jobs, probe
from sdr.options import Recording

CAPTURE = Path(__file__).resolve().parents[2] / "shared/data/real/L1_20211202_084700_4MHz_IQ.bin"
pytestmark = pytest.mark.skipif(not CAPTURE.is_file(), reason=f"the capture {CAPTURE.name} is not here")
GPS = {26, 31, 29, 16, 32}
GALILEO = {27, 30, 7, 15, 21, 19, 20}


def test_receive_tracks_all_and_says_why_there_is_no_fix(tmp_path):
    result = jobs.receive(
        CAPTURE, Recording("ci8", 4e6, conjugate=True), output=tmp_path / "out.h5", quiet=True
    )
    tracked = {(s["signal"], s["prn"]) for s in result["satellites"] if s["locked_s"] > 0.1}
    assert {("L1CA", p) for p in GPS} | {("E1C", p) for p in GALILEO} <= tracked
    for s in result["satellites"]:
        if s["signal"] == "E1C" and s["prn"] in GALILEO:
            # Upright once the pilot's sign is taken out: the composite's minus sign on E1-C.
            assert s["secondary_code"]
            assert s["sync_patterns"]["upright"] >= 1
    assert result["fix"] is None
    assert "0.5 s" in result["no_fix_reason"]


@pytest.mark.parametrize("conjugated", [False, True])
def test_probe_finds_the_inversion_by_itself(conjugated):
    result = probe.probe(CAPTURE, Recording("ci8", 4e6, conjugate=conjugated))
    assert result["declaration"]["inverted"] is True
    assert result["declaration"]["inverted_significance"] > 10
    assert {s["prn"] for s in result["satellites"] if s["signal"] == "L1CA"} >= GPS


def test_probe_finds_format_and_rate_by_itself():
    declaration = probe.probe(CAPTURE, Recording())["declaration"]
    assert declaration["format"] == "ci8"
    assert declaration["fs_hz"] == 4e6
