"""What the server knows and can show: the history behind the service's seam."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from messages.proto.straitlink.view_pb2 import VIEW_STATUS_REFUSED, ImageRequest
from perception_server.camera_inputs import decode_camera_message
from perception_server.dispatch import Reply, Request, empty_reply
from perception_server.errors import InputError, NoDataError, RequestError
from perception_server.history import History, HistoryLimits
from perception_server.image_answer import answer_image, frame_of
from perception_server.image_wish import image_wish
from perception_server.pictures import Calibration, CameraFrame

BACKWARDS_NS = 5_000_000_000  # stamps that fall back this far are of a log that has begun anew


def check_request(request: Request) -> None:
    """Raise RequestError for a request that cannot be, whatever the data."""
    if isinstance(request, ImageRequest):
        image_wish(request)


class SensorHistory:
    """Takes sensors' messages and answers requests from what they left; see service.Sensors.

    sources: by key, the name under which requests know a sensor. Times in the history are the messages'
    own; the bus's differ where a log is replayed, and a log that repeats empties the history each time it
    begins anew.
    """

    def __init__(self, sources: Mapping[str, str], limits: HistoryLimits | None = None) -> None:
        self.counters: Counter[str] = Counter()
        self._sources = sources
        self._limits = limits or HistoryLimits()
        self._history = History(self._limits)
        self._newest_ns = 0
        self._bus_minus_sensor_ns = 0

    def take(self, key: str, encoding: str, payload: bytes, capture_ns: int, now_ns: int) -> None:
        """A sensor's message; one that cannot be read is counted. capture_ns: by the bus's clock."""
        try:
            item = decode_camera_message(self._sources.get(key, key), encoding, payload)
        except InputError:
            self.counters[f"refused {key}"] += 1
            return
        if isinstance(item, Calibration):
            self._history.insert_calibration(item)
        elif isinstance(item, CameraFrame):
            self._follow(item.capture_ns, capture_ns)
            self._history.insert_image(item)

    def check(self, request: Request) -> None:
        """Raise RequestError for a request that cannot be, whatever the data."""
        check_request(request)

    def newest_ns(self, request: Request) -> int | None:
        """The capture time of the newest data that the request would show; None if there is none."""
        if not isinstance(request, ImageRequest):
            return None
        try:
            return frame_of(image_wish(request), self._history.snapshot()).capture_ns
        except (NoDataError, RequestError):
            return None

    def answer(self, request: Request, budget_bytes: int) -> tuple[Reply, int, int]:
        """The reply, and the capture time of its newest data by the sensor's and by the bus's clock."""
        history = self._history.snapshot()
        if not isinstance(request, ImageRequest):
            return empty_reply(request, VIEW_STATUS_REFUSED, "view: not served"), 0, 0
        reply = answer_image(request, history, budget_bytes)
        return reply, reply.frame_ns, reply.frame_ns + self._bus_minus_sensor_ns

    def _follow(self, stamp_ns: int, bus_ns: int) -> None:
        if stamp_ns < self._newest_ns - BACKWARDS_NS:
            self.counters["begun anew"] += 1
            self._history = History(self._limits)
            self._newest_ns = stamp_ns
        if stamp_ns >= self._newest_ns:
            self._newest_ns = stamp_ns
            self._bus_minus_sensor_ns = bus_ns - stamp_ns
