"""Inversion told by tracked signals: on made-up epochs, and on a sky whose I and Q are exchanged."""

import numpy as np
import pytest

from sdr import iffile, jobs
from sdr.drift import CodeDrift
from signals.constants import CHIP_RATE_HZ, CYCLES_PER_CHIP
from tracking.channel import STATE_LOCKED
from tracking.records import EPOCH

FS_HZ = 4e6


def _slabs(drift, prn, doppler_hz, sign, seconds=10):
    """Epochs of 20 ms, code sliding by ``sign`` times what the Doppler says, with 0.05 chip of loop noise."""
    rng = np.random.default_rng(prn)
    n = round(0.02 * FS_HZ)
    for slab in range(5 * seconds):
        rows = np.zeros(10, EPOCH)
        rows["prn"], rows["state"], rows["n_samples"] = prn, STATE_LOCKED, n
        rows["sample_index"] = (slab * 10 + np.arange(10)) * n
        t_s = rows["sample_index"] / FS_HZ
        slide = (CHIP_RATE_HZ + sign * doppler_hz / CYCLES_PER_CHIP) * t_s
        rows["code_phase_chips"] = (slide + 0.05 * rng.standard_normal()) % 1023.0
        rows["doppler_hz"] = doppler_hz
        drift.hear("L1CA", rows)


@pytest.mark.parametrize(
    ("signs", "inverted"),
    [
        ((1, 1, 1), False),
        ((-1, -1, -1), True),
        ((-1, 0.3, 0.0), False),
        ((-1, -1, 0.3), True),
        ((-1, -1, 1, 1), False),
    ],
)
def test_made_up(signs, inverted):
    drift = CodeDrift(FS_HZ)
    for prn, sign in enumerate(signs, 1):
        _slabs(drift, prn, (-1) ** prn * 900.0 * prn, sign)
    assert drift.inverted is inverted


def test_little_doppler_is_not_judged():
    drift = CodeDrift(FS_HZ)
    for prn in (1, 2, 3):
        _slabs(drift, prn, 100.0, -1)
    assert not drift.inverted


def test_exchanged_i_and_q(tmp_path):
    """Weak Dopplers stay locked in an inverted sky: the receiver names the reason and gives no position."""
    jobs.simulate("demo", tmp_path / "sky", overrides=["duration_s=6", "front_end.fs_hz=2.6e6"], quiet=True)
    data = np.fromfile(tmp_path / "sky.sigmf-data", np.int8).reshape(-1, 2)
    swapped = tmp_path / "swapped.bin"
    data[:, ::-1].tofile(swapped)
    for conjugate in (False, True):
        declared = iffile.Declaration(swapped, "ci8", 2.6e6, conjugate=conjugate)
        result = jobs.receive(swapped, declared, output=tmp_path / "out.h5", quiet=True)
        assert ("the spectrum is inverted" in result["no_fix_reason"]) is not conjugate
