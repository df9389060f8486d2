"""The ultra-tight filters' claims against their errors over Monte Carlo, without a jam and in one."""

import numpy as np
import pytest

from nav.imu import BarometerSpec, ImuSpec
from nav.ultratight import SteeringSpec
from sdr.reproduce import karaim
from sdr.uttwin import Trial, batch

N_RUNS = 20
SPAN_S, JAM_S, AT_S = 72.0, (25.0, 71.0), 68.0
GRADES = {"riss_sf": "karaim2020", "ecef17": "karaim2020", "pinson13": "navigation"}
"""Pinson's model has no states for sensor biases: navigation grade."""


@pytest.mark.parametrize("js_db", [0.0, 45.0])
@pytest.mark.parametrize("model", list(GRADES))
def test_nees_and_nis_are_within_their_chi_square_bounds(model, js_db):
    from scipy.stats import chi2

    barometer = BarometerSpec() if model == "pinson13" else None
    trial = Trial(js_db=js_db, jam_s=JAM_S, imu=ImuSpec(grade=GRADES[model]), barometer=barometer)
    out = batch(karaim.sky(SPAN_S), trial, SteeringSpec(mode="ultra_tight", model=model), N_RUNS, seed=23)
    assert np.all(out[:, -1, 11] == 8)  # locked channels
    # Position (3), clock bias and drift at one instant of each run: independent, 5 degrees of freedom each.
    nees = out[:, round(AT_S * 10) - 1, 8]
    low, high = chi2.ppf((1e-6, 1 - 1e-6), 5 * N_RUNS) / N_RUNS
    assert low < nees.mean() < high, f"NEES {nees.mean():.2f}, not within {low:.2f} to {high:.2f}"
    # NIS, 16 rows, one epoch in ten (the C/N0 remembers 0.1 s). Its R is that of a C/N0 as pessimistic as two estimates
    # allow, on purpose: the mean lies up to a tenth below the degrees of freedom in a jam, never above.
    jam = slice(round(JAM_S[0] * 10) + 10, round(JAM_S[1] * 10) - 10)
    total, dof = out[:, jam, 9].sum(), out[:, jam, 10].sum()
    low, high = chi2.ppf((1e-6, 1 - 1e-6), dof) / dof
    assert low - (0.1 if js_db else 0.0) < total / dof < high + 0.01, f"NIS per row {total / dof:.3f}"
