"""Memory is constant in the length of the file."""

import os
import subprocess
import sys

import pytest

from sdr import iffile, scenario

FS_HZ = 4.0e6
SHORT_S, LONGER = 4.0, 4
SKY = f"""
name = "memory"
seed = 5
duration_s = {SHORT_S * LONGER}
[sky]
max_satellites = 4
[front_end]
fs_hz = {FS_HZ}
"""

pytestmark = pytest.mark.skipif(
    not hasattr(os, "wait4"), reason="the peak memory of a child is read with wait4"
)


def _peak_bytes(meta, duration_s, output):
    """Highest resident memory of a process that receives the first ``duration_s``."""
    command = [sys.executable, "-m", "sdr", "receive", str(meta), "--duration-s", f"{duration_s:g}"]
    child = subprocess.Popen([*command, "-o", str(output), "--json"], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    assert child.returncode == 0
    return usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def test_peak_memory_does_not_grow_with_the_file(tmp_path):
    """Four times the samples, 96 MB more of them, may add only what results wait for the next checkpoint.

    Those rows are queued, joined and written through the file's chunks: at most four times their bytes at once. What
    an allocator keeps in pieces is bounded by the arrays of a slab, of which four are alive: samples as read and as
    planes, and the outputs of two slabs.
    """
    spec = scenario.parse(SKY, "memory")
    source = scenario.source(spec)
    with iffile.create_recording(tmp_path / "sky", source, spec) as writer:
        while (iq := source.read(round(0.2 * FS_HZ))[1]).shape[1]:
            writer.write(iq)
    meta = next(p for p in writer.files if str(p).endswith(".sigmf-meta"))
    results = [tmp_path / "short.h5", tmp_path / "long.h5"]
    _peak_bytes(meta, 1.0, results[0])  # compiles
    short, long = (_peak_bytes(meta, SHORT_S * k, path) for k, path in zip((1, LONGER), results))
    rows = sum(_row_bytes(results[1]).values()) - sum(_row_bytes(results[0]).values())
    slab = 2 * 0.2 * FS_HZ
    samples = 2 * FS_HZ * SHORT_S * (LONGER - 1)
    allowed = 4 * rows + 4 * slab
    assert allowed < 0.5 * samples  # else the test could not fail
    assert long - short < allowed


def _row_bytes(path):
    """Bytes of every dataset before compression."""
    from sdr import store

    sizes: dict[str, int] = {}
    with store.read(path) as h5:
        h5.visititems(lambda name, item: sizes.update({name: item.nbytes} if hasattr(item, "nbytes") else {}))
    return sizes
