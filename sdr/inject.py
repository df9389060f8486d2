"""Injection: jammers and echoes of a scenario added to a recording, with truth.

The recording is scaled to unit noise per component, the jammers are added at their exact J/N0, and the sum goes through
the gain control and the quantiser of the recording's own format (or of the scenario's, where it states another number
of bits). The recording's power per component stands for its noise: satellites lie below it. J/S needs S, which is
estimated by acquisition: its interval is reported. An echo is one of all that was recorded, noise included: a
delayed copy of everything.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sdr import iffile, scenario
from sdr.jobs import _progress
from sdr.scenario import Scenario
from sdr.store import Store
from signals.frontend import FrontEnd, FrontEndSpec
from signals.jammers import JammerRun
from signals.multipath import EchoRun
from tracking.acquisition import AcquisitionSpec, acquire, slab_samples

if TYPE_CHECKING:
    from sdr.__main__ import Recording

SLAB = 1 << 18
POWER_S = 1.0
"""The noise power is taken from so much of the recording's beginning."""
HALF_TAPS = 24
"""Half length of the filter that delays by fractions of a sample."""
BITS = {"ci1": 1, "ci2": 2, "ci2tc": 2, "raw8": 2, "ci8": 8, "cu8": 8, "ci16": 16, "cf32": 32}


def inject(
    file: Path,
    recording: "Recording",
    name: str,
    output: Path,
    *,
    overrides: Sequence[str] = (),
    quiet: bool = False,
) -> dict[str, Any]:
    """Add the jammers and echoes of scenario ``name`` to a recording -> JSON object."""
    spec, text = scenario.load(name, overrides)
    if not spec.jammer and spec.multipath is None:
        raise ValueError(
            f"scenario '{spec.name}' has neither jammer nor multipath: there is nothing to inject"
        )
    source = iffile.open_recording(file, iffile.declaration(file, recording))
    if not source.complex:
        raise ValueError(f"'{file}' holds real samples: injection works on complex ones")
    base = output.with_suffix("") if output.suffix in (".sigmf-meta", ".sigmf-data", ".bin") else output
    if Path(f"{base}.sigmf-data").resolve() == source.declared.data.resolve():
        raise ValueError(f"'{output}' is the recording itself: give another output")
    noise_rms = _noise_rms(source, file)
    satellites = _against(spec, source, file)
    duration_s = source.n_samples / source.fs_hz
    runs = _jammers(spec, source, duration_s, satellites)
    echoes = (
        None if spec.multipath is None else spec.multipath.start(scenario._child(spec, scenario.MULTIPATH))
    )
    bits = BITS.get(source.format.name, 8)
    front = FrontEndSpec(
        fs_hz=source.fs_hz, if_hz=source.if_hz, bits=bits, agc=spec.front_end.agc if bits < 32 else None
    )
    front_end = front.start(math.sqrt(1.0 + sum(r.rms**2 for r in runs)))
    extra = {"gnss:bits": bits, "gnss:injected": spec.name}
    annotations = [a for r in runs for a in r.annotations(source.fs_hz, source.n_samples)]
    fmt = {1: "ci1", 2: "ci2", 16: "ci16", 32: "cf32"}.get(bits, "ci8")
    truth_path = base.with_name(base.name + ".truth.h5")
    with (
        iffile.RecordingWriter(
            base,
            fmt,
            source.fs_hz,
            source.if_hz,
            source.start,
            f"{file.name} with {spec.name}",
            annotations,
            extra,
        ) as writer,
        Store(truth_path, command="inject", scenario=text, seed=spec.seed) as store,
        _progress(spec.name, source.n_samples, quiet) as advance,
    ):
        _stream(source, noise_rms, runs, echoes, front_end, writer, advance)
        index = np.arange(0, source.n_samples, max(round(0.1 * source.fs_hz), 1)).astype(np.uint64)
        for place, run in enumerate(runs):
            store.append("truth/jammers", run.truth(index, place))
        if echoes is not None:
            gain, delay_s = echoes.series(0.0, 0.1, max(int(duration_s / 0.1), 1))
            store.append("truth/echo_gain", np.ascontiguousarray(gain.T))
            store.append("truth/echo_delay_s", np.ascontiguousarray(delay_s.T))
    table = [_row(k, run, satellites, source.fs_hz) for k, run in enumerate(runs)]
    files = [str(p) for p in writer.files] + [str(truth_path)]
    return {
        "files": files, "samples": writer.n_samples, "noise_rms_lsb": noise_rms, "jammers": table,
        "text": "\n".join([*(_line(r) for r in table), *(f"  {f}" for f in files)]),
    }  # fmt: skip


def _noise_rms(source: Any, file: Path) -> float:
    _, iq = source.read_at(0, min(round(POWER_S * source.fs_hz), source.n_samples))
    rms = float(np.sqrt(np.mean(iq.astype(np.float64) ** 2)))
    if rms == 0.0:
        raise ValueError(f"'{file}' begins with {POWER_S:g} s of zeros: its noise level is not known")
    return rms


def _against(spec: Scenario, source: Any, file: Path) -> dict[str, tuple[float, float]]:
    """C/N0 and its standard deviation of the satellites that powers refer to, by acquisition at the beginning.

    The estimate's relative deviation is that of a power of C/N0 T over noise in T: sqrt(2 / (C/N0 T) + ..) of first
    order, T the samples that were searched.
    """
    out = {}
    search = AcquisitionSpec()
    for name in {j.against for j in spec.jammer if j.against}:
        signal = "L1CA" if name[0] == "G" else "E1C"
        n0, iq = source.read_at(0, min(slab_samples(signal, source.fs_hz, search), source.n_samples))
        row = acquire(iq, n0, source.fs_hz, source.if_hz, signal, [int(name[1:])], search)[0]
        if not row["acquired"]:
            raise ValueError(
                f"satellite {name} was not found at the start of '{file}': give the power as jn0_dbhz or power_dbw"
            )
        ratio = 10 ** (row["cn0_dbhz"] / 10) * iq.shape[1] / source.fs_hz
        out[name] = float(row["cn0_dbhz"]), 4.343 * math.sqrt(2 / ratio)
    return out


def _jammers(spec: Scenario, source: Any, duration_s: float, satellites: dict[str, Any]) -> list[JammerRun]:
    """The jammers in the recording's rate; J/S becomes J/N0 by the estimated C/N0."""
    fixed = []
    for k, one in enumerate(spec.jammer):
        change: dict[str, Any] = {}
        if one.against:
            change = {"js_db": None, "against": None, "jn0_dbhz": one.js_db + satellites[one.against][0]}
        if one.line is not None and one.line.follow_doppler:
            raise ValueError(
                f"jammer {k + 1} follows the Doppler of a satellite, which is not known in a recording:"
                " set line.follow_doppler = false"
            )
        fixed.append(one.model_copy(update=change))
    copy = spec.model_copy(update={"jammer": tuple(fixed), "duration_s": duration_s})
    return scenario.jammers(copy, source.fs_hz, source.if_hz, True, None)


def _stream(
    source: Any,
    rms: float,
    runs: list[JammerRun],
    echoes: EchoRun | None,
    front_end: FrontEnd,
    writer: Any,
    advance: Any,
) -> None:
    n0 = 0
    while n0 < source.n_samples:
        n = min(SLAB, source.n_samples - n0)
        iq = _read(source, n0, n, rms)
        if echoes is not None:
            iq += _echo(source, n0, n, rms, echoes)
        for run in runs:
            run.add(iq, n0)
        writer.write(front_end.push(iq) if front_end.streaming else front_end(iq))
        n0 += n
        advance(n0)


def _read(source: Any, n0: int, n: int, rms: float) -> np.ndarray:
    """Samples n0 .. in units of the noise; zeros before the first and after the last."""
    begin, end = max(n0, 0), min(n0 + n, source.n_samples)
    out = np.zeros((2, n), np.float32)
    if begin < end:
        out[:, begin - n0 : end - n0] = source.read_at(begin, end - begin)[1] * np.float32(1.0 / rms)
    return out


def _echo(source: Any, n0: int, n: int, rms: float, echoes: EchoRun) -> np.ndarray:
    """g(t) x(t - tau) of every echo, delays and gains in steps of 1 ms on an absolute grid, sinc interpolation."""
    step = max(round(1e-3 * source.fs_hz), 1)
    out = np.zeros(n, np.complex64)
    first = n0 // step
    gain, delay_s = echoes.series(
        first * step / source.fs_hz, step / source.fs_hz, (n0 + n) // step - first + 2
    )
    for i in range(first, (n0 + n - 1) // step + 1):
        begin, end = max(i * step, n0), min((i + 1) * step, n0 + n)
        x = np.arange(begin, end) / step - i
        for k in range(echoes.n_echo):
            delay = delay_s[k, i - first] * source.fs_hz
            whole, part = divmod(delay, 1.0)
            taps = np.sinc(np.arange(-HALF_TAPS, HALF_TAPS + 1) - part) * np.kaiser(2 * HALF_TAPS + 1, 6.0)
            s = _read(source, begin - int(whole) - HALF_TAPS, end - begin + 2 * HALF_TAPS, rms)
            late = np.convolve(s[0] + 1j * s[1], taps, "valid")
            # The recorded carrier at the intermediate frequency turns with the delay; the gain holds all phase.
            turn = np.exp(2j * np.pi * np.mod(source.if_hz * delay_s[k, i - first], 1.0))
            a, b = gain[k, i - first], gain[k, i - first + 1]
            out[begin - n0 : end - n0] += (a + (b - a) * x) * turn * late
    return np.stack([out.real, out.imag])


def _row(place: int, run: JammerRun, satellites: dict[str, Any], fs_hz: float) -> dict[str, Any]:
    row = {
        "jammer": place, "kind": run.spec.kind, "jn0_dbhz": run.jn0_dbhz, "jn_db": run.jn0_dbhz - 10 * math.log10(fs_hz),
        "js_db": None, "js_db_95": None, "against": None,
    }  # fmt: skip
    for name, (cn0, sigma) in satellites.items():
        js = run.jn0_dbhz - cn0
        row |= {"against": name, "js_db": js, "js_db_95": [js - 1.96 * sigma, js + 1.96 * sigma]}
    return row


def _line(row: dict[str, Any]) -> str:
    text = f"jammer {row['jammer'] + 1} {row['kind']}: J/N {row['jn_db']:.2f} dB, J/N0 {row['jn0_dbhz']:.2f} dB-Hz"
    if row["against"]:
        low, high = row["js_db_95"]
        text += f", J/S {row['js_db']:.1f} dB (95 %: {low:.1f} to {high:.1f}) against {row['against']}"
    return text
