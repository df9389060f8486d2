"""Tracking channels: the Specs that describe them and the Run that owns their state."""

import math
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from signals.codes import secondary_code
from signals.constants import CHIP_RATE_HZ, F_L1_HZ
from signals.modulation import BLOCK, SIGNALS, autocorrelation, chip_acf, code_table, sampled_band_hz
from tracking.discriminators import (
    CARRIER_DISCRIMINATORS,
    CODE_DISCRIMINATORS,
    CodeDiscriminator,
    CostasDiscriminator,
    code_scale_chips,
)
from tracking.kernels import CHANNEL, HISTORY, KIND_CA, KIND_DATA, KIND_PILOT, SYMBOL, survey, track_slab
from tracking.lock import STATE_BIT_SYNC, STATE_IDLE, STATE_LOCKED, STATE_LOST, STATE_PULL_IN
from tracking.loops import MAX_BT, adapted_gains, dll_gains, fll_gain, pll_gains
from tracking.records import AIDING, EPOCH, REPLICA
from tracking.vector_ir import HAS_INTEGER_PATH, LONGEST_MULTILEVEL

__all__ = [
    "STATE_BIT_SYNC",
    "STATE_IDLE",
    "STATE_LOCKED",
    "STATE_LOST",
    "STATE_PULL_IN",
    "AdaptSpec",
    "E1Tracking",
    "L1caTracking",
    "TapsSpec",
    "Tracker",
    "TrackingSpec",
]

_FROZEN = ConfigDict(frozen=True, extra="forbid")
_BOC61_FITS_HZ = 15e6  # below it the BOC(6,1) part of CBOC is not in the samples (signals.modulation)
_MAX_TABLE_RATE_HZ = 330e6  # rows per sample x fs: bounds a table's size at high rates


def _text(signal):
    """A fixed-width bytes field (array scalar or 0-d array) as text."""
    return np.asarray(signal).item().decode()


class TapsSpec(BaseModel):
    """A multicorrelator window: offsets k * spacing_chips, k = -(count - 1) / 2 .. (count - 1) / 2."""

    model_config = _FROZEN
    count: int = Field(ge=1, le=255)
    """Number of taps, odd."""
    spacing_chips: float = Field(gt=0.0, le=10.0)
    """Distance between taps."""

    @field_validator("count")
    @classmethod
    def _odd(cls, count):
        if count % 2 == 0:
            raise ValueError(f"count = {count}: a window about the prompt has an odd number of taps")
        return count


class AdaptSpec(BaseModel):
    """Loop bandwidths that follow the C/N0 of the last tenth of a second, down from ``pll_bw_hz`` and ``dll_bw_hz``.

    Each loop takes the bandwidth at which noise and dynamic stress together are least (``tracking.loops``): about the 7th
    root of C/N0 for the carrier, the 3rd for the code. What a monitor asks for (``receiver.respond``) counts as so
    much more noise.
    """

    model_config = _FROZEN
    jerk_mps3: float = Field(1.0, gt=0.0, le=1e4)
    """Jerk along the line of sight that the carrier loop must bear."""
    code_drift_mps: float = Field(0.1, gt=0.0, le=100.0)
    """Rate at which the code may leave the carrier that aids it."""
    pll_min_hz: float = Field(2.0, gt=0.0, le=100.0)
    """Least noise bandwidth of the carrier loop."""
    dll_min_hz: float = Field(0.05, gt=0.0, le=10.0)
    """Least noise bandwidth of the code loop."""
    cn0_s: float = Field(0.1, ge=0.02, le=10.0)
    """Time constant of the C/N0 that they follow."""


class _Loops(BaseModel):
    """Loop settings that both signals share. Bandwidths are one-sided noise bandwidths."""

    model_config = _FROZEN
    pll_order: Literal[2, 3] = 3
    """Order of the carrier loop."""
    pll_bw_hz: float = Field(10.0, gt=0.0, le=300.0)
    """Noise bandwidth of the carrier loop, one-sided."""
    dll_order: Literal[1, 2] = 1
    """Order of the code loop, which the carrier aids."""
    dll_bw_hz: float = Field(1.0, gt=0.0, le=50.0)
    """Noise bandwidth of the code loop, one-sided."""
    fll_bw_hz: float = Field(0.0, ge=0.0, le=50.0)
    """Noise bandwidth of the frequency aid; 0: none."""
    code_discriminator: CodeDiscriminator = "envelope"
    """Code discriminator."""
    taps: TapsSpec | None = None
    """Window of additional correlator taps; unset: E, P, L alone."""
    adapt: AdaptSpec | None = None
    """Bandwidths follow the noise; unset: they are fixed."""

    def _check(self, T_s):
        if self.adapt is not None:
            self._check_adapt(self.adapt)
        pll_gains(self.pll_order, self.pll_bw_hz, T_s)
        dll_gains(self.dll_order, self.dll_bw_hz, T_s)
        fll_gain(self.fll_bw_hz, T_s)

    def _check_adapt(self, adapt):
        if (self.pll_order, self.dll_order) != (3, 1):
            raise ValueError("adapt is made for pll_order = 3 and dll_order = 1: leave them as they are")
        for key in ("pll", "dll"):
            least, greatest = getattr(adapt, f"{key}_min_hz"), getattr(self, f"{key}_bw_hz")
            if least > greatest:
                raise ValueError(
                    f"adapt.{key}_min_hz = {least:g} lies above {key}_bw_hz = {greatest:g}: swap them"
                )


class L1caTracking(_Loops):
    """GPS L1 C/A channels. ``early_late_space_chips`` is the whole spacing between E and L."""

    integration_ms: Literal[1, 2, 4, 5, 10, 20] = 20
    """Coherent integration after bit synchronisation."""
    early_late_space_chips: float = Field(0.5, gt=0.0, lt=2.0)
    """Whole spacing between early and late."""
    carrier_discriminator: CostasDiscriminator = "costas_atan"
    """Phase discriminator, insensitive to data."""

    @model_validator(mode="after")
    def _stable(self):
        self._check(self.integration_ms * 1e-3)
        if self.code_discriminator == "very_early_late":
            raise ValueError('code_discriminator = "very_early_late" belongs to BOC signals: use "envelope"')
        return self


class E1Tracking(_Loops):
    """Galileo E1 channels: the pilot E1-C (pure PLL after secondary-code synchronisation) or the data E1-B
    alone.
    """

    component: Literal["pilot", "data"] = "pilot"
    """The pilot E1-C carries the loops, or the data E1-B alone."""
    integration_ms: int = Field(20, ge=4, le=100)
    """Coherent integration."""
    replica: Literal["BOC11", "CBOC"] = "BOC11"
    """Waveform of the replica."""
    early_late_space_chips: float = Field(
        default_factory=lambda data: 0.1 if data.get("replica") == "CBOC" else 0.25, gt=0.0, lt=0.6
    )
    """Whole spacing between early and late; 0.1 with a CBOC replica, whose peak has no slope at 0.25."""
    very_early_late_space_chips: float = Field(1.0, ge=0.8, le=1.2)
    """Whole spacing between very early and very late."""
    side_peak_protection: bool = True
    """Jump back when a side peak of the BOC correlation is tracked."""

    @model_validator(mode="after")
    def _stable(self):
        if self.integration_ms % 4:
            raise ValueError(
                f"integration_ms = {self.integration_ms}: E1 integrates whole codes, a multiple of 4"
            )
        if self.component == "data" and self.integration_ms != 4:
            raise ValueError(
                f"integration_ms = {self.integration_ms}: E1-B carries a new symbol every 4 ms; "
                'use 4, or component = "pilot"'
            )
        self._check(self.integration_ms * 1e-3)
        return self


class TrackingSpec(BaseModel):
    """Section ``[tracking]``: loops, taps and lock detectors of all channels.

    ``arithmetic``: "auto" correlates int8 samples in 16-bit integers where the processor allows (-90 dB), everything
    else in single precision (-100 dB); "float" never uses integers, for results that are alike on all processors.
    """

    model_config = _FROZEN
    l1ca: L1caTracking = L1caTracking()
    e1: E1Tracking = E1Tracking()
    cn0_window_s: float = Field(1.0, ge=0.05, le=30.0)
    """Window of the C/N0 estimators."""
    cn0_min_dbhz: float = Field(22.0, ge=0.0, le=60.0)
    """A channel weaker than this is not locked."""
    lock_in: float = Field(0.7, gt=0.0, lt=1.0)
    """Carrier-lock indicator from which a channel counts as locked."""
    lock_out: float = Field(0.4, gt=-1.0, lt=1.0)
    """Carrier-lock indicator below which it no longer does."""
    lost_after_s: float = Field(1.0, gt=0.0, le=600.0)
    """A channel without lock for this long is given up."""
    settle_s: float = Field(0.6, ge=0.2, le=10.0)
    """Least length of each stage of the pull-in."""
    pull_in_dll_bw_hz: float = Field(4.0, gt=0.0, le=20.0)
    """Code loop before bit synchronisation."""
    settle_pll_bw_hz: float = Field(12.0, gt=0.0, le=15.0)
    """Carrier loop while settling."""
    settle_fll_bw_hz: float = Field(1.0, ge=0.0, le=10.0)
    """Frequency aid while settling."""
    settle_dll_bw_hz: float = Field(2.0, gt=0.0, le=10.0)
    """Code loop while settling."""
    threads: int = Field(1, ge=1, le=64)
    """Threads of the correlators; the results do not depend on it."""
    arithmetic: Literal["auto", "float"] = "auto"
    """Integer correlation where possible, or single precision everywhere."""

    @model_validator(mode="after")
    def _hysteresis(self):
        if self.lock_out >= self.lock_in:
            raise ValueError(f"lock_out = {self.lock_out:g} must be below lock_in = {self.lock_in:g}")
        return self

    def start(self, fs_hz, if_hz=0.0, prn_path=None):
        """Begin tracking samples of rate ``fs_hz`` at intermediate frequency ``if_hz`` -> Tracker."""
        return Tracker(self, fs_hz, if_hz, prn_path)


class Tracker:
    """All channels of a receiver: give it slabs, get integrations. Made by ``TrackingSpec.start``.

    Attributes
    ----------
    channels : CHANNEL (C,)
        Full state of every channel (``tracking.kernels``); read it, do not write.
    symbols, symbol_counts : SYMBOL (C, n), int64 (C,)
        Data symbols of the last slab.
    """

    def __init__(self, spec, fs_hz, if_hz=0.0, prn_path=None):
        if not (math.isfinite(fs_hz) and fs_hz >= CHIP_RATE_HZ):
            raise ValueError(
                f"fs_hz = {fs_hz:g}: tracking needs at least {CHIP_RATE_HZ:g} samples per second"
            )
        if not abs(if_hz) <= fs_hz / 2:
            raise ValueError(f"if_hz = {if_hz:g} lies beyond half the sampling rate {fs_hz:g}")
        self.spec, self.fs_hz, self.if_hz, self.prn_path = spec, float(fs_hz), float(if_hz), prn_path
        self.channels = np.zeros(0, CHANNEL)
        self.symbols, self.symbol_counts = np.zeros((0, 0), SYMBOL), np.zeros(0, np.int64)
        self._taps, self._windows = [], []
        self._tap_q = np.zeros((0, 3), np.int64)
        self._acc = np.zeros((0, 6))
        self._hist = np.zeros((0, HISTORY, 2))
        self._commands = np.zeros(0, AIDING)
        self._pool, self._tables = np.zeros(0, np.int8), {}
        self._shortest_s, self._longest_s = 4e-3, 0.0
        self._tail, self._end, self._begun = np.zeros((2, 0), np.int8), 0, False
        self._secondary = np.asarray(secondary_code(), np.float64)
        self._threads = ThreadPoolExecutor(spec.threads - 1) if spec.threads > 1 else None

    # ------------------------------------------------------------------------------------------- channels
    def add(self, acquisition):
        """Start a channel from one ACQUISITION row -> channel index.

        The channel begins at the next sample that will be processed (or, before the first slab, at the row's
        own sample); the code phase is carried there with the row's Doppler. A channel that was lost or
        released leaves its index to the next one.
        """
        signal = _text(acquisition["signal"])
        if signal not in SIGNALS:
            raise ValueError(f"signal {signal!r} is unknown: use one of {', '.join(SIGNALS)}")
        prn = int(acquisition["prn"])
        st, offsets, n_window = self._describe(signal, prn)
        c = self._slot()
        self._place(c, st, offsets, n_window)
        start = self._end if self._begun else int(acquisition["sample_index"])
        doppler = float(acquisition["doppler_hz"])
        rate = CHIP_RATE_HZ * (1.0 + doppler / F_L1_HZ) / self.fs_hz
        phase = float(acquisition["code_phase_chips"]) + (start - int(acquisition["sample_index"])) * rate
        length = float(st["code_length_chips"])
        n = math.ceil((length - phase % length) / rate)
        st["next_sample"], st["code_phase_chips"] = start + n, phase % length + n * rate - length
        st["doppler_hz"] = st["rate_hz"] = doppler
        st["state"] = STATE_PULL_IN
        self.channels[c] = st
        self._shortest_s = min(self._shortest_s, float(st["period_s"]))
        self._longest_s = max(self._longest_s, float(st["period_s"]))
        return c

    def release(self, c):
        """Stop channel ``c`` and free its index."""
        self.channels["state"][c] = STATE_IDLE

    def lost(self):
        """Indices of channels that lost lock: acquire their satellites again and ``add`` them."""
        return np.flatnonzero(self.channels["state"] == STATE_LOST)

    def taps_chips(self, c):
        """True offsets of all taps of channel ``c``, chips, in the order of ``corr[c, k]`` (first the
        window).
        """
        return self._taps[c]

    def window(self, c):
        """Number of leading taps that form the multicorrelator window the Spec asked for (0: none)."""
        return self._windows[c]

    def _slot(self):
        free = np.flatnonzero(np.isin(self.channels["state"], (STATE_IDLE, STATE_LOST)))
        if len(free):
            return int(free[0])
        grow = lambda a: np.concatenate([a, np.zeros((1, *a.shape[1:]), a.dtype)])  # noqa: E731
        self.channels, self._tap_q, self._acc = grow(self.channels), grow(self._tap_q), grow(self._acc)
        self._hist, self._commands = grow(self._hist), grow(self._commands)
        self._taps.append(None)
        self._windows.append(0)
        return len(self.channels) - 1

    def _place(self, c, st, offsets, n_window):
        """Tap offsets in 1/P samples; the arrays grow to the widest channel."""
        n_taps = len(offsets)
        wide = n_taps + 2
        if wide > self._tap_q.shape[1]:
            more = wide - self._tap_q.shape[1]
            self._tap_q = np.pad(self._tap_q, ((0, 0), (0, more)))
            self._acc = np.pad(self._acc, ((0, 0), (0, 2 * more)))
        per_chip = float(st["samples_per_chip"]) * int(st["n_phase"])
        q = np.round(np.asarray(offsets) * per_chip).astype(np.int64)
        noise = self._noise_offset(_text(st["signal"]), int(st["prn"]))
        self._tap_q[c] = 0
        self._tap_q[c, :n_taps] = q
        self._tap_q[c, n_taps] = round(noise * per_chip)
        self._acc[c], self._hist[c], self._commands[c] = 0.0, 0.0, np.zeros((), AIDING)
        self._taps[c], self._windows[c] = q / per_chip, n_window

    def _noise_offset(self, signal, prn):
        """Code offset of the noise reference: where the own code's side lobes are smallest, chips."""
        key = ("noise", signal, prn)
        if key not in self._tables:
            length = SIGNALS[signal].code_length_chips
            chips = np.arange(int(0.2 * length), int(0.8 * length))
            waveform = "BPSK" if signal == "L1CA" else "BOC11"
            level = np.abs(autocorrelation(signal, prn, chips, waveform, waveform, self.prn_path))
            worst = np.max(np.lib.stride_tricks.sliding_window_view(level, 5), axis=1)
            self._tables[key] = int(chips[2 + np.argmin(worst)])
        return self._tables[key]

    def _describe(self, signal, prn):
        """Constants of a channel -> (CHANNEL scalar, tap offsets in chips, taps in the window)."""
        spec = self.spec
        is_ca = signal == "L1CA"
        loops = spec.l1ca if is_ca else spec.e1
        pilot = not is_ca and loops.component == "pilot"
        signal = "L1CA" if is_ca else ("E1C" if pilot else "E1B")
        waveform = "BPSK" if is_ca else ("BOC11" if loops.replica == "BOC11" else SIGNALS[signal].waveform)
        st = np.zeros((), CHANNEL)
        st["signal"], st["prn"] = signal, prn
        st["kind"] = KIND_CA if is_ca else (KIND_PILOT if pilot else KIND_DATA)
        st["code_length_chips"], st["period_s"] = (
            SIGNALS[signal].code_length_chips,
            SIGNALS[signal].code_period_s,
        )
        self._assign_tables(st, signal, prn, waveform, pilot)
        offsets, n_window, roles = self._offsets(loops, is_ca, st)
        st["early"], st["prompt"], st["late"], st["very_early"], st["very_late"] = roles
        st["n_taps"], st["n_sums"] = len(offsets), len(offsets) + 1 + pilot
        if roles[3] >= 0:
            st["very_offset_chips"] = offsets[roles[3]]
        self._assign_discriminators(st, loops, is_ca, pilot, waveform, offsets)
        self._assign_loops(st, loops)
        return st, offsets, n_window

    def _assign_tables(self, st, signal, prn, waveform, pilot):
        table = self._table(signal, prn, waveform)
        st["table_start"], st["scale"], st["samples_per_chip"], columns, n_phase = table
        if pilot:
            data_waveform = "BOC11" if waveform == "BOC11" else SIGNALS["E1B"].waveform
            st["data_table_start"], st["data_scale"] = self._table("E1B", prn, data_waveform)[:2]
        st["table_columns"], st["n_phase"], st["phase_shift"] = columns, n_phase, n_phase.bit_length() - 1
        st["longest_block"] = BLOCK if st["scale"] == 1.0 else LONGEST_MULTILEVEL
        exact = SIGNALS[signal].code_length_chips * float(st["samples_per_chip"]) * n_phase
        st["wrap_q"] = round(exact)
        st["wrap_error_q"] = round(exact) - exact

    def _table(self, signal, prn, waveform):
        """Place a code table in the pool -> (start, scale, samples per chip, columns, rows)."""
        key = (signal, prn, waveform)
        if key not in self._tables:
            n_phase = 64
            while n_phase > 4 and n_phase * self.fs_hz > _MAX_TABLE_RATE_HZ:
                n_phase //= 2
            table = code_table(signal, prn, self.fs_hz, n_phase, waveform, path=self.prn_path)
            start = len(self._pool)
            self._pool = np.concatenate([self._pool, table.table.ravel()])
            self._tables[key] = (start, table.scale, table.samples_per_chip, table.table.shape[1], n_phase)
        return self._tables[key]

    @staticmethod
    def _offsets(loops, is_ca, st):
        """All tap offsets, window first; roles are indices of E, P, L, VE, VL."""
        grid = float(st["samples_per_chip"]) * int(st["n_phase"])
        offsets = []
        if loops.taps is not None:
            half = (loops.taps.count - 1) // 2
            offsets = [k * loops.taps.spacing_chips for k in range(-half, half + 1)]
        n_window = len(offsets)

        def index(chips):
            for t, have in enumerate(offsets):
                if round(have * grid) == round(chips * grid):
                    return t
            offsets.append(chips)
            return len(offsets) - 1

        half = 0.5 * loops.early_late_space_chips
        very = -1.0 if is_ca else 0.5 * loops.very_early_late_space_chips
        if is_ca:
            roles = [index(half), index(0.0), index(-half), -1, -1]
        else:
            roles = [index(half), index(0.0), index(-half), index(very), index(-very)]
        snapped = np.round(np.asarray(offsets) * grid) / grid
        if len(set(snapped[roles[:3]])) < 3:
            raise ValueError(
                f"early_late_space_chips = {loops.early_late_space_chips:g} is finer than the replica's grid of "
                f"{1 / grid:.3g} chips at this sampling rate; use a wider spacing"
            )
        return snapped, n_window, roles

    def _assign_discriminators(self, st, loops, is_ca, pilot, waveform, offsets):
        carrier = loops.carrier_discriminator if is_ca else ("four_quadrant" if pilot else "costas_atan")
        st["carrier_code"] = CARRIER_DISCRIMINATORS[carrier]
        st["code_code"] = CODE_DISCRIMINATORS[loops.code_discriminator]
        incoming = waveform
        if not is_ca and self.fs_hz >= _BOC61_FITS_HZ:
            incoming = SIGNALS[_text(st["signal"])].waveform
        band_hz = sampled_band_hz(self.fs_hz)
        acf = lambda d: chip_acf(d, incoming, waveform, band_hz)  # noqa: E731
        spacing = float(offsets[int(st["early"])] - offsets[int(st["late"])])
        very = 1.0 if is_ca else float(offsets[int(st["very_early"])] - offsets[int(st["very_late"])])
        st["code_scale_chips"] = code_scale_chips(loops.code_discriminator, acf, spacing, very)
        st["pull_scale_chips"] = code_scale_chips("power", acf, spacing)
        st["r_half"] = float(acf(0.5 * spacing)) / float(acf(0.0))
        if not is_ca and not loops.side_peak_protection:
            st["very_early"] = st["very_late"] = -1

    def _assign_loops(self, st, loops):
        spec, period = self.spec, float(st["period_s"])
        T_s = loops.integration_ms * 1e-3
        m_track = round(T_s / period)
        m_settle = min(m_track, round(20e-3 / period))
        T_settle = m_settle * period
        st["m_track"], st["m_settle"] = m_track, m_settle
        bw, stage = min(spec.settle_pll_bw_hz, MAX_BT / T_settle), 0
        while stage == 0 or (bw > loops.pll_bw_hz and stage < len(st["stage_s"])):
            st["pll_stages"][stage] = pll_gains(loops.pll_order, bw, T_settle)
            st["stage_s"][stage] = max(spec.settle_s, 4.0 / bw if stage else 0.0)
            bw, stage = 0.5 * bw, stage + 1
        st["n_stages"] = stage
        st["pll_track"] = pll_gains(loops.pll_order, loops.pll_bw_hz, T_s)
        st["dll_pull"] = dll_gains(1, spec.pull_in_dll_bw_hz, period)[0]
        st["dll_settle"] = dll_gains(1, max(spec.settle_dll_bw_hz, loops.dll_bw_hz), T_settle)[0]
        st["dll_track"] = dll_gains(loops.dll_order, loops.dll_bw_hz, T_s)
        st["fll_settle"] = fll_gain(spec.settle_fll_bw_hz, T_settle)
        st["fll_track"] = fll_gain(loops.fll_bw_hz, T_s)
        st["pll_bw_hz"], st["dll_bw_hz"] = loops.pll_bw_hz, loops.dll_bw_hz
        if loops.adapt is not None:
            self._assign_adaptation(st, loops, T_s)
        for name in ("cn0_window_s", "cn0_min_dbhz", "lock_in", "lock_out", "lost_after_s"):
            st[name] = getattr(spec, name)

    @staticmethod
    def _assign_adaptation(st, loops, T_s):
        a, is_ca = loops.adapt, st["kind"] == KIND_CA
        costas = st["carrier_code"] != CARRIER_DISCRIMINATORS["four_quadrant"]
        st["adapt_s"] = a.cn0_s
        st["adapted"] = adapted_gains(
            (a.pll_min_hz, loops.pll_bw_hz), (a.dll_min_hz, loops.dll_bw_hz), loops.fll_bw_hz, T_s, bool(costas),
            1.0 if is_ca else 3.0, loops.early_late_space_chips, a.jerk_mps3, a.code_drift_mps,
        )  # fmt: skip

    # ------------------------------------------------------------------------------------------------ run
    def process(self, n0, iq, aiding=None, stops=(), steer=None):
        """Track one slab.

        Parameters
        ----------
        n0 : int
            Absolute index of the slab's first sample; slabs follow each other without gaps.
        iq : int8 | int16 | float32 (2, n)
        aiding : AIDING (C,), optional
            Steering, one row per channel; it stays in force until replaced. None: nothing new.
        stops : int, ascending
            Samples within the slab at which ``steer(stop, epochs, counts)`` may replace it: all channels have come to the
            stop and no further, their integrations so far are in ``epochs`` and ``counts``.

        Returns
        -------
        epochs : EPOCH (C, n_max)
        counts : int64 (C,)
            Filled rows per channel.
        corr : complex64 (C, n_max, K)
            Correlator outputs of those integrations at ``taps_chips(c)``; unused columns are zero.
        """
        self._check(int(n0), iq)
        self._command(aiding)
        # What was left over grows by the first code periods of the slab: no channel needs to cross the seam after them.
        tail = np.concatenate([self._tail, iq[:, : self._head_samples()]], axis=1)
        first, n_left = self._end - self._tail.shape[1], self._tail.shape[1]
        self._end += iq.shape[1]
        n_channels, n_max = len(self.channels), self._most_periods(self._end - first)
        epochs = np.zeros((n_channels, n_max), EPOCH)
        corr = np.zeros((n_channels, n_max, self._tap_q.shape[1] - 2), np.complex64)
        counts, self.symbol_counts = np.zeros(n_channels, np.int64), np.zeros(n_channels, np.int64)
        self.symbols = np.zeros((n_channels, n_max + HISTORY // 4), SYMBOL)
        integer = int(HAS_INTEGER_PATH and iq.dtype == np.int8 and self.spec.arithmetic == "auto")

        def run(which, since, stop):
            for begin, samples in ((first, tail), (first + n_left, iq)):
                if since >= begin + samples.shape[1]:
                    continue  # every channel is beyond the seam
                xi, xq = samples[:, : stop - begin]
                track_slab(
                    which, integer, xi, xq, begin, self.fs_hz, self.if_hz, self._pool, self._tap_q, self._secondary,
                    self.channels, self._acc, self._hist, self._commands, epochs, counts, corr, self.symbols,
                    self.symbol_counts,
                )  # fmt: skip

        active = self._running()[0]
        for since, stop in pairwise([first, *stops, self._end]):
            if len(active):
                self._share(run, active, since, stop)
            if stop < self._end:
                self._command(steer(stop, epochs, counts))
        self._keep(tail[:, :n_left], iq)
        return epochs, counts, corr

    def _command(self, aiding):
        """Put AIDING rows in force, if there are any."""
        if aiding is None:
            return
        if len(aiding) != len(self.channels):
            raise ValueError(
                f"aiding has {len(aiding)} rows for {len(self.channels)} channels: give one each"
            )
        self._commands[:] = aiding

    def _check(self, n0, iq):
        """Raise ValueError unless the slab continues the samples before it."""
        if iq.ndim != 2 or iq.shape[0] != 2 or iq.dtype not in (np.int8, np.int16, np.float32):
            raise ValueError(
                f"a slab is a (2, n) array of int8, int16 or float32, not {iq.dtype} of shape {iq.shape}"
            )
        if self._begun and n0 != self._end:
            raise ValueError(
                f"slab starts at sample {n0} where {self._end} was expected: slabs must not leave gaps"
            )
        if self._tail.size and self._tail.dtype != iq.dtype:
            raise ValueError(f"slab is {iq.dtype} after {self._tail.dtype}: keep one sample type")
        if not self._begun:
            self._end, self._begun = n0, True
        if not self._tail.size:
            self._tail = np.zeros((2, 0), iq.dtype)

    def _head_samples(self):
        """Two of the longest code periods: a period that steering stretches is at most one and a half."""
        return math.ceil(2.01 * self.fs_hz * self._longest_s)

    def _most_periods(self, n):
        return int(n / (self.fs_hz * self._shortest_s) * 1.01) + 2

    def _running(self):
        """Indices of channels that take samples, and the oldest sample that one of them needs."""
        which = np.empty(len(self.channels), np.int64)
        count, oldest = survey(self.channels, which)
        return which[:count], oldest if count else self._end

    def _share(self, run, active, since, stop):
        """Run the channels from one sample to another, each on one thread."""
        n = min(self.spec.threads, len(active))
        if self._threads is None or n < 2:
            run(active, since, stop)
            return
        others = [self._threads.submit(run, active[t::n], since, stop) for t in range(1, n)]
        run(active[::n], since, stop)
        for other in others:
            other.result()

    def _keep(self, left, iq):
        """Keep the samples that some channel still needs: of those ``left`` over before the slab, and of the slab."""
        needed = self._end - min(self._running()[1], self._end)
        if needed <= iq.shape[1]:
            self._tail = iq[:, iq.shape[1] - needed :].copy()
        else:
            self._tail = np.concatenate([left[:, left.shape[1] + iq.shape[1] - needed :], iq], axis=1)

    def snapshot(self, sample_index):
        """Replicas of all channels at one receiver sample -> REPLICA (C,).

        The NCO of each channel is run from its next code period to ``sample_index`` at its present rates, so
        that pseudoranges formed from these rows belong to one receiver time. Nothing but the filtered replica
        enters.
        """
        ch = self.channels
        out = np.zeros(len(ch), REPLICA)
        dt = (int(sample_index) - ch["next_sample"]) / self.fs_hz
        ramp = ch["doppler_rate_hz_s"] * (
            (ch["next_sample"] - ch["start_sample"]) / self.fs_hz * (ch["m_done"] > 0)
        )
        doppler = ch["doppler_hz"] + ramp
        mean = doppler + 0.5 * ch["doppler_rate_hz_s"] * dt
        code_hz = CHIP_RATE_HZ * (1.0 + mean / F_L1_HZ) + ch["code_rate_chips_s"]
        phase = ch["code_phase_chips"] + dt * code_hz
        periods = np.floor(phase / np.maximum(ch["code_length_chips"], 1.0)).astype(np.int64)
        out["sample_index"] = sample_index
        out["code_phase_chips"] = phase - periods * ch["code_length_chips"]
        out["code_period"] = ch["code_period"] + periods
        out["carrier_phase_cycles"] = ch["carrier_cycles"] + mean * dt
        out["doppler_hz"] = np.where(
            ch["steered"] != 0, doppler + ch["doppler_rate_hz_s"] * dt, ch["rate_hz"]
        )
        out["doppler_rate_hz_s"] = np.where(ch["steered"] != 0, ch["doppler_rate_hz_s"], ch["rate_hz_s"])
        out["phase_locked"] = ch["phase_locked"] != 0
        out["lock_s"] = np.where(
            out["phase_locked"], (sample_index - ch["lock_start_sample"]) / self.fs_hz, 0.0
        )
        for name in (
            "signal",
            "prn",
            "state",
            "cn0_dbhz",
            "cn0_prompt_dbhz",
            "carrier_lock",
            "code_lock",
            "slips",
        ):
            out[name] = ch[name]
        return out
