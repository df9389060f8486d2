"""How a stranger's recording must be read: sample format, rate and intermediate frequency, from its bytes alone.

The bytes narrow the format down (`plausible_formats`); which of those it is, at which rate, is what finds satellites:
only as declared rightly does a code repeat every millisecond, and half-right readings find them far weaker.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sdr import iffile
from tracking.acquisition import AcquisitionSpec, acquire

COMMON_RATES_HZ = tuple(
    float(round(1e6 * r))  # 1e6 * 2.046 lies below 2046000
    for r in (
        *(2.046, 2.048, 2.4, 2.5, 2.6, 2.8, 3.2, 4.0, 4.092, 4.096, 5.0, 5.456, 6.0, 6.625, 8.0, 8.184),
        *(10.0, 12.0, 12.5, 16.0, 16.368, 20.0, 20.46, 24.0, 25.0, 26.0, 30.0, 40.0, 50.0),
    )
)
"""Rates that front ends and published data sets use; tried when none is declared."""
REAL_FRONT_ENDS_HZ = (
    (16.3676e6, 4.1304e6),
    (38.192e6, 9.548e6),
    (5.456e6, 1.364e6),
    (5.714286e6, 1.405e6),
    (8.1838e6, 2.046e6),
    (11.999e6, 3.563e6),
    (12e6, 3.563e6),
    (6.5e6, 1.62e6),
    (40e6, 9.58e6),
)
"""Rate and IF of front ends that deliver real samples elsewhere than at a quarter of their rate."""
CREDIBLE = 10.0
"""Score (statistics over thresholds, summed over the satellites) from which no further format is tried."""
HEAD_BYTES = 1 << 20
LOOK_S = 0.02


def fit(declared: iffile.Declaration) -> tuple[iffile.Declaration, list[str]]:
    """The declaration with what it leaves open filled in, and what was tried, for people.

    Where nothing is found as far as it is declared, all is left open. Raises ValueError where nothing that was tried
    finds a satellite.
    """
    best, told = _search(declared)
    if best is None and (declared.format or declared.fs_hz or declared.if_hz):
        best, more = _search(undeclared(declared))
        told = [*told, "no satellite is found as declared", *more]
    if best is None:
        raise ValueError(
            f"'{declared.data}': no GPS satellite was found ({'; '.join(told)}); give --format, --fs-hz and --if-hz as "
            "the recorder was set"
        )
    return best, told


def undeclared(declared: iffile.Declaration) -> iffile.Declaration:
    """The same file with format, rate, IF and inversion open."""
    return replace(declared, format=None, fs_hz=None, if_hz=None, conjugate=False)


def _search(declared: iffile.Declaration) -> tuple[iffile.Declaration | None, list[str]]:
    formats = [declared.format] if declared.format else plausible_formats(_head(declared))
    best: iffile.Declaration | None = None
    most, tried = 0.0, 0
    for fmt in formats:
        for trial in _trials(replace(declared, format=fmt)):
            tried += 1
            found = score(trial)
            if found > most:
                most, best = found, trial
        if most >= CREDIBLE:
            break
    return best, [f"{tried} ways of reading it tried, as {' or '.join(formats)}"]


def plausible_formats(head: bytes) -> list[str]:
    """Formats whose values would look like noise through a front end, likeliest first.

    Noise lies about its middle and thins out towards the ends of its scale; a byte that is only the lower half of a
    number, that has the wrong sign convention or that holds several samples does not.
    """
    head = head[: len(head) // 8 * 8]
    if len(head) < 4096:
        raise ValueError(f"{len(head)} bytes are too few to guess a format: give --format and --fs-hz")
    with np.errstate(invalid="ignore", over="ignore"):
        values = np.abs(np.frombuffer(head, "<f4").astype(np.float64))
    if np.mean((values == 0) | ((values > 1e-9) & (values < 1e9))) > 0.999:
        return ["cf32", "rf32"]
    packed = _two_bit_fields(np.frombuffer(head, "u1"))
    if packed:
        return packed
    low, high = np.frombuffer(head, "i1").reshape(-1, 2).T
    extended = np.mean(high == np.where(low < 0, -1, 0)) > 0.8
    if extended or np.ptp(low) == 0 or (_noise(high) and not _noise(low)):
        return ["ci16", "ri16"]
    if _noise(low) and _noise(high):
        return ["ci8", "ri8"]
    if _noise(low ^ -128) and _noise(high ^ -128):
        return ["cu8", "ru8"]
    return ["ci1", "ri1"]


def _noise(values: np.ndarray) -> bool:
    """Whether the middle of the 8-bit scale is fuller than its ends (the last level apart, where clipping piles up)."""
    size = np.abs(values.astype(np.int16))
    return float(np.mean((size >= 96) & (size < 127))) < 0.6 * float(np.mean(size < 32))


def _two_bit_fields(raw: np.ndarray) -> list[str]:
    """Two-bit formats, if all pairs of bits are alike and no coin's: two's complement's agree, or large ones are rare."""
    bits = np.unpackbits(raw, bitorder="little").reshape(-1, 8, 2)
    low = bits[:, :, 0].mean(axis=0)
    equal = (bits[:, :, 0] == bits[:, :, 1]).mean(axis=0)
    if np.ptp(low) > 0.05 or np.ptp(equal) > 0.05 or abs(equal.mean() - 0.5) > 0.45:
        return []
    if abs(equal.mean() - 0.5) > 0.05:
        return ["ci2tc", "ri2tc"]
    return ["ci2", "raw8", "ri2"] if abs(low.mean() - 0.5) > 0.05 else []


def _head(declared: iffile.Declaration) -> bytes:
    if not declared.data.is_file():
        missing = "is not a file" if declared.data.exists() else "does not exist"
        raise ValueError(f"'{declared.data}' {missing}")
    with declared.data.open("rb") as f:
        f.seek(declared.header_bytes)
        return f.read(HEAD_BYTES)


def _trials(declared: iffile.Declaration) -> Iterator[iffile.Declaration]:
    """Every usual rate and IF where the declaration leaves them open."""
    rates = [declared.fs_hz] if declared.fs_hz is not None else list(COMMON_RATES_HZ)
    real = not iffile.sample_format(str(declared.format)).complex
    if declared.if_hz is not None or not real:
        yield from (replace(declared, fs_hz=fs, if_hz=declared.if_hz or 0.0) for fs in rates)
        return
    yield from (replace(declared, fs_hz=fs, if_hz=fs / 4) for fs in rates)
    for fs, if_hz in REAL_FRONT_ENDS_HZ:
        if declared.fs_hz is None or abs(declared.fs_hz / fs - 1) < 1e-3:
            yield replace(declared, fs_hz=declared.fs_hz or fs, if_hz=if_hz)


def score(trial: iffile.Declaration) -> float:
    """Statistics over thresholds of the GPS satellites found in 20 ms read so, summed; 0 if none."""
    try:
        source = iffile.open_recording(trial.data, trial)
        iq = source.read(min(source.n_samples, int(LOOK_S * source.fs_hz)))[1]
    except ValueError:  # it cannot be read so: an odd size, an IF beyond the band, floats that are none
        return 0.0
    if iq.shape[1] < 0.002 * source.fs_hz or not iq.any():
        return 0.0
    rows = acquire(iq, 0, source.fs_hz, source.if_hz, "L1CA", list(range(1, 33)), AcquisitionSpec())
    return float(np.sum(np.where(rows["acquired"], rows["statistic"] / rows["threshold"], 0.0)))
