"""Injection: jammers and echoes of a scenario added to a recording, with truth.

The recording is scaled to unit noise per component, the jammers are added at their exact J/N0, and the sum goes through
the scenario's gain loop, if it has one, and a quantiser of the recording's own number of bits. The recording's power per
component stands for its noise: satellites lie below it. J/S needs S, which is estimated by acquisition: its interval is
reported. An echo is one of all that was recorded, noise included: a delayed copy of everything.

Coarse levels are first spread over what they stand for (`Recorded`): what is weaker than a step would otherwise vanish
in the second quantiser. The satellites go through two quantisers so (2 bits: twice 0.55 dB).
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sdr import iffile, scenario
from sdr.progress import progress
from sdr.scenario import Scenario
from sdr.store import Store
from signals.frontend import FrontEnd, FrontEndSpec
from signals.jammers import JammerRun
from signals.multipath import EchoRun
from tracking.acquisition import AcquisitionSpec, acquire, slab_samples

if TYPE_CHECKING:
    from sdr.options import Recording

SLAB = 1 << 18
POWER_S = 1.0
"""The noise power is taken from so much of the recording's beginning."""
SPREAD = 9
"""Place of the spread's seed among those of the scenario."""
STEP_S = 1e-3
"""Delays and gains of echoes go in such steps."""
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
    plots: bool = False,
    quiet: bool = False,
) -> dict[str, Any]:
    """Add the jammers and echoes of scenario ``name`` to a recording -> JSON object; ``plots``: and draw it."""
    spec, text = scenario.load(name, overrides)
    if not spec.jammer and spec.multipath is None:
        raise ValueError(
            f"scenario '{spec.name}' has neither jammer nor multipath: there is nothing to inject"
        )
    source = iffile.open_recording(file, iffile.declaration(file, recording))
    if not source.complex:
        raise ValueError(f"'{file}' holds real samples: injection works on complex ones")
    base = output.with_suffix("") if output.suffix in (".sigmf-meta", ".sigmf-data", ".bin") else output
    if source.declared.data.resolve() in {Path(f"{base}{end}").resolve() for end in (".sigmf-data", ".bin")}:
        raise ValueError(f"'{output}' is the recording itself: give another output")
    recorded = Recorded(source, file, scenario._child(spec, SPREAD))
    satellites = _against(spec, source, file)
    duration_s = source.n_samples / source.fs_hz
    runs = _jammers(spec, source, duration_s, satellites)
    echoes = _echoes(spec, duration_s)
    bits = BITS.get(source.format.name, 8)
    front = FrontEndSpec(
        fs_hz=source.fs_hz, if_hz=source.if_hz, bits=bits, agc=spec.front_end.agc if bits < 32 else None
    )
    echo_power = 0.0 if echoes is None else float(echoes.power.sum())
    front_end = front.start(math.sqrt(1.0 + echo_power + sum(r.rms**2 for r in runs)))
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
        progress(spec.name, source.n_samples, quiet) as advance,
    ):
        _stream(recorded, runs, echoes, front_end, writer, advance)
        index = np.arange(0, source.n_samples, max(round(0.1 * source.fs_hz), 1)).astype(np.uint64)
        for place, run in enumerate(runs):
            store.append("truth/jammers", run.truth(index, place))
        if echoes is not None:
            store.append("truth/echoes", echoes.truth(index, source.fs_hz))
    table = [_row(k, run, satellites, source.fs_hz) for k, run in enumerate(runs)]
    files = [str(p) for p in writer.files] + [str(truth_path)]
    lines = [*(_line(r) for r in table), *_echo_lines(echoes)]
    figures = [str(_draw(base, Path(files[0]), source, runs, lines, list(satellites)))] if plots else []
    return {
        "files": files, "samples": writer.n_samples, "noise_rms_lsb": recorded.rms, "jammers": table, "figures": figures,
        "text": "\n".join([*lines, *(f"  {f}" for f in files + figures)]),
    }  # fmt: skip


def _draw(
    base: Path, written: Path, source: Any, runs: list[JammerRun], lines: list[str], names: list[str]
) -> Path:
    """Figure of the recording before and after, over the time in which a jammer is on."""
    from sdr.inject_figure import injection

    after = iffile.open_recording(written, iffile.declaration(written))
    n = source.n_samples
    on, off = [min(r.n_on, n) for r in runs] or [0], [min(r.n_off, n) for r in runs] or [n]
    span_s = min(on) / source.fs_hz, max(off) / source.fs_hz
    return injection(base / "injection.png", source, after, span_s, "\n".join(lines), names)


class Recorded:
    """Run that reads a recording in units of its noise, as it was before its quantiser as far as that can be known.

    A level of 1 or 2 bits becomes a draw from the part of a Gaussian that it stands for, by its share of POWER_S; one of
    8 bits is spread evenly over its step. Draws belong to absolute samples. Wider formats stay as they are.
    """

    def __init__(self, source: Any, file: Path, seed: np.random.SeedSequence) -> None:
        self.source, self.n_samples, self._seed = source, source.n_samples, seed
        _, iq = source.read_at(0, min(round(POWER_S * source.fs_hz), source.n_samples))
        self.rms = float(np.sqrt(np.mean(iq.astype(np.float64) ** 2)))
        if self.rms == 0.0:
            raise ValueError(f"'{file}' begins with {POWER_S:g} s of zeros: its noise level is not known")
        self._levels = np.array(sorted(source.format.levels))
        self._edges = np.append([np.mean(iq < level) for level in self._levels], 1.0)
        self._coarse, self._spread = source.format.bits <= 2, source.format.bits <= 8
        self._kept: dict[int, np.ndarray] = {}

    def read(self, n0: int, n: int) -> np.ndarray:
        """Samples n0 .., float32 (2, n); zeros before the first and after the last."""
        begin, end = max(n0, 0), min(n0 + n, self.n_samples)
        out = np.zeros((2, n), np.float32)
        while begin < end:
            block, at = divmod(begin, SLAB)
            stop = min(end, (block + 1) * SLAB)
            out[:, begin - n0 : stop - n0] = self._slab(block)[:, at : at + stop - begin]
            begin = stop
        return out

    def _slab(self, block: int) -> np.ndarray:
        """Samples of block ``block`` of SLAB; the last two that were asked for are kept."""
        if block not in self._kept:
            begin = block * SLAB
            iq = self.source.read_at(begin, min(SLAB, self.n_samples - begin))[1]
            seed = np.random.SeedSequence(self._seed.entropy, spawn_key=(*self._seed.spawn_key, block))
            self._kept = dict([*self._kept.items()][-1:]) | {block: self._before_quantiser(iq, seed)}
        return self._kept[block]

    def _before_quantiser(self, iq: np.ndarray, seed: np.random.SeedSequence) -> np.ndarray:
        if not self._spread:
            return iq * np.float32(1.0 / self.rms)
        u = np.random.Generator(np.random.Philox(seed)).random(iq.shape, np.float32)
        if not self._coarse:
            return (iq + (u - np.float32(0.5))) * np.float32(1.0 / self.rms)
        from scipy.special import ndtri

        k = np.searchsorted(self._levels, iq)
        low, high = self._edges[k], self._edges[k + 1]
        return ndtri(low + (u + 2.0**-25) * (high - low)).astype(np.float32)


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


def _echoes(spec: Scenario, duration_s: float) -> EchoRun | None:
    if spec.multipath is None:
        return None
    if spec.multipath.satellites is not None:
        raise ValueError(
            "multipath.satellites: in a recording satellites are not apart, an echo is one of them all: leave it out"
        )
    run = spec.multipath.start(scenario._child(spec, scenario.MULTIPATH))
    run.check(duration_s, STEP_S)
    return run


def _stream(
    recorded: Recorded,
    runs: list[JammerRun],
    echoes: EchoRun | None,
    front_end: FrontEnd,
    writer: Any,
    advance: Any,
) -> None:
    n0 = 0
    while n0 < recorded.n_samples:
        n = min(SLAB, recorded.n_samples - n0)
        iq = recorded.read(n0, n)
        if echoes is not None:
            iq += _echo(recorded, n0, n, echoes)
        for run in runs:
            run.add(iq, n0)
        writer.write(front_end.push(iq) if front_end.streaming else front_end(iq))
        n0 += n
        advance(n0)


def _echo(recorded: Recorded, n0: int, n: int, echoes: EchoRun) -> np.ndarray:
    """g(t) x(t - tau) of every echo: delays hold and gains go in lines over STEP_S, on an absolute grid."""
    fs_hz, if_hz = recorded.source.fs_hz, recorded.source.if_hz
    step = max(round(STEP_S * fs_hz), 1)
    out = np.zeros(n, np.complex64)
    first, step_s = n0 // step, step / fs_hz
    gain, delay_s = echoes.series(first * step_s, step_s, (n0 + n) // step - first + 2)
    # Without their Doppler the gains are slow; it comes back by the sample.
    at = first * step_s + step_s * np.arange(gain.shape[1])
    turns = np.mod(echoes.doppler_hz[:, None] * at, 1.0)
    gain = gain * np.exp(-2j * np.pi * turns)
    for i in range(first, (n0 + n - 1) // step + 1):
        begin, end = max(i * step, n0), min((i + 1) * step, n0 + n)
        x = np.arange(begin, end) / step - i
        for k in range(echoes.n_echo):
            late = _late(recorded, begin, end, delay_s[k, i - first] * fs_hz)
            a, b = gain[k, i - first], gain[k, i - first + 1]
            # The recorded carrier at the intermediate frequency turns with the delay; the gain holds all phase.
            turn = if_hz * delay_s[k, i - first]
            spin = np.mod(echoes.doppler_hz[k] * np.arange(begin, end) / fs_hz + turn, 1.0)
            out[begin - n0 : end - n0] += (a + (b - a) * x) * np.exp(2j * np.pi * spin) * late
    return np.stack([out.real, out.imag])


def _late(recorded: Recorded, begin: int, end: int, delay: float) -> np.ndarray:
    """The samples begin .. end - 1 as they were ``delay`` samples before, by sinc interpolation: complex."""
    whole, part = divmod(delay, 1.0)
    taps = np.sinc(np.arange(-HALF_TAPS, HALF_TAPS + 1) - part) * np.kaiser(2 * HALF_TAPS + 1, 6.0)
    s = recorded.read(begin - int(whole) - HALF_TAPS, end - begin + 2 * HALF_TAPS)
    return np.convolve(s[0] + 1j * s[1], taps, "valid")


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


def _echo_lines(echoes: EchoRun | None) -> list[str]:
    if echoes is None:
        return []
    return [
        f"echo {k + 1}: {1e9 * delay_s:.1f} ns late at the start, {10 * math.log10(power):.1f} dB, of all that was recorded"
        for k, (delay_s, power) in enumerate(zip(echoes.delay_s, echoes.power))
    ]
