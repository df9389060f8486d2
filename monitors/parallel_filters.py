"""Bank of parallel Kalman filters against offsets of single satellites (Vanek 1999), compiled as one call per epoch.

A navigation filter uses every healthy satellite. Detection filters leave one out, the satellite under test: its
residual, against what the others predict, is summed as chi = sum r^2 / A over a window (A = h P h' + R). Three filters
per satellite are reset to the navigation filter in turn, so that one always has a long memory. Above the threshold the
satellite is declared failed (figure of merit 1 -> 0), the navigation filter takes the state of the detection filter
that has run longest without that satellite, and every filter that used it starts again from there.

The sum is not chi-square with window degrees of freedom: residuals of one window share one drifting error (standard
deviation 5-12 instead of 6 for 18). P(chi2_18 > 64) = 4.6e-7 is therefore *not* the false-alarm rate; calibrate the
threshold by Monte Carlo.

Additions of the seed's chapter 5: a short-window sum for steps beside the long one for ramps; any reset period and
number of filters (run a second bank for longer memory); any number of satellites with sequential failures; filters on
all sets of four, never reset, which test every satellite left out; re-certification of a satellite that is well again.
"""

import itertools
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numba import njit
from pydantic import BaseModel, ConfigDict, Field, model_validator

from monitors.noise_rmd import tuned_variance
from nav.errormodels import FOOT_M
from nav.eskf_kernels import chain, joseph_scalar, predict

MAX_SET_FILTERS = 70
OLDEST, LEADING = 0, 1


@njit(cache=True, nogil=True)
def _scalar_update(x, p, hrow, z, var, g, gain):
    joseph_scalar(p, hrow, var, g, gain)
    resid = z
    for j in range(x.size):
        resid -= hrow[j] * x[j]
    for j in range(x.size):
        x[j] += gain[j] * resid


@njit(cache=True, nogil=True)
def residual(x, p, hrow, z, var):
    """(r, A): innovation of one scalar measurement and its variance."""
    n = x.size
    r = z
    a = var
    for j in range(n):
        if hrow[j] != 0.0:
            r -= hrow[j] * x[j]
            acc = 0.0
            for q in range(n):
                acc += p[j, q] * hrow[q]
            a += hrow[j] * acc
    return r, a


@njit(cache=True, nogil=True)
def _window_sum(hist, count, length):
    """Sum of the last min(count, length) entries of a ring of ratios."""
    acc = 0.0
    for age in range(min(count, length)):
        acc += hist[(count - 1 - age) % hist.size]
    return acc


@njit(cache=True, nogil=True)
def _restart(j, x, p, age):
    """Filter j (index 1..J) starts again from the navigation filter (index 0); its sums are dropped."""
    x[j] = x[0]
    p[j] = p[0]
    age[j] = 0


@njit(cache=True, nogil=True)
def _alike(use_0, use, test, avail):
    """Whether a filter tests nobody now and takes what the navigation filter takes."""
    for i in range(avail.size):
        if avail[i] and (test[i] or use[i] != use_0[i]):
            return False
    return True


@njit(cache=True, nogil=True)
def _same(a, b):
    for i in range(a.size):
        if a[i] != b[i]:
            return False
    return True


@njit(cache=True, nogil=True)
def bank_step(
    x, p, age, hist, use, test, period, phase, epoch, phi, qd, h, z, var, avail, extra_h, extra_z, extra_var,
    excluded, good, var_at_exclusion, limits, ints, resid, resid_var, stat_long, stat_short,
):  # fmt: skip
    """One epoch of the whole bank, in place; returns the satellite declared failed now, or -1.

    Filters 0 (navigation) and 1..J: ``x`` (J+1, n), ``p`` (J+1, n, n), ``age`` (J+1,) epochs since the reset,
    ``hist`` (J+1, m, W) ratios r^2/A, ``use``, ``test`` (J+1, m) bool, ``period``, ``phase`` (J+1,) epochs (0 = never).
    Satellites: ``h`` (m, n), ``z``, ``var``, ``avail`` (m,); other aids ``extra_*`` (k, ..) go into every filter.
    ``limits`` = (long, short, recertify below, growth of A allowed); ``ints`` = (short window, windows needed to
    recertify or 0, least satellites, 1 = sets (smallest statistic counts) or 0 (largest), reset rule).
    Writes ``resid``, ``resid_var`` (J+1, m), NaN where not tested, and ``stat_*`` (m,).
    """
    filters, m = use.shape
    n = x.shape[1]
    window = hist.shape[2]
    g = np.zeros(n)
    gain = np.zeros(n)
    pf = np.zeros((n, n))
    xf = np.zeros(n)
    n_short, need_good, least, sets, rule = ints[0], ints[1], ints[2], ints[3], ints[4]
    x0, p0 = x[0].copy(), p[0].copy()
    for f in range(filters):
        if (
            f > 0
            and _alike(use[0], use[f], test[f], avail)
            and _same(x[f], x0)
            and _same(p[f].ravel(), p0.ravel())
        ):
            # Of a slot that nobody is in: the navigation filter once more.
            for i in range(m):
                resid[f, i] = resid_var[f, i] = math.nan
                if test[f, i]:
                    hist[f, i, age[f] % window] = 0.0
            x[f] = x[0]
            p[f] = p[0]
            age[f] += 1
            continue
        xf[:] = np.dot(phi, x[f])
        pf[:] = p[f]
        predict(pf, phi, qd)
        for i in range(m):
            resid[f, i] = math.nan
            resid_var[f, i] = math.nan
            if test[f, i] and avail[i]:
                r, a = residual(xf, pf, h[i], z[i], var[i])
                resid[f, i] = r
                resid_var[f, i] = a
                hist[f, i, age[f] % window] = r * r / a
            elif test[f, i]:
                hist[f, i, age[f] % window] = 0.0
        for k in range(extra_z.size):
            _scalar_update(xf, pf, extra_h[k], extra_z[k], extra_var[k], g, gain)
        for i in range(m):
            if use[f, i] and avail[i] and not excluded[i]:
                _scalar_update(xf, pf, h[i], z[i], var[i], g, gain)
        x[f] = xf
        p[f] = pf
        age[f] += 1
    # Statistics and decision.
    declared = -1
    worst = 1.0
    healthy = 0
    for i in range(m):
        if avail[i] and not excluded[i]:
            healthy += 1
        long_sum = math.inf if sets == 1 else 0.0
        short_sum = long_sum
        any_test = False
        for f in range(1, filters):
            if not test[f, i]:
                continue
            any_test = True
            a_sum = _window_sum(hist[f, i], age[f], window)
            b_sum = _window_sum(hist[f, i], age[f], n_short) if age[f] >= n_short else 0.0
            if sets == 1:
                long_sum, short_sum = min(long_sum, a_sum), min(short_sum, b_sum)
            else:
                long_sum, short_sum = max(long_sum, a_sum), max(short_sum, b_sum)
        stat_long[i] = long_sum if any_test else 0.0
        stat_short[i] = short_sum if any_test else 0.0
        ratio = max(stat_long[i] / limits[0], stat_short[i] / limits[1])
        if not excluded[i] and avail[i] and ratio > worst:
            worst = ratio
            declared = i
    if declared >= 0 and healthy - 1 < least:
        declared = -1
    if declared >= 0:
        source = -1
        best = -math.inf
        for f in range(1, filters):
            if test[f, declared]:
                merit = float(age[f])
                if rule == 1:
                    merit = _window_sum(hist[f, declared], age[f], window)
                elif sets == 1:
                    merit = -resid_var[f, declared]
                if merit > best:
                    best = merit
                    source = f
        excluded[declared] = True
        good[declared] = 0
        var_at_exclusion[declared] = resid_var[source, declared]
        x[0] = x[source]
        p[0] = p[source]
        for f in range(1, filters):
            if use[f, declared]:
                _restart(f, x, p, age)
    # Re-certification, judged on full windows just before they are dropped, then scheduled resets.
    for f in range(1, filters):
        due = period[f] > 0 and (epoch - phase[f]) % period[f] == 0
        full = period[f] == 0 and age[f] > 0 and age[f] % window == 0
        if need_good > 0 and (due or full):
            for i in range(m):
                if excluded[i] and test[f, i] and avail[i] and i != declared and age[f] >= window:
                    calm = _window_sum(hist[f, i], age[f], window) <= limits[2]
                    narrow = resid_var[f, i] <= limits[3] * var_at_exclusion[i]
                    good[i] = good[i] + 1 if calm and narrow else 0
                    if good[i] >= need_good:
                        excluded[i] = False
        if due:
            _restart(f, x, p, age)
    return declared


@njit(cache=True, nogil=True)
def monte_carlo(
    x0, w, v, v2, sigma, fault, sut, baro_noise, phi, qd, h, extra_h, extra_var, p0, use, test, period, phase,
    limits, detect_from, ints, window, rmd_ring, rmd_scheme, rmd_decay, rmd_divisor, r0, rmd_short, rmd_ratio, fixed_var,
    declared_at, false_other, trace_resid, trace_var, trace_chi, trace_x, trace_p, trace_r,
):  # fmt: skip
    """Monte Carlo of the bank on a linear model (feedforward: truth and filters share phi); one call per batch of runs.

    ``x0`` (runs, n) truth, ``w`` (runs, T, n) process noise, ``v``, ``v2`` (runs, T, m) unit noise of the two
    redundant channels (until the ring of differences is full the true variance is used), ``sigma`` (T, m) true standard deviation, ``fault`` (T,) offset of satellite ``sut``,
    ``baro_noise`` (runs, T, k) noise of the other aids. ``fixed_var`` > 0 replaces the estimated R (no adaptation).
    Nothing is declared before epoch ``detect_from``. Writes the epoch (1..T) at which ``sut`` was declared (0 = never), whether any other was, and, for the first runs,
    traces of the filters that test ``sut``.
    """
    runs, t_count, m = v.shape
    filters, n = use.shape[0], x0.shape[1]
    off = np.full(4, math.inf)
    k_extra = extra_var.size
    for run in range(runs):
        truth = x0[run].copy()
        x = np.zeros((filters, n))
        p = np.zeros((filters, n, n))
        for f in range(filters):
            p[f] = p0
        age = np.zeros(filters, dtype=np.int64)
        hist = np.zeros((filters, m, window))
        excluded = np.zeros(m, dtype=np.bool_)
        good = np.zeros(m, dtype=np.int64)
        at_exclusion = np.zeros(m)
        avail = np.ones(m, dtype=np.bool_)
        resid = np.zeros((filters, m))
        resid_var = np.zeros((filters, m))
        stat_long = np.zeros(m)
        stat_short = np.zeros(m)
        rmd_ring[:] = 0.0
        z = np.zeros(m)
        var = np.zeros(m)
        extra_z = np.zeros(k_extra)
        declared_at[run] = 0
        for t in range(t_count):
            truth = np.dot(phi, truth) + w[run, t]
            for i in range(m):
                z[i] = np.dot(h[i], truth) + sigma[t, i] * v[run, t, i]
                d = sigma[t, i] * (v[run, t, i] - v2[run, t, i])
                rmd_ring[i, t % rmd_ring.shape[1]] = d
                if fixed_var > 0.0:
                    var[i] = fixed_var
                elif t + 1 < rmd_ring.shape[1]:
                    var[i] = sigma[t, i] ** 2 + r0
                else:
                    var[i] = tuned_variance(
                        rmd_ring[i], t + 1, rmd_scheme, rmd_decay, rmd_divisor, r0, rmd_short, rmd_ratio
                    )
            z[sut] += fault[t]
            for k in range(k_extra):
                extra_z[k] = np.dot(extra_h[k], truth) + baro_noise[run, t, k]
            hit = bank_step(
                x, p, age, hist, use, test, period, phase, t + 1, phi, qd, h, z, var, avail, extra_h, extra_z,
                extra_var, excluded, good, at_exclusion, off if t + 1 < detect_from else limits, ints, resid, resid_var,
                stat_long, stat_short,
            )  # fmt: skip
            if hit == sut and declared_at[run] == 0:
                declared_at[run] = t + 1
            elif hit >= 0:
                false_other[run] += 1
            if run < trace_x.shape[0]:
                c = 0
                for f in range(1, filters):
                    if test[f, sut] and c < trace_resid.shape[2]:
                        trace_resid[run, t, c] = resid[f, sut]
                        trace_var[run, t, c] = resid_var[f, sut]
                        # What the declaration saw: restarted filters have nothing left to sum.
                        trace_chi[run, t, c] = (
                            _window_sum(hist[f, sut], age[f], window) if age[f] > 0 else math.nan
                        )
                        c += 1
                trace_x[run, t] = truth - x[0]
                for a in range(n):
                    for b in range(n):
                        trace_p[run, t, a, b] = p[0, a, b]
                for i in range(m):
                    trace_r[run, t, i] = var[i] - r0


class ParallelFilters(BaseModel):
    """Scenario section of the bank (Vanek 1999, table 1: period 18, three staggered, sum over 18, threshold 64).

    ``short_threshold`` is off (infinite) unless given; ``recertify_windows`` 0 = a failed satellite stays out.
    ``recertify_growth`` bounds how much A may have grown since the exclusion: as A grows after the loss of a satellite, a
    constant offset looks ever more harmless (Vanek 1999, section 3.6.5).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    kind: Literal["parallel_filters"] = "parallel_filters"
    scheme: Literal["leave_one_out", "sets_of_four"] = "leave_one_out"
    """Each filter leaves one satellite out, or uses a set of four."""
    period_epochs: int = Field(18, ge=2, le=10_000)
    """Life of a filter before it is started afresh."""
    staggered: int = Field(3, ge=1, le=12)
    """Filters alive at a time, of different age."""
    window_epochs: int = Field(18, ge=1, le=10_000)
    """Epochs summed into the test statistic."""
    threshold: float = Field(64.0, gt=0)
    """Limit of the summed statistic."""
    short_window_epochs: int = Field(3, ge=1, le=1000)
    """Epochs of the short sum, for sudden faults."""
    short_threshold: float = Field(math.inf, gt=0)
    """Limit of the short sum; infinite: off."""
    r0_m2: float = Field(7.0 * FOOT_M**2, ge=0)
    """Range variance that the bank assumes."""
    reset_to: Literal["oldest", "leading"] = "oldest"
    """Whose state the main filter takes after a fault."""
    min_satellites: int = Field(3, ge=1, le=64)
    """Fewer satellites than this are never left by an exclusion."""
    recertify_windows: int = Field(0, ge=0, le=1000)
    """Quiet windows after which an excluded satellite returns; 0: never."""
    recertify_threshold: float = Field(
        34.8, gt=0, description="0.99 quantile of chi-square with 18 degrees of freedom"
    )
    """Limit of the statistic that counts as quiet."""
    recertify_growth: float = Field(1.5, ge=1)
    """How much the sensitivity factor may have grown since the exclusion."""

    @model_validator(mode="after")
    def _fits(self):
        if self.scheme == "leave_one_out" and self.period_epochs % self.staggered:
            raise ValueError(
                f"period_epochs ({self.period_epochs}) must be a multiple of the {self.staggered} staggered filters."
            )
        if self.short_window_epochs > self.window_epochs:
            raise ValueError("short_window_epochs must not exceed window_epochs.")
        if self.scheme == "leave_one_out" and self.window_epochs > self.period_epochs:
            raise ValueError(
                "window_epochs must not exceed period_epochs: the sums are dropped at every reset."
            )
        return self

    def layout(self, m: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """(use, test, period, phase) of the filters for m satellite slots, filter 0 = navigation."""
        if self.scheme == "sets_of_four":
            return _sets_layout(m)
        if m < 2:
            raise ValueError(f"The parallel filters need at least 2 satellites besides other aids, not {m}.")
        count = 1 + m * self.staggered
        use, test = np.ones((count, m), dtype=np.bool_), np.zeros((count, m), dtype=np.bool_)
        period, phase = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
        for j in range(1, count):
            s, f = divmod(j - 1, self.staggered)
            use[j, s], test[j, s] = False, True
            period[j], phase[j] = self.period_epochs, f * self.period_epochs // self.staggered
        return use, test, period, phase

    def numbers(self) -> tuple[np.ndarray, np.ndarray]:
        """(limits, ints) as ``bank_step`` takes them."""
        limits = np.array(
            [self.threshold, self.short_threshold, self.recertify_threshold, self.recertify_growth]
        )
        sets = int(self.scheme == "sets_of_four")
        rule = LEADING if self.reset_to == "leading" else OLDEST
        ints = [self.short_window_epochs, self.recertify_windows, self.min_satellites, sets, rule]
        return limits, np.array(ints, dtype=np.int64)

    def start(self, m: int, p0: np.ndarray) -> "ParallelBank":
        """Start on m satellite slots; ``p0`` (n, n) the navigation filter's covariance now."""
        return ParallelBank(self, m, p0)


def _sets_layout(m: int):
    """Filters on all sets of four satellites: each tests every satellite it leaves out, and is never reset."""
    if m < 5:
        raise ValueError(f"Sets of four need at least 5 satellites, not {m}.")
    sets = list(itertools.combinations(range(m), 4))
    if len(sets) > MAX_SET_FILTERS:
        raise ValueError(
            f"{m} satellites make {len(sets)} sets of four, more than {MAX_SET_FILTERS}: use leave_one_out."
        )
    use = np.zeros((1 + len(sets), m), dtype=np.bool_)
    use[0] = True
    for j, members in enumerate(sets):
        use[1 + j, list(members)] = True
    test = ~use
    zero = np.zeros(1 + len(sets), dtype=np.int64)
    return use, test, zero, zero.copy()


@dataclass(frozen=True)
class BankReport:
    """After one epoch: ``declared`` satellite or -1, ``fom`` (m,) figures of merit, statistics (m,), the navigation
    filter's error state ``x`` (n,) and covariance ``p`` (n, n); ``reset`` tells that it was just replaced.
    """

    declared: int
    fom: np.ndarray
    stat_long: np.ndarray
    stat_short: np.ndarray
    x: np.ndarray
    p: np.ndarray
    reset: bool


class ParallelBank:
    """The live bank. Call once per epoch with the same phi, Qd, H, z, R as the receiver's own filter.

    Error states are of a common nominal trajectory; when the receiver injects a correction dx into it, ``shift(dx)``
    moves every filter along. R is used as given: add R0 by ``NoiseRmd`` or pass ``spec.r0_m2`` yourself.
    """

    def __init__(self, spec: ParallelFilters, m: int, p0: np.ndarray):
        self.spec = spec
        self._layout = spec.layout(m)
        self._numbers = spec.numbers()
        filters, n = self._layout[0].shape[0], p0.shape[0]
        self.x, self.p = np.zeros((filters, n)), np.tile(np.asarray(p0, dtype=np.float64), (filters, 1, 1))
        self.excluded = np.zeros(m, dtype=np.bool_)
        self.unavailable: str | None = None
        self._age = np.zeros(filters, dtype=np.int64)
        self._hist = np.zeros((filters, m, spec.window_epochs))
        self._good, self._at = np.zeros(m, dtype=np.int64), np.zeros(m)
        self.resid, self.resid_var = np.full((filters, m), np.nan), np.full((filters, m), np.nan)
        self._long, self._short = np.zeros(m), np.zeros(m)
        self._epoch = 0

    def shift(self, dx: np.ndarray) -> None:
        """The nominal state was corrected by dx = true - estimate: subtract it from every filter's error state."""
        self.x -= dx

    def __call__(
        self, phi, qd, h, z, var, avail=None, extra_h=None, extra_z=None, extra_var=None
    ) -> BankReport:
        """One epoch: predict by (phi, qd), test, update, decide. ``extra_*`` are other aids (barometer, odometer)."""
        m, n = h.shape
        avail = np.ones(m, dtype=np.bool_) if avail is None else np.asarray(avail, dtype=np.bool_)
        extra = extra_h, extra_z, extra_var
        if extra_z is None:
            extra = np.zeros((0, n)), np.zeros(0), np.zeros(0)
        if not (np.all((var > 0) | ~avail) and np.all(extra[2] > 0)):
            raise ValueError("The parallel filters need measurement variances above zero.")
        use, test, period, phase = self._layout
        self._epoch += 1
        clean = np.where(avail, z, 0.0), np.where(avail, var, 1.0)
        declared = bank_step(
            self.x, self.p, self._age, self._hist, use, test, period, phase, self._epoch, phi, qd, h, *clean, avail,
            *extra, self.excluded, self._good, self._at, *self._numbers, self.resid, self.resid_var, self._long, self._short,
        )  # fmt: skip
        few = int((avail & ~self.excluded).sum())
        self.unavailable = None
        if few < self.spec.min_satellites + 1:
            need = self.spec.min_satellites + 1
            self.unavailable = (
                f"The parallel filters need {need} satellites to exclude one, {few} are in use."
            )
        fom = np.where(self.excluded, 0, 1)
        return BankReport(
            int(declared),
            fom,
            self._long.copy(),
            self._short.copy(),
            self.x[0].copy(),
            self.p[0].copy(),
            declared >= 0,
        )


@njit(cache=True, nogil=True)
def gather(total_phi, total_qd, moved, row, total, total_var, count, phi, qd, h, r, var, avail):
    """One epoch of the filter into a PacedBank's sums, in place; rows of ``avail`` (m,) count."""
    chain(total_phi, total_qd, phi, qd)
    moved[:] = np.dot(phi, moved)
    for i in range(avail.size):
        if not avail[i]:
            continue
        total[i] += r[i]
        for j in range(moved.size):
            total[i] += h[i, j] * moved[j]
            row[i, j] = h[i, j]
        total_var[i] += var[i]
        count[i] += 1.0


class PacedBank:
    """A ParallelBank on every n-th epoch of a filter that corrects its own trajectory in between, on the mean of the ranges.

    The bank's states are relative to the trajectory as it was at its last epoch; what the filter has corrected since then
    is carried along, m <- phi m + dx. Each satellite's mean of z = r + H m over its n epochs has the noise R / n (white
    ranges) and stands for the last of them: the prediction error hardly changes within a second.
    """

    def __init__(self, spec: ParallelFilters, m: int, p0: np.ndarray, every: int = 1):
        self.bank, self.every = spec.start(m, p0), every
        self._r0, self._shape = spec.r0_m2, (m, p0.shape[0])
        self._moved, self._epoch = np.zeros(p0.shape[0]), 0
        self._open()

    def _open(self) -> None:
        m, n = self._shape
        self._phi, self._qd, self._h = np.eye(n), np.zeros((n, n)), np.zeros((m, n))
        self._sum, self._var, self._n = np.zeros(m), np.zeros(m), np.zeros(m)

    def __call__(self, phi, qd, h, r, var, avail, dx, aids=None) -> BankReport | None:
        """One epoch of the filter: ``r`` (m,) innovations that its correction ``dx`` (n,) followed; ``aids`` (h, r, var)."""
        sums = self._phi, self._qd, self._moved, self._h, self._sum, self._var, self._n
        gather(*sums, phi, qd, h, r, var, avail)
        self._epoch += 1
        if self._epoch % self.every:
            self._moved += dx
            return None
        extra = (None, None, None) if aids is None else (aids[0], aids[1] + aids[0] @ self._moved, aids[2])
        n, there = np.maximum(self._n, 1.0), self._n > 0
        mean_var = np.where(there, self._var / n**2 + self._r0, 1.0)
        report = self.bank(self._phi, self._qd, self._h, self._sum / n, mean_var, there, *extra)
        self.bank.shift(self._moved + dx)
        self._moved = np.zeros_like(self._moved)
        self._open()
        return report

    def moved(self, dx: np.ndarray) -> None:
        """Somebody else corrected the filter's trajectory by dx."""
        self._moved += dx

    def takeover(self) -> np.ndarray:
        """dx (n,) that brings the filter to the bank's navigation filter; the bank's states move along."""
        correction = self.bank.x[0].copy()
        self.bank.shift(correction)
        return correction
