"""When a view is rendered, for whom, and what is told of it."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from messages.proto.straitlink.view_pb2 import (
    VIEW_STATUS_ACCEPTED,
    VIEW_STATUS_CANCELLED,
    VIEW_STATUS_DOES_NOT_FIT,
    VIEW_STATUS_NO_DATA,
    VIEW_STATUS_REFUSED,
    VIEW_STATUS_RENDERED,
    VIEW_STATUS_UNCHANGED,
    Image,
    ImageRequest,
    ViewRequest,
)
from perception_server.dispatch import MAX_ACTIVE, Dispatcher, Job, Reply, Request, Stream, wish_of
from perception_server.errors import RequestError
from perception_server.receipts import Left
from perception_server.request_status import Status

MS = 1_000_000
S = 1_000_000_000
HEAD = "robot/view/head"
REQUESTED = "robot/view/requested"
LOW = ImageRequest(preset="head_low")


def check(request: Request) -> None:
    if isinstance(request, ImageRequest) and request.quality > 100:
        raise RequestError("quality = 101: must be within 1..100")


@dataclass
class Desk:
    """A dispatcher, its clock, the newest data, and a renderer that always gives the same."""

    streams: tuple[Stream, ...] = ()
    now_ns: int = 0
    newest_ns: int | None = 0
    told: list[Status] = field(default_factory=list)
    status: int = VIEW_STATUS_RENDERED
    left: list[tuple[int, Job, Reply]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.dispatcher = Dispatcher(self.streams, REQUESTED, check, self.told.append)

    def job(self) -> Job | None:
        return self.dispatcher.next_job(self.now_ns, lambda request: self.newest_ns)

    def work(self) -> list[Reply]:
        """Do all that may be done now; what left."""
        before = len(self.left)
        while (job := self.job()) is not None:
            self.render(job)
        return [reply for _, _, reply in self.left[before:]]

    def render(self, job: Job) -> Reply | None:
        made = job.reply
        if made is None:
            made = Image(request_id=job.request.request_id, status=self.status, data=b"x")  # type: ignore[arg-type]
            made.smallest_bytes = 900
        left = self.dispatcher.finish(job, made, self.newest_ns or 0, self.now_ns)
        if left is not None:
            self.left.append((self.now_ns, job, left))
            if left.status == VIEW_STATUS_RENDERED:
                wish = wish_of(job.request)
                entry = Left(job.request.request_id, job.key, wish, 1, self.newest_ns or 0)
                self.dispatcher.receipts.on_left(entry, self.now_ns, 0)
        return left

    def advance(self, duration_ns: int, *, camera: bool = True) -> None:
        """Let time pass in steps, with a camera that takes a frame each step."""
        for _ in range(duration_ns // (50 * MS)):
            self.now_ns += 50 * MS
            if camera:
                self.newest_ns = self.now_ns
            self.work()

    def stages(self, request_id: int) -> list[str]:
        return [status.stage.value for status in self.told if status.request_id == request_id]


def test_without_an_asker_a_stream_is_published_on_its_period() -> None:
    desk = Desk((Stream(HEAD, LOW, 1 * S),))
    desk.advance(10 * S)
    assert 10 <= len(desk.left) <= 11
    assert all(job.key == HEAD and not job.pulled for _, job, _ in desk.left)


def test_with_an_asker_nothing_is_rendered_before_it_asks_and_then_the_newest_to_its_budget() -> None:
    desk = Desk((Stream(HEAD, LOW, 0),))
    desk.dispatcher.asked(HEAD, 5_000, desk.now_ns)
    assert len(desk.work()) == 1
    desk.advance(5 * S)
    assert len(desk.left) == 1
    desk.dispatcher.asked(HEAD, 700, desk.now_ns)
    (_,) = desk.work()
    assert [job.budget_bytes for _, job, _ in desk.left] == [5_000, 700]
    assert all(job.pulled for _, job, _ in desk.left)


def test_an_asker_waits_until_the_period_has_passed_and_there_is_something_new() -> None:
    desk = Desk((Stream(HEAD, LOW, 1 * S),))
    desk.dispatcher.asked(HEAD, 5_000, 0)
    desk.work()
    desk.dispatcher.asked(HEAD, 5_000, 0)
    desk.now_ns = S
    assert desk.work() == []  # due, but the frame is the same
    desk.newest_ns = desk.now_ns
    assert len(desk.work()) == 1


def test_an_asker_that_went_away_is_forgotten_and_publishing_begins_again() -> None:
    desk = Desk((Stream(HEAD, LOW, 1 * S),))
    desk.dispatcher.asked(HEAD, 5_000, 0)
    desk.work()
    desk.advance(29 * S)
    assert len(desk.left) == 1
    desk.advance(10 * S)
    assert 8 <= len(desk.left) <= 11 and not desk.left[-1][1].pulled


def test_a_request_is_answered_once_on_the_requested_key() -> None:
    desk = Desk()
    reply = desk.dispatcher.request(ImageRequest(request_id=7, preset="head_low"), 0)
    assert reply.status == VIEW_STATUS_ACCEPTED
    desk.advance(5 * S)
    ((_, job, _),) = desk.left
    assert job.key == REQUESTED
    assert desk.stages(7) == ["accepted", "rendered"]


def test_a_request_repeats_for_its_duration() -> None:
    desk = Desk()
    desk.dispatcher.request(ImageRequest(request_id=7, period_ms=500, duration_s=4), 0)
    desk.advance(10 * S)
    assert 8 <= len(desk.left) <= 9
    assert desk.stages(7)[0] == "accepted" and desk.stages(7)[-1] == "ended"


@pytest.mark.parametrize("request_id", [7, 9])
def test_what_repeats_is_cancelled_by_its_number_or_its_view(request_id: int) -> None:
    desk = Desk()
    desk.dispatcher.request(ImageRequest(request_id=7, preset="head_low", period_ms=500), 0)
    desk.advance(2 * S)
    before = len(desk.left)
    cancel = ImageRequest(request_id=request_id, preset="head_low", period_ms=-1)
    assert desk.dispatcher.request(cancel, desk.now_ns).status == VIEW_STATUS_CANCELLED
    desk.advance(2 * S)
    assert len(desk.left) == before and desk.stages(7)[-1] == "cancelled"


def test_cancelling_what_is_not_there_is_refused() -> None:
    reply = Desk().dispatcher.request(ViewRequest(request_id=7, preset="height_map_scene", period_ms=-1), 0)
    assert reply.status == VIEW_STATUS_REFUSED and reply.error.startswith("period_ms = -1")


def test_a_view_and_an_image_of_one_number_are_two_requests() -> None:
    desk = Desk()
    desk.dispatcher.request(ImageRequest(request_id=7, period_ms=500), 0)
    desk.dispatcher.request(ViewRequest(request_id=7, period_ms=500), 0)
    assert len(desk.work()) == 2


def test_a_bad_request_is_refused_with_its_field_and_the_operator_hears_of_it() -> None:
    desk = Desk()
    request = ImageRequest(request_id=7, quality=101)
    reply = desk.dispatcher.request(request, 0)
    desk.dispatcher.tell_operator(request, reply)
    (left,) = desk.work()
    assert left.status == VIEW_STATUS_REFUSED and left.error == "quality = 101: must be within 1..100"
    assert desk.told[0].error == left.error and desk.stages(7) == ["refused"]


def test_requests_are_bounded() -> None:
    desk = Desk()
    for number in range(MAX_ACTIVE):
        desk.dispatcher.request(ImageRequest(request_id=number, period_ms=500), 0)
    reply = desk.dispatcher.request(ImageRequest(request_id=99, period_ms=500), 0)
    assert reply.status == VIEW_STATUS_REFUSED and "cancel one" in reply.error
    again = desk.dispatcher.request(ImageRequest(request_id=3, period_ms=900), 0)
    assert again.status == VIEW_STATUS_ACCEPTED


def test_a_frame_is_not_sent_twice_unless_asked_or_lost() -> None:
    desk = Desk()
    for number, said in ((1, {}), (2, {}), (2, {}), (3, {"again": True}), (4, {"at_ns": 5})):
        desk.dispatcher.request(ImageRequest(request_id=number, preset="head_low", **said), 0)  # type: ignore[arg-type]
        desk.work()
    statuses = [reply.status for _, _, reply in desk.left]
    rendered = VIEW_STATUS_RENDERED
    assert statuses == [rendered, VIEW_STATUS_UNCHANGED, VIEW_STATUS_UNCHANGED, rendered, rendered]


def test_a_lost_view_may_be_requested_again() -> None:
    desk = Desk()
    for number in (1, 2):
        desk.dispatcher.request(ImageRequest(request_id=number, preset="head_low"), 0)
        desk.work()
        desk.dispatcher.receipts.on_receipt(REQUESTED, desk.now_ns, 0, "sent")
        desk.dispatcher.receipts.on_receipt(REQUESTED, desk.now_ns, 0, "lost")
    assert [reply.status for _, _, reply in desk.left] == [VIEW_STATUS_RENDERED] * 2
    assert desk.stages(1) == ["accepted", "rendered", "sent", "lost"]


def test_a_retry_of_the_same_request_is_answered_again() -> None:
    desk = Desk()
    for _ in range(2):
        desk.dispatcher.request(ImageRequest(request_id=1, preset="head_low"), 0)
        desk.work()
    assert [reply.status for _, _, reply in desk.left] == [VIEW_STATUS_RENDERED] * 2


def test_a_delivered_view_is_told_once() -> None:
    desk = Desk()
    desk.dispatcher.request(ImageRequest(request_id=1), 0)
    desk.work()
    for stage in ("queued", "sent", "delivered", "delivered", "nonsense"):
        desk.dispatcher.receipts.on_receipt(REQUESTED, desk.now_ns, 0, stage)
    assert desk.stages(1) == ["accepted", "rendered", "sent", "delivered"]


@pytest.mark.parametrize("status", [VIEW_STATUS_NO_DATA, VIEW_STATUS_DOES_NOT_FIT])
def test_a_failure_is_told_at_once_of_one_request_once_of_what_repeats_and_a_stream_stays_silent(
    status: int,
) -> None:
    desk = Desk((Stream(HEAD, LOW, 1 * S),), status=status)
    desk.dispatcher.request(ImageRequest(request_id=1), 0)
    desk.dispatcher.request(ImageRequest(request_id=2, period_ms=500), 0)
    desk.advance(5 * S)
    assert sorted(reply.request_id for _, _, reply in desk.left) == [1, 2]
    assert desk.stages(0) == ["failed"] and desk.stages(1) == desk.stages(2) == ["accepted", "failed"]
    desk.status = VIEW_STATUS_RENDERED
    desk.advance(2 * S)
    assert desk.stages(0)[1] == desk.stages(2)[2] == "rendered"


def test_one_view_waits_for_a_larger_budget_but_not_for_ever() -> None:
    desk = Desk(status=VIEW_STATUS_DOES_NOT_FIT)
    for number in (1, 2):
        desk.dispatcher.request(ImageRequest(request_id=number, budget_bytes=number - 1), 0)
    for _ in range(20):
        desk.dispatcher.asked(REQUESTED, 300, desk.now_ns)
        desk.advance(1 * S)
    assert desk.stages(1) == desk.stages(2) == ["accepted", "failed"]
    left_ns = {reply.request_id: at_ns for at_ns, _, reply in desk.left}
    assert left_ns[2] < 1 * S  # its own budget is too small: waiting does not help
    assert 10 * S <= left_ns[1] < 12 * S


def test_what_fails_keeps_the_asker_for_the_next_that_works() -> None:
    desk = Desk((Stream(HEAD, LOW, 0),), status=VIEW_STATUS_NO_DATA)
    desk.dispatcher.asked(HEAD, 5_000, 0)
    assert desk.work() == []
    desk.status = VIEW_STATUS_RENDERED
    desk.advance(1 * S)
    assert len(desk.left) == 1 and desk.left[0][1].pulled


def test_a_request_that_is_replaced_while_it_is_rendered_leaves_nothing() -> None:
    desk = Desk()
    desk.dispatcher.request(ImageRequest(request_id=1, preset="head_low"), 0)
    job = desk.job()
    assert job is not None
    desk.dispatcher.request(ImageRequest(request_id=1, preset="head_high"), 0)
    assert desk.render(job) is None
    (reply,) = desk.work()
    assert reply.status == VIEW_STATUS_RENDERED


def test_the_smaller_of_the_two_budgets_counts() -> None:
    desk = Desk()
    desk.dispatcher.request(ImageRequest(request_id=1, budget_bytes=900), 0)
    desk.dispatcher.asked(REQUESTED, 5_000, 0)
    job = desk.job()
    assert job is not None and job.budget_bytes == 900
    queried = desk.dispatcher.query(ImageRequest(budget_bytes=900), 400)
    assert isinstance(queried, Job) and queried.budget_bytes == 400 and queried.key == ""


def test_a_query_is_answered_at_once_and_always() -> None:
    desk = Desk()
    for _ in range(2):
        job = desk.dispatcher.query(ImageRequest(request_id=1), 0)
        assert isinstance(job, Job)
        reply = desk.render(job)
        assert reply is not None and reply.status == VIEW_STATUS_RENDERED


def test_the_clock_is_looked_at_no_more_often_than_needed() -> None:
    desk = Desk()
    assert desk.dispatcher.wakeup_ns(0) is None
    desk.dispatcher.request(ImageRequest(request_id=1, period_ms=2_000), 0)
    desk.work()
    assert desk.dispatcher.wakeup_ns(0) == 2 * S


def test_nobody_can_ask_on_a_foreign_key() -> None:
    assert not Desk().dispatcher.asked("robot/other", 100, 0)
