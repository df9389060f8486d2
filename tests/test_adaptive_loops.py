"""Loop bandwidths that follow the noise: the law, jitter, continuity, a jam that only they survive, and the hand-over."""

from contextlib import contextmanager
from itertools import pairwise

import numpy as np
import pytest
from tracking_signal import Satellite, amplitude, mix, noise, track

from sdr import scenario
from sdr.receiver import Receiver
from tracking import loops
from tracking.channel import STATE_LOCKED, AdaptSpec, TrackingSpec
from tracking.records import AIDING, EPOCH

FS = 2.048e6
TEN_MS = {"integration_ms": 10, "pll_bw_hz": 18.0, "dll_bw_hz": 1.0}


def spec_for(adapt=True, signal="l1ca", **settings):
    return TrackingSpec(**{signal: {"adapt": AdaptSpec() if adapt is True else adapt, **settings}})


# ---------------------------------------------------------------------------------------------------------- the law
@pytest.mark.parametrize("cn0", [22.0, 30.0, 45.0])
def test_the_carrier_bandwidth_has_the_least_error(cn0):
    """Thermal variance plus squared lag of the discrete loop itself, j T^3 / K3 (the integrator of the third order grows by
    K3 e / T^2 an integration), on a grid of bandwidths: the law's is the best to what B T < 0.05 leaves of the continuous
    loop (1 - p = w T to second order: 3 w T / 2 of the lag, a seventh of which in B) and to the grid.
    """
    T, jerk = 1e-3, 3.0
    grid = np.geomspace(2.0, 40.0, 120)
    k3 = np.array([loops.pll_gains(3, b, T)[2] for b in grid.tolist()])
    error = loops.pll_jitter_cycles(cn0, grid, T) ** 2 + (jerk / loops.WAVELENGTH_M * T**3 / k3) ** 2
    best = grid[np.argmin(error)]
    assert loops.adapted_pll_bw_hz(cn0, T, jerk) == pytest.approx(best, rel=1.5 * 2 * best * T / 7 * 2 + 0.02)


def test_the_code_bandwidth_has_the_least_error():
    # A first-order loop x' = 4 B e lags a code that drifts at v by v / (4 B).
    one_hz, grid = loops.dll_jitter_chips(30.0, 1.0, 0.02, 0.5), np.geomspace(0.01, 5.0, 2000)
    error = one_hz**2 * grid + (0.2 / loops.METRES_PER_CHIP / (4 * grid)) ** 2
    assert loops.adapted_dll_bw_hz(one_hz, 0.2) == pytest.approx(grid[np.argmin(error)], rel=0.005)


def test_bounds_hold_and_noise_narrows():
    rows = loops.adapted_gains((4.0, 15.0), (0.1, 1.0), 5.0, 0.02, True, 1.0, 0.5, 1.0, 0.1)
    pll, dll = rows[:, 5], rows[:, 6]
    assert pll[0] == 4.0 and pll[-1] == 15.0 and dll[0] == 0.1 and np.all(dll <= 1.0)
    assert np.all(np.diff(pll) >= 0) and np.all(np.diff(dll) >= 0)
    # The seventh root: 10 dB (free of squaring loss) are a factor 10^(1/7), from the law itself.
    free = loops.adapted_pll_bw_hz(np.array([35.0, 45.0]), 0.02, 1.0, False)
    assert free[1] / free[0] == pytest.approx(10 ** (1 / 7))


@pytest.mark.parametrize(
    "settings, word",
    [
        ({"pll_order": 2}, "pll_order = 3"),
        ({"dll_order": 2}, "dll_order = 1"),
        ({"pll_bw_hz": 1.0}, "pll_min_hz = 2 lies above pll_bw_hz = 1"),
        ({"dll_bw_hz": 0.01}, "dll_min_hz = 0.05 lies above dll_bw_hz = 0.01"),
    ],
)
def test_impossible_settings_are_refused(settings, word):
    with pytest.raises(ValueError, match=word):
        spec_for(**settings)


# ------------------------------------------------------------------------------------------------------- the loops
@pytest.mark.parametrize("signal", ["L1CA", "E1C"])
def test_jitter_is_that_of_a_fixed_loop_of_the_bandwidth_logged(signal):
    """Sigma of B t independent pairs is known to 1 / sqrt(4 B t); the bandwidth follows an estimate that scatters, 3 %."""
    seconds, cn0, T = 22.0, 36.0, 0.02
    own = cn0 if signal == "L1CA" else cn0 - 10 * np.log10(2)
    sat = Satellite(
        signal, 5, FS, doppler_hz=1711.3, code_chips=300.3, waveform=None if signal == "L1CA" else "BOC11"
    )
    settings = {"pll_bw_hz": 15.0, "dll_bw_hz": 5.0}
    adapt = AdaptSpec(jerk_mps3=0.3, code_drift_mps=5.0)
    tracker = spec_for(adapt, "l1ca" if signal == "L1CA" else "e1", **settings).start(FS)
    tracker.add(sat.acquisition(0, 30.0, 0.1))
    (e,), _ = track(tracker, [sat], cn0, seconds, seed=21)
    e = e[e["sample_index"] > 2.0 * FS]
    assert np.all(e["state"] == STATE_LOCKED)
    pll, dll = float(e["pll_bw_hz"].mean()), float(e["dll_bw_hz"].mean())
    assert pll == pytest.approx(loops.adapted_pll_bw_hz(own, T, 0.3, signal == "L1CA"), rel=0.05)
    assert 3.0 < pll < 12.0 and 0.2 < dll < 3.0  # neither bound
    phase, code = sat.phase_error(e), sat.code_error(e)
    phase -= np.round(np.mean(phase) * 2) / 2
    slope, t = (1.0 if signal == "L1CA" else 3.0), seconds - 2.0
    st = tracker.channels[0]
    spacing = float(np.subtract(*tracker.taps_chips(0)[[st["early"], st["late"]]]))
    want = loops.pll_jitter_cycles(own, pll, T, signal == "L1CA")
    assert np.std(phase) / want == pytest.approx(1.0, abs=5 / np.sqrt(4 * pll * t) + 0.03)
    want = loops.dll_jitter_chips(own, dll, T, spacing, slope, 1 - slope * spacing)
    assert np.std(code) / want == pytest.approx(1.0, abs=5 / np.sqrt(4 * dll * t) + 0.03)


def jammed(spec, cn0s, parts_s, seed):
    """One satellite through stretches of different C/N0 -> (EPOCH rows, satellite, tracker)."""
    sat = Satellite("L1CA", 5, FS, doppler_hz=1200.0, code_chips=300.3)
    tracker = spec.start(FS)
    tracker.add(sat.acquisition(0, 20.0, 0.1))
    rng, count, rows = np.random.default_rng(seed), round(0.1 * FS), []
    levels = np.repeat(cn0s, [round(10 * s) for s in parts_s])
    for k, cn0 in enumerate(levels):
        # As an AGC has it: the noise stays, the signal sinks.
        z, s = noise(rng, count, 25.0), sat.samples(k * count, count)
        e, n, _ = tracker.process(k * count, mix(z, s, amplitude(cn0, FS, 25.0)))
        rows.append(e[0, : n[0]])
    return np.concatenate(rows), sat, tracker


def test_an_adaptive_loop_holds_through_a_jam_in_which_a_fixed_one_does_not():
    """45 - 23 - 45 dB-Hz, 12 s of it. 18 Hz at 10 ms: 20 degrees of thermal jitter, beyond the 15 of a Costas loop (Kaplan &
    Hegarty, 5.6); the law's 6 Hz: 11 degrees.
    """
    narrow = loops.adapted_pll_bw_hz(23.0, 0.01, 0.5)
    assert (
        360 * loops.pll_jitter_cycles(23.0, 18.0, 0.01)
        > 15.0
        > 12
        > 360 * loops.pll_jitter_cycles(23.0, narrow, 0.01)
    )
    off, lost_s = {}, np.inf
    for adapt in (AdaptSpec(jerk_mps3=0.5), None):
        e, sat, _ = jammed(spec_for(adapt, **TEN_MS), (45.0, 23.0, 45.0), (3.0, 12.0, 2.0), seed=4)
        e = e[(e["state"] == STATE_LOCKED) & (e["sample_index"] > 2.0 * FS)]
        phase = sat.phase_error(e)
        off[adapt is None] = phase - np.median(phase[:50])
        if adapt is not None:
            t = e["sample_index"] / FS
            jam = (t > 3.3) & (t < 15.0)
            assert e["pll_bw_hz"][jam].mean() == pytest.approx(narrow, rel=0.05)
            assert e["pll_bw_hz"][t > 15.5].mean() == pytest.approx(
                loops.adapted_pll_bw_hz(45.0, 0.01, 0.5), rel=0.03
            )
            # 0.3 s after the jam began the loop is as narrow as it will be.
            assert e["pll_bw_hz"][(t > 3.2) & (t < 3.4)].mean() < 1.2 * narrow
            assert t[-1] > 16.9
        else:
            lost_s = e["sample_index"][-1] / FS
    assert np.max(np.abs(off[False])) < 0.25
    assert lost_s < 15.5  # given up within the jam


def test_the_nco_goes_on_where_the_bandwidth_changes():
    """Frequency after each integration: integrators in Hz and Hz/s go on, only the gains are those of the logged bandwidth.

    Gains between rows 1 dB apart are taken from a straight line: 1e-3 of them at the most, on 0.1 cycle in 10 ms 1e-2 Hz.
    """
    T = 0.01
    sat = Satellite("L1CA", 5, FS, doppler_hz=1200.0, code_chips=300.3)
    tracker = spec_for(AdaptSpec(jerk_mps3=0.5), **TEN_MS).start(FS)
    tracker.add(sat.acquisition())
    track(tracker, [sat], 45.0, 2.0, seed=3)
    st = tracker.channels[0].copy()
    rate, accel = float(st["rate_hz"]), float(st["rate_hz_s"])
    (e,), _ = track(tracker, [sat], 37.0, 1.0, seed=4, start=20 * int(0.1 * FS))
    e = e[e["sample_index"] >= st["start_sample"]]
    changes = []
    for now, following in pairwise(e):
        k1, k2, k3 = loops.pll_gains(3, float(now["pll_bw_hz"]), T)
        phase = float(now["phase_error_cycles"])
        accel += k3 * phase / T**2
        rate += k2 * phase / T + accel * T
        assert following["doppler_hz"] == pytest.approx(rate + k1 * phase / T, abs=0.02)
        rate = float(following["doppler_hz"]) - k1 * phase / T
        changes.append(abs(float(following["pll_bw_hz"]) - float(now["pll_bw_hz"])))
    assert max(changes) > 0.05 and np.ptp(e["pll_bw_hz"]) > 2.0


def test_same_bits_for_any_slab_size():
    sat = Satellite("L1CA", 5, FS, doppler_hz=1200.0, code_chips=300.3)
    count, rng = round(2.0 * FS), np.random.default_rng(9)
    iq = mix(noise(rng, count, 25.0), sat.samples(0, count), amplitude(38.0, FS, 25.0))
    ends = []
    for slab_s in (0.02, 0.313):
        tracker = spec_for(**TEN_MS).start(FS)
        tracker.add(sat.acquisition())
        n = round(slab_s * FS)
        for n0 in range(0, count, n):
            tracker.process(n0, iq[:, n0 : n0 + n])
        ends.append(tracker.channels[0])
    for name in ("doppler_hz", "code_phase_chips", "pll_bw_hz", "dll_bw_hz", "fast_prompt"):
        assert ends[0][name] == ends[1][name]


# ---------------------------------------------------------------------------------------------------- the hand-over
def test_what_a_monitor_asks_for_counts_as_noise():
    sat = Satellite("L1CA", 5, FS, doppler_hz=1200.0, code_chips=300.3)
    tracker = spec_for(AdaptSpec(jerk_mps3=0.5), **TEN_MS).start(FS)
    tracker.add(sat.acquisition())
    track(tracker, [sat], 45.0, 1.5, seed=3)
    rng, count, seen = np.random.default_rng(5), round(0.1 * FS), []
    for k, factor in enumerate([0.0] * 5 + [100.0] * 5 + [0.0] * 5):
        n0 = round(1.5 * FS) + k * count
        aiding = np.zeros(1, AIDING)
        aiding["weaken"] = factor
        z = mix(noise(rng, count, 25.0), sat.samples(n0, count), amplitude(45.0, FS, 25.0))
        e, n, _ = tracker.process(n0, z, aiding)
        assert not tracker.channels["steered"][0]
        seen.append(float(e[0, 1 : n[0]]["pll_bw_hz"].mean()))  # the first began before the command
    T, jerk = 0.01, 0.5
    for part, cn0 in ((seen[:5], 45.0), (seen[5:10], 25.0), (seen[10:], 45.0)):
        # 100 times the noise at once; squaring loss as if the C/N0 were 20 dB lower, which is at least that.
        np.testing.assert_allclose(part, loops.adapted_pll_bw_hz(cn0, T, jerk), rtol=0.05)


def flagged(receiver):
    """A receiver whose `cw` monitor may flag, with more of its settings, and its samples' rate."""
    text = """
        schema = 1
        name = "flags"
        duration_s = 1.0
        [sky]
        start = 2024-03-01T12:00:00
        [receiver.acquisition]
        systems = ["G"]
        [[receiver.monitor]]
        name = "cw"
        detector = { kind = "FFT" }
        [receiver.tracking.l1ca.taps]
        count = 35
        spacing_chips = 0.65
    """
    spec = scenario.parse(text + receiver, "flags")
    return Receiver(spec.receiver, scenario.source(spec)), spec.front_end.fs_hz


@pytest.mark.parametrize(("weaken", "slab_s"), [('["cw"]', 0.02), ("[]", 0.2)])
def test_flags_hold_at_the_next_update_of_a_steering_filter(weaken, slab_s):
    """Slabs are as short as the updates where monitors may flag, and no shorter where nothing comes back."""
    receiver, fs_hz = flagged(f"""
        [receiver.steering]
        mode = "vector"
        [receiver.respond]
        weaken = {weaken}
    """)
    ends = [out.n_end for out in receiver]
    assert np.max(np.diff(ends)) == round(slab_s * fs_hz)


def test_flags_and_variances_reach_the_loops_one_slab_later():
    receiver, fs_hz = flagged("""
        [receiver.tracking.l1ca]
        adapt = {}
        [receiver.respond]
        weaken = ["cw"]
        weaken_by = 50.0
    """)
    sat = Satellite("L1CA", 7, fs_hz)
    receiver.channel_of["L1CA", 7] = receiver.tracker.add(sat.acquisition())
    assert receiver._commands(0)["weaken"].tolist() == [0.0]
    receiver.flags._until[b"G", 7] = 10
    receiver.flags._until[b"G", 8] = 10  # not tracked
    assert receiver._commands(0)["weaken"].tolist() == [50.0]
    assert receiver._commands(11)["weaken"].tolist() == [0.0]


@pytest.mark.parametrize("order", [{"pll_order": 2}, {"dll_order": 2}])
def test_other_orders_are_refused(order):
    with pytest.raises(ValueError, match="adapt is made for pll_order = 3 and dll_order = 1"):
        spec_for(**order).start(FS)


@pytest.mark.parametrize("adapts", [True, False])
def test_bandwidths_used_are_drawn_where_they_follow_the_noise(tmp_path, monkeypatch, adapts):
    import h5py

    from sdr import plot

    e = np.zeros(100, EPOCH)
    e["sample_index"], e["cn0_dbhz"], e["dll_bw_hz"] = np.arange(100) * 1000, 40.0, 0.5
    e["pll_bw_hz"][20:] = np.linspace(15.0, 6.0, 80) if adapts else 15.0  # 0 while it settles
    drawn, real = [], plot.figure

    @contextmanager
    def figure(*a, **k):
        with real(*a, **k) as axes:
            yield axes
            drawn.extend(np.ravel(axes))

    monkeypatch.setattr(plot, "figure", figure)
    with h5py.File(tmp_path / "r.h5", "w") as h5:
        rows = h5.create_dataset("tracking/G07_L1CA/epochs", data=e)
        rows.attrs.update(fs_hz=FS, signal="L1CA", prn=7)
        assert plot._cn0(h5, plot._channels(h5), tmp_path) == tmp_path / "cn0.png"
    assert len(drawn) == (3 if adapts else 1)
    if adapts:
        seen = drawn[1].lines[0].get_ydata()
        assert np.isnan(seen[:20]).all()
        np.testing.assert_array_equal(seen[20:], e["pll_bw_hz"][20:])
