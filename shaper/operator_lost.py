"""What the robot's side does when the operator is lost: says so on its own bus, until the operator is back.

Heard is who has sealed a datagram under the keys of the moment; a beat leaves each side at least once a
second. What the robot makes of the message is the robot's affair: stand still, sit down, go home.
"""

from __future__ import annotations

from dataclasses import dataclass

_NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class OperatorLostSettings:
    """[operator_lost]. payload: published on key when nothing was heard for after_ns, and every repeat_ns.

    back_payload: published once the operator is heard again; None to delete the key instead.
    """

    key: str
    payload: bytes
    after_ns: int
    repeat_ns: int = _NS_PER_S
    encoding: str = ""
    back_payload: bytes | None = None


@dataclass(frozen=True, slots=True)
class OperatorLost:
    """Nothing was heard for so long: the message is to be published (again)."""

    silent_ns: int
    first: bool


@dataclass(frozen=True, slots=True)
class OperatorBack:
    """Heard again: the message is to be withdrawn."""

    silent_ns: int


class OperatorWatch:
    """Turns when the operator was last heard into what to say. Lost at the start, if nobody ever comes."""

    def __init__(self, settings: OperatorLostSettings, now_ns: int) -> None:
        self.lost = False
        self._settings = settings
        self._heard_ns = now_ns
        self._say_at_ns = now_ns + settings.after_ns

    def look(self, last_heard_ns: int | None, now_ns: int) -> OperatorLost | OperatorBack | None:
        """What is to be said now, if anything."""
        if last_heard_ns is not None and last_heard_ns > self._heard_ns:
            silent_ns, self._heard_ns = last_heard_ns - self._heard_ns, last_heard_ns
            self._say_at_ns = last_heard_ns + self._settings.after_ns
            if self.lost:
                self.lost = False
                return OperatorBack(silent_ns)
        if now_ns < self._say_at_ns:
            return None
        first, self.lost = not self.lost, True
        self._say_at_ns = now_ns + self._settings.repeat_ns
        return OperatorLost(now_ns - self._heard_ns, first)

    def wakeup_at_ns(self) -> int:
        """When to look again, if nothing is heard."""
        return self._say_at_ns
