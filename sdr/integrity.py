"""Measurement-integrity monitors on the live receiver: sections ``[receiver.integrity]`` and ``[receiver.respond]``.

After every navigation epoch each monitor reads what was left of it (``sdr.watched``): by the navigator, or by the filter that
steers the channels. What may act on the next epoch is a matter of ``[receiver.respond]``; without that section nothing goes
back and the receiver's bits are those without monitors. A monitor that cannot work says why in one sentence and the receiver
goes on.

| monitor | statistic | threshold | reads |
|---|---|---|---|
| innovation | r_i^2 / S_ii of each range | chi-square, 1 degree | filter |
| raim | parity chi-square over its quantile; the suspect has the largest w-test | 1 | ranges |
| bias_bank | probability of the best bias that fits | ``declare`` | ranges |
| als | sigma estimated over sigma claimed | 1 + z_p / sqrt(2 N_d) | filter |
| noise_rmd | the same, from differences of successive code discriminators | 1 + z_p / sqrt(2 N_R) | channels |
| parallel_filters | windowed chi-square of the satellite left out | ``threshold`` | filter |
"""

from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from monitors.als import Als
from monitors.bias_bank import BiasBank
from monitors.noise_rmd import DiscriminatorNoise, NoiseRmd
from monitors.parallel_filters import ParallelFilters
from monitors.protection import Protection
from nav.navigator import Navigator, Snapshot
from nav.navlog import Remedy
from nav.steering import Steering
from sdr.filter_monitors import P_NOISE, FilterMonitors, noise_limit
from sdr.findings import Alarms, found
from sdr.range_monitors import MEMORY, RangeMonitors
from sdr.respond import RespondSpec, rows_of
from sdr.watched import NavigatorWatch, SteeringWatch, Watched

MONITORS = ("innovation", "raim", "bias_bank", "als", "noise_rmd", "parallel_filters")
LEVELS = "protection"
"""It raises no alarm, but says why there is no level."""
_FROZEN = ConfigDict(frozen=True, extra="forbid")


class ChiSquare(BaseModel):
    """A chi-square test at a false-alarm probability per test."""

    model_config = _FROZEN
    p_false_alarm: float = Field(1e-6, gt=0, lt=0.5)
    """False-alarm probability of one test."""


class Limits(Protection):
    """Protection levels and the alert limits they are compared with (APV-I by default: 40 m, 50 m)."""

    kind: Literal["protection"] = "protection"
    hal_m: float = Field(40.0, gt=0)
    """Horizontal alert limit."""
    val_m: float = Field(50.0, gt=0)
    """Vertical alert limit."""
    every_s: float = Field(1.0, ge=0)
    """Levels are computed at the first position this long after the last."""


class IntegritySpec(BaseModel):
    """Section ``[receiver.integrity]``; a monitor whose section is left out is off but for the first two tests."""

    model_config = _FROZEN
    innovation: ChiSquare | None = ChiSquare()
    raim: ChiSquare | None = ChiSquare()
    bias_bank: BiasBank | None = None
    als: Als | None = None
    noise_rmd: NoiseRmd | None = None
    parallel_filters: ParallelFilters | None = None
    bank_every: int = Field(1, ge=1, le=10_000)
    """Filter epochs that make one epoch of the parallel filters."""
    protection: Limits | None = None
    gap_s: float = Field(1.0, ge=0)
    """Exceedances closer than this are one alarm."""

    def start(self, respond: RespondSpec, fs_hz: float) -> "IntegrityLive":
        """-> IntegrityLive."""
        return IntegrityLive(self, respond, fs_hz)


class IntegrityLive:
    """Run of an IntegritySpec: call it after every navigation epoch; ``remedy`` is what holds for the next one."""

    def __init__(self, spec: IntegritySpec, respond: RespondSpec, fs_hz: float) -> None:
        self.spec, self.fs_hz = spec, fs_hz
        self.alarms = {n: Alarms(spec.gap_s) for n in (*MONITORS, LEVELS) if getattr(spec, n) is not None}
        self.remedy: Remedy | None = None
        self.response = respond.start()
        self.steered: SteeringWatch | None = None
        self._navigator: NavigatorWatch | None = None
        self._ranges = RangeMonitors(spec, self.response, self.alarms)
        self._noise = None if spec.noise_rmd is None else DiscriminatorNoise(spec.noise_rmd, fs_hz)
        self._filter: tuple[Watched, FilterMonitors] | None = None

    # -- what is watched ----------------------------------------------------------------------------------------------

    def watch(self, navigator: Navigator, steering: Steering | None = None) -> None:
        """Watch a navigator, whose filter is logged from now on, where it has one, and who may steer."""
        self._navigator = NavigatorWatch(navigator, max(self._log_epochs(), MEMORY))
        if steering is not None:
            steering.log_length = max(self._log_epochs(), steering.log_length)

    def gather(self, steering: Steering) -> None:
        """A steering filter finished an epoch; while there is one, it is watched and not the navigator."""
        if steering.filter is None:
            self.steered = None
            return
        if self.steered is None or self.steered.filter is not steering.filter:
            self.steered = SteeringWatch(steering, max(self._log_epochs(), MEMORY))
        self.steered.hear()

    def _log_epochs(self) -> int:
        return 0 if self.spec.als is None else self.spec.als.window_epochs + self.spec.als.settle_epochs

    def hear(
        self, channels: dict[tuple[str, int], int], epochs: np.ndarray, counts: np.ndarray, loops
    ) -> None:
        """New integrations of all channels, see ``DiscriminatorNoise.hear``."""
        if self._noise is not None:
            self._noise.hear(channels, epochs, counts, loops)

    # -- one epoch ----------------------------------------------------------------------------------------------------

    def __call__(self, sample: int) -> dict[str, np.ndarray]:
        """Rows by dataset name of the epoch at ``sample``; sets ``remedy`` for the next."""
        t_s = sample / self.fs_hz
        out: dict[str, np.ndarray] = {}
        watch = self.steered or self._navigator
        assert watch is not None
        if not watch.look(sample):
            return out
        snap = watch.snapshot
        if snap is None:
            self._ranges.lack(watch.reason)
        else:
            self._ranges(snap, sample, t_s, out)
        filter_monitors = self._monitors_of(watch)
        dx, p = filter_monitors(watch, sample, t_s, out)
        self._name_rivals(out.get("parallel_filters"), t_s)
        self._noise_rows(watch, snap, sample, t_s, out)
        for name in MONITORS:
            if name in out:
                self.alarms[name].add(out[name])
        removal = self._ranges.remove(watch.log, dx is not None)
        if removal.dx is not None:
            filter_monitors.moved(removal.dx)
            dx = removal.dx if dx is None else dx + removal.dx
        extra = removal.extra
        if removal.ended:
            p, extra = (watch.p if p is None else p) + extra, None
        remedy = self.response.answer(snap, t_s, dx, p, extra)
        self.remedy = None if remedy is None else watch.hand(remedy)
        if remedy is not None and len(remedy.rows):
            out["response"] = rows_of(remedy, sample, t_s)
        return out

    def _monitors_of(self, watch: Watched) -> FilterMonitors:
        """The filter monitors of what is watched; another filter has another history."""
        if self._filter is None or self._filter[0] is not watch:
            self._filter = watch, FilterMonitors(self.spec, self.response, self.alarms, watch.slots)
        return self._filter[1]

    def _name_rivals(self, rows: np.ndarray | None, t_s: float) -> None:
        """Beside whom the parallel filters accuse, those that the ranges do not tell from it; left out with it where that may be."""
        if rows is None:
            return
        for i in np.flatnonzero(rows["value"] >= rows["threshold"]):
            name = f"{rows['system'][i].decode()}{rows['prn'][i]:02d}"
            rivals = self._ranges.rivals(name)
            rows["rivals"][i] = " ".join(rivals).encode()
            if "parallel_filters" in self.response.spec.exclude and self._ranges.spare([name, *rivals], t_s):
                self.response.accuse(rivals, t_s)

    def _noise_rows(self, watch: Watched, snap: Snapshot | None, sample: int, t_s: float, out) -> None:
        """Noise by redundant measurements, which is that of one integration; a normal point is the mean of several."""
        if self._noise is None or self.spec.noise_rmd is None:
            return
        known = self._noise.estimate(self.steered is not None)
        if not known or snap is None:
            self.alarms["noise_rmd"].lack("no channel has filled its window of differences yet")
            return
        names, own = snap.names, snap.own_m2
        if not all(n in known for n in names):
            own = own[[n in known for n in names]]
            names = [n for n in names if n in known]
        var = np.array([known[n] for n in names]) / watch.fresh
        sigma, now = np.sqrt(var), self.response.variance(names, own)
        if names:
            limit = noise_limit(self.spec.noise_rmd.window)
            out["noise_rmd"] = found(names, sample, t_s, np.sqrt(var / now), limit, sigma)
        if self.response.spec.noise == "noise_rmd":
            self.response.scale = {n: v / o for n, v, o in zip(names, var, own) if v > 0}

    def report(self) -> list[dict[str, Any]]:
        """One row per monitor and satellite that it tested, for JSON; of protection levels one where some were infinite."""
        p_fa = {
            "innovation": self.spec.innovation.p_false_alarm if self.spec.innovation else None,
            "raim": self.spec.raim.p_false_alarm if self.spec.raim else None,
            "als": P_NOISE,
            "noise_rmd": P_NOISE,
        }
        said = [(n, a) for n, a in self.alarms.items() if n != LEVELS or a.unavailable_epochs]
        return [row for name, alarms in said for row in alarms.report(name, p_fa.get(name))]
