"""Every bounded message loads, fits, states unit and source of each bound, and reads any bytes."""

from __future__ import annotations

import contextlib
from functools import cache

import pytest
from google.protobuf.message import Message
from hypothesis import given
from hypothesis import strategies as st

from messages.bounded_catalogue import BOUNDED_CATALOGUE, find_bounded
from messages.dccl import Codec, DecodeError, EncodeError, FieldInfo
from messages.payload.maps import maps_of
from messages.proto.straitlink.bounded.robot_state_pb2 import RobotState
from messages.proto.straitlink.bounded.steering_command_pb2 import SteeringCommand

NAMES = [message.name for message in BOUNDED_CATALOGUE]
# Numbers without a unit: counts, hashes, ratios, the components of quaternions, and parameters whose
# unit their template knows.
PURE = ("_id", "_hash", "sequence", "_ratio", "feed_forward", "parameters", "orientation.", "hand.")


@cache
def codec(name: str) -> Codec[Message]:
    found = find_bounded(name)
    assert found is not None
    return Codec(found.message_type)


def leaves(name: str) -> list[FieldInfo]:
    rows = codec(name).info().fields
    return [
        r for r in rows if not any(other.path.startswith((f"{r.path}.", f"{r.path}[].")) for other in rows)
    ]


def test_ids_and_names_are_unique() -> None:
    infos = [codec(name).info() for name in NAMES]
    ids = [info.message_id for info in infos]
    assert len(set(ids)) == len(ids) == len(set(NAMES)) == 16
    assert all(info.id_bits == 8 for info in infos)


@pytest.mark.parametrize("name", NAMES)
def test_each_field_states_where_its_bounds_come_from_and_in_which_unit(name: str) -> None:
    for row in leaves(name):
        assert row.description, row.path
        is_number = row.type_name.rstrip("?").partition("[")[0] in ("double", "float", "uint32", "sint32")
        if is_number and not any(word in row.path for word in PURE):
            assert row.unit, row.path


def test_the_state_of_a_humanoid_with_pose_and_wrenches_fits_68_bytes() -> None:
    info = codec("straitlink.bounded.RobotState").info()
    assert info.max_bytes <= 68
    assert len([r for r in info.fields if r.path.startswith("positions.")]) == 28


def test_joints_and_pose_alone_take_what_they_need() -> None:
    positions = {f.name: 0.1 for f in RobotState.Positions.DESCRIPTOR.fields}
    state = RobotState(positions=positions)
    for joint, value in (("back_bky", 0.0), ("r_arm_elx", -0.5)):
        setattr(state.positions, joint, value)
    state.pelvis.x, state.pelvis.y, state.pelvis.z = 12.34, -5.6, 0.93
    state.pelvis.orientation.w = 1
    state.pelvis.orientation.x = state.pelvis.orientation.y = state.pelvis.orientation.z = 0
    data = codec("straitlink.bounded.RobotState").encode(state)
    assert len(data) == 54
    after = codec("straitlink.bounded.RobotState").decode(data)
    assert isinstance(after, RobotState)
    assert after.pelvis.x == pytest.approx(12.34) and not after.HasField("left_foot")


def test_the_hands_of_hubo_keep_to_the_limits_of_its_operators() -> None:
    rows = {r.path.removeprefix("positions."): r for r in leaves("straitlink.bounded.JointCommand")}
    assert len(rows) == 24
    assert (rows["LSR"].minimum, rows["LSR"].maximum) == (-0.3, 2.0)
    assert (rows["RSR"].minimum, rows["RSR"].maximum) == (-2.0, 0.3)
    assert (rows["RHY"].minimum, rows["LHY"].maximum) == (-1.8, 1.8)
    assert (rows["LWP"].minimum, rows["LWP"].maximum) == (-1.4, 1.2)


@pytest.mark.parametrize(("angle_deg", "is_reachable"), [(28, False), (29, True), (90, True), (91, False)])
def test_a_wheel_is_turned_by_what_the_hands_reach(angle_deg: int, is_reachable: bool) -> None:
    rim = {"x": 0.5, "y": 0.1, "z": 0.3}
    command = SteeringCommand(
        command_id=1,
        rim_a=rim,
        rim_b=rim,
        rim_c=rim,
        angle=angle_deg,
        direction=SteeringCommand.RIGHT,
        motion=SteeringCommand.CROSS_OVER,
        feed_forward=1,
    )
    with (
        contextlib.nullcontext()
        if is_reachable
        else pytest.raises(EncodeError, match=r"angle = \d+.* 29.* 90")
    ):
        assert (
            codec("straitlink.bounded.SteeringCommand").decode(
                codec("straitlink.bounded.SteeringCommand").encode(command)
            )
            == command
        )


@pytest.mark.parametrize("name", NAMES)
@given(data=st.binary(max_size=80))
def test_any_bytes_are_a_message_or_a_decode_error(name: str, data: bytes) -> None:
    with contextlib.suppress(DecodeError):
        codec(name).decode(data)


@pytest.mark.parametrize("name", NAMES)
def test_maps_of_a_message_take_distinct_types(name: str) -> None:
    maps = maps_of(codec(name).message_type)
    types = [m.bus_type for m in maps]
    assert len(set(types)) == len(types)
    assert all(t.startswith(("application/cdr;", "application/protobuf;")) for t in types)


def test_an_unknown_name_finds_nothing() -> None:
    assert find_bounded("straitlink.bounded.Nothing") is None
