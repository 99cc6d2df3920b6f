"""How large a datagram the path takes: tried by probes, and noticed when large ones vanish.

Where the channel has probes, datagrams start at what nearly every path takes, and padded probes find the
largest size up to the configured one that passes, by halving (RFC 8899). If several in a row that were
larger than anything that arrived meanwhile are lost, while smaller ones do arrive, the path has become a
black hole for them. Then sizes fall to the floor, and are searched anew; later the configured size is
tried again. Without probes the configured size is taken at its word.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from shaper.notices import Notice, NoticeKind

FLOOR_BYTES = 548  # IPv4's 576 without headers (RFC 1122, section 3.3.3): every path takes it
START_BYTES = 1200  # what IPv6's least MTU leaves with room for a tunnel; QUIC's (RFC 9000, section 14.1)
_SUSPECTS = 6  # that vanish one after the other; at 30 % of random loss one in 1,400 such rows
_WITNESSES = 2  # smaller ones that arrived meanwhile
_NS_PER_S = 1_000_000_000
_FIRST_PROBE_NS = _NS_PER_S
_PROBE_PATIENCE_NS = 3 * _NS_PER_S
_TRIES = 2  # a probe may be lost by chance
_CLOSE_ENOUGH_BYTES = 24
_RETRY_NS, _LONGEST_RETRY_NS = 60 * _NS_PER_S, 600 * _NS_PER_S


@dataclass(frozen=True, slots=True)
class _SentSize:
    """A datagram under way, for its size only."""

    mtu: PathMtu
    size_bytes: int

    def on_arrived(self) -> None:
        self.mtu.on_arrived(self.size_bytes)

    def on_lost(self) -> None:
        self.mtu.on_lost(self.size_bytes)


class PathMtu:
    """UDP payloads up to `size_bytes` are believed to pass."""

    def __init__(self, ceiling_bytes: int) -> None:
        self.size_bytes = ceiling_bytes
        self.can_probe = False  # a size that fell would never rise: then it does not fall
        self.notices: deque[Notice] = deque(maxlen=8)
        self._ceiling_bytes = ceiling_bytes
        self._floor_bytes = min(FLOOR_BYTES, ceiling_bytes)
        self._fell = False
        self._suspects: list[int] = []
        self._witnesses = 0
        self._high_bytes = ceiling_bytes  # the largest that is still to be tried
        self._probe_bytes = 0  # under way
        self._tries = 0
        self._probe_at_ns: int | None = None
        self._wait_ns = 0  # until the next probe, counted from when somebody looks
        self._retry_ns = _RETRY_NS

    def start_probing(self) -> None:
        """There are probes: nothing larger than what nearly every path takes leaves before one has passed."""
        self.can_probe = True
        self.size_bytes = min(START_BYTES, self._ceiling_bytes)
        self._wait_ns = _FIRST_PROBE_NS

    # What is seen of ordinary datagrams.

    def watch(self, size_bytes: int) -> _SentSize | None:
        """What wants to know of a datagram's fate. size_bytes: UDP payload."""
        wanted = self.can_probe and (size_bytes > self._floor_bytes or self._suspects)
        return _SentSize(self, size_bytes) if wanted else None

    def on_arrived(self, size_bytes: int) -> None:
        """What was lost and is no larger than this was lost by chance."""
        if not self._suspects:
            return
        if size_bytes >= min(self._suspects):
            self._suspects = [lost for lost in self._suspects if lost > size_bytes]
        else:
            self._witnesses += 1
        if not self._suspects:
            self._witnesses = 0
        self._judge()

    def on_lost(self, size_bytes: int) -> None:
        """Chance, or the path."""
        if size_bytes > self._floor_bytes and size_bytes <= self.size_bytes:
            self._suspects.append(size_bytes)
            self._judge()

    def _judge(self) -> None:
        if len(self._suspects) < _SUSPECTS or self._witnesses < _WITNESSES:
            return
        smallest = min(self._suspects)
        self._suspects, self._witnesses = [], 0
        self.size_bytes, self._fell = self._floor_bytes, True
        self._high_bytes = smallest - 1
        self._probe_bytes = self._tries = 0
        self._probe_at_ns, self._wait_ns = None, _FIRST_PROBE_NS
        self.notices.append(
            Notice(
                NoticeKind.PATH_MTU,
                f"datagrams of {smallest} bytes vanish on the path, smaller ones arrive: sending at most "
                f"{self.size_bytes} bytes until a larger size is found to pass; if it stays so, set "
                "link.max_datagram_bytes on both sides, or mend the path's MTU (a tunnel, a modem)",
            )
        )

    # Probes.

    @property
    def is_at_ceiling(self) -> bool:
        """Whether there is nothing larger to be tried."""
        return self.size_bytes >= self._ceiling_bytes

    def next_probe(self, wanted_bytes: int, now_ns: int) -> int | None:
        """Size of a probe that should leave now; None if none should, or none is needed.

        wanted_bytes: full datagrams now. No probe is larger: on a thin link it would hold up what follows it.
        """
        if self.size_bytes >= min(wanted_bytes, self._ceiling_bytes):
            return None
        if self._probe_at_ns is None:
            self._probe_at_ns = now_ns + self._wait_ns
        if now_ns < self._probe_at_ns:
            return None
        if self._probe_bytes > wanted_bytes:  # the link has become thinner since the first try
            self._probe_bytes = self._tries = 0
        if self._probe_bytes and self._tries >= _TRIES:
            self._high_bytes = self._probe_bytes - 1
            self._probe_bytes = self._tries = 0
        if not self._probe_bytes:
            if self._high_bytes - self.size_bytes < _CLOSE_ENOUGH_BYTES:
                self._try_all_again_later(now_ns)
                return None
            middle = (self.size_bytes + self._high_bytes + 1) // 2
            largest = self._high_bytes if self._high_bytes == self._ceiling_bytes else middle
            self._probe_bytes = min(largest, wanted_bytes)
        self._tries += 1
        self._probe_at_ns = now_ns + _PROBE_PATIENCE_NS
        return self._probe_bytes

    def on_probe_arrived(self, size_bytes: int, now_ns: int) -> None:
        """The peer has a probe of this size."""
        if self._probe_bytes and size_bytes == self._probe_bytes:
            self.size_bytes = size_bytes
            self._probe_bytes = self._tries = 0
            self._probe_at_ns = now_ns
            if size_bytes >= self._ceiling_bytes:
                self._retry_ns = _RETRY_NS
                if self._fell:
                    text = f"datagrams of {size_bytes} bytes pass again"
                    self.notices.append(Notice(NoticeKind.PATH_MTU, text))
                self._fell = False

    def wakeup_at_ns(self, wanted_bytes: int) -> int | None:
        """When a probe may be due."""
        return self._probe_at_ns if self.size_bytes < min(wanted_bytes, self._ceiling_bytes) else None

    def _try_all_again_later(self, now_ns: int) -> None:
        self._high_bytes = self._ceiling_bytes
        self._probe_at_ns = now_ns + self._retry_ns
        self._retry_ns = min(2 * self._retry_ns, _LONGEST_RETRY_NS)
