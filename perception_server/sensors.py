"""What the server knows and can show: the history behind the service's seam."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import TypeAlias

from messages.proto.straitlink.view_pb2 import ImageRequest
from perception_server.answer import answer, newest_data_ns
from perception_server.camera_inputs import decode_camera_message
from perception_server.dispatch import Reply, Request
from perception_server.errors import InputError, NoDataError, RequestError
from perception_server.frames import StampedTransform
from perception_server.geometry_inputs import GeometryInputs
from perception_server.history import History, HistoryLimits
from perception_server.image_answer import answer_image, frame_of
from perception_server.image_wish import image_wish
from perception_server.pictures import Calibration, CameraFrame, Disparity
from perception_server.readiness import Readiness
from perception_server.scan_geometry import RawCloud, RawScan, ScanPlacement
from perception_server.view_wish import view_wish

_Item: TypeAlias = list[StampedTransform] | RawScan | RawCloud | Disparity | Calibration | CameraFrame

BACKWARDS_NS = 5_000_000_000  # stamps that fall back this far are of a log that has begun anew


def check_request(request: Request) -> None:
    """Raise RequestError for a request that cannot be, whatever the data."""
    if isinstance(request, ImageRequest):
        image_wish(request)
    else:
        view_wish(request)


class SensorHistory:
    """Takes sensors' messages and answers requests from what they left; see service.Sensors.

    sources: by key, the name under which requests know a sensor. Times in the history are the messages'
    own; the bus's differ where a log is replayed, and a log that repeats empties the history each time it
    begins anew. encodings: by key, of publishers that do not say theirs. readiness: what can be drawn so
    far; all, if left out.
    """

    def __init__(
        self,
        sources: Mapping[str, str],
        limits: HistoryLimits | None = None,
        placement: ScanPlacement | None = None,
        inputs: GeometryInputs | None = None,
        encodings: Mapping[str, str] | None = None,
        readiness: Readiness | None = None,
    ) -> None:
        self.counters: Counter[str] = Counter()
        self._sources = sources
        self._encodings = encodings or {}
        self._readiness = readiness or Readiness()
        self._limits = limits or HistoryLimits()
        self._placement = placement or ScanPlacement()
        self._inputs = inputs or GeometryInputs()
        self._history = History(self._limits, self._placement)
        self._newest_ns = 0
        self._bus_minus_sensor_ns = 0

    def take(self, key: str, encoding: str, payload: bytes, capture_ns: int, now_ns: int) -> None:
        """A sensor's message; one that cannot be read is counted. capture_ns: by the bus's clock."""
        source = self._sources.get(key, key)
        encoding = self._encodings.get(key, encoding)
        try:
            geometry = self._inputs.decode(source, encoding, payload)
            item = geometry if geometry is not None else decode_camera_message(source, encoding, payload)
        except InputError:
            self.counters[f"refused {key}"] += 1
            return
        self._insert(item, capture_ns, now_ns)

    def _insert(self, item: _Item, capture_ns: int, now_ns: int) -> None:
        if isinstance(item, list):
            moving = [transform.stamp_ns for transform in item if not transform.is_static]
            if moving:
                self._follow(max(moving), capture_ns)
            self._history.insert_transforms(item, now_ns)
        elif isinstance(item, RawScan | RawCloud):
            self._follow(item.end_ns, capture_ns)
            if isinstance(item, RawScan):
                self._history.insert_scan(item, now_ns)
            else:
                self._history.insert_cloud(item, now_ns)
        elif isinstance(item, Calibration):
            self._history.insert_calibration(item)
        else:
            self._follow(item.capture_ns, capture_ns)
            if isinstance(item, Disparity):
                self._history.insert_disparity(item)
            else:
                self._history.insert_image(item)

    @property
    def history_counters(self) -> dict[str, int]:
        """What the history could not keep, by reason, since it was last begun; reasons that occurred."""
        counted = self._history.counters
        found = {
            "scans without a pose": counted.without_pose,
            "scans beyond those that may wait": counted.overflowed,
            "transforms refused": counted.transforms_refused,
        }
        return {reason: count for reason, count in found.items() if count}

    def check(self, request: Request) -> None:
        """Raise RequestError for a request that cannot be, whatever the data."""
        check_request(request)

    def newest_ns(self, request: Request) -> int | None:
        """The capture time of the newest data that the request would show; None if there is none."""
        try:
            history = self._history.snapshot()
            if isinstance(request, ImageRequest):
                return frame_of(image_wish(request), history).capture_ns
            return newest_data_ns(view_wish(request), history)
        except (NoDataError, RequestError):
            return None

    def answer(self, request: Request, budget_bytes: int) -> tuple[Reply, int, int]:
        """The reply, and the capture time of its newest data by the sensor's and by the bus's clock."""
        history = self._history.snapshot()
        if isinstance(request, ImageRequest):
            image = answer_image(self._readiness.for_now(request), history, budget_bytes)
            return image, image.frame_ns, image.frame_ns + self._bus_minus_sensor_ns
        view = self._readiness.geometry_not_yet(request) or answer(request, history, budget_bytes)
        return view, view.newest_ns, view.newest_ns + self._bus_minus_sensor_ns

    def _follow(self, stamp_ns: int, bus_ns: int) -> None:
        if stamp_ns < self._newest_ns - BACKWARDS_NS:
            self.counters["begun anew"] += 1
            self._history = History(self._limits, self._placement)
            self._newest_ns = stamp_ns
        if stamp_ns >= self._newest_ns:
            self._newest_ns = stamp_ns
            self._bus_minus_sensor_ns = bus_ns - stamp_ns
