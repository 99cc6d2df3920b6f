"""A protobuf message as a table, by its wire format alone."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from messages.keyed_entries import REST, Entry, NotProtobufError, key_hash, split_entries

ITEMS, NAME, CPU, STATE = 2, 1, 3, 4


def varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes(out) + bytes([value])


def text(field: int, value: bytes) -> bytes:
    return varint(field << 3 | 2) + varint(len(value)) + value


def number(field: int, value: int) -> bytes:
    return varint(field << 3) + varint(value)


def item(name: bytes, cpu: int = 0, state: int = 0) -> bytes:
    return text(ITEMS, text(NAME, name) + number(CPU, cpu) + number(STATE, state))


def split(message: bytes) -> dict[int, Entry]:
    return split_entries(message, ITEMS, NAME, ignored={CPU}, ignored_outside={1})


def test_items_are_told_apart_by_their_keys_and_the_rest_stands_for_itself() -> None:
    message = number(1, 7) + item(b"a") + number(5, 9) + item(b"b")
    entries = split(message)
    assert {name: entry.raw for name, entry in entries.items()} == {
        REST: number(1, 7) + number(5, 9),
        key_hash(b"a"): item(b"a"),
        key_hash(b"b"): item(b"b"),
    }


def test_what_is_to_be_ignored_makes_no_difference_and_anything_else_does() -> None:
    def compared(message: bytes) -> dict[int, bytes]:
        return {name: entry.compared for name, entry in split(message).items()}

    before = compared(number(1, 7) + number(5, 9) + item(b"a", cpu=10, state=1))
    assert compared(number(1, 8) + number(5, 9) + item(b"a", cpu=99, state=1)) == before
    assert compared(number(1, 7) + number(5, 9) + item(b"a", cpu=10, state=2)) != before
    assert compared(number(1, 7) + number(5, 8) + item(b"a", cpu=10, state=1)) != before


@given(
    st.lists(st.tuples(st.binary(max_size=6), st.integers(0, 1 << 40), st.integers(0, 1 << 20)), max_size=12),
    st.lists(st.tuples(st.sampled_from([5, 6, 300]), st.integers(0, 1 << 60)), max_size=4),
)
def test_the_pieces_hold_the_whole_message_and_nothing_else(
    items: list[tuple[bytes, int, int]], others: list[tuple[int, int]]
) -> None:
    message = b"".join(number(f, v) for f, v in others) + b"".join(item(n, c, s) for n, c, s in items)
    entries = split(message)
    assert sum(len(entry.raw) for entry in entries.values()) == len(message)
    assert set(entries) == {REST} | {key_hash(name) for name, _, _ in items}
    again = split(b"".join(entry.raw for entry in entries.values()))
    assert again == entries


def test_items_of_one_name_stay_together_and_in_order() -> None:
    entries = split(item(b"a", state=1) + item(b"b") + item(b"a", state=2))
    assert entries[key_hash(b"a")].raw == item(b"a", state=1) + item(b"a", state=2)


def test_an_item_without_a_key_is_an_item_of_the_empty_key() -> None:
    assert key_hash(b"") in split(text(ITEMS, number(CPU, 1)))


def test_an_empty_message_has_nothing_but_its_rest() -> None:
    assert split(b"") == {REST: Entry(b"", b"")}


def test_all_wire_types_in_use_are_passed_over() -> None:
    fixed = varint(7 << 3 | 1) + bytes(8) + varint(8 << 3 | 5) + bytes(4)
    assert split(fixed + item(b"a"))[REST].raw == fixed


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (b"\x0b", "wire type 3"),
        (b"\x0c", "wire type 4"),
        (b"\x0a\x05ab", "past the end"),
        (b"\x09abc", "past the end"),
        (b"\x00\x01", "number 0"),
        (b"\x08" + b"\x80" * 10 + b"\x01", "does not end"),
        (b"\x08\x80", "does not end"),
        (text(ITEMS, b"\x0b"), "wire type 3"),
    ],
)
def test_what_is_no_protobuf_is_said(message: bytes, reason: str) -> None:
    with pytest.raises(NotProtobufError, match=reason):
        split(message)


@given(st.binary(max_size=60))
def test_any_bytes_split_or_raise_that_they_are_none(data: bytes) -> None:
    for message in (data, text(ITEMS, data), item(b"a") + data):
        with contextlib.suppress(NotProtobufError):
            entries = split(message)
            assert sum(len(entry.raw) for entry in entries.values()) == len(message)


@given(st.binary(max_size=20))
def test_no_key_is_taken_for_the_rest(key: bytes) -> None:
    assert 0 < key_hash(key) < 1 << 32
