"""What the operator does: plans of footsteps and motions, and requests for views, every few seconds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from messages.catalogue import CATALOGUE, CatalogueTopic
from messages.proto.straitlink.footstep_plan_pb2 import FootstepPlan
from messages.proto.straitlink.motion_plan_pb2 import MotionPlan
from messages.proto.straitlink.view_pb2 import ViewRequest
from straitlink.synthetic.gait import ANKLE_HEIGHT_M, STEP_RATE_HZ, foot_poses
from straitlink.synthetic.joints import JOINT_NAMES, LOWER_RAD, UPPER_RAD, joint_positions
from straitlink.synthetic.rigid import quaternion_from_rotation
from straitlink.synthetic.robot_state import Samples
from straitlink.synthetic.settings import START_NS, SyntheticSettings

_STREAM = 130
_ARMS_AND_BACK = 16  # the first joints of the table
_KNOT_PERIOD_NS = 200_000_000
_VIEWS = (
    ("height_map_scene", ViewRequest.FORMAT_HEIGHT_MAP, 5_000),
    ("range_map_workspace", ViewRequest.FORMAT_RANGE_MAP, 0),
    ("height_map_corridor", ViewRequest.FORMAT_HEIGHT_MAP, 10_000),
    ("cloud_workspace", ViewRequest.FORMAT_CLOUD, 0),
    ("height_map_scene", ViewRequest.FORMAT_HEIGHT_MAP, -1),  # cancelled
)

_Event = Callable[[int, int, SyntheticSettings, np.random.Generator], bytes]


def footstep_plan(
    plan_id: int, capture_ns: int, settings: SyntheticSettings, random: np.random.Generator
) -> bytes:
    """The next 6 to 12 steps of the robot's own way, as the operator would lay them."""
    count = int(random.integers(6, 13))
    plan = FootstepPlan(capture_ns=capture_ns, plan_id=plan_id, frame_id="map")
    times_s = (capture_ns - START_NS) * 1e-9 + np.arange(1, count + 1, dtype=np.float64) / STEP_RATE_HZ
    for index in range(count):
        left = (index + plan_id) % 2 == 0
        pose = foot_poses(times_s[index : index + 1], left=left)[0]
        x, y = pose[:2, 3].tolist()
        qx, qy, qz, qw = quaternion_from_rotation(pose[:3, :3]).tolist()
        step = plan.footsteps.add(
            foot=FootstepPlan.FOOT_LEFT if left else FootstepPlan.FOOT_RIGHT,
            is_final=index == count - 1,
            is_locked=bool(random.random() < 0.1),
            swing_height_m=0.08,
            duration_s=1 / STEP_RATE_HZ,
        )
        step.pose.position.x, step.pose.position.y, step.pose.position.z = x, y, ANKLE_HEIGHT_M
        rotation = step.pose.orientation
        rotation.x, rotation.y, rotation.z, rotation.w = qx, qy, qz, qw
    return plan.SerializeToString()


def motion_plan(
    plan_id: int, capture_ns: int, settings: SyntheticSettings, random: np.random.Generator
) -> bytes:
    """20 to 50 knots for back, neck and arms, from where they are to a random pose within the limits."""
    count = int(random.integers(20, 51))
    joints = slice(0, _ARMS_AND_BACK)
    now_s = np.array([(capture_ns - START_NS) * 1e-9])
    start = joint_positions(now_s, settings.seed)[0, joints]
    goal = start + random.uniform(-0.4, 0.4, _ARMS_AND_BACK)
    goal = np.clip(goal, LOWER_RAD[joints] + 0.01, UPPER_RAD[joints] - 0.01)
    plan = MotionPlan(capture_ns=capture_ns, plan_id=plan_id, joint_names=JOINT_NAMES[joints])
    for index in range(count):
        ratio = index / (count - 1)
        eased = ratio * ratio * (3 - 2 * ratio)
        positions = start + eased * (goal - start)
        plan.knot_points.add(time_from_start_ns=index * _KNOT_PERIOD_NS, positions_rad=positions.tolist())
    return plan.SerializeToString()


def view_request(
    request_id: int, capture_ns: int, settings: SyntheticSettings, random: np.random.Generator
) -> bytes:
    """One of the views in turn: some once, some repeated, some cancelled."""
    preset, form, period_ms = _VIEWS[request_id % len(_VIEWS)]
    request = ViewRequest(
        capture_ns=capture_ns, request_id=request_id, preset=preset, format=form, period_ms=period_ms
    )
    return request.SerializeToString()


_EVENTS: dict[str, _Event] = {
    "operator/footstep_plan": footstep_plan,
    "operator/motion_plan": motion_plan,
    "operator/view_request": view_request,
}


def scripted(topic: CatalogueTopic, settings: SyntheticSettings) -> Samples:
    """The operator's events on one topic; between two of them 0.5 to 1.5 times their mean distance."""
    random = np.random.default_rng([settings.seed, _STREAM, CATALOGUE.index(topic)])
    event, mean_s = _EVENTS[topic.key], 1 / topic.rate_hz
    time_s, count = random.uniform(0.2, 1.0), 0
    while round(time_s * 1e9) < settings.duration_ns:
        capture_ns = START_NS + round(time_s * 1e9)
        yield capture_ns, event(count, capture_ns, settings, random)
        time_s, count = time_s + mean_s * random.uniform(0.5, 1.5), count + 1


SCRIPT_SOURCES = dict.fromkeys(_EVENTS, scripted)
