"""Rare misses and rare errors: importance sampling of one epoch, multilevel splitting through closed loops.

Both are unbiased for any settings; settings decide the variance alone. Their intervals come from independent
repetitions, never from within one.
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from monitors.batch import sum_dumps
from signals.constants import METRES_PER_CHIP

__all__ = [
    "Course",
    "Importance",
    "Splitting",
    "find_levels",
    "importance_miss_rate",
    "repeated_rate",
    "split",
]

_MAX_LEVELS = 60


class Importance(BaseModel):
    """Mean-shift importance sampling of single epochs without loops: P_MD of the GLRT against a CW.

    A trial is one repetition. See ``importance_miss_rate``.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    kind: Literal["importance"] = "importance"
    draws: int = Field(20_000, ge=100, le=10_000_000)
    """Draws of one repetition."""


class Splitting(BaseModel):
    """Fixed-effort multilevel splitting with the closed-loop twin, whose state is cloned where it crosses a level.

    Level: largest |code error| so far over ``trial.excess_m`` (definitions excess, undetected), or the share of the
    pass without an alarm (event). Every stage follows ``particles`` paths from where the last stage's crossed, each
    with noise of its own; P = product of the shares that cross (Garvels, PhD thesis, Twente 2000, section 3.2.1).
    Carrier phase of the jammer, symbols and echoes stay those of the path's beginning. A trial is one repetition.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    kind: Literal["splitting"] = "splitting"
    particles: int = Field(200, ge=10, le=100_000)
    """Paths followed in each stage."""
    levels: tuple[float, ...] | None = None  # ascending, between 0 and 1; None: from a pilot of its own seed
    success: float = Field(0.2, gt=0, lt=1)
    """Share of the paths that should cross each level found by the pilot."""

    @model_validator(mode="after")
    def _check(self):
        levels = self.levels or ()
        if any(not 0 < x < 1 for x in levels) or any(b <= a for a, b in pairwise(levels)):
            raise ValueError("levels must ascend and lie between 0 and 1; the event itself, at 1, is added")
        return self


def importance_miss_rate(run, disturbance, threshold, n_draws, seed, shrink=1.0):
    """P_MD of the GLRT against a CW, one epoch and no loops, by mean-shift importance sampling.

    In whitened coordinates y = u + noise, noise ~ CN(0, 2 s2 I), u = P W (disturbance). Draw it about the shift sh =
    -(1 - x) u, x = sqrt(2 s2 threshold) / |u|, where misses are common, and weight each miss by
    exp(-(Re(sh^H noise) - |sh|^2 / 2) / s2).

    Parameters
    ----------
    run : monitors.glrt.GlrtRun
        Started with accumulate_epochs = 1; its noise variance must be known.
    disturbance : complex (K,)
        The CW at the taps (prompt = 1), without noise: ``tracking.correlator_model.cw_taps``. The peak is projected out.
    shrink : float
        Multiplies the shift; 0 is plain counting.

    Returns
    -------
    p, relative_se, n_effective : float
        n_effective = (sum w)^2 / sum w^2 over the misses.
    """
    s2 = run.noise_variance
    u = run.operator @ np.asarray(disturbance)
    norm = float(np.linalg.norm(u))
    x = min(1.0, math.sqrt(2 * s2 * threshold) / norm)
    shift = -shrink * (1 - x) * u
    rng = np.random.Generator(np.random.Philox(seed))
    weights = []
    done = 0
    while done < n_draws:
        m = min(8192, n_draws - done)
        g = rng.standard_normal((2, m, len(u)))
        noise = math.sqrt(s2) * (g[0] + 1j * g[1]) + shift
        log_w = -((noise @ shift.conj()).real - 0.5 * np.sum(np.abs(shift) ** 2)) / s2
        missed = run.whitened_statistic(noise + u) < threshold
        weights.append(np.where(missed, np.exp(log_w), 0.0))
        done += m
    w = np.concatenate(weights)
    p = float(w.mean())
    if p == 0.0:
        return 0.0, math.inf, 0.0
    return p, float(w.std() / math.sqrt(len(w)) / p), float(w.sum() ** 2 / np.sum(w * w))


# -- splitting ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Course:
    """What a path is watched for: its level over time, and when it is over.

    ``monitor``, ``threshold``: a trained Run of single epochs and its limit, unused for "excess". ``first``,
    ``stop``: monitor epochs, counted from the twin's start, between which the path is watched (for "event" the pass
    with its time to alert). ``limit_m``: of the raw code error.
    """

    definition: str  # "event", "excess" or "undetected"
    first: int
    stop: int
    limit_m: float = math.inf
    monitor: Any = None
    threshold: float = math.inf
    dumps: int = 1
    chunk: int = 100

    def levels(self, epochs, corr, at):
        """Level at each monitor epoch of a stretch that begins with epoch ``at`` -> float (m,), and whether it died."""
        alarm = np.zeros(len(epochs) // self.dumps, bool)
        if self.definition != "excess":
            alarm = self.monitor.fresh()(sum_dumps(corr, self.dumps))["value"] >= self.threshold
        if self.definition == "event":
            died = np.flatnonzero(alarm)
            level = (at + 1 + np.arange(len(alarm)) - self.first) / (self.stop - self.first)
            return (level[: died[0]], True) if len(died) else (level, False)
        error = np.abs(epochs["code_error_chips"]) * METRES_PER_CHIP
        error = np.where(np.repeat(alarm, self.dumps), 0.0, error).reshape(-1, self.dumps)
        return error.max(axis=1) / self.limit_m, False


@dataclass
class _Path:
    """One run of the twin and the highest level it has reached."""

    run: Any
    level: float = 0.0

    def branch(self, key):
        return _Path(self.run.branch(key), self.level)

    def advance(self, course, goal):
        """Follow until the level reaches ``goal`` (True) or the course ends (False); stops in the very epoch."""
        if self.level >= goal:
            return True
        d = course.dumps
        while (at := self.run.epoch // d) < course.stop:
            state, epoch = self.run.state.copy(), self.run.epoch
            m = min(course.chunk, course.stop - at)
            level, died = course.levels(*self.run(m * d), at)
            above = np.flatnonzero(level >= goal)
            if len(above):
                self.run.state[:], self.run.epoch = state, epoch
                self.run((int(above[0]) + 1) * d)
                self.level = float(level[above[0]])
                return True
            self.level = max(self.level, float(level.max(initial=0.0)))
            if died:
                return False
        return False


def _key(root, *numbers):
    return np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, *numbers))


def _paths(twin, course, root, stage, pool, n):
    """The n paths of a stage: new ones, or branches of the pool, each member as often as the next (at random)."""
    if stage == 0:
        for i in range(n):
            run = twin.start(_key(root, 0, i))
            run(course.first * course.dumps)
            yield _Path(run)
        return
    order = np.random.Generator(np.random.Philox(_key(root, stage, n))).permutation(len(pool))
    for i in range(n):
        key = _key(root, stage, i).generate_state(1, np.uint64)[0]
        yield pool[order[i % len(pool)]].branch(key)


def split(twin, course, levels, particles, root):
    """One repetition of fixed-effort splitting: unbiased estimate of P(the level reaches 1).

    Parameters
    ----------
    twin : tracking.correlator_model.Twin
    course : Course
    levels : float (L,)
        Ascending, the last is 1.
    root : SeedSequence
        Of this repetition.

    Returns
    -------
    p : float
    crossed : int (L,)
        Paths of ``particles`` that crossed each level.
    """
    pool: list[_Path] = []
    crossed, p = np.zeros(len(levels), np.int64), 1.0
    for stage, goal in enumerate(levels):
        pool = [
            path for path in _paths(twin, course, root, stage, pool, particles) if path.advance(course, goal)
        ]
        crossed[stage] = len(pool)
        p *= len(pool) / particles
        if not pool:
            break
        for path in pool:
            path.run.rest()
    return p, crossed


def find_levels(twin, course, particles, success, root):
    """Levels that about ``success`` of the paths cross, from a pilot -> float (L,) that ends with 1.

    Each stage runs its paths to their end, takes the level that the best of them reached and follows them again,
    with the same noise, to there. Use another root than for the estimate, which stays unbiased whatever comes out.
    """
    levels: list[float] = []
    pool: list[_Path] = []
    while len(levels) < _MAX_LEVELS:
        best = []
        for path in _paths(twin, course, root, len(levels), pool, particles):
            path.advance(course, math.inf)
            best.append(path.level)
        best.sort()
        last = levels[-1] if levels else 0.0
        goal = best[min(int(particles * (1 - success)), particles - 1)]
        if goal <= last:
            goal = next((b for b in best if b > last), last)
        if goal >= 1.0:
            return np.array([*levels, 1.0])
        if goal <= last:
            raise ValueError(
                f"splitting: none of {particles} paths got beyond level {last:.3g}: use more particles, or give levels"
            )
        levels.append(goal)
        stage = len(levels) - 1
        pool = [p for p in _paths(twin, course, root, stage, pool, particles) if p.advance(course, goal)]
        for path in pool:
            path.run.rest()
    raise ValueError(
        f"splitting: more than {_MAX_LEVELS} levels; use a larger success or a more frequent event"
    )


def repeated_rate(estimates, confidence=0.95):
    """Mean of independent unbiased estimates with its interval -> (p, low, high, n_effective).

    Student's t on the mean, taken of its logarithm: p exp(-+t se / p), since such estimates are positive and skewed.
    n_effective = p (1 - p) / se^2: as many independent trials would tell as much. All zero: no upper limit below 1.
    """
    from scipy.special import stdtrit

    x = np.asarray(estimates, float)
    p = float(x.mean()) if len(x) else math.nan
    if len(x) < 2 or not p > 0:
        return p, 0.0, 1.0, float(len(x))
    se = float(x.std(ddof=1)) / math.sqrt(len(x))
    factor = math.exp(min(stdtrit(len(x) - 1, 0.5 + 0.5 * confidence) * se / p, 500.0))
    effective = p * (1 - p) / se**2 if se > 0 else math.inf
    return p, p / factor, min(1.0, p * factor), effective
