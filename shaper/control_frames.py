"""What the two ends tell each other beside messages: reports, confirmations, receipts, ledgers."""

from __future__ import annotations

from shaper.datagram import append_estimate, append_known, append_ledger, append_receipt, append_report
from shaper.estimate_exchange import EstimateExchange
from shaper.events import LinkState
from shaper.frames import EstimateFrame, KnownFrame, LedgerFrame, PaddingFrame, ReceiptFrame
from shaper.incoming import Incoming
from shaper.ledger_exchange import LedgerExchange
from shaper.outgoing import Outgoing
from shaper.path import Content
from shaper.timers import Timers

_CONFIRMATIONS_PER_DATAGRAM = 32  # topics or messages at a time; more wait for the next datagram


class ControlFrames:
    """Puts them into datagrams that leave, and takes them out of those that come. epoch: our own."""

    def __init__(self, epoch: int, outgoing: Outgoing, timers: Timers) -> None:
        self.ledgers = LedgerExchange(epoch)
        self.estimates = EstimateExchange()
        self._epoch = epoch
        self._outgoing = outgoing
        self._timers = timers

    def append(
        self, out: bytearray, incoming: Incoming, now_ns: int, *, report_due: bool
    ) -> tuple[Content, ...]:
        """Append what the peer is to be told of its messages; what wants to know whether that arrives."""
        if incoming.has_unreported and (report_due or self._timers.may_piggyback(now_ns)):
            append_report(out, incoming.take_report())
            self._timers.reported_at_ns = now_ns
        if incoming.has_to_confirm:
            append_known(out, incoming.take_known(_CONFIRMATIONS_PER_DATAGRAM))
        if not incoming.has_receipts:
            return ()
        frame, content = incoming.take_receipts(_CONFIRMATIONS_PER_DATAGRAM)
        append_receipt(out, frame)
        return (content,)

    def append_beat(self, out: bytearray, incoming: Incoming, state: LinkState, now_ns: int) -> None:
        """Append what our direction is taken for, and counters that have changed, some at a time."""
        estimate = self.estimates.take(state, now_ns)
        if estimate is not None:
            append_estimate(out, estimate)
        for ledger in self.ledgers.take(self._outgoing, incoming):
            append_ledger(out, ledger)

    def on_peer_restarted(self) -> None:
        """The peer has to be told everything anew, and has told nothing."""
        self.ledgers.on_peer_restarted()
        self.estimates.on_peer_restarted()

    def on_frame(
        self,
        frame: PaddingFrame | EstimateFrame | KnownFrame | ReceiptFrame | LedgerFrame,
        incoming: Incoming,
        now_ns: int,
    ) -> None:
        """Take what the peer tells, unless it speaks to our former self."""
        if isinstance(frame, PaddingFrame):  # it only makes a datagram larger
            return
        if isinstance(frame, EstimateFrame):
            self.estimates.on_frame(frame, now_ns)
        elif isinstance(frame, LedgerFrame) and frame.sent_half:
            self.ledgers.on_sent_half(frame, incoming)
        elif frame.epoch != self._epoch:
            return
        elif isinstance(frame, KnownFrame):
            self._outgoing.on_known(frame.topic_ids)
        elif isinstance(frame, ReceiptFrame):
            for topic_id, number, outcome in frame.receipts:
                self._outgoing.on_outcome(topic_id, number, outcome)
        else:
            self.ledgers.on_received_half(frame, self._outgoing)
