"""RINEX navigation files: read (2, 3 and 4, GPS and Galileo I/NAV, by georinex) and written (3.04).

georinex 1.16 takes the fields apart. Around it: it pads a (time, satellite) grid with NaN and files repeated
epochs under invented names ('E24_1'), it refuses rows whose blank fields are cut off, and it keeps no time
corrections. So the text is bounded and completed before, and the grid is taken apart after.
"""

import gzip
import io
import re
import warnings
from datetime import datetime
from pathlib import Path

import numpy as np

from signals.constants import SECONDS_PER_WEEK
from signals.orbits import default_iono_utc
from signals.records import EPHEMERIS, IONO_UTC
from signals.timescale import calendar, week_tow

MAX_FILE_BYTES = 32 << 20
MAX_RECORDS = 30_000
_MAX_GRID_BYTES = 64 << 20
_MAX_AGE_S = {"G": 7_200.0, "E": 10_800.0}
_ZERO = " 0.000000000000E+00"

URA_M = (2.0, 2.8, 4.0, 5.7, 8.0, 11.3, 16.0, 32.0, 64.0, 128.0, 256.0, 512.0, 1024.0, 2048.0, 4096.0, 8192.0)
"""Nominal accuracy of the GPS URA indices 0..15 (IS-GPS-200, 20.3.3.3.1.3)."""
URA_LIMIT_M = (
    2.4,
    3.4,
    4.85,
    6.85,
    9.65,
    13.65,
    24.0,
    48.0,
    96.0,
    192.0,
    384.0,
    768.0,
    1536.0,
    3072.0,
    6144.0,
)
"""Upper limits of the indices 0..14; files hold either these or the nominal values."""
SISA_M = np.concatenate(
    [np.arange(50) * 0.01, 0.5 + np.arange(25) * 0.02, 1.0 + np.arange(25) * 0.04, 2.0 + np.arange(26) * 0.16]
)
"""Accuracy of the Galileo SISA indices 0..125 (Galileo OS SIS ICD, table on SISA)."""

_FIELDS = {
    "SVclockBias": "af0_s",
    "SVclockDrift": "af1_s_s",
    "SVclockDriftRate": "af2_s_s2",
    "Crs": "crs_m",
    "DeltaN": "delta_n_rad_s",
    "M0": "m0_rad",
    "Cuc": "cuc_rad",
    "Eccentricity": "e",
    "Cus": "cus_rad",
    "sqrtA": "sqrt_a_sqrt_m",
    "Toe": "toe_s",
    "Cic": "cic_rad",
    "Omega0": "omega0_rad",
    "Cis": "cis_rad",
    "Io": "i0_rad",
    "Crc": "crc_m",
    "omega": "omega_rad",
    "OmegaDot": "omega_dot_rad_s",
    "IDOT": "idot_rad_s",
}


def read_rinex_nav(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Ephemerides and ionosphere/UTC parameters of a RINEX 2, 3 or 4 navigation file, plain or gzip.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    EPHEMERIS (n,)
        GPS LNAV and Galileo I/NAV records (data source bit 0 or 2; F/NAV left out: its clock and group delay
        are for E5a), sorted by system, PRN, toe, transmission time; identical copies once. Values as written:
        call `signals.orbits.check_ephemeris` on what is used.
    IONO_UTC ()
        From the header (RINEX 4: from the last ION and STO records), moved to tot = t0g = 0 and message resolution;
        what is lacking is the default.

    Raises
    ------
    ValueError
        Missing, too large, not RINEX navigation, malformed, or without a GPS or Galileo record.
    ModuleNotFoundError
        georinex is not installed; the message names the extra.

    Notes
    -----
    RINEX 3.04, tables A5, A6, A8; RINEX 2.11, tables A3, A4; RINEX 4.00, 5.4 (records of other systems and of CNAV
    and F/NAV are skipped). Comments and headers in the middle, as in files put together, are skipped too.
    """
    version, kind, header, records = _split(path, _read_text(path))
    ephemerides = _flatten(_georinex(path, version, kind, records))
    if ephemerides.size == 0:
        raise ValueError(
            f"RINEX file {path} holds no GPS or Galileo I/NAV ephemeris: give a navigation file with one"
        )
    return ephemerides, _iono_utc(path, header, ephemerides[-1])


def select(ephemerides: np.ndarray, system: str, prn: int, week: int, tow_s: float) -> np.ndarray | None:
    """The record of a satellite to use at (week, tow_s), shape (), or None where none is valid.

    The latest with toe at or before that time; else the nearest after it. Valid for 2 h (GPS) or 3 h
    (Galileo) from toe. Of several with one toe, the last transmitted.
    """
    mine = ephemerides[(ephemerides["system"] == system.encode()) & (ephemerides["prn"] == prn)]
    age = (week - mine["week"]) * float(SECONDS_PER_WEEK) + tow_s - mine["toe_s"]
    valid = np.abs(age) <= _MAX_AGE_S[system]
    mine, age = mine[valid], age[valid]
    if mine.size == 0:
        return None
    sent = np.mod(mine["tow_s"] - mine["toe_s"] + SECONDS_PER_WEEK // 2, SECONDS_PER_WEEK)
    best = np.lexsort((-sent, np.abs(age), age < 0.0))[0]
    return mine[best].reshape(())


def accuracy_index(system: str, metres: float) -> int:
    """Message index of an accuracy: the smallest that covers it; 15 (GPS), 255 (Galileo) if none."""
    table = URA_LIMIT_M if system == "G" else SISA_M
    none = 15 if system == "G" else 255
    fits = np.flatnonzero(np.asarray(table) >= metres - 1e-6)
    return int(fits[0]) if fits.size and metres >= 0.0 else none


def accuracy_m(system: str, index: int) -> float:
    """Accuracy in m of a message index; the RINEX value -1 for a Galileo index without prediction."""
    if system == "G":
        return URA_M[min(max(index, 0), 15)]
    return float(SISA_M[index]) if 0 <= index < SISA_M.size else -1.0


# --- reading ------------------------------------------------------------------------------------------------


def _read_text(path) -> list[str]:
    file = Path(path)
    if not file.is_file():
        raise ValueError(f"RINEX file {path} does not exist")
    try:
        with file.open("rb") as raw:
            packed = raw.read(2) == b"\x1f\x8b"
        with gzip.open(file, "rb") if packed else file.open("rb") as stream:
            data = stream.read(MAX_FILE_BYTES + 1)
    except (OSError, EOFError) as err:
        raise ValueError(f"RINEX file {path} cannot be read: {err}") from None
    if len(data) > MAX_FILE_BYTES:
        raise ValueError(
            f"RINEX file {path} holds more than {MAX_FILE_BYTES >> 20} MiB of text: give one day"
        )
    return data.decode("ascii", errors="replace").splitlines()


def _split(path, lines: list[str]) -> tuple[int, str, list[str], list[list[str]]]:
    """Version, type letter, header lines, and records of GPS and Galileo as their eight lines."""
    first = lines[0].ljust(80) if lines else ""
    if "RINEX VERSION" not in first or not re.fullmatch(r"\s*[234](\.\d+)?\s*", first[:9]):
        raise ValueError(
            f"file {path} is not RINEX 2, 3 or 4: its first line must state the version in columns 1-9"
        )
    version = int(float(first[:9]))
    kind = first[20]
    if kind not in ("NE" if version == 2 else "N"):
        raise ValueError(f"RINEX file {path} is of type {kind!r}: GPS or Galileo navigation data are needed")
    end = next((i for i, line in enumerate(lines) if "END OF HEADER" in line), None)
    if end is None:
        raise ValueError(f"RINEX file {path} has no END OF HEADER: it is damaged or cut off")
    epoch = re.compile(r"[GE][ \d]\d \d{4}" if version > 2 else r"[ \d]\d [ \d]\d ")
    other = re.compile(r"[A-Z][ \d]\d \d{4}" if version > 2 else r"[ \d]\d [ \d]\d ")
    # A letter in column 61 begins the label of a header's line.
    header, body = lines[:end], [line for line in lines[end + 1 :] if not line[60:61].isalpha()]
    if version == 4:
        version, corrections, body = 3, *_as_rinex_3(path, body)
        header = header + corrections
    starts = [i for i, line in enumerate(body) if other.match(line)]
    records = [body[a:b] for a, b in zip(starts, [*starts[1:], len(body)]) if epoch.match(body[a])]
    records = [[line for line in record if line.strip()] for record in records]
    if len(records) > MAX_RECORDS:
        raise ValueError(
            f"RINEX file {path} holds {len(records)} records, more than {MAX_RECORDS}: give one day"
        )
    for record in records:
        if len(record) != 8:
            raise ValueError(
                f"RINEX file {path}: the record {record[0][:23]!r} has {len(record)} lines instead of 8"
            )
    return version, kind, header, records


def _as_rinex_3(path, body: list[str]) -> tuple[list[str], list[str]]:
    """Lines of a RINEX 4 body as RINEX 3 has them: corrections for the header, and records of LNAV and I/NAV."""
    corrections, records = [], []
    starts = [i for i, line in enumerate(body) if line.startswith(">")]
    for a, b in zip(starts, [*starts[1:], len(body)]):
        words = body[a].split()
        kind, message = words[1:2], words[3:4]
        if kind == ["EPH"] and message in (["LNAV"], ["INAV"]) and words[2][0] in "GE":
            records += body[a + 1 : b]
        elif kind in (["ION"], ["STO"]):
            try:
                corrections += _correction_lines(kind[0], words[2][0] + "".join(message), body[a + 1 : b])
            except (ValueError, IndexError, OverflowError):
                raise ValueError(f"RINEX file {path}: the record {body[a].strip()!r} is malformed") from None
    return corrections, records


def _correction_lines(kind: str, source: str, lines: list[str]) -> list[str]:
    """Header lines of RINEX 3 that say what an ION or STO record of RINEX 4 says; none for those of no use here."""
    numbers = [_fields(lines[0], 23), *(_fields(line, 4) for line in lines[1:])]
    if kind == "ION" and source == "GLNAV":
        values = [x for row in numbers for x in row][:8]
        rows = [("GPSA", values[:4]), ("GPSB", values[4:])]
    elif kind == "ION" and source == "EIFNV":
        rows = [("GAL ", [*numbers[0], 0.0][:4])]
    elif kind == "STO" and lines[0][24:28] in ("GPUT", "GAGP", "GPGA"):
        week, tow_s = week_tow(datetime(*(int(x) for x in lines[0][4:23].split())))  # type: ignore[arg-type]
        a0, a1 = numbers[1][1:3]
        text = f"{lines[0][24:28]} {a0:17.10E}{a1:16.9E}{int(tow_s):7d}{week:5d}"
        return [text.ljust(60) + "TIME SYSTEM CORR"]
    else:
        return []
    return [
        (f"{key} " + "".join(f"{x:12.4E}" for x in row)).ljust(60) + "IONOSPHERIC CORR" for key, row in rows
    ]


def _fields(line: str, start: int) -> list[float]:
    """Numbers of 19 columns each from ``start`` on."""
    cells = [line[i : i + 19].strip() for i in range(start, len(line.rstrip()), 19)]
    return [float(re.sub("[Dd]", "E", cell)) for cell in cells if re.fullmatch(r"[-+.\dEeDd]+", cell)]


def _georinex(path, version: int, kind: str, records: list[list[str]]):
    """xarray dataset of the records, which are completed by zeros where trailing fields were left blank."""
    try:
        import georinex
    except ModuleNotFoundError as err:
        if err.name != "georinex":
            raise
        raise ModuleNotFoundError(
            "reading RINEX needs georinex: install the extra with  pip install 'gnss-baseband[rinex]'",
            name="georinex",
        ) from None
    _check_grid(path, version, records)
    last = {}
    for number, record in enumerate(records):
        # georinex drops a RINEX 2 satellite that repeats an epoch; RINEX 3 repeats (I/NAV, F/NAV) it files.
        last[(record[0][:22] if version == 2 else number)] = record
    text = [f"{version:6d}.00".ljust(20) + kind.ljust(20) + "M".ljust(20) + "RINEX VERSION / TYPE"]
    text.append(" " * 60 + "END OF HEADER")
    for record in last.values():
        text += _complete(path, record, 4 if version == 3 else 3)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)
            return georinex.rinexnav(io.StringIO("\n".join(text) + "\n"))
    except Exception as err:  # a parser of strangers' text: whatever it raises is this file's fault
        raise ValueError(f"RINEX file {path} is malformed: {err}") from None


def _check_grid(path, version: int, records: list[list[str]]) -> None:
    """Refuse a file for which georinex would need more than _MAX_GRID_BYTES."""
    heads = [record[0][:23] for record in records]
    times = len({head[3:] for head in heads})
    copies = max(np.unique(heads, return_counts=True)[1], default=1)
    size = times * len({head[:3] for head in heads}) * int(copies) * 40 * 8
    if size > _MAX_GRID_BYTES:
        raise ValueError(
            f"RINEX file {path} spreads over too many epochs and satellites: give one day of data"
        )


def _complete(path, record: list[str], indent: int) -> list[str]:
    """The eight lines with every blank field of 19 columns written as zero, and D exponents as E.

    A field that is no number is refused here: georinex would drop its record without a word.
    """
    out = []
    for row, line in enumerate(record):
        start = indent if row else indent + 19
        cells = [line[start + 19 * i : start + 19 * (i + 1)] for i in range(4 if row else 3)]
        cells = [re.sub("[Dde]", "E", cell).rjust(19) if cell.strip() else _ZERO for cell in cells]
        for cell in cells:
            if not re.fullmatch(r"\s*[-+]?\d*\.?\d+\.?(E[-+]?\d{1,3})?\s*", cell):
                raise ValueError(
                    f"RINEX file {path}: record {record[0][:23]!r} holds {cell!r}, which is no number"
                )
        out.append(line[:start].ljust(start) + "".join(cells))
    return out


def _flatten(nav) -> np.ndarray:
    """EPHEMERIS records of every filled cell of georinex's grid."""
    rows = []
    times = nav["time"].values.astype("datetime64[ns]").astype(np.int64)
    columns = {name: nav[name].transpose("time", "sv").values for name in nav.data_vars}
    for j, name in enumerate(nav["sv"].values):
        system, prn = str(name)[0], int(str(name)[1:3])
        for i in np.flatnonzero(~np.isnan(columns["sqrtA"][:, j])):
            cell = {key: float(values[i, j]) for key, values in columns.items()}
            if system == "G" or (system == "E" and int(cell.get("DataSrc") or 0) & 0b101):
                rows.append(_record(system, prn, int(times[i]), cell))
    out = np.array(rows, dtype=EPHEMERIS)
    return np.unique(out[np.lexsort((out["tow_s"], out["toe_s"], out["week"], out["prn"], out["system"]))])


def _record(system: str, prn: int, toc_ns: int, cell: dict[str, float]) -> np.ndarray:
    eph = np.zeros((), EPHEMERIS)
    eph["system"], eph["prn"] = system.encode(), prn
    for source, field in _FIELDS.items():
        eph[field] = cell[source]
    toc = datetime(1970, 1, 1) + np.timedelta64(toc_ns // 1000, "us").astype(object)
    toc_week, eph["toc_s"] = week_tow(toc.replace(microsecond=0))
    # Files number weeks in several ways; the date of toc does not.
    eph["week"] = toc_week + round((float(eph["toc_s"]) - cell["Toe"]) / SECONDS_PER_WEEK)
    sent = cell.get("TransTime", np.nan)
    eph["tow_s"] = sent % SECONDS_PER_WEEK if abs(sent) < 2 * SECONDS_PER_WEEK else cell["Toe"]
    if system == "G":
        eph["iode"], eph["iodc"], eph["tgd_s"] = cell["IODE"], cell["IODC"], cell["TGD"]
        eph["health"], eph["accuracy_index"] = cell["health"], accuracy_index("G", cell["SVacc"])
        # Hours in the standard (0 = unknown), the flag itself in some files.
        eph["fit_interval"] = cell["FitIntvl"] == 1.0 or cell["FitIntvl"] > 4.0
        return eph
    eph["iode"] = eph["iodc"] = cell["IODnav"]
    eph["tgd_s"], eph["bgd_e5a_s"] = cell["BGDe5b"], cell["BGDe5a"]
    # RINEX: bit 0 E1-B DVS, bits 1-2 E1-B HS, the others belong to E5.
    eph["health"], eph["accuracy_index"] = int(cell["health"]) & 0b111, accuracy_index("E", cell["SISA"])
    return eph


def _iono_utc(path, header: list[str], eph: np.ndarray) -> np.ndarray:
    out = default_iono_utc(int(eph["week"]), int(eph["toe_s"]))
    try:
        for line in header:
            line = line.ljust(80)
            _header_line(out, line[:60], line[60:].strip())
    except (ValueError, OverflowError):
        raise ValueError(f"RINEX file {path}: the header line {line.strip()!r} is malformed") from None
    if not all(np.all(np.isfinite(out[f])) for f in IONO_UTC.names or ()):
        raise ValueError(f"RINEX file {path}: an ionosphere or time correction of the header is not finite")
    return out


def _numbers(text: str, width: int, count: int) -> list[float]:
    return [float(text[width * i : width * (i + 1)].replace("D", "E")) for i in range(count)]


def _header_line(out: np.ndarray, text: str, label: str) -> None:
    """Take one header line over into the IONO_UTC record."""
    key = text[:4].strip()
    if label == "ION ALPHA" or (label == "IONOSPHERIC CORR" and key == "GPSA"):
        start = 5 if key == "GPSA" else 2
        out["alpha"] = _rounded(_numbers(text[start:], 12, 4), (2.0**-30, 2.0**-27, 2.0**-24, 2.0**-24))
    elif label == "ION BETA" or (label == "IONOSPHERIC CORR" and key == "GPSB"):
        start = 5 if key == "GPSB" else 2
        out["beta"] = _rounded(_numbers(text[start:], 12, 4), (2.0**11, 2.0**14, 2.0**16, 2.0**16))
    elif label == "IONOSPHERIC CORR" and key == "GAL":
        out["ai"] = _rounded(_numbers(text[5:], 12, 3), (2.0**-2, 2.0**-8, 2.0**-15))
    elif label == "TIME SYSTEM CORR" and key in ("GPUT", "GAGP", "GPGA"):
        a0, a1 = float(text[5:22].replace("D", "E")), float(text[22:38].replace("D", "E"))
        t0, week = int(text[38:45]), int(text[45:50])
        names = ("a0_utc_s", "a1_utc_s_s", "week_t") if key == "GPUT" else ("a0g_s", "a1g_s_s", "week_0g")
        lsb = (2.0**-30, 2.0**-50) if key == "GPUT" else (2.0**-35, 2.0**-51)
        # Same line, reference moved to the start of its week (see `default_iono_utc`).
        out[names[0]], out[names[1]] = _rounded((a0 - a1 * t0, a1), lsb)
        out[names[2]] = week if week > 0 else out[names[2]]
    elif label == "LEAP SECONDS":
        values = [int(text[6 * i : 6 * (i + 1)]) for i in range(4) if text[6 * i : 6 * (i + 1)].strip()]
        out["dt_ls_s"] = values[0]
        if len(values) == 4:
            out["dt_lsf_s"], out["week_lsf"], out["dn"] = values[1:]
        elif len(values) < 4:
            out["dt_lsf_s"] = values[0]


def _rounded(values, lsb) -> np.ndarray:
    lsb = np.asarray(lsb)
    return np.rint(np.asarray(values) / lsb) * lsb


# --- writing ------------------------------------------------------------------------------------------------


def write_rinex_nav(path: str | Path, ephemerides: np.ndarray, iono_utc: np.ndarray) -> None:
    """Write EPHEMERIS records and an IONO_UTC record as RINEX 3.04 navigation data (tables A5, A6, A8)."""
    lines = _header(ephemerides, iono_utc)
    for eph in np.atleast_1d(ephemerides):
        lines += _gps_lines(eph) if eph["system"] == b"G" else _galileo_lines(eph)
    Path(path).write_text("\n".join(lines) + "\n", encoding="ascii")


def _header(ephemerides: np.ndarray, iono: np.ndarray) -> list[str]:
    systems = {bytes(s) for s in np.atleast_1d(ephemerides)["system"]}
    letter = {frozenset({b"G"}): "G: GPS", frozenset({b"E"}): "E: GALILEO"}.get(
        frozenset(systems), "M: MIXED"
    )
    body = [
        (f"{'3.04':>9}{'':11}{'NAVIGATION DATA':20}{letter:20}", "RINEX VERSION / TYPE"),
        (f"{'gnss-baseband':20}{'':20}{'':20}", "PGM / RUN BY / DATE"),
        ("GPSA " + "".join(f"{x:12.4E}" for x in iono["alpha"]), "IONOSPHERIC CORR"),
        ("GPSB " + "".join(f"{x:12.4E}" for x in iono["beta"]), "IONOSPHERIC CORR"),
        ("GAL  " + "".join(f"{x:12.4E}" for x in (*iono["ai"], 0.0)), "IONOSPHERIC CORR"),
        (_correction("GPUT", iono, "a0_utc_s", "a1_utc_s_s", "tot_s", "week_t"), "TIME SYSTEM CORR"),
        (_correction("GAUT", iono, "a0_utc_s", "a1_utc_s_s", "tot_s", "week_t"), "TIME SYSTEM CORR"),
        (_correction("GAGP", iono, "a0g_s", "a1g_s_s", "t0g_s", "week_0g"), "TIME SYSTEM CORR"),
        (
            "".join(f"{int(iono[f]):6d}" for f in ("dt_ls_s", "dt_lsf_s", "week_lsf", "dn")),
            "LEAP SECONDS",
        ),
        ("", "END OF HEADER"),
    ]
    return [f"{text:60}{label}" for text, label in body]


def _correction(key: str, iono: np.ndarray, a0: str, a1: str, t0: str, week: str) -> str:
    return f"{key} {float(iono[a0]):17.10E}{float(iono[a1]):16.9E}{int(iono[t0]):7d}{int(iono[week]):5d}"


def _cells(*values) -> str:
    """Fields of 19 columns, None left blank; the format has two digits of exponent."""
    return "".join(
        " " * 19 if x is None else f"{0.0 if abs(float(x)) < 1e-99 else float(x):19.12E}" for x in values
    )


def _orbit_lines(eph: np.ndarray) -> list[str]:
    """Epoch line and broadcast orbits 1 to 4, which both systems share."""
    toe_abs = int(eph["week"]) * SECONDS_PER_WEEK + float(eph["toe_s"])
    to_toc = (
        np.mod(float(eph["toc_s"]) - toe_abs + SECONDS_PER_WEEK // 2, SECONDS_PER_WEEK)
        - SECONDS_PER_WEEK // 2
    )
    toc = calendar(0, toe_abs + to_toc)
    name = f"{bytes(eph['system']).decode()}{int(eph['prn']):02d}"
    return [
        f"{name} {toc:%Y %m %d %H %M %S}" + _cells(eph["af0_s"], eph["af1_s_s"], eph["af2_s_s2"]),
        "    " + _cells(eph["iode"], eph["crs_m"], eph["delta_n_rad_s"], eph["m0_rad"]),
        "    " + _cells(eph["cuc_rad"], eph["e"], eph["cus_rad"], eph["sqrt_a_sqrt_m"]),
        "    " + _cells(eph["toe_s"], eph["cic_rad"], eph["omega0_rad"], eph["cis_rad"]),
        "    " + _cells(eph["i0_rad"], eph["crc_m"], eph["omega_rad"], eph["omega_dot_rad_s"]),
    ]


def _gps_lines(eph: np.ndarray) -> list[str]:
    return [
        *_orbit_lines(eph),
        "    " + _cells(eph["idot_rad_s"], 1, eph["week"], 0),
        "    "
        + _cells(accuracy_m("G", int(eph["accuracy_index"])), eph["health"], eph["tgd_s"], eph["iodc"]),
        "    " + _cells(eph["tow_s"], 6 if eph["fit_interval"] else 4),
    ]


def _galileo_lines(eph: np.ndarray) -> list[str]:
    # 517 = I/NAV from E1-B and E5b-I, clock for (E5b, E1) (bits 0, 2, 9).
    return [
        *_orbit_lines(eph),
        "    " + _cells(eph["idot_rad_s"], 517, eph["week"]),
        "    "
        + _cells(accuracy_m("E", int(eph["accuracy_index"])), eph["health"], eph["bgd_e5a_s"], eph["tgd_s"]),
        "    " + _cells(eph["tow_s"]),
    ]
