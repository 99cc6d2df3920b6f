"""The synthetic mission as an MCAP file, byte-identical for equal settings."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import cast

from google.protobuf.descriptor import Descriptor
from mcap.writer import CompressionType, IndexType, Writer

from messages.catalogue import CATALOGUE
from straitlink.schemas import file_descriptor_set
from straitlink.synthetic.frames import SPINDLE_RPM, STATIC_FRAMES
from straitlink.synthetic.perception import JPEG_QUALITY
from straitlink.synthetic.scene import build_scene
from straitlink.synthetic.settings import START_NS, SyntheticSettings, SyntheticSummary, TopicSummary
from straitlink.synthetic.stream import message_stream

GROUND_TRUTH_NAME = "ground_truth.json"
METADATA_NAME = "straitlink.synthetic"
_CHUNK_BYTES = 1 << 20
_LIBRARY = "straitlink synthetic 1"  # names no versions: they would change the bytes
_PROGRESS_STEP_NS = 250_000_000

OnProgress = Callable[[float], None]


def synthesize(
    path: Path, settings: SyntheticSettings, on_progress: OnProgress | None = None
) -> SyntheticSummary:
    """Write the mission to an MCAP file, streaming; log_time = publish_time = capture time.

    on_progress: called with the share done, 0..1, four times per second of the log.
    Raises OSError if the file cannot be written.
    """
    counts = {topic.key: [0, 0] for topic in CATALOGUE}
    report = on_progress or (lambda _: None)
    next_report_ns = START_NS
    with path.open("wb") as file:
        writer = Writer(
            file,
            chunk_size=_CHUNK_BYTES,
            compression=CompressionType.ZSTD,
            index_types=IndexType.ALL,
            use_chunking=True,
            enable_crcs=True,
        )
        channels = _open(writer, settings)
        for message in message_stream(settings):
            if message.capture_ns >= next_report_ns:
                report((message.capture_ns - START_NS) / settings.duration_ns)
                next_report_ns += _PROGRESS_STEP_NS
            writer.add_message(
                channels[message.key],
                log_time=message.capture_ns,
                data=message.payload,
                publish_time=message.capture_ns,
                sequence=message.sequence,
            )
            count = counts[message.key]
            count[0] += 1
            count[1] += len(message.payload)
        writer.finish()
    report(1.0)
    return _summary(path, settings, counts)


def ground_truth(settings: SyntheticSettings) -> dict[str, object]:
    """What the log's attachment says: the scene's boxes in `map`, and where the sensors are mounted."""
    return {
        "frame_id": "map",
        "boxes": [box.as_json() for box in build_scene(settings.seed)],
        "mounts": [
            {"parent_frame_id": parent, "child_frame_id": child, "parent_from_child": matrix.tolist()}
            for parent, child, matrix in STATIC_FRAMES
        ],
    }


def _open(writer: Writer, settings: SyntheticSettings) -> dict[str, int]:
    """Header, parameters, ground truth, and a channel for every topic: channel ids by key."""
    writer.start(profile="", library=_LIBRARY)
    parameters = {**asdict(settings), "spindle_rpm": SPINDLE_RPM, "jpeg_quality": JPEG_QUALITY}
    writer.add_metadata(METADATA_NAME, {name: str(value) for name, value in parameters.items()})
    writer.add_attachment(
        create_time=START_NS,
        log_time=START_NS,
        name=GROUND_TRUTH_NAME,
        media_type="application/json",
        data=json.dumps(ground_truth(settings), separators=(",", ":")).encode(),
    )
    schemas: dict[str, int] = {}
    channels: dict[str, int] = {}
    for topic in CATALOGUE:
        if topic.schema_name not in schemas:
            data = file_descriptor_set(cast(Descriptor, topic.message_type.DESCRIPTOR)).SerializeToString(
                deterministic=True
            )
            schemas[topic.schema_name] = writer.register_schema(topic.schema_name, "protobuf", data)
        channels[topic.key] = writer.register_channel(
            topic.mcap_topic, "protobuf", schemas[topic.schema_name]
        )
    return channels


def _summary(path: Path, settings: SyntheticSettings, counts: dict[str, list[int]]) -> SyntheticSummary:
    topics = tuple(TopicSummary(topic.key, topic.schema_name, *counts[topic.key]) for topic in CATALOGUE)
    return SyntheticSummary(
        path=path,
        duration_s=settings.duration_s,
        messages=sum(topic.messages for topic in topics),
        payload_bytes=sum(topic.payload_bytes for topic in topics),
        file_bytes=path.stat().st_size,
        topics=topics,
    )
