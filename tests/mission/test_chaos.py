"""Fifty missions in which everything goes wrong; `straitlink chaos --count 1000` flies more."""

from __future__ import annotations

import subprocess
import sys

import pytest

from shaper.events import Delivered, Receipt, ReceiptStage
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


def test_the_command_says_what_it_flew() -> None:
    run = subprocess.run(
        [sys.executable, "-m", "straitlink", "chaos", "--seed", "5", "--count", "2"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert run.stdout.startswith("2 missions, 0 broken: ")
