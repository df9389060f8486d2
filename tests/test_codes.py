"""Spreading codes against the interface documents' check values, and hostile tables."""

import csv

import numpy as np
import pytest

from signals.codes import E1_TABLE, primary_code, prn_dir, prns_of, secondary_code

# First ten chips in octal, IS-GPS-200: PRN 1-63, then 120-158.
# fmt: off
FIRST_10 = """
    1440 1620 1710 1744 1133 1455 1131 1454 1626 1504 1642 1750 1764 1772 1775 1776 1156 1467 1633 1715
    1746 1763 1063 1706 1743 1761 1770 1774 1127 1453 1625 1712 1745 1713 1134 1456 1713 1760 1236 0063
    0626 0126 1674 1234 0271 0712 0213 0412 0236 0450 0061 0142 0775 0762 0111 1600 0424 1351 1550 1271
    1441 0444 0032 0671 0536 1510 1545 0160 0701 0013 1060 0245 0527 1436 1226 1257 0046 1071 0561 1037
    0770 1327 1472 0124 0366 0133 0465 0717 0217 1742 1422 1442 0523 0736 1635 0136 0273 1026 0003 1670
    0624 0235
"""
# fmt: on


@pytest.mark.parametrize("prn, octal", list(zip(prns_of("L1CA"), FIRST_10.split())))
def test_first_ten_chips_of_ca(prn, octal):
    bits = (1 - primary_code("L1CA", prn)[:10]) // 2
    assert int("".join(map(str, bits)), 2) == int(octal, 8)


def test_ca_codes_are_gold_codes():
    # Gold codes of length 2^10 - 1 correlate to -1, -65 or 63 only; PRN 34 and 37 are the same code.
    spectra = [np.fft.rfft(primary_code("L1CA", prn)) for prn in (1, 2, 6, 33, 63, 120, 158)]
    for i, a in enumerate(spectra):
        for j, b in enumerate(spectra):
            values = np.unique(np.rint(np.fft.irfft(a * np.conj(b), 1023)).astype(int))
            assert set(values) <= ({-1, -65, 63, 1023} if i == j else {-1, -65, 63})
    assert np.array_equal(primary_code("L1CA", 34), primary_code("L1CA", 37))
    assert all(primary_code("L1CA", prn).sum() in (-1, -65, 63) for prn in prns_of("L1CA"))


def test_e1_codes_have_their_published_properties():
    first = {("E1B", 1): "F5D710", ("E1B", 2): "96B856", ("E1B", 3): "E57DE1", ("E1B", 4): "C0FC4C",
             ("E1C", 1): "B39340", ("E1C", 2): "A64F94", ("E1C", 3): "FD1F69", ("E1C", 4): "EE38BA"}  # fmt: skip
    for (signal, prn), digits in first.items():
        bits = (1 - primary_code(signal, prn)[:24]) // 2
        assert f"{int(''.join(map(str, bits)), 2):06X}" == digits
    worst_auto = {"E1B": 0, "E1C": 0}
    spectra = []
    for signal in worst_auto:
        for prn in range(1, 51):
            chips = primary_code(signal, prn)
            assert chips.sum(dtype=int) == 0
            spectra.append(np.fft.rfft(chips))
            acf = np.rint(np.fft.irfft(np.abs(spectra[-1]) ** 2, 4092)).astype(int)
            assert acf[0] == 4092 and acf[1] == acf[-1] == 0
            worst_auto[signal] = max(worst_auto[signal], np.max(np.abs(acf[1:])))
    assert 20 * np.log10(worst_auto["E1B"] / 4092) == pytest.approx(-25.71, abs=0.005)
    assert 20 * np.log10(worst_auto["E1C"] / 4092) == pytest.approx(-25.39, abs=0.005)
    worst = 0
    for i in range(99):
        cross = np.fft.irfft(np.conj(spectra[i]) * np.array(spectra[i + 1 :]), 4092, axis=1)
        worst = max(worst, int(np.rint(np.max(np.abs(cross)))))
    assert worst == 244


def test_secondary_code_is_the_shipped_one():
    with (prn_dir() / "galileo_e1c_secondary_code.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert "".join(str((1 - c) // 2) for c in secondary_code()) == row["bits"]
    assert f"{int(row['bits'], 2) << 3:07X}" == row["hex"]


def test_unknown_signal_and_prn_are_refused():
    for signal, prn, word in (
        ("L1CA", 64, "PRN 64"),
        ("E1B", 51, "PRN 51"),
        ("E1C", 0, "PRN 0"),
        ("L5", 1, "L5"),
    ):
        with pytest.raises(ValueError, match=word):
            primary_code(signal, prn)


def _table():
    return (prn_dir() / E1_TABLE).read_text().splitlines(keepends=True)


def _flip(line):
    return line[:-2] + ("0" if line[-2] != "0" else "1") + "\n"


def _move_digit(line):
    """Put one hexadecimal digit elsewhere: the sum of the chips stays zero."""
    prefix, digits = line.rsplit(",", 1)
    return f"{prefix},{digits[1:101]}{digits[0]}{digits[101:]}"


@pytest.mark.parametrize(
    "damage, words",
    [
        (lambda t: t[:7] + t[8:], "E1B PRN 7 is missing"),
        (lambda t: t[:60], "E1C PRN 10 is missing"),
        (lambda t: [*t[:7], _flip(t[7]), *t[8:]], "E1B PRN 7 is damaged"),
        (lambda t: [*t[:52], _move_digit(t[52]), *t[53:]], "E1C PRN 2 is damaged"),
        (lambda t: [*t[:7], t[7][:-5] + "\n", *t[8:]], "E1B PRN 7 has 1019 hex digits"),
        (lambda t: [*t[:7], t[7][:-2] + "G\n", *t[8:]], "E1B PRN 7 has a character"),
        (lambda t: [*t[:7], t[7][:20] + " " + t[7][21:], *t[8:]], "E1B PRN 7 has a character"),
        (lambda t: [*t, t[7]], "E1B PRN 7 appears twice"),
        (lambda t: [*t[:8], "E1B,8," + t[7].split(",")[2], *t[9:]], "E1B PRN 8 is damaged"),
        (lambda t: [*t, "E1B,51," + t[7].split(",")[2]], "PRN '51' is none of"),
        (lambda t: [*t, "E1B,,\n"], "is none of"),
        (lambda t: [], "E1B PRN 1 is missing"),
        (lambda t: ["\x00\x01garbage"], "incomplete|not ASCII CSV"),
        (lambda t: ["é" * 10], "not ASCII"),
        (lambda t: ["x" * 200_000], "not ASCII CSV|incomplete"),
    ],
)
def test_damaged_tables_are_refused_with_the_reason(tmp_path, damage, words):
    path = tmp_path / E1_TABLE
    path.write_text("".join(damage(_table())), encoding="utf-8")
    with pytest.raises(ValueError, match=words):
        primary_code("E1B", 1, path)


def test_another_path_and_a_table_too_large(tmp_path):
    path = tmp_path / E1_TABLE
    path.write_text("".join(_table()))
    for place in (path, tmp_path, str(path)):
        assert np.array_equal(primary_code("E1C", 12, place), primary_code("E1C", 12))
    path.write_text("".join(_table()[:-1]))
    with pytest.raises(ValueError, match="E1C PRN 50 is missing"):
        primary_code("E1C", 12, path)
    path.write_bytes(b"x" * (2 << 20))
    with pytest.raises(ValueError, match="2097152 bytes"):
        primary_code("E1B", 1, path)
    with pytest.raises(ValueError, match="not found"):
        primary_code("E1B", 1, tmp_path / "absent.csv")


def test_codes_are_read_only():
    for signal in ("L1CA", "E1B"):
        with pytest.raises(ValueError):
            primary_code(signal, 1)[0] = 0
