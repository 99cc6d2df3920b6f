"""What docs/encodings.md says is so: its configurations load, its sizes are those of the synthetic mission."""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path

import pytest
from mcap.reader import make_reader

from messages.bounded_catalogue import find_bounded
from messages.payload import Payload
from messages.payload.bounded import BoundedEncoding
from messages.payload.maps import maps_of
from shaper.config import load_config
from straitlink.synthetic.mission_log import synthesize
from straitlink.synthetic.settings import SyntheticSettings
from tests.messages.payload.robots import write_schema
from tests.shaper.test_config import MINIMAL

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "encodings.md").read_text()
ROW = re.compile(r"\| `(\S+/\S+)` \| (\d+) \| `(\S+)` \| (\d+) \| `(\S+)` \|")


def test_the_configurations_of_the_page_load(tmp_path: Path) -> None:
    write_schema(tmp_path)
    blocks = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    assert len(blocks) >= 2
    for number, block in enumerate(blocks):
        path = tmp_path / f"{number}.toml"
        path.write_text(MINIMAL + block)
        assert load_config(path).endpoint.encodings


def test_the_encoding_that_the_example_offers_loads(tmp_path: Path) -> None:
    text = (ROOT / "examples" / "robot.toml").read_text()
    offered = text[text.index("# [encodings.") :].replace("# ", "")
    text = text.replace('max_hz = 5\ncompression = "zstd"', 'max_hz = 5\nencoding = "atlas"', 1)
    path = tmp_path / "robot.toml"
    path.write_text(text + offered)
    rules = {rule.key_expression: rule for rule in load_config(path).endpoint.rules}
    assert rules["robot/joint_states"].encoding is not None


def test_the_mission_s_messages_take_what_the_page_says(tmp_path: Path) -> None:
    rows = {topic: cells for topic, *cells in ROW.findall(PAGE)}
    assert len(rows) == 7
    log = tmp_path / "mission.mcap"
    synthesize(log, SyntheticSettings(6.0, 1, light=True))
    sizes: dict[str, list[tuple[int, int]]] = defaultdict(list)
    encodings = {}
    for topic, (_, _, _, name) in rows.items():
        found = find_bounded(name)
        assert found is not None
        encodings[topic] = BoundedEncoding(found.message_type, maps_of(found.message_type))
    with log.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages(topics=[f"/{t}" for t in rows]):
            topic = channel.topic[1:]
            assert schema is not None and schema.name == rows[topic][1]
            if len(sizes[topic]) >= 50:
                continue
            bus_type = f"application/protobuf;{schema.name}"
            data = encodings[topic].encode(Payload(message.data, bus_type)).data
            payload = encodings[topic].decode(data, bus_type, 100_000, message.publish_time)
            assert payload.type == bus_type
            sizes[topic].append((len(message.data), len(data)))
    for topic, pairs in sizes.items():
        before, _, after, _ = rows[topic]
        mean_before, mean_after = (sum(column) / len(pairs) for column in zip(*pairs, strict=True))
        if topic.startswith("robot/"):
            assert mean_after == pytest.approx(int(after), abs=0.5), topic
        assert mean_before == pytest.approx(int(before), rel=0.25), topic
    assert {topic for topic in rows if topic.startswith("robot/")} <= sizes.keys()
