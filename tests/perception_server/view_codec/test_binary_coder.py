"""The binary range coder and the tables and contexts that feed it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perception_server.view_codec.binary_coder import (
    check_end,
    code_bit,
    decoder,
    encoded_bytes,
    encoder,
)
from perception_server.view_codec.context_mixing import (
    FRESH,
    MOST_LOGIT,
    NAT,
    RATE,
    SQUASH,
    STRETCH,
    learned,
    logit_of,
)
from perception_server.view_codec.errors import DecodeError

DECISIONS = st.lists(st.tuples(st.integers(0, 1), st.integers(1, 65535)), max_size=300)


def written(decisions: list[tuple[int, int]]) -> bytes:
    coder, data = encoder(3 * len(decisions) + 8)
    for bit, p in decisions:
        code_bit(coder, data, bit, p)
    return encoded_bytes(coder, data)


@given(DECISIONS)
def test_bits_come_back_at_any_probabilities(decisions: list[tuple[int, int]]) -> None:
    coder, data = decoder(written(decisions))
    assert [code_bit(coder, data, 0, p) for _, p in decisions] == [bit for bit, _ in decisions]
    check_end(coder, data)


@given(st.binary(max_size=40), st.lists(st.integers(1, 65535), max_size=200))
def test_any_bytes_read_as_bits(stream: bytes, probabilities: list[int]) -> None:
    coder, data = decoder(stream)
    assert {code_bit(coder, data, 0, p) for p in probabilities} <= {0, 1}


def test_bytes_after_the_stream_are_refused() -> None:
    decisions = [(1, 40_000), (0, 9_000)] * 40
    coder, data = decoder(written(decisions) + b"tail")
    for _, p in decisions:
        code_bit(coder, data, 0, p)
    with pytest.raises(DecodeError, match="bytes follow"):
        check_end(coder, data)


def test_a_cut_stream_is_refused() -> None:
    decisions = [(1, 40_000), (0, 9_000)] * 80
    stream = written(decisions)
    coder, data = decoder(stream[: len(stream) // 2])
    for _, p in decisions:
        code_bit(coder, data, 0, p)
    with pytest.raises(DecodeError, match="is cut"):
        check_end(coder, data)


def test_a_buffer_too_small_is_found_at_the_end() -> None:
    coder, data = encoder(2)
    for _ in range(40):
        code_bit(coder, data, 1, 1 << 15)
    with pytest.raises(OverflowError, match="does not fit"):
        encoded_bytes(coder, data)


def test_a_stream_costs_its_entropy() -> None:
    bits = (np.random.default_rng(1).random(20_000) < 0.1).astype(int)
    p = round(0.1 * 65536)
    ideal_bits = sum(-math.log2(p / 65536 if bit else 1 - p / 65536) for bit in bits)
    assert 8 * len(written([(int(bit), p) for bit in bits])) < ideal_bits * 1.0002 + 16


def test_the_tables_are_the_logistic_function_and_its_inverse() -> None:
    exact = [65536 / (1 + math.exp(-i / NAT)) for i in range(-MOST_LOGIT, MOST_LOGIT + 1)]
    assert max(abs(a - b) for a, b in zip(exact, np.asarray(SQUASH), strict=True)) <= 0.5001
    p = (np.arange(4096) + 0.5) / 4096
    assert np.abs(np.log(p / (1 - p)) * NAT - np.asarray(STRETCH)).max() < 2.0


def test_a_context_learns_the_share_of_ones() -> None:
    slot = FRESH
    for i in range(200):
        slot = learned(RATE, slot, int(i % 4 == 0), 255)
    assert logit_of(STRETCH, slot) == pytest.approx(math.log(0.25 / 0.75) * NAT, abs=12)
