"""Run of ``[receiver.steering]``: from the scalar receiver's fix to NCO commands, epoch after epoch, and back.

The hand-over to tracking is an AIDING row per channel, stamped with the sample from which it holds. A filter that no longer
knows a range to half a chip or a rate to half the discriminator's reach lets go: the channels return to their own loops, and
the next scalar fix starts it anew. Nothing diverges silently.
"""

import math
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from nav import pvt
from nav import ultratight_kernels as kernels
from nav.imu import BarometerSpec, ImuSpec, OdometerSpec
from nav.measurements import WEEK_MS
from nav.navlog import Remedy
from nav.records import SATELLITE, SOLUTION, STEERING
from nav.riss import speed_at
from nav.sensor_files import check_axes
from nav.ultratight import (
    COASTING,
    LOST,
    SCALAR,
    STEERED,
    USABLE_CN0_HZ,
    Filter,
    SteeringSpec,
    build_model,
    discriminator_table,
    model_code,
    nominal_of,
    start_covariance,
)
from nav.ultratight_kernels import LEFT_OUT
from signals.constants import C_MPS, METRES_PER_CHIP, SECONDS_PER_WEEK, WAVELENGTH_M
from signals.orbits import orbit_coefficients
from signals.records import EPHEMERIS
from tracking.lock import STATE_LOCKED
from tracking.records import AIDING

SLOTS = 24
"""Channels that one filter can hold."""
MIN_CN0_DBHZ = 30.0
"""A channel is taken over in phase lock at this C/N0 at the least."""
ISB_SIGMA_M = 5.0
"""Of an inter-system bias that a scalar fix gave."""
REPORT_S = 0.1
"""Between new values of the slower columns of ``Steering.record``."""
AXES_S, AXES_ROWS = 10.0, 3000
"""Without an odometer the IMU's axes are held against the satellites this often, over so many rows of ``REPORT_S``."""
REFRESH_S = 1.0
"""Atmosphere and ephemerides are renewed this often."""
MISSING_S = 5.0
"""A vector receiver that misses as many satellites as it hears for this long lets go: its replicas are elsewhere."""
INCONSISTENT_RATIO = 2.5
"""Mean of the normalised innovations squared (none above ``kernels.SURPRISE``) through a second, beyond which the filter is
not believed: sensors of another unit, frame or start. It stays below 1.2 through a jam and an outage."""


@dataclass(frozen=True)
class Sensors:
    """Rows of an IMU, an odometer and a barometer that cover the samples, with the Specs that describe their noise."""

    imu_spec: ImuSpec
    odometer_spec: OdometerSpec | None
    imu: np.ndarray
    odometer: np.ndarray | None
    barometer_spec: BarometerSpec | None = None
    barometer: np.ndarray | None = None

    def table(self) -> np.ndarray:
        """Sensor rows (m, N_SENSOR) at IMU times."""
        out = np.zeros((self.imu.size, kernels.N_SENSOR))
        out[:, :3], out[:, 3:6] = self.imu["gyro_rad_s"], self.imu["accel_mps2"]
        if self.odometer is not None:
            out[:, 6] = speed_at(self.odometer, self.imu["t_s"])
        out[:, 7] = np.nan
        if self.barometer is not None:
            at = np.searchsorted(self.imu["t_s"], self.barometer["t_s"] - 1e-6)
            known = at < self.imu.size
            out[at[known], 7] = self.barometer["height_m"][known]
        return out


def _time_of_week(ms, frac_s):
    """(whole s, remainder) of a receiver time in (whole ms, remainder)."""
    whole = ms // 1000
    return float(whole % SECONDS_PER_WEEK), (ms - whole * 1000) * 1e-3 + frac_s


class Steering:
    """Run of a SteeringSpec in vector or ultra-tight mode.

    After ``advance``: ``state``, ``record`` (STEERING row), ``reason`` (why it is not steering).
    """

    filter: Any  # Filter while it steers, else None

    def __init__(
        self,
        spec: SteeringSpec,
        fs_hz: float,
        sensors: Sensors | None,
        spacing_chips: dict[str, float],
        min_elevation_rad=0.0,
    ):
        self.spec, self.fs_hz, self.sensors = spec, float(fs_hz), sensors
        self.min_elevation_rad = min_elevation_rad
        self.model = build_model(
            spec,
            *((sensors.imu_spec, sensors.odometer_spec, sensors.barometer_spec) if sensors else ()),
        )
        self.per_epoch, self.dt_s = 1, 1.0 / spec.update_hz
        self._table = np.zeros((0, kernels.N_SENSOR))
        self._sensor_sample: list[int] = []
        self.axes = "not observable"
        self._moves: deque[tuple[float, ...]] = deque(maxlen=AXES_ROWS)
        if spec.mode == "ultra_tight":
            self._read_sensors()
        self._tables = np.stack(
            [
                discriminator_table("L1CA", spacing_chips["L1CA"]),
                discriminator_table("E1", spacing_chips["E1"]),
            ]
        )
        if spec.code_noise_m is not None:
            # Of the discriminator, whatever its gain: an estimate of C/N0 that dips must not make it small.
            self._tables[:, :, 1] = (spec.code_noise_m / METRES_PER_CHIP) ** 2
        self.log_length = 256
        self.state, self.reason, self.filter = SCALAR, "waiting for a scalar fix", None
        self.record = np.zeros(1, STEERING)
        self.sample = -1
        self._fix_since = -1
        self._seconds, self._released = {STEERED: 0.0, COASTING: 0.0}, ""
        self._began_s: float | None = None
        self._n_released, self._estimate_isb, self._reference = 0, False, "G"
        self._slots()

    def _slots(self):
        self.active, self.slot = np.zeros(SLOTS, np.bool_), np.zeros(SLOTS, np.int64)
        self.second, self.period_s = np.zeros(SLOTS), np.full(SLOTS, 1e-3)
        self.delay, self.delay_rate, self.bias = np.zeros(SLOTS), np.zeros(SLOTS), np.zeros(SLOTS)
        self.inflate, self.which = np.ones(2 * SLOTS), np.zeros(SLOTS, np.int64)
        self.orbit, self.toe_toc_tgd = np.zeros((SLOTS, 19)), np.zeros((SLOTS, 3))
        self.name: list[tuple[str, int] | None] = [None] * SLOTS
        self._taken = [b""] * SLOTS  # EPHEMERIS of each, as bytes
        self._ratio, self._missing_s, self._next_refresh = 1.0, 0.0, 0

    def _read_sensors(self):
        assert self.sensors is not None
        rate = self.sensors.imu_spec.rate_hz
        step = float(np.median(np.diff(self.sensors.imu["t_s"])))
        if abs(step * rate - 1.0) > 1e-3:
            raise ValueError(
                f"IMU rows come every {step:.6g} s, but sensors.imu.rate_hz = {rate:g}: set it to {1 / step:.6g}"
            )
        per = rate / self.spec.update_hz
        if per < 1 or abs(per - round(per)) > 1e-6:
            raise ValueError(
                f"sensors.imu.rate_hz = {rate:g} is not a multiple of receiver.steering.update_hz = {self.spec.update_hz:g}"
            )
        self.per_epoch, self.dt_s = round(per), 1.0 / rate
        self._table = self.sensors.table()
        self._sensor_sample = self.sensors.imu["sample_index"].tolist()
        if self.sensors.odometer is not None:
            self.axes = check_axes(self._table[:, 3:5], self._table[:, 2], self._table[:, 6], self.dt_s)

    # -- start and end ------------------------------------------------------------------------------------------

    def try_start(self, sample: int, solution, navigator, channels, ephemerides, klobuchar) -> bool:
        """Take over at ``sample`` from a scalar fix there, when all that is needed is known; else ``reason`` says what not.

        ``channels``: (tracker index, signal, prn, cn0_dbhz) of those in phase lock.
        """
        if solution is None or not bool(solution["valid"]):
            self._fix_since = -1
            self.reason = "waiting for a scalar fix"
            return False
        if self._fix_since < 0:
            self._fix_since = sample
        if sample - self._fix_since < self.spec.start_after_s * self.fs_hz:
            self.reason = "scalar fixes settle"
            return False
        clock, bias_m, isb_m = navigator.handover()
        has_gps = any(signal == "L1CA" for _, signal, _, _ in channels)
        self._reference = "G" if has_gps else "E"
        try:
            self._begin(sample, solution, bias_m)
        except ValueError as err:
            self.reason = str(err)
            return False
        self.meet(isb_m)
        self._clock, self._klobuchar = clock, klobuchar
        self.sample = sample
        self.take(channels, ephemerides)
        self.refresh(ephemerides)
        if int(self.active.sum()) < self.spec.min_satellites:
            self.reason = f"{int(self.active.sum())} of {self.spec.min_satellites} satellites can be steered"
            self.filter = None
            self._slots()
            return False
        self.state, self.reason = STEERED, ""
        if self._began_s is None:
            self._began_s = sample / self.fs_hz
        return True

    def _begin(self, sample, solution, bias_m):
        pos, vel = np.array(solution["pos_ecef_m"]), np.array(solution["vel_ecef_mps"])
        azimuth = None if self.spec.heading_deg is None else math.radians(self.spec.heading_deg)
        speed = None
        if self._table.size:
            row = max(bisect_right(self._sensor_sample, sample) - 1, 0)
            speed = float(self._table[row, 6])
        moving = float(np.linalg.norm(vel))
        has_odometer = self.sensors is not None and self.sensors.odometer is not None
        if speed is not None and has_odometer and abs(speed - moving) > 1.0 + 0.2 * moving:
            raise ValueError(
                f"the odometer says {speed:.1f} m/s where the fix says {moving:.1f}: is it in m/s, and of this recording?"
            )
        x = nominal_of(
            self.model, pos, vel, bias_m, float(solution["clock_drift_mps"]), 0.0, azimuth,
            speed if kernels.SCALE >= model_code(self.model) else None,
        )  # fmt: skip
        imu = self.sensors.imu_spec if self.sensors else None
        p = start_covariance(
            self.model, x, pos_m=self.spec.range_sigma_m, vel_mps=0.2, bias_m=2.0 * self.spec.range_sigma_m, drift_mps=0.3,
            heading_rad=min(0.01 + 0.25 / max(moving, 1.0), 0.3), imu=imu, fix_m2=np.array(solution["cov_ecef_m2"]),
        )  # fmt: skip
        barometer = self.sensors.barometer_spec if self.sensors else None
        self.filter = Filter(self.spec, self.model, x, p, SLOTS, self.log_length, barometer)
        self._estimate_isb = False
        self._moves.clear()

    def meet(self, isb_m: float | None) -> None:
        """Learn Galileo's clock minus GPS's from the position stage; until then only the first system is steered."""
        if self._estimate_isb or isb_m is None:
            return
        f = self.filter
        f.x[kernels.ISB] = isb_m if self._reference == "G" else -isb_m
        f.p[-1, :] = f.p[:, -1] = 0.0
        f.p[-1, -1] = ISB_SIGMA_M**2
        self._estimate_isb = True

    def release(self, reason: str) -> np.ndarray:
        """Let all channels go."""
        self.state, self.reason, self.filter = LOST, reason, None
        self._fix_since = -1
        self._n_released += 1
        self._released = f"{self.sample / self.fs_hz:.1f} s: {reason}"
        self._slots()
        return np.zeros(0, AIDING)

    # -- channels -----------------------------------------------------------------------------------------------

    def take(self, channels, ephemerides):
        """Put channels in phase lock under command; those with an ephemeris, above the mask, that agree in code."""
        newest = {(e["system"].decode(), int(e["prn"])): e for e in ephemerides}
        for index, signal, prn, cn0_dbhz in channels:
            system = "G" if signal == "L1CA" else "E"
            if (signal, prn) in self.name or cn0_dbhz < MIN_CN0_DBHZ or (system, prn) not in newest:
                continue
            if newest[system, prn]["health"] != 0 or (system != self._reference and not self._estimate_isb):
                continue
            free = np.flatnonzero(~self.active)
            if free.size == 0:
                return
            i = int(free[0])
            self.active[i], self.slot[i], self.name[i] = True, index, (signal, prn)
            self.second[i] = float(system != self._reference)
            self.period_s[i], self.which[i] = (1e-3, 0) if system == "G" else (4e-3, 1)
            self.filter.power[i], self.inflate[[i, SLOTS + i]], self.bias[i] = 0.0, 1.0, 0.0
            self._set_orbit(i, newest[system, prn])
            self.filter.rho[i] = 2.2e7 + self.filter.clock()[0]
            self._next_refresh = 0

    def _set_orbit(self, i, eph):
        self.orbit[i] = orbit_coefficients(np.array([eph], EPHEMERIS))[0]
        self.toe_toc_tgd[i] = eph["toe_s"], eph["toc_s"], eph["tgd_s"]
        self._taken[i] = eph.tobytes()

    def drop(self, i: int):
        """Leave channel slot i to its own loops."""
        self.active[i], self.name[i] = False, None

    def weaken(self, signal: str, prn: int, factor: float) -> bool:
        """Multiply the measurement variance of one satellite from the next epoch on (a monitor's flag); False: not steered."""
        if not factor > 0.0:
            raise ValueError(f"factor = {factor:g}: a variance is multiplied by something above zero")
        if (signal, prn) not in self.name:
            return False
        i = self.name.index((signal, prn))
        self.inflate[[i, SLOTS + i]] = min(factor, LEFT_OUT)
        return True

    def heed(self, remedy: Remedy | None, own_m2: dict[str, float]) -> None:
        """What the monitors ask of each satellite from the next epoch on, through ``weaken``; and biases taken off its range.

        ``own_m2``: the receiver's own range variances by name (G07), to which one that was asked for is in proportion; it
        acts on the range alone.
        """
        rows = (
            {} if remedy is None else {f"{r['system'].decode()}{int(r['prn']):02d}": r for r in remedy.rows}
        )
        for i in np.flatnonzero(self.active):
            signal, prn = self.name[i] or ("", 0)
            name = f"{'G' if signal == 'L1CA' else 'E'}{prn:02d}"
            row, factor = rows.get(name), 1.0
            self.bias[i] = 0.0 if row is None else row["bias_m"]
            if row is not None:
                factor = LEFT_OUT if row["exclude"] else max(1.0, row["weaken"])
            self.weaken(signal, prn, factor)
            if row is not None and row["variance_m2"] > 0 and name in own_m2:
                self.inflate[i] = min(factor * row["variance_m2"] / own_m2[name], LEFT_OUT)

    def measure(self, rows, channels):
        """Turn the NCOs' TRANSMIT ``rows`` of steered ``channels`` into measurements: NCO plus discriminator, in place.

        The code phase and the Doppler move by what the discriminators saw, smoothed in ``kernels.OBSERVED_HZ``; the carrier's
        phase is the NCO's own and says nothing, which its lock time of 0 tells. Others are left alone.
        """
        at = {int(self.slot[i]): i for i in np.flatnonzero(self.active)}
        for row, c in zip(rows, channels):
            if int(c) not in at:
                continue
            kept = self.filter.power[at[int(c)]]
            if kept[kernels.WEIGHT] == 0.0:
                continue  # taken over just now
            tow_s = row["tow_tx_frac_s"] - kept[kernels.RANGE_OFF_M] / C_MPS
            whole = math.floor(tow_s * 1e3)
            if row["tow_tx_ms"] >= 0:
                row["tow_tx_ms"] = (row["tow_tx_ms"] + whole) % WEEK_MS
            row["tow_tx_frac_s"] = tow_s - whole * 1e-3
            row["doppler_hz"] -= kept[kernels.RATE_OFF_MPS] / WAVELENGTH_M
            row["cn0_dbhz"] = min(row["cn0_dbhz"], 10.0 * math.log10(max(kept[kernels.CN0_HZ], 1.0)))
            row["lock_s"], row["cycle_slip"] = 0.0, True

    def refresh(self, ephemerides):
        """Newest ephemerides, atmosphere and elevation of all channels."""
        newest = {(e["system"].decode(), int(e["prn"])): e for e in ephemerides}
        rows = np.flatnonzero(self.active)
        for i in rows:
            name = self.name[i]
            assert name is not None
            signal, prn = name
            eph = newest.get(("G" if signal == "L1CA" else "E", prn))
            if eph is not None and eph.tobytes() != self._taken[i]:
                self._set_orbit(i, eph)
        pos, vel = self.filter.position()
        sats = np.zeros(rows.size, SATELLITE)
        tow, frac = self._receiver_tow(self.sample)
        sat_pos, sat_vel = np.zeros((SLOTS, 3)), np.zeros((SLOTS, 3))
        unused = np.zeros((SLOTS, 3)), np.zeros(SLOTS), np.zeros(SLOTS)
        kernels.satellites_at(
            self.orbit, self.toe_toc_tgd, self.active, tow, frac, self.filter.rho, sat_pos, sat_vel, *unused
        )
        sats["pos_ecef_m"], sats["vel_ecef_mps"] = sat_pos[rows], sat_vel[rows]
        pvt.look(sats, pos, vel, tow + frac, self._klobuchar[0], self._klobuchar[1])
        self.delay[rows] = sats["iono_m"] + sats["tropo_m"]
        self.delay_rate[rows] = sats["atmosphere_rate_mps"]
        for i, el in zip(rows, sats["elevation_rad"]):
            if el < self.min_elevation_rad:
                self.drop(int(i))
        self._next_refresh = self.sample + round(REFRESH_S * self.fs_hz)

    def _receiver_tow(self, sample):
        return _time_of_week(*self._clock.read(sample))

    # -- one epoch ----------------------------------------------------------------------------------------------

    def advance(self, sample: int, epochs, counts, channels_state, ephemerides) -> np.ndarray:
        """Predict to ``sample``, update from the epochs since the last call, command what follows.

        ``epochs``, ``counts``: of ``Tracker.process``, which has come to ``sample``; ``channels_state`` (C,) STATE_* of the tracker's channels;
        ``ephemerides``: called once a second for the newest EPHEMERIS rows. Returns AIDING (C,).
        """
        if kernels.any_unlocked(self.active, self.slot, np.ascontiguousarray(channels_state)):
            for i in np.flatnonzero(self.active & (channels_state[self.slot] != STATE_LOCKED)):
                self.drop(int(i))
        if sample >= self._next_refresh:
            self.refresh(ephemerides())
        commands = np.zeros(len(channels_state), AIDING)
        nis, rows, surprise = self._step(sample, epochs, counts, commands)
        self._watch_axes(sample)
        self._judge(sample, surprise, rows)
        self._report(sample, nis, rows)
        if self.state == LOST:
            return np.zeros(len(channels_state), AIDING)
        return commands

    def _step(self, sample, epochs, counts, commands):
        f = self.filter
        sensors = self._sensors(sample)
        dt_s = self.dt_s if sensors.shape[0] > 1 or self._table.size else (sample - self.sample) / self.fs_hz
        ms, frac_s = self._clock.read(sample)
        tow, tow_frac = _time_of_week(ms, frac_s)
        log, delay = f.slot(sample / self.fs_hz), self.delay + self.bias
        nis, rows, surprise = kernels.navigation_epoch(
            f.code, f.x, f.p, sensors, dt_s, 1.0 / self.spec.update_hz, f.epochs, self.spec.block, f.filter_s, f.rates, f.q, self.spec.limit_sigma, self.spec.fast_cn0_s,
            self.spec.slow_cn0_s, self.spec.code_floor_m, self.spec.rate_floor_mps, self.sample, sample, self.fs_hz, ms, frac_s, tow,
            tow_frac, self.orbit, self.toe_toc_tgd, self.active, self.slot, self.second, self.period_s,
            delay, self.delay_rate, self.inflate, self._tables, self.which, epochs, counts, f.power, f.cn0,
            f.rho, f.rate, f.accel, f.los, f.f, log.phi, log.qd, log.h, log.r, log.var, f.own, log.used, log.k, log.s, log.p, f.dx,
            commands,
        )  # fmt: skip
        f.nis, f.n_rows = nis, rows
        self.sample = sample
        return nis, rows, surprise

    def _sensors(self, sample):
        """Sensor rows of the epoch that ends at ``sample``; vector mode has one empty row."""
        if not self._table.size:
            return np.zeros((1, kernels.N_SENSOR))
        last = bisect_right(self._sensor_sample, sample + 1)
        first = last - self.per_epoch
        if first < 0 or sample - self._sensor_sample[last - 1] > 1.5 * self.dt_s * self.fs_hz:
            raise ValueError(
                f"sensor data do not cover sample {sample}; record them over the whole time of the samples"
            )
        return self._table[first:last]

    def _judge(self, sample, surprise, rows):
        """State from what is seen and how well the next interval is known."""
        f = self.filter
        if rows:
            self._ratio += (surprise - self._ratio) / self.spec.update_hz
        sigma = np.zeros(2)
        usable, missing, heard = kernels.outlook(
            f.code, f.x, f.p, f.los, self.active, f.power, f.cn0, USABLE_CN0_HZ, sigma
        )
        self.sigma, self.usable = sigma, usable
        self._missing_s = self._missing_s + 1.0 / self.spec.update_hz if missing >= heard > 0 else 0.0
        self.state = STEERED if usable >= 1 else COASTING
        why = ""
        if not (math.isfinite(sigma[0]) and math.isfinite(sigma[1])):
            why = "the filter's state is not finite"
        elif sigma[0] > self.spec.release_code_m:
            why = (
                f"a range is predicted no better than {sigma[0]:.0f} m: too coarse for the code discriminator"
            )
        elif sigma[1] > self.spec.release_rate_mps:
            why = f"a rate is predicted no better than {sigma[1]:.1f} m/s: too coarse for the frequency discriminator"
        elif self.spec.mode == "vector" and self._missing_s > MISSING_S:
            why = f"{missing} satellites are not where they are predicted, {heard} are"
        elif usable >= self.spec.min_satellites and self._ratio > INCONSISTENT_RATIO:
            why = f"innovations are {self._ratio:.1f} times what the filter expects"
        if why:
            self._check_axes()
            self.release(why)

    def _watch_axes(self, sample):
        """Without an odometer a car's speed is that which satellites give; kept while enough of them are heard."""
        if self.sensors is None or self.sensors.odometer is not None or not self.due(REPORT_S):
            return
        if self.sensors.imu_spec.attitude != "land":
            return
        if self.usable < self.spec.min_satellites:
            self._moves.clear()
            return
        last = bisect_right(self._sensor_sample, sample + 1)
        mean = self._table[max(last - round(REPORT_S / self.dt_s), 0) : last].mean(axis=0)
        speed = float(np.linalg.norm(self.filter.position()[1]))
        self._moves.append((mean[3], mean[4], mean[2], speed))
        if self.due(AXES_S):
            self._check_axes()

    def _check_axes(self):
        if self._moves:
            m = np.array(self._moves)
            self.axes = check_axes(m[:, :2], m[:, 2], m[:, 3], REPORT_S, "the satellites' Doppler")

    def due(self, every_s: float) -> bool:
        """Whether this epoch is one of those ``every_s`` apart."""
        return self.filter.epochs % max(1, round(every_s * self.spec.update_hz)) == 0

    def summary(self) -> dict[str, Any]:
        """How it went: from when on, for how long with and without satellites, how often it let go and why the last time.

        ``axes``: what the odometer, or the satellites' Doppler, says of the IMU's, see ``sensor_files.check_axes``.
        """
        return {
            "mode": self.spec.mode, "model": self.model.kind, "first_s": self._began_s,
            "steered_s": self._seconds[STEERED], "coasting_s": self._seconds[COASTING], "released": self._n_released,
            "reason": self._released or self.reason, "axes": self.axes,
        }  # fmt: skip

    def _report(self, sample, nis, rows):
        r = self.record[0]
        if self.state != LOST:
            self._seconds[self.state] += 1.0 / self.spec.update_hz
        if self.filter is not None and self.due(REPORT_S):
            f, cn0 = self.filter, np.sort(self.filter.cn0[self.active])
            r["sigma_2d_m"] = kernels.horizontal_sigma(f.code, f.x, f.p)
            r["cn0_median_dbhz"] = 10.0 * math.log10(max(float(cn0[cn0.size // 2]), 1.0)) if cn0.size else 0.0
        self.record[0] = (
            sample, sample / self.fs_hz, self.state, np.count_nonzero(self.active), self.usable, nis, rows,
            r["sigma_2d_m"], self.sigma[0], self.sigma[1], r["cn0_median_dbhz"],
        )  # fmt: skip

    def solution(self, week: int) -> np.ndarray:
        """SOLUTION row of the last epoch; valid while the filter steers with satellites or coasts within 50 m."""
        f, row = self.filter, np.zeros(1, SOLUTION)
        pos, vel = f.position()
        bias, drift = f.clock()
        tow, frac = self._receiver_tow(self.sample)
        r = row[0]
        r["sample_index"], r["t_s"], r["week"] = self.sample, self.sample / self.fs_hz, week
        r["tow_s"] = (tow + (frac - bias / C_MPS)) % SECONDS_PER_WEEK
        r["pos_ecef_m"], r["vel_ecef_mps"] = pos, vel
        r["clock_bias_m"], r["clock_drift_mps"], r["isb_m"] = (
            bias,
            drift,
            f.x[kernels.ISB] if self._estimate_isb else np.nan,
        )
        r["cov_ecef_m2"] = f.covariance()
        r["gdop"] = r["pdop"] = r["hdop"] = r["vdop"] = np.nan
        r["n_used"], r["chi2"], r["dof"] = self.usable, f.nis, f.n_rows
        r["valid"] = self.state == STEERED or (self.state == COASTING and self.record[0]["sigma_2d_m"] < 50.0)
        return row

    def names(self) -> list[str]:
        """Satellites under command, G07 for instance."""
        return [f"{'G' if n[0] == 'L1CA' else 'E'}{n[1]:02d}" for n in self.name if n is not None]


__all__ = ["SLOTS", "Sensors", "Steering"]
