"""The carousel on a UDP socket of its own: the robot sends at a fixed rate, the operator only listens."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict

from shaper.address import is_loopback
from shaper.bus import BusSample
from shaper.carousel import Carousel
from shaper.carousel_config import CarouselConfig
from shaper.carousel_receiver import CarouselReceiver
from shaper.carousel_wire import LIFE_BITS
from shaper.config import ShaperConfig
from shaper.events import Delivered
from shaper.ledger import SentLedger
from shaper.link_end import LinkEnd
from shaper.udp import Datagrams, UdpLink

_BATCH = 32  # datagrams that leave before the loop looks at the two-way link: some 1 ms
_UNREADY_S = 0.05  # until keys are agreed
_LONGEST_SLEEP_S = 60.0
_NS_PER_S = 1_000_000_000


class CarouselLink:
    """This side's half of a link without a way back, if the configuration has one; else it does nothing.

    link: the two-way link, whose session seals. on_delivered: takes each message that comes, once.
    """

    def __init__(
        self, config: ShaperConfig, link: LinkEnd, on_delivered: Callable[[Delivered], None]
    ) -> None:
        self.sender: Carousel | None = None
        self.receiver: CarouselReceiver | None = None
        self._channel = link.channel
        self._on_delivered = on_delivered
        self._loop = asyncio.get_running_loop()
        self._next: asyncio.Handle | None = None
        self._socket = contextlib.ExitStack()
        self._udp: UdpLink | None = None
        carousel, endpoint = config.carousel, link.endpoint
        if carousel is None:
            return
        if carousel.settings is not None:
            life, now_ns = secrets.randbits(LIFE_BITS), time.monotonic_ns()
            self.sender = Carousel(carousel.settings, life, now_ns, link.channel.overhead_bytes)
            return

        def age_of(stamp_us: int, now_ns: int) -> int | None:
            return None if endpoint.peer_clock is None else endpoint.peer_clock.age_ns(stamp_us, now_ns)

        limits, accept = config.endpoint.limits, config.endpoint.accept
        self.receiver = CarouselReceiver(limits, accept, endpoint.received_ledgers, age_of)

    async def open(self, config: CarouselConfig | None) -> None:
        """Open the socket. Raises UdpError."""
        if config is None:
            return
        host = config.address[0]
        anywhere = "::" if ":" in host else "127.0.0.1" if is_loopback(host) else "0.0.0.0"
        listen = config.address if self.sender is None else (anywhere, 0)
        self._udp = await UdpLink.open(listen, config.address, self._on_datagrams)
        self._socket.callback(self._udp.close)

    def close(self) -> None:
        """Send and hear nothing more."""
        if self._next is not None:
            self._next.cancel()
        self._socket.close()

    @property
    def key_expressions(self) -> list[str]:
        """What is to be subscribed to on the local bus."""
        return [] if self.sender is None else [topic.key_expression for topic in self.sender.topics]

    def is_latest(self, key: str) -> bool | None:
        """Whether only the newest sample of a key counts; None if the key does not go round."""
        topic = None if self.sender is None else self.sender.topic_of(key)
        return None if topic is None else topic.latest

    def offer(self, sample: BusSample, capture_ns: int, unix_minus_monotonic_ns: int) -> bool:
        """A local publisher has a message; whether it is the carousel's."""
        if self.sender is None or self.sender.topic_of(sample.key) is None:
            return False
        payload, unix_ns = sample.payload.to_bytes(), capture_ns + unix_minus_monotonic_ns
        now_ns = time.monotonic_ns()
        if sample.missed:
            self.sender.missed(sample.key, sample.missed)
        if self.sender.offer(sample.key, payload, sample.encoding, capture_ns, unix_ns, now_ns):
            if self._next is not None:
                self._next.cancel()
            self._next = self._loop.call_soon(self._send, self.sender)
        return True

    @property
    def sent_ledgers(self) -> Mapping[str, SentLedger]:
        """Counters of the topics that go round, by key."""
        return {} if self.sender is None else self.sender.ledgers

    def counters_dict(self) -> dict[str, int]:
        """Datagrams, and drops that belong to no topic."""
        sent = {} if self.sender is None else asdict(self.sender.counters)
        return sent if self.receiver is None else asdict(self.receiver.counters)

    def _send(self, carousel: Carousel) -> None:
        """What may leave now, a batch at a time: the two-way link must not wait."""
        if not self._channel.ready:
            self._next = self._loop.call_later(_UNREADY_S, self._send, carousel)
            return
        assert self._udp is not None, "nothing is offered before the socket is open"
        for _ in range(_BATCH):
            body = carousel.next_datagram(time.monotonic_ns())
            if body is None:
                break
            sealed = self._channel.seal_carousel(body)
            assert sealed is not None, "a channel that is ready seals"
            self._udp.send(sealed, self._udp.peer)
        at_s = carousel.wakeup_at_ns(time.monotonic_ns()) / _NS_PER_S
        self._next = self._loop.call_at(min(at_s, self._loop.time() + _LONGEST_SLEEP_S), self._send, carousel)

    def _on_datagrams(self, datagrams: Datagrams) -> None:
        if self.receiver is None:  # nothing is expected to come back
            return
        for data, _source, received_ns in datagrams:
            body = self._channel.open_carousel(data)
            delivered = None if body is None else self.receiver.receive(body, received_ns)
            if delivered is not None:
                self._on_delivered(delivered)
