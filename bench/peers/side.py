"""One end of a run, in its own network namespace: plays its direction of the load and notes what arrives.

Both ends are processes of one host, so their monotonic clocks are the same one and ages are exact.
"""

from __future__ import annotations

import argparse
import json
import os
import struct
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

from bench.peers.transport import Session, Side, Transport, peer_named
from straitlink.mission.load import LoadTopic, load_named_or_file

_HEAD = struct.Struct("<IQ")  # number, capture time in ns of the host's monotonic clock


@dataclass(slots=True)
class Notes:
    """offered: messages that the sources made, by topic.

    arrivals: (number, captured_ns, arrived_ns), by topic.
    """

    offered: dict[str, list[int]] = field(default_factory=dict)
    arrivals: dict[str, list[tuple[int, int, int]]] = field(default_factory=dict)
    blocked_s: float = 0.0

    def on_message(self, key: str, payload: bytes) -> None:
        """Something of the other side."""
        number, captured_ns = _HEAD.unpack_from(payload)
        self.arrivals.setdefault(key, []).append((number, captured_ns, time.monotonic_ns()))


def play(topic: LoadTopic, transport: Transport, notes: Notes, begin_ns: int, end_ns: int) -> None:
    """Publish a topic at its rate, each sample stamped with the instant at which it was due.

    While publish blocks, the sensor goes on: what fell due meanwhile counts as offered, and only the newest
    of it is published.
    """
    rate_hz = min(topic.rate_hz, topic.max_hz or topic.rate_hz)
    period_ns = round(1e9 / rate_hz)
    offered = notes.offered.setdefault(topic.key, [])
    filler = os.urandom(max(0, topic.payload_bytes - _HEAD.size))
    number = 0
    while True:
        due_ns = begin_ns + number * period_ns
        if due_ns >= end_ns:
            return
        offered.append(due_ns)
        now_ns = time.monotonic_ns()
        if due_ns > now_ns:
            time.sleep((due_ns - now_ns) / 1e9)
        if due_ns + period_ns > now_ns:
            before_ns = time.monotonic_ns()
            transport.publish(topic.key, _HEAD.pack(number, due_ns) + filler)
            notes.blocked_s += (time.monotonic_ns() - before_ns) / 1e9
        number += 1


def run(side: Side, peer: str, load_name: str, begin_ns: int, seconds: float, drain_s: float) -> Notes:
    """The whole of one side, from opening the stack to closing it."""
    load = load_named_or_file(load_name)
    direction = "down" if side == "robot" else "up"
    topics = [t for t in load.topics if t.direction == direction and t.traffic_class is not None]
    notes = Notes()
    transport = peer_named(peer).open(Session(side, load, notes.on_message))
    end_ns = begin_ns + round(seconds * 1e9)
    threads = [
        threading.Thread(target=play, args=(topic, transport, notes, begin_ns, end_ns), daemon=True)
        for topic in topics
    ]
    for thread in threads:
        thread.start()
    time.sleep(max(0.0, (end_ns - time.monotonic_ns()) / 1e9 + drain_s))
    transport.close()
    return notes


def main() -> None:
    """Called by bench.peers.run inside the namespace."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--side", choices=("robot", "operator"), required=True)
    parser.add_argument("--peer", required=True)
    parser.add_argument("--load", required=True)
    parser.add_argument("--begin-ns", type=int, required=True)
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--drain", type=float, required=True)
    parser.add_argument("--out", type=Path, required=True)
    a = parser.parse_args()
    notes = run(a.side, a.peer, a.load, a.begin_ns, a.seconds, a.drain)
    document = {"offered": notes.offered, "arrivals": notes.arrivals, "blocked_s": notes.blocked_s}
    a.out.write_text(json.dumps(document))
    sys.stdout.flush()
    os._exit(0)  # stacks whose threads do not end must not hold the next run up


if __name__ == "__main__":
    main()
