"""The perception server as a process: its configuration, a bus, the service, until it is stopped."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

import zenoh

from messages.proto.straitlink.view_pb2 import Image
from perception_server.dispatch import Reply
from perception_server.geometry_inputs import GeometryInputs, ScanTiming
from perception_server.image_file import base_as_compressed_image
from perception_server.readiness import Readiness
from perception_server.sensors import SensorHistory
from perception_server.service import PerceptionService, ServiceSettings
from perception_server.view_codec import DecodeError
from perception_server.warm_up import warm_up
from shaper.bus import BusError, BusSettings, open_bus
from straitlink.perception_config import PerceptionConfig

_log = logging.getLogger(__name__)
_BUS_RETRY_S = 1.0
_COMPILING = "warming up: compiling what draws and reads views, once on this machine"
_SLOW_S = 2.0  # to load compiled code takes less
_FOXGLOVE_IMAGE = "application/protobuf;foxglove.CompressedImage"


def serve_views(
    config: PerceptionConfig,
    stop: threading.Event,
    on_open: Callable[[], None] = lambda: None,
    say: Callable[[str], None] = lambda line: None,
) -> dict[str, int]:
    """Serve until `stop` is set; what was counted on the way. Raises BusError.

    Until what draws is compiled, pictures leave as plain JPEGs and requests for geometry are told to wait;
    say: called with a line when that is so, and when it is over.
    """
    sensors = SensorHistory(
        {each.key: each.name for each in config.inputs},
        config.limits,
        config.placement,
        GeometryInputs(ScanTiming(config.mirror_period_s), config.static_sources),
        {each.key: _encoding(each.type) for each in config.inputs if each.type},
        readiness := Readiness(pictures=False, geometry=False),
    )
    settings = ServiceSettings(
        inputs=[each.key for each in config.inputs],
        streams=config.streams,
        prefix=config.server.prefix,
        view_requests=config.server.view_requests,
        image_requests=config.server.image_requests,
        convert={key: as_foxglove for key in config.foxglove_keys},
    )
    session = open_when_there(config.bus, stop)
    if session is None:
        return {}
    try:
        service = PerceptionService(session, settings, sensors)
        on_open()
        warm_up_beside(readiness, say)
        stop.wait()
        service.close()
        if service.samples_dropped:
            sensors.counters["samples dropped: too many at once"] = service.samples_dropped
    finally:
        session.close()
    return {**sensors.counters, **sensors.history_counters}


def open_when_there(bus: BusSettings, stop: threading.Event) -> zenoh.Session | None:
    """The bus, waiting for one that we only connect to; None if asked to stop before. Raises BusError."""
    while not stop.is_set():
        try:
            return open_bus(bus)
        except BusError as error:
            if bus.listen:
                raise
            _log.warning("%s; trying again", error)
            stop.wait(_BUS_RETRY_S)
    return None


def warm_up_beside(
    readiness: Readiness | None = None, say: Callable[[str], None] = lambda line: None
) -> None:
    """Load or compile the kernels in a thread; say so if it takes long, and when they are ready."""
    known = readiness or Readiness()
    threading.Thread(target=_warm_up, args=(known, say), name="warm-up", daemon=True).start()


def _warm_up(readiness: Readiness, say: Callable[[str], None]) -> None:
    began_s = time.monotonic()
    slow = threading.Timer(
        _SLOW_S, say, ("warming up: compiling what draws and reads views, once on this machine",)
    )
    slow.daemon = True
    slow.start()
    try:
        warm_up(readiness)
    except Exception:  # whatever it is: requests must not be told to wait for what never comes
        _log.exception("views of geometry may be wrong or late")
    finally:
        slow.cancel()
        readiness.pictures = readiness.geometry = True
    say(f"ready after {time.monotonic() - began_s:.1f} s")


def _encoding(type_name: str) -> str:
    """As Zenoh has it: ROS 2's types have slashes."""
    return f"application/{'cdr' if '/' in type_name else 'protobuf'};{type_name}"


def as_foxglove(reply: Reply) -> tuple[bytes, str]:
    """An Image's base picture as foxglove.CompressedImage: what any viewer on the operator's bus shows."""
    if not isinstance(reply, Image):
        raise DecodeError("only an Image becomes a CompressedImage")
    return base_as_compressed_image(reply).SerializeToString(), _FOXGLOVE_IMAGE
