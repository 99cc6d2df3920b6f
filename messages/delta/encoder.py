"""The sender of a state stream: each message against the newest one that the receiver is known to hold."""

from __future__ import annotations

from typing import Generic, TypeVar

from google.protobuf.message import Message as ProtobufMessage

from messages.dccl import Codec, Encoded
from messages.dccl.errors import EncodeError, told_of
from messages.dccl.limits import Deviations
from messages.delta.course import Expectation
from messages.delta.lanes import lanes_of
from messages.delta.layout import CHECK_BITS, check_of, encode_distance, encode_held, encode_leans
from messages.delta.leaning import Leaning, leanings
from messages.delta.sample import HISTORY, MAX_DISTANCE, WINDOW, References, Sample, make_sample
from messages.entropy import RangeEncoder

M = TypeVar("M", bound=ProtobufMessage)
_REFRESH = 256  # messages at most between two without reference, should the receiver fail unnoticed


class DeltaEncoder(Generic[M]):
    """Encodes a stream of messages of one type. No I/O, no clock, no memory beyond WINDOW messages.

    codec: what quantises the messages, and decides what happens to values out of range.
    check_bits: of the check, 0 to 24. It guards against a receiver that holds another message under a
    number than was sent (after a restart that nobody noticed), and fails to at most once in 2^check_bits;
    measured once in ten times as many, as the slack of the last byte is checked too.
    """

    def __init__(self, codec: Codec[M], *, check_bits: int = CHECK_BITS) -> None:
        if not 0 <= check_bits <= 24:
            raise EncodeError(f"check_bits = {check_bits} is not within 0 and 24")
        self._codec = codec
        self._lanes = lanes_of(codec)
        self._check_bits = check_bits
        self._sent: dict[int, Sample] = {}
        self._held: set[int] = set()  # of those, what the receiver has acknowledged
        self._alone = 0  # the last number that was coded without a reference
        self._refresh: int | None = None  # the last that was, although there was one
        self._root: int | None = None  # the last such that is acknowledged: nothing older is referred to

    def encode(self, message: M, number: int) -> bytes:
        """The message's bytes. number: the transport's own, rising, of this message and no other.

        A number may be coded again as long as no message with it has left. EncodeError as in Codec.
        """
        return self.encode_checked(message, number).data

    def encode_checked(self, message: M, number: int) -> Encoded:
        """The message's bytes, with a note of each value that was clamped or sent as unset."""
        self._codec.check(message)
        deviations = Deviations([])
        try:
            values = self._lanes.gather(message, deviations)
        except EncodeError as error:
            raise EncodeError(told_of(self._codec.schema.name, error)) from error
        known = self._references(number)
        data, leans = self._shortest(values, known)
        if known is not None and len(data) > self.max_size:
            known, leans, data = None, False, self._coded(values, None, None)
        if known is None:
            self._alone = number
            self._refresh = number if self._held else self._refresh
        self._remember(number, make_sample(number, values, known, leans))
        return Encoded(data, tuple(deviations.found))

    def on_acknowledged(self, number: int) -> None:
        """The receiver has decoded, or will decode before anything that is sent from now on, this message."""
        if number in self._sent:
            self._held.add(number)
            if number == self._refresh:
                self._root = number

    def reset(self) -> None:
        """The receiver has forgotten everything."""
        self._sent.clear()
        self._held.clear()
        self._refresh = self._root = None

    @property
    def max_size(self) -> int:
        """The most bytes that a message takes: those of one without reference."""
        size = 1
        for lane in self._lanes.lanes:
            size *= lane.count
        return (size.bit_length() + 8 + self._check_bits + 7) // 8

    def _shortest(self, values: list[int], known: References | None) -> tuple[bytes, bool]:
        """With lanes leaning on each other or without, whichever is shorter; and whether they lean."""
        alone = self._coded(values, known, None)
        found = leanings(self._lanes.lanes, known) if known is not None else {}
        if not found:
            return alone, False
        leaning = self._coded(values, known, found)
        return (leaning, True) if len(leaning) < len(alone) else (alone, False)

    def _coded(
        self, values: list[int], known: References | None, leaning: dict[int, Leaning] | None
    ) -> bytes:
        coder = RangeEncoder()
        if known is None:
            encode_distance(coder, 0)
            for value, lane in zip(values, self._lanes.lanes, strict=True):
                coder.encode_uniform(value, lane.count)
        else:
            encode_distance(coder, known.distance)
            gaps = {gap for gap, _ in known.history}
            encode_held(coder, [gap in gaps for gap in range(1, HISTORY + 1)])
            encode_leans(coder, leaning is not None, known.reference.leans)
            Expectation(self._lanes.lanes, known, leaning or {}).encode(coder, values)
        mask = (1 << self._check_bits) - 1
        coder.encode_uniform(check_of(self._codec.schema_hash, values) & mask, mask + 1)
        return coder.finish_bytes()

    def _references(self, number: int) -> References | None:
        held = self._held
        if self._root is not None:
            held = {n for n in held if self._sent[n].root >= self._root}
        near = [n for n in held if 0 < number - n <= MAX_DISTANCE]
        if not near or number - self._alone >= _REFRESH:
            return None
        newest = max(near)
        history = tuple(
            (gap, self._sent[newest - gap]) for gap in range(1, HISTORY + 1) if newest - gap in held
        )
        return References(number - newest, self._sent[newest], history)

    def _remember(self, number: int, sample: Sample) -> None:
        self._held.discard(number)
        self._sent[number] = sample
        for old in [n for n in self._sent if n <= number - WINDOW]:
            del self._sent[old]
            self._held.discard(old)
