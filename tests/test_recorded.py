"""Campaigns over recordings: windows, jammers and counts that replay, whatever the workers."""

import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from sdr import jobs, store
from sdr.campaign import results, run, trials
from sdr.campaign.load import from_table

SKY = """
name = "recorded"
seed = 5
duration_s = 16
[sky]
start = 2024-03-01T12:01:00
signals = ["L1CA"]
max_satellites = 3
cn0_dbhz = 48.0
[front_end]
fs_hz = 2.0e6
bits = 8
[receiver.acquisition]
systems = ["G"]
"""


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    base = tmp_path_factory.mktemp("recorded")
    (base / "sky.toml").write_text(SKY, encoding="utf-8")
    jobs.simulate(str(base / "sky.toml"), output=base / "sky", quiet=True)
    return str(base / "sky.sigmf-meta")


def table(recording, **changes):
    return {
        "name": "recorded",
        "recordings": [{"file": recording}],
        "window_s": 14.0,
        "jammer": {"kind": "Narrowband", "bandwidth_hz": 2000.0, "start_s": 9.0},
        "grid": {"jammer.jn0_dbhz": [20.0, 82.0]},
        "receiver": {
            "acquisition": {"systems": ["G"]},
            "tracking": {"l1ca": {"taps": {"count": 15, "spacing_chips": 0.65}}},
            "monitor": [
                {"name": "glrt", "p_fa": 1e-4, "settle_s": 1.0, "training_s": 3.0, "detector": {"kind": "GLRT"}},
            ],
        },
        "stop": {"max_trials": 2, "definition": "all"},
    } | changes  # fmt: skip


def test_a_strong_jammer_is_found_and_a_weak_one_is_not(recording, tmp_path):
    result = run.execute(from_table(table(recording)), tmp_path / "r.h5", workers=1)
    weak, strong = result["points"]
    assert weak["axes"] == {"recording": recording, "jammer.jn0_dbhz": 20.0}
    # Two windows of at least two channels, 5 s of 50 tests a second each.
    assert weak["n"] > 2 * 2 * 5 * 50 * 0.9 and weak["rate"] > 0.98
    assert strong["rate"] < 0.1 and strong["event_k"] == 0 and strong["event_n"] >= 4
    assert strong["alarmed_trials"] == 2 and strong["first_alarm_median_s"] < 3.0
    assert strong["cn0_dbhz"] < weak["cn0_dbhz"] - 1.0
    assert weak["rule"] == "live" and weak["threshold"] is None
    with store.read(tmp_path / "r.h5") as h5:
        rows = h5["campaign/trials"][:]
    # Alone, in another process and in another order, a trial is the same.
    c = from_table(table(recording))
    alone = trials.evaluate_trials(c.text, 1, 1, 1, None)
    kept = rows[(rows["point"] == 1) & (rows["trial"] == 1)]
    assert alone.tobytes() == kept.tobytes()
    assert not np.array_equal(rows["peak"][0::2], rows["peak"][1::2])


def test_a_point_without_jammer_counts_false_alarms(recording, tmp_path):
    quiet = table(recording, jammer={"kind": "none"}, grid={}, stop={"max_trials": 1, "definition": "all"})
    (point,) = run.execute(from_table(quiet), tmp_path / "q.h5", workers=1)["points"]
    assert point["definition"] == "false_alarm" and point["n"] > 500 and point["rate"] < 0.01


DIES = """
import json, os, pathlib, signal, sys
from sdr.campaign import load, results, run
text, out, after = sys.argv[1], pathlib.Path(sys.argv[2]), int(sys.argv[3])
keep, kept = results.Results.keep, []
def dies(self, rows):
    keep(self, rows)
    kept.append(rows)
    if len(kept) == after:
        self._journal.write(b"R half a record")
        self._journal.flush()
        os.kill(os.getpid(), signal.SIGKILL)
results.Results.keep = dies
run.execute(load.from_table(json.loads(text)), out, workers=2)
"""


def test_killed_resumed_and_with_other_workers_it_ends_the_same(recording, tmp_path):
    """SIGKILL right after the first and after the second chunk that was kept, in the middle of the next record."""
    many = table(recording, stop={"max_trials": 4, "definition": "all", "min_trials": 4})
    one, out = tmp_path / "one.h5", tmp_path / "killed.h5"
    expected = run.execute(from_table(many), one, workers=1)
    kept = 0
    for after in (1, 2):
        died = subprocess.run(
            [sys.executable, "-c", DIES, json.dumps(many), str(out), str(after)],
            env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        )
        assert died.returncode == -signal.SIGKILL
        with results.Results(from_table(many), out) as begun:
            assert kept < begun.resumed < 8 and not begun.complete
            kept = begun.resumed
    result = run.execute(from_table(many), out, workers=2)
    assert result["resumed_trials"] == kept and result["complete"]
    assert not out.with_name("killed.h5.journal").exists()
    told = [{**p, "output": ""} for p in result["points"]]
    assert told == [{**p, "output": ""} for p in expected["points"]]
    with store.read(one) as a, store.read(out) as b:
        for name in ("trials", "points", "rates"):
            assert a[f"campaign/{name}"][:].tobytes() == b[f"campaign/{name}"][:].tobytes(), name


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"window_s": 20.0}, "less than window_s = 20"),
        ({"recordings": [{"file": "nowhere.bin"}]}, "nowhere"),
        ({"recordings": []}, "recordings"),
        ({"grid": {"twin.prn": [1, 2]}}, "starts with jammer"),
        ({"jammer": {"kind": "CW", "js_db": 10.0, "against": "G05"}, "grid": {}}, "give jammer.jn0_dbhz"),
        ({"jammer": {"kind": "CW", "loud": 1}}, "jammer"),
        ({"stop": {"definition": "hazard"}}, "no truth"),
        ({"receiver": {}}, r"add \[\[receiver.monitor\]\]"),
    ],
)
def test_what_cannot_be_received_is_refused(recording, change, sentence):
    with pytest.raises((ValueError, OSError), match=sentence) as err:
        from_table(table(recording, **change))
    assert "\n" not in str(err.value)
