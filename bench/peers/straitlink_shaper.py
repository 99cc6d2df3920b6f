"""straitlink: each side's Zenoh bus is this process, its shaper a daemon beside it; one configuration."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import tomlkit
import zenoh

from bench.peers.transport import Session
from messages.attachment import Stamp
from shaper.bus import BusSettings, open_bus
from shaper.key_file import write_key_file
from shaper.link_key import LinkKey

_BUS = "tcp/127.0.0.1:7447"
_PORT = 9001
_KEY_FILE = "link.key"
_KEY = LinkKey(b"peer", b"known to all who read this bench")  # both sides run in our own namespaces


class StraitlinkShaper:
    """publish is a put on the local bus."""

    def __init__(self, session: Session) -> None:
        self._bus = open_bus(BusSettings(listen=[_BUS]))
        on_message = session.on_message
        self._subscribers = [
            self._bus.declare_subscriber(
                key, lambda sample: on_message(str(sample.key_expr), sample.payload.to_bytes())
            )
            for key in session.keys(ours=False)
        ]
        self._publishers: dict[str, zenoh.Publisher] = {
            key: self._bus.declare_publisher(key) for key in session.keys(ours=True)
        }
        self._counts = dict.fromkeys(self._publishers, 0)
        self._folder = tempfile.TemporaryDirectory()
        path = Path(self._folder.name) / "shaper.toml"
        path.write_text(config(session))
        write_key_file(path.parent / _KEY_FILE, _KEY)
        self._daemon = subprocess.Popen([sys.executable, "-m", "straitlink", "shaper", str(path)])

    def publish(self, key: str, payload: bytes) -> None:
        """put() of the topic's publisher, with the capture time as an attachment."""
        stamp = Stamp(time.time_ns(), self._counts[key])
        self._counts[key] += 1
        self._publishers[key].put(payload, attachment=stamp.encode())

    def close(self) -> None:
        """End the daemon and the bus."""
        self._daemon.terminate()
        self._daemon.wait(10)
        self._bus.close()
        self._folder.cleanup()


def config(session: Session) -> str:
    """The shaper's: what the load says of each topic, and the two addresses; nothing of the link."""
    rows = [
        {"key": t.key, "class": t.traffic_class.name}
        for t in session.load.topics
        if t.traffic_class is not None and t.key in session.keys(ours=True)
    ]
    document = {
        "link": {
            "side": session.side,
            "listen": f"{session.address}:{_PORT}",
            "peer": f"{session.peer_address}:{_PORT}",
            "accept": session.keys(ours=False),
            "keys": [_KEY_FILE],
            "estimator": "adaptive",
        },
        "zenoh": {"connect": [_BUS]},
        "topics": rows,
    }
    return tomlkit.dumps(document)


def open_transport(_name: str, session: Session) -> StraitlinkShaper:
    """Both sides alike."""
    return StraitlinkShaper(session)
