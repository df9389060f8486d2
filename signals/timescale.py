"""GPS time: continuous week and second of week, to and from calendar time."""

from datetime import datetime, timedelta

from signals.constants import SECONDS_PER_WEEK

GPS_EPOCH = datetime(1980, 1, 6)
"""Start of week 0 (IS-GPS-200, 3.3.4)."""
GST_WEEK_OFFSET = 1024
"""GST week 0 is GPS week 1024 (Galileo OS SIS ICD, 5.1.2)."""


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
