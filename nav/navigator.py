"""The position stage of the receiver: from channel states and decoded messages to one SOLUTION per epoch.

``Navigator.update`` takes plain records (``TRANSMIT`` rows, ``EPHEMERIS`` rows, ``IONO_UTC`` rows) and
nothing else: no truth and no start time enters. When there is no position, ``reason`` says in one sentence
why.
"""

from collections.abc import Set
from copy import copy
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from nav import kernels, pvt
from nav.measurements import Hatch, ReceiverClock, observables
from nav.navlog import EXCLUDED_M2, NavigatorLog, Remedy
from nav.pvt import NoFix
from nav.records import OBSERVATION, SATELLITE, SOLUTION, VIEW
from signals.constants import C_MPS, SECONDS_PER_WEEK

STEER_ABOVE_M = 1e-4 * C_MPS
"""The receiver time is stepped when its clock bias exceeds 0.1 ms (and once, at the first fix)."""
FIRST_SIGMA_M = 100.0
"""Range sigma of the very first pass, where neither elevation nor atmosphere is known."""
KLOBUCHAR_DEFAULT = (
    np.array([0.1118e-7, -0.7451e-8, -0.5961e-7, 0.1192e-6]),
    np.array([0.1167e6, -0.2294e6, -0.1311e6, 0.1049e7]),
)
"""GPS broadcast of 2004-01-01, RTKLIB's stand-in too, until parameters are decoded: GPS sends them once in 12.5
minutes, Galileo never (its own are for NeQuick). Half of a day-time delay is better than none of it."""
RESTART_AFTER = 3
"""Epochs in a row with fewer than half of the ranges accepted, after which the filter starts afresh."""


class FilterSpec(BaseModel):
    """Section ``[receiver.navigation.filter]``: the position-velocity-clock Kalman filter (kind = "ekf")."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    accel_psd_m2_s3: Annotated[float, Field(gt=0)] = 1.0
    """White acceleration per ECEF axis: 1 lets a car turn; 0.01 suits a static antenna, 100 an aircraft."""
    clock_f_m2_s: Annotated[float, Field(ge=0)] = 0.009
    """Spectral density of the clock's phase noise."""
    clock_g_m2_s3: Annotated[float, Field(ge=0)] = 0.035
    """Spectral densities of clock phase and frequency noise; the defaults are a TCXO's."""
    isb_psd_m2_s: Annotated[float, Field(ge=0)] = 1e-6
    """Random walk of the inter-system bias."""
    gate_sigma: Annotated[float, Field(ge=3)] = 6.0
    """A range or rate whose innovation exceeds this many sigmas is left out."""
    coast_s: Annotated[float, Field(ge=0)] = 10.0
    """Without any accepted range for this long, solutions are marked not valid."""


class NavigationSpec(BaseModel):
    """Section ``[receiver.navigation]``: how positions are computed.

    ``smoothing_s`` is the Hatch window; unset it is 100 s for least squares and 0 for the filter, which
    smooths by its own dynamics and wants white ranges.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["least_squares", "ekf"] = "least_squares"
    rate_hz: Annotated[float, Field(gt=0, le=50)] = 1.0
    """Positions per second."""
    systems: Annotated[tuple[Literal["G", "E"], ...], Field(min_length=1, max_length=2)] = ("G", "E")
    """Constellations that enter the position."""
    elevation_mask_deg: Annotated[float, Field(ge=0, lt=90)] = 5.0
    """Satellites below this elevation are not used."""
    cn0_mask_dbhz: Annotated[float, Field(ge=0, le=60)] = 20.0
    """Satellites weaker than this are not used."""
    gdop_max: Annotated[float, Field(gt=1)] = 30.0
    """No position is given when the satellites stand closer together than this."""
    iono: Literal["klobuchar", "none"] = "klobuchar"
    """Ionosphere correction."""
    tropo: Literal["saastamoinen", "none"] = "saastamoinen"
    """Troposphere correction."""
    smoothing_s: Annotated[float | None, Field(ge=0, le=3600)] = None
    """Window of the carrier smoothing (Hatch); unset: 100 s for least squares, none for the filter."""
    isb: Literal["estimate", "ggto"] = "estimate"
    """How Galileo and GPS time are brought together: by an unknown, or by the broadcast offset."""
    use_unhealthy: bool = False
    """Use satellites whose message says that they are unhealthy."""
    max_ephemeris_age_s: Annotated[float, Field(gt=0)] = 4 * 3600.0
    """Ephemerides older than this are not used."""
    raim: bool = True
    """Least squares leaves out satellites whose residuals do not fit."""
    raim_p_fa: Annotated[float, Field(gt=0, lt=1)] = 1e-5
    """False-alarm probability of that test per epoch."""
    sigma_code_m: Annotated[float, Field(gt=0)] = 1.0
    """Code noise at 45 dB-Hz before smoothing."""
    sigma_atmosphere_m: Annotated[float, Field(gt=0)] = 0.3
    """What the corrections leave at the zenith (orbits, clocks, atmosphere)."""
    sigma_doppler_mps: Annotated[float, Field(gt=0)] = 0.05
    """Range-rate noise at 45 dB-Hz."""
    filter: FilterSpec = FilterSpec()

    @model_validator(mode="after")
    def _consistent(self):
        if self.kind == "least_squares" and "filter" in self.model_fields_set:
            raise ValueError('navigation.filter belongs to kind = "ekf"; this kind is "least_squares".')
        if self.kind == "ekf" and self.smoothing_s:
            raise ValueError(
                'navigation.smoothing_s belongs to kind = "least_squares": "ekf" smooths by itself.'
            )
        if len(set(self.systems)) != len(self.systems):
            raise ValueError("navigation.systems names one system twice; write each of G, E once.")
        return self

    @property
    def smoothing_window_s(self):
        """The Hatch window in force, s."""
        if self.smoothing_s is not None:
            return self.smoothing_s
        return 100.0 if self.kind == "least_squares" else 0.0

    def start(self, fs_hz):
        """A Navigator for samples at fs_hz."""
        return Navigator(self, fs_hz)


class Snapshot(NamedTuple):
    """Ranges of one epoch as the integrity monitors see them, one row per satellite above the mask.

    ``residual_m``: of least squares, or the filter's innovations; ``variance_m2`` as used (an excluded satellite has
    ``use`` False), ``own_m2`` the receiver's own; ``second`` 1 where the inter-system bias is added.
    """

    names: list[str]
    los: np.ndarray
    second: np.ndarray
    residual_m: np.ndarray
    variance_m2: np.ndarray
    own_m2: np.ndarray
    use: np.ndarray
    pos_ecef_m: np.ndarray


def _name(system, prn):
    return f"{system.decode()}{int(prn):02d}"


class Navigator:
    """Run of a NavigationSpec.

    After ``update``: ``reason`` (empty on success), ``late`` (the ranges said that samples are missing), ``observations`` and ``satellites`` (aligned rows of the
    epoch), ``used`` (names), ``excluded`` (names RAIM left out), ``residual_m`` (n,) and ``notes`` (what
    was asked for and could not be applied yet).
    """

    def __init__(self, spec: NavigationSpec, fs_hz: float):
        self.spec = spec
        self.fs_hz = float(fs_hz)
        self.clock = ReceiverClock(fs_hz)
        self.hatch = Hatch(spec.smoothing_window_s, fs_hz)
        self.reason = ""
        self.notes: list[str] = []
        self.observations = np.zeros(0, OBSERVATION)
        self.satellites = np.zeros(0, SATELLITE)
        self.used: list[str] = []
        self.excluded: list[str] = []
        self.residual_m = np.zeros(0)
        self.innovations = np.zeros((0, 3))
        self.snapshot: Snapshot | None = None
        self.log: NavigatorLog | None = None
        """Set one to have the filter's epochs recorded; recording changes nothing."""
        self.late = False
        self._doubted: Set[tuple[bytes, int]] = frozenset()
        self._remedy: Remedy | None = None
        self._extra: np.ndarray | None = None
        self._smoothing = np.ones(0)
        self._steered_m = 0.0
        self._state: np.ndarray | None = None  # (5,) last position, bias, ISB
        self._vel = np.zeros(3)
        self._isb_known = False
        self._x = np.zeros(kernels.N_EKF)
        self._p = np.zeros((kernels.N_EKF, kernels.N_EKF))
        self._filter_sample = -1
        self._reference = b"G"
        self._last_range_sample = -1
        self._rejected_epochs = 0

    def update(
        self, transmit, ephemeris, iono_utc_gps=None, iono_utc_galileo=None, remedy: Remedy | None = None,
        doubted=frozenset(),
    ):  # fmt: skip
        """One epoch.

        Parameters
        ----------
        transmit : TRANSMIT rows of all locked channels at one sample
        ephemeris : EPHEMERIS rows, the latest of each satellite
        iono_utc_gps, iono_utc_galileo : IONO_UTC row or None
            Klobuchar parameters (GPS) and the GGTO (Galileo), as far as decoded.
        remedy : Remedy or None
            What the integrity monitors ask for; None changes nothing.
        doubted : set of (system, prn), b"G" or b"E"
            Satellites whose transmit times no message has confirmed since all channels were disturbed.

        Returns
        -------
        SOLUTION row, or None with ``reason`` set.
        """
        self.reason, self.notes, self.used, self.excluded = "", [], [], []
        self.snapshot, self.late = None, False
        self._doubted = doubted
        self._take(remedy)
        try:
            obs, eph = self._select(transmit, np.atleast_1d(ephemeris))
            sats = pvt.satellites(obs, eph)
            self.observations, self.satellites = obs, sats
            fix = self._filter if self._filter_sample >= 0 else self._least_squares
            return fix(obs, sats, eph, iono_utc_gps, iono_utc_galileo)
        except NoFix as why:
            self.reason, self.late = str(why), isinstance(why, pvt.Late)
            return self._coast(transmit, ephemeris)

    def _take(self, remedy):
        """Note the remedy of this epoch; a state handed back replaces the filter's now."""
        self._remedy, self._extra = remedy, None if remedy is None else remedy.extra
        if remedy is None or (remedy.dx is None and remedy.p is None) or self._filter_sample < 0:
            return
        if remedy.dx is not None:
            self._x += remedy.dx
        if remedy.p is not None:
            self._p[:] = remedy.p

    def klobuchar(self, iono_utc_gps):
        """Ionosphere parameters in force: (alpha, beta), or None where the correction is switched off."""
        return self._klobuchar(iono_utc_gps)

    def handover(self):
        """What a steering filter starts from: (copy of the receiver clock, clock bias in it (m), ISB (m) or None).

        The inter-system bias is Galileo's clock minus GPS's.
        """
        if self._state is None:
            raise NoFix("there is no fix to start from.")
        known = self._isb_known or (self._filter_sample >= 0 and self._p[8, 8] < 100.0)
        isb_m = float(self._state[4]) if self._reference == b"G" else -float(self._state[4])
        return copy(self.clock), float(self._state[3]), isb_m if known else None

    def view(self):
        """VIEW rows: the satellites of the last epoch that had observations, in their order."""
        rows = np.zeros(self.satellites.size, VIEW)
        for name in SATELLITE.names or ():
            rows[name] = self.satellites[name]
        rows["sample_index"] = self.observations["sample_index"]
        rows["used"] = [_name(s["system"], s["prn"]) in self.used for s in self.satellites]
        return rows

    # -- which satellites --

    def _select(self, transmit, ephemeris):
        """Observations that can be used, one per satellite, with their ephemerides; NoFix says what is
        missing."""
        wanted = [s.encode() for s in self.spec.systems]
        rows = transmit[np.isin(transmit["system"], wanted)]
        if rows.size == 0:
            raise NoFix("no satellite is tracked.")
        timed = rows[rows["tow_tx_ms"] >= 0]
        if timed.size and not self.clock.is_set:
            self.clock.set_from_transmit(timed)
        obs = observables(timed, self.clock)
        smoothing = self.hatch.smooth(obs)
        newest = {(e["system"], int(e["prn"])): i for i, e in enumerate(ephemeris)}
        keep: list[int] = []
        index: list[int] = []
        dropped: list[str] = []
        for i in np.argsort(-obs["cn0_dbhz"], kind="stable"):
            key = (obs["system"][i], int(obs["prn"][i]))
            why = self._unfit(obs[i], ephemeris[newest[key]] if key in newest else None)
            if why:
                dropped.append(f"{_name(*key)} {why}")
            elif key not in [(obs["system"][j], int(obs["prn"][j])) for j in keep]:
                keep.append(int(i))
                index.append(newest[key])
        if (len(keep) < 4 and self._filter_sample < 0) or not keep:
            waiting = rows[rows["tow_tx_ms"] < 0]
            undecoded = [f"{_name(r['system'], r['prn'])} has no transmit time yet" for r in waiting]
            raise NoFix(
                f"{len(keep)} of the 4 satellites needed are ready; tracked: {rows.size}"
                + (f" ({', '.join(undecoded + dropped)})." if undecoded or dropped else ".")
            )
        order = np.argsort(keep)
        self._smoothing = smoothing[np.array(keep)[order]]
        return obs[np.array(keep)[order]], ephemeris[np.array(index)[order]]

    def _unfit(self, row, eph):
        """Why an observation cannot be used, or an empty string."""
        if eph is None:
            return "has no ephemeris yet"
        if eph["health"] != 0 and not self.spec.use_unhealthy:
            return "is marked unhealthy"
        half_week_s = SECONDS_PER_WEEK / 2
        age_s = abs((row["tow_tx_s"] - eph["toe_s"] + half_week_s) % SECONDS_PER_WEEK - half_week_s)
        if age_s > self.spec.max_ephemeris_age_s:
            return f"has an ephemeris {age_s / 3600:.1f} h old"
        if row["cn0_dbhz"] < self.spec.cn0_mask_dbhz:
            return f"is weaker than {self.spec.cn0_mask_dbhz:g} dB-Hz"
        return ""

    # -- what the epoch's ranges mean --

    def _klobuchar(self, iono_utc_gps):
        if self.spec.iono == "none":
            return None
        row = None if iono_utc_gps is None else np.atleast_1d(iono_utc_gps)[0]
        if row is None or not row["beta"].any():  # a row may hold other parameters than these
            self.notes.append("ionosphere corrected with default parameters: GPS's are not decoded yet")
            return KLOBUCHAR_DEFAULT
        return row["alpha"], row["beta"]

    def _second(self, obs, eph, iono_utc_galileo):
        """(second (n,), metres to add per row, estimate the ISB?): whose clock the satellites refer to.

        With the GGTO applied all refer to GPS time. Otherwise the satellites of the second system share
        the ISB as unknown; with too few of them for that, the last estimate is held.
        """
        galileo = obs["system"] == b"E"
        none = np.zeros(obs.size)
        if self.spec.isb == "ggto":
            row = None if iono_utc_galileo is None else np.atleast_1d(iono_utc_galileo)[0]
            if row is not None and any(row[f] for f in ("a0g_s", "a1g_s_s", "t0g_s", "week_0g")):
                ggto_m = pvt.ggto_m(row, float(obs["tow_tx_s"][0]), self._week(eph))
                return none, galileo * ggto_m, False
            self.notes.append("GGTO not decoded yet: inter-system bias estimated")
        if self._filter_sample >= 0:
            second = (obs["system"] != self._reference).astype(float)
            return second, none, bool(second.any())
        if galileo.all() or not galileo.any():
            return none, none, False
        if self._isb_known and self._state is not None and obs.size < 5:
            return none, galileo * -self._state[4], False
        return galileo.astype(float), none, True

    def _week(self, eph):
        """Continuous week of the receiver time, from the ephemerides' week and toe."""
        tow_s = self.clock.read(self.observations["sample_index"][0])[0] * 1e-3 % SECONDS_PER_WEEK
        return int(eph["week"][0]) + round((float(eph["toe_s"][0]) - tow_s) / SECONDS_PER_WEEK)

    def _corrected(self, obs, sats, offset, field):
        corrected = obs[field] + sats["clock_m"] - sats["iono_m"] - sats["tropo_m"] + offset
        if self._remedy is None:
            return corrected
        return corrected - self._asked(sats, "bias_m", 0.0)

    def _asked(self, sats, field, otherwise):
        """A field of the remedy for each satellite; ``otherwise`` where it says nothing."""
        assert self._remedy is not None
        at = self._remedy.find(sats["system"], sats["prn"])
        values = np.append(self._remedy.rows[field], otherwise)  # index -1 is the last
        return values[at]

    def _excluded(self, sats):
        """(n,) bool: satellites that the remedy leaves out."""
        if self._remedy is None:
            return np.zeros(sats.size, bool)
        return self._asked(sats, "exclude", False).astype(bool)

    def _variance(self, obs, sats):
        own = self._own_variance(obs, sats)
        if self._remedy is None:
            return own
        asked = self._asked(sats, "variance_m2", np.nan)
        return np.where(np.isnan(asked), own, asked) * np.maximum(self._asked(sats, "weaken", 1.0), 1.0)

    def _own_variance(self, obs, sats):
        return pvt.range_variance(
            obs["cn0_dbhz"],
            sats["elevation_rad"],
            self.spec.sigma_code_m,
            self.spec.sigma_atmosphere_m,
            self._smoothing,
        )

    def _above_mask(self, sats):
        return (sats["elevation_rad"] >= np.radians(self.spec.elevation_mask_deg)).astype(np.uint8)

    @property
    def _p_fa(self):
        return self.spec.raim_p_fa if self.spec.raim else 0.0

    def _check_time(self, obs, sats, second, offset, use, estimate, state):
        """Raise NoFix where samples are missing; unsmoothed ranges, for smoothing remembers those before a hole."""
        at = use == 1
        doubted = any((s, int(p)) in self._doubted for s, p in zip(sats["system"][at], sats["prn"][at]))
        expected, unused, los = np.empty(obs.size), np.empty(obs.size), np.zeros((obs.size, 3))
        pos, vel = (np.ascontiguousarray(sats[f]) for f in ("pos_ecef_m", "vel_ecef_mps"))
        kernels.predict_ranges(pos, vel, state[:3], self._vel, expected, unused, los)
        variance = self._variance(obs, sats) / self._smoothing
        residual = self._corrected(obs, sats, offset, "pseudorange_m") - expected
        m = pvt.count_unknowns(second, use, estimate)
        pvt.refuse_late(sats, los, variance, second, use, residual, m, self._p_fa, doubted)

    # -- least squares --

    def _least_squares(self, obs, sats, eph, iono_utc_gps, iono_utc_galileo):
        second, offset, estimate = self._second(obs, eph, iono_utc_galileo)
        tow_s = obs["tow_tx_s"][0]
        klobuchar = self._klobuchar(iono_utc_gps)
        everyone = np.ones(obs.size, np.uint8)
        p_fa = self._p_fa
        if self._state is None:
            crude = self._corrected(obs, sats, offset, "pseudorange_m")
            variance = np.full(obs.size, FIRST_SIGMA_M**2)
            start = pvt.raim(sats, crude, variance, second, everyone, estimate, p_fa)[0].state
        else:
            start = self._state
        for turn in range(3):  # elevations and delays come from the position of the pass before
            pvt.look(sats, start[:3], self._vel, tow_s, klobuchar, self.spec.tropo != "none")
            use = self._above_mask(sats)
            self._say_masked(use)
            use[self._excluded(sats)] = 0
            if turn == 0:
                self._check_time(obs, sats, second, offset, use, estimate, start)
            corrected = self._corrected(obs, sats, offset, "pseudorange_smoothed_m")
            variance = self._variance(obs, sats)
            fix, out = pvt.raim(sats, corrected, variance, second, use, estimate, p_fa, start)
            moved_m = float(np.linalg.norm(fix.state[:3] - start[:3]))
            start = fix.state
            if moved_m < 1.0:
                break
        self.excluded = [_name(sats["system"][i], sats["prn"][i]) for i in out]
        gdop, pdop, hdop, vdop = pvt.dilution(fix.los, second, fix.use, fix.n_unknowns, fix.state[:3])
        if gdop > self.spec.gdop_max:
            raise NoFix(
                f"GDOP {gdop:.0f} exceeds {self.spec.gdop_max:g}: "
                f"the {int(fix.use.sum())} satellites stand too close together."
            )
        rate_var = pvt.rate_variance(obs["cn0_dbhz"], self.spec.sigma_doppler_mps, 0.02)
        for _ in range(2):  # the rate of the troposphere wants the velocity
            velocity = pvt.solve_velocity(sats, pvt.range_rate(obs, sats), rate_var, fix.use, fix.state[:3])
            if np.linalg.norm(velocity.vel_ecef_mps - self._vel) < 0.3:
                break
            self._vel = velocity.vel_ecef_mps
            pvt.look(sats, fix.state[:3], self._vel, tow_s, klobuchar, self.spec.tropo != "none")
        self.residual_m = fix.residual_m
        self._snap(
            obs,
            sats,
            self._above_mask(sats) == 1,
            fix.los,
            second,
            fix.residual_m,
            variance,
            fix.use == 1,
            fix.state[:3],
        )
        self.used = [_name(s, p) for s, p, u in zip(sats["system"], sats["prn"], fix.use) if u]
        state = self._settle(fix, estimate)
        if self.spec.kind == "ekf":
            self._start_filter(obs, state, velocity, fix)
        row = self._row(obs, eph, state, velocity.vel_ecef_mps, velocity.drift_mps, fix.cov[:3, :3])
        row["isb_m"] = state[4] if estimate else np.nan
        row["gdop"], row["pdop"], row["hdop"], row["vdop"] = gdop, pdop, hdop, vdop
        row["n_used"], row["chi2"], row["dof"] = int(fix.use.sum()), fix.chi2, fix.dof
        return row

    def _snap(self, obs, sats, part, los, second, residual, variance, use, pos_ecef_m):
        names = [_name(s, n) for s, n in zip(sats["system"][part], sats["prn"][part])]
        own = self._own_variance(obs, sats)
        self.snapshot = Snapshot(
            names,
            los[part],
            second[part],
            residual[part],
            variance[part],
            own[part],
            use[part],
            pos_ecef_m.copy(),
        )

    def _say_masked(self, use):
        if use.sum() < 4:
            raise NoFix(
                f"{int(use.sum())} of {use.size} satellites stand above the "
                f"{self.spec.elevation_mask_deg:g} deg mask, 4 are needed."
            )

    def _settle(self, fix, estimate):
        """Remember the fix and steer the receiver time; returns the state in the steered time."""
        state = fix.state.copy()
        first = self._state is None
        if estimate and fix.n_unknowns == 5:
            self._isb_known = True
        elif self._isb_known and self._state is not None:
            state[4] = self._state[4]
        if first or abs(state[3]) > STEER_ABOVE_M:
            self._steer(state[3], first)
            state[3] = 0.0
        self._state = state
        return state

    def _steer(self, bias_m, first):
        """Take the bias out of the receiver time; the reported bias goes on, from zero at the first fix."""
        self.clock.steer(bias_m / C_MPS)
        self.hatch.shift(-bias_m)
        self._steered_m += 0.0 if first else bias_m

    def _row(self, obs, eph, state, vel, drift, cov):
        row = np.zeros((), SOLUTION)
        sample = int(obs["sample_index"][0])
        ms, frac_s = self.clock.read(sample)
        row["sample_index"], row["t_s"] = sample, sample / self.fs_hz
        row["tow_s"] = (ms * 1e-3 + (frac_s - state[3] / C_MPS)) % SECONDS_PER_WEEK
        row["week"] = int(eph["week"][0]) + round(
            (float(eph["toe_s"][0]) - float(row["tow_s"])) / SECONDS_PER_WEEK
        )
        row["pos_ecef_m"], row["vel_ecef_mps"] = state[:3], vel
        row["clock_bias_m"], row["clock_drift_mps"] = state[3] + self._steered_m, drift
        row["cov_ecef_m2"] = cov
        row["valid"] = True
        return row

    # -- Kalman filter --

    def _start_filter(self, obs, state, velocity, fix):
        self._x[:3], self._x[3:6] = state[:3], velocity.vel_ecef_mps
        self._x[6], self._x[7], self._x[8] = state[3], velocity.drift_mps, state[4]
        self._p[:] = 0.0
        m = fix.n_unknowns
        at = np.array([0, 1, 2, 6, 8][:m])
        self._p[np.ix_(at, at)] = fix.cov[:m, :m]
        rates = np.array([3, 4, 5, 7])
        self._p[np.ix_(rates, rates)] = velocity.cov
        if m == 4:
            self._p[8, 8] = 1e6  # no ISB seen yet: 1 km (3 us)
        systems = set(obs["system"].tolist())
        self._reference = b"G" if b"G" in systems else b"E"
        self._filter_sample = self._last_range_sample = int(obs["sample_index"][0])
        self._rejected_epochs = 0
        if self.log is not None:
            self.log.restart()

    def _predict(self, sample):
        f = self.spec.filter
        dt_s = (sample - self._filter_sample) / self.fs_hz
        if dt_s <= 0.0:
            raise ValueError(
                f"navigation epochs must move forward: sample {sample} after {self._filter_sample}."
            )
        kernels.pvt_predict(
            self._x, self._p, dt_s, f.accel_psd_m2_s3, f.clock_f_m2_s, f.clock_g_m2_s3, f.isb_psd_m2_s
        )
        self._filter_sample = sample
        if self.log is not None:
            self.log.predicted(dt_s, self._p, f)

    def _filter(self, obs, sats, eph, iono_utc_gps, iono_utc_galileo):
        sample = int(obs["sample_index"][0])
        self._predict(sample)
        second, offset, estimate = self._second(obs, eph, iono_utc_galileo)
        klobuchar = self._klobuchar(iono_utc_gps)
        tropo = self.spec.tropo != "none"
        pvt.look(sats, self._x[:3], self._x[3:6], obs["tow_tx_s"][0], klobuchar, tropo)
        use = self._above_mask(sats) == 1
        present = np.where(self._excluded(sats), 0, use).astype(np.uint8)
        self._check_time(obs, sats, second, offset, present, estimate, self._x)
        n = int(use.sum())
        ranges = self._corrected(obs, sats, offset, "pseudorange_m")[use]
        range_var = self._variance(obs, sats)[use]
        out = self._excluded(sats)[use]
        range_var[out] = EXCLUDED_M2
        rates = pvt.range_rate(obs, sats)[use]
        own_rate_var = pvt.rate_variance(obs["cn0_dbhz"], self.spec.sigma_doppler_mps, 0.02)[use]
        rate_var = np.where(out, EXCLUDED_M2, own_rate_var)
        innovation, variance, taken = np.zeros(2 * n), np.zeros(2 * n), np.zeros(2 * n, np.uint8)
        before = self._x.copy()
        kernels.pvt_update(
            self._x, self._p, np.ascontiguousarray(sats["pos_ecef_m"][use]),
            np.ascontiguousarray(sats["vel_ecef_mps"][use]), second[use], ranges, range_var, rates, rate_var,
            self.spec.filter.gate_sigma**2, innovation, variance, taken,
        )  # fmt: skip
        taken[np.tile(out, 2)] = 0
        self.innovations = np.column_stack([innovation, variance, taken])
        los, unused = np.zeros((obs.size, 3)), np.empty(obs.size)
        kernels.predict_ranges(
            np.ascontiguousarray(sats["pos_ecef_m"]), np.ascontiguousarray(sats["vel_ecef_mps"]),
            before[:3], before[3:6], unused, unused, los,
        )  # fmt: skip
        part = np.zeros(obs.size, bool)
        part[np.flatnonzero(use)[taken[:n] == 1]] = True
        full = np.zeros((2, obs.size))
        full[0, use], full[1, use] = innovation[:n], range_var
        self._snap(obs, sats, use, los, second, full[0], full[1], part, before[:3])
        if self.log is not None:
            own = np.concatenate([self._own_variance(obs, sats)[use], own_rate_var])
            both = np.concatenate([range_var, rate_var])
            dx = self._x - before
            assert self.snapshot is not None
            self.log.updated(
                sample / self.fs_hz,
                self.snapshot.names,
                los[use],
                second[use],
                innovation,
                both,
                own,
                taken,
                dx,
            )
        self._watch(sample, n, int(taken[:n].sum()))
        names = [_name(s, p) for s, p in zip(sats["system"][use], sats["prn"][use])]
        self.used = [name for name, t in zip(names, taken[:n]) if t]
        self.excluded = [name for name, t in zip(names, taken[:n]) if not t]
        ranges_only = taken[:n], innovation[:n], variance[:n]
        return self._filter_row(obs, sats, eph, use, second, *ranges_only, estimate)

    def _watch(self, sample, n, n_taken):
        """Restart from least squares when the filter keeps refusing what it is given."""
        if n_taken:
            self._last_range_sample = sample
        self._rejected_epochs = self._rejected_epochs + 1 if 2 * n_taken < n else 0
        if self._rejected_epochs >= RESTART_AFTER:
            self._filter_sample, self._state = -1, None
            raise NoFix(f"the filter refused most ranges for {RESTART_AFTER} epochs and starts afresh.")

    def _filter_row(self, obs, sats, eph, use, second, taken, innovation, variance, estimate):
        if abs(self._x[6]) > STEER_ABOVE_M:
            self._steer(self._x[6], False)
            self._x[6] = 0.0
        self._state = np.array([*self._x[:3], self._x[6], self._x[8]])
        row = self._row(obs, eph, self._state, self._x[3:6], self._x[7], self._claim())
        isb_m = self._x[8] if self._reference == b"G" else -self._x[8]
        row["isb_m"] = isb_m if estimate and second[use].any() else np.nan
        part = np.zeros(obs.size, np.uint8)
        part[np.flatnonzero(use)[taken == 1]] = 1
        los = sats["pos_ecef_m"] - self._x[:3]
        los /= np.linalg.norm(los, axis=1, keepdims=True)
        m = pvt.count_unknowns(second, part, estimate)
        row["gdop"], row["pdop"], row["hdop"], row["vdop"] = pvt.dilution(los, second, part, m, self._x[:3])
        row["n_used"], row["dof"] = int(taken.sum()), int(taken.sum())
        row["chi2"] = float(np.sum((innovation**2 / variance)[taken == 1]))
        row["valid"] = self._fresh()
        if not row["valid"]:
            self.reason = "the filter coasts: no range was accepted for longer than filter.coast_s."
        return row

    def _claim(self):
        """Covariance of the position, with what the monitors' corrections may be wrong by."""
        return (self._p if self._extra is None else self._p + self._extra)[:3, :3]

    def _fresh(self):
        return self._filter_sample - self._last_range_sample <= self.spec.filter.coast_s * self.fs_hz

    def _coast(self, transmit, ephemeris):
        """Without usable satellites a started filter predicts; least squares gives nothing."""
        if self._filter_sample < 0 or transmit.size == 0 or np.atleast_1d(ephemeris).size == 0:
            return None
        sample = int(transmit["sample_index"][0])
        if sample > self._filter_sample:
            self._predict(sample)
        obs = np.zeros(1, OBSERVATION)
        obs["sample_index"] = sample
        state = np.array([*self._x[:3], self._x[6], self._x[8]])
        row = self._row(obs, np.atleast_1d(ephemeris), state, self._x[3:6], self._x[7], self._claim())
        row["isb_m"], row["valid"] = np.nan, self._fresh()
        for name in ("gdop", "pdop", "hdop", "vdop"):
            row[name] = np.inf
        return row
