"""[encodings] of a configuration: loaded from beside it, checked, and alike on both sides of a link."""

from __future__ import annotations

from pathlib import Path

import pytest
import zstandard
from mcap.reader import make_reader

from messages.from_urdf import Detail
from messages.payload.joints import (
    CDR_JOINT_STATE,
    FOXGLOVE_JOINT_STATES,
    read_joint_state,
    read_joint_states,
    write_joint_state,
)
from messages.proto.straitlink.heartbeat_pb2 import Heartbeat
from messages.proto.straitlink.process_status_pb2 import ProcessStatus
from shaper.config import ShaperConfig, load_config
from shaper.errors import ConfigError
from shaper.events import Delivered
from tests.messages.payload.robots import NAMES, sample, write_schema
from tests.shaper.pair import MS, Pair, S
from tests.shaper.test_config import MINIMAL

G1_LOG = Path(__file__).resolve().parents[3] / "shared" / "data" / "logs" / "g1_teleop_ep001.mcap"
JOINTS = MINIMAL + 'encoding = "joints"\n[encodings.joints]\nproto = "g1.proto"\n'
KEY = "robot/joint_states"
PROCESSES = "application/protobuf;straitlink.ProcessStatus"


def load(folder: Path, text: str, name: str = "side.toml") -> ShaperConfig:
    path = folder / name
    path.write_text(text)
    return load_config(path)


def pair_of(robot: ShaperConfig, operator: ShaperConfig) -> Pair:
    return Pair(rules=robot.endpoint.rules, encodings=operator.endpoint.encodings)


def test_joint_states_cross_in_45_bytes_by_two_files_and_a_schema_alone(tmp_path: Path) -> None:
    write_schema(tmp_path)
    robot = load(tmp_path, JOINTS)
    operator = load(
        tmp_path, MINIMAL + '[encodings.g1]\nproto = "g1.proto"\nmessage = "g1.JointStates"\n', "b.toml"
    )
    pair = pair_of(robot, operator)
    for step in range(20):
        pair.offer(pair.robot, KEY, write_joint_state(sample(step)), encoding=CDR_JOINT_STATE)
        pair.advance(100 * MS)
    pair.advance(1 * S)
    delivered = [e for e in pair.operator.events if isinstance(e, Delivered)]
    assert [e.encoding for e in delivered] == [CDR_JOINT_STATE] * 20
    for step, event in enumerate(delivered):
        state = read_joint_state(event.payload)
        assert (state.names, state.stamp_ns) == (NAMES, sample(step).stamp_ns)
    assert pair.robot.endpoint.sent_ledgers()[KEY].sent_bytes == 20 * 45


@pytest.mark.skipif(not G1_LOG.exists(), reason="the recording is not here")
def test_the_real_recording_crosses_a_thin_link_as_valid_joint_states(tmp_path: Path) -> None:
    write_schema(tmp_path)
    config = load(tmp_path, JOINTS)
    pair = pair_of(config, config)
    with G1_LOG.open("rb") as stream:
        payloads = [m.data for _, _, m in make_reader(stream).iter_messages(topics="/joint_states")][:150]
    for payload in payloads:
        pair.offer(pair.robot, KEY, payload, encoding="application/cdr;sensor_msgs/msg/JointState")
        pair.advance(33_333_333)
    pair.advance(1 * S)
    delivered = [read_joint_state(e.payload) for e in pair.operator.events if isinstance(e, Delivered)]
    ledger = pair.robot.endpoint.sent_ledgers()[KEY]
    assert ledger.sent == len(delivered) > 140 and ledger.sent_bytes <= 45 * ledger.sent
    sent = {round(s.stamp_ns, -6): s for s in map(read_joint_state, payloads)}
    for state in delivered:
        for name, position in sent[state.stamp_ns].positions.items():
            assert state.positions[name] == pytest.approx(position, abs=0.001)


def test_the_operator_s_bus_may_have_foxglove_s_form(tmp_path: Path) -> None:
    write_schema(tmp_path)
    publish = f'publish = "{FOXGLOVE_JOINT_STATES}"\n'
    pair = pair_of(load(tmp_path, JOINTS), load(tmp_path, JOINTS + publish, "b.toml"))
    pair.offer(pair.robot, KEY, write_joint_state(sample(1)), encoding=CDR_JOINT_STATE)
    pair.advance(1 * S)
    (event,) = [e for e in pair.operator.events if isinstance(e, Delivered)]
    assert event.encoding == FOXGLOVE_JOINT_STATES
    assert read_joint_states(event.payload).names == NAMES


def test_publishers_that_tell_no_type_are_helped_by_assume(tmp_path: Path) -> None:
    write_schema(tmp_path)
    assumed = load(tmp_path, JOINTS + f'assume = "{CDR_JOINT_STATE}"\n')
    for config, crosses in ((assumed, True), (load(tmp_path, JOINTS), False)):
        pair = pair_of(config, assumed)
        pair.offer(pair.robot, KEY, write_joint_state(sample(1)), encoding="zenoh/bytes")
        pair.advance(1 * S)
        delivered = [e for e in pair.operator.events if isinstance(e, Delivered)]
        assert [read_joint_state(e.payload).names for e in delivered] == [NAMES] * crosses


def test_the_names_of_processes_cross_once_and_then_no_more(tmp_path: Path) -> None:
    text = (
        MINIMAL
        + 'encoding = "processes"\n[encodings.processes]\nmessage = "straitlink.bounded.ProcessReport"\n'
    )
    config = load(tmp_path, text)
    pair = pair_of(config, config)
    status = ProcessStatus(processes=[ProcessStatus.Process(name=f"p{i}", host="atlas0") for i in range(20)])
    sizes = []
    for step in range(12):
        status.processes[step].state = ProcessStatus.State.STATE_FAILED
        before = pair.robot.endpoint.sent_ledgers().get(KEY)
        sizes.append(-before.sent_bytes if before else 0)
        pair.offer(pair.robot, KEY, status.SerializeToString(), encoding=PROCESSES)
        pair.advance(200 * MS)
        sizes[-1] += pair.robot.endpoint.sent_ledgers()[KEY].sent_bytes
    delivered = [e.payload for e in pair.operator.events if isinstance(e, Delivered)]
    assert sizes[0] > 200 and sizes[4:] == [56] * 8
    last = ProcessStatus.FromString(delivered[-1])
    assert [(p.name, p.host, p.state) for p in last.processes] == [
        (p.name, p.host, p.state) for p in status.processes
    ]


def test_another_detail_of_the_same_robot_is_another_encoding(tmp_path: Path) -> None:
    write_schema(tmp_path)
    coarse = write_schema(tmp_path, Detail(bits=10), "coarse.proto").name
    fine, other = load(tmp_path, JOINTS), load(tmp_path, JOINTS.replace("g1.proto", coarse), "b.toml")
    assert fine.endpoint.encodings.keys().isdisjoint(other.endpoint.encodings)
    pair = pair_of(fine, other)
    pair.offer(pair.robot, KEY, write_joint_state(sample(1)), encoding=CDR_JOINT_STATE)
    pair.advance(1 * S)
    assert pair.operator.endpoint.received_ledgers[KEY].unreadable == 1


def test_a_dictionary_is_an_encoding(tmp_path: Path) -> None:
    samples = [b'{"name": "process_%d", "state": "RUNNING"}' % (i % 97) for i in range(3000)]
    (tmp_path / "status.zdict").write_bytes(zstandard.train_dictionary(2000, samples).as_bytes())
    text = MINIMAL + 'encoding = "status"\n[encodings.status]\ndictionary = "status.zdict"\n'
    config = load(tmp_path, text)
    pair = pair_of(config, config)
    pair.offer(pair.robot, KEY, samples[5], encoding="application/json")
    pair.advance(1 * S)
    (event,) = [e for e in pair.operator.events if isinstance(e, Delivered)]
    assert (event.payload, event.encoding) == (samples[5], "application/json")
    assert pair.robot.endpoint.sent_ledgers()[KEY].sent_bytes < len(samples[5])


@pytest.mark.parametrize(
    ("addition", "reason"),
    [
        ('encoding = "legs"\n', r'topics\[0\].encoding = "legs": expected one of \[encodings\]: there is no such'),
        ("[encodings.x]\n", r"encodings.x = .*expected either proto and message"),
        ('[encodings.x]\nproto = "a"\ndictionary = "b"\n', "expected either proto and message"),
        ('[encodings.x]\ndictionary = "b"\npublish = "a/b"\n', "go with a message"),
        ('[encodings.x]\ndictionary = "none.zdict"\n', r"encodings.x: .*none.zdict cannot be read: No such file"),
        ('[encodings.x]\ndictionary = "side.toml"\n', "encodings.x: .* no trained zstd dictionary"),
        ('[encodings.x]\nproto = "none.proto"\n', r"encodings.x: .*none.proto: no such .proto file"),
        ('[encodings.x]\nproto = "g1.proto"\nmessage = "g1.Legs"\n', "message = 'g1.Legs': g1.proto has g1.JointStates"),
        ('[encodings.x]\nproto = "g1.proto"\nassume = "image/jpeg"\n', "'image/jpeg' cannot be said as g1.JointStates"),
        ('[encodings.x]\nproto = "g1.proto"\nout_of_range = "dccl"\n', "out_of_range"),
        ('[encodings.x]\nschema = "g1.proto"\n', "unknown key; expected one of proto, message, dictionary"),
    ],
)  # fmt: skip
def test_a_mistake_in_an_encoding_is_told_with_its_place(tmp_path: Path, addition: str, reason: str) -> None:
    write_schema(tmp_path)
    with pytest.raises(ConfigError, match=reason):
        load(tmp_path, MINIMAL + addition)


@pytest.mark.parametrize(
    ("addition", "reason"),
    [
        ('compression = "zstd"\n', "compression: expected none beside an encoding"),
        ("entries = { field = 1, key = 1 }\n", "entries: expected a class"),
    ],
)
def test_an_encoding_goes_with_no_other_treatment_of_the_payload(
    tmp_path: Path, addition: str, reason: str
) -> None:
    write_schema(tmp_path)
    text = JOINTS.replace('encoding = "joints"\n', 'encoding = "joints"\n' + addition)
    with pytest.raises(ConfigError, match=reason):
        load(tmp_path, text)
    with pytest.raises(ConfigError, match="a shared state crosses as differences"):
        load(tmp_path, JOINTS.replace('class = "state"', 'class = "status"'))


def test_the_same_schema_in_two_folders_is_the_same_encoding(tmp_path: Path) -> None:
    digests = []
    for name in ("here", "there"):
        folder = tmp_path / name
        folder.mkdir()
        write_schema(folder)
        digests.append(tuple(load(folder, JOINTS).endpoint.encodings))
    assert digests[0] == digests[1]


def test_a_message_of_the_catalogue_is_taken_by_its_name_alone(tmp_path: Path) -> None:
    text = MINIMAL + 'encoding = "beat"\n[encodings.beat]\nmessage = "straitlink.Heartbeat"\n'
    config = load(tmp_path, text)
    pair = pair_of(config, config)
    beat = Heartbeat(sequence=5, uptime_s=77, mode=2, battery_ratio=0.5)
    pair.offer(
        pair.robot, KEY, beat.SerializeToString(), encoding="application/protobuf;straitlink.Heartbeat"
    )
    pair.advance(1 * S)
    (event,) = [e for e in pair.operator.events if isinstance(e, Delivered)]
    after = Heartbeat.FromString(event.payload)
    assert (after.sequence, after.mode, after.capture_ns) == (5, 2, event.capture_unix_ns)
    with pytest.raises(ConfigError, match=r"'straitlink.Nothing': the catalogue has straitlink.Heartbeat, "):
        load(tmp_path, text.replace("straitlink.Heartbeat", "straitlink.Nothing"))
