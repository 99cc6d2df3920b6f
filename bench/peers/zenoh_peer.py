"""eclipse-zenoh between the two sides: one TCP link, two by priority, or UDP. Configurations: config/*.json5.

Priorities, express and congestion control are set per publisher, as Zenoh's documentation has it.
"""

from __future__ import annotations

import time

import zenoh

from bench.peers.transport import CONFIG_FOLDER, Session, Side
from straitlink.mission.load import LoadTopic

_PRIORITY_OF_TIER = (
    zenoh.Priority.REAL_TIME,
    zenoh.Priority.INTERACTIVE_HIGH,
    zenoh.Priority.INTERACTIVE_LOW,
    zenoh.Priority.DATA_HIGH,
    zenoh.Priority.DATA,
    zenoh.Priority.DATA_LOW,
    zenoh.Priority.BACKGROUND,
)  # as Zenoh numbers them: 1 to 7
_SMALL_BYTES = 4096


class ZenohTransport:
    """A peer with explicit endpoints; publishers are declared once."""

    def __init__(self, config: zenoh.Config, session: Session) -> None:
        self._session = zenoh.open(config)
        self._publishers = {
            topic.key: self._declare(topic)
            for topic in session.load.topics
            if topic.key in session.keys(ours=True)
        }
        on_message = session.on_message
        self._subscribers = [
            self._session.declare_subscriber(
                key, lambda sample: on_message(str(sample.key_expr), sample.payload.to_bytes())
            )
            for key in session.keys(ours=False)
        ]

    def publish(self, key: str, payload: bytes) -> None:
        """put() of the topic's publisher."""
        self._publishers[key].put(payload)

    def close(self) -> None:
        """Close the session with its links."""
        self._session.close()

    def _declare(self, topic: LoadTopic) -> zenoh.Publisher:
        assert topic.traffic_class is not None, "keys() leaves local topics out"
        reliable = topic.traffic_class.reliable
        control = zenoh.CongestionControl.BLOCK if reliable else zenoh.CongestionControl.DROP
        return self._session.declare_publisher(
            topic.key,
            priority=_PRIORITY_OF_TIER[min(topic.traffic_class.tier, len(_PRIORITY_OF_TIER) - 1)],
            congestion_control=control,
            express=topic.payload_bytes < _SMALL_BYTES,
        )


def open_transport(name: str, session: Session) -> ZenohTransport:
    """The operator listens, the robot connects; tried until the other side is there."""
    config = zenoh.Config.from_file(str(_config_path(name, session.side)))
    deadline_s = time.monotonic() + 10
    while True:
        try:
            return ZenohTransport(config, session)
        except zenoh.ZError:
            if time.monotonic() > deadline_s:
                raise
            time.sleep(0.2)


def _config_path(name: str, side: Side) -> object:
    return CONFIG_FOLDER / f"{name}.{side}.json5"
