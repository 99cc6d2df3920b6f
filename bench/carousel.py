"""What the carousel costs: sealed datagrams a second that one core sends, and receives."""

from __future__ import annotations

import argparse
import json
import random
import time

from shaper.carousel import Carousel, CarouselSettings, CarouselTopic
from shaper.carousel_receiver import CarouselReceiver
from shaper.carousel_seal import CarouselSeal
from shaper.carousel_wire import CLEAR
from shaper.frames import IP_UDP_BYTES
from shaper.incoming import Limits

_RATE_BPS = 285_000_000
_REPEATS = 5
_PICTURES, _PICTURE_BYTES = 50, 140_425


def measure(repeats: int = _REPEATS) -> dict[str, float]:
    """The best of some runs: microseconds for each datagram, and Mbit/s on the wire at 100 % of a core."""
    rng = random.Random(1)
    pictures = [rng.randbytes(_PICTURE_BYTES) for _ in range(_PICTURES)]
    best = [_once(pictures) for _ in range(repeats)]
    datagrams, wire_bits = best[0][2], best[0][3]
    send_s, receive_s = min(run[0] for run in best), min(run[1] for run in best)
    return {
        "datagrams": datagrams,
        "send_us": round(1e6 * send_s / datagrams, 2),
        "receive_us": round(1e6 * receive_s / datagrams, 2),
        "send_mbps": round(wire_bits / send_s / 1e6, 1),
        "receive_mbps": round(wire_bits / receive_s / 1e6, 1),
    }


def _once(pictures: list[bytes]) -> tuple[float, float, int, int]:
    """(seconds to send, seconds to receive, datagrams, bits on the wire) of one round."""
    secret = bytes(32)
    ours, theirs = CarouselSeal(secret), CarouselSeal(secret)
    settings = CarouselSettings((CarouselTopic("**"),), _RATE_BPS)
    carousel = Carousel(settings, 1, 0, protection_bytes=8)
    receiver = CarouselReceiver(Limits(), ("**",), {}, lambda stamp_us, now_ns: None)
    for number, picture in enumerate(pictures):
        assert carousel.offer(f"camera/{number}", picture, "image/jpeg", 0, 0, 0)
    sealed, now_ns = [], 0
    started_s = time.perf_counter()
    while carousel.counters.carousel_rounds == 0:
        body = carousel.next_datagram(now_ns)
        if body is None:
            now_ns = carousel.wakeup_at_ns(now_ns)
        else:
            sealed.append(ours.seal(body, 1, "robot"))
    sent_s = time.perf_counter()
    delivered = 0
    for datagram in sealed:
        opened = theirs.open(datagram, "robot")
        delivered += opened is not None and receiver.receive(opened, 0) is not None
    received_s = time.perf_counter()
    assert delivered == len(pictures), "every picture arrives"
    assert all(len(datagram) > CLEAR.size for datagram in sealed)
    bits = 8 * sum(len(datagram) + IP_UDP_BYTES for datagram in sealed)
    return sent_s - started_s, received_s - sent_s, len(sealed), bits


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    result = measure()
    if parser.parse_args().json:
        print(json.dumps(result, indent=1))
        return
    for way in ("send", "receive"):
        cost_us, mbps = result[f"{way}_us"], result[f"{way}_mbps"]
        print(f"{way:8} {cost_us:6.1f} us a datagram, {mbps:7.1f} Mbit/s on one core")


if __name__ == "__main__":
    main()
