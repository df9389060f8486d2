"""Galileo I/NAV on E1-B: the tables of the words, the encoder and the decoder side by side.

Source: Galileo OS SIS ICD, 4.1.4 (coding), 4.3 (pages, order of words), 5.1 (contents). A word is an integer
of 128 bits. Weeks are continuous GPS weeks (GST week + 1024) outside the message.
"""

import numpy as np

from signals import fec
from signals.almanac import elements, epoch_on_grid, latest_records, reference_time
from signals.constants import GNSS_PI, SECONDS_PER_WEEK
from signals.fields import Field, bits_of, check_start, integer, message_of, pack, unpack
from signals.lnav import BROADCAST, FIRST_WEEK, nearest_week
from signals.records import EPHEMERIS, IONO_UTC

SYMBOL_MS = 4
PART_SYMBOLS, PAGE_SYMBOLS = 250, 500
WORD_BITS = 128
GST_WEEK_0 = 1024
"""Continuous GPS week of GST week 0 (1999-08-22)."""
SYNC = np.array([0, 1, 0, 1, 1, 0, 0, 0, 0, 0], np.uint8)
"""Synchronisation pattern of each page part (ICD, 4.3.2.1)."""
SYNC_SIGNS = (1 - 2 * SYNC.astype(np.float32)).astype(np.float32)
SECONDARY_SYNC = (0b00000100, 0b00101011, 0b00101111)
"""SSP1..3, sent in pages whose even part starts at GST mod 6 = 1, 3, 5 s (ICD 2.x, 4.3.2.3)."""
REFERENCE_SQRT_A = np.sqrt(29_600_000.0)
REFERENCE_INCLINATION_RAD = 56.0 / 180.0 * GNSS_PI

# --- tables ---


TYPE = integer("type", 1, 6)
IODNAV = integer("iode", 7, 10)
WORD_1 = (
    TYPE,
    IODNAV,
    Field("toe_s", ((17, 14),), "u", 60.0, "s", exact=True, top=10_079),
    Field("m0_rad", ((31, 32),), "s", 2**-31, "semicircle", cyclic=True),
    Field("e", ((63, 32),), "u", 2**-33),
    Field("sqrt_a_sqrt_m", ((95, 32),), "u", 2**-19, "m^0.5"),
)
WORD_2 = (
    TYPE,
    IODNAV,
    Field("omega0_rad", ((17, 32),), "s", 2**-31, "semicircle", cyclic=True),
    Field("i0_rad", ((49, 32),), "s", 2**-31, "semicircle"),
    Field("omega_rad", ((81, 32),), "s", 2**-31, "semicircle", cyclic=True),
    Field("idot_rad_s", ((113, 14),), "s", 2**-43, "semicircle/s"),
)
WORD_3 = (
    TYPE,
    IODNAV,
    Field("omega_dot_rad_s", ((17, 24),), "s", 2**-43, "semicircle/s"),
    Field("delta_n_rad_s", ((41, 16),), "s", 2**-43, "semicircle/s"),
    Field("cuc_rad", ((57, 16),), "s", 2**-29, "rad"),
    Field("cus_rad", ((73, 16),), "s", 2**-29, "rad"),
    Field("crc_m", ((89, 16),), "s", 2**-5, "m"),
    Field("crs_m", ((105, 16),), "s", 2**-5, "m"),
    integer("accuracy_index", 121, 8),
)
WORD_4 = (
    TYPE,
    IODNAV,
    integer("prn", 17, 6),
    Field("cic_rad", ((23, 16),), "s", 2**-29, "rad"),
    Field("cis_rad", ((39, 16),), "s", 2**-29, "rad"),
    Field("toc_s", ((55, 14),), "u", 60.0, "s", exact=True, top=10_079),
    Field("af0_s", ((69, 31),), "s", 2**-34, "s"),
    Field("af1_s_s", ((100, 21),), "s", 2**-46, "s/s"),
    Field("af2_s_s2", ((121, 6),), "s", 2**-59, "s/s^2"),
)
WORD_5 = (
    TYPE,
    Field("ai0", ((7, 11),), "u", 2**-2, "sfu"),
    Field("ai1", ((18, 11),), "s", 2**-8, "sfu/deg"),
    Field("ai2", ((29, 14),), "s", 2**-15, "sfu/deg^2"),
    integer("storm_regions", 43, 5),
    Field("bgd_e5a_s", ((48, 10),), "s", 2**-32, "s"),
    Field("tgd_s", ((58, 10),), "s", 2**-32, "s"),  # BGD(E1,E5b)
    integer("e5b_hs", 68, 2),
    integer("e1b_hs", 70, 2),
    integer("e5b_dvs", 72, 1),
    integer("e1b_dvs", 73, 1),
    integer("gst_week", 74, 12),
    integer("gst_tow_s", 86, 20, top=SECONDS_PER_WEEK - 1),
)
WORD_6 = (
    TYPE,
    Field("a0_utc_s", ((7, 32),), "s", 2**-30, "s"),
    Field("a1_utc_s_s", ((39, 24),), "s", 2**-50, "s/s"),
    Field("dt_ls_s", ((63, 8),), "s", 1.0, "s", exact=True),
    Field("tot_s", ((71, 8),), "u", 3600.0, "s", exact=True, top=167),
    integer("week_t_256", 79, 8),
    integer("week_lsf_256", 87, 8),
    integer("dn", 95, 3),
    Field("dt_lsf_s", ((98, 8),), "s", 1.0, "s", exact=True),
    integer("gst_tow_s", 106, 20, top=SECONDS_PER_WEEK - 1),
)
WORD_0 = (
    TYPE,
    integer("time", 7, 2),  # binary 10: week and TOW are valid
    integer("gst_week", 97, 12),
    integer("gst_tow_s", 109, 20, top=SECONDS_PER_WEEK - 1),
)
IODA = integer("ioda", 7, 4)
ALMANAC_TIME = (
    integer("week_a_4", 11, 2),
    Field("toa_s", ((13, 10),), "u", 600.0, "s", exact=True, top=1007),
)


def _orbit(k: int, *starts: int) -> tuple[Field, ...]:
    """Almanac orbit fields of satellite `k` of a group; as many as there are first bits in `starts`."""
    kinds = (
        (6, "svid", "u", 1.0, ""),
        (13, "delta_sqrt_a", "s", 2**-9, "m^0.5"),
        (11, "e", "u", 2**-16, ""),
        (16, "omega_rad", "s", 2**-15, "semicircle"),
        (11, "delta_i_rad", "s", 2**-14, "semicircle"),
        (16, "omega0_rad", "s", 2**-15, "semicircle"),
        (11, "omega_dot_rad_s", "s", 2**-33, "semicircle/s"),
        (16, "m0_rad", "s", 2**-15, "semicircle"),
    )
    return tuple(
        Field(f"{name}_{k}", ((start, n),), kind, scale, unit, cyclic=unit == "semicircle" and n == 16)
        for start, (n, name, kind, scale, unit) in zip(starts, kinds, strict=False)
    )


def _late(k: int, name: str, start: int) -> Field:
    """Orbit field that a satellite continues with in the next word."""
    n, scale, unit = {
        "omega0_rad": (16, 2**-15, "semicircle"),
        "omega_dot_rad_s": (11, 2**-33, "semicircle/s"),
        "m0_rad": (16, 2**-15, "semicircle"),
    }[name]
    return Field(f"{name}_{k}", ((start, n),), "s", scale, unit, cyclic=n == 16)


def _clock(k: int, start: int) -> tuple[Field, ...]:
    """Almanac clock and health of satellite `k` of a group: 16 + 13 + 2 + 2 bits."""
    return (
        Field(f"af0_s_{k}", ((start, 16),), "s", 2**-19, "s"),
        Field(f"af1_s_s_{k}", ((start + 16, 13),), "s", 2**-38, "s/s"),
        integer(f"e5b_hs_{k}", start + 29, 2),
        integer(f"e1b_hs_{k}", start + 31, 2),
    )


WORD_7 = (TYPE, IODA, *ALMANAC_TIME, *_orbit(1, 23, 29, 42, 53, 69, 80, 96, 107))
WORD_8 = (TYPE, IODA, *_clock(1, 11), *_orbit(2, 44, 50, 63, 74, 90, 101, 117))
WORD_9 = (TYPE, IODA, *ALMANAC_TIME, _late(2, "m0_rad", 23), *_clock(2, 39), *_orbit(3, 72, 78, 91, 102, 118))
GGTO = (
    Field("a0g_s", ((87, 16),), "s", 2**-35, "s"),
    Field("a1g_s_s", ((103, 12),), "s", 2**-51, "s/s"),
    Field("t0g_s", ((115, 8),), "u", 3600.0, "s", exact=True, top=167),
    integer("week_0g_64", 123, 6),
)
WORD_10 = (
    TYPE,
    IODA,
    _late(3, "omega0_rad", 11),
    _late(3, "omega_dot_rad_s", 27),
    _late(3, "m0_rad", 38),
    *_clock(3, 54),
    *GGTO,
)
GGTO_ABSENT = (1 << 42) - 1
"""All ones in the four GGTO fields: not available (ICD, 5.1.8)."""
WORDS = {
    0: WORD_0,
    1: WORD_1,
    2: WORD_2,
    3: WORD_3,
    4: WORD_4,
    5: WORD_5,
    6: WORD_6,
    7: WORD_7,
    8: WORD_8,
    9: WORD_9,
    10: WORD_10,
    63: (TYPE,),
}
"""Fields of each word type sent or understood."""
ORDER = (
    (2, 4, 6, 7, 8, 63, 63, 63, 0, 63, 1, 3, 5, 0, 63),
    (2, 4, 6, 9, 10, 63, 63, 63, 0, 63, 1, 3, 5, 0, 63),
)
"""Word types of the 15 pages of even and odd sub-frames of 30 s; 63 stands for words 16 to 20 and 22."""

# --- encoder ---


def page_symbols(word: int, secondary_sync: int = 0) -> np.ndarray:
    """Symbols of one nominal page, even then odd part: uint8 (500,)."""
    bits = bits_of(word, WORD_BITS)
    even = np.zeros(120, np.uint8)
    even[2:114] = bits[:112]
    odd = np.zeros(120, np.uint8)
    odd[0] = 1
    odd[2:18] = bits[112:]
    odd[82:106] = bits_of(fec.crc24q(np.concatenate((even[:114], odd[:82]))), 24)
    odd[106:114] = bits_of(secondary_sync, 8)
    parts = [np.concatenate((SYNC, fec.interleave(fec.convolve(part)))) for part in (even, odd)]
    return np.concatenate(parts)


def _time_values(week: int, tow_s: int) -> dict[str, int]:
    return {"gst_week": (week - GST_WEEK_0) % 4096, "gst_tow_s": tow_s}


def _health_values(health: int) -> dict[str, int]:
    return {"e1b_dvs": health & 1, "e1b_hs": health >> 1, "e5b_dvs": 0, "e5b_hs": 0}


def _word_5(record: np.void, iono_utc: np.void | None, week: int, tow_s: int, where: str) -> int:
    ai = (0.0, 0.0, 0.0) if iono_utc is None else iono_utc["ai"]
    values = {"type": 5, "ai0": ai[0], "ai1": ai[1], "ai2": ai[2], "storm_regions": 0}
    values |= {"bgd_e5a_s": record["bgd_e5a_s"], "tgd_s": record["tgd_s"]}
    values |= _health_values(int(record["health"])) | _time_values(week, tow_s)
    return pack(WORD_5, values, WORD_BITS, where)


def _word_6(iono_utc: np.void, tow_s: int, where: str) -> int:
    tot_s = epoch_on_grid(float(iono_utc["tot_s"]), 3600)
    a0, a1 = float(iono_utc["a0_utc_s"]), float(iono_utc["a1_utc_s_s"])
    values = {name: iono_utc[name] for name in ("dt_ls_s", "dn", "dt_lsf_s")}
    values |= {
        "type": 6,
        "a0_utc_s": a0 + a1 * (tot_s - float(iono_utc["tot_s"])),
        "a1_utc_s_s": a1,
        "tot_s": tot_s,
    }
    values |= {
        "week_t_256": iono_utc["week_t"] % 256,
        "week_lsf_256": iono_utc["week_lsf"] % 256,
        "gst_tow_s": tow_s,
    }
    return pack(WORD_6, values, WORD_BITS, where)


def _ggto(iono_utc: np.void | None, where: str) -> int:
    if iono_utc is None:
        return GGTO_ABSENT
    t0g_s = epoch_on_grid(float(iono_utc["t0g_s"]), 3600)
    a0, a1 = float(iono_utc["a0g_s"]), float(iono_utc["a1g_s_s"])
    values = {"a0g_s": a0 + a1 * (t0g_s - float(iono_utc["t0g_s"])), "a1g_s_s": a1, "t0g_s": t0g_s}
    return pack(GGTO, values | {"week_0g_64": (iono_utc["week_0g"] - GST_WEEK_0) % 64}, WORD_BITS, where)


def almanac_groups(almanac: np.ndarray | None) -> list[list[np.void]]:
    """Galileo satellites in threes by number; orbits that the format cannot hold (E14, E18) are left out."""
    records = latest_records(almanac, b"E", 36).values()
    fit = [r for r in records if abs(r["sqrt_a_sqrt_m"] - REFERENCE_SQRT_A) < 7.99 and r["e"] < 0.031]
    return [fit[i : i + 3] for i in range(0, len(fit), 3)] or [[]]


def _almanac_values(group: list[np.void], week: int, toa_s: int) -> dict[str, float]:
    """Fields of words 7 to 10 of one group; a missing satellite has SVID 0."""
    names = {field.name for table in (WORD_7, WORD_8, WORD_9, WORD_10) for field in table}
    values: dict[str, float] = dict.fromkeys(names, 0)
    values |= {"ioda": (week * SECONDS_PER_WEEK + toa_s) // 600 % 16, "toa_s": toa_s}
    values["week_a_4"] = (week - GST_WEEK_0) % 4
    for k, record in enumerate(group, 1):
        element = elements(record, week, toa_s)
        element["svid"] = int(record["prn"])
        element["delta_sqrt_a"] = element["sqrt_a_sqrt_m"] - REFERENCE_SQRT_A
        element["delta_i_rad"] = element["i0_rad"] - REFERENCE_INCLINATION_RAD
        element["e1b_hs"] = int(record["health"]) >> 1
        values |= {f"{name}_{k}": value for name, value in element.items() if f"{name}_{k}" in names}
    return values


def _almanac_word(number: int, groups: list[list[np.void]], k: int, iono_utc: np.void | None) -> int:
    everyone = [record for group in groups for record in group]
    week, toa_s = reference_time(everyone, 600) if everyone else (GST_WEEK_0, 0)
    values = _almanac_values(groups[k], week, toa_s) | {"type": number}
    if number < 10:
        return pack(WORDS[number], values, WORD_BITS, "I/NAV almanac")
    table = WORD_10[: -len(GGTO)]
    return pack(table, values, WORD_BITS, "I/NAV almanac") | _ggto(iono_utc, "I/NAV word 10")


def _sorted_records(ephemeris: np.ndarray | np.void) -> np.ndarray:
    records = np.atleast_1d(np.asarray(ephemeris, EPHEMERIS))
    if records.size == 0 or np.any(records["system"] != b"E") or np.any(records["prn"] != records["prn"][0]):
        raise ValueError("I/NAV needs one or more ephemerides of one Galileo satellite")
    if not 1 <= records["prn"][0] <= 36:
        raise ValueError(f"I/NAV: SVID {records['prn'][0]} is not in 1 to 36")
    return records[np.lexsort((records["toe_s"], records["week"]))]


def _in_force(records: np.ndarray, time_s: int) -> int:
    """Index of the data set sent at absolute time `time_s`: a set goes on air at its toe."""
    cut_over_s = records["week"] * float(SECONDS_PER_WEEK) + records["toe_s"]
    return max(int(np.searchsorted(cut_over_s, time_s, side="right")) - 1, 0)


def encode(
    ephemeris: np.ndarray | np.void,
    iono_utc: np.void | None,
    almanac: np.ndarray | None,
    week: int,
    tow_s: int,
    n_symbols: int,
) -> np.ndarray:
    """I/NAV symbols of one satellite on E1-B as transmitted from (week, tow_s) on; GST and GPS seconds
    coincide.

    Parameters
    ----------
    ephemeris : EPHEMERIS record, or array of records of this satellite; one of several comes into force on
        the first 30 s sub-frame at or after its toe.
    iono_utc : IONO_UTC record (NeQuick, UTC, GGTO), or None: word 6 a dummy, GGTO marked absent, ai zero.
    almanac : EPHEMERIS array, reduced to almanacs at the latest toe, three satellites a minute; None: none
        (SVID 0).
    week, tow_s : continuous GPS week (GST week + 1024) and whole second of the first symbol.
    n_symbols : number of 4 ms symbols.

    Returns
    -------
    int8 (n_symbols,), logic 0 -> +1, logic 1 -> -1.

    Raises
    ------
    ValueError naming the field, its value and the range allowed, if a value does not fit its field.
    """
    records = _sorted_records(ephemeris)
    groups = almanac_groups(almanac)
    where = f"I/NAV of E{records['prn'][0]:02d}"
    check_start(where, week, tow_s, n_symbols)
    iono_utc = None if iono_utc is None else np.atleast_1d(iono_utc)[0]
    cache: dict[tuple[int, ...], int] = {}

    def static_word(number: int, in_force: int, group: int) -> int:
        key = (number, in_force, group)
        if key not in cache:
            if number >= 7:
                cache[key] = _almanac_word(number, groups, group, iono_utc)
            else:
                record = records[in_force]
                values = {name: record[name] for name in BROADCAST} | {"type": number}
                cache[key] = pack(WORDS[number], values, WORD_BITS, where)
        return cache[key]

    def word(page: int) -> int:
        sub_frame, place = divmod(page, 15)
        page_week, page_tow_s = divmod(2 * page + 1, SECONDS_PER_WEEK)
        number = ORDER[sub_frame % 2][place]
        in_force = _in_force(records, sub_frame * 30)
        if number == 0:
            return pack(
                WORD_0, {"type": 0, "time": 2} | _time_values(page_week, page_tow_s), WORD_BITS, where
            )
        if number == 5:
            return _word_5(records[in_force], iono_utc, page_week, page_tow_s, where)
        if number == 6 and iono_utc is not None:
            return _word_6(iono_utc, page_tow_s, where)
        if number in (6, 63):
            return 63 << 122
        return static_word(
            number, in_force if number < 7 else 0, sub_frame // 2 % len(groups) if number >= 7 else 0
        )

    start_s = int(week) * SECONDS_PER_WEEK + int(tow_s)
    first = (start_s - 1) // 2  # page whose even part starts at the odd second 2 first + 1
    skip = (start_s - (2 * first + 1)) * PART_SYMBOLS
    pages = []
    for page in range(first, first - (-(skip + n_symbols) // PAGE_SYMBOLS)):
        content = word(page)
        pages.append(page_symbols(content, 0 if content >> 122 == 63 else SECONDARY_SYNC[page % 3]))
    symbols = np.concatenate(pages) if pages else np.empty(0, np.uint8)
    return 1 - 2 * symbols[skip : skip + n_symbols].astype(np.int8)


def quantised(ephemeris: np.void) -> np.void:
    """Ephemeris as a receiver reads it from the message: every field rounded to its last bit."""
    record = np.array([ephemeris], EPHEMERIS)[0]
    where = f"I/NAV of E{record['prn']:02d}"
    values = {name: record[name] for name in BROADCAST}
    words = [pack(WORDS[k], values | {"type": k}, WORD_BITS, where) for k in (1, 2, 3, 4)]
    words.append(_word_5(record, None, int(record["week"]), 0, where))
    for k, word in enumerate(words, 1):
        for name, value in unpack(WORDS[k], word, WORD_BITS).items():
            if name in BROADCAST:
                record[name] = value
    record["iodc"] = record["iode"]
    return record


# --- decoder ---


def decode_part(symbols: np.ndarray) -> tuple[np.ndarray, int]:
    """Bits of one page part and its polarity.

    Parameters
    ----------
    symbols : float32 (250,) soft symbols, + = logic 0, possibly inverted; the first ten are the sync pattern.

    Returns
    -------
    uint8 (120,) bits, and +1 (upright) or -1 (inverted), from the soft correlation with the sync pattern.
    """
    polarity = 1 if float(symbols[:10] @ SYNC_SIGNS) >= 0.0 else -1
    return fec.viterbi(fec.deinterleave(symbols[10:]) * np.float32(polarity)), polarity


def page_word(even: np.ndarray, odd: np.ndarray) -> tuple[int, bool]:
    """Word of 128 bits from the bits of an even and an odd part, and whether the CRC over both holds."""
    crc_ok = fec.crc24q(np.concatenate((even[:114], odd[:106]))) == 0
    return message_of(np.concatenate((even[2:114], odd[2:18]))), crc_ok


def _find(symbols: np.ndarray) -> int:
    """First place where a whole good page begins: two sync patterns, and its CRC; -1 if there is none."""
    n = symbols.size - PAGE_SYMBOLS + 1
    single = np.correlate(np.where(symbols < 0, -1, 1), SYNC_SIGNS.astype(np.int64), "valid")
    double = single[: max(n, 0)] + single[PART_SYMBOLS : PART_SYMBOLS + max(n, 0)]
    for first in np.flatnonzero(np.abs(double) >= 16).tolist():
        even, _ = decode_part(symbols[first : first + PART_SYMBOLS])
        odd, _ = decode_part(symbols[first + PART_SYMBOLS : first + PAGE_SYMBOLS])
        if even[0] == 0 and odd[0] == 1 and page_word(even, odd)[1]:
            return first
    return -1


class Decoder:
    """I/NAV symbols of one satellite to time, ephemeris, health, ionosphere and GGTO.

    Symbols may be inverted as a whole: the sync pattern of each part tells. A place is accepted as the start
    of a page if two sync patterns 250 symbols apart fit (at most two wrong of 20) and the CRC of the page
    between holds; time counts once two words agree on it, or the later one says that up to a minute is missing
    between them: a hole in the samples.

    Parameters
    ----------
    prn : satellite; words 4 of another SVID are refused.

    Attributes
    ----------
    synced, polarity : +1 upright, -1 inverted, 0 unknown.
    ephemeris : EPHEMERIS record or None; words 1 to 4 of one IODnav, newest set, with word 5.
    iono_utc, iono_utc_valid : IONO_UTC record and the set of its parts received ("nequick", "utc", "ggto").
    ggto : (a0g_s, a1g_s_s, t0g_s, week_0g), GST minus GPS time, or None.
    almanac : SVID -> dict of almanac elements.
    health, healthy : E1B_DVS + 2 E1B_HS; healthy is None before word 5.
    svid : of the last word 4.
    timed_index : index of the last page that said the time; -1 before any.
    pages_ok, pages_failed, pages_alert : counts while synced (alert pages cannot be checked on E1-B alone).
    words : number of good pages by word type.
    """

    symbol_ms = SYMBOL_MS
    symbols_per_week = SECONDS_PER_WEEK * 1000 // SYMBOL_MS
    lost_after = 5  # pages that fail in a row
    longest_hole = 15_000  # symbols

    def __init__(self, prn: int):
        self.prn = prn
        self.ephemeris: np.void | None = None
        self.iono_utc = np.zeros(1, IONO_UTC)[0]
        self.iono_utc_valid: set[str] = set()
        self.ggto: tuple[float, float, float, int] | None = None
        self.almanac: dict[int, dict[str, float]] = {}
        self.health: int | None = None
        self.svid: int | None = None
        self.polarity = 0
        self.synced = False
        self.pages_ok = self.pages_failed = self.pages_alert = 0
        self.words: dict[int, int] = {}
        self._symbols = np.empty(0, np.float32)
        self._before = np.empty(0, np.float32)  # the page that was read last
        self._index = 0  # of self._symbols[0]
        self._missed = 0
        self._phase: int | None = None  # confirmed: symbols since the start of the week at index 0
        self._phase_candidate: int | None = None
        self.timed_index = -1
        self._week_anchor: tuple[int, int, int] | None = None  # (week, index of a symbol in it, phase)
        self._set: dict[int, dict[str, float]] = {}
        self._word_5: dict[str, float] | None = None
        self._almanac_words: dict[int, dict[str, float]] = {}

    @property
    def healthy(self) -> bool | None:
        """E1B_HS = 0 and E1B_DVS = 0; None before word 5."""
        return None if self.health is None else self.health == 0

    def tow_of(self, index: int) -> int | None:
        """Transmit time of the start of symbol `index`, ms of week, GST; None until confirmed."""
        if self._phase is None:
            return None
        return (self._phase + int(index)) % self.symbols_per_week * self.symbol_ms

    def week_of(self, index: int) -> int | None:
        """Continuous week in which symbol `index` was sent; None until time and week are known."""
        if self._phase is None or self._week_anchor is None or self._week_anchor[2] != self._phase:
            return None
        week, anchor, _ = self._week_anchor
        period = self.symbols_per_week
        return week + (self._phase + int(index)) // period - (self._phase + anchor) // period

    @property
    def week(self) -> int | None:
        """Continuous week of the last symbol fed."""
        return self.week_of(self._index + self._symbols.size - 1)

    def feed(self, symbols: np.ndarray, index0: int) -> list[tuple[str, int, int, bool]]:
        """Take soft symbols (+ = logic 0) whose first one has running index `index0`.

        A jump of the index is a loss of symbols: sync is sought afresh and time confirmed anew; decoded data
        stay.

        Returns
        -------
        List of ("page", word type, index of the first symbol of its even part, crc_ok); the type is -1 for a
        page that failed and for an alert page.
        """
        new = np.asarray(symbols, np.float32)
        if not np.isfinite(new).all():
            raise ValueError(f"I/NAV symbols from index {index0} on hold NaN or infinity: feed finite values")
        if index0 != self._index + self._symbols.size:
            self._restart(int(index0))
        self._symbols = np.concatenate((self._symbols, new))
        events = []
        while self._advance():
            if self._symbols.size < PAGE_SYMBOLS:
                break
            events.append(self._page())
        return events

    def _restart(self, index0: int) -> None:
        self._symbols, self._before, self._index = np.empty(0, np.float32), np.empty(0, np.float32), index0
        self.synced, self.polarity, self._missed = False, 0, 0
        if self._phase is not None:
            self._phase_candidate, self._phase = self._phase, None

    def _drop(self, n: int) -> None:
        self._symbols, self._index = self._symbols[n:], self._index + n

    def _advance(self) -> bool:
        """Move to the start of a page; False if none is in sight."""
        if self.synced:
            return True
        n = self._symbols.size - PAGE_SYMBOLS + 1
        if n <= 0:
            return False
        first = _find(self._symbols)
        if first < 0:
            self._drop(n)
            return False
        self._drop(first)
        self.synced, self._missed = True, 0
        return True

    def _page(self) -> tuple[str, int, int, bool]:
        index = self._index
        even, _ = decode_part(self._symbols[:PART_SYMBOLS])
        odd, polarity = decode_part(self._symbols[PART_SYMBOLS:PAGE_SYMBOLS])
        before, self._before = self._before, self._symbols[:PAGE_SYMBOLS]
        self._drop(PAGE_SYMBOLS)
        word, crc_ok = page_word(even, odd)
        paired = even[0] == 0 and odd[0] == 1
        if crc_ok and paired and even[1] == odd[1] == 0:
            self.pages_ok, self._missed, self.polarity = self.pages_ok + 1, 0, polarity
            number = word >> 122
            self.words[number] = self.words.get(number, 0) + 1
            self._take(number, word, index)
            return "page", number, index, True
        if paired and even[1] == odd[1] == 1:
            self.pages_alert += 1  # says nothing about sync: its CRC covers the E5b part as well
            return "page", -1, index, False
        self.pages_failed += 1
        self._missed += 1
        self._mind_holes(before)
        if self._missed >= self.lost_after:
            self.synced = False
        return "page", -1, index, False

    def _mind_holes(self, before: np.ndarray) -> None:
        """Where a page failed and a good one begins before it: symbols are missing, and time waits for the next word."""
        both = np.concatenate((before, self._before))
        first = _find(both[1:]) + 1
        if self._phase is None or not 0 < first < before.size:
            return
        self._phase_candidate, self._phase = self._phase, None
        self._symbols = np.concatenate((both[first:], self._symbols))
        self._index -= both.size - first
        self._missed = 0

    def _take(self, number: int, word: int, index: int) -> None:
        if number not in WORDS or number == 63:
            return
        values = unpack(WORDS[number], word, WORD_BITS)
        if "gst_tow_s" in values and (number != 0 or values["time"] == 2):
            self._take_time(values, index)
        if 1 <= number <= 4:
            if number == 4:
                self.svid = int(values["prn"])
                if self.svid != self.prn:
                    return
            self._set[number] = values
            self._assemble(index)
        elif number == 5:
            self._take_word_5(values, index)
        elif number == 6:
            self._take_utc(values)
        elif number >= 7:
            self._take_almanac(number, values, word)

    def _take_time(self, values: dict[str, float], index: int) -> None:
        """Keep the time of a word: candidate first, confirmed when a second word agrees; else time is unknown."""
        if values["gst_tow_s"] >= SECONDS_PER_WEEK:
            return
        phase = (int(values["gst_tow_s"]) * PART_SYMBOLS - index) % self.symbols_per_week
        if self._phase_candidate is not None:
            missing = (phase - self._phase_candidate) % self.symbols_per_week
            self._phase = phase if missing <= self.longest_hole else None
            if missing and self._week_anchor is not None:
                week, anchor, _ = self._week_anchor
                self._week_anchor = week, anchor - missing, phase
        self._phase_candidate, self.timed_index = phase, index
        if "gst_week" in values:
            self._week_anchor = (int(values["gst_week"]) + GST_WEEK_0, index, phase)

    def _assemble(self, index: int) -> None:
        """Ephemeris from words 1 to 4 if they are of one IODnav, and word 5."""
        if len(self._set) < 4 or self._word_5 is None or self._week_anchor is None:
            return
        if len({values["iode"] for values in self._set.values()}) > 1:
            return
        week, anchor, phase = self._week_anchor
        time = phase + index
        week += time // self.symbols_per_week - (phase + anchor) // self.symbols_per_week
        tow_s = time % self.symbols_per_week * self.symbol_ms * 1e-3
        record = np.zeros(1, EPHEMERIS)[0]
        for values in (*self._set.values(), self._word_5):
            for name, value in values.items():
                if name in BROADCAST:
                    record[name] = value
        record["system"], record["prn"], record["iodc"] = b"E", self.prn, record["iode"]
        record["health"], record["tow_s"] = self.health, tow_s
        record["week"] = week + round((tow_s - float(record["toe_s"])) / SECONDS_PER_WEEK)
        if self.ephemeris is not None and self.ephemeris["iode"] == record["iode"]:
            record["tow_s"] = self.ephemeris["tow_s"]  # of the first time the set was complete
        self.ephemeris = record

    def _take_word_5(self, values: dict[str, float], index: int) -> None:
        self._word_5 = values
        self.health = int(values["e1b_dvs"]) + 2 * int(values["e1b_hs"])
        self.iono_utc["ai"] = values["ai0"], values["ai1"], values["ai2"]
        self.iono_utc_valid.add("nequick")
        self._assemble(index)

    def _reference_week(self) -> int:
        return self._week_anchor[0] if self._week_anchor else FIRST_WEEK + 512

    def _take_utc(self, values: dict[str, float]) -> None:
        for name in ("a0_utc_s", "a1_utc_s_s", "tot_s", "dt_ls_s", "dn", "dt_lsf_s"):
            self.iono_utc[name] = values[name]
        self.iono_utc["week_t"] = nearest_week(values["week_t_256"], 256, self._reference_week())
        self.iono_utc["week_lsf"] = nearest_week(values["week_lsf_256"], 256, self._reference_week())
        self.iono_utc_valid.add("utc")

    def _take_almanac(self, number: int, values: dict[str, float], word: int) -> None:
        """Words 7 to 10 in this order with one IODa make three almanacs; word 10 holds GGTO."""
        if number == 7:
            self._almanac_words = {}
        elif self._almanac_words.get(number - 1, {}).get("ioda") != values["ioda"]:
            self._almanac_words = {}
        if number == 7 or self._almanac_words:
            self._almanac_words[number] = values
        if number == 10:
            self._take_ggto(values, word)
            if len(self._almanac_words) == 4:
                self._take_group({k: v for w in self._almanac_words.values() for k, v in w.items()})

    def _take_ggto(self, values: dict[str, float], word: int) -> None:
        if word & GGTO_ABSENT == GGTO_ABSENT:
            self.ggto = None
            self.iono_utc_valid.discard("ggto")
            return
        week = nearest_week((int(values["week_0g_64"]) + GST_WEEK_0) % 64, 64, self._reference_week())
        for name in ("a0g_s", "a1g_s_s", "t0g_s"):
            self.iono_utc[name] = values[name]
        self.iono_utc["week_0g"] = week
        self.ggto = (float(values["a0g_s"]), float(values["a1g_s_s"]), float(values["t0g_s"]), week)
        self.iono_utc_valid.add("ggto")

    def _take_group(self, values: dict[str, float]) -> None:
        for k in (1, 2, 3):
            svid = int(values[f"svid_{k}"])
            if svid == 0:
                continue
            element = {name[:-2]: value for name, value in values.items() if name.endswith(f"_{k}")}
            element["sqrt_a_sqrt_m"] = element.pop("delta_sqrt_a") + REFERENCE_SQRT_A
            element["i0_rad"] = element.pop("delta_i_rad") + REFERENCE_INCLINATION_RAD
            self.almanac[svid] = element | {"toa_s": values["toa_s"], "week_a_4": values["week_a_4"]}
