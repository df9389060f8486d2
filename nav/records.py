"""Structured arrays that leave this package.

Signs: innovation = measured - predicted; error state = true - estimate; u = unit vector receiver ->
satellite. Frames are in the names: ecef, ned; ``C_bn`` rotates body (forward, right, down) into
north-east-down.
"""

import numpy as np

TRANSMIT = np.dtype(
    [
        ("sample_index", "u8"),  # the same for all rows of one epoch
        ("system", "S1"),  # b"G" or b"E"
        ("signal", "S4"),
        ("prn", "i4"),
        ("tow_tx_ms", "i8"),  # whole ms of the transmit time of week at sample_index; -1: not decoded yet
        ("tow_tx_frac_s", "f8"),  # remainder, in [0, 1e-3)
        ("doppler_hz", "f8"),
        ("carrier_phase_cycles", "f8"),  # grows with positive Doppler
        ("cn0_dbhz", "f8"),
        ("lock_s", "f8"),  # time since the phase was last lost
        ("cycle_slip", "?"),  # since the previous epoch
    ]
)
"""What tracking and telemetry know of one channel at a common receiver sample."""

OBSERVATION = np.dtype(
    [
        ("sample_index", "u8"),
        ("system", "S1"),
        ("signal", "S4"),
        ("prn", "i4"),
        ("tow_tx_s", "f8"),  # transmit time, integer part of the ms kept exact: see tow_tx_ms
        ("tow_tx_ms", "i8"),  # whole milliseconds of the transmit time
        ("tow_tx_frac_s", "f8"),  # remainder, in [0, 1e-3)
        ("pseudorange_m", "f8"),
        ("pseudorange_smoothed_m", "f8"),
        ("doppler_hz", "f8"),
        ("carrier_phase_cycles", "f8"),
        ("cn0_dbhz", "f8"),
        ("lock_s", "f8"),
        ("cycle_slip", "?"),
    ]
)
"""One satellite at a common receiver sample."""

SATELLITE = np.dtype(
    [
        ("system", "S1"),
        ("prn", "i4"),
        ("pos_ecef_m", "f8", 3),  # at transmission, in the Earth-fixed frame of that instant
        ("vel_ecef_mps", "f8", 3),
        ("clock_m", "f8"),  # c x (dt_SV - TGD or BGD), relativity included
        ("clock_rate_mps", "f8"),
        ("azimuth_rad", "f8"),
        ("elevation_rad", "f8"),
        ("iono_m", "f8"),
        ("tropo_m", "f8"),
        ("atmosphere_rate_mps", "f8"),  # what the carrier sees: d(tropo - iono)/dt
    ]
)
"""A satellite at transmission and, once a position is known, as seen from it; row i = observation i."""

VIEW = np.dtype([("sample_index", "u8"), *((n, SATELLITE[n]) for n in SATELLITE.names or ()), ("used", "?")])
"""A satellite as the position stage saw it at one epoch; ``used`` says whether it entered the position."""

SOLUTION = np.dtype(
    [
        ("sample_index", "u8"),
        ("t_s", "f8"),
        ("week", "i4"),
        ("tow_s", "f8"),
        ("pos_ecef_m", "f8", 3),
        ("vel_ecef_mps", "f8", 3),
        ("clock_bias_m", "f8"),
        ("clock_drift_mps", "f8"),
        ("isb_m", "f8"),  # Galileo minus GPS receiver bias
        ("cov_ecef_m2", "f8", (3, 3)),
        ("gdop", "f8"),
        ("pdop", "f8"),
        ("hdop", "f8"),
        ("vdop", "f8"),
        ("n_used", "i4"),
        ("chi2", "f8"),
        ("dof", "i4"),
        ("valid", "?"),
    ]
)

IMU = np.dtype(
    [
        ("sample_index", "u8"),  # IF sample at the interval's end
        ("t_s", "f8"),  # end of the interval over which the sensors integrated
        ("gyro_rad_s", "f8", 3),  # mean over the interval, body axes forward, right, down; inertial rate
        ("accel_mps2", "f8", 3),  # mean specific force; at rest and level (0, 0, -g)
    ]
)
"""One output of an inertial measurement unit; its increments are the means times the interval."""

ODOMETER = np.dtype(
    [
        ("sample_index", "u8"),
        ("t_s", "f8"),
        ("speed_mps", "f8"),  # along the forward axis at t_s; negative in reverse
    ]
)
"""One output of the wheel speed sensor."""

BAROMETER = np.dtype(
    [
        ("sample_index", "u8"),
        ("t_s", "f8"),
        ("height_m", "f8"),  # above the ellipsoid, as the pressure says
    ]
)
"""One output of the barometric altimeter."""

STEERING = np.dtype(
    [
        ("sample_index", "u8"),
        ("t_s", "f8"),
        ("state", "u1"),  # nav.ultratight: SCALAR, STEERED, COASTING, LOST
        ("n_steered", "i4"),  # channels under command
        ("n_used", "i4"),  # of them with a usable C/N0
        ("nis", "f8"),  # normalised innovations squared, sum over the rows
        ("rows", "i4"),
        ("sigma_2d_m", "f8"),
        ("sigma_range_m", "f8"),  # worst predicted range and rate
        ("sigma_rate_mps", "f8"),
        ("cn0_median_dbhz", "f8"),
    ]
)
"""What the steering filter did in one epoch."""
