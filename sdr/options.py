"""Options that several commands share."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

Json = Annotated[
    bool, Parameter(name="--json", negative="", help="Print one JSON object on stdout and nothing else.")
]
Out = Annotated[Path | None, Parameter(name=["--output", "-o"], help="Results file (HDF5).")]
Set = Annotated[
    list[str],
    Parameter(
        name="--set",
        negative="",
        help="Override a scenario key, e.g. --set receiver.tracking.l1ca.dll_bw_hz=1",
    ),
]
Threads = Annotated[int, Parameter(help="Worker threads; the results do not depend on it.")]


@Parameter(name="*")
@dataclass(frozen=True)
class Recording:
    """How a file of IF samples is to be read; what SigMF or .tag metadata say needs no option."""

    format: Annotated[
        str | None,
        Parameter(help="ci8 ci16 cf32 ri8 ri16 rf32 ci1 ci2 ri1 ri2, or a receiver's own name for it."),
    ] = None
    fs_hz: Annotated[float | None, Parameter(help="Sample rate in Hz.")] = None
    if_hz: Annotated[float | None, Parameter(help="Intermediate frequency in Hz.")] = None
    conjugate: Annotated[
        bool, Parameter(negative="", help="The spectrum is inverted: conjugate the samples.")
    ] = False
    skip_s: Annotated[float, Parameter(help="Leave out the first seconds.")] = 0.0
    duration_s: Annotated[float | None, Parameter(help="Use this many seconds.")] = None
