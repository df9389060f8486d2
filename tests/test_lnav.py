"""LNAV: message against the textbook, decoder against everything a channel does to bits."""

import naive_message as naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from signals import lnav
from signals.almanac import elements
from signals.constants import EARTH_RATE_RAD_S, GNSS_PI, MU_GPS_M3_S2
from signals.fields import pack
from signals.records import EPHEMERIS, IONO_UTC

WEEK = 2200
TABLES = {1: lnav.SUBFRAME_1, 2: lnav.SUBFRAME_2, 3: lnav.SUBFRAME_3}
CARRIED = {f.name: f for table in TABLES.values() for f in table if f.name in EPHEMERIS.names}


def ephemeris(prn: int = 5, iode: int = 77, **fields: float) -> np.void:
    record = np.zeros((), EPHEMERIS)[()]
    record["system"], record["prn"], record["week"] = b"G", prn, WEEK
    record["toe_s"] = record["toc_s"] = 7200.0
    record["iode"], record["iodc"] = iode, iode + 256
    record["sqrt_a_sqrt_m"], record["e"], record["i0_rad"] = 5153.6, 0.0123, 0.96
    record["m0_rad"], record["omega0_rad"], record["omega_rad"] = 2.9, -2.1, 0.7
    record["omega_dot_rad_s"], record["idot_rad_s"], record["delta_n_rad_s"] = -8.1e-9, 1.2e-10, 4.6e-9
    record["cuc_rad"], record["cus_rad"], record["cic_rad"], record["cis_rad"] = 1e-6, -7e-6, 5e-8, -1e-7
    record["crc_m"], record["crs_m"], record["tgd_s"] = 211.5, -20.25, -1.1e-8
    record["af0_s"], record["af1_s_s"], record["accuracy_index"] = -1.2e-4, 3.4e-12, 2
    for name, value in fields.items():
        record[name] = value
    return record


def iono_utc() -> np.void:
    record = np.zeros((), IONO_UTC)[()]
    record["alpha"] = 4 * 2.0**-30, 2 * 2.0**-27, -(2.0**-24), -(2.0**-24)
    record["beta"] = 44 * 2.0**11, 3 * 2.0**14, -(2.0**16), -5 * 2.0**16
    record["a0_utc_s"], record["a1_utc_s_s"], record["tot_s"] = 7 * 2.0**-30, -3 * 2.0**-50, 4096.0 * 60
    record["week_t"], record["dt_ls_s"], record["week_lsf"], record["dn"] = WEEK + 1, 18, WEEK - 100, 7
    record["dt_lsf_s"] = 18
    return record


def same(decoded: np.void | None, sent: np.void) -> bool:
    """Equal in every field of the message (tow_s is the receiver's own)."""
    sent = lnav.quantised(sent)
    return decoded is not None and all(decoded[n] == sent[n] for n in EPHEMERIS.names if n != "tow_s")


def stream(
    seconds: int, tow_s: int = 0, record: np.ndarray | np.void | None = None, **options: object
) -> np.ndarray:
    record = ephemeris() if record is None else record
    args = {"iono": None, "almanac": None, "week": WEEK} | options
    return lnav.encode(record, args["iono"], args["almanac"], args["week"], tow_s, 50 * seconds)


def flip(bits: np.ndarray, *places: int) -> np.ndarray:
    bits = bits.copy()
    bits[list(places)] *= -1
    return bits


# --- the message ---


def test_parity_vector() -> None:
    assert [lnav.parity(0x8B0ABC, p) for p in range(4)] == [0b111110, 0b101000, 0b010111, 0b000001]


@given(st.integers(0, 2**24 - 1), st.integers(0, 3))
@settings(max_examples=200, deadline=None)
def test_parity_equals_the_equations(data: int, previous: int) -> None:
    d = [int(b) for b in format(data, "024b")]
    assert lnav.parity(data, previous) == naive.value(naive.parity(d, previous >> 1, previous & 1))


def test_frame_as_a_textbook_reads_it() -> None:
    bits = ((1 - stream(60, 604_770)) // 2).tolist()
    words = naive.lnav_words(bits)
    assert all(good for _, good in words)
    for k in range(10):
        tlm, how = words[10 * k][0], words[10 * k + 1][0]
        assert tlm[:8] == [1, 0, 0, 0, 1, 0, 1, 1]
        assert naive.value(how[:17]) == (100_795 + k + 1) % 100_800
        assert naive.value(how[19:22]) == k % 5 + 1
        assert bits[300 * k + 58 : 300 * k + 60] == [0, 0] == bits[300 * k + 298 : 300 * k + 300]
    weeks = [naive.value(words[k][0][:10]) for k in (2, 52)]
    assert weeks == [WEEK % 1024, (WEEK + 1) % 1024]  # the week changes with the subframe sent at its start


@given(st.integers(0, 604_799), st.integers(0, 40), st.integers(1, 700))
@settings(max_examples=30, deadline=None)
def test_any_start_reads_the_same_stream(tow_s: int, later_s: int, n_bits: int) -> None:
    almanac = np.array([ephemeris(prn) for prn in (1, 5, 31)])
    whole = lnav.encode(ephemeris(), iono_utc(), almanac, WEEK, tow_s, 50 * later_s + n_bits)
    week, tow = divmod(WEEK * 604_800 + tow_s + later_s, 604_800)
    assert np.array_equal(
        whole[50 * later_s :], lnav.encode(ephemeris(), iono_utc(), almanac, week, tow, n_bits)
    )


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_round_trip_of_any_ephemeris(data: st.DataObject) -> None:
    """Any value between the limits comes back within half the last bit, exact fields exactly."""
    record = ephemeris()
    for name, field in CARRIED.items():
        low, high = field.limits
        if field.exact:
            record[name] = data.draw(st.integers(low, high)) * field.lsb
        else:
            record[name] = data.draw(st.floats(low * field.lsb, high * field.lsb))
    record["iode"] = record["iodc"] & 0xFF
    decoder = lnav.Decoder(5)
    decoder.feed(stream(18, 0, record), 0)
    got = decoder.ephemeris
    assert got is not None
    for name, field in CARRIED.items():
        error = abs(got[name] - record[name])
        if field.cyclic:
            error = min(error, abs(error - field.lsb * 2.0**field.n))
        assert error <= 0.5 * field.lsb * (1 + 1e-6) + 1e-15 * abs(record[name]), name
    toe = int(record["toe_s"])
    assert got["week"] * 604_800 + toe - WEEK * 604_800 in range(-302_400, 302_401)


@pytest.mark.parametrize(
    "name", [n for n, f in CARRIED.items() if not f.cyclic and n not in ("iode", "iodc")]
)
def test_out_of_range_is_refused_by_name(name: str) -> None:
    field = CARRIED[name]
    for raw in (field.limits[1] + 1, field.limits[0] - 1):
        with pytest.raises(ValueError, match=rf"G05: {name} = .*allowed"):
            stream(30, 0, ephemeris(**{name: raw * field.lsb}))


def test_angles_come_back_within_half_a_turn() -> None:
    """Angles are sent modulo one turn (of the ICD's pi), however the record counts them."""
    decoder = lnav.Decoder(5)
    decoder.feed(stream(18, 0, ephemeris(m0_rad=3.3, omega0_rad=-9.0, omega_rad=np.pi)), 0)
    assert decoder.ephemeris is not None
    turn, lsb = 2 * GNSS_PI, GNSS_PI * 2**-31
    for name, want in (("m0_rad", 3.3 - turn), ("omega0_rad", -9.0 + turn)):
        assert abs(decoder.ephemeris[name] - want) <= lsb
    assert abs(abs(decoder.ephemeris["omega_rad"]) - GNSS_PI) <= lsb


def test_other_values_that_cannot_be_sent() -> None:
    with pytest.raises(ValueError, match="e = nan is not a finite number"):
        stream(30, 0, ephemeris(e=np.nan))
    with pytest.raises(ValueError, match=r"toe_s = 7203\.0 must be a whole multiple of 16 s"):
        stream(30, 0, ephemeris(toe_s=7203.0))
    with pytest.raises(ValueError, match="IODE 78 must equal the low 8 bits of IODC 333"):
        stream(30, 0, ephemeris(iodc=333, iode=78))
    with pytest.raises(ValueError, match="one GPS satellite"):
        stream(30, 0, np.array([ephemeris(5), ephemeris(6)]))
    for tow_s in (-1, 604_800, 0.5):
        with pytest.raises(ValueError, match="must be a whole second from 0 to 604799"):
            lnav.encode(ephemeris(), None, None, WEEK, tow_s, 300)


# --- the decoder ---


@pytest.mark.parametrize("sign", [1, -1])
def test_clean_stream(sign: int) -> None:
    """From the middle of a subframe; inverted streams need no repair but say so."""
    decoder = lnav.Decoder(5)
    events = decoder.feed(0.3 * sign * stream(100, 2).astype(np.float32), 1000)
    assert [e[1] for e in events] == [(k + 1) % 5 + 1 for k in range(16)]
    assert all(e[3] for e in events)
    assert events[0][2] == 1000 + 200
    assert (decoder.polarity, decoder.synced, decoder.words_failed, decoder.words_ok) == (sign, True, 0, 160)
    assert decoder.tow_of(1000) == 2000
    assert decoder.tow_of(1001) == 2020
    assert decoder.week == WEEK
    assert (decoder.health, decoder.healthy) == (0, True)
    assert same(decoder.ephemeris, ephemeris())


@given(st.lists(st.integers(1, 400), min_size=1, max_size=30), st.sampled_from([1, -1]))
@settings(max_examples=25, deadline=None)
def test_chunks_do_not_matter(chunks: list[int], sign: int) -> None:
    bits = flip(sign * stream(60, 3), 700, 701, 1555)
    whole, pieces = lnav.Decoder(5), lnav.Decoder(5)
    expected = whole.feed(bits, 50)
    events, at = [], 0
    for n in (*chunks, bits.size):
        events += pieces.feed(bits[at : at + n], 50 + at)
        at += n
        at = min(at, bits.size)
    assert events == expected
    assert pieces.tow_of(0) == whole.tow_of(0)
    assert pieces.words_failed == whole.words_failed


def test_time_waits_for_a_second_header() -> None:
    bits, decoder = stream(30, 0), lnav.Decoder(5)
    decoder.feed(bits[:300], 0)
    assert decoder.tow_of(0) is None
    decoder.feed(bits[300:600], 300)
    assert decoder.tow_of(0) == 0


def test_preambles_inside_the_data_do_not_deceive() -> None:
    """0x8B and 0x74 all over the subframe, and random bits without any message."""
    record = ephemeris(omega0_rad=0.0, crs_m=0x0B8B * 2**-5, cuc_rad=0x748B * 2**-29, cic_rad=0x748B * 2**-29)
    bits = stream(60, 1, record)
    decoder = lnav.Decoder(5)
    assert all(e[3] and (e[2] - 250) % 300 == 0 for e in decoder.feed(bits, 0))
    noise = lnav.Decoder(5)
    assert noise.feed(np.random.default_rng(1).standard_normal(100_000).astype(np.float32), 0) == []
    assert not noise.synced
    assert noise.polarity == 0


def test_gap_drops_time_until_a_header_agrees() -> None:
    bits, decoder = stream(120, 0), lnav.Decoder(5)
    decoder.feed(bits[:1000], 0)
    assert decoder.tow_of(0) == 0
    decoder.feed(bits[1100:1250], 1100)
    assert decoder.tow_of(0) is None
    assert not decoder.synced
    decoder.feed(bits[1250:1260], 1250)
    assert decoder.synced
    assert decoder.tow_of(1500) == 30_000
    events = decoder.feed(bits[1260:1500], 1260)
    assert events == [("subframe", 5, 1200, True)]
    # an index that starts anew: one header contradicts the old count, the second settles the new one
    decoder.feed(bits[3300:3600], 0)
    assert decoder.tow_of(0) is None
    decoder.feed(bits[3600:4500], 300)
    assert decoder.tow_of(0) == 66_000
    assert decoder.week is None  # the old week belonged to the old numbering
    decoder.feed(bits[4500:4800], 1200)
    assert decoder.week == WEEK


@pytest.mark.parametrize("at, missing", [(700, 1), (700, 7), (850, 75), (700, 300), (700, 650)])
def test_a_hole_that_no_index_tells_is_seen_at_the_next_header(at: int, missing: int) -> None:
    """Bits vanish and the count goes on: time, and week, are right from the first whole header after them."""
    decoder, bits = lnav.Decoder(5), stream(60)
    decoder.feed(1.0 - 2.0 * bits[:at], 0)
    assert decoder.tow_of(0) == 0 and decoder.week is not None
    rest = bits[at + missing :]
    header = -(-(at + missing) // 300) * 300 - at - missing + 60
    decoder.feed(1.0 - 2.0 * rest[: header - 1], at)
    assert decoder.tow_of(0) == 0
    decoder.feed(1.0 - 2.0 * rest[header - 1 : header + 240], at + header - 1)
    assert decoder.tow_of(0) == 20 * missing and decoder.week_of(at) == WEEK
    assert decoder.synced and decoder.subframes_ok > 0


def test_half_cycle_slip_costs_the_word_it_hits() -> None:
    bits = stream(60, 0).astype(np.float32)
    bits[6 * 50 * 2 + 100 :] *= -1  # in word 4 of subframe 3
    decoder = lnav.Decoder(5)
    events = decoder.feed(bits, 0)
    assert [e[3] for e in events] == [k != 2 for k in range(10)]
    assert decoder.words_failed == 1
    assert decoder.polarity == -1
    assert same(decoder.ephemeris, ephemeris())


def test_noise_never_yields_a_wrong_ephemeris() -> None:
    """Bit error rate 1 %: words pass with probability (0.99^32) on average; what passes is right.

    A word is undetected wrong only with 4 or more errors that parity misses: 32-bit words, C(32,4) 1e-8 2^-6
    = 6e-6.
    """
    rng = np.random.default_rng(2)
    decoder, bits = lnav.Decoder(5), stream(3000, 0).astype(np.float32)
    bits *= np.where(rng.random(bits.size) < 0.01, -1, 1).astype(np.float32)
    for first in range(0, bits.size, 300):
        decoder.feed(bits[first : first + 300], first)
        assert decoder.ephemeris is None or same(decoder.ephemeris, ephemeris())
    n = decoder.words_ok + decoder.words_failed
    # 30 bits of the word and the two before it must be right (pairs of errors are always detected)
    p = 0.99**32
    assert abs(decoder.words_ok / n - p) < 5 * np.sqrt(p * (1 - p) / n) * np.sqrt(2) + 0.01
    assert same(decoder.ephemeris, ephemeris())
    assert decoder.tow_of(0) == 0


@pytest.mark.parametrize(
    "sent, read", [("abaaa", "aaaaa"), ("baaaa", "bbaaa"), ("ababa", "aaaaa"), ("abbaa", "aabba")]
)
def test_another_clock_under_the_same_issue_is_believed_when_it_comes_twice(sent: str, read: str) -> None:
    """Frames b carry another af0 than a, in a word that passes parity."""
    records = {"a": ephemeris(), "b": ephemeris(af0_s=-9e-5)}
    streams = {name: stream(150, record=record).astype(np.float32) for name, record in records.items()}
    decoder = lnav.Decoder(5)
    for k, (now, expected) in enumerate(zip(sent, read)):
        part = slice(1500 * k, 1500 * (k + 1))
        assert all(ok for *_, ok in decoder.feed(streams[now][part], part.start))
        assert same(decoder.ephemeris, records[expected])


def test_loss_of_sync_and_recovery() -> None:
    bits = stream(90, 0).astype(np.float32)
    bits[900:2000] = np.random.default_rng(3).standard_normal(1100)
    moved = np.concatenate((bits[:2000], bits[2007:]))  # a slip of seven bits that the index did not notice
    decoder = lnav.Decoder(5)
    good = [e for e in decoder.feed(moved, 0) if e[3]]
    assert good[-1][2] % 300 == 300 - 7
    assert decoder.tow_of(4193) == 84_000


def test_cut_over_never_mixes_data_sets() -> None:
    """Two sets 2 h apart; the new one goes on air two hours before its toe, here at 7200 s of week."""
    old = ephemeris(iode=10)
    new = ephemeris(iode=11, toe_s=14_400.0, toc_s=14_400.0, m0_rad=-1.0, sqrt_a_sqrt_m=5153.7, i0_rad=0.961)
    bits = stream(120, 7200 - 60, np.array([new, old]))
    decoder, seen = lnav.Decoder(5), []
    for first in range(0, bits.size, 50):
        decoder.feed(bits[first : first + 50], first)
        if decoder.ephemeris is not None:
            assert same(decoder.ephemeris, old) or same(decoder.ephemeris, new)
        seen.append(None if decoder.ephemeris is None else int(decoder.ephemeris["iode"]))
    assert seen.index(10) == 17
    assert seen.index(11) == 60 + 17
    # subframe 2 of the first new frame lost: the old set stays until the next frame
    decoder, damaged = lnav.Decoder(5), flip(bits, 60 * 50 + 300 + 100)
    decoder.feed(damaged[: 90 * 50], 0)
    assert same(decoder.ephemeris, old)
    decoder.feed(damaged[90 * 50 :], 90 * 50)
    assert same(decoder.ephemeris, new)


@pytest.mark.parametrize(
    "record", [ephemeris(), ephemeris(toe_s=604_784.0, week=WEEK - 1), ephemeris(toe_s=0.0, week=WEEK)]
)
def test_week_of_toe_around_the_roll_over(record: np.void) -> None:
    for week, tow_s in ((WEEK - 1, 604_740), (WEEK, 0)):
        decoder = lnav.Decoder(5)
        decoder.feed(stream(120, tow_s, record, week=week), 0)
        assert decoder.ephemeris is not None
        assert decoder.ephemeris["week"] == record["week"]
        assert decoder.tow_of(0) == tow_s * 1000
        assert decoder.tow_of(3000) == (tow_s + 60) % 604_800 * 1000
        assert decoder.week_of(2999) == week
        assert decoder.week_of(3000) == (WEEK if tow_s else week)


def test_week_era() -> None:
    """Ten bits of week: 1200 and 2224 look alike; the caller's first week decides."""
    bits = stream(60, 0, ephemeris(week=1200), week=1200)
    for first_week, week in ((lnav.FIRST_WEEK, 2224), (1024, 1200), (1200, 1200), (1201, 2224)):
        decoder = lnav.Decoder(5, first_week)
        decoder.feed(bits, 0)
        assert decoder.week == week


def test_health_and_alert() -> None:
    decoder = lnav.Decoder(5)
    assert decoder.healthy is None
    decoder.feed(stream(30, 0, ephemeris(health=63)), 0)
    assert (decoder.health, decoder.healthy) == (63, False)
    assert decoder.ephemeris is not None
    assert decoder.ephemeris["health"] == 63


def test_alert_flag_makes_a_healthy_satellite_unusable() -> None:
    values = {"preamble": lnav.PREAMBLE, "tlm_message": 0, "integrity": 0, "anti_spoof": 1}
    frame = []
    for k in range(5):
        header = values | {"tow_count": k + 1, "subframe": k + 1, "alert": k >= 1}
        body = lnav._ephemeris_subframe(ephemeris(), min(k + 1, 3), WEEK, "test")
        frame.append(pack(lnav.HEADER, header, 300, "test") | body)
    bits, decoder = 1 - 2 * lnav.transmit(frame).astype(np.int8), lnav.Decoder(5)
    decoder.feed(bits[:300], 0)
    assert (decoder.alert, decoder.healthy) == (False, True)
    decoder.feed(bits[300:], 300)
    assert (decoder.alert, decoder.health, decoder.healthy) == (True, 0, False)


def test_iono_utc_and_almanac_over_one_master_frame() -> None:
    almanac = np.array([ephemeris(prn, health=3 * (prn == 7)) for prn in (1, 5, 7, 25, 32)])
    sent = iono_utc()
    decoder = lnav.Decoder(5)
    decoder.feed(stream(780, 0, iono=sent, almanac=almanac), 0)
    assert decoder.iono_utc_valid == {"klobuchar", "utc"}
    for name in (
        "alpha",
        "beta",
        "a0_utc_s",
        "a1_utc_s_s",
        "tot_s",
        "week_t",
        "dt_ls_s",
        "week_lsf",
        "dn",
        "dt_lsf_s",
    ):
        assert np.array_equal(decoder.iono_utc[name], sent[name]), name
    assert sorted(decoder.almanac) == [1, 5, 7, 25, 32]
    assert [decoder.almanac[p]["health"] for p in (1, 7)] == [0, 3]
    fields = {f.name: f for f in lnav.ALMANAC}
    want = elements(ephemeris(), WEEK, 4096)
    for name in (
        "e",
        "sqrt_a_sqrt_m",
        "omega0_rad",
        "m0_rad",
        "omega_rad",
        "omega_dot_rad_s",
        "af0_s",
        "af1_s_s",
    ):
        assert abs(decoder.almanac[5][name] - want[name]) <= 0.5001 * fields[name].lsb, name
    without = lnav.Decoder(5)
    without.feed(stream(780, 0), 0)
    assert without.iono_utc_valid == set()
    assert without.almanac == {}


def test_time_polynomial_keeps_its_value_off_the_grid() -> None:
    sent = iono_utc()
    sent["tot_s"], sent["a1_utc_s_s"] = 3600.0 * 33, 1e-10
    decoder = lnav.Decoder(5)
    decoder.feed(stream(40, 17 * 30, iono=sent), 0)
    got = decoder.iono_utc
    assert got["tot_s"] % 4096 == 0
    at = 200_000.0
    want, have = (r["a0_utc_s"] + r["a1_utc_s_s"] * (at - r["tot_s"]) for r in (sent, got))
    assert abs(want - have) < 2**-31 + 2**-51 * abs(at - got["tot_s"])


def node_and_anomaly(
    m0: float, node: float, node_rate: float, n: float, toe_s: float, t_s: float
) -> tuple[float, float]:
    """Mean anomaly and longitude of the node at second `t_s` of the week of the reference time."""
    return m0 + n * (t_s - toe_s), node + (node_rate - EARTH_RATE_RAD_S) * (
        t_s - toe_s
    ) - EARTH_RATE_RAD_S * toe_s


@pytest.mark.parametrize("weeks", [0, 1])
def test_almanac_describes_the_same_orbit(weeks: int) -> None:
    record = ephemeris(idot_rad_s=0.0, toe_s=600_000.0, toc_s=600_000.0)
    toa_s = 4096
    reduced = elements(record, WEEK + weeks, toa_s)
    n = np.sqrt(MU_GPS_M3_S2) / record["sqrt_a_sqrt_m"] ** 3 + record["delta_n_rad_s"]
    rate = record["omega_dot_rad_s"]
    age_s = weeks * 604_800 + toa_s - 600_000.0
    assert abs(reduced["af0_s"] - (record["af0_s"] + record["af1_s_s"] * age_s)) < 1e-15
    for t_s in (0.0, 300_000.0, 650_000.0):  # in the week of the record
        want = node_and_anomaly(record["m0_rad"], record["omega0_rad"], rate, n, 600_000.0, t_s)
        have = node_and_anomaly(
            reduced["m0_rad"], reduced["omega0_rad"], rate, n, toa_s, t_s - 604_800.0 * weeks
        )
        for a, b in zip(want, have, strict=True):
            assert abs(np.angle(np.exp(1j * (a - b)))) < 1e-9
