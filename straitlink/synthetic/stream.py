"""All topics of the mission as one stream in order of time."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence

from messages.catalogue import CATALOGUE, CatalogueTopic
from straitlink.synthetic.operator_script import SCRIPT_SOURCES
from straitlink.synthetic.perception import PERCEPTION_SOURCES
from straitlink.synthetic.robot_state import STATE_SOURCES, Samples
from straitlink.synthetic.scene import Box, build_scene
from straitlink.synthetic.settings import SyntheticSettings
from straitlink.synthetic.supervision import SUPERVISION_SOURCES
from straitlink.synthetic.ticks import SyntheticMessage

_BODY_SOURCES: dict[str, Callable[[CatalogueTopic, SyntheticSettings], Samples]] = {
    **STATE_SOURCES,
    **SUPERVISION_SOURCES,
    **SCRIPT_SOURCES,
}


def message_stream(settings: SyntheticSettings) -> Iterator[SyntheticMessage]:
    """The whole mission, both directions, by capture time; ties in the catalogue's order.

    Lazy: holds half a second of each topic. The keys tell the direction: "robot/..." comes down,
    "operator/..." goes up.
    """
    boxes = build_scene(settings.seed)
    sources = (_numbered(index, topic, settings, boxes) for index, topic in enumerate(CATALOGUE))
    for _, _, message in heapq.merge(*sources):
        yield message


def _numbered(
    index: int, topic: CatalogueTopic, settings: SyntheticSettings, boxes: Sequence[Box]
) -> Iterator[tuple[int, int, SyntheticMessage]]:
    """A topic's samples with what orders them; (time, index) is unique, so messages are never compared."""
    key, schema_name = topic.key, topic.schema_name
    for sequence, (capture_ns, payload) in enumerate(_samples(topic, settings, boxes)):
        yield capture_ns, index, SyntheticMessage(key, schema_name, payload, capture_ns, sequence)


def _samples(topic: CatalogueTopic, settings: SyntheticSettings, boxes: Sequence[Box]) -> Samples:
    if topic.rate_hz == 0:  # on demand only: nobody presses the emergency stop in this mission
        return iter(())
    if topic.key in PERCEPTION_SOURCES:
        return PERCEPTION_SOURCES[topic.key](topic, settings, boxes)
    return _BODY_SOURCES[topic.key](topic, settings)
