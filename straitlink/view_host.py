"""The operator's side of views as a process: what comes over the link, for any viewer on this bus."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field

import zenoh

from perception_server.decoded import ViewDecoder
from shaper.bus import BusSettings
from straitlink.perception_host import open_when_there, warm_up_beside


@dataclass(frozen=True, slots=True)
class ViewHostSettings:
    """prefix: of the keys that views come on. What KEY shows is published as TO/KEY/image, grid or cloud."""

    bus: BusSettings
    prefix: str = "robot/view"
    to: str = "decoded"
    stop: threading.Event = field(default_factory=threading.Event)


def show_views(
    settings: ViewHostSettings,
    on_open: Callable[[], None] = lambda: None,
    say: Callable[[str], None] = lambda line: None,
) -> dict[str, int]:
    """Decode until `stop` is set; what was counted. Raises BusError.

    say: called with a line if what decodes must be compiled first, and when it is ready.

    Zenoh calls back in one thread per subscriber, so views are decoded one after the other. Each message
    keeps its attachment: the capture time on the robot.
    """
    decoder = ViewDecoder()
    session = open_when_there(settings.bus, settings.stop)
    if session is None:
        return {}

    def take(sample: zenoh.Sample) -> None:
        for shown in decoder.take(str(sample.encoding), sample.payload.to_bytes()):
            session.put(
                f"{settings.to}/{sample.key_expr}/{shown.what}",
                shown.payload,
                encoding=shown.encoding,
                attachment=sample.attachment,
            )

    try:
        subscriber = session.declare_subscriber(f"{settings.prefix}/**", take)
        on_open()
        warm_up_beside(say=say)
        settings.stop.wait()
        subscriber.undeclare()
    finally:
        session.close()
    return {"could not be decoded": decoder.refused, "chips of another time": decoder.others}
