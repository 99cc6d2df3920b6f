"""A band in the words of `tc ... netem`, and what the kernel then says that it has.

netem delays first and serves then, charges the Ethernet frame unless told otherwise, and limits its queue in
packets, those in the delay line included. Its rates are in bit/s as `bit`; tc's `bps` and `kbps` are bytes.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

from .band import IP_UDP_HEADER_BYTES, Band, DirectionProfile, JitterShape, ProfileError

ETHERNET_BYTES = 14
HALF_NORMAL = "straitlink-half-normal"
_TABLE_ENTRIES = 4096
_TABLE_SCALE = 8192  # pkt_sched.h: NETEM_DIST_SCALE, one sigma
_NO_LIMIT_PACKETS = 100_000
_NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class NetemBand:
    """One band as netem has it. delay_ns and jitter_ns: mean and scale in netem's sense."""

    limit_packets: int
    delay_ns: int
    jitter_ns: int
    distribution: str | None
    loss: tuple[str, ...]
    duplicate_ratio: float
    corrupt_ratio: float
    rate_bps: int
    packet_overhead_bytes: int

    def arguments(self) -> list[str]:
        """All settings, also those that are zero: a change leaves alone what it is not told."""
        words = ["limit", str(self.limit_packets), "delay", _time(self.delay_ns)]
        if self.jitter_ns:
            words.append(_time(self.jitter_ns))
            words += ["distribution", self.distribution] if self.distribution else []
        words += ["loss", *self.loss]
        words += ["duplicate", _percent(self.duplicate_ratio), "corrupt", _percent(self.corrupt_ratio)]
        return [*words, "rate", f"{self.rate_bps}bit", str(self.packet_overhead_bytes)]

    def differences(self, options: dict[str, Any]) -> list[str]:
        """What the options of `tc -j qdisc show` say otherwise, as sentences' halves; empty if all agree."""
        delay = options.get("delay", {})
        rate = options.get("rate", {})
        asked_and_had = [
            ("limit", self.limit_packets, options.get("limit"), 0),
            ("delay in s", self.delay_ns / 1e9, delay.get("delay", 0.0), 2e-6),
            ("jitter in s", self.jitter_ns / 1e9, delay.get("jitter", 0.0), 2e-6),
            ("rate in byte/s", self.rate_bps // 8, rate.get("rate"), 0),
            ("packet overhead", self.packet_overhead_bytes, rate.get("packetoverhead"), 0),
            ("duplicate", self.duplicate_ratio, options.get("duplicate", {}).get("duplicate", 0.0), 1e-6),
            ("corrupt", self.corrupt_ratio, options.get("corrupt", {}).get("corrupt", 0.0), 1e-6),
        ]
        if self.loss[0] == "random":
            had_ratio = options.get("loss-random", {}).get("loss", 0.0)
            asked_and_had.append(("loss", float(self.loss[1].rstrip("%")) / 100, had_ratio, 1e-6))
        elif "loss-gemodel" not in options:
            asked_and_had.append(("loss-gemodel", 1, 0, 0))
        return [
            f"{name} = {asked} was asked for, the kernel has {had}"
            for name, asked, had, tolerance in asked_and_had
            if had is None or abs(asked - had) > tolerance
        ]


def netem_band(direction: DirectionProfile, index: int, packet_bytes: int) -> NetemBand:
    """One band of a direction; packet_bytes: the IP packets that a buffer in bytes or seconds is counted in.

    Raises ProfileError for what netem cannot do. minimum_bytes is not known to it: smaller packets cost less.
    """
    band = direction.bands[index]
    if band.rate_bps == 0:
        raise ProfileError(f"Band {index} has rate_bps = 0; netem cannot hold a queue (0 is no limit to it).")
    if band.reorder:
        raise ProfileError(f"Band {index} has reorder = true; netem keeps the order where it has a rate.")
    if direction.mtu_bytes is not None:
        raise ProfileError(f"mtu_bytes = {direction.mtu_bytes} is not netem's; set the device's MTU.")
    uniform = band.jitter_shape is JitterShape.UNIFORM
    return NetemBand(
        limit_packets=_limit_packets(direction, index, packet_bytes),
        delay_ns=band.one_way_delay_ns + (band.jitter_ns // 2 if uniform else 0),
        jitter_ns=band.jitter_ns // 2 if uniform else band.jitter_ns,
        distribution=None if uniform or not band.jitter_ns else HALF_NORMAL,
        loss=_loss(band),
        duplicate_ratio=band.duplicate_ratio,
        corrupt_ratio=band.corrupt_ratio,
        rate_bps=band.rate_bps // 8 * 8,  # the kernel counts bytes per second
        packet_overhead_bytes=direction.overhead_bytes - IP_UDP_HEADER_BYTES - ETHERNET_BYTES,
    )


def half_normal_table() -> str:
    """|N(0, 1)| as tc's distribution file: values in units of 1/8192 sigma, each as likely as the others."""
    normal = NormalDist()
    values = []
    for number in range(_TABLE_ENTRIES):
        quantile = normal.inv_cdf((1 + (number + 0.5) / _TABLE_ENTRIES) / 2)
        values.append(min(32_767, round(quantile * _TABLE_SCALE)))
    lines = [" ".join(map(str, values[at : at + 8])) for at in range(0, len(values), 8)]
    return "\n".join(["# |N(0, 1)|", *lines, ""])


def _limit_packets(direction: DirectionProfile, index: int, packet_bytes: int) -> int:
    band = direction.bands[index]
    limits = [_NO_LIMIT_PACKETS]
    charged_bytes = packet_bytes + direction.overhead_bytes - IP_UDP_HEADER_BYTES
    if direction.buffer_packets is not None:
        limits.append(direction.buffer_packets)
    if direction.buffer_bytes is not None:
        limits.append(direction.buffer_bytes // charged_bytes)
    if direction.buffer_ns is not None:
        limits.append(direction.buffer_ns * band.rate_bps // (8 * _NS_PER_S * charged_bytes))
    delayed = band.rate_bps * band.one_way_delay_ns / (8 * _NS_PER_S * charged_bytes)
    return max(1, min(limits)) + round(delayed)


def _loss(band: Band) -> tuple[str, ...]:
    burst = band.burst_loss
    if burst is None:
        return "random", _percent(band.loss_ratio)
    ratios = (burst.enter_bad_ratio, burst.leave_bad_ratio, burst.bad_loss_ratio, burst.good_loss_ratio)
    return ("gemodel", *(_percent(ratio) for ratio in ratios))


def _time(duration_ns: int) -> str:
    return f"{duration_ns / 1000:.3f}us"


def _percent(ratio: float) -> str:
    return f"{ratio * 100:.6g}%"
