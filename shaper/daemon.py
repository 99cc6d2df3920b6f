"""The live shaper: an endpoint between the local Zenoh bus and a UDP socket, on one asyncio loop."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from messages.attachment import Stamp, decode_stamp
from shaper.bus import BusError, BusInlet, BusOutlet, Session, open_bus
from shaper.carousel_udp import CarouselLink
from shaper.config import ShaperConfig
from shaper.doorstep import Doorstep
from shaper.endpoint import Endpoint
from shaper.estimation.adaptive import AdaptiveEstimator
from shaper.estimation.predicting import PredictingEstimator
from shaper.events import Delivered, EncodingTrouble, Event, LinkState, PeerStarted, Receipt, Wanted
from shaper.flood_gate import FloodGates
from shaper.frames import IP_UDP_BYTES
from shaper.link_end import LinkEnd, pump_link
from shaper.link_estimator import LinkEstimator, PresetBands
from shaper.notices import Notice
from shaper.operator_lost import OperatorBack, OperatorLost, OperatorWatch
from shaper.secure_channel import Address
from shaper.session import TAG_BYTES as PROTECTION_BYTES
from shaper.socket_filter import Admission
from shaper.trace import TraceFile
from shaper.trace_records import (
    LEDGER_INTERVAL_NS,
    Direction,
    SentBins,
    event_record,
    ledger_record,
    receiving_record,
    start_record,
)
from shaper.traffic_class import Keep, first_match
from shaper.udp import Datagrams

_NS_PER_S = 1_000_000_000
_BUS_RETRY_S = 1.0
_SILENCE_NS = 5 * _NS_PER_S  # after which a person should know
_HAND_OVER_S = 0.005
_LISTENERS_S = 5.0  # after the bus is up: Zenoh tries to connect again every four seconds at most
_FILTER_NS = 100_000_000  # so often the filter in front of the socket is looked at ...
_FILTER_UNWANTED = 64  # ... and when so much has come that nobody wants: so begins a flood
_GATHER_S = 0.005  # adds at most this to an age; the link adds ten times as much
_OLDEST_CAPTURE_NS = 3600 * _NS_PER_S  # a stamp further from now is not of this run, or of another clock
_EARLIEST_CAPTURE_NS = -_NS_PER_S

_log = logging.getLogger(__name__)


class Daemon:
    """One side of the link, from `start` to `stop`; behind its doorstep, which has its port and its keys."""

    def __init__(self, config: ShaperConfig, door: Doorstep, trace_path: Path | None = None) -> None:
        self._config = config
        self._door = door
        self._trace = None if trace_path is None else TraceFile(trace_path)
        self._bins = SentBins(lambda record: self._trace.write(record) if self._trace else None)
        self._sends: Direction = "down" if config.side == "robot" else "up"
        self._timer: asyncio.TimerHandle | None = None
        self._gathering = False
        self._gathered_at_s = 0.0
        self._seen_ns = 0  # the latest instant that the core has been told of
        self._silent = False
        self._outlet: BusOutlet | None = None
        self._listeners_until_s = 0.0  # until then what must not be lost waits for somebody to listen
        self._admission = Admission()
        self._filter_again_ns = self._filtered_numbers = self._filtered_unwanted = 0
        self._gates = FloodGates(0)
        self._due_on_bus: deque[Callable[[], bool]] = deque()
        self._delivered: list[Callable[[], None]] = []  # on the bus, as good as certainly

    async def run(self, stop: asyncio.Event) -> None:
        """Carry messages until `stop` is set. Raises BusError, UdpError or MetricsError."""
        self._loop = asyncio.get_running_loop()
        with contextlib.ExitStack() as stack:
            if self._trace is not None:
                stack.callback(self._trace.close)
            stack.callback(self._on_handed_over)
            self._set_up()
            stack.callback(self._finish_trace)
            session = await self._open_bus(stop)
            if session is None:  # asked to stop while the bus was not there yet
                return
            stack.callback(session.close)
            outlet = self._outlet = BusOutlet(session)
            self._listeners_until_s = time.monotonic() + _LISTENERS_S
            stack.callback(outlet.close)
            stack.callback(self._carousel.close)
            await self._carousel.open(self._config.carousel)
            if self._config.metrics is not None:
                from shaper.metrics import MetricsServer  # takes a while to load, and few want it

                stack.callback(
                    MetricsServer(self._config.metrics, self.endpoint, self._link.counters_dict).close
                )
            self._inlet = self._open_inlet(session)
            stack.callback(self._inlet.close)
            self._start_trace()
            self._door.hand_over(self._on_datagrams)
            self._pump(time.monotonic_ns())
            ledgers = asyncio.create_task(self._tell_ledgers())
            stack.callback(ledgers.cancel)
            stack.callback(self._stop_timer)
            await stop.wait()

    def _set_up(self) -> None:
        """The endpoint behind its channel."""
        config, door, now_ns, unix_ns = self._config, self._door, time.monotonic_ns(), time.time_ns()
        settings = replace(config.endpoint, protection_bytes=PROTECTION_BYTES if door.keys else 0)
        estimator = _make_estimator(config, now_ns)
        self.endpoint = Endpoint(settings, estimator, door.epoch, now_ns, unix_ns, door.journal)
        if door.said_bytes:
            self.endpoint.on_channel_sent(door.said_bytes, now_ns)
            self._bins.on_sent(door.said_bytes + IP_UDP_BYTES, now_ns)
        lost = config.operator_lost
        watch = None if lost is None else OperatorWatch(lost, now_ns)
        self._link = LinkEnd(self.endpoint, door.channel, watch, door.tables)
        self._seen_ns = now_ns
        self._carousel = CarouselLink(config, self._link, self._handle)

    def _open_inlet(self, session: Session) -> BusInlet:
        def wake() -> None:
            self._loop.call_soon_threadsafe(self._gather_samples)

        expressions = [rule.key_expression for rule in self._config.endpoint.rules if not rule.pull]
        expressions = self._carousel.key_expressions + expressions
        return BusInlet(session, expressions, self._is_latest, wake, time.monotonic_ns)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()

    async def _open_bus(self, stop: asyncio.Event) -> Session | None:
        """The local bus; one that we only connect to may come up later than we do."""
        while not stop.is_set():
            try:
                return await self._loop.run_in_executor(None, open_bus, self._config.bus)
            except BusError as error:
                if self._config.bus.listen:
                    raise
                _log.warning("%s; trying again", error)
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(stop.wait(), _BUS_RETRY_S)
        return None

    # What happens: the bus, the link, the timer.

    def _gather_samples(self) -> None:
        """At once after a quiet moment, else with what comes meanwhile: thousands a second, few wake-ups."""
        if not self._gathering:
            self._gathering = True
            self._loop.call_at(self._gathered_at_s + _GATHER_S, self._on_samples)

    def _on_samples(self) -> None:
        """Take what has gathered; while they come one after the other, look again without being told."""
        now_s = self._loop.time()
        busy = now_s - self._gathered_at_s < 2 * _GATHER_S
        self._gathered_at_s = now_s
        samples = self._inlet.take(look_again=busy)
        self._gathering = busy and len(samples) > 0
        if self._gathering:
            self._loop.call_at(now_s + _GATHER_S, self._on_samples)
        elif busy:
            samples = self._inlet.take()  # from now on we are told; what came just before is here
        now_ns = time.monotonic_ns()
        unix_minus_monotonic_ns = time.time_ns() - now_ns
        more = False
        for sample in samples:
            stamp = decode_stamp(sample.attachment) if sample.attachment else None
            capture_ns = _capture_ns(stamp, sample.received_ns, unix_minus_monotonic_ns)
            if self._carousel.offer(sample, capture_ns, unix_minus_monotonic_ns):
                continue
            tag = 0 if stamp is None else stamp.capture_ns << 32 | stamp.sequence
            more |= self.endpoint.offer(sample.key, sample.payload, capture_ns, now_ns, sample.encoding, tag)
            if sample.missed:
                self.endpoint.missed(sample.key, sample.missed)
        if more:
            self._pump(now_ns)

    def _on_datagrams(self, datagrams: Datagrams) -> None:
        for data, source, received_ns in datagrams:
            self._seen_ns = max(self._seen_ns, received_ns)  # the core's time never goes back
            self._link.receive(data, source, self._seen_ns)
        self._pump(time.monotonic_ns())

    def _on_timer(self) -> None:
        self._timer = None
        now_ns = time.monotonic_ns()
        self._link.on_timer(now_ns)
        self._pump(now_ns)

    def _pump(self, now_ns: int) -> None:
        self._seen_ns = now_ns
        wakeup_ns = pump_link(self._link, now_ns, self._send, self._handle)
        self._filter_strangers(now_ns)
        when_s = wakeup_ns / _NS_PER_S
        if self._timer is not None:
            if self._timer.when() == when_s:
                return
            self._timer.cancel()
        self._timer = self._loop.call_at(when_s, self._on_timer)

    def _filter_strangers(self, now_ns: int) -> None:
        """Tell the kernel which session numbers are ours, at once, and how much of a flood may pass."""
        channel = self._link.channel
        unwanted = channel.unwanted.total
        if not self._door.keys or (
            now_ns < self._filter_again_ns
            and channel.numbers_drawn == self._filtered_numbers
            and unwanted - self._filtered_unwanted < _FILTER_UNWANTED
        ):
            return
        self._filter_again_ns, self._filtered_unwanted = now_ns + _FILTER_NS, unwanted
        self._filtered_numbers = channel.numbers_drawn
        admission = Admission(
            tuple(channel.session_ids()),
            tuple(key.id for key in self._door.keys) if channel.ready else (),
            channel.peers,
            self._gates.look(channel.unwanted, now_ns),
        )
        if admission != self._admission:
            self._admission = admission
            self._door.udp.take_only(admission)

    # What comes out.

    def _send(self, datagram: bytes, address: Address) -> None:
        self._door.udp.send(datagram, address)
        if self._trace is not None:
            self._bins.on_sent(len(datagram) + IP_UDP_BYTES, time.monotonic_ns())

    def _handle(self, event: Event) -> None:
        if isinstance(event, Delivered):
            capture_unix_ns = event.capture_unix_ns
            if capture_unix_ns is None:
                capture_unix_ns = time.time_ns() - (event.age_ns or 0)
            stamp = Stamp(capture_unix_ns, event.number)
            self._deliver(event, stamp.encode())
        elif isinstance(event, PeerStarted):
            _log.info("the other side %s", "has started anew" if event.again else "is heard")
        elif isinstance(event, Receipt):
            self._tell(f"receipt/{event.key}", receipt_document(event), self._listeners_until_s)
        elif isinstance(event, EncodingTrouble):
            _log.warning("%s: %d %s: %s", event.key, event.count, event.what, event.reason)
            self._tell(f"encoding/{event.key}", asdict(event))
        elif isinstance(event, LinkState):
            self._tell_link(event)
        elif isinstance(event, Notice):
            _log.log(logging.WARNING if event.kind.is_fault else logging.INFO, "%s", event.text)
            self._tell("notice", asdict(event))
        elif isinstance(event, OperatorLost):
            self._say_that_the_operator_is_lost(event)
        elif isinstance(event, OperatorBack):
            self._withdraw_operator_lost(event)
        elif isinstance(event, Wanted):
            self._inlet.ask(event.key, event.budget_bytes)
        if self._trace is not None:
            self._trace.write(event_record(event, time.monotonic_ns()))

    def _deliver(self, event: Delivered, attachment: bytes) -> None:
        """Publish a message. One that is on record must get there: it waits while the outlet is full."""
        assert self._outlet is not None, "nothing comes in before the bus is open"
        done = event.on_handed_over
        if done is None:
            self._outlet.publish(event.key, event.payload, event.encoding, attachment)
            return

        def on_put() -> None:  # in the outlet's thread
            with contextlib.suppress(RuntimeError):  # the loop is closed: so is the journal
                self._loop.call_soon_threadsafe(self._note_when_handed_over, done)

        until_s = min(self._listeners_until_s, time.monotonic() + event.left_ns / _NS_PER_S)
        put = partial(
            self._outlet.publish, event.key, event.payload, event.encoding, attachment, on_put, until_s
        )
        self._due_on_bus.append(put)
        if len(self._due_on_bus) == 1:
            self._put_what_is_due()

    def _put_what_is_due(self) -> None:
        while self._due_on_bus:
            if not self._due_on_bus[0]():
                self._loop.call_later(_HAND_OVER_S, self._put_what_is_due)
                return
            self._due_on_bus.popleft()

    def _note_when_handed_over(self, on_handed_over: Callable[[], None]) -> None:
        """Zenoh sends in a thread of its own: what it took a moment ago is on the bus by now."""
        if not self._delivered:
            self._loop.call_later(_HAND_OVER_S, self._on_handed_over)
        self._delivered.append(on_handed_over)

    def _on_handed_over(self) -> None:
        delivered, self._delivered = self._delivered, []
        for on_handed_over in delivered:
            on_handed_over()

    def _say_that_the_operator_is_lost(self, event: OperatorLost) -> None:
        settings = self._config.operator_lost
        assert settings is not None, "who has not asked is not told"
        if event.first:
            silent_s = event.silent_ns / _NS_PER_S
            _log.warning("the operator is lost: nothing for %.1f s; publishing %s", silent_s, settings.key)
        self._publish(settings.key, settings.payload, settings.encoding, b"")

    def _withdraw_operator_lost(self, event: OperatorBack) -> None:
        settings = self._config.operator_lost
        assert settings is not None and self._outlet is not None, "who has not asked is not told"
        _log.info("the operator is back after %.1f s", event.silent_ns / _NS_PER_S)
        if settings.back_payload is None:
            self._outlet.withdraw(settings.key)
        else:
            self._publish(settings.key, settings.back_payload, settings.encoding, b"")

    def _tell_link(self, state: LinkState) -> None:
        now_ns = time.monotonic_ns()
        watch, peer = self._link.watch, self._link.channel.peer_address
        told = state.receiving
        self._tell(
            "link",
            {
                **asdict(state),
                "sends": self._sends,
                "receiving": told and {**receiving_record(told), "age_ns": now_ns - told.told_ns},
                "secured": bool(self._door.keys) and self._link.channel.ready,
                "peer": f"{peer[0]}:{peer[1]}",
                "last_heard_age_ns": self._link.silence_ns(now_ns),
                "operator_lost": watch is not None and watch.lost,
            },
        )

    # The trace.

    def _start_trace(self) -> None:
        if self._trace is not None:
            self._trace.write(start_record(self._config.side, time.monotonic_ns(), time.time_ns()))

    async def _tell_ledgers(self) -> None:
        while True:
            await asyncio.sleep(LEDGER_INTERVAL_NS / _NS_PER_S)
            now_ns = time.monotonic_ns()
            self._link.set_wall_clock(time.time_ns(), now_ns)
            self._say_whether_the_peer_is_heard(now_ns)
            record = ledger_record(self.endpoint, self._sends, now_ns, self._carousel.sent_ledgers)
            record["datagrams"] = {**self._link.counters_dict(), **self._carousel.counters_dict()}
            self._tell("ledger", record)
            self._tell_link(self.endpoint.link_state())
            for key, (budget_bytes, period_ns) in self.endpoint.demands(now_ns).items():
                self._tell(f"demand/{key}", {"budget_bytes": budget_bytes, "period_ns": period_ns})
            if self._trace is not None:
                self._trace.write(record)

    def _say_whether_the_peer_is_heard(self, now_ns: int) -> None:
        """Say it when that changes: a wrong address looks like a link that is down."""
        silent = self.endpoint.silence_ns(now_ns) > _SILENCE_NS
        if silent == self._silent:
            return
        self._silent = silent
        host, port = self._config.peer
        if silent:
            _log.warning("nothing comes from the other side (%s:%d); going on", host, port)
        else:
            _log.info("the other side is heard again")

    def _tell(self, name: str, document: Mapping[str, object], patient_until_s: float = 0.0) -> None:
        """Publish something about the link itself on the local bus; wildcards do not match it."""
        assert self._outlet is not None, "nothing comes in before the bus is open"
        payload = json.dumps(document, separators=(",", ":")).encode()
        self._outlet.publish(
            f"@straitlink/{name}", payload, "application/json", b"", patient_until_s=patient_until_s
        )

    def _publish(self, key: str, payload: bytes, encoding: str, attachment: bytes) -> None:
        assert self._outlet is not None, "nothing comes in before the bus is open"
        self._outlet.publish(key, payload, encoding, attachment)

    def _is_latest(self, key: str) -> bool:
        """Whether only the newest sample of a key counts."""
        goes_round, rule = self._carousel.is_latest(key), first_match(self._config.endpoint.rules, key)
        if goes_round is not None:
            return goes_round
        return rule is not None and rule.traffic_class.keep is Keep.LATEST

    def _finish_trace(self) -> None:
        self._bins.flush()
        if self._trace is not None:
            now_ns = time.monotonic_ns()
            self._trace.write(ledger_record(self.endpoint, self._sends, now_ns, self._carousel.sent_ledgers))


def _make_estimator(config: ShaperConfig, now_ns: int) -> LinkEstimator:
    max_wire_bytes = config.endpoint.max_datagram_bytes + IP_UDP_BYTES
    if config.estimator == "adaptive":
        adaptive = AdaptiveEstimator(config.bands, now_ns, max_wire_bytes)
        return PredictingEstimator(adaptive, max_wire_bytes) if config.predict else adaptive
    return PresetBands(config.bands, config.pace_ratio, max_wire_bytes, now_ns)


def _capture_ns(stamp: Stamp | None, received_ns: int, unix_minus_monotonic_ns: int) -> int:
    """When a sample was captured, on the monotonic clock: by its stamp if plausible, else its arrival."""
    if stamp is None:
        return received_ns
    capture_ns = stamp.capture_ns - unix_minus_monotonic_ns
    age_ns = received_ns - capture_ns
    return capture_ns if _EARLIEST_CAPTURE_NS < age_ns < _OLDEST_CAPTURE_NS else received_ns


def receipt_document(receipt: Receipt) -> dict[str, object]:
    """A receipt as it is published: the publisher knows its message by the stamp that it attached."""
    return {
        "topic": receipt.key,
        "stage": receipt.stage.value,
        "capture_ns": receipt.tag >> 32,
        "sequence": receipt.tag & 0xFFFF_FFFF,
    }
