"""Separate-bias estimation against the filter with one more state, and the removal of an offset from a filter that goes on."""

import numpy as np
import pytest

from monitors.separate_bias import RATE_SIGMA_MPS, BiasRemoval, SeparateBias
from nav.eskf import EpochLog, Eskf

N, M, ROW, DT_S = 4, 6, 2, 0.2
PHI = np.eye(N) + np.diag([DT_S, 0.0, DT_S], 1)
QD = np.diag([1e-3, 1e-2, 1e-3, 1e-2])
VAR = np.array([1.0, 2.0, 1.5, 1.0, 3.0, 1.0])
TAU_M = 20.0


def rows(k):
    """Geometry of epoch k."""
    return np.random.default_rng([7, k]).standard_normal((M, N))


class Face:
    """A filter of four states whose log has the face of ``NormalPoints``."""

    def __init__(self, names="ABCDEF", geometry=rows):
        self.filt, self.geometry, self.z = Eskf(np.eye(N), M), geometry, np.zeros(M)
        self.x, self.dx, self.names = np.zeros(N), np.zeros(N), list(names)
        self.epochs, self.count, self.length = [], 0, 1000

    def step(self, k, z):
        self.filt.predict(PHI, QD)
        self.x = PHI @ self.x
        prior = self.filt.p.copy()
        h = self.geometry(k)
        s = h @ prior @ h.T + np.diag(VAR)
        gain = prior @ h.T @ np.linalg.inv(s)
        r = z - h @ self.x
        self.dx = self.filt.update(r, h, VAR).copy()
        np.testing.assert_allclose(self.dx, gain @ r, atol=1e-9)
        self.x += self.dx
        used = np.ones(M, bool)
        self.epochs.append(EpochLog(k * DT_S, PHI, QD, h, gain, r, s, VAR, prior, used))
        self.count += 1

    def last(self):
        return self.epochs[-1]

    def log(self, n):
        return EpochLog(*(np.array(a) for a in zip(*self.epochs[-n:])))


def augmented(z, onset, drifts, sigma, row=ROW):
    """(x, P, bias, its variance, log likelihood) of the filter that has the offset as its fifth state, known to begin at epoch ``onset``."""
    p = np.zeros((N + 1, N + 1))
    p[:N, :N], p[N, N] = np.eye(N), sigma**2
    x, log_l = np.zeros(N + 1), 0.0
    phi, qd = np.eye(N + 1), np.zeros((N + 1, N + 1))
    phi[:N, :N], qd[:N, :N] = PHI, QD
    for k, one in enumerate(z):
        x, p = phi @ x, phi @ p @ phi.T + qd
        h = np.column_stack([rows(k), np.zeros(M)])
        if k >= onset:
            h[row, N] = (k - onset + 1) * DT_S if drifts else 1.0
        s, r = h @ p @ h.T + np.diag(VAR), one - h @ x
        log_l -= 0.5 * (r @ np.linalg.solve(s, r) + np.linalg.slogdet(s)[1])
        gain = p @ h.T @ np.linalg.inv(s)
        x, p = x + gain @ r, p - gain @ h @ p
    return x[:N], p[:N, :N], x[N], p[N, N], log_l


@pytest.mark.parametrize(("drifts", "sigma"), [(False, TAU_M), (True, RATE_SIGMA_MPS)])
def test_a_known_onset_gives_the_filter_with_one_more_state(drifts, sigma):
    """Friedland's identity, to rounding: state, covariance, size and its variance."""
    rng, onset, n = np.random.default_rng(3), 10, 40
    z = 3.0 * rng.standard_normal((n, M))
    face, run = Face(), SeparateBias([ROW], N, TAU_M)
    for k in range(n):
        face.step(k, z[k])
        run(face.last(), face.last().r, DT_S, onset=k == onset)
    run._keep((run._drifts == drifts) & np.isinf(run._until_s))
    got = run.posterior((n - 1) * DT_S, M)
    x, p, size, var, _ = augmented(z, onset, drifts, sigma)
    np.testing.assert_allclose(face.x - got.effect, x, atol=1e-9)
    np.testing.assert_allclose(face.filt.p + got.cov, p, atol=1e-9)
    np.testing.assert_allclose(1.0 / (run._info + sigma**-2.0), var, rtol=1e-9)
    np.testing.assert_allclose(got.size_m[ROW], size * ((n - onset) * DT_S if drifts else 1.0), rtol=1e-9)
    np.testing.assert_array_equal(got.weight, np.arange(M) == ROW)


def test_satellites_weigh_by_the_evidence_of_the_filter_with_one_more_state():
    """Mixture of the augmented filters of two rows, by the likelihood of their innovations: weights, state and covariance."""
    rng, onset, n = np.random.default_rng(8), 10, 20
    z = np.sqrt(VAR) * rng.standard_normal((n, M))
    z[onset:, ROW] += 1.0
    face, run = Face(), SeparateBias([1, ROW], N, TAU_M)
    for k in range(n):
        face.step(k, z[k])
        run(face.last(), face.last().r, DT_S, onset=k == onset)
    run._keep(~run._drifts)
    got = run.posterior((n - 1) * DT_S, M)
    each = [augmented(z, onset, False, TAU_M, row) for row in (1, ROW)]
    w = np.exp([one[4] - each[0][4] for one in each])
    w /= w.sum()
    x = sum(a * one[0] for a, one in zip(w, each))
    p = sum(a * (one[1] + np.outer(one[0] - x, one[0] - x)) for a, one in zip(w, each))
    assert 0.01 < w.min()
    np.testing.assert_allclose(got.weight[[1, ROW]], w, rtol=1e-9)
    np.testing.assert_allclose(got.size_m[[1, ROW]], [a * one[2] for a, one in zip(w, each)], rtol=1e-8)
    np.testing.assert_allclose(face.x - got.effect, x, atol=1e-9)
    np.testing.assert_allclose(face.filt.p + got.cov, p, atol=1e-9)


def test_the_evidence_finds_onset_and_shape():
    """A step of 12 m (10 sigma an epoch) after 30 epochs: all the weight on that onset and on the step; a ramp likewise."""
    rng = np.random.default_rng(4)
    for drifts in (False, True):
        face, run = Face(), SeparateBias(range(M), N, TAU_M)
        for k in range(80):
            z = np.sqrt(VAR) * rng.standard_normal(M)
            z[ROW] += 0.0 if k < 30 else 2.0 * (k - 29) * DT_S if drifts else 12.0
            face.step(k, z)
            run(face.last(), face.last().r, DT_S, onset=True)
        got = run.posterior(79 * DT_S, M)
        assert np.all(run._drifts == drifts) and np.all(
            np.abs(run._since_s - 29 * DT_S) < 2.5 * DT_S + drifts
        )
        assert got.weight[ROW] > 0.99 and abs(got.size_m[ROW] - (20.0 if drifts else 12.0)) < 5 * np.sqrt(
            VAR[ROW] / 10
        )


def fly(removal, n=200, start=60, stop=10**9, named=(80, 10**9), size_m=10.0, seed=5):
    """Truth at rest at zero: (final error, claimed covariance, shifts): ``removal`` acts while row 2 is named."""
    rng, face = np.random.default_rng(seed), Face()
    truth, shift, taken, extra = np.zeros(N), {}, [], np.zeros((N, N))
    for k in range(n):
        truth = PHI @ truth + np.sqrt(np.diag(QD)) * rng.standard_normal(N)
        z = rows(k) @ truth + np.sqrt(VAR) * rng.standard_normal(M)
        z[ROW] += size_m * (start <= k < stop) - shift.get("C", 0.0)
        face.step(k, z)
        if removal is None:
            continue
        out = removal(face, "C" if named[0] <= k < named[1] else None, shift)
        shift = out.shift
        taken.append(shift.get("C", 0.0))
        if out.dx is not None:
            face.x = face.x + out.dx
        extra = np.zeros((N, N)) if out.extra is None else out.extra
        if out.ended:
            face.filt.p += extra
            face.count, face.epochs = 0, []
    return truth - face.x, face.filt.p + extra, taken


def test_a_drift_that_ends_is_one_offset():
    """3 m/s for 5 s, named within, then 15 m for good: 20 flights' errors are as large as claimed, and 15 m are taken off."""
    from scipy.stats import chi2

    total, last = 0.0, []
    for seed in range(20):
        rng, face, removal = np.random.default_rng(seed), Face(), BiasRemoval(TAU_M, 1000)
        truth, shift, out = np.zeros(N), dict[str, float](), None
        for k in range(140):
            truth = PHI @ truth + np.sqrt(np.diag(QD)) * rng.standard_normal(N)
            z = rows(k) @ truth + np.sqrt(VAR) * rng.standard_normal(M)
            z[ROW] += 3.0 * min(max(k - 60, 0) * DT_S, 5.0) - shift.get("C", 0.0)
            face.step(k, z)
            out = removal(face, None if k < 70 else "C", shift)
            shift = out.shift
            face.x = face.x if out.dx is None else face.x + out.dx
        error = truth - face.x
        total += error @ np.linalg.solve(face.filt.p + out.extra, error)
        last.append(shift["C"])
    low, high = chi2.isf([1 - 3e-7, 3e-7], 20 * N)
    assert low < total < high
    # 55 epochs of the row alone, and a third of them spent on telling the state from it.
    assert abs(np.mean(last) - 15.0) < 5 * np.sqrt(VAR[ROW] / (20 * 55 / 3))


def test_feeding_the_estimate_back_changes_nothing_but_the_filter():
    """An offset taken off ranges and state epoch by epoch leaves the state that batch estimation at the end gives."""
    error, cov, taken = fly(BiasRemoval(TAU_M, 1000))
    plain, face_cov, _ = fly(None)
    rng, face, run = np.random.default_rng(5), Face(), SeparateBias(range(M), N, TAU_M)
    truth = np.zeros(N)
    for k in range(200):
        truth = PHI @ truth + np.sqrt(np.diag(QD)) * rng.standard_normal(N)
        z = rows(k) @ truth + np.sqrt(VAR) * rng.standard_normal(M)
        z[ROW] += 10.0 * (k >= 60)
        face.step(k, z)
        run(face.last(), face.last().r, DT_S, onset=k <= 80)
    end = run.posterior(200 * DT_S, M)
    np.testing.assert_allclose(error, truth - (face.x - end.effect), atol=1e-6)
    np.testing.assert_allclose(cov, face.filt.p + end.cov, atol=1e-6)
    assert abs(taken[-1] - 10.0) < 5 * np.sqrt(VAR[ROW] / 60) and np.count_nonzero(taken) == 120
    np.testing.assert_allclose(plain, truth - face.x, atol=1e-12)
    np.testing.assert_allclose(face_cov, face.filt.p, atol=1e-12)


@pytest.mark.parametrize("when", [{}, {"stop": 140, "named": (80, 150)}])
def test_errors_are_as_large_as_claimed(when):
    """Normalised squared errors of 60 flights sum to a chi-square of 30 * 4; while the offset stands, and after it has ended.

    Left in, the offset makes it thousands; taken off without its uncertainty, half as much again.
    """
    from scipy.stats import chi2

    total = 0.0
    for seed in range(30):
        error, cov, _ = fly(BiasRemoval(TAU_M, 1000), n=160, size_m=4.0, seed=seed, **when)
        total += error @ np.linalg.solve(cov, error)
    low, high = chi2.isf([1 - 3e-7, 3e-7], 30 * N)
    assert low < total < high


def alike(k):
    """Rows B and C differ by a fifth of any other two."""
    h = np.random.default_rng(7).standard_normal((M, N)) + 0.1 * rows(k)
    h[1] = h[ROW] + 0.2 * h[1]
    return h


@pytest.mark.parametrize("named", ["B", "C"])
def test_of_two_alike_the_claim_holds_the_doubt(named):
    """B drifts and is named, or C instead: either way the errors of 30 flights are as large as claimed, a chi-square of 30 * 4."""
    from scipy.stats import chi2

    total = 0.0
    for seed in range(30):
        rng, face, removal = np.random.default_rng(seed), Face(geometry=alike), BiasRemoval(TAU_M, 1000)
        truth, shift, extra = np.zeros(N), dict[str, float](), np.zeros((N, N))
        for k in range(160):
            truth = PHI @ truth + np.sqrt(np.diag(QD)) * rng.standard_normal(N)
            z = alike(k) @ truth + np.sqrt(VAR) * rng.standard_normal(M)
            z[1] += 0.3 * max(k - 60, 0) * DT_S
            z -= [shift.get(n, 0.0) for n in face.names]
            face.step(k, z)
            out = removal(face, None if k < 100 else named, shift)
            shift = out.shift
            if out.dx is not None:
                face.x, extra = face.x + out.dx, out.extra
        error = truth - face.x
        total += error @ np.linalg.solve(face.filt.p + extra, error)
    low, high = chi2.isf([1 - 3e-7, 3e-7], 30 * N)
    assert low < total < high


def test_another_satellite_named_undoes_the_first():
    """C is accused at first, B is at fault: the end is that of a removal that accused B from the start."""
    ends = []
    for wrong in (True, False):
        rng, face, removal = np.random.default_rng(9), Face(), BiasRemoval(TAU_M, 1000)
        shift: dict[str, float] = {}
        for k in range(120):
            z = np.sqrt(VAR) * rng.standard_normal(M)
            z[1] += 8.0 * (k >= 50) - shift.get("B", 0.0)
            z[ROW] -= shift.get("C", 0.0)
            face.step(k, z)
            name = None if k < 60 else "C" if wrong and k < 80 else "B"
            out = removal(face, name, shift)
            shift = out.shift
            face.x = face.x if out.dx is None else face.x + out.dx
        ends.append(face.x)
    np.testing.assert_allclose(ends[0], ends[1], atol=2e-2)
