import builtins
import gzip
from pathlib import Path

import numpy as np
import pytest

from signals.orbits import check_ephemeris, default_iono_utc, nominal_constellation, quantise_ephemeris
from signals.rinex import SISA_M, URA_M, accuracy_index, accuracy_m, read_rinex_nav, select, write_rinex_nav

pytest.importorskip("georinex")
WEEK, TOW = 2303, 475_200
REAL = (
    Path(__file__).resolve().parents[2]
    / "shared"
    / "data"
    / "rinex"
    / "VILL00ESP_R_20181700000_01D_MN.rnx.gz"
)
BOTH = np.concatenate([nominal_constellation("E", WEEK, TOW)[:5], nominal_constellation("G", WEEK, TOW)[:5]])
IONO = default_iono_utc(WEEK)


def written(tmp_path, records=BOTH):
    path = tmp_path / "nav.rnx"
    write_rinex_nav(path, records, IONO)
    return path


def close(a, b):
    """Equal to the 13 digits that RINEX holds."""
    for name in a.dtype.names:
        if a.dtype[name].kind == "f":
            assert np.allclose(a[name], b[name], rtol=1e-12, atol=0), name
        else:
            assert np.array_equal(a[name], b[name]), name


def test_round_trip_gives_the_same_messages(tmp_path):
    records = BOTH.copy()
    records["health"][[0, 7]] = 5, 40
    records["fit_interval"][6] = 1
    records["af2_s_s2"][5] = 2.0**-55
    ephemerides, iono = read_rinex_nav(written(tmp_path, records))
    close(ephemerides, records)
    assert np.array_equal(quantise_ephemeris(ephemerides), records)
    assert iono == IONO


def test_lines_are_fixed_width(tmp_path):
    lines = written(tmp_path).read_text().splitlines()
    end = next(i for i, line in enumerate(lines) if "END OF HEADER" in line)
    assert all(line[60:].strip() for line in lines[: end + 1])
    for line in lines[end + 1 :]:
        assert len(line) in (23, 42, 61, 80)
        assert all(
            np.isfinite(float(line[i : i + 19]))
            for i in range(len(line) % 19, len(line), 19)
            if line[i : i + 19].strip() and not (line[0] in "GE" and i < 23)
        )


def test_week_crossing_of_toc_and_toe(tmp_path):
    eph = nominal_constellation("G", WEEK, 0)[:1]
    eph["week"], eph["toe_s"], eph["toc_s"] = WEEK, 0.0, 604_784.0
    close(read_rinex_nav(written(tmp_path, eph))[0], eph)


@pytest.mark.skipif(not REAL.exists(), reason="the real navigation file is not here")
def test_real_file_against_its_own_text():
    ephemerides, iono = read_rinex_nav(REAL)
    text = gzip.decompress(REAL.read_bytes()).decode().splitlines()
    starts = [
        i
        for i, line in enumerate(text)
        if line[:1] in "GE" and line[1:3].strip().isdigit() and line[4:8] == "2018"
    ]
    gps = [i for i in starts if text[i][0] == "G"]
    inav = [i for i in starts if text[i][0] == "E" and int(float(text[i + 5][23:42])) & 5]
    assert len(inav) < sum(text[i][0] == "E" for i in starts)  # F/NAV is in the file and stays out
    assert np.sum(ephemerides["system"] == b"G") == len({tuple(text[i : i + 8]) for i in gps})
    assert np.sum(ephemerides["system"] == b"E") == len({tuple(text[i : i + 8]) for i in inav})
    for i in (gps[3], gps[100], inav[0], inav[200]):
        cells = [float(text[i][23 + 19 * k : 42 + 19 * k]) for k in range(3)]
        rows = [
            [float(line[4 + 19 * k : 23 + 19 * k] or 0) for k in range(len(line.rstrip()) // 19)]
            for line in text[i + 1 : i + 8]
        ]
        mine = select(ephemerides, text[i][0], int(text[i][1:3]), 2006, rows[2][0])
        assert [mine["af0_s"], mine["af1_s_s"], mine["af2_s_s2"]] == cells
        assert [mine["iode"], mine["crs_m"], mine["delta_n_rad_s"], mine["m0_rad"]] == rows[0][:4]
        assert [mine["toe_s"], mine["cic_rad"], mine["omega0_rad"], mine["cis_rad"]] == rows[2][:4]
        assert mine["week"] == 2006 and mine["tgd_s"] == rows[5][3 if text[i][0] == "E" else 2]
    check_ephemeris(ephemerides)
    lsb = quantise_ephemeris(ephemerides)
    # What is broadcast is a multiple of the last bit: rounding moves nothing beyond the 13 digits written.
    assert np.allclose(lsb["m0_rad"], ephemerides["m0_rad"], rtol=0, atol=1e-11)
    assert np.allclose(lsb["sqrt_a_sqrt_m"], ephemerides["sqrt_a_sqrt_m"], rtol=0, atol=1e-8)
    assert iono["dt_ls_s"] == 18 and np.allclose(
        iono["alpha"], [5.5879e-9, 1.4901e-8, -5.9605e-8, -1.1921e-7], rtol=1e-4
    )
    assert np.isclose(iono["a0g_s"], 2.2322637960e-08 + 1.021405183e-14 * 259_200, atol=2**-36)


RINEX_2 = """     2.11           N: GPS NAV DATA                         RINEX VERSION / TYPE
    0.1118D-07  0.1490D-07 -0.5960D-07 -0.1192D-06          ION ALPHA
    0.8397D+05  0.9830D+05 -0.6554D+05 -0.5243D+06          ION BETA
    18                                                      LEAP SECONDS
                                                            END OF HEADER
"""


def rinex_2(eph):
    """The GPS record in the columns of RINEX 2.11, table A4, with D exponents and the last line cut short."""
    from signals.rinex import _gps_lines
    from signals.timescale import calendar

    lines = _gps_lines(eph)
    toc = calendar(int(eph["week"]), float(eph["toc_s"]))
    head = f"{int(eph['prn']):2d} {toc:%y} {toc.month:2d} {toc.day:2d} {toc.hour:2d} {toc.minute:2d}{toc.second:5.1f}"
    body = [line[1:] for line in lines[1:]]
    return "\n".join([head + lines[0][23:], *body[:-1], body[-1][: 3 + 19]]).replace("E", "D") + "\n"


def test_rinex_2_is_read_and_a_repeated_epoch_costs_no_satellite(tmp_path):
    records = nominal_constellation("G", WEEK, TOW)[:3]
    path = tmp_path / "brdc.24n"
    path.write_text(RINEX_2 + "".join(rinex_2(e) for e in (*records, records[1])))
    ephemerides, iono = read_rinex_nav(path)
    close(ephemerides, records)
    assert np.allclose(iono["beta"], [83_968, 98_304, -65_536, -524_288])


def rinex_4(records):
    """The records as RINEX 4.00 has them (tables A7 to A36), among records of other kinds and systems."""
    from signals.rinex import _galileo_lines, _gps_lines

    lines = [
        "     4.00           NAVIGATION DATA     M                   RINEX VERSION / TYPE",
        f"{'    18    18  1929     7':60}LEAP SECONDS",
        f"{'':60}END OF HEADER",
        "> STO G03 LNAV",
        "    2024 03 01 00 00 00 GPUT                                  UTC(USNO)",
        "     4.320000000000E+05 9.313225746155E-10-5.329070518201E-15 0.000000000000E+00",
        "> EPH R04 FDMA",
        "R04 2024 03 01 00 15 00 1.0E-05 0.0E+00 0.0E+00",
        *["     1.0E+00 1.0E+00 1.0E+00 1.0E+00"] * 4,
        "> EOP G03 CNAV",
        "    2024 03 01 00 00 00 1.0E-01 1.0E-04 0.0E+00",
        *["                        1.0E-01 1.0E-04 0.0E+00"] * 2,
        "> EPH G05 CNAV",
        "G05 2024 03 01 12 00 00 1.0E-04 0.0E+00 0.0E+00",
        *["     1.0E+00 1.0E+00 1.0E+00 1.0E+00"] * 8,
    ]
    for eph in records:
        system = bytes(eph["system"]).decode()
        lines.append(f"> EPH {system}{int(eph['prn']):02d} {'LNAV' if system == 'G' else 'INAV'}")
        lines += _gps_lines(eph) if system == "G" else _galileo_lines(eph)
    return [
        *lines,
        "> ION G03 LNAV",
        "    2024 03 01 12 00 00 1.117587089539E-08 1.490116119385E-08-5.960464477539E-08",
        "    -1.192092895508E-07 8.396800000000E+04 9.830400000000E+04-6.553600000000E+04",
        "    -5.242880000000E+05 0.000000000000E+00",
        "> ION E11 IFNV",
        "    2024 03 01 12 00 00 1.235000000000E+02 4.101562500000E-01 9.765625000000E-04",
        "     0.000000000000E+00",
        "> ION C20 CNVX",
        "    2024 03 01 12 00 00 1.0E+01 1.0E+00 1.0E+00",
    ]


def test_rinex_4_gives_what_rinex_3_gives(tmp_path):
    path = tmp_path / "brd4.rnx"
    path.write_text("\n".join(rinex_4(BOTH)) + "\n")
    ephemerides, iono = read_rinex_nav(path)
    close(ephemerides, read_rinex_nav(written(tmp_path))[0])
    assert np.allclose(iono["alpha"], [12 * 2.0**-30, 2 * 2.0**-27, -(2.0**-24), -2 * 2.0**-24], rtol=0)
    assert np.allclose(iono["beta"], [83_968, 98_304, -65_536, -524_288])
    assert np.allclose(iono["ai"], [123.5, 105 * 2.0**-8, 32 * 2.0**-15]) and iono["dt_ls_s"] == 18
    # A0 at the start of the week: -6 / 2^50 s/s over the 432000 s since.
    assert iono["a0_utc_s"] == pytest.approx(2.0**-30 + 6 * 2.0**-50 * 432_000, abs=2.0**-31)
    text = path.read_text().replace("GPUT  ", "GPUT x").replace("> STO G03", "> STO")
    path.write_text(text.replace("2024 03 01 12 00 00 1.235", "2024 03 xx 12 00 00 1.235"))
    read_rinex_nav(path)  # what is of no use need not be right
    path.write_text("\n".join(rinex_4(BOTH)).replace("2024 03 01 00 00 00 GPUT", "2024 13 01 00 00 00 GPUT"))
    with pytest.raises(ValueError, match=r"STO G03 LNAV.*malformed"):
        read_rinex_nav(path)


def test_files_put_together_with_comments_and_other_systems(tmp_path):
    lines = written(tmp_path).read_text().splitlines()
    end = next(i for i, line in enumerate(lines) if "END OF HEADER" in line)
    header, body = lines[: end + 1], lines[end + 1 :]
    glonass = [
        "R04 2024 03 01 00 15 00" + " 1.000000000000D-05" * 3,
        *["    " + " 1.000000000000D+00" * 4] * 3,
    ]
    beidou = [
        "C20 2024 03 01 00 00 00" + " 1.000000000000D-05" * 3,
        *["    " + " 1.000000000000D+00" * 4] * 7,
    ]
    comment = f"{'put together by hand':60}COMMENT"
    text = [
        *header,
        *glonass,
        *body[:8],
        comment,
        *header,
        *beidou,
        *(line.replace("E", "e") for line in body[8:80]),
    ]
    text = [line if line[:1] != "e" else "E" + line[1:] for line in text]
    path = tmp_path / "together.rnx"
    path.write_text("\r\n".join(text) + "\r\n")
    close(read_rinex_nav(path)[0], read_rinex_nav(written(tmp_path))[0])


def test_select_prefers_the_latest_past_record():
    rows = np.repeat(BOTH[5:6], 4)
    rows["toe_s"] = TOW + np.array([-7_200.0, -1_200.0, 600.0, -1_200.0])
    rows["tow_s"] = rows["toe_s"] + np.array([0, 0, 0, 30.0])
    prn = int(rows["prn"][0])
    assert select(rows, "G", prn, WEEK, TOW) == rows[3]
    assert select(rows[2:3], "G", prn, WEEK, TOW) == rows[2]
    assert select(rows, "G", prn, WEEK, TOW + 7_800) == rows[2]
    assert select(rows, "G", prn, WEEK, TOW + 7_801) is None
    assert select(rows, "G", prn, WEEK + 1, TOW) is None and select(rows, "G", 33, WEEK, TOW) is None


def test_accuracy_indices():
    assert [accuracy_index("G", x) for x in (2.0, 2.8, 11.3, 6_144.0, 9e9, -1.0)] == [0, 1, 5, 14, 15, 15]
    assert [accuracy_index("E", x) for x in (0.37, 1.32, 3.12, 6.0, 7.0, -1.0)] == [
        37,
        83,
        107,
        125,
        255,
        255,
    ]
    assert all(accuracy_index("G", accuracy_m("G", k)) == k for k in range(len(URA_M)))
    assert all(accuracy_index("E", accuracy_m("E", k)) == k for k in [*range(len(SISA_M)), 255])


def test_strangers_files_are_refused_with_one_sentence(tmp_path, monkeypatch):
    good = written(tmp_path).read_text()
    cases = {
        "does not exist": None,
        "is not RINEX 2, 3 or 4": "",
        "is not RINEX 2, 3 or 4: ": good.replace("     3.04", "     5.00"),
        "is of type 'O'": good.replace("NAVIGATION DATA", "OBSERVATION DAT"),
        "END OF HEADER": good.split("END OF HEADER")[0],
        "lines instead of 8": "\n".join(good.splitlines()[:-1]),
        "is no number": good.replace(" 5.17", " x.17"),
        "header line .*GPSA.* malformed": good.replace("GPSA ", "GPSA x"),
        "no GPS or Galileo": good.split("END OF HEADER")[0] + "END OF HEADER\n",
    }
    for match, text in cases.items():
        path = tmp_path / "bad.rnx"
        path.unlink(missing_ok=True)
        if text is not None:
            path.write_text(text)
        with pytest.raises(ValueError, match=match):
            read_rinex_nav(path)
    (tmp_path / "bad.rnx").write_bytes(np.random.default_rng(1).bytes(4_000))
    with pytest.raises(ValueError, match="not RINEX"):
        read_rinex_nav(tmp_path / "bad.rnx")
    (tmp_path / "bad.gz").write_bytes(gzip.compress(good.encode())[:-30])
    with pytest.raises(ValueError, match="cannot be read"):
        read_rinex_nav(tmp_path / "bad.gz")
    # A decompression bomb is cut at the cap.
    (tmp_path / "bad.gz").write_bytes(gzip.compress(b"0" * 40_000_000))
    with pytest.raises(ValueError, match="32 MiB"):
        read_rinex_nav(tmp_path / "bad.gz")


def test_a_grid_that_would_not_fit_is_refused(tmp_path):
    eph = np.repeat(BOTH[5:6], 12_000)
    eph["prn"] = np.arange(eph.size) % 32 + 1
    absolute = 16.0 * np.arange(eph.size)
    eph["toe_s"] = eph["toc_s"] = absolute % 604_800
    with pytest.raises(ValueError, match="too many epochs"):
        read_rinex_nav(written(tmp_path, eph))


def test_without_georinex_the_error_names_the_extra(tmp_path, monkeypatch):
    path = written(tmp_path)
    real = builtins.__import__

    def absent(name, *args, **kw):
        if name == "georinex":
            raise ModuleNotFoundError("No module named 'georinex'", name="georinex")
        return real(name, *args, **kw)

    monkeypatch.setattr(builtins, "__import__", absent)
    with pytest.raises(ModuleNotFoundError, match=r"gnss-baseband\[rinex\]"):
        read_rinex_nav(path)
