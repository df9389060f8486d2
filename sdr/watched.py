"""What the integrity monitors look at: the navigator, or the filter that steers the channels. One epoch, one face.

``snapshot``: the ranges of the epoch (``nav.navigator.Snapshot``), None without a position; ``log``: the filter's epochs,
``nav.navlog.NavigatorLog`` or ``monitors.normal_points.NormalPoints``, None where no filter runs; ``innovations(n)``: the last n
epochs for an estimator that wants each innovation, ``fresh`` of them since the monitors' last epoch; ``p``: the covariance now.
Both only read, but for ``hand``, which passes an answer on.
"""

from collections import deque
from typing import Any

import numpy as np

from monitors.normal_points import NormalPoints
from nav import ultratight_kernels as kernels
from nav.eskf import EpochLog
from nav.navigator import Navigator, Snapshot
from nav.navlog import EXCLUDED_M2, NavigatorLog, Remedy
from nav.steering import LEFT_OUT, SLOTS, Steering

AT_ONCE = 50
"""Most epochs of a steering filter that wait to be gathered."""


class NavigatorWatch:
    """The navigator: least squares, or its Kalman filter where ``length`` epochs of a log are wanted."""

    def __init__(self, navigator: Navigator, length: int) -> None:
        self.navigator = navigator
        if navigator.spec.kind == "ekf":
            navigator.log = NavigatorLog(length=length)
        self.slots = 0 if navigator.log is None else navigator.log.slots
        self.fresh = 1
        self._sample = -1

    def look(self, sample: int) -> bool:
        """Whether there is an epoch at ``sample`` to judge."""
        self._sample = sample
        return True

    @property
    def snapshot(self) -> Snapshot | None:
        """Ranges of this epoch."""
        return self.navigator.snapshot

    @property
    def reason(self) -> str:
        """Why there are none, or no log."""
        if self.navigator.snapshot is None:
            return self.navigator.reason or "there was no position"
        if self.navigator.spec.kind != "ekf":
            return 'it reads a Kalman filter\'s log: set receiver.navigation.kind = "ekf"'
        return "the filter has not started"

    @property
    def log(self) -> NavigatorLog | None:
        """Log of the filter, when this epoch is in it."""
        log, t_s = self.navigator.log, self._sample / self.navigator.fs_hz
        return log if log is not None and log.count and log.last().t_s == t_s else None

    @property
    def p(self) -> np.ndarray:
        """The filter's covariance now."""
        return self.navigator._p

    def innovations(self, n: int) -> EpochLog:
        """The last n epochs."""
        assert self.navigator.log is not None
        return self.navigator.log.log(n)

    def claimed(self, n: int) -> np.ndarray:
        """(2S,) the receiver's own variances of one innovation."""
        assert self.navigator.log is not None
        return self.navigator.log.own

    def hand(self, remedy: Remedy) -> Remedy:
        """Everything is taken at the next epoch; after a reset what was logged belongs to another filter."""
        if remedy.p is not None and self.navigator.log is not None:
            self.navigator.log.drop()
        return remedy


class SteeringWatch:
    """A steering filter: every epoch is gathered, ``per_look`` of them make one that is judged."""

    def __init__(self, steering: Steering, length: int) -> None:
        f = steering.filter
        clock, drift = kernels.clock_states(f.code)
        self.steering, self.filter, self.slots = steering, f, SLOTS
        self.points = NormalPoints(f.p.shape[0], SLOTS, clock, drift, length)
        self._gain = np.repeat(np.array([clock, drift]), SLOTS)
        self._single: deque[np.ndarray] = deque(maxlen=length)
        self.fresh, self._ready, self._epoch = 0, False, steering.filter.epochs - 1
        self._name: list[tuple[str, int] | None] = []
        self._names: list[str | None] = []

    def gather(self) -> None:
        """Take the filter's newest epochs into the window."""
        self.points.add(*self.filter.since(self._epoch))
        self._epoch = self.filter.epochs

    def hear(self) -> None:
        """The filter finished an epoch; they are gathered together, long before its log forgets them."""
        if self.filter.epochs - self._epoch >= AT_ONCE:
            self.gather()

    def look(self, sample: int) -> bool:
        """End the window at ``sample``; False when it does not count."""
        st = self.steering
        if st.name != self._name:
            self._name = list(st.name)
            self._names = [
                None if n is None else f"{'G' if n[0] == 'L1CA' else 'E'}{n[1]:02d}" for n in st.name
            ]
        self.gather()
        self._ready = self.points.close(sample / st.fs_hz, self._names, st.inflate, self.filter.p)
        self.fresh = self.points.epochs
        self._single.append(self.points.single.copy())
        return self._ready

    @property
    def snapshot(self) -> Snapshot | None:
        """Ranges of this epoch: normal points about the trajectory at the window's start."""
        p, st = self.points, self.steering
        i = np.flatnonzero(p.seen[:SLOTS])
        if not self._ready or not len(i):
            return None
        return Snapshot(
            [str(p.names[k]) for k in i], self.filter.los[i].copy(), st.second[i].copy(), p.z[i], p.own[i] * st.inflate[i],
            p.own[i], st.inflate[i] < LEFT_OUT, self.filter.position()[0],
        )  # fmt: skip

    @property
    def reason(self) -> str:
        """Why there are none."""
        return "the steering filter was not fed"

    @property
    def log(self) -> NormalPoints | None:
        """Normal points."""
        return self.points if self._ready else None

    @property
    def p(self) -> np.ndarray:
        """The filter's covariance now."""
        return self.filter.p

    def innovations(self, n: int) -> EpochLog:
        """The last n epochs of the filter itself, rows of unit gain, ``s`` empty; without excluded rows.

        ALS seeks one variance per row: epochs of less than half the row's usual gain, whose unit-gain noise is at least
        four times the usual, are not looked at (they stay in the filter's gains).
        """
        log = self.filter.log(n)
        g = log.h[:, np.arange(SLOTS * 2), self._gain]
        told = log.used & (g > 0) & (log.var < 0.5 * EXCLUDED_M2)
        usual = np.array([np.median(x[t]) if t.any() else 0.0 for x, t in zip(g.T, told.T)])
        used = told & (g > 0.5 * usual)
        g[~told] = 1.0
        # In place: these are megabytes.
        np.divide(log.h, g[:, :, None], out=log.h)
        np.multiply(log.k, g[:, None, :], out=log.k)
        np.divide(log.r, g, out=log.r)
        np.divide(log.var, g**2, out=log.var)
        return log._replace(used=used)

    def claimed(self, n: int) -> np.ndarray:
        """(2S,) the receiver's own variances of one innovation, mean over about the last n epochs."""
        rows = np.array(self._single)[-max(1, round(n / max(self.fresh, 1))) :]
        count = np.isfinite(rows).sum(axis=0)
        return np.where(count > 0, np.nansum(rows, axis=0) / np.maximum(count, 1), 1.0)

    def own_m2(self) -> dict[str, float]:
        """The receiver's own variance of each range, to which an answer is in proportion."""
        return {
            str(n): float(v)
            for n, v, s in zip(self.points.names, self.points.own, self.points.seen)
            if n and s
        }

    def hand(self, remedy: Remedy) -> Remedy:
        """A new state or covariance is taken at once, between two epochs; the rest by ``Steering.heed``."""
        self.filter.correct(remedy.dx, remedy.p)
        self.filter.extra = remedy.extra
        if remedy.p is not None:
            self.points.restart(remedy.p)
        return remedy._replace(dx=None, p=None, extra=None)


Watched = NavigatorWatch | SteeringWatch
__all__: list[Any] = ["NavigatorWatch", "SteeringWatch", "Watched"]
