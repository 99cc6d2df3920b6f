from __future__ import annotations

import json
from pathlib import Path

from netem_scripts.link import DropReason
from netem_scripts.profile_file import profile_from_dict
from netem_scripts.profiles import profile_named
from netem_scripts.records import BandRecord, PacketRecord, StartRecord
from netem_scripts.trace import LinkTrace


def test_a_trace_holds_one_line_per_record_already_before_it_is_closed(tmp_path: Path) -> None:
    path = tmp_path / "link.jsonl"
    profile = profile_named("trials")
    with LinkTrace(path) as trace:
        trace.write(StartRecord(10, 20, profile))
        trace.write(BandRecord(10, "up", 1_000_000, 50_000_000))
        trace.write(PacketRecord(11, "down", 128, 5, None))
        trace.write(PacketRecord(12, "down", 128, 6, DropReason.OVERFLOW))
        lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    start, band, sent, dropped = lines
    assert profile_from_dict(start.pop("profile"), where="trace", name="") == profile
    assert start == {"event": "start", "t_ns": 10, "unix_ns": 20, "side": "link"}
    assert band == {
        "event": "band",
        "t_ns": 10,
        "direction": "up",
        "rate_bps": 1_000_000,
        "one_way_delay_ns": 50_000_000,
    }
    packet = {"event": "packet", "t_ns": 11, "direction": "down", "wire_bytes": 128, "queue_delay_ns": 5}
    assert sent == {**packet, "dropped": None}
    assert dropped == {**packet, "t_ns": 12, "queue_delay_ns": 6, "dropped": "OVERFLOW"}
