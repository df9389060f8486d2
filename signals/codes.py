"""Spreading codes: GPS C/A by shift registers, Galileo E1-B/C from ``data/prn_codes``; logic 0 -> +1."""

import csv
import io
import zlib
from functools import lru_cache
from importlib import resources
from pathlib import Path

import numpy as np

__all__ = ["E1_TABLE", "primary_code", "prn_dir", "prns_of", "secondary_code"]

E1_TABLE = "galileo_e1_primary_codes.csv"
_E1_CHIPS = 4092
_MAX_TABLE_BYTES = 1 << 20

# Delay of G2 in chips, IS-GPS-200, 3.3.2.3 (table 3-I and its extension to PRN 63; SBAS 120-158).
# fmt: off
_G2_DELAYS = [
    5, 6, 7, 8, 17, 18, 139, 140, 141, 251, 252, 254, 255, 256, 257, 258, 469, 470, 471, 472, 473, 474,
    509, 512, 513, 514, 515, 516, 859, 860, 861, 862, 863, 950, 947, 948, 950, 67, 103, 91, 19, 679, 225,
    625, 946, 638, 161, 1001, 554, 280, 710, 709, 775, 864, 558, 220, 397, 55, 898, 759, 367, 299, 1018,
    145, 175, 52, 21, 237, 235, 886, 657, 634, 762, 355, 1012, 176, 603, 130, 359, 595, 68, 386, 797, 456,
    499, 883, 307, 127, 211, 121, 118, 163, 628, 853, 484, 289, 811, 202, 1021, 463, 568, 904,
]
# fmt: on
_G2_DELAY = dict(zip([*range(1, 64), *range(120, 159)], _G2_DELAYS))
# CRC-32 (low 16 bits) of the packed chips, logic 1 as 1: E1B PRN 1-50, then E1C.
_E1_CHECKS = """
    D501 CC89 3829 4F88 9687 F6E6 33D2 D245 1CEE BDA1 4640 64D1 5663 21AC A1F6 2FC6 6F20 A94E C671 757D
    D1D8 780C 8EBB D919 F9DA 2D4B FF8C 47B2 D558 FC23 B2D9 F728 6478 78C4 D0F1 DC5B E75F 1E9D 933D 3231
    AA23 A2EA 8DDA 742C BE29 D62B E255 C3CB 3A42 FC62 88A7 559C C538 C685 4BC8 4B70 A1CC 08A5 2848 AAB5
    4D4C 4E52 D77A C5DC 6A72 4BD8 FF10 A94A E042 DAD4 363E 2B7D 8D9D FD99 46A8 91D9 19AA 9380 38D1 8F52
    8113 02F4 7D9E B47F C81E F16C FB67 7888 E893 2CC6 599E E5F6 1C2D D12C 35EB B97A 7F82 D6B6 809A DC40
"""
_CS25_1 = "0011100000001010110110010"  # Galileo OS SIS ICD, table 20


def prn_dir():
    """Directory of the shipped code tables: inside the wheel, else ``data/prn_codes`` of the checkout."""
    packed = resources.files("signals") / "_prn_codes"
    return packed if packed.is_dir() else Path(__file__).resolve().parents[1] / "data" / "prn_codes"


def prns_of(signal):
    """PRN numbers for which ``signal`` ("L1CA", "E1B", "E1C") has a code, ascending tuple of int."""
    if signal == "L1CA":
        return tuple(_G2_DELAY)
    if signal in ("E1B", "E1C"):
        return tuple(range(1, 51))
    raise ValueError(f"unknown signal {signal!r}: use one of L1CA, E1B, E1C")


def primary_code(signal, prn, path=None):
    """Primary code as chips +-1.

    Parameters
    ----------
    signal : str
        "L1CA" (PRN 1-63 and SBAS 120-158), "E1B" or "E1C" (PRN 1-50).
    prn : int
    path : path-like, optional
        Another table of E1 codes: a CSV ``signal,prn,hex``, or a directory with one of the shipped name.

    Returns
    -------
    ndarray int8 (1023,) or (4092,), read-only

    Raises
    ------
    ValueError
        Unknown signal or PRN; the E1 table is missing, damaged or incomplete (names PRN and reason).

    Notes
    -----
    C/A: G1 = 1 + x^3 + x^10, G2 = 1 + x^2 + x^3 + x^6 + x^8 + x^9 + x^10 (IS-GPS-200, 3.3.2.3). E1: memory
    codes of the Galileo OS SIS ICD, annex C.
    """
    allowed = prns_of(signal)
    if prn not in allowed:
        span = "1-63 and 120-158" if signal == "L1CA" else "1-50"
        raise ValueError(f"{signal} has no PRN {prn}: use {span}")
    if signal == "L1CA":
        return _ca_code(int(prn))
    return _e1_codes(*_table_key(path))[signal, int(prn)]


def secondary_code():
    """CS25_1, the secondary code of every E1-C pilot, one chip per 4 ms: int8 (25,) of +-1."""
    return np.array([1 - 2 * int(bit) for bit in _CS25_1], np.int8)


def _lfsr(taps):
    """One period (1023 bits) of a 10-stage register that starts with all ones."""
    stages = [1] * 10
    out = np.empty(1023, np.int8)
    for i in range(1023):
        out[i] = stages[9]
        stages = [sum(stages[t - 1] for t in taps) & 1, *stages[:9]]
    return out


@lru_cache(maxsize=1)
def _registers():
    return _lfsr((3, 10)), _lfsr((2, 3, 6, 8, 9, 10))


@lru_cache(maxsize=128)
def _ca_code(prn):
    g1, g2 = _registers()
    chips = (1 - 2 * (g1 ^ np.roll(g2, _G2_DELAY[prn]))).astype(np.int8)
    chips.flags.writeable = False
    return chips


def _table_key(path):
    """(path, size, mtime): the cache notices a table that was replaced."""
    file = prn_dir() / E1_TABLE if path is None else Path(path)
    if file.is_dir():
        file = file / E1_TABLE
    if not file.is_file():
        raise ValueError(f"E1 code table {file} not found: give a CSV signal,prn,hex with the 100 codes")
    if not isinstance(file, Path):
        return file, 0, 0
    status = file.stat()
    if status.st_size > _MAX_TABLE_BYTES:
        raise ValueError(
            f"E1 code table {file} has {status.st_size} bytes: at most {_MAX_TABLE_BYTES} are read"
        )
    return file, status.st_size, status.st_mtime_ns


@lru_cache(maxsize=4)
def _e1_codes(file, size, mtime_ns):
    """All codes of a table, {(signal, prn): chips}, each checked."""
    try:
        rows = list(csv.DictReader(io.StringIO(file.read_bytes().decode("ascii"))))
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"E1 code table {file} is not ASCII CSV ({error}): bring signal,prn,hex") from None
    codes = {}
    for line, row in enumerate(rows, 2):
        key, chips = _e1_row(file, line, row)
        if key in codes:
            raise ValueError(f"E1 code table {file}, line {line}: {key[0]} PRN {key[1]} appears twice")
        codes[key] = chips
    for signal in ("E1B", "E1C"):
        for prn in prns_of(signal):
            if (signal, prn) not in codes:
                raise ValueError(f"E1 code table {file} is incomplete: {signal} PRN {prn} is missing")
    return codes


def _e1_row(file, line, row):
    """One row of the table -> key and chips; refuses what cannot be an E1 memory code."""
    where = f"E1 code table {file}, line {line}"
    signal, prn, digits = (row.get(k) or "" for k in ("signal", "prn", "hex"))
    if signal not in ("E1B", "E1C") or not (prn.isdecimal() and len(prn) < 3 and 1 <= int(prn) <= 50):
        raise ValueError(f"{where}: {signal[:8]!r} PRN {prn[:8]!r} is none of E1B, E1C with PRN 1-50")
    name = f"{signal} PRN {prn}"
    if len(digits) != _E1_CHIPS // 4:
        raise ValueError(f"{where}: {name} has {len(digits)} hex digits, {_E1_CHIPS // 4} are needed")
    try:
        packed = bytes.fromhex("0" + digits) if digits.isalnum() else None
    except ValueError:
        packed = None
    if packed is None:
        raise ValueError(f"{where}: {name} has a character that is not a hexadecimal digit")
    chips = (1 - 2 * np.unpackbits(np.frombuffer(packed, np.uint8))[4:].astype(np.int8)).astype(np.int8)
    check = int(_E1_CHECKS.split()[50 * (signal == "E1C") + int(prn) - 1], 16)
    if zlib.crc32(np.packbits(chips < 0).tobytes()) & 0xFFFF != check:
        raise ValueError(f"{where}: {name} is damaged, its chips are not those of the ICD (checksum)")
    chips.flags.writeable = False
    return (signal, int(prn)), chips
