"""A campaign point once more, on IF samples: the same jammer phase and echoes, the receiver's own channel.

The trial's seed decides CW phase and echoes as in the twin; noise, narrow-band jammers and data symbols are drawn anew
from it. A tracking channel follows the samples, and the monitors, trained as in the campaign, see its taps. Twin and
samples are then compared second by second: a two-sample test of the mean statistic and of the share of misses.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from monitors.batch import sum_dumps, trial_seed
from sdr.campaign.load import load
from sdr.campaign.spec import Campaign
from sdr.campaign.trials import fit_thresholds, offset_from_line_hz, quiet_statistics, span, trained
from sdr.progress import progress
from sdr.watch.null import one_blas_thread
from signals.codes import primary_code
from signals.constants import CHIP_RATE_HZ
from signals.jammers import Narrowband
from signals.modulation import SIGNALS, chip_waveform
from tracking.channel import STATE_LOCKED, TrackingSpec
from tracking.correlator_model import Twin, TwinNBI, _cw_rows, _keys, jammer_hz
from tracking.records import ACQUISITION

FS_HZ = {"L1CA": 5.0037e6, "E1B": 8.1907e6}
"""Rates whose aliases of the chip spectrum keep the lines' amplitudes within 1 % over the code phase."""
SLAB_S = 0.1
LIMIT_S = 60.0
"""Length of signal that is synthesised at most."""
Z_AGREE = 4.0


def confirm(name: str, point: int, *, overrides: Sequence[str] = (), quiet: bool = False) -> dict[str, Any]:
    """Compare point ``point`` of a campaign on samples with the twin; the command's JSON object."""
    campaign = load(name, tuple(overrides))
    if campaign.live:
        raise ValueError(f"--confirm: '{campaign.spec.name}' counts on samples already")
    if not 0 <= point < len(campaign.points):
        raise ValueError(
            f"--confirm {point}: '{campaign.spec.name}' has points 0 to {len(campaign.points) - 1}"
        )
    twin = campaign.points[point]
    count, spacing = _confirmable(campaign, twin)
    T = twin.integration_s
    settle = campaign.spec.trial.settle_epochs
    epochs = min(campaign.spec.trial.epochs, max(50, round(LIMIT_S / T) - settle))
    group = campaign.group[point]
    values = quiet_statistics(campaign.text, group, 0, campaign.spec.threshold.trials)
    limits = fit_thresholds(campaign, group, values)["threshold"]
    runs = trained(campaign.text, group)
    seed = trial_seed(campaign.spec.seeds.evaluation, point, 0)
    with one_blas_thread():
        model = twin.start(seed)(settle + epochs)
    t_s, corr = _on_samples(twin, seed, (settle + epochs) * T, count, spacing, quiet)
    rows = []
    for i, (monitor, run) in enumerate(runs.items()):
        with one_blas_thread():
            a = _series(run, model[0]["t_s"][settle:], model[1][settle:], twin, campaign.spec.dumps)
            late = t_s >= settle * T
            b = _series(run, t_s[late], corr[late], twin, campaign.spec.dumps)
        rows.append({"monitor": monitor, "threshold": float(limits[i])} | _compare(a, b, float(limits[i])))
    result = {
        "name": campaign.spec.name, "point": point, "axes": campaign.settings[point], "fs_hz": FS_HZ[twin.signal],
        "duration_s": (settle + epochs) * T, "agree": all(r["agree"] for r in rows), "monitors": rows,
    }  # fmt: skip
    result["text"] = _text(result)
    return result


def _confirmable(campaign: Campaign, twin: Twin) -> tuple[int, float]:
    """Number and spacing of the taps; ValueError for what the sample path does not make."""
    taps = twin.tap_array_chips
    step = np.diff(taps)
    if twin.signal not in FS_HZ or (twin.signal == "E1B" and twin.waveform != "BOC11"):
        raise ValueError(
            '--confirm: samples are made for L1CA and for E1B with waveform = "BOC11"; choose such a point'
        )
    if campaign.spec.dumps != 1 and (twin.signal == "L1CA" or twin.data != twin.wiped):
        raise ValueError(
            "--confirm: sums of dumps are made on samples for E1B, without data or with data wiped"
        )
    if twin.fs_hz is not None or twin.bandwidth_hz is not None:
        raise ValueError(
            "--confirm: samples are made without a front-end filter; choose a point without bandwidth_hz and fs_hz"
        )
    if twin.dynamics.at(np.array([1.0]))[1].any() or twin.dynamics.jerk_mps3:
        raise ValueError("--confirm: a point with dynamics is not made on samples; choose one without")
    if len(taps) % 2 == 0 or not np.allclose(step, step[0]) or not np.allclose(taps, -taps[::-1]):
        raise ValueError("--confirm: the taps must be evenly spaced about zero")
    return len(taps), float(step[0])


def _on_samples(twin: Twin, seed: Any, duration_s: float, count: int, spacing: float, quiet: bool) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Mid-times and taps (prompt = 1 at the signal's amplitude) of the locked integrations of one channel."""
    fs_hz = FS_HZ[twin.signal]
    samples = _Samples(twin, seed, duration_s)
    loops: dict[str, Any] = {
        "integration_ms": round(twin.integration_s * 1e3), "early_late_space_chips": twin.early_late_space_chips,
        "pll_order": twin.pll_order, "pll_bw_hz": twin.pll_bandwidth_hz, "dll_bw_hz": twin.dll_bandwidth_hz,
        "code_discriminator": twin.code_discriminator, "taps": {"count": count, "spacing_chips": spacing},
    }  # fmt: skip
    if twin.signal == "E1B":
        loops |= {"component": "data", "side_peak_protection": False}
    else:
        loops["carrier_discriminator"] = twin.carrier_discriminator
    section = "l1ca" if twin.signal == "L1CA" else "e1"
    tracker = TrackingSpec.model_validate({section: loops}).start(fs_hz, 0.0)
    start = np.zeros((), ACQUISITION)
    start["signal"], start["prn"], start["cn0_dbhz"], start["acquired"] = (
        twin.signal.encode(),
        twin.prn,
        twin.cn0_dbhz,
        True,
    )
    c = tracker.add(start)
    t_s, out = [], []
    n = round(SLAB_S * fs_hz)
    total = math.ceil(duration_s * fs_hz / n)
    with progress("samples", total, quiet) as advance:
        for k in range(total):
            epochs, counts, corr = tracker.process(k * n, samples.read(k * n, n))
            e, z = epochs[c, : counts[c]], corr[c, : counts[c], :count]
            locked = e["state"] == STATE_LOCKED
            t_s.append((e["sample_index"][locked] + 0.5 * e["n_samples"][locked]) / fs_hz)
            out.append(z[locked] / samples.amplitude)
            advance(k + 1)
    t, z = np.concatenate(t_s), np.concatenate(out)
    if not len(t):
        raise ValueError(
            "--confirm: the channel did not lock on the samples; the jammer is too strong for this point"
        )
    return t, z


class _Samples:
    """Signal, echoes, CW and noise of one trial; unit noise density of 1 per sample and component."""

    def __init__(self, twin: Twin, seed: Any, duration_s: float) -> None:
        self.twin, self.fs_hz = twin, FS_HZ[twin.signal]
        _, symbol, _, rng, echo_seed, _ = _keys(seed)
        self.cws = _cw_rows(twin.model_copy(update={"fs_hz": None}), rng)
        self.echoes = twin.multipath.start(echo_seed) if twin.multipath else None
        fresh = np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, 99))
        self.rng = np.random.Generator(np.random.Philox(fresh))
        self.bits = np.random.default_rng(int(symbol)).integers(0, 2, 100_000) * 2.0 - 1.0
        if twin.signal == "E1B" and not twin.data:
            self.bits[:] = (
                1.0  # C/A always has bits, which its synchronisation needs and no single epoch sees
            )
        slots = chip_waveform(twin.waveform or SIGNALS[twin.signal].waveform)
        chips = primary_code(twin.signal, twin.prn)
        self.slots = len(slots)
        self.wave = (chips[:, None] * slots[None, :]).astype(np.float32).ravel()
        self.symbol = len(chips) * (SIGNALS[twin.signal].symbol_periods or 1)
        cn0_dbhz = twin.cn0_dbhz - twin.loss_db
        # C/N0 = A^2 fs / (2 sigma^2), sigma = 1.
        self.amplitude = math.sqrt(2.0 * 10 ** (cn0_dbhz / 10) / self.fs_hz)
        self.noise = [
            _narrowband(twin, j, cn0_dbhz).start(
                self.fs_hz,
                0.0,
                duration_s + 1.0,
                np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, 98, i)),
            )
            for i, j in enumerate(twin.jammers)
            if isinstance(j, TwinNBI)
        ]

    def read(self, n0: int, n: int) -> np.ndarray:
        """Samples n0 .. n0 + n - 1, float32 (2, n)."""
        t = (n0 + np.arange(n)) / self.fs_hz
        z = self._code(t, 0.0).astype(np.complex128)
        if self.echoes is not None and self.echoes.n_echo:
            z += self._echo(n0, n, t)
        for f, rate, phase, ratio, start, end in self.cws.tolist():
            turn = phase + f * t + 0.5 * rate * t * t
            z += ratio * np.exp(2j * np.pi * (turn - np.floor(turn))) * ((t >= start) & (t < end))
        noise = self.rng.standard_normal((2, n), np.float32)
        iq = (self.amplitude * np.stack([z.real, z.imag]) + noise).astype(np.float32)
        for run in self.noise:
            run.add(iq, n0)
        return iq

    def _code(self, t: np.ndarray, delay_s: Any) -> np.ndarray:
        x = CHIP_RATE_HZ * (t - delay_s) + self.twin.code_phase_chips
        slot = np.floor(x * self.slots).astype(np.int64)
        return self.wave[slot % len(self.wave)] * self.bits[slot // (self.slots * self.symbol)]

    def _echo(self, n0: int, n: int, t: np.ndarray) -> np.ndarray:
        """Echoes with gain and delay held for a millisecond."""
        step = 1e-3
        first = math.floor(n0 / self.fs_hz / step)
        assert self.echoes is not None
        gain, delay_s = self.echoes.series((first + 0.5) * step, step, math.ceil(n / self.fs_hz / step) + 2)
        at = np.floor(t / step).astype(np.int64) - first
        total = np.zeros(n, np.complex128)
        for g, d in zip(gain, np.asarray(delay_s)):
            total += g[at] * self._code(t, d[at])
        return total


def _narrowband(twin: Twin, j: TwinNBI, cn0_dbhz: float) -> Narrowband:
    """The noise of a twin as a jammer of samples."""
    stop_s = None if math.isinf(j.end_s) else j.end_s
    return Narrowband(
        jn0_dbhz=j.js_db + cn0_dbhz, freq_hz=jammer_hz(twin, j), bandwidth_hz=j.bandwidth_hz, start_s=j.start_s, stop_s=stop_s
    )  # fmt: skip


def _series(
    run: Any, t_s: np.ndarray, corr: np.ndarray, twin: Twin, dumps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Mid-times and values of a monitor on a series of epochs, those near the line or of noise that is on."""
    if twin.wiped:  # by the signs that a receiver would find; a jammer takes them on
        sign = np.where(corr[:, np.argmin(np.abs(twin.tap_array_chips))].real < 0, -1, 1).astype(np.float32)
        corr = corr * sign[:, None]
    s = run.fresh()(sum_dumps(corr, dumps))
    middle = np.maximum(s["epoch"] - span(run) // 2, 0)
    t = sum_dumps(t_s[:, None], dumps)[:, 0][middle]
    if not twin.jammers:
        return t, s["value"]
    if isinstance(twin.jammers[0], TwinNBI):
        on = (t >= twin.jammers[0].start_s) & (t < twin.jammers[0].end_s)
        return t[on], s["value"][on]
    near = np.abs(offset_from_line_hz(twin, t)) * twin.integration_s * dumps < 1.0
    return t[near], s["value"][near]


def _compare(a: tuple, b: tuple, threshold: float) -> dict[str, Any]:
    """Means over whole seconds, paired: statistic and share of misses."""
    both = sorted(set(np.floor(a[0]).astype(int)) & set(np.floor(b[0]).astype(int)))
    if len(both) < 5:
        raise ValueError(
            "--confirm: fewer than 5 s of the trial are near a line and locked; lengthen trial.epochs"
        )
    mean = lambda s, f: np.array([f(s[1][np.floor(s[0]) == k]).mean() for k in both])  # noqa: E731
    out: dict[str, Any] = {"seconds": len(both)}
    for key, f in (("statistic", lambda v: v), ("missed", lambda v: (v < threshold).astype(float))):
        x, y = mean(a, f), mean(b, f)
        d = y - x
        # A misses' rate that both sides hold at a few per thousand cannot show a scatter of its own.
        error = max(float(d.std(ddof=1)) / math.sqrt(len(d)), 1e-3 if key == "missed" else 1e-9)
        out |= {
            f"{key}_twin": float(x.mean()),
            f"{key}_samples": float(y.mean()),
            f"{key}_z": float(d.mean() / error),
        }
    out["agree"] = abs(out["statistic_z"]) < Z_AGREE and abs(out["missed_z"]) < Z_AGREE
    return out


def _text(result: dict[str, Any]) -> str:
    rows = [
        f"{result['name']}, point {result['point']}: {result['duration_s']:g} s on samples of {result['fs_hz'] / 1e6:g} MHz against the twin"
    ]
    for r in result["monitors"]:
        rows.append(
            f"  {r['monitor']:16} statistic {r['statistic_samples']:.3f} (twin {r['statistic_twin']:.3f}, z {r['statistic_z']:+.1f}), "
            f"missed {r['missed_samples']:.3f} (twin {r['missed_twin']:.3f}, z {r['missed_z']:+.1f}): "
            + ("agree" if r["agree"] else "DISAGREE")
        )
    rows.append("twin and samples agree" if result["agree"] else "twin and samples DISAGREE")
    return "\n".join(rows)
