"""The command line: JSON and nothing else, one sentence and exit code 2, valid files whatever happens."""

import json
import os
import re
import resource
import signal
import subprocess
import sys
import time

import h5py
import numpy as np
import pytest

from sdr import __main__ as command_line

GNSSBB = [sys.executable, "-m", "sdr"]
SHORT = ["--set", "duration_s=1"]


def gnssbb(*args, **kwargs):
    return subprocess.run([*GNSSBB, *map(str, args)], capture_output=True, text=True, timeout=300, **kwargs)


@pytest.fixture(scope="module")
def noise(tmp_path_factory):
    """0.3 s of 8-bit noise without any satellite."""
    path = tmp_path_factory.mktemp("noise") / "noise.bin"
    rng = np.random.default_rng(1)
    path.write_bytes(
        np.clip(np.round(20 * rng.standard_normal(2 * 1_200_000)), -127, 127).astype(np.int8).tobytes()
    )
    return path


def test_json_is_one_object_and_nothing_else(tmp_path):
    done = gnssbb("run", "demo", "-o", tmp_path / "a.h5", "--json", *SHORT)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert {
        "command",
        "version",
        "schema",
        "duration_s",
        "real_time_factor",
        "satellites",
        "fix",
        "no_fix_reason",
        "output",
    } <= set(result)
    assert result["command"] == "run"
    assert result["fix"] is None
    assert "too short" in result["no_fix_reason"]


def test_time_spent_on_compiling_is_told_apart(tmp_path, monkeypatch):
    """Whoever runs it first waits for the compiler: a kernel that is new in the middle of a run is in the summary, else nothing is."""
    import contextlib

    from numba import njit

    from sdr import jobs

    @contextlib.contextmanager
    def watched(label, total, quiet):
        new = njit(lambda x: x + 1.0)
        yield lambda done, note="": new(float(done))

    short = {"overrides": ["duration_s=1"], "output": tmp_path / "a.h5", "quiet": True}
    jobs.run("demo", **short)
    warm = jobs.run("demo", **short)
    monkeypatch.setattr(jobs, "progress", watched)
    new = jobs.run("demo", **short)
    assert warm["compiling_s"] == 0.0 < new["compiling_s"]
    assert "compiled" not in warm["text"]
    assert "; 58 s of it compiled kernels" in jobs._summary(new | {"compiling_s": 57.6})


def test_no_satellite_says_what_was_searched(noise, tmp_path):
    done = gnssbb("receive", noise, "--format", "ci8", "--fs-hz", "4e6", "-o", tmp_path / "a.h5", "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["satellites"] == []
    assert "L1CA PRN 1-32" in result["no_fix_reason"]
    assert "5000 Hz" in result["no_fix_reason"]


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["run", "no-such-scenario"], ["no-such-scenario", "demo"]),
        (["run", "demo", "--set", "front_end.fs_hz=1e5"], ["fs_hz"]),
        (["run", "demo", "--set", "front_end.if_hz=3e6"], ["if_hz"]),
        (["run", "demo", "--set", "duration_s=-1"], ["duration_s", "-1"]),
        (["run", "demo", "--set", "duratoin_s=1"], ["duratoin_s", "duration_s"]),
        (["run", "demo", "--set", "receiver.tracking.l1ca.pll_bw_hz=40"], ["PLL"]),
        (["run", "demo", "--set", "nonsense"], ["key=value"]),
        (["receive", "missing.bin"], ["missing.bin"]),
        (["receive", "EMPTY", "--format", "ci8", "--fs-hz", "4e6"], ["empty"]),
        (["receive", "ODD", "--format", "ci8", "--fs-hz", "4e6"], ["byte"]),
        (["receive", "NOISE", "--format", "xyz", "--fs-hz", "4e6"], ["xyz", "ci8"]),
        (["receive", "NOISE", "--format", "ci8"], ["fs-hz"]),
        (["receive", "NOISE", "--format", "ci8", "--fs-hz", "5e5"], ["500000"]),
        (["receive", "NOISE", "--format", "ci8", "--fs-hz", "4e6", "--if-hz", "3e6"], ["3"]),
        (["receive", "NOISE", "--format", "ci8", "--fs-hz", "4e6", "--skip-s", "9"], ["0.3"]),
        (["receive", "NAN", "--format", "cf32", "--fs-hz", "4e6"], ["1234"]),
        (["receive", "NOISE", "--format", "ci8", "--fs-hz", "1e15"], ["1e+15"]),
        (["receive", "NOISE", "--format", "ci8", "--fs-hz", "4e6", "--threads", "0"], ["threads", "0"]),
        (["probe", "FLAT", "--format", "ci8", "--fs-hz", "4e6"], ["equal"]),
        (["plot", "NOISE"], ["HDF5"]),
        (["lines", "--signal", "L5"], ["L5", "L1CA"]),
        (["acquire", "NOISE", "--format", "ci8", "--fs-hz", "4e6", "--p-fa", "2"], ["p_fa"]),
        (["run", "demo", "--frobnicate"], ["frobnicate"]),
        (
            ["run", "demo", "--set", 'jammer=[{kind="Cw"}]'],
            ["jammer.0.kind' = 'Cw' is not one of 'CW', 'Chirp'"],
        ),
        (["run", "demo", "--set", "jammer=[{freq_hz=3}]"], ["jammer.0.kind' is missing"]),
        (["run", "demo", "--set", "sky.foo=1", "--set", "duration_s=-3"], ["then see to 'sky.foo'"]),
    ],
)
def test_bad_input_is_one_sentence(args, words, noise, tmp_path):
    (tmp_path / "empty.bin").write_bytes(b"")
    (tmp_path / "odd.bin").write_bytes(b"\1" * 8_000_001)
    samples = np.ones(400_000, np.float32)
    samples[2 * 1234] = np.nan
    (tmp_path / "nan.bin").write_bytes(samples.tobytes())
    (tmp_path / "flat.bin").write_bytes(b"\7" * 400_000)
    names = {
        "NOISE": noise,
        "EMPTY": tmp_path / "empty.bin",
        "ODD": tmp_path / "odd.bin",
        "NAN": tmp_path / "nan.bin",
        "FLAT": tmp_path / "flat.bin",
    }
    done = gnssbb(*[names.get(a, a) for a in args], cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("gnssbb: ")
    assert "Traceback" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
    for word in words:
        assert word in done.stderr, done.stderr


def test_no_fix_under_a_tone_says_where_it_is_and_what_to_do(tmp_path):
    """300 kHz falls into a bin of 4 MHz / 512 = 7.8 kHz; J/N is J/N0 less 66 dB of 4 MHz."""
    tone = 'jammer=[{kind="CW", freq_hz=300e3, jn0_dbhz=86.0}]'
    done = gnssbb("run", "demo", "-o", tmp_path / "a.h5", "--json", *SHORT, "--set", tone)
    reason = json.loads(done.stdout)["no_fix_reason"]
    words = re.search(r"narrow interference at (\S+) kHz from the carrier, (\S+) dB over", reason)
    assert words is not None and 'kind="Notch"' in reason, reason
    assert abs(float(words[1]) - 300.0) < 7.9 and abs(float(words[2]) - 20.0) <= 1.0
    done = gnssbb("run", "demo", "-o", tmp_path / "a.h5", "--json", *SHORT)
    assert "interference" not in json.loads(done.stdout)["no_fix_reason"]


def test_a_rate_too_low_for_galileo_still_finds_gps(noise, tmp_path):
    done = gnssbb("receive", noise, "--format", "ci8", "--fs-hz", "2e6", "-o", tmp_path / "a.h5", "--json")
    reason = json.loads(done.stdout)["no_fix_reason"]
    assert "L1CA PRN 1-32" in reason and "E1C" not in reason


def _hear_interrupts():
    """A shell gives its background jobs an ignored SIGINT, which the tests below would inherit."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def _begin(tmp_path, *args):
    out = tmp_path / "long.h5"
    process = subprocess.Popen(
        [*GNSSBB, "run", "demo", "-o", str(out), "--set", "duration_s=3000", *args],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=_hear_interrupts,
    )  # fmt: skip
    for _ in range(600):
        time.sleep(0.2)
        try:
            with h5py.File(out) as h5:
                if "tracking" in h5:
                    return process, out
        except OSError:
            pass
        assert process.poll() is None, process.stderr.read()
    raise AssertionError("no checkpoint came")


def _check(out, complete):
    with h5py.File(out) as h5:
        assert bool(h5.attrs["complete"]) is complete
        group = next(iter(h5["tracking"].values()))
        assert len(group["epochs"]) == len(group["corr"]) > 0
    assert gnssbb("plot", out, "-o", out.parent / "figures").returncode == 0


def test_sigkill_leaves_a_valid_file(tmp_path):
    process, out = _begin(tmp_path)
    process.kill()
    process.wait()
    _check(out, False)


def test_sigterm_and_ctrl_c_exit_130_with_what_was_computed(tmp_path):
    for number in (signal.SIGTERM, signal.SIGINT):
        process, out = _begin(tmp_path)
        process.send_signal(number)
        _, err = process.communicate(timeout=60)
        assert process.returncode == 130, err
        assert "Traceback" not in err
        _check(out, False)
        out.unlink()


def test_full_disk_is_one_sentence_and_keeps_the_last_checkpoint(tmp_path):
    def small_disk():
        resource.setrlimit(resource.RLIMIT_FSIZE, (3_000_000, 3_000_000))

    env = os.environ | {"NUMBA_CACHE_DIR": os.environ.get("NUMBA_CACHE_DIR", "")}
    gnssbb("run", "demo", "-o", tmp_path / "warm.h5", *SHORT)
    done = gnssbb("simulate", "demo", "-o", tmp_path / "big", *SHORT, preexec_fn=small_disk, env=env)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr


def test_an_interrupt_in_a_destructor_is_not_lost(monkeypatch):
    class Dying:
        def __del__(self):
            raise KeyboardInterrupt

    monkeypatch.setattr(sys, "unraisablehook", command_line._interrupt_again)
    _hear_interrupts()
    with pytest.raises(KeyboardInterrupt):
        Dying()
        time.sleep(10)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_an_interrupt_answered_with_another_error_exits_130(monkeypatch, number):
    """Compiled libraries turn an exception that a signal raised inside them into TypeError or SystemError."""

    def job(**_):
        try:
            signal.raise_signal(number)
        except KeyboardInterrupt:
            raise SystemError("returned a result with an exception set") from None

    before = {n: signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGINT)}
    monkeypatch.setattr(command_line, "app", job)
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    _hear_interrupts()
    try:
        with pytest.raises(SystemExit) as left:
            command_line.main()
    finally:
        for n, handler in before.items():
            signal.signal(n, handler)
    assert left.value.code == 130
