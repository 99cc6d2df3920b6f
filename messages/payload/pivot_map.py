"""Pivot plans, which have a bound that no single field can state: how far one step may turn the object."""

from __future__ import annotations

from google.protobuf.message import Message

from messages.payload.bounded import SameMessage
from messages.payload.topic_encoding import PayloadError
from messages.proto.straitlink.bounded.pivot_plan_pb2 import PivotPlan

MAX_TURN_DEG = 22.5  # from one step's heading to the next; beyond it the object tips over its corner


class PivotPlanMap(SameMessage):
    """A pivot plan, refused where a step turns too far or turns about the corner that the last one did."""

    def __init__(self) -> None:
        super().__init__(PivotPlan)

    def to_message(self, payload: bytes) -> Message:
        """The payload parsed and checked."""
        plan = super().to_message(payload)
        assert isinstance(plan, PivotPlan)
        heading_deg, corner = 0.0, None
        for number, step in enumerate(plan.steps):
            turn_deg = step.angle - heading_deg
            if not abs(turn_deg) <= MAX_TURN_DEG:
                raise PayloadError(
                    f"steps[{number}].angle = {step.angle:g} turns a pivot plan by {turn_deg:g} deg, beyond "
                    f"{MAX_TURN_DEG}"
                )
            if step.corner == corner:
                raise PayloadError(f"steps[{number}] of a pivot plan stays on the corner of the step before")
            heading_deg, corner = step.angle, step.corner
        return plan
