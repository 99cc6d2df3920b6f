"""Overviews of camera topics on a host's bus: the newest picture, small, once a period."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import zenoh
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from google.protobuf.message import DecodeError

from messages.attachment import Stamp, decode_stamp
from perception_server.overview import Overview, ViewError, render_overview
from shaper.bus import BusSettings, open_bus

_FOXGLOVE_IMAGE = "application/protobuf;foxglove.CompressedImage"


@dataclass(frozen=True, slots=True)
class OverviewSettings:
    """sources: keys of foxglove.CompressedImage topics, such as robot/head_camera/image.

    The overview of A/B is published as A/overview, with the capture time of its picture.
    """

    bus: BusSettings
    sources: Sequence[str]
    overview: Overview = field(default_factory=Overview)
    period_s: float = 1.0
    stop: threading.Event = field(default_factory=threading.Event)


class _Source:
    """The newest picture of one topic; a picture is rendered once."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self.key = key
        self.refused = 0
        self._newest: zenoh.Sample | None = None
        self._sent = 0
        self._subscriber = session.declare_subscriber(key, self._take)
        folder = key.rpartition("/")[0]
        self._publisher = session.declare_publisher(
            f"{folder}/overview" if folder else "overview", encoding=zenoh.Encoding(_FOXGLOVE_IMAGE)
        )

    def _take(self, sample: zenoh.Sample) -> None:
        self._newest = sample

    def publish(self, overview: Overview) -> None:
        """Render and publish the newest picture, unless that has been done."""
        sample, self._newest = self._newest, None
        if sample is None:
            return
        image = CompressedImage()
        try:
            image.ParseFromString(sample.payload.to_bytes())
            image.data = render_overview(image.data, overview)
        except (DecodeError, ViewError):
            self.refused += 1
            return
        image.format = "jpeg"
        attachment = sample.attachment
        stamp = decode_stamp(attachment.to_bytes()) if attachment is not None else None
        capture_ns = stamp.capture_ns if stamp is not None else time.time_ns()
        self._publisher.put(image.SerializeToString(), attachment=Stamp(capture_ns, self._sent).encode())
        self._sent += 1


def publish_overviews(settings: OverviewSettings) -> dict[str, int]:
    """Run until settings.stop is set; returns, per source, how many pictures could not be read."""
    session = open_bus(settings.bus)
    try:
        sources = [_Source(session, key) for key in settings.sources]
        due_s = time.monotonic()
        while not settings.stop.wait(max(0.0, due_s - time.monotonic())):
            for source in sources:
                source.publish(settings.overview)
            due_s += settings.period_s
        return {source.key: source.refused for source in sources}
    finally:
        session.close()
