"""One mission: composition of endpoints, links and sources on the virtual event loop."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from netem_scripts.band import Band, DirectionProfile, Profile
from netem_scripts.event_loop import EventLoop
from netem_scripts.link import Link
from netem_scripts.records import BandRecord, PacketRecord, StartRecord, event_of
from shaper.carousel_wire import LIFE_BITS
from shaper.endpoint import Endpoint
from shaper.endpoint_settings import EndpointSettings
from shaper.estimation.adaptive import AdaptiveEstimator
from shaper.estimation.predicting import PredictingEstimator
from shaper.events import Delivered, Event
from shaper.frames import EPOCH_BITS, IP_UDP_BYTES
from shaper.handshake import MEMORY_BYTES, TABLE_HASH_BYTES, Identity, Side, other_side
from shaper.ledger import ReceivedLedger
from shaper.link_end import LinkEnd, pump_link
from shaper.link_estimator import EstimatorFactory, LinkEstimator, PresetBand, PresetBands
from shaper.link_key import make_link_key
from shaper.secure_channel import Address, SecureChannel
from shaper.trace_records import (
    LEDGER_INTERVAL_NS,
    Record,
    SentBins,
    event_record,
    ledger_record,
    start_record,
)
from straitlink.mission.carousel import CarouselPlan, MissionCarousel
from straitlink.mission.clock import HostClock
from straitlink.mission.load import Load, LoadTopic
from straitlink.mission.outcome import QueueSampler, TopicOutcome, percentiles_ms, settled_mask, topic_row

_NS_PER_S = 1_000_000_000
_EPOCH_UNIX_NS = 1_387_000_000 * _NS_PER_S  # virtual missions take place in December 2013
DRAIN_NS = 60 * _NS_PER_S  # at the end sources stop, and what is under way has this long to arrive
_MAX_CLOCK_OFFSET_NS = 3600 * _NS_PER_S

Direction = Literal["down", "up"]
TraceWriter = Callable[[str, Record], None]
"""Takes the name of a trace ("robot", "operator", "link") and a record."""


def adaptive(bands: Sequence[PresetBand], now_ns: int) -> LinkEstimator:
    """The estimator that needs no presets."""
    return AdaptiveEstimator(bands, now_ns)


def predicting(bands: Sequence[PresetBand], now_ns: int) -> LinkEstimator:
    """The same, slowed just before falls that come at regular times."""
    return PredictingEstimator(AdaptiveEstimator(bands, now_ns))


def presets(bands: Sequence[PresetBand], now_ns: int) -> LinkEstimator:
    """The announced bands, told apart by round trips."""
    return PresetBands(bands, now_ns=now_ns)


@dataclass(frozen=True, slots=True)
class MissionSettings:
    """What is run. bands: presets of the shapers; those of the profile unless given.

    estimator: makes each side's. max_drift_ppm: each host's clock drifts by up to so much.
    synchronised: both hosts' clocks show true time, which only a control of the bench needs.
    carousel: a second link without a way back, for the load's topics that go round.
    """

    profile: Profile
    load: Load
    duration_ns: int
    seed: int = 1
    bands: tuple[PresetBand, ...] = ()
    estimator: EstimatorFactory = adaptive
    max_drift_ppm: int = 50
    synchronised: bool = False
    carousel: CarouselPlan | None = None


class _Host:
    """An endpoint with its clock and its end of the link."""

    def __init__(self, mission: _Mission, sends: Direction, rng: random.Random) -> None:
        settings = mission.settings
        self.sends: Direction = sends
        self.side: Side = "robot" if sends == "down" else "operator"
        offset_ns = rng.randrange(_MAX_CLOCK_OFFSET_NS)
        drift_ppm = rng.randint(-settings.max_drift_ppm, settings.max_drift_ppm)
        self.clock = HostClock(offset_ns, drift_ppm, _EPOCH_UNIX_NS)
        if settings.synchronised:
            self.clock = HostClock(unix_ns=_EPOCH_UNIX_NS)
        self.bands = settings.bands or preset_bands(settings.profile, sends)
        self.link_end = self._make_link_end(mission, rng)
        self.endpoint = self.link_end.endpoint
        profile = settings.profile
        self.direction = profile.down if sends == "down" else profile.up
        self.link = Link(self.direction, random.Random(rng.getrandbits(64)))
        self.queue = QueueSampler(self.direction)
        self.bins = SentBins(lambda record: mission.trace(self.side, record))
        self._mission = mission
        self._loop = mission.loop
        self._timer_ns = -1
        self.peer: _Host

    def _make_link_end(self, mission: _Mission, rng: random.Random) -> LinkEnd:
        """As live: behind a channel with the link's key, both made from the mission's seed."""
        now_ns = self.clock.local_ns(0)
        unix_ns = self.clock.unix_at_ns(now_ns)
        identity = Identity(rng.getrandbits(EPOCH_BITS), rng.randbytes(MEMORY_BYTES), bytes(TABLE_HASH_BYTES))
        channel = SecureChannel(
            self.side,
            [mission.key],
            identity,
            _address(other_side(self.side)),
            rng.randbytes,
            now_ns,
            unix_ns,
        )
        settings = EndpointSettings(
            mission.settings.load.rules(self.sends), protection_bytes=channel.overhead_bytes
        )
        estimator = mission.settings.estimator(self.bands, now_ns)
        endpoint = Endpoint(settings, estimator, identity.epoch, now_ns, unix_ns)
        return LinkEnd(endpoint, channel)

    def offer(self, key: str, payload: bytes) -> None:
        """A source on this host has published."""
        now_ns = self.clock.local_ns(self._loop.now_ns)
        if self.endpoint.offer(key, payload, now_ns, now_ns):
            self.pump(now_ns)

    def receive(self, datagram: bytes) -> None:
        """The link has brought a datagram."""
        now_ns = self.clock.local_ns(self._loop.now_ns)
        self.link_end.receive(datagram, _address(self.peer.side), now_ns)
        self.pump(now_ns)

    def pump(self, now_ns: int) -> None:
        """Drain the endpoint and arm its timer."""
        wakeup_ns = pump_link(self.link_end, now_ns, self._send, self._handle)
        when_ns = max(self.clock.true_ns(wakeup_ns), self._loop.now_ns)
        if when_ns != self._timer_ns:
            self._timer_ns = when_ns
            self._loop.call_at(when_ns, partial(self._on_timer, when_ns))

    def _on_timer(self, when_ns: int) -> None:
        if when_ns != self._timer_ns:  # armed anew since
            return
        self._timer_ns = -1
        now_ns = self.clock.local_ns(when_ns)
        self.link_end.on_timer(now_ns)
        self.pump(now_ns)

    def _send(self, datagram: bytes, _address: Address) -> None:
        now_ns = self._loop.now_ns
        passage = self.link.transmit(len(datagram), now_ns)
        self.queue.on_packet(now_ns, passage.departure_ns)
        self._mission.on_datagram(self, datagram, passage.queue_delay_ns, passage.drop)
        self.bins.on_sent(passage.wire_bytes, now_ns)
        for arrival_ns in passage.arrivals_ns:
            self._loop.call_at(arrival_ns, partial(self.peer.receive, datagram))

    def _handle(self, event: Event) -> None:
        self._mission.on_event(self, event)


class _Mission:
    def __init__(self, settings: MissionSettings, trace: TraceWriter | None) -> None:
        rng = random.Random(settings.seed)
        self.settings = settings
        self.loop = EventLoop()
        self._write = trace
        self._digest = hashlib.sha256()
        self.key = make_link_key(rng.randbytes)
        self.robot = _Host(self, "down", rng)
        self.operator = _Host(self, "up", rng)
        self.robot.peer, self.operator.peer = self.operator, self.robot
        self.topics = {t.key: TopicOutcome(t.direction) for t in settings.load.topics}
        self._rng = rng
        self._carousel: MissionCarousel | None = None
        if settings.carousel is not None:
            fast_rng = random.Random(f"carousel {settings.seed}")  # its own: the thin link's is not disturbed
            self._carousel = MissionCarousel(
                settings.carousel,
                settings.load,
                self.loop,
                self.robot,
                self.operator,
                fast_rng.getrandbits(LIFE_BITS),
                fast_rng,
                self._digest.update,
                lambda delivered: self.on_event(self.operator, delivered),
            )

    def run(self, on_progress: Callable[[float], None] | None) -> dict[str, Any]:
        self._start_traces()
        self._shake_hands()
        for host in (self.robot, self.operator):
            host.pump(host.clock.local_ns(0))
        for topic in self.settings.load.topics:
            self._start_source(topic)
        end_ns = self.settings.duration_ns
        if self._write is not None:
            self._schedule_ledgers(LEDGER_INTERVAL_NS)
        while self.loop.now_ns < end_ns:
            self.loop.run_until(min(end_ns, self.loop.now_ns + _NS_PER_S))
            if on_progress is not None:
                on_progress(self.loop.now_ns / end_ns)
        result: dict[str, Any] = {
            "link": {h.sends: self._link_result(h) for h in (self.robot, self.operator)}
        }
        if self._carousel is not None:
            result["carousel"] = self._carousel.result(end_ns)
        self._drain()
        self._finish_traces()
        result["topics"] = self._topic_results()
        result["trace_sha256"] = self._digest.hexdigest()
        return result

    def _shake_hands(self) -> None:
        """A mission begins when its two shapers know each other; `straitlink chaos` is about the rest."""
        robot, operator = self.robot, self.operator
        for here, there in ((operator, robot), (robot, operator), (operator, robot)):
            while (outgoing := here.link_end.channel.next_handshake(here.clock.local_ns(0))) is not None:
                there.link_end.receive(outgoing[0], _address(here.side), there.clock.local_ns(0))

    # What hosts tell.

    def on_datagram(self, host: _Host, datagram: bytes, queue_delay_ns: int, drop: Any) -> None:
        self._digest.update(b"%d %s " % (self.loop.now_ns, host.sends.encode()))
        self._digest.update(datagram)
        host.queue.overflows += drop == "OVERFLOW"
        host.queue.losses += drop == "LOSS"
        if self._write is not None:
            wire_bytes = len(datagram) + IP_UDP_BYTES
            record = PacketRecord(self.loop.now_ns, host.sends, wire_bytes, queue_delay_ns, drop)
            self._write("link", event_of(record))

    def on_event(self, host: _Host, event: Event) -> None:
        now_ns = self.loop.now_ns
        if isinstance(event, Delivered):
            assert event.capture_unix_ns is not None, "the first datagram of a peer tells its wall clock"
            captured_ns = host.peer.clock.true_of_unix_ns(event.capture_unix_ns)
            self.topics[event.key].on_delivered(now_ns - captured_ns, len(event.payload))
        if self._write is not None:
            self._write(host.side, event_record(event, now_ns))

    def trace(self, name: str, record: Record) -> None:
        if self._write is not None:
            self._write(name, record)

    # Sources.

    def _start_source(self, topic: LoadTopic) -> None:
        host = self.robot if topic.direction == "down" else self.operator
        payload = self._rng.randbytes(topic.payload_bytes)
        outcome, loop, end_ns = self.topics[topic.key], self.loop, self.settings.duration_ns
        period_ns = _NS_PER_S / topic.rate_hz
        phase_ns = topic.starts_at_ns + self._rng.random() * period_ns
        count = 0

        def publish() -> None:
            nonlocal count
            outcome.offered += 1
            count += 1
            next_ns = int(phase_ns + count * period_ns)
            if next_ns < end_ns:
                loop.call_at(next_ns, publish)
            if not topic.goes_round:
                host.offer(topic.key, payload)
            elif self._carousel is not None:
                self._carousel.offer(topic.key, payload)

        if int(phase_ns) < end_ns:
            loop.call_at(int(phase_ns), publish)

    def _drain(self) -> None:
        """Let what is under way arrive; stop as soon as nothing waits and nothing is in transit."""
        limit_ns = self.loop.now_ns + DRAIN_NS
        while self.loop.now_ns < limit_ns:
            self.loop.run_until(self.loop.now_ns + _NS_PER_S // 10)
            quiet = all(
                sum(ledger.queued for ledger in host.endpoint.sent_ledgers().values()) == 0
                and host.link.totals(self.loop.now_ns).in_transit <= 1
                for host in (self.robot, self.operator)
            )
            if quiet:
                self.loop.run_until(self.loop.now_ns + _NS_PER_S)
                return

    # Results.

    def _link_result(self, host: _Host) -> dict[str, Any]:
        duration_ns = self.settings.duration_ns
        host.queue.advance(duration_ns)
        samples_ns = host.queue.samples_ns()
        p50, p95, maximum = percentiles_ms(samples_ns)
        settled = samples_ns[settled_mask(host.direction, len(samples_ns))]
        capacity_bits = host.link.capacity_bits(0, duration_ns)
        return {
            "utilisation": round(host.link.served_bits(duration_ns) / capacity_bits, 4),
            "queue_delay_p50_ms": p50,
            "queue_delay_p95_ms": p95,
            "queue_delay_max_ms": maximum,
            "queue_delay_max_settled_ms": percentiles_ms(settled)[2],
            "buffer_drops": host.queue.overflows,
            "lost_packets": host.queue.losses,
            "wire_bytes": host.endpoint.counters.sent_wire_bytes,
            "datagrams": host.endpoint.counters.sent_datagrams,
        }

    def _topic_results(self) -> dict[str, Any]:
        sent = {**self.robot.endpoint.sent_ledgers(), **self.operator.endpoint.sent_ledgers()}
        sent.update(self._carousel.sender.ledgers if self._carousel is not None else {})
        rows = {}
        reliable = {t.key for t in self.settings.load.topics if t.is_reliable}
        for key, outcome in self.topics.items():
            ledger = sent.get(key)
            counts = None if ledger is None else {**ledger.as_dict(), "queued": ledger.queued}
            receiver = self.operator if outcome.direction == "down" else self.robot
            received = receiver.endpoint.received_ledgers.get(key, ReceivedLedger())
            expired_there = 0 if key in reliable else received.expired
            rows[key] = topic_row(outcome, counts, expired_there, received.stale, received.unreadable)
        return rows

    # Traces.

    def _start_traces(self) -> None:
        if self._write is None:
            return
        self._write("link", event_of(StartRecord(0, _EPOCH_UNIX_NS, self.settings.profile)))
        for host in (self.robot, self.operator):
            self._write(host.side, start_record(host.side, 0, _EPOCH_UNIX_NS))
            self._trace_band(host)

    def _trace_band(self, host: _Host) -> None:
        now_ns = self.loop.now_ns
        band = host.link.band_at(now_ns)
        self.trace("link", event_of(BandRecord(now_ns, host.sends, band.rate_bps, band.one_way_delay_ns)))
        change_ns = host.link.next_change_ns(now_ns)
        if change_ns is not None and change_ns < self.settings.duration_ns:
            self.loop.call_at(change_ns, partial(self._trace_band, host))

    def _schedule_ledgers(self, when_ns: int) -> None:
        if when_ns <= self.settings.duration_ns:
            self.loop.call_at(when_ns, partial(self._trace_ledgers, when_ns))

    def _trace_ledgers(self, when_ns: int) -> None:
        for host in (self.robot, self.operator):
            self.trace(host.side, self._ledgers(host, when_ns))
        self._schedule_ledgers(when_ns + LEDGER_INTERVAL_NS)

    def _ledgers(self, host: _Host, when_ns: int) -> Record:
        goes_round = self._carousel is not None and host is self.robot
        return ledger_record(
            host.endpoint,
            host.sends,
            when_ns,
            self._carousel.sender.ledgers if goes_round and self._carousel is not None else None,
        )

    def _finish_traces(self) -> None:
        for host in (self.robot, self.operator):
            host.bins.flush()
            self.trace(host.side, self._ledgers(host, self.loop.now_ns))


def _address(side: Side) -> Address:
    return side, 0  # of the emulated link's two ends


def preset_bands(profile: Profile, sends: Direction) -> tuple[PresetBand, ...]:
    """The profile's own bands as presets of one sending direction, as the Trials announced theirs.

    The presets' delay is half the round trip: where the directions differ, the mean of the two.
    """
    ours, theirs = (profile.down, profile.up) if sends == "down" else (profile.up, profile.down)
    paired = len(ours.bands) == len(theirs.bands)
    presets: dict[tuple[int, int], PresetBand] = {}
    for index, band in enumerate(ours.bands):
        if band.rate_bps == 0 or band.loss_ratio == 1.0:
            continue  # a blackout is no band to send at
        back = theirs.bands[index] if paired else _nearest(theirs, band)
        delay_ns = (band.one_way_delay_ns + back.one_way_delay_ns) // 2
        name = f"{band.rate_bps // 1000} kbit/s {delay_ns // 1_000_000} ms"
        presets[band.rate_bps, delay_ns] = PresetBand(name, band.rate_bps, delay_ns)
    return tuple(presets.values())


def _nearest(direction: DirectionProfile, band: Band) -> Band:
    return min(direction.bands, key=lambda b: abs(b.one_way_delay_ns - band.one_way_delay_ns))


def run_mission(
    settings: MissionSettings,
    trace: TraceWriter | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> dict[str, Any]:
    """Run a mission to its end; the same settings give the same result to the byte.

    The result holds "topics", "link" and "trace_sha256", a digest of every datagram with its time.
    """
    return _Mission(settings, trace).run(on_progress)
