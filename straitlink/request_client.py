"""A view requested from this host's bus, straight from the server or over the link."""

from __future__ import annotations

import queue
import random
import time
from collections.abc import Callable
from dataclasses import dataclass

import zenoh

from messages.attachment import Stamp
from messages.proto.straitlink.view_pb2 import VIEW_STATUS_ACCEPTED, ImageRequest
from perception_server.bus_messages import parse_reply
from perception_server.dispatch import Reply, Request
from perception_server.readiness import is_warming_up
from shaper.bus import BusSettings, open_bus

_DIRECT_S = 20.0  # a query that somebody answers is rendered by then
_WARMING_S = 5.0  # until a server that is still warming up is asked again
_AGAIN_S = 10.0  # a request over the link that was not answered is put once more


class RequestFailedError(Exception):
    """No view came; the message says why."""


@dataclass(frozen=True, slots=True)
class RequestSettings:
    """Where to ask. prefix: of the server's views. timeout_s: of the whole."""

    bus: BusSettings
    prefix: str = "robot/view"
    view_requests: str = "operator/view_request"
    image_requests: str = "operator/image_request"
    timeout_s: float = 60.0


def request_view(
    request: Request, settings: RequestSettings, say: Callable[[str], None] = lambda line: None
) -> tuple[Reply, float]:
    """The reply and how many seconds it took. Raises RequestFailedError, BusError.

    On the robot's bus the server answers a query; on the operator's there is none, and the request goes
    over the link as a message. A server that is still warming up is asked again until timeout_s.
    """
    request.capture_ns = time.time_ns()
    if not request.request_id:
        request.request_id = random.randrange(1, 1 << 16)
    session = open_bus(settings.bus)
    began_s = time.monotonic()
    try:
        while True:
            reply = _query(session, request) or _over_the_link(session, request, settings, say)
            took_s = time.monotonic() - began_s
            if not is_warming_up(reply) or took_s + _WARMING_S > settings.timeout_s:
                return reply, took_s
            say(reply.error)
            time.sleep(_WARMING_S)
    finally:
        session.close()


def _query(session: zenoh.Session, request: Request) -> Reply | None:
    """Ask a server on this very bus; None if there is none."""
    key = "perception/image" if isinstance(request, ImageRequest) else "perception/view"
    for reply in session.get(key, payload=request.SerializeToString(), timeout=_DIRECT_S):
        if reply.ok is not None:
            return parse_reply(str(reply.ok.encoding), reply.ok.payload.to_bytes())
        text = reply.err.payload.to_string() if reply.err is not None else ""
        raise RequestFailedError(f"the server says: {text or 'nothing'}")
    return None


def _over_the_link(
    session: zenoh.Session, request: Request, settings: RequestSettings, say: Callable[[str], None]
) -> Reply:
    """Publish the request and wait for the view that names it; ask again while none comes."""
    arrived: queue.SimpleQueue[Reply] = queue.SimpleQueue()

    def take(sample: zenoh.Sample) -> None:
        reply = parse_reply(str(sample.encoding), sample.payload.to_bytes())
        if reply is not None and reply.request_id == request.request_id:
            arrived.put(reply)

    subscriber = session.declare_subscriber(f"{settings.prefix}/requested", take)
    is_image = isinstance(request, ImageRequest)
    key = settings.image_requests if is_image else settings.view_requests
    deadline_s = time.monotonic() + settings.timeout_s
    try:
        sequence = 0
        while (left_s := deadline_s - time.monotonic()) > 0:
            stamp = Stamp(time.time_ns(), sequence)
            session.put(
                key, request.SerializeToString(), encoding=_encoding(request), attachment=stamp.encode()
            )
            say(f"request {request.request_id} is on its way over {key}" + (", again" if sequence else ""))
            sequence += 1
            try:
                while (reply := arrived.get(timeout=min(left_s, _AGAIN_S))).status == VIEW_STATUS_ACCEPTED:
                    say("accepted")
                return reply
            except queue.Empty:
                continue
    finally:
        subscriber.undeclare()
    raise RequestFailedError(
        f"no view came within {settings.timeout_s:g} s: is `straitlink perception` running on the robot, and "
        f"do the shapers carry {key} and {settings.prefix}/requested?"
    )


def _encoding(request: Request) -> str:
    return f"application/protobuf;{request.DESCRIPTOR.full_name}"
