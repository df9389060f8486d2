"""What a campaign keeps: a results file, and a journal that survives being killed at any moment.

Finished trials are appended to ``OUT.journal`` at once, each chunk framed with its length and checksum; what a
killed process left torn at the end is cut off. Trials in flight are computed again with the same seeds, and a
trial that is known already is never counted twice. When the campaign is complete its results are in ``OUT``
(HDF5) and the journal is gone.
"""

import contextlib
import io
import json
import os
import struct
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sdr import store, version
from sdr.campaign.spec import THRESHOLD, TRIAL, Campaign
from sdr.campaign.tally import PointCount, advantages, mask, summarise

_MAGIC = b"gnssbb campaign journal 1\n"
_FRAME = struct.Struct("<cQI")
_MAX_FRAME = 1 << 30

RATE = np.dtype(
    [
        ("point", "i4"),
        ("monitor", "S16"),
        ("k", "i8"),
        ("n", "i8"),
        ("rate", "f8"),
        ("ci_low", "f8"),
        ("ci_high", "f8"),
        ("n_effective", "f8"),
        ("trials", "i8"),
        ("threshold", "f8"),
        ("stop_reason", "S16"),
    ]
)
"""Summary of one point and monitor."""

ADVANTAGE = np.dtype(
    [
        ("axes", "S200"),  # JSON of the other axes
        ("monitor", "S16"),
        ("against", "S16"),
        ("p_md", "f8"),
        ("power_db", "f8"),  # where P_MD is p_md, in the unit of the power axis (dBW or J/S)
        ("power_low_db", "f8"),
        ("power_high_db", "f8"),
        ("gain_db", "f8"),  # how much less power than "against" needs
        ("gain_low_db", "f8"),
        ("gain_high_db", "f8"),
    ]
)
"""Jammer power that one monitor needs for one P_MD, and its advantage over the first monitor; NaN: not crossed."""


MASK = np.dtype(
    [
        ("bandwidth_hz", "f8"),  # 0: a tone
        ("monitor", "S16"),
        ("worst_offset_hz", "f8"),  # of the grid's offsets
        ("worst_line_hz", "f8"),  # the code line that the tone was put on there
        ("worst_line_db", "f8"),  # its level, power of the code = 1
        ("mask_dbw", "f8"),  # what the mask tolerates
        ("loss_1db_dbw", "f8"),  # least power that costs 1 dB of C/N0
        ("loss_of_lock_dbw", "f8"),
        ("detected_dbw", "f8"),  # least power with P_MD below 1/2
    ]
)
"""Mask scan: the worst lobe at each bandwidth and the least powers of the grid there; NaN: none."""


class Results:
    """Counts of a campaign, its journal and its results file. Use as a context manager."""

    def __init__(self, campaign: Campaign, path: Path) -> None:
        self.campaign, self.path = campaign, path
        self.journal_path = path.with_name(path.name + ".journal")
        self.counts = [PointCount(campaign, i) for i in range(len(campaign.points))]
        self.thresholds = np.zeros(0, THRESHOLD)
        self.resumed = 0
        self.complete = False
        self._journal: Any = None
        self._last, self._cost_s = time.monotonic(), 0.0

    def __enter__(self) -> "Results":
        self._read_results()
        if self.complete:
            return self
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._journal = open(self.journal_path, "a+b")
        self._lock()
        try:
            self._read_journal()
        except ValueError:
            self._journal.close()
            raise
        self.resumed = sum(c.kept for c in self.counts)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._journal is None:
            return
        if kind is not None:
            with contextlib.suppress(OSError):
                self.write()
        self._journal.close()
        if kind is None and self.complete:
            self.journal_path.unlink(missing_ok=True)

    def _lock(self) -> None:
        try:
            import fcntl
        except ImportError:
            return
        try:
            fcntl.flock(self._journal, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._journal.close()
            raise ValueError(
                f"another campaign is writing '{self.path}' now; wait for it or give another -o"
            ) from None

    def _read_results(self) -> None:
        if not self.path.exists():
            return
        with store.read(self.path) as h5:
            if "campaign/points" not in h5:
                raise ValueError(
                    f"'{self.path}' holds other results, not a campaign; give another -o or delete it"
                )
            self._check_origin(dict(h5["campaign/points"].attrs), self.path)
            self.thresholds = h5["campaign/thresholds"][:] if "campaign/thresholds" in h5 else self.thresholds
            if "campaign/trials" in h5:
                self._add(h5["campaign/trials"][:])
            self.complete = bool(h5.attrs["complete"])

    def _check_origin(self, head: dict[str, Any], path: Path) -> None:
        if head.get("fingerprint") != self.campaign.fingerprint:
            raise ValueError(
                f"'{path}' holds another campaign ('{head.get('campaign')}'): its settings differ; give another -o, "
                "or delete it to start anew"
            )
        if head.get("version") != version():
            raise ValueError(
                f"'{path}' was begun by version {head.get('version')}, this is {version()}: trials of two versions are "
                "not mixed; give another -o, or delete it to start anew"
            )

    def head(self) -> dict[str, str]:
        """What identifies a results file."""
        return {
            "fingerprint": self.campaign.fingerprint, "version": version(), "campaign": self.campaign.spec.name,
        }  # fmt: skip

    def _read_journal(self) -> None:
        """Take in every whole frame; cut off what a kill left torn."""
        f = self._journal
        f.seek(0, os.SEEK_END)
        size = f.tell()
        f.seek(0)
        if size and f.read(len(_MAGIC)) != _MAGIC[:size]:
            raise ValueError(f"'{self.journal_path}' is not a campaign journal; give another -o or delete it")
        if size < len(_MAGIC):
            f.truncate(0)
            f.write(_MAGIC)
            self._append(b"H", json.dumps(self.head()).encode())
            return
        good = f.tell()
        for kind, payload in _frames(f, size):
            self._take(kind, payload)
            good = f.tell()
        f.truncate(good)
        if good == len(_MAGIC):
            self._append(b"H", json.dumps(self.head()).encode())

    def _take(self, kind: bytes, payload: bytes) -> None:
        if kind == b"H":
            self._check_origin(json.loads(payload), self.journal_path)
            return
        array = np.load(io.BytesIO(payload), allow_pickle=False)
        if kind == b"T" and array.dtype == THRESHOLD:
            new = array[~np.isin(array["group"], self.thresholds["group"])]
            self.thresholds = np.concatenate([self.thresholds, new])
        elif kind == b"R" and array.dtype == TRIAL:
            self._add(array)
        else:
            raise ValueError(
                f"'{self.journal_path}' has a record this version does not know; delete it to start anew"
            )

    def _append(self, kind: bytes, payload: bytes) -> None:
        try:
            self._journal.seek(0, os.SEEK_END)
            self._journal.write(_FRAME.pack(kind, len(payload), zlib.crc32(payload)) + payload)
            self._journal.flush()
        except OSError as err:
            raise OSError(
                f"'{self.journal_path}' cannot be written: {err.strerror}; what it holds stays"
            ) from None

    def _append_array(self, kind: bytes, array: np.ndarray) -> None:
        buffer = io.BytesIO()
        np.save(buffer, array, allow_pickle=False)
        self._append(kind, buffer.getvalue())

    def keep_thresholds(self, rows: np.ndarray) -> None:
        """Thresholds of one group, once and for all."""
        self._append_array(b"T", rows)
        self.thresholds = np.concatenate([self.thresholds, rows])

    def keep(self, rows: np.ndarray) -> None:
        """TRIAL rows of a chunk: journal first, then count."""
        self._append_array(b"R", rows)
        self._add(rows)
        if time.monotonic() - self._last > max(5.0, 20.0 * self._cost_s):
            self.write()

    def _add(self, rows: np.ndarray) -> None:
        m = len(self.campaign.spec.monitor)
        for trial in rows.reshape(-1, m):
            index = int(trial["point"][0])
            if not 0 <= index < len(self.counts):
                raise ValueError(
                    f"'{self.path}' has trials of point {index}, which this campaign does not have"
                )
            self.counts[index].add(trial)

    def write(self, complete: bool = False) -> None:
        """Write the results file anew; it is replaced atomically."""
        begin = time.monotonic()
        out = store.Store(self.path, command="campaign", scenario=self.campaign.text, seed=None)
        points = np.array(
            [(c.index, c.done, (c.reason or "").encode()) for c in self.counts],
            [("point", "i4"), ("trials", "i8"), ("stop_reason", "S16")],
        )
        axes = json.dumps(self.campaign.settings[:2000], default=str)
        out.append("campaign/points", points, **self.head(), axes=axes)
        # In the order of the groups, not in that of their completion.
        out.append("campaign/thresholds", np.sort(self.thresholds, order=["group", "monitor"]))
        rows = [r for c in self.counts for r in c.rows]
        out.append("campaign/trials", np.concatenate(rows) if rows else np.zeros(0, TRIAL))
        rates = self.rows()
        table = np.array(
            [tuple(r[f] if r[f] is not None else np.nan for f in RATE.names or ()) for r in _for_hdf5(rates)],
            RATE,
        )
        out.append("campaign/rates", table)
        out.append("campaign/advantages", np.array([_advantage(r) for r in self.advantages()], ADVANTAGE))
        out.append("campaign/mask", np.array([_mask_row(r) for r in mask(self.campaign, rates)], MASK))
        out.checkpoint(complete=complete)
        self.complete = complete
        self._last = time.monotonic()
        self._cost_s = self._last - begin

    def rows(self) -> list[dict[str, Any]]:
        """Summary rows of the points that have trials."""
        return summarise(self.campaign, self.counts, self.thresholds)

    def advantages(self) -> list[dict[str, Any]]:
        """Comparison of the monitors in dB of jammer power."""
        return advantages(self.campaign, self.counts)

    def summary(self) -> dict[str, Any]:
        """The command's JSON object."""
        spec = self.campaign.spec
        trials = sum(c.done for c in self.counts)
        rows = self.rows()
        return {
            "name": spec.name,
            "output": str(self.path),
            "complete": self.complete,
            "trials": trials,
            "resumed_trials": self.resumed,
            "epochs": sum(c.done * self.campaign.length(c.index).epochs for c in self.counts),
            "p_fa": spec.p_fa_test,
            "points": rows,
            "advantages": self.advantages(),
            "mask": mask(self.campaign, rows),
        }


def _for_hdf5(rows: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    for r in rows:
        yield r | {"monitor": r["monitor"].encode(), "stop_reason": (r["stop_reason"] or "").encode()}


def _mask_row(r: dict[str, Any]) -> tuple:
    values = (np.nan if r[n] is None else r[n] for n in MASK.names or ())
    return tuple(v.encode() if isinstance(v, str) else v for v in values)


def _advantage(r: dict[str, Any]) -> tuple:
    pairs = (r["power_db"], *r["power_ci_db"]), (r["gain_db"], *r["gain_ci_db"])
    numbers = [np.nan if v is None else v for pair in pairs for v in pair]
    return json.dumps(r["axes"], default=str)[:200].encode(), r["monitor"].encode(), r["against"].encode(), r["p_md"], *numbers  # fmt: skip


def _frames(f: Any, size: int) -> Iterator[tuple[bytes, bytes]]:
    """Whole, sound frames; stops at the first that is not."""
    while True:
        head = f.read(_FRAME.size)
        if len(head) < _FRAME.size:
            return
        kind, length, crc = _FRAME.unpack(head)
        if length > min(_MAX_FRAME, size - f.tell()):
            return
        payload = f.read(length)
        if zlib.crc32(payload) != crc:
            return
        yield kind, payload


def read(path: Path | str) -> h5py.File:
    """Open a campaign's results for reading."""
    h5 = store.read(path)
    if "campaign/points" not in h5:
        h5.close()
        raise ValueError(f"'{path}' holds no campaign; give a results file written by gnssbb campaign")
    return h5
