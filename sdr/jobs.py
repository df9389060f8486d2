"""The jobs behind the commands: run, simulate, receive, acquire. Each returns the command's JSON object."""

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numba.core.event import TimingListener, install_listener

from nav.sensor_files import write_barometer, write_imu, write_odometer
from nav.steering import Sensors
from sdr import holes, iffile, scenario, toml
from sdr.modes import SideBySide, table
from sdr.modes import draw as draw_modes
from sdr.progress import progress
from sdr.receiver import Outcome, Receiver
from sdr.scenario import ReceiverSpec, Scenario
from sdr.spectrum import EVERY_S, STRONG_DB, Spectrogram
from sdr.store import Store
from sdr.watch.post import report_lines, totals
from signals.geodesy import ecef_to_geodetic
from signals.modulation import SIGNALS
from tracking.acquisition import AcquisitionSpec, lowest_rate_hz, slab_samples
from tracking.acquisition import acquire as search
from tracking.channel import STATE_LOCKED
from tracking.loops import dll_jitter_chips, pll_jitter_cycles

if TYPE_CHECKING:
    from sdr.options import Recording

SILENT_DB = 80.0
"""No converter's noise lies so far below a line: there is none."""
MOST_HOLES = 5
"""Holes in a recording that are listed in words."""
SYSTEM_LETTER = {"L1CA": "G", "E1B": "E", "E1C": "E"}


def run(
    name: str,
    *,
    output: Path | str | None = None,
    overrides: Sequence[str] = (),
    threads: int = 1,
    plots: bool = False,
    quiet: bool = False,
) -> dict[str, Any]:
    """Synthesise the scenario ``name`` and receive it in one stream."""
    spec, text = _scenario(name, overrides, threads)
    source = scenario.source(spec, threads)
    path = Path(output) if output else Path(f"{spec.name}.h5")
    with Store(path, command="run", scenario=text, seed=spec.seed) as store:
        side = (
            SideBySide(spec, Spectrogram(source), scenario.sensors(spec))
            if spec.receiver.steering.compare
            else None
        )
        sensors = scenario.sensors(spec) if spec.receiver.steering.mode == "ultra_tight" else None
        result = _receive(spec.receiver, source, store, spec.name, quiet, sensors, side)
    return _finish(result, path, plots)


def receive(
    file: Path,
    recording: "Recording",
    name: str | None = None,
    *,
    output: Path | str | None = None,
    overrides: Sequence[str] = (),
    threads: int = 1,
    plots: bool = False,
    quiet: bool = False,
    imu: Path | None = None,
    odometer: Path | None = None,
    barometer: Path | None = None,
) -> dict[str, Any]:
    """Receive a recording with the receiver of scenario ``name`` (default: the default receiver)."""
    spec, text = _receiver(name, overrides, threads)
    source = iffile.open_recording(file, iffile.declaration(file, recording))
    path = Path(output) if output else Path.cwd() / (Path(file).stem + ".results.h5")
    with Store(path, command="receive", scenario=text, seed=None) as store:
        sensors = scenario.read_sensors(name, overrides, imu, odometer, barometer, source)
        if sensors is not None and spec.steering.mode != "ultra_tight":
            raise ValueError(
                f'--imu serves the ultra-tight receiver; this one is "{spec.steering.mode}": add '
                "--set receiver.steering.mode=ultra_tight"
            )
        result = _receive(spec, source, store, Path(file).name, quiet, sensors)
    return _finish(result, path, plots)


def simulate(
    name: str, output: Path, *, overrides: Sequence[str] = (), threads: int = 1, quiet: bool = False
) -> dict[str, Any]:
    """Write the scenario's samples as a recording, and the truth in HDF5 beside it."""
    spec, text = _scenario(name, overrides, threads)
    source = scenario.source(spec, threads)
    begin = time.perf_counter()
    base = (
        output.with_suffix("") if output.suffix in (".sigmf-meta", ".sigmf-data", ".bin", ".h5") else output
    )
    truth_path = base.with_name(base.name + ".truth.h5")
    with (
        iffile.create_recording(base, source, spec) as writer,
        Store(truth_path, command="simulate", scenario=text, seed=spec.seed) as store,
        progress(spec.name, source.n_samples, quiet) as advance,
    ):
        truth = _Truth(source, store)
        done = 0
        while done < source.n_samples:
            n0, iq = source.read(round(0.1 * source.fs_hz))
            done = n0 + iq.shape[1]
            writer.write(iq)
            truth.up_to(done)
            if store.due():
                store.checkpoint()
            advance(done)
        truth.up_to(done, last=True)
    elapsed = time.perf_counter() - begin
    files = [str(p) for p in writer.files] + [str(truth_path)] + _write_sensors(spec, base)
    duration_s = source.n_samples / source.fs_hz
    satellites = [
        {"signal": s.signal, "prn": s.prn, "cn0_dbhz": float(s.cn0_dbhz)}
        for s in source.sky.satellites
        if not s.name.endswith("-spoofed")
    ]
    text_out = f"{duration_s:g} s, {source.n_samples} samples, {len(satellites)} satellites, {duration_s / elapsed:.1f} times real time\n"
    return {
        "files": files,
        "samples": source.n_samples,
        "duration_s": duration_s,
        "satellites": satellites,
        "real_time_factor": duration_s / elapsed,
        "text": text_out + "\n".join(f"  {f}" for f in files),
    }


def _write_sensors(spec: Scenario, base: Path) -> list[str]:
    """The scenario's IMU, odometer and barometer as CSV beside its recording."""
    sensors = scenario.sensors(spec)
    if sensors is None:
        return []
    parts: list[tuple[str, Any, Any]] = [
        (".imu.csv", write_imu, sensors.imu),
        (".odo.csv", write_odometer, sensors.odometer),
        (".baro.csv", write_barometer, sensors.barometer),
    ]
    files = []
    for suffix, write, rows in parts:
        if rows is not None:
            files.append(base.with_name(base.name + suffix))
            write(files[-1], rows)
    return [str(f) for f in files]


def acquire(
    file: Path, recording: "Recording", signals: Sequence[str], doppler_hz: float | None, p_fa: float | None
) -> dict[str, Any]:
    """Search the start of a recording for satellites."""
    unknown = [s for s in signals if s not in SIGNALS]
    if unknown:
        raise ValueError(f"signal '{unknown[0]}' is not known; allowed: {', '.join(SIGNALS)}")
    given = {"doppler_range_hz": doppler_hz, "p_fa": p_fa}
    spec = toml.validate(AcquisitionSpec, {k: v for k, v in given.items() if v is not None}, "acquire")
    source = iffile.open_recording(file, iffile.declaration(file, recording))
    signals = [s for s in signals if source.fs_hz >= lowest_rate_hz(s)] or signals
    n = max(slab_samples(s, source.fs_hz, spec) for s in signals)
    n0, iq = _first(source, file, n)
    rows = np.concatenate([search(iq, n0, source.fs_hz, source.if_hz, s, None, spec) for s in signals])
    found = [
        {"signal": r["signal"].decode(), "prn": int(r["prn"])}
        | {k: float(r[k]) for k in ("doppler_hz", "code_phase_chips", "statistic", "threshold", "cn0_dbhz")}
        for r in rows[rows["acquired"]]
    ]
    table = [
        f"{len(found)} of {len(rows)} searched satellites found in {iq.shape[1] / source.fs_hz * 1e3:.0f} ms"
    ]
    table += [
        f"  {r['signal']:5} {r['prn']:3d}  Doppler {r['doppler_hz']:+9.1f} Hz  code {r['code_phase_chips']:8.2f} chips"
        f"  C/N0 {r['cn0_dbhz']:4.1f} dB-Hz  statistic {r['statistic']:.2f} (threshold {r['threshold']:.2f})"
        for r in found
    ]
    return {"satellites": found, "text": "\n".join(table)}


def _first(source: Any, file: Path, n: int) -> tuple[int, np.ndarray]:
    n0, iq = source.read(min(n, source.n_samples))
    if iq.shape[1] == 0:
        raise ValueError(f"'{file}' holds no samples in the part that was asked for")
    return n0, iq


def _scenario(name: str, overrides: Sequence[str], threads: int) -> tuple[Scenario, str]:
    spec, text = scenario.load(
        name, [*overrides, f"receiver.tracking.threads={threads}"] if threads != 1 else overrides
    )
    return spec, text


def _receiver(name: str | None, overrides: Sequence[str], threads: int) -> tuple[ReceiverSpec, str]:
    if threads != 1:
        overrides = [*overrides, f"receiver.tracking.threads={threads}"]
    if name is not None:
        spec, text = scenario.load(name, overrides)
        return spec.receiver, text
    return scenario.receiver_only(overrides)


# -- the common part of run and receive -------------------------------------------------------------------------------


class _Tally:
    """What a run adds up as it goes: for the summary, without keeping the epochs."""

    def __init__(self) -> None:
        self.locked_s: dict[tuple[str, int], float] = {}
        self.fixes: list[np.ndarray] = []
        self.used: dict[str, None] = {}
        self.levels: list[np.ndarray] = []
        self.holes: list[dict[str, float]] = []

    def stanford(self, source: Any, receiver: Receiver) -> dict[str, Any] | None:
        """Counts of the Stanford diagram, horizontal and vertical; None without truth or protection levels."""
        sky = getattr(source, "sky", None)
        if sky is None or not self.levels or not self.fixes:
            return None
        from sdr.errors import stanford_counts

        fixes = np.concatenate(self.fixes)
        true = sky.receiver(fixes["sample_index"] / receiver.fs_hz)
        return stanford_counts(fixes, true["pos_ecef_m"], np.concatenate(self.levels))


def _receive(
    spec: ReceiverSpec,
    source: Any,
    store: Store,
    label: str,
    quiet: bool,
    sensors: Sensors | None = None,
    side: SideBySide | None = None,
) -> dict[str, Any]:
    watched = side.source if side else Spectrogram(source)
    receiver = side.primary if side else Receiver(spec, watched, sensors)
    spectra = {"samples/spectrum": watched}
    if receiver.mitigation:
        receiver.source = spectra["mitigation/spectrum"] = Spectrogram(receiver.mitigation)
    truth = _Truth(source, store)
    tally = _Tally()
    begin, compiling = time.perf_counter(), TimingListener()
    try:
        with (
            progress(label, source.n_samples, quiet) as advance,
            install_listener("numba:compile", compiling),
        ):
            for outcome in receiver:
                _store_outcome(store, receiver, outcome, tally)
                if side:
                    side.follow(outcome)
                for name, passed in spectra.items():
                    store.append(name, passed.rows(), fs_hz=source.fs_hz, if_hz=source.if_hz, every_s=EVERY_S)
                truth.up_to(outcome.n_end)
                if store.due():
                    store.checkpoint()
                advance(outcome.n_end, f"{len(receiver.channel_of)} tracked, {len(tally.fixes)} fixes")
    finally:
        truth.up_to(receiver.position, last=True)
        _store_theory(store, receiver)
        _store_alarms(store, receiver)
    duration_s = receiver.position / receiver.fs_hz
    result: dict[str, Any] = {
        "duration_s": duration_s,
        "real_time_factor": duration_s / (time.perf_counter() - begin),
        "compiling_s": compiling.duration if compiling.done else 0.0,
        "satellites": receiver.satellites(tally.locked_s),
        "monitors": _monitors(receiver, source),
        "protection": tally.stanford(source, receiver),
        "steering": None if receiver.steering is None else receiver.steering.summary(),
        "holes": tally.holes,
    }
    result["monitor_totals"] = totals(result["monitors"])
    if side:
        side.store(store)
        result["modes"] = side.modes()
    result["fix"], result["no_fix_reason"] = _fix(receiver, source, tally), None
    if result["fix"] is None:
        heard = list(spectra.values())[-1]
        why = _why_no_fix(receiver, duration_s, result["satellites"]), _interference(receiver, heard)
        result["no_fix_reason"] = "; ".join(part.rstrip(".") for part in why if part)
    return result


def _interference(receiver: Receiver, heard: Spectrogram) -> str:
    """What the spectrum of the samples that were received has to say of it; empty if nothing."""
    lines_hz, jn_db = heard.lines()
    if jn_db < STRONG_DB:
        return ""
    if jn_db > SILENT_DB:
        return "the samples hold one level and nothing else: the recorder was not running, or the format is another"
    what = f"narrow interference at {lines_hz[0] / 1e3:+.0f} kHz from the carrier"
    if len(lines_hz) > 1:
        what += f" and {len(lines_hz) - 1} more lines"
    kind = "Notch" if len(lines_hz) == 1 else "Excision"
    done = receiver.spec.mitigation
    cure = "receive a complex recording with receiver.mitigation, or filter it before"
    if getattr(receiver.source, "complex", True):
        cure = f'use --set receiver.mitigation={{kind="{kind}"}} (in quotes)'
    if done is not None:
        cure = f"this is what {done.kind} leaves of it; " + (
            cure if done.kind != kind else "no mitigation here takes more"
        )
    return f"there is {what}, {jn_db:.0f} dB over the noise of the whole band: {cure}"


def _store_outcome(store: Store, receiver: Receiver, outcome: Outcome, tally: _Tally) -> None:
    store.append("acquisition", outcome.found)
    if receiver.mitigation:
        store.append("mitigation/tones", receiver.mitigation.tones())
    for row in outcome.found:
        tally.locked_s.setdefault((row["signal"].decode(), int(row["prn"])), 0.0)
    channels = receiver.tracker.channels
    for c, epochs, corr in outcome.epochs:
        signal, prn = channels["signal"][c].decode(), int(channels["prn"][c])
        name = f"tracking/{SYSTEM_LETTER[signal]}{prn:02d}_{signal}"
        store.append(f"{name}/epochs", epochs, signal=signal, prn=prn, fs_hz=receiver.fs_hz)
        taps = receiver.tracker.taps_chips(c)
        store.append(
            f"{name}/corr",
            corr[:, : len(taps)],
            taps_chips=taps,
            waveform=receiver.waveform(signal),
            **_roles(channels[c]),
        )
        locked = epochs["state"] == STATE_LOCKED
        tally.locked_s[signal, prn] += float(epochs["n_samples"][locked].sum()) / receiver.fs_hz
    for name, rows in outcome.statistics:
        store.append(f"monitors/{name}", rows)
    for part in outcome.integrity:
        for name, rows in part.items():
            store.append(f"monitors/{name}", rows)
        if "protection" in part:
            tally.levels.append(part["protection"])
    for rows in outcome.observations:
        store.append("navigation/observations", rows)
    if outcome.steering:
        store.append("navigation/steering", np.concatenate(outcome.steering))
    for rows in outcome.views:
        store.append("navigation/satellites", rows)
    for rows in outcome.holes:
        store.append("navigation/holes", rows)
        tally.holes += holes.told(rows)
    for row in outcome.solutions:
        store.append("navigation/solution", row, fs_hz=receiver.fs_hz, **_leap(receiver))
        if row["valid"][0]:
            tally.fixes.append(row)
            tally.used.update(dict.fromkeys(receiver.navigator.used))


def _leap(receiver: Receiver) -> dict[str, int]:
    """GPS minus UTC, as far as a message said it."""
    rows = [receiver.telemetry.iono_utc(system) for system in ("G", "E")]
    said = [int(row["dt_ls_s"]) for row in rows if row is not None and row["dt_ls_s"]]
    return {"leap_s": said[0]} if said else {}


def _roles(channel: np.void) -> dict[str, int]:
    """Which taps are early, prompt and late; very early and very late only where there are such."""
    roles = {r: int(channel[r]) for r in ("early", "prompt", "late", "very_early", "very_late")}
    return {f"{r}_tap": k for r, k in roles.items() if k >= 0}


class _Truth:
    """Writes the truth of a synthetic source at 10 Hz, a second at a time; a recording has none."""

    def __init__(self, source: Any, store: Store) -> None:
        self._source, self._store = source, store
        self._index = source.truth_index() if hasattr(source, "truth_index") else np.empty(0, np.uint64)

    def up_to(self, sample: int, last: bool = False) -> None:
        ready = self._index[: np.searchsorted(self._index, sample)]
        if len(ready) >= 10 or (last and len(ready)):
            self._store.append("truth/satellites", self._source.truth(ready))
            self._store.append("truth/receiver", self._source.pvt_truth(ready))
            self._store.append("truth/jammers", self._source.jammer_truth(ready))
            self._store.append("truth/echoes", self._source.echo_truth(ready))
            self._store.append("truth/faults", self._source.fault_truth(ready))
            self._index = self._index[len(ready) :]


def _store_theory(store: Store, receiver: Receiver) -> None:
    """Thermal standard deviations at each channel's last C/N0, for the figures."""
    replica = receiver.tracker.snapshot(receiver.position)
    for (signal, prn), c in receiver.channel_of.items():
        loops = receiver.spec.tracking.l1ca if signal == "L1CA" else receiver.spec.tracking.e1
        t_s, cn0 = loops.integration_ms * 1e-3, float(replica["cn0_dbhz"][c])
        now, space = receiver.tracker.channels[c], loops.early_late_space_chips
        if not np.isfinite(cn0) or cn0 < 10.0:
            continue
        store.append(
            f"tracking/{SYSTEM_LETTER[signal]}{prn:02d}_{signal}/epochs",
            np.empty(0),
            phase_sigma_cycles=pll_jitter_cycles(cn0, now["pll_bw_hz"], t_s),
            code_sigma_m=293.05 * dll_jitter_chips(cn0, now["dll_bw_hz"], t_s, space),
        )


def _store_alarms(store: Store, receiver: Receiver) -> None:
    """What waits in the monitors, their thresholds and their alarms, and when they could not watch."""
    for monitor in receiver.monitors:
        for rows in monitor.flush(receiver.position):
            store.append(f"monitors/{monitor.spec.name}", rows)
        for post in monitor.posts:
            store.append("monitors/thresholds", post.watched())
            store.append("monitors/alarms", post.alarms())
            store.append("monitors/unwatched", post.unwatched())


def _monitors(receiver: Receiver, source: Any) -> list[dict[str, Any]]:
    """One row per monitor and channel: threshold, number of tests, alarms; false ones where the jammers are known."""
    starts = [j.n_on / receiver.fs_hz for j in getattr(source, "jammers", ()) if hasattr(j, "n_on")]
    quiet_until_s = min(starts, default=math.inf)
    rows = [row for monitor in receiver.monitors for row in monitor.report(quiet_until_s)]
    return rows + ([] if receiver.integrity is None else receiver.integrity.report())


def _fix(receiver: Receiver, source: Any, tally: _Tally) -> dict[str, Any] | None:
    if not tally.fixes or receiver.drift.inverted:
        return None
    rows = np.concatenate(tally.fixes)
    mean = rows["pos_ecef_m"].mean(axis=0)
    lat_rad, lon_rad, height_m = ecef_to_geodetic(mean[None])
    fix = {
        "first_s": float(rows["t_s"][0]),
        "epochs": len(rows),
        "lat_deg": float(np.degrees(lat_rad[0])),
        "lon_deg": float(np.degrees(lon_rad[0])),
        "height_m": float(height_m[0]),
        "pos_ecef_m": mean.tolist(),
        "used": list(tally.used),
    }
    sky = getattr(source, "sky", None)
    if sky is not None:
        truth = sky.receiver(rows["sample_index"] / receiver.fs_hz)
        error = rows["pos_ecef_m"] - truth["pos_ecef_m"]
        fix["rms_3d_m"] = float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
    return fix


def _why_no_fix(receiver: Receiver, duration_s: float, satellites: list[dict[str, Any]]) -> str:
    if not satellites:
        searched = (
            receiver.searched_text() or "nothing: the recording is shorter than one search, or all zeros"
        )
        return f"no satellite was found; searched {searched}; gnssbb probe shows which declaration of a file fits"
    if receiver.drift.inverted:
        return (
            f"{len(satellites)} satellites were found, but their codes slide against their Dopplers: the spectrum is "
            "inverted; give --conjugate, or leave it out if it was given"
        )
    locked = [s for s in satellites if s["locked_s"] > 0]
    with_ephemeris = [s for s in satellites if s["ephemeris"]]
    if duration_s < 18.0 and not with_ephemeris:
        return (
            f"{len(satellites)} satellites were found and {len(locked)} tracked, but {duration_s:.3g} s are too short: an "
            "ephemeris takes 18 s of GPS or about 25 s of Galileo at the least, from any start up to 30 s and more"
        )
    return f"{len(satellites)} satellites found, {len(locked)} tracked, {len(with_ephemeris)} with ephemeris: {receiver.navigator.reason}"


def _finish(result: dict[str, Any], path: Path, plots: bool) -> dict[str, Any]:
    result["output"] = str(path)
    if plots and result["satellites"]:
        from sdr.plot import plot

        result["figures"] = [str(p) for p in plot(path)]
        if result.get("modes"):
            result["figures"].append(str(draw_modes(path)))
    result["text"] = _summary(result)
    return result


def _summary(result: dict[str, Any]) -> str:
    rows = [f"{result['duration_s']:g} s in {result['real_time_factor']:.1f} times real time"]
    if result["compiling_s"] >= 1.0:
        rows[0] += f"; {result['compiling_s']:.0f} s of it compiled kernels, which are kept for the next run"
    rows.append(f"{'satellite':>10} {'locked (s)':>10} {'Doppler (Hz)':>13} {'C/N0 (dB-Hz)':>13}  message")
    for s in result["satellites"]:
        numbers = (
            f"{s['doppler_hz']:+13.1f} {s['cn0_dbhz']:13.1f}"
            if s["doppler_hz"] is not None
            else f"{'lost':>13} {'':13}"
        )
        health = {True: "healthy", False: "UNHEALTHY", None: ""}[s["healthy"]]
        message = f"ephemeris {health}" if s["ephemeris"] else "none yet"
        rows.append(f"{s['signal']:>6} {s['prn']:3d} {s['locked_s']:10.1f} {numbers}  {message}")
    fix = result["fix"]
    if fix is None:
        rows.append(f"no fix: {result['no_fix_reason']}")
    else:
        error = f", 3D error {fix['rms_3d_m']:.2f} m rms against truth" if "rms_3d_m" in fix else ""
        rows.append(
            f"position {fix['lat_deg']:.7f} deg, {fix['lon_deg']:.7f} deg, {fix['height_m']:.2f} m: {fix['epochs']} fixes "
            f"from {fix['first_s']:.1f} s on with {len(fix['used'])} satellites{error}"
        )
    rows += [holes.sentence(h) for h in result["holes"][:MOST_HOLES]]
    if len(result["holes"]) > MOST_HOLES:
        rows.append(f"and {len(result['holes']) - MOST_HOLES} more holes: navigation/holes of the results")
    rows += report_lines(result["monitors"], result["monitor_totals"])
    if result["steering"]:
        rows.append(_steering_text(result["steering"]))
    if result.get("modes"):
        rows += table(result["modes"])
    rows.append(f"results in {result['output']}")
    rows += [f"  {p}" for p in result.get("figures", [])]
    return "\n".join(rows)


def _steering_text(s: dict[str, Any]) -> str:
    head = f"{s['mode']} ({s['model']}):"
    if s["first_s"] is None:
        return f"{head} never steered: {s['reason']}"
    text = f"{head} from {s['first_s']:.1f} s on, {s['steered_s']:.1f} s with satellites and {s['coasting_s']:.1f} s without"
    return text + (f", let go {s['released']} times, the last at {s['reason']}" if s["released"] else "")
