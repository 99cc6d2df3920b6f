import pytest
from hypothesis import given
from hypothesis import strategies as st

from shaper.errors import DecodeError
from shaper.varint import MAX_BYTES, MAX_VALUE, append_varint, read_varint, varint_bytes


@given(st.integers(0, MAX_VALUE), st.binary(max_size=3), st.binary(max_size=3))
def test_a_value_comes_back_with_the_offset_after_it(value: int, before: bytes, after: bytes) -> None:
    out = bytearray(before)
    append_varint(out, value)
    end = len(out)

    assert read_varint(bytes(out) + after, len(before)) == (value, end)
    assert end - len(before) == varint_bytes(value)


@pytest.mark.parametrize(
    ("value", "encoded"), [(0, "00"), (127, "7f"), (128, "8001"), (300, "ac02"), (MAX_VALUE, "ff" * 5 + "7f")]
)
def test_seven_bits_a_byte_least_significant_first(value: int, encoded: str) -> None:
    out = bytearray()
    append_varint(out, value)
    assert out.hex() == encoded


@given(st.binary(max_size=10), st.integers(0, 12))
def test_any_bytes_are_a_value_or_a_decode_error(data: bytes, at: int) -> None:
    try:
        value, end = read_varint(data, at)
    except DecodeError:
        return
    assert 0 <= value <= MAX_VALUE
    assert at < end <= min(len(data), at + MAX_BYTES)


@pytest.mark.parametrize("data", [b"", b"\x80", b"\xff" * MAX_BYTES, b"\xff" * MAX_BYTES + b"\x00"])
def test_a_value_that_does_not_end_is_refused(data: bytes) -> None:
    with pytest.raises(DecodeError, match="does not end"):
        read_varint(data, 0)


@pytest.mark.parametrize("value", [-1, MAX_VALUE + 1])
def test_a_value_out_of_range_is_our_mistake(value: int) -> None:
    with pytest.raises(AssertionError, match="outside"):
        append_varint(bytearray(), value)
