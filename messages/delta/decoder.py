"""The receiver of a state stream: any message decodes whose references have come, whatever else was lost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from google.protobuf.message import Message as ProtobufMessage

from messages.dccl import Codec, DecodeError
from messages.delta.course import Expectation
from messages.delta.lanes import lanes_of
from messages.delta.layout import CHECK_BITS, check_of, decode_distance, decode_held, decode_leans
from messages.delta.leaning import leanings
from messages.delta.sample import WINDOW, References, Sample, make_sample
from messages.entropy import RangeDecoder

M = TypeVar("M", bound=ProtobufMessage)
_KEPT = 2 * WINDOW  # messages; twice, since what comes late pushes out what came early


@dataclass(slots=True)
class DeltaCounters:
    """What was decoded, and what was dropped and why."""

    decoded: int = 0
    reference_missing: int = 0
    mismatched: int = 0


class DeltaDecoder(Generic[M]):
    """Decodes the messages of one DeltaEncoder; codec and check_bits as there.

    It never returns another message than was sent, but for one in 2^check_bits of those whose references
    are not what the sender takes them for; these and messages without their references are dropped.
    """

    def __init__(self, codec: Codec[M], *, check_bits: int = CHECK_BITS) -> None:
        self.counters = DeltaCounters()
        self._codec = codec
        self._lanes = lanes_of(codec)
        self._check_bits = check_bits
        self._max_bytes = sum(lane.count.bit_length() + 40 for lane in self._lanes.lanes) // 8 + 16
        self._samples: dict[int, Sample] = {}

    def decode(self, data: bytes, number: int, now_ns: int | None = None) -> M:
        """The message that was sent with this number; DecodeError, and a count, if it cannot be known.

        now_ns: the receiver's Unix time, for messages with times.
        """
        if len(data) > self._max_bytes:
            self.counters.mismatched += 1
            raise DecodeError(f"{len(data)} bytes are more than any {self._codec.schema.name}")
        coder = RangeDecoder(int.from_bytes(data, "big"), 8 * len(data))
        distance = decode_distance(coder)
        known, leans = None, False
        if distance == 0:
            lanes = self._lanes.lanes
            values = [min(lane.count - 1, coder.decode_uniform(lane.count)) for lane in lanes]
        else:
            known = self._references(coder, number, distance)
            leans = decode_leans(coder, known.reference.leans)
            found = leanings(self._lanes.lanes, known) if leans else {}
            values = Expectation(self._lanes.lanes, known, found).decode(coder)
        mask = (1 << self._check_bits) - 1
        check = check_of(self._codec.schema_hash, values) & mask
        if coder.decode_uniform(mask + 1) != check or not coder.is_finished(len(data)):
            self.counters.mismatched += 1
            raise DecodeError(
                f"{self._codec.schema.name} {number}: its check does not agree with its content"
            )
        try:
            message = self._lanes.scatter(values, now_ns)
        except (ValueError, OverflowError) as error:
            raise DecodeError(f"{self._codec.schema.name} {number}: {error}") from error
        self._remember(number, make_sample(number, values, known, leans))
        self.counters.decoded += 1
        return message  # type: ignore[return-value]

    def reset(self) -> None:
        """The sender has started anew: what it numbers has nothing to do with what is held."""
        self._samples.clear()

    def _references(self, coder: RangeDecoder, number: int, distance: int) -> References:
        held = [gap for gap, is_held in enumerate(decode_held(coder), 1) if is_held]
        newest = number - distance
        missing = [n for n in (newest, *(newest - gap for gap in held)) if n not in self._samples]
        if missing:
            self.counters.reference_missing += 1
            raise DecodeError(f"{self._codec.schema.name} {number} needs {missing[0]}, which is not here")
        history = tuple((gap, self._samples[newest - gap]) for gap in held)
        return References(distance, self._samples[newest], history)

    def _remember(self, number: int, sample: Sample) -> None:
        self._samples.pop(number, None)
        self._samples[number] = sample
        if len(self._samples) > _KEPT:
            del self._samples[next(iter(self._samples))]
