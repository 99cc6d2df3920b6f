"""What payloads take on the bus and across the link, and what turning them costs.

    python -m bench.encodings [--log LOG.mcap] [--json]

Each topic of a log that a bounded message of the catalogue can say; joint states of any robot by a schema
with 12 bits for each joint. CPU time, best of several rounds over the same messages. Without --log: the
synthetic mission.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from mcap.reader import make_reader

from bench.machine import keep
from messages.bounded_catalogue import BOUNDED_CATALOGUE
from messages.dccl import load_proto, sendable_types
from messages.from_urdf import Detail, proto_of
from messages.payload import Payload, PayloadError
from messages.payload.bounded import BoundedEncoding, canonical
from messages.payload.joints import FORMS
from messages.payload.maps import maps_of
from messages.urdf import Joint, Robot
from straitlink.schemas import PayloadType, zenoh_encoding
from straitlink.synthetic.mission_log import synthesize
from straitlink.synthetic.settings import SyntheticSettings

ROUNDS = 5
MESSAGES = 200  # of a topic
MAX_BYTES = 1_000_000


@dataclass(frozen=True, slots=True)
class EncodingFigures:
    """One topic; times of one core for one message."""

    topic: str
    message: str
    bus_bytes: float
    link_bytes: float
    encode_us: float
    decode_us: float


def measure(topic: str, encoding: BoundedEncoding, payloads: Sequence[Payload]) -> EncodingFigures:
    """Sizes and times of one topic. Raises PayloadError where the encoding cannot carry it."""
    encoded = [encoding.encode(payload).data for payload in payloads]
    bus_type = payloads[0].type
    return EncodingFigures(
        topic,
        encoding.codec.schema.name,
        round(sum(len(payload.data) for payload in payloads) / len(payloads), 1),
        round(sum(map(len, encoded)) / len(encoded), 1),
        _best_us(lambda: [encoding.encode(payload) for payload in payloads]) / len(payloads),
        _best_us(lambda: [encoding.decode(data, bus_type, MAX_BYTES, 1) for data in encoded]) / len(payloads),
    )


def _best_us(work: Callable[[], object]) -> float:
    times_ns = []
    for _ in range(ROUNDS):
        began_ns = time.process_time_ns()
        work()
        times_ns.append(time.process_time_ns() - began_ns)
    return min(times_ns) / 1000


def payloads_of(log: Path) -> dict[str, list[Payload]]:
    """The first messages of each topic."""
    payloads: dict[str, list[Payload]] = {}
    with log.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            name = "" if schema is None else schema.name
            bus_type = zenoh_encoding(PayloadType(channel.message_encoding, name))
            several = payloads.setdefault(channel.topic, [])
            if len(several) < MESSAGES:
                several.append(Payload(message.data, bus_type))
    return payloads


def candidates(payloads: Sequence[Payload]) -> list[BoundedEncoding]:
    """Encodings that may carry a topic: those of the catalogue, then one made for its joints."""
    bus_type = canonical(payloads[0].type)
    found = []
    for message in BOUNDED_CATALOGUE:
        maps = maps_of(message.message_type)
        if bus_type in {m.bus_type for m in maps} | {f"application/protobuf;{message.name}"}:
            found.append(BoundedEncoding(message.message_type, maps))
    if bus_type in FORMS:
        found.append(_for_joints(FORMS[bus_type][0](payloads[0].data).names))
    return found


def _for_joints(names: Sequence[str]) -> BoundedEncoding:
    robot = Robot("robot", tuple(Joint(name, "revolute", -3.15, 3.15) for name in names))
    with TemporaryDirectory() as folder:
        path = Path(folder) / "robot.proto"
        path.write_text(proto_of(robot, Detail(bits=12), "the log"))
        (message_type,) = sendable_types(load_proto(path)).values()
    return BoundedEncoding(message_type, maps_of(message_type))


def run(log: Path) -> list[EncodingFigures]:
    """The figures of every topic that something can carry."""
    figures = []
    for topic, payloads in sorted(payloads_of(log).items()):
        for encoding in candidates(payloads):
            try:
                figures.append(measure(topic, encoding, payloads))
            except PayloadError:
                continue
            break
    return figures


def main() -> None:
    """Print the figures and keep them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--log", type=Path)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    with TemporaryDirectory() as folder:
        log = arguments.log
        if log is None:
            log = Path(folder) / "mission.mcap"
            synthesize(log, SyntheticSettings(6.0, 1, light=True))
        figures = run(log)
    document = keep("encodings", {"topics": [asdict(row) for row in figures]})
    if arguments.json:
        print(json.dumps(document, indent=1))
        return
    print(f"{'topic':32}{'as':38}{'bus B':>8}{'link B':>8}{'encode us':>11}{'decode us':>11}")
    for row in figures:
        print(
            f"{row.topic:32}{row.message:38}{row.bus_bytes:8.0f}{row.link_bytes:8.0f}"
            f"{row.encode_us:11.0f}{row.decode_us:11.0f}"
        )


if __name__ == "__main__":
    main()
