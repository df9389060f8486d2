"""Kernels of the error-state filter: discretisation, prediction, sequential Joseph updates, gain schedules.

Everything works on plain float64 arrays, n states and m measurement rows; rows that are not ``used`` are skipped
and leave zero columns in the gain, so that a row keeps its place (one row = one channel) while satellites come and go.
"""

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def discretise(f, q_diag, dt_s, phi, qd):
    """Transition and process noise of one step, Phi = I + F dt + F^2 dt^2/2, Qd = (Phi Qc Phi' + Qc) dt/2.

    ``f`` (n, n) in 1/s, ``q_diag`` (n,) the diagonal of Qc; writes ``phi`` and ``qd`` (n, n).
    Trapezoidal rule of the integral in Van Loan 1978, eq. 1.2.
    """
    n = f.shape[0]
    f2 = np.dot(f, f)
    half = 0.5 * dt_s * dt_s
    for i in range(n):
        for j in range(n):
            phi[i, j] = f[i, j] * dt_s + f2[i, j] * half
        phi[i, i] += 1.0
    for i in range(n):
        for j in range(i, n):
            acc = 0.0
            for k in range(n):
                acc += phi[i, k] * q_diag[k] * phi[j, k]
            if i == j:
                acc += q_diag[i]
            qd[i, j] = 0.5 * dt_s * acc
            qd[j, i] = qd[i, j]


@njit(cache=True, nogil=True)
def predict(p, phi, qd):
    """P <- Phi P Phi' + Qd in place, symmetric by construction."""
    n = p.shape[0]
    t = np.dot(phi, p)
    for i in range(n):
        for j in range(i, n):
            acc = qd[i, j]
            for k in range(n):
                acc += t[i, k] * phi[j, k]
            p[i, j] = acc
            p[j, i] = acc


@njit(cache=True, nogil=True)
def chain(phi_total, qd_total, phi, qd):
    """Append one step to an accumulated transition: Phi_t <- Phi Phi_t, Qd_t <- Phi Qd_t Phi' + Qd."""
    phi_total[:] = np.dot(phi, phi_total)
    predict(qd_total, phi, qd)


@njit(cache=True, nogil=True)
def innovation_covariance(p, h, var, used, s):
    """S = H P H' + diag(R) over the used rows; zero elsewhere."""
    m, n = h.shape
    g = np.zeros(n)
    s[:] = 0.0
    for i in range(m):
        if not used[i]:
            continue
        g[:] = 0.0
        for j in range(n):
            if h[i, j] != 0.0:
                for q in range(n):
                    g[q] += h[i, j] * p[j, q]
        for a in range(i, m):
            if used[a]:
                acc = 0.0
                for q in range(n):
                    acc += h[a, q] * g[q]
                s[i, a] = acc
                s[a, i] = acc
        s[i, i] += var[i]


@njit(cache=True, nogil=True)
def joseph_scalar(p, hrow, var, g, gain):
    """One scalar measurement: writes P h to ``g`` and the gain to ``gain``, updates P; returns S = h'Ph + R.

    Joseph form P <- (I - k h') P (I - k h')' + R k k' evaluated in O(n^2) as
    P - k g' - (A h - R k) k', A = P - k g' (Bucy and Joseph 1968; Bierman 1977, III.5).
    """
    n = p.shape[0]
    g[:] = 0.0
    for j in range(n):
        hj = hrow[j]
        if hj != 0.0:
            for q in range(n):
                g[q] += hj * p[j, q]
    hg = 0.0
    for j in range(n):
        hg += hrow[j] * g[j]
    s = hg + var
    inv = 1.0 / s
    hk = 0.0
    for j in range(n):
        gain[j] = g[j] * inv
        hk += hrow[j] * gain[j]
    for i in range(n):
        # (A h - R k)_i, zero but for rounding: the term that makes the form stable.
        rest = g[i] - gain[i] * hg - var * gain[i]
        ki = gain[i]
        for j in range(i, n):
            p[i, j] -= ki * g[j] + rest * gain[j]
            p[j, i] = p[i, j]
    return s


@njit(cache=True, nogil=True)
def update(p, h, var, used, z, k, dx):
    """Sequential scalar Joseph updates with diagonal R; P in place, dx and the equivalent batch gain K written.

    ``z`` (m,) innovations about dx = 0, ``h`` (m, n), ``var`` (m,). K (n, m) satisfies dx = K z exactly, whatever
    the order: K <- (I - k_i h_i') K before column i is set to k_i.
    """
    m, n = h.shape
    g = np.zeros(n)
    gain = np.zeros(n)
    dx[:] = 0.0
    k[:] = 0.0
    for i in range(m):
        if not used[i]:
            continue
        joseph_scalar(p, h[i], var[i], g, gain)
        resid = z[i]
        for j in range(n):
            resid -= h[i, j] * dx[j]
        for j in range(n):
            dx[j] += gain[j] * resid
        for c in range(i):
            if used[c]:
                acc = 0.0
                for j in range(n):
                    acc += h[i, j] * k[j, c]
                for j in range(n):
                    k[j, c] -= gain[j] * acc
        for j in range(n):
            k[j, i] = gain[j]


@njit(cache=True, nogil=True)
def step(p, phi, qd, h, var, used, z, k, s, p_prior, dx):
    """One navigation epoch: predict, S, update. All outputs are arrays passed in."""
    predict(p, phi, qd)
    p_prior[:] = p
    innovation_covariance(p, h, var, used, s)
    update(p, h, var, used, z, k, dx)


@njit(cache=True, nogil=True)
def nis(r, s, used):
    """Normalised innovation squared r' S^-1 r over the used rows; returns (value, degrees of freedom)."""
    m = r.size
    low = np.zeros((m, m))
    y = np.zeros(m)
    total = 0.0
    dof = 0
    for i in range(m):
        if not used[i]:
            continue
        for j in range(i):
            if used[j]:
                acc = s[i, j]
                for q in range(j):
                    acc -= low[i, q] * low[j, q]
                low[i, j] = acc / low[j, j]
        acc = s[i, i]
        for q in range(i):
            acc -= low[i, q] * low[i, q]
        if not acc > 0.0:
            return math.nan, 0
        low[i, i] = math.sqrt(acc)
        acc = r[i]
        for q in range(i):
            acc -= low[i, q] * y[q]
        y[i] = acc / low[i, i]
        total += y[i] * y[i]
        dof += 1
    return total, dof


@njit(cache=True, nogil=True)
def gain_schedule(p, phi, qd, h, var, used, k_out, s_out, p_out):
    """Run the covariance alone over E epochs (gains do not depend on data); phi[e] leads from e-1 to e.

    ``phi`` (E, n, n), ``h`` (E, m, n), ``var`` (E, m); epoch 0 is predicted with phi[0] too (identity to start at P).
    """
    m, n = h.shape[1:]
    dx = np.zeros(n)
    z = np.zeros(m)
    for e in range(phi.shape[0]):
        step(p, phi[e], qd[e], h[e], var[e], used[e], z, k_out[e], s_out[e], p_out[e], dx)


@njit(cache=True, nogil=True)
def replay(e0, phi, h, k, w, v, r_out, e_out):
    """True prediction errors and innovations of a linear filter with given gains, for many runs at once.

    e_k = phi_k e+_{k-1} + w_k ; r_k = H e_k + v_k ; e+_k = e_k - K r_k. ``e0`` (runs, n) is the posterior error
    before epoch 0; ``w`` (E, runs, n), ``v`` (E, runs, m); writes ``r_out`` (E, runs, m) and ``e_out`` (E, runs, n),
    the error after each update.
    """
    err = e0.copy()
    for t in range(phi.shape[0]):
        prior = np.dot(err, phi[t].T) + w[t]
        r = np.dot(prior, h[t].T) + v[t]
        err = prior - np.dot(r, k[t].T)
        r_out[t] = r
        e_out[t] = err
