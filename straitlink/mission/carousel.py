"""A second link in a mission: from the robot to the operator only, served by a carousel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, Protocol

from netem_scripts.band import Profile
from netem_scripts.event_loop import EventLoop
from netem_scripts.link import Link, RandomSource
from shaper.carousel import Carousel, CarouselSettings, CarouselTopic
from shaper.carousel_receiver import CarouselReceiver
from shaper.events import Delivered
from shaper.incoming import Limits
from shaper.link_end import LinkEnd
from straitlink.mission.clock import HostClock
from straitlink.mission.load import Load

_NS_PER_S = 1_000_000_000
_RATE_SHARE = 0.95  # of the link's best band, unless a rate is given


@dataclass(frozen=True, slots=True)
class CarouselPlan:
    """profile: of the second link; its way up is not used. rate_bps: fixed; 95 % of its best band if 0."""

    profile: Profile
    rate_bps: int = 0
    repeat_ns: int = _NS_PER_S // 2

    def settings(self, load: Load) -> CarouselSettings:
        """For the topics of a load that go round: each its newest sample."""
        best_bps = max(band.rate_bps for band in self.profile.down.bands)
        topics = tuple(CarouselTopic(topic.key) for topic in load.topics if topic.goes_round)
        return CarouselSettings(topics, self.rate_bps or int(_RATE_SHARE * best_bps), self.repeat_ns)


class CarouselHost(Protocol):
    """A host of a mission."""

    clock: HostClock
    link_end: LinkEnd


class MissionCarousel:
    """Both halves and the link between them.

    on_sent: each datagram; on_delivered: at the operator, each message once.
    """

    def __init__(
        self,
        plan: CarouselPlan,
        load: Load,
        loop: EventLoop,
        robot: CarouselHost,
        operator: CarouselHost,
        life: int,
        link_random: RandomSource,
        on_sent: Callable[[bytes], None],
        on_delivered: Callable[[Delivered], None],
    ) -> None:
        self._on_sent = on_sent
        self._loop, self._robot, self._operator = loop, robot, operator
        self._on_delivered = on_delivered
        channel, endpoint = robot.link_end.channel, operator.link_end.endpoint
        self.sender = Carousel(plan.settings(load), life, robot.clock.local_ns(0), channel.overhead_bytes)
        self.link = Link(plan.profile.down, link_random)

        def age_of(stamp_us: int, now_ns: int) -> int | None:
            return None if endpoint.peer_clock is None else endpoint.peer_clock.age_ns(stamp_us, now_ns)

        self.receiver = CarouselReceiver(Limits(), ("**",), endpoint.received_ledgers, age_of)
        self._timer_ns = -1

    def offer(self, key: str, payload: bytes) -> None:
        """A source on the robot has published something that goes round."""
        clock = self._robot.clock
        now_ns = clock.local_ns(self._loop.now_ns)
        if self.sender.offer(key, payload, "", now_ns, clock.unix_at_ns(now_ns), now_ns):
            self._pump()

    def result(self, duration_ns: int) -> dict[str, Any]:
        """How the link was used: of what it could carry, and of what came whether it was news."""
        used = self.link.served_bits(duration_ns) / self.link.capacity_bits(0, duration_ns)
        return {
            "rate_bps": self.sender.rate_bps,
            "utilisation": round(used, 4),
            **asdict(self.sender.counters),
            **asdict(self.receiver.counters),
        }

    def _pump(self) -> None:
        clock, channel = self._robot.clock, self._robot.link_end.channel
        now_ns = clock.local_ns(self._loop.now_ns)
        while channel.ready and (body := self.sender.next_datagram(now_ns)) is not None:
            sealed = channel.seal_carousel(body)
            assert sealed is not None, "a channel that is ready seals"
            self._on_sent(sealed)
            for arrival_ns in self.link.transmit(len(sealed), self._loop.now_ns).arrivals_ns:
                self._loop.call_at(arrival_ns, partial(self._receive, sealed))
        when_ns = max(clock.true_ns(self.sender.wakeup_at_ns(now_ns)), self._loop.now_ns)
        if when_ns != self._timer_ns:
            self._timer_ns = when_ns
            self._loop.call_at(when_ns, partial(self._on_timer, when_ns))

    def _on_timer(self, when_ns: int) -> None:
        if when_ns == self._timer_ns:  # not armed anew since
            self._timer_ns = -1
            self._pump()

    def _receive(self, sealed: bytes) -> None:
        body = self._operator.link_end.channel.open_carousel(sealed)
        now_ns = self._operator.clock.local_ns(self._loop.now_ns)
        delivered = None if body is None else self.receiver.receive(body, now_ns)
        if delivered is not None:
            self._on_delivered(delivered)
