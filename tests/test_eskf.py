"""Error-state engine: textbook twins, the log's identities, stability, consistency and refusals."""

import time

import numpy as np
import pytest
from scipy.linalg import expm

from nav import eskf, eskf_kernels
from nav.errormodels import Ecef17, EcefState
from nav.eskf import Eskf


def small_model(rng, n=6, m=4):
    f = rng.normal(size=(n, n)) * 0.3
    h = rng.normal(size=(m, n))
    a = rng.normal(size=(n, n))
    return f, h, a @ a.T + np.eye(n), rng.uniform(0.5, 3.0, m), rng.uniform(0.01, 0.2, n)


def test_discretise_and_van_loan_agree_with_the_exponential():
    f, _, _, _, q = small_model(np.random.default_rng(0))
    dt = 1e-3
    exact, qd_exact = eskf.van_loan(f, q, dt)
    np.testing.assert_allclose(exact, expm(f * dt), rtol=1e-12)
    phi, qd = eskf.discretise(f, q, dt)
    # Remainders: |F dt|^3/6 and the trapezoid's dt^3 |F|^2 q / 6 (numbers for |F| < 2).
    np.testing.assert_allclose(phi, exact, atol=(2 * dt) ** 3)
    np.testing.assert_allclose(qd, qd_exact, atol=dt**3 * 4 * q.max())
    fine = (
        sum(expm(f * s) @ np.diag(q) @ expm(f * s).T for s in (np.arange(2000) + 0.5) * dt / 2000) * dt / 2000
    )
    np.testing.assert_allclose(qd_exact, fine, rtol=1e-7)


def test_psd_root_keeps_the_small_units():
    """Radians and metres in one matrix: every entry to 1e-12 of its own scale."""
    d = np.array([1e-9, 1e-7, 1.0, 30.0])
    c = np.eye(4) + 0.3 * (np.ones((4, 4)) - np.eye(4))
    m = c * np.outer(d, d)
    root = eskf.psd_root(m)
    np.testing.assert_allclose(root @ root.T, m, rtol=1e-12)
    assert not eskf.psd_root(np.zeros((2, 2))).any()


def test_lyapunov_steady_state():
    """A stable scalar Gauss-Markov state settles at q / (2 beta)."""
    phi, qd = eskf.van_loan(np.array([[-0.5]]), np.array([0.2]), 0.1)
    filt = Eskf(np.array([[5.0]]), 1)
    for _ in range(400):
        filt.predict(phi, qd)
    assert filt.p[0, 0] == pytest.approx(0.2, rel=1e-9)


def test_update_is_the_textbook_one_and_the_gain_is_the_batch_gain():
    rng = np.random.default_rng(1)
    _, h, p0, var, _ = small_model(rng)
    z = rng.normal(size=4)
    filt = Eskf(p0, 4)
    dx = filt.update(z, h, var).copy()
    s = h @ p0 @ h.T + np.diag(var)
    k = p0 @ h.T @ np.linalg.inv(s)
    log = filt.log()
    np.testing.assert_allclose(log.k[0], k, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(log.s[0], s, rtol=1e-12)
    np.testing.assert_allclose(dx, k @ z, rtol=1e-10)
    a = np.eye(6) - k @ h
    np.testing.assert_allclose(filt.p, a @ p0 @ a.T + k @ np.diag(var) @ k.T, rtol=1e-9, atol=1e-12)


def test_correlated_noise_is_the_textbook_update():
    rng = np.random.default_rng(2)
    _, h, p0, _, _ = small_model(rng)
    b = rng.normal(size=(4, 4))
    r = b @ b.T + np.eye(4)
    z = rng.normal(size=4)
    used = np.array([True, False, True, True])
    filt = Eskf(p0, 4)
    dx = filt.update(z, h, r, used).copy()
    hu, ru = h[used], r[np.ix_(used, used)]
    k = p0 @ hu.T @ np.linalg.inv(hu @ p0 @ hu.T + ru)
    np.testing.assert_allclose(dx, k @ z[used], rtol=1e-9)
    np.testing.assert_allclose(filt.log().k[0][:, used], k, rtol=1e-9)
    assert not filt.log().k[0][:, 1].any()


def test_unused_rows_change_nothing_whatever_they_hold():
    rng = np.random.default_rng(3)
    _, h, p0, var, _ = small_model(rng)
    z = rng.normal(size=4)
    used = np.array([True, True, False, True])
    a, b = Eskf(p0, 4), Eskf(p0, 4)
    dx_a = a.update(z, h, var, used).copy()
    z2, var2 = z.copy(), var.copy()
    z2[2], var2[2] = np.nan, -1.0
    dx_b = b.update(z2, h, var2, used)
    np.testing.assert_array_equal(dx_a, dx_b)
    np.testing.assert_array_equal(a.p, b.p)


def test_log_reproduces_the_prediction_error_recursion():
    """phi of the log chains every predict between two updates."""
    rng = np.random.default_rng(4)
    f, h, p0, var, q = small_model(rng)
    phi, qd = eskf.discretise(f, q, 0.02)
    filt = Eskf(p0, 4)
    for _ in range(5):
        for _ in range(3):
            filt.predict(phi, qd)
        filt.update(rng.normal(size=4), h, var)
    log = filt.log()
    np.testing.assert_allclose(log.phi[2], phi @ phi @ phi, rtol=1e-12, atol=1e-14)
    p = log.p[1]
    post = p - log.k[1] @ log.s[1] @ log.k[1].T
    np.testing.assert_allclose(log.phi[2] @ post @ log.phi[2].T + log.qd[2], log.p[2], rtol=1e-9, atol=1e-11)


def test_ring_keeps_the_latest_in_order():
    filt = Eskf(np.eye(2), 1, log_length=4)
    for i in range(7):
        filt.update(np.array([float(i)]), np.array([[1.0, 0.0]]), np.ones(1), t_s=float(i))
    np.testing.assert_array_equal(filt.log().t_s, [3, 4, 5, 6])
    np.testing.assert_array_equal(filt.log(2).r[:, 0], [5, 6])
    with pytest.raises(ValueError, match="holds 4 epochs"):
        filt.log(5)


def test_joseph_form_stays_positive_where_the_plain_form_does_not():
    """Prior 1e6 times worse than the measurement, two nearly equal rows, 20,000 updates."""
    p = np.diag([1e8, 1e8, 1e-6])
    h = np.array([[1.0, 1.0, 0.0], [1.0, 1.0 + 1e-7, 0.0]])
    filt = Eskf(p, 2)
    for _ in range(20_000):
        filt.predict(np.eye(3), np.diag([1e-9, 1e-9, 0.0]))
        filt.update(np.zeros(2), h, np.full(2, 1e-10))
    assert np.linalg.eigvalsh(filt.p).min() > -1e-9 * np.abs(filt.p).max()
    np.testing.assert_array_equal(filt.p, filt.p.T)


def ecef_problem(rate_hz=10.0, n_epochs=300, m=7):
    rng = np.random.default_rng(5)
    model = Ecef17()
    s = EcefState(np.array([3.1e6, 4.6e6, 2.6e6]), np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3), 0.0, 0.0)
    u = rng.normal(size=(m, 3))
    u /= np.linalg.norm(u, axis=1)[:, None]
    h = np.zeros((m, 17))
    h[:, 0:3], h[:, 15] = -u, 1.0
    t = np.arange(n_epochs) / rate_hz
    pairs = [
        eskf.discretise(
            model.f_matrix(s, np.array([3 * np.sin(x), 2 * np.cos(x), -9.8])), model.q_diag(), 1 / rate_hz
        )
        for x in t
    ]
    p0 = np.diag(np.r_[[100.0] * 3, [1.0] * 3, [1e-4] * 3, [2.5e-3] * 3, [1e-8] * 3, 900.0, 9.0])
    return np.array([a for a, _ in pairs]), np.array([b for _, b in pairs]), np.tile(h, (n_epochs, 1, 1)), p0


def test_nees_and_nis_of_the_17_state_filter_are_chi_square():
    """Monte Carlo on the exact linear model: means within z = 5 of n and m."""
    phi, qd, h, p0 = ecef_problem()
    log = eskf.linear_log(phi, qd, h, np.full(7, 4.0), p0, 0.1)
    runs = 200
    r, err = eskf.replay(log, p0, np.full(7, 4.0), runs, np.random.default_rng(6))
    s_inv = np.linalg.inv(log.s)
    nis = np.einsum("era,eab,erb->er", r, s_inv, r)
    # Innovations of the true filter are white: epochs are independent.
    assert abs(nis.mean() - 7) < 5 * np.sqrt(2 * 7 / nis.size)
    prior = log.p[-1]
    post = prior - log.k[-1] @ log.s[-1] @ log.k[-1].T
    d = 1 / np.sqrt(np.diag(post))
    corr = post * np.outer(d, d)
    nees = np.einsum("ra,ab,rb->r", err[-1] * d, np.linalg.inv(corr), err[-1] * d)
    assert abs(nees.mean() - 17) < 5 * np.sqrt(2 * 17 / runs)


def test_live_filter_and_gain_schedule_are_the_same():
    phi, qd, h, p0 = ecef_problem(n_epochs=40)
    log = eskf.linear_log(phi, qd, h, np.full(7, 4.0), p0, 0.1)
    filt = Eskf(p0, 7)
    for e in range(40):
        filt.predict(phi[e], qd[e])
        filt.update(np.zeros(7), h[e], np.full(7, 4.0))
    np.testing.assert_allclose(filt.log().k, log.k, rtol=1e-9, atol=1e-15)
    values, dof = eskf.nis(filt.log())
    assert np.all(dof == 7) and np.all(values == 0)


def test_kernel_nis_is_the_quadratic_form():
    rng = np.random.default_rng(8)
    a = rng.normal(size=(5, 5))
    s, r = a @ a.T + np.eye(5), rng.normal(size=5)
    used = np.array([True, False, True, True, False])
    value, dof = eskf_kernels.nis(r, s, used)
    sub = s[np.ix_(used, used)]
    assert dof == 3 and value == pytest.approx(r[used] @ np.linalg.solve(sub, r[used]), rel=1e-12)


def test_step_cost_is_small_against_a_python_loop():
    """20 rows x 17 states: one compiled step against the same algebra in numpy, in one run."""
    phi, qd, h7, p0 = ecef_problem(n_epochs=1)
    h = np.ascontiguousarray(np.tile(h7[0], (3, 1))[:20])
    used, var, z = np.ones(20, dtype=bool), np.full(20, 4.0), np.zeros(20)
    k, s, prior, dx = np.zeros((17, 20)), np.zeros((20, 20)), np.zeros((17, 17)), np.zeros(17)
    p = p0.copy()
    eskf_kernels.step(p, phi[0], qd[0], h, var, used, z, k, s, prior, dx)

    def compiled():
        eskf_kernels.step(p, phi[0], qd[0], h, var, used, z, k, s, prior, dx)

    def plain():
        q = phi[0] @ p0 @ phi[0].T + qd[0]
        for i in range(20):
            gain = q @ h[i] / (h[i] @ q @ h[i] + 4.0)
            a = np.eye(17) - np.outer(gain, h[i])
            q = a @ q @ a.T + np.outer(gain, gain) * 4.0

    def best(function):
        spans = []
        for _ in range(60):
            start = time.thread_time()
            function()
            spans.append(time.thread_time() - start)
        return min(spans)

    assert best(compiled) < 0.5 * best(plain)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Eskf(np.array([[1.0, 2.0], [0.0, 1.0]]), 1), "symmetric"),
        (lambda: Eskf(np.eye(2), 0), "m_max"),
        (lambda: Eskf(np.eye(2), 1).update(np.zeros(2), np.zeros((2, 2)), np.ones(2)), "1 rows"),
        (lambda: Eskf(np.eye(2), 1).update(np.zeros(1), np.ones((1, 2)), np.array([-1.0])), "above zero"),
        (lambda: Eskf(np.eye(2), 1).update(np.array([np.nan]), np.ones((1, 2)), np.ones(1)), "finite"),
    ],
)
def test_refusals(call, message):
    with pytest.raises(ValueError, match=message):
        call()
