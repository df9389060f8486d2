"""Channel coding of I/NAV against the ICD's vectors, textbook twins and brute force."""

import itertools

import naive_message as naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from signals import fec

PART_BITS = 114


def noise_std(es_n0_db: float) -> float:
    """Standard deviation of the noise on +-1 symbols: N0 / 2 per dimension for Es = 1."""
    return float(np.sqrt(0.5 / 10 ** (es_n0_db / 10)))


def parts(rng: np.random.Generator, n: int) -> np.ndarray:
    return np.hstack((rng.integers(0, 2, (n, PART_BITS)), np.zeros((n, 6), int))).astype(np.uint8)


def test_crc_check_value_and_division() -> None:
    bits = np.unpackbits(np.frombuffer(b"123456789", np.uint8))
    assert fec.crc24q(bits) == 0xCDE703
    bits = np.random.default_rng(1).integers(0, 2, 196).astype(np.uint8)
    remainder = naive.crc24q(bits.tolist())
    assert fec.crc24q(bits) == naive.value(remainder)
    assert fec.crc24q(np.concatenate((bits, remainder))) == 0


def test_crc_sees_every_burst_up_to_24_bits() -> None:
    rng = np.random.default_rng(2)
    for _ in range(300):
        error = np.zeros(220, np.uint8)
        length = rng.integers(1, 25)
        start = rng.integers(0, 220 - length + 1)
        error[start : start + length] = rng.integers(0, 2, length)
        error[start] = 1
        assert fec.crc24q(error) != 0


def test_encoder_vectors() -> None:
    for pattern, last in (
        ("10000000", "1011101001001001"),
        ("00000100", "1110100100100101"),
        ("00101011", "0110110001001110"),
        ("00101111", "1101000000111110"),
    ):
        tail = "" if pattern == "10000000" else "000000"
        symbols = fec.convolve(np.array([int(b) for b in pattern + tail]))
        assert "".join(map(str, symbols[-16:])) == last


@given(st.lists(st.integers(0, 1), min_size=120, max_size=120))
@settings(max_examples=50, deadline=None)
def test_encoder_and_interleaver_equal_their_twins(bits: list[int]) -> None:
    symbols = fec.convolve(np.array(bits, np.uint8))
    assert symbols.tolist() == naive.convolve(bits)
    sent = fec.interleave(symbols)
    assert sent.tolist() == naive.interleave(symbols.tolist())
    assert np.array_equal(fec.deinterleave(sent), symbols)


def test_all_zero_part_is_alternating_rows() -> None:
    sent = fec.interleave(fec.convolve(np.zeros(120, np.uint8)))
    assert np.array_equal(sent, np.tile(np.repeat([0, 1], 30), 4))


def test_viterbi_is_maximum_likelihood() -> None:
    """Brute force over all 2^8 messages of a short block, at a noise that often favours another."""
    rng = np.random.default_rng(3)
    messages = [np.array((*m, 0, 0, 0, 0, 0, 0), np.uint8) for m in itertools.product((0, 1), repeat=8)]
    book = np.array([1.0 - 2.0 * fec.convolve(m) for m in messages])
    changed = 0
    for _ in range(200):
        sent = rng.integers(0, 256)
        soft = (book[sent] + noise_std(-6.0) * rng.standard_normal(28)).astype(np.float32)
        best = int(np.argmax(book @ soft))
        assert np.array_equal(fec.viterbi(soft), messages[best])
        changed += best != sent
    assert changed > 10


def test_viterbi_equals_the_twin_on_noisy_parts() -> None:
    """The same noise: every part equal, right or wrong."""
    rng = np.random.default_rng(4)
    sent = parts(rng, 400)
    soft = np.array([1.0 - 2.0 * fec.convolve(b) for b in sent])
    soft = (soft + noise_std(-3.0) * rng.standard_normal(soft.shape)).astype(np.float32)
    ours = np.array([fec.viterbi(s) for s in soft])
    twins = naive.viterbi(soft.astype(float))
    wrong = np.any(twins != sent, axis=1)
    assert 40 < wrong.sum() < 360
    assert np.array_equal(ours, twins)


@given(st.floats(1e-3, 1e3))
@settings(max_examples=20, deadline=None)
def test_viterbi_ignores_the_scale(scale: float) -> None:
    rng = np.random.default_rng(5)
    soft = rng.standard_normal(240).astype(np.float32)
    assert np.array_equal(fec.viterbi(soft), fec.viterbi((soft * np.float32(scale)).astype(np.float32)))


def test_erasures_and_polarity() -> None:
    """A fifth erased is mended; an inverted part decodes to the complement, wrong only at its ends."""
    rng = np.random.default_rng(6)
    sent = parts(rng, 1)[0]
    soft = (1.0 - 2.0 * fec.convolve(sent)).astype(np.float32)
    erased = soft.copy()
    erased[::5] = 0.0
    assert np.array_equal(fec.viterbi(erased), sent)
    inverted = fec.viterbi(-soft)
    assert np.array_equal(inverted[10:100], 1 - sent[10:100])
    disagreement = np.count_nonzero(np.sign(-soft) != 1.0 - 2.0 * fec.convolve(inverted))
    assert 0 < disagreement < 24


@pytest.mark.parametrize("es_n0_db", [-3.0, -1.5])
def test_part_error_rate_within_0_2_db(es_n0_db: float) -> None:
    """Error rate of our decoder between those of the twin's Monte Carlo 0.2 dB above and below, z = 5.

    Independent noise and messages; the variance of a difference of two rates is p (1 - p) (1/n + 1/m).
    """
    n_twin, n_ours = 16_000, 16_000

    def twin(at_db: float, seed: int) -> float:
        rng = np.random.default_rng(seed)
        wrong = 0
        for _ in range(n_twin // 1000):
            sent = parts(rng, 4)
            words = np.tile(
                np.array([1.0 - 2.0 * np.array(naive.convolve(b.tolist())) for b in sent]), (250, 1)
            )
            decoded = naive.viterbi(words + noise_std(at_db) * rng.standard_normal(words.shape))
            wrong += np.count_nonzero(np.any(decoded != np.tile(sent, (250, 1)), axis=1))
        return wrong / n_twin

    rng = np.random.default_rng(7)
    sent = parts(rng, 50)
    words = [(1.0 - 2.0 * fec.convolve(b)).astype(np.float32) for b in sent]
    wrong = 0
    for k in range(n_ours):
        soft = words[k % 50] + noise_std(es_n0_db) * rng.standard_normal(240, np.float32)
        wrong += not np.array_equal(fec.viterbi(soft), sent[k % 50])
    rate = wrong / n_ours
    low, high = twin(es_n0_db + 0.2, 8), twin(es_n0_db - 0.2, 9)
    slack = 5.0 * np.sqrt(max(high * (1 - high), 1e-4) * (1 / n_twin + 1 / n_ours))
    assert low - slack <= rate <= high + slack
