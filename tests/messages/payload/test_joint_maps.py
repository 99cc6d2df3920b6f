"""Joint states go into the robot's own message and come back with names, in either form of the bus."""

from __future__ import annotations

import contextlib
import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from messages.dccl import load_proto, sendable_types
from messages.from_urdf import Detail, proto_of
from messages.payload import Payload, PayloadError
from messages.payload.bounded import BoundedEncoding
from messages.payload.joint_maps import joint_maps
from messages.payload.joints import (
    CDR_JOINT_STATE,
    FORMS,
    FOXGLOVE_JOINT_STATES,
    JointSample,
    read_joint_state,
    write_joint_state,
    write_joint_states,
)
from messages.urdf import Joint, Robot
from tests.messages.payload.robots import NAMES, UPPER_BODY, sample

G1_LOG = Path(__file__).resolve().parents[4] / "shared" / "data" / "logs" / "g1_teleop_ep001.mcap"
LIMIT = 100_000
TWELVE_BITS = Detail(bits=12)


@cache
def encoding(
    robot: Robot = UPPER_BODY,
    detail: Detail = TWELVE_BITS,
    *,
    publish: str = "",
    out_of_range: str = "raise",
) -> BoundedEncoding:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "robot.proto"
        path.write_text(proto_of(robot, detail, "test"))
        (message_type,) = sendable_types(load_proto(path)).values()
    return BoundedEncoding(
        message_type,
        joint_maps(message_type),
        publish=publish,
        out_of_range=out_of_range,  # type: ignore[arg-type]
    )


def crossed(given: JointSample, form: str = CDR_JOINT_STATE, **options: object) -> tuple[JointSample, int]:
    """What comes out on the other side, and how many bytes it took."""
    reader, writer = FORMS[form]
    used = encoding(**options)  # type: ignore[arg-type]
    data = used.encode(Payload(writer(given), form)).data
    payload = used.decode(data, form, LIMIT, None)
    assert payload.type == form
    return reader(payload.data), len(data)


def assert_close(before: JointSample, after: JointSample, robot: Robot = UPPER_BODY) -> None:
    for joint in robot.joints:
        half_a_step = (joint.upper - joint.lower) / 4094 / 2 * 1.002
        assert after.positions[joint.name] == pytest.approx(before.positions[joint.name], abs=half_a_step)


@pytest.mark.parametrize("form", FORMS)
def test_26_joints_cross_in_45_bytes_and_come_back_with_names_order_and_stamp(form: str) -> None:
    for step in range(0, 100, 7):
        before = sample(step)
        after, size = crossed(before, form)
        assert size == 45
        assert (after.names, after.stamp_ns) == (before.names, before.stamp_ns)
        assert_close(before, after)


def test_the_payload_on_the_other_side_is_valid_cdr_of_the_same_size() -> None:
    before = write_joint_state(sample(3))
    used = encoding()
    after = used.decode(used.encode(Payload(before, CDR_JOINT_STATE)).data, CDR_JOINT_STATE, LIMIT, None)
    assert len(after.data) == len(before)
    assert after.data[:4] == before[:4] == b"\0\1\0\0"


def test_one_side_may_have_another_form_on_its_bus_than_the_other() -> None:
    data = encoding().encode(Payload(write_joint_states(sample(3)), FOXGLOVE_JOINT_STATES)).data
    payload = encoding(publish=CDR_JOINT_STATE).decode(data, FOXGLOVE_JOINT_STATES, LIMIT, None)
    assert payload.type == CDR_JOINT_STATE
    assert read_joint_state(payload.data).names == NAMES


def test_a_short_type_name_is_the_same_type_and_comes_back_as_it_was_told() -> None:
    short = "application/cdr;sensor_msgs/JointState"
    used = encoding()
    payload = used.decode(used.encode(Payload(write_joint_state(sample(1)), short)).data, short, LIMIT, None)
    assert payload.type == short


def test_some_of_the_joints_cross_alone() -> None:
    whole = sample(5)
    names = NAMES[3:9]
    after, size = crossed(JointSample(whole.stamp_ns, names, {n: whole.positions[n] for n in names}, {}, {}))
    assert after.names == names and size == 45


def test_velocities_and_efforts_cross_if_the_schema_has_them_and_are_absent_if_not_told() -> None:
    detail = Detail(bits=12, velocity_bits=8, effort_bits=8)
    full = replace(sample(1), velocities=dict.fromkeys(NAMES, 0.5), efforts=dict.fromkeys(NAMES, -1.0))
    after, _ = crossed(full, detail=detail)
    assert after.velocities[NAMES[0]] == pytest.approx(0.5, abs=0.1)
    assert after.efforts[NAMES[0]] == pytest.approx(-1.0, abs=0.1)
    assert crossed(full)[0].velocities == {}
    alone, size = crossed(sample(1), detail=detail)
    assert (alone.velocities, alone.efforts, size) == ({}, {}, 45)


def test_a_nan_is_not_told_and_comes_back_as_nan() -> None:
    before = sample(1)
    before.positions[NAMES[2]] = math.nan
    detail = Detail(bits=12, velocity_bits=8)
    after, _ = crossed(replace(before, velocities=dict.fromkeys(NAMES, 0.0)), detail=detail)
    assert math.isnan(after.positions[NAMES[2]]) and after.names == NAMES


def test_a_continuous_joint_s_angle_is_taken_modulo_a_turn() -> None:
    robot = Robot("cart", (Joint("wheel", "continuous", -math.pi, math.pi),))
    after, _ = crossed(JointSample(0, ("wheel",), {"wheel": 100.0}, {}, {}), robot=robot)
    assert math.remainder(after.positions["wheel"] - 100.0, 2 * math.pi) == pytest.approx(0, abs=1e-3)


def test_without_a_stamp_the_link_s_capture_time_stands_in() -> None:
    used = encoding(detail=Detail(bits=12, has_stamp=False))
    data = used.encode(Payload(write_joint_state(sample(1)), CDR_JOINT_STATE)).data
    assert len(data) == 40
    payload = used.decode(data, CDR_JOINT_STATE, LIMIT, 1_700_000_000_000_000_007)
    assert read_joint_state(payload.data).stamp_ns == 1_700_000_000_000_000_007


def test_a_joint_beyond_its_limit_is_refused_by_name_or_clamped_and_told() -> None:
    before = sample(1)
    before.positions[NAMES[0]] = 9.0
    payload = Payload(write_joint_state(before), CDR_JOINT_STATE)
    with pytest.raises(PayloadError, match=r"positions.kLeftShoulderPitch = 9 .*2\.7"):
        encoding().encode(payload)
    clamped = encoding(out_of_range="clamp").encode(payload)
    assert "positions.kLeftShoulderPitch = 9" in clamped.altered
    after = read_joint_state(encoding().decode(clamped.data, CDR_JOINT_STATE, LIMIT, None).data)
    assert after.positions[NAMES[0]] == pytest.approx(2.7, abs=0.002)


def test_joints_that_the_robot_lacks_or_names_twice_are_refused() -> None:
    for names, reason in ((("tail",), "no joint 'tail'"), (NAMES[:1] * 2, "more than once")):
        payload = write_joint_state(JointSample(0, names, dict.fromkeys(names, 0.0), {}, {}))
        with pytest.raises(PayloadError, match=reason):
            encoding().encode(Payload(payload, CDR_JOINT_STATE))


def test_another_type_is_refused_with_those_that_are_taken() -> None:
    with pytest.raises(
        PayloadError, match=r"'image/jpeg' cannot be said as g1.JointStates; it takes .*JointState"
    ):
        encoding().encode(Payload(b"", "image/jpeg"))


@given(st.binary(max_size=300), st.sampled_from(list(FORMS)))
def test_any_payload_is_encoded_or_refused(data: bytes, form: str) -> None:
    with contextlib.suppress(PayloadError):
        encoding().encode(Payload(data, form))


@given(st.integers(0, 811), st.binary(min_size=1, max_size=8))
def test_a_damaged_joint_state_is_encoded_or_refused(place: int, damage: bytes) -> None:
    payload = bytearray(write_joint_state(sample(1)))
    payload[place : place + len(damage)] = damage
    with contextlib.suppress(PayloadError):
        encoding().encode(Payload(bytes(payload), CDR_JOINT_STATE))


@given(st.binary(max_size=60), st.sampled_from([*FORMS, "", "x;y/z"]))
def test_any_bytes_from_the_link_are_read_or_refused(data: bytes, form: str) -> None:
    with contextlib.suppress(PayloadError):
        encoding().decode(data, form, LIMIT, None)


@pytest.mark.skipif(not G1_LOG.exists(), reason="the recording is not here")
def test_the_real_recording_crosses_in_45_bytes_a_message() -> None:
    with G1_LOG.open("rb") as stream:
        payloads = [m.data for _, _, m in make_reader(stream).iter_messages(topics="/joint_states")]
    assert {len(payload) for payload in payloads} == {812}
    for payload in payloads:
        before = read_joint_state(payload)
        used = encoding()
        data = used.encode(Payload(payload, CDR_JOINT_STATE)).data
        after = read_joint_state(used.decode(data, CDR_JOINT_STATE, LIMIT, None).data)
        assert len(data) <= 45 and set(after.names) == set(before.names)
        assert abs(after.stamp_ns - before.stamp_ns) <= 500_000
        assert_close(before, after)
