"""What ``gnssbb export`` writes is read back by other programs' readers and says what the results say."""

import csv
import io
import shutil
import xml.etree.ElementTree as ET
from datetime import datetime, timedelta
from functools import reduce

import h5py
import numpy as np
import pytest
from scipy.io import loadmat

from nav.records import OBSERVATION, SOLUTION
from sdr import jobs, plot
from sdr.errors import hermite
from sdr.export import _degrees, export
from sdr.rinex_obs import lines
from signals.constants import C_MPS, F_L1_HZ, SECONDS_PER_WEEK, WAVELENGTH_M
from signals.geodesy import ecef_to_geodetic
from signals.timescale import calendar, leap_seconds

KML = "{http://www.opengis.net/kml/2.2}"
GX = "{http://www.google.com/kml/ext/2.2}"
GPX = "{http://www.topografix.com/GPX/1/1}"


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Half a minute of GPS and Galileo, with a few seconds of positions."""
    path = tmp_path_factory.mktemp("export") / "e1.h5"
    result = jobs.run(
        "demo-e1", output=path, overrides=["duration_s=34", "sky.start=2024-03-01T12:01:28"], quiet=True
    )
    assert result["fix"] is not None, result["no_fix_reason"]
    return path


@pytest.fixture(scope="module")
def written(results):
    base = results.parent / "out"
    names = {"rinex_obs": "a.obs", "nmea": "a.nmea", "kml": "a.kml", "gpx": "a.gpx"}
    export(results, **{k: base / v for k, v in names.items()}, mat=base / "mat", csv_dir=base / "csv")
    assert not list(base.rglob("*.part"))
    return base


@pytest.fixture(scope="module")
def stored(results):
    with h5py.File(results) as h5:
        return {
            "solution": h5["navigation/solution"][:],
            "observations": h5["navigation/observations"][:],
            "satellites": h5["navigation/satellites"][:],
            "truth": h5["truth/satellites"][:],
            "leap_s": int(h5["navigation/solution"].attrs["leap_s"]),
        }


def _geodetic(solution):
    lat_rad, lon_rad, height_m = ecef_to_geodetic(solution["pos_ecef_m"])
    return np.degrees(lat_rad), np.degrees(lon_rad), height_m


@pytest.mark.filterwarnings("ignore::FutureWarning:georinex")
def test_rinex_is_read_by_georinex_and_agrees_with_truth(written, stored):
    georinex = pytest.importorskip("georinex")
    obs = georinex.load(written / "a.obs")
    assert obs.attrs["version"] == 3.05
    np.testing.assert_allclose(
        obs.attrs["position"], stored["solution"]["pos_ecef_m"].mean(axis=0), atol=1e-4
    )
    samples = np.unique(stored["observations"]["sample_index"])
    samples = samples[samples >= stored["solution"]["sample_index"][0]]
    assert len(obs.time) == len(samples)
    fs_hz = 4e6
    start = datetime(2024, 3, 1, 12, 1, 28)
    for k, (tag, n) in enumerate(zip(obs.time.values.astype("M8[ns]"), samples)):
        # georinex keeps microseconds; what the tag means is settled against the truth below.
        tag_s = (tag - np.datetime64(start)) / np.timedelta64(1, "s")
        residual_m = []
        for sv in obs.sv.values:
            code_m = float(obs["C1C"].sel(sv=sv)[k])
            truth = stored["truth"]
            truth = truth[(truth["system"] == sv[:1].encode()) & (truth["prn"] == int(sv[1:]))]
            if np.isfinite(code_m):
                delay_s = hermite(
                    np.array([n / fs_hz]),
                    truth["sample_index"] / fs_hz,
                    truth["delay_s"],
                    truth["delay_rate_s_s"],
                )[0]
                residual_m.append(code_m - C_MPS * (delay_s + tag_s - n / fs_hz))
        assert len(residual_m) >= 7
        # Thermal noise: 40 dB-Hz, B = 1 Hz gives 1.5 m; five sigmas. Georinex cuts the tag: up to 1 us, 300 m, common.
        assert np.ptp(residual_m) < 2 * 5 * 1.5
        assert -1.0 < np.mean(residual_m) < 301.0
    # The receiver time is steered at the first fix; afterwards the tags are GPS time but for 0.3 ppm of drift.
    gps = [calendar(int(r["week"]), float(r["tow_s"])) for r in stored["solution"]]
    tags = obs.time.values.astype("M8[us]").astype(datetime)
    off_s = np.array([(t - g).total_seconds() for t, g in zip(tags, gps)])
    assert np.all(np.abs(off_s) < 0.5e-3 + 1e-6)
    assert np.all(np.abs(off_s[1:]) < 20e-6)


@pytest.mark.filterwarnings("ignore::FutureWarning:georinex")
def test_rinex_phase_grows_with_range_and_keeps_to_the_code(written):
    georinex = pytest.importorskip("georinex")
    obs = georinex.load(written / "a.obs")
    for sv in obs.sv.values:
        one = (
            obs.sel(sv=sv).dropna("time", subset=["L1C"])
            if obs["L1C"].sel(sv=sv).notnull().sum() > 2
            else None
        )
        if one is None:
            continue
        apart_m = (one["C1C"] - one["L1C"] * WAVELENGTH_M).values
        assert (
            np.ptp(apart_m) < 2 * 5 * 1.5
        )  # code noise; the wrong sign runs away by 2 Doppler wavelengths a second
        assert abs(apart_m[0]) < WAVELENGTH_M
        t_s = (one.time.values - one.time.values[0]) / np.timedelta64(1, "s")
        rate = np.diff(one["L1C"].values) / np.diff(t_s)
        mean = 0.5 * (one["D1C"].values[1:] + one["D1C"].values[:-1])
        clock_hz = F_L1_HZ * 2e-6  # georinex cuts the tags to a microsecond
        np.testing.assert_allclose(rate[1:], -mean[1:], atol=5.0 + clock_hz)


def test_rinex_lines_are_fixed_width(written):
    text = (written / "a.obs").read_text().splitlines()
    end = next(k for k, line in enumerate(text) if line[60:].strip() == "END OF HEADER")
    assert all(len(line) <= 80 for line in text[: end + 1])
    assert text[0][20] == "O" and text[0][40] == "M"
    body = [line for line in text[end + 1 :] if line[0] != ">"]
    assert body
    for line in body:
        assert line[0] in "GE" and line[1:3].isdigit()
        assert line[3 + 10] == "." and line[19 + 10] == "." and line[35 + 10] == "."
        half_cycle = int(line[33].strip() or 0) & 2
        assert bool(half_cycle) is (line[0] == "G")


def _hand_made(steps_s):
    """One satellite at rest seen by a clock that is stepped: OBSERVATION and SOLUTION rows."""
    n = len(steps_s)
    obs, sol = np.zeros(n, OBSERVATION), np.zeros(n, SOLUTION)
    fs_hz, start_ms = 4e6, SECONDS_PER_WEEK * 1000 - 2000
    obs["system"], obs["signal"], obs["prn"], obs["lock_s"], obs["cn0_dbhz"] = b"G", b"L1CA", 5, 1e3, 45
    for k, step_s in enumerate(steps_s):
        obs["sample_index"][k] = sol["sample_index"][k] = round((k + 1) * fs_hz)
        gps_ms = start_ms + k * 1000
        obs["tow_tx_ms"][k], obs["tow_tx_frac_s"][k] = (gps_ms - 71) % (SECONDS_PER_WEEK * 1000), 0.0005
        obs["pseudorange_m"][k] = C_MPS * (0.0705 + step_s)
        obs["carrier_phase_cycles"][k] = 1000.0
        sol["week"][k], sol["tow_s"][k] = (
            2303 + gps_ms // (SECONDS_PER_WEEK * 1000),
            gps_ms / 1000 % SECONDS_PER_WEEK,
        )
    sol["pos_ecef_m"] = [6.4e6, 0, 0]
    return list(lines(obs, sol, fs_hz, "test 1"))


def test_steps_of_the_receiver_time_move_tag_code_and_phase_alike_across_the_end_of_a_week():
    text = _hand_made([0.0, 1.23456789e-4, 4.0e-3, 0.0])
    body = [line for line in text if line[:3] == "G05"]
    tags = [line for line in text if line[0] == ">"]
    assert [t[2:21] for t in tags] == [
        "2024 03 02 23 59 58", "2024 03 02 23 59 59", "2024 03 03 00 00  0", "2024 03 03 00 00  1"
    ]  # fmt: skip
    code = np.array([float(line[3:17]) for line in body])
    phase = np.array([float(line[19:33]) for line in body])
    tag_s = np.array([float(t[19:29]) % 1 for t in tags])
    tag_s -= np.round(tag_s)
    # The third step is of 4 ms: such tags come back to GPS time, and code and phase with them.
    np.testing.assert_allclose(tag_s, [0.0, 123.5e-6, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(code, C_MPS * (0.0705 + tag_s), atol=1e-3)
    np.testing.assert_allclose(phase - phase[0], F_L1_HZ * (tag_s - tag_s[0]), atol=2e-3)
    assert [line[33] for line in body] == ["3", "2", "2", "2"]


def test_nmea_checksums_and_positions(written, stored):
    raw = (written / "a.nmea").read_bytes()
    assert raw.endswith(b"\r\n")
    sentences = raw.decode("ascii").split("\r\n")[:-1]
    by_type = {}
    for sentence in sentences:
        body, _, checksum = sentence[1:].partition("*")
        assert sentence[0] == "$" and len(sentence) <= 80
        assert reduce(lambda a, b: a ^ b, body.encode()) == int(checksum, 16)
        by_type.setdefault(body[2:5], []).append(body.split(","))
    solution = stored["solution"]
    lat_deg, lon_deg, height_m = _geodetic(solution)
    assert len(by_type["GGA"]) == len(by_type["RMC"]) == len(by_type["VTG"]) == len(solution)
    for k, (gga, rmc) in enumerate(zip(by_type["GGA"], by_type["RMC"])):
        assert int(gga[2][:2]) + float(gga[2][2:]) / 60 == pytest.approx(lat_deg[k], abs=1e-8)
        assert int(gga[4][:3]) + float(gga[4][3:]) / 60 == pytest.approx(lon_deg[k], abs=1e-8)
        assert float(gga[9]) + float(gga[11]) == pytest.approx(height_m[k], abs=0.0051)
        utc = calendar(int(solution["week"][k]), float(solution["tow_s"][k])) - timedelta(
            seconds=stored["leap_s"]
        )
        said = datetime.strptime(f"{rmc[9]} {rmc[1]}", "%d%m%y %H%M%S.%f")
        assert abs((said - utc).total_seconds()) <= 0.00051
    assert stored["leap_s"] == 18
    used = {f"{g[-1]}:{n}" for g in by_type["GSA"] for n in g[3:15] if n}
    expected = {
        f"{ {b'G': 1, b'E': 3}[s['system']] }:{s['prn']:02d}" for s in stored["satellites"] if s["used"]
    }
    assert used == expected


def test_kml_and_gpx_parse_and_hold_the_positions(written, stored):
    lat_deg, lon_deg, height_m = _geodetic(stored["solution"])
    root = ET.parse(written / "a.kml").getroot()
    coords = np.array([[float(v) for v in c.text.split()] for c in root.iter(f"{GX}coord")])
    np.testing.assert_allclose(coords, np.column_stack([lon_deg, lat_deg, height_m]), atol=1e-4)
    np.testing.assert_allclose(coords[:, :2], np.column_stack([lon_deg, lat_deg]), atol=1e-9)
    assert len(list(root.iter(f"{KML}when"))) == len(coords)
    points = list(ET.parse(written / "a.gpx").getroot().iter(f"{GPX}trkpt"))
    np.testing.assert_allclose([float(p.get("lat")) for p in points], lat_deg, atol=1e-9)
    np.testing.assert_allclose([float(p.get("lon")) for p in points], lon_deg, atol=1e-9)
    np.testing.assert_allclose([float(p.find(f"{GPX}ele").text) for p in points], height_m, atol=1e-4)


def test_mat_has_the_names_and_signs_of_gnss_sdr(written, results):
    with h5py.File(results) as h5:
        channels = sorted(h5["tracking"])
        for k, name in enumerate(channels):
            epochs, corr = h5["tracking"][name]["epochs"][:], h5["tracking"][name]["corr"]
            mat = loadmat(written / "mat" / f"tracking_ch_{k}.mat", squeeze_me=True)
            np.testing.assert_array_equal(mat["PRN_start_sample_count"], epochs["sample_index"])
            assert np.all(mat["PRN"] == corr.parent["epochs"].attrs["prn"])
            prompt = np.hypot(mat["Prompt_I"], mat["Prompt_Q"])
            np.testing.assert_allclose(mat["abs_P"], prompt, rtol=1e-4)
            np.testing.assert_allclose(
                mat["abs_P"],
                np.hypot(epochs["prompt_i"], epochs["prompt_q"]) * epochs["n_samples"],
                rtol=1e-4,
            )
            locked = epochs["state"] == epochs["state"].max()
            for side in ("abs_E", "abs_L"):  # half a chip apart: three quarters of the prompt, E1's less
                assert 0.5 < np.mean(mat[side][locked] / mat["abs_P"][locked]) < 0.9
            # In GNSS-SDR the phase falls while the Doppler is positive.
            rate_hz = np.polyfit(
                mat["PRN_start_sample_count"][locked] / mat["fs_hz"], mat["acc_carrier_phase_rad"][locked], 1
            )[0] / (2 * np.pi)
            assert rate_hz == pytest.approx(-np.mean(mat["carrier_doppler_hz"][locked]), abs=2.0)
            assert mat["corr"].shape == corr.shape and len(mat["taps_chips"]) == corr.shape[1]
            for name_ in (
                "carr_error_hz",
                "code_error_chips",
                "CN0_SNV_dB_Hz",
                "carrier_lock_test",
                "code_freq_chips",
                "TOW_ms",
                "WN",
            ):
                assert mat[name_].shape == epochs.shape
    assert len(list((written / "mat").iterdir())) == len(channels)


def test_csv_gives_every_dataset_back(written, results):
    with h5py.File(results) as h5:
        names = []
        h5.visititems(lambda n, o: names.append(n) if isinstance(o, h5py.Dataset) else None)
        assert {p.stem for p in (written / "csv").iterdir()} == {n.replace("/", "_") for n in names}
        rows = list(csv.DictReader(io.StringIO((written / "csv" / "navigation_solution.csv").read_text())))
        solution = h5["navigation/solution"][:]
        assert len(rows) == len(solution)
        for axis in range(3):
            said = [float(r[f"pos_ecef_m_{axis}"]) for r in rows]
            np.testing.assert_array_equal(said, solution["pos_ecef_m"][:, axis])
        channel = next(iter(h5["tracking"]))
        corr = h5["tracking"][channel]["corr"][:]
        table = np.genfromtxt(written / "csv" / f"tracking_{channel}_corr.csv", delimiter=",", skip_header=1)
        k = corr.shape[1]
        np.testing.assert_array_equal(np.float32(table[:, :k]), corr.real)
        np.testing.assert_array_equal(np.float32(table[:, k:]), corr.imag)


def test_the_sky_of_a_recording_is_where_the_truth_says(results, stored, tmp_path):
    """Azimuth and elevation come from the decoded ephemerides and the position; the sky figure needs no truth."""
    seen, truth = stored["satellites"], stored["truth"]
    assert len({(s["system"], s["prn"]) for s in seen}) >= 8
    for s in seen:
        at = truth[(truth["system"] == s["system"]) & (truth["prn"] == s["prn"])]
        at = at[np.argmin(np.abs(at["sample_index"].astype(float) - float(s["sample_index"])))]
        # A position error of 100 m at 20 000 km, and 0.1 s of the satellite's motion: far below a milliradian.
        assert abs(s["elevation_rad"] - at["elevation_rad"]) < 1e-3
        around = (s["azimuth_rad"] - at["azimuth_rad"] + np.pi) % (2 * np.pi) - np.pi
        assert abs(around) * np.cos(at["elevation_rad"]) < 1e-3
    copy = tmp_path / "recording.h5"
    shutil.copy(results, copy)
    with h5py.File(copy, "r+") as h5:
        del h5["truth"]
    assert tmp_path / "figures" / "sky.png" in plot.plot(copy, tmp_path / "figures")


def test_observations_are_stored_once_per_epoch(stored):
    obs = stored["observations"]
    keys = list(zip(obs["sample_index"].tolist(), obs["system"].tolist(), obs["prn"].tolist()))
    assert len(keys) == len(set(keys))


@pytest.mark.parametrize(
    ("group", "option", "words"),
    [
        ("navigation/solution", "rinex_obs", ["no position", "fix"]),
        ("navigation/solution", "nmea", ["no position", "fix"]),
        ("navigation/observations", "rinex_obs", ["pseudoranges"]),
        ("tracking", "mat", ["no tracked satellite"]),
    ],
)
def test_missing_data_is_one_sentence_and_leaves_nothing(results, group, option, words, tmp_path):
    copy = tmp_path / "less.h5"
    shutil.copy(results, copy)
    with h5py.File(copy, "r+") as h5:
        del h5[group]
    with pytest.raises(ValueError) as error:
        export(copy, **{option: tmp_path / "out"})
    assert all(w in str(error.value) for w in words) and "\n" not in str(error.value)
    assert not (tmp_path / "out").exists() and not list(tmp_path.glob("*.part"))


def test_nothing_asked_for_is_refused(results):
    with pytest.raises(ValueError, match="--rinex-obs"):
        export(results)


def test_degrees_do_not_round_to_sixty_minutes():
    assert _degrees(-9.99999999999, 3, "EW") == "01000.000000,W"
    assert _degrees(48.0, 2, "NS") == "4800.000000,N"


def test_leap_seconds():
    assert leap_seconds(datetime(2024, 3, 1)) == 18
    assert leap_seconds(datetime(2017, 1, 1, 0, 0, 17)) == 17
    assert leap_seconds(datetime(2017, 1, 1, 0, 0, 18)) == 18
    with pytest.raises(ValueError, match="1980"):
        leap_seconds(datetime(1980, 2, 1))
