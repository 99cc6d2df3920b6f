"""The synthetic mission: a walking humanoid's log, made from numbers alone, with exact ground truth."""

from straitlink.synthetic.mission_log import synthesize
from straitlink.synthetic.settings import SyntheticSettings, SyntheticSummary, TopicSummary
from straitlink.synthetic.stream import message_stream
from straitlink.synthetic.ticks import SyntheticMessage

__all__ = [
    "SyntheticMessage",
    "SyntheticSettings",
    "SyntheticSummary",
    "TopicSummary",
    "message_stream",
    "synthesize",
]
