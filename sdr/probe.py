"""What is in a stranger's recording: levels, balance, spectrum, spurs, satellites, and which declaration fits it.

Every finding is a statistic of the samples themselves. Spectral inversion cannot be seen in a spectrum at zero IF,
nor by finding satellites (C/A correlates either way): it is decided by the sign of code-phase drift against carrier
Doppler. Code and carrier come from one clock, so the code of a satellite with Doppler f_d slides by f_d / 1540 chips
per second; in an inverted recording by minus that.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sdr import guess, iffile
from signals.constants import CYCLES_PER_CHIP, F_L1_HZ
from signals.modulation import SIGNALS
from tracking.acquisition import AcquisitionSpec, acquire, lowest_rate_hz

if TYPE_CHECKING:
    from sdr.options import Recording

LOOK_S = 1.0
SPUR_DB = 10.0
MUCH_BETTER = 1.5
"""Another reading must find so many times as much as the declared one to be believed instead."""

FAR_HZ = (20e3, 170e3)
"""Half widths of the searches for a recorder whose clock is far off, 13 and 100 ppm, where the usual one finds nothing."""
OFF_HZ = 6e3
"""Middle of the Dopplers from which the clock is off, and not the receiver in motion."""


def probe(path: Path, recording: "Recording", figures: Path | None = None) -> dict[str, Any]:
    """Probe a recording; returns the JSON object of the ``probe`` command, with ``text`` for people.

    Raises ValueError with one sentence for a file that cannot be read as declared.
    """
    declared = iffile.declaration(path, recording)
    tried: list[str] = []
    if declared.format is None or declared.fs_hz is None or _needs_if(declared):
        declared, tried = guess.fit(declared)
    iq, result = _findings(declared)
    if result["declaration"]["inverted"] is None:
        better = _better(declared)
        if better is not None:
            tried = [f"not as declared ({_options(declared)}): read otherwise, far more is found"]
            declared = better
            iq, result = _findings(declared)
    result["advice"] = _advice(path, result, declared.conjugate, tried)
    if figures is not None:
        result["figures"] = [str(p) for p in _draw(figures, iq, result.pop("psd"), result["spurs"])]
    result.pop("psd", None)
    result["text"] = _text(path, result)
    return result


def _findings(declared: "iffile.Declaration") -> tuple[np.ndarray, dict[str, Any]]:
    """The first second of samples, and all that is said of them; ``psd`` is for the figure alone."""
    source = iffile.open_recording(declared.data, declared)
    iq, fs_hz, if_hz = (
        source.read(min(source.n_samples, int(LOOK_S * source.fs_hz)))[1],
        source.fs_hz,
        source.if_hz,
    )
    if iq.size and np.all(iq == iq[:, :1]):
        raise ValueError(
            f"'{declared.data}': all samples of the first {iq.shape[1] / fs_hz:.3g} s are equal: the recorder was not"
            " running, or this is padding (--skip-s leaves it out)"
        )
    psd = spectrum(iq, fs_hz)
    satellites = _satellites(iq, fs_hz, if_hz)
    inverted, significance = inversion(iq, fs_hz, if_hz, satellites)
    return iq, statistics(iq) | {
        "spurs": find_spurs(*psd),
        "declaration": {
            "format": declared.format,
            "fs_hz": fs_hz,
            "if_hz": declared.if_hz or 0.0,
            # The answer is about the file: a declared conjugation is undone before it is given.
            "inverted": None if inverted is None else inverted != declared.conjugate,
            "inverted_significance": significance,
        },
        "satellites": satellites,
        "psd": psd,
    }


def _needs_if(declared: "iffile.Declaration") -> bool:
    return declared.if_hz is None and not iffile.sample_format(str(declared.format)).complex


def _better(declared: "iffile.Declaration") -> "iffile.Declaration | None":
    """Another way of reading the file that finds far more satellites; None where there is none."""
    try:
        other, _ = guess.fit(guess.undeclared(declared))
    except ValueError:
        return None
    return other if guess.score(other) > MUCH_BETTER * guess.score(declared) else None


def statistics(iq: np.ndarray) -> dict[str, Any]:
    """Level histogram, DC and I/Q balance of planar samples (2, n).

    ``iq_balance_db`` is 20 log10(rms I / rms Q); ``iq_skew_deg`` is asin of the I-Q correlation coefficient.
    """
    i, q = iq[0].astype(np.float64), iq[1].astype(np.float64)
    real = not q.any()
    dc = [float(i.mean()), float(q.mean())]
    rms_i, rms_q = i.std(), q.std()
    levels, counts = np.unique(iq[0], return_counts=True)
    if len(levels) > 256:
        counts, edges = np.histogram(iq[0], bins=64)
        levels = 0.5 * (edges[1:] + edges[:-1])
    balanced = not real and rms_i > 0 and rms_q > 0
    return {
        "levels": [{"level": float(v), "share": float(c / i.size)} for v, c in zip(levels, counts)],
        "dc": dc,
        "rms": float(np.sqrt(rms_i**2 + rms_q**2)),
        "iq_balance_db": float(20 * np.log10(rms_i / rms_q)) if balanced else None,
        "iq_skew_deg": float(np.degrees(np.arcsin(np.mean((i - dc[0]) * (q - dc[1])) / (rms_i * rms_q))))
        if balanced
        else None,
    }


def spectrum(iq: np.ndarray, fs_hz: float, n_fft: int = 4096) -> tuple[np.ndarray, np.ndarray]:
    """Welch power density (Hann, half overlap) in dB per Hz relative to the total power; frequencies in Hz."""
    z = iq[0].astype(np.float32) + 1j * iq[1].astype(np.float32)
    n_fft = min(n_fft, 1 << int(np.log2(max(z.size, 2))))
    window = np.hanning(n_fft).astype(np.float32)
    starts = range(0, z.size - n_fft + 1, n_fft // 2)
    psd = np.zeros(n_fft)
    for s in starts:
        psd += np.abs(np.fft.fft(z[s : s + n_fft] * window)) ** 2
    psd /= len(starts) * fs_hz * np.sum(window.astype(np.float64) ** 2)
    total = max(float(np.mean(np.abs(z) ** 2)), 1e-30)
    freq = np.fft.fftshift(np.fft.fftfreq(n_fft, 1 / fs_hz))
    return freq, 10 * np.log10(np.maximum(np.fft.fftshift(psd) / total, 1e-30))


def find_spurs(freq_hz: np.ndarray, psd_db: np.ndarray, most: int = 8) -> list[dict[str, float]]:
    """Narrow peaks that stand ``SPUR_DB`` above the running median of the spectrum, strongest first."""
    half = 64
    padded = np.pad(psd_db, half, mode="edge")
    floor = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1), axis=1)
    excess = psd_db - floor
    peak = (excess > SPUR_DB) & (psd_db >= np.roll(psd_db, 1)) & (psd_db >= np.roll(psd_db, -1))
    order = np.flatnonzero(peak)[np.argsort(-excess[peak])][:most]
    return [{"freq_hz": float(freq_hz[k]), "level_db": float(excess[k])} for k in order]


def inversion(
    iq: np.ndarray, fs_hz: float, if_hz: float, satellites: list[dict[str, Any]]
) -> tuple[bool | None, float | None]:
    """Whether the spectrum of ``iq`` is inverted, and the significance of the answer in standard deviations.

    Code phase is measured in a row of short dwells; the slope of its drift against f_d / 1540 is +1 for an upright
    and -1 for an inverted spectrum. None where no satellite or too little drift leaves the sign open (< 4 sigma).
    """
    n = iq.shape[1]
    dwells = max(2, min(12, int(n / fs_hz / 0.04)))
    length = n // dwells
    if length < 0.01 * fs_hz or not satellites:
        return None, None
    num = den = 0.0
    residual: list[np.ndarray] = []
    for sat in satellites:
        spec = AcquisitionSpec(p_fa=1e-2, doppler_range_hz=100.0, doppler_center_hz=sat["doppler_hz"])
        rows = [
            r[0]
            for d in range(dwells)
            if (
                r := acquire(
                    iq[:, d * length : (d + 1) * length],
                    d * length,
                    fs_hz,
                    if_hz,
                    sat["signal"],
                    [sat["prn"]],
                    spec,
                )
            ).size
            and r[0]["acquired"]
        ]
        if len(rows) < 2:
            continue
        t = np.array([float(r["sample_index"]) for r in rows]) / fs_hz
        period = SIGNALS[sat["signal"]].code_length_chips
        drift = np.unwrap(np.array([r["code_phase_chips"] for r in rows]) - t * 1.023e6, period=period)
        x = (t - t.mean()) * sat["doppler_hz"] / CYCLES_PER_CHIP
        y = drift - drift.mean()
        num, den = num + float(x @ y), den + float(x @ x)
        residual.append(np.minimum(np.abs(y - x), np.abs(y + x)))
    if den == 0.0:
        return None, None
    sigma = max(0.02, float(np.sqrt(np.mean(np.concatenate(residual) ** 2)))) / np.sqrt(den)
    slope = num / den
    significance = abs(slope) / sigma
    return (slope < 0 if significance >= 4.0 else None), float(significance)


def _satellites(iq: np.ndarray, fs_hz: float, if_hz: float) -> list[dict[str, Any]]:
    """Satellites of the first tenth of a second; where there are none, of a recorder whose clock is far off."""
    found = _search(iq, fs_hz, if_hz, AcquisitionSpec(), ("L1CA", "E1C"))
    for wide_hz in FAR_HZ if not found else ():
        far = _search(iq, fs_hz, if_hz, AcquisitionSpec(doppler_range_hz=wide_hz), ("L1CA",))
        if len(far) > 1:
            near = AcquisitionSpec(doppler_center_hz=_center_hz(far))
            return _search(iq, fs_hz, if_hz, near, ("L1CA", "E1C"))
    return found


def _search(
    iq: np.ndarray, fs_hz: float, if_hz: float, spec: AcquisitionSpec, signals: tuple[str, ...]
) -> list[dict[str, Any]]:
    window, names = (
        iq[:, : int(0.1 * fs_hz)],
        ("doppler_hz", "code_phase_chips", "cn0_dbhz", "statistic", "threshold"),
    )
    found = []
    for signal in signals:
        prns = spec.gps_prns if signal == "L1CA" else spec.galileo_prns
        too_short = window.shape[1] < 2 * fs_hz * SIGNALS[signal].code_period_s
        if too_short or fs_hz < lowest_rate_hz(signal):
            continue
        rows = acquire(window, 0, fs_hz, if_hz, signal, list(prns), spec)
        for row in rows[rows["acquired"]]:
            found.append({"signal": signal, "prn": int(row["prn"])} | {k: float(row[k]) for k in names})
    return found


def _center_hz(satellites: list[dict[str, Any]]) -> float:
    """Doppler of the recorder's clock: the middle of the satellites', to 100 Hz."""
    return round(float(np.median([s["doppler_hz"] for s in satellites])), -2) + 0.0


def _advice(path: Path, result: dict[str, Any], conjugated: bool, tried: list[str]) -> str:
    declaration, sats = result["declaration"], result["satellites"]
    parts = list(tried)
    if not sats:
        parts.append(
            "no satellite found: check --format, --fs-hz and --if-hz, and whether the antenna saw the sky"
        )
    elif declaration["inverted"] is None:
        parts.append("spectral inversion undecided: use a longer recording or one with larger Doppler")
    elif declaration["inverted"] and not conjugated:
        parts.append("the spectrum is inverted: give --conjugate to receive")
    elif not declaration["inverted"] and conjugated:
        parts.append("the spectrum is upright: do not give --conjugate")
    dc, rms = max(abs(v) for v in result["dc"]), result["rms"]
    if rms > 0 and dc > 0.1 * rms:
        parts.append(f"DC is {dc / rms:.0%} of the rms level: a line at the centre frequency")
    balance = result["iq_balance_db"]
    if balance is not None and abs(balance) > 1.0:
        parts.append(f"I and Q differ by {balance:.1f} dB")
    share = max((v["share"] for v in result["levels"]), default=0.0)
    if rms == 0:
        parts.append("all samples are equal: the recorder was not running or the file is padding")
    elif share > 0.9:
        parts.append("nearly all samples share one level: the gain is too low or the format is wrong")
    if result["spurs"]:
        parts.append(
            f"strongest spur {result['spurs'][0]['level_db']:.0f} dB above the floor at {result['spurs'][0]['freq_hz']:.0f} Hz"
        )
    options = f"--format {declaration['format']} --fs-hz {declaration['fs_hz']:.10g} --if-hz {declaration['if_hz']:.10g}"
    options += " --conjugate" if declaration["inverted"] else ""
    if sats and abs(center_hz := _center_hz(sats)) > OFF_HZ:
        parts.append(
            f"the recorder's clock is {abs(center_hz) / F_L1_HZ * 1e6:.1f} ppm off: Dopplers centre on {center_hz:+.0f} Hz"
        )
        upright_hz = -center_hz if bool(declaration["inverted"]) != conjugated else center_hz
        options += f" --set receiver.acquisition.doppler_center_hz={upright_hz:.0f}"
    parts.append(f"gnssbb receive {path} {options}")
    return "; ".join(parts)


def _options(declared: "iffile.Declaration") -> str:
    return f"{declared.format}, {(declared.fs_hz or 0.0) / 1e6:.6g} Msps, IF {(declared.if_hz or 0.0) / 1e6:.6g} MHz"


def _text(path: Path, result: dict[str, Any]) -> str:
    d = result["declaration"]
    inverted = {True: "inverted", False: "upright", None: "inversion undecided"}[d["inverted"]]
    sure = "" if d["inverted_significance"] is None else f" ({d['inverted_significance']:.1f} sigma)"
    rows = [
        f"{path}",
        f"  declaration   {d['format']}, {d['fs_hz'] / 1e6:.6g} Msps, IF {d['if_hz'] / 1e6:.6g} MHz, spectrum {inverted}{sure}",
        f"  rms level     {result['rms']:.3g}, DC {result['dc'][0]:+.3g} {result['dc'][1]:+.3g}, {len(result['levels'])} levels",
    ]
    if result["iq_balance_db"] is not None:
        rows.append(
            f"  I/Q           {result['iq_balance_db']:+.2f} dB, skew {result['iq_skew_deg']:+.2f} deg"
        )
    rows += [
        f"  spur          {s['freq_hz']:+12.0f} Hz {s['level_db']:5.1f} dB above the floor"
        for s in result["spurs"]
    ]
    rows += [
        f"  {s['signal']:5} {s['prn']:3d}     Doppler {s['doppler_hz']:+8.0f} Hz, C/N0 {s['cn0_dbhz']:4.1f} dB-Hz"
        for s in result["satellites"]
    ]
    rows += [f"  {p}" for p in result["advice"].split("; ")]
    return "\n".join(rows)


def _draw(
    directory: Path, iq: np.ndarray, psd: tuple[np.ndarray, np.ndarray], spurs: list[dict[str, float]]
) -> list[Path]:
    from sdr.figure import figure

    freq_hz, psd_db = psd

    directory.mkdir(parents=True, exist_ok=True)
    with figure(directory / "spectrum.png", "Spectrum") as ax:
        ax.plot(freq_hz / 1e6, psd_db, lw=0.8)
        for s in spurs:
            ax.axvline(s["freq_hz"] / 1e6, color="C3", lw=0.6, ls=":")
        ax.set(xlabel="frequency from the centre (MHz)", ylabel="power density (dB/Hz re total)")
    with figure(directory / "levels.png", "Level histogram") as ax:
        for row, name in zip(iq, "IQ"):
            if row.any():
                ax.hist(
                    row,
                    bins=min(256, len(np.unique(row[:100_000])) or 1),
                    histtype="step",
                    density=True,
                    label=name,
                )
        ax.set(xlabel="level", ylabel="share per level")
        ax.legend()
    return [directory / "spectrum.png", directory / "levels.png"]
