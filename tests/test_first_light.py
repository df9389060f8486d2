"""The whole receiver: from a scenario, and from its file alone, to a position."""

import json
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from sdr import jobs
from sdr.errors import hermite, tracking_errors
from sdr.options import Recording
from signals.constants import CHIP_RATE_HZ, METRES_PER_CHIP
from tracking.loops import dll_jitter_chips, pll_jitter_cycles

FS_HZ = 4e6
SATELLITE_KEYS = {
    "signal",
    "prn",
    "acquired",
    "locked_s",
    "doppler_hz",
    "code_phase_chips",
    "cn0_dbhz",
    "ephemeris",
    "healthy",
}
FIX_KEYS = {"first_s", "epochs", "lat_deg", "lon_deg", "height_m", "pos_ecef_m", "used", "rms_3d_m"}
QUIET_CLOCK = "clock={bias_s=2e-4, drift_s_s=3e-7}"


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    result = jobs.run("demo", output=folder / "demo.h5", overrides=[QUIET_CLOCK], quiet=True)
    return result, folder / "demo.h5"


def test_demo_fixes_within_5_m(demo):
    result, _ = demo
    assert result["no_fix_reason"] is None
    assert set(result["fix"]) == FIX_KEYS
    assert result["fix"]["rms_3d_m"] < 5.0
    assert result["fix"]["first_s"] < 45.0
    assert all(set(s) >= SATELLITE_KEYS for s in result["satellites"])
    assert all(s["ephemeris"] and s["healthy"] for s in result["satellites"])


def test_jitter_doppler_and_cn0_agree_with_theory_and_truth(demo):
    """Code error AND phase error AND C/N0 of each channel, against thermal theory (5 sigma of the sample estimate)."""
    _, path = demo
    with h5py.File(path) as h5:
        truth = h5["truth/satellites"][:]
        power_hz = {
            prn: 10 ** (truth["cn0_dbhz"][truth["prn"] == prn].mean() / 10) for prn in np.unique(truth["prn"])
        }
        for group in h5["tracking"].values():
            epochs, signal = group["epochs"][:], group["epochs"].attrs["signal"]
            mine = truth[truth["prn"] == group["epochs"].attrs["prn"]]
            errors = tracking_errors(epochs, mine, FS_HZ, signal)
            settled = errors["t_s"] > 15.0
            # The other satellites are noise of density 2/3 C / R_c each (integral of sinc^4: rectangular chips).
            prn = int(group["epochs"].attrs["prn"])
            others = sum(p for k, p in power_hz.items() if k != prn) * 2 / 3 / CHIP_RATE_HZ
            cn0 = 10 * np.log10(power_hz[prn] / (1 + others))
            code_sigma_m = METRES_PER_CHIP * dll_jitter_chips(cn0, 1.0, 0.02, 0.5)
            phase_sigma = pll_jitter_cycles(cn0, 10.0, 0.02)
            t = errors["t_s"][settled]
            # A loop of bandwidth B gives about 2 B independent values a second.
            n_code, n_phase = 2 * 1.0 * (t[-1] - t[0]), 2 * 10.0 * (t[-1] - t[0])
            code, phase = errors["code_m"][settled], errors["phase_cycles"][settled]
            assert abs(code.mean()) < 5 * code_sigma_m / np.sqrt(n_code)
            assert abs(code.std() / code_sigma_m - 1) < 5 / np.sqrt(2 * n_code)
            assert abs(phase.std() / phase_sigma - 1) < 5 / np.sqrt(2 * n_phase)
            # Two per cent of amplitude are lost to 8-bit levels and table rounding at the most.
            assert abs(np.median(epochs["cn0_dbhz"][epochs["sample_index"] > 15 * FS_HZ]) - cn0) < 0.5


def test_position_is_as_good_as_its_covariance_claims(demo):
    """Errors against truth divided by the claimed sigma: neither proud nor timid (means over a correlated minute)."""
    _, path = demo
    with h5py.File(path) as h5:
        s, truth = h5["navigation/solution"][:], h5["truth/receiver"][:]
    t, t_k = s["sample_index"] / FS_HZ, truth["sample_index"] / FS_HZ
    true = np.stack(
        [hermite(t, t_k, truth["pos_ecef_m"][:, i], truth["vel_ecef_mps"][:, i]) for i in range(3)], axis=1
    )
    error = s["pos_ecef_m"] - true
    nees = np.einsum("ki,kij,kj->k", error, np.linalg.inv(s["cov_ecef_m2"]), error)
    # Smoothed ranges of one minute are nearly one draw: chi-square of 3 degrees, 1 - 1e-6.
    assert nees.mean() < 30.7


def test_file_alone_gives_the_same_position(demo, tmp_path):
    """No truth reaches the receiver: the samples on disk, alone in a directory, give the same bits as the stream."""
    result, path = demo
    made = jobs.simulate("demo", tmp_path / "sky", overrides=[QUIET_CLOCK], threads=2, quiet=True)
    for name in made["files"]:
        if name.endswith(".h5"):
            Path(name).unlink()
    meta = next(Path(f) for f in made["files"] if f.endswith(".sigmf-meta"))
    document = json.loads(meta.read_text())
    meta.write_text(json.dumps({k: document[k] for k in ("global", "captures", "annotations")}))
    again = jobs.receive(meta, Recording(), "demo", output=tmp_path / "out.h5", quiet=True)
    assert again["fix"]["pos_ecef_m"] == result["fix"]["pos_ecef_m"]
    assert "rms_3d_m" not in again["fix"]
    with h5py.File(path) as a, h5py.File(tmp_path / "out.h5") as b:
        assert "truth" not in b
        for name in a["tracking"]:
            np.testing.assert_array_equal(a[f"tracking/{name}/corr"][:], b[f"tracking/{name}/corr"][:])
        np.testing.assert_array_equal(a["navigation/observations"][:], b["navigation/observations"][:])


def test_threads_change_nothing(tmp_path):
    over = ["duration_s=3"]
    jobs.run("demo", output=tmp_path / "1.h5", overrides=over, quiet=True)
    jobs.run("demo", output=tmp_path / "2.h5", overrides=over, threads=2, quiet=True)
    with h5py.File(tmp_path / "1.h5") as a, h5py.File(tmp_path / "2.h5") as b:
        assert set(a["tracking"]) == set(b["tracking"])
        for name in a["tracking"]:
            np.testing.assert_array_equal(a[f"tracking/{name}/corr"][:], b[f"tracking/{name}/corr"][:])


def test_results_describe_themselves(demo):
    _, path = demo
    with h5py.File(path) as h5:
        assert h5.attrs["software"] == "gnss-baseband"
        assert h5.attrs["complete"]
        assert 'name = "demo"' in h5.attrs["scenario"]
        assert QUIET_CLOCK in h5.attrs["scenario"]
        group = next(iter(h5["tracking"].values()))
        units = json.loads(group["epochs"].attrs["units"])
        assert units["doppler_hz"] == "Hz"
        assert units["code_phase_chips"] == "chip"
        assert group["corr"].shape == (len(group["epochs"]), len(group["corr"].attrs["taps_chips"]))


def test_figures_are_drawn(demo):
    from sdr.plot import plot

    _, path = demo
    drawn = plot(path)
    assert {p.name for p in drawn} >= {
        "tracking_errors.png",
        "cn0.png",
        "iq.png",
        "correlation.png",
        "sky.png",
        "position.png",
    }
    assert all(p.stat().st_size > 10_000 for p in drawn)


def test_galileo_alone_and_together(tmp_path):
    both = jobs.run("demo-e1", output=tmp_path / "b.h5", overrides=["duration_s=45"], quiet=True)
    assert both["fix"]["rms_3d_m"] < 3.0
    assert {u[0] for u in both["fix"]["used"]} == {"G", "E"}
    over = ["duration_s=45", 'receiver.acquisition.systems=["E"]']
    alone = jobs.run("demo-e1", output=tmp_path / "e.h5", overrides=over, quiet=True)
    assert alone["fix"]["rms_3d_m"] < 3.0
    assert {u[0] for u in alone["fix"]["used"]} == {"E"}


def test_whole_samples_per_chip_cost_no_accuracy(tmp_path):
    """Two samples per chip on a clock that stands still: with sharp codes the position was 47 to 72 m off."""
    over = ["front_end.fs_hz=2.046e6", "clock={bias_s=2e-4, drift_s_s=0}", "duration_s=45"]
    result = jobs.run("demo", output=tmp_path / "two.h5", overrides=over, quiet=True)
    with h5py.File(tmp_path / "two.h5") as h5:
        truth = h5["truth/satellites"][:]
        for group in h5["tracking"].values():
            epochs, prn = group["epochs"][:], group["epochs"].attrs["prn"]
            errors = tracking_errors(epochs, truth[truth["prn"] == prn], 2.046e6, "L1CA")
            t_s, code_m = (errors[name][errors["t_s"] > 15] for name in ("t_s", "code_m"))
            # 3 dB below the weakest satellite's 39.7: what the others and the band cost. 2 B values a second.
            sigma_m = METRES_PER_CHIP * dll_jitter_chips(36.7, 1.0, 0.02, 0.5)
            assert abs(code_m.mean()) < 5 * sigma_m / np.sqrt(2 * (t_s[-1] - t_s[0])), prn
    assert result["fix"]["rms_3d_m"] < 2.0


def test_help_imports_nothing_heavy():
    code = (
        "import sys; from sdr.__main__ import app; app(['--help'], exit_on_error=False, result_action='return_value'); "
        "assert not {'numba', 'scipy', 'numpy', 'h5py', 'matplotlib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
