"""The ultra-tight filters' claims against their errors over Monte Carlo, without a jam and in one."""

import numpy as np
import pytest

from nav import ultratight
from nav.imu import BarometerSpec, ImuSpec, ecef17_of
from nav.ultratight import SteeringSpec
from sdr.reproduce import aided_loops, karaim
from sdr.uttwin import Sky, Trial, batch
from signals.trajectory import HighDynamics

N_RUNS = 20
SPAN_S, JAM_S, AT_S = 72.0, (25.0, 71.0), 68.0
GRADES = {"riss_sf": "karaim2020", "ecef17": "karaim2020", "pinson13": "navigation"}
"""Pinson's model has no states for sensor biases: navigation grade."""


@pytest.mark.parametrize(("js_db", "gain_control"), [(0.0, False), (45.0, False), (45.0, True)])
@pytest.mark.parametrize("model", list(GRADES))
def test_nees_and_nis_are_within_their_chi_square_bounds(model, js_db, gain_control):
    from scipy.stats import chi2

    barometer = BarometerSpec() if model == "pinson13" else None
    imu = ImuSpec(grade=GRADES[model])
    trial = Trial(js_db=js_db, jam_s=JAM_S, gain_control=gain_control, imu=imu, barometer=barometer)
    out = batch(karaim.sky(SPAN_S), trial, SteeringSpec(mode="ultra_tight", model=model), N_RUNS, seed=23)
    assert np.all(out[:, -1, 11] == 8)  # locked channels
    # Position (3), clock bias and drift at one instant of each run: independent, 5 degrees of freedom each.
    nees = out[:, round(AT_S * 10) - 1, 8]
    low, high = chi2.ppf((1e-6, 1 - 1e-6), 5 * N_RUNS) / N_RUNS
    assert low < nees.mean() < high, f"NEES {nees.mean():.2f}, not within {low:.2f} to {high:.2f}"
    # NIS, 16 rows, one epoch in ten (the C/N0 remembers 0.1 s): R from an estimated C/N0 scatters by its relative error.
    jam = slice(round(JAM_S[0] * 10) + 10, round(JAM_S[1] * 10) - 10)
    total, dof = out[:, jam, 9].sum(), out[:, jam, 10].sum()
    low, high = chi2.ppf((1e-6, 1 - 1e-6), dof) / dof
    assert low - 0.01 < total / dof < high + 0.01, f"NIS per row {total / dof:.3f}"


def test_manoeuvres_of_6_g_do_not_make_the_17_states_overconfident(monkeypatch):
    """Scale factors (300 ppm) and misalignments (0.3 mrad) have no states; without their noise the mean is beyond the bounds."""
    from scipy.stats import chi2

    runs, at = 16, slice(150, None, 50)  # 5 s apart, the correlation time of manoeuvres
    sky = Sky(40.0, HighDynamics(acc_ned_mps2=aided_loops.PROFILES["6 g"]).start(40.0))
    spec = SteeringSpec(mode="ultra_tight", model="ecef17")
    mean = [batch(sky, aided_loops.trial(), spec, runs, seed=3)[:, at, 8].mean()]
    blind = lambda imu, **clock: ecef17_of(imu, **clock, scale_sigma=0.0, misalignment_sigma_rad=0.0)  # noqa: E731
    monkeypatch.setattr(ultratight, "ecef17_of", blind)
    mean.append(batch(sky, aided_loops.trial(), spec, runs, seed=3)[:, at, 8].mean())
    # The same bounds as if only every second instant counted.
    low, high = chi2.ppf((1e-4, 1 - 1e-4), 5 * runs * 2) / (runs * 2)
    assert low < mean[0] < high, f"NEES {mean[0]:.2f}, not within {low:.2f} to {high:.2f}"
    assert mean[1] > mean[0] + 1.0
