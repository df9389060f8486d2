"""Recordings of IF samples: raw formats, SigMF and PocketSDR ``.tag`` metadata, in and out; ION's ``.sdrx``, in.

Packed samples lie least significant bits first, I before Q. Two-bit values are sign and magnitude as the MAX2771
and PocketSDR have them (0 1 2 3 = +1 +3 -1 -3); the formats ``..tc`` are two's complement as GNSS-SDR's
``Two_Bit_Packed_File_Signal_Source`` expects (0 1 2 3 = +1 +3 -3 -1). One bit: 0 = +1, 1 = -1.
"""

import contextlib
import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

from sdr import sdrx
from signals.constants import F_L1_HZ
from signals.frontend import check_sampling
from signals.timescale import calendar

__all__ = [
    "ALIASES",
    "FORMATS",
    "Declaration",
    "RecordingSource",
    "RecordingWriter",
    "create_recording",
    "declaration",
    "open_recording",
    "sample_format",
]

_MAX_META_BYTES = 16 << 20
_MAX_TAG_BYTES = 16 << 10
_CHUNK_BYTES = 1 << 20
_MAX_FILE_HZ = 1e9


@dataclass(frozen=True)
class SampleFormat:
    """How samples lie in a file."""

    name: str
    complex: bool
    dtype: str  # of the values in the file; "" when packed
    bits: int  # of a value
    sample_bits: int  # of a whole sample
    levels: tuple[int, ...] = ()  # packed: level of each code
    sigmf: str | None = None


def _whole(name: str, dtype: str, sigmf: str) -> SampleFormat:
    bits = 8 * np.dtype(dtype).itemsize
    parts = 1 if name[0] == "r" else 2
    return SampleFormat(name, parts == 2, dtype, bits, parts * bits, (), sigmf)


def _packed(name: str, levels: tuple[int, ...], sample_bits: int | None = None) -> SampleFormat:
    bits, parts = len(levels).bit_length() - 1, 1 if name.startswith("ri") else 2
    return SampleFormat(name, parts == 2, "", bits, sample_bits or parts * bits, levels)


_SIGN = (1, -1)
_SIGN_MAGNITUDE = (1, 3, -1, -3)
_TWOS_COMPLEMENT = (1, 3, -3, -1)
FORMATS = {
    f.name: f
    for f in (
        *(_whole(f"{p}i8", "i1", f"{p}i8") for p in "cr"),
        *(_whole(f"{p}u8", "u1", f"{p}u8") for p in "cr"),
        *(_whole(f"{p}i16", "<i2", f"{p}i16_le") for p in "cr"),
        *(_whole(f"{p}f32", "<f4", f"{p}f32_le") for p in "cr"),
        *(_packed(f"{p}i1", _SIGN) for p in "cr"),
        *(_packed(f"{p}i2", _SIGN_MAGNITUDE) for p in "cr"),
        *(_packed(f"{p}i2tc", _TWOS_COMPLEMENT) for p in "cr"),
        _packed("raw8", _SIGN_MAGNITUDE, 8),
    )
}
"""By name: c(omplex) or r(eal), i(nteger), u(nsigned, offset 128) or f(loat), bits. raw8: PocketSDR, RF channel 1."""
ALIASES = {
    "ibyte": "ci8", "int8x2": "ci8", "cs8": "ci8", "ic8": "ci8", "sc8": "ci8",
    "byte": "ri8", "int8": "ri8", "s8": "ri8",
    "cbyte": "ci8", "ishort": "ci16", "cshort": "ci16", "int16x2": "ci16", "cs16": "ci16", "sc16": "ci16",
    "short": "ri16", "int16": "ri16", "s16": "ri16",
    "gr_complex": "cf32", "fc32": "cf32", "float32x2": "cf32", "complex64": "cf32", "cfile": "cf32",
    "float": "rf32", "float32": "rf32", "f32": "rf32",
    "cu8": "cu8", "rtl": "cu8", "ci16_le": "ci16", "ri16_le": "ri16", "cf32_le": "cf32", "rf32_le": "rf32",
    "int2x2": "ci2", "int2": "ri2", "int1x2": "ci1", "int1": "ri1", "2bit": "ri2", "1bit": "ri1",
}  # fmt: skip
"""Names that receivers and recorders give to these formats (GNSS-SDR, PocketSDR, GNU Radio, UHD, SigMF)."""


def sample_format(name: str) -> SampleFormat:
    """Format of this name or alias, in any case; ValueError if there is none."""
    key = str(name).strip().lower()
    key = ALIASES.get(key, key)
    if key not in FORMATS:
        raise ValueError(f"format '{name}' is not known; use one of {', '.join(FORMATS)}")
    return FORMATS[key]


@dataclass(frozen=True)
class Declaration:
    """What is known of a recording; None where nothing says it."""

    data: Path
    format: str | None = None
    fs_hz: float | None = None
    if_hz: float | None = None
    conjugate: bool = False
    skip_s: float = 0.0
    duration_s: float | None = None
    start: datetime | None = None
    header_bytes: int = 0
    annotations: tuple[dict[str, Any], ...] = ()


def declaration(path: Path | str, recording: Any = None) -> Declaration:
    """What metadata beside the file and the caller's options say of it; options win.

    Parameters
    ----------
    path : the data, a ``.sigmf-meta``, a ``.sdrx``, or a SigMF base name.
    recording : anything with format, fs_hz, if_hz, conjugate, skip_s, duration_s.
    """
    path = Path(path)
    meta, tag = _meta_path(path), Path(f"{path}.tag")
    if path.suffix == ".sdrx":
        fields = sdrx.read(path, _read_text(path, _MAX_META_BYTES))
        known = Declaration(**fields | {"start": _datetime(fields["start"])})
    elif meta is not None:
        known = _read_sigmf(meta)
    elif tag.is_file():
        known = _read_tag(path, tag)
    else:
        known = Declaration(path)
    given = {
        name: getattr(recording, name)
        for name in ("format", "fs_hz", "if_hz", "duration_s")
        if getattr(recording, name, None) is not None
    }
    if "format" in given:
        given["format"] = sample_format(given["format"]).name
    given["conjugate"] = known.conjugate or bool(getattr(recording, "conjugate", False))
    return replace(known, skip_s=float(getattr(recording, "skip_s", 0.0) or 0.0), **given)


def _meta_path(path: Path) -> Path | None:
    """The ``.sigmf-meta`` that belongs to this path, if there is one."""
    if path.suffix == ".sigmf-meta":
        return path
    candidate = (
        path.with_suffix(".sigmf-meta") if path.suffix == ".sigmf-data" else Path(f"{path}.sigmf-meta")
    )
    return candidate if candidate.is_file() and (path.suffix == ".sigmf-data" or not path.is_file()) else None


def _read_text(path: Path, limit: int) -> str:
    if not path.is_file():
        raise ValueError(f"'{path}' does not exist")
    if path.stat().st_size > limit:
        raise ValueError(f"'{path}' is larger than {limit} bytes: it is not the metadata of a recording")
    try:
        return path.read_bytes().decode("utf-8")
    except UnicodeDecodeError as err:
        raise ValueError(f"'{path}' is not text (UTF-8): it is not the metadata of a recording") from err


def _read_sigmf(meta: Path) -> Declaration:
    text = _read_text(meta, _MAX_META_BYTES)
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as err:  # ValueError: of JSON, or an integer of thousands of digits
        raise ValueError(f"'{meta}' is not JSON: it cannot be read as SigMF metadata") from err
    head = content.get("global") if isinstance(content, dict) else None
    captures = content.get("captures") if isinstance(content, dict) else None
    if not isinstance(head, dict) or not isinstance(captures, list) or len(captures) > 100_000:
        raise ValueError(f"'{meta}' lacks the objects 'global' and 'captures' of SigMF")
    if any(not isinstance(c, dict) for c in captures):
        raise ValueError(f"'{meta}': every capture must be a JSON object")
    if head.get("core:num_channels", 1) != 1:
        raise ValueError(f"'{meta}' declares several channels; write each channel to a file of its own")
    first = captures[0] if captures else {}
    # A capture that leaves the centre out keeps it.
    centres = {
        f for c in captures if (f := c.get("core:frequency")) is not None and not isinstance(f, list | dict)
    }
    if len(centres) > 1:
        raise ValueError(f"'{meta}' changes its centre frequency between captures; split it into files")
    if_hz = _number(meta, head, "gnss:if_hz", None, -_MAX_FILE_HZ, _MAX_FILE_HZ)
    frequency = _number(meta, first, "core:frequency", None, 0.0, 1e12)
    if if_hz is None and frequency is not None:
        if_hz = F_L1_HZ - frequency
    annotations = content.get("annotations", [])
    annotations = annotations if isinstance(annotations, list) else []
    return Declaration(
        data=_dataset(meta, head),
        format=_sigmf_format(meta, head),
        fs_hz=_number(meta, head, "core:sample_rate", None, 1.0, _MAX_FILE_HZ),
        if_hz=if_hz,
        conjugate=head.get("gnss:inverted") is True,
        start=_datetime(first.get("core:datetime")),
        header_bytes=int(_number(meta, first, "core:header_bytes", 0, 0, 1 << 40) or 0),
        annotations=tuple(a for a in annotations if isinstance(a, dict)),
    )


def _number(meta: Path, table: dict, key: str, default, low: float, high: float):
    value = table.get(key, default)
    if value is None or value is default:
        return value
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ValueError(f"'{meta}': {key} must be a number from {low:g} to {high:g}")
    return float(value)


def _sigmf_format(meta: Path, head: dict) -> str:
    datatype = head.get("core:datatype")
    for f in FORMATS.values():
        if f.sigmf is not None and datatype in (
            f.sigmf,
            f.sigmf.removesuffix("_le") if f.bits == 8 else f.sigmf,
        ):
            return f.name
    known = ", ".join(f.sigmf for f in FORMATS.values() if f.sigmf)
    raise ValueError(
        f"'{meta}': core:datatype {str(datatype)[:40]!r} is not supported; convert to one of {known}"
    )


def _dataset(meta: Path, head: dict) -> Path:
    """The data file: beside the metadata, never elsewhere."""
    name = head.get("core:dataset")
    if name is None:
        return meta.with_suffix(".sigmf-data")
    if (
        not isinstance(name, str)
        or not name
        or "\0" in name
        or Path(name).name != name
        or name in (".", "..")
    ):
        raise ValueError(f"'{meta}': core:dataset must be the plain name of a file beside it")
    return meta.parent / name


def _datetime(value: Any) -> datetime | None:
    try:
        return datetime.fromisoformat(value) if isinstance(value, str) else None
    except ValueError:
        return None


_TAG_FORMATS = {
    "INT8": ("ri8", False),
    "INT8X2": ("ci8", True),
    "CS8": ("ci8", False),
    "CS16": ("ci16", False),
    "RAW8": ("raw8", True),
}
"""PocketSDR's FMT: format, and whether PocketSDR flips Q when it reads it (its front end inverts the spectrum)."""


def _read_tag(path: Path, tag: Path) -> Declaration:
    """PocketSDR's sidecar: lines ``KEY = value``; F_S and F_LO in MHz, the first RF channel counts."""
    keys = {}
    for line in _read_text(tag, _MAX_TAG_BYTES).splitlines():
        key, sep, value = line.partition("=")
        if sep:
            keys[key.strip()] = value.strip()
    name = keys.get("FMT", "")
    if name in _TAG_FORMATS:
        fmt, conjugate = _TAG_FORMATS[name]
    elif name.lower() in FORMATS:
        fmt, conjugate = name.lower(), False
    else:
        allowed = ", ".join([*_TAG_FORMATS, *(f.upper() for f in FORMATS)])
        raise ValueError(f"'{tag}': FMT {name[:40]!r} is not supported; allowed are {allowed}")
    fs_hz, lo_hz = (_tag_mhz(tag, keys, key) for key in ("F_S", "F_LO"))
    start = _datetime(keys.get("TIME", "").replace("/", "-"))
    return Declaration(path, fmt, fs_hz, None if lo_hz is None else F_L1_HZ - lo_hz, conjugate, start=start)


def _tag_mhz(tag: Path, keys: dict[str, str], key: str) -> float | None:
    if key not in keys:
        return None
    try:
        value = float(keys[key].split(",")[0])
    except ValueError:
        value = math.nan
    if not 0.0 < value < 1e5:
        raise ValueError(f"'{tag}': {key} must be a frequency in MHz")
    # Decimal megahertz to the nearest microhertz: 1575.42 must come back as exactly F_L1.
    return round(value * 1e6, 6)


def open_recording(path: Path | str, declared: Declaration) -> "RecordingSource":
    """Run that reads a recording as declared; ValueError with one sentence if that cannot be."""
    data = declared.data
    if not data.exists():
        raise ValueError(f"'{data}' does not exist")
    if not data.is_file():
        raise ValueError(f"'{data}' is not a file")
    if declared.format is None or declared.fs_hz is None:
        missing = [o for o, v in (("--format", declared.format), ("--fs-hz", declared.fs_hz)) if v is None]
        raise ValueError(f"nothing beside '{path}' says how it was recorded: give {' and '.join(missing)}")
    fmt = sample_format(declared.format)
    fs_hz, if_hz = float(declared.fs_hz), declared.if_hz
    if if_hz is None and not fmt.complex:
        raise ValueError(
            f"'{data}' holds real samples ({fmt.name}): give their intermediate frequency (--if-hz)"
        )
    if_hz = float(if_hz or 0.0)
    if fs_hz > _MAX_FILE_HZ:
        raise ValueError(f"fs_hz = {fs_hz:g} is beyond what is read, {_MAX_FILE_HZ:g}: give it in Hz")
    check_sampling(fs_hz, if_hz, fmt.complex)
    first, n = _span(declared, fmt, fs_hz)
    return RecordingSource(declared, fmt, fs_hz, if_hz, first, n)


def _span(declared: Declaration, fmt: SampleFormat, fs_hz: float) -> tuple[int, int]:
    """First sample and number of samples of the part that is wanted."""
    size = declared.data.stat().st_size - declared.header_bytes
    if size <= 0:
        raise ValueError(f"'{declared.data}' is empty")
    whole = max(fmt.sample_bits // 8, 1)
    if size % whole:
        raise ValueError(
            f"'{declared.data}' holds {size} bytes, not a whole number of {whole}-byte {fmt.name} samples:"
            " it is truncated, or the format is another"
        )
    total = size * 8 // fmt.sample_bits
    skip_s, duration_s = declared.skip_s, declared.duration_s
    if not (math.isfinite(skip_s) and skip_s >= 0):
        raise ValueError(f"skip_s = {skip_s:g} must be zero or more")
    if duration_s is not None and not duration_s > 0:
        raise ValueError(f"duration_s = {duration_s:g} must be positive")
    first = round(skip_s * fs_hz)
    if first >= total:
        raise ValueError(
            f"'{declared.data}' lasts {total / fs_hz:g} s at {fs_hz:g} Hz: nothing is left after skipping {skip_s:g} s"
        )
    n = total - first
    if duration_s is not None:
        n = min(n, max(round(min(duration_s * fs_hz, 2**62)), 1))
    return first, n


class RecordingSource:
    """Run that delivers the samples of a file, slab after slab, in constant memory.

    ``if_hz`` is where the signal lies after conjugation; with real samples an inverted spectrum is the mirror at
    ``-if_hz``, and nothing is conjugated.
    """

    def __init__(
        self, declared: Declaration, fmt: SampleFormat, fs_hz: float, if_hz: float, first: int, n: int
    ):
        self.declared, self.format = declared, fmt
        self.fs_hz, self.complex, self.n_samples = fs_hz, fmt.complex, n
        self.if_hz = -if_hz if declared.conjugate and not fmt.complex else if_hz
        self.start = declared.start
        self.dtype = np.dtype({"<i2": np.int16, "<f4": np.float32}.get(fmt.dtype, np.int8))
        self._first, self._position = first, 0
        self._file = declared.data.open("rb", buffering=0)
        self._buffer = np.empty(_CHUNK_BYTES, np.uint8)
        self._levels = np.array(fmt.levels or [0], np.int8)

    def read(self, n: int) -> tuple[int, np.ndarray]:
        """Next n samples, or what is left: (index of the first, planar (2, n))."""
        n0 = self._position
        n = max(min(int(n), self.n_samples - n0), 0)
        out = np.empty((2, n), self.dtype)
        step = _CHUNK_BYTES * 8 // self.format.sample_bits - 8
        for at in range(0, n, step):
            self._fill(out, at, min(step, n - at), self._first + n0 + at)
        self._position = n0 + n
        return n0, out

    def read_at(self, n0: int, n: int) -> tuple[int, np.ndarray]:
        """The same from sample ``n0`` on."""
        self._position = n0
        return self.read(n)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _fill(self, out: np.ndarray, at: int, n: int, sample: int) -> None:
        """Samples from ``sample`` of the file on -> ``out[:, at : at + n]``."""
        fmt = self.format
        bit = sample * fmt.sample_bits
        offset, size = bit % 8, (bit % 8 + n * fmt.sample_bits + 7) // 8
        self._load(bit // 8 + self.declared.header_bytes, size)
        raw, sign = self._buffer[:size], -1 if self.declared.conjugate else 1
        if fmt.levels:
            _unpack(raw, offset, fmt.sample_bits, fmt.bits, fmt.complex, self._levels, sign, out, at, n)
        elif fmt.dtype == "<f4":
            bad = _split_float32(
                raw.view("<f4").astype(np.float32, copy=False), fmt.complex, sign, out, at, n
            )
            if bad >= 0:
                raise ValueError(
                    f"'{self.declared.data}': sample {sample + bad} is not a finite number: the file is damaged, or the"
                    f" format is not {fmt.name}"
                )
        else:
            self._split_integers(raw, sign, out, at, n)

    def _split_integers(self, raw: np.ndarray, sign: int, out: np.ndarray, at: int, n: int) -> None:
        """int8, offset binary or int16: both parts of a complex sample are read as one word."""
        fmt = self.format
        bits = fmt.bits if fmt.complex else 0
        word = np.dtype(f"<i{fmt.sample_bits // 8}")
        words = raw.view(word).astype(word.newbyteorder("="), copy=False)
        flip = 0x80 * (0x0101 if fmt.complex else 1) if fmt.dtype == "u1" else 0
        if flip:
            words = words ^ np.array(flip).astype(words.dtype)
        if fmt.complex:
            _split_words(words, bits, sign, out, at)
        else:
            out[0, at : at + n], out[1, at : at + n] = words, 0

    def _load(self, offset: int, size: int) -> None:
        self._file.seek(offset)
        view, got = self._buffer.data[:size], 0
        while got < size:
            step = self._file.readinto(view[got:])
            if not step:
                raise ValueError(f"'{self.declared.data}' became shorter while it was read")
            got += step


@njit(cache=True, nogil=True)
def _unpack(raw, offset, sample_bits, bits, is_complex, levels, sign, out, at, n):
    mask = (1 << bits) - 1
    for k in range(n):
        bit = offset + k * sample_bits
        out[0, at + k] = levels[(raw[bit >> 3] >> (bit & 7)) & mask]
        q = 0
        if is_complex:
            bit += bits
            q = sign * levels[(raw[bit >> 3] >> (bit & 7)) & mask]
        out[1, at + k] = q


# Unsigned indices: no test for negative ones, so that the loops become vector instructions.


@njit(cache=True, nogil=True)
def _split_words(words, bits, sign, out, at):
    """I in the ``bits`` low bits, Q in the high ones."""
    a, top = np.uint64(at), np.int32((1 << (bits - 1)) - 1)
    for k in range(np.uint64(len(words))):
        q = np.int32(words[k]) >> np.int32(bits)
        out[0, a + k] = words[k]
        # -(-128) does not fit into 8 bits: 127 is nearest
        out[1, a + k] = q if sign > 0 else min(-q, top)


@njit(cache=True, nogil=True)
def _split_float32(raw, is_complex, sign, out, at, n):
    """Returns the first sample that is not finite, or -1."""
    a, two, one, turn, odd = np.uint64(at), np.uint64(2), np.uint64(1), np.float32(sign), np.int32(0)
    if is_complex:
        for k in range(np.uint64(n)):
            out[0, a + k] = raw[two * k]
            out[1, a + k] = turn * raw[two * k + one]
    else:
        for k in range(np.uint64(n)):
            out[0, a + k] = raw[k]
            out[1, a + k] = 0
    for k in range(np.uint64(len(raw))):
        odd |= np.int32(not np.isfinite(raw[k]))
    if not odd:
        return -1
    for k in range(len(raw)):
        if not np.isfinite(raw[k]):
            return k // 2 if is_complex else k
    return -1


@njit(cache=True, nogil=True)
def _pack(iq, sample_bits, bits, is_complex, codes, raw, sign):
    """Levels -> codes, least significant bits first; ``raw`` starts as zeros. Returns the first level that has none."""
    for k in range(iq.shape[1]):
        for r in range(2 if is_complex else 1):
            value = np.int64(iq[r, k]) * (sign if r == 1 else 1)
            code = codes[value + 4] if -4 <= value <= 4 else -1
            if code < 0:
                return k
            bit = k * sample_bits + r * bits
            raw[bit >> 3] |= code << (bit & 7)
    return -1


class RecordingWriter:
    """Run that writes a recording; whatever happens, what is on disk is a valid recording.

    SigMF for whole bytes (``base.sigmf-data`` and ``.sigmf-meta``), for packed samples ``base.bin`` with a
    PocketSDR ``.tag``. Metadata are written first and replaced at the end (both by renaming), samples are appended
    whole: an interrupted run leaves a shorter recording.

    Parameters
    ----------
    base : Path
        Without extension.
    fmt : str
        A name of `FORMATS`. ``raw8`` repeats the samples in both RF channels, with Q flipped as PocketSDR has it.
    fs_hz, if_hz : float
    start : datetime, optional
        UTC of the first sample.
    description : str
    annotations : sequence of dict
        SigMF annotations (``core:sample_start``, ``core:label``, ..).
    extra : dict, optional
        More keys of the global object, all with the prefix ``gnss:``.
    """

    def __init__(
        self,
        base: Path | str,
        fmt: str,
        fs_hz: float,
        if_hz: float = 0.0,
        start: datetime | None = None,
        description: str = "",
        annotations: Sequence[dict[str, Any]] = (),
        extra: dict[str, Any] | None = None,
    ):
        self.format = sample_format(fmt)
        if self.format.dtype == "u1":
            raise ValueError("unsigned samples are only read: write ci8 or ri8")
        check_sampling(fs_hz, if_hz, self.format.complex)
        self.fs_hz, self.if_hz, self.start = float(fs_hz), float(if_hz), start
        self.description, self.annotations, self.extra = description, list(annotations), dict(extra or {})
        base = Path(base)
        if not base.parent.is_dir():
            raise ValueError(f"directory '{base.parent}' does not exist")
        packed = self.format.sigmf is None
        self.data = Path(f"{base}.bin" if packed else f"{base}.sigmf-data")
        self.meta = Path(f"{self.data}.tag" if packed else f"{base}.sigmf-meta")
        self.files = [self.data, self.meta]
        self.n_samples = 0
        self._rest = np.zeros((2, 0), np.int8)
        self._codes = np.full(9, -1, np.int64)
        for code, level in enumerate(self.format.levels):
            self._codes[level + 4] = code
        self.data.unlink(missing_ok=True)
        self._write_meta(complete=False)
        self._file = self.data.open("wb", buffering=0)

    def __enter__(self) -> "RecordingWriter":
        return self

    def __exit__(self, *exc) -> None:
        self.close(complete=exc[0] is None)

    def write(self, iq: np.ndarray) -> None:
        """Append planar samples (2, n) of the format's own type; real formats take row 0.

        Packed samples that do not fill a byte wait for the next call; at the end up to 7 are dropped.
        """
        fmt = self.format
        if fmt.sigmf is None:
            self._write_packed(iq)
            return
        wanted = np.dtype(fmt.dtype)
        if iq.dtype != wanted:
            raise ValueError(f"samples of type {iq.dtype} cannot be written as {fmt.name}")
        whole = np.ascontiguousarray(iq.T if fmt.complex else iq[0]).astype(wanted, copy=False)
        self._append(whole.reshape(-1).view(np.uint8), fmt.sample_bits // 8)
        self.n_samples += iq.shape[1]

    def close(self, complete: bool = True) -> None:
        """Finish the metadata and close the file."""
        if self._file.closed:
            return
        self._file.close()
        self._write_meta(complete)

    def _write_packed(self, iq: np.ndarray) -> None:
        fmt = self.format
        iq = np.concatenate([self._rest, iq.astype(np.int8, copy=False)], axis=1)
        per_byte = 8 // fmt.sample_bits
        n = iq.shape[1] // per_byte * per_byte
        raw = np.zeros(n // per_byte, np.uint8)
        sign = -1 if fmt.name == "raw8" else 1
        bad = _pack(iq[:, :n], fmt.sample_bits, fmt.bits, fmt.complex, self._codes, raw, sign)
        if bad >= 0:
            levels = ", ".join(f"{v:+d}" for v in sorted(fmt.levels))
            raise ValueError(f"sample {self.n_samples + bad} is not one of the levels {levels} of {fmt.name}")
        if fmt.name == "raw8":
            raw |= raw << 4
        self._append(raw, 1)
        self._rest = iq[:, n:].copy()
        self.n_samples += n

    def _append(self, raw: np.ndarray, sample_bytes: int) -> None:
        """Write all bytes, or leave whole samples and let the error pass."""
        view, done = raw.data, 0
        try:
            while done < len(view):
                done += self._file.write(view[done:]) or 0
        except OSError:
            with contextlib.suppress(OSError):
                size = self._file.seek(0, os.SEEK_END)
                self._file.truncate(size - size % sample_bytes)
            raise

    def _write_meta(self, complete: bool) -> None:
        text = self._tag() if self.format.sigmf is None else self._sigmf(complete)
        part = Path(f"{self.meta}.part")
        part.write_text(text, encoding="utf-8")
        os.replace(part, self.meta)

    def _tag(self) -> str:
        raw8 = self.format.name == "raw8"
        name, channels = ("RAW8", 2) if raw8 else (self.format.name.upper(), 1)
        start = self.start or datetime(1980, 1, 6, tzinfo=UTC)
        parts = 2 if self.format.complex else 1
        lines = {
            "PROG": "gnss-baseband",
            "TIME": f"{start:%Y/%m/%d %H:%M:%S}.{start.microsecond // 1000:03d}",
            "FMT ": name,
            "F_S ": f"{self.fs_hz * 1e-6:.12g}",
            "F_LO": ",".join([f"{(F_L1_HZ - self.if_hz) * 1e-6:.12g}"] * channels),
            "IQ  ": ",".join([str(parts)] * channels),
            "BITS": ",".join([str(self.format.bits)] * channels),
        }
        return "".join(f"{key} = {value}\n" for key, value in lines.items())

    def _sigmf(self, complete: bool) -> str:
        capture: dict[str, Any] = {"core:sample_start": 0, "core:frequency": F_L1_HZ - self.if_hz}
        if self.start is not None:
            capture["core:datetime"] = f"{self.start:%Y-%m-%dT%H:%M:%S.%f}Z"
        head = {
            "core:datatype": self.format.sigmf,
            "core:sample_rate": self.fs_hz,
            "core:version": "1.2.0",
            "core:num_channels": 1,
            "core:description": self.description,
            "core:recorder": "gnss-baseband",
            "core:extensions": [{"name": "gnss", "version": "0.1.0", "optional": True}],
            "gnss:if_hz": self.if_hz,
            "gnss:complete": complete,
        }
        annotations = sorted(self.annotations, key=lambda a: a.get("core:sample_start", 0))
        content = {"global": head | self.extra, "captures": [capture], "annotations": annotations}
        return json.dumps(content, indent=2, allow_nan=False) + "\n"


def create_recording(base: Path | str, source: Any, scenario: Any = None) -> RecordingWriter:
    """Writer for what a synthetic source delivers, in the format that its front end implies.

    ``source`` needs ``spec`` (FrontEndSpec) and ``sky``; jammers may offer ``annotations(fs_hz)``.
    """
    front_end = source.spec
    fmt = ("c" if front_end.complex else "r") + {1: "i1", 2: "i2", 16: "i16", 32: "f32"}.get(
        front_end.bits, "i8"
    )
    sky = source.sky
    leap_s = int(sky.iono_utc["dt_ls_s"])
    start = (calendar(sky.week, sky.tow_s) - timedelta(seconds=leap_s)).replace(tzinfo=UTC)
    annotations = [
        a
        for j in getattr(source, "jammers", ())
        if hasattr(j, "annotations")
        for a in j.annotations(source.fs_hz, source.n_samples)
    ]
    extra = {"gnss:week": sky.week, "gnss:tow_s": float(sky.tow_s), "gnss:bits": front_end.bits}
    if scenario is not None:
        extra["gnss:scenario"] = scenario.name
    return RecordingWriter(
        base,
        fmt,
        source.fs_hz,
        source.if_hz,
        start,
        getattr(scenario, "description", "") or "",
        annotations,
        extra,
    )
