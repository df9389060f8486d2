"""Echoes of the direct signal: an aeronautical channel and a plain list, both stateless in time.

An echo with gain g(t) and excess delay tau(t) >= 0 adds ``g(t) s(t - tau(t))`` to the direct signal s(t),
with the direct signal's own carrier phase: all its extra phase is in g(t), so tau(t) moves the code only. In
a correlator whose replica is advanced by d the echo is g R(d + tau).

Unit-power fading n(t) with a flat spectrum inside +-B/2 is a sum of sinusoids (Steingass, Lehner et al.,
PLANS 2004: h(t, tau) = 1 + sum_i sqrt(P_i) n_i(t) delta(tau - tau_i)), so that any instant can be evaluated
alone.
"""

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from numba import njit
from pydantic import BaseModel, ConfigDict, Field, model_validator

from signals.constants import C_MPS, WAVELENGTH_M
from signals.records import ECHO_TRUTH

__all__ = ["Aeronautical", "Echo", "EchoRun", "Echoes", "MultipathSpec", "echo_gain", "echo_series"]

N_TONES = 24
"""Sinusoids per fading echo."""
_TWO_PI = 2.0 * math.pi


@njit(cache=True, nogil=True, error_model="numpy")
def echo_gain(t_s, amplitude, doppler_hz, tone_hz, tone_cycles):
    """Complex gain of one echo at one instant, relative to the direct signal.

    g(t) = a e^{2 pi i f_d t} / sqrt(M) sum_m e^{2 pi i (f_m t + p_m)}; ``tone_hz``, ``tone_cycles`` float64 (M,).
    """
    re, im = 0.0, 0.0
    for m in range(tone_hz.shape[0]):
        turn = (tone_hz[m] + doppler_hz) * t_s + tone_cycles[m]
        angle = _TWO_PI * (turn - math.floor(turn))
        re += math.cos(angle)
        im += math.sin(angle)
    a = amplitude / math.sqrt(tone_hz.shape[0])
    return complex(a * re, a * im)


@njit(cache=True, nogil=True, error_model="numpy")
def echo_series(t0_s, step_s, amplitude, doppler_hz, tone_hz, tone_cycles, out):
    """``echo_gain`` at t0 + i step of every echo; ``out`` complex64 (n_echo, n), tones float64 (n_echo,
    M).
    """
    n = out.shape[1]
    total = np.empty(n, np.complex128)
    for k in range(out.shape[0]):
        total[:] = 0.0
        n_tones = tone_hz.shape[1]
        for m in range(n_tones):
            f = tone_hz[k, m] + doppler_hz[k]
            turn = f * t0_s + tone_cycles[k, m]
            angle = _TWO_PI * (turn - math.floor(turn))
            z = complex(math.cos(angle), math.sin(angle))
            w = complex(math.cos(_TWO_PI * f * step_s), math.sin(_TWO_PI * f * step_s))
            for i in range(n):
                total[i] += z
                z *= w
        a = amplitude[k] / math.sqrt(n_tones)
        for i in range(n):
            out[k, i] = a * total[i]


_SatId = Annotated[str, Field(pattern=r"^[GE]\d\d$")]


class _Spec(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Echo(_Spec):
    """One echo of a list: excess delay at t = 0 and its rate, power, Doppler and phase against the direct
    signal.
    """

    delay_s: float = Field(ge=0, le=1e-3)
    """Excess delay at the start."""
    delay_rate_s_s: float = Field(0.0, ge=-1e-5, le=1e-5)
    """Its rate."""
    power_db: float = Field(ge=-100, le=20)
    """Power relative to the direct signal."""
    doppler_hz: float = Field(0.0, ge=-1e4, le=1e4)
    """Doppler relative to the direct signal."""
    phase_rad: float | None = None  # None: drawn per trial
    bandwidth_hz: float = Field(0.0, ge=0, le=1e4)  # Doppler spread, flat over +-B/2; 0: no fading


class Echoes(_Spec):
    """A plain list of echoes."""

    kind: Literal["Echoes"] = "Echoes"
    satellites: tuple[_SatId, ...] | None = None
    """Those that have echoes; None: all."""
    echoes: tuple[Echo, ...] = Field(min_length=1, max_length=64)

    def start(self, seed):
        """Draw phases and tones -> EchoRun."""
        return _run([_row(e) for e in self.echoes], seed)


class Aeronautical(_Spec):
    """Aircraft on approach: fuselage echo, optional refracted component, ground echo.

    Sourced: h(t, tau) above; a fuselage echo of -14.2 dB, 1 to 2 ns late; elevation 10 degrees (Ouzeau et al.
    2008, section VI; Steingass et al. 2004). Assumed, hence settings: every other value. Ground: tau = 2 h
    sin(E) / c, Doppler = +2 v sin(E) / lambda while sinking (the excess path shortens).
    """

    kind: Literal["Aeronautical"] = "Aeronautical"
    satellites: tuple[_SatId, ...] | None = None
    """Those that have echoes; None: all."""
    elevation_deg: float = Field(10.0, gt=0, le=90)
    """Elevation of the satellite."""
    fuselage_power_db: float | None = Field(-14.2, ge=-100, le=0)  # None: no fuselage echo
    fuselage_delay_s: float = Field(1.5e-9, ge=0, le=1e-7)  # assumed within the sourced 1 to 2 ns
    fuselage_bandwidth_hz: float = Field(0.1, gt=0, le=1e3)  # assumed
    refracted_power_db: float | None = Field(None, ge=-100, le=0)  # assumed; None: off
    refracted_bandwidth_hz: float = Field(0.1, gt=0, le=1e3)  # assumed
    ground_power_db: float | None = Field(-15.0, ge=-100, le=0)  # assumed: -15 (stress) to -25; None: off
    ground_bandwidth_hz: float = Field(2.0, gt=0, le=1e3)  # assumed
    height_m: float = Field(914.0, gt=0, le=2e4)  # assumed, at t = 0
    height_end_m: float = Field(60.0, gt=0, le=2e4)  # assumed; the descent then begins anew
    sink_rate_mps: float = Field(3.0, ge=0, le=100)  # assumed
    visible_s: float = Field(0.0, ge=0)  # assumed: mean dwell of the ground echo; 0: always there
    hidden_s: float = Field(0.0, ge=0)
    """Mean time for which the echo is hidden, between mean times visible."""

    @model_validator(mode="after")
    def _check(self):
        if self.sink_rate_mps > 0 and self.height_end_m >= self.height_m:
            raise ValueError(
                f"height_end_m = {self.height_end_m:g} must be below height_m = {self.height_m:g} "
                "(or set sink_rate_mps = 0)"
            )
        if (self.visible_s > 0) != (self.hidden_s > 0):
            raise ValueError("visible_s and hidden_s: give both mean dwell times, or neither")
        return self

    def start(self, seed):
        """Draw phases, tones and visibility -> EchoRun. ``seed``: SeedSequence or int."""
        rows = []
        if self.fuselage_power_db is not None:
            rows.append(_fading(self.fuselage_power_db, self.fuselage_delay_s, self.fuselage_bandwidth_hz))
        if self.refracted_power_db is not None:
            rows.append(_fading(self.refracted_power_db, 0.0, self.refracted_bandwidth_hz))
        if self.ground_power_db is not None:
            rows.append(self._ground())
        return _run(rows, seed)

    def _ground(self):
        slope = 2.0 * math.sin(math.radians(self.elevation_deg))
        row = _fading(self.ground_power_db, slope * self.height_m / C_MPS, self.ground_bandwidth_hz)
        row["doppler_hz"] = slope * self.sink_rate_mps / WAVELENGTH_M
        row["delay_rate_s_s"] = -slope * self.sink_rate_mps / C_MPS
        if self.sink_rate_mps > 0:
            row["repeat_s"] = (self.height_m - self.height_end_m) / self.sink_rate_mps
        row["dwell_s"] = (self.visible_s, self.hidden_s)
        return row


MultipathSpec = Annotated[Aeronautical | Echoes, Field(discriminator="kind")]
"""Section ``multipath`` of a scenario."""


def _fading(power_db, delay_s, bandwidth_hz):
    return {
        "power_db": power_db,
        "delay_s": delay_s,
        "delay_rate_s_s": 0.0,
        "doppler_hz": 0.0,
        "bandwidth_hz": bandwidth_hz,
        "phase_rad": None,
        "repeat_s": math.inf,
        "dwell_s": (0.0, 0.0),
    }


def _row(echo):
    return {**_fading(0.0, 0.0, 0.0), **echo.model_dump()}


def _run(rows, seed):
    rng = np.random.Generator(np.random.Philox(seed))
    n = len(rows)
    tone_hz, tone_cycles = np.zeros((n, N_TONES)), np.empty((n, N_TONES))
    for k, row in enumerate(rows):
        jitter = rng.random(N_TONES)
        phases = rng.random(N_TONES)
        if row["bandwidth_hz"] > 0:
            tone_hz[k] = row["bandwidth_hz"] * ((np.arange(N_TONES) + jitter) / N_TONES - 0.5)
            tone_cycles[k] = phases
            continue
        # Without spread all tones coincide: their sum over sqrt(M) has modulus sqrt(M).
        tone_cycles[k] = phases[0] if row["phase_rad"] is None else row["phase_rad"] / _TWO_PI
        row["power_db"] = row["power_db"] - 10 * math.log10(N_TONES)
    return EchoRun(
        amplitude=np.array([10 ** (r["power_db"] / 20) for r in rows]),
        doppler_hz=np.array([r["doppler_hz"] for r in rows], float),
        tone_hz=tone_hz,
        tone_cycles=tone_cycles,
        delay_s=np.array([r["delay_s"] for r in rows], float),
        delay_rate_s_s=np.array([r["delay_rate_s_s"] for r in rows], float),
        repeat_s=np.array([r["repeat_s"] for r in rows], float),
        dwell_s=[r["dwell_s"] for r in rows],
        rngs=rng.spawn(n),
    )


@dataclass(eq=False)
class EchoRun:
    """Echoes of one trial: ``series`` gives gain and delay at any time, the same however it is asked."""

    amplitude: np.ndarray
    doppler_hz: np.ndarray
    tone_hz: np.ndarray
    tone_cycles: np.ndarray
    delay_s: np.ndarray
    delay_rate_s_s: np.ndarray
    repeat_s: np.ndarray
    dwell_s: list
    rngs: list
    _switch_s: dict = field(default_factory=dict)

    @property
    def n_echo(self):
        """Number of echoes."""
        return len(self.amplitude)

    @property
    def power(self):
        """Mean power of each over that of the direct signal, while it is visible."""
        return self.amplitude**2 * np.where(self.tone_hz.any(axis=1), 1.0, N_TONES)

    def check(self, duration_s, step_s):
        """Refuse what samples whose gains are lines between nodes ``step_s`` apart cannot follow.

        Raises ValueError for an echo that would come before the direct path and for fading of more than 0.2 / step,
        whose lines would lie 1 % below its amplitude in the mean.
        """
        last = self.delay_s + self.delay_rate_s_s * np.minimum(duration_s, self.repeat_s)
        width_hz = 2.0 * np.abs(self.tone_hz).max(axis=1, initial=0.0)
        for k in range(self.n_echo):
            if last[k] < 0.0:
                raise ValueError(
                    f"echo {k + 1} would come before the direct path after {-self.delay_s[k] / self.delay_rate_s_s[k]:.4g} s:"
                    " raise its delay_s or its delay_rate_s_s"
                )
            if width_hz[k] > 0.2 / step_s:
                raise ValueError(
                    f"echo {k + 1} fades over {width_hz[k]:.3g} Hz, samples follow {0.2 / step_s:g} Hz: lower its bandwidth"
                )

    def truth(self, sample_index, fs_hz, system=b"", prn=0):
        """ECHO_TRUTH rows at these samples, by sample and echo; satellite 0 of no system: of all that arrives."""
        rows = [np.zeros(0, ECHO_TRUTH)]
        for i in np.atleast_1d(np.asarray(sample_index, np.uint64)):
            gain, delay_s = self.series(i / fs_hz, 1.0, 1)
            part = np.zeros(self.n_echo, ECHO_TRUTH)
            part["sample_index"], part["t_s"], part["prn"], part["system"] = i, i / fs_hz, prn, system
            part["echo"], part["delay_s"] = np.arange(self.n_echo), delay_s[:, 0]
            part["phase_rad"] = np.angle(gain[:, 0])
            with np.errstate(divide="ignore"):
                part["power_db"] = 20 * np.log10(np.abs(gain[:, 0]))
            rows.append(part)
        return np.concatenate(rows)

    def series(self, t0_s, step_s, n):
        """Gains complex64 (n_echo, n) and excess delays in s, float64 (n_echo, n), at t0 + i step >= 0."""
        gain = np.empty((self.n_echo, n), np.complex64)
        echo_series(t0_s, step_s, self.amplitude, self.doppler_hz, self.tone_hz, self.tone_cycles, gain)
        t_s = t0_s + step_s * np.arange(n)
        for k, dwell_s in enumerate(self.dwell_s):
            if dwell_s[0] > 0:
                gain[k, np.searchsorted(self._switches(k, t_s[-1]), t_s, "right") % 2 == 1] = 0.0
        return gain, self.delays(t_s)

    def delays(self, t_s):
        """Excess delays in s, float64 (n_echo, n); never below zero."""
        phase_s = np.where(
            np.isfinite(self.repeat_s)[:, None], np.mod(t_s, self.repeat_s[:, None]), t_s[None, :]
        )
        return np.maximum(self.delay_s[:, None] + self.delay_rate_s_s[:, None] * phase_s, 0.0)

    def _switches(self, k, t_s):
        """Times at which echo k appears or vanishes (it starts visible), drawn in order as far as ``t_s``."""
        times = self._switch_s.setdefault(k, [])
        while not times or times[-1] <= t_s:
            dwell_s = self.rngs[k].exponential(self.dwell_s[k][len(times) % 2])
            times.append((times[-1] if times else 0.0) + dwell_s)
        return times
