"""What chance does to the packets of one direction; the random source is passed in."""

from __future__ import annotations

from typing import Protocol

from .band import Band, BurstLoss, JitterShape


class RandomSource(Protocol):
    """Where chance comes from; random.Random fits."""

    def random(self) -> float: ...
    def gauss(self, mu: float, sigma: float) -> float: ...
    def getrandbits(self, k: int, /) -> int: ...


class Chance:
    """Draws a packet's misfortunes; no number is drawn for what the band excludes."""

    __slots__ = ("_bad", "_rng")

    def __init__(self, rng: RandomSource) -> None:
        self._rng = rng
        self._bad = False  # the state of a band with burst loss

    def loses(self, band: Band) -> bool:
        """Whether the packet is lost."""
        if band.burst_loss is not None:
            return self._loses_in_burst(band.burst_loss)
        return bool(band.loss_ratio) and self._rng.random() < band.loss_ratio

    def duplicates(self, band: Band) -> bool:
        """Whether the packet arrives twice."""
        return bool(band.duplicate_ratio) and self._rng.random() < band.duplicate_ratio

    def corrupted_bit(self, band: Band, payload_bytes: int) -> int | None:
        """The bit of the payload that is flipped, 0 being the highest of the first byte; None for none."""
        if band.corrupt_ratio and self._rng.random() < band.corrupt_ratio and payload_bytes > 0:
            return int(self._rng.random() * payload_bytes * 8)
        return None

    def jitter_ns(self, band: Band) -> int:
        """The delay on top of the band's."""
        if not band.jitter_ns:
            return 0
        if band.jitter_shape is JitterShape.UNIFORM:
            return int(self._rng.random() * (band.jitter_ns + 1))
        return int(abs(self._rng.gauss(0.0, band.jitter_ns)))

    def _loses_in_burst(self, burst: BurstLoss) -> bool:
        """The state that the packet finds decides, as in netem; the change is for the next one."""
        bad = self._bad
        leave_ratio = burst.leave_bad_ratio if bad else burst.enter_bad_ratio
        if self._rng.random() < leave_ratio:
            self._bad = not bad
        return self._rng.random() < (burst.bad_loss_ratio if bad else burst.good_loss_ratio)


def with_flipped_bit(payload: bytes, bit: int) -> bytes:
    """The payload with one bit the other way round; bit 0 is the highest of the first byte."""
    flipped = bytearray(payload)
    flipped[bit // 8] ^= 0x80 >> bit % 8
    return bytes(flipped)
