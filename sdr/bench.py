"""Speed of this machine's receiver and generator: ``gnssbb bench``.

Absolute rates drift with the machine and its other work. What is comparable are the ratios to a fixed plain kernel (one
fused loop with look-up tables for carrier and code) taken in turn, A-B-A-B, in the same run: both see the same clock
and the same neighbours. Every figure is a median over rounds of thread CPU time, except where wall time is named.
"""

import math
import multiprocessing
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numba as nb
import numpy as np

from monitors.fft import FftMonitor
from sdr import iffile, scenario
from sdr.receiver import Receiver
from sdr.watch.channels import WatchSpec
from sdr.watch.null import one_blas_thread
from signals.kernels import noise_block
from signals.modulation import BLOCK
from signals.source import SyntheticSource
from tracking.acquisition import AcquisitionSpec, acquire, slab_samples
from tracking.channel import TrackingSpec
from tracking.correlator_model import Twin

FS_HZ = 4.0e6
LUT = 1024
ROUNDS = 5
SECONDS = 4.0
WATCHED_S = 20.0
SKY = """
name = "bench"
seed = 7
duration_s = {duration_s}
[sky]
start = 2024-03-01T12:01:00
signals = {signals}
max_satellites = {satellites}
cn0_dbhz = 47.0
[front_end]
fs_hz = {fs_hz}
bits = 8
[receiver.acquisition]
systems = {systems}
{receiver}
"""


@nb.njit(nogil=True, fastmath={"nsz", "arcp", "contract", "afn", "reassoc"})
def plain_kernel(iq, code, n, carrier_step, code_step, cos_table, sin_table, out):
    """The fixed reference: early, prompt and late in one loop, carrier and code by look-up, nothing clever."""
    phase = 0.0
    chip = 0.5
    sums = np.zeros(6, np.float32)
    for k in range(n):
        j = np.int64(phase * LUT) & (LUT - 1)
        i_in, q_in = np.float32(iq[0, k]), np.float32(iq[1, k])
        c, s = cos_table[j], sin_table[j]
        wi = i_in * c + q_in * s
        wq = q_in * c - i_in * s
        for t in range(3):
            value = code[np.int64(chip + 0.25 * t)]
            sums[2 * t] += wi * value
            sums[2 * t + 1] += wq * value
        phase += carrier_step
        chip += code_step
    out[:] = sums


def bench(*, quick: bool = False, quiet: bool = False) -> dict[str, Any]:
    """Measure; returns the JSON object of the ``bench`` command."""
    rounds = 2 if quick else ROUNDS
    say = (lambda _: None) if quiet else (lambda line: print(line, flush=True))
    say(f"{cpu_name()}: rates per core, medians of {rounds} rounds in turn with the plain kernel")
    plain = _plain()
    one, one_ratio = _in_turn(_channel("L1CA", {}), plain, rounds)
    wide, wide_ratio = _in_turn(
        _channel("L1CA", {"l1ca": {"taps": {"count": 35, "spacing_chips": 0.65}}}), plain, rounds
    )
    five = _median(
        [
            _rate(_channel("L1CA", {"l1ca": {"taps": {"count": 5, "spacing_chips": 0.25}}}))
            for _ in range(rounds)
        ]
    )
    pilot, pilot_ratio = _in_turn(_channel("E1C", {}), plain, rounds)
    say(f"  one channel E/P/L     {one / 1e9:6.2f} Gsample/s   {one_ratio:5.1f} times the plain kernel")
    say(f"  one channel 35 taps   {wide / 1e9:6.2f} Gsample/s   {wide_ratio:5.1f}")
    say(
        f"  E1 data + pilot       {pilot / 1e9:6.2f} Gsample/s   costs {five / pilot:.2f} C/A channels of 5 taps"
    )
    synth, synth_ratio = _in_turn(_synthesis(["L1CA"], 10), plain, rounds)
    cboc = _median([_rate(_synthesis(["E1"], 8)) for _ in range(rounds)])
    say(
        f"  synthesis, 10 sat     {synth / 1e6:6.0f} satellite*Msps   {synth_ratio:5.1f}; CBOC {cboc / 1e6:.0f} component*Msps"
    )
    costs = _jammer_costs(40 * rounds)
    for name, cost in costs.items():
        say(f"  {name:22s}{cost['satellites']:6.2f} satellites, {cost['noise']:5.2f} thermal generators")
    share = _median([_monitors() for _ in range(rounds)])
    say(f"  live monitors         {100 * share:6.1f} % of the tracking of 8 channels with 35 taps")
    open_loop, closed_loop = (_median([_rate(job) for _ in range(rounds)]) for job in _twins())
    say(
        f"  twin, 35 taps         {open_loop / 1e6:6.2f} million epochs/s through the FFT, {closed_loop / 1e6:.2f} with loops"
    )
    front = _median([_rate(_front_end) for _ in range(rounds)])
    say(
        f"  front end, all stages {front / FS_HZ:6.1f} times real time at {FS_HZ / 1e6:g} Msps, with its synthesis"
    )
    found_s = _median([_acquisition() for _ in range(rounds)])
    say(f"  acquisition 32 PRN    {found_s:6.3f} s")
    chain, compute = _chain(20.0 if quick else 60.0)
    say(
        f"  whole chain, 8 ch     {chain / 1e6:6.0f} channel*Msps, file to position ({compute:.1f} times real time)"
    )
    ratio, steered = _steered(rounds)
    say(f"  ultra-tight, 10 ch    {steered:6.1f} times real time, costs {ratio:.2f} scalar receivers")
    shares = {name: _integrity(name) for name in (() if quick else ("integrity-ramp", "integrity-ut-ramp"))}
    for name, part in shares.items():
        say(f"  integrity monitors    {100 * part:6.1f} % of the receiver's time ({name})")
    speedup = _median([_threads() for _ in range(rounds)])
    say(f"  2 threads             {speedup:6.2f} of two independent processes")
    return {
        "track_channel_msps_per_core": chain / 1e6,
        "track_one_channel_gsps": one / 1e9,
        "track_35_taps_gsps": wide / 1e9,
        "track_e1_pilot_data_cost": five / pilot,
        "synth_satellite_msps_per_core": synth / 1e6,
        "synth_cboc_component_cost": (synth / cboc),
        "jammer_cost_satellites": {name: cost["satellites"] for name, cost in costs.items()},
        "jammer_cost_noise": {name: cost["noise"] for name, cost in costs.items()},
        "monitors_share_of_tracking": share,
        "twin_open_fft_epochs_s": open_loop,
        "twin_closed_epochs_s": closed_loop,
        "front_end_msps": front / 1e6,
        "acquire_32_prn_s": found_s,
        "threads_2_speedup": speedup,
        "integrity_share": shares,
        "ratio_to_reference": {
            "track_e_p_l": one_ratio,
            "track_35_taps": wide_ratio,
            "track_e1_pilot_data": pilot_ratio,
            "synth": synth_ratio,
        },
        "real_time_factor_8_channels": compute,
        "real_time_factor_ultra_tight": steered,
        "ultra_tight_over_scalar": ratio,
        "cpu": cpu_name(),
        "text": "",
    }


def cpu_name() -> str:
    """Model name of the processor."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        import platform

        return platform.processor() or platform.machine()
    return next(
        (line.split(":", 1)[1].strip() for line in text.splitlines() if line.startswith("model name")),
        "unknown",
    )


Job = Callable[[], tuple[float, float]]
"""Does its work once; returns the samples (times channels or satellites) it handled and the CPU seconds they took."""


def _rate(job: Job) -> float:
    done, seconds = job()
    return done / seconds


def _in_turn(job: Job, plain: Job, rounds: int) -> tuple[float, float]:
    """Median rate of ``job`` and median of its ratios to ``plain``, run in turn."""
    job(), plain()
    pairs = [(_rate(job), _rate(plain)) for _ in range(rounds)]
    return _median([a for a, _ in pairs]), _median([a / b for a, b in pairs])


def _median(values: list[float]) -> float:
    return float(np.median(values))


def _plain() -> Job:
    rng = np.random.default_rng(1)
    n = 4_000_000
    iq = np.clip(np.round(20 * rng.standard_normal((2, n))), -127, 127).astype(np.int8)
    code = np.where(rng.random(n // 3 + 8) < 0.5, -1, 1).astype(np.float32)
    angle = 2 * math.pi * np.arange(LUT) / LUT
    cos_table, sin_table = np.cos(angle).astype(np.float32), np.sin(angle).astype(np.float32)
    out = np.zeros(6, np.float32)

    def job() -> tuple[float, float]:
        begin = time.thread_time()
        plain_kernel(iq, code, n, 1234.5 / FS_HZ, 1.023e6 / FS_HZ, cos_table, sin_table, out)
        return float(n), time.thread_time() - begin

    return job


def _channel(signal: str, tracking: dict[str, Any]) -> Job:
    """One channel with all its loops over int8 samples; pull-in and synchronisation are not timed."""
    source = _sky(SECONDS, 4, ["L1CA" if signal == "L1CA" else "E1"])
    iq = source.read(source.n_samples)[1]
    rows = acquire(iq[:, : slab_samples(signal, FS_HZ)], 0, FS_HZ, 0.0, signal, None, AcquisitionSpec())
    row = rows[rows["acquired"]][0]
    spec = TrackingSpec.model_validate(tracking)
    slab, settled = round(0.1 * FS_HZ), round(1.0 * FS_HZ)

    def job() -> tuple[float, float]:
        tracker = spec.start(FS_HZ)
        tracker.add(row)
        begin = 0.0
        for n0 in range(0, iq.shape[1], slab):
            if n0 == settled:
                begin = time.thread_time()
            tracker.process(n0, iq[:, n0 : n0 + slab])
        return float(iq.shape[1] - settled), time.thread_time() - begin

    return job


def _scenario(
    duration_s: float, satellites: int, signals: list[str], receiver: str = ""
) -> scenario.Scenario:
    systems = [s for s, name in (("G", "L1CA"), ("E", "E1")) if name in signals]
    text = SKY.format(
        duration_s=duration_s,
        satellites=satellites,
        signals=signals,
        systems=systems,
        fs_hz=FS_HZ,
        receiver=receiver,
    )
    return scenario.parse(text, "bench")


def _sky(duration_s: float, satellites: int, signals: list[str]) -> SyntheticSource:
    return scenario.source(_scenario(duration_s, satellites, signals))


def _synthesis(signals: list[str], satellites: int) -> Job:
    def job() -> tuple[float, float]:
        source = _sky(SECONDS, satellites, signals)
        source.read(round(0.1 * FS_HZ))
        begin, samples = time.thread_time(), 0
        while n := source.read(round(0.1 * FS_HZ))[1].shape[1]:
            samples += n
        components = len(source.sky.satellites) * (2 if "E1" in signals else 1)
        return float(samples * components), time.thread_time() - begin

    return job


JAMMERS = {
    "CW": 'kind = "CW"',
    "CW sweep 1 kHz/s": 'kind = "CW"\nrate_hz_s = 1e3',
    "chirp 20 us": 'kind = "Chirp"\nsweep_hz = 3e6\nsweep_s = 20e-6',
    "chirp 5 ms, triangle": 'kind = "Chirp"\nsweep_hz = 3e6\nsweep_s = 5e-3\nshape = "triangular"',
    "pulsed 30 %": 'kind = "Pulsed"\nrate_hz = 1000\nduty = 0.3',
    "DME 2700 pairs/s": 'kind = "Pulsed"\nrate_hz = 2700\nshape = "dme"',
    "matched spectrum": 'kind = "MatchedSpectrum"',
    "wide-band noise": 'kind = "Wideband"',
    "noise of 10 kHz": 'kind = "Narrowband"\nbandwidth_hz = 1e4',
    "noise of 100 kHz": 'kind = "Narrowband"\nbandwidth_hz = 1e5',
    "noise of 1 MHz": 'kind = "Narrowband"\nbandwidth_hz = 1e6',
    "noise of 3 MHz": 'kind = "Narrowband"\nbandwidth_hz = 3e6',
}


@nb.njit(nogil=True)
def _thermal(blocks: int) -> None:
    """The generator of the thermal noise and nothing else, into the first-level cache."""
    out_i, out_q = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    hash1, hash2 = np.empty(BLOCK, np.uint32), np.empty(BLOCK, np.uint32)
    for block in range(blocks):
        noise_block(out_i, out_q, hash1, hash2, np.uint64(1), np.uint64(block), np.float32(1.0))


def _jammer_costs(rounds: int) -> dict[str, dict[str, float]]:
    """What jammers and an echo add to the synthesis of 10 satellites, over a satellite and over the thermal noise.

    Quarters of a second in turn, thread CPU time, medians of the differences. A satellite is what the whole sky costs
    more than its first one, over their number (9 rise, not 10): same tables, Doppler and data bits as in any run. Two
    echoes are added, as satellites go in pairs, and one is half of that. The thermal noise is its generator alone: a synthesis
    without noise has zeros to write instead, 0.07 of that.
    """
    span_s = 1.0 + rounds * 0.25
    spec = _scenario(span_s, 10, ["L1CA"])
    texts = {
        name: f"jn0_dbhz = 70.0\n{'' if 'Wideband' in text else 'freq_hz = 1e5'}\n{text}"
        for name, text in JAMMERS.items()
    }
    sources = {
        "": scenario.source(spec),
        "one": scenario.source(_scenario(span_s, 1, ["L1CA"])),
    }
    for name, text in texts.items():
        sources[name] = scenario.source(_scenario(span_s, 10, ["L1CA"], f"[[jammer]]\n{text}"))
    satellites = sources[""].sky.satellites
    pair = "{ delay_s = 3e-7, power_db = -6.0 }, { delay_s = 5e-7, power_db = -6.0 }"
    echo = f'[multipath]\nkind = "Echoes"\nsatellites = ["{satellites[0].name}"]\nechoes = [{pair}]'
    sources["echo"] = scenario.source(_scenario(span_s, 10, ["L1CA"], echo))
    size = round(0.25 * FS_HZ)
    for source in sources.values():
        source.read(round(FS_HZ))
    _thermal(1)
    jobs: dict[str, Callable[[], Any]] = {key: partial(source.read, size) for key, source in sources.items()}
    jobs["thermal"] = partial(_thermal, round(size / BLOCK))
    times: dict[str, list[float]] = {key: [] for key in jobs}
    for _ in range(rounds):
        for key, job in jobs.items():
            begin = time.thread_time()
            job()
            times[key].append(time.thread_time() - begin)
    noise = float(np.median(times.pop("thermal")))
    more = {key: float(np.median(np.subtract(t, times[""]))) for key, t in times.items()}
    satellite = -more["one"] / (len(satellites) - 1)
    costs = {key: cost for key, cost in more.items() if key not in ("", "one")}
    costs["echo"] /= 2
    return {key: {"satellites": cost / satellite, "noise": cost / noise} for key, cost in costs.items()}


def _twins() -> tuple[Job, Job]:
    """The twin of one C/A channel with 35 taps: open loop through the maximum of the FFT, and with its loops."""
    spec = Twin(signal="L1CA", prn=6, cn0_dbhz=40.5, integration_s=0.02)
    source, loops = spec.start_open(1), spec.start(1)
    monitor = FftMonitor().start(spec.tap_array_chips, spec.integration_s)
    size = source.block_epochs

    def timed(work: Callable[[int], Any], blocks: int) -> tuple[float, float]:
        with one_blas_thread():
            work(0)
            begin = time.thread_time()
            for i in range(blocks):
                work(i)
        return float(blocks * size), time.thread_time() - begin

    return (
        lambda: timed(lambda i: monitor.block(source.block(i)), 1000),
        lambda: timed(lambda _: loops(size), 200),
    )


def _front_end() -> tuple[float, float]:
    """Samples through every stage of scenario front-end, the synthesis of its three satellites included."""
    source = scenario.source(scenario.load("front-end", [f"front_end.fs_hz={FS_HZ}"])[0])
    source.read(round(0.1 * FS_HZ))
    begin = time.thread_time()
    for _ in range(10):
        source.read(round(0.2 * FS_HZ))
    return 2.0 * FS_HZ, time.thread_time() - begin


def _acquisition() -> float:
    """Seconds of CPU for 32 PRN, +-5 kHz, 10 x 1 ms at 4.096 Msps, the search alone."""
    fs_hz = 4.096e6
    rng = np.random.default_rng(3)
    iq = np.clip(np.round(20 * rng.standard_normal((2, round(0.010 * fs_hz)))), -127, 127).astype(np.int8)
    spec = AcquisitionSpec(non_coherent=10)
    begin = time.process_time()
    acquire(iq, 0, fs_hz, 0.0, "L1CA", list(range(1, 33)), spec)
    return time.process_time() - begin


def _monitors() -> float:
    """CPU of FFT and GLRT every epoch, AR residual every epoch and AR refit once a second, over that of tracking."""
    source = _sky(WATCHED_S, 8, ["L1CA"])
    first = source.read(slab_samples("L1CA", FS_HZ))[1]
    rows = acquire(first, 0, FS_HZ, 0.0, "L1CA", None, AcquisitionSpec())
    taps = {"count": 35, "spacing_chips": 0.65}
    tracker = TrackingSpec.model_validate({"l1ca": {"taps": taps}}).start(FS_HZ)
    for row in rows[rows["acquired"]]:
        tracker.add(row)
    watches = [
        WatchSpec.model_validate({"name": d["kind"], "detector": d, "settle_s": 0.5, "training_s": 4.0, "threshold": 1e9})
        for d in (
            {"kind": "FFT"}, {"kind": "GLRT"}, {"kind": "AR", "hop_s": 0.02}, {"kind": "AR", "form": "refit", "hop_s": 1.0},
        )
    ]  # fmt: skip
    runs: list[Any] = [w.start(FS_HZ) for w in watches]
    nominal = taps["spacing_chips"] * (np.arange(taps["count"]) - taps["count"] // 2)
    spent = np.zeros(2)
    iq, n0 = first, 0
    while iq.shape[1]:
        marks = [time.thread_time()]
        epochs, counts, corr = tracker.process(n0, iq)
        marks.append(time.thread_time())
        for run in runs:
            for c in np.flatnonzero(counts):
                k = tracker.window(c)
                run(
                    "L1CA", int(tracker.channels["prn"][c]), epochs[c, : counts[c]], corr[c, : counts[c], :k],
                    (nominal, tracker.taps_chips(c)[:k]), "BPSK",
                )  # fmt: skip
        marks.append(time.thread_time())
        if n0 > (WATCHED_S - 10.0) * FS_HZ:
            spent += np.diff(marks)
        n0, iq = source.read(round(0.2 * FS_HZ))
    return float(spent[1] / spent[0])


def _chain(duration_s: float) -> tuple[float, float]:
    """File to position: channel samples per second of CPU, and the real-time factor of the whole run."""
    spec = _scenario(duration_s, 8, ["L1CA"])
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder) / "bench"
        source = scenario.source(spec, threads=2)
        with iffile.create_recording(base, source, spec) as writer:
            while (iq := source.read(round(0.1 * FS_HZ))[1]).shape[1]:
                writer.write(iq)
        meta = next(p for p in writer.files if str(p).endswith(".sigmf-meta"))
        for k in range(2):  # the first compiles
            opened = iffile.open_recording(meta, iffile.declaration(meta))
            receiver = Receiver(spec.receiver, opened)
            begin, samples = time.process_time(), 0.0
            for outcome in receiver:
                samples += len(receiver.channel_of) * (outcome.n_end - outcome.n0)
                if k == 0 and outcome.n_end > 2 * FS_HZ:
                    break
            elapsed = time.process_time() - begin
    return samples / elapsed, duration_s / elapsed


STEERED_FROM_S, STEERED_S = 30.0, 8.0
"""The ultra-tight receiver has taken over by then; how long it is timed."""


class _Memory:
    """The samples of a source, read once and kept."""

    def __init__(self, source: Any) -> None:
        self.fs_hz, self.if_hz, self.n_samples = source.fs_hz, source.if_hz, source.n_samples
        self.iq, self.position = source.read(source.n_samples)[1], 0

    def read(self, n: int) -> tuple[int, np.ndarray]:
        n0, self.position = self.position, min(self.position + n, self.n_samples)
        return n0, self.iq[:, n0 : self.position]


def _steered(rounds: int) -> tuple[float, float]:
    """CPU time of an ultra-tight receiver (100 Hz IMU and odometer, 50 Hz updates) over that of a scalar one, in turn on the
    same samples of 10 satellites, once it steers; and its real-time factor.
    """
    sky = [
        "jammer=[]",
        "sky.start=2024-03-01T10:00:58",
        "sky.max_satellites=10",
        "sky.elevation_mask_deg=5",
        f"duration_s={STEERED_FROM_S + STEERED_S}",
    ]
    spec = scenario.load("drive-jam", sky)[0]
    memory, sensors = _Memory(scenario.source(spec, threads=2)), scenario.sensors(spec)

    def seconds(mode: str) -> float:
        memory.position = 0
        steering = spec.receiver.steering.with_mode(mode)
        receiver = Receiver(spec.receiver.model_copy(update={"steering": steering}), memory, sensors)
        begin = 0.0
        for outcome in receiver:
            if begin == 0.0 and outcome.n_end >= STEERED_FROM_S * memory.fs_hz:
                begin = time.thread_time()
        return time.thread_time() - begin

    seconds("scalar"), seconds("ultra_tight")
    pairs = [(seconds("ultra_tight"), seconds("scalar")) for _ in range(rounds)]
    return _median([a / b for a, b in pairs]), STEERED_S / _median([a for a, _ in pairs])


class _Clocked:
    """Any object, with the CPU seconds of this thread that calls of it (of ``methods``, if given) have taken."""

    def __init__(self, what: Any, methods: tuple[str, ...] = ()) -> None:
        self._what, self._methods, self.seconds = what, methods, 0.0

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._what, name)
        if not callable(value) or (self._methods and name not in self._methods):
            return value
        return lambda *a, **k: self(*a, of=value, **k)

    def __call__(self, *args: Any, of: Any = None, **named: Any) -> Any:
        begin = time.thread_time()
        result = (of or self._what)(*args, **named)
        self.seconds += time.thread_time() - begin
        return result


INTEGRITY_FROM_S, INTEGRITY_TO_S = 45.0, 75.0
"""Time over which the integrity monitors' share is taken: one period of ALS on 50 Hz, its pause included, two on 5 Hz."""


def _integrity(name: str) -> float:
    """Share of the integrity monitors, and of the log kept for them, in the receiver's CPU time."""
    spec, _ = scenario.load(name, [f"duration_s={INTEGRITY_TO_S}", "fault=[]"])
    source = _Clocked(scenario.source(spec), ("read",))
    receiver: Any = Receiver(spec.receiver, source, scenario.sensors(spec))
    receiver.integrity = _Clocked(receiver.integrity)
    parts, log = [receiver.integrity], receiver.navigator.log
    for method in () if log is None else ("predicted", "updated"):
        parts.append(_Clocked(getattr(log, method)))
        setattr(log, method, parts[-1])
    begin, before = 0.0, 0.0
    for outcome in receiver:
        if begin == 0.0 and outcome.n_end >= INTEGRITY_FROM_S * receiver.fs_hz:
            begin = time.process_time()
            before = source.seconds
            for part in parts:
                part.seconds = 0.0
    whole = time.process_time() - begin - (source.seconds - before)
    return sum(part.seconds for part in parts) / whole


def _track_all(threads: int, barrier: Any = None) -> float:
    """Wall seconds in which 8 locked channels track what follows the first second of a sky."""
    source = _sky(SECONDS, 8, ["L1CA"])
    iq = source.read(source.n_samples)[1]
    rows = acquire(iq[:, : slab_samples("L1CA", FS_HZ)], 0, FS_HZ, 0.0, "L1CA", None, AcquisitionSpec())
    tracker = TrackingSpec.model_validate({"threads": threads}).start(FS_HZ)
    for row in rows[rows["acquired"]]:
        tracker.add(row)
    slab, settled = round(0.2 * FS_HZ), round(1.0 * FS_HZ)
    begin = 0.0
    for n0 in range(0, iq.shape[1], slab):
        if n0 == settled:
            if barrier is not None:
                barrier.wait()
            begin = time.perf_counter()
        tracker.process(n0, iq[:, n0 : n0 + slab])
    return time.perf_counter() - begin


def _worker(barrier: Any, queue: Any) -> None:
    queue.put(_track_all(1, barrier))


def _threads() -> float:
    """Throughput of two threads over that of two independent single-thread processes, wall time."""
    together = _track_all(2)
    context = multiprocessing.get_context("spawn")
    barrier, queue = context.Barrier(2), context.Queue()
    workers = [context.Process(target=_worker, args=(barrier, queue)) for _ in range(2)]
    for w in workers:
        w.start()
    apart = max(queue.get(timeout=300) for _ in workers)
    for w in workers:
        w.join()
    # The processes do the work twice.
    return apart / (2 * together)
