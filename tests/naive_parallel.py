"""Textbook twin of the parallel filter bank: one Kalman filter object per filter, written from Vanek's text."""

import numpy as np


class Filter:
    """A Kalman filter that may not use one satellite, and sums its squared normalised residuals."""

    def __init__(self, p0, skip=None):
        self.x, self.p, self.skip, self.chi, self.age = np.zeros(len(p0)), p0.copy(), skip, [], 0

    def epoch(self, phi, qd, rows, z, var, numbers, failed):
        """Predict, form the residual of the satellite under test, update with the others."""
        self.x, self.p = phi @ self.x, phi @ self.p @ phi.T + qd
        if self.skip is not None:
            i = numbers.index(self.skip)
            a = rows[i] @ self.p @ rows[i] + var[i]
            self.chi.append((z[i] - rows[i] @ self.x) ** 2 / a)
        use = [i for i, s in enumerate(numbers) if s != self.skip and s not in failed]
        h = rows[use]
        k = self.p @ h.T @ np.linalg.inv(h @ self.p @ h.T + np.diag(var[use]))
        self.x = self.x + k @ (z[use] - h @ self.x)
        self.p = (np.eye(len(self.x)) - k @ h) @ self.p
        self.p = (self.p + self.p.T) / 2
        self.age += 1

    def take(self, other):
        """Reset to another filter's estimate; the sum begins anew."""
        self.x, self.p, self.chi, self.age = other.x.copy(), other.p.copy(), [], 0


def bank(phi, qd, h, baro, z, var, p0, threshold=64.0, period=18, count=3, window=18):
    """Run all epochs; rows are (barometer, satellites). Returns nav x (T, n), largest sums (T, m), declarations."""
    m = h.shape[0]
    numbers = ["baro", *range(m)]
    rows = np.vstack([baro, h])
    nav = Filter(p0)
    tests = [[Filter(p0, s) for _ in range(count)] for s in range(m)]
    failed, out_x, out_stat, declared = set(), [], [], []
    for t in range(1, len(z) + 1):
        for f in [nav, *(f for group in tests for f in group)]:
            f.epoch(phi, qd, rows, z[t - 1], var[t - 1], numbers, failed)
        stat = [max(sum(f.chi[-window:]) for f in group) for group in tests]
        over = [s for s in range(m) if s not in failed and stat[s] > threshold]
        if over and m - len(failed) - 1 >= 3:
            s = max(over, key=lambda i: stat[i])
            oldest = max(tests[s], key=lambda f: f.age)
            nav.x, nav.p = oldest.x.copy(), oldest.p.copy()
            failed.add(s)
            declared.append((t, s))
            for other in range(m):
                if other != s:
                    for f in tests[other]:
                        f.take(nav)
        for group in tests:
            for i, f in enumerate(group):
                if (t - i * period // count) % period == 0:
                    f.take(nav)
        out_x.append(nav.x.copy())
        out_stat.append(stat)
    return np.array(out_x), np.array(out_stat), declared
