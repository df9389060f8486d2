"""Measurement-integrity monitors on the live navigation stage: sections ``[receiver.integrity]`` and ``[receiver.respond]``.

After every navigation epoch each monitor reads what navigation left: the ranges with their residuals (`nav.navigator.
Snapshot`), the Kalman filter's epoch log, and the channels' integrations. What may act on the next epoch is a matter of
``[receiver.respond]``; without that section nothing goes back and the receiver's bits are those without monitors. A monitor
that cannot work says why in one sentence and the receiver goes on.

| monitor | statistic | threshold | reads |
|---|---|---|---|
| innovation | r_i^2 / S_ii of each range | chi-square, 1 degree | filter |
| raim | parity chi-square over its quantile; the suspect has the largest w-test | 1 | ranges |
| bias_bank | probability of the best bias that fits | ``declare`` | ranges |
| als | sigma estimated over sigma claimed | 1 + z_p / sqrt(2 N_d) | filter |
| noise_rmd | the same, from differences of successive code discriminators | 1 + z_p / sqrt(2 N_R) | channels |
| parallel_filters | windowed chi-square of the satellite left out | ``threshold`` | filter |
"""

import math
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from monitors.als import Als
from monitors.bias_bank import BiasBank, weight_matrix
from monitors.integrity import Integrity, IntegrityRun
from monitors.integrity import Respond as FilterRespond
from monitors.noise_rmd import SCHEMES, NoiseRmd, window_variance
from monitors.parallel_filters import ParallelFilters
from monitors.protection import Protection, solution
from nav.frames import geodetic_from_ecef, rotation_enu_to_ecef
from nav.navigator import Navigator, Snapshot
from nav.navlog import EXCLUDED_M2, REMEDY, NavigatorLog, Remedy
from nav.ultratight import discriminator_table
from nav.ultratight_kernels import look_up
from signals.constants import METRES_PER_CHIP
from tracking.channel import STATE_LOCKED

INTEGRITY = np.dtype(
    [
        ("system", "S1"),
        ("prn", "i4"),
        ("sample_index", "u8"),
        ("t_s", "f8"),
        ("value", "f8"),
        ("threshold", "f8"),
        ("estimate_m", "f8"),  # bias (bias_bank) or range sigma (als, noise_rmd); NaN elsewhere
    ]
)
"""One value of one monitor on one satellite."""
PROTECTION = np.dtype(
    [
        ("sample_index", "u8"),
        ("t_s", "f8"),
        ("hpl_m", "f8"),
        ("vpl_m", "f8"),
        ("hal_m", "f8"),
        ("val_m", "f8"),
    ]
)
"""Protection levels of one position and the alert limits."""
RESPONSE = np.dtype(
    [
        ("sample_index", "u8"),
        ("t_s", "f8"),
        ("system", "S1"),
        ("prn", "i4"),
        ("variance_m2", "f8"),
        ("bias_m", "f8"),
        ("exclude", "?"),
        ("weaken", "f8"),
    ]
)
"""What was asked of the next epoch, one row per satellite that anything was asked of."""
MONITORS = ("innovation", "raim", "bias_bank", "als", "noise_rmd", "parallel_filters")
MEMORY = 50
"""Epochs over which the onset of an identified bias is looked for."""
_FROZEN = ConfigDict(frozen=True, extra="forbid")


class ChiSquare(BaseModel):
    """A chi-square test at a false-alarm probability per test."""

    model_config = _FROZEN
    p_false_alarm: float = Field(1e-6, gt=0, lt=0.5)
    """False-alarm probability of one test."""


class Limits(Protection):
    """Protection levels and the alert limits they are compared with (APV-I by default: 40 m, 50 m)."""

    kind: Literal["protection"] = "protection"
    hal_m: float = Field(40.0, gt=0)
    """Horizontal alert limit."""
    val_m: float = Field(50.0, gt=0)
    """Vertical alert limit."""
    every_s: float = Field(1.0, ge=0)
    """Levels are computed at the first position this long after the last."""
    """Vertical alert limit."""


class IntegritySpec(BaseModel):
    """Section ``[receiver.integrity]``; a monitor whose section is left out is off but for the first two tests."""

    model_config = _FROZEN
    innovation: ChiSquare | None = ChiSquare()
    raim: ChiSquare | None = ChiSquare()
    bias_bank: BiasBank | None = None
    als: Als | None = None
    noise_rmd: NoiseRmd | None = None
    parallel_filters: ParallelFilters | None = None
    bank_every: int = Field(1, ge=1, le=10_000)
    """Filter epochs that make one epoch of the parallel filters."""
    protection: Limits | None = None
    gap_s: float = Field(1.0, ge=0)
    """Exceedances closer than this are one alarm."""

    def start(self, respond: "RespondSpec", fs_hz: float) -> "IntegrityLive":
        """-> IntegrityLive."""
        return IntegrityLive(self, respond, fs_hz)


class RespondSpec(BaseModel):
    """Section ``[receiver.respond]``: which monitor may act, and how. Everything is off by default.

    ``noise``: range variances from this estimator; ``bias``: an identified bias is subtracted; ``exclude``: satellites that
    these monitors accuse are left out until ``hold_s`` after the last accusation (parallel filters: until re-certified);
    ``reset``: the filter takes the state and covariance of the parallel filter that never saw the fault; ``fallback``:
    when faults of one constellation are too many to name, navigate by the other for ``hold_s``; ``weaken``: an alarm of an
    interference monitor (``[[receiver.monitor]]``) raises the variances of the channel that it watches, until ``hold_s`` after.
    All of it acts on the position and on a filter that steers the channels alike.
    """

    model_config = _FROZEN
    noise: Literal["als", "noise_rmd"] | None = None
    """Range variances come from this estimator."""
    bias: bool = False
    """Subtract a bias that was identified."""
    exclude: tuple[Literal["innovation", "raim", "parallel_filters"], ...] = ()
    """Leave out satellites that these monitors accuse."""
    reset: bool = False
    """Take the state of the parallel filter that never saw the fault."""
    fallback: bool = False
    """Navigate by the other constellation when too many of one are faulty."""
    weaken: tuple[str, ...] = ()
    """Interference monitors, by name, whose alarms make a satellite weigh less."""
    weaken_by: float = Field(100.0, gt=1, le=1e6)
    """Factor on its variances."""
    hold_s: float = Field(10.0, gt=0, le=3600)
    """How long an action outlasts its cause."""

    @property
    def off(self) -> bool:
        """Whether nothing may act."""
        return not (self.noise or self.bias or self.exclude or self.reset or self.fallback)

    @model_validator(mode="after")
    def _twice(self):
        for key in ("exclude", "weaken"):
            if len(set(getattr(self, key))) != len(getattr(self, key)):
                raise ValueError(f"{key} names one monitor twice; write each once")
        return self

    def check(self, spec: IntegritySpec | None) -> None:
        """ValueError when an answer is wanted of a monitor that is not on."""
        wanted = [self.noise, "bias_bank" if self.bias else None, "parallel_filters" if self.reset else None]
        wanted += [*self.exclude, "raim" if self.fallback else None]
        for name in wanted:
            if name is not None and (spec is None or getattr(spec, name) is None):
                raise ValueError(
                    f"receiver.respond wants an answer of '{name}', which is off: add [receiver.integrity.{name}]"
                )


# ------------------------------------------------------------------------------------------------ what is watched


class _FilterView:
    """The navigator's filter as `monitors.integrity` sees it; a reset waits for the next epoch."""

    def __init__(self, log: NavigatorLog, navigator: Navigator) -> None:
        self._log, self._navigator = log, navigator
        self.n_rows = 2 * log.slots
        self.pending: np.ndarray | None = None

    @property
    def p(self) -> np.ndarray:
        """Covariance now."""
        return self._navigator._p

    def log(self, n_epochs: int | None = None):
        """Epochs of the log."""
        return self._log.log(n_epochs)

    def reset(self, p: np.ndarray) -> None:
        """Take over at the next epoch; what was logged belongs to another filter."""
        self.pending = p.copy()
        self._log.drop()


class _Alarms:
    """Tests and alarms of one monitor by satellite."""

    def __init__(self, gap_s: float) -> None:
        self.gap_s = gap_s
        self.found: dict[tuple[bytes, int], list[dict[str, float]]] = {}
        self.tests: dict[tuple[bytes, int], int] = {}
        self.threshold: dict[tuple[bytes, int], float] = {}
        self.unavailable_epochs = 0
        self.reason: str | None = None

    def add(self, rows: np.ndarray) -> None:
        self.reason = None
        for row in rows:
            key = bytes(row["system"]), int(row["prn"])
            self.tests[key] = self.tests.get(key, 0) + 1
            self.threshold[key] = float(row["threshold"])
            if row["value"] < row["threshold"]:
                continue
            mine, t, value = self.found.setdefault(key, []), float(row["t_s"]), float(row["value"])
            if mine and t - mine[-1]["end_s"] <= self.gap_s:
                mine[-1]["end_s"], mine[-1]["peak"] = t, max(mine[-1]["peak"], value)
            else:
                mine.append({"start_s": t, "end_s": t, "peak": value})

    def lack(self, reason: str | None) -> None:
        if reason:
            self.unavailable_epochs += 1
            self.reason = reason


class IntegrityLive:
    """Run of an IntegritySpec: call after every navigation epoch; `remedy` is what holds for the next one."""

    def __init__(self, spec: IntegritySpec, respond: RespondSpec, fs_hz: float) -> None:
        self.spec, self.respond, self.fs_hz = spec, respond, fs_hz
        self.alarms = {n: _Alarms(spec.gap_s) for n in MONITORS if getattr(spec, n) is not None}
        self.remedy: Remedy | None = None
        self._filter: IntegrityRun | None = None
        self._view: Any = None  # _FilterView: what the monitors of the filter read of an Eskf
        self._bank: Any = None  # run of the bias bank
        self._bank_names: list[str] = []
        self._until: dict[str, float] = {}
        self._failed: set[str] = set()
        self._shift: dict[str, float] = {}
        self._variance: dict[str, float] = {}
        self._rmd: dict[str, float] = {}
        self._differences: dict[str, np.ndarray] = {}
        self._last: dict[str, tuple[int, float]] = {}
        self._only: tuple[str, float] = ("", 0.0)
        self._past: list[tuple[list[str], np.ndarray, np.ndarray]] = []
        self._new_bias: dict[str, float] = {}
        self._next_level_s = 0.0

    def watch(self, navigator: Navigator) -> None:
        """Have the navigator's filter logged where a monitor needs it."""
        if navigator.spec.kind != "ekf":
            return
        need = MEMORY if self.spec.als is None else self.spec.als.window_epochs + self.spec.als.settle_epochs
        navigator.log = NavigatorLog(length=max(need, MEMORY))

    # -- one epoch ---------------------------------------------------------------------------------------------------

    def __call__(self, navigator: Navigator, sample: int) -> dict[str, np.ndarray]:
        """Rows by dataset name of this epoch; sets ``remedy`` for the next."""
        t_s = sample / self.fs_hz
        out: dict[str, np.ndarray] = {}
        snap = navigator.snapshot
        if snap is None:
            self._lack_all(navigator.reason or "there was no position")
        else:
            self._ranges(snap, sample, t_s, out)
        dx = self._filtered(navigator, sample, t_s, out)
        self._noise_rows(snap, sample, t_s, out)
        for name, rows in out.items():
            if name in self.alarms:
                self.alarms[name].add(rows)
        undo = self._undo(navigator.log)
        if undo is not None:
            dx = undo if dx is None else dx + undo
        self._answer(snap, t_s, dx)
        if self.remedy is not None and len(self.remedy.rows):
            rows = np.zeros(len(self.remedy.rows), RESPONSE)
            for name in REMEDY.names or ():
                rows[name] = self.remedy.rows[name]
            rows["sample_index"], rows["t_s"] = sample, t_s
            out["response"] = rows
        return out

    def _lack_all(self, reason: str) -> None:
        for name in ("raim", "bias_bank"):
            if name in self.alarms:
                self.alarms[name].lack(reason)

    # -- monitors on the ranges of one epoch ----------------------------------------------------------------------------

    def _ranges(self, snap: Snapshot, sample: int, t_s: float, out: dict[str, np.ndarray]) -> None:
        # The tests use the receiver's noise as it stands, and judge excluded satellites too.
        var = np.where(snap.variance_m2 < 0.5 * EXCLUDED_M2, snap.variance_m2, snap.own_m2)
        var = np.array([self._variance.get(n, v) for n, v in zip(snap.names, var)])
        raw = snap.residual_m + np.array([self._shift.get(n, 0.0) for n in snap.names])
        h = np.column_stack([-snap.los, np.ones(len(raw)), snap.second])
        self._raim(snap, raw, h, var, sample, t_s, out)
        self._biases(snap, raw, h, var, sample, t_s, out)
        self._protect(snap, h, var, sample, t_s, out)

    def _raim(self, snap, raw, h, var, sample, t_s, out) -> None:
        if self.spec.raim is None:
            return
        corrected = raw - np.array([self._shift.get(n, 0.0) for n in snap.names])
        p_fa = self.spec.raim.p_false_alarm
        part = [i for i in range(len(raw))]
        accused: list[int] = []
        first = None
        reason = ""
        while True:
            try:
                w = _parity(h[part], var[part])
            except (ValueError, np.linalg.LinAlgError) as error:
                reason = str(error).replace("The bias bank needs", "RAIM needs")
                break
            wr = w @ corrected[part]
            chi2, dof = float(corrected[part] @ wr), len(part) - _rank(h[part])
            limit = _chi2_limit(dof, p_fa)
            suspect = part[int(np.argmax(wr**2 / np.maximum(np.diag(w), 1e-12 / var[part])))]
            if first is None:
                first = chi2 / limit, suspect
            if chi2 < limit:
                break
            accused.append(suspect)
            part.remove(suspect)
        if first is None:
            self.alarms["raim"].lack(reason)
            return
        out["raim"] = _row(snap.names[first[1]], sample, t_s, first[0], 1.0)
        if reason:
            self.alarms["raim"].lack(reason)
        several = len(accused) > 1 and len({snap.names[i][0] for i in accused}) == 1
        if self.respond.fallback and accused and (several or reason):
            self._fall_back(snap, corrected, h, var, t_s)
        if "raim" in self.respond.exclude and not reason:
            for i in accused:
                self._until[snap.names[i]] = t_s + self.respond.hold_s

    def _fall_back(self, snap, corrected, h, var, t_s) -> None:
        """Keep to the constellation that agrees with itself, if exactly one does."""
        assert self.spec.raim is not None
        agree = []
        for system in "GE":
            part = [i for i, n in enumerate(snap.names) if n[0] == system]
            try:
                w = _parity(h[part], var[part])
            except (ValueError, np.linalg.LinAlgError):
                continue
            dof = len(part) - _rank(h[part])
            if corrected[part] @ w @ corrected[part] < _chi2_limit(dof, self.spec.raim.p_false_alarm):
                agree.append(system)
        if len(agree) == 1:
            self._only = agree[0], t_s + self.respond.hold_s

    def _biases(self, snap, raw, h, var, sample, t_s, out) -> None:
        if self.spec.bias_bank is None:
            return
        new = [n for n in snap.names if n not in self._bank_names]
        if new or self._bank is None:
            # A satellite came: the hypotheses of the others go on where they stood.
            self._bank = _grown(self.spec.bias_bank, self._bank, len(self._bank_names) + len(new))
            self._bank_names += new
        at = np.array([self._bank_names.index(n) for n in snap.names])
        m = len(self._bank_names)
        r, hh, v, used = np.zeros(m), np.zeros((m, h.shape[1])), np.ones(m), np.zeros(m, bool)
        gone = np.array([n in self._failed or self._until.get(n, 0.0) > t_s for n in snap.names], bool)
        r[at], hh[at], v[at], used[at] = raw, h, var, ~gone
        report = self._bank(r, hh, v, used)
        if report is None:
            self.alarms["bias_bank"].lack(self._bank.unavailable)
            return
        biased = np.flatnonzero(report.bias_m != 0)
        best = int(biased[np.argmax(report.probability[biased])])
        name = self._bank_names[int(report.row[best])]
        value = float(report.probability[best]) if report.fits or report.best != best else 0.0
        out["bias_bank"] = _row(
            name, sample, t_s, value, self.spec.bias_bank.declare, float(report.bias_m[best])
        )
        if self.respond.bias:
            self._past.append((list(snap.names), *_scores(raw, h, var, ~gone)))
            del self._past[:-MEMORY]
            found = self._bank.correction_m(report)
            before, self._shift = self._shift, {n: float(b) for n, b in zip(self._bank_names, found) if b}
            self._new_bias = {n: b for n, b in self._shift.items() if not before}

    def _undo(self, log: NavigatorLog | None) -> np.ndarray | None:
        """What a bias that was just identified has done to the filter's state since its onset, with the sign reversed.

        Onset by cumulative sum: the epoch from which the log-likelihood ratio to now, sum of mu (W r)_i - mu^2 W_ii / 2,
        is largest. The state it polluted follows c <- (I - K H) phi c + K_i mu.
        """
        if not self._new_bias or log is None or log.count == 0:
            return None
        (name, mu), self._new_bias = next(iter(self._new_bias.items())), {}
        ratio = []
        for names, wr, w in reversed(self._past[-min(log.count, log.length) :]):
            at = names.index(name) if name in names else -1
            ratio.append(mu * wr[at] - 0.5 * mu * mu * w[at] if at >= 0 else 0.0)
        age = 1 + int(np.argmax(np.cumsum(ratio)))
        part, row = log.log(age), log.names.index(name)
        c = np.zeros(log.dx.size)
        for e in range(age):
            c = part.phi[e] @ c if e else c
            c = c + part.k[e] @ ((np.arange(part.r.shape[1]) == row) * mu * part.used[e] - part.h[e] @ c)
        return -c

    def _protect(self, snap, h, var, sample, t_s, out) -> None:
        if self.spec.protection is None or t_s < self._next_level_s:
            return
        self._next_level_s = t_s + self.spec.protection.every_s - 1e-6
        use = snap.use
        lat, lon, _ = geodetic_from_ecef(snap.pos_ecef_m)
        enu = -snap.los[use] @ rotation_enu_to_ecef(lat, lon)
        clocks = h[use][:, 3:]
        if not np.ptp(clocks[:, 1]) > 0:
            clocks = clocks[:, :1]
        row = np.zeros(1, PROTECTION)
        row["sample_index"], row["t_s"] = sample, t_s
        row["hal_m"], row["val_m"] = self.spec.protection.hal_m, self.spec.protection.val_m
        try:
            row["hpl_m"], row["vpl_m"] = levels(
                np.column_stack([enu, clocks]), var[use], self.spec.protection
            )
        except (ValueError, np.linalg.LinAlgError):
            row["hpl_m"] = row["vpl_m"] = np.inf
        out["protection"] = row

    # -- monitors on the filter's log -----------------------------------------------------------------------------------

    def _filtered(self, navigator: Navigator, sample: int, t_s: float, out) -> np.ndarray | None:
        log = navigator.log
        wanted = [n for n in ("innovation", "als", "parallel_filters") if n in self.alarms]
        if log is None or log.count == 0 or log.log(1).t_s[0] != t_s:
            why = 'it reads a Kalman filter\'s log: set receiver.navigation.kind = "ekf"'
            if navigator.spec.kind == "ekf":
                why = navigator.reason or "the filter has not started"
            for name in wanted:
                self.alarms[name].lack(why)
            return None
        self._innovations(log, sample, t_s, out)
        if self.spec.als is None and self.spec.parallel_filters is None:
            return None
        if self._filter is None:
            self._start_filter(log, navigator)
        if self._filter is None:
            return None
        remedy = self._filter(self._view, log.dx, log.z, log.h, log.seen)
        for part, reason in remedy.unavailable.items():
            self.alarms[part].lack(reason)
        if remedy.als is not None:
            self._als_rows(log, remedy.als, sample, t_s, out)
        if remedy.bank is not None:
            self._bank_rows(log, remedy.bank, sample, t_s, out)
        if "parallel_filters" in self.respond.exclude:
            self._failed = {n for n, x in zip(log.names, remedy.exclude[: log.slots]) if n and x}
        return remedy.dx

    def _start_filter(self, log: NavigatorLog, navigator: Navigator) -> None:
        spec, respond = self.spec, self.respond
        whole = Integrity(
            als=spec.als,
            bias_bank=None,
            parallel_filters=spec.parallel_filters,
            bank_every=spec.bank_every,
            respond=FilterRespond(
                noise=respond.noise == "als",
                exclude="parallel_filters" in respond.exclude,
                reset=respond.reset,
            ),
        )
        self._view = _FilterView(log, navigator)
        try:
            self._filter = whole.start(self._view, np.arange(log.slots))
        except ValueError as error:
            for name in ("als", "parallel_filters"):
                if name in self.alarms:
                    self.alarms[name].lack(str(error))

    def _innovations(self, log, sample, t_s, out) -> None:
        if self.spec.innovation is None:
            return
        last = log.log(1)
        limit = _chi2_limit(1, self.spec.innovation.p_false_alarm)
        rows = np.flatnonzero(log.seen[: log.slots])
        part = np.zeros(len(rows), INTEGRITY)
        for k, i in enumerate(rows):
            # Excluded rows weigh nothing, so their own prediction is independent of them.
            var = last.var[0, i] if last.var[0, i] < 0.5 * EXCLUDED_M2 else log.own[i]
            var = self._variance.get(log.names[i], var)
            s = float(log.h[i] @ last.p[0] @ log.h[i]) + var
            part[k] = _row(log.names[i], sample, t_s, log.z[i] ** 2 / s, limit)[0]
        out["innovation"] = part
        # One satellite that stands out; when most do, the noise is wrong and no satellite is at fault.
        high = part["value"] > limit
        if "innovation" in self.respond.exclude and 2 * high.sum() < len(rows):
            for i in rows[high]:
                self._until[log.names[i]] = t_s + self.respond.hold_s

    def _als_rows(self, log, result, sample, t_s, out) -> None:
        sigma = result.sigma_m
        claimed = np.sqrt(log.log(1).var[0] if log.count else log.own)
        limit = 1.0 + _normal_limit(1e-6) / math.sqrt(2.0 * result.n_epochs)
        part = []
        for row, s in zip(result.rows, sigma):
            name = log.names[row]
            now = math.sqrt(self._variance.get(name, log.own[row])) if log.seen[row] else claimed[row]
            part.append(_row(name, sample, t_s, s / max(now, 1e-9), limit, s))
        out["als"] = np.concatenate(part)
        if self.respond.noise == "als":
            least = max(float(sigma.max()) * 1e-2, 1e-3)
            self._variance = {log.names[r]: max(s, least) ** 2 for r, s in zip(result.rows, sigma)}

    def _bank_rows(self, log, report, sample, t_s, out) -> None:
        rows = [i for i in range(log.slots) if log.names[i] and log.seen[i]]
        assert self.spec.parallel_filters is not None
        limit = self.spec.parallel_filters.threshold
        if rows:
            parts = [_row(log.names[i], sample, t_s, report.stat_long[i], limit) for i in rows]
            out["parallel_filters"] = np.concatenate(parts)

    # -- redundant measurements -----------------------------------------------------------------------------------------

    def hear(self, name: str, epochs: np.ndarray, loops: Any, steered: bool = False) -> None:
        """New integrations of one channel: differences of successive code discriminators (noise_rmd)."""
        if self.spec.noise_rmd is None or not len(epochs):
            return
        locked = epochs[epochs["state"] == STATE_LOCKED]
        if not len(locked):
            self._last.pop(name, None)
            return
        error = METRES_PER_CHIP * locked["code_error_chips"].astype(float)
        begin = locked["sample_index"].astype(np.int64)
        end = begin + locked["n_samples"]
        before, last = self._last.get(name, (-1, 0.0))
        joined = np.concatenate([[before], end[:-1]]) == begin
        d = np.diff(np.concatenate([[last], error]))[joined]
        self._last[name] = int(end[-1]), float(error[-1])
        window = self.spec.noise_rmd.window
        kept = np.concatenate([self._differences.get(name, np.zeros(0)), d])[-window:]
        self._differences[name] = kept
        if len(kept) == window:
            scheme = SCHEMES[self.spec.noise_rmd.scheme]
            mean = window_variance(kept, window, scheme, self.spec.noise_rmd.decay)
            t_s = float(locked["n_samples"][-1]) / self.fs_hz
            gain = code_gain(name[0], loops.early_late_space_chips, round(float(locked["cn0_dbhz"][-1])), t_s)
            share = loop_share(0.0 if steered else loops.dll_bw_hz, t_s, gain)
            self._rmd[name] = mean * share + self.spec.noise_rmd.r0_m2

    def _noise_rows(self, snap, sample, t_s, out) -> None:
        if self.spec.noise_rmd is None:
            return
        if not self._rmd or snap is None:
            self.alarms["noise_rmd"].lack("no channel has filled its window of differences yet")
            return
        limit = 1.0 + _normal_limit(1e-6) / math.sqrt(2.0 * self.spec.noise_rmd.window)
        parts = []
        for name, var in zip(snap.names, snap.own_m2):
            if name in self._rmd:
                own = self._variance.get(name, var)
                sigma = math.sqrt(self._rmd[name])
                parts.append(_row(name, sample, t_s, sigma / math.sqrt(own), limit, sigma))
        if parts:
            out["noise_rmd"] = np.concatenate(parts)
        if self.respond.noise == "noise_rmd":
            self._variance = {n: v for n, v in self._rmd.items() if v > 0}

    # -- the answer -----------------------------------------------------------------------------------------------------

    def _answer(self, snap: Snapshot | None, t_s: float, dx: np.ndarray | None) -> None:
        p = None if self._view is None else self._view.pending
        if self._view is not None:
            self._view.pending = None
        if self.respond.off:
            self.remedy = None
            return
        out = {n for n, until in self._until.items() if until > t_s} | self._failed
        names = set(self._variance) | set(self._shift) | out
        system, until = self._only
        if system and until > t_s and snap is not None:
            others = {n for n in snap.names if n[0] != system}
            # Falling back names the constellation, no longer single satellites of the one that is kept.
            out = {n for n in out if n[0] != system} | others
            names |= others
        rows = np.zeros(len(names), REMEDY)
        for row, name in zip(rows, sorted(names)):
            row["system"], row["prn"] = name[:1].encode(), int(name[1:])
            row["variance_m2"] = self._variance.get(name, np.nan)
            row["bias_m"] = self._shift.get(name, 0.0)
            row["exclude"] = name in out
        self.remedy = Remedy(rows, dx, p)

    def report(self) -> list[dict[str, Any]]:
        """One row per monitor and satellite that it tested, for JSON; a monitor that never could, one row with the reason."""
        p_fa = {
            "innovation": self.spec.innovation.p_false_alarm if self.spec.innovation else None,
            "raim": self.spec.raim.p_false_alarm if self.spec.raim else None,
            "als": 1e-6,
            "noise_rmd": 1e-6,
        }
        out: list[dict[str, Any]] = []
        for name, a in self.alarms.items():
            head = {"name": name, "unavailable": a.reason, "unavailable_epochs": a.unavailable_epochs}
            if not a.tests:
                out.append(
                    head
                    | {
                        "signal": "",
                        "prn": 0,
                        "threshold": None,
                        "p_fa": p_fa.get(name),
                        "tests": 0,
                        "alarms": [],
                    }
                )
            for key in sorted(a.tests):
                signal = {b"G": "L1CA", b"E": "E1C"}[key[0]]
                out.append(
                    head
                    | {"signal": signal, "prn": key[1], "threshold": a.threshold[key], "p_fa": p_fa.get(name)}
                    | {"tests": a.tests[key], "alarms": a.found.get(key, [])}
                )
        return out


# -------------------------------------------------------------------------------------------------------- small parts


def loop_share(dll_bw_hz: float, integration_s: float, gain: float = 1.0) -> float:
    """Variance of the replica's code phase over E[(e_{k+1} - e_k)^2] of successive discriminators e.

    First-order loop x' = x - a e, e = g x + n, a = 4 B T / (1 + 2 B T), g the discriminator's gain in noise: the range
    carries x, E[x^2] = a / (g (2 - g a)) E[n^2], and E[d^2] = (g^2 a)^2 E[x^2] + ((1 + g a)^2 + 1) E[n^2]. Without a loop
    (B = 0: steered from outside) the measurement is n / g itself.
    """
    if dll_bw_hz == 0.0:
        return 0.5 / gain**2
    bt = dll_bw_hz * integration_s
    a = 4.0 * bt / (1.0 + 2.0 * bt)
    x = a / (gain * (2.0 - gain * a))
    return x / ((gain * gain * a) ** 2 * x + (1.0 + gain * a) ** 2 + 1.0)


@lru_cache(maxsize=512)
def code_gain(signal: str, spacing_chips: float, cn0_dbhz: float, integration_s: float) -> float:
    """Gain of the normalised code discriminator in noise (``nav.ultratight.discriminator_table``)."""
    row = np.empty(4)
    table = discriminator_table("L1CA" if signal == "G" else "E1", spacing_chips)
    look_up(table, 10.0 ** (0.1 * cn0_dbhz) * integration_s, row)
    return float(row[0])


def _row(
    name: str, sample: int, t_s: float, value: float, threshold: float, estimate: float = math.nan
) -> np.ndarray:
    row = np.zeros(1, INTEGRITY)
    row[0] = name[:1].encode(), int(name[1:]), sample, t_s, value, threshold, estimate
    return row


def _scores(
    raw: np.ndarray, h: np.ndarray, var: np.ndarray, used: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(W r, diagonal of W) of the parity weight W over the used ranges, zero elsewhere."""
    wr, diag = np.zeros(raw.size), np.zeros(raw.size)
    w = _parity(h[used], var[used])
    wr[used], diag[used] = w @ raw[used], np.diag(w)
    return wr, diag


def _rank(h: np.ndarray) -> int:
    return int(np.linalg.matrix_rank(h, tol=1e-9))


def _parity(h: np.ndarray, var: np.ndarray) -> np.ndarray:
    return weight_matrix(h, var)


@lru_cache(maxsize=256)
def _chi2_limit(dof: int, p: float) -> float:
    from scipy.special import chdtri

    return float(chdtri(dof, p))


@lru_cache(maxsize=16)
def _normal_limit(p: float) -> float:
    from scipy.special import ndtri

    return -float(ndtri(p))


def _grown(spec: BiasBank, old, m: int):
    """A bank for m satellites that carries on the log probabilities of an older, smaller one."""
    run = spec.start(m)
    if old is not None:
        run.log_p[: old.log_p.size] = old.log_p
        # A newcomer's hypotheses begin where any other improbable one stands.
        run.log_p[old.log_p.size :] = math.log(spec.floor)
        run._chi2[:, : old.log_p.size] = old._chi2
        run._chi2[:, old.log_p.size :] = old._chi2[:, :1]
        run._dof[:], run._count = old._dof, old._count
    return run


STEP = 1.03
"""Slopes are rounded up to this ratio, so that a level is computed once and not every epoch."""


@lru_cache(maxsize=32)
def _missed(threshold: float, dof: int) -> tuple[np.ndarray, np.ndarray]:
    """Biases of unit non-centrality, and the probability that the test misses each."""
    from scipy.special import chndtr

    bias = np.linspace(0.0, math.sqrt(threshold) + 8.0, 400)
    return bias, chndtr(threshold, dof, np.maximum(bias**2, 1e-12))


@lru_cache(maxsize=4096)
def _unit_level(vertical: bool, k: int, allowed: float, threshold: float, dof: int) -> float:
    """Level of unit sigma for the slope STEP^k per unit of sqrt(non-centrality); as ``monitors.protection``, 1e-4."""
    from scipy.special import chndtr, ndtr, ndtri

    bias, missed = _missed(threshold, dof)
    shift = STEP**k * bias
    low, high = 0.0, float(shift[-1]) + 4.0 - float(ndtri(min(allowed, 0.5) / 4))
    while high - low > 1e-4 * high:
        middle = 0.5 * (low + high)
        if vertical:
            tail = ndtr(shift - middle) + ndtr(-shift - middle)
        else:
            tail = 1.0 - chndtr(middle**2, 2, np.maximum(shift**2, 1e-12))
        low, high = (low, middle) if np.max(tail * missed) <= allowed else (middle, high)
    return high


def levels(h_enu: np.ndarray, var: np.ndarray, spec: Protection) -> tuple[float, float]:
    """(HPL, VPL) as ``monitors.protection.protection_levels``, at most ``STEP`` larger, from a table that fills itself.

    With b' = b sqrt(P_ii) the risk of satellite i depends on its slope S_i / sqrt(P_ii) over sigma alone.
    """
    s, cov, parity = solution(h_enu, var)
    m, q = h_enu.shape
    dof = m - q
    threshold = _chi2_limit(dof, spec.p_false_alarm)
    part = 0.5 * spec.p_hmi / spec.independent_epochs / (m + 1)
    allowed = min(part / spec.p_fault, 1.0)
    up = float(math.sqrt(cov[2, 2]))
    major = float(np.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1]))
    levels_m = []
    for vertical, sigma, size in ((False, major, np.hypot(s[0], s[1])), (True, up, np.abs(s[2]))):
        found = math.sqrt(_chi2_limit(1 if vertical else 2, part)) * sigma
        for i in range(m):
            if parity[i, i] * sigma**2 <= 1e-9:
                return math.inf, math.inf
            slope = max(size[i] / (sigma * math.sqrt(parity[i, i])), 1e-3)
            k = math.ceil(math.log(slope) / math.log(STEP))
            found = max(found, sigma * _unit_level(vertical, k, allowed, threshold, dof))
        levels_m.append(found)
    return levels_m[0], levels_m[1]
