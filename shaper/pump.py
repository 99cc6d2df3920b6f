"""What drivers do after every call: drain an endpoint, then wait."""

from __future__ import annotations

from collections.abc import Callable

from shaper.endpoint import Endpoint
from shaper.events import Event


def pump(
    endpoint: Endpoint,
    now_ns: int,
    send: Callable[[bytes], None],
    handle: Callable[[Event], None],
) -> int:
    """Send what may leave, hand over what has happened; returns when to call `on_timer` and again."""
    while (datagram := endpoint.next_datagram(now_ns)) is not None:
        send(datagram)
    while (event := endpoint.next_event()) is not None:
        handle(event)
    return endpoint.wakeup_at_ns(now_ns)
