"""Two shapers and a link between them in virtual time, without the bookkeeping of a mission."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from netem_scripts.band import Profile
from netem_scripts.event_loop import EventLoop
from netem_scripts.link import Link
from shaper.endpoint import Endpoint
from shaper.endpoint_settings import EndpointSettings
from shaper.events import Delivered, Event
from shaper.incoming import Limits
from shaper.link_estimator import PresetBands
from shaper.pump import pump
from shaper.traffic_class import TopicRule
from straitlink.mission.mission import preset_bands


class Pair:
    """A robot that publishes and an operator that receives, on an event loop that others may share."""

    def __init__(
        self,
        loop: EventLoop,
        profile: Profile,
        rules: Sequence[TopicRule],
        max_topics: int,
        seed: int,
        on_delivered: Callable[[Delivered], None] | None = None,
    ) -> None:
        self.offered = self.delivered = 0
        self._on_delivered = on_delivered
        self._loop = loop
        limits = replace(Limits(), max_topics=max_topics)
        rng = random.Random(seed)
        self._ends = [
            Endpoint(
                EndpointSettings(tuple(rules) if sends == "down" else (), limits=limits),
                PresetBands(preset_bands(profile, sends)),
                epoch=rng.getrandbits(16),
                now_ns=loop.now_ns,
                unix_ns=loop.now_ns,
            )
            for sends in ("down", "up")
        ]
        self._links = [Link(way, random.Random(rng.getrandbits(64))) for way in (profile.down, profile.up)]
        self._timers_ns = [-1, -1]
        for end in (0, 1):
            self._pump(end)

    @property
    def robot(self) -> Endpoint:
        """The end that publishes."""
        return self._ends[0]

    def offer(self, key: str, payload: bytes) -> None:
        """A publisher on the robot."""
        now_ns = self._loop.now_ns
        self.offered += 1
        if self._ends[0].offer(key, payload, now_ns, now_ns):
            self._pump(0)

    def _pump(self, end: int) -> None:
        wakeup_ns = pump(self._ends[end], self._loop.now_ns, partial(self._send, end), self._handle)
        when_ns = max(wakeup_ns, self._loop.now_ns)
        if when_ns != self._timers_ns[end]:
            self._timers_ns[end] = when_ns
            self._loop.call_at(when_ns, partial(self._on_timer, end, when_ns))

    def _on_timer(self, end: int, when_ns: int) -> None:
        if self._timers_ns[end] == when_ns:
            self._timers_ns[end] = -1
            self._ends[end].on_timer(when_ns)
            self._pump(end)

    def _send(self, end: int, datagram: bytes) -> None:
        for arrival_ns in self._links[end].transmit(len(datagram), self._loop.now_ns).arrivals_ns:
            self._loop.call_at(arrival_ns, partial(self._receive, 1 - end, datagram))

    def _receive(self, end: int, datagram: bytes) -> None:
        self._ends[end].receive_datagram(datagram, self._loop.now_ns)
        self._pump(end)

    def _handle(self, event: Event) -> None:
        if isinstance(event, Delivered):
            self.delivered += 1
            if self._on_delivered is not None:
                self._on_delivered(event)
