"""The estimator: three states, and what each does with what happens. See docs/link_estimation.md.

probe    trains of small datagrams are sent at a cautious rate, until their spacing tells the true one
run      departures follow the virtual queue; arrivals correct it, the rate and the delay of the empty link
hold     the peer is silent, its queue grows, or a report is overdue: a trickle leaves, and is timed
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice

from shaper.estimation.bands import Bands
from shaper.estimation.baseline import Baseline
from shaper.estimation.dispersion import RISE_RATIO, Dispersion
from shaper.estimation.flights import Flight, Flights
from shaper.estimation.followed_rate import FollowedRate
from shaper.estimation.ideas import Ideas
from shaper.estimation.new_band import NewBand
from shaper.estimation.overdue import is_overdue
from shaper.estimation.round_trips import RoundTrips
from shaper.estimation.silence import HICCUP_NS, Silence
from shaper.estimation.sizes import TRAIN_BYTES, full_bytes, train_bytes
from shaper.estimation.standstill import Standstill
from shaper.estimation.states import Input, State, follow
from shaper.estimation.trains import TRAIN_DATAGRAMS, TRAIN_INTERVAL_NS, Trains, probing_bps
from shaper.estimation.trickle import TRICKLE_BYTES, pace_trickle
from shaper.estimation.virtual_queue import VirtualQueue
from shaper.estimation.way_back import WayBack
from shaper.link_estimator import PresetBand
from shaper.path import HeardPacket, ReportedPacket, SentPacket

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000

START_BPS = 60_000  # assumed until the first train is reported; MIT's thin band with room for a heartbeat
LEAST_BPS, MOST_BPS = 2_000, 100_000_000
ALLOWANCE_NS = 3_600_000  # queue that is kept so that the link never runs dry, and every spread tells
ALLOWANCE_NOISE = 0.4  # and this much per noise of arrivals
SAME_CAUTION = 1.05  # a band may be so many times slower, though the peer's words take as long as before

REPLIES, REPLY_NS = 3, 40 * NS_PER_MS  # single datagrams between the first trains, to report, so far apart
SAME_RATIO = 1.05  # trains this near the old rate are the old band's, whose delay holds
RISEN_RATIO = 1.5  # trains this much faster than the old rate are another band's
PATIENCE_NS = 500 * NS_PER_MS  # with promises of the peer that may be of a faster band ...
ROOM_NS = 50 * NS_PER_MS  # a full buffer has room for a train after so long ...
LITTLE_LOSS = 0.02  # ... but where more is lost, this train and the next one are two chances
LIGHT_BPS = 36_000  # a train takes a tenth of a second there: thinner links take what has left for one
FRESH_NS = 1 * NS_PER_S  # ... until so long after a change

THIN_BPS = 150_000  # so little leaves there in a round trip that to pause for one would cost more

SAME_NS = 10 * NS_PER_MS  # a delay within this of the old band's says that the band is the old one
SURELY_NS = 25 * NS_PER_MS  # a silent link changed before what the peer's last datagram tells, by about this
QUICKER_NS = 8 * NS_PER_MS  # a delay lower by this is another band, or a higher rate
NOISE_FACTOR = 4.0

ANCHOR_NOISE_NS = 500_000  # one arrival more is looked at per this much noise
SETTLED_NS = 3 * NS_PER_S  # after which a band is worth remembering
FRESH_CONFIDENCE, DOUBTFUL_CONFIDENCE = 0.7, 0.3  # in run, but not settled yet; in probe
_NEVER_NS = 1 << 62
_NO_LIMIT_BYTES = 1 << 40


class AdaptiveEstimator:
    """Implements shaper.link_estimator.LinkEstimator for one sending direction."""

    trickles = True

    def __init__(
        self,
        bands: Sequence[PresetBand] = (),
        now_ns: int = 0,
        max_wire_bytes: int = 1228,
        ideas: Ideas | None = None,
    ) -> None:
        self.pacer = VirtualQueue(START_BPS, ALLOWANCE_NS, now_ns)
        self.state = State.PROBE
        self.in_flight_limit_bytes = _NO_LIMIT_BYTES
        self.rate_bps = START_BPS
        self.loss_ratio = 0.0
        self._max_wire_bytes = max_wire_bytes
        self._ideas = ideas or Ideas()
        self._known_bps: float | None = None  # the rate before the link changed, or now in run
        self._followed = FollowedRate()
        self._flights = Flights()
        self._sent_bits = 0  # those of the pacer that flights account for
        self._dispersion = Dispersion()
        self._baseline = Baseline(now_ns)
        self._silence, self._way_back, self._standstill = Silence(), WayBack(), Standstill()
        self._bands, self._new_band = Bands(), NewBand()
        self._epoch_ns = now_ns  # what leaves from then on meets the present band
        self._settled_from_ns = self._hold_from_ns = now_ns
        self._replies_left = 0
        self._empty_ns = now_ns  # when the virtual queue runs or ran empty
        self._rtts = RoundTrips()
        self._rtt_before_ns = 0  # the shortest one when it came to be held
        self._silent = False  # whether it is the peer's silence for which the link is held
        self._trains = Trains(now_ns, hinted=bool(bands))
        if bands:  # a hint: trains follow each other at the thinnest band's rate until one is reported
            self.rate_bps = min(band.rate_bps for band in bands)
            self.pacer.set(self.rate_bps, 0, now_ns)
        self._hinted, self._reported = bool(bands), False

    # What the endpoint reads.

    @property
    def datagram_bytes(self) -> int:
        return full_bytes(self.rate_bps, self._max_wire_bytes)

    @property
    def band(self) -> str:
        if self.state is not State.RUN:
            return self.state.value
        return "new" if self._bands.current is None else self._bands.current.name

    @property
    def queue_ns(self) -> int:
        return self.pacer.level_ns

    @property
    def confidence(self) -> float:
        if self.state is State.RUN:
            return 1.0 if self._bands.current is not None else FRESH_CONFIDENCE
        return 0.0 if self.state is State.HOLD or self._known_bps is None else DOUBTFUL_CONFIDENCE

    def probe_bytes(self, now_ns: int) -> int:
        if self._silence.heard_ns < 0:
            return 0
        if self.state is State.RUN:
            return train_bytes(self.rate_bps, self._noise_ns, self.datagram_bytes) if self._trains.left else 0
        if self.state is State.PROBE:
            if not self._trains.left and not self._trains.are_needed(now_ns):
                return 0
            return train_bytes(self.pacer.rate_bps, self._noise_ns, self.datagram_bytes)
        return TRAIN_BYTES if self._trains.left else TRICKLE_BYTES

    # What happens.

    def on_sent(self, packet: SentPacket, now_ns: int) -> None:
        pacer = self.pacer
        bits = packet.wire_bytes * 8
        bits_before, self._sent_bits = pacer.sent_bits - self._sent_bits - bits, pacer.sent_bits
        self._flights.on_sent(packet.number, bits, pacer.found_ns, now_ns, max(0, bits_before))
        idle_ns = now_ns - self._empty_ns
        wait_ns = pacer.wait_ns(now_ns)
        self._empty_ns = now_ns + wait_ns
        of_train = self._trains.on_sent(packet.number, pacer, now_ns)
        if self.state is State.PROBE:
            nothing_known = self._known_bps is None and not self._hinted
            self._trains.pace(of_train, self._empty_ns, nothing_known, pacer, now_ns)
        elif self.state is State.HOLD:
            held_ns, rate_bps = now_ns - self._hold_from_ns, self._known_bps or START_BPS
            carried = packet.wire_bytes > TRICKLE_BYTES and self._silent
            rtt_ns, in_train = self._rtt_before_ns, self._trains.left > 0
            pace_trickle(pacer, held_ns, rate_bps, rtt_ns, now_ns, in_train=in_train, carried=carried)
        elif self.state is State.RUN and self._ideas.verify:
            self._baseline.make_pauses(pacer, self._empty_ns, idle_ns, self._apparent_delay_ns, now_ns)

    def on_report(
        self, settled: Sequence[ReportedPacket], rtt_ns: int | None, loss_ratio: float, now_ns: int
    ) -> None:
        self.loss_ratio = loss_ratio
        self._reported = True
        previous = self._flights.acked[-1] if self._flights.acked else None
        arrived = self._flights.on_report(settled)
        if not arrived:
            return
        judged_bps = self._known_bps if self.state is State.RUN else None
        for flight in arrived:
            if previous is not None and flight.number == previous.number + 1:
                self._dispersion.add(previous, flight, judged_bps)
            previous = flight
        if rtt_ns is not None:
            self._rtts.add(rtt_ns, now_ns)
        rate_bps, base_ns = self._known_bps or START_BPS, self._baseline.delay_ns
        is_known = self.state is State.RUN and base_ns is not None
        if not is_known and self._ideas.remainder:
            margin_ns = SAME_NS + NOISE_FACTOR * self._noise_ns
            # The peer's words that date the change may have come in a clump: then it was earlier.
            since_ns = self._epoch_ns if base_ns is None else self._epoch_ns - self._rtts.shortest_ns
            self._new_band.on_arrived(arrived, since_ns, rate_bps, base_ns, margin_ns)
        if self.state is State.RUN:
            self._run(arrived, now_ns)
        else:
            self._find(arrived, now_ns)

    def on_heard(self, packet: HeardPacket, now_ns: int) -> None:
        first = self._silence.heard_ns < 0
        reported, self._reported = self._reported, False
        silence_ns, sent_us, promise_ns = now_ns - self._silence.heard_ns, packet.sent_us, packet.promise_ns
        noise_ns = self._silence.noise_ns
        late, quicker = self._silence.on_heard(packet, now_ns)
        fills = self._way_back.fills(sent_us, promise_ns, self._silence.noise_ns, now_ns)
        if first:
            self._epoch_ns = self.pacer.not_before_ns = now_ns
            self._trains.await_answer(0, now_ns)
            return
        if self.state is State.HOLD and self._silent and now_ns > self._hold_from_ns:
            hiccup = self._silence.unbroken or (silence_ns < HICCUP_NS and not late)
            if hiccup and not fills and self._known_bps is not None:
                self._enter(Input.HICCUP, now_ns)
                self._resume(self._known_bps, now_ns)
            else:
                self._enter(Input.HEARD, now_ns)
                self._begin_probing(now_ns)
                if self._ideas.standstill:
                    self._standstill.end(packet, silence_ns, self._silence.later_ns, noise_ns, now_ns)
                    self.pacer.free_from_ns = now_ns + self._standstill.patience_ns
        elif (late and self._was_silent()) or self._is_another_way_back():
            why = Input.SILENCE if late else Input.QUICKENED
            self._hold(why, self._changed_before_ns(now_ns - silence_ns), now_ns)
            self._enter(Input.HEARD, now_ns)
            self._begin_probing(now_ns)
        elif self.state is State.RUN:
            if quicker and self._ideas.quicker:
                self._trains.doubt(self._rtts.shortest_ns, now_ns)
            self._look_for_more(now_ns)
            self._look_for_overdue(sent_us, reported, now_ns)
            fills = fills and self._baseline.delay_ns is not None  # else it drains, and nothing leaves anyway
            if fills and self._ideas.way_back and self.state is State.RUN:
                self._hold(Input.FILLS, self._changed_before_ns(self._way_back.began_ns), now_ns)
        elif self.state is State.HOLD:
            return
        elif fills and self._trains.enough and self._ideas.way_back and not self._standstill.held:
            # It was no blackout, but another band: its delay and queue were together what the delay had been.
            self._hold(Input.FILLS, self._changed_before_ns(self._way_back.began_ns), now_ns)
        elif self._standstill.is_as_before(packet, now_ns):
            self._send_as_before(now_ns)
        elif now_ns > self.pacer.sent_ns + REPLY_NS and self._replies_left:
            self._replies_left -= 1  # the peer waits to be told of its trains
            self.pacer.free = max(1, self.pacer.free)

    def _is_another_way_back(self) -> bool:
        """A way back that is suddenly shorter is another band's, which may carry less in our direction."""
        known = self.state is State.RUN and self._baseline.delay_ns is not None and self.rate_bps > THIN_BPS
        return known and self._silence.quickened and self._ideas.quickened

    def _was_silent(self) -> bool:
        """What comes late would have been missed, were it not that loss may have taken it."""
        known = self.state is State.RUN and self._baseline.delay_ns is not None
        return known and self._silence.misses > 1 and self._ideas.silence

    def on_peer_restarted(self, now_ns: int) -> None:
        """Its clock is another; the link is not."""
        self._silence.on_peer_restarted()
        self._way_back = WayBack()
        self._flights = Flights()
        self._dispersion.forget()
        self._baseline.restart(now_ns)

    def wakeup_at_ns(self) -> int | None:
        if self._silence.heard_ns < 0:
            return None
        if self.state is State.HOLD:
            return self.pacer.opens_ns()
        if self.state is State.PROBE:
            return min(self._silence_ns(), self._trains.next_at_ns(self.pacer.opens_ns()))
        return self._silence_ns() if self._ideas.silence else None

    def on_timer(self, now_ns: int) -> None:
        if self.state is not State.HOLD and now_ns >= self._silence_ns() and self._ideas.silence:
            self._hold(Input.SILENCE, self._changed_before_ns(self._silence.heard_ns), now_ns)

    def _changed_before_ns(self, heard_ns: int) -> int:
        """The earliest time of a change that the peer's datagram of then does not show."""
        return heard_ns - self._rtts.shortest_ns // 2 - SURELY_NS

    # Probe and hold: find out what the link is now.

    def _find(self, arrived: list[Flight], now_ns: int) -> None:
        """Whether the old band is back, or trains tell a new one."""
        if self._known_bps is not None and self._met_the_old_band(arrived):
            self._enter(Input.UNCHANGED, now_ns)
            self._resume(self._known_bps, now_ns)
            return
        if self._known_bps is None or arrived[-1].sent_ns >= self._hold_from_ns:  # not of the old backlog
            self._trains.on_answer(self._known_bps is None, self._rtts, now_ns)
        rate_bps, same = self._measure()
        if rate_bps is not None:
            self._enter(Input.MEASURED, now_ns)
            if same:
                self._resume(rate_bps, now_ns)
            else:
                self._change(rate_bps, now_ns)
                self._trains.doubt(self._rtts.shortest_ns, now_ns)  # it may be more: trains are few
        elif self.state is State.HOLD and not self._silent:
            self._enter(Input.HEARD, now_ns)
            self._begin_probing(now_ns)
        elif self.state is State.PROBE and self._trains.are_all_reported(arrived[-1].number):
            self._trains.begin(self.pacer)  # they told nothing, and fill nothing
            self.pacer.not_before_ns = now_ns

    def _measure(self) -> tuple[float | None, bool]:
        """The rate by the trains, if they tell one, and whether it is the old band's, with its delay."""
        known_bps = self._known_bps
        told_bps = self._dispersion.of_trains(self._epoch_ns, self._surely_ns, known_bps)
        if known_bps is None or not self._dispersion.still(self._surely_ns, known_bps):
            return told_bps, False
        if told_bps is not None and told_bps >= RISEN_RATIO * known_bps:
            return told_bps, False
        return known_bps, self._baseline.delay_ns is not None and (told_bps or 0.0) < SAME_RATIO * known_bps

    def _met_the_old_band(self, arrived: list[Flight]) -> bool:
        base_ns, rate_bps = self._baseline.delay_ns, self._known_bps
        if base_ns is None or rate_bps is None or not self._ideas.unchanged:
            return False
        margin_ns = SAME_NS + NOISE_FACTOR * self._noise_ns
        newest = arrived[-1]
        return newest.sent_ns >= self._surely_ns and abs(newest.delay_ns(rate_bps) - base_ns) < margin_ns

    @property
    def _surely_ns(self) -> int:
        """What left since then has surely met the present band."""
        return self._hold_from_ns if self._silent else self._epoch_ns

    def _silence_ns(self) -> int:
        """When the peer has been silent for too long. After a change its promises are of the former band."""
        deadline_ns = self._silence.deadline_ns
        if self.state is State.RUN and self._baseline.delay_ns is None:  # it drains: nothing leaves anyway
            deadline_ns = max(deadline_ns, self.pacer.not_before_ns)
        fresh = self.state is State.PROBE or deadline_ns < self._settled_from_ns + FRESH_NS
        return deadline_ns + (PATIENCE_NS if fresh else 0)

    def _begin_probing(self, now_ns: int) -> None:
        """Trains leave at a cautious rate: the link may have become much slower."""
        known_bps = self._known_bps or START_BPS
        cautious_bps = probing_bps(known_bps)
        if self._silent and self._silence.as_ever:  # a blackout, more likely than another band
            cautious_bps = known_bps / SAME_CAUTION
            self._trains.need_no_more()
        first = self._flights.first_since(self._epoch_ns)
        queue_ns = 0 if first is None else self._flights.simulate(cautious_bps, first, 0, now_ns)
        self.pacer.set(_whole(cautious_bps), queue_ns, now_ns, _whole(known_bps))
        self.pacer.not_before_ns = now_ns
        self._trains.begin(self.pacer)
        self._replies_left = REPLIES
        self._trains.await_answer(self._rtts.newest_ns, now_ns)

    def _send_as_before(self, now_ns: int) -> None:
        """The link has been away, with all that it held: it serves that first, as fast as before."""
        cautious_bps = (self._known_bps or START_BPS) / SAME_CAUTION
        served_ns = now_ns - self._standstill.ended_ns + self._rtt_before_ns // 2
        held_ns = int(self._flights.bits_since(self._epoch_ns) * 1e9 / cautious_bps)
        left_ns = max(0, held_ns - served_ns)
        self._trains.stop(self.pacer)
        self._trains.need_no_more()
        self.pacer.set(_whole(cautious_bps), left_ns, now_ns)
        self.pacer.not_before_ns = now_ns
        self._empty_ns = now_ns + left_ns

    def _hold(self, why: Input, since_ns: int, now_ns: int) -> None:
        """Send no more than a trickle. since_ns: when the link may have changed."""
        self._enter(why, now_ns)
        self._epoch_ns = max(self._epoch_ns, since_ns)
        self._new_band.restart()
        self._standstill = Standstill()
        self._hold_from_ns, self._rtt_before_ns = now_ns, self._rtts.shortest_ns
        self._silent = why in (Input.SILENCE, Input.QUICKENED)
        self._silence.deadline_ns = _NEVER_NS
        left = self._flights.count_since(self._epoch_ns)
        if left < TRAIN_DATAGRAMS or (self._known_bps or 0.0) > LIGHT_BPS:
            self._trains.begin(self.pacer)
            self.pacer.free_from_ns = now_ns + (ROOM_NS if self.loss_ratio < LITTLE_LOSS else 0)
        self.pacer.allowance_ns = _NEVER_NS
        self.pacer.not_before_ns = now_ns

    # Run: keep the queue short, the rate right, and notice changes.

    def _run(self, arrived: list[Flight], now_ns: int) -> None:
        rate_bps = self._known_bps
        assert rate_bps is not None, "run knows the rate"
        noise_ns = self._noise_ns
        fallen_ns = max(self._baseline.lower(flight.delay_ns(rate_bps)) for flight in arrived)
        if fallen_ns > QUICKER_NS + NOISE_FACTOR * noise_ns and self._ideas.quicker:
            self._dispersion.forget_before(arrived[-1].sent_ns)
            self._trains.doubt(self._rtts.shortest_ns, now_ns)
        fallen_bps = self._dispersion.fallen(rate_bps)
        if fallen_bps is not None:
            self._enter(Input.FALL, now_ns)
            self._epoch_ns = arrived[0].sent_ns
            self._change(fallen_bps, now_ns)
            return
        risen_bps = self._dispersion.risen(rate_bps)
        if risen_bps is not None and risen_bps < RISE_RATIO * rate_bps:
            rate_bps = risen_bps  # the band is as before, only known better
            self._followed.restart(rate_bps)
            self._set_rate(rate_bps)
        elif risen_bps is not None:
            if self._ideas.bands:
                risen_bps = self._bands.likely(risen_bps, self._rtts.newest_ns)
            self._enter(Input.RISE, now_ns)
            self._epoch_ns = arrived[0].sent_ns
            self._change(risen_bps, now_ns)
            self._trains.doubt(self._rtts.shortest_ns, now_ns)
            return
        average_bps = self._dispersion.average(rate_bps)
        if average_bps is not None:
            if self._baseline.delay_ns is None and self._flights.hold_from_before(self._settled_from_ns):
                self._followed.restart(average_bps)
            rate_bps, beyond = self._followed.follow(rate_bps, average_bps)
            if beyond:
                self._trains.doubt(self._rtts.shortest_ns, now_ns)
            self._set_rate(rate_bps)
        if self._ideas.gaps:
            newest_first = islice(reversed(self._flights.acked), len(arrived) + 1)
            self._baseline.look_for_idle(newest_first, rate_bps, noise_ns)
        if self._baseline.on_arrived(arrived, rate_bps, noise_ns, now_ns) or not self._baseline.pausing:
            self._anchor(now_ns)
        elif self._baseline.delay_ns is None:
            self._drain(rate_bps, now_ns)
        if now_ns - self._settled_from_ns > SETTLED_NS:
            self._bands.settle(rate_bps, self._rtts.shortest_ns)

    def _drain(self, rate_bps: float, now_ns: int) -> None:
        """Correct the queue whose end is awaited by what arrives of it."""
        wait_ns = self.pacer.wait_ns(now_ns)
        if self._flights.most_queue_ns(rate_bps) < wait_ns:
            self._await_empty(self._flights.most_queue_ns(rate_bps), now_ns)
        elif self._flights.hold_from_before(self._settled_from_ns):
            left_ns = self._new_band.queue_ns(self._flights, rate_bps, now_ns)
            if left_ns > wait_ns + SAME_NS + NOISE_FACTOR * self._noise_ns:
                self._await_empty(left_ns, now_ns)

    def _anchor(self, now_ns: int) -> None:
        """Set the virtual queue by the newest arrivals: by the least late of some, as noise only adds."""
        base_ns, rate_bps = self._baseline.delay_ns, self._known_bps
        if base_ns is None or rate_bps is None or not self._ideas.anchor:
            return
        looked_at = min(8, 1 + int(self._noise_ns / ANCHOR_NOISE_NS), len(self._flights.acked))
        best = self._flights.least_late(looked_at, rate_bps)
        wait_ns = max(0, best.delay_ns(rate_bps) - base_ns)
        self._set_queue(self._flights.simulate(rate_bps, best, wait_ns, now_ns), now_ns)

    def _change(self, rate_bps: float, now_ns: int) -> None:
        """The link carries another rate since the epoch; its delay may be another too."""
        rate_bps = min(MOST_BPS, max(LEAST_BPS, rate_bps))
        self._bands.leave()
        self._followed.restart(rate_bps)
        self._settled_from_ns = now_ns
        self._set_rate(rate_bps)
        self._dispersion.forget()
        first = self._flights.first_since(self._epoch_ns)
        queue_ns = 0 if first is None else self._flights.simulate(rate_bps, first, 0, now_ns)
        self._await_empty(max(queue_ns, self._new_band.queue_ns(self._flights, rate_bps, now_ns)), now_ns)
        self._rtts.forget_all_but_the_newest()

    def _resume(self, rate_bps: float, now_ns: int) -> None:
        """The band is the old one; of a queue whose end was awaited, the wait goes on."""
        self._set_rate(rate_bps)
        if self._baseline.delay_ns is None:
            self._await_empty(min(self.pacer.wait_ns(now_ns), self._flights.most_queue_ns(rate_bps)), now_ns)
            return
        newest = self._flights.acked[-1]  # there is one: by such the delay is known
        wait_ns = max(0, newest.delay_ns(rate_bps) - self._baseline.delay_ns)
        self._set_queue(self._flights.simulate(rate_bps, newest, wait_ns, now_ns), now_ns)
        self.pacer.not_before_ns = now_ns

    def _await_empty(self, queue_ns: int, now_ns: int) -> None:
        """Pause until the link holds nothing, to learn its delay."""
        self._set_queue(queue_ns, now_ns)
        self.pacer.pause(now_ns + queue_ns + self._baseline.pause_ns)
        self._baseline.restart(self.pacer.not_before_ns)

    def _look_for_overdue(self, peer_us: int, reported: bool, now_ns: int) -> None:
        """Hold if the peer has spoken at this time of its clock, and said nothing of what had arrived."""
        base_ns, rate_bps = self._baseline.delay_ns, self._known_bps
        if base_ns is None or rate_bps is None or not self._baseline.verified or not self._ideas.overdue:
            return
        unreported = self._flights.unreported
        misses = self._silence.needed_misses(self.loss_ratio), 0 if reported else self._silence.misses
        if is_overdue(unreported, misses, base_ns, rate_bps, self._noise_ns, peer_us):
            self._hold(Input.OVERDUE, unreported[0].sent_ns, now_ns)

    def _look_for_more(self, now_ns: int) -> None:
        """A train now and then, while it is in doubt whether the link carries more than it did."""
        length = self._trains.next_length(
            self.pacer.not_before_ns, self._rtts.newest_ns, self._noise_ns, now_ns
        )
        if length:
            self._trains.begin(self.pacer, length)

    @property
    def _noise_ns(self) -> float:
        """Sigma of one arrival."""
        return 0.7 * self._dispersion.noise_ns

    def _apparent_delay_ns(self) -> int:
        """The empty link's delay by the newest arrivals, should the virtual queue be right."""
        if self._known_bps is None or not self._flights.acked:
            return -_NEVER_NS
        best = self._flights.least_late(10, self._known_bps)
        return best.delay_ns(self._known_bps) - best.wait_ns

    def _enter(self, happened: Input, now_ns: int) -> None:
        self.state = follow(self.state, happened)
        self.in_flight_limit_bytes = 0 if self.state is State.HOLD else _NO_LIMIT_BYTES
        self._trains.stop(self.pacer)
        self.pacer.urgent_from_ns = now_ns
        self.pacer.allowance_ns = ALLOWANCE_NS + int(ALLOWANCE_NOISE * self._noise_ns)

    def _set_rate(self, rate_bps: float) -> None:
        self._trains.interval_ns = TRAIN_INTERVAL_NS
        self._known_bps = rate_bps
        self.rate_bps = _whole(rate_bps)

    def _set_queue(self, wait_ns: int, now_ns: int) -> None:
        self.pacer.set(self.rate_bps, wait_ns, now_ns)
        self._empty_ns = now_ns + wait_ns


def _whole(rate_bps: float) -> int:
    return max(LEAST_BPS, int(rate_bps))
