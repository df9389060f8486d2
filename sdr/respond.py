"""What the integrity monitors may do: section ``[receiver.respond]``, and the answer that holds for the next epoch."""

from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from nav.navigator import Snapshot
from nav.navlog import REMEDY, Remedy
from sdr.findings import split

RESPONSE = np.dtype(
    [
        ("sample_index", "u8"),
        ("t_s", "f8"),
        ("system", "S1"),
        ("prn", "i4"),
        ("variance_m2", "f8"),
        ("bias_m", "f8"),
        ("exclude", "?"),
        ("weaken", "f8"),
    ]
)
"""What was asked of the next epoch, one row per satellite that anything was asked of."""


NOBODY = np.zeros(0, REMEDY)


class RespondSpec(BaseModel):
    """Section ``[receiver.respond]``: which monitor may act, and how. Everything is off by default.

    ``noise``: range variances from this estimator; ``bias``: an identified bias is subtracted; ``exclude``: satellites that
    these monitors accuse are left out until ``hold_s`` after the last accusation (parallel filters: until re-certified);
    ``reset``: the filter takes the state and covariance of the parallel filter that never saw the fault; ``fallback``:
    when faults of one constellation are too many to name, navigate by the other for ``hold_s``; ``weaken``: an alarm of an
    interference monitor (``[[receiver.monitor]]``) raises the variances of the channel that it watches, until ``hold_s`` after.
    All of it acts on the position and on a filter that steers the channels alike.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    noise: Literal["als", "noise_rmd"] | None = None
    """Range variances come from this estimator."""
    bias: bool = False
    """Take an offset that was identified off its range and off the filter's state, and add its uncertainty to the claim."""
    exclude: tuple[Literal["innovation", "raim", "parallel_filters"], ...] = ()
    """Leave out satellites that these monitors accuse."""
    reset: bool = False
    """Take the state of the parallel filter that never saw the fault."""
    fallback: bool = False
    """Navigate by the other constellation when too many of one are faulty."""
    weaken: tuple[str, ...] = ()
    """Interference monitors, by name, whose alarms make a satellite weigh less."""
    weaken_by: float = Field(100.0, gt=1, le=1e6)
    """Factor on its variances."""
    hold_s: float = Field(10.0, gt=0, le=3600)
    """How long an action outlasts its cause."""

    @property
    def off(self) -> bool:
        """Whether nothing may act."""
        return not (self.noise or self.bias or self.exclude or self.reset or self.fallback)

    @model_validator(mode="after")
    def _twice(self):
        for key in ("exclude", "weaken"):
            if len(set(getattr(self, key))) != len(getattr(self, key)):
                raise ValueError(f"{key} names one monitor twice; write each once")
        return self

    def check(self, on: object | None, smoothing_s: float = 0.0) -> None:
        """ValueError when an answer is wanted of a monitor that is not on (``on``: the IntegritySpec), or of smoothed ranges."""
        wanted = [self.noise, "bias_bank" if self.bias else None, "parallel_filters" if self.reset else None]
        wanted += [*self.exclude, "raim" if self.fallback else None]
        for name in wanted:
            if name is not None and (on is None or getattr(on, name) is None):
                raise ValueError(
                    f"receiver.respond wants an answer of '{name}', which is off: add [receiver.integrity.{name}]"
                )
        if not self.off and smoothing_s > 0:
            raise ValueError(
                f"receiver.respond wants answers from ranges that are smoothed over {smoothing_s:g} s, in which a fault of now is "
                "mixed with the time before it: set receiver.navigation.smoothing_s = 0"
            )

    def start(self) -> "Response":
        """-> Response."""
        return Response(self)


class Response:
    """What the monitors have found out so far, as far as it may act; ``answer`` is what holds for the next epoch.

    ``scale``: variances over the receiver's own, by name; ``shift``: biases (m); ``failed``: satellites that the parallel
    filters hold for failed; ``accuse`` leaves satellites out for ``hold_s``, ``keep`` to one constellation.
    """

    def __init__(self, spec: RespondSpec) -> None:
        self.spec = spec
        self.scale: dict[str, float] = {}
        self.shift: dict[str, float] = {}
        self.failed: set[str] = set()
        self._until: dict[str, float] = {}
        self._only: tuple[str, float] = ("", 0.0)

    def accuse(self, names, t_s: float) -> None:
        """Leave these satellites out from now on."""
        for name in names:
            self._until[name] = t_s + self.spec.hold_s

    def keep(self, system: str, t_s: float) -> None:
        """Navigate by one constellation."""
        self._only = system, t_s + self.spec.hold_s

    def out(self, t_s: float) -> set[str]:
        """Satellites left out now."""
        return {n for n, until in self._until.items() if until > t_s} | self.failed

    def variance(self, names, own_m2: np.ndarray) -> np.ndarray:
        """Variances in force, from the receiver's own."""
        return own_m2 * np.array([self.scale.get(n, 1.0) for n in names]) if self.scale else own_m2

    def shifts(self, names) -> np.ndarray:
        """Biases taken off the ranges of ``names``, m."""
        return np.array([self.shift.get(n, 0.0) for n in names]) if self.shift else np.zeros(len(names))

    def answer(self, snap: Snapshot | None, t_s: float, dx, p, extra=None) -> Remedy | None:
        """The remedy of the next epoch; None while nothing may act."""
        if self.spec.off:
            return None
        if not (self.scale or self.shift or self.failed or self._until or self._only[0]):
            return Remedy(NOBODY, dx, p, extra)
        out = self.out(t_s)
        own = {} if snap is None else dict(zip(snap.names, snap.own_m2))
        names = (set(self.scale) & set(own)) | set(self.shift) | out
        system, until = self._only
        if system and until > t_s:
            others = {n for n in own if n[0] != system}
            # Falling back names the constellation, no longer single satellites of the one that is kept.
            out = {n for n in out if n[0] != system} | others
            names |= others
        rows = np.zeros(len(names), REMEDY)
        for row, name in zip(rows, sorted(names)):
            row["system"], row["prn"] = split(name)
            row["variance_m2"] = (
                self.scale[name] * own[name] if name in self.scale and name in own else np.nan
            )
            row["bias_m"], row["exclude"] = self.shift.get(name, 0.0), name in out
        return Remedy(rows, dx, p, extra)


def rows_of(remedy: Remedy, sample: int, t_s: float) -> np.ndarray:
    """RESPONSE rows of a remedy."""
    rows = np.zeros(len(remedy.rows), RESPONSE)
    for name in REMEDY.names or ():
        rows[name] = remedy.rows[name]
    rows["sample_index"], rows["t_s"] = sample, t_s
    return rows
