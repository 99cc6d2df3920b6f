"""A dictionary makes small payloads of a topic smaller, and no bytes make its decoder raise anything else."""

from __future__ import annotations

import contextlib

import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from messages.payload import Payload, PayloadError, digest_of
from messages.payload.dictionary import DictionaryEncoding

SAMPLES = [
    b'{"process": "walk_%d", "state": "RUNNING", "load": 0.%d}' % (i % 40, i * 7919 % 997)
    for i in range(2000)
]
TRAINED = zstandard.train_dictionary(2048, SAMPLES).as_bytes()
ENCODING = DictionaryEncoding(TRAINED)
LIMIT = 4096


def decoded(data: bytes, max_bytes: int = LIMIT) -> bytes:
    return ENCODING.decode(data, "application/json", max_bytes, None).data


@given(st.one_of(st.sampled_from(SAMPLES), st.binary(max_size=LIMIT)))
def test_every_payload_comes_back_and_costs_at_most_a_byte_more(data: bytes) -> None:
    encoded = ENCODING.encode(Payload(data, "application/json")).data
    assert decoded(encoded) == data
    assert len(encoded) <= len(data) + 1


def test_payloads_like_those_it_was_trained_on_shrink_to_less_than_half_of_plain_zstd() -> None:
    payload = b'{"process": "walk_11", "state": "RUNNING", "load": 0.5}'
    encoded = ENCODING.encode(Payload(payload, "application/json")).data
    assert len(encoded) < len(zstandard.compress(payload)) / 2


@given(st.binary(max_size=200).map(lambda tail: b"\1" + tail) | st.binary(max_size=50))
def test_any_bytes_are_read_or_refused(data: bytes) -> None:
    with contextlib.suppress(PayloadError):
        assert len(decoded(data)) <= LIMIT


@given(st.sampled_from(SAMPLES), st.integers(0, 60), st.integers(1, 255))
def test_a_damaged_message_is_read_or_refused(sample: bytes, place: int, flip: int) -> None:
    data = bytearray(ENCODING.encode(Payload(sample, "")).data)
    data[place % len(data)] ^= flip
    with contextlib.suppress(PayloadError):
        decoded(bytes(data))


def test_a_payload_that_would_grow_beyond_the_limit_is_refused_before_it_does() -> None:
    bomb = ENCODING.encode(Payload(bytes(50_000_000), "")).data
    with pytest.raises(PayloadError, match="50000000 bytes is beyond 4096"):
        decoded(bomb)


def test_two_dictionaries_have_two_digests() -> None:
    other = DictionaryEncoding(zstandard.train_dictionary(1024, SAMPLES).as_bytes())
    assert digest_of(ENCODING) == digest_of(DictionaryEncoding(TRAINED)) != digest_of(other)


def test_a_file_that_is_no_dictionary_is_refused() -> None:
    with pytest.raises(PayloadError, match="no trained zstd dictionary"):
        DictionaryEncoding(b"not a dictionary")
