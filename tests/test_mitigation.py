"""Mitigation: same samples for any slabs, transparent without interference, known estimation errors, C/N0 recovered."""

import math

import numpy as np
import pytest

from signals.clock import ClockSpec
from signals.frontend import FrontEndSpec
from signals.jammers import CW, Narrowband, Pulsed
from signals.modulation import SIGNALS, code_table
from signals.sky import ScriptedSpec, SkySpec
from signals.source import SyntheticSource
from signals.trajectory import Static
from tracking.mitigation import Blanking, Cancellation, Excision, Notch, estimate_tone

Z = 5.0
FS_HZ = 4.0e6
ALL = [Blanking(), Excision(), Notch(), Cancellation()]


class Samples:
    """Samples as a source."""

    def __init__(self, iq):
        self.iq, self.fs_hz, self.if_hz, self.n_samples, self.at = iq, FS_HZ, 0.0, iq.shape[1], 0

    def read(self, n):
        n0, self.at = self.at, min(self.at + n, self.n_samples)
        return n0, self.iq[:, n0 : self.at]


def through(spec, iq, slabs=(1 << 30,)):
    run, parts, k = spec.start(Samples(iq)), [], 0
    while True:
        n0, x = run.read(min(slabs[k % len(slabs)], iq.shape[1]))
        if x.shape[1] == 0:
            return np.concatenate(parts, axis=1)
        assert n0 == sum(p.shape[1] for p in parts)
        parts.append(x)
        k += 1


def noise(n, seed=1, scale=20.0):
    return (
        np.round(scale * np.random.default_rng(seed).standard_normal((2, n))).clip(-127, 127).astype(np.int8)
    )


@pytest.mark.parametrize("spec", ALL, ids=lambda s: s.kind)
def test_slabs_do_not_matter_and_nothing_is_lost(spec):
    iq = noise(123_457)
    iq[:, 40_000:40_400] = 120
    whole = through(spec, iq)
    assert whole.shape == iq.shape
    for slabs in ([80_000], [1, 1023, 50_001]):
        np.testing.assert_array_equal(through(spec, iq, slabs), whole)


@pytest.mark.parametrize("spec", ALL, ids=lambda s: s.kind)
def test_noise_alone_passes(spec):
    """Lost power: blanking exp(-10) (1 + 10) (1 + 2 guard); excision p_fa x (ln(n / p_fa) + 1) / n of each frame."""
    iq = noise(400_000)
    kept = 1 - np.sum((through(spec, iq).astype(float) - iq) ** 2) / np.sum(iq.astype(float) ** 2)
    assert kept > 1 - {"Blanking": 2e-3, "Excision": 2e-4, "Notch": 1e-9, "Cancellation": 1e-4}[spec.kind]


def test_excision_follows_the_front_end_filter():
    """Noise of 35 % of the band: a floor that was flat over frequency would be that of the stop band, and nearly all
    the noise would go. ``p_fa`` per frame of one bin in about 360, and the bins on the filter's skirts: 1 %."""
    front = FrontEndSpec(fs_hz=FS_HZ, bits=8, filter={"bandwidth_hz": 1.4e6}).start(1.0)
    iq = front.push(np.random.default_rng(3).standard_normal((2, 400_000)).astype(np.float32), last=True)
    kept = np.sum(through(Excision(), iq).astype(float) ** 2) / np.sum(iq.astype(float) ** 2)
    assert kept > 0.99
    tone = 60.0 * np.exp(2j * np.pi * 0.05 * np.arange(iq.shape[1]))
    jammed = np.clip(np.round(iq + np.stack([tone.real, tone.imag])), -127, 127).astype(np.int8)
    left = through(Excision(), jammed) - through(Excision(), iq)
    # the tone goes, and with it the few bins that the window's main lobe and its skirts fill
    assert np.mean(np.abs(left) ** 2) < 0.1 * np.mean(iq.astype(float) ** 2)


@pytest.mark.parametrize("sweep", [0.0, 30.0])
def test_tone_estimates_reach_the_bound(sweep):
    """Variances of the middle frequency 6 / ((2 pi)^2 rho n^3), of the rate 90 / (pi^2 rho n^5), of the amplitude
    sigma^2 / (2 n), at rest and swept by 30 bins: 400 trials, z sqrt(2 / n)."""
    rng, n, rho, trials = np.random.default_rng(2), 2000, 0.3, 400
    a, k = math.sqrt(2 * rho), np.arange(n) - 0.5 * (n - 1)
    errors = []
    for _ in range(trials):
        f, phase, rate = rng.uniform(-0.45, 0.45), rng.uniform(0, 1), rng.uniform(-1, 1) * sweep / n**2
        z = a * np.exp(2j * np.pi * (f * k + 0.5 * rate * k * k + phase))
        z += rng.standard_normal(n) + 1j * rng.standard_normal(n)
        found, swept, gain, energy = estimate_tone(z, math.log(n / 1e-4))
        errors.append((found - f, swept - rate, abs(gain) - a, 10 * math.log10(energy / (rho * n))))
    variance = np.var(np.array(errors), axis=0)
    bounds = 6 / (4 * np.pi**2 * rho * n**3), 90 / (np.pi**2 * rho * n**5), 1 / n
    np.testing.assert_allclose(variance[:3] / bounds, 1.0, atol=Z * math.sqrt(2 / trials))
    assert abs(np.mean(errors, axis=0)[3]) < Z * math.sqrt(variance[3] / trials) + 0.1
    assert estimate_tone(rng.standard_normal(n) + 1j * rng.standard_normal(n), math.log(n / 1e-4)) is None


@pytest.mark.parametrize("jn_db", [0.0, 40.0])
@pytest.mark.parametrize("rate_hz_s", [1e3, 1e5, 1e8])
def test_a_swept_tone_is_removed(rate_hz_s, jn_db):
    """Of a tone of which phase, amplitude, frequency and rate are estimated, 4 dimensions of 2 n stay: half a noise
    sample of 2 each. So little is left of 40 dB, as frames of 10 ms hold up to a quarter of the band."""
    n = 160_000
    t = np.arange(n) / FS_HZ
    a = math.sqrt(800 * 10 ** (jn_db / 10))
    tone = a * np.exp(2j * np.pi * (0.5 * rate_hz_s * t - 1.9e6) * t)
    clean = noise(n).astype(np.float64)
    run = Cancellation(max_tones=1).start(
        Samples((np.stack([tone.real, tone.imag]) + clean).astype(np.float32))
    )
    _, y = run.read(n)
    rows = run.tones()
    assert len(rows) == 4
    middle_hz = -1.9e6 + rate_hz_s * (rows["sample_index"] + 20_000 - 0.5) / FS_HZ
    rho, m = a**2 / 800, 40_000.0
    np.testing.assert_allclose(
        rows["freq_hz"], middle_hz, atol=Z * FS_HZ * math.sqrt(6 / (4 * np.pi**2 * rho * m**3))
    )
    np.testing.assert_allclose(
        rows["rate_hz_s"], rate_hz_s, atol=Z * FS_HZ**2 * math.sqrt(90 / (np.pi**2 * rho * m**5))
    )
    left = np.sum((y - clean) ** 2)
    # chi square of 4 x 4 degrees, variance 400 each
    assert left / 400 < 16 + Z * math.sqrt(32) + 2


def cn0_dbhz(jammer, spec, duration_s=0.4, **front_end):
    """C/N0 of a standing satellite of 45 dB-Hz after 1 ms correlations with the true code."""
    duration = duration_s
    sky = SkySpec(source="none", scripted=(ScriptedSpec(prn=7, cn0_dbhz=45.0),)).start(
        Static(lat_deg=47.0, lon_deg=15.0, height_m=400.0).start(), ClockSpec().start(3, duration), duration
    )
    runs = [] if jammer is None else [jammer.start(FS_HZ, 0.0, duration, 9, sky)]
    front = FrontEndSpec(**({"fs_hz": FS_HZ, "bits": 16} | front_end))
    source = SyntheticSource(sky, front, duration, 4, jammers=runs)
    truth = source.truth(np.array([0], np.uint64))[0]
    if spec is not None:
        source = spec.start(source)
    _, iq = source.read(1 << 30)
    table = code_table("L1CA", 7, FS_HZ)
    phase = truth["code_phase_chips"] * table.samples_per_chip * 64
    row, col = round(phase) % 64, round(phase) // 64
    n = round(SIGNALS["L1CA"].code_period_s * FS_HZ)
    code = np.roll(table.table[row, :n].astype(float), -col)
    blocks = (iq[0] + 1j * iq[1].astype(float))[: iq.shape[1] // n * n].reshape(-1, n)
    prompt, other = blocks @ code, blocks @ np.roll(code, n // 2)
    skip = len(prompt) // 4  # filters settle
    noise_power = np.mean(np.abs(other[skip:]) ** 2)
    signal = np.mean(np.abs(prompt[skip:]) ** 2) - noise_power
    return 10 * math.log10(max(signal, 1e-9) / noise_power / 1e-3)


TONE = CW(freq_hz=123_456.0, jn0_dbhz=80.0)


@pytest.mark.parametrize(
    ("jammer", "spec", "at_least_db"),
    [
        # A cancelled tone costs 3 of 40,000 dimensions; a notch of contraction k a share (1 - k) / k of the band plus the
        # wander of z0; excision the main lobe of the window, about 9 of 1024 bins, and its side lobes.
        (TONE, Cancellation(), 44.5),
        (TONE, Notch(), 44.0),
        (TONE, Excision(), 44.0),
        (Narrowband(bandwidth_hz=20e3, freq_hz=3e5, jn0_dbhz=80.0), Excision(), 43.5),
        # A tenth of the samples blanked is 0.9 dB of C/N0.
        (Pulsed(rate_hz=1000.0, duty=0.1, freq_hz=2e5, jn0_dbhz=90.0), Blanking(), 43.5),
        (Pulsed(rate_hz=3000.0, shape="dme", random=True, freq_hz=2e5, jn0_dbhz=90.0), Blanking(), 43.0),
    ],
    ids=lambda x: getattr(x, "kind", ""),
)
def test_cn0_is_recovered(jammer, spec, at_least_db):
    """J/N 14 to 24 dB at the front end; estimates of 300 integrations are good to 0.25 dB (one sigma)."""
    jammed, mitigated = cn0_dbhz(jammer, None), cn0_dbhz(jammer, spec)
    print(f"\n{jammer.kind:10} {spec.kind:12} without {jammed:5.1f}  with {mitigated:5.1f} dB-Hz")
    assert mitigated > at_least_db - 0.75
    assert mitigated > jammed + 3.0


def test_without_interference_cn0_stays():
    clean = cn0_dbhz(None, None)
    assert clean == pytest.approx(45.0, abs=1.0)
    for spec in ALL:
        assert cn0_dbhz(None, spec) == pytest.approx(clean, abs=0.1)


def test_cancellation_reports_what_it_removed():
    n = 400_000
    t = np.arange(n) / FS_HZ
    a, f = 30.0, -654_321.5
    tone = a * np.exp(2j * np.pi * (f * t + 0.3))
    iq = (np.stack([tone.real, tone.imag]) + noise(n)).astype(np.float32)
    run = Cancellation().start(Samples(iq))
    run.read(n)
    rows = run.tones()
    assert len(rows) == 10
    # CRB over 40,000 samples at rho = 900 / 800
    sigma = math.sqrt(6 / (4 * np.pi**2 * a**2 / 800 * 40_000.0**3)) * FS_HZ
    np.testing.assert_allclose(rows["freq_hz"], f, atol=Z * sigma)
    np.testing.assert_allclose(rows["amplitude"], a, atol=Z * 20 / math.sqrt(40_000))


def test_real_samples_are_refused():
    source = Samples(noise(1000))
    source.complex = False
    with pytest.raises(ValueError, match="complex"):
        Notch().start(source)
