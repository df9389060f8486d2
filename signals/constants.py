"""Physical and signal constants, each with its source."""

C_MPS = 299_792_458.0
"""Speed of light (IS-GPS-200, 20.3.3.3.3)."""
F_L1_HZ = 1_575.42e6
"""GPS L1 / Galileo E1 carrier (IS-GPS-200, 3.3.1.1; Galileo OS SIS ICD, table 2)."""
CHIP_RATE_HZ = 1.023e6
"""Chip rate of C/A, E1-B and E1-C."""
CYCLES_PER_CHIP = 1540
"""Carrier cycles per chip, F_L1_HZ / CHIP_RATE_HZ, exact."""
WAVELENGTH_M = C_MPS / F_L1_HZ
METRES_PER_CHIP = C_MPS / CHIP_RATE_HZ

GNSS_PI = 3.1415926535898
"""Value of pi that the ICDs prescribe for semicircles (IS-GPS-200, table 20-IV)."""
EARTH_RATE_RAD_S = 7.2921151467e-5
"""WGS 84 / GTRF Earth rotation rate used by both ICDs."""
MU_GPS_M3_S2 = 3.986005e14
MU_GALILEO_M3_S2 = 3.986004418e14
F_REL_GPS_S_SQRT_M = -4.442807633e-10
F_REL_GALILEO_S_SQRT_M = -4.442807309e-10
"""Relativistic clock constants, -2 sqrt(mu) / c^2 (IS-GPS-200, 20.3.3.3.3.1; Galileo OS SIS ICD, 5.1.4)."""

WGS84_A_M = 6_378_137.0
WGS84_F = 1.0 / 298.257223563
WGS84_E2 = WGS84_F * (2.0 - WGS84_F)
MU_EARTH_M3_S2 = 3.986004418e14
"""WGS 84 gravitational constant of the Earth."""

SECONDS_PER_WEEK = 604_800
