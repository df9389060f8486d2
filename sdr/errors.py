"""Errors against truth, and the standard deviation that theory predicts for them."""

import h5py
import numpy as np

from signals.constants import CHIP_RATE_HZ, METRES_PER_CHIP, WAVELENGTH_M
from signals.modulation import SIGNALS


def hermite(x: np.ndarray, x_k: np.ndarray, y_k: np.ndarray, dy_k: np.ndarray) -> np.ndarray:
    """Cubic Hermite interpolation of values ``y_k`` with slopes ``dy_k`` at nodes ``x_k`` (ascending)."""
    k = np.clip(np.searchsorted(x_k, x, side="right") - 1, 0, len(x_k) - 2)
    h = x_k[k + 1] - x_k[k]
    s = (x - x_k[k]) / h
    return (
        (1 + 2 * s) * (1 - s) ** 2 * y_k[k]
        + s * (1 - s) ** 2 * h * dy_k[k]
        + s**2 * (3 - 2 * s) * y_k[k + 1]
        + s**2 * (s - 1) * h * dy_k[k + 1]
    )


def tracking_errors(
    epochs: np.ndarray, truth: np.ndarray, fs_hz: float, signal: str
) -> dict[str, np.ndarray]:
    """Replica minus truth for one channel.

    Parameters: ``epochs`` EPOCH rows and ``truth`` TRUTH rows of the same satellite. Returns arrays over the epochs
    inside the truth's span: ``t_s``, ``code_m``, ``phase_cycles`` (the constant of the carrier, a multiple of half a
    cycle, removed), ``doppler_hz`` and ``code_minus_carrier_m`` (its mean removed).
    """
    inside = (epochs["sample_index"] >= truth["sample_index"][0]) & (
        epochs["sample_index"] <= truth["sample_index"][-1]
    )
    e = epochs[inside]
    t = e["sample_index"] / fs_hz
    t_k = truth["sample_index"] / fs_hz
    delay = hermite(t, t_k, truth["delay_s"], truth["delay_rate_s_s"])
    phase = hermite(t, t_k, truth["carrier_phase_cycles"], truth["doppler_hz"])
    doppler = hermite(t, t_k, truth["doppler_hz"], truth["doppler_rate_hz_s"])
    length = SIGNALS[signal].code_length_chips
    code = e["code_phase_chips"] - CHIP_RATE_HZ * (t - delay)
    code = (code + 0.5 * length) % length - 0.5 * length
    d_phase = e["carrier_phase_cycles"] - phase
    d_phase -= np.round(2 * np.median(d_phase)) / 2 if len(d_phase) else 0.0
    cmc = code * METRES_PER_CHIP - d_phase * WAVELENGTH_M
    return {
        "t_s": t,
        "code_m": code * METRES_PER_CHIP,
        "phase_cycles": d_phase,
        "doppler_hz": e["doppler_hz"] - doppler,
        "code_minus_carrier_m": cmc - (np.mean(cmc) if len(cmc) else 0.0),
    }


def position_errors(solution: np.ndarray, truth: np.ndarray, fs_hz: float) -> np.ndarray:
    """Estimated minus true position in local east, north, up metres, shape (n, 3)."""
    from signals.geodesy import ecef_to_geodetic, ned_matrix

    t, t_k = solution["sample_index"] / fs_hz, truth["sample_index"] / fs_hz
    true = np.stack(
        [hermite(t, t_k, truth["pos_ecef_m"][:, i], truth["vel_ecef_mps"][:, i]) for i in range(3)], axis=1
    )
    lat_rad, lon_rad, _ = ecef_to_geodetic(true[:1])
    ned = (solution["pos_ecef_m"] - true) @ ned_matrix(lat_rad[0], lon_rad[0]).T
    return ned[:, [1, 0, 2]] * [1.0, 1.0, -1.0]


def satellite_truth(h5: h5py.File, system: bytes, prn: int) -> np.ndarray:
    """TRUTH rows of one satellite, empty if the file has none."""
    if "truth/satellites" not in h5:
        return np.empty(0)
    rows = h5["truth/satellites"][:]
    return rows[(rows["system"] == system) & (rows["prn"] == prn)]


def levels_and_errors(
    solution: np.ndarray, true_ecef_m: np.ndarray, levels: np.ndarray
) -> dict[str, tuple[np.ndarray, np.ndarray, float]]:
    """{"horizontal", "vertical"}: |error|, protection level (n,), alert limit, at the epochs that have both.

    ``solution`` SOLUTION (n,), ``true_ecef_m`` (n, 3) at its samples, ``levels`` rows of ``monitors/protection``.
    """
    from signals.geodesy import ecef_to_geodetic, ned_matrix

    _, i, j = np.intersect1d(solution["sample_index"], levels["sample_index"], return_indices=True)
    lat_rad, lon_rad, _ = ecef_to_geodetic(true_ecef_m[:1])
    ned = (solution["pos_ecef_m"][i] - true_ecef_m[i]) @ ned_matrix(lat_rad[0], lon_rad[0]).T
    h = levels[j]
    return {
        "horizontal": (np.hypot(ned[:, 0], ned[:, 1]), h["hpl_m"], float(levels["hal_m"][0])),
        "vertical": (np.abs(ned[:, 2]), h["vpl_m"], float(levels["val_m"][0])),
    }


def stanford_counts(
    solution: np.ndarray, true_ecef_m: np.ndarray, levels: np.ndarray
) -> dict[str, dict[str, int]]:
    """Epochs in each region of the Stanford diagram; "hazardous" counts HMI."""
    from monitors.protection import stanford

    parts = levels_and_errors(solution, true_ecef_m, levels)
    return {k: stanford(error, level, limit) for k, (error, level, limit) in parts.items()}
