"""Monitors on a Kalman filter's epochs, the navigator's or the steering filter's: innovations, ALS, parallel filters."""

import math
from functools import lru_cache

import numpy as np

from monitors.bias_bank import chi2_limit
from monitors.normal_points import NormalPoints
from monitors.parallel_filters import BankReport, PacedBank
from monitors.protection import all_positive, innovation_ratios
from nav.navlog import NavigatorLog
from sdr.findings import Alarms, found
from sdr.respond import Response
from sdr.watched import Watched

LEAST_SHARE = 1e-4
"""Smallest variance that ALS may ask for, as a share of the largest."""
P_NOISE = 1e-6
"""False-alarm probability of "noisier than claimed"."""


@lru_cache(maxsize=16)
def noise_limit(n: int) -> float:
    """Ratio of sigmas that an estimate from n values exceeds with probability ``P_NOISE``: 1 + z / sqrt(2 n)."""
    from scipy.special import ndtri

    return 1.0 - float(ndtri(P_NOISE)) / math.sqrt(2.0 * n)


class FilterMonitors:
    """Run of the filter monitors of an IntegritySpec on one filter; a new filter needs a new one."""

    def __init__(self, spec, response: Response, alarms: dict[str, Alarms], slots: int) -> None:
        self.spec, self.response, self.alarms = spec, response, alarms
        self._als = None if spec.als is None else spec.als.start(np.arange(slots))
        self._bank: PacedBank | None = None
        self._broken = False

    def __call__(
        self, watch: Watched, sample: int, t_s: float, out
    ) -> tuple[np.ndarray | None, np.ndarray | None]:
        """One epoch; rows into ``out``. Returns (dx, covariance) that the filter should take over, or None."""
        log = watch.log
        if log is None:
            return self._lack(watch.reason)
        var = self._variances(log)
        if not all_positive(var, log.seen):
            return self._lack("the filter's range variances are not all above zero")
        if not math.isfinite(log.z.sum()):
            return self._lack("the filter's innovations are not finite numbers")
        names = [str(n) for n, x in zip(log.names, log.seen.tolist()) if x]
        self._innovations(log, names, var, sample, t_s, out)
        dx, p = self._parallel(watch, log, names, var, sample, t_s, out)
        if p is not None and self._als is not None:
            self._als.restart()
            return dx, p
        retuned = self._noise(watch, log, sample, t_s, out)
        return dx, p if retuned is None else retuned

    def _lack(self, reason: str) -> tuple[None, None]:
        for name in ("innovation", "als", "parallel_filters"):
            if name in self.alarms:
                self.alarms[name].lack(reason)
        return None, None

    def moved(self, dx: np.ndarray) -> None:
        """The filter's state was corrected by somebody else."""
        if self._bank is not None:
            self._bank.moved(dx)

    def _variances(self, log: NavigatorLog | NormalPoints) -> np.ndarray:
        """(S,) range variances in force, of excluded satellites too: theirs are judged by what they would weigh."""
        return self.response.variance(log.names, log.own[: log.slots])

    def _innovations(self, log, names, var, sample, t_s, out) -> None:
        if self.spec.innovation is None:
            return
        ratio, limit = np.empty(len(names)), chi2_limit(1, self.spec.innovation.p_false_alarm)
        innovation_ratios(log.h, log.last().p, log.z, var, log.seen, ratio)
        out["innovation"] = found(names, sample, t_s, ratio, limit)
        if "innovation" not in self.response.spec.exclude:
            return
        # One satellite that stands out; when most do, the noise is wrong and no satellite is at fault.
        high = [n for n, x in zip(names, ratio.tolist()) if x > limit]
        if 2 * len(high) < len(names):
            self.response.accuse(high, t_s)

    # -- noise ----------------------------------------------------------------------------------------------------------

    def _noise(self, watch, log, sample, t_s, out) -> np.ndarray | None:
        """ALS when its window is full; returns the covariance to restart with, if it may."""
        if self._als is None:
            return None
        may = self.response.spec.noise == "als"
        result = self._als.look(watch.innovations, watch.fresh)
        self.alarms["als"].lack(self._als.unavailable)
        if result is None:
            return None
        names = [log.names[r] for r in result.rows]
        sigma, claimed = result.sigma_m, watch.claimed(self.spec.als.window_epochs)[result.rows]
        now = np.sqrt(self.response.variance(names, claimed))
        out["als"] = found(names, sample, t_s, sigma / now, noise_limit(result.n_epochs), sigma)
        if not may:
            return None
        # Non-negative least squares may end at exactly zero, which is no variance.
        least = LEAST_SHARE * float(sigma.max()) ** 2
        self.response.scale |= {n: max(s * s, least) / c for n, s, c in zip(names, sigma, claimed)}
        return result.covariance if self.spec.als.retune_p else None

    # -- parallel filters -------------------------------------------------------------------------------------------------

    def _parallel(
        self, watch, log, names, var, sample, t_s, out
    ) -> tuple[np.ndarray | None, np.ndarray | None]:
        spec = self.spec.parallel_filters
        if spec is None or not self._start(watch):
            return None, None
        assert self._bank is not None
        last, m = log.last(), log.slots
        seen = log.seen[:m]
        raw = log.z[:m] + self.response.shifts(log.names)
        report = self._bank(last.phi, last.qd, log.h[:m], raw, var, seen, log.dx)
        if report is None:
            return None, None
        self.alarms["parallel_filters"].lack(self._bank.bank.unavailable)
        out["parallel_filters"] = found(names, sample, t_s, report.stat_long[seen], spec.threshold)
        return self._act(log, report)

    def _start(self, watch: Watched) -> bool:
        if self._bank is None and not self._broken:
            try:
                spec = self.spec.parallel_filters
                self._bank = PacedBank(spec, watch.slots, watch.p, self.spec.bank_every)
            except ValueError as error:
                self._broken = True
                self.alarms["parallel_filters"].lack(str(error))
        return self._bank is not None

    def _act(self, log: NavigatorLog, report: BankReport) -> tuple[np.ndarray | None, np.ndarray | None]:
        assert self._bank is not None
        if "parallel_filters" in self.response.spec.exclude:
            failed = self._bank.bank.excluded
            self.response.failed = {n for n, x in zip(log.names, failed) if n and x}
        if not (report.reset and self.response.spec.reset):
            return None, None
        return self._bank.takeover(), report.p
