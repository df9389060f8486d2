"""Figures of a results file: tracking errors, C/N0, I/Q, correlation function, sky and position."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sdr import store
from sdr.errors import position_errors, satellite_truth, tracking_errors
from sdr.figure import attacks, canvas, channel_name, figure


def plot(results: Path, directory: Path | None = None) -> list[Path]:
    """Draw every figure that ``results`` has data for; returns their paths."""
    from sdr.integrity_figures import integrity, stanford
    from sdr.truth_figures import echoes, motion
    from sdr.watch.figures import alarms, monitors

    directory = directory or Path(results).with_suffix("")
    with store.read(results) as h5:
        if "campaign/points" in h5:
            from sdr.campaign import figures

            return figures.plot(results, directory)
        directory.mkdir(parents=True, exist_ok=True)
        channels = _channels(h5)
        drawn = []
        for draw in (
            _tracking_errors,
            _cn0,
            _iq,
            _correlation,
            _sky,
            _position,
            _spectrum,
            _attack,
            _attacked_peak,
            motion,
            echoes,
            monitors,
            alarms,
            integrity,
            stanford,
        ):
            path = draw(h5, channels, directory)
            if path is not None:
                drawn.append(path)
    if not drawn:
        raise ValueError(f"'{results}' has nothing to draw: no satellite was tracked")
    return drawn


def _channels(h5: h5py.File) -> dict[str, h5py.Group]:
    return {n: g for n, g in h5.get("tracking", {}).items() if len(g["epochs"])}


def _tracking_errors(h5: h5py.File, channels: dict[str, h5py.Group], directory: Path) -> Path | None:
    """Errors in time, all satellites; beside them each satellite's rms against its thermal sigma."""
    with_truth = {}
    for name, group in channels.items():
        attrs = group["epochs"].attrs
        truth = satellite_truth(h5, b"G" if attrs["signal"] == "L1CA" else b"E", attrs["prn"])
        if len(truth) > 1:
            with_truth[name] = tracking_errors(group["epochs"][:], truth, attrs["fs_hz"], attrs["signal"])
    if not with_truth:
        return None
    path = directory / "tracking_errors.png"
    with figure(
        path, "Tracking errors: replica minus truth", rows=4, size=(12, 10), widths=(3.0, 1.0)
    ) as axes:
        for row, (key, label, theory) in zip(axes, ERRORS, strict=True):
            _one_error(row, key, theory, with_truth, channels)
            row[0].set_ylabel(label)
        axes[-1, 0].set_xlabel("time (s)")
        axes[-1, 1].tick_params(axis="x", rotation=90, labelsize=7)
        axes[0, 1].set_title("rms of each satellite", fontsize=9)
        axes[0, 1].legend(fontsize=7)
    return path


ERRORS = (
    ("code_m", "code (m)", "code_sigma_m"),
    ("phase_cycles", "phase (cycle)", "phase_sigma_cycles"),
    ("doppler_hz", "Doppler (Hz)", None),
    ("code_minus_carrier_m", "code − carrier (m)", None),
)
"""Column of the tracking errors, its label, and the attribute of the epochs that holds its thermal sigma."""


def _one_error(
    row: Any, key: str, theory: str | None, with_truth: dict[str, Any], channels: dict[str, h5py.Group]
) -> None:
    """One kind of error: over time in the left axes, rms and thermal sigma of each satellite in the right."""
    spans = []
    for k, (name, errors) in enumerate(with_truth.items()):
        attrs, label = channels[name]["epochs"].attrs, channel_name(channels[name])
        settled = errors["t_s"] > errors["t_s"][:1] + 2.0
        values = errors[key][settled]
        row[0].plot(errors["t_s"][settled], values, lw=0.5, alpha=0.6, color=f"C{k}")
        if not len(values):
            continue
        spans.append(values)
        first = not k
        row[1].plot(
            label, np.sqrt(np.mean(values**2)), "o", color=f"C{k}", label="measured" if first else None
        )
        if theory and theory in attrs:
            row[1].plot(label, attrs[theory], "k_", ms=12, label="thermal σ" if first else None)
    limit = 1.3 * float(np.quantile(np.abs(np.concatenate(spans)), 0.999)) if spans else 1.0
    row[0].set_ylim(-limit or -1, limit or 1)
    row[1].set_ylim(0, 1.35 * row[1].dataLim.y1 or 1)


def _cn0(h5: h5py.File, channels: dict[str, h5py.Group], directory: Path) -> Path | None:
    if not channels:
        return None
    path = directory / "cn0.png"
    adapts = any(np.ptp(bw[bw > 0]) > 0 for bw in map(_bandwidth, channels.values()) if (bw > 0).any())
    with figure(path, "Carrier-to-noise density", rows=3 if adapts else 1) as axes:
        for group in channels.values():
            e = group["epochs"]
            t_s, label = e["sample_index"] / e.attrs["fs_hz"], channel_name(group)
            for ax, key in zip(np.ravel(axes), ("cn0_dbhz", "pll_bw_hz", "dll_bw_hz")):
                ax.plot(t_s, np.where(e[key] > 0, e[key], np.nan), lw=0.8, label=label)
        for ax, name in zip(
            np.ravel(axes), ("C/N0 (dB-Hz)", "PLL bandwidth used (Hz)", "DLL bandwidth used (Hz)")
        ):
            ax.set_ylabel(name)
        np.ravel(axes)[-1].set_xlabel("time (s)")
        np.ravel(axes)[0].legend(ncol=8, fontsize=7)
    return path


def _bandwidth(group: h5py.Group) -> np.ndarray:
    """Noise bandwidths of the carrier loop in force; 0: steered, pulling in or settling."""
    return np.asarray(group["epochs"]["pll_bw_hz"])


def _iq(h5: h5py.File, channels: dict[str, h5py.Group], directory: Path) -> Path | None:
    if not channels:
        return None
    path = directory / "iq.png"
    columns = min(4, len(channels))
    rows = -(-len(channels) // columns)
    fig = canvas((2.4 * columns, 2.5 * rows))
    fig.suptitle("Prompt correlator, last 2000 integrations (ADC levels)")
    for k, group in enumerate(channels.values()):
        ax = fig.add_subplot(rows, columns, k + 1)
        e = group["epochs"][-2000:]
        ax.plot(e["prompt_i"], e["prompt_q"], ".", ms=1.5, alpha=0.4)
        limit = 1.1 * float(max(np.abs(e["prompt_i"]).max(), np.abs(e["prompt_q"]).max(), 1e-9))
        ax.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal", title=channel_name(group))
        ax.tick_params(labelsize=6)
        ax.grid(alpha=0.3)
    fig.savefig(path, dpi=130)
    return path


def _correlation(h5: h5py.File, channels: dict[str, h5py.Group], directory: Path) -> Path | None:
    grouped = {n: g for n, g in channels.items() if "corr" in g and g["corr"].shape[1] >= 3}
    if not grouped:
        return None
    from signals.modulation import chip_acf

    path = directory / "correlation.png"
    with figure(path, "Correlation function across the taps, last second") as ax:
        for group in grouped.values():
            corr, taps = group["corr"][-50:], group["corr"].attrs["taps_chips"]
            prompt = int(np.argmin(np.abs(taps)))
            aligned = np.mean(corr * np.exp(-1j * np.angle(corr[:, prompt : prompt + 1])), axis=0).real
            order = np.argsort(taps)
            ax.plot(
                taps[order], aligned[order] / aligned[prompt], ".-", ms=4, lw=0.8, label=channel_name(group)
            )
        attrs = next(iter(grouped.values()))["corr"].attrs
        d = np.linspace(-1.5, 1.5, 601)
        ax.plot(d, chip_acf(d, attrs["waveform"], attrs["waveform"]), "k", lw=0.8, alpha=0.5, label="ideal")
        ax.set(xlabel="tap offset (chip, early positive)", ylabel="amplitude re prompt")
        ax.legend(ncol=6, fontsize=7)
    return path


def _sky(h5: h5py.File, channels: dict[str, h5py.Group], directory: Path) -> Path | None:
    if "truth/satellites" not in h5 and "navigation/satellites" not in h5:
        return None
    rows = h5["truth/satellites" if "truth/satellites" in h5 else "navigation/satellites"][:]
    rows = rows[rows["elevation_rad"] > 0]
    if not len(rows):
        return None
    tracked = {channel_name(g) for g in channels.values()}
    path = directory / "sky.png"
    with figure(path, "Sky", projection="polar", size=(6, 6)) as ax:
        ax.set_theta_zero_location("N")
        ax.set_theta_direction(-1)
        for system, prn in sorted({(r["system"], r["prn"]) for r in rows}):
            one = rows[(rows["system"] == system) & (rows["prn"] == prn)]
            name = f"{system.decode()}{prn:02d}"
            zenith_deg = 90 - np.degrees(one["elevation_rad"])
            color = {b"G": "C0", b"E": "C1"}[system] if name in tracked else "0.6"
            ax.plot(one["azimuth_rad"], zenith_deg, color=color, lw=1)
            ax.plot(one["azimuth_rad"][-1], zenith_deg[-1], "o", color=color)
            ax.annotate(
                name,
                (one["azimuth_rad"][-1], zenith_deg[-1]),
                xytext=(5, 5),
                textcoords="offset points",
                fontsize=8,
            )
        ax.set_rlim(0, 90)
        ax.set_rticks([15, 30, 45, 60, 75], labels=["75°", "60°", "45°", "30°", "15°"], fontsize=6)
    return path


def _position(h5: h5py.File, channels: dict[str, h5py.Group], directory: Path) -> Path | None:
    if "navigation/solution" not in h5:
        return None
    solution = h5["navigation/solution"][:]
    solution = solution[solution["valid"]]
    if not len(solution):
        return None
    path = directory / "position.png"
    fs_hz = h5["navigation/solution"].attrs["fs_hz"]
    truth = h5["truth/receiver"][:] if "truth/receiver" in h5 else None
    from signals.geodesy import ecef_to_geodetic, ned_matrix

    if truth is not None:
        enu, title = position_errors(solution, truth, fs_hz), "Position error against truth"
    else:
        mean = solution["pos_ecef_m"].mean(axis=0)
        lat_rad, lon_rad, _ = ecef_to_geodetic(mean[None])
        enu = ((solution["pos_ecef_m"] - mean) @ ned_matrix(lat_rad[0], lon_rad[0]).T)[:, [1, 0, 2]] * [
            1,
            1,
            -1,
        ]
        title = "Position about its mean"
    with figure(path, title, rows=2, size=(9, 7)) as (ax, ax_n):
        for k, name in enumerate(("east", "north", "up")):
            ax.plot(
                solution["t_s"],
                enu[:, k],
                lw=0.9,
                label=f"{name}, rms {np.sqrt(np.mean(enu[:, k] ** 2)):.2f} m",
            )
        ax.set_ylabel("m")
        ax.legend(fontsize=8)
        ax_n.step(solution["t_s"], solution["n_used"], where="post", label="satellites used")
        ax_n.plot(solution["t_s"], solution["pdop"], label="PDOP")
        ax_n.set_xlabel("time (s)")
        ax_n.legend(fontsize=8)
    return path


def _spectrum(h5: h5py.File, channels: dict[str, h5py.Group], directory: Path) -> Path | None:
    """Waterfall of what was received, and its mean with and without attack."""
    if "samples/spectrum" not in h5 or len(h5["samples/spectrum"]) < 2:
        return None
    data = h5["samples/spectrum"]
    rows, attrs = data[:], data.attrs
    freq_mhz = ((np.arange(rows.shape[1]) / rows.shape[1] - 0.5) * attrs["fs_hz"] - attrs["if_hz"]) * 1e-6
    t_s = np.arange(len(rows)) * attrs["every_s"]
    on = np.any([(t_s >= a) & (t_s < b) for a, b in attacks(h5)] or [np.zeros(len(t_s), bool)], axis=0)
    parts = [("without jammer" if on.any() else "mean", rows[~on]), ("with jammer", rows[on])]
    if "mitigation/spectrum" in h5:
        cleaned = h5["mitigation/spectrum"][:]
        parts.append(("with jammer, after the mitigation", cleaned[on[: len(cleaned)]]))
    path = directory / "spectrum.png"
    with figure(path, "Spectrum of the samples", rows=2, size=(9, 8)) as (ax, fall):
        for label, part in parts:
            if len(part):
                ax.plot(freq_mhz, 10 * np.log10(np.mean(10 ** (part / 10), axis=0)), lw=0.9, label=label)
        ax.set_ylabel("power per bin (dB re ADC level²)")
        ax.legend(fontsize=8)
        low, high = np.quantile(rows, [0.02, 0.999])
        image = fall.pcolormesh(freq_mhz, t_s, rows, vmin=low, vmax=high, shading="nearest", rasterized=True)
        fall.figure.colorbar(image, ax=[ax, fall], label="dB", shrink=0.5)
        if "mitigation/tones" in h5 and len(h5["mitigation/tones"]):
            tones = h5["mitigation/tones"][:]
            fall.plot(
                tones["freq_hz"] * 1e-6,
                tones["sample_index"] / attrs["fs_hz"],
                "r.",
                ms=2,
                label="tones found",
            )
            fall.legend(fontsize=8)
        fall.set(xlabel="offset from the carrier (MHz)", ylabel="time (s)")
    return path


def _attack(h5: h5py.File, channels: dict[str, h5py.Group], directory: Path) -> Path | None:
    """C/N0, code and carrier errors, the attack shaded."""
    spans = attacks(h5)
    if not spans or not channels:
        return None
    path = directory / "attack.png"
    seen: tuple[list, list] = ([], [])
    with figure(path, "Under attack (shaded)", rows=3, size=(9, 8)) as axes:
        for k, group in enumerate(channels.values()):
            e, color = group["epochs"][:], f"C{k}"
            attrs = group["epochs"].attrs
            t_s = e["sample_index"] / attrs["fs_hz"]
            late = t_s > t_s[0] + 0.5  # the first estimates are of a few integrations
            axes[0].plot(t_s[late], e["cn0_dbhz"][late], lw=0.8, color=color, label=channel_name(group))
            truth = satellite_truth(h5, b"G" if attrs["signal"] == "L1CA" else b"E", attrs["prn"])
            if len(truth) > 1:
                errors = tracking_errors(e, truth, attrs["fs_hz"], attrs["signal"])
                settled = errors["t_s"] > errors["t_s"][:1] + 1.0
                for ax, values, key in zip(axes[1:], seen, ("code_m", "doppler_hz"), strict=True):
                    ax.plot(errors["t_s"], errors[key], lw=0.6, color=color)
                    values.append(np.abs(errors[key][settled]))
        for ax, values, least, most in zip(axes[1:], seen, (5.0, 1.0), (300.0, 50.0), strict=True):
            widest = max((np.quantile(v, 0.999) for v in values if len(v)), default=least)
            limit = 1.2 * float(np.clip(widest, least, most))
            ax.set_ylim(-limit, limit)
        for ax, label in zip(axes, ("C/N0 (dB-Hz)", "code (m)", "Doppler (Hz)"), strict=True):
            ax.set_ylabel(label)
            for begin, end in spans:
                ax.axvspan(begin, end, color="C3", alpha=0.12, lw=0)
        axes[0].legend(ncol=10, fontsize=7, loc="lower center", bbox_to_anchor=(0.5, 1.0))
        axes[-1].set_xlabel("time (s)")
    return path


def _attacked_peak(h5: h5py.File, channels: dict[str, h5py.Group], directory: Path) -> Path | None:
    """Correlation function of the satellite that is hit hardest, before and during the attack."""
    spans = attacks(h5)
    hit = [g for g in channels.values() if "corr" in g and g["corr"].shape[1] >= 3 and len(g["epochs"]) > 100]
    if not spans or not hit:
        return None

    def parts(group: h5py.Group) -> tuple[np.ndarray, np.ndarray]:
        t_s = group["epochs"]["sample_index"] / group["epochs"].attrs["fs_hz"]
        inside = np.any([(t_s > a + 0.1) & (t_s < b - 0.1) for a, b in spans], axis=0)
        return (t_s < spans[0][0]) & (t_s > t_s[0] + 1.0), inside

    def distortion(group: h5py.Group) -> float:
        before, during = parts(group)
        magnitude = np.abs(group["corr"][:])
        if before.sum() < 10 or during.sum() < 10:
            return -1.0
        clean = magnitude[before].mean(axis=0)
        return float(np.mean(np.abs(magnitude[during].mean(axis=0) - clean)) / clean.max())

    group = max(hit, key=distortion)
    if distortion(group) < 0:
        return None
    before, during = parts(group)
    taps = group["corr"].attrs["taps_chips"]
    order, path = np.argsort(taps), directory / "correlation_attack.png"
    prompt = int(np.argmin(np.abs(taps)))
    with figure(
        path, f"Correlation function of {channel_name(group)}: in-phase part, 10 to 90 % of the epochs"
    ) as ax:
        for mask, label, color in ((before, "before", "C0"), (during, "during", "C3")):
            corr = group["corr"][:][mask]
            real = (corr * np.exp(-1j * np.angle(corr[:, prompt : prompt + 1]))).real[:, order]
            low, middle, high = np.quantile(real, [0.1, 0.5, 0.9], axis=0)
            ax.plot(taps[order], middle, ".-", ms=4, color=color, label=f"{label} the attack")
            ax.fill_between(taps[order], low, high, color=color, alpha=0.2, lw=0)
        ax.set(xlabel="tap offset (chip, early positive)", ylabel="amplitude (ADC levels)")
        ax.legend(fontsize=8)
    return path
