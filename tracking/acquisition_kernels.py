"""Kernels of the acquisition chain, on plain arrays."""

import numba as nb
import numpy as np


@nb.njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
def resample(xi, xq, taps, ratio, out):
    """out[:, j] = x at time j * ratio (input samples), by the interpolator's nearest row.

    ``taps`` float32 (P + 1, n_taps): row r interpolates r/P of a sample behind tap n_taps/2 - 1. Beyond the ends of
    x lie zeros. ``out`` float32 (2, n_out).
    """
    n, n_taps, n_phase = len(xi), taps.shape[1], taps.shape[0] - 1
    for j in range(out.shape[1]):
        t = j * ratio
        i = int(t)
        row = taps[int((t - i) * n_phase + 0.5)]
        first = i - n_taps // 2 + 1
        lo, hi = max(0, -first), min(n_taps, n - first)
        re, im = np.float32(0), np.float32(0)
        for k in range(lo, hi):
            re += row[k] * xi[first + k]
            im += row[k] * xq[first + k]
        out[0, j] = re
        out[1, j] = im


@nb.njit(cache=True, nogil=True, fastmath=True)
def shifted_product(spectrum, shift, template, out):
    """out[k] = spectrum[(k + shift) mod n] * template[k]; complex64 (n,), 0 <= shift < n, all finite."""
    # Unsigned indices: no test for negative ones, so that the loops become vector instructions.
    n, s = np.uint64(len(out)), np.uint64(shift)
    for k in range(n - s):
        out[k] = spectrum[k + s] * template[k]
    for k in range(n - s, n):
        out[k] = spectrum[k + s - n] * template[k]


@nb.njit(cache=True, nogil=True, fastmath=True)
def add_power(y, shift, acc):
    """acc[i] += |y[(i - shift) mod n]|^2, n = len(acc) <= len(y), 0 <= shift < n, all finite."""
    n, s = np.uint64(len(acc)), np.uint64(shift)
    for i in range(s):
        re, im = y[i + n - s].real, y[i + n - s].imag
        acc[i] += re * re + im * im
    for i in range(s, n):
        re, im = y[i - s].real, y[i - s].imag
        acc[i] += re * re + im * im


@nb.njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz", "nnan"})
def row_peak(acc, guard):
    """(peak, its index, mean and standard deviation of the cells further than ``guard`` from it, circularly)."""
    n = len(acc)
    total, square, at = np.float32(0), np.float32(0), 0
    for i in range(np.uint64(n)):
        total += acc[i]
        square += acc[i] * acc[i]
    peak = np.float32(0)
    for first in range(0, n, 64):  # most blocks do not hold a new maximum
        high = np.float32(0)
        for i in range(np.uint64(first), np.uint64(min(first + 64, n))):
            high = max(high, acc[i])
        if high > peak:
            peak, at = high, first
    while acc[at] != peak:
        at += 1
    near, near_square = 0.0, 0.0
    for i in range(at - guard, at + guard + 1):
        near += acc[i % n]
        near_square += acc[i % n] * acc[i % n]
    count = n - 2 * guard - 1
    mean = (total - near) / count
    return peak, at, mean, np.sqrt(max((square - near_square) / count - mean * mean, 0.0))


@nb.njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz", "nnan"})
def spectral_power(spectrum, width, ratio, power, suspects):
    """power = |spectrum|^2; suspects[r]: the highest of bins r width .. (r + 1) width - 1 exceeds ``ratio`` times their median.

    It does where more than half of the bins stay below the highest / ratio: no bin needs sorting. What is left over
    behind the last whole row belongs to it.
    """
    rows = len(suspects)
    for r in range(rows):
        first, n = np.uint64(r * width), np.uint64(width if r < rows - 1 else len(power) - r * width)
        high = np.float32(0)
        for k in range(n):
            re, im = spectrum[first + k].real, spectrum[first + k].imag
            power[first + k] = re * re + im * im
            high = max(high, power[first + k])
        limit, below = high / np.float32(ratio), np.int32(0)
        for k in range(np.uint64(width)):
            below += np.int32(power[first + k] < limit)
        suspects[r] = 2 * below >= width


@nb.njit(cache=True, nogil=True)
def rotate(x, cycles_per_sample, out):
    """out = x exp(-2 pi i f n), planar float32 (2, n); the phase is exact at every 256th sample."""
    step = np.exp(-2j * np.pi * cycles_per_sample)
    cosine, sine = np.empty(256, np.float32), np.empty(256, np.float32)
    w = 1.0 + 0.0j
    for k in range(256):
        cosine[k], sine[k] = w.real, w.imag
        w *= step
    n = x.shape[1]
    xi, xq, yi, yq = x[0], x[1], out[0], out[1]
    for first in range(0, n, 256):
        turn = (cycles_per_sample * first) % 1.0
        c, s = np.float32(np.cos(2 * np.pi * turn)), np.float32(-np.sin(2 * np.pi * turn))
        at = np.uint64(first)
        for k in range(np.uint64(min(256, n - first))):
            re = c * cosine[k] - s * sine[k]
            im = c * sine[k] + s * cosine[k]
            a, b = xi[at + k], xq[at + k]
            yi[at + k] = a * re - b * im
            yq[at + k] = a * im + b * re


@nb.njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
def piece_sums(x, table, samples_per_chip, length, phase_chips, chips_per_sample, first, piece, out):
    """Correlate consecutive pieces of ``piece`` samples (not an integer) with the code.

    x planar float32 (2, n); ``table`` as ``signals.modulation.CodeTable``; ``phase_chips``: code phase at sample 0;
    piece p covers samples round(first + p piece) .. round(first + (p + 1) piece); ``out`` complex128 (pieces,).
    """
    n_phase = table.shape[0]
    xi, xq = x[0], x[1]
    for p in range(len(out)):
        lo, hi = int(first + p * piece + 0.5), int(first + (p + 1) * piece + 0.5)
        phase = (phase_chips + lo * chips_per_sample) % length
        q = int(phase * samples_per_chip * n_phase + 0.5)
        row = table[q % n_phase]
        column = q // n_phase
        re, im = np.float32(0), np.float32(0)
        a, b = np.uint64(lo), np.uint64(column)
        for k in range(np.uint64(hi - lo)):
            c = np.float32(row[b + k])
            re += c * xi[a + k]
            im += c * xq[a + k]
        out[p] = complex(re, im)


@nb.njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
def subtract_code(x, table, samples_per_chip, length, phase_chips, chips_per_sample, edges):
    """x -= a_j code between consecutive ``edges`` (samples), a_j = sum x code / sum code^2 there.

    x planar float32 (2, n) at zero Doppler, in place; code read in blocks of at most 1024 samples.
    """
    n_phase = table.shape[0]
    for j in range(len(edges) - 1):
        lo, hi = int(edges[j] + 0.5), int(edges[j + 1] + 0.5)
        re, im, energy = 0.0, 0.0, 0.0
        for write in range(2):
            for start in range(lo, hi, 1024):
                phase = (phase_chips + start * chips_per_sample) % length
                q = int(phase * samples_per_chip * n_phase + 0.5)
                row = table[q % n_phase]
                column = q // n_phase
                a, b = np.float32(re), np.float32(im)
                s, t, e = np.float32(0), np.float32(0), np.float32(0)
                for k in range(min(1024, hi - start)):
                    c = np.float32(row[column + k])
                    if write:
                        x[0, start + k] -= a * c
                        x[1, start + k] -= b * c
                    else:
                        s += c * x[0, start + k]
                        t += c * x[1, start + k]
                        e += c * c
                if not write:
                    re, im, energy = re + s, im + t, energy + e
            if energy > 0:
                re, im, energy = re / energy, im / energy, 0.0


@nb.njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
def window_power(pieces, span, step, piece_s, residual_hz, out):
    """out[f] = sum over windows of |sum_k pieces[c, first + k] exp(-2 pi i f (k + 1/2) piece_s)|^2; returns their number.

    Windows of ``span`` pieces begin at every ``step`` pieces of each component; ``pieces`` complex128 (components, n).
    """
    turn, count = np.empty(span, np.complex128), 0
    for f in range(len(out)):
        for k in range(span):
            turn[k] = np.exp(-2j * np.pi * residual_hz[f] * ((k + 0.5) * piece_s))
        total, count = 0.0, 0
        for c in range(pieces.shape[0]):
            for first in range(0, pieces.shape[1] - span + 1, step):
                z = 0.0 + 0.0j
                for k in range(span):
                    z += pieces[c, first + k] * turn[k]
                total += z.real * z.real + z.imag * z.imag
                count += 1
        out[f] = total
    return count
