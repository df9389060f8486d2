"""The one place that knows which FFT library runs: FFTW where it is installed, else scipy."""

import threading

import numpy as np

try:
    import pyfftw
except ImportError:  # pragma: no cover - the fallback is tested by name
    pyfftw = None

__all__ = ["fast_length", "row_fft"]

_PLANNING = threading.Lock()  # FFTW's planner is not re-entrant; executing plans is


def row_fft(n, inverse=False, library=None):
    """Plan one complex64 transform of length n, to be run many times on the same two rows.

    Y_k = sum_n X_n exp(-+2 pi i k n / N); neither direction is divided by N. Planned without measuring: the same
    bits in every run. One plan serves one thread.

    Parameters
    ----------
    n : int
    inverse : bool
    library : str, optional
        "fftw" or "scipy"; default FFTW if present.

    Returns
    -------
    source, result : ndarray complex64 (n,)
        Write into ``source``, which the run may destroy; read ``result``.
    run : callable
        ``run()`` transforms.
    """
    library = library or ("scipy" if pyfftw is None else "fftw")
    if library == "scipy":
        return _row_scipy(n, inverse)
    source, result = (pyfftw.empty_aligned(n, "complex64") for _ in range(2))
    with _PLANNING:
        plan = pyfftw.FFTW(
            source,
            result,
            direction="FFTW_BACKWARD" if inverse else "FFTW_FORWARD",
            flags=("FFTW_ESTIMATE", "FFTW_DESTROY_INPUT"),
        )
    source[:] = 0
    return source, result, plan.execute


def _row_scipy(n, inverse):
    from scipy.fft import fft, ifft

    source, result = np.zeros(n, np.complex64), np.zeros(n, np.complex64)

    def run():
        result[:] = ifft(source, norm="forward") if inverse else fft(source)

    return source, result, run


def fast_length(n_max):
    """Largest length <= n_max whose only prime factors are 2, 3 and 5."""
    if n_max < 1:
        raise ValueError(f"no transform length up to {n_max}")
    best, five = 1, 1
    while five <= n_max:
        three = five
        while three <= n_max:
            best = max(best, three << ((n_max // three).bit_length() - 1))
            three *= 3
        five *= 5
    return best
