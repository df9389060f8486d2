"""I/NAV: pages against the textbook, decoder against everything a channel does to symbols."""

import naive_message as naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from signals import fec, inav
from signals.almanac import elements
from signals.fields import bits_of, pack
from signals.records import EPHEMERIS, IONO_UTC

WEEK = 2200
CARRIED = {
    f.name: f for k in (1, 2, 3, 4, 5) for f in inav.WORDS[k] if f.name in EPHEMERIS.names and f.name != "prn"
}


def ephemeris(prn: int = 5, iode: int = 77, **fields: float) -> np.void:
    record = np.zeros((), EPHEMERIS)[()]
    record["system"], record["prn"], record["week"] = b"E", prn, WEEK
    record["toe_s"] = record["toc_s"] = 7200.0
    record["iode"] = record["iodc"] = iode
    record["sqrt_a_sqrt_m"], record["e"], record["i0_rad"] = 5440.61, 0.0003, 0.98
    record["m0_rad"], record["omega0_rad"], record["omega_rad"] = -0.4, 2.3, -1.9
    record["omega_dot_rad_s"], record["idot_rad_s"], record["delta_n_rad_s"] = -5.5e-9, -2e-10, 3.1e-9
    record["cuc_rad"], record["cus_rad"], record["cic_rad"], record["cis_rad"] = 5e-6, 8e-6, -3e-8, 2e-8
    record["crc_m"], record["crs_m"], record["tgd_s"], record["bgd_e5a_s"] = 171.5, 120.25, -3.9e-9, 2.8e-9
    record["af0_s"], record["af1_s_s"], record["accuracy_index"] = 4.7e-4, -7.8e-12, 107
    for name, value in fields.items():
        record[name] = value
    if "iode" in fields:
        record["iodc"] = record["iode"]
    return record


def iono_utc() -> np.void:
    record = np.zeros((), IONO_UTC)[()]
    record["ai"] = 61.25, -45 * 2.0**-8, 143 * 2.0**-15
    record["a0_utc_s"], record["a1_utc_s_s"], record["tot_s"] = 5 * 2.0**-30, 2 * 2.0**-50, 3600.0 * 48
    record["week_t"], record["dt_ls_s"], record["week_lsf"], record["dn"] = WEEK, 18, WEEK - 100, 7
    record["dt_lsf_s"] = 18
    record["a0g_s"], record["a1g_s_s"] = 77 * 2.0**-35, -3 * 2.0**-51
    record["t0g_s"], record["week_0g"] = 7200.0, WEEK
    return record


def same(decoded: np.void | None, sent: np.void) -> bool:
    """Equal in every field of the message (tow_s is the receiver's own)."""
    sent = inav.quantised(sent)
    return decoded is not None and all(decoded[n] == sent[n] for n in EPHEMERIS.names if n != "tow_s")


def stream(seconds: int, tow_s: int = 0, record=None, **options) -> np.ndarray:
    record = ephemeris() if record is None else record
    args = {"iono": None, "almanac": None, "week": WEEK} | options
    signs = inav.encode(record, args["iono"], args["almanac"], args["week"], tow_s, 250 * seconds)
    return signs.astype(np.float32)


def page(word: int) -> np.ndarray:
    return 1.0 - 2.0 * inav.page_symbols(word).astype(np.float32)


def word(number: int, record: np.void | None = None, **extra: float) -> int:
    record = ephemeris() if record is None else record
    values = {n: record[n] for n in EPHEMERIS.names if n != "system"} | {"type": number} | extra
    return pack(inav.WORDS[number], values, 128, "test")


def types(events: list) -> list[int]:
    return [event[1] for event in events]


# --- the message ---


@given(st.integers(0, 2**128 - 1), st.sampled_from(inav.SECONDARY_SYNC))
@settings(max_examples=30, deadline=None)
def test_page_equals_the_textbook(content: int, secondary: int) -> None:
    ours = inav.page_symbols(content, secondary).tolist()
    assert ours == naive.page(bits_of(content, 128).tolist(), bits_of(secondary, 8).tolist())


def test_order_time_and_secondary_sync() -> None:
    """Even parts at odd seconds, order of the ICD, TOW and WN of the even part, SSP by GST mod 6."""
    decoder, symbols = inav.Decoder(5), stream(120, 604_740, iono=iono_utc(), week=WEEK - 1)
    events = decoder.feed(symbols, 0)
    assert events[0][2] == 250
    first = [2, 4, 6, 7, 8, 63, 63, 63, 0, 63, 1, 3, 5, 0, 63]
    second = [2, 4, 6, 9, 10, 63, 63, 63, 0, 63, 1, 3, 5, 0, 63]
    assert types(events) == (2 * (first + second))[:59]
    for kind, index in ((e[1], e[2]) for e in events):
        odd, _ = inav.decode_part(symbols[index + 250 : index + 500])
        second_of_week = (604_740 + index // 250) % 604_800
        want = inav.SECONDARY_SYNC[second_of_week % 6 // 2] if kind != 63 else 0
        assert naive.value(odd[106:114].tolist()) == want
        even, _ = inav.decode_part(symbols[index : index + 250])
        content = even[2:114].tolist() + odd[2:18].tolist()
        if kind in (0, 5, 6):
            start = {0: 109, 5: 86, 6: 106}[kind]
            assert naive.value(content[start - 1 : start + 19]) == second_of_week
        if kind in (0, 5):
            start = {0: 97, 5: 74}[kind]
            week = naive.value(content[start - 1 : start + 11]) + 1024
            assert week == (WEEK if index >= 250 * 60 else WEEK - 1)


@given(st.integers(0, 604_799), st.integers(0, 70), st.integers(1, 900))
@settings(max_examples=20, deadline=None)
def test_any_start_reads_the_same_stream(tow_s: int, later_s: int, n: int) -> None:
    almanac = np.array([ephemeris(prn) for prn in (1, 2, 3, 30)])
    whole = inav.encode(ephemeris(), iono_utc(), almanac, WEEK, tow_s, 250 * later_s + n)
    week, tow = divmod(WEEK * 604_800 + tow_s + later_s, 604_800)
    assert np.array_equal(whole[250 * later_s :], inav.encode(ephemeris(), iono_utc(), almanac, week, tow, n))


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
    record["iodc"] = record["iode"]
    record["health"] = data.draw(st.integers(0, 7))
    decoder = inav.Decoder(5)
    decoder.feed(stream(33, 0, record), 0)
    got = decoder.ephemeris
    assert got is not None
    for name, field in CARRIED.items():
        error = abs(got[name] - record[name])
        if field.cyclic:
            error = min(error, abs(error - field.lsb * 2.0**field.n))
        assert error <= 0.5 * field.lsb * (1 + 1e-6) + 1e-15 * abs(record[name]), name
    assert got["health"] == record["health"] == decoder.health
    assert decoder.healthy == (record["health"] == 0)
    assert got["week"] * 604_800 + int(record["toe_s"]) - WEEK * 604_800 in range(-302_400, 302_401)


@pytest.mark.parametrize("name", [n for n, f in CARRIED.items() if not f.cyclic])
def test_out_of_range_is_refused_by_name(name: str) -> None:
    field = CARRIED[name]
    for raw in (field.limits[1] + 1, field.limits[0] - 1):
        with pytest.raises(ValueError, match=rf"E05: {name} = .*allowed"):
            stream(60, 0, ephemeris(**{name: raw * field.lsb}))


def test_other_values_that_cannot_be_sent() -> None:
    with pytest.raises(ValueError, match=r"toc_s = 7210\.0 must be a whole multiple of 60 s"):
        stream(30, 0, ephemeris(toc_s=7210.0))
    with pytest.raises(ValueError, match="SVID 40 is not in 1 to 36"):
        stream(30, 0, ephemeris(prn=40))
    with pytest.raises(ValueError, match=r"e1b_hs = 4\.0"):
        stream(30, 0, ephemeris(health=8))
    for tow_s in (-1, 604_800, 0.5):
        with pytest.raises(ValueError, match="must be a whole second from 0 to 604799"):
            inav.encode(ephemeris(), None, None, WEEK, tow_s, 300)
    with pytest.raises(ValueError, match="NaN or infinity"):
        inav.Decoder(5).feed(np.array([1.0, np.nan]), 0)


# --- the decoder ---


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("tow_s", [100, 101])
def test_clean_stream(sign: int, tow_s: int) -> None:
    """Starting with an odd or an even part, upright or inverted."""
    decoder = inav.Decoder(5)
    symbols = 0.01 * sign * stream(65, tow_s, iono=iono_utc())
    events = decoder.feed(symbols, 5000)
    assert all(e[3] for e in events)
    assert events[0][2] == 5000 + 250 * (tow_s % 2 == 0)
    assert len(events) == 32
    assert (decoder.polarity, decoder.synced, decoder.pages_failed, decoder.pages_ok) == (sign, True, 0, 32)
    assert (decoder.tow_of(5000), decoder.tow_of(5001)) == (tow_s * 1000, tow_s * 1000 + 4)
    assert decoder.week == WEEK
    assert (decoder.health, decoder.healthy, decoder.svid) == (0, True, 5)
    assert same(decoder.ephemeris, ephemeris())
    assert decoder.iono_utc_valid == {"nequick", "utc", "ggto"}
    for name in IONO_UTC.names:
        assert np.array_equal(decoder.iono_utc[name], iono_utc()[name]), name
    assert decoder.ggto == (77 * 2.0**-35, -3 * 2.0**-51, 7200.0, WEEK)


@given(st.lists(st.integers(1, 800), min_size=1, max_size=40), st.sampled_from([1, -1]))
@settings(max_examples=15, deadline=None)
def test_chunks_do_not_matter(chunks: list[int], sign: int) -> None:
    symbols = sign * stream(40, 17) + np.random.default_rng(1).normal(0, 0.5, 10_000).astype(np.float32)
    whole, pieces = inav.Decoder(5), inav.Decoder(5)
    expected = whole.feed(symbols, 50)
    events, at = [], 0
    for n in (*chunks, symbols.size):
        events += pieces.feed(symbols[at : at + n], 50 + at)
        at = min(at + n, symbols.size)
    assert events == expected
    assert pieces.tow_of(0) == whole.tow_of(0) is not None


def test_time_waits_for_a_second_word() -> None:
    symbols, decoder = stream(40, 16), inav.Decoder(5)
    decoder.feed(symbols[: 250 * 8], 0)
    assert decoder.words[0] == 1
    assert decoder.tow_of(0) is None
    decoder.feed(symbols[250 * 8 :], 250 * 8)
    assert decoder.tow_of(0) == 16_000


def test_sync_patterns_by_chance_do_not_deceive() -> None:
    """Noise alone, with a forest of true sync patterns 250 apart but no page."""
    symbols = np.random.default_rng(2).standard_normal(60_000).astype(np.float32)
    for start in (3, 40, 77, 130):
        for part in range(start, symbols.size - 10, 250):
            symbols[part : part + 10] = 3.0 * inav.SYNC_SIGNS
    decoder = inav.Decoder(5)
    assert decoder.feed(symbols, 0) == []
    assert not decoder.synced
    assert decoder.polarity == 0


def test_odd_with_next_even_is_no_page() -> None:
    """An even part goes with the very next odd part: with another page's, only equal dummies pass."""
    symbols = stream(60, 1).reshape(-1, 250)
    swapped = symbols.copy()
    swapped[0::2], swapped[1::2] = symbols[1::2], symbols[0::2]
    decoder = inav.Decoder(5)
    events = decoder.feed(swapped.ravel()[: 250 * 59], 0)
    assert {e[1] for e in events} <= {-1, 63}
    assert -1 in types(events)


def test_lost_part_loses_its_page_only() -> None:
    symbols, decoder = stream(60, 1), inav.Decoder(5)
    events = decoder.feed(symbols[: 250 * 9], 0)
    events += decoder.feed(symbols[250 * 10 :], 250 * 10)
    assert types(events[:6]) == [2, 4, 63, 7, 63, 63]
    assert [e[2] for e in events[3:5]] == [1500, 2500]
    assert same(decoder.ephemeris, ephemeris())
    assert decoder.tow_of(0) == 1000


def test_gap_drops_time_until_a_word_agrees() -> None:
    symbols, decoder = stream(150, 0), inav.Decoder(5)
    decoder.feed(symbols[: 250 * 60], 0)
    assert decoder.tow_of(0) == 0
    decoder.feed(symbols[250 * 61 : 250 * 71], 250 * 61)
    assert decoder.tow_of(0) is None
    assert decoder.week is None
    decoder.feed(symbols[250 * 71 : 250 * 79], 250 * 71)  # the first word 0
    assert decoder.tow_of(0) == 0
    assert decoder.week == WEEK
    decoder.feed(symbols[250 * 90 : 250 * 110], 0)  # numbering anew: word 0 and 5 needed
    assert decoder.tow_of(0) is None
    decoder.feed(symbols[250 * 110 : 250 * 118], 250 * 20)
    assert decoder.tow_of(0) == 90_000


@pytest.mark.parametrize("missing", [1, 25, 249, 375, 500, 1100])
def test_a_hole_that_no_index_tells_is_seen_at_the_next_page(missing: int) -> None:
    """Symbols vanish and the count goes on: no time from the page that fails, the right one from the next time word."""
    decoder, symbols = inav.Decoder(5), stream(120, 0)
    at = 250 * 60 + 333
    decoder.feed(symbols[:at], 0)
    assert decoder.tow_of(0) == 0 and decoder.week == WEEK
    decoder.feed(symbols[at + missing : 250 * 70], at)
    # Whole pages are missed by nothing but time.
    assert decoder.synced and (decoder.tow_of(0) in (None, 4 * missing) or missing % 500 == 0)
    decoder.feed(symbols[250 * 70 : 250 * 90], 250 * 70 - missing)
    assert decoder.tow_of(0) == 4 * missing and decoder.week_of(at) == WEEK


def test_half_cycle_slip_costs_one_page() -> None:
    symbols, decoder = stream(60, 1), inav.Decoder(5)
    symbols[250 * 10 + 130 :] *= -1
    events = decoder.feed(symbols, 0)
    assert [e[3] for e in events].count(False) == 1
    assert decoder.polarity == -1
    assert same(decoder.ephemeris, ephemeris())


def test_loss_of_sync_and_recovery() -> None:
    symbols = stream(90, 1)
    symbols[250 * 20 : 250 * 40] = np.random.default_rng(3).standard_normal(250 * 20)
    moved = np.concatenate((symbols[: 250 * 40], symbols[250 * 40 + 7 :]))  # a slip the index did not notice
    decoder = inav.Decoder(5)
    good = [e for e in decoder.feed(moved, 0) if e[3]]
    assert good[-1][2] % 500 == 500 - 7
    assert decoder.tow_of(500 - 7) == 3000


def test_change_of_iodnav_never_mixes() -> None:
    """The new set comes into force at its toe; until all four words are there the old one stays."""
    old = ephemeris(iode=76, toe_s=6600.0, toc_s=6600.0)
    new = ephemeris(iode=77, m0_rad=-0.2, af0_s=4.8e-4)
    symbols, decoder, seen = stream(120, 7200 - 60, np.array([new, old])), inav.Decoder(5), []
    for first in range(0, symbols.size, 250):
        decoder.feed(symbols[first : first + 250], first)
        assert decoder.ephemeris is None or same(decoder.ephemeris, old) or same(decoder.ephemeris, new)
        seen.append(None if decoder.ephemeris is None else int(decoder.ephemeris["iode"]))
    assert seen.index(76) == 26  # word 5 ends with second 26
    assert seen.index(77) == 60 + 24  # word 3
    # words 2 and 4 of the old set with 1 and 3 of the new one: nothing new
    decoder = inav.Decoder(5)
    order = [(5, new), (2, old), (4, old), (1, old), (3, old), (1, new), (3, new), (2, new)]
    for k, (number, record) in enumerate(order):
        extra = dict.fromkeys(("ai0", "ai1", "ai2", "storm_regions"), 0)
        extra |= inav._time_values(WEEK, 1 + 2 * k) | inav._health_values(0)
        decoder.feed(page(word(number, record, **extra)), 500 * k)
        if k >= 4:
            assert same(decoder.ephemeris, old)
    decoder.feed(page(word(4, new)), 500 * len(order))
    assert same(decoder.ephemeris, new)


def test_no_ephemeris_without_word_5() -> None:
    decoder = inav.Decoder(5)
    symbols = np.concatenate([page(word(k)) for k in (1, 2, 3, 4)])
    assert types(decoder.feed(symbols, 0)) == [1, 2, 3, 4]
    assert decoder.ephemeris is None
    assert decoder.healthy is None


def test_word_4_of_another_satellite_is_refused() -> None:
    decoder = inav.Decoder(6)
    decoder.feed(stream(65, 0), 0)
    assert decoder.svid == 5
    assert decoder.ephemeris is None


def test_dummy_unknown_and_reserved_words_pass_without_effect() -> None:
    decoder = inav.Decoder(5)
    numbers = [63, 21, 22, 16, 17, 20, 30, 62]
    symbols = np.concatenate([page(n << 122 | (1 << 122) - 1) for n in numbers])
    assert types(decoder.feed(symbols, 0)) == numbers
    assert decoder.words == dict.fromkeys(numbers, 1)
    assert decoder.pages_failed == 0
    assert (decoder.ephemeris, decoder.tow_of(0), decoder.health, decoder.almanac) == (None, None, None, {})


def test_alert_page_is_not_read_even_if_its_crc_holds() -> None:
    alert = 1.0 - 2.0 * np.array(naive.page(bits_of(4 << 122, 128).tolist(), 8 * [0], page_type=1))
    decoder = inav.Decoder(5)
    events = decoder.feed(np.concatenate((page(63 << 122), alert, page(63 << 122))), 0)
    assert types(events) == [63, -1, 63]
    assert decoder.svid is None


@pytest.mark.parametrize(("time", "known"), [(0, False), (1, False), (2, True), (3, False)])
def test_word_0_counts_only_when_it_says_so(time: int, known: bool) -> None:
    decoder = inav.Decoder(5)
    for k in range(3):
        values = {"type": 0, "time": time} | inav._time_values(WEEK, 17 + 2 * k)
        decoder.feed(page(pack(inav.WORD_0, values, 128, "test")), 500 * k)
    assert (decoder.tow_of(0) == 17_000) == known
    assert (decoder.week == WEEK) == known


def test_alert_page_is_dropped_and_harmless() -> None:
    """Its CRC runs over E5b too: ten in a row are neither good pages nor a reason to lose sync."""
    symbols = stream(60, 1)
    alert = naive.page(bits_of(0x1234 << 100, 128).tolist(), 8 * [0], page_type=1, crc_of=[1, 0, 1])
    for k in range(3, 13):
        symbols[500 * k : 500 * k + 500] = 1.0 - 2.0 * np.array(alert)
    decoder = inav.Decoder(5)
    events = decoder.feed(symbols, 0)
    assert [e[1] for e in events[3:13]] == 10 * [-1]
    assert (decoder.pages_alert, decoder.pages_failed, decoder.pages_ok) == (10, 0, 20)
    assert decoder.synced
    assert same(decoder.ephemeris, ephemeris())


def test_week_end() -> None:
    decoder = inav.Decoder(5)
    decoder.feed(stream(120, 604_740, ephemeris(toe_s=0.0, toc_s=0.0), week=WEEK - 1), 7)
    assert decoder.tow_of(7) == 604_740_000
    assert decoder.tow_of(7 + 250 * 60) == 0
    assert decoder.tow_of(6 + 250 * 60) == 604_799_996
    assert [decoder.week_of(k + 250 * 60) for k in (6, 7)] == [WEEK - 1, WEEK]
    assert decoder.week == WEEK
    assert decoder.ephemeris is not None
    assert decoder.ephemeris["week"] == WEEK


def test_almanac_of_four_satellites_takes_two_minutes() -> None:
    records = [ephemeris(prn, health=4 * (prn == 8)) for prn in (2, 5, 8, 33)]
    odd_orbit = ephemeris(14, sqrt_a_sqrt_m=5289.3, e=0.16)  # as E14 and E18: the format cannot hold it
    outdated = ephemeris(8, toe_s=600.0, m0_rad=3.0)
    almanac = np.array([*records, odd_orbit, outdated])
    decoder = inav.Decoder(5)
    decoder.feed(stream(125, 0, almanac=almanac), 0)
    assert sorted(decoder.almanac) == [2, 5, 8, 33]
    assert [decoder.almanac[p]["e1b_hs"] for p in (5, 8)] == [0, 2]
    fields = {f.name[:-2]: f for f in (*inav.WORD_7, *inav.WORD_8)}
    want = elements(ephemeris(), WEEK, 7200)
    for name in ("e", "omega0_rad", "m0_rad", "omega_rad", "omega_dot_rad_s", "af0_s", "af1_s_s"):
        for prn in (2, 5, 8, 33):
            assert abs(decoder.almanac[prn][name] - want[name]) <= 0.5001 * fields[name].lsb, name
    assert abs(decoder.almanac[8]["sqrt_a_sqrt_m"] - 5440.61) <= 2**-10 * 1.0001
    assert decoder.ggto is None
    assert "ggto" not in decoder.iono_utc_valid


def test_almanac_words_combine_only_in_order_with_one_ioda() -> None:
    groups = inav.almanac_groups(np.array([ephemeris(prn) for prn in (1, 2, 3)]))
    words = {k: inav._almanac_word(k, groups, 0, iono_utc()) for k in (7, 8, 9, 10)}
    other = {k: content ^ (1 << 118) for k, content in words.items()}  # last bit of IODa
    for order in ([9, 10, 7, 8], [7, 8, 10, 9], [8, 9, 10]):
        decoder = inav.Decoder(1)
        decoder.feed(np.concatenate([page(words[k]) for k in order]), 0)
        assert decoder.almanac == {}
    decoder = inav.Decoder(1)
    decoder.feed(np.concatenate([page(w) for w in (words[7], words[8], other[9], other[10])]), 0)
    assert decoder.almanac == {}
    decoder.feed(np.concatenate([page(words[k]) for k in (7, 63, 8, 9, 10) if k in words]), 2000)
    assert sorted(decoder.almanac) == [1, 2, 3]


def test_page_error_rate_equals_that_of_the_twin() -> None:
    """Pages through sync, decoder and CRC at Es/N0 = -1.5 dB against the naive Viterbi on the same symbols.

    A page fails when either part is wrong; the two decide on the same noise, so that they may differ only
    where the sync pattern is misread: ten symbols at -1.5 dB, Q(sqrt(20 * 0.708)) = 8e-5 per part, 2 n of
    them.
    """
    n, rng = 1500, np.random.default_rng(5)
    symbols = np.tile(stream(60, 1), n // 30)
    noisy = (symbols + np.sqrt(0.5 / 10**-0.15) * rng.standard_normal(symbols.size)).astype(np.float32)
    noisy[:2000] = symbols[:2000]
    decoder = inav.Decoder(5)
    decoder.lost_after = n
    good = np.array([event[3] for event in decoder.feed(noisy, 0)])
    order = np.array([fec.deinterleave(np.arange(240))])[0]
    decoded = naive.viterbi(noisy.reshape(-1, 250)[:, 10:][:, order].astype(float))
    sent = naive.viterbi(symbols.reshape(-1, 250)[:, 10:][:, order].astype(float))
    # the decoder's CRC covers bits 1..114 and 1..106; errors in the SSP alone do not fail a page
    wrong = np.any((decoded != sent)[0::2, :114], axis=1) | np.any((decoded != sent)[1::2, :106], axis=1)
    assert 0.1 < wrong.mean() < 0.5
    expected = 2 * n * 8e-5
    assert np.count_nonzero(good == wrong) <= expected + 5 * np.sqrt(expected) + 1
    assert decoder.pages_ok == good.sum()
