"""Kernels of the geometry chain: broadcast orbit, atmosphere, light time. One module, so one on-disk cache.

Everything here is per satellite and per instant, plain arrays and scalars in, float64 throughout, no
fastmath: the delay (0.07 s) has to hold micrometres.
"""

import math

import numpy as np
from numba import njit

from signals.constants import C_MPS, EARTH_RATE_RAD_S, GNSS_PI, WGS84_A_M, WGS84_E2, WGS84_F

ORBIT_FIELDS = (
    "mean_motion_rad_s",
    "a_m",
    "e",
    "m0_rad",
    "omega_node_rad",
    "omega_dot_rel_rad_s",
    "i0_rad",
    "idot_rad_s",
    "omega_rad",
    "cuc_rad",
    "cus_rad",
    "crc_m",
    "crs_m",
    "cic_rad",
    "cis_rad",
    "af0_s",
    "af1_s_s",
    "af2_s_s2",
    "rel_s",
)
"""Columns of the flat orbit array made by `signals.orbits.orbit_coefficients`."""

IONOSPHERE_M = 350e3
"""Height of the shell that holds all of Klobuchar's ionosphere (IS-GPS-200, 20.3.3.5.2.5): above it there is none."""
KLOBUCHAR_X_ICD = 1.57
"""Half width of the day-time cosine, rad (IS-GPS-200, figure 20-4)."""
KLOBUCHAR_X_CONTINUOUS = math.sqrt(6.0 - math.sqrt(12.0))
"""First zero of 1 - x^2/2 + x^4/24: with this limit the model has no step of 2 % of its amplitude at dusk."""

_MIN_ELEVATION_RAD = math.radians(1.0)
_RATE_STEP_S = 1e-3
_TAU0_S = 0.075


@njit(cache=True, nogil=True)
def orbit_kernel(k, dt_toe_s, dt_toc_s):
    """Satellite position, velocity and clock from broadcast elements (IS-GPS-200, table 20-IV, derived).

    Parameters
    ----------
    k : float64 (19,)
        One row of `signals.orbits.orbit_coefficients`.
    dt_toe_s, dt_toc_s : float64
        Seconds from toe and from toc to the instant, within +-302400.

    Returns
    -------
    tuple of 8 float64
        x, y, z (m), vx, vy, vz (m/s) in ECEF at the instant; clock (s) and its rate (s/s), relativistic term
        included, group delay not.
    """
    n, a, e = k[0], k[1], k[2]
    m = k[3] + n * dt_toe_s
    ea = m + e * math.sin(m)
    for _ in range(20):
        step = (ea - e * math.sin(ea) - m) / (1.0 - e * math.cos(ea))
        ea -= step
        if abs(step) < 1e-14:
            break
    sin_e, cos_e = math.sin(ea), math.cos(ea)
    q = 1.0 - e * cos_e
    ea_dot = n / q
    root = math.sqrt(1.0 - e * e)
    phi = math.atan2(root * sin_e, cos_e - e) + k[8]
    phi_dot = root * ea_dot / q
    s2, c2 = math.sin(2.0 * phi), math.cos(2.0 * phi)
    u = phi + k[10] * s2 + k[9] * c2
    r = a * q + k[12] * s2 + k[11] * c2
    i = k[6] + k[7] * dt_toe_s + k[14] * s2 + k[13] * c2
    u_dot = phi_dot * (1.0 + 2.0 * (k[10] * c2 - k[9] * s2))
    r_dot = a * e * sin_e * ea_dot + 2.0 * phi_dot * (k[12] * c2 - k[11] * s2)
    i_dot = k[7] + 2.0 * phi_dot * (k[14] * c2 - k[13] * s2)
    node = k[4] + k[5] * dt_toe_s
    su, cu, si, ci = math.sin(u), math.cos(u), math.sin(i), math.cos(i)
    so, co = math.sin(node), math.cos(node)
    xp, yp = r * cu, r * su
    xp_dot, yp_dot = r_dot * cu - yp * u_dot, r_dot * su + xp * u_dot
    x, y, z = xp * co - yp * ci * so, xp * so + yp * ci * co, yp * si
    vx = xp_dot * co - (yp_dot * ci - yp * si * i_dot) * so - y * k[5]
    vy = xp_dot * so + (yp_dot * ci - yp * si * i_dot) * co + x * k[5]
    vz = yp_dot * si + yp * ci * i_dot
    clock = k[15] + dt_toc_s * (k[16] + dt_toc_s * k[17]) + k[18] * sin_e
    clock_rate = k[16] + 2.0 * dt_toc_s * k[17] + k[18] * cos_e * ea_dot
    return x, y, z, vx, vy, vz, clock, clock_rate


@njit(cache=True, nogil=True)
def orbits_kernel(k, dt_toe_s, dt_toc_s, out):
    """`orbit_kernel` over instants: k (19,), dt (n,), out (n, 8) written."""
    for j in range(dt_toe_s.size):
        state = orbit_kernel(k, dt_toe_s[j], dt_toc_s[j])
        for c in range(8):
            out[j, c] = state[c]


@njit(cache=True, nogil=True)
def geodetic_kernel(x, y, z):
    """Latitude, longitude (rad), height (m) of one ECEF point; the scalar twin of `signals.geodesy`."""
    b = WGS84_A_M * (1.0 - WGS84_F)
    p = math.hypot(x, y)
    beta = math.atan2(z * WGS84_A_M, p * b)
    lat = 0.0
    for _ in range(3):
        sb, cb = math.sin(beta), math.cos(beta)
        lat = math.atan2(z + WGS84_E2 / (1.0 - WGS84_E2) * b * sb**3, p - WGS84_E2 * WGS84_A_M * cb**3)
        beta = math.atan2((1.0 - WGS84_F) * math.sin(lat), math.cos(lat))
    s = math.sin(lat)
    height = p * math.cos(lat) + z * s - WGS84_A_M * math.sqrt(1.0 - WGS84_E2 * s * s)
    return lat, math.atan2(y, x), height


@njit(cache=True, nogil=True)
def klobuchar_kernel(lat_rad, lon_rad, azimuth_rad, elevation_rad, tow_s, alpha, beta, x_limit):
    """Single-frequency L1 group delay of the ionosphere in s (IS-GPS-200, 20.3.3.5.2.5 and figure 20-4).

    ``x_limit`` is KLOBUCHAR_X_ICD for the letter of the ICD (a receiver), KLOBUCHAR_X_CONTINUOUS for a truth
    without steps.
    """
    el = elevation_rad / GNSS_PI
    psi = 0.0137 / (el + 0.11) - 0.022
    phi_i = min(max(lat_rad / GNSS_PI + psi * math.cos(azimuth_rad), -0.416), 0.416)
    lam_i = lon_rad / GNSS_PI + psi * math.sin(azimuth_rad) / math.cos(phi_i * GNSS_PI)
    phi_m = phi_i + 0.064 * math.cos((lam_i - 1.617) * GNSS_PI)
    local_s = (43_200.0 * lam_i + tow_s) % 86_400.0
    amp = max(alpha[0] + phi_m * (alpha[1] + phi_m * (alpha[2] + phi_m * alpha[3])), 0.0)
    per = max(beta[0] + phi_m * (beta[1] + phi_m * (beta[2] + phi_m * beta[3])), 72_000.0)
    x = 2.0 * GNSS_PI * (local_s - 50_400.0) / per
    slant = 1.0 + 16.0 * (0.53 - el) ** 3
    if abs(x) < x_limit:
        return slant * (5e-9 + amp * (1.0 - x * x / 2.0 + x**4 / 24.0))
    return slant * 5e-9


@njit(cache=True, nogil=True)
def saastamoinen_kernel(lat_rad, height_m, elevation_rad, humidity):
    """Slant delay of the troposphere in m: standard atmosphere, Saastamoinen zenith delay over sin(el).

    Hydrostatic 0.0022768 P / (1 - 0.00266 cos 2 lat - 0.00028 h_km), wet 0.002277 (1255 / T + 0.05) e
    (RTKLIB manual 2.4.2, E.5 (1)-(4)). Above 10 km, where RTKLIB returns zero, the atmosphere goes on.
    """
    h = max(height_m, 0.0)
    base = 1.0 - 2.2557e-5 * h
    if base <= 0.0:
        return 0.0
    pressure_hpa = 1013.25 * base**5.2568
    temp_k = max(15.0 - 6.5e-3 * h + 273.16, 216.65)
    vapour_hpa = 6.108 * humidity * math.exp((17.15 * temp_k - 4684.0) / (temp_k - 38.45))
    dry = 0.0022768 * pressure_hpa / (1.0 - 0.00266 * math.cos(2.0 * lat_rad) - 0.00028 * h / 1e3)
    wet = 0.002277 * (1255.0 / temp_k + 0.05) * vapour_hpa
    return (dry + wet) / math.sin(elevation_rad)


@njit(cache=True, nogil=True)
def _look(lat, lon, dx, dy, dz):
    """Elevation and azimuth (rad, azimuth in (-pi, pi]) of an ECEF line of sight."""
    sl, cl, so, co = math.sin(lat), math.cos(lat), math.sin(lon), math.cos(lon)
    radial = co * dx + so * dy
    north, east, up = -sl * radial + cl * dz, -so * dx + co * dy, cl * radial + sl * dz
    return math.atan2(up, math.hypot(north, east)), math.atan2(east, north)


@njit(cache=True, nogil=True)
def _atmosphere(lat, lon, height, dx, dy, dz, tow_s, iono_on, alpha, beta, tropo_on, humidity):
    """Ionospheric group delay and tropospheric delay, both in s, of one line of sight (d = satellite - r)."""
    el, az = _look(lat, lon, dx, dy, dz)
    # A satellite below the mask is not synthesised; the floor only keeps its numbers finite.
    el = max(el, _MIN_ELEVATION_RAD)
    iono_s, tropo_s = 0.0, 0.0
    if iono_on and height < IONOSPHERE_M:
        iono_s = klobuchar_kernel(lat, lon, az, el, tow_s, alpha, beta, KLOBUCHAR_X_CONTINUOUS)
    if tropo_on:
        tropo_s = saastamoinen_kernel(lat, height, el, humidity) / C_MPS
    return iono_s, tropo_s


@njit(cache=True, nogil=True)
def propagate_kernel(
    k, dt0_toe_s, dt0_toc_s, offset_s, t_s, r, v, tow0_s, iono_on, alpha, beta, tropo_on, humidity, out
):
    """Delay of every satellite at every instant, light time and Earth rotation solved exactly.

    tau = |R3(w tau) x_s(t - tau) - x_r(t)| / c + T + I, delay = tau - dt_sv(t - tau) + offset. The rate is
    its exact derivative, tau' = (u.R v_s - u.v_r + c (T + I)') / (c + u.R v_s - w u.R'x_s) with u the line of
    sight; T' and I' are central differences over +-1 ms along the motion (error < 1e-6 m/s).

    Parameters
    ----------
    k : (S, 19); dt0_toe_s, dt0_toc_s, offset_s : (S,)
        Orbits; seconds from toe, toc to the start epoch; group delay minus system time offset.
    t_s : (m,) true time since the start; r, v : (m, 3) receiver position and velocity in ECEF.
    out : (8, S, m), written
        delay, delay rate, ionosphere (s), its rate, elevation, azimuth (rad), range (m), flight time (s).
    """
    w, h = EARTH_RATE_RAD_S, _RATE_STEP_S
    place = np.empty((t_s.size, 3, 3))  # geodetic, at t - h, t, t + h
    for j in range(t_s.size):
        for i in range(3):
            d = (i - 1) * h
            place[j, i] = geodetic_kernel(r[j, 0] + d * v[j, 0], r[j, 1] + d * v[j, 1], r[j, 2] + d * v[j, 2])
    for s in range(k.shape[0]):
        for j in range(t_s.size):
            t, rx, ry, rz = t_s[j], r[j, 0], r[j, 1], r[j, 2]
            tow = tow0_s + t
            tau, iono, tropo = _TAU0_S, 0.0, 0.0
            x = y = z = vx = vy = vz = clock = clock_rate = dx = dy = dz = rho = 0.0
            for it in range(3):
                x, y, z, vx, vy, vz, clock, clock_rate = orbit_kernel(
                    k[s], dt0_toe_s[s] + (t - tau), dt0_toc_s[s] + (t - tau)
                )
                sw, cw = math.sin(w * tau), math.cos(w * tau)
                x, y = cw * x + sw * y, cw * y - sw * x
                vx, vy = cw * vx + sw * vy, cw * vy - sw * vx
                dx, dy, dz = x - rx, y - ry, z - rz
                rho = math.sqrt(dx * dx + dy * dy + dz * dz)
                if it == 1:  # the last round moves the satellite by less than a millimetre
                    g = place[j, 1]
                    iono, tropo = _atmosphere(
                        g[0], g[1], g[2], dx, dy, dz, tow, iono_on, alpha, beta, tropo_on, humidity
                    )
                tau = rho / C_MPS + iono + tropo
            ux, uy, uz = dx / rho, dy / rho, dz / rho
            rvx, rvy, rvz = v[j, 0], v[j, 1], v[j, 2]
            lx, ly, lz = vx - rvx, vy - rvy, vz - rvz
            g = place[j, 2]
            i1, t1 = _atmosphere(
                g[0], g[1], g[2], dx + h * lx, dy + h * ly, dz + h * lz,
                tow + h, iono_on, alpha, beta, tropo_on, humidity,
            )  # fmt: skip
            g = place[j, 0]
            i0, t0 = _atmosphere(
                g[0], g[1], g[2], dx - h * lx, dy - h * ly, dz - h * lz,
                tow - h, iono_on, alpha, beta, tropo_on, humidity,
            )  # fmt: skip
            iono_rate, atm_rate = (i1 - i0) / (2.0 * h), (i1 + t1 - i0 - t0) / (2.0 * h)
            us = ux * vx + uy * vy + uz * vz
            # R3(w tau) turns with tau: d(R x)/d(tau) = w (y, -x, 0).
            turn = w * (ux * y - uy * x)
            los = us - (ux * rvx + uy * rvy + uz * rvz)
            tau_rate = (los + C_MPS * atm_rate) / (C_MPS + us - turn)
            el, az = _look(place[j, 1, 0], place[j, 1, 1], dx, dy, dz)
            out[0, s, j] = tau - clock + offset_s[s]
            out[1, s, j] = tau_rate - clock_rate * (1.0 - tau_rate)
            out[2, s, j] = iono
            out[3, s, j] = iono_rate
            out[4, s, j] = el
            out[5, s, j] = az % (2.0 * np.pi)
            out[6, s, j] = rho
            out[7, s, j] = tau
