"""A value that does not fit is refused, clamped or dropped, as the codec was told; never unnoticed."""

from __future__ import annotations

import math
from typing import Any

import pytest
from google.protobuf.message import Message

from messages.dccl import Codec, DecodeError, EncodeError
from tests.messages.dccl.declare import Declared, declare, number

T = declare(
    number("need", -1, 1, precision=2),
    number("may", -1, 1, label="optional", precision=2),
    number("count", 0, 5, "int32", label="optional"),
    number("arm", -1, 1, "float", label="repeated", precision=2, max_repeat=4),
    Declared("name", "string", "optional", {"max_length": 3}),
)


def message(**fields: Any) -> Message:
    return T(**{"need": 0.0, **fields})


@pytest.mark.parametrize("value", [1.02, -1.02, math.inf, -math.inf, math.nan])
@pytest.mark.parametrize(("field", "path"), [("need", "need"), ("may", "may"), ("arm", "arm[1]")])
def test_a_strict_codec_names_message_field_value_and_bound(field: str, path: str, value: float) -> None:
    sent = message(**{field: [0.5, value] if field == "arm" else value})
    with pytest.raises(EncodeError) as error:
        Codec(T).encode(sent)
    assert str(error.value).startswith("test.T: ")
    assert path in str(error.value)
    assert f"{value:.1f}"[:3] in str(error.value)
    assert "-1 to 1" in str(error.value)


def test_clamping_goes_to_the_nearest_bound_and_says_so() -> None:
    codec = Codec(T, out_of_range="clamp")
    encoded = codec.encode_checked(message(need=7, may=-math.inf, count=9, arm=[0.5, -2, 3]))
    back: Any = codec.decode(encoded.data)
    assert (back.need, back.may, back.count) == (1, -1, 5)
    assert list(back.arm) == [0.5, -1, 1]
    assert [d.path for d in encoded.deviations] == ["need", "may", "count", "arm[1]", "arm[2]"]
    assert {d.what for d in encoded.deviations} == {"clamped to its nearest bound"}


@pytest.mark.parametrize("sent", [message(need=math.nan), message(may=math.nan), message(arm=[math.nan])])
def test_nan_has_no_nearest_bound(sent: Message) -> None:
    with pytest.raises(EncodeError, match="not a number"):
        Codec(T, out_of_range="clamp").encode(sent)


def test_the_library_s_silent_zero_is_counted() -> None:
    codec = Codec(T, strict=False)
    encoded = codec.encode_checked(message(need=7, may=2, arm=[0.5, math.nan, 3]))
    back: Any = codec.decode(encoded.data)
    assert back.need == -1
    assert not back.HasField("may")
    assert list(back.arm) == [0.5, -1, -1]
    assert [(d.path, d.what) for d in encoded.deviations] == [
        ("need", "sent as the minimum"),
        ("may", "sent as unset"),
        ("arm[1]", "sent as the minimum"),
        ("arm[2]", "sent as the minimum"),
    ]


def test_the_treatment_is_a_matter_of_each_field() -> None:
    codec = Codec(T, out_of_range={"may": "dccl", "arm": "clamp"})
    encoded = codec.encode_checked(message(may=2, arm=[2]))
    assert [d.path for d in encoded.deviations] == ["may", "arm[0]"]
    with pytest.raises(EncodeError, match="need"):
        codec.encode(message(need=2))


def test_what_fits_is_sent_without_a_note() -> None:
    assert Codec(T, strict=False).encode_checked(message(need=1, may=-1, arm=[1, -1])).deviations == ()


def test_a_value_within_the_bounds_is_not_refused_for_the_bound_s_own_rounding() -> None:
    # 0.05f is above 0.05, so that DCCL calls its own maximum out of range (its issue 149).
    tight = declare(number("f", 0, 0.05, "float", precision=2), number("d", -180, 180, precision=9))
    codec = Codec(tight)
    back: Any = codec.decode(codec.encode(tight(f=0.05, d=-180)))
    assert back.f == pytest.approx(0.05)
    assert back.d == pytest.approx(-180)


def test_long_strings_and_lists_are_refused_or_cut() -> None:
    sent = message(name="a\u00e9\u00e9", arm=[0] * 5)
    with pytest.raises(EncodeError, match="arm has 5 elements; its bounds are 0 to 4"):
        Codec(T).encode(sent)
    encoded = Codec(T, strict=False).encode_checked(sent)
    back: Any = Codec(T).decode(encoded.data)
    assert len(back.arm) == 4
    assert back.name == "a\u00e9"
    assert [d.path for d in encoded.deviations] == ["arm", "name"]


def test_a_character_that_was_cut_in_the_middle_is_left_out() -> None:
    encoded = Codec(T, strict=False).encode_checked(message(name="aa\u00e9"))
    back: Any = Codec(T).decode(encoded.data)
    assert back.name == "aa"


def test_bytes_that_are_no_text_are_refused() -> None:
    text = declare(Declared("name", "string", options={"max_length": 3}))
    codec = Codec(text)
    data = bytearray(codec.encode(text(name="abc")))
    data[2] |= 0x02  # the highest bit of "a": id in 8 bits, length in 2, then the text
    with pytest.raises(DecodeError, match="name: its 3 bytes are not UTF-8"):
        codec.decode(bytes(data))


def test_a_missing_required_field_is_named() -> None:
    with pytest.raises(EncodeError, match=r"test.T misses required fields: need"):
        Codec(T).encode(T())


def test_a_message_of_another_class_is_refused() -> None:
    with pytest.raises(EncodeError, match=r"test\.T is not a message of the class that this codec has"):
        Codec(T).encode(declare(number("need", -1, 1))(need=0))


def test_a_wire_integer_beyond_the_bounds_is_refused() -> None:
    codec = Codec(declare(number("x", 0, 5, "int32")))
    assert [codec.decode(bytes([10, x])).x for x in range(6)] == [0, 1, 2, 3, 4, 5]  # type: ignore[attr-defined]
    with pytest.raises(DecodeError, match="x: 7 on the wire is beyond its bounds 0 to 5"):
        codec.decode(b"\x0a\x07")


def test_what_follows_a_message_is_refused_only_by_a_strict_codec() -> None:
    plain = declare(number("x", 0, 5, "int32"))
    with pytest.raises(DecodeError, match="2 bytes follow the 2 of"):
        Codec(plain).decode(b"\x0a\x03\x0a\x04")
    assert Codec(plain, strict=False).decode(b"\x0a\x03\x0a\x04").x == 3  # type: ignore[attr-defined]


def test_another_message_s_id_is_refused() -> None:
    with pytest.raises(DecodeError, match="the first bytes are not the id"):
        Codec(declare(number("x", 0, 5, "int32"))).decode(b"\x0c\x03")
