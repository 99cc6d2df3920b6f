"""What a robot's state costs, alone and against what has arrived: `python -m bench.delta`.

10 Hz, joints to 1 mrad (hands to 0.001 of their stroke), position to 1 mm, orientation to 2 mrad, time to
1 ms. The recording is ../shared/data/logs/g1_teleop_ep001.mcap, where it is: 26 joints of a teleoperated
humanoid, with two that stand still to make 28, and a pose at rest. The walking robot is the synthetic
mission's. Bytes are all that a message takes, references and check (as the shaper has it) included.
"""

from __future__ import annotations

import argparse
import json
import random
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.machine import provenance
from messages.dccl import Codec, load_proto
from messages.delta import DeltaDecoder, DeltaEncoder
from messages.payload.delta import CHECK_BITS
from straitlink.synthetic.gait import walking_pose
from straitlink.synthetic.joints import JOINT_LIMITS, LOWER_RAD, UPPER_RAD, joint_positions
from straitlink.synthetic.rigid import quaternion_from_rotation

OUT = Path("out/bench/delta.json")
RECORDING = Path(__file__).resolve().parents[2] / "shared" / "data" / "logs" / "g1_teleop_ep001.mcap"
RATE_HZ = 10
WALK_S = 60
NOISE_RAD = 2e-4  # of the walking robot's encoders
UNIX_S = 1_700_000_000
NS_PER_S = 1_000_000_000
ROUND_TRIPS = (1, 3, 10)  # messages until an acknowledgement is back: 0.1, 0.3 and 1 s

# Unitree G1's limits, rounded outwards from its public URDF; hands as the recording has them, 0 to 1.
ARM_RAD = ((-3.1, 2.7), (-2.3, 2.3), (-2.7, 2.7), (-1.1, 2.1), (-2.0, 2.0), (-1.7, 1.7), (-1.7, 1.7))
G1_BOUNDS = (*ARM_RAD, *ARM_RAD, *[(0.0, 1.0)] * 12, (-0.6, 0.6), (-0.6, 0.6))
ATLAS_BOUNDS = tuple(
    (np.floor(j.lower_rad * 1000) / 1000, np.ceil(j.upper_rad * 1000) / 1000) for j in JOINT_LIMITS
)

Rows = Sequence[dict[str, Any]]


@dataclass(frozen=True, slots=True)
class DeltaFigures:
    """One motion in one form. reference_s: age of what has arrived; None where messages stand alone."""

    motion: str
    form: str
    reference_s: float | None
    loss_ratio: float
    mean_bytes: float
    max_bytes: int
    encodes_per_s: int
    decodes_per_s: int


def schema(name: str, bounds: Sequence[tuple[float, float]], *, exact: bool) -> str:
    """A state message with time, pose and one field for each joint."""
    group = 'codec_group: "straitlink.1"' if exact else ""
    if exact:
        time_options = 'codec: "straitlink.time.1" max: 60 resolution: 0.001'
        turn_options = 'codec: "straitlink.quaternion.1" resolution: 0.002 min_repeat: 4 max_repeat: 4'
    else:
        time_options = 'codec: "dccl.time" precision: 3'
        turn_options = "min: -1 max: 1 precision: 3 min_repeat: 4 max_repeat: 4"
    fields = [f"required double t = 1 [(dccl.field) = {{ {time_options} }}];"]
    fields.append(f"repeated double turn = 2 [(dccl.field) = {{ {turn_options} }}];")
    places = [("x", -1000, 1000), ("y", -1000, 1000), ("z", -100, 100)]
    places += [(f"j{i}", *bound) for i, bound in enumerate(bounds)]
    for number, (field, low, high) in enumerate(places, 3):
        options = f"min: {low:g} max: {high:g} resolution: 0.001"
        fields.append(f"required double {field} = {number} [(dccl.field) = {{ {options} }}];")
    header = f"option (dccl.msg) = {{ codec_version: 4 id: 120 max_bytes: 100 {group} }};"
    return f"message {name} {{ {header} {' '.join(fields)} }}"


def codecs() -> dict[str, Codec[Any]]:
    """The state in its forms, by name."""
    messages = [
        schema("AtlasDccl", ATLAS_BOUNDS, exact=False),
        schema("Atlas", ATLAS_BOUNDS, exact=True),
        schema("G1Dccl", G1_BOUNDS, exact=False),
        schema("G1", G1_BOUNDS, exact=True),
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "state.proto"
        imports = 'import "dccl/option_extensions.proto"; import "dccl/straitlink_extensions.proto";'
        path.write_text(f'syntax = "proto2"; {imports} package bench; {" ".join(messages)}')
        types = load_proto(path)
    return {name.removeprefix("bench."): Codec(t, out_of_range="clamp") for name, t in types.items()}


def row(joints: Any, unix_s: float, place: Any = (1.0, 2.0, 0.8), turn: Any = (0, 0, 0, 1)) -> dict[str, Any]:
    """The fields of one message."""
    places = dict(zip("xyz", map(float, place), strict=True))
    return {"t": unix_s, "turn": list(turn), **places, **{f"j{i}": v for i, v in enumerate(joints)}}


def walking() -> Rows:
    """The synthetic robot's first minute, stamps with up to 4 ms of jitter."""
    times_s = np.arange(0, WALK_S, 1 / RATE_HZ)
    noise = NOISE_RAD * np.random.default_rng(3).standard_normal((times_s.size, len(JOINT_LIMITS)))
    joints = np.clip(joint_positions(times_s, 1) + noise, LOWER_RAD, UPPER_RAD).tolist()
    pose = walking_pose(times_s)
    turns = quaternion_from_rotation(pose[:, :3, :3]).tolist()
    return [
        row(joints[k], UNIX_S + t + 0.001 * (7 * k % 5), pose[k, :3, 3], turns[k])
        for k, t in enumerate(times_s.tolist())
    ]


def recorded(first: int) -> Rows:
    """The recording's joint states, every third from `first` on: 30 Hz become 10."""
    from mcap.reader import make_reader
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    rows = []
    with RECORDING.open("rb") as stream:
        for _, _, message in make_reader(stream).iter_messages(topics=["/joint_states"]):
            state: Any = store.deserialize_cdr(message.data, "sensor_msgs/msg/JointState")
            rows.append(row([*state.position.tolist(), 0.0, 0.0], message.log_time / NS_PER_S))
    return rows[first :: 30 // RATE_HZ]


def per_second(work: Callable[[], object], count: int) -> int:
    """How often a CPU second does one of the `count` things that `work` does; the best of three."""
    best_s = float("inf")
    for _ in range(3):
        started_s = time.process_time()
        work()
        best_s = min(best_s, time.process_time() - started_s)
    return round(count / best_s)


def stream(
    codec: Codec[Any], messages: Sequence[Any], round_trip: int, loss_ratio: float
) -> Iterator[tuple[int, bytes, bool]]:
    """Number, bytes and whether it arrives, of each message."""
    encoder, chance = DeltaEncoder(codec, check_bits=CHECK_BITS), random.Random(7)
    arrives = [chance.random() >= loss_ratio for _ in messages]
    for n, message in enumerate(messages):
        if n >= round_trip and arrives[n - round_trip]:
            encoder.on_acknowledged(n - round_trip)
        yield n, encoder.encode(message, n), arrives[n]


def measure_delta(
    motion: str, codec: Codec[Any], rows: Rows, round_trip: int, loss_ratio: float
) -> DeltaFigures:
    """A stream; what is counted begins when there are references with all of their history."""
    messages = [codec.message_type(**fields) for fields in rows]
    sent = list(stream(codec, messages, round_trip, loss_ratio))
    sizes = [len(data) for n, data, _ in sent if n >= 2 * round_trip + 8]

    def decode() -> None:
        decoder = DeltaDecoder(codec, check_bits=CHECK_BITS)
        for n, data, arrives in sent:
            if arrives:
                got = decoder.decode(data, n, int(rows[n]["t"] * NS_PER_S))
                assert abs(got.j3 - rows[n]["j3"]) <= 0.00051  # wrong bytes would make these figures void

    return DeltaFigures(
        motion,
        "delta",
        round_trip / RATE_HZ,
        loss_ratio,
        round(sum(sizes) / len(sizes), 1),
        max(sizes),
        per_second(lambda: list(stream(codec, messages, round_trip, loss_ratio)), len(messages)),
        per_second(decode, sum(arrives for _, _, arrives in sent)),
    )


def measure_alone(motion: str, form: str, codec: Codec[Any], rows: Rows) -> DeltaFigures:
    """Each message by itself."""
    messages = [codec.message_type(**fields) for fields in rows]
    sent = [codec.encode(message) for message in messages]
    now_ns = int(rows[0]["t"] * NS_PER_S)
    sizes = [len(data) for data in sent]
    return DeltaFigures(
        motion,
        form,
        None,
        0.0,
        round(sum(sizes) / len(sizes), 1),
        max(sizes),
        per_second(lambda: [codec.encode(message) for message in messages], len(messages)),
        per_second(lambda: [codec.decode(data, now_ns) for data in sent], len(sent)),
    )


def figures() -> list[DeltaFigures]:
    """All of them; of the recording only where it is."""
    known = codecs()
    motions = [("walking", known["AtlasDccl"], known["Atlas"], walking())]
    if RECORDING.exists():
        motions.append(("recorded", known["G1Dccl"], known["G1"], recorded(0)))
    made = []
    for motion, dccl, own, rows in motions:
        made.append(measure_alone(motion, "DCCL", dccl, rows))
        made.append(measure_alone(motion, "straitlink.1", own, rows))
        made += [measure_delta(motion, own, rows, round_trip, 0.0) for round_trip in ROUND_TRIPS]
        made.append(measure_delta(motion, own, rows, ROUND_TRIPS[-1], 0.1))
    return made


def main() -> None:
    """Print a table, or JSON; either way leave the figures in out/bench/delta.json."""
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    made = figures()
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text(json.dumps({**provenance(), "delta": [asdict(f) for f in made]}, indent=1))
    if arguments.json:
        print(OUT.read_text())
        return
    table = Table(title="28 joints and pose at 10 Hz, bytes a message", title_justify="left", box=SIMPLE)
    for heading in ("motion", "form", "reference"):
        table.add_column(heading, no_wrap=True)
    for heading in ("loss", "mean B", "max B", "encodes/s", "decodes/s"):
        table.add_column(heading, justify="right", no_wrap=True)
    for f in made:
        age = "none" if f.reference_s is None else f"{f.reference_s:g} s old"
        counts = (f"{f.mean_bytes:.1f}", str(f.max_bytes), f"{f.encodes_per_s:,}", f"{f.decodes_per_s:,}")
        table.add_row(f.motion, f.form, age, f"{f.loss_ratio:.0%}", *counts)
    console = Console()
    console.width = max(console.width, 100)
    console.print(table)


if __name__ == "__main__":
    main()
