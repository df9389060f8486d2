"""Campaigns: the same counts whatever happened on the way; stop rules; refusals."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from monitors.detection import clopper_pearson
from sdr import store
from sdr.campaign import crew, results, run, tally, trials
from sdr.campaign.load import from_table, load
from sdr.campaign.spec import THRESHOLD, TRIAL
from sdr.campaign.tally import PointCount
from sdr.campaign.trials import evaluate_trials, quiet_statistics

TABLE = {
    "name": "small",
    "p_fa": 1e-2,
    "twin": {"signal": "L1CA", "prn": 6, "cn0_dbhz": 40.5, "integration_s": 0.02},
    "jammer": {"kind": "CW", "offset_hz": -20.0, "rate_hz_s": 2.0},
    "monitor": [
        {"name": "fft", "detector": {"kind": "FFT"}},
        {"name": "glrt", "rule": "analytic", "detector": {"kind": "GLRT"}},
        {"name": "ar", "rule": "gaussian", "detector": {"kind": "AR", "hop_s": 1.0}},
    ],
    "grid": {"jammer": {"js_db": [0.0, 4.0]}, "twin.prn": [6, 10]},
    "trial": {"epochs": 500, "settle_epochs": 100},
    "training": {"trials": 3, "epochs": 3000},
    "threshold": {"trials": 10, "epochs": 2500},
    "stop": {"max_trials": 24, "errors": 500, "min_trials": 3},
}
SUMMARY = (
    "point",
    "monitor",
    "k",
    "n",
    "rate",
    "ci_low",
    "ci_high",
    "n_effective",
    "trials",
    "stop_reason",
    "threshold",
)


def table(**changes):
    return json.loads(json.dumps(TABLE)) | changes


def write(path, content):
    """A table as TOML: JSON values are TOML values but for inline tables, which get their own notation."""

    def value(v):
        if isinstance(v, dict):
            return "{" + ", ".join(f"{json.dumps(k)} = {value(x)}" for k, x in v.items()) + "}"
        if isinstance(v, list):
            return "[" + ", ".join(map(value, v)) + "]"
        return json.dumps(v)

    def nested(k, v):
        return f"{k} = {value(v)}" if "." not in k else f'"{k}" = {value(v)}'

    path.write_text("\n".join(nested(k, v) for k, v in content.items()), encoding="utf-8")
    return str(path)


def contents(path):
    with store.read(path) as h5:
        assert h5.attrs["complete"]
        return {n: h5[f"campaign/{n}"][:] for n in ("trials", "rates", "points", "thresholds")}


def same(a, b):
    for n in a:
        for field in a[n].dtype.names:
            x, y = a[n][field], b[n][field]
            assert x.tobytes() == y.tobytes(), (
                n,
                field,
                np.flatnonzero(x != y)[:5],
                x[x != y][:5],
                y[x != y][:5],
            )
    return True


def environment():
    return os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[1])}


def command(file, out, *more):
    return [sys.executable, "-m", "sdr", "campaign", file, "-o", str(out), "--json", *more]


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """The campaign run once, with one worker and nothing in its way."""
    base = tmp_path_factory.mktemp("campaign")
    file = write(base / "small.toml", TABLE)
    out = base / "one.h5"
    result = run.run(file, output=out, workers=1, quiet=True)
    return file, result, contents(out)


def test_points_carry_counts_intervals_and_reasons(reference):
    _, result, stored = reference
    assert result["complete"] and len(result["points"]) == 4 * 3
    for row in result["points"]:
        assert set(SUMMARY) <= set(row)
        assert row["ci_low"] <= row["rate"] <= row["ci_high"]
        assert row["stop_reason"] in ("errors", "precision", "max_trials")
        assert 0 <= row["k"] <= row["n"]
    weak, strong = (r for r in result["points"] if r["monitor"] == "fft" and r["axes"]["twin.prn"] == 6)
    assert weak["rate"] > strong["rate"]
    assert len(stored["trials"]) == 3 * result["trials"]
    json.dumps(result, allow_nan=False)
    # Known thresholds are shared by points that differ in the jammer alone.
    assert sorted(set(stored["thresholds"]["group"].tolist())) == [0, 1]


def test_workers_do_not_matter(reference, tmp_path):
    file, _, expected = reference
    run.run(file, output=tmp_path / "two.h5", workers=2, quiet=True)
    assert same(contents(tmp_path / "two.h5"), expected)


def test_a_trial_is_a_function_of_its_seed(reference):
    c = from_table(TABLE)
    limits = np.zeros(3, THRESHOLD)
    limits["threshold"] = 3.0, 10.0, 1.0
    together = evaluate_trials(c.text, 2, 4, 3, limits)
    alone = evaluate_trials(c.text, 2, 6, 1, limits)
    assert together[-3:].tobytes() == alone.tobytes()
    assert together[0]["cn0_dbhz"] != together[3]["cn0_dbhz"]


def test_the_three_sets_share_no_trial(reference):
    c = from_table(TABLE)
    draws = {
        s: trials._quiet_corr(c, 0, getattr(c.spec.seeds, s), 0, 10)
        for s in ("training", "threshold", "evaluation")
    }
    assert not np.array_equal(draws["training"], draws["threshold"])
    assert not np.array_equal(draws["threshold"], draws["evaluation"])
    # The evaluation seed does not touch what the threshold set gives, nor the reverse.
    other = from_table(table(seeds={"evaluation": 77}))
    a, b = (quiet_statistics(x.text, 0, 0, 1) for x in (c, other))
    assert all(np.array_equal(p, q) for p, q in zip(a[0], b[0]))
    with pytest.raises(ValueError, match="must all differ"):
        from_table(table(seeds={"training": 3}))


def test_killed_again_and_again_it_ends_the_same(reference, tmp_path):
    """SIGKILL whenever the journal has grown: torn tails, open chunks and half-written results included."""
    file, _, expected = reference
    out, journal = tmp_path / "killed.h5", tmp_path / "killed.h5.journal"
    grown, kills = 0, 0
    for _ in range(4):
        p = subprocess.Popen(
            command(file, out, "--workers", "2"), env=environment(), stdout=subprocess.DEVNULL
        )
        deadline = time.monotonic() + 120
        while p.poll() is None and time.monotonic() < deadline:
            size = journal.stat().st_size if journal.exists() else 0
            if size > grown + 8000:
                p.send_signal(signal.SIGKILL)
                kills += 1
                break
            time.sleep(0.002)
        p.wait()
        if not journal.exists():
            break
        grown = journal.stat().st_size
    assert kills >= 2
    if journal.exists():
        with journal.open("r+b") as f:  # and a torn last record
            f.truncate(grown - 11)
    before = results.Results(load(file), out)
    with before:
        kept = before.resumed
    result = json.loads(
        subprocess.run(command(file, out), env=environment(), stdout=subprocess.PIPE, check=True).stdout
    )
    assert kept > 0 and result["resumed_trials"] == kept
    assert same(contents(out), expected)
    assert not journal.exists()
    # Asked once more, it answers from the file.
    again = run.run(file, output=out, quiet=True)
    assert again["points"] == result["points"]


def test_a_trial_that_came_before_its_turn_is_kept(reference, tmp_path):
    """Chunks end in any order: one that a kill left waiting for an earlier one is not run again, nor counted yet."""
    file, _, expected = reference
    trials = expected["trials"]
    later = trials[(trials["point"] == 0) & (trials["trial"] == 1)]
    with results.Results(load(file), tmp_path / "ahead.h5") as begun:
        begun.keep(later)
    with results.Results(load(file), tmp_path / "ahead.h5") as again:
        assert again.resumed == 1 and again.counts[0].done == 0 and again.counts[0].has(1)


def test_a_worker_that_dies_is_replaced(reference, tmp_path):
    file, _, expected = reference
    out = tmp_path / "died.h5"
    p = subprocess.Popen(command(file, out, "--workers", "2"), env=environment(), stdout=subprocess.DEVNULL)
    killed = False
    while p.poll() is None:
        journal = tmp_path / "died.h5.journal"
        if not killed and journal.exists() and journal.stat().st_size > 4000:
            worker = _workers_of(p.pid)
            if worker:
                os.kill(worker[-1], signal.SIGKILL)
                killed = True
        time.sleep(0.005)
    assert killed and p.returncode == 0
    assert same(contents(out), expected)


def _workers_of(pid):
    """Children of the process's fork server: /proc only."""
    parents = {}
    for name in os.listdir("/proc"):
        if name.isdigit():
            try:
                with open(f"/proc/{name}/stat") as f:
                    parents[int(name)] = int(f.read().rsplit(")", 1)[1].split()[1])
            except OSError:
                continue
    mine = [c for c, p in parents.items() if p == pid]
    return sorted(c for c, p in parents.items() if p in mine)


# -- stop rules ---------------------------------------------------------------------------------------------------


def counter(**stop):
    c = from_table(
        table(stop=stop, monitor=TABLE["monitor"][:1], grid={}, jammer={"kind": "CW", "js_db": 3.0})
    )
    return PointCount(c, 0)


def rows(trial, k, n=100):
    r = np.zeros(1, TRIAL)
    r["trial"], r["hit_missed"], r["hit_n"] = trial, k, n
    return r


def test_stop_rules_are_evaluated_in_trial_order():
    errors = [0, 3, 1, 5, 9, 2, 2, 2]
    orders = [list(range(8)), [7, 3, 5, 1, 6, 0, 2, 4], [4, 0, 1, 2, 3, 5, 6, 7]]
    ends = []
    for order in orders:
        c = counter(max_trials=8, errors=9)
        for t in order:
            c.add(rows(t, errors[t]))
            c.add(rows(t, errors[t]))  # twice is once
        ends.append((c.done, c.reason, sum(int(r["hit_missed"][0]) for r in c.rows)))
    assert ends == [(4, "errors", 9)] * 3


def test_stop_at_the_precision_that_the_trials_have():
    """Independent tests: the standard error of k / n is sqrt(p (1 - p) / n)."""
    rng = np.random.default_rng(5)
    c = counter(max_trials=10_000, relative_error=0.05)
    t = 0
    while c.reason is None:
        c.add(rows(t, rng.binomial(100, 0.2)))
        t += 1
    assert c.reason == "precision"
    n = 100 * c.done
    # (1 - p) / (p n) = 0.05^2 -> n = 1600; the estimate of the error is itself 20 % loose there.
    assert 1000 < n < 3000
    # Trials that are all of one piece need as many trials as independent tests would.
    d = counter(max_trials=10_000, relative_error=0.05)
    t = 0
    while d.reason is None:
        d.add(rows(t, 100 * int(rng.random() < 0.2)))
        t += 1
    assert d.done > 1000


def test_no_errors_is_a_bound():
    c = counter(max_trials=40)
    for t in range(40):
        c.add(rows(t, 0, 1))
    r = tally.point_rate(np.zeros(40, int), np.ones(40, int), 0)
    assert c.reason == "max_trials" and (r.low, r.high) == clopper_pearson(0, 40)
    assert r.high > 0.08


def test_whole_jammers_are_an_axis():
    """Kinds differ in their keys: each value of the axis is a jammer of its own, and the points differ by it alone."""
    cw, noise = {"kind": "CW", "js_db": 6.0}, {"kind": "NBI", "js_db": 6.0, "bandwidth_hz": 1e4}
    c = from_table(table(jammer={}, grid={"jammer": [cw, noise]}))
    kinds = [p.jammers[0].kind for p in c.points]
    assert kinds == ["CW", "NBI"] and c.group == [0, 0]
    assert c.points[1].jammers[0].bandwidth_hz == 1e4


# -- refusals -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"grid": {"jammer.js_db": []}}, "an axis is a list of one value or more"),
        ({"grid": {"jammer.js_db": 3.0}}, "an axis is a list"),
        ({"grid": {"monitor.kind": ["FFT"]}}, "starts with twin. or jammer."),
        ({"grid": {"jammer.bandwidth_hz": [100.0], "jammer.js_db": [1.0]}}, "bandwidth_hz"),
        ({"grid": {"jammer.js_db": [1.0, 1.0]}}, "repeats an earlier one"),
        ({"grid": {"jammer.power_dbw": [-155.0]}}, "needs signal_dbw"),
        ({"grid": {"twin.prn": [6, 999], "jammer.js_db": [1.0]}}, "999"),
        (
            {
                "grid": {
                    "jammer.js_db": list(range(200)),
                    "twin.prn": list(range(1, 32)),
                    "twin.dll_bandwidth_hz": [1, 2, 3, 4],
                }
            },
            "at most 20000",
        ),
        ({"p_fa": 0.7}, "less than 0.5"),
        ({"name": "../elsewhere"}, "name"),
        ({"requirement": "APV-II", "p_fa": None}, "APV-II has no published P_FA"),
        ({"stop": {"max_trails": 3}}, "max_trails"),
        ({"twin": TABLE["twin"] | {"integration_s": 0.1}}, "vectors"),  # AR with 30 vectors in 3 s
    ],
)
def test_what_cannot_be_run_is_refused(change, sentence):
    with pytest.raises(ValueError, match=sentence) as err:
        from_table(table(**change))
    assert "\n" not in str(err.value)


def test_p_fa_beyond_the_training_says_how_much_it_needs(tmp_path):
    monitor = [{"name": "fft", "rule": "empirical", "detector": {"kind": "FFT"}}]
    file = write(tmp_path / "c.toml", table(p_fa=1e-5, monitor=monitor, grid={"jammer.js_db": [3.0]}))
    with pytest.raises(ValueError, match="at least 1000000 independent training epochs") as err:
        run.run(file, output=tmp_path / "c.h5", workers=1, quiet=True)
    assert "'fft'" in str(err.value)


def test_results_of_another_campaign_or_version_are_left_alone(reference, tmp_path, monkeypatch):
    file, _, _ = reference
    out = tmp_path / "mine.h5"
    other = write(tmp_path / "other.toml", table(p_fa=2e-2))
    with results.Results(load(file), out) as r:
        r.write()
    size = out.stat().st_size
    with pytest.raises(ValueError, match="another campaign"):
        run.run(other, output=out, workers=1, quiet=True)
    monkeypatch.setattr(results, "version", lambda: "99.0")
    with pytest.raises(ValueError, match="not mixed"):
        run.run(file, output=out, workers=1, quiet=True)
    assert out.stat().st_size == size


def test_two_at_once_on_one_file_are_refused(reference, tmp_path):
    file, _, _ = reference
    out = tmp_path / "busy.h5"
    with (
        results.Results(load(file), out),
        pytest.raises(ValueError, match="another campaign is writing"),
    ):
        results.Results(load(file), out).__enter__()


def test_a_scheduler_that_is_not_there(reference, tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    file, _, _ = reference
    monkeypatch.setattr(crew, "CONNECT_S", 1.0)
    with pytest.raises(OSError, match=r"scheduler 'tcp://127\.0\.0\.1:9' cannot be reached"):
        run.run(file, output=tmp_path / "x.h5", scheduler="tcp://127.0.0.1:9", quiet=True)


# -- a real cluster on loopback -----------------------------------------------------------------------------------


def _start(*arguments):
    return subprocess.Popen(
        [sys.executable, "-m", "distributed.cli." + arguments[0], *arguments[1:]],
        env=environment() | {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "3"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


@pytest.fixture
def cluster(tmp_path):
    """A scheduler and two workers, each a process of its own."""
    pytest.importorskip("distributed")
    note = tmp_path / "scheduler.json"
    scheduler = _start(
        "dask_scheduler",
        "--host",
        "127.0.0.1",
        "--port",
        "0",
        "--no-dashboard",
        "--scheduler-file",
        str(note),
    )
    processes = [scheduler]
    try:
        deadline = time.monotonic() + 60
        address = None
        while address is None and time.monotonic() < deadline:
            time.sleep(0.05)
            with contextlib.suppress(
                FileNotFoundError, json.JSONDecodeError
            ):  # not there yet, or half written
                address = json.loads(note.read_text())["address"]
        processes += [
            _start("dask_worker", address, "--no-nanny", "--nthreads", "1", "--no-dashboard", "--host", "127.0.0.1",
                   "--local-directory", str(tmp_path / f"w{i}"), "--death-timeout", "60")
            for i in range(2)
        ]  # fmt: skip
        yield address, processes
    finally:
        for p in processes:
            p.kill()
            p.wait()


def test_a_cluster_gives_the_same_though_a_worker_is_killed(reference, cluster, tmp_path):
    file, _, expected = reference
    address, processes = cluster
    out, journal = tmp_path / "cluster.h5", tmp_path / "cluster.h5.journal"
    p = subprocess.Popen(
        command(file, out, "--scheduler", address), env=environment(), stdout=subprocess.DEVNULL
    )
    killed = False
    while p.poll() is None:
        if not killed and journal.exists() and journal.stat().st_size > 6000:
            processes[1].send_signal(signal.SIGKILL)
            killed = True
        time.sleep(0.005)
    assert p.returncode == 0, p.stderr.read().decode()
    assert killed
    assert same(contents(out), expected)


def test_a_scheduler_that_dies_leaves_what_was_counted(reference, cluster, tmp_path):
    file, _, expected = reference
    address, processes = cluster
    out, journal = tmp_path / "lost.h5", tmp_path / "lost.h5.journal"
    p = subprocess.Popen(
        command(file, out, "--scheduler", address), env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )  # fmt: skip
    while p.poll() is None:
        if journal.exists() and journal.stat().st_size > 12_000:
            for q in processes:
                q.send_signal(signal.SIGKILL)
            break
        time.sleep(0.005)
    _, errors = p.communicate(timeout=120)
    assert p.returncode == 2, errors.decode()
    assert errors.decode().count("\n") == 1 and "was lost; what was counted stays in" in errors.decode()
    result = run.run(file, output=out, workers=1, quiet=True)
    assert result["resumed_trials"] > 0
    assert same(contents(out), expected)
