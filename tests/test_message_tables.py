"""The field tables against the design note that states them, read by program."""

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
