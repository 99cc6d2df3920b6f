"""Which view is rendered next: standing streams, operators' requests, and when the link has room.

A stream has a key of its own; all that operators request leaves on one key together. While a key is pulled
(asked for with a byte budget when the link has room), its views leave as answers; else they are published
when they fall due. Nothing is rendered ahead.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeAlias

from messages.proto.straitlink.view_pb2 import (
    VIEW_STATUS_ACCEPTED,
    VIEW_STATUS_CANCELLED,
    VIEW_STATUS_DOES_NOT_FIT,
    VIEW_STATUS_REFUSED,
    VIEW_STATUS_RENDERED,
    VIEW_STATUS_UNCHANGED,
    Image,
    ImageRequest,
    View,
    ViewRequest,
)
from messages.proto.straitlink.view_pb2 import ViewStatus as ReplyStatus
from perception_server.errors import RequestError
from perception_server.receipts import Receipts
from perception_server.request_status import Stage, Status

Request: TypeAlias = ViewRequest | ImageRequest
Reply: TypeAlias = View | Image
Newest: TypeAlias = Callable[[Request], int | None]
"""The capture time of the newest data that a request would show; None if there is none."""

MAX_ACTIVE = 32  # requests that repeat or wait
DEFAULT_BUDGET_BYTES = 1_000_000  # of a view that nobody gives a budget for
PULLED_FOR_NS = 30_000_000_000  # a key that was asked for is not published on for this long
ASK_LASTS_NS = 3_000_000_000  # an asker that is still there has asked anew by then
PATIENCE_NS = 10_000_000_000
RETRY_NS = 500_000_000  # until what had no data, or did not fit, is tried again
POLL_NS = 50_000_000  # between two looks whether there is new data for what is due
_MAX_ANSWERS = 64
_NEVER_NS = -1
_NS_PER_MS = 1_000_000
_NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Stream:
    """A standing view. period_ns: at least this between two views."""

    key: str
    request: Request
    period_ns: int = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Job:
    """Something to render now, in at most budget_bytes.

    key: where it leaves; "" for the direct reply to a query. pulled: it answers the key's asker; else it is
    published. reply: what there is to say already, without rendering.
    """

    key: str
    request: Request
    budget_bytes: int
    pulled: bool = False
    reply: Reply | None = None


@dataclass(slots=True)
class _Active:
    """A stream, or an operator's request."""

    key: str
    request: Request
    period_ns: int  # 0 = once
    due_ns: int
    until_ns: int | None = None
    patient_until_ns: int = 0  # before this, a budget of the moment that is too small is waited out
    standing: bool = False
    shown_ns: int | None = _NEVER_NS  # newest data of its last view
    failed_with: str = ""


@dataclass(slots=True)
class _Key:
    asked_ns: int | None = None  # since when an asker waits
    last_asked_ns: int | None = None
    budget_bytes: int = 0

    def has_asker(self, now_ns: int) -> bool:
        return self.asked_ns is not None and now_ns - self.asked_ns <= ASK_LASTS_NS

    def may_leave(self, now_ns: int) -> bool:
        """Whether there is an asker, or nobody who would come back to ask."""
        if self.has_asker(now_ns) or self.last_asked_ns is None:
            return True
        return now_ns - self.last_asked_ns > PULLED_FOR_NS


class Dispatcher:
    """Takes requests and questions in, hands out jobs; one thread at a time.

    check: raises RequestError for a request that cannot be. tell: takes each Status.
    """

    def __init__(
        self,
        streams: Iterable[Stream],
        requested_key: str,
        check: Callable[[Request], None],
        tell: Callable[[Status], None],
        default_budget_bytes: int = DEFAULT_BUDGET_BYTES,
    ) -> None:
        self.requested_key = requested_key
        self.receipts = Receipts(tell)
        self._check = check
        self._tell = tell
        self._default_budget_bytes = default_budget_bytes
        self._streams = [_Active(s.key, s.request, s.period_ns, 0, standing=True) for s in streams]
        self._requests: OrderedDict[tuple[str, int], _Active] = OrderedDict()
        self._answers: deque[tuple[Request, Reply]] = deque(maxlen=_MAX_ANSWERS)
        self._keys = {key: _Key() for key in (*(s.key for s in self._streams), requested_key)}

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys that views leave on."""
        return tuple(self._keys)

    # What happens.

    def request(self, request: Request, now_ns: int) -> Reply:
        """Take an operator's request: accepted, refused or cancelled, as the reply says."""
        try:
            self._check(request)
        except RequestError as error:
            return self._refuse(request, str(error))
        if request.period_ms < 0:
            return self._cancel(request)
        name = _name(request)
        if name not in self._requests and len(self._requests) >= MAX_ACTIVE:
            return self._refuse(
                request, f"request_id = {request.request_id}: {MAX_ACTIVE} requests are active; cancel one"
            )
        period_ns = request.period_ms * _NS_PER_MS
        until_ns = now_ns + request.duration_s * _NS_PER_S if period_ns and request.duration_s else None
        self._requests[name] = _Active(
            self.requested_key, request, period_ns, now_ns, until_ns, now_ns + PATIENCE_NS
        )
        self._say(request, Stage.ACCEPTED)
        return empty_reply(request, VIEW_STATUS_ACCEPTED)

    def tell_operator(self, request: Request, reply: Reply) -> None:
        """Let a reply without a picture leave where the operator's views leave, as soon as may be."""
        self._answers.append((request, reply))

    def query(self, request: Request, budget_bytes: int) -> Job | Reply:
        """A query for one view: a job for its direct reply, or what there is to say at once."""
        try:
            self._check(request)
        except RequestError as error:
            return self._refuse(request, str(error))
        self._say(request, Stage.ACCEPTED, key="")
        return Job("", request, self._budget_bytes(request, budget_bytes or self._default_budget_bytes))

    def asked(self, key: str, budget_bytes: int, now_ns: int) -> bool:
        """Somebody has room on a key for a view of this size; False for a key that is none of ours."""
        known = self._keys.get(key)
        if known is None:
            return False
        known.asked_ns = known.last_asked_ns = now_ns
        known.budget_bytes = budget_bytes
        return True

    # What is to be done.

    def next_job(self, now_ns: int, newest: Newest) -> Job | None:
        """What has waited longest and may leave now; None if nothing."""
        self._end_what_is_over(now_ns)
        key = self._keys[self.requested_key]
        if self._answers and key.may_leave(now_ns):
            request, reply = self._answers.popleft()
            return Job(self.requested_key, request, 0, key.has_asker(now_ns), reply)
        for active in sorted(self._actives(), key=lambda each: each.due_ns):
            if active.due_ns > now_ns:
                return None
            key = self._keys[active.key]
            repeats = active.period_ns or active.standing
            if not key.may_leave(now_ns) or (repeats and newest(active.request) == active.shown_ns):
                continue
            pulled = key.has_asker(now_ns)
            offered_bytes = key.budget_bytes if pulled else self._default_budget_bytes
            budget_bytes = self._budget_bytes(active.request, offered_bytes)
            return Job(active.key, active.request, budget_bytes, pulled)
        return None

    def wakeup_ns(self, now_ns: int) -> int | None:
        """When to look for a job again if nothing happens before; None if there is nothing to wait for."""
        due_ns = [active.due_ns for active in self._actives()]
        if not due_ns:
            return None
        return max(min(due_ns), now_ns + POLL_NS)

    def finish(self, job: Job, reply: Reply, source_ns: int, now_ns: int) -> Reply | None:
        """A job is done: what is to leave, or None if nothing is. source_ns: of the newest data shown."""
        if job.reply is None and (found := self._after_rendering(job, reply, source_ns, now_ns)) is not reply:
            if found is None:
                return None
            reply = found
        if job.pulled:
            self._keys[job.key].asked_ns = None
        return reply

    def _after_rendering(self, job: Job, reply: Reply, source_ns: int, now_ns: int) -> Reply | None:
        active = next((each for each in self._actives() if each.request is job.request), None)
        if active is None and job.key:
            return None  # cancelled or replaced meanwhile
        repeats = active is not None and (active.standing or active.period_ns > 0)
        if reply.status == VIEW_STATUS_RENDERED and job.key and not repeats:
            reply = self._unless_shown(job, reply, source_ns)
        rendered = reply.status == VIEW_STATUS_RENDERED
        size_bytes = reply.ByteSize() if rendered else 0
        stage = Stage.RENDERED if rendered else Stage.FAILED
        status = Status(
            job.request.request_id, stage, job.key, reply.error, size_bytes, job.budget_bytes, source_ns
        )
        if active is not None and self._may_yet_fit(active, job, reply, now_ns):
            active.due_ns = now_ns + RETRY_NS
            return None
        if active is None or not repeats:
            self._tell(status)
            if active is not None:
                del self._requests[_name(job.request)]
            return reply
        return self._advance(active, reply, status, now_ns)

    def _may_yet_fit(self, active: _Active, job: Job, reply: Reply, now_ns: int) -> bool:
        """Whether it was the scheduler's budget of the moment that one view did not fit."""
        if reply.status != VIEW_STATUS_DOES_NOT_FIT or active.period_ns or not job.pulled:
            return False
        own_bytes = job.request.budget_bytes
        return now_ns < active.patient_until_ns and not 0 < own_bytes < reply.smallest_bytes

    def _advance(self, active: _Active, reply: Reply, status: Status, now_ns: int) -> Reply | None:
        """Let what repeats fall due anew. A failure is told once, and on a standing stream's key never."""
        if status.stage is Stage.RENDERED:
            active.failed_with = ""
            active.shown_ns = status.source_ns
            # On the beat, unless beats were missed: those are not made up for.
            active.due_ns = max(active.due_ns + active.period_ns, now_ns + active.period_ns // 2)
            self._tell(status)
            return reply
        active.due_ns = now_ns + max(active.period_ns, RETRY_NS)
        known = active.failed_with == f"{reply.status}"
        active.failed_with = f"{reply.status}"
        if not known:
            self._tell(status)
        return None if known or active.standing else reply

    def _unless_shown(self, job: Job, reply: Reply, source_ns: int) -> Reply:
        """The reply, or UNCHANGED if another request for the same was shown this very data."""
        request = job.request
        if isinstance(request, ImageRequest) and (request.again or request.HasField("at_ns")):
            return reply
        shown = self.receipts.shown(wish_of(request))
        if shown is None or shown[0] != source_ns or shown[1] == request.request_id:
            return reply  # the same request once more: its reply was lost
        return empty_reply(request, VIEW_STATUS_UNCHANGED, "the newest data has been sent before")

    # How.

    def _actives(self) -> list[_Active]:
        return [*self._streams, *self._requests.values()]

    def _budget_bytes(self, request: Request, offered_bytes: int) -> int:
        return min(offered_bytes, request.budget_bytes or offered_bytes)

    def _refuse(self, request: Request, error: str) -> Reply:
        self._say(request, Stage.REFUSED, error)
        return empty_reply(request, VIEW_STATUS_REFUSED, error)

    def _cancel(self, request: Request) -> Reply:
        """Cancel by request_id, or else all of the same preset and source."""
        names = [_name(request)] if _name(request) in self._requests else []
        if not names:
            names = [
                name for name, active in self._requests.items() if _is_same_view(active.request, request)
            ]
        if not names:
            which = f"request_id = {request.request_id}, or this preset and source"
            return self._refuse(request, f"period_ms = -1: no active request has {which}")
        for name in names:
            self._say(self._requests.pop(name).request, Stage.CANCELLED)
        return empty_reply(request, VIEW_STATUS_CANCELLED)

    def _end_what_is_over(self, now_ns: int) -> None:
        over = [n for n, a in self._requests.items() if a.until_ns is not None and a.until_ns < now_ns]
        for name in over:
            self._say(self._requests.pop(name).request, Stage.ENDED)

    def _say(self, request: Request, stage: Stage, error: str = "", key: str | None = None) -> None:
        self._tell(Status(request.request_id, stage, self.requested_key if key is None else key, error))


def empty_reply(request: Request, status: ReplyStatus.ValueType, error: str = "") -> Reply:
    """A reply of the request's kind that carries no picture."""
    kind = Image if isinstance(request, ImageRequest) else View
    return kind(request_id=request.request_id, status=status, error=error)


def wish_of(request: Request) -> bytes:
    """What a request wants to see, whatever its number and time."""
    wish = type(request)()
    wish.CopyFrom(request)  # type: ignore[arg-type]
    for name in ("request_id", "capture_ns", "budget_bytes"):
        wish.ClearField(name)
    return wish.DESCRIPTOR.name.encode() + wish.SerializeToString(deterministic=True)


def _name(request: Request) -> tuple[str, int]:
    return request.DESCRIPTOR.name, request.request_id


def _is_same_view(active: Request, cancel: Request) -> bool:
    same_kind = type(active) is type(cancel) and active.preset == cancel.preset
    if isinstance(active, ImageRequest) and isinstance(cancel, ImageRequest):
        return same_kind and active.source == cancel.source
    return same_kind
