"""Differences against samples that the receiver has acknowledged: state streams that no loss can stall.

A stream of messages of one type, each coded against one that the other side is known to hold. See
docs/dccl.md for the bytes.
"""

from messages.delta.decoder import DeltaDecoder
from messages.delta.encoder import DeltaEncoder

__all__ = ["DeltaDecoder", "DeltaEncoder"]
