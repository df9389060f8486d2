"""Channel coding of Galileo I/NAV: CRC-24Q, convolutional code, Viterbi decoder, block interleaver.

Bits are uint8 (0 or 1). Symbols are soft, + = logic 0. Source: Galileo OS SIS ICD, 4.1.4 (FEC, interleaving)
and 5.1.9.4 (CRC).
"""

import numpy as np
from numba import njit

CRC24Q = 0x1864CFB
"""Generator of CRC-24Q (Galileo OS SIS ICD, 5.1.9.4; Qualcomm): initial value 0, no reflection."""
G1, G2 = 0o171, 0o133
"""Generators of the rate 1/2, K = 7 code, newest bit leftmost; G2's output is inverted (ICD, 4.1.4.1)."""
INTERLEAVER_COLUMNS, INTERLEAVER_ROWS = 30, 8
"""Block interleaver of one page part (ICD, 4.1.4.2)."""


def _outputs() -> np.ndarray:
    register = np.arange(128)
    parity = np.array([bin(r).count("1") & 1 for r in register])
    return (2 * parity[register & G1] + (parity[register & G2] ^ 1)).astype(np.uint8)


OUTPUTS = _outputs()
"""Encoder output 2 * first + second for each content of the register (newest bit = bit 6), uint8 (128,)."""


@njit(cache=True, nogil=True)
def _crc24q(bits):
    crc = 0
    for i in range(bits.size):
        crc = (crc << 1) ^ (int(bits[i]) << 24)
        if crc & 0x1000000:
            crc ^= CRC24Q
    return crc


def crc24q(bits: np.ndarray) -> int:
    """CRC-24Q of a bit sequence; zero over data with its CRC appended."""
    return int(_crc24q(np.asarray(bits, np.uint8)))


@njit(cache=True, nogil=True)
def _convolve(bits, outputs, symbols):
    state = 0
    for k in range(bits.size):
        register = (int(bits[k]) << 6) | state
        out = outputs[register]
        symbols[2 * k] = out >> 1
        symbols[2 * k + 1] = out & 1
        state = register >> 1


def convolve(bits: np.ndarray) -> np.ndarray:
    """Convolutional code of `bits` from state 0: uint8 (2 n,), G1 then inverted G2 for each bit."""
    symbols = np.empty(2 * len(bits), np.uint8)
    _convolve(np.asarray(bits, np.uint8), OUTPUTS, symbols)
    return symbols


@njit(cache=True, nogil=True)
def _viterbi(soft, outputs, bits):
    n = bits.size
    decision = np.zeros((n, 64), np.uint8)
    metric = np.full(64, np.float32(-1e30), np.float32)
    metric[0] = 0.0
    new = np.empty(64, np.float32)
    gain = np.empty(4, np.float32)
    for k in range(n):
        a, b = soft[2 * k], soft[2 * k + 1]
        gain[0], gain[1], gain[2], gain[3] = a + b, a - b, b - a, -a - b
        for s in range(64):
            # both registers that end in state s: the oldest bit, which is shifted out, is 0 or 1
            register = s << 1
            zero = metric[register & 63] + gain[outputs[register]]
            one = metric[(register | 1) & 63] + gain[outputs[register | 1]]
            if one > zero:
                decision[k, s] = 1
                new[s] = one
            else:
                new[s] = zero
        metric, new = new, metric
    state = 0
    for k in range(n - 1, -1, -1):
        bits[k] = state >> 5
        state = ((state << 1) | decision[k, state]) & 63
    return metric[0]


def viterbi(soft: np.ndarray) -> np.ndarray:
    """Most likely bits of a terminated code word (starts and ends in state 0) in Gaussian noise.

    Maximises sum(soft * sign(symbol)) over all code words, so any positive scale will do and 0 is an erasure.

    Parameters
    ----------
    soft : float32 (2 n,), + = logic 0, deinterleaved.

    Returns
    -------
    uint8 (n,), the last six are the zero tail.
    """
    bits = np.empty(len(soft) // 2, np.uint8)
    _viterbi(np.ascontiguousarray(soft, np.float32), OUTPUTS, bits)
    return bits


def interleave(symbols: np.ndarray) -> np.ndarray:
    """Order of transmission of the 240 symbols of a part: written in columns of 8, read in rows of 30."""
    return symbols.reshape(INTERLEAVER_COLUMNS, INTERLEAVER_ROWS).T.ravel()


def deinterleave(symbols: np.ndarray) -> np.ndarray:
    """Inverse of `interleave`."""
    return symbols.reshape(INTERLEAVER_ROWS, INTERLEAVER_COLUMNS).T.ravel()
