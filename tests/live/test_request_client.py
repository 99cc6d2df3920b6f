"""Who asks for a view while the server still compiles what draws it gets the view, not the excuse."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import zenoh

from messages.proto.straitlink.view_pb2 import VIEW_STATUS_NO_DATA, VIEW_STATUS_RENDERED, View, ViewRequest
from perception_server.bus_messages import VIEW_ENCODING
from perception_server.readiness import Readiness, is_warming_up
from shaper.bus import BusSettings, open_bus
from straitlink import request_client
from straitlink.demo.configs import free_addresses
from straitlink.request_client import RequestSettings, request_view

pytestmark = pytest.mark.live


@contextmanager
def server(answers: int) -> Iterator[tuple[RequestSettings, list[int]]]:
    """A bus with a server that is warm after so many answers; the numbers of the requests that it got."""
    endpoint = free_addresses().robot_bus
    session = open_bus(BusSettings(listen=[endpoint]))
    asked: list[int] = []

    def answer(query: zenoh.Query) -> None:
        assert query.payload is not None
        request = ViewRequest.FromString(query.payload.to_bytes())
        asked.append(request.request_id)
        view = Readiness(geometry=len(asked) > answers).geometry_not_yet(request)
        view = view or View(request_id=request.request_id, status=VIEW_STATUS_RENDERED, data=b"drawn")
        query.reply(query.key_expr, view.SerializeToString(), encoding=VIEW_ENCODING)

    queryable = session.declare_queryable("perception/view", answer)
    try:
        yield RequestSettings(BusSettings(connect=[endpoint]), timeout_s=20.0), asked
    finally:
        queryable.undeclare()
        session.close()


def test_a_server_that_warms_up_is_asked_again_until_it_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(request_client, "_WARMING_S", 0.1)
    said: list[str] = []
    with server(answers=2) as (settings, asked):
        reply, took_s = request_view(ViewRequest(preset="height_map_scene"), settings, said.append)
    assert (reply.status, reply.data) == (VIEW_STATUS_RENDERED, b"drawn")
    assert len(asked) == 3 and len(set(asked)) == 1
    assert len(said) == 2 and all("being compiled" in line for line in said)
    assert took_s < settings.timeout_s


def test_what_it_says_is_the_answer_once_there_is_no_time_to_ask_again() -> None:
    with server(answers=9) as (settings, asked):
        hurried = RequestSettings(settings.bus, timeout_s=1.0)
        reply, _ = request_view(ViewRequest(request_id=5, preset="height_map_scene"), hurried)
    assert reply.status == VIEW_STATUS_NO_DATA and is_warming_up(reply)
    assert asked == [5]
