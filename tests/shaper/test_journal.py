"""Reliable messages across kill -9: each once, or reported lost; a journal that stays whole and small."""

from __future__ import annotations

import random
import sqlite3
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shaper.errors import ConfigError
from shaper.events import ReceiptStage
from shaper.frames import Outcome
from shaper.journal import Journal, MemoryJournal
from shaper.journal_file import JournalFile
from shaper.settled import SettledTopic
from tests.shaper.pair import MS, S
from tests.shaper.secured import Host, SecuredPair

Kinds = Callable[[Path], Journal]
KINDS: list[Kinds] = [
    lambda path: MemoryJournal(b"12345678", 10, 1000),
    lambda path: JournalFile(path / "a.journal", random.Random(1).randbytes, 10, 1000),
]


def met() -> SecuredPair:
    pair = SecuredPair(journals=True)
    pair.advance(2 * S)
    return pair


def kill(pair: SecuredPair, host: Host) -> None:
    pair.start(host)
    pair.advance(3 * S)


def stages(host: Host, tag: int) -> list[str]:
    return [r.stage.value for r in host.receipts if r.tag == tag]


# Of our own.


def test_what_had_left_but_not_arrived_when_the_sender_was_killed_arrives_once() -> None:
    pair = met()
    pair.loses = lambda data, to: True
    pair.offer(pair.robot, "robot/command/a", b"go", tag=7)
    pair.advance(10 * MS)
    pair.loses = lambda data, to: False
    kill(pair, pair.robot)
    assert pair.operator.payloads == [b"go"]
    assert stages(pair.robot, 7) == ["delivered"]


def test_what_had_arrived_when_the_sender_was_killed_is_not_given_twice() -> None:
    pair = met()
    pair.offer(pair.robot, "robot/command/a", b"go", tag=7)
    pair.advance(60 * MS)  # it is there; the receipt is on its way
    assert pair.operator.payloads == [b"go"]
    kill(pair, pair.robot)
    assert pair.operator.payloads == [b"go"]
    assert stages(pair.robot, 7) == ["delivered"]
    assert pair.robot.link.endpoint.sent_ledgers()["robot/command/a"].queued == 0


def test_what_had_not_left_when_the_sender_was_killed_is_reported_lost() -> None:
    pair = SecuredPair(journals=True)  # nobody has met anybody: nothing leaves
    pair.offer(pair.robot, "robot/command/a", b"go", tag=7)
    pair.start(pair.robot)
    pair.advance(3 * S)
    assert pair.operator.payloads == []
    assert stages(pair.robot, 7) == ["lost"]
    ledger = pair.robot.link.endpoint.sent_ledgers()["robot/command/a"]
    assert (ledger.offered, ledger.lost_at_restart, ledger.queued) == (1, 1, 0)


def test_a_message_that_expired_while_its_sender_was_dead_is_told_by_the_receiver() -> None:
    pair = met()
    pair.offer(pair.robot, "robot/command/a", b"go", tag=7)
    pair.advance(60 * MS)
    pair.loses = lambda data, to: True
    pair.advance(30 * S)
    pair.loses = lambda data, to: False
    kill(pair, pair.robot)
    assert pair.operator.payloads == [b"go"]
    assert stages(pair.robot, 7)[-1:] == ["delivered"]


def test_numbers_go_on_after_a_restart() -> None:
    pair = met()
    for life in range(4):
        for i in range(5):
            pair.offer(pair.robot, "robot/command/a", b"%d %d" % (life, i))
        pair.advance(1 * S)
        kill(pair, pair.robot)
    assert pair.operator.payloads == [b"%d %d" % (life, i) for life in range(4) for i in range(5)]


# Of the peer's.


def test_what_was_delivered_when_the_receiver_was_killed_is_not_given_twice() -> None:
    pair = met()
    pair.offer(pair.robot, "robot/command/a", b"go", tag=7)
    pair.advance(60 * MS)
    assert pair.operator.payloads == [b"go"]
    pair.underway.clear()  # its receipt dies with it
    kill(pair, pair.operator)
    assert pair.operator.payloads == []
    assert stages(pair.robot, 7)[-1] == "delivered"


def test_what_was_being_handed_over_when_the_receiver_was_killed_is_reported_lost_and_not_repeated() -> None:
    pair = met()
    pair.operator.hands_over = False
    pair.offer(pair.robot, "robot/command/a", b"go", tag=7)
    pair.advance(60 * MS)
    pair.operator.hands_over = True
    kill(pair, pair.operator)
    assert pair.operator.payloads == []
    assert stages(pair.robot, 7)[-1] == ReceiptStage.LOST
    pair.offer(pair.robot, "robot/command/a", b"on", tag=8)
    pair.advance(1 * S)
    assert pair.operator.payloads == [b"on"]


def test_a_receiver_whose_journal_is_gone_is_a_new_one() -> None:
    pair = met()
    pair.offer(pair.robot, "robot/command/a", b"one")
    pair.advance(1 * S)
    pair.operator.journal = MemoryJournal(b"another!")
    kill(pair, pair.operator)
    pair.offer(pair.robot, "robot/command/a", b"two")
    pair.advance(1 * S)
    assert pair.operator.payloads == [b"two"]


EVENTS = st.lists(
    st.tuples(st.sampled_from(["offer", "offer", "robot", "operator", "lose", "wait"]), st.integers(1, 400)),
    max_size=30,
)


@given(EVENTS, st.integers(0, 1000))
def test_whatever_is_killed_when_each_message_is_given_once_or_told_as_lost(
    events: list[tuple[str, int]], seed: int
) -> None:
    pair = SecuredPair(journals=True, seed=seed)
    pair.advance(1 * S)
    given_out: list[bytes] = []
    outcomes: dict[int, list[str]] = {}
    offered = 0

    def collect() -> None:
        given_out.extend(pair.operator.payloads)
        pair.operator.events.clear()
        for receipt in pair.robot.receipts:
            outcomes.setdefault(receipt.tag, []).append(receipt.stage.value)
        pair.robot.events.clear()

    for what, amount in events:
        if what == "offer":
            offered += 1
            pair.offer(pair.robot, "robot/command/a", b"%d" % offered, tag=offered)
        elif what == "lose":
            pair.underway = pair.underway[amount % 3 :]
        pair.advance(amount * MS)
        collect()
        if what in ("robot", "operator"):
            pair.start(pair.robot if what == "robot" else pair.operator)
    pair.advance(30 * S)
    collect()
    assert len(given_out) == len(set(given_out))
    for tag in range(1, offered + 1):
        final = [s for s in outcomes[tag] if s not in ("queued", "sent")]
        assert len(final) == 1, (tag, outcomes[tag])
        assert (final == ["delivered"]) == (b"%d" % tag in given_out), (tag, outcomes[tag])


# The journal itself.


@pytest.mark.parametrize("kind", KINDS)
def test_a_journal_is_bounded_in_messages_and_bytes(tmp_path: Path, kind: Kinds) -> None:
    journal = kind(tmp_path)
    serials = [journal.accept("a", 1, 0, "", bytes(10)) for _ in range(12)]
    assert serials[9] is not None and serials[10:] == [None, None]
    for serial in serials[:10]:
        assert serial is not None
        journal.settle(serial)
    assert journal.accept("a", 1, 0, "", bytes(1001)) is None
    assert journal.accept("a", 1, 0, "", bytes(1000)) is not None


@pytest.mark.parametrize("kind", KINDS)
def test_outcomes_are_remembered_as_long_as_a_sender_may_ask(tmp_path: Path, kind: Kinds) -> None:
    topic = SettledTopic(kind(tmp_path), b"peer", "a")
    assert topic.next_number is None
    for number in range(1000):
        topic.hand_over(number)
        topic.settle(number, Outcome.DELIVERED)
    again = SettledTopic(topic._journal, b"peer", "a")
    assert again.next_number == 1000
    assert again.outcome(1000 - 64) is Outcome.DELIVERED
    assert len(topic._journal.outcomes(b"peer", "a")) <= 2 * 128


def test_a_journal_file_gives_back_what_was_written(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    journal = JournalFile(path, random.Random(1).randbytes)
    tag = (1_750_000_000_000_000_000 << 32) | 9
    first = journal.accept("a", tag, 5, "text", b"one")
    second = journal.accept("a", 2, 6, "", b"two")
    assert first is not None and second is not None
    journal.depart(first, "a", 41)
    journal.meet(b"the peer")
    journal.record(b"the peer", "b", 3, None)
    journal.close()
    again = JournalFile(path, random.Random(2).randbytes)
    assert [(m.tag, m.payload, m.number) for m in again.own_messages()] == [
        (tag, b"one", 41),
        (2, b"two", None),
    ]
    assert again.next_numbers() == {"a": 42}
    assert (again.memory, again.peer_memory) == (journal.memory, b"the peer")
    assert again.outcomes(b"the peer", "b") == {3: None}


def test_a_peer_that_names_ever_new_topics_does_not_fill_the_journal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shaper.journal_file.MAX_TOPICS", 20)
    journal = JournalFile(tmp_path / "a.journal", random.Random(1).randbytes)
    for i in range(1000):
        journal.record(b"peer", f"topic/{i}", 0, Outcome.DELIVERED)
    (rows,) = journal._db.execute("SELECT count(*) FROM theirs").fetchone()
    assert rows == 20


@pytest.mark.parametrize("kind", KINDS)
def test_no_two_lives_have_the_same_epoch(tmp_path: Path, kind: Kinds) -> None:
    journal = kind(tmp_path)
    assert len({journal.begin_life() for _ in range(300)}) == 300


def test_after_a_reboot_nothing_is_sent_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.journal"
    journal = JournalFile(path, random.Random(1).randbytes)
    serial = journal.accept("a", 1, 5, "", b"one")
    assert serial is not None
    journal.depart(serial, "a", 0)
    journal.close()
    monkeypatch.setattr("shaper.journal_file._boot_id", lambda: "another")
    again = JournalFile(path, random.Random(2).randbytes)
    assert [m.number for m in again.own_messages()] == [None]
    assert again.next_numbers() == {"a": 1}


def test_two_daemons_do_not_share_a_journal(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    JournalFile(path, random.Random(1).randbytes)
    code = (
        "import sys, pathlib, secrets\nfrom shaper.journal_file import JournalFile\n"
        "JournalFile(pathlib.Path(sys.argv[1]), secrets.token_bytes)"
    )
    holder = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=False
    )
    assert "another daemon has it open" in holder.stderr


def test_a_damaged_journal_is_put_aside_and_a_place_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    path.write_bytes(b"this is no database, and was none" * 100)
    assert JournalFile(path, random.Random(1).randbytes).own_messages() == []
    assert (tmp_path / "a.journal.damaged").exists()
    with pytest.raises(ConfigError, match=r"link\.journal"):
        JournalFile(tmp_path / "nowhere" / "a.journal", random.Random(1).randbytes)


def test_a_journal_of_another_format_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    db = sqlite3.connect(path)
    db.execute("PRAGMA user_version = 99")
    db.execute("CREATE TABLE x (y)")
    db.commit()
    db.close()
    JournalFile(path, random.Random(1).randbytes)
    assert (tmp_path / "a.journal.damaged").exists()


def test_a_journal_is_its_owners_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    path.touch(0o644)  # by an earlier version
    journal = JournalFile(path, random.Random(1).randbytes)
    journal.accept("a", 1, 5, "", b"a command")
    modes = {each.name: stat.S_IMODE(each.stat().st_mode) for each in tmp_path.iterdir()}
    assert set(modes.values()) == {0o600}, modes
    assert "a.journal-wal" in modes
    journal.close()


def test_a_full_disk_stops_new_reliable_messages_and_not_the_link(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    journal = JournalFile(tmp_path / "a.journal", random.Random(1).randbytes)
    serial = journal.accept("a", 1, 5, "", b"one")
    assert serial is not None
    (pages,) = journal._db.execute("PRAGMA page_count").fetchone()
    journal._db.execute(f"PRAGMA max_page_count = {pages}")
    refused = [journal.accept("a", 2, 5, "", bytes(5000)) for _ in range(20)]
    assert refused[-1] is None and journal.failing
    assert caplog.text.count("make room on the disk") == 1
    journal._db.execute(f"PRAGMA max_page_count = {10 * pages}")
    journal.depart(serial, "a", 7)
    journal.settle(serial)
    assert not journal.failing and "written again" in caplog.text
    assert journal.accept("a", 3, 5, "", b"three") is not None
    assert journal.next_numbers() == {"a": 8}
    journal.close()
