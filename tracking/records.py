"""Structured arrays that leave this package. Signs are written here, once.

* Positive Doppler = satellite approaching. ``doppler_hz`` excludes the intermediate frequency.
* Tap offset > 0 = replica advanced = early. ``corr[c, k, t]`` is the tap ``taps_chips[t]``.
* ``code_error_chips`` > 0: the incoming code is ahead of the replica (the NCO must advance).
* ``phase_error_cycles`` > 0: the incoming carrier is ahead of the replica; same for ``freq_error_hz``.
* Correlator outputs are normalised: sum over the integration of sample x conj(carrier) x code, divided by the
  number of samples, so that amplitude is in ADC levels and noise standard deviation falls as 1/sqrt(n).
* Carrier phase of the replica is 2 pi (f_if + f_doppler) n / fs accumulated from the first sample of the file:
  it *grows* with positive Doppler.
"""

import numpy as np

ACQUISITION = np.dtype(
    [
        ("signal", "S4"),  # b"L1CA", b"E1B", b"E1C"
        ("prn", "i4"),
        ("sample_index", "u8"),  # where code_phase_chips holds
        ("doppler_hz", "f8"),
        ("code_phase_chips", "f8"),  # phase of the incoming primary code at sample_index
        ("cn0_dbhz", "f8"),  # of the component named in signal
        ("statistic", "f8"),
        ("threshold", "f8"),
        ("acquired", "?"),
    ]
)

EPOCH = np.dtype(
    [
        ("sample_index", "u8"),  # first sample of the integration
        ("n_samples", "i4"),
        ("prn", "i4"),
        ("state", "u1"),  # see tracking.channel.STATE_*
        ("symbol_index", "i8"),  # count of code periods since the channel started, at the integration's start
        ("tow_s", "f8"),  # transmit time at the integration's first sample, NaN until decoded
        ("code_phase_chips", "f8"),  # replica's primary-code phase at sample_index
        ("carrier_phase_cycles", "f8"),  # replica, accumulated, at sample_index, f_if removed
        ("doppler_hz", "f8"),
        ("doppler_rate_hz_s", "f8"),
        ("code_rate_hz", "f8"),
        ("prompt_i", "f4"),
        ("prompt_q", "f4"),
        (
            "prompt2_i",
            "f4",
        ),  # second half of the integration's sum, over all n_samples: first half = prompt - prompt2
        ("prompt2_q", "f4"),
        ("data_i", "f4"),  # E1-B prompt while the pilot carries the loops; else 0
        ("data_q", "f4"),
        ("noise_i", "f4"),  # noise-reference tap of this integration, as the prompt
        ("noise_q", "f4"),
        (
            "noise_power",
            "f4",
        ),  # |noise-reference tap|^2 of one code period, smoothed, scaled to the integration
        ("code_error_chips", "f4"),  # discriminator outputs, replica rounding removed
        ("phase_error_cycles", "f4"),
        ("freq_error_hz", "f4"),
        ("cn0_dbhz", "f4"),  # noise-reference estimator
        ("cn0_prompt_dbhz", "f4"),  # prompt-only estimator
        ("carrier_lock", "f4"),  # cos(2 phase error) average
        ("code_lock", "f4"),
        ("cycle_slip", "u1"),
        ("pll_bw_hz", "f4"),  # noise bandwidths of the loops in force; 0: steered, pulling in or settling
        ("dll_bw_hz", "f4"),
    ]
)
"""One integration of one channel; the correlator array (C, n, K) complex64 travels beside it."""

AIDING = np.dtype(
    [
        ("sample_index", "u8"),  # the command holds from here
        ("steered", "u1"),  # 0: the channel's own loops; 1: NCO follows this record
        ("code_phase_chips", "f8"),  # wanted primary-code phase at sample_index
        ("doppler_hz", "f8"),
        ("doppler_rate_hz_s", "f8"),
        ("weaken", "f8"),  # factor on the variances with which loops of its own adapt; below 1: none
    ]
)
"""What navigation hands to tracking for the NEXT slab: stamped for the interval in which it is used."""

REPLICA = np.dtype(
    [
        ("sample_index", "u8"),
        ("signal", "S4"),
        ("prn", "i4"),
        ("state", "u1"),
        ("code_phase_chips", "f8"),  # primary code, in [0, L)
        ("code_period", "i8"),  # whole code periods since the channel started
        ("carrier_phase_cycles", "f8"),
        ("doppler_hz", "f8"),  # of the loop filter (steered: of the NCO)
        ("doppler_rate_hz_s", "f8"),
        ("cn0_dbhz", "f8"),  # of the component named in signal
        ("cn0_prompt_dbhz", "f8"),
        ("carrier_lock", "f8"),
        ("code_lock", "f8"),
        ("phase_locked", "?"),
        ("lock_s", "f8"),  # since the phase was declared locked
        ("slips", "i8"),  # cycle slips flagged since the channel started
    ]
)
"""The replica of one channel at a common receiver sample (``Tracker.snapshot``): no raw discriminator in it."""
