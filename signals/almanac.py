"""Reduction of an ephemeris to the elements of an almanac at a common reference time (GPS and Galileo)."""

from collections.abc import Iterable

import numpy as np

from signals.constants import EARTH_RATE_RAD_S, MU_GALILEO_M3_S2, MU_GPS_M3_S2, SECONDS_PER_WEEK


def latest_records(almanac: np.ndarray | None, system: bytes, last_prn: int) -> dict[int, np.void]:
    """Newest record (by toe) of each satellite 1 .. last_prn of a system, by number."""
    if almanac is None:
        return {}
    chosen = [r for r in np.atleast_1d(almanac) if r["system"] == system and 1 <= r["prn"] <= last_prn]
    chosen.sort(key=lambda record: (int(record["prn"]), int(record["week"]), float(record["toe_s"])))
    return {int(record["prn"]): record for record in chosen}


def reference_time(almanac: Iterable[np.void], step_s: int) -> tuple[int, int]:
    """(week, s of week) of the latest time of ephemeris, rounded down to a multiple of `step_s`."""
    latest = max(almanac, key=lambda record: (int(record["week"]), float(record["toe_s"])))
    return int(latest["week"]), int(latest["toe_s"]) // step_s * step_s


def elements(ephemeris: np.void, week: int, toa_s: int) -> dict[str, float]:
    """Almanac elements of one satellite at (week, toa_s), angles in rad.

    M0 and af0 move with the mean motion and the clock drift. The node is reckoned from the start of the week
    of the reference time, so it also moves by the Earth's rotation over whole weeks:
    Omega0' = Omega0 + OmegaDot dt - OmegaE 604800 dweek (IS-GPS-200, table 20-IV, lines of the node).
    """
    mu = MU_GPS_M3_S2 if ephemeris["system"] == b"G" else MU_GALILEO_M3_S2
    weeks = week - int(ephemeris["week"])
    dt_s = weeks * SECONDS_PER_WEEK + toa_s - float(ephemeris["toe_s"])
    dtoc_s = weeks * SECONDS_PER_WEEK + toa_s - float(ephemeris["toc_s"])
    mean_motion = np.sqrt(mu) / float(ephemeris["sqrt_a_sqrt_m"]) ** 3 + float(ephemeris["delta_n_rad_s"])
    node = float(ephemeris["omega0_rad"]) + float(ephemeris["omega_dot_rad_s"]) * dt_s
    return {
        "m0_rad": float(ephemeris["m0_rad"]) + mean_motion * dt_s,
        "omega0_rad": node - EARTH_RATE_RAD_S * SECONDS_PER_WEEK * weeks,
        "omega_rad": float(ephemeris["omega_rad"]),
        "i0_rad": float(ephemeris["i0_rad"]) + float(ephemeris["idot_rad_s"]) * dt_s,
        "omega_dot_rad_s": float(ephemeris["omega_dot_rad_s"]),
        "e": float(ephemeris["e"]),
        "sqrt_a_sqrt_m": float(ephemeris["sqrt_a_sqrt_m"]),
        "af0_s": float(ephemeris["af0_s"]) + float(ephemeris["af1_s_s"]) * dtoc_s,
        "af1_s_s": float(ephemeris["af1_s_s"]),
    }


def epoch_on_grid(tot_s: float, step_s: int) -> int:
    """Multiple of `step_s` nearest to `tot_s` inside the week: where a reference time may lie."""
    return min(round(tot_s / step_s), (SECONDS_PER_WEEK - 1) // step_s) * step_s
