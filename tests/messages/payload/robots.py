"""A robot with joint limits, its schema, and joint states of it: what the tests of joint encodings share."""

from __future__ import annotations

import math
from pathlib import Path

from messages.from_urdf import Detail, proto_of
from messages.payload.joints import JointSample
from messages.urdf import Joint, Robot

# A humanoid's upper body with hands, as the G1 recording has it; limits rounded from public tables.
ARM = ((-3.1, 2.7), (-2.3, 2.3), (-2.6, 2.6), (-1.1, 2.1), (-2.0, 2.0), (-1.6, 1.6), (-1.6, 1.6))
ARM_NAMES = ("ShoulderPitch", "ShoulderRoll", "ShoulderYaw", "Elbow", "WristRoll", "WristPitch", "WristYaw")
HAND_NAMES = ("HandPinky", "HandRing", "HandMiddle", "HandIndex", "HandThumbBend", "HandThumbRotation")

UPPER_BODY = Robot(
    "g1",
    (
        *(
            Joint(f"k{side}{name}", "revolute", lower, upper, 20.0, 25.0)
            for side in ("Left", "Right")
            for name, (lower, upper) in zip(ARM_NAMES, ARM, strict=True)
        ),
        *(
            Joint(f"k{side}{name}", "revolute", 0.0, 1.0, 5.0, 2.0)
            for side in ("Left", "Right")
            for name in HAND_NAMES
        ),
    ),
)
NAMES = tuple(joint.name for joint in UPPER_BODY.joints)


def write_schema(folder: Path, detail: Detail | None = None, name: str = "g1.proto") -> Path:
    path = folder / name
    path.write_text(proto_of(UPPER_BODY, detail or Detail(bits=12), "a table"))
    return path


def sample(step: int, stamp_ns: int = 1_767_225_600_123_000_000) -> JointSample:
    """All joints somewhere within their limits."""
    positions = {
        j.name: j.lower + (j.upper - j.lower) * (0.5 + 0.49 * math.sin(0.1 * step + i))
        for i, j in enumerate(UPPER_BODY.joints)
    }
    return JointSample(stamp_ns + step * 33_000_000, NAMES, positions, {}, {})
