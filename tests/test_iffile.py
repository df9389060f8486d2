"""Recordings: formats, metadata, hostile files."""

import json
import os
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sdr.iffile import (
    ALIASES,
    FORMATS,
    Declaration,
    RecordingWriter,
    declaration,
    open_recording,
    sample_format,
)
from signals.constants import F_L1_HZ

SHARED = Path(__file__).resolve().parents[2] / "shared"
FS_HZ = 4e6
WRITTEN = [f for f in FORMATS if "u8" not in f]


def options(**given):
    empty = {
        "format": None,
        "fs_hz": None,
        "if_hz": None,
        "conjugate": False,
        "skip_s": 0.0,
        "duration_s": None,
    }
    return SimpleNamespace(**(empty | given))


def samples(name, n=10_007, seed=1):
    """Random samples that the format can hold, planar."""
    fmt, rng = FORMATS[name], np.random.default_rng(seed)
    if fmt.levels:
        iq = rng.choice(np.array(fmt.levels, np.int8), (2, n))
    elif fmt.dtype == "<f4":
        iq = rng.standard_normal((2, n)).astype(np.float32)
    else:
        iq = rng.integers(-127, 128, (2, n)).astype(fmt.dtype)
    if not fmt.complex:
        iq[1] = 0
    return iq


def write_raw(path, values):
    path.write_bytes(np.asarray(values).tobytes())
    return path


def read_all(source, step):
    parts, at = [], 0
    while True:
        n0, iq = source.read(step)
        assert n0 == at
        if iq.shape[1] == 0:
            return np.concatenate(parts, axis=1)
        assert iq.flags.c_contiguous
        at += iq.shape[1]
        parts.append(iq)


@pytest.mark.parametrize("name", WRITTEN)
@pytest.mark.parametrize("step", [313, 10_007])
def test_round_trip(tmp_path, name, step):
    iq = samples(name)
    if_hz = 0.0 if FORMATS[name].complex else 1.0e6
    with RecordingWriter(tmp_path / "a", name, FS_HZ, if_hz) as writer:
        for at in range(0, iq.shape[1], 1000):
            writer.write(iq[:, at : at + 1000])
    source = open_recording(writer.data, declaration(writer.data))
    back = read_all(source, step)
    assert (source.fs_hz, source.if_hz, source.format.name) == (FS_HZ, if_hz, name)
    assert back.shape[1] == writer.n_samples == source.n_samples
    assert iq.shape[1] - back.shape[1] <= 7
    np.testing.assert_array_equal(back, iq[:, : back.shape[1]])
    assert not list(tmp_path.glob("*.part"))


def test_read_does_not_depend_on_chunk_or_skip(tmp_path):
    for name in ("ri2", "ci1", "ci16"):
        iq = samples(name, 50_000)
        with RecordingWriter(tmp_path / name, name, FS_HZ, 0.0 if name[0] == "c" else 1e6) as writer:
            writer.write(iq)
        declared = declaration(writer.data, options(skip_s=777 / FS_HZ, duration_s=1234 / FS_HZ))
        source = open_recording(writer.data, declared)
        assert source.n_samples == 1234
        np.testing.assert_array_equal(read_all(source, 100), iq[:, 777 : 777 + 1234])


def test_more_than_one_chunk(tmp_path):
    iq = samples("ci8", 1_300_000)
    path = write_raw(tmp_path / "a.bin", iq.T)
    source = open_recording(path, Declaration(path, "ci8", FS_HZ))
    np.testing.assert_array_equal(source.read(10**9)[1], iq)


@pytest.mark.parametrize("name", ["ci8", "ci16", "cf32", "ci2", "raw8"])
def test_conjugate_flips_q(tmp_path, name):
    iq = samples(name, 4000)
    with RecordingWriter(tmp_path / "a", name, FS_HZ) as writer:
        writer.write(iq)
    declared = declaration(writer.data)
    flipped = open_recording(writer.data, replace(declared, conjugate=not declared.conjugate)).read(4000)[1]
    np.testing.assert_array_equal(flipped, iq * np.array([[1], [-1]], iq.dtype))


def test_conjugate_of_the_lowest_integer(tmp_path):
    path = write_raw(tmp_path / "a.bin", np.array([5, -128, -128, 7], np.int8))
    iq = open_recording(path, Declaration(path, "ci8", FS_HZ, conjugate=True)).read(2)[1]
    np.testing.assert_array_equal(iq, [[5, -128], [127, -7]])


def test_inverted_real_samples_are_the_mirror_frequency(tmp_path):
    path = write_raw(tmp_path / "a.bin", np.arange(100, dtype=np.int8))
    source = open_recording(path, Declaration(path, "ri8", FS_HZ, 1e6, conjugate=True))
    assert source.if_hz == -1e6 and not source.complex
    np.testing.assert_array_equal(source.read(100)[1], [np.arange(100), np.zeros(100)])


def test_packed_order_is_that_of_other_receivers(tmp_path):
    """Least significant bits first; PocketSDR's sign and magnitude, GNSS-SDR's 2 x + 1 of a signed two-bit field."""
    byte = 0b11_10_01_00  # codes 0, 1, 2, 3 in time
    path = write_raw(tmp_path / "a.bin", np.array([byte], np.uint8))
    wanted = {
        "ri2": [[1, 3, -1, -3], [0, 0, 0, 0]],
        "ri2tc": [[1, 3, -3, -1], [0, 0, 0, 0]],
        "ci2": [[1, -1], [3, -3]],
        "ci2tc": [[1, -3], [3, -1]],
        "ri1": [[1, 1, -1, 1, 1, -1, -1, -1], [0] * 8],
        "ci1": [[1, -1, 1, -1], [1, 1, -1, -1]],
        "raw8": [[1], [3]],
    }
    for name, levels in wanted.items():
        iq = open_recording(
            path, Declaration(path, name, FS_HZ, None if FORMATS[name].complex else 1e6)
        ).read(8)[1]
        np.testing.assert_array_equal(iq, levels, err_msg=name)


def test_unsigned_is_offset_binary(tmp_path):
    path = write_raw(tmp_path / "a.bin", np.array([0, 255, 128, 127], np.uint8))
    iq = open_recording(path, Declaration(path, "cu8", FS_HZ)).read(2)[1]
    np.testing.assert_array_equal(iq, [[-128, 0], [127, -1]])


def test_names_that_users_know():
    for alias, name in ALIASES.items():
        assert sample_format(alias.upper()) is FORMATS[name]
    with pytest.raises(ValueError, match="format 'ci7' is not known; use one of"):
        sample_format("ci7")


def test_sigmf_metadata_is_valid_and_read_back(tmp_path):
    sigmf = pytest.importorskip("sigmf")
    iq = samples("ci8", 5000)
    note = {"core:sample_start": 10, "core:sample_count": 20, "core:label": "CW", "gnss:js_db": 20.0}
    start = datetime(2024, 3, 1, 11, 59, 42, tzinfo=UTC)
    with RecordingWriter(tmp_path / "a", "ci8", 4.096e6, 12_345.0, start, "two words", [note]) as writer:
        writer.write(iq)
    meta = sigmf.sigmffile.fromfile(str(writer.meta), skip_checksum=True)
    meta.validate()
    assert meta.sample_count == 5000
    declared = declaration(tmp_path / "a")
    assert (declared.format, declared.fs_hz, declared.if_hz, declared.start) == (
        "ci8",
        4.096e6,
        12_345.0,
        start,
    )
    assert declared.annotations == (note,) and not declared.conjugate
    assert declaration(writer.data) == declared == declaration(writer.meta)


def test_options_win_over_metadata(tmp_path):
    with RecordingWriter(tmp_path / "a", "ci8", FS_HZ) as writer:
        writer.write(samples("ci8", 100))
    declared = declaration(writer.meta, options(format="CS16", fs_hz=5e6, if_hz=1.0, conjugate=True))
    assert (declared.format, declared.fs_hz, declared.if_hz, declared.conjugate) == ("ci16", 5e6, 1.0, True)


def test_tag_of_pocketsdr(tmp_path):
    path = write_raw(tmp_path / "L1.bin", np.zeros(100, np.int8))
    tag = "PROG = pocket_dump\nTIME = 2024/03/01 12:00:00.000\nFMT  = INT8X2\nF_S  = 12\nF_LO = 1573.42,1200\nIQ   = 2\n"
    Path(f"{path}.tag").write_text(tag)
    declared = declaration(path)
    assert (declared.format, declared.fs_hz, declared.if_hz, declared.conjugate) == ("ci8", 12e6, 2e6, True)
    assert declared.start == datetime(2024, 3, 1, 12)


def test_tag_keeps_the_intermediate_frequency(tmp_path):
    with RecordingWriter(tmp_path / "a", "ci2", 4.096e6, 12_345.0) as writer:
        writer.write(samples("ci2", 100))
    assert declaration(writer.data).if_hz == pytest.approx(12_345.0, abs=1e-3)


def test_interrupted_writer_leaves_a_valid_recording(tmp_path):
    iq = samples("ci16", 5000)
    writer = RecordingWriter(tmp_path / "a", "ci16", FS_HZ)
    writer.write(iq)
    # Neither close() nor __exit__ is reached.
    source = open_recording(writer.data, declaration(writer.data))
    np.testing.assert_array_equal(source.read(9999)[1], iq)
    assert json.loads(writer.meta.read_text())["global"]["gnss:complete"] is False


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_full_disk_is_reported(tmp_path):
    writer = RecordingWriter(tmp_path / "a", "ci8", FS_HZ)
    writer._file.close()
    writer._file = open("/dev/full", "wb", buffering=0)
    with pytest.raises(OSError, match="No space left"):
        writer.write(samples("ci8", 100))


BAD_FILES = {
    "empty": (b"", "ci8", "is empty"),
    "odd": (b"\0" * 1001, "ci8", "not a whole number of 2-byte ci8 samples"),
    "odd16": (b"\0" * 1002, "ci16", "not a whole number of 4-byte ci16 samples"),
    "oddfloat": (b"\0" * 12, "cf32", "not a whole number of 8-byte cf32 samples"),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_sizes(tmp_path, case):
    content, name, message = BAD_FILES[case]
    path = tmp_path / "a.bin"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message):
        open_recording(path, Declaration(path, name, FS_HZ))


BAD_DECLARATIONS = [
    ({"data": Path("no_such_file")}, "does not exist"),
    ({"format": None}, "give --format$"),
    ({"format": None, "fs_hz": None}, "give --format and --fs-hz"),
    ({"fs_hz": 1.0e6}, "too low for complex samples: the main lobe"),
    ({"format": "ri8", "fs_hz": 2.0e6, "if_hz": 5e5}, "too low for real samples"),
    ({"if_hz": 2.1e6}, "beyond fs_hz / 2"),
    ({"format": "ri8"}, "give their intermediate frequency"),
    ({"format": "ri8", "if_hz": 3e6}, "between 0 and fs_hz / 2"),
    ({"fs_hz": float("nan")}, "must be finite"),
    ({"skip_s": -1.0}, "skip_s = -1"),
    ({"skip_s": 1.0}, "nothing is left after skipping"),
    ({"duration_s": 0.0}, "must be positive"),
]


@pytest.mark.parametrize("change, message", BAD_DECLARATIONS)
def test_bad_declarations(tmp_path, change, message):
    path = write_raw(tmp_path / "a.bin", np.zeros(4000, np.int8))
    with pytest.raises(ValueError, match=message):
        open_recording(path, replace(Declaration(path, "ci8", FS_HZ), **change))


def test_samples_that_are_not_numbers(tmp_path):
    values = np.zeros((4000, 2), np.float32)
    values[1234, 1] = np.nan
    path = write_raw(tmp_path / "a.bin", values)
    source = open_recording(path, Declaration(path, "cf32", FS_HZ, skip_s=100 / FS_HZ))
    source.read(1000)
    with pytest.raises(ValueError, match="sample 1234 is not a finite number"):
        source.read(1000)


def test_file_that_shrinks_while_it_is_read(tmp_path):
    path = write_raw(tmp_path / "a.bin", np.zeros(4000, np.int8))
    source = open_recording(path, Declaration(path, "ci8", FS_HZ))
    os.truncate(path, 100)
    with pytest.raises(ValueError, match="became shorter"):
        source.read(2000)


GOOD_META = {
    "global": {"core:datatype": "ci8", "core:sample_rate": FS_HZ, "core:version": "1.2.0"},
    "captures": [{"core:sample_start": 0, "core:frequency": F_L1_HZ}],
    "annotations": [],
}
HOSTILE = [
    ("not json", "is not JSON"),
    ("[" * 100_000, "is not JSON"),
    ('{"global": {"core:sample_rate": ' + "9" * 5000 + '}, "captures": []}', "is not JSON"),
    (
        '{"global": {"core:datatype": "ci8", "core:sample_rate": 1e999}, "captures": []}',
        "core:sample_rate must be",
    ),
    ({**GOOD_META, "global": {**GOOD_META["global"], "core:datatype": "ci16_be"}}, "convert to one of ci8"),
    (
        {**GOOD_META, "global": {**GOOD_META["global"], "core:sample_rate": 10**300}},
        "core:sample_rate must be",
    ),
    ("[]", "lacks the objects"),
    ({"global": {}, "captures": 3}, "lacks the objects"),
    ({**GOOD_META, "captures": [1]}, "must be a JSON object"),
    ({**GOOD_META, "global": {**GOOD_META["global"], "core:dataset": "../../etc/passwd"}}, "plain name"),
    ({**GOOD_META, "global": {**GOOD_META["global"], "core:dataset": "/etc/passwd"}}, "plain name"),
    ({**GOOD_META, "global": {**GOOD_META["global"], "core:dataset": ".."}}, "plain name"),
    ({**GOOD_META, "global": {**GOOD_META["global"], "core:dataset": "a\0b"}}, "plain name"),
    ({**GOOD_META, "global": {**GOOD_META["global"], "core:dataset": ["x"]}}, "plain name"),
    ({**GOOD_META, "global": {**GOOD_META["global"], "core:datatype": "cf64_le"}}, "not supported"),
    ({**GOOD_META, "global": {**GOOD_META["global"], "core:datatype": ["ci8"]}}, "not supported"),
    ({**GOOD_META, "global": {**GOOD_META["global"], "core:sample_rate": 1e300}}, "core:sample_rate must be"),
    ({**GOOD_META, "global": {**GOOD_META["global"], "core:sample_rate": True}}, "core:sample_rate must be"),
    ({**GOOD_META, "global": {**GOOD_META["global"], "core:sample_rate": "4e6"}}, "core:sample_rate must be"),
    ({**GOOD_META, "global": {**GOOD_META["global"], "core:num_channels": 2}}, "several channels"),
    ({**GOOD_META, "captures": [{"core:frequency": float("nan")}]}, "core:frequency must be"),
    ({**GOOD_META, "captures": [{"core:frequency": 1e9}, {"core:frequency": 2e9}]}, "changes its centre"),
    ({**GOOD_META, "captures": [{"core:header_bytes": -1}]}, "core:header_bytes must be"),
]


@pytest.mark.parametrize("case", range(len(HOSTILE)))
def test_hostile_metadata(tmp_path, case):
    content, message = HOSTILE[case]
    write_raw(tmp_path / "a.sigmf-data", np.zeros(4000, np.int8))
    meta = tmp_path / "a.sigmf-meta"
    meta.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(ValueError, match=message):
        declaration(meta)


def test_good_metadata_of_the_hostile_table_is_read(tmp_path):
    write_raw(tmp_path / "a.sigmf-data", np.zeros(4000, np.int8))
    meta = tmp_path / "a.sigmf-meta"
    meta.write_text(json.dumps(GOOD_META))
    assert open_recording(meta, declaration(meta)).n_samples == 2000


def test_oversized_metadata_is_not_read(tmp_path):
    meta = tmp_path / "a.sigmf-meta"
    with meta.open("wb") as f:
        f.truncate(1 << 30)
    with pytest.raises(ValueError, match="is larger than"):
        declaration(meta)
    path = write_raw(tmp_path / "b.bin", np.zeros(10, np.int8))
    with Path(f"{path}.tag").open("wb") as f:
        f.truncate(1 << 30)
    with pytest.raises(ValueError, match="is larger than"):
        declaration(path)


@pytest.mark.parametrize(
    "tag", ["FMT = RAW99\nF_S = 4", "FMT = CS8\nF_S = fast", "FMT = CS8\nF_S = -4", "", "\xff\xfe"]
)
def test_hostile_tag(tmp_path, tag):
    path = write_raw(tmp_path / "b.bin", np.zeros(10, np.int8))
    Path(f"{path}.tag").write_text(tag, encoding="latin-1")
    with pytest.raises(ValueError):
        declaration(path)


def test_levels_that_a_packed_format_cannot_hold(tmp_path):
    writer = RecordingWriter(tmp_path / "a", "ci2", FS_HZ)
    iq = samples("ci2", 100)
    iq[1, 42] = 2
    with pytest.raises(ValueError, match="sample 42 is not one of the levels -3, -1, \\+1, \\+3 of ci2"):
        writer.write(iq)
    with pytest.raises(ValueError, match="cannot be written as ci8"):
        RecordingWriter(tmp_path / "b", "ci8", FS_HZ).write(iq.astype(np.float32))


def test_directory_that_does_not_exist(tmp_path):
    with pytest.raises(ValueError, match="does not exist"):
        RecordingWriter(tmp_path / "no" / "a", "ci8", FS_HZ)


@pytest.mark.skipif(not SHARED.is_dir(), reason="the real capture is not here")
def test_real_capture():
    path = SHARED / "data/real/L1_20211202_084700_4MHz_IQ.bin"
    declared = declaration(path, options(format="ci8", fs_hz=4e6, conjugate=True))
    source = open_recording(path, declared)
    assert source.n_samples == 2_000_000
    iq = source.read(10_000)[1]
    raw = np.fromfile(path, np.int8, 20_000).reshape(-1, 2).T
    np.testing.assert_array_equal(iq, raw * np.array([[1], [-1]], np.int8))


def test_sigmf_captures_that_leave_the_centre_out_keep_it(tmp_path):
    captures = [*GOOD_META["captures"], {"core:sample_start": 1000}]
    (tmp_path / "a.sigmf-meta").write_text(json.dumps({**GOOD_META, "captures": captures}))
    assert declaration(tmp_path / "a.sigmf-meta").if_hz == 0.0
