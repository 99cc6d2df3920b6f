"""Generated schemas, generated values, any bytes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from google.protobuf.message import Message
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st

from messages.dccl import Codec, DecodeError, EncodeError
from messages.dccl.numeric import to_float32
from tests.messages.dccl.declare import Declared, declare

NOW_NS = 1_700_000_000_000_000_000
INTEGERS = (
    "int32",
    "int64",
    "uint32",
    "uint64",
    "sint32",
    "sint64",
    "fixed32",
    "fixed64",
    "sfixed32",
    "sfixed64",
)
LABELS = ("required", "optional", "repeated")
# Shrinking such schemas takes minutes and the first example says enough.
PROFILE = settings(
    deadline=None,
    max_examples=100,
    derandomize=True,
    report_multiple_bugs=False,
    phases=[Phase.explicit, Phase.generate],
)


def labelled(draw: st.DrawFn, declared: Declared, version: int, labels: Sequence[str]) -> Declared:
    declared.label = draw(st.sampled_from(labels))
    if declared.label == "repeated":
        declared.options["max_repeat"] = draw(st.sampled_from([1, 3, 8, 70]))
        if version >= 3:
            declared.options["min_repeat"] = draw(st.integers(0, 1))
    return declared


@st.composite
def numbers(draw: st.DrawFn, name: str) -> Declared:
    type_name = draw(st.sampled_from(("double", "float", *INTEGERS)))
    if type_name in INTEGERS:
        low = draw(st.integers(0, 1000)) * (1 if "u" in type_name or type_name.startswith("fixed") else -1)
        return Declared(name, type_name, options={"min": low, "max": low + draw(st.integers(0, 2**30))})
    precision = draw(st.integers(-3, 6 if type_name == "double" else 3))
    step = 10.0**-precision
    start, count = draw(st.integers(-5000, 5000)), draw(st.integers(0, 20000))
    # The decimal that somebody would write, not the product of two doubles.
    low, high = (float(f"{index}e{-precision}") for index in (start, start + count))
    bounds: dict[str, Any] = {"min": low, "max": high}
    if draw(st.booleans()):
        return Declared(name, type_name, options={**bounds, "precision": precision})
    return Declared(name, type_name, options={**bounds, "resolution": step})


@st.composite
def fields(draw: st.DrawFn, name: str, version: int, depth: int, labels: Sequence[str]) -> Declared:
    kinds = ["number"] * 4 + ["bool", "enum", "string", "bytes", "time"] + (["message"] if depth else [])
    kind = draw(st.sampled_from(kinds))
    if kind == "number":
        declared = draw(numbers(name))
    elif kind == "bool":
        declared = Declared(name, "bool")
    elif kind == "enum":
        values = draw(st.lists(st.integers(-5, 300), min_size=1, max_size=6, unique=True))
        declared = Declared(name, "enum", enum=[(f"V{i}", v) for i, v in enumerate(values)])
        if version >= 3:
            declared.options["packed_enum"] = draw(st.booleans())
    elif kind == "time":
        declared = Declared(
            name, "double", options={"codec": "dccl.time", "precision": draw(st.integers(0, 3))}
        )
    elif kind == "message":
        inner_labels = LABELS if version >= 3 else ("optional", "repeated")
        inner = draw(st.lists(st.integers(), min_size=1, max_size=3))
        declared = Declared(
            name,
            "message",
            message=[draw(fields(f"f{i}", version, depth - 1, inner_labels)) for i in range(len(inner))],
        )
    else:
        declared = Declared(name, kind, options={"max_length": draw(st.integers(1, 12))})
    return labelled(draw, declared, version, labels)


@st.composite
def schemas(draw: st.DrawFn) -> tuple[list[Declared], dict[str, Any]]:
    version = draw(st.sampled_from([2, 3, 4]))
    count = draw(st.integers(1, 7))
    declared = [draw(fields(f"f{i}", version, 2, LABELS)) for i in range(count)]
    if version == 4 and draw(st.booleans()):
        for i in range(2):
            member = draw(fields(f"o{i}", version, 1, ["optional"]))
            member.oneof = "choice"
            declared.append(member)
    options: dict[str, Any] = {"version": version, "max_bytes": 100_000}
    options["id"] = draw(st.sampled_from([0, 127, 128, 32767]))
    if version >= 3 and draw(st.booleans()):
        options["codec_group"] = "dccl.presence"
    return declared, options


def value_of(draw: st.DrawFn, declared: Declared) -> Any:
    options = declared.options
    if options.get("codec") == "dccl.time":
        return 1_700_000_000 + draw(st.integers(-40_000_000, 40_000_000)) / 1000
    if declared.type_name == "bool":
        return draw(st.booleans())
    if declared.type_name == "enum":
        return draw(st.sampled_from([value for _, value in declared.enum]))
    if declared.type_name == "string":
        text = draw(st.text(st.characters(codec="ascii"), max_size=options["max_length"]))
        return text
    if declared.type_name == "bytes":
        # Versions 2 and 3 fill up with zeros, so only full ones come back as they were.
        return draw(st.binary(min_size=options["max_length"], max_size=options["max_length"]))
    if declared.type_name in INTEGERS:
        return draw(st.integers(options["min"], options["max"]))
    low, high = options["min"], options["max"]
    if declared.type_name == "double":
        return draw(st.floats(low, high))
    return to_float32(draw(st.floats(low, high)))


def resolution_of(declared: Declared) -> float:
    if "precision" in declared.options:
        return float(10.0 ** -declared.options["precision"])
    return float(declared.options.get("resolution", 1.0))


def fill(draw: st.DrawFn, message: Message, declared_fields: Sequence[Declared]) -> None:
    chosen = draw(st.sampled_from(["", "o0", "o1"]))
    for declared in declared_fields:
        is_set = declared.label == "required" or declared.name == chosen or not declared.oneof
        if not is_set or (declared.label == "optional" and not declared.oneof and draw(st.booleans())):
            continue
        if declared.label == "repeated":
            high = declared.options["max_repeat"]
            count = draw(st.integers(declared.options.get("min_repeat", 0), high))
            elements = getattr(message, declared.name)
            for _ in range(count):
                if declared.type_name == "message":
                    fill(draw, elements.add(), declared.message)
                else:
                    elements.append(value_of(draw, declared))
        elif declared.type_name == "message":
            getattr(message, declared.name).SetInParent()
            fill(draw, getattr(message, declared.name), declared.message)
        else:
            setattr(message, declared.name, value_of(draw, declared))


@st.composite
def messages(draw: st.DrawFn) -> tuple[list[Declared], int, Codec[Message], Message]:
    declared, options = draw(schemas())
    codec: Codec[Message] = Codec(declare(*declared, **options))
    message = codec.message_type()
    fill(draw, message, declared)
    return declared, options["version"], codec, message


def seen(message: Message, declared_fields: Sequence[Declared], version: int) -> dict[str, Any]:
    """What of a message the format can carry: version 2 does not know empty from absent."""
    contents: dict[str, Any] = {}
    for declared in declared_fields:
        value = getattr(message, declared.name)
        if declared.label != "repeated" and not message.HasField(declared.name):
            continue
        values = list(value) if declared.label == "repeated" else [value]
        if declared.type_name == "message":
            values = [seen(v, declared.message, version) for v in values]
            values = [v for v in values if v or version > 2]
        if declared.type_name == "string" and version < 4:
            values = [v for v in values if v]
        if declared.label == "repeated" or values:
            contents[declared.name] = values if declared.label == "repeated" else values[0]
    return {k: v for k, v in contents.items() if v != [] or version > 2}


def assert_near(got: Any, sent: Any, declared: Declared) -> None:
    if declared.label == "repeated":
        assert len(got) == len(sent), declared.name
        pairs = list(zip(got, sent, strict=True))
    else:
        pairs = [(got, sent)]
    for ours, theirs in pairs:
        if declared.type_name == "message":
            assert ours.keys() == theirs.keys()
            for inner in declared.message:
                if inner.name in theirs:
                    assert_near(ours[inner.name], theirs[inner.name], inner)
        elif declared.type_name in ("double", "float"):
            slack = 1e-9 * max(1.0, abs(theirs)) if declared.type_name == "double" else 2e-7 * abs(theirs)
            assert math.isclose(ours, theirs, rel_tol=0, abs_tol=resolution_of(declared) * 0.5001 + slack)
        else:
            assert ours == theirs, declared.name


@given(messages())
@PROFILE
def test_a_message_comes_back_within_half_a_resolution(
    generated: tuple[list[Declared], int, Codec[Message], Message],
) -> None:
    declared, version, codec, message = generated
    data = codec.encode(message)
    assert codec.info().min_bytes <= len(data) <= codec.info().max_bytes
    assert codec.min_size <= len(data) <= codec.max_size
    back = codec.decode(data, NOW_NS)
    got, sent = seen(back, declared, version), seen(message, declared, version)
    assert got.keys() == sent.keys()
    for each in declared:
        if each.name in sent:
            assert_near(got[each.name], sent[each.name], each)


@given(messages(), st.binary(max_size=8))
@PROFILE
def test_a_message_ends_where_it_ends_whatever_follows(
    generated: tuple[list[Declared], int, Codec[Message], Message], tail: bytes
) -> None:
    _, _, codec, message = generated
    data = codec.encode(message)
    back, size = codec.decode_prefix(data + tail, NOW_NS)
    assert size == len(data)
    assert back == codec.decode(data, NOW_NS)


def wild_value(draw: st.DrawFn, declared: Declared) -> Any:
    if declared.type_name == "double":
        return draw(st.floats())
    if declared.type_name == "float":
        return draw(st.floats(width=32))
    if declared.type_name in INTEGERS:
        bits = 32 if "32" in declared.type_name else 64
        is_unsigned = declared.type_name.startswith(("u", "fixed"))
        return draw(
            st.integers(0, 2**bits - 1)
            if is_unsigned
            else st.integers(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        )
    if declared.type_name in ("string", "bytes"):
        return draw(st.text(max_size=20) if declared.type_name == "string" else st.binary(max_size=20))
    return value_of(draw, declared)


@given(schemas(), st.sampled_from(["dccl", "clamp"]), st.data())
@PROFILE
def test_a_lenient_codec_encodes_any_value_and_notes_what_it_changed(
    schema: tuple[list[Declared], dict[str, Any]], treatment: Any, data: st.DataObject
) -> None:
    declared, options = schema
    declared = [d for d in declared if d.type_name != "message" and not d.oneof]
    codec: Codec[Message] = Codec(declare(*declared, **options), strict=False, out_of_range=treatment)

    @st.composite
    def wild(draw: st.DrawFn) -> Message:
        message = codec.message_type()
        for each in declared:
            if each.label == "repeated":
                getattr(message, each.name).extend(
                    [wild_value(draw, each) for _ in range(draw(st.integers(0, 4)))]
                )
            elif each.label == "required" or draw(st.booleans()):
                setattr(message, each.name, wild_value(draw, each))
        return message

    message = data.draw(wild())
    try:
        encoded = codec.encode_checked(message)
    except EncodeError as error:
        assert treatment == "clamp" and "not a number" in str(error)
        return
    assert codec.info().min_bytes <= len(encoded.data) <= codec.info().max_bytes
    back = codec.decode(encoded.data, NOW_NS)
    if encoded.deviations or options["version"] < 4:
        return
    for each in declared:
        if each.label == "required" and each.type_name not in ("double", "float"):
            assert getattr(back, each.name) == getattr(message, each.name)


@given(messages(), st.data())
@PROFILE
def test_a_message_cut_short_is_refused(
    generated: tuple[list[Declared], int, Codec[Message], Message], data: st.DataObject
) -> None:
    _, _, codec, message = generated
    whole = codec.encode(message)
    cut = whole[: data.draw(st.integers(0, len(whole) - 1))]
    try:
        codec.decode(cut, NOW_NS)
    except DecodeError:
        return
    raise AssertionError(f"{len(cut)} of {len(whole)} bytes passed for a message")


@given(schemas(), st.binary(max_size=200), st.integers(0, 2**62))
@example(([Declared("t", "uint64", options={"codec": "dccl.time"})], {"version": 4}), b"\x0a\xff\xff\x00", 0)
@PROFILE
def test_any_bytes_are_a_message_or_a_decode_error(
    schema: tuple[list[Declared], dict[str, Any]], data: bytes, now_ns: int
) -> None:
    declared, options = schema
    codec: Codec[Message] = Codec(declare(*declared, **options), strict=False)
    head = codec.schema.id_wire.to_bytes(codec.schema.id_bits // 8, "little")
    for attempt in (data, head + data):
        try:
            message, size = codec.decode_prefix(attempt, now_ns)
        except DecodeError:
            continue
        assert size <= len(attempt)
        assert isinstance(message, codec.message_type)
