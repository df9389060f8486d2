"""GPS LNAV: the tables of the message, the encoder and the decoder side by side.

Source: IS-GPS-200, 20.3 (fields: tables 20-I to 20-VI and figure 20-1; parity: 20.3.5.2). A subframe is an
integer of 300 bits in which the six parity bits of each word are zero until `transmit` fills them.
"""

import numpy as np
from numba import njit

from signals.almanac import elements, epoch_on_grid, latest_records, reference_time
from signals.constants import GNSS_PI, SECONDS_PER_WEEK
from signals.fields import Field, bits_of, check_start, integer, pack, unpack
from signals.records import EPHEMERIS, IONO_UTC

BROADCAST = tuple(name for name in EPHEMERIS.names or () if name != "system")
_ANY_TIME = {"prn", "week", "tow_s", "iode", "iodc", "accuracy_index", "health", "fit_interval"}
OF_ONE_ISSUE = set(BROADCAST) - _ANY_TIME
"""Fields that change with IODC and IODE only."""
BIT_MS = 20
FIRST_WEEK = 1900
"""Default start of the 1024 weeks into which the truncated week is resolved (2016-06-05)."""
SUBFRAME_BITS = 300
SUBFRAMES_PER_WEEK = 100_800
PREAMBLE = 0b10001011

# --- tables ---

HEADER = (
    integer("preamble", 1, 8),
    integer("tlm_message", 9, 14),
    integer("integrity", 23, 1),
    integer("tow_count", 31, 17, top=SUBFRAMES_PER_WEEK - 1),  # of the start of the next subframe, 6 s
    integer("alert", 48, 1),
    integer("anti_spoof", 49, 1),
    integer("subframe", 50, 3),
)
SUBFRAME_1 = (
    integer("week_1024", 61, 10),
    integer("codes_on_l2", 71, 2),
    integer("accuracy_index", 73, 4),
    integer("health", 77, 6),
    Field("iodc", ((83, 2), (211, 8)), exact=True),
    integer("l2_p_data", 91, 1),
    Field("tgd_s", ((197, 8),), "s", 2**-31, "s"),
    Field("toc_s", ((219, 16),), "u", 16.0, "s", exact=True, top=37_799),
    Field("af2_s_s2", ((241, 8),), "s", 2**-55, "s/s^2"),
    Field("af1_s_s", ((249, 16),), "s", 2**-43, "s/s"),
    Field("af0_s", ((271, 22),), "s", 2**-31, "s"),
)
SUBFRAME_2 = (
    integer("iode", 61, 8),
    Field("crs_m", ((69, 16),), "s", 2**-5, "m"),
    Field("delta_n_rad_s", ((91, 16),), "s", 2**-43, "semicircle/s"),
    Field("m0_rad", ((107, 8), (121, 24)), "s", 2**-31, "semicircle", cyclic=True),
    Field("cuc_rad", ((151, 16),), "s", 2**-29, "rad"),
    Field("e", ((167, 8), (181, 24)), "u", 2**-33),
    Field("cus_rad", ((211, 16),), "s", 2**-29, "rad"),
    Field("sqrt_a_sqrt_m", ((227, 8), (241, 24)), "u", 2**-19, "m^0.5"),
    Field("toe_s", ((271, 16),), "u", 16.0, "s", exact=True, top=37_799),
    integer("fit_interval", 287, 1),
    integer("aodo", 288, 5),  # 900 s; 31 = no correction table (20.3.3.4.4)
)
SUBFRAME_3 = (
    Field("cic_rad", ((61, 16),), "s", 2**-29, "rad"),
    Field("omega0_rad", ((77, 8), (91, 24)), "s", 2**-31, "semicircle", cyclic=True),
    Field("cis_rad", ((121, 16),), "s", 2**-29, "rad"),
    Field("i0_rad", ((137, 8), (151, 24)), "s", 2**-31, "semicircle"),
    Field("crc_m", ((181, 16),), "s", 2**-5, "m"),
    Field("omega_rad", ((197, 8), (211, 24)), "s", 2**-31, "semicircle", cyclic=True),
    Field("omega_dot_rad_s", ((241, 24),), "s", 2**-43, "semicircle/s"),
    integer("iode", 271, 8),
    Field("idot_rad_s", ((279, 14),), "s", 2**-43, "semicircle/s"),
)
PAGE = (integer("data_id", 61, 2), integer("sv_id", 63, 6))
PAGE_18 = (
    *PAGE,
    *(
        Field(
            f"alpha{i}", ((start, 8),), "s", 2.0**exponent, f"s/semicircle^{i}".removesuffix("/semicircle^0")
        )
        for i, (start, exponent) in enumerate(((69, -30), (77, -27), (91, -24), (99, -24)))
    ),
    *(
        Field(
            f"beta{i}", ((start, 8),), "s", 2.0**exponent, f"s/semicircle^{i}".removesuffix("/semicircle^0")
        )
        for i, (start, exponent) in enumerate(((107, 11), (121, 14), (129, 16), (137, 16)))
    ),
    Field("a1_utc_s_s", ((151, 24),), "s", 2**-50, "s/s"),
    Field("a0_utc_s", ((181, 24), (211, 8)), "s", 2**-30, "s"),
    Field("tot_s", ((219, 8),), "u", 4096.0, "s", exact=True, top=147),
    integer("week_t_256", 227, 8),
    Field("dt_ls_s", ((241, 8),), "s", 1.0, "s", exact=True),
    integer("week_lsf_256", 249, 8),
    integer("dn", 257, 8),
    Field("dt_lsf_s", ((271, 8),), "s", 1.0, "s", exact=True),
)
ALMANAC = (
    *PAGE,
    Field("e", ((69, 16),), "u", 2**-21),
    Field("toa_s", ((91, 8),), "u", 4096.0, "s", exact=True, top=147),
    Field("delta_i_rad", ((99, 16),), "s", 2**-19, "semicircle"),  # from 0.30 semicircle
    Field("omega_dot_rad_s", ((121, 16),), "s", 2**-38, "semicircle/s"),
    integer("health", 137, 8),
    Field("sqrt_a_sqrt_m", ((151, 24),), "u", 2**-11, "m^0.5"),
    Field("omega0_rad", ((181, 24),), "s", 2**-23, "semicircle", cyclic=True),
    Field("omega_rad", ((211, 24),), "s", 2**-23, "semicircle", cyclic=True),
    Field("m0_rad", ((241, 24),), "s", 2**-23, "semicircle", cyclic=True),
    Field("af0_s", ((271, 8), (290, 3)), "s", 2**-20, "s"),
    Field("af1_s_s", ((279, 11),), "s", 2**-38, "s/s"),
)
HEALTH_1_24 = (  # subframe 5 page 25 (figure 20-1, sheet 5)
    *PAGE,
    Field("toa_s", ((69, 8),), "u", 4096.0, "s", exact=True, top=147),
    integer("week_a_256", 77, 8),
    *(integer(f"health_{k + 1}", 91 + 30 * (k // 4) + 6 * (k % 4), 6) for k in range(24)),
)
CONFIG_STARTS = (
    *(69 + 4 * k for k in range(4)),
    *(91 + 30 * (k // 6) + 4 * (k % 6) for k in range(24)),
    *(211 + 4 * k for k in range(4)),
)
HEALTH_STARTS_25_32 = (229, 241, 247, 253, 259, 271, 277, 283)
HEALTH_25_32 = (  # subframe 4 page 25 (figure 20-1, sheet 9)
    *PAGE,
    *(integer(f"config_{k + 1}", start, 4) for k, start in enumerate(CONFIG_STARTS)),
    *(integer(f"health_{k + 25}", start, 6) for k, start in enumerate(HEALTH_STARTS_25_32)),
)
SUBFRAME_4_SV_ID = (
    57, 25, 26, 27, 28, 57, 29, 30, 31, 32, 57, 62, 52, 53, 54, 57, 55, 56, 58, 59, 57, 60, 61, 62, 63,
)  # fmt: skip
"""SV (page) ID of the 25 pages of subframe 4 (table 20-V)."""
HEALTH_PAGE_SV_ID = 51
REFERENCE_INCLINATION_RAD = 0.30 * GNSS_PI
ALTERNATING = sum(0xAAAAAA << (6 + 30 * (9 - word)) for word in range(2, 10)) & ((1 << 232) - 1) & ~(3 << 6)
"""Alternating ones and zeros behind the SV ID of a dummy page (20.3.3.5.1.2)."""

# --- parity ---

PARITY_MASKS = (0x2EC7CD2, 0x1763E69, 0x2BB1F34, 0x15D8F9A, 0x1AEC7CD, 0x22DEA27)
"""Equations of D25..D30 over [D29* D30* d1..d24] (table 20-XIV)."""


@njit(cache=True, nogil=True)
def _odd(x):
    x ^= x >> 16
    x ^= x >> 8
    x ^= x >> 4
    x ^= x >> 2
    return (x ^ (x >> 1)) & 1


@njit(cache=True, nogil=True)
def _parity(x):
    bits = 0
    for mask in PARITY_MASKS:
        bits = bits << 1 | _odd(x & mask)
    return bits


def parity(data: int, previous: int) -> int:
    """Parity bits D25..D30 of the 24 data bits d1..d24; `previous` = D29*, D30* as a 2-bit integer."""
    return int(_parity((int(previous) << 24) | int(data)))


@njit(cache=True, nogil=True)
def _transmit(words, previous, bits):
    for w in range(words.size):
        data = words[w] & 0xFFFFFF
        if w % 10 == 1 or w % 10 == 9:
            # bits 23, 24 are chosen so that D29 = D30 = 0; d24 alone enters D29, d23 only D30
            data &= 0xFFFFFC
            data |= _odd(((previous << 24) | data) & PARITY_MASKS[4])
            data |= _odd(((previous << 24) | data) & PARITY_MASKS[5]) << 1
        check = _parity((previous << 24) | data)
        sent = (((data ^ 0xFFFFFF) if previous & 1 else data) << 6) | check
        for i in range(30):
            bits[30 * w + i] = (sent >> (29 - i)) & 1
        previous = sent & 3


def transmit(subframes: list[int]) -> np.ndarray:
    """Transmitted bits, uint8 (300 n,), of subframes given without parity; the one before ended in 00."""
    words = np.array([(s >> (276 - 30 * w)) & 0xFFFFFF for s in subframes for w in range(10)], np.int64)
    bits = np.empty(SUBFRAME_BITS * len(subframes), np.uint8)
    _transmit(words, 0, bits)
    return bits


@njit(cache=True, nogil=True)
def _check(bits, first, n_words, previous, data, good):
    for w in range(n_words):
        received = 0
        for i in range(30):
            received = (received << 1) | int(bits[first + 30 * w + i])
        d = received >> 6
        if previous & 1:
            d ^= 0xFFFFFF
        data[w] = d
        good[w] = _parity((previous << 24) | d) == received & 63
        previous = received & 3


@njit(cache=True, nogil=True)
def _find(bits, start):
    """First place from `start` that reads like words 1 and 2 of a subframe, and its polarity; -1 if none."""
    data = np.empty(2, np.int64)
    good = np.empty(2, np.bool_)
    for first in range(start, bits.size - 59):
        byte = 0
        for i in range(8):
            byte = (byte << 1) | int(bits[first + i])
        if byte != 0x8B and byte != 0x74:
            continue
        previous = 0 if byte == 0x8B else 3
        last = (int(bits[first + 58]) << 1) | int(bits[first + 59])
        if last != previous:
            continue
        _check(bits, first, 2, previous, data, good)
        subframe = (data[1] >> 2) & 7
        count = data[1] >> 7
        start_count = (count + 100799) % 100800
        if good[0] and good[1] and count < 100800 and subframe == start_count % 5 + 1:
            return first, 1 if byte == 0x8B else -1
    return -1, 0


# --- encoder ---


def _values(record: np.void) -> dict[str, float]:
    return {name: float(record[name]) for name in BROADCAST}


def _header(count: int, where: str) -> int:
    values = {"preamble": PREAMBLE, "tlm_message": 0, "integrity": 0, "alert": 0, "anti_spoof": 1}
    values |= {"tow_count": (count + 1) % SUBFRAMES_PER_WEEK, "subframe": count % 5 + 1}
    return pack(HEADER, values, SUBFRAME_BITS, where)


def _ephemeris_subframe(record: np.void, number: int, week: int, where: str) -> int:
    values = _values(record) | {"week_1024": week % 1024, "codes_on_l2": 1, "l2_p_data": 0, "aodo": 31}
    table = (SUBFRAME_1, SUBFRAME_2, SUBFRAME_3)[number - 1]
    return pack(table, values, SUBFRAME_BITS, where)


def _dummy_page(sv_id: int) -> int:
    return pack(PAGE, {"data_id": 1, "sv_id": sv_id}, SUBFRAME_BITS, "LNAV dummy page") | ALTERNATING


def _utc_values(iono_utc: np.void, step_s: int) -> dict[str, float]:
    """Fields of the time polynomial, moved to a reference time that the message can hold."""
    tot_s = epoch_on_grid(float(iono_utc["tot_s"]), step_s)
    shift_s = tot_s - float(iono_utc["tot_s"])
    a1 = float(iono_utc["a1_utc_s_s"])
    values = {name: float(iono_utc[name]) for name in ("dt_ls_s", "dn", "dt_lsf_s")}
    values |= {"a0_utc_s": float(iono_utc["a0_utc_s"]) + a1 * shift_s, "a1_utc_s_s": a1, "tot_s": tot_s}
    return values | {"week_t_256": iono_utc["week_t"] % 256, "week_lsf_256": iono_utc["week_lsf"] % 256}


def _page_18(iono_utc: np.void | None) -> int:
    if iono_utc is None:
        return _dummy_page(0)
    values = _utc_values(iono_utc, 4096) | {"data_id": 1, "sv_id": 56}
    for i in range(4):
        values |= {f"alpha{i}": iono_utc["alpha"][i], f"beta{i}": iono_utc["beta"][i]}
    return pack(PAGE_18, values, SUBFRAME_BITS, "LNAV subframe 4 page 18")


def _almanac_page(records: dict[int, np.void], prn: int, week: int, toa_s: int) -> int:
    if prn not in records:
        return _dummy_page(0)
    record = records[prn]
    values: dict[str, float] = elements(record, week, toa_s)
    values["delta_i_rad"] = values["i0_rad"] - REFERENCE_INCLINATION_RAD
    # 8-bit health: 3 bits on the data (111 = all bad), 5 on the signals (20.3.3.5.1.3)
    health = int(record["health"])
    values |= {
        "data_id": 1,
        "sv_id": prn,
        "toa_s": toa_s,
        "health": (0b111 << 5 if health >> 5 else 0) | health & 31,
    }
    return pack(ALMANAC, values, SUBFRAME_BITS, f"LNAV almanac of G{prn:02d}")


def _health_page(
    records: dict[int, np.void], table: tuple[Field, ...], sv_id: int, week: int, toa_s: int
) -> int:
    """Page 25 of subframe 4 or 5; a satellite without almanac has health 63 and configuration 0."""
    values = {"data_id": 1, "sv_id": sv_id, "toa_s": toa_s, "week_a_256": week % 256}
    for prn in range(1, 33):
        values[f"health_{prn}"] = int(records[prn]["health"]) if prn in records else 63
        values[f"config_{prn}"] = 0b1001 if prn in records else 0  # anti-spoof on, block II (20.3.3.5.1.4)
    return pack(table, values, SUBFRAME_BITS, "LNAV health page")


def _long_term_page(subframe: int, page: int, iono_utc: np.void | None, records: dict[int, np.void]) -> int:
    """Subframe 4 or 5, pages 1..25 (table 20-V)."""
    week, toa_s = reference_time(records.values(), 4096) if records else (0, 0)
    if subframe == 5 and page == 25:
        return _health_page(records, HEALTH_1_24, HEALTH_PAGE_SV_ID, week, toa_s)
    if subframe == 5:
        return _almanac_page(records, page, week, toa_s)
    sv_id = SUBFRAME_4_SV_ID[page - 1]
    if sv_id == 56:
        return _page_18(iono_utc)
    if sv_id == 63:
        return _health_page(records, HEALTH_25_32, sv_id, week, toa_s)
    return _almanac_page(records, sv_id, week, toa_s) if sv_id <= 32 else _dummy_page(sv_id)


def _sorted_records(ephemeris: np.ndarray | np.void) -> np.ndarray:
    records = np.atleast_1d(np.asarray(ephemeris, EPHEMERIS))
    if records.size == 0 or np.any(records["system"] != b"G") or np.any(records["prn"] != records["prn"][0]):
        raise ValueError("LNAV needs one or more ephemerides of one GPS satellite")
    for record in records:
        if not record["iode"] == record["iodc"] & 0xFF:
            raise ValueError(
                f"LNAV of G{record['prn']:02d}: IODE {record['iode']} must equal the low 8 bits of "
                f"IODC {record['iodc']}"
            )
    return records[np.lexsort((records["toe_s"], records["week"]))]


def _in_force(records: np.ndarray, time_s: int) -> int:
    """Index of the data set sent at absolute time `time_s`: a set goes on air two hours before its toe."""
    cut_over_s = records["week"] * float(SECONDS_PER_WEEK) + records["toe_s"] - 7200.0
    return max(int(np.searchsorted(cut_over_s, time_s, side="right")) - 1, 0)


def encode(
    ephemeris: np.ndarray | np.void,
    iono_utc: np.void | None,
    almanac: np.ndarray | None,
    week: int,
    tow_s: int,
    n_bits: int,
) -> np.ndarray:
    """LNAV bits of one satellite as transmitted from GPS time (week, tow_s) on.

    Parameters
    ----------
    ephemeris : EPHEMERIS record, or array of records of this satellite; one of several comes into force on
        the first frame at least two hours before its toe.
    iono_utc : IONO_UTC record for subframe 4 page 18, or None for a dummy page.
    almanac : EPHEMERIS array, reduced to almanacs at the latest toe; others' pages are dummies. None: all
        dummies.
    week, tow_s : continuous GPS week and whole second of the first bit.
    n_bits : number of 20 ms bits.

    Returns
    -------
    int8 (n_bits,), logic 0 -> +1, logic 1 -> -1.

    Raises
    ------
    ValueError naming the field, its value and the range allowed, if a value does not fit its field.
    """
    records = _sorted_records(ephemeris)
    by_prn = latest_records(almanac, b"G", 32)
    where = f"LNAV of G{records['prn'][0]:02d}"
    check_start(where, week, tow_s, n_bits)
    iono_utc = None if iono_utc is None else np.atleast_1d(iono_utc)[0]
    cache: dict[tuple[int, int, int], int] = {}

    def body(count: int) -> int:
        subframe, frame = count % 5 + 1, count // 5
        if subframe <= 3:
            in_force, week_now = _in_force(records, frame * 30), count // SUBFRAMES_PER_WEEK
            key = (subframe, in_force, week_now)
            if key not in cache:
                cache[key] = _ephemeris_subframe(records[in_force], subframe, week_now, where)
        else:
            page = frame % (SUBFRAMES_PER_WEEK // 5) % 25 + 1
            key = (subframe, page, 0)
            if key not in cache:
                cache[key] = _long_term_page(subframe, page, iono_utc, by_prn)
        return cache[key]

    first = (int(week) * SECONDS_PER_WEEK + int(tow_s)) // 6
    skip = int(tow_s) % 6 * 50
    counts = range(first, first + -(-(skip + n_bits) // SUBFRAME_BITS))
    bits = transmit([body(count) | _header(count, where) for count in counts])
    return 1 - 2 * bits[skip : skip + n_bits].astype(np.int8)


def quantised(ephemeris: np.void) -> np.void:
    """Ephemeris as a receiver reads it from the message: every field rounded to its last bit."""
    record = np.array([ephemeris], EPHEMERIS)[0]
    for number, table in enumerate((SUBFRAME_1, SUBFRAME_2, SUBFRAME_3), 1):
        message = _ephemeris_subframe(record, number, int(record["week"]), f"LNAV of G{record['prn']:02d}")
        for name, value in unpack(table, message, SUBFRAME_BITS).items():
            if name in BROADCAST:
                record[name] = value
    return record


# --- decoder ---


def nearest_week(truncated: float, modulus: int, week: int) -> int:
    """Week nearest to `week` whose value modulo `modulus` is `truncated`."""
    return week + (int(truncated) - week + modulus // 2) % modulus - modulus // 2


class Decoder:
    """LNAV bits of one satellite to time, ephemeris, health and ionosphere.

    Bits may be inverted as a whole (half cycle of the carrier): the preamble tells, and parity undoes it. A
    place is accepted as the start of a subframe if preamble, parity of words 1 and 2, their trailing zeros
    and the agreement of subframe number and TOW allow it (chance 1e-7 per bit); time counts once two headers
    agree on it, or the later one says that up to a minute is missing between them: a hole in the samples.

    Parameters
    ----------
    prn : satellite.
    first_week : the ten bits of the week are resolved into first_week .. first_week + 1023; the default holds
        for signals of 2016-06 to 2036-01. Older or later recordings need another.

    Attributes
    ----------
    synced, polarity : +1 upright, -1 inverted, 0 unknown.
    ephemeris : EPHEMERIS record or None; subframes 1, 2, 3 of one IODC / IODE, newest set.
    iono_utc, iono_utc_valid : IONO_UTC record and the set of its parts received ("klobuchar", "utc").
    almanac : prn -> dict of almanac elements.
    health, alert, healthy : 6-bit health, alert flag of the last header, and their summary (None = unknown).
    timed_index : index of the last header that said the time; -1 before any.
    words_ok, words_failed, subframes_ok, subframes_failed : parity counts while synced.
    ggto : None (LNAV carries none).
    """

    symbol_ms = BIT_MS
    symbols_per_week = SECONDS_PER_WEEK * 1000 // BIT_MS
    lost_after = 3  # subframes without a valid header
    longest_hole = 3000  # bits

    def __init__(self, prn: int, first_week: int = FIRST_WEEK):
        self.prn = prn
        self.first_week = first_week
        self.ephemeris: np.void | None = None
        self.iono_utc = np.zeros(1, IONO_UTC)[0]
        self.iono_utc_valid: set[str] = set()
        self.ggto = None
        self.almanac: dict[int, dict[str, float]] = {}
        self.health: int | None = None
        self.alert: bool | None = None
        self.polarity = 0
        self.synced = False
        self.words_ok = self.words_failed = self.subframes_ok = self.subframes_failed = 0
        self._bits = np.empty(0, np.uint8)
        self._before = np.empty(0, np.uint8)  # the subframe that was read last
        self._index = 0  # of self._bits[0]
        self._sought = -1  # index of the subframe whose header was looked for elsewhere
        self._missed = 0
        self._phase: int | None = None  # confirmed: symbols since the start of the week at index 0
        self._phase_candidate: int | None = None
        self.timed_index = -1
        self._week_anchor: tuple[int, int, int] | None = None  # (week, index of a symbol in it, phase)
        self._subframes: dict[int, dict[str, float]] = {}
        self._said: dict[int, dict[str, float]] = {}  # orbit or clock of the last subframe of each kind

    @property
    def healthy(self) -> bool | None:
        """Health 0 and no alert flag; None before subframe 1."""
        return None if self.health is None else self.health == 0 and not self.alert

    def tow_of(self, index: int) -> int | None:
        """Transmit time of the start of bit `index`, ms of week, GPS time; None until confirmed."""
        if self._phase is None:
            return None
        return (self._phase + int(index)) % self.symbols_per_week * self.symbol_ms

    def week_of(self, index: int) -> int | None:
        """Continuous week in which bit `index` was sent; None until time and week are known."""
        if self._phase is None or self._week_anchor is None or self._week_anchor[2] != self._phase:
            return None
        week, anchor, _ = self._week_anchor
        period = self.symbols_per_week
        return week + (self._phase + int(index)) // period - (self._phase + anchor) // period

    @property
    def week(self) -> int | None:
        """Continuous week of the last bit fed."""
        return self.week_of(self._index + self._bits.size - 1)

    def feed(self, symbols: np.ndarray, index0: int) -> list[tuple[str, int, int, bool]]:
        """Take soft bits (+ = logic 0) whose first one has running index `index0`.

        A jump of the index is a loss of bits: sync is sought afresh and time confirmed anew; decoded data
        stay.

        Returns
        -------
        List of ("subframe", id or 0 if unreadable, index of its first bit, all ten words pass parity).
        """
        bits = (np.asarray(symbols) < 0).astype(np.uint8)
        expected = self._index + self._bits.size
        if index0 != expected:
            self._restart(int(index0))
        self._bits = np.concatenate((self._bits, bits))
        events = []
        while self._advance():
            if self._bits.size < SUBFRAME_BITS:
                break
            events.append(self._subframe())
        return events

    def _restart(self, index0: int) -> None:
        self._bits, self._before, self._index = np.empty(0, np.uint8), np.empty(0, np.uint8), index0
        self.synced, self.polarity, self._missed = False, 0, 0
        if self._phase is not None:
            self._phase_candidate, self._phase = self._phase, None

    def _drop(self, n: int) -> None:
        self._bits, self._index = self._bits[n:], self._index + n

    def _advance(self) -> bool:
        """Move to the start of a subframe; False if none is in sight."""
        if self.synced:
            self._mind_holes()
            return True
        first, polarity = _find(self._bits, 0)
        if first < 0:
            self._drop(max(self._bits.size - 59, 0))
            return False
        self._sync(first, polarity)
        return True

    def _sync(self, first: int, polarity: int) -> None:
        self._drop(first)
        self.synced, self.polarity, self._missed = True, polarity, 0
        message, _ = self._read(2)
        self._accept_header(unpack(HEADER, message, SUBFRAME_BITS), self._index)

    def _mind_holes(self) -> None:
        """Where no header stands at its place, but one before it: bits are missing, which nothing else tells."""
        if self._bits.size < 60 or self._sought == self._index or self._phase is None:
            return
        self._sought = self._index
        if _find(self._bits[:60], 0)[0] == 0:
            return
        earlier = np.concatenate((self._before, self._bits[:60]))
        first, polarity = _find(earlier, 1)
        if first > 0:
            self._bits, self._index = (
                np.concatenate((self._before, self._bits)),
                self._index - self._before.size,
            )
            self._sync(first, polarity)

    def _read(self, n_words: int) -> tuple[int, np.ndarray]:
        """Subframe as an upright integer from its first words, and which pass parity; sets polarity."""
        data, good = np.zeros(10, np.int64), np.zeros(10, np.bool_)
        upright = np.count_nonzero(self._bits[:8] != bits_of(PREAMBLE, 8)) <= 4
        _check(self._bits, 0, n_words, 0 if upright else 3, data, good)
        if good[0]:
            self.polarity = 1 if upright else -1
        return sum(int(d) << (276 - 30 * w) for w, d in enumerate(data)), good

    def _subframe(self) -> tuple[str, int, int, bool]:
        index = self._index
        message, good = self._read(10)
        self.words_ok += int(good.sum())
        self.words_failed += int(10 - good.sum())
        header = unpack(HEADER, message, SUBFRAME_BITS)
        number = 0
        if good[0] and good[1] and self._accept_header(header, index):
            self._missed = 0
            number = int(header["subframe"])
        else:
            self._missed += 1
        ok = bool(good.all()) and number > 0
        self.subframes_ok += ok
        self.subframes_failed += not ok
        if ok:
            self._take(number, message, index)
        self._before = self._bits[:SUBFRAME_BITS]
        self._drop(SUBFRAME_BITS)
        # a place never confirmed by a second header was a chance one
        if self._missed >= (1 if self._phase is None else self.lost_after):
            self.synced = False
        return "subframe", number, index, ok

    def _accept_header(self, header: dict[str, float], index: int) -> bool:
        """Check the header, keep its time: a candidate first, confirmed by a second header that agrees.

        One that does not leaves time unknown.
        """
        count = (int(header["tow_count"]) - 1) % SUBFRAMES_PER_WEEK
        if header["preamble"] != PREAMBLE or header["tow_count"] >= SUBFRAMES_PER_WEEK:
            return False
        if header["subframe"] != count % 5 + 1:
            return False
        phase = (count * SUBFRAME_BITS - index) % self.symbols_per_week
        if index != self.timed_index:
            self._confirm(phase)
        self._phase_candidate, self.timed_index = phase, index
        self.alert = bool(header["alert"])
        return True

    def _confirm(self, phase: int) -> None:
        if self._phase_candidate is None:
            return
        missing = (phase - self._phase_candidate) % self.symbols_per_week
        self._phase = phase if missing <= self.longest_hole else None
        if missing and self._phase is not None and self._week_anchor is not None:
            week, anchor, _ = self._week_anchor
            self._week_anchor = week, anchor - missing, phase

    def _take(self, number: int, message: int, index: int) -> None:
        if number <= 3:
            values = unpack((SUBFRAME_1, SUBFRAME_2, SUBFRAME_3)[number - 1], message, SUBFRAME_BITS)
            if self._contradicts(number, values):
                return
            self._subframes[number] = values | {"index": index}
            if number == 1 and self._phase_candidate is not None:
                self.health = int(values["health"])
                week = self.first_week + (int(values["week_1024"]) - self.first_week) % 1024
                self._week_anchor = (week, index, self._phase_candidate)
            self._assemble()
            return
        page = unpack(PAGE, message, SUBFRAME_BITS)
        if page["data_id"] != 1:
            return
        if number == 4 and page["sv_id"] == 56:
            self._take_page_18(unpack(PAGE_18, message, SUBFRAME_BITS))
        elif 1 <= page["sv_id"] <= 32:
            values = unpack(ALMANAC, message, SUBFRAME_BITS)
            values["i0_rad"] = values.pop("delta_i_rad") + REFERENCE_INCLINATION_RAD
            self.almanac[int(page["sv_id"])] = values

    def _contradicts(self, number: int, values: dict[str, float]) -> bool:
        """Whether an orbit or clock came otherwise before under the same issue, which does not happen (20.3.4.4).

        It is an error that parity let pass, as one word in 64 at a half-cycle slip; but what comes alike twice running is
        right, and the first time was wrong.
        """
        issue, held = "iodc" if number == 1 else "iode", self.ephemeris
        said = {n: values[n] for n in OF_ONE_ISSUE & values.keys()}
        before, self._said[number] = self._said.get(number), said
        if held is None or held[issue] != values[issue] or said == before:
            return False
        return any(held[n] != value for n, value in said.items())

    def _assemble(self) -> None:
        """Ephemeris from subframes 1, 2, 3 if they are of one data set and time is known."""
        if len(self._subframes) < 3 or self._week_anchor is None:
            return
        one, two, three = (self._subframes[k] for k in (1, 2, 3))
        if not int(one["iodc"]) & 0xFF == two["iode"] == three["iode"]:
            return
        week, anchor, phase = self._week_anchor
        tow_s = (phase + anchor) % self.symbols_per_week * self.symbol_ms * 1e-3
        record = np.zeros(1, EPHEMERIS)[0]
        for name, value in (one | two | three).items():
            if name in BROADCAST:
                record[name] = value
        record["system"], record["prn"], record["tow_s"] = b"G", self.prn, tow_s
        record["week"] = week + round((tow_s - float(record["toe_s"])) / SECONDS_PER_WEEK)
        if self.ephemeris is not None and self.ephemeris["iodc"] == record["iodc"]:
            record["tow_s"] = self.ephemeris["tow_s"]  # of the first time the set was complete
        self.ephemeris = record

    def _take_page_18(self, values: dict[str, float]) -> None:
        reference = self._week_anchor[0] if self._week_anchor else self.first_week + 512
        for i in range(4):
            self.iono_utc["alpha"][i], self.iono_utc["beta"][i] = values[f"alpha{i}"], values[f"beta{i}"]
        for name in ("a0_utc_s", "a1_utc_s_s", "tot_s", "dt_ls_s", "dn", "dt_lsf_s"):
            self.iono_utc[name] = values[name]
        self.iono_utc["week_t"] = nearest_week(values["week_t_256"], 256, reference)
        self.iono_utc["week_lsf"] = nearest_week(values["week_lsf_256"], 256, reference)
        self.iono_utc_valid |= {"klobuchar", "utc"}
