"""A small independent signal generator for tracking tests: exact code phases, no table, no NCO."""

import math

import numpy as np
from numba import njit

from signals.codes import primary_code, secondary_code
from signals.modulation import SIGNALS, chip_waveform
from tracking.records import ACQUISITION

CHIP_RATE_HZ = 1.023e6


@njit(cache=True)
def _samples(out, n0, fs, if_hz, doppler, ramp, phase0, code0, data, pilot, symbols, per_symbol, secondary):
    """data, pilot: (L, slots) chip values; pilot of length 0: none. The carrier is exact at every 64th sample."""
    length, slots = data.shape
    turn = 1.0 + 0.0j
    step = 1.0 + 0.0j
    for k in range(len(out)):
        n = n0 + k
        t = n / fs
        cycles = doppler * t + 0.5 * ramp * t * t
        x = code0 + 1.023e6 * t + cycles / 1540.0
        whole = math.floor(x)
        chip = whole % length
        slot = int((x - whole) * slots)
        period = whole // length
        value = data[chip, slot] * symbols[(period // per_symbol) % len(symbols)]
        if len(pilot):
            value = (value - pilot[chip, slot] * secondary[period % 25]) * math.sqrt(0.5)
        if k % 64 == 0:
            angle = if_hz / fs * n
            angle = 2.0 * math.pi * (angle - math.floor(angle) + cycles + phase0)
            turn = complex(math.cos(angle), math.sin(angle))
            w = 2.0 * math.pi * (if_hz + doppler + ramp * (t + 32 / fs)) / fs
            step = complex(math.cos(w), math.sin(w))
        out[k] = value * turn
        turn *= step


@njit(cache=True)
def _mix(noise, signal, gain, out):
    for k in range(len(noise)):
        z = noise[k] + gain * signal[k]
        out[0, k] = np.int8(min(127.0, max(-127.0, np.rint(z.real))))
        out[1, k] = np.int8(min(127.0, max(-127.0, np.rint(z.imag))))


class Satellite:
    """Signal of one satellite: complex samples at any sample index, carrier and code coherent.

    Doppler doppler_hz + ramp_hz_s t; the code phase advances with the carrier's / 1540.
    """

    def __init__(self, signal, prn, fs_hz, if_hz=0.0, doppler_hz=0.0, ramp_hz_s=0.0, code_chips=0.0, phase0=0.1,
                 waveform=None, seed=1, symbols=None):  # fmt: skip
        self.signal, self.prn, self.fs_hz, self.if_hz = signal, prn, fs_hz, if_hz
        self.doppler_hz, self.ramp_hz_s, self.code_chips, self.phase0 = (
            doppler_hz,
            ramp_hz_s,
            code_chips,
            phase0,
        )
        names = ("L1CA",) if signal == "L1CA" else ("E1B", "E1C")
        parts = [
            np.outer(primary_code(n, prn), chip_waveform(waveform or SIGNALS[n].waveform)) for n in names
        ]
        self.data = parts[0]
        self.pilot = parts[1] if len(parts) == 2 else np.zeros((0, 1))
        self.length = len(self.data)
        random = np.random.default_rng(seed).integers(0, 2, 100_000) * 2.0 - 1.0
        self.symbols = random if symbols is None else np.asarray(symbols, float)
        self.secondary = np.asarray(secondary_code(), float)

    def cycles(self, n):
        t = np.asarray(n, float) / self.fs_hz
        return self.doppler_hz * t + 0.5 * self.ramp_hz_s * t * t

    def doppler(self, n):
        return self.doppler_hz + self.ramp_hz_s * np.asarray(n, float) / self.fs_hz

    def code_phase(self, n):
        """Total code phase in chips since transmission of symbol 0."""
        return self.code_chips + CHIP_RATE_HZ / self.fs_hz * np.asarray(n, float) + self.cycles(n) / 1540.0

    def samples(self, n0, count):
        out = np.empty(count, np.complex128)
        per_symbol = 20 if self.signal == "L1CA" else 1
        _samples(out, n0, self.fs_hz, self.if_hz, self.doppler_hz, self.ramp_hz_s, self.phase0, self.code_chips,
                 self.data, self.pilot, self.symbols, per_symbol, self.secondary)  # fmt: skip
        return out

    def acquisition(self, n=0, doppler_error_hz=0.0, code_error_chips=0.0):
        """What acquisition would report at sample ``n``, with errors."""
        row = np.zeros((), ACQUISITION)
        row["signal"], row["prn"], row["sample_index"] = self.signal, self.prn, n
        row["doppler_hz"] = self.doppler(n) + doppler_error_hz
        row["code_phase_chips"] = (self.code_phase(n) + code_error_chips) % self.length
        return row

    def code_error(self, epochs):
        """Code phase of the replica minus the signal's, chips, at the first sample of integrations."""
        error = epochs["code_phase_chips"] - self.code_phase(epochs["sample_index"])
        return (error + self.length / 2) % self.length - self.length / 2

    def phase_error(self, epochs):
        """Replica minus signal, cycles, at mid-integration (NCO frequency constant within one)."""
        middle = epochs["sample_index"] + 0.5 * epochs["n_samples"]
        replica = (
            epochs["carrier_phase_cycles"] + epochs["doppler_hz"] * 0.5 * epochs["n_samples"] / self.fs_hz
        )
        return replica - self.phase0 - self.cycles(middle)


def amplitude(cn0_dbhz, fs_hz, sigma):
    """C = A^2 and N0 = 2 sigma^2 / fs for complex samples of noise ``sigma`` per component."""
    return np.sqrt(2.0 * sigma**2 / fs_hz * 10 ** (np.asarray(cn0_dbhz, float) / 10))


def digitise(z, dtype=np.int8):
    iq = np.stack([z.real, z.imag])
    if dtype != np.float32:
        info = np.iinfo(dtype)
        iq = np.clip(np.rint(iq), info.min, info.max)
    return np.ascontiguousarray(iq.astype(dtype))


def mix(noise, signal, gain):
    """int8 planar slab of noise + gain x signal."""
    out = np.empty((2, len(noise)), np.int8)
    _mix(noise, signal, gain, out)
    return out


def noise(rng, count, sigma):
    z = rng.standard_normal(2 * count, np.float32).view(np.complex64)
    return np.float32(sigma) * z


def slab(satellites, cn0_dbhz, n0, count, rng, sigma=25.0, dtype=np.int8):
    """Satellites of the given C/N0 (one each) in complex noise of ``sigma`` per component -> (2, count)."""
    z = noise(rng, count, sigma)
    for s, cn0 in zip(satellites, np.broadcast_to(cn0_dbhz, len(satellites))):
        z = z + amplitude(cn0, s.fs_hz, sigma) * s.samples(n0, count)
    return digitise(z, dtype)


def track(tracker, satellites, cn0_dbhz, seconds, seed, slab_s=0.1, start=0, sigma=25.0):
    """Run a tracker on generated samples -> list per channel of EPOCH arrays, list of corr arrays."""
    rng = np.random.default_rng(seed)
    fs = satellites[0].fs_hz
    count = round(slab_s * fs)
    epochs, corr = [[] for _ in tracker.channels], [[] for _ in tracker.channels]
    for k in range(round(seconds / slab_s)):
        n0 = start + k * count
        e, n, z = tracker.process(n0, slab(satellites, cn0_dbhz, n0, count, rng, sigma))
        for c in range(len(tracker.channels)):
            epochs[c].append(e[c, : n[c]])
            corr[c].append(z[c, : n[c]])
    return [np.concatenate(e) for e in epochs], [np.concatenate(z) for z in corr]
