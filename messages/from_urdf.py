"""A robot's URDF as a .proto: one bounded field for each joint, with exactly its limits.

The message that comes out is understood by `messages.payload.joint_maps`: three groups of fields
(positions, velocities, efforts), each field with its joint's name as json_name.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal

from messages.urdf import Joint, Robot

# Milliseconds since 1970 in 42 bits, until the year 2109. MIT's bounds of 2013 ended in December 2015.
MAX_STAMP_MS = (1 << 42) - 1
_STAMP_BITS = 42
_FIGURES = 4  # of a resolution that is chosen for a number of bits


@dataclass(frozen=True, slots=True)
class Detail:
    """How finely the joints are told.

    bits: for each position; None to use the resolutions instead (rad of turning, m of sliding joints).
    velocity_bits, effort_bits: for each velocity and effort; 0 leaves them out.
    margin_ratio: by which share of its range a position may exceed each limit (encoders do).
    has_stamp: the sample's time crosses too, in milliseconds; without it the link's capture time stands in.
    """

    bits: int | None = None
    resolution_rad: float = 0.001
    resolution_m: float = 0.0005
    velocity_bits: int = 0
    effort_bits: int = 0
    margin_ratio: float = 0.0
    has_stamp: bool = True

    def __post_init__(self) -> None:
        for name, least in (("bits", 2), ("velocity_bits", 0), ("effort_bits", 0)):
            value = getattr(self, name)
            if value is not None and not (value == 0 == least or 2 <= value <= 32):
                raise ValueError(f"{name} = {value} is not within 2..32")
        for name in ("resolution_rad", "resolution_m"):
            if not 1e-9 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} = {getattr(self, name)} is not within 1e-9..1")
        if not 0 <= self.margin_ratio <= 1:
            raise ValueError(f"margin_ratio = {self.margin_ratio} is not within 0..1")


@dataclass(frozen=True, slots=True)
class _Bounds:
    """minimum and maximum are whole multiples of the resolution, as DCCL asks."""

    minimum: Decimal
    maximum: Decimal
    resolution: Decimal

    @property
    def bits(self) -> int:
        """Of an optional field, in which one value more says that it is unset.

        In doubles and in DCCL's order, whose rounding noise can cost a bit.
        """
        values = math.ceil((float(self.maximum) - float(self.minimum)) / float(self.resolution) + 2)
        return (values - 1).bit_length()


def proto_of(robot: Robot, detail: Detail, source: str, joints: Iterable[str] | None = None) -> str:
    """The .proto file's text. joints: only these, in this order; names that the robot lacks raise KeyError.

    source: what the limits were read from, told in the file.
    """
    by_name = {joint.name: joint for joint in robot.joints}
    chosen = robot.joints if joints is None else tuple(by_name[name] for name in joints)
    groups = [("Positions", "positions", [_position_bounds(joint, detail) for joint in chosen])]
    if detail.velocity_bits:
        limits = [_symmetric(joint, "velocity", detail.velocity_bits) for joint in chosen]
        groups.append(("Velocities", "velocities", limits))
    if detail.effort_bits:
        limits = [_symmetric(joint, "effort", detail.effort_bits) for joint in chosen]
        groups.append(("Efforts", "efforts", limits))
    bits = _STAMP_BITS * detail.has_stamp
    bits += sum(1 + sum(b.bits for b in bounds) for _, _, bounds in groups)
    lines = [
        f"// Joint states of {_one_line(robot.name)}, bounds from {_one_line(source)}.",
        "// Written by `straitlink messages from-urdf`; both sides of a link need the same file.",
        'syntax = "proto2";',
        f"package {_identifier(robot.name).lower()};",
        "",
        'import "dccl/option_extensions.proto";',
        "",
        "message JointStates {",
        f"  option (dccl.msg) = {{ codec_version: 4 omit_id: true max_bytes: {-(-bits // 8)} }};",
    ]
    for title, field, bounds in groups:
        lines += ["", f"  message {title} {{", *_fields(chosen, field, bounds), "  }"]
    lines.append("")
    if detail.has_stamp:
        lines.append(
            f"  optional uint64 stamp_ms = 1 [(dccl.field) = {{ min: 0 max: {MAX_STAMP_MS - 1} "
            'units { unit: "ms" } description: "Unix time" }];'
        )
    lines += [f"  optional {title} {field} = {number};" for number, (title, field, _) in enumerate(groups, 2)]
    return "\n".join([*lines, "}", ""])


def _position_bounds(joint: Joint, detail: Detail) -> _Bounds:
    margin = 0.0 if joint.kind == "continuous" else detail.margin_ratio * (joint.upper - joint.lower)
    lower, upper = joint.lower - margin, joint.upper + margin
    if detail.bits is not None:
        return _bounds_of_bits(lower, upper, detail.bits)
    resolution = detail.resolution_m if joint.kind == "prismatic" else detail.resolution_rad
    return _snapped(lower, upper, Decimal(repr(resolution)))


def _symmetric(joint: Joint, quantity: str, bits: int) -> _Bounds:
    limit: float | None = getattr(joint, quantity)
    if not limit:
        raise ValueError(
            f"joint {joint.name!r} states no {quantity} limit within 0 and 1e6: {quantity} bits need one"
        )
    return _bounds_of_bits(-abs(limit), abs(limit), bits)


def _bounds_of_bits(lower: float, upper: float, bits: int) -> _Bounds:
    """The finest resolution of four figures with which the range, snapped outwards, takes so many bits."""
    steps = (1 << bits) - 2  # 2^bits values, of which one says "unset"
    resolution = max(upper - lower, 1e-6) / steps
    exponent = math.floor(math.log10(resolution)) - _FIGURES + 1
    unit = Decimal(1).scaleb(exponent)
    count = math.ceil(resolution / float(unit))
    while (bounds := _snapped(lower, upper, count * unit)).bits > bits:
        count += 1
    return bounds


def _snapped(lower: float, upper: float, resolution: Decimal) -> _Bounds:
    first = (Decimal(repr(lower)) / resolution).to_integral_value(ROUND_FLOOR)
    last = (Decimal(repr(upper)) / resolution).to_integral_value(ROUND_CEILING)
    return _Bounds(first * resolution, max(last, first + 1) * resolution, resolution)


_UNITS = {"positions": ("rad", "m"), "velocities": ("rad/s", "m/s"), "efforts": ("Nm", "N")}


def _fields(joints: Iterable[Joint], group: str, bounds: Iterable[_Bounds]) -> list[str]:
    lines, taken = [], set[str]()
    for number, (joint, limits) in enumerate(zip(joints, bounds, strict=True), 1):
        field = _identifier(joint.name)
        while field.lower() in taken:
            field += "_"
        taken.add(field.lower())
        unit = _UNITS[group][joint.kind == "prismatic"]
        name = json.dumps(joint.name, ensure_ascii=False)
        lowest, highest, step = (_text(v) for v in (limits.minimum, limits.maximum, limits.resolution))
        lines.append(
            f"    optional double {field} = {number} [json_name = {name}, "
            f"(dccl.field) = {{ min: {lowest} max: {highest} resolution: {step} "
            f'units {{ unit: "{unit}" }} description: "{joint.kind}" }}];'
        )
    return lines


def _text(value: Decimal) -> str:
    return f"{value.normalize():f}"


def _identifier(name: str) -> str:
    text = re.sub(r"[^0-9A-Za-z_]", "_", name)
    return text if re.match(r"[A-Za-z]", text) else f"j_{text}"


def _one_line(text: str) -> str:
    return re.sub(r"\s+", " ", text)
