"""The first that a shaper does: its port, its journal, and its first word to the other side.

The answer is on its way while the rest of the program is loaded and the bus is joined. So a side that was
killed is back one round trip after it is up, where that takes as long as a round trip, and not two. What
the answer brings is taken only then: until this side proves itself, nothing changes for the other one.
"""

from __future__ import annotations

import logging
import secrets
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType

from shaper.agreement import make_table
from shaper.config import ShaperConfig
from shaper.errors import ConfigError
from shaper.frames import EPOCH_BITS
from shaper.handshake import ANSWER, MEMORY_BYTES, Identity
from shaper.journal_file import JournalFile
from shaper.key_file import read_key_file
from shaper.link_key import LinkKey
from shaper.open_channel import OpenChannel
from shaper.secure_channel import SecureChannel
from shaper.socket_filter import Admission
from shaper.table_exchange import TableExchange
from shaper.udp import Datagrams, UdpLink

_KEPT_ANSWERS = 64  # of a flood of false ones the true one may be lost: it is asked for again
_FRESH_NS = 10_000_000_000  # an answer that has waited for longer may be forgotten where it came from

_log = logging.getLogger(__name__)


class Doorstep:
    """Port, journal and channel of one side, from before the bus is there until the daemon is gone.

    Raises ConfigError for a key file that is missing, damaged or open to others.
    """

    udp: UdpLink
    journal: JournalFile | None = None
    channel: SecureChannel | OpenChannel

    def __init__(self, config: ShaperConfig) -> None:
        self.keys = read_keys(config)
        settings = config.endpoint
        self.tables = TableExchange(make_table(settings.rules, settings.accept, settings.encodings))
        self.epoch = 0
        self.said_bytes = 0  # the first word's, if there is one
        self._config = config
        self._answers: deque[tuple[bytes, tuple[str, int], int]] = deque(maxlen=_KEPT_ANSWERS)

    async def step(self) -> None:
        """Open the port and the journal, and say the first word. Raises UdpError or ConfigError."""
        config = self._config
        # The port first: a daemon that runs already is told by that, and nothing of it is touched.
        self.udp = await UdpLink.open(config.listen, config.peer, self._keep_answers)
        limits = config.endpoint.limits
        if config.journal is not None:
            self.journal = JournalFile(
                config.journal, secrets.token_bytes, limits.max_journal_messages, limits.max_journal_bytes
            )
        if self.journal is None:
            self.epoch, memory = secrets.randbits(EPOCH_BITS), secrets.token_bytes(MEMORY_BYTES)
        else:
            self.epoch, memory = self.journal.begin_life(), self.journal.memory
        if not self.keys:
            _log.warning("the link is open: whoever can reach %s:%d is heard", *config.listen)
            self.channel = OpenChannel(self.udp.peer)
            return
        now_ns = time.monotonic_ns()
        identity = Identity(self.epoch, memory, self.tables.hash)
        self.channel = SecureChannel(
            config.side, self.keys, identity, self.udp.peer, secrets.token_bytes, now_ns, time.time_ns()
        )
        first_word = self.channel.next_handshake(now_ns)
        assert first_word is not None, "a channel without a session starts a handshake"
        self.udp.send(*first_word)
        self.said_bytes = len(first_word[0])
        self.udp.take_only(Admission(tuple(self.channel.session_ids())))

    def hand_over(self, on_datagrams: Callable[[Datagrams], None]) -> None:
        """From now on this takes what comes; at once, the answers that have come."""
        self.udp.hand_to(on_datagrams)
        now_ns = time.monotonic_ns()
        fresh = [each for each in self._answers if now_ns - each[2] < _FRESH_NS]
        self._answers.clear()
        if fresh:
            on_datagrams(fresh)

    def _keep_answers(self, datagrams: Datagrams) -> None:
        self._answers.extend(each for each in datagrams if each[0][:1] == bytes([ANSWER]))

    def __enter__(self) -> Doorstep:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self.journal is not None:
            self.journal.close()
        if hasattr(self, "udp"):
            self.udp.close()


def read_keys(config: ShaperConfig) -> tuple[LinkKey, ...]:
    """The link keys of a configuration; none for an open link. Raises ConfigError."""
    if not config.key_files and not config.open_link:
        raise ConfigError(
            "link.keys is missing: a robot's commands need a key: run `straitlink keygen link.key`, copy the "
            'file to the other side and set link.keys = ["link.key"] on both (or link.open = true, which is '
            "for loopback only)"
        )
    keys = tuple(read_key_file(path) for path in config.key_files)
    for index, key in enumerate(keys):
        if key.id in {other.id for other in keys[:index]}:
            raise ConfigError(f"{config.key_files[index]}: key {key.name} stands twice in link.keys")
    return keys
