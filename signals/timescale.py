"""GPS time: continuous week and second of week, to and from calendar time."""

from datetime import datetime, timedelta

from signals.constants import SECONDS_PER_WEEK

GPS_EPOCH = datetime(1980, 1, 6)
"""Start of week 0 (IS-GPS-200, 3.3.4)."""


def week_tow(gps_time: datetime) -> tuple[int, int]:
    """Continuous GPS week and whole second of week of a calendar GPS time (no leap seconds).

    Raises
    ------
    ValueError
        If the time carries a zone, a fraction of a second, or precedes 1980-01-06.
    """
    if gps_time.tzinfo is not None:
        raise ValueError(f"start {gps_time.isoformat()} carries a time zone: write GPS time without one")
    if gps_time.microsecond:
        raise ValueError(f"start {gps_time.isoformat()} has a fraction of a second: use a whole second")
    if gps_time < GPS_EPOCH:
        raise ValueError(f"start {gps_time.isoformat()} precedes the GPS epoch 1980-01-06")
    elapsed = gps_time - GPS_EPOCH
    return divmod(elapsed.days * 86_400 + elapsed.seconds, SECONDS_PER_WEEK)


def calendar(week: int, tow_s: float) -> datetime:
    """Calendar GPS time of a continuous week and second of week (microsecond resolution)."""
    return GPS_EPOCH + timedelta(days=7 * int(week), seconds=float(tow_s))


LEAP_SECONDS = (
    (datetime(1999, 1, 1), 13),
    (datetime(2006, 1, 1), 14),
    (datetime(2009, 1, 1), 15),
    (datetime(2012, 7, 1), 16),
    (datetime(2015, 7, 1), 17),
    (datetime(2017, 1, 1), 18),
)
"""UTC dates from which GPS time is this many seconds ahead (IERS Bulletin C 16 to 52)."""


def leap_seconds(gps_time: datetime) -> int:
    """GPS minus UTC in whole seconds at a calendar GPS time from 1999 on; ValueError before."""
    for start, seconds in reversed(LEAP_SECONDS):
        if gps_time - timedelta(seconds=seconds) >= start:
            return seconds
    raise ValueError(f"{gps_time:%Y-%m-%d} precedes {LEAP_SECONDS[0][0]:%Y}: its leap seconds are not listed")
