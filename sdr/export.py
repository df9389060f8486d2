"""A results file in the formats of others: RINEX observations, NMEA, KML, GPX, GNSS-SDR's tracking dump, CSV.

Every file appears whole or not at all: it is written beside itself and renamed.
"""

import csv
import math
import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sdr import store, version
from signals.constants import CHIP_RATE_HZ, CYCLES_PER_CHIP
from signals.geodesy import ecef_to_geodetic, ned_matrix
from signals.timescale import calendar, leap_seconds

CSV_ROWS = 16_384
KNOTS_PER_MPS = 3600.0 / 1852.0
SLOW_MPS = 0.1
"""Below this speed a course means nothing and is left empty."""
NMEA_SYSTEM = {"G": ("GP", 1), "E": ("GA", 3)}
"""Talker and system number (NMEA 0183 4.11)."""
KML = "http://www.opengis.net/kml/2.2"
KML_GX = "http://www.google.com/kml/ext/2.2"
GPX = "http://www.topografix.com/GPX/1/1"


@dataclass(frozen=True)
class Track:
    """Valid positions of a results file, with UTC."""

    rows: np.ndarray
    utc: list[datetime]
    lat_deg: np.ndarray
    lon_deg: np.ndarray
    height_m: np.ndarray
    """Above the WGS 84 ellipsoid: no geoid is applied."""
    vel_ned_mps: np.ndarray
    used: list[list[str]]
    """Names of the satellites of each position."""


def export(
    results: Path,
    *,
    rinex_obs: Path | None = None,
    nmea: Path | None = None,
    kml: Path | None = None,
    gpx: Path | None = None,
    mat: Path | None = None,
    csv_dir: Path | None = None,
) -> dict[str, Any]:
    """Write the files that are asked for; returns the JSON object of the ``export`` command.

    Raises ValueError with one sentence where the results lack what a format needs.
    """
    wanted = {"rinex_obs": rinex_obs, "nmea": nmea, "kml": kml, "gpx": gpx}
    if not any([*wanted.values(), mat, csv_dir]):
        raise ValueError(
            "nothing to export: give at least one of --rinex-obs, --nmea, --kml, --gpx, --mat, --csv"
        )
    files: list[Path] = []
    with store.read(results) as h5:
        if any(wanted.values()):
            track = read_track(h5, results)
            makers: dict[str, Callable[..., Iterable[str]]]
            makers = {"rinex_obs": _rinex, "nmea": nmea_lines, "kml": kml_lines, "gpx": gpx_lines}
            for name, path in wanted.items():
                if path is not None:
                    lines = makers[name](h5, track) if name == "rinex_obs" else makers[name](track)
                    files.append(write_text(path, lines, "\r\n" if name == "nmea" else "\n"))
        if mat is not None:
            files += write_mat(h5, results, mat)
        if csv_dir is not None:
            files += write_csv(h5, results, csv_dir)
    text = "\n".join(str(f) for f in files)
    return {"files": [str(f) for f in files], "text": text}


def write_text(path: Path, lines: Iterable[str], end: str = "\n") -> Path:
    """Write lines to ``path``, which is replaced only when all are written."""
    with _replacing(path) as part, part.open("w", encoding="utf-8", newline="") as f:
        f.writelines(line + end for line in lines)
    return Path(path)


class _replacing:
    """Context: a ``.part`` beside ``path`` that takes its place on success and vanishes on failure."""

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self.part = self.path.with_name(self.path.name + ".part")

    def __enter__(self) -> Path:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        return self.part

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            os.replace(self.part, self.path)
        else:
            self.part.unlink(missing_ok=True)


# -- positions ----------------------------------------------------------------------------------------------------------


def read_track(h5: h5py.File, results: Path) -> Track:
    """Valid positions of a results file; ValueError if it has none."""
    rows: np.ndarray = h5["navigation/solution"][:] if "navigation/solution" in h5 else np.empty(0)
    rows = rows[rows["valid"]] if len(rows) else rows
    if not len(rows):
        raise ValueError(
            f"'{results}' holds no position: RINEX, NMEA, KML and GPX need a run that reached a fix"
        )
    leap_s = h5["navigation/solution"].attrs.get("leap_s")
    gps = [calendar(int(r["week"]), float(r["tow_s"])) for r in rows]
    utc = [t - timedelta(seconds=int(leap_seconds(t) if leap_s is None else leap_s)) for t in gps]
    lat_rad, lon_rad, height_m = ecef_to_geodetic(rows["pos_ecef_m"])
    rotation = [ned_matrix(a, b) for a, b in zip(lat_rad, lon_rad)]
    vel = np.array([r @ v for r, v in zip(rotation, rows["vel_ecef_mps"])])
    return Track(rows, utc, np.degrees(lat_rad), np.degrees(lon_rad), height_m, vel, _used(h5, rows))


def _used(h5: h5py.File, rows: np.ndarray) -> list[list[str]]:
    names: dict[int, list[str]] = {int(n): [] for n in rows["sample_index"]}
    if "navigation/satellites" in h5:
        for s in h5["navigation/satellites"][:]:
            if s["used"] and int(s["sample_index"]) in names:
                names[int(s["sample_index"])].append(f"{s['system'].decode()}{int(s['prn']):02d}")
    return list(names.values())


def _rinex(h5: h5py.File, track: Track) -> Iterator[str]:
    from sdr.rinex_obs import lines

    if "navigation/observations" not in h5:
        raise ValueError("the results hold no pseudoranges: --rinex-obs needs navigation/observations")
    fs_hz = float(h5["navigation/solution"].attrs["fs_hz"])
    observations = h5["navigation/observations"][:]
    observations = observations[observations["sample_index"] >= track.rows["sample_index"][0]]
    return lines(observations, track.rows, fs_hz, f"gnss-baseband {version()}")


# -- NMEA 0183 ----------------------------------------------------------------------------------------------------------


def nmea_lines(track: Track) -> Iterator[str]:
    """GGA, RMC, GSA and VTG of every position (NMEA 0183 4.11).

    The altitude is the height above the ellipsoid and the geoid separation is given as 0, so that their sum is right.
    """
    systems = sorted({name[0] for used in track.used for name in used}) or ["G"]
    talker = NMEA_SYSTEM[systems[0]][0] if len(systems) == 1 else "GN"
    for k, (row, utc) in enumerate(zip(track.rows, track.utc)):
        utc += timedelta(microseconds=500)  # milliseconds are cut off below, so that they round
        clock = f"{utc:%H%M%S}.{utc.microsecond // 1000:03d}"
        place = f"{_degrees(track.lat_deg[k], 2, 'NS')},{_degrees(track.lon_deg[k], 3, 'EW')}"
        height = f"{track.height_m[k]:.2f},M,0.0,M"
        yield _checked(
            f"{talker}GGA,{clock},{place},1,{min(int(row['n_used']), 99):02d},{_dop(row['hdop'])},{height},,"
        )
        north_mps, east_mps, _ = track.vel_ned_mps[k]
        speed_mps = math.hypot(north_mps, east_mps)
        course = f"{math.degrees(math.atan2(east_mps, north_mps)) % 360:.1f}" if speed_mps > SLOW_MPS else ""
        knots = f"{speed_mps * KNOTS_PER_MPS:.2f}"
        yield _checked(f"{talker}RMC,{clock},A,{place},{knots},{course},{utc:%d%m%y},,,A,V")
        for system in [s for s in systems if any(n[0] == s for n in track.used[k])]:
            yield from _gsa(talker, system, [n for n in track.used[k] if n[0] == system], row)
        yield _checked(f"{talker}VTG,{course},T,,M,{knots},N,{speed_mps * 3.6:.2f},K,A")


def _gsa(talker: str, system: str, used: list[str], row: np.void) -> Iterator[str]:
    dops = ",".join(_dop(row[n]) for n in ("pdop", "hdop", "vdop"))
    for k in range(0, len(used), 12):
        ids = [f"{int(n[1:]):02d}" for n in used[k : k + 12]]
        ids += [""] * (12 - len(ids))
        yield _checked(f"{talker}GSA,A,3,{','.join(ids)},{dops},{NMEA_SYSTEM[system][1]}")


def _dop(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else "99.99"


def _degrees(angle_deg: float, width: int, letters: str) -> str:
    """Degrees and minutes with six decimals (2 mm), rounded before they are divided."""
    whole, micro = divmod(round(abs(angle_deg) * 60e6), 60_000_000)
    return f"{whole:0{width}d}{micro // 1_000_000:02d}.{micro % 1_000_000:06d},{letters[int(angle_deg < 0)]}"


def _checked(sentence: str) -> str:
    total = 0
    for byte in sentence.encode("ascii"):
        total ^= byte
    return f"${sentence}*{total:02X}"


# -- KML and GPX --------------------------------------------------------------------------------------------------------


def kml_lines(track: Track) -> Iterator[str]:
    """OGC KML 2.2: the mean position as a point, and a track with time. Heights are above the ellipsoid."""
    ET.register_namespace("", KML)
    ET.register_namespace("gx", KML_GX)
    root = ET.Element(f"{{{KML}}}kml")
    document = ET.SubElement(root, f"{{{KML}}}Document")
    point = ET.SubElement(_named(document, "mean position"), f"{{{KML}}}Point")
    _child(point, KML, "altitudeMode", "absolute")
    mean = [float(np.mean(v)) for v in (track.lon_deg, track.lat_deg, track.height_m)]
    _child(point, KML, "coordinates", "{:.9f},{:.9f},{:.4f}".format(*mean))
    path = ET.SubElement(_named(document, "positions"), f"{{{KML_GX}}}Track")
    _child(path, KML, "altitudeMode", "absolute")
    for utc in track.utc:
        _child(path, KML, "when", _iso(utc))
    for lat_deg, lon_deg, height_m in zip(track.lat_deg, track.lon_deg, track.height_m):
        _child(path, KML_GX, "coord", f"{lon_deg:.9f} {lat_deg:.9f} {height_m:.4f}")
    yield from _xml(root)


def gpx_lines(track: Track) -> Iterator[str]:
    """GPX 1.1: one track segment with time, satellites and dilutions. Elevations are above the ellipsoid."""
    ET.register_namespace("", GPX)
    root = ET.Element(f"{{{GPX}}}gpx", {"version": "1.1", "creator": "gnss-baseband"})
    segment = ET.SubElement(ET.SubElement(root, f"{{{GPX}}}trk"), f"{{{GPX}}}trkseg")
    for k, row in enumerate(track.rows):
        place = {"lat": f"{track.lat_deg[k]:.9f}", "lon": f"{track.lon_deg[k]:.9f}"}
        point = ET.SubElement(segment, f"{{{GPX}}}trkpt", place)
        _child(point, GPX, "ele", f"{track.height_m[k]:.4f}")
        _child(point, GPX, "time", _iso(track.utc[k]))
        _child(point, GPX, "sat", str(int(row["n_used"])))
        for name in ("hdop", "vdop", "pdop"):
            if np.isfinite(row[name]):
                _child(point, GPX, name, f"{row[name]:.3f}")
    yield from _xml(root)


def _named(document: ET.Element, name: str) -> ET.Element:
    placemark = ET.SubElement(document, f"{{{KML}}}Placemark")
    _child(placemark, KML, "name", name)
    return placemark


def _child(parent: ET.Element, space: str, tag: str, text: str) -> None:
    ET.SubElement(parent, f"{{{space}}}{tag}").text = text


def _iso(utc: datetime) -> str:
    return utc.isoformat(timespec="microseconds") + "Z"


def _xml(root: ET.Element) -> Iterator[str]:
    ET.indent(root)
    yield '<?xml version="1.0" encoding="UTF-8"?>'
    yield ET.tostring(root, encoding="unicode")


# -- GNSS-SDR's tracking dump -------------------------------------------------------------------------------------------


def write_mat(h5: h5py.File, results: Path, directory: Path) -> list[Path]:
    """One ``tracking_ch_N.mat`` per channel with the variables of GNSS-SDR's dump (row vectors, MATLAB 5 format).

    Beside them: ``corr`` (epochs, taps), ``taps_chips``, ``fs_hz`` and ``signal``. Raises ValueError without channels.
    """
    from scipy.io import savemat

    channels = [g for _, g in sorted(h5.get("tracking", {}).items()) if "corr" in g and len(g["epochs"])]
    if not channels:
        raise ValueError(f"'{results}' holds no tracked satellite: --mat needs tracking/*/epochs and corr")
    week = int(h5["navigation/solution"]["week"][0]) if "navigation/solution" in h5 else 0
    files = []
    for k, group in enumerate(channels):
        path = Path(directory) / f"tracking_ch_{k}.mat"
        with _replacing(path) as part:
            savemat(str(part), dump(group, week), appendmat=False, oned_as="row", do_compression=True)
        files.append(path)
    return files


def dump(group: h5py.Group, week: int) -> dict[str, Any]:
    """Variables of GNSS-SDR's tracking dump (dll_pll_veml_tracking.cc, documentation of 0.0.21) from one channel.

    Correlator outputs are sums over the integration, as there (ours are means); the accumulated phase grows with
    range, as there; ``carr_error_hz`` holds cycles and ``code_error_filt_chips`` chips per second, as there.
    """
    e, attrs = group["epochs"][:], group["epochs"].attrs
    corr, fs_hz = group["corr"][:] * e["n_samples"][:, None], float(attrs["fs_hz"])
    taps = {name: _magnitude(corr, group["corr"].attrs, role) for name, role in TAP_ROLES.items()}
    tow_ms = np.where(np.isfinite(e["tow_s"]), np.round(e["tow_s"] * 1e3), 0)
    return taps | {
        "Prompt_I": (e["prompt_i"] * e["n_samples"]).astype("f4"),
        "Prompt_Q": (e["prompt_q"] * e["n_samples"]).astype("f4"),
        "PRN_start_sample_count": e["sample_index"],
        "acc_carrier_phase_rad": -2 * np.pi * e["carrier_phase_cycles"],
        "carrier_doppler_hz": e["doppler_hz"],
        "carrier_doppler_rate_hz": e["doppler_rate_hz_s"],
        "code_freq_chips": e["code_rate_hz"],
        "code_freq_rate_chips": e["doppler_rate_hz_s"] / CYCLES_PER_CHIP,
        "carr_error_hz": e["phase_error_cycles"],
        "carr_error_filt_hz": e["doppler_hz"] - e["doppler_hz"][0],
        "code_error_chips": e["code_error_chips"],
        "code_error_filt_chips": e["code_rate_hz"] - CHIP_RATE_HZ - e["doppler_hz"] / CYCLES_PER_CHIP,
        "CN0_SNV_dB_Hz": e["cn0_dbhz"],
        "carrier_lock_test": e["carrier_lock"],
        "aux1": e["code_phase_chips"] / e["code_rate_hz"] * fs_hz,
        "aux2": e["sample_index"].astype("f8"),
        "PRN": np.full(len(e), attrs["prn"], "u4"),
        "TOW_ms": tow_ms.astype("u4"),
        "WN": np.full(len(e), week, "u4"),
        "corr": corr,
        "taps_chips": group["corr"].attrs["taps_chips"],
        "fs_hz": fs_hz,
        "signal": attrs["signal"],
    }


TAP_ROLES = {
    "abs_VE": "very_early",
    "abs_E": "early",
    "abs_P": "prompt",
    "abs_L": "late",
    "abs_VL": "very_late",
}


def _magnitude(corr: np.ndarray, attrs: h5py.AttributeManager, role: str) -> np.ndarray:
    if f"{role}_tap" not in attrs:
        if role in ("early", "prompt", "late"):
            raise ValueError(
                "the results do not say which taps are early and late: run again with this version"
            )
        return np.zeros(len(corr), "f4")
    return np.abs(corr[:, int(attrs[f"{role}_tap"])]).astype("f4")


# -- CSV ----------------------------------------------------------------------------------------------------------------


def write_csv(h5: h5py.File, results: Path, directory: Path) -> list[Path]:
    """One CSV per dataset, named after its path; columns ``name_k`` for arrays, ``_re`` and ``_im`` for complex."""
    names: list[str] = []
    h5.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
    if not names:
        raise ValueError(f"'{results}' holds no dataset: nothing was computed before it ended")
    files = []
    for name in names:
        path = Path(directory) / (re.sub(r"[^A-Za-z0-9.-]+", "_", name).lstrip(".") + ".csv")
        with _replacing(path) as part, part.open("w", encoding="utf-8", newline="") as f:
            writer = csv.writer(f)
            for k, (header, rows) in enumerate(_tables(h5[name])):
                if k == 0:
                    writer.writerow(header)
                writer.writerows(rows)
        files.append(path)
    return files


def _tables(data: h5py.Dataset) -> Iterator[tuple[list[str], Iterable[tuple]]]:
    """Blocks of a dataset as header and rows, so that memory does not grow with its length."""
    for begin in range(0, max(len(data), 1), CSV_ROWS):
        block = data[begin : begin + CSV_ROWS]
        fields = block.dtype.names or ("value",)
        columns: dict[str, np.ndarray] = {}
        for name in fields:
            columns |= _flat(name, block[name] if block.dtype.names else block)
        yield list(columns), zip(*(c.tolist() for c in columns.values()))


def _flat(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    if values.dtype.kind == "S":
        values = np.char.decode(values, "ascii", "replace")
    if values.dtype.kind == "c":
        return _flat(f"{name}_re", values.real) | _flat(f"{name}_im", values.imag)
    if values.ndim == 1:
        return {name: values}
    return {f"{name}_{'_'.join(map(str, i))}": values[:, *i] for i in np.ndindex(values.shape[1:])}
