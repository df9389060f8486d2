"""A small independent signal generator for tracking tests: exact code phases, no table, no NCO."""

import numpy as np

from signals.codes import primary_code, secondary_code
from signals.modulation import SIGNALS, chip_waveform

CHIP_RATE_HZ = 1.023e6
F_L1_HZ = 1575.42e6


class Satellite:
    """Signal of one satellite: complex samples at any sample index, carrier and code coherent.

    Doppler f(t) = doppler_hz + ramp_hz_s t; carrier phase = phase0 + integral of f; code phase advances with
    it / 1540.
    """

    def __init__(
        self,
        signal,
        prn,
        fs_hz,
        if_hz=0.0,
        doppler_hz=0.0,
        ramp_hz_s=0.0,
        code_chips=0.0,
        phase0=0.1,
        waveform=None,
        seed=1,
    ):
        self.signal, self.fs_hz, self.if_hz = signal, fs_hz, if_hz
        self.doppler_hz, self.ramp_hz_s, self.code_chips, self.phase0 = (
            doppler_hz,
            ramp_hz_s,
            code_chips,
            phase0,
        )
        names = ("L1CA",) if signal == "L1CA" else ("E1B", "E1C")
        self.chips = [primary_code(n, prn).astype(np.float64) for n in names]
        self.slots = [chip_waveform(waveform or SIGNALS[n].waveform) for n in names]
        self.symbols = np.random.default_rng(seed).integers(0, 2, 100_000) * 2.0 - 1.0
        self.secondary = np.asarray(secondary_code(), float)

    def cycles(self, n):
        t = np.asarray(n, float) / self.fs_hz
        return self.phase0 + self.doppler_hz * t + 0.5 * self.ramp_hz_s * t * t

    def code_phase(self, n):
        """Total code phase in chips since transmission of symbol 0."""
        t = np.asarray(n, float) / self.fs_hz
        return self.code_chips + CHIP_RATE_HZ * t + (self.cycles(n) - self.phase0) / 1540.0

    def baseband(self, n):
        x = self.code_phase(n)
        if self.signal == "L1CA":
            return self._component(0, x) * self.symbols[np.floor(x / 20460).astype(int)]
        period = np.floor(x / 4092).astype(int)
        b = self._component(0, x) * self.symbols[period]
        c = self._component(1, x) * self.secondary[period % 25]
        return (b - c) / np.sqrt(2.0)

    def _component(self, k, x):
        chips, slots = self.chips[k], self.slots[k]
        slot = np.floor((x % 1.0) * len(slots)).astype(int)
        return chips[np.floor(x).astype(np.int64) % len(chips)] * slots[slot]

    def samples(self, n0, count):
        n = np.arange(n0, n0 + count)
        cycles = self.cycles(n) + (n * (self.if_hz / self.fs_hz)) % 1.0
        return self.baseband(n) * np.exp(2j * np.pi * cycles)


def slab(satellites, cn0_dbhz, n0, count, rng, sigma=25.0, dtype=np.int8):
    """Satellites of the given C/N0 (one each) in complex noise of ``sigma`` per component -> (2, count)."""
    fs = satellites[0].fs_hz
    z = sigma * (rng.standard_normal(count) + 1j * rng.standard_normal(count))
    for s, cn0 in zip(satellites, np.broadcast_to(cn0_dbhz, len(satellites))):
        # C = A^2 and N0 = 2 sigma^2 / fs for complex samples.
        z += np.sqrt(2.0 * sigma**2 / fs * 10 ** (cn0 / 10)) * s.samples(n0, count)
    iq = np.stack([z.real, z.imag])
    if dtype != np.float32:
        info = np.iinfo(dtype)
        iq = np.clip(np.rint(iq), info.min, info.max)
    return np.ascontiguousarray(iq.astype(dtype))
