"""Two endpoints joined by hand: offer, transfer, drop, advance.

True time starts at 0 and moves only by `step` and `advance`. Each side's clock has its own offset, so
nothing can work by accident of agreeing clocks. Datagrams are underway for the sender's `delay_ns`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from shaper.datagram import decode_datagram
from shaper.endpoint import Endpoint
from shaper.endpoint_settings import EndpointSettings
from shaper.events import Delivered, Event, LinkState, PeerStarted, Receipt
from shaper.frames import Frame, Header
from shaper.incoming import Limits
from shaper.link_estimator import LinkEstimator, PresetBand, PresetBands
from shaper.pump import pump
from shaper.traffic_class import DEFAULT_CLASSES, TopicRule
from shaper.wire_type import Encodings

MS = 1_000_000
S = 1_000_000_000
HOUR = 3600 * S
UNIX_NS = 1_750_000_000 * S  # the wall clock, the same on both hosts, at true time 0

RULES = tuple(
    TopicRule(f"*/{name}/**" if name not in ("emergency", "heartbeat") else f"*/{name}", traffic_class)
    for name, traffic_class in DEFAULT_CLASSES.items()
)
"""One rule per built-in class: "robot/heartbeat", "robot/state/...", "robot/bulk/..." and so on."""

FAST = PresetBand("fast", 1_000_000, 50 * MS)
THIN = PresetBand("thin", 100_000, 500 * MS)


@dataclass
class Side:
    """One host: its endpoint, its clock, what it has sent and what it was told."""

    endpoint: Endpoint
    offset_ns: int
    delay_ns: int
    underway: list[tuple[int, bytes]] = field(default_factory=list)  # (arrival in true time, datagram)
    sent: list[tuple[int, bytes]] = field(default_factory=list)  # (true time, datagram), everything ever
    events: list[Event] = field(default_factory=list)
    wakeup_ns: int = 0  # true time
    loses: Callable[[bytes], bool] = lambda datagram: False
    copies: Callable[[], tuple[int, ...]] = lambda: (0,)  # extra delay of each copy of the next datagram

    def local_ns(self, true_ns: int) -> int:
        return true_ns + self.offset_ns

    @property
    def delivered(self) -> list[Delivered]:
        return [e for e in self.events if isinstance(e, Delivered)]

    @property
    def payloads(self) -> list[bytes]:
        return [e.payload for e in self.delivered]

    @property
    def receipts(self) -> list[Receipt]:
        return [e for e in self.events if isinstance(e, Receipt)]

    def stages(self, tag: int) -> list[str]:
        """What was told of a reliable message, in order."""
        return [e.stage.value for e in self.receipts if e.tag == tag]

    @property
    def peer_starts(self) -> list[PeerStarted]:
        return [e for e in self.events if isinstance(e, PeerStarted)]

    @property
    def link_states(self) -> list[LinkState]:
        return [e for e in self.events if isinstance(e, LinkState)]

    @property
    def decoded(self) -> list[tuple[Header, list[Frame]]]:
        """Everything that this side has ever sent, taken apart."""
        return [decode_datagram(datagram) for _, datagram in self.sent]

    def frames(self, kind: type[Frame]) -> list[Frame]:
        return [frame for _, frames in self.decoded for frame in frames if isinstance(frame, kind)]


class Pair:
    """A robot and an operator. `met=False` starts them as strangers; else they have exchanged reports."""

    def __init__(
        self,
        *,
        bands: tuple[PresetBand, ...] = (FAST,),
        delay_ns: int | None = None,
        rules: tuple[TopicRule, ...] = RULES,
        accept: tuple[str, ...] = ("**",),
        limits: Limits | None = None,
        guaranteed: Mapping[int, float] | None = None,
        encodings: Encodings | None = None,
        robot_offset_ns: int = 3 * HOUR,
        operator_offset_ns: int = 7 * HOUR + 123_456_789,
        met: bool = True,
    ) -> None:
        self.now_ns = 0
        self._bands = bands
        self._settings = EndpointSettings(
            rules,
            accept,
            limits=limits or Limits(),
            guaranteed=guaranteed or {},
            encodings=encodings or {},
        )
        self._epochs = 100
        delay_ns = bands[0].one_way_delay_ns if delay_ns is None else delay_ns
        self.robot = Side(self._start(robot_offset_ns), robot_offset_ns, delay_ns)
        self.operator = Side(self._start(operator_offset_ns), operator_offset_ns, delay_ns)
        if met:
            self.advance(6 * delay_ns + 1 * S)
            self.forget_history()

    # What a story is told with.

    def offer(
        self,
        side: Side,
        key: str,
        payload: bytes = b"x",
        *,
        age_ns: int = 0,
        encoding: str = "",
        tag: int = 0,
        pumped: bool = True,
    ) -> bool:
        """A publisher on this side has a message, captured `age_ns` ago."""
        now_ns = side.local_ns(self.now_ns)
        more = side.endpoint.offer(key, payload, now_ns - age_ns, now_ns, encoding, tag)
        if pumped:
            self.pump(side)
        return more

    def transfer(self, side: Side) -> None:
        """Everything of this side's that is underway arrives now."""
        underway, side.underway = side.underway, []
        for _, datagram in underway:
            self.receive(self.other(side), datagram)

    def drop(self, side: Side) -> int:
        """Everything of this side's that is underway is lost; how many datagrams that was."""
        count = len(side.underway)
        side.underway.clear()
        return count

    def advance(self, duration_ns: int) -> None:
        """Let time pass: deliver what arrives, call the timers that run out."""
        until_ns = self.now_ns + duration_ns
        while self.next_ns() <= until_ns:
            self.step()
        self.now_ns = until_ns

    def step(self) -> None:
        """Jump to whatever comes next, an arrival or a wake-up, and let it happen."""
        next_ns = self.next_ns()
        self.now_ns = max(self.now_ns, next_ns)
        for side in (self.robot, self.operator):
            arrived = [d for at_ns, d in side.underway if at_ns <= self.now_ns]
            side.underway = [(at_ns, d) for at_ns, d in side.underway if at_ns > self.now_ns]
            for datagram in arrived:
                self.receive(self.other(side), datagram)
        for side in (self.robot, self.operator):
            if side.wakeup_ns <= self.now_ns:
                side.endpoint.on_timer(side.local_ns(self.now_ns))
                self.pump(side)

    def restart(self, side: Side) -> None:
        """Kill one daemon and start it anew; what is underway stays so."""
        side.endpoint = self._start(side.offset_ns)
        side.events.clear()
        side.wakeup_ns = self.now_ns

    # What the story is made of.

    def pump(self, side: Side) -> None:
        def send(datagram: bytes) -> None:
            side.sent.append((self.now_ns, datagram))
            if not side.loses(datagram):
                for extra_ns in side.copies():
                    side.underway.append((self.now_ns + side.delay_ns + extra_ns, datagram))

        wakeup_ns = pump(side.endpoint, side.local_ns(self.now_ns), send, side.events.append)
        side.wakeup_ns = wakeup_ns - side.offset_ns
        assert side.wakeup_ns > self.now_ns, "a drained endpoint asks to be woken now: it would spin"

    def receive(self, side: Side, datagram: bytes) -> None:
        side.endpoint.receive_datagram(datagram, side.local_ns(self.now_ns))
        self.pump(side)

    def other(self, side: Side) -> Side:
        return self.operator if side is self.robot else self.robot

    def next_ns(self) -> int:
        arrivals = [at_ns for side in (self.robot, self.operator) for at_ns, _ in side.underway]
        return min([*arrivals, self.robot.wakeup_ns, self.operator.wakeup_ns])

    def forget_history(self) -> None:
        for side in (self.robot, self.operator):
            side.sent.clear()
            side.events.clear()

    def _start(self, offset_ns: int) -> Endpoint:
        self._epochs += 1
        estimator: LinkEstimator = PresetBands(self._bands)
        return Endpoint(
            self._settings, estimator, self._epochs, self.now_ns + offset_ns, UNIX_NS + self.now_ns
        )
