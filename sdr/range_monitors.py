"""Monitors on the ranges of one epoch: RAIM, the bias bank and the protection levels, and who among alike satellites lies.

All use the receiver's noise as it stands and judge excluded satellites too. Two satellites whose rows of the parity weight
are alike, rho = W_ij / sqrt(W_ii W_jj), explain a fault almost equally well: whoever is accused, the others that the last
``RECENT`` epochs leave possible are named beside it, and are left out with it where exclusion is asked for.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from monitors.bias_bank import BiasBank, BiasReport, chi2_limit, parity_weight
from monitors.normal_points import NormalPoints
from monitors.protection import quick_levels
from monitors.raim import isolate
from monitors.separate_bias import BiasRemoval, Removal
from nav.frames import geodetic_from_ecef, rotation_enu_to_ecef
from nav.navigator import Snapshot
from nav.navlog import NavigatorLog
from sdr.findings import PROTECTION, Alarms, found
from sdr.respond import Response

MEMORY = 400
"""Epochs in which the onset of an offset may lie: 80 s at 5 Hz."""
RECENT = 50
"""Epochs over which rivals are weighed."""
ODDS = 99.0
"""A satellite is no rival once its own fault would be this much less likely."""


@dataclass(eq=False)
class Ranges:
    """Ranges of one epoch: residuals (m,) without corrections, H (m, 5), variances (m,)."""

    names: list[str]
    raw: np.ndarray
    h: np.ndarray
    var: np.ndarray

    @cached_property
    def _score(self) -> np.ndarray:
        try:
            w, _ = parity_weight(self.h, self.var)
        except ValueError:
            return np.zeros((2, len(self.names)))
        return np.array([w @ self.raw, np.diag(w)])

    def score(self, names: list[str]) -> np.ndarray:
        """(W r, diagonal of W) of satellites ``names``; zero where the parity says nothing."""
        if names == self.names:
            return self._score
        at = [self.names.index(n) if n in self.names else -1 for n in names]
        return np.column_stack([self._score, np.zeros(2)])[:, at]


def _since(x: np.ndarray) -> np.ndarray:
    """Sums over the epochs (rows) from each to the last."""
    return np.cumsum(x[::-1], axis=0)[::-1]


class RangeMonitors:
    """Run of the range monitors of an IntegritySpec; ``alarms`` by monitor, ``response`` what they may tell."""

    def __init__(self, spec, response: Response, alarms: dict[str, Alarms]) -> None:
        self.spec, self.response, self.alarms = spec, response, alarms
        self._bank: BiasTracker | None = None if spec.bias_bank is None else BiasTracker(spec.bias_bank)
        self._past: list[Ranges] = []
        largest = 0.0 if spec.bias_bank is None else max(map(abs, spec.bias_bank.grid_m))
        self._removal = BiasRemoval(largest, MEMORY)
        self._faulty: str | None = None
        self._declared: dict[str, float] = {}
        self._next_level_s = 0.0

    def lack(self, reason: str) -> None:
        """There are no ranges."""
        for name in ("raim", "bias_bank"):
            if name in self.alarms:
                self.alarms[name].lack(reason)

    def __call__(self, snap: Snapshot, sample: int, t_s: float, out: dict[str, np.ndarray]) -> None:
        """One epoch; rows into ``out``."""
        if not math.isfinite(snap.residual_m.sum()):
            return self.lack("the ranges of this epoch are not finite numbers")
        var = self.response.variance(snap.names, snap.own_m2)
        shift = self.response.shifts(snap.names)
        h = np.empty((len(snap.names), 5))
        h[:, :3], h[:, 3], h[:, 4] = -snap.los, 1.0, snap.second
        raw = snap.residual_m + shift
        self._past.append(Ranges(snap.names, raw, h, var))
        del self._past[:-RECENT]
        self._raim(snap, h, var, sample, t_s, out)
        self._biases(snap.names, raw, h, var, sample, t_s, out)
        self._protect(snap, h, var, sample, t_s, out)

    # -- RAIM ---------------------------------------------------------------------------------------------------------

    def _raim(self, snap, h, var, sample, t_s, out) -> None:
        if self.spec.raim is None:
            return
        accused, first, reason = isolate(snap.residual_m, h, var, self.spec.raim.p_false_alarm)
        if first is None:
            self.alarms["raim"].lack(reason)
            return
        name = snap.names[first[1]]
        rivals = self.rivals(name) if accused else []
        out["raim"] = found([name], sample, t_s, first[0], 1.0, rivals=" ".join(rivals).encode())
        if reason:
            self.alarms["raim"].lack(reason)
        several = len(accused) > 1 and len({snap.names[i][0] for i in accused}) == 1
        if self.response.spec.fallback and accused and (several or reason):
            self._fall_back(snap, h, var, t_s)
        if "raim" in self.response.spec.exclude and not reason:
            self.response.accuse([snap.names[i] for i in accused] + rivals, t_s)

    def _fall_back(self, snap, h, var, t_s) -> None:
        """Keep to the constellation that agrees with itself, if exactly one does."""
        agree = []
        for system in "GE":
            part = [i for i, n in enumerate(snap.names) if n[0] == system]
            try:
                w, dof = parity_weight(h[part], var[part])
            except ValueError:
                continue
            r = snap.residual_m[part]
            if r @ w @ r < chi2_limit(dof, self.spec.raim.p_false_alarm):
                agree.append(system)
        if len(agree) == 1:
            self.response.keep(agree[0], t_s)

    # -- who it is ----------------------------------------------------------------------------------------------------

    def rivals(self, name: str) -> list[str]:
        """Satellites whose own fault would explain the last epochs nearly as well as a fault of ``name``.

        Fault of satellite i with shape s_k and size free: 2 ln L = (sum s_k (W r)_i)^2 / sum s_k^2 W_ii; the larger of a
        bias and a ramp since the epoch that suits it best, at every fourth epoch of the memory. Sums since every epoch are
        sums from the end, of ramps sums of sums, and j^2 = 2 j (j + 1) / 2 - j.
        """
        names = self._past[-1].names if self._past else []
        if name not in names:
            return []
        wr, w = (_since(x) for x in np.stack([e.score(names) for e in self._past[-RECENT:]], axis=1))
        ramp, first = _since(w), slice(None, None, 4)
        best = np.zeros(len(names))
        for score, size in ((wr, w), (_since(wr), 2.0 * _since(ramp) - ramp)):
            best = np.maximum(best, (score[first] ** 2 / np.maximum(size[first], 1e-12)).max(axis=0))
        close = best > best[names.index(name)] - 2.0 * math.log(ODDS)
        return [n for n, c in zip(names, close) if c and n != name]

    def spare(self, names: list[str], t_s: float) -> bool:
        """Whether a fault would still be seen without these satellites and those left out already."""
        last, gone = self._past[-1], self.response.out(t_s) | set(names)
        keep = [n not in gone for n in last.names]
        try:
            parity_weight(last.h[keep], last.var[keep])
        except ValueError:
            return False
        return True

    # -- bias bank ----------------------------------------------------------------------------------------------------

    def _biases(self, names, raw, h, var, sample, t_s, out) -> None:
        if self._bank is None:
            return
        gone = self.response.out(t_s)
        report = self._bank(names, raw, h, var, np.array([n not in gone for n in names], bool))
        if report is None:
            self.alarms["bias_bank"].lack(self._bank.run.unavailable)
            return
        name, value, bias_m = self._bank.suspect(report)
        rivals = self.rivals(name) if value >= self.spec.bias_bank.declare and name in names else []
        limit = self.spec.bias_bank.declare
        out["bias_bank"] = found([name], sample, t_s, value, limit, bias_m, " ".join(rivals).encode())
        if self.response.spec.bias:
            self._faulty = self._bank.faulty(report, self._removal.name)
            self._declared = self._bank.correction(report)

    def remove(self, log: NavigatorLog | NormalPoints | None, replaced: bool) -> Removal:
        """What the filter must do about the satellite that the bank accuses; without a filter its declared bias is taken off.

        ``replaced``: the filter takes another's state now.
        """
        if not self.response.spec.bias:
            return Removal(self.response.shift)
        if replaced:
            self._removal.forget()
        if log is None or log.count == 0:
            self.response.shift = self._declared
            return Removal(self.response.shift)
        removal = self._removal(log, self._faulty, self.response.shift)
        self.response.shift = removal.shift
        return removal

    # -- protection levels --------------------------------------------------------------------------------------------

    def _protect(self, snap, h, var, sample, t_s, out) -> None:
        if self.spec.protection is None or t_s < self._next_level_s:
            return
        limits = self.spec.protection
        self._next_level_s = t_s + limits.every_s - 1e-6
        use = snap.use
        lat, lon, _ = geodetic_from_ecef(snap.pos_ecef_m)
        enu = -snap.los[use] @ rotation_enu_to_ecef(lat, lon)
        clocks = h[use][:, 3:]
        if not np.ptp(clocks[:, 1]) > 0:
            clocks = clocks[:, :1]
        row = np.zeros(1, PROTECTION)
        row["sample_index"], row["t_s"] = sample, t_s
        row["hal_m"], row["val_m"] = limits.hal_m, limits.val_m
        alarms = self.alarms["protection"]
        try:
            levels, alarms.reason = quick_levels(np.column_stack([enu, clocks]), var[use], limits), None
            if not math.isfinite(sum(levels)):
                alarms.lack(
                    "a fault of one satellite would not be seen by the others: its protection level is infinite"
                )
        except ValueError as error:
            levels = math.inf, math.inf
            alarms.lack(str(error))
        row["hpl_m"], row["vpl_m"] = levels
        out["protection"] = row


class BiasTracker:
    """A bias bank whose satellites come and go; the hypotheses of those that stay go on where they stood."""

    def __init__(self, spec: BiasBank) -> None:
        self.spec, self.names = spec, list[str]()
        self.run = spec.start(1)
        self._heard, self._at = list[str](), np.zeros(0, np.int64)

    def __call__(self, names, raw, h, var, used) -> BiasReport | None:
        """One epoch of satellites ``names``; see ``BiasBankRun``."""
        if names != self._heard:
            self._seat(names)
        return self.run.ranges(self._at, raw, h, var, used)

    def _seat(self, names) -> None:
        """A place in the bank for every satellite that has none, and the place of each of ``names``."""
        new = [n for n in names if n not in self.names]
        if new:
            first = not self.names
            self.names += new
            self.run = self.spec.start(len(self.names)) if first else self.run.grown(len(self.names))
        self._heard, self._at = list(names), np.array([self.names.index(n) for n in names])

    def suspect(self, report: BiasReport) -> tuple[str, float, float]:
        """(satellite, probability of its bias or 0 when it does not fit, bias in m) of the most probable bias."""
        best = 1 + int(report.probability[1:].argmax())  # the first is that of no bias
        value = float(report.probability[best]) if report.fits or report.best != best else 0.0
        return self.names[int(report.row[best])], value, float(report.bias_m[best])

    def faulty(self, report: BiasReport, before: str | None) -> str | None:
        """The satellite that is biased by whatever size, as probable as ``declare`` wants; ``before`` stays while some bias is likelier
        than none, whoever has it."""
        if report.probability[0] > 0.5:
            return None
        of = np.bincount(report.row, np.where(report.bias_m != 0, report.probability, 0.0), len(self.names))
        top = int(np.argmax(of))
        if of[top] >= self.spec.declare and report.fits:
            return self.names[top]
        return before if of.sum() > 0.5 else None

    def correction(self, report: BiasReport) -> dict[str, float]:
        """Declared biases by name."""
        if not report.declared:
            return {}
        return {n: float(b) for n, b in zip(self.names, self.run.correction_m(report)) if b}
