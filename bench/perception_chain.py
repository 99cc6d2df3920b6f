"""A log through the whole chain: replay, perception server, shaper, a slow link, shaper, operator.

    python -m bench.perception_chain [LOG.mcap] [--profile constant-100k-500ms] [--out DIR] [--json]

Every request is made on the operator's bus, as `straitlink request` makes it; what comes is saved as PNG,
to be looked at, and as NPZ. Told are the bytes of each view and the time from asking to having it.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import tomlkit
from mcap.reader import make_reader

from bench.machine import keep
from netem_scripts.profiles import load_profile
from perception_server.geometry_inputs import GeometryInputs
from shaper.bus import BusSettings
from straitlink.demo.children import Children
from straitlink.demo.configs import Addresses, free_addresses, write_configs
from straitlink.errors import user_errors
from straitlink.replay import topic_key
from straitlink.request_client import RequestSettings, request_view
from straitlink.request_words import request_of
from straitlink.saved_view import describe, save_view
from straitlink.schemas import PayloadType, zenoh_encoding
from straitlink.synthetic import SyntheticSettings, synthesize

_CAMERAS = ("CompressedImage", "RawImage", "Image")
_LIDAR = ("LaserScan", "PointCloud2", "PointCloud")
_POSES = ("TFMessage", "FrameTransforms", "FrameTransform")
_CALIBRATIONS = ("CameraInfo", "CameraCalibration")
IMAGE_REQUESTS = (
    "head_low",
    "head_high",
    "chip source=head chips=220,140,200,200",
    "head_with_chip chips=220,140,200,200",
    "head_low grey=true quality=30",
)
LIDAR_REQUESTS = (
    "height_map_scene",
    "range_map_scene",
    "range_map_workspace",
    "cloud_scene",
    "octree_scene",
)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of one request. took_s: from asking to having it."""

    request: str
    took_s: float
    told: str
    file: str


@contextmanager
def chain(log: Path, out: Path, profile_name: str):  # type: ignore[no-untyped-def]
    """All processes of both hosts and the link between; yields the operator's bus."""
    out.mkdir(parents=True, exist_ok=True)
    addresses, profile = free_addresses(), load_profile(profile_name)
    write_configs(out, addresses, profile, ())
    inputs = inputs_of(log)
    _write_views(out, addresses, inputs, log)
    with Children(out) as children:
        for name, endpoint in (("robot-bus", addresses.robot_bus), ("operator-bus", addresses.operator_bus)):
            child = children.start(name, ["bus", "--listen", endpoint])
            children.wait_until(name, lambda child=child: b"open" in child.log.read_bytes())
        link = ["link", "--profile", profile_name, "--trace", str(out / "link.jsonl")]
        link += ["--robot-side", addresses.link_robot, "--operator-side", addresses.link_operator]
        link += ["--robot-peer", addresses.robot_shaper, "--operator-peer", addresses.operator_shaper]
        children.start("link", link)
        for side in ("operator", "robot"):
            arguments = ["shaper", str(out / f"{side}.toml"), "--trace", str(out / f"{side}.jsonl")]
            children.start(f"{side}-shaper", arguments)
        server = children.start("perception", ["perception", str(out / "perception.toml")])
        children.wait_until("the perception server", lambda: b"open" in server.log.read_bytes())
        children.start("replay", ["replay", str(log), "--connect", addresses.robot_bus, "--loop", "0"])
        yield addresses.operator_bus


def inputs_of(log: Path) -> dict[str, str]:
    """Names and keys of the log's cameras, scanners, poses and calibrations."""
    found: dict[str, str] = {}
    with log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None, f"{log} has no summary"
    for channel in summary.channels.values():
        kind = summary.schemas[channel.schema_id].name.rpartition("/")[2].rpartition(".")[2]
        if kind in (*_CAMERAS, *_LIDAR, *_POSES, *_CALIBRATIONS):
            key = topic_key(channel.topic)
            camera = next((name for name in ("head", "chest") if name in key and kind in _CAMERAS), None)
            found[camera or key.replace("/", "_")] = key
    return found


def frames_of(log: Path) -> tuple[str, set[str]]:
    """The root of the log's tree of frames, "map" where there is none, and all frames."""
    reader, parents, children = GeometryInputs(), dict[str, None](), set[str]()
    with log.open("rb") as stream:
        for number, (schema, channel, message) in enumerate(make_reader(stream).iter_messages()):
            kind = "" if schema is None else schema.name
            if kind.rpartition("/")[2].rpartition(".")[2] in _POSES:
                encoding = zenoh_encoding(PayloadType(channel.message_encoding, kind))
                for each in reader.decode(channel.topic, encoding, message.data) or ():
                    parents[each.parent] = None
                    children.add(each.child)
            if number > 20_000:
                break
    return next((name for name in parents if name not in children), "map"), children


def _write_views(out: Path, addresses: Addresses, inputs: dict[str, str], log: Path) -> None:
    """The robot's shaper pulls views; nothing of the log itself crosses."""
    world, frames = frames_of(log)
    path = out / "robot.toml"
    robot = tomlkit.parse(path.read_text())
    rule = {"key": "robot/view/requested", "class": "perception", "max_hz": 1, "pull": True}
    robot["topics"] = [rule]
    path.write_text(tomlkit.dumps(robot))
    document = {
        "zenoh": {"connect": [addresses.robot_bus]},
        "frames": {"world": world, "sweep_frame": "head" if "head" in frames else ""},
        "inputs": {name: {"key": key} for name, key in inputs.items()},
    }
    (out / "perception.toml").write_text(tomlkit.dumps(document))


def _synthetic(out: Path) -> Path:
    out.mkdir(parents=True, exist_ok=True)
    log = out / "synthetic.mcap"
    if not log.exists():
        synthesize(log, SyntheticSettings(duration_s=20))
    return log


def run(log: Path, out: Path, profile: str, requests: Sequence[str], settle_s: float) -> list[Outcome]:
    """Make the requests one after the other; settle_s: of the log before the first."""
    outcomes = []
    with chain(log, out, profile) as bus:
        time.sleep(settle_s)
        settings = RequestSettings(BusSettings(connect=[bus]), timeout_s=40)
        for number, words in enumerate(requests):
            path = out / f"{log.stem}-{number}-{words.split()[0]}.png"
            began_s = time.monotonic()
            try:
                reply, took_s = request_view(request_of(words.split()), settings)
                told = describe(reply)
                save_view(reply, path)
                save_view(reply, path.with_suffix(".npz"))
            except user_errors() as error:
                outcomes.append(Outcome(words, time.monotonic() - began_s, str(error), ""))
                continue
            outcomes.append(Outcome(words, round(took_s, 2), told, path.name))
    return outcomes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("log", type=Path, nargs="?", help="MCAP file; the synthetic mission unless given")
    parser.add_argument("--profile", default="constant-100k-500ms")
    parser.add_argument("--out", type=Path, default=Path("out/chain"))
    parser.add_argument("--settle", type=float, default=12.0, metavar="SECONDS", help="of log before asking")
    parser.add_argument("--requests", nargs="*", help="instead of those that fit the log")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    log = arguments.log or _synthetic(arguments.out)
    kinds = inputs_of(log)
    fitting = [*(IMAGE_REQUESTS if "head" in kinds else ())]
    fitting += LIDAR_REQUESTS if any("scan" in key or "cloud" in key for key in kinds.values()) else ()
    fitting += ["chest", "chest pan_rad=0.3 tilt_rad=-0.2"] if "chest" in kinds else ()
    world, frames = frames_of(log)
    if "head" not in frames:  # the presets stand at the head
        fitting = [words + f" frame_id={world}" if words in LIDAR_REQUESTS else words for words in fitting]
    requests = arguments.requests or fitting
    outcomes = run(log, arguments.out, arguments.profile, requests, arguments.settle)
    document = keep(
        "perception_chain",
        {
            "profile": arguments.profile,
            "log": log.name,
            "outcomes": [asdict(outcome) for outcome in outcomes],
        },
    )
    if arguments.json:
        print(json.dumps(document, indent=1))
        return
    for outcome in outcomes:
        print(f"{outcome.request:45} {outcome.took_s:6.2f} s  {outcome.told}  {outcome.file}")


if __name__ == "__main__":
    main()
