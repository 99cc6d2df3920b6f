"""One chaos mission from its seed: storm, calm, and what is asked of both."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from netem_scripts.event_loop import EventLoop
from netem_scripts.link import Link
from shaper.frames import IP_UDP_BYTES
from shaper.handshake import Side
from shaper.link_key import make_link_key
from shaper.secure_channel import Address
from straitlink.chaos.faults import (
    CALM_NS,
    CLOCK_STEP_NS,
    NS_PER_S,
    STORM_NS,
    Fault,
    FaultKind,
    draw_direction,
    draw_faults,
)
from straitlink.chaos.host import ChaosHost
from straitlink.chaos.invariants import (
    MAX_ELEMENTS,
    MAX_ELEMENTS_IN_CALM,
    BrokenInvariant,
    Fates,
    check_elements,
)

_CONFIGURED: dict[Side, Address] = {"robot": ("10.0.0.1", 9001), "operator": ("10.0.0.2", 9002)}
_OFFERS = (  # class, payload bytes at most, mean interval in ms, reliable
    ("command", 80, 400, True),
    ("plan", 6000, 3000, True),
    ("emergency", 20, 8000, True),
    ("heartbeat", 64, 500, False),
    ("state", 120, 500, False),
    ("perception", 5000, 2000, False),
)
_CAPTURED = 50
_STRANGER: Address = ("203.0.113.1", 666)
_RELAY_NS = 4 * NS_PER_S


class ChaosError(Exception):
    """An invariant was broken; the message ends with the command that shows it again."""


@dataclass(frozen=True, slots=True)
class ChaosReport:
    """What a mission was made of, to see that it was one. digest: of all that crossed the link."""

    seed: int
    kills: int
    offered: int
    delivered: int
    lost: int
    digest: str


def run_chaos(seed: int) -> ChaosReport:
    """Run the mission of a seed; same seed, same bytes. Raises ChaosError.

    Odd seeds estimate the link from what it shows, even ones from presets.
    """
    chaos = _Chaos(seed)
    try:
        return chaos.run()
    except Exception as error:
        what = str(error) if isinstance(error, BrokenInvariant) else repr(error)
        at_s = chaos.loop.now_ns / NS_PER_S
        command = f"straitlink chaos --seed {seed}"
        raise ChaosError(f"seed {seed} at {at_s:.3f} s: {what}; again with: {command}") from error


class _Chaos:
    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.loop = EventLoop()
        self._rng = rng = random.Random(seed)
        key = make_link_key(rng.randbytes)
        self.hosts: dict[Side, ChaosHost] = {
            side: ChaosHost(
                side, key, _CONFIGURED, random.Random(rng.getrandbits(64)), adaptive=seed % 2 == 1
            )
            for side in _CONFIGURED
        }
        robot, operator = self.hosts.values()
        robot.own_fates = operator.other_fates = Fates("down")
        operator.own_fates = robot.other_fates = Fates("up")
        self._links = {
            side: Link(draw_direction(rng), random.Random(rng.getrandbits(64))) for side in _CONFIGURED
        }
        self._mtu_bytes = 1500
        self._relayed_until_ns: dict[Side, int] = dict.fromkeys(_CONFIGURED, 0)
        self._captured: list[tuple[bytes, Address]] = []
        self._tag = 0
        self._kills = 0
        self._digest = hashlib.sha256()

    def run(self) -> ChaosReport:
        for host in self.hosts.values():
            self._start(host)
        for fault in draw_faults(self._rng):
            self.loop.call_at(fault.at_ns, partial(self._befall, fault))
        for side in self.hosts:
            for row in _OFFERS:
                self._offer_later(side, *row)
        self._tell_time()
        self.loop.run_until(STORM_NS + CALM_NS // 2)
        self._check_that_both_carry()
        self.loop.run_until(STORM_NS + CALM_NS)
        return self._finish()

    # Processes.

    def _start(self, host: ChaosHost) -> None:
        if host.link is None:
            host.start(self.loop.now_ns)
            self._pump(host)

    def _pump(self, host: ChaosHost) -> None:
        was_alive = host.link is not None
        host.pump(self.loop.now_ns, self._send)
        if was_alive and host.link is None:  # died in the middle of a delivery
            self._kills += 1
            self.loop.call_at(self.loop.now_ns + NS_PER_S // 100, partial(self._start, host))
        elif host.wakeup_ns is not None:
            if host.wakeup_ns <= self.loop.now_ns:
                raise BrokenInvariant(f"the {host.side}'s side asks to be woken at once: it would spin")
            self.loop.call_at(host.wakeup_ns, partial(self._on_timer, host, host.wakeup_ns))

    def _on_timer(self, host: ChaosHost, when_ns: int) -> None:
        if host.link is not None and host.wakeup_ns == when_ns:
            host.wakeup_ns = None
            host.link.on_timer(host.local_ns(when_ns))
            self._pump(host)

    # The link.

    def _send(self, data: bytes, source: Address, to: Address) -> None:
        self._digest.update(data)
        if len(self._captured) < _CAPTURED:
            self._captured.append((data, to))
        else:
            self._captured[self._rng.randrange(_CAPTURED)] = data, to
        if len(data) + IP_UDP_BYTES > self._mtu_bytes:
            return
        side = next(s for s, host in self.hosts.items() if host.address == source)
        passage = self._links[side].transmit(len(data), self.loop.now_ns)
        for arrival_ns in passage.arrivals_ns:
            arrived = data
            if passage.corrupted_bit is not None:
                at, bit = divmod(passage.corrupted_bit, 8)
                arrived = data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :]
            self.loop.call_at(arrival_ns, partial(self._arrive, arrived, source, to))

    def _arrive(self, data: bytes, source: Address, to: Address) -> None:
        for host in self.hosts.values():
            if host.address == to and host.link is not None:
                now_ns = self.loop.now_ns
                if now_ns < self._relayed_until_ns[host.side]:
                    host.link.receive(data, _STRANGER, host.local_ns(now_ns))
                host.link.receive(data, source, host.local_ns(now_ns))
                self._pump(host)

    # The publishers.

    def _offer_later(self, side: Side, kind: str, most_bytes: int, mean_ms: int, reliable: bool) -> None:
        wait_ns = 1 + round(self._rng.expovariate(1 / (mean_ms * 1_000_000)))
        at_ns = self.loop.now_ns + wait_ns
        if at_ns < STORM_NS + CALM_NS // 3:
            self.loop.call_at(at_ns, partial(self._offer, side, kind, most_bytes, mean_ms, reliable))

    def _offer(self, side: Side, kind: str, most_bytes: int, mean_ms: int, reliable: bool) -> None:
        self._put(side, kind, self._rng.randrange(most_bytes), reliable)
        self._offer_later(side, kind, most_bytes, mean_ms, reliable)

    def _put(self, side: Side, kind: str, size_bytes: int, reliable: bool) -> int:
        self._tag += 1
        host = self.hosts[side]
        payload = self._tag.to_bytes(8, "little") + self._rng.randbytes(size_bytes)
        host.offer(f"{side}/{kind}/a", payload, self._tag, self.loop.now_ns, reliable=reliable)
        self._pump(host)
        return self._tag

    def _tell_time(self) -> None:
        """Daemons look at the wall clock once a second."""
        for host in self.hosts.values():
            if host.link is not None:
                host.link.set_wall_clock(host.unix_ns(self.loop.now_ns), host.local_ns(self.loop.now_ns))
                check_elements(host.link, MAX_ELEMENTS)
        self.loop.call_at(self.loop.now_ns + NS_PER_S, self._tell_time)

    # What goes wrong.

    def _befall(self, fault: Fault) -> None:
        host = self.hosts[fault.side]
        acts: dict[FaultKind, Callable[[ChaosHost, int], None]] = {
            FaultKind.KILL: self._kill,
            FaultKind.MOVE: self._move,
            FaultKind.CLOCK: self._step_clock,
            FaultKind.MTU: self._set_mtu,
            FaultKind.HOSTILE: self._be_hostile,
            FaultKind.RELAY: self._relay,
        }
        acts[fault.kind](host, fault.amount)

    def _kill(self, host: ChaosHost, wait_ms: int) -> None:
        if host.link is None:
            return
        if wait_ms == 1:
            host.kill_while_delivering()
            return
        self._kills += 1
        host.kill()
        self.loop.call_at(self.loop.now_ns + wait_ms * 1_000_000, partial(self._start, host))

    def _move(self, host: ChaosHost, amount: int) -> None:
        host.address = f"10.1.{amount >> 8 & 0xFF}.{amount & 0xFF}", 1024 + (amount >> 16)

    def _step_clock(self, host: ChaosHost, amount: int) -> None:
        host.unix_offset_ns += CLOCK_STEP_NS if amount & 1 else -CLOCK_STEP_NS

    def _set_mtu(self, _host: ChaosHost, amount: int) -> None:
        self._mtu_bytes = amount

    def _relay(self, host: ChaosHost, amount: int) -> None:
        self._relayed_until_ns[host.side] = self.loop.now_ns + amount % _RELAY_NS

    def _be_hostile(self, host: ChaosHost, amount: int) -> None:
        rng = random.Random(amount)
        for _ in range(20):
            if host.link is None or not self._captured:
                return
            data, _ = rng.choice(self._captured)
            how = rng.randrange(4)
            if how == 1:
                data = data[: rng.randrange(len(data))]
            elif how == 2:
                at = rng.randrange(len(data))
                data = data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]
            elif how == 3:
                data = rng.randbytes(len(data))
            source = _STRANGER if rng.random() < 0.5 else host.link.channel.peer_address
            host.link.receive(data, source, host.local_ns(self.loop.now_ns))
            self._pump(host)

    # The end.

    def _check_that_both_carry(self) -> None:
        """Half-way through the calm a command must cross each way within three seconds."""
        tags = {side: self._put(side, "command", 10, True) for side in self.hosts}
        self.loop.run_until(self.loop.now_ns + 3 * NS_PER_S)
        for side, tag in tags.items():
            fate = self.hosts[side].own_fates.fates.get(tag)
            if fate is None or not fate.deliveries:
                raise BrokenInvariant(f"the {side}'s side carries nothing although the link is well again")

    def _finish(self) -> ChaosReport:
        offered = delivered = 0
        for host in self.hosts.values():
            host.own_fates.check_end()
            offered += len(host.own_fates.fates)
            delivered += sum(fate.deliveries for fate in host.own_fates.fates.values())
            assert host.link is not None, "whoever was killed was started again"
            check_elements(host.link, MAX_ELEMENTS_IN_CALM)
            for key, ledger in host.link.endpoint.sent_ledgers().items():
                if ledger.queued:
                    raise BrokenInvariant(f"{key}: {ledger.queued} messages are still open in the ledger")
        robot = self.hosts["robot"].link
        if robot is None or robot.watch is None or robot.watch.lost:
            raise BrokenInvariant("the robot's side still takes the operator for lost")
        lost = offered - delivered
        return ChaosReport(self.seed, self._kills, offered, delivered, lost, self._digest.hexdigest())
