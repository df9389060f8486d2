"""The measurement-integrity monitors together on a running filter's epoch log, and what they ask the receiver to do.

Each monitor reads the log only. What may act is a matter of ``Respond``; with everything off (the default) the filter and
its log are never touched, so that a run with monitors is bit-identical to one without.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from monitors.als import Als, AlsResult
from monitors.bias_bank import BiasBank, BiasReport
from monitors.parallel_filters import BankReport, PacedBank, ParallelFilters
from nav.eskf import Eskf

LEAST_SHARE = 1e-4
"""Smallest estimated variance that is used, as a share of the largest."""


class Respond(BaseModel):
    """Which answers act: estimated R, identified bias removed, failed satellite excluded, filter reset."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    noise: bool = False
    bias: bool = False
    exclude: bool = False
    reset: bool = False


class Integrity(BaseModel):
    """Scenario section. ``bank_every`` epochs of the filter make one epoch of the parallel filters."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    kind: Literal["integrity"] = "integrity"
    als: Als | None = Als()
    bias_bank: BiasBank | None = BiasBank()
    parallel_filters: ParallelFilters | None = ParallelFilters()
    bank_every: int = Field(1, ge=1, le=10_000)
    respond: Respond = Respond()

    def start(self, filt: Eskf, range_rows: np.ndarray, aid_rows: np.ndarray | None = None) -> "IntegrityRun":
        """Start on a filter; ``range_rows`` index one pseudorange row per satellite, ``aid_rows`` other aids."""
        return IntegrityRun(self, filt, np.asarray(range_rows), aid_rows)


@dataclass(frozen=True)
class Remedy:
    """What holds from the next epoch on, over the filter's m rows.

    ``var_m2`` (m,) NaN where the receiver's own R stands; ``bias_m`` (m,) to subtract from the measurements; ``exclude``
    (m,) bool; ``dx`` (n,) or None: a correction to inject now, when the filter was reset. The reports of this epoch
    are None where a monitor gave none; ``unavailable`` holds one sentence per monitor that could not work.
    """

    var_m2: np.ndarray
    bias_m: np.ndarray
    exclude: np.ndarray
    dx: np.ndarray | None
    als: AlsResult | None
    bias: BiasReport | None
    bank: BankReport | None
    unavailable: dict[str, str]


class IntegrityRun:
    """Call once per epoch, after ``filt.update`` and before its dx is forgotten."""

    def __init__(self, spec: Integrity, filt: Eskf, rows: np.ndarray, aid_rows: np.ndarray | None):
        m = filt.n_rows
        if rows.size == 0 or rows.min() < 0 or rows.max() >= m or np.unique(rows).size != rows.size:
            raise ValueError(f"range_rows must be different measurement rows between 0 and {m - 1}.")
        self.spec, self.rows = spec, rows
        self.aids = np.zeros(0, dtype=np.int64) if aid_rows is None else np.asarray(aid_rows)
        self._als = None if spec.als is None else spec.als.start(rows)
        self._bias = None if spec.bias_bank is None else spec.bias_bank.start(rows.size)
        self._bank = None
        if spec.parallel_filters is not None:
            self._bank = PacedBank(spec.parallel_filters, rows.size, filt.p, spec.bank_every)
        self._var, self._shift = np.full(m, np.nan), np.zeros(m)
        self._exclude = np.zeros(m, dtype=np.bool_)

    def __call__(self, filt: Eskf, dx: np.ndarray, z=None, h=None, seen=None) -> Remedy:
        """One epoch.

        ``dx`` (n,) is what ``filt.update`` returned and the receiver injects. ``z`` (m,), ``h`` (m, n), ``seen`` (m,) are
        this epoch's innovations, rows and availability *with* the excluded satellites, which stay under test; by default
        the log's, in which rows that the filter did not use are empty.
        """
        log = filt.log(1)
        seen = log.used[0] if seen is None else np.asarray(seen, dtype=np.bool_)
        h = log.h[0] if h is None else h
        raw = np.where(seen, (log.r[0] if z is None else z) + self._shift, 0.0)
        lacks: dict[str, str] = {}
        bank, correction = self._parallel(filt, log, raw, h, seen, dx, lacks)
        bias = self._biases(log, raw, lacks)
        als = self._noise(filt, lacks)
        return Remedy(
            self._var.copy(), self._shift.copy(), self._exclude.copy(), correction, als, bias, bank, lacks
        )

    def _noise(self, filt, lacks) -> AlsResult | None:
        """ALS on the range rows; last, since retuning empties the log."""
        if self._als is None:
            return None
        result = self._als(filt, self.spec.respond.noise)
        if self._als.unavailable:
            lacks["als"] = self._als.unavailable
        if result is not None and self.spec.respond.noise:
            estimate = np.diag(result.r_cov_m2)
            # Non-negative least squares may end at exactly zero, which is no variance.
            self._var[result.rows] = np.maximum(estimate, LEAST_SHARE * estimate.max())
        return result

    def _biases(self, log, raw, lacks) -> BiasReport | None:
        """Bias bank on the uncorrected innovations of the used ranges."""
        if self._bias is None:
            return None
        rows = self.rows
        report = self._bias(raw[rows], log.h[0][rows], log.var[0][rows], log.used[0][rows])
        if report is None:
            lacks["bias_bank"] = self._bias.unavailable
        elif self.spec.respond.bias:
            self._shift[rows] = self._bias.correction_m(report)
        return report

    def _parallel(self, filt, log, raw, h, seen, dx, lacks) -> tuple[BankReport | None, np.ndarray | None]:
        """Parallel filters; what they declare is excluded, and the filter reset, where that is asked for."""
        if self._bank is None:
            return None, None
        rows, aids = self.rows, self.aids[log.used[0][self.aids]]
        others = (h[aids], raw[aids], log.var[0][aids]) if aids.size else None
        report = self._bank(
            log.phi[0], log.qd[0], h[rows], raw[rows], log.var[0][rows], seen[rows], dx, others
        )
        if report is None:
            return None, None
        if self._bank.bank.unavailable:
            lacks["parallel_filters"] = self._bank.bank.unavailable
        if self.spec.respond.exclude:
            self._exclude[rows] = self._bank.bank.excluded
        if not (report.reset and self.spec.respond.reset):
            return report, None
        correction = self._bank.takeover()
        filt.reset(report.p)
        return report, correction
