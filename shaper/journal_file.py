"""The journal of a live daemon: one SQLite file in WAL mode, bounded. The driver of `shaper.journal`.

Every call commits by itself; a commit is in the kernel's hands when it returns, which is what outlives
kill -9. A power cut may take the last commits (synchronous = NORMAL) but leaves the file whole. Where the
disk is full or gone the link goes on without: new reliable messages are refused, those under way are no
longer on record. The file is its owner's alone, as commands are in it. Times are of the monotonic clock,
which starts anew with the machine: what was under way then is given up.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path

from shaper.errors import ConfigError
from shaper.frames import Outcome
from shaper.handshake import MEMORY_BYTES
from shaper.journal import MAX_MEMORIES, MAX_TOPICS, REMEMBERED_OUTCOMES, OwnMessage

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_FORMAT = 1
_MODE = 0o600
_HANDING_OVER = -1  # in the outcome column
_SCHEMA = """
CREATE TABLE about (name TEXT PRIMARY KEY, value) WITHOUT ROWID;
CREATE TABLE own (serial INTEGER PRIMARY KEY AUTOINCREMENT, key TEXT NOT NULL, tag TEXT NOT NULL,
    capture_ns INTEGER NOT NULL, encoding TEXT NOT NULL, payload BLOB NOT NULL, number INTEGER);
CREATE TABLE next_number (key TEXT PRIMARY KEY, number INTEGER NOT NULL) WITHOUT ROWID;
CREATE TABLE memory (id INTEGER PRIMARY KEY, memory BLOB NOT NULL UNIQUE);
CREATE TABLE theirs (memory INTEGER NOT NULL, key TEXT NOT NULL, number INTEGER NOT NULL,
    outcome INTEGER NOT NULL, PRIMARY KEY (memory, key, number)) WITHOUT ROWID;
"""

_log = logging.getLogger(__name__)


class JournalFile:
    """A journal in a file that this process alone may use. Raises ConfigError where it cannot.

    failing: the last thing that was to be recorded could not be.
    """

    def __init__(
        self,
        path: Path,
        random_bytes: Callable[[int], bytes],
        max_messages: int = 4096,
        max_bytes: int = 16_000_000,
    ) -> None:
        self._path = path
        self._max_messages = max_messages
        self._max_bytes = max_bytes
        self._random = random_bytes
        self.failing = False
        self._open()
        about = dict(self._db.execute("SELECT name, value FROM about"))
        self.memory: bytes = about["memory"]
        self.peer_memory: bytes = about.get("peer_memory", b"")
        self._rows, self._bytes = self._db.execute(
            "SELECT count(*), coalesce(sum(length(payload)), 0) FROM own"
        ).fetchone()
        topics = self._db.execute("SELECT DISTINCT memory, key FROM theirs ORDER BY memory")
        self._topics: dict[tuple[int, str], None] = dict.fromkeys(topics.fetchall())

    def close(self) -> None:
        """Close the file; what is in it stays."""
        self._db.close()

    def begin_life(self) -> int:
        (before,) = self._db.execute("SELECT max(value) FROM about WHERE name = 'life'").fetchone()
        life = (int.from_bytes(self.memory[:2], "little") if before is None else before) + 1 & 0xFFFF
        self._db.execute("INSERT OR REPLACE INTO about VALUES ('life', ?)", (life,))
        return life

    def own_messages(self) -> list[OwnMessage]:
        rows = self._db.execute("SELECT serial, key, tag, capture_ns, encoding, payload, number FROM own")
        return [OwnMessage(serial, key, int(tag), *rest) for serial, key, tag, *rest in rows]

    def next_numbers(self) -> dict[str, int]:
        return dict(self._db.execute("SELECT key, number FROM next_number"))

    def accept(self, key: str, tag: int, capture_ns: int, encoding: str, payload: bytes) -> int | None:
        if self._rows >= self._max_messages or self._bytes + len(payload) > self._max_bytes:
            return None
        row = (key, str(tag), capture_ns, encoding, payload)  # a tag has up to 96 bits
        serial: int | None = None
        with self._writing() as db:
            serial = db.execute(
                "INSERT INTO own (key, tag, capture_ns, encoding, payload) VALUES (?, ?, ?, ?, ?)", row
            ).lastrowid
        if serial is None or self.failing:
            return None
        self._rows += 1
        self._bytes += len(payload)
        return serial

    def depart(self, serial: int, key: str, number: int) -> None:
        with self._writing() as db:
            db.execute("UPDATE own SET number = ? WHERE serial = ?", (number, serial))
            db.execute("INSERT OR REPLACE INTO next_number VALUES (?, ?)", (key, number + 1))

    def settle(self, serial: int) -> None:
        settled: list[tuple[int]] = []
        with self._writing() as db:
            settled = db.execute(
                "DELETE FROM own WHERE serial = ? RETURNING length(payload)", (serial,)
            ).fetchall()
        for (count,) in settled:
            self._rows -= 1
            self._bytes -= count

    def outcomes(self, memory: bytes, key: str) -> dict[int, Outcome | None]:
        rows = self._db.execute(
            "SELECT number, outcome FROM theirs WHERE memory = (SELECT id FROM memory WHERE memory = ?)"
            " AND key = ? ORDER BY number",
            (memory, key),
        )
        return {n: None if outcome == _HANDING_OVER else Outcome(outcome) for n, outcome in rows}

    def record(self, memory: bytes, key: str, number: int, outcome: Outcome | None) -> None:
        value = _HANDING_OVER if outcome is None else int(outcome)
        with self._writing() as db:
            place = self._memory_id(memory)
            db.execute("INSERT OR REPLACE INTO theirs VALUES (?, ?, ?, ?)", (place, key, number, value))
            if number % REMEMBERED_OUTCOMES == 0:
                old = (place, key, number - REMEMBERED_OUTCOMES)
                db.execute("DELETE FROM theirs WHERE memory = ? AND key = ? AND number < ?", old)
            if (place, key) not in self._topics:
                self._add_topic(place, key)

    def _add_topic(self, place: int, key: str) -> None:
        """The peer names the topics: of too many the oldest gives way."""
        self._topics[place, key] = None
        if len(self._topics) > MAX_TOPICS:
            oldest = next(iter(self._topics))
            del self._topics[oldest]
            self._db.execute("DELETE FROM theirs WHERE memory = ? AND key = ?", oldest)

    def meet(self, memory: bytes) -> None:
        self.peer_memory = memory
        with self._writing() as db:
            db.execute("INSERT OR REPLACE INTO about VALUES ('peer_memory', ?)", (memory,))

    def _memory_id(self, memory: bytes) -> int:
        row = self._db.execute("SELECT id FROM memory WHERE memory = ?", (memory,)).fetchone()
        if row is not None:
            return int(row[0])
        cursor = self._db.execute("INSERT INTO memory (memory) VALUES (?)", (memory,))
        assert cursor.lastrowid is not None, "an insert gives its row a number"
        oldest = (cursor.lastrowid - MAX_MEMORIES,)
        self._db.execute("DELETE FROM theirs WHERE memory <= ?", oldest)
        self._db.execute("DELETE FROM memory WHERE id <= ?", oldest)
        return cursor.lastrowid

    @contextlib.contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        """All of it or nothing; what cannot be written is told once, and does not stop the link."""
        try:
            self._db.execute("BEGIN")
            yield self._db
            self._db.execute("COMMIT")
        except sqlite3.Error as error:
            with contextlib.suppress(sqlite3.Error):
                self._db.execute("ROLLBACK")
            if not self.failing:
                _log.error(
                    "%s: the journal cannot be written: %s: until it can, new reliable messages are "
                    "refused, and those under way may be lost or come twice if a daemon is killed: make "
                    "room on the disk",
                    self._path,
                    error,
                )
            self.failing = True
        else:
            if self.failing:
                _log.warning("%s: the journal can be written again", self._path)
            self.failing = False

    # Opening.

    def _open(self) -> None:
        try:
            self._db = self._connect()
        except sqlite3.DatabaseError as error:
            if isinstance(error, sqlite3.OperationalError):
                raise ConfigError(f"{self._path}: the journal cannot be used: {_reason(error)}") from error
            # Not a journal, or a damaged one. It is kept for whoever wants to look into it.
            self._path.replace(self._path.with_name(self._path.name + ".damaged"))
            for suffix in ("-wal", "-shm"):
                self._path.with_name(self._path.name + suffix).unlink(missing_ok=True)
            self._db = self._connect()

    def _connect(self) -> sqlite3.Connection:
        with contextlib.suppress(OSError):  # SQLite says what is wrong with the place
            descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT, _MODE)
            os.fchmod(descriptor, _MODE)  # SQLite's other two files take the mode of this one
            os.close(descriptor)
        db = sqlite3.connect(self._path, isolation_level=None, timeout=2.0)
        try:
            db.execute("PRAGMA locking_mode = EXCLUSIVE")
            db.execute("PRAGMA journal_mode = WAL")
            db.execute("PRAGMA synchronous = NORMAL")
            db.execute("PRAGMA journal_size_limit = 4000000")
            self._prepare(db)
        except sqlite3.Error:
            db.close()
            raise
        return db

    def _prepare(self, db: sqlite3.Connection) -> None:
        boot_id = _boot_id()
        (version,) = db.execute("PRAGMA user_version").fetchone()
        if version not in (0, _FORMAT):
            raise sqlite3.DatabaseError(f"format {version} is not {_FORMAT}")
        db.execute("BEGIN IMMEDIATE")
        if version == 0:
            for statement in _SCHEMA.split(";"):
                db.execute(statement)
            db.execute("INSERT INTO about VALUES ('memory', ?)", (self._random(MEMORY_BYTES),))
            db.execute(f"PRAGMA user_version = {_FORMAT}")
        (before,) = db.execute("SELECT max(value) FROM about WHERE name = 'boot_id'").fetchone()
        if before != boot_id:  # another life of the machine: its clock, and its buses, have started anew
            db.execute("UPDATE own SET number = NULL")
            db.execute("INSERT OR REPLACE INTO about VALUES ('boot_id', ?)", (boot_id,))
        db.execute("COMMIT")
        damage = db.execute("PRAGMA quick_check(1)").fetchone()[0]
        if damage != "ok":
            raise sqlite3.DatabaseError(damage)


def _boot_id() -> str:
    with contextlib.suppress(OSError):
        return _BOOT_ID.read_text().strip()
    return "unknown"


def _reason(error: sqlite3.OperationalError) -> str:
    text = str(error)
    if "locked" in text:
        return "another daemon has it open: each needs its own link.journal"
    if "unable to open" in text or "readonly" in text:
        return f'{text}: choose a place that can be written with link.journal, or link.journal = "off"'
    return text
