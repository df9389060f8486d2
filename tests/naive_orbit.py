"""Textbook twins of the geometry kernels, written from the other end: rotation matrices, bisection, degrees."""

import numpy as np
from scipy.optimize import brentq

C = 299_792_458.0
OMEGA_E = 7.2921151467e-5


def rot_x(a):
    return np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])


def rot_z(a):
    return np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])


def satellite(eph, t_since_toe, t_since_toc):
    """ECEF position and clock with relativity; Kepler's equation by bisection, frames by matrices."""
    mu = 3.986004418e14 if eph["system"] == b"E" else 3.986005e14
    a = float(eph["sqrt_a_sqrt_m"]) ** 2
    m = eph["m0_rad"] + (np.sqrt(mu / a**3) + eph["delta_n_rad_s"]) * t_since_toe
    e = eph["e"]
    ea = brentq(lambda x: x - e * np.sin(x) - m, m - 1.0, m + 1.0, xtol=1e-15, rtol=1e-15)
    nu = 2.0 * np.arctan(np.sqrt((1.0 + e) / (1.0 - e)) * np.tan(ea / 2.0))
    phi = nu + eph["omega_rad"]
    wave = np.array([np.cos(2.0 * phi), np.sin(2.0 * phi)])
    u = phi + wave @ [eph["cuc_rad"], eph["cus_rad"]]
    r = a * (1.0 - e * np.cos(ea)) + wave @ [eph["crc_m"], eph["crs_m"]]
    inc = eph["i0_rad"] + eph["idot_rad_s"] * t_since_toe + wave @ [eph["cic_rad"], eph["cis_rad"]]
    inertial_node = eph["omega0_rad"] + eph["omega_dot_rad_s"] * t_since_toe
    earth = OMEGA_E * (eph["toe_s"] + t_since_toe)
    pos = rot_z(inertial_node - earth) @ rot_x(inc) @ rot_z(u) @ np.array([r, 0.0, 0.0])
    rel = -2.0 * np.sqrt(mu * a) / C**2 * e * np.sin(ea)
    clock = eph["af0_s"] + eph["af1_s_s"] * t_since_toc + eph["af2_s_s2"] * t_since_toc**2 + rel
    return pos, clock


def klobuchar_m(lat_deg, lon_deg, az_deg, el_deg, tow, alpha, beta):
    """IS-GPS-200 figure 20-4 in metres, angles in degrees."""
    e = el_deg / 180.0
    psi = 0.0137 / (e + 0.11) - 0.022
    phi = np.clip(lat_deg / 180.0 + psi * np.cos(np.deg2rad(az_deg)), -0.416, 0.416)
    lam = lon_deg / 180.0 + psi * np.sin(np.deg2rad(az_deg)) / np.cos(phi * np.pi)
    mag = phi + 0.064 * np.cos((lam - 1.617) * np.pi)
    t = (43200.0 * lam + tow) % 86400.0
    amp = max(np.polyval(list(alpha)[::-1], mag), 0.0)
    per = max(np.polyval(list(beta)[::-1], mag), 72000.0)
    x = 2.0 * np.pi * (t - 50400.0) / per
    day = amp * (1.0 - x**2 / 2.0 + x**4 / 24.0) if abs(x) < 1.57 else 0.0
    return C * (1.0 + 16.0 * (0.53 - e) ** 3) * (5e-9 + day)
