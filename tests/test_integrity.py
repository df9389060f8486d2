"""The monitors together on a running filter: response on is more accurate and more honest; off, nothing changes."""

import numpy as np
import pytest

from monitors.als import Als
from monitors.bias_bank import BiasBank
from monitors.integrity import Integrity, Respond
from monitors.parallel_filters import ParallelFilters
from nav import eskf
from nav.eskf import Eskf
from sdr.reproduce import highdynamics as hd

EPOCHS, FAULT = 1600, 900
FT = 0.3048


@pytest.fixture(scope="module")
def problem():
    return hd.problem(10.0, EPOCHS)


def fly(problem, spec, sigma, fault, seed, var=1.0):
    """Truth error, filter and monitors in a loop; position error (T,), NIS per row (T,), last remedy, events."""
    rng = np.random.default_rng(seed)
    filt = Eskf(problem.p0, 7)
    run = spec.start(filt, np.arange(7))
    error = rng.normal(size=17) * hd.P0_SIGMA
    base, remedy = np.full(7, var), None
    place, honest, declared = np.empty(EPOCHS), np.empty(EPOCHS), []
    for e in range(EPOCHS):
        error = problem.phi[e] @ error + eskf.psd_root(problem.qd[e]) @ rng.normal(size=17)
        filt.predict(problem.phi[e], problem.qd[e])
        z = problem.h[e] @ error + sigma * rng.normal(size=7) + fault[e]
        r, used = base, np.ones(7, bool)
        if remedy is not None:
            z = z - remedy.bias_m
            r = np.where(np.isnan(remedy.var_m2), base, remedy.var_m2)
            used = ~remedy.exclude
        dx = filt.update(z, problem.h[e], r, used).copy()
        value, dof = eskf.nis(filt.log(1))
        error = error - dx
        remedy = run(filt, dx, z, problem.h[e], np.ones(7, bool))
        if remedy.dx is not None:
            error = error - remedy.dx
        if remedy.bank is not None and remedy.bank.declared >= 0:
            declared.append((e, remedy.bank.declared))
        place[e], honest[e] = np.linalg.norm(error[:3]), value[0] / dof[0]
    return place, honest, remedy, declared


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


QUIET = Integrity(als=None, bias_bank=None, parallel_filters=None)


def test_noise_of_thirty_metres(problem):
    """ALS: mean NIS within 20 % of its degrees of freedom, and the position no worse."""
    on = Integrity(als=Als(), bias_bank=None, parallel_filters=None, respond=Respond(noise=True))
    none = np.zeros((EPOCHS, 7))
    a_place, a_nis, _, _ = fly(problem, QUIET, 30.0, none, 1)
    b_place, b_nis, remedy, _ = fly(problem, on, 30.0, none, 1)
    assert a_nis[700:].mean() > 100 and 0.8 < b_nis[700:].mean() < 1.2
    assert rms(b_place[700:]) < rms(a_place[700:])
    # Two estimates on 500 epochs: sigma to 1/sqrt(1000) each.
    assert np.all(np.abs(np.sqrt(remedy.var_m2) - 30) < 5 * 30 / np.sqrt(1000))


def test_bias_of_ten_metres(problem):
    on = Integrity(als=None, parallel_filters=None, bias_bank=BiasBank(), respond=Respond(bias=True))
    fault = np.zeros((EPOCHS, 7))
    fault[FAULT:, 1] = 10.0
    a_place, _, _, _ = fly(problem, QUIET, 1.0, fault, 2)
    b_place, b_nis, remedy, _ = fly(problem, on, 1.0, fault, 2)
    assert remedy.bias_m[1] == 10.0 and np.count_nonzero(remedy.bias_m) == 1
    assert rms(b_place[FAULT + 100 :]) < 0.5 * rms(a_place[FAULT + 100 :])
    assert 0.8 < b_nis[FAULT + 100 :].mean() < 1.2


def test_ramp_of_one_foot_per_second(problem):
    """Parallel filters on every tenth epoch: the right satellite, excluded, and the navigation taken back."""
    bank = ParallelFilters(r0_m2=0.3, threshold=64.0)
    on = Integrity(
        als=None,
        bias_bank=None,
        parallel_filters=bank,
        bank_every=10,
        respond=Respond(exclude=True, reset=True),
    )
    fault = np.zeros((EPOCHS, 7))
    fault[FAULT:, 4] = FT * 0.1 * np.arange(EPOCHS - FAULT)
    a_place, _, _, _ = fly(problem, QUIET, 1.0, fault, 3)
    b_place, b_nis, remedy, declared = fly(problem, on, 1.0, fault, 3)
    assert [s for _, s in declared] == [4] and declared[0][0] - FAULT < 300
    assert remedy.exclude[4] and remedy.exclude.sum() == 1
    assert rms(b_place[-200:]) < 0.5 * rms(a_place[-200:])
    assert 0.8 < b_nis[-300:].mean() < 1.2


def test_everything_listens_and_nothing_is_touched(problem):
    """Respond off: bit-identical to no monitors at all, while the monitors do report."""
    fault = np.zeros((EPOCHS, 7))
    fault[FAULT:, 1] = 10.0
    a = fly(problem, QUIET, 3.0, fault, 4, var=9.0)
    b = fly(problem, Integrity(bank_every=10), 3.0, fault, 4, var=9.0)
    np.testing.assert_array_equal(a[0], b[0])
    np.testing.assert_array_equal(a[1], b[1])
    assert b[2].bias.row[b[2].bias.best] == 1 and not b[2].bias_m.any() and not b[2].exclude.any()


def test_clean_run_alarms_nobody(problem):
    """All monitors acting on a clean, well-tuned filter leave it alone but for R-hat, 1 +- 5 %-ish."""
    spec = Integrity(
        parallel_filters=ParallelFilters(r0_m2=0.3),
        bank_every=10,
        respond=Respond(noise=True, bias=True, exclude=True, reset=True),
    )
    _, nis, remedy, declared = fly(problem, spec, 1.0, np.zeros((EPOCHS, 7)), 5)
    assert declared == [] and not remedy.bias_m.any() and not remedy.exclude.any()
    assert 0.9 < nis.mean() < 1.1


def test_wrong_rows_are_refused():
    filt = Eskf(np.eye(17), 7)
    with pytest.raises(ValueError, match="range_rows"):
        Integrity().start(filt, np.array([0, 9]))
