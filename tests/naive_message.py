"""Textbook twins of the message coding: from the equations, sharing nothing with signals."""

import numpy as np

PARITY_EQUATIONS = (  # IS-GPS-200, table 20-XIV: (index of the starred bit, data bits)
    ("D29*", (1, 2, 3, 5, 6, 10, 11, 12, 13, 14, 17, 18, 20, 23)),
    ("D30*", (2, 3, 4, 6, 7, 11, 12, 13, 14, 15, 18, 19, 21, 24)),
    ("D29*", (1, 3, 4, 5, 7, 8, 12, 13, 14, 15, 16, 19, 20, 22)),
    ("D30*", (2, 4, 5, 6, 8, 9, 13, 14, 15, 16, 17, 20, 21, 23)),
    ("D30*", (1, 3, 5, 6, 7, 9, 10, 14, 15, 16, 17, 18, 21, 22, 24)),
    ("D29*", (3, 5, 6, 8, 9, 10, 11, 13, 15, 19, 22, 23, 24)),
)


def parity(d: list[int], d29: int, d30: int) -> list[int]:
    """D25..D30 of the data bits d[0] = d1 .. d[23] = d24."""
    star = {"D29*": d29, "D30*": d30}
    return [(star[name] + sum(d[k - 1] for k in places)) % 2 for name, places in PARITY_EQUATIONS]


def lnav_words(bits: list[int]) -> list[tuple[list[int], bool]]:
    """(upright data bits, parity holds) of each word of a bit stream that starts on a subframe after 00."""
    words, d29, d30 = [], 0, 0
    for first in range(0, len(bits) - 29, 30):
        word = bits[first : first + 30]
        d = [b ^ d30 for b in word[:24]]
        words.append((d, parity(d, d29, d30) == word[24:]))
        d29, d30 = word[28], word[29]
    return words


def value(bits: list[int]) -> int:
    """Unsigned number, most significant bit first."""
    return int("".join(map(str, bits)), 2)


def crc24q(bits: list[int]) -> list[int]:
    """Remainder of bits * x^24 by the generator, by long division."""
    generator = [int(b) for b in format(0x1864CFB, "025b")]
    rest = list(bits) + 24 * [0]
    for k in range(len(bits)):
        if rest[k]:
            for j in range(25):
                rest[k + j] ^= generator[j]
    return rest[-24:]


def convolve(bits: list[int]) -> list[int]:
    """Rate 1/2, K = 7: G1 = 1 + D + D^2 + D^3 + D^6, G2 = 1 + D^2 + D^3 + D^5 + D^6, G2 inverted."""
    delayed = [[0] * k + list(bits)[: len(bits) - k] for k in range(7)]
    out = []
    for k in range(len(bits)):
        out.append(sum(delayed[d][k] for d in (0, 1, 2, 3, 6)) % 2)
        out.append((1 + sum(delayed[d][k] for d in (0, 2, 3, 5, 6))) % 2)
    return out


def interleave(symbols: list[int]) -> list[int]:
    """tx[30 i + j] = enc[8 j + i]."""
    sent = [0] * 240
    for i in range(8):
        for j in range(30):
            sent[30 * i + j] = symbols[8 * j + i]
    return sent


def page(
    word: list[int], secondary_sync: list[int], page_type: int = 0, crc_of: list[int] | None = None
) -> list[int]:
    """500 symbols of an I/NAV page that carries 128 bits; `crc_of` = other bits that the CRC is made of."""
    even = [0, page_type, *word[:112]]
    odd = [1, page_type, *word[112:], *(64 * [0])]
    odd = odd + crc24q(crc_of or even + odd) + secondary_sync
    sync = [0, 1, 0, 1, 1, 0, 0, 0, 0, 0]
    return [s for part in (even, odd) for s in sync + interleave(convolve(part + 6 * [0]))]


def viterbi(soft: np.ndarray) -> np.ndarray:
    """Maximum-likelihood bits of many terminated code words at once, float64 (pages, 2 n) -> (pages, n).

    The register holds the newest bit in its lowest place (unlike signals.fec); the state is its low six bits.
    """
    pages, n = soft.shape[0], soft.shape[1] // 2
    state = np.arange(64)
    taps = ((0, 1, 2, 3, 6), (0, 2, 3, 5, 6))
    history = np.empty((n, pages, 64), np.uint8)
    metric = np.full((pages, 64), -1e9)
    metric[:, 0] = 0.0
    for k in range(n):
        options = []
        for oldest in (0, 1):
            register = state + 64 * oldest  # bit j of the register is the input j steps ago
            first = sum((register >> t) & 1 for t in taps[0]) % 2
            second = (1 + sum((register >> t) & 1 for t in taps[1])) % 2
            branch = soft[:, 2 * k, None] * (1 - 2 * first) + soft[:, 2 * k + 1, None] * (1 - 2 * second)
            options.append(metric[:, register >> 1] + branch)
        history[k] = options[1] > options[0]
        metric = np.maximum(*options)
    bits = np.empty((pages, n), np.uint8)
    now, each = np.zeros(pages, int), np.arange(pages)
    for k in range(n - 1, -1, -1):
        bits[:, k] = now & 1
        now = (now + 64 * history[k, each, now].astype(int)) >> 1
    return bits
