"""Karaim et al. 2020: scalar, vector and ultra-tight GPS/RISS through 90 s of jamming.

The paper gives neither J/S, C/N0, loop settings, R policy nor geometry. Here J/S is swept on the multi-satellite twin, and the
table is set beside the J/S at which our vector receiver is as bad as the published one; then the three receivers run on
IF samples. Drive: 36 km/h with turns, 8 satellites, C/N0 44 dB-Hz, T 20 ms, 90 s of jamming: from 60 s of 180 s on, where the
table is sought from 180 s of 570 s on, as published. Quick: 6 runs a point instead of 50, without IF samples.

Every part (50 runs of a point, or one run on samples) is a file in ``parts``, named by a digest of its settings: a command
that was stopped goes on where it was.
"""

import hashlib
import os
import sys
import threading
import time
import zipfile
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nav.ultratight import MODES, SteeringSpec
from sdr import uttwin
from sdr.uttwin import EVERY, T_S, Policy, Sky, Trial
from sdr.uttwin import run as run_trial
from signals.jammers import CW, CodeLine, Narrowband

SWEEP_DB = (0, 20, 25, 30, 32.5, 35, 40, 42.5, 45, 47.5, 50, 51, 52.5, 55, 57.5, 60)
TABLE_DB = (50, 51, 52.5)
"""J/S at which the published table is sought."""
QUICK_DB = (0, 20, 30, 40, 45, 50, 55, 60)
SCALAR_DB = (28, 29, 31, 33, 34, 36, 37, 38, 39)
"""J/S at which the scalar receiver is looked at more closely."""
BANDWIDTH_HZ = 2400.0
SETTLED_S = 10.0
RECOVERED_M = 20.0
FIXED_DBHZ = 44.0
SAMPLES_JAM_S = (45.0, 135.0)
SAMPLES_S = 165.0
SAMPLES_SEEDS = 3
NEES_RUNS, NEES_JAM_S, NEES_S, NEES_AT_S = 10, (40.0, 60.0), 60.0, (39.0, 49.0, 59.0)
"""Short runs of the ultra-tight receiver on IF samples, in the 2.4 kHz tone of 45 dB, and when its error is held against its claim."""
LINE_PRN = 8
"""Satellite of the drive whose strongest line the CW hits."""

ITEMS = ("Ve", "Vn", "Vu", "Spd2D", "Spd3D", "East", "North", "Up", "Pos2D", "Pos3D")
RUN = np.dtype(
    [
        ("rms", "f8", (10,)), ("max", "f8", (10,)), ("rms_jam", "f8", (10,)), ("max_jam", "f8", (10,)),
        ("end_2d_m", "f8"), ("n_lost", "i4"), ("no_fix", "f8"), ("nees", "f8", (4,)), ("nis_clean", "f8"), ("nis_jam", "f8"),
    ]
)  # fmt: skip
"""One run of the twin: errors in the order of ITEMS over the whole run (after SETTLED_S) and over the jam, 2D error 30 s after
the jam, satellites lost at its end, share of the jam without a fix, NEES (5 degrees of freedom: position, clock) before
the jam, 30 s and 89 s into it and at the end, NIS over its rows before and in the jam."""
ON_SAMPLES = np.dtype(
    [
        ("mode", "S11"), ("rms_2d_m", "f8"), ("max_2d_m", "f8"), ("rms_jam_2d_m", "f8"), ("max_jam_2d_m", "f8"),
        ("rms_speed_mps", "f8"), ("rms_jam_speed_mps", "f8"), ("n_lost", "i4"), ("n_satellites", "i4"),
        ("recovered_s", "f8"), ("no_fix", "f8"),
    ]
)  # fmt: skip
"""One receiver on IF samples; ``recovered_s`` after the jam, nan: not by the end."""


class Drive(NamedTuple):
    """Length of a run and when it is jammed."""

    span_s: float
    jam_s: tuple[float, float]


SHORT, LONG = Drive(180.0, (60.0, 150.0)), Drive(570.0, (180.0, 270.0))


class Case(NamedTuple):
    """One point of the twin."""

    name: str
    span_s: float
    trial: Trial
    spec: SteeringSpec
    policy: Policy = Policy()
    guarded: bool = True
    """Scalar: lock detectors take channels out of the solution."""


class SamplesCase(NamedTuple):
    """One run on IF samples."""

    name: str
    jammer: Narrowband | CW
    seed: int


class NeesCase(NamedTuple):
    """One short run on IF samples, for consistency."""

    name: str
    jammer: Narrowband
    seed: int


class Size(NamedTuple):
    """How much is run."""

    n_runs: int
    levels: tuple[float, ...]
    scalar_levels: tuple[float, ...]
    table_levels: tuple[float, ...]
    table_drive: Drive


QUICK = Size(6, QUICK_DB, (), (50, 55), SHORT)
WHOLE = Size(50, SWEEP_DB, SCALAR_DB, TABLE_DB, LONG)


# -- what is run ----------------------------------------------------------------------------------------------------


def twin_cases(size: Size) -> list[Case]:
    """Sweep of the three receivers, the scalar one more closely and without lock detectors, variants."""
    cases = []
    for js in size.levels:
        cases += [
            _case(sweep_name(js, m), js, SteeringSpec(mode=m), _drive(js, size)) for m in reversed(MODES)
        ]
    for js in size.scalar_levels:
        if js not in size.levels:
            cases.append(_case(sweep_name(js, "scalar"), js, SteeringSpec(), SHORT))
    for js in size.table_levels:
        drive = size.table_drive
        cases.append(_case(unguarded_name(js), js, SteeringSpec(), drive, guarded=False))
        spec = SteeringSpec(mode="ultra_tight", limit_sigma=0.0)
        cases.append(_case(trusting_name(js), js, spec, drive, policy=FIXED))
    return cases + _variants(size)


def _drive(js_db: float, size: Size) -> Drive:
    return size.table_drive if js_db in size.table_levels else SHORT


def _case(name: str, js_db: float, spec: SteeringSpec, drive: Drive = SHORT, **options) -> Case:
    return Case(name, drive.span_s, Trial(js_db=float(js_db), jam_s=drive.jam_s), spec, **options)


def sweep_name(js_db: float, mode: str) -> str:
    """Name of a point of the sweep."""
    return f"J/S {js_db:g} dB {mode}"


def unguarded_name(js_db: float) -> str:
    """Name of a scalar point without lock detectors."""
    return f"J/S {js_db:g} dB scalar without lock detectors"


def trusting_name(js_db: float) -> str:
    """Name of an ultra-tight point that takes every measurement as if there were no jammer."""
    return f"J/S {js_db:g} dB ultra-tight, R of {FIXED_DBHZ:g} dB-Hz for ever, no innovation limit"


FIXED = Policy(use_gain=False, fixed_dbhz=FIXED_DBHZ)


def _variants(size: Size) -> list[Case]:
    """The ultra-tight receiver without GPS, with other error models and other policies for R; other vector receivers."""
    ut, vt = SteeringSpec(mode="ultra_tight"), SteeringSpec(mode="vector")
    full, paper = (SteeringSpec(mode="ultra_tight", model=kind) for kind in ("ecef17", "riss11"))
    slow = Policy(use_gain=False, fast_s=1.0)
    blocked = Trial(jam_s=SHORT.jam_s, blocked_s=SHORT.jam_s)
    cases = [
        Case("RISS alone, signals blocked", SHORT.span_s, blocked, ut),
        Case("full IMU (17 states) alone, signals blocked", SHORT.span_s, blocked, full),
    ]
    for js in (0, 45, 55):
        cases.append(_case(f"J/S {js} dB, full IMU (17 states)", js, full))
        cases.append(_case(f"J/S {js} dB, RISS 11 states as printed", js, paper))
    for js in (45, 50, 55, 60):
        cases.append(
            _case(f"J/S {js} dB ultra-tight, R of {FIXED_DBHZ:g} dB-Hz for ever", js, ut, policy=FIXED)
        )
        if js not in size.table_levels:
            trusting = ut.model_copy(update={"limit_sigma": 0.0})
            cases.append(_case(trusting_name(js), js, trusting, policy=FIXED))
    for js in (40, 45, 50):
        cases.append(_case(f"J/S {js} dB vector, no gain, C/N0 over 1 s", js, vt, policy=slow))
    skips = Policy(use_gain=False, fast_s=1.0, skip_below_dbhz=17.8)
    return [*cases, _case("J/S 45 dB vector, skips below 17.8 dB-Hz", 45, vt, policy=skips)]


def samples_jammers() -> list[tuple[str, Narrowband | CW]]:
    """The 2.4 kHz tone, a CW on a line, and one swept over +-5 kHz in the 90 s."""
    start, stop = SAMPLES_JAM_S
    times: dict[str, Any] = {"against": "G01", "start_s": start, "stop_s": stop}
    found: list[tuple[str, Narrowband | CW]] = [
        (f"2.4 kHz tone, J/S {js} dB", Narrowband(bandwidth_hz=BANDWIDTH_HZ, js_db=js, **times))
        for js in (30, 45, 50, 55)
    ]
    line = CodeLine(signal="L1CA", prn=LINE_PRN, line="worst")
    found.append(
        (f"CW on the strongest line of G{LINE_PRN:02d}, J/S 45 dB", CW(js_db=45, line=line, **times))
    )
    sweep = CW(js_db=45, freq_hz=-5e3, rate_hz_s=1e4 / (stop - start), **times)
    return [*found, ("CW swept over +-5 kHz, J/S 45 dB", sweep)]


def nees_cases(seed: int) -> list[NeesCase]:
    """NEES_RUNS short runs in the tone of 45 dB."""
    start, stop = NEES_JAM_S
    tone = Narrowband(bandwidth_hz=BANDWIDTH_HZ, js_db=45, against="G01", start_s=start, stop_s=stop)
    return [NeesCase("NEES, 2.4 kHz tone, J/S 45 dB", tone, NEES_RUNS * seed + i) for i in range(NEES_RUNS)]


def samples_cases(seed: int) -> list[SamplesCase]:
    """Every jammer with SAMPLES_SEEDS seeds."""
    return [
        SamplesCase(name, jammer, SAMPLES_SEEDS * seed + i)
        for i in range(SAMPLES_SEEDS)
        for name, jammer in samples_jammers()
    ]


# -- parts ----------------------------------------------------------------------------------------------------------


Results = dict[Any, dict[str, np.ndarray]]
"""Case -> arrays of its part."""


def compute(directory: Path, cases, samples, size: Size, seed: int) -> Results:
    """Every part: read where a file has it, else computed, on two threads (kernels release the interpreter)."""
    directory.mkdir(parents=True, exist_ok=True)
    stop = threading.Event()
    work: list[tuple[Any, Path, Any, tuple]] = []
    for case in cases:
        path = directory / _file_name(case.name, (case, size.n_runs, seed))
        work.append((case, path, twin_part, (case, size, seed, stop)))
    for one in samples:
        part = nees_part if isinstance(one, NeesCase) else samples_part
        work.append((one, directory / _file_name(one.name, one), part, (one, stop)))
    kept = {case: arrays for case, path, _, _ in work if (arrays := _read(path)) is not None}
    todo = [w for w in work if w[0] not in kept]
    if kept:
        _say(f"{len(kept)} of {len(work)} parts are in {directory}")
    began, results = time.monotonic(), dict(kept)
    with ThreadPoolExecutor(min(2, os.cpu_count() or 1)) as pool:
        try:
            running = {pool.submit(_keep, path, f, a): (case, path) for case, path, f, a in todo}
            for n, done in enumerate(as_completed(running), 1):
                case = running[done][0]
                results[case] = done.result()
                left = (time.monotonic() - began) / n * (len(todo) - n) / 60
                _say(f"{len(kept) + n} of {len(work)}: {case.name}; about {left:.0f} min left")
        except BaseException:
            stop.set()
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return results


def _say(text: str) -> None:
    print(f"karaim2020: {text}", file=sys.stderr, flush=True)


def _file_name(name: str, settings: Any) -> str:
    digest = hashlib.sha256(repr(settings).encode()).hexdigest()[:12]
    slug = "".join(c if c.isalnum() else "-" for c in name)
    return f"{slug[:60]}-{digest}.npz"


def _read(path: Path) -> dict[str, np.ndarray] | None:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {k: file[k] for k in file.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return None


def _keep(path: Path, function, arguments) -> dict[str, np.ndarray]:
    """Compute a part and put its file in place whole."""
    arrays = function(*arguments)
    half = path.with_suffix(".part")
    with half.open("wb") as file:
        np.savez(file, **arrays)
    os.replace(half, path)
    return arrays


class Stopped(Exception):
    """A part was given up because another failed or the command was interrupted."""


def twin_part(case: Case, size: Size, seed: int, stop=None) -> dict[str, np.ndarray]:
    """``runs`` (n_runs,) RUN of one case; trial i has the seed (seed, spawn_key (crc32 of the name, i))."""
    rows, point = [], zlib.crc32(case.name.encode())
    for i in range(size.n_runs):
        if stop is not None and stop.is_set():
            raise Stopped
        sequence = np.random.SeedSequence(seed, spawn_key=(point, i))
        rows.append(measure(run_trial(sky(case.span_s), case.trial, case.spec, sequence, case.policy, case.guarded),
                            case.trial.jam_s))  # fmt: skip
    return {"runs": np.array(rows, RUN)}


_SKY = threading.Lock()


def sky(span_s: float) -> Sky:
    """Geometry of the drive, made once."""
    with _SKY:
        return _sky(span_s)


@lru_cache(maxsize=2)
def _sky(span_s: float) -> Sky:
    return Sky(span_s, uttwin.drive(span_s).start(span_s))


def measure(out: np.ndarray, jam_s: tuple[float, float]) -> np.void:
    """RUN of one trial's output (epochs, N_OUT)."""
    e, n, u, ve, vn, vu = (out[:, i] for i in range(6))
    v2, p2 = np.hypot(ve, vn), np.hypot(e, n)
    q = np.stack([ve, vn, vu, v2, np.hypot(v2, vu), e, n, u, p2, np.hypot(p2, u)], axis=1)
    t = (np.arange(len(out)) + 1) * T_S * EVERY
    at = lambda x: int(np.argmin(np.abs(t - min(x, t[-1]))))  # noqa: E731
    whole, jam = t > SETTLED_S, (t > jam_s[0]) & (t <= jam_s[1])
    clean = whole & (t <= jam_s[0])
    row = np.zeros(1, RUN)[0]
    with np.errstate(all="ignore"):
        for suffix, mask in (("", whole), ("_jam", jam)):
            fixed = q[mask & np.isfinite(p2)]
            row["rms" + suffix] = np.sqrt(np.mean(fixed**2, axis=0)) if len(fixed) else np.nan
            row["max" + suffix] = np.max(np.abs(fixed), axis=0) if len(fixed) else np.nan
        row["nis_clean"] = np.mean(out[clean, 9]) / np.mean(out[clean, 10])
        row["nis_jam"] = np.mean(out[jam, 9]) / np.mean(out[jam, 10])
    row["end_2d_m"] = p2[at(jam_s[1] + 30.0)]
    row["n_lost"] = out[0, 11] - out[at(jam_s[1]), 11]
    row["no_fix"] = np.mean(~np.isfinite(p2[jam]))
    row["nees"] = out[[at(jam_s[0] - 1.0), at(jam_s[0] + 30.0), at(jam_s[1] - 1.0), at(t[-1])], 8]
    return row


# -- IF samples -----------------------------------------------------------------------------------------------------


def samples_scenario(jammer: Narrowband | CW, seed: int, duration_s: float | None = None):
    """The built-in drive with another jammer (SAMPLES_S, 90 s of it) and turns throughout."""
    from sdr import scenario

    spec = scenario.load("drive-jam")[0]
    place = {k: getattr(spec.motion, k) for k in ("lat_deg", "lon_deg", "height_m")}
    span_s = duration_s or SAMPLES_S
    changes = {
        "seed": seed,
        "duration_s": span_s,
        "motion": uttwin.drive(span_s, **place),
        "jammer": (jammer,),
    }
    return spec.model_copy(update=changes)


def samples_part(case: SamplesCase, stop=None) -> dict[str, np.ndarray]:
    """``receivers`` (3,) ON_SAMPLES, and each receiver's TRACK: three receivers side by side, see ``sdr.modes``."""
    from sdr import scenario
    from sdr.modes import SideBySide

    spec = samples_scenario(case.jammer, case.seed)
    side = SideBySide(spec, scenario.source(spec), scenario.sensors(spec))
    for outcome in side.primary:
        if stop is not None and stop.is_set():
            raise Stopped
        side.follow(outcome)
    tracks, numbers = side.tracks(), side.modes()
    rows = [_receiver(mode, tracks[mode], numbers[mode]) for mode in tracks]
    return {"receivers": np.array(rows, ON_SAMPLES), **tracks}


def nees_part(case: NeesCase, stop=None) -> dict[str, np.ndarray]:
    """``nees`` (3,): e' P^-1 e of the position (3 degrees of freedom) at NEES_AT_S, of the ultra-tight receiver alone."""
    from sdr import scenario
    from sdr.receiver import Receiver

    spec = samples_scenario(case.jammer, case.seed, NEES_S)
    source = scenario.source(spec)
    steering = spec.receiver.steering.with_mode("ultra_tight")
    receiver = Receiver(
        spec.receiver.model_copy(update={"steering": steering}), source, scenario.sensors(spec)
    )
    found = []
    for outcome in receiver:
        if stop is not None and stop.is_set():
            raise Stopped
        found += outcome.solutions
    rows = np.concatenate(found)
    at = rows[np.argmin(np.abs(rows["t_s"][:, None] - np.array(NEES_AT_S)), axis=0)]
    error = at["pos_ecef_m"] - source.sky.receiver(at["t_s"])["pos_ecef_m"]
    return {"nees": np.einsum("ei,eij,ej->e", error, np.linalg.inv(at["cov_ecef_m2"]), error)}


def _receiver(mode: str, track: np.ndarray, numbers: dict) -> tuple:
    jam = track[(track["t_s"] > SAMPLES_JAM_S[0]) & (track["t_s"] <= SAMPLES_JAM_S[1])]
    rms = lambda x: float(np.sqrt(np.mean(x**2)))  # noqa: E731
    back = numbers["recovered_s"]
    return (
        mode.encode(), numbers["rms_2d_m"], numbers["max_2d_m"], numbers["rms_jam_2d_m"], jam["error_2d_m"].max(),
        numbers["rms_speed_mps"], rms(jam["error_speed_mps"]), numbers["satellites_lost"],
        numbers["satellites"],
        np.nan if back is None else back, np.mean(~jam["valid"]),
    )  # fmt: skip


# -- effective Q ----------------------------------------------------------------------------------------------------


def effective_q(prn: int, doppler_hz, freq_hz, bandwidth_hz: float = BANDWIDTH_HZ) -> float:
    """Q of C/N0_eff = 1 / (1/C/N0 + (J/S) / (Q R_c)) in dB, mean interference over the given instants.

    Lines of the received code stand at f_d + k / 1 ms, |c_k|^2 of the power in each. A jammer of flat density in B around
    ``freq_hz`` (from L1): 1/Q = R_c / B sum |c_k|^2 over the lines inside; ``bandwidth_hz`` 0, a CW integrated over T:
    1/Q = R_c T sum |c_k|^2 sinc^2((f - f_k) T) (Betz 2001, with a line spectrum). inf where no line lies inside.
    """
    import math

    from signals.constants import CHIP_RATE_HZ
    from tracking.correlator_model import code_spectrum

    f = np.atleast_1d(np.asarray(freq_hz, float) - np.asarray(doppler_hz, float))
    reach = max(3, round(bandwidth_hz / 1e3))
    k = np.round(f / 1e3).astype(int)[:, None] + np.arange(-reach, reach + 1)
    off = f[:, None] - 1e3 * k
    power = np.abs(code_spectrum("L1CA", prn, k)) ** 2
    share = (
        (np.abs(off) < 0.5 * bandwidth_hz) / bandwidth_hz if bandwidth_hz else T_S * np.sinc(off * T_S) ** 2
    )
    inverse = CHIP_RATE_HZ * float(np.mean(np.sum(power * share, axis=1)))
    return math.inf if inverse == 0.0 else -10 * math.log10(inverse)


def effective_qs() -> Iterator[tuple[str, str, float]]:
    """(jammer, satellite, Q in dB) on the drive of the IF samples, mean over the jam."""
    from sdr import scenario
    from signals.constants import F_L1_HZ

    jammers = [j for j in samples_jammers() if not j[0].startswith("2.4") or "45" in j[0]]
    source = scenario.source(samples_scenario(jammers[0][1], 0))
    t = np.arange(SAMPLES_JAM_S[0], SAMPLES_JAM_S[1], 0.05)
    doppler = -F_L1_HZ * source.sky.propagate(t).phase_delay_rate_s_s
    names = [s.name for s in source.sky.satellites]
    for name, jammer in jammers:
        if isinstance(jammer, Narrowband):
            freq, width = np.zeros(t.size), jammer.bandwidth_hz
        elif jammer.line is None:
            freq, width = jammer.freq_hz + jammer.rate_hz_s * (t - t[0]), 0.0
        else:
            hit = doppler[names.index(f"G{jammer.line.prn:02d}")]
            freq, width = hit + jammer.line.freq_hz() * (1.0 + hit / F_L1_HZ), 0.0
        for s, f in zip(source.sky.satellites, doppler):
            # Lines of a code that comes in at another rate stand wider by as much.
            yield name, s.name, effective_q(s.prn, f * (1.0 + freq / F_L1_HZ), freq, width)
