"""Running GNSS-SDR, the outside judge: its configuration for our 8-bit I/Q files, and the positions it prints."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

FS_HZ = 4_000_000
HEAD = f"""[GNSS-SDR]
GNSS-SDR.internal_fs_sps={FS_HZ}
SignalSource.implementation=File_Signal_Source
SignalSource.filename=none
SignalSource.item_type=ibyte
SignalSource.sampling_frequency={FS_HZ}
SignalSource.samples=0
SignalSource.enable_throttle_control=false
SignalConditioner.implementation=Signal_Conditioner
DataTypeAdapter.implementation=Ibyte_To_Complex
InputFilter.implementation=Pass_Through
InputFilter.item_type=gr_complex
Resampler.implementation=Pass_Through
Resampler.item_type=gr_complex
Channels.in_acquisition=4
Observables.implementation=Hybrid_Observables
PVT.implementation=RTKLIB_PVT
PVT.positioning_mode=Single
PVT.iono_model=Broadcast
PVT.trop_model=Saastamoinen
PVT.elevation_mask=5
PVT.output_rate_ms=100
PVT.display_rate_ms=1000
PVT.output_enabled=false
"""
GPS = """Channels_1C.count={n}
Acquisition_1C.implementation=GPS_L1_CA_PCPS_Acquisition
Acquisition_1C.item_type=gr_complex
Acquisition_1C.pfa=1e-6
Acquisition_1C.doppler_max=6000
Acquisition_1C.doppler_step=250
Acquisition_1C.coherent_integration_time_ms=1
Acquisition_1C.max_dwells=4
Acquisition_1C.blocking=true
Tracking_1C.implementation=GPS_L1_CA_DLL_PLL_Tracking
Tracking_1C.item_type=gr_complex
Tracking_1C.early_late_space_chips=0.5
Tracking_1C.pll_bw_hz=35.0
Tracking_1C.dll_bw_hz=2.0
Tracking_1C.pll_filter_order=3
Tracking_1C.dll_filter_order=2
TelemetryDecoder_1C.implementation=GPS_L1_CA_Telemetry_Decoder
"""
GALILEO = """Channels_1B.count={n}
Acquisition_1B.implementation=Galileo_E1_PCPS_Ambiguous_Acquisition
Acquisition_1B.item_type=gr_complex
Acquisition_1B.coherent_integration_time_ms=4
Acquisition_1B.acquire_pilot=true
Acquisition_1B.cboc=false
Acquisition_1B.pfa=0.01
Acquisition_1B.doppler_max=6000
Acquisition_1B.doppler_step=50
Acquisition_1B.bit_transition_flag=true
Acquisition_1B.max_dwells=1
Acquisition_1B.blocking=true
Tracking_1B.implementation=Galileo_E1_DLL_PLL_VEML_Tracking
Tracking_1B.item_type=gr_complex
Tracking_1B.track_pilot=true
Tracking_1B.extend_correlation_symbols=4
Tracking_1B.pll_bw_hz=15.0
Tracking_1B.dll_bw_hz=2.0
Tracking_1B.pll_bw_narrow_hz=5.0
Tracking_1B.dll_bw_narrow_hz=0.5
Tracking_1B.pll_filter_order=3
Tracking_1B.dll_filter_order=2
Tracking_1B.early_late_space_chips=0.15
Tracking_1B.very_early_late_space_chips=0.5
Tracking_1B.early_late_space_narrow_chips=0.15
Tracking_1B.very_early_late_space_narrow_chips=0.5
TelemetryDecoder_1B.implementation=Galileo_E1B_Telemetry_Decoder
TelemetryDecoder_1B.enable_reed_solomon=false
"""


def positions(data: Path, folder: Path, n_gps: int, n_galileo: int) -> np.ndarray:
    """Run GNSS-SDR on 8-bit I/Q at 4 Msps; rows of (seconds of day UTC, lat_deg, lon_deg, height_m)."""
    if shutil.which("gnss-sdr") is None:
        pytest.skip("gnss-sdr is not installed (Debian package gnss-sdr)")
    text = HEAD + (GPS.format(n=n_gps) if n_gps else "") + (GALILEO.format(n=n_galileo) if n_galileo else "")
    config = folder / "receiver.conf"
    config.write_text(text)
    command = ["gnss-sdr", f"--config_file={config}", f"--signal_source={data}", f"--log_dir={folder}"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=500, errors="replace")
    number = r"(-?[\d.]+)"
    pattern = rf"Position at \S+ (\d+):(\d+):{number} UTC.*?Lat = {number} \[deg\], Long = {number} \[deg\], Height = {number}"
    found = re.findall(pattern, done.stdout)
    assert found, f"GNSS-SDR printed no position; its last words: {done.stdout[-500:]}"
    return np.array(
        [[int(h) * 3600 + int(m) * 60 + float(s), float(a), float(b), float(c)] for h, m, s, a, b, c in found]
    )
