"""A stranger's flood on loopback: does the heartbeat's age change?

    python -m bench.wire_flood [--rate 100000] [--seconds 10] [--initiations] [--json]

First the heartbeat alone; then with random datagrams to the operator's shaper's port, or with forged
initiations that name the link's key; then with the same flood beside it, to a port that nobody reads: what
its sending alone costs on a machine with few processors. cpu_of_a_core: of that shaper while it is flooded.
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

from bench.machine import keep
from bench.wire_rig import BEAT_KEY, WireRig
from messages.attachment import Stamp
from shaper.bus import open_bus
from shaper.handshake import INITIATION, INITIATION_BYTES
from shaper.key_file import read_key_file
from straitlink.demo.configs import KEY_FILE

_HZ = 20
_BURST = 100


def _flood(address: str, rate_hz: int, seconds: float, key_id: bytes, sent: Any) -> None:
    """Datagrams in bursts, at the rate or as fast as this process can.

    Random ones of 20 to 120 bytes, or initiations that name a key.
    """
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
                if key_id:
                    body = noise[at : at + INITIATION_BYTES - 1 - len(key_id)]
                    stranger.sendto(bytes([INITIATION]) + key_id + body, target)
                else:
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


def _flooded(
    rig: WireRig, address: str, rate_hz: int, seconds: float, key_id: bytes
) -> tuple[list[float], int]:
    """Ages while an address is flooded, and how many datagrams a second that was."""
    sent = multiprocessing.Value("q", 0)
    attack = multiprocessing.Process(target=_flood, args=(address, rate_hz, seconds, key_id, sent))
    attack.start()
    ages = _beat(rig, seconds)
    attack.join()
    return ages, round(sent.value / seconds)


def measure(rate_hz: int, seconds: float, *, initiations: bool) -> dict[str, Any]:
    """Ages without the flood, with it, and with it beside."""
    with tempfile.TemporaryDirectory() as folder, WireRig(Path(folder)) as rig:
        rig.start_all()
        time.sleep(3)
        key_id = read_key_file(Path(folder) / KEY_FILE).id if initiations else b""
        calm = _beat(rig, seconds)
        cpu_s = rig.cpu_s("operator")
        flooded, per_s = _flooded(rig, rig.addresses.operator_shaper, rate_hz, seconds, key_id)
        cpu_s = rig.cpu_s("operator") - cpu_s
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as nobody:
            nobody.bind(("127.0.0.1", 0))
            beside, _ = _flooded(rig, f"127.0.0.1:{nobody.getsockname()[1]}", rate_hz, seconds, key_id)
    p95_calm, p95_flooded, p95_beside = (float(np.percentile(ages, 95)) for ages in (calm, flooded, beside))
    return {
        "kind": "initiations" if initiations else "random",
        "cpu_of_a_core": round(cpu_s / (seconds + 1), 3),
        "datagrams_per_s": per_s,
        "heartbeats_calm": len(calm),
        "heartbeats_flooded": len(flooded),
        "age_p95_calm_s": round(p95_calm, 4),
        "age_p95_flooded_s": round(p95_flooded, 4),
        "age_p95_beside_s": round(p95_beside, 4),
        "ratio": round(p95_flooded / p95_calm, 3),
        "ratio_to_beside": round(p95_flooded / p95_beside, 3),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rate", type=int, default=100_000)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--initiations", action="store_true")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    result = measure(arguments.rate, arguments.seconds, initiations=arguments.initiations)
    document = keep("wire_flood_initiations" if arguments.initiations else "wire_flood", result)
    if arguments.json:
        print(json.dumps(document, indent=1))
    else:
        for name, value in result.items():
            print(f"{name:24} {value}")


if __name__ == "__main__":
    main()
