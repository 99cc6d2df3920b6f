"""Thirty missions in which everything goes wrong; `make test-thorough` flies five hundred."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace
from typing import cast

import pytest

from shaper.events import Delivered, Receipt, ReceiptStage
from shaper.ledger import SentLedger
from shaper.link_end import LinkEnd
from shaper.whereabouts import Address
from straitlink.chaos import ChaosError, run_chaos
from straitlink.chaos.host import ChaosHost
from straitlink.chaos.invariants import BrokenInvariant, Fates


@pytest.mark.parametrize("first", range(0, 50, 10))
def test_no_reliable_message_is_lost_or_doubled_whatever_happens(first: int) -> None:
    reports = [run_chaos(seed) for seed in range(first, first + 10)]
    assert sum(r.kills for r in reports) > 20
    assert sum(r.delivered for r in reports) > 1000


def test_the_same_seed_gives_the_same_bytes() -> None:
    assert run_chaos(3) == run_chaos(3)


def test_a_broken_invariant_names_the_seed_and_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    """A shaper that forgets what it has delivered: the missions must notice."""
    start = ChaosHost.start

    def start_without_journal(self: ChaosHost, true_ns: int) -> None:
        self._journal._theirs.clear()
        start(self, true_ns)

    monkeypatch.setattr(ChaosHost, "start", start_without_journal)
    with pytest.raises(ChaosError, match=r"seed \d+ at .*given twice.*straitlink chaos --seed \d+"):
        for seed in range(20):
            run_chaos(seed)


def delivery(tag: int) -> Delivered:
    return Delivered("a", tag.to_bytes(8, "little"), "", 0, None, None, None)


@pytest.mark.parametrize(
    ("events", "reason"),
    [
        ([delivery(1), delivery(1)], "given twice"),
        ([delivery(2), delivery(1)], "after a later one"),
        ([delivery(3)], "never put there"),
        ([Receipt("a", 1, ReceiptStage.DELIVERED)], "told delivered, given 0 times"),
        ([delivery(1), Receipt("a", 1, ReceiptStage.EXPIRED)], "told expired, given 1 times"),
        ([], "nobody ever told"),
    ],
)
def test_each_invariant_can_be_broken(events: list[Delivered | Receipt], reason: str) -> None:
    fates = Fates("down")
    fates.offered("a", 1)
    fates.offered("a", 2)
    with pytest.raises(BrokenInvariant, match=reason):
        for event in events:
            fates.delivered(event) if isinstance(event, Delivered) else fates.told(event)
        fates.check_end()


def sender(**counters: int) -> LinkEnd:
    """A link end of which only the ledgers are looked at."""
    ledger = SentLedger(offered=5, **counters)
    return cast(LinkEnd, SimpleNamespace(endpoint=SimpleNamespace(sent_ledgers=lambda: {"a": ledger})))


def test_a_ledger_that_counts_what_nobody_was_told_is_noticed() -> None:
    fates = Fates("down")
    fates.offered("a", 1)
    fates.told(Receipt("a", 1, ReceiptStage.EXPIRED))
    fates.check_ledgers(sender(expired=1))
    with pytest.raises(BrokenInvariant, match="counts 1 sent, told were 0"):
        fates.check_ledgers(sender(expired=1, sent=1))


def test_a_sample_that_is_played_back_is_noticed() -> None:
    fates = Fates("down")
    fates.sampled(delivery(1))
    fates.on_receiver_start()
    fates.sampled(delivery(1))
    with pytest.raises(BrokenInvariant, match="given twice"):
        fates.sampled(delivery(1))


def test_a_side_that_keeps_what_it_is_sent_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    receive = LinkEnd.receive

    def keep(self: LinkEnd, data: bytes, source: Address, now_ns: int) -> None:
        self.__dict__.setdefault("kept", []).append(data)
        receive(self, data, source, now_ns)

    monkeypatch.setattr(LinkEnd, "receive", keep)
    with pytest.raises(ChaosError, match=r"elements are held, more than"):
        for seed in range(10):
            run_chaos(seed)


def test_the_command_says_what_it_flew() -> None:
    run = subprocess.run(
        [sys.executable, "-m", "straitlink", "chaos", "--seed", "5", "--count", "2"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert run.stdout.startswith("2 missions, 0 broken: ")
