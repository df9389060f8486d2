"""What bytes tell of a stranger's recording: formats on noise of many shapes, and a capture that is declared wrongly."""

import re
from pathlib import Path

import numpy as np
import pytest

from sdr import guess, iffile, jobs, probe
from sdr.options import Recording

CAPTURE = Path(__file__).resolve().parents[2] / "shared" / "data" / "real" / "L1_20211202_084700_4MHz_IQ.bin"
N = 1 << 16


def _noise(rms):
    return rms * np.random.default_rng(5).standard_normal((N, 2))


def _clip(x, low, high):
    return np.clip(np.round(x), low, high)


def _packed(levels, fmt, tmp_path):
    with iffile.RecordingWriter(tmp_path / "p", fmt, 4e6) as writer:
        writer.write(levels.T.astype(np.int8))
    return writer.data.read_bytes()


def _two_bits(x):
    return np.sign(x + 1e-9) * np.where(np.abs(x) > 1.0, 3, 1)


@pytest.mark.parametrize("rms", [0.5, 2.0, 28.0, 60.0, 100.0])
def test_eight_bits(rms):
    x = _clip(_noise(rms), -128, 127).astype(np.int8)
    assert guess.plausible_formats(x.tobytes())[0] == "ci8"
    assert guess.plausible_formats((x.astype(np.int16) + 128).astype(np.uint8).tobytes())[0] == "cu8"


@pytest.mark.parametrize("rms", [0.7, 3.0, 28.0, 100.0, 300.0, 3000.0, 10000.0])
def test_sixteen_bits(rms):
    x = _clip(_noise(rms), -32768, 32767).astype("<i2")
    assert guess.plausible_formats(x.tobytes())[0] == "ci16"


@pytest.mark.parametrize("step", [4, 16, 256])
def test_sixteen_bits_left_adjusted(step):
    x = (_clip(_noise(6000.0 / step), -32768 // step, 32767 // step) * step).astype("<i2")
    assert guess.plausible_formats(x.tobytes())[0] == "ci16"


@pytest.mark.parametrize("rms", [1e-4, 1.0, 3e4])
def test_floats(rms):
    assert guess.plausible_formats(_noise(rms).astype("<f4").tobytes())[0] == "cf32"


def test_packed(tmp_path):
    two = _two_bits(_noise(1.0))
    assert guess.plausible_formats(_packed(two, "ci2", tmp_path))[0] == "ci2"
    assert guess.plausible_formats(_packed(two, "ci2tc", tmp_path))[0] == "ci2tc"
    assert guess.plausible_formats(_packed(np.sign(two), "ci1", tmp_path))[0] == "ci1"


@pytest.mark.skipif(not CAPTURE.is_file(), reason="the capture is not there")
@pytest.mark.parametrize("declared", [Recording("ci16", 4e6), Recording("ci8", 5e6)])
def test_wrong_declaration_is_put_right(declared, monkeypatch):
    monkeypatch.setattr(guess, "COMMON_RATES_HZ", (2.6e6, 4e6, 5e6, 8e6))
    result = probe.probe(CAPTURE, declared)
    told = result["declaration"]
    assert (told["format"], told["fs_hz"], told["inverted"]) == ("ci8", 4e6, True)
    assert "--format ci8 --fs-hz 4000000 --if-hz 0 --conjugate" in result["advice"]
    assert "declared" in result["advice"]


def test_a_clock_far_off_is_found_and_said(tmp_path):
    over = ["clock={drift_s_s=6e-5}", "front_end.fs_hz=2.6e6", "duration_s=0.5"]
    made = jobs.simulate("demo", tmp_path / "off", overrides=over, quiet=True)
    result = probe.probe(tmp_path / "off.sigmf-meta", Recording())
    assert len(result["satellites"]) >= 5 and result["declaration"]["inverted"] is False
    # 60 ppm of 1575.42 MHz; the middle of satellites within 5 kHz of it.
    center = re.search(r"doppler_center_hz=(-?\d+)", result["advice"])
    assert center and abs(float(center[1]) + 94_525) < 5000, made
