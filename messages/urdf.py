"""The movable joints of a robot, with their limits, from its URDF."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from typing import Literal, get_args

JointKind = Literal["revolute", "continuous", "prismatic"]

MAX_URDF_BYTES = 50_000_000
MAX_JOINTS = 1000
_MAX = 1e6  # of any limit, in its unit
_KINDS: dict[str, JointKind] = {k: k for k in get_args(JointKind)}


class UrdfError(Exception):
    """A URDF that cannot be used; the message names the joint and what is wrong with it."""


@dataclass(frozen=True, slots=True)
class Joint:
    """One movable joint. lower, upper: rad, or m of a prismatic joint; a continuous one has -pi..pi.

    velocity: rad/s or m/s; effort: Nm or N; both as the greatest magnitude, None where the URDF has none.
    """

    name: str
    kind: JointKind
    lower: float
    upper: float
    velocity: float | None = None
    effort: float | None = None


@dataclass(frozen=True, slots=True)
class Robot:
    """A robot's name and movable joints, in the order of its URDF."""

    name: str
    joints: tuple[Joint, ...]


def parse_urdf(data: bytes) -> Robot:
    """Read a URDF (expanded, no xacro). Raises UrdfError.

    Mimic joints are joints like any other: publishers of joint states tell them. Fixed, floating and
    planar ones have no single position and are left out.
    """
    if len(data) > MAX_URDF_BYTES:
        raise UrdfError(f"a URDF of {len(data)} bytes is beyond {MAX_URDF_BYTES}")
    # Entities can make a small file enormous, and no URDF has a document type.
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise UrdfError("a URDF must have no document type and no entities")
    try:
        root = ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        raise UrdfError(f"not XML: {error}") from error
    if root.tag != "robot":
        raise UrdfError(f"the outermost element is <{root.tag}>, not <robot>")
    if any("xacro" in element.tag for element in root.iter()):
        raise UrdfError("it has xacro macros: expand it first (`xacro robot.urdf.xacro > robot.urdf`)")
    elements = [joint for joint in root.findall("joint") if joint.get("type") in _KINDS]
    if not elements:
        raise UrdfError("it has no movable joint")
    if len(elements) > MAX_JOINTS:
        raise UrdfError(f"it has {len(elements)} movable joints, beyond {MAX_JOINTS}")
    joints = tuple(_joint(element) for element in elements)
    names = [joint.name for joint in joints]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise UrdfError(f"joint {twice[0]!r} is there more than once")
    return Robot(root.get("name") or "robot", joints)


def _joint(element: ElementTree.Element) -> Joint:
    name, kind = element.get("name", ""), _KINDS[element.get("type", "")]
    if not name:
        raise UrdfError(f"a {kind} joint has no name")
    if name.startswith("[") or not name.isprintable():  # what a .proto cannot hold as a json_name
        raise UrdfError(f"joint {name!r}: a name must be printable and not start with '['")
    limit = element.find("limit")
    velocity, effort = _magnitude(limit, "velocity"), _magnitude(limit, "effort")
    if kind == "continuous":
        return Joint(name, kind, -math.pi, math.pi, velocity, effort)
    lower, upper = _number(name, limit, "lower"), _number(name, limit, "upper")
    if lower is None and upper is None:
        raise UrdfError(f"joint {name!r} is {kind} but states no limits: give <limit lower= upper=>")
    lower, upper = lower or 0.0, upper or 0.0  # the URDF specification's default for one that is left out
    if lower > upper:
        raise UrdfError(f"joint {name!r}: lower = {lower:g} is above upper = {upper:g}")
    return Joint(name, kind, lower, upper, velocity, effort)


def _magnitude(limit: ElementTree.Element | None, attribute: str) -> float | None:
    """What a URDF has for "as much as it can" (0, inf, 1e9) is no limit."""
    try:
        value = abs(float("" if limit is None else limit.get(attribute, "")))
    except ValueError:
        return None
    return value if 0 < value <= _MAX else None


def _number(joint: str, limit: ElementTree.Element | None, attribute: str) -> float | None:
    text = None if limit is None else limit.get(attribute)
    if text is None:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) <= _MAX:
        raise UrdfError(f"joint {joint!r}: {attribute} = {text!r} is no number within -1e6..1e6")
    return value
