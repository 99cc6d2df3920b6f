"""Range coding of integers whose spread is known only roughly: the same bits on every machine."""

from messages.entropy.range_coder import RangeDecoder, RangeEncoder
from messages.entropy.spread import NEAR, Spread

__all__ = ["NEAR", "RangeDecoder", "RangeEncoder", "Spread"]
