"""Scalar, vector and ultra-tight receivers side by side on the same samples, against the truth."""

import math
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from nav.records import STEERING
from nav.steering import Sensors
from sdr.receiver import Outcome, Receiver
from sdr.scenario import Scenario
from signals.constants import CHIP_RATE_HZ, F_L1_HZ
from signals.modulation import SIGNALS
from tracking.channel import STATE_LOCKED

RECOVERED_M = 10.0
"""A receiver has recovered when its 2D error stays below this."""
HALF_CHIP = 0.5
COLORS = {"scalar": "C3", "vector": "C1", "ultra_tight": "C0"}
PULL_IN_HZ = 25.0
"""A satellite is lost when its replica is off by more than half a chip or this."""

TRACK = np.dtype([("t_s", "f8"), ("error_2d_m", "f8"), ("error_speed_mps", "f8"), ("valid", "?")])
"""Position error of one receiver at the rate of its positions; where it has no valid one its last is held."""


class Tee:
    """One source for several receivers; samples are kept until the slowest has read them."""

    def __init__(self, source: Any, n: int) -> None:
        self.source = source
        self._kept: deque[tuple[int, np.ndarray]] = deque()
        self._end = 0
        self.views = [View(self) for _ in range(n)]

    def take(self, first: int, n: int) -> np.ndarray:
        """Samples first .. first + n - 1, or what there is of them."""
        while self._end < first + n:
            n0, iq = self.source.read(first + n - self._end)
            if iq.shape[1] == 0:
                break
            self._kept.append((n0, iq))
            self._end = n0 + iq.shape[1]
        stop = min(first + n, self._end)
        parts = [
            iq[:, max(first - n0, 0) : stop - n0]
            for n0, iq in self._kept
            if n0 < stop and n0 + iq.shape[1] > first
        ]
        return np.concatenate(parts, axis=1) if parts else self.source.read(0)[1]

    def forget(self) -> None:
        """Drop what every view has read."""
        oldest = min(v.position for v in self.views)
        while self._kept and self._kept[0][0] + self._kept[0][1].shape[1] <= oldest:
            self._kept.popleft()


class View:
    """A source that reads its own way through a Tee."""

    def __init__(self, tee: Tee) -> None:
        self._tee = tee
        self.position = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._tee.source, name)

    def read(self, n: int) -> tuple[int, np.ndarray]:
        """Next n samples."""
        n0 = self.position
        iq = self._tee.take(n0, n)
        self.position = n0 + iq.shape[1]
        self._tee.forget()
        return n0, iq


class SideBySide:
    """Receivers that differ in ``steering.mode`` alone; the last one named is the primary, whose results are stored whole."""

    def __init__(self, spec: Scenario, source: Any, sensors: Sensors | None) -> None:
        steering = spec.receiver.steering
        names = list(dict.fromkeys(steering.compare))
        tee = Tee(source, len(names))
        self.receivers: dict[str, Receiver] = {
            mode: Receiver(
                spec.receiver.model_copy(update={"steering": steering.with_mode(mode)}),
                view,
                sensors if mode == "ultra_tight" else None,
            )
            for mode, view in zip(names, tee.views)
        }
        self.primary_mode = names[-1]
        self.source, self.fs_hz = source, float(source.fs_hz)
        self._others = {m: iter(r) for m, r in self.receivers.items() if m != self.primary_mode}
        self.solutions: dict[str, list[np.ndarray]] = {m: [] for m in names}
        self.steering: dict[str, list[np.ndarray]] = {m: [] for m in names}
        stops = [j.stop_s for j in spec.jammer if j.stop_s is not None]
        starts = [j.start_s for j in spec.jammer]
        self.jam_s = (min(starts), min(max(stops), spec.duration_s)) if starts and stops else None
        self._tracked: dict[str, list[tuple[str, int]]] = {}
        self.lost: dict[str, int] = {}

    @property
    def primary(self) -> Receiver:
        """The receiver whose outcomes are stored."""
        return self.receivers[self.primary_mode]

    def follow(self, outcome: Outcome) -> None:
        """Note the primary's outcome and bring the others to the same sample."""
        self._note(self.primary_mode, outcome)
        for mode, run in self._others.items():
            while self.receivers[mode].position < outcome.n_end:
                other = next(run, None)
                if other is None:
                    break
                self._note(mode, other)

    def _note(self, mode: str, outcome: Outcome) -> None:
        self.solutions[mode] += outcome.solutions
        self.steering[mode] += outcome.steering
        if self.jam_s is None:
            return
        receiver = self.receivers[mode]
        start, stop = (round(t * self.fs_hz) for t in self.jam_s)
        if outcome.n0 < start <= outcome.n_end:
            self._tracked[mode] = [
                key
                for key, c in receiver.channel_of.items()
                if receiver.tracker.channels["state"][c] == STATE_LOCKED
            ]
        if outcome.n0 < stop <= outcome.n_end and mode in self._tracked:
            self.lost[mode] = self._count_lost(receiver, self._tracked[mode])

    def _count_lost(self, receiver: Receiver, tracked: list[tuple[str, int]]) -> int:
        """Satellites tracked when the jam began whose replica is not on the signal now."""
        sample = receiver.position
        replica = receiver.tracker.snapshot(sample)
        sky = self.source.sky
        true = sky.propagate(np.array([sample / self.fs_hz]))
        row = {(s.system, s.prn): i for i, s in enumerate(sky.satellites)}
        lost = 0
        for signal, prn in tracked:
            c = receiver.channel_of.get((signal, prn))
            if c is None or replica["state"][c] != STATE_LOCKED:
                lost += 1
                continue
            i = row[SIGNALS[signal].system, prn]
            length = SIGNALS[signal].code_length_chips
            chips = (sample / self.fs_hz - true.delay_s[i, 0]) * CHIP_RATE_HZ
            off = (replica["code_phase_chips"][c] - chips + length / 2) % length - length / 2
            df = replica["doppler_hz"][c] + F_L1_HZ * true.phase_delay_rate_s_s[i, 0]
            lost += bool(abs(off) > HALF_CHIP or abs(df) > PULL_IN_HZ)
        return lost

    # -- report ---------------------------------------------------------------------------------------------------

    def tracks(self) -> dict[str, np.ndarray]:
        """TRACK rows of every receiver, where the scalar one has positions, from the time on when all have had one for 5 s."""
        firsts = []
        for mode, rows in self.solutions.items():
            valid = [r for r in rows if r["valid"][0]]
            if not valid:
                return {}
            began = self.steering[mode][0]["t_s"][0] if self.steering[mode] else valid[0]["t_s"][0]
            firsts.append(max(float(valid[0]["t_s"][0]), float(began)))
        end_s = self.primary.position / self.fs_hz
        # In between, a position's velocity would count as wrong by how much it changed since.
        rate_hz = self.primary.spec.navigation.rate_hz
        t = np.arange(math.ceil(rate_hz * (max(firsts) + 5.0)), math.floor(rate_hz * end_s) + 1) / rate_hz
        return {mode: self._track(mode, t) for mode in self.solutions}

    def _track(self, mode: str, t: np.ndarray) -> np.ndarray:
        rows = np.concatenate(self.solutions[mode])
        rows = rows[rows["valid"]]
        at = np.clip(np.searchsorted(rows["t_s"], t + 1e-6, side="right") - 1, 0, None)
        true = self.source.sky.receiver(t)
        age = t - rows["t_s"][at]
        fresh = age < 1.5 / self.receivers[mode].spec.navigation.rate_hz
        # Between solutions the position runs on with its velocity; where there are none any more it is held.
        pos = rows["pos_ecef_m"][at] + np.where(fresh, age, 0.0)[:, None] * rows["vel_ecef_mps"][at]
        error = pos - true["pos_ecef_m"]
        up = true["pos_ecef_m"] / np.linalg.norm(true["pos_ecef_m"], axis=1, keepdims=True)
        level = error - up * np.sum(error * up, axis=1, keepdims=True)
        out = np.zeros(t.size, TRACK)
        out["t_s"], out["error_2d_m"] = t, np.linalg.norm(level, axis=1)
        out["error_speed_mps"] = np.linalg.norm(rows["vel_ecef_mps"][at] - true["vel_ecef_mps"], axis=1)
        out["valid"] = fresh
        return out

    def modes(self) -> dict[str, dict[str, float | int | None]]:
        """The comparison, one entry per receiver."""
        return {mode: self._numbers(mode, track) for mode, track in self.tracks().items()}

    def _numbers(self, mode: str, track: np.ndarray) -> dict[str, float | int | None]:
        e, t = track["error_2d_m"], track["t_s"]
        start, stop = self.jam_s or (math.inf, math.inf)
        jam = (t > start) & (t <= stop)
        rms = lambda x: float(np.sqrt(np.mean(x**2))) if x.size else None  # noqa: E731
        good = (e < RECOVERED_M) & track["valid"]
        after = np.flatnonzero((t > stop) & ~good)
        recovered: float | None = None
        if self.jam_s and good[-1] and t[-1] > stop:
            recovered = float(t[after[-1] + 1] - stop) if after.size else 0.0
        return {
            "rms_2d_m": rms(e), "max_2d_m": float(e.max()), "rms_jam_2d_m": rms(e[jam]),
            "rms_speed_mps": rms(track["error_speed_mps"]), "satellites_lost": self.lost.get(mode),
            "satellites": len(self._tracked.get(mode, ())) or None,
            "recovered_s": recovered, "valid_share": float(track["valid"].mean()),
        }  # fmt: skip

    def store(self, store: Any) -> None:
        """Append every receiver's solutions, steering and error to the results."""
        for mode, track in self.tracks().items():
            store.append(f"modes/{mode}/track", track, jam_s=np.array(self.jam_s or (-1.0, -1.0)))
            if self.steering[mode]:
                store.append(f"modes/{mode}/steering", np.concatenate(self.steering[mode]))
            store.append(f"modes/{mode}/solution", np.concatenate(self.solutions[mode]))


def table(modes: dict[str, dict[str, Any]]) -> list[str]:
    """The comparison as aligned text."""
    head = f"{'receiver':12} {'2D rms (m)':>11} {'max':>9} {'in jam':>9} {'speed (m/s)':>12} {'lost':>5} {'recovered (s)':>14}"
    rows = [head]
    for mode, m in modes.items():
        back = "no" if m["recovered_s"] is None else f"{m['recovered_s']:.1f}"
        jam = "-" if m["rms_jam_2d_m"] is None else f"{m['rms_jam_2d_m']:.2f}"
        lost = "-" if m["satellites_lost"] is None else str(m["satellites_lost"])
        rows.append(
            f"{mode:12} {m['rms_2d_m']:11.2f} {m['max_2d_m']:9.2f} {jam:>9} {m['rms_speed_mps']:12.3f} {lost:>5} {back:>14}"
        )
    return rows


def draw(results: Path, directory: Path | None = None) -> Path:
    """Position and speed error of the receivers against time, the jam shaded -> modes.png."""
    import h5py

    from sdr.figure import figure

    directory = directory or Path(results).with_suffix("")
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / "modes.png"
    with (
        h5py.File(results) as h5,
        figure(path, "Three receivers on the same samples", rows=3, size=(9, 8)) as axes,
    ):
        for mode, group in h5["modes"].items():
            track, color = group["track"][:], COLORS[mode]
            axes[0].semilogy(track["t_s"], np.maximum(track["error_2d_m"], 1e-3), color, lw=1.0, label=mode)
            axes[1].semilogy(track["t_s"], np.maximum(track["error_speed_mps"], 1e-4), color, lw=1.0)
            if "steering" in group:
                rows = group["steering"][:].astype(STEERING)
                axes[2].plot(rows["t_s"], rows["n_used"], color, lw=1.0, label=mode)
            start, stop = group["track"].attrs["jam_s"]
        for ax in axes:
            if start >= 0:
                ax.axvspan(start, stop, color="0.5", alpha=0.15)
        axes[0].set_ylabel("2D error (m)")
        axes[0].legend(fontsize=8)
        axes[1].set_ylabel("speed error (m/s)")
        axes[2].set(ylabel="satellites above 17 dB-Hz", xlabel="time (s)")
    return path
