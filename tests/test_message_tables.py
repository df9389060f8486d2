"""The field tables against the design note that states them, read by program."""

import gzip
import re
from pathlib import Path

import pytest

from signals import inav, lnav

NOTE = Path(__file__).resolve().parents[2] / "shared" / "design" / "nav_message_fields.md"
pytestmark = pytest.mark.skipif(not NOTE.is_file(), reason="the design note is not beside this checkout")

LNAV_TABLES = {
    "TLM/HOW": lnav.HEADER,
    "Subframe 1": lnav.SUBFRAME_1,
    "Subframe 2": lnav.SUBFRAME_2,
    "Subframe 3": lnav.SUBFRAME_3,
    "Subframe 4 page 18": lnav.PAGE_18,
    "Almanac page": lnav.ALMANAC,
}
NOT_FIELDS = ("Reserved", "Parity", "Solved", "Spare", "Dummy")


def sections() -> dict[str, list[list[str]]]:
    """Heading -> rows of the table below it."""
    found: dict[str, list[list[str]]] = {}
    title = ""
    for line in NOTE.read_text().splitlines():
        if line.startswith("#"):
            title = line.lstrip("# ")
        elif line.startswith("|") and not line.startswith("|---"):
            found.setdefault(title, []).append([cell.strip() for cell in line.strip("|").split("|")])
    return found


def number(text: str) -> float:
    match = re.fullmatch(r"(\d+)(?:\^(-?\d+))?", text)
    assert match, text
    return float(match[1]) ** int(match[2] or 1)


def stated(rows: list[list[str]], kind_column: int) -> set[tuple]:
    """{(spans, kind, scale, is angle)} of the rows of a table of the note."""
    fields = set()
    for row in rows[1:]:
        name, place = row[0], row[1]
        if name.startswith(NOT_FIELDS) or name == "TLM message":
            continue
        if (kind_column == 3 and ".." in place) or "+" in place:
            ends = [[int(x) for x in part.split("..")] for part in place.split("+")]
            spans = tuple((a[0], a[-1] - a[0] + 1) for a in ends)
        else:
            spans = ((int(place), int(row[2])),)
        kind = row[kind_column]
        scale = 1.0 if row[kind_column + 1] in ("-", "index") else number(row[kind_column + 1])
        unit = row[kind_column + 2]
        fields.add((spans, kind if kind in "us" else "u", scale, unit.startswith("semicircle")))
    return fields


def ours(table: tuple) -> set[tuple]:
    """The same of one of our tables."""
    return {
        (f.spans, f.kind, f.scale, f.unit.startswith("semicircle")) for f in table if f.name != "tlm_message"
    }


@pytest.mark.parametrize("title", LNAV_TABLES)
def test_lnav_table(title: str) -> None:
    rows = next(rows for heading, rows in sections().items() if heading.startswith(title))
    want, have = stated(rows, 3), ours(LNAV_TABLES[title])
    # counts of 6 s, 900 s and the truncated week are kept as integers
    integers = {item for item in want ^ have if item[0] in (((31, 17),), ((288, 5),))}
    assert want ^ have == integers
    assert {item[0] for item in want} == {item[0] for item in have}


@pytest.mark.parametrize("number_", sorted(inav.WORDS))
def test_inav_table(number_: int) -> None:
    rows = next(rows for heading, rows in sections().items() if heading.startswith(f"Word type {number_}:"))
    want, have = stated(rows, 3), ours(inav.WORDS[number_])
    if number_ == 5:  # five storm flags of one bit each are one field of five bits
        flags = {(((43 + k, 1),), "u", 1.0, False) for k in range(5)}
        assert flags <= want
        want = want - flags | {(((43, 5),), "u", 1.0, False)}
    assert want == have


RINEX = NOTE.parents[1] / "data" / "rinex" / "VILL00ESP_R_20181700000_01D_MN.rnx.gz"
ORBIT_LINES = (
    ("iode", "crs_m", "delta_n_rad_s", "m0_rad"),
    ("cuc_rad", "e", "cus_rad", "sqrt_a_sqrt_m"),
    ("toe_s", "cic_rad", "omega0_rad", "cis_rad"),
    ("i0_rad", "crc_m", "omega_rad", "omega_dot_rad_s"),
    ("idot_rad_s",),
)
"""Order of the numbers of a RINEX 3 record, common to GPS and Galileo (RINEX 3.03, tables A6 and A8)."""


def broadcast_records() -> list[tuple[str, dict[str, float]]]:
    """(system, fields) of the GPS and Galileo records of a day recorded at a station."""
    lines = gzip.open(RINEX, "rt").read().splitlines()
    at = next(k for k, line in enumerate(lines) if "END OF HEADER" in line) + 1
    records = []
    while at < len(lines):
        system = lines[at][0]
        n = 4 if system in "RS" else 8
        if system in "GE":
            rows = [[row[4 + 19 * k : 23 + 19 * k] for k in range(4)] for row in lines[at : at + n]]
            values = dict(zip(("af0_s", "af1_s_s", "af2_s_s2"), rows[0][1:], strict=True))
            for names, row in zip(ORBIT_LINES, rows[1:], strict=False):
                values |= dict(zip(names, row, strict=False))
            values["tgd_s"] = rows[6][2 if system == "G" else 3]
            records.append((system, {name: float(text.replace("D", "e")) for name, text in values.items()}))
        at += n
    return records


@pytest.mark.skipif(not RINEX.is_file(), reason="the RINEX file is not beside this checkout")
def test_real_broadcasts_lie_on_our_grid() -> None:
    """Every number of a real day is a whole multiple of our last bit, and inside our limits.

    RINEX prints 13 digits, so a 32-bit field comes back within 2^32 1e-12 / 2 = 0.002 of its last bit.
    """
    tables = {
        "G": (*lnav.SUBFRAME_1, *lnav.SUBFRAME_2, *lnav.SUBFRAME_3),
        "E": (*inav.WORD_1, *inav.WORD_2, *inav.WORD_3, *inav.WORD_4, *inav.WORD_5),
    }
    records = broadcast_records()
    assert len(records) > 500
    for system, values in records:
        for field in tables[system]:
            if field.name in values:
                raw = values[field.name] / field.lsb
                assert abs(raw - round(raw)) < 0.0025, (system, field.name)
                assert field.limits[0] <= round(raw) <= field.limits[1], (system, field.name)
