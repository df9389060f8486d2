"""Results in self-describing HDF5 that is valid at every moment of a run.

Rows are buffered and appended at *checkpoints*: the file so far is copied beside itself, the rows are added to the
copy, and the copy takes the file's place in one atomic rename. A process killed at any instant therefore leaves the
last checkpoint, whole. Checkpoints are spaced so that copying stays a small part of the run.

Layout (schema 1): root attributes ``software version schema command scenario seed created_utc complete``;
structured datasets under ``/truth /acquisition /tracking /navigation /monitors`` whose attribute ``units`` is a JSON
object field -> unit.
"""

import contextlib
import json
import os
import shutil
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sdr import SCHEMA_VERSION, version

UNITS = {
    "_m2_s3": "m^2/s^3",
    "_dbw_hz": "dBW/Hz",
    "_deg_s": "deg/s",
    "_m2_s": "m^2/s",
    "_mps2": "m/s^2",
    "_mps3": "m/s^3",
    "_ns": "ns",
    "_mg": "mg",
    "_mrad": "mrad",
    "_m_s2": "m/s^2",
    "_s_s2": "s/s^2",
    "_s_s": "s/s",
    "_rad_s": "rad/s",
    "_hz_s": "Hz/s",
    "_dbhz": "dB-Hz",
    "_mps": "m/s",
    "_m2": "m^2",
    "_chips": "chip",
    "_cycles": "cycle",
    "_rad": "rad",
    "_deg": "deg",
    "_dbw": "dBW",
    "_db": "dB",
    "_hz": "Hz",
    "_ms": "ms",
    "_m": "m",
    "_s": "s",
}
"""Unit of a field from the suffix of its name, longest first."""


def unit_of(field: str) -> str:
    """Unit that a field's name states, or '1'."""
    return next((unit for suffix, unit in UNITS.items() if field.endswith(suffix)), "1")


class Store:
    """A results file being written. Use as a context manager; ``append`` rows, ``checkpoint`` now and then."""

    def __init__(self, path: Path | str, *, command: str, scenario: str, seed: int | None) -> None:
        self.path = Path(path)
        self._pending: dict[str, list[np.ndarray]] = {}
        self._attrs: dict[str, dict[str, Any]] = {}
        self._root = {
            "software": "gnss-baseband",
            "version": version(),
            "schema": SCHEMA_VERSION,
            "command": command,
            "scenario": scenario,
            "seed": -1 if seed is None else seed,
            "created_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        }
        self._last = time.monotonic()
        self._cost_s = 0.0
        self._started = False
        self.path.parent.mkdir(parents=True, exist_ok=True)

    def __enter__(self) -> "Store":
        self.checkpoint()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.checkpoint(complete=kind is None)

    def append(self, name: str, rows: np.ndarray, **attrs: Any) -> None:
        """Queue ``rows`` for dataset ``name``; ``attrs`` are set on the dataset when it is first written."""
        if len(rows):
            self._pending.setdefault(name, []).append(np.array(rows))
        if attrs:
            self._attrs.setdefault(name, {}).update(attrs)

    def due(self) -> bool:
        """Whether enough time has passed for a checkpoint to cost less than a twentieth of the run."""
        return time.monotonic() - self._last > max(5.0, 20.0 * self._cost_s)

    def checkpoint(self, complete: bool = False) -> None:
        """Write what is queued; the file on disk is replaced atomically."""
        begin = time.monotonic()
        part = self.path.with_name(self.path.name + ".part")
        try:
            if self._started:
                shutil.copyfile(self.path, part)
            with h5py.File(part, "r+" if self._started else "w") as h5:
                for key, value in self._root.items():
                    h5.attrs[key] = value
                h5.attrs["complete"] = complete
                for name, blocks in self._pending.items():
                    _extend(h5, name, _joined(blocks))
                for name, attrs in self._attrs.items():
                    if name in h5:
                        h5[name].attrs.update(attrs)
            os.replace(part, self.path)
        except OSError as err:
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
            kept = f"; '{self.path}' holds the results up to the last checkpoint" if self._started else ""
            raise OSError(f"results cannot be written to '{self.path}': {_reason(err)}{kept}") from None
        self._pending.clear()
        self._started = True
        self._last = time.monotonic()
        self._cost_s = self._last - begin


def _reason(err: OSError) -> str:
    return os.strerror(err.errno).lower() if err.errno else (str(err).splitlines() or ["unknown reason"])[0]


def _joined(blocks: list[np.ndarray]) -> np.ndarray:
    """All rows; records as opaque bytes, for numpy would compare their fields block by block."""
    kind = blocks[0].dtype
    if kind.names is None:
        return np.concatenate(blocks)
    return np.concatenate([b.view(f"V{kind.itemsize}") for b in blocks]).view(kind)


def _extend(h5: h5py.File, name: str, rows: np.ndarray) -> None:
    if name not in h5:
        chunk = max(1, min(len(rows), (1 << 18) // max(1, rows[:1].nbytes)))
        data = h5.create_dataset(
            name,
            data=rows,
            maxshape=(None, *rows.shape[1:]),
            chunks=(chunk, *rows.shape[1:]),
            shuffle=True,
            compression="lzf",
        )
        if rows.dtype.names:
            data.attrs["units"] = json.dumps({f: unit_of(f) for f in rows.dtype.names})
        return
    data = h5[name]
    n = len(data)
    data.resize(n + len(rows), axis=0)
    data[n:] = rows


def read(path: Path | str) -> h5py.File:
    """Open a results file for reading; ValueError with one sentence if it is not one of ours."""
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"results file '{path}' does not exist")
    try:
        h5 = h5py.File(path, "r")
    except OSError:
        raise ValueError(f"'{path}' is not an HDF5 file; give a results file written by gnssbb") from None
    if h5.attrs.get("software") != "gnss-baseband":
        h5.close()
        raise ValueError(
            f"'{path}' was not written by gnssbb; give a results file written by run, receive or campaign"
        )
    if int(h5.attrs["schema"]) > SCHEMA_VERSION:
        found = int(h5.attrs["schema"])
        h5.close()
        raise ValueError(
            f"'{path}' has schema {found}, this version reads up to {SCHEMA_VERSION}; update gnss-baseband"
        )
    return h5
