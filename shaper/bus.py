"""The local Zenoh bus: the only file of the core packages that speaks to Zenoh."""

from __future__ import annotations

import contextlib
import ctypes
import json
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

import zenoh
from zenoh.handlers import Callback

from shaper.key_expression import matches

Session = zenoh.Session
_Item = TypeVar("_Item")

_MAX_KEYS_REMEMBERED = 8192  # of subscriptions and of publishers
_LISTENER_POLL_S = 0.005
_MAX_ATTACHED = 64  # of Zenoh's threads: it has two that read, and those that it ends stay in memory

# Two buses on one machine must meet only through the link. Scouting would let them find each other,
# and Zenoh's implicit shared memory would carry payloads of 3 kB and more around an emulated link.
_ISOLATION: dict[str, object] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "transport/shared_memory/enabled": False,
}


@dataclass(frozen=True, slots=True)
class BusSettings:
    """Where a session of the local bus listens and connects.

    listen, connect: Zenoh endpoints such as "tcp/127.0.0.1:7447".
    mode: "router", "peer" or "client"; None for a router where it listens (all that connect to it see
    each other) and a client where it only connects (and connects again when the router was away).
    options: Zenoh's own configuration by path ("transport/link/tx/queue/size/data"), passed through.
    """

    listen: Sequence[str] = ()
    connect: Sequence[str] = ()
    mode: str | None = None
    options: Mapping[str, object] = field(default_factory=dict)


class BusError(Exception):
    """The local bus could not be opened; the message says which endpoint or option."""


def open_bus(settings: BusSettings) -> zenoh.Session:
    """Open an isolated session: explicit endpoints only, no scouting, no shared memory."""
    config = zenoh.Config()
    values: dict[str, object] = {
        "mode": settings.mode or ("router" if settings.listen else "client"),
        **_ISOLATION,
        "listen/endpoints": list(settings.listen),
        "connect/endpoints": list(settings.connect),
        **settings.options,
    }
    for path, value in values.items():
        try:
            config.insert_json5(path, json.dumps(value))
        except zenoh.ZError as error:
            # Zenoh's texts go on with where in its own source the error arose.
            reason = str(error).partition(" at /")[0].rpartition('msg: "')[2]
            raise BusError(f"zenoh option {path} = {value!r} is refused: {reason}") from error
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = f"listen {list(settings.listen)}, connect {list(settings.connect)}"
        reason = str(error).partition(" at /")[0].rstrip("! ")
        raise BusError(f"cannot open the Zenoh bus ({where}): {reason}") from error


class BusSample(NamedTuple):
    """What a local publisher put. payload: not copied yet. missed: samples of the key that it replaced."""

    key: str
    payload: zenoh.ZBytes
    encoding: str
    attachment: bytes
    received_ns: int
    missed: int = 0


class BusInlet:
    """Subscribes to what crosses the link and hands it to an event loop, in batches.

    Zenoh calls back in the threads that read its sockets; all that happens there is a note, and one wake-up
    of the loop for as many samples as have gathered by then. Of a key of which only the newest sample counts
    (`is_latest`) just that one is noted, so thousands of samples a second cost the loop a few hundred.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key_expressions: Sequence[str],
        is_latest: Callable[[str], bool],
        on_samples: Callable[[], None],
        clock_ns: Callable[[], int],
    ) -> None:
        self._session = session
        self._inbox: deque[tuple[str, zenoh.Sample, int]] = deque()
        self._newest: dict[str, tuple[zenoh.Sample, int, int]] = {}  # with arrival and number replaced
        self._lock = threading.Lock()
        self._is_latest = is_latest
        self._on_samples = on_samples
        self._clock_ns = clock_ns
        self._announced = False
        distinct = _without_covered(key_expressions)
        # Only samples of other sessions: what the shaper itself publishes must not cross back.
        self._subscribers = [
            session.declare_subscriber(
                expression, _direct(self._callback(index, distinct)), allowed_origin=zenoh.Locality.REMOTE
            )
            for index, expression in enumerate(distinct)
        ]

    def take(self, *, look_again: bool = False) -> list[BusSample]:
        """The samples that have gathered, oldest first among those that all count.

        look_again: the caller will do so by itself, and is not told of more until it takes without this.
        """
        self._announced = look_again
        with self._lock:
            newest, self._newest = self._newest, {}
        samples = []
        while self._inbox:
            key, sample, received_ns = self._inbox.popleft()
            samples.append(_bus_sample(key, sample, received_ns, 0))
        for key, (sample, received_ns, missed) in newest.items():
            samples.append(_bus_sample(key, sample, received_ns, missed))
        return samples

    def ask(self, key: str, budget_bytes: int) -> None:
        """Ask the key's queryable for its newest item; the first answer comes like a sample."""

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                self._inbox.append((key, reply.ok, self._clock_ns()))
                self._announce()

        selector, target = f"{key}?max_bytes={budget_bytes}", zenoh.QueryTarget.BEST_MATCHING
        self._session.get(selector, _direct(on_reply), target=target)

    def close(self) -> None:
        """Take no more samples."""
        for subscriber in self._subscribers:
            subscriber.undeclare()

    def _callback(self, index: int, expressions: Sequence[str]) -> Callable[[zenoh.Sample], None]:
        # Where two expressions overlap, both subscribers get the sample: the first of them owns the key.
        overlapping = [e for e in expressions[:index] if zenoh.KeyExpr(e).intersects(expressions[index])]
        kinds: dict[str, bool | None] = {}  # by key: latest or not; None if another subscriber owns it

        def kind_of(key: str) -> bool | None:
            return None if any(matches(e, key) for e in overlapping) else self._is_latest(key)

        def on_sample(sample: zenoh.Sample) -> None:
            if sample.kind != zenoh.SampleKind.PUT:
                return
            key = str(sample.key_expr)
            try:
                latest = kinds[key]
            except KeyError:
                if len(kinds) >= _MAX_KEYS_REMEMBERED:
                    kinds.clear()
                latest = kinds[key] = kind_of(key)
            if latest is None:
                return
            now_ns = self._clock_ns()
            if latest:
                with self._lock:
                    before = self._newest.get(key)
                    self._newest[key] = sample, now_ns, 0 if before is None else before[2] + 1
            else:
                self._inbox.append((key, sample, now_ns))
            self._announce()

        return on_sample

    def _announce(self) -> None:
        if not self._announced:
            self._announced = True
            self._on_samples()


class _Put(NamedTuple):
    """Something for the bus. payload: None to delete what is there."""

    key: str
    payload: bytes | None
    encoding: str = ""
    attachment: bytes = b""
    on_put: Callable[[], None] | None = None
    patient_until_s: float = 0.0


class BusOutlet:
    """Publishes what came over the link, from a thread of its own.

    A local subscriber that does not read blocks a put for seconds; the link must not wait for it. A
    message that finds the outlet's queue full is dropped and counted.
    """

    def __init__(self, session: zenoh.Session, max_messages: int = 1024) -> None:
        self.dropped = 0
        self._session = session
        self._queue: queue.Queue[_Put | None] = queue.Queue(max_messages)
        self._publishers: dict[tuple[str, str], zenoh.Publisher] = {}
        self._awaiting: dict[str, deque[_Put]] = {}  # by key, what waits for somebody to listen
        self._max_awaiting = max_messages // 2  # one more is put at once
        self._thread = threading.Thread(target=self._run, name="bus-outlet", daemon=True)
        self._thread.start()

    def publish(
        self,
        key: str,
        payload: bytes,
        encoding: str,
        attachment: bytes,
        on_put: Callable[[], None] | None = None,
        patient_until_s: float = 0.0,
    ) -> bool:
        """Publish a message soon; False if it was dropped. on_put: called in the outlet's thread.

        patient_until_s: until then (monotonic clock) it may wait for the key to have a subscriber. What
        connects to a bus that was away does so seconds after it is back.
        """
        return self._enqueue(_Put(key, payload, encoding, attachment, on_put, patient_until_s))

    def withdraw(self, key: str) -> bool:
        """Delete what was published on a key."""
        return self._enqueue(_Put(key, None))

    def _enqueue(self, put: _Put) -> bool:
        try:
            self._queue.put_nowait(put)
        except queue.Full:
            self.dropped += 1
            return False
        return True

    def close(self) -> None:
        """Publish what is queued and stop, within two seconds."""
        with contextlib.suppress(queue.Full):
            self._queue.put(None, timeout=1)
        self._thread.join(timeout=1)

    def _run(self) -> None:
        while True:
            try:
                item = self._queue.get(timeout=_LISTENER_POLL_S if self._awaiting else None)
            except queue.Empty:
                self._put_what_is_listened_to(time.monotonic())
                continue
            if item is None:
                break
            if self._awaiting or item.patient_until_s:
                now_s = time.monotonic()
                self._put_what_is_listened_to(now_s)
                if self._must_wait(item, now_s):
                    self._awaiting.setdefault(item.key, deque()).append(item)
                    continue
            self._put(item)
        self._put_what_is_listened_to(float("inf"))

    def _must_wait(self, item: _Put, now_s: float) -> bool:
        """Whether nobody listens yet; and nothing overtakes what waits on its key."""
        if item.key in self._awaiting:
            return True
        if now_s >= item.patient_until_s or sum(map(len, self._awaiting.values())) >= self._max_awaiting:
            return False
        return not self._has_listener(item)

    def _put_what_is_listened_to(self, now_s: float) -> None:
        for key, waiting in list(self._awaiting.items()):
            while waiting and (now_s >= waiting[0].patient_until_s or self._has_listener(waiting[0])):
                self._put(waiting.popleft())
            if not waiting:
                del self._awaiting[key]

    def _has_listener(self, item: _Put) -> bool:
        try:
            publisher = self._publisher(item.key, item.encoding)
            status: Any = publisher.matching_status  # its stub says bool, which it is not
            return bool(status.matching)
        except zenoh.ZError:  # the put will meet the same, and count it
            return True

    def _put(self, item: _Put) -> None:
        try:
            if item.payload is None:
                self._session.delete(item.key)
            else:
                self._publisher(item.key, item.encoding).put(item.payload, attachment=item.attachment)
        except zenoh.ZError:  # the session is closing, or the key is none: nothing else may stop here
            self.dropped += 1
        if item.on_put is not None:
            item.on_put()

    def _publisher(self, key: str, encoding: str) -> zenoh.Publisher:
        publisher = self._publishers.get((key, encoding))
        if publisher is None:
            if len(self._publishers) >= _MAX_KEYS_REMEMBERED:
                self._publishers.pop(next(iter(self._publishers))).undeclare()
            publisher = self._publishers[key, encoding] = self._session.declare_publisher(
                key,
                encoding=zenoh.Encoding(encoding),
                congestion_control=zenoh.CongestionControl.BLOCK,
                express=True,
            )
        return publisher


_attached: set[int] = set()  # by their identifiers


def _direct(callback: Callable[[_Item], None]) -> Callback[_Item]:
    """Called in the thread of Zenoh that has read the item, for which `callback` must be quick.

    By default a thread of Python's is in between, which costs a switch each time. A thread that Python does
    not know has its frames' memory mapped at each call and unmapped after it, which costs as much; so it is
    attached once more at its first call, and stays known. Together a third of what taking 4,000 samples/s
    costs (`python -m bench.ingest`).
    """

    def on_item(item: _Item) -> None:
        thread = threading.get_ident()
        if thread not in _attached and len(_attached) < _MAX_ATTACHED:
            _attached.add(thread)
            ctypes.pythonapi.PyGILState_Ensure()
        callback(item)

    return Callback(on_item, indirect=False)


def _bus_sample(key: str, sample: zenoh.Sample, received_ns: int, missed: int) -> BusSample:
    attachment = sample.attachment
    return BusSample(
        key,
        sample.payload,
        str(sample.encoding),
        b"" if attachment is None else attachment.to_bytes(),
        received_ns,
        missed,
    )


def _without_covered(key_expressions: Sequence[str]) -> list[str]:
    distinct = list(dict.fromkeys(key_expressions))
    return [
        e for e in distinct if not any(other != e and zenoh.KeyExpr(other).includes(e) for other in distinct)
    ]
