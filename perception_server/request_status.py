"""How far a request, or a view of it, has come: what is told on the bus."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Stage(StrEnum):
    """The stages of a request, and of each view that comes of it."""

    ACCEPTED = "accepted"
    REFUSED = "refused"
    CANCELLED = "cancelled"
    ENDED = "ended"  # its duration is over
    RENDERED = "rendered"
    FAILED = "failed"  # no data, or it does not fit: the error says which
    SENT = "sent"  # the last byte has left over the link
    DELIVERED = "delivered"
    LOST = "lost"
    EXPIRED = "expired"


@dataclass(frozen=True, slots=True)
class Status:
    """News of a request. request_id: 0 for a standing stream, which nobody requested.

    key: where its views leave; "" for the reply to a query. size_bytes, source_ns: of the view in question.
    """

    request_id: int
    stage: Stage
    key: str
    error: str = ""
    size_bytes: int = 0
    budget_bytes: int = 0
    source_ns: int = 0
