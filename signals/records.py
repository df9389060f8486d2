"""Structured arrays that leave this package; the unit is part of every field name.

Time. The master clock is the integer sample index. Scenario time ``t_s`` is seconds since the start epoch,
which is a *whole second* of GPS time ``(week, tow_s)``: small numbers keep delays exact to micrometres, where a
float64 time of week would round them to centimetres. ``week`` counts from 1980-01-06 without roll-over for both
systems (GST week + 1024).

Signs. ``delay_s`` grows with range. Positive Doppler = approaching. Logic 0 -> +1, logic 1 -> -1.
"""

import numpy as np

EPHEMERIS = np.dtype(
    [
        ("system", "S1"),  # b"G" or b"E"
        ("prn", "i4"),
        ("week", "i4"),  # continuous GPS week of toe
        ("toe_s", "f8"),
        ("toc_s", "f8"),
        ("tow_s", "f8"),  # transmission time of the message, s of week
        ("iode", "i4"),  # GPS IODE, Galileo IODnav
        ("iodc", "i4"),
        ("sqrt_a_sqrt_m", "f8"),
        ("e", "f8"),
        ("m0_rad", "f8"),
        ("delta_n_rad_s", "f8"),
        ("omega0_rad", "f8"),
        ("i0_rad", "f8"),
        ("omega_rad", "f8"),
        ("omega_dot_rad_s", "f8"),
        ("idot_rad_s", "f8"),
        ("cuc_rad", "f8"),
        ("cus_rad", "f8"),
        ("crc_m", "f8"),
        ("crs_m", "f8"),
        ("cic_rad", "f8"),
        ("cis_rad", "f8"),
        ("af0_s", "f8"),
        ("af1_s_s", "f8"),
        ("af2_s_s2", "f8"),
        ("tgd_s", "f8"),  # GPS TGD; Galileo BGD(E1,E5b)
        ("bgd_e5a_s", "f8"),  # Galileo BGD(E1,E5a)
        ("accuracy_index", "i4"),  # GPS URA index, Galileo SISA index
        ("health", "i4"),  # GPS 6-bit health; Galileo E1B_DVS + 2 * E1B_HS (0 = usable, both systems)
        ("fit_interval", "i4"),  # GPS fit-interval flag
    ]
)
"""One broadcast ephemeris and clock, GPS LNAV or Galileo I/NAV."""

IONO_UTC = np.dtype(
    [
        ("alpha", "f8", 4),  # Klobuchar alpha0..3, s / semicircle^n
        ("beta", "f8", 4),  # Klobuchar beta0..3, s / semicircle^n
        ("ai", "f8", 3),  # NeQuick ai0..2, sfu / deg^n
        ("a0_utc_s", "f8"),
        ("a1_utc_s_s", "f8"),
        ("tot_s", "f8"),
        ("week_t", "i4"),  # continuous week of tot
        ("dt_ls_s", "i4"),
        ("week_lsf", "i4"),
        ("dn", "i4"),
        ("dt_lsf_s", "i4"),
        ("a0g_s", "f8"),  # GST - GPS at t0g (Galileo word 10)
        ("a1g_s_s", "f8"),
        ("t0g_s", "f8"),
        ("week_0g", "i4"),
    ]
)
"""Ionosphere, UTC and GGTO parameters of a constellation."""

TRUTH = np.dtype(
    [
        ("sample_index", "u8"),
        ("t_s", "f8"),  # receiver time: sample_index / fs
        ("prn", "i4"),
        ("system", "S1"),
        ("delay_s", "f8"),  # total code delay incl. satellite and receiver clock, atmosphere
        ("delay_rate_s_s", "f8"),
        ("code_phase_chips", "f8"),  # phase of the received primary code at the sample, in [0, L)
        ("carrier_phase_cycles", "f8"),  # received carrier phase minus f_if * t, continuous
        ("doppler_hz", "f8"),
        ("doppler_rate_hz_s", "f8"),
        ("cn0_dbhz", "f8"),  # of the whole signal (both E1 components together)
        ("elevation_rad", "f8"),
        ("azimuth_rad", "f8"),
        ("range_m", "f8"),
    ]
)
"""Truth of one satellite at one sample (written at least every 0.1 s)."""

PVT_TRUTH = np.dtype(
    [
        ("sample_index", "u8"),
        ("t_s", "f8"),
        ("pos_ecef_m", "f8", 3),
        ("vel_ecef_mps", "f8", 3),
        ("clock_bias_s", "f8"),
        ("clock_drift_s_s", "f8"),
    ]
)
"""Truth of the receiver."""

JAMMER_TRUTH = np.dtype(
    [
        ("sample_index", "u8"),
        ("t_s", "f8"),
        ("jammer", "i4"),  # place in the scenario's list
        ("kind", "S15"),
        ("on", "?"),
        ("freq_hz", "f8"),  # of the centre at this sample, offset from the carrier
        ("bandwidth_hz", "f8"),  # about that centre, 0 for a tone; a swept tone: of the sweep
        ("jn0_dbhz", "f8"),  # power over thermal noise density (pulsed: while a pulse lasts); -inf while off
        ("js_db", "f8"),  # power over that of the satellite it was set against, when it began; NaN: none
    ]
)
"""Truth of one jammer at one sample."""

ECHO_TRUTH = np.dtype(
    [
        ("sample_index", "u8"),
        ("t_s", "f8"),
        ("prn", "i4"),  # 0: all that was recorded, its echo being injected
        ("system", "S1"),
        ("echo", "i4"),  # place in the list of the satellite's echoes
        ("delay_s", "f8"),  # excess over the direct signal
        ("power_db", "f8"),  # relative to the direct signal, -inf while it is hidden
        ("phase_rad", "f8"),  # carrier phase minus that of the direct signal
    ]
)
"""Truth of one echo at one sample."""

FAULT_TRUTH = np.dtype(
    [
        ("sample_index", "u8"),
        ("t_s", "f8"),
        ("fault", "i4"),  # place in the scenario's list
        ("kind", "S12"),
        ("system", "S1"),  # empty: all satellites
        ("prn", "i4"),
        ("on", "?"),
        ("code_m", "f8"),  # added to the code's range (a spoofer: its range minus the genuine one)
        ("carrier_m", "f8"),
        ("level_db", "f8"),  # added to the satellite's C/N0 (a spoofer: its power over the genuine one)
    ]
)
"""Truth of one fault at one sample."""

CODE_LINE = np.dtype(
    [
        ("signal", "S4"),
        ("waveform", "S5"),  # b"BPSK", b"BOC11", b"CBOC+", b"CBOC-"
        ("prn", "i4"),
        ("freq_hz", "f8"),  # offset from the carrier; the mirror line at -freq_hz has the same level
        ("level_db", "f8"),  # power of this one line, relative to the whole component
    ]
)
"""One line of a code spectrum."""
