"""Seed 001 (Vanek 1999, parallel Kalman filters) on its own 13-state linear model, in feet.

Four satellites, 1 Hz, runs of 250 s, detection from 150 s, faults from 200 s. The thesis does not give the satellite
geometry, the barometer's noise, speed or latitude. The geometry used here is the one of 22 random ones that fits its
Tables 2 and 3 best; the rest hardly matters. Detection filters that test the satellite under test are simulated, as in
the thesis; the others are not, since only that satellite fails.
"""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from monitors import noise_rmd
from monitors import parallel_filters as pf
from nav import eskf
from nav.errormodels import FOOT_M, Pinson13, measurement_rows, pinson_state, unit_vectors_enu
from sdr.reproduce import clopper_pearson, new_figure, row, save_figure, write_table

GEOMETRY = {
    "G*": ((202.0, 144.0, 221.0, 71.0), (21.0, 53.0, 53.0, 41.0)),
    "C": ((45.0, 135.0, 225.0, 315.0), (50.0, 20.0, 45.0, 25.0)),
    "Z": ((0.0, 0.0, 120.0, 240.0), (90.0, 20.0, 20.0, 20.0)),
}
"""Azimuths and elevations; the satellite under test is the first."""
T_END, T_WARM, T_FAULT = 250, 150, 200
SIGMA_FT = 3.0
BARO_VAR_FT2 = 100.0
LAT_RAD, SPEED_FPS = math.radians(40.0), 500.0
P0_SIGMA = np.r_[[300 * FOOT_M / 6.4e6] * 2, 1e-5, [2e-5] * 3, [0.3] * 3, 30.0, 30.0, 30.0, 0.3]
STEPS = ((22, 0.0), (20, 0.1), (15, 0.2), (10, 0.7), (5, 0.8))
RAMPS = ((2.0, 0.0), (1.5, 0.0), (1.0, 0.3), (0.5, 0.7))
RAMPS_V = ((2.0, 0.0), (1.5, 0.0), (1.0, 0.7), (0.5, 0.9))
"""(fault, published missed-alarm rate of 10 runs): Tables 2, 3 and 4. Steps in feet, ramps in feet per second."""


class Scene(NamedTuple):
    """A linear problem in metres."""

    phi: np.ndarray
    root_qd: np.ndarray
    qd: np.ndarray
    h: np.ndarray
    baro_h: np.ndarray
    enu: np.ndarray
    p0: np.ndarray


class Outcome(NamedTuple):
    """Per run: epoch of the declaration (0 = never); and traces of the first runs."""

    declared_at: np.ndarray
    resid: np.ndarray
    resid_var: np.ndarray
    chi: np.ndarray
    x: np.ndarray
    p: np.ndarray
    r_hat: np.ndarray


def scene(geometry: str = "G*", model: Pinson13 | None = None) -> Scene:
    """The printed model (F44 without restoring term) at a fixed latitude, straight and level flight to the north-east."""
    model = Pinson13(form="feedforward", printed_baro=True) if model is None else model
    speed = SPEED_FPS * FOOT_M / math.sqrt(2)
    state = pinson_state(LAT_RAD, 0.0, 10_000 * FOOT_M, [speed, speed, 0.0])
    phi, qd = eskf.van_loan(model.f_matrix(state, np.array([0.0, 0.0, 9.8])), model.q_diag(), 1.0)
    az, el = GEOMETRY[geometry]
    h = measurement_rows(model, state, unit_vectors_enu(az, el) @ state.c_en)
    lam, vec = np.linalg.eigh(qd)
    root = vec * np.sqrt(np.clip(lam, 0, None))
    return Scene(phi, root, qd, h, model.baro_row()[None], model.enu_map(state), np.diag(P0_SIGMA**2))


def spec(**changes) -> pf.ParallelFilters:
    """Table 1 of the thesis."""
    return pf.ParallelFilters(r0_m2=changes.pop("r0_ft2", 7.0) * FOOT_M**2, **changes)


def simulate(
    s: Scene,
    bank: pf.ParallelFilters,
    fault_ft,
    runs: int,
    seed,
    sigma_ft=None,
    n_r: int = 50,
    adapt: bool = True,
    detect: bool = True,
    traces: int = 0,
) -> Outcome:
    """Run a batch. ``fault_ft`` (T,) on the first satellite, ``sigma_ft`` (T, m); ``adapt`` False = R fixed at 9 ft^2."""
    rng = np.random.default_rng(seed)
    m, n = s.h.shape
    sigma = np.full((T_END, m), SIGMA_FT) if sigma_ft is None else sigma_ft
    use, test, period, phase = bank.layout(m)
    keep = np.r_[0, np.flatnonzero(test[:, 0])]
    layout = tuple(np.ascontiguousarray(a[keep]) for a in (use, test, period, phase))
    limits, ints = bank.numbers()
    traced = min(traces, runs)
    shape = traced, T_END
    out = Outcome(
        np.zeros(runs, dtype=np.int64), *(np.full((*shape, 3), np.nan) for _ in range(3)),
        np.full((*shape, n), np.nan), np.full((*shape, n, n), np.nan), np.full((*shape, m), np.nan),
    )  # fmt: skip
    other = np.zeros(runs, dtype=np.int64)
    rmd = noise_rmd.NoiseRmd(window=n_r, scheme="printed", pairing="two_channel")
    empty = np.zeros((0, 0, 3))
    for lo in range(0, runs, 50):
        b = min(50, runs - lo)
        noise = rng.standard_normal((b, T_END, n)) @ s.root_qd.T
        x0 = rng.standard_normal((b, n)) @ np.sqrt(s.p0)
        v, v2 = rng.standard_normal((2, b, T_END, m))
        baro = rng.standard_normal((b, T_END, 1)) * math.sqrt(BARO_VAR_FT2) * FOOT_M
        parts = [a[lo : lo + b] for a in out[1:]] if lo < traced else [empty] * 3 + [
            np.zeros((0, 0, n)), np.zeros((0, 0, n, n)), np.zeros((0, 0, m))
        ]  # fmt: skip
        fixed = 0.0 if adapt else (SIGMA_FT * FOOT_M) ** 2
        pf.monte_carlo(
            x0, noise, v, v2, sigma * FOOT_M, np.asarray(fault_ft) * FOOT_M, 0, baro, s.phi, s.qd, s.h, s.baro_h,
            np.array([BARO_VAR_FT2 * FOOT_M**2]), s.p0, *layout, limits, T_WARM if detect else T_END + 1, ints,
            bank.window_epochs, np.zeros((m, n_r)), noise_rmd.SCHEMES[rmd.scheme], rmd.decay, rmd.divisor,
            bank.r0_m2 if adapt else 0.0, 0, 2.0, fixed, out.declared_at[lo : lo + b], other[lo : lo + b], *parts,
        )  # fmt: skip
    return out


def step_fault(size_ft: float) -> np.ndarray:
    """Offset from 200 s on."""
    return np.where(np.arange(1, T_END + 1) >= T_FAULT, size_ft, 0.0)


def ramp_fault(rate_fps: float) -> np.ndarray:
    """Ramp from 200 s on."""
    return rate_fps * np.clip(np.arange(1, T_END + 1) - T_FAULT, 0.0, None)


def case_v_sigma(m: int = 4) -> np.ndarray:
    """Three times the noise from 150 to 230 s on every satellite."""
    t = np.arange(1, T_END + 1)
    return np.repeat(np.where((t >= T_FAULT - 50) & (t < T_FAULT + 30), 3 * SIGMA_FT, SIGMA_FT)[:, None], m, axis=1)


def counts(out: Outcome) -> tuple[int, int, int, np.ndarray]:
    """(missed, runs without an early alarm, early alarms, delays of the detections)."""
    d = out.declared_at
    early = (d > 0) & (d < T_FAULT)
    late = d[d >= T_FAULT]
    clean = int(d.size - early.sum())
    return clean - late.size, clean, int(early.sum()), late - T_FAULT


def fault_row(item: str, published: float, out: Outcome, note: str = "") -> dict:
    """Missed-alarm row: reproduced when 10 thesis runs agree with our rate (exact two-sided binomial, 5 %)."""
    from scipy.stats import binomtest

    missed, clean, early, delay = counts(out)
    rate = missed / clean
    low, high = clopper_pearson(missed, clean)
    p_value = binomtest(round(published * 10), 10, rate).pvalue
    verdict = "reproduced" if p_value > 0.05 else "not reproduced"
    published_ci = clopper_pearson(round(published * 10), 10)
    when = f"delay 50/95 % {np.median(delay):.0f}/{np.quantile(delay, 0.95):.0f} s; " if delay.size else ""
    text = (
        f"{missed} of {clean}; {when}thesis 10 runs, 95 % {published_ci[0]:.2f}-{published_ci[1]:.2f}, p = {p_value:.3f}; "
        f"early alarms {early} of {out.declared_at.size}"
    )
    return row(item, published, rate, low, high, verdict, f"{text}{'; ' + note if note else ''}")


def batches_of_ten(out: Outcome) -> str:
    """5-95 % range of the missed-alarm rate over batches of 10 runs, as the thesis had."""
    d = out.declared_at
    missed = (d == 0)[d[: d.size] * 0 == 0]
    usable = missed[: 10 * (missed.size // 10)].reshape(-1, 10).mean(axis=1)
    return f"10-run batches 5-95 %: {np.quantile(usable, 0.05):.1f}-{np.quantile(usable, 0.95):.1f}"
