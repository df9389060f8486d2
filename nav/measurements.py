"""From channel states at one receiver sample to pseudoranges on a common receiver time, and their smoothing.

A pseudorange is c (T_rx - T_tx): receiver clock minus the satellite's own clock as read off its code. Both
are kept as whole milliseconds plus a remainder, because a float64 time of week resolves only 1.2e-10 s
(3.5 cm).
"""

import math

import numpy as np

from nav.records import OBSERVATION, TRANSMIT
from signals.constants import C_MPS, CHIP_RATE_HZ, SECONDS_PER_WEEK, WAVELENGTH_M

WEEK_MS = SECONDS_PER_WEEK * 1000
START_DELAY_S = 0.070
"""Flight time assumed of the nearest satellite when the receiver time is first set (MEO: 64 to 90 ms)."""
CODE_PERIOD_MS = {b"L1CA": 1, b"E1B": 4, b"E1C": 4}
SYSTEM_OF_SIGNAL = {b"L1CA": b"G", b"E1B": b"E", b"E1C": b"E"}


def transmit_rows(
    sample_index,
    signal,
    prn,
    period_count,
    reference_count,
    reference_tow_ms,
    code_phase_chips,
    doppler_hz,
    carrier_phase_cycles,
    cn0_dbhz,
    lock_s,
    cycle_slip,
):
    """TRANSMIT rows of C channels at one sample.

    T_tx = reference_tow_ms + (period_count - reference_count) x code period + code_phase_chips / 1.023e6.

    Parameters
    ----------
    sample_index : int, common to all channels
    signal, prn : (C,) bytes and int
    period_count, reference_count : (C,) int, primary code periods counted by the channel now and at the
        code start whose transmit time is known
    reference_tow_ms : (C,) int, transmit time of week at that code start, ms; -1 while not decoded
    code_phase_chips : (C,) float, in [0, L), at sample_index
    doppler_hz, carrier_phase_cycles, cn0_dbhz, lock_s : (C,) float;  cycle_slip : (C,) bool
    """
    signal = np.asarray(signal, dtype="S4")
    rows = np.zeros(signal.size, TRANSMIT)
    rows["sample_index"] = sample_index
    rows["signal"] = signal
    rows["prn"] = prn
    reference_tow_ms = np.asarray(reference_tow_ms, dtype=np.int64)
    period_ms = np.array([CODE_PERIOD_MS[s] for s in signal.tolist()], dtype=np.int64)
    rows["system"] = [SYSTEM_OF_SIGNAL[s] for s in signal.tolist()]
    within_s = np.asarray(code_phase_chips, dtype=float) / CHIP_RATE_HZ
    within_ms = np.floor(within_s * 1e3).astype(np.int64)
    frac_s = np.asarray(within_s - within_ms * 1e-3)
    periods = np.asarray(period_count, dtype=np.int64) - np.asarray(reference_count, dtype=np.int64)
    tow_ms = reference_tow_ms + periods * period_ms + within_ms
    rows["tow_tx_ms"] = np.where(reference_tow_ms < 0, -1, tow_ms % WEEK_MS)
    rows["tow_tx_frac_s"] = np.where(frac_s < 0.0, 0.0, frac_s)
    rows["doppler_hz"] = doppler_hz
    rows["carrier_phase_cycles"] = carrier_phase_cycles
    rows["cn0_dbhz"] = cn0_dbhz
    rows["lock_s"] = lock_s
    rows["cycle_slip"] = cycle_slip
    return rows


class ReceiverClock:
    """Receiver time of week (whole ms, remainder) of a sample index; set once, then steered by the clock
    solution."""

    def __init__(self, fs_hz):
        self.fs_hz = float(fs_hz)
        self.is_set = False
        self._sample = 0
        self._ms = 0
        self._frac_s = 0.0

    def set_from_transmit(self, rows):
        """Start: largest transmit time of the epoch + 70 ms. Rows without transmit time are ignored."""
        known = rows[rows["tow_tx_ms"] >= 0]
        if known.size == 0:
            raise ValueError("the receiver time needs one decoded transmit time, and none is decoded.")
        after_ms = _week_wrap_ms(known["tow_tx_ms"] - known["tow_tx_ms"][0])
        latest_s = float(np.max(after_ms * 1e-3 + known["tow_tx_frac_s"]))
        self._sample = int(known["sample_index"][0])
        self._ms = int(known["tow_tx_ms"][0])
        self._frac_s = latest_s + START_DELAY_S
        self.is_set = True

    def read(self, sample_index):
        """(whole ms, remainder in s in [0, 1e-3)) of the receiver time of week at a sample; ms is not
        wrapped."""
        elapsed = int(sample_index) - self._sample
        whole_s = math.floor(elapsed / self.fs_hz)
        rest_s = (elapsed - whole_s * self.fs_hz) / self.fs_hz + self._frac_s
        rest_ms = math.floor(rest_s * 1e3)
        return self._ms + whole_s * 1000 + rest_ms, rest_s - rest_ms * 1e-3

    def steer(self, bias_s):
        """Take bias_s (receiver minus GPS time) out of the receiver time."""
        self._frac_s -= float(bias_s)


def _week_wrap_ms(difference_ms):
    """Differences of times of week to [-half week, half week)."""
    return (difference_ms + WEEK_MS // 2) % WEEK_MS - WEEK_MS // 2


def observables(rows, clock):
    """OBSERVATION rows of the TRANSMIT rows whose transmit time is known; unsmoothed.

    pseudorange = c [(ms_rx - ms_tx) 1e-3 + (frac_rx - frac_tx)], the ms difference exact and week-wrapped.
    pseudorange_smoothed_m is a copy until ``Hatch`` replaces it.
    """
    known = rows[rows["tow_tx_ms"] >= 0]
    out = np.zeros(known.size, OBSERVATION)
    if known.size == 0:
        return out
    if np.any(known["sample_index"] != known["sample_index"][0]):
        raise ValueError(
            "observables of one epoch must share one sample index; take all channels at one sample."
        )
    for name in TRANSMIT.names or ():
        out[name] = known[name]
    out["tow_tx_s"] = known["tow_tx_ms"] * 1e-3 + known["tow_tx_frac_s"]
    rx_ms, rx_frac_s = clock.read(known["sample_index"][0])
    delay_s = _week_wrap_ms(rx_ms - known["tow_tx_ms"]) * 1e-3 + (rx_frac_s - known["tow_tx_frac_s"])
    out["pseudorange_m"] = C_MPS * delay_s
    out["pseudorange_smoothed_m"] = out["pseudorange_m"]
    return out


class Hatch:
    """Carrier smoothing of the code, one running mean of code minus carrier per channel.

    m_k = m_{k-1} + w (rho_k + lambda phi_k - m_{k-1}),  smoothed_k = m_k - lambda phi_k,
    w = 1/k until the window is full, then dt / window (Hatch 1982 in its recursive form; phi grows with
    Doppler, hence the plus sign). White code noise of variance s^2 leaves s^2/k, in the long run s^2 w/(2
    - w).

    A single frequency cannot remove the ionosphere's code-carrier divergence: a delay that drifts at I'
    biases the smoothed range by -2 I' window (the carrier is advanced where the code is delayed). 100 s at
    a quiet 1 mm/s cost 0.2 m; only a second frequency would allow divergence-free smoothing.
    """

    def __init__(self, window_s, fs_hz):
        if window_s < 0.0:
            raise ValueError(f"smoothing window {window_s} s is negative; use 0 to switch smoothing off.")
        self.window_s = float(window_s)
        self.fs_hz = float(fs_hz)
        self._state = {}

    def smooth(self, obs):
        """Fill ``pseudorange_smoothed_m`` in place; a slip, a lock younger than an epoch or a gap resets.

        Returns
        -------
        (n,) variance of the smoothed range over that of the raw one for white code noise,
        v_k = (1 - w)^2 v_{k-1} + w^2.
        """
        ratio = np.ones(obs.size)
        if self.window_s == 0.0:
            return ratio
        for i, row in enumerate(obs):
            key = (bytes(row["signal"]), int(row["prn"]))
            sample = int(row["sample_index"])
            phase_m = WAVELENGTH_M * float(row["carrier_phase_cycles"])
            code_minus_carrier_m = float(row["pseudorange_m"]) + phase_m
            mean, count, last, v = self._state.get(key, (0.0, 0, sample, 1.0))
            dt_s = (sample - last) / self.fs_hz
            if row["cycle_slip"] or row["lock_s"] < dt_s * (1.0 - 1e-9) or dt_s > self.window_s:
                count = 0
            count += 1
            weight = max(1.0 / count, min(1.0, dt_s / self.window_s))
            mean += weight * (code_minus_carrier_m - mean)
            ratio[i] = (1.0 - weight) ** 2 * v + weight**2
            self._state[key] = (mean, count, sample, ratio[i])
            row["pseudorange_smoothed_m"] = mean - phase_m
        return ratio

    def shift(self, step_m):
        """The receiver time was steered: every pseudorange moved by step_m."""
        self._state = {k: (m + step_m, *rest) for k, (m, *rest) in self._state.items()}
