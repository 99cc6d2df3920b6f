"""A stranger's flood on loopback: does the heartbeat's age change?

    python -m bench.wire_flood [--rate 100000] [--seconds 10] [--json]

First the heartbeat alone, then with random datagrams to the robot's and the operator's shaper's ports.
On a machine with few processors the flood's own sending is part of the load.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import socket
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from bench.wire_rig import BEAT_KEY, WireRig
from messages.attachment import Stamp
from shaper.bus import open_bus

_HZ = 20
_BURST = 100


def _flood(address: str, rate_hz: int, seconds: float, sent: Any) -> None:
    """Random datagrams of 20 to 200 bytes, in bursts, at the rate or as fast as this process can."""
    host, _, port = address.rpartition(":")
    noise = os.urandom(1 << 16)
    target = host, int(port)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        started_s = time.monotonic()
        count = 0
        while (elapsed_s := time.monotonic() - started_s) < seconds:
            if count > elapsed_s * rate_hz:
                time.sleep(0.0005)
                continue
            for index in range(_BURST):
                at = (count + index) * 61 % 65_000
                stranger.sendto(noise[at : at + 20 + index], target)
            count += _BURST
    sent.value = count


def _beat(rig: WireRig, seconds: float) -> list[float]:
    """Ages (s) of the heartbeats of a while, as the operator's shaper measures them."""
    before = len(rig.records("operator"))
    session = open_bus(rig.bus("robot"))
    publisher = session.declare_publisher(BEAT_KEY)
    started_s = time.monotonic()
    for index in range(int(seconds * _HZ)):
        time.sleep(max(0.0, started_s + index / _HZ - time.monotonic()))
        publisher.put(bytes(64), attachment=Stamp(time.time_ns(), index).encode())
    time.sleep(1)
    session.close()
    records = [r for r in rig.records("operator")[before:] if r["event"] == "delivered"]
    return [r["age_ns"] / 1e9 for r in records if r["age_ns"] is not None]


def measure(rate_hz: int, seconds: float) -> dict[str, Any]:
    """Ages without and with the flood."""
    with tempfile.TemporaryDirectory() as folder, WireRig(Path(folder)) as rig:
        rig.start_all()
        time.sleep(3)
        calm = _beat(rig, seconds)
        sent = multiprocessing.Value("q", 0)
        attack = multiprocessing.Process(
            target=_flood, args=(rig.addresses.operator_shaper, rate_hz, seconds, sent)
        )
        attack.start()
        flooded = _beat(rig, seconds)
        attack.join()
    p95_calm, p95_flooded = (float(np.percentile(ages, 95)) for ages in (calm, flooded))
    return {
        "datagrams_per_s": round(sent.value / seconds),
        "heartbeats_calm": len(calm),
        "heartbeats_flooded": len(flooded),
        "age_p95_calm_s": round(p95_calm, 4),
        "age_p95_flooded_s": round(p95_flooded, 4),
        "ratio": round(p95_flooded / p95_calm, 3),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rate", type=int, default=100_000)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    result = measure(arguments.rate, arguments.seconds)
    if arguments.json:
        print(json.dumps(result, indent=1))
    else:
        for name, value in result.items():
            print(f"{name:24} {value}")


if __name__ == "__main__":
    main()
