"""Two link ends, secured or open, joined by hand: what `pair` is to endpoints, with addresses and keys.

True time moves only by `advance`. A network is between the two that tests may look into and change.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from shaper.agreement import make_table
from shaper.endpoint import Endpoint
from shaper.endpoint_settings import EndpointSettings
from shaper.events import Delivered, Event, Receipt
from shaper.frames import IP_UDP_BYTES
from shaper.handshake import Identity, Side
from shaper.incoming import Limits
from shaper.journal import Journal, MemoryJournal
from shaper.link_end import LinkEnd, pump_link
from shaper.link_estimator import PresetBands
from shaper.link_key import LinkKey, make_link_key
from shaper.notices import Notice, NoticeKind
from shaper.operator_lost import OperatorLostSettings, OperatorWatch
from shaper.secure_channel import Address, SecureChannel
from shaper.table_exchange import TableExchange
from tests.shaper.pair import FAST, MS, RULES, UNIX_NS, S

KEY = make_link_key(random.Random(1).randbytes)
OTHER_KEY = make_link_key(random.Random(2).randbytes)
ADDRESSES: dict[Side, Address] = {"robot": ("10.0.0.1", 9001), "operator": ("10.0.0.2", 9002)}


@dataclass
class Host:
    """One host: its link end, clock, address, and all that it ever sent or was told."""

    side: Side
    keys: tuple[LinkKey, ...]
    offset_ns: int
    unix_offset_ns: int = 0
    address: Address = ("", 0)
    link: LinkEnd = field(init=False)
    sent: list[tuple[int, bytes, Address]] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    wakeup_ns: int = 0
    journal: Journal | None = None
    hands_over: bool = True  # else it is killed before the bus has what is delivered

    def handle(self, event: Event) -> None:
        self.events.append(event)
        if isinstance(event, Delivered) and event.on_handed_over is not None and self.hands_over:
            event.on_handed_over()

    @property
    def channel(self) -> SecureChannel:
        assert isinstance(self.link.channel, SecureChannel)
        return self.link.channel

    @property
    def payloads(self) -> list[bytes]:
        return [e.payload for e in self.events if isinstance(e, Delivered)]

    @property
    def receipts(self) -> list[Receipt]:
        return [e for e in self.events if isinstance(e, Receipt)]

    def notices(self, kind: NoticeKind) -> list[str]:
        return [e.text for e in self.events if isinstance(e, Notice) and e.kind is kind]


class SecuredPair:
    """A robot and an operator; datagrams take `delay_ns` unless `loses` says that they are lost."""

    def __init__(
        self,
        *,
        robot_keys: tuple[LinkKey, ...] = (KEY,),
        operator_keys: tuple[LinkKey, ...] = (KEY,),
        operator_unix_offset_ns: int = 0,
        operator_side: Side = "operator",
        delay_ns: int = 50 * MS,
        seed: int = 1,
        limits: Limits | None = None,
        journals: bool = False,
        operator_lost: OperatorLostSettings | None = None,
        tables: Mapping[Side, EndpointSettings] | None = None,
    ) -> None:
        self.now_ns = 0
        self.operator_lost = operator_lost
        self.tables = dict(tables or {})
        self.delay_ns = delay_ns
        self.limits = limits or Limits()
        self.rng = random.Random(seed)
        self.underway: list[tuple[int, bytes, Address, Address]] = []  # (arrival, data, from, to)
        self.loses: Callable[[bytes, Address], bool] = lambda data, to: False
        self.robot = Host("robot", robot_keys, 3 * S, address=ADDRESSES["robot"])
        self.operator = Host(
            operator_side, operator_keys, 7000 * S, operator_unix_offset_ns, address=ADDRESSES["operator"]
        )
        self.hosts = (self.robot, self.operator)
        if journals:
            for host in self.hosts:
                host.journal = MemoryJournal(self.rng.randbytes(8))
        for host in self.hosts:
            self.start(host)

    def start(self, host: Host) -> None:
        """Start a daemon, or start it anew after it was killed."""
        now_ns = self.now_ns + host.offset_ns
        unix_ns = UNIX_NS + self.now_ns + host.unix_offset_ns
        peer = self.other(host).address
        settings, exchange, table_hash = EndpointSettings(RULES, limits=self.limits), None, bytes(8)
        if host.side in self.tables:
            settings = self.tables[host.side]
            exchange = TableExchange(make_table(settings.rules, settings.accept, settings.encodings))
            table_hash = exchange.hash
        if host.journal is None:
            identity = Identity(self.rng.getrandbits(16), self.rng.randbytes(8), table_hash)
        else:
            identity = Identity(host.journal.begin_life(), host.journal.memory, table_hash)
        channel = SecureChannel(host.side, host.keys, identity, peer, self.rng.randbytes, now_ns, unix_ns)
        settings = replace(settings, protection_bytes=channel.overhead_bytes)
        estimator = PresetBands((FAST,), max_wire_bytes=settings.max_datagram_bytes + IP_UDP_BYTES)
        endpoint = Endpoint(settings, estimator, identity.epoch, now_ns, unix_ns, host.journal)
        lost = self.operator_lost if host is self.robot else None
        host.link = LinkEnd(
            endpoint, channel, None if lost is None else OperatorWatch(lost, now_ns), exchange
        )
        host.events.clear()
        host.wakeup_ns = self.now_ns

    def other(self, host: Host) -> Host:
        return self.operator if host is self.robot else self.robot

    def offer(self, host: Host, key: str, payload: bytes = b"x", tag: int = 0) -> None:
        now_ns = self.now_ns + host.offset_ns
        host.link.endpoint.offer(key, payload, now_ns, now_ns, tag=tag)
        self.pump(host)

    def pump(self, host: Host) -> None:
        def send(data: bytes, to: Address) -> None:
            host.sent.append((self.now_ns, data, to))
            if not self.loses(data, to):
                self.underway.append((self.now_ns + self.delay_ns, data, host.address, to))

        wakeup_ns = pump_link(host.link, self.now_ns + host.offset_ns, send, host.handle)
        host.wakeup_ns = wakeup_ns - host.offset_ns
        assert host.wakeup_ns > self.now_ns, "a drained link asks to be woken now: it would spin"

    def receive(self, host: Host, data: bytes, source: Address) -> None:
        host.link.receive(data, source, self.now_ns + host.offset_ns)
        self.pump(host)

    def advance(self, duration_ns: int) -> None:
        until_ns = self.now_ns + duration_ns
        while (next_ns := self.next_ns()) <= until_ns:
            self.now_ns = max(self.now_ns, next_ns)
            due = [item for item in self.underway if item[0] <= self.now_ns]
            self.underway = [item for item in self.underway if item[0] > self.now_ns]
            for _, data, source, to in due:
                for host in self.hosts:
                    if host.address == to:
                        self.receive(host, data, source)
            for host in self.hosts:
                if host.wakeup_ns <= self.now_ns:
                    host.link.on_timer(self.now_ns + host.offset_ns)
                    self.pump(host)
        self.now_ns = until_ns

    def next_ns(self) -> int:
        return min([item[0] for item in self.underway] + [host.wakeup_ns for host in self.hosts])
