"""Exact observations from the sky's geometry, for tests of the position stage without samples or tracking."""

import numpy as np

from nav.measurements import WEEK_MS
from nav.records import TRANSMIT
from signals.clock import ClockSpec
from signals.constants import C_MPS, F_L1_HZ, WAVELENGTH_M
from signals.sky import SkySpec
from signals.trajectory import Static

FS_HZ = 4e6


def make_sky(duration_s=600.0, motion=None, clock=None, **sky):
    motion = (motion or Static(lat_deg=48.1, lon_deg=11.6, height_m=520.0)).start(duration_s)
    clock = (clock or ClockSpec()).start(1, duration_s)
    return SkySpec(**sky).start(motion, clock, duration_s)


def transmit(sky, t_s, noise_m=0.0, rate_noise_mps=0.0, rng=None, fault_m=None):
    """TRANSMIT rows of all visible satellites at receiver reading t_s; ``fault_m`` {name: metres}."""
    p = sky.propagate([t_s])
    seen = [i for i in range(len(sky.satellites)) if p.visible[i, 0]]
    rows = np.zeros(len(seen), TRANSMIT)
    for k, i in enumerate(seen):
        sat = sky.satellites[i]
        delay = p.delay_s[i, 0] + (fault_m or {}).get(sat.name, 0.0) / C_MPS
        doppler = -F_L1_HZ * p.phase_delay_rate_s_s[i, 0]
        if rng is not None:
            delay += noise_m / C_MPS * rng.standard_normal()
            doppler += rate_noise_mps / WAVELENGTH_M * rng.standard_normal()
        ms = int(np.floor((t_s - delay) * 1e3))
        rows[k]["tow_tx_ms"] = (sky.tow_s * 1000 + ms) % WEEK_MS
        rows[k]["tow_tx_frac_s"] = (t_s - delay) - ms * 1e-3
        rows[k]["system"], rows[k]["prn"] = sat.system.encode(), sat.prn
        rows[k]["signal"] = b"L1CA" if sat.system == "G" else b"E1C"
        rows[k]["doppler_hz"] = doppler
        rows[k]["carrier_phase_cycles"] = -F_L1_HZ * p.phase_delay_s[i, 0]
        rows[k]["cn0_dbhz"] = p.cn0_dbhz[i, 0]
    rows["sample_index"] = round(t_s * FS_HZ)
    rows["lock_s"] = 1e4
    return rows


def ephemerides(sky):
    return np.array([s.ephemeris for s in sky.satellites])
