"""One side of a chaos mission: a process that may die, a bus, a clock and an address that may change."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable

from shaper.endpoint import Endpoint
from shaper.endpoint_settings import EndpointSettings
from shaper.estimation.adaptive import AdaptiveEstimator
from shaper.events import Delivered, Event, Receipt
from shaper.handshake import TABLE_HASH_BYTES, Identity, Side
from shaper.journal import MemoryJournal
from shaper.link_end import LinkEnd, pump_link
from shaper.link_estimator import LinkEstimator, PresetBand, PresetBands
from shaper.link_key import LinkKey
from shaper.operator_lost import OperatorLostSettings, OperatorWatch
from shaper.secure_channel import Address, SecureChannel
from shaper.traffic_class import DEFAULT_CLASSES, TopicRule
from straitlink.chaos.faults import NS_PER_S
from straitlink.chaos.invariants import LIMITS, MAX_JOURNAL_MESSAGES, Fates, check_bounds, check_deliveries

_EPOCH_UNIX_NS = 1_387_000_000 * NS_PER_S
_BANDS = (
    PresetBand("fast", 1_000_000, 50_000_000),
    PresetBand("thin", 100_000, 500_000_000),
)
RULES = tuple(
    TopicRule(f"*/{name}/**", traffic_class)
    for name, traffic_class in DEFAULT_CLASSES.items()
    if name != "status"
)
_OPERATOR_LOST = OperatorLostSettings("robot/operator_lost", b"stand still", after_ns=5 * NS_PER_S)
Send = Callable[[bytes, Address, Address], None]


class Killed(Exception):
    """The process was killed in the middle of something."""


class ChaosHost:
    """A host whose shaper is killed and started, in front of which the bus and the journal stay."""

    def __init__(
        self,
        side: Side,
        key: LinkKey,
        configured: dict[Side, Address],
        rng: random.Random,
        *,
        adaptive: bool,
    ) -> None:
        self.side: Side = side
        self.address = configured[side]
        self.clock_offset_ns = rng.randrange(3600 * NS_PER_S)
        self.unix_offset_ns = 0
        self.link: LinkEnd | None = None
        self.wakeup_ns: int | None = None
        self.lives = 0
        self.other_fates: Fates
        self.own_fates: Fates
        self._delivered: Counter[str] = Counter()  # by the present process
        self._key = key
        self._configured = configured
        self._adaptive = adaptive  # its estimator knows nothing of the link, or is told two bands
        self._rng = rng
        self._kill_in = 0  # deliveries until the process dies in the middle of one; 0 for not at all
        self._journal = MemoryJournal(rng.randbytes(8), max_messages=MAX_JOURNAL_MESSAGES)

    def local_ns(self, true_ns: int) -> int:
        return true_ns + self.clock_offset_ns

    def unix_ns(self, true_ns: int) -> int:
        return _EPOCH_UNIX_NS + true_ns + self.unix_offset_ns

    def start(self, true_ns: int) -> None:
        """A new process, with what the journal has of the former one."""
        now_ns, unix_ns = self.local_ns(true_ns), self.unix_ns(true_ns)
        peer = self._configured["operator" if self.side == "robot" else "robot"]
        identity = Identity(self._journal.begin_life(), self._journal.memory, bytes(TABLE_HASH_BYTES))
        channel = SecureChannel(self.side, [self._key], identity, peer, self._rng.randbytes, now_ns, unix_ns)
        settings = EndpointSettings(RULES, limits=LIMITS, protection_bytes=channel.overhead_bytes)
        estimator: LinkEstimator = (
            AdaptiveEstimator(now_ns=now_ns) if self._adaptive else PresetBands(_BANDS, now_ns=now_ns)
        )
        endpoint = Endpoint(settings, estimator, identity.epoch, now_ns, unix_ns, self._journal)
        watch = OperatorWatch(_OPERATOR_LOST, now_ns) if self.side == "robot" else None
        self.link = LinkEnd(endpoint, channel, watch)
        self.lives += 1
        self.own_fates.on_start()
        self._delivered.clear()
        self.other_fates.on_receiver_start()
        self._kill_in = 0
        self.wakeup_ns = true_ns

    def kill(self) -> None:
        """kill -9."""
        self.link = None
        self.wakeup_ns = None

    def kill_while_delivering(self) -> None:
        """Die at one of the next deliveries, before or after the bus has it."""
        self._kill_in = self._rng.randint(1, 4)

    def offer(self, key: str, payload: bytes, tag: int, true_ns: int, *, reliable: bool) -> None:
        """A publisher of this side's bus; what it puts while the shaper is dead goes nowhere."""
        if self.link is None:
            return
        if reliable:
            self.own_fates.offered(key, tag)
        now_ns = self.local_ns(true_ns)
        self.link.endpoint.offer(key, payload, now_ns, now_ns, tag=tag)

    def pump(self, true_ns: int, send: Send) -> None:
        """Drain the process; check what it holds."""
        link = self.link
        if link is None:
            return

        def send_from_here(data: bytes, to: Address) -> None:
            send(data, self.address, to)

        try:
            wakeup_ns = pump_link(link, self.local_ns(true_ns), send_from_here, self._handle)
        except Killed:
            self.kill()
            return
        self.wakeup_ns = wakeup_ns - self.clock_offset_ns
        check_bounds(link, self._journal)
        check_deliveries(link, self._delivered)
        self.own_fates.check_ledgers(link)

    def _handle(self, event: Event) -> None:
        if isinstance(event, Receipt):
            self.own_fates.told(event)
        elif isinstance(event, Delivered):
            self._deliver(event)

    def _deliver(self, event: Delivered) -> None:
        self._delivered[event.key] += 1
        if event.on_handed_over is None:
            self.other_fates.sampled(event)
            return
        if self._kill_in:
            self._kill_in -= 1
            if not self._kill_in:
                if self._rng.random() < 0.5:
                    self.other_fates.delivered(event)
                raise Killed
        self.other_fates.delivered(event)
        event.on_handed_over()
