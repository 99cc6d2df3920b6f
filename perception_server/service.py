"""The perception server on a robot's bus: sensors in, views out, each in a thread of its own."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

import zenoh

from messages.attachment import Stamp, decode_stamp
from messages.proto.straitlink.view_pb2 import (
    VIEW_STATUS_NO_DATA,
    VIEW_STATUS_RENDERED,
    ImageRequest,
    ViewRequest,
)
from perception_server.bus_messages import (
    RequestType,
    fields_of,
    parse_request,
    reply_encoding,
    request_from_fields,
    status_document,
)
from perception_server.dispatch import Dispatcher, Job, Reply, Request, Stream, empty_reply, wish_of
from perception_server.errors import RequestError
from perception_server.receipts import Left
from perception_server.request_status import Stage, Status

QUERY_KEYS: dict[str, RequestType] = {"perception/view": ViewRequest, "perception/image": ImageRequest}
STATUS_KEY = "@straitlink/view"
_RECEIPTS = "@straitlink/receipt/**"
_log = logging.getLogger(__name__)
A = TypeVar("A")
B = TypeVar("B")
_IDLE_S = 1.0
_MAX_WAITING_SAMPLES = 1024
_MAX_WAITING_QUERIES = 32


class Sensors(Protocol):
    """What the service shows views of. `take` is called by one thread, the others by another."""

    def take(self, key: str, encoding: str, payload: bytes, capture_ns: int, now_ns: int) -> None:
        """A sensor's message; bad ones are counted."""

    def newest_ns(self, request: Request) -> int | None:
        """The capture time of the newest data that a request would show."""

    def answer(self, request: Request, budget_bytes: int) -> tuple[Reply, int, int]:
        """The reply, the capture time of its newest data by the sensor, and by the bus's clock."""

    def check(self, request: Request) -> None:
        """Raise RequestError for a request that cannot be."""


@dataclass(frozen=True, slots=True)
class ServiceSettings:
    """inputs: key expressions of the sensors' topics. streams: standing views.

    prefix: what operators request leaves on PREFIX/requested. view_requests, image_requests: keys on which
    their requests arrive. convert: of a stream's key, what its replies become (payload and encoding).
    """

    inputs: Sequence[str]
    streams: Sequence[Stream] = ()
    prefix: str = "robot/view"
    view_requests: str = "operator/view_request"
    image_requests: str = "operator/image_request"
    convert: Mapping[str, Callable[[Reply], tuple[bytes, str]]] = field(default_factory=dict)


class PerceptionService:
    """Open from construction to `close`; Zenoh's threads only leave notes here."""

    def __init__(self, session: zenoh.Session, settings: ServiceSettings, sensors: Sensors) -> None:
        self.samples_dropped = 0
        self._session = session
        self._settings = settings
        self._sensors = sensors
        self._lock = threading.Condition()
        self._dispatcher = Dispatcher(
            settings.streams, f"{settings.prefix}/requested", sensors.check, self._tell
        )
        self._samples: deque[zenoh.Sample] = deque(maxlen=_MAX_WAITING_SAMPLES)
        self._arrived = threading.Event()
        self._askers: dict[str, zenoh.Query] = {}
        self._queries: deque[tuple[Job, zenoh.Query]] = deque()
        self._sequence = 0
        self._stopping = False
        self._statuses: deque[Status] = deque(maxlen=256)
        self._threads = [
            threading.Thread(target=work, name=f"perception-{work.__name__}", daemon=True)
            for work in (self._ingest, self._render)
        ]
        self._declared = self._declare()
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Take and give no more; a render under way is waited for, five seconds at most."""
        for declared in self._declared:
            declared.undeclare()  # type: ignore[no-untyped-call]
        with self._lock:
            self._stopping = True
            self._lock.notify_all()
        self._arrived.set()
        for thread in self._threads:
            thread.join(timeout=5)
        self._askers.clear()

    def _declare(self) -> list[zenoh.Subscriber[None] | zenoh.Queryable[None]]:
        session, settings = self._session, self._settings
        declared: list[zenoh.Subscriber[None] | zenoh.Queryable[None]] = [
            session.declare_subscriber(key, self._on_sample) for key in dict.fromkeys(settings.inputs)
        ]
        requests: tuple[tuple[str, RequestType], ...] = (
            (settings.view_requests, ViewRequest),
            (settings.image_requests, ImageRequest),
        )
        for key, kind in requests:
            declared.append(session.declare_subscriber(key, _bound(self._on_request, kind)))
        declared.append(session.declare_subscriber(_RECEIPTS, self._on_receipt))
        for key in self._dispatcher.keys:
            declared.append(session.declare_queryable(key, _bound(self._on_pull, key)))
        for key, kind in QUERY_KEYS.items():
            declared.append(session.declare_queryable(key, _bound(self._on_query, kind)))
        return declared

    # What Zenoh's threads leave.

    def _on_sample(self, sample: zenoh.Sample) -> None:
        self.samples_dropped += len(self._samples) == _MAX_WAITING_SAMPLES  # the oldest gives way
        self._samples.append(sample)
        self._arrived.set()

    def _on_request(self, kind: RequestType, sample: zenoh.Sample) -> None:
        try:
            request = parse_request(kind, sample.payload.to_bytes())
        except RequestError as error:
            with self._lock:
                self._tell(Status(0, Stage.REFUSED, str(sample.key_expr), str(error)))
                self._lock.notify_all()
            return
        with self._lock:
            reply = self._dispatcher.request(request, time.monotonic_ns())
            if request.period_ms or reply.error:
                self._dispatcher.tell_operator(request, reply)
            self._lock.notify_all()

    def _on_receipt(self, sample: zenoh.Sample) -> None:
        try:
            told = json.loads(sample.payload.to_bytes())
            news = (str(told["topic"]), int(told["capture_ns"]), int(told["sequence"]), str(told["stage"]))
        except (ValueError, KeyError, TypeError):
            return
        with self._lock:
            self._dispatcher.receipts.on_receipt(*news)
            self._lock.notify_all()

    def _on_pull(self, key: str, query: zenoh.Query) -> None:
        """A question is kept until there is an answer; its asker asks anew, and the newest one counts."""
        budget = str(query.parameters.get("max_bytes") or "")
        if not (budget.isascii() and budget.isdigit()):
            query.reply_err(f"max_bytes = {budget!r}: must be a number of bytes".encode())
            return
        with self._lock:
            self._dispatcher.asked(key, min(int(budget), 1 << 32), time.monotonic_ns())
            self._askers[key] = query
            self._lock.notify_all()

    def _on_query(self, kind: RequestType, query: zenoh.Query) -> None:
        """`perception/image?preset=head_low`, or a serialised request as the query's payload."""
        fields = fields_of(str(query.parameters))
        budget = fields.pop("max_bytes", "0")
        try:
            if not (budget.isascii() and budget.isdigit()):
                raise RequestError(f"max_bytes = {budget!r}: must be a number of bytes")
            payload = query.payload
            request = (
                request_from_fields(kind, fields)
                if payload is None
                else parse_request(kind, payload.to_bytes())
            )
        except RequestError as error:
            query.reply_err(str(error).encode())
            return
        with self._lock:
            if request.period_ms:
                found: Job | Reply = self._dispatcher.request(request, time.monotonic_ns())
            else:
                found = self._dispatcher.query(request, int(budget))
            if isinstance(found, Job) and len(self._queries) < _MAX_WAITING_QUERIES:
                self._queries.append((found, query))
            self._lock.notify_all()
        if not isinstance(found, Job):
            self._reply(query, str(query.key_expr), found, None)

    # The threads.

    def _ingest(self) -> None:
        """Sensors' messages into the history, in order of arrival; never waits for a render."""
        while not self._stopping:
            self._arrived.wait(_IDLE_S)
            self._arrived.clear()
            while self._samples and not self._stopping:
                sample = self._samples.popleft()
                stamp = decode_stamp(sample.attachment.to_bytes()) if sample.attachment is not None else None
                self._sensors.take(
                    str(sample.key_expr),
                    str(sample.encoding),
                    sample.payload.to_bytes(),
                    time.time_ns() if stamp is None else stamp.capture_ns,
                    time.monotonic_ns(),
                )

    def _render(self) -> None:
        """One view after the other, each when it may leave."""
        while not self._stopping:
            with self._lock:
                job, query = self._next()
                if job is None:
                    self._wait()
            self._publish_statuses()
            if job is not None:
                self._do(job, query)

    def _next(self) -> tuple[Job | None, zenoh.Query | None]:
        if self._queries:
            return self._queries.popleft()
        job = self._dispatcher.next_job(time.monotonic_ns(), self._sensors.newest_ns)
        return job, self._askers.pop(job.key, None) if job is not None and job.pulled else None

    def _wait(self) -> None:
        now_ns = time.monotonic_ns()
        wakeup_ns = self._dispatcher.wakeup_ns(now_ns)
        waits_s = _IDLE_S if wakeup_ns is None else min(_IDLE_S, (wakeup_ns - now_ns) / 1e9)
        if not self._statuses and not self._stopping:
            self._lock.wait(waits_s)

    def _do(self, job: Job, query: zenoh.Query | None) -> None:
        if job.reply is not None:
            reply, source_ns, capture_ns = job.reply, 0, time.time_ns()
        else:
            reply, source_ns, capture_ns = self._answer(job)
        with self._lock:
            left = self._dispatcher.finish(job, reply, source_ns, time.monotonic_ns())
            if left is None:
                if query is not None:  # nothing to give it yet: it waits on, unless it has asked anew
                    self._askers.setdefault(job.key, query)
                return
            self._sequence += 1
            stamp = Stamp(capture_ns, self._sequence)
            if job.key and left.status == VIEW_STATUS_RENDERED:
                wish, size = wish_of(job.request), left.ByteSize()
                entry = Left(job.request.request_id, job.key, wish, size, source_ns)
                self._dispatcher.receipts.on_left(entry, stamp.capture_ns, stamp.sequence)
        self._leave(job, query, left, stamp)

    def _answer(self, job: Job) -> tuple[Reply, int, int]:
        try:
            return self._sensors.answer(job.request, job.budget_bytes)
        except Exception:  # one view that breaks something must not take the others with it
            _log.exception("a view could not be rendered: %s", str(job.request).replace("\n", ", "))
            return empty_reply(job.request, VIEW_STATUS_NO_DATA, "the server could not render it"), 0, 0

    def _leave(self, job: Job, query: zenoh.Query | None, reply: Reply, stamp: Stamp) -> None:
        if query is not None:
            self._reply(query, job.key or str(query.key_expr), reply, stamp)
        elif job.key:
            payload, encoding = self._converted(job.key, reply)
            self._session.put(job.key, payload, encoding=encoding, attachment=stamp.encode())

    def _reply(self, query: zenoh.Query, key: str, reply: Reply, stamp: Stamp | None) -> None:
        payload, encoding = self._converted(key, reply)
        attachment = None if stamp is None else stamp.encode()
        with query:
            query.reply(key, payload, encoding=encoding, attachment=attachment)

    def _converted(self, key: str, reply: Reply) -> tuple[bytes, str]:
        convert = self._settings.convert.get(key)
        if convert is not None:
            return convert(reply)
        return reply.SerializeToString(), reply_encoding(reply)

    def _tell(self, status: Status) -> None:
        """Called with the lock held: what is told leaves when it is free."""
        self._statuses.append(status)

    def _publish_statuses(self) -> None:
        while self._statuses:
            status = self._statuses.popleft()
            key = f"{STATUS_KEY}/{status.request_id or status.key}"
            self._session.put(key, status_document(status), encoding="application/json")


def _bound(callback: Callable[[A, B], None], first: A) -> Callable[[B], None]:
    """The callback with its first argument given; zenoh wants a plain function."""
    return lambda second: callback(first, second)
