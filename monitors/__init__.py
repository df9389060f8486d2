"""Statistics on correlator outputs and innovations, thresholds, and detection probabilities.

An interference monitor is one file: a frozen Spec, whose ``kind`` names it and whose ``start`` gives the Run, and the
line ``DETECTORS = (TheSpec,)``. Scenarios, campaigns and the reference pages find it by that line.
"""

import importlib
import pkgutil


def detectors() -> tuple[type, ...]:
    """Specs of all interference monitors: what the files of this package name in ``DETECTORS``."""
    names = sorted(m.name for m in pkgutil.iter_modules(__path__))
    files = [importlib.import_module(f"{__name__}.{name}") for name in names]
    return tuple(spec for file in files for spec in getattr(file, "DETECTORS", ()))
