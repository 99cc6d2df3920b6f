"""What the estimator believes while little is sent: `python -m bench.link_idle`.

A link that carries heartbeats only, or heartbeats and joints at 30 % of the thin band, must raise no alarm,
and when a camera starts after minutes of that, its first image must leave at the band's rate.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from bench.machine import provenance
from netem_scripts.profiles import load_profile
from shaper.estimation.adaptive import AdaptiveEstimator
from shaper.estimation.states import State
from shaper.link_estimator import PresetBand
from shaper.path import HeardPacket, ReportedPacket
from shaper.trace_records import Record
from straitlink.mission import MissionSettings, load_named_or_file, run_mission
from straitlink.mission.load import Load

OUT = Path("out/bench/link_idle.json")
NS_PER_S = 1_000_000_000
FIRST_S = 2.0  # of traffic, in which the rate must come right


@dataclass(frozen=True, slots=True)
class IdleFigures:
    """alarms: how often either side left the state `run` before the camera. early, late: the robot's
    estimate a minute into the mission, and just before the camera (bit/s). first_use: of the link, in the
    first two seconds of the camera."""

    row: str
    profile: str
    seed: int
    alarms: int
    early_bps: int
    late_bps: int
    true_bps: int
    first_use: float
    first_image_s: float


class _Watched(AdaptiveEstimator):
    """Notes when the state changes, and what the rate is."""

    def __init__(self, now_ns: int) -> None:
        super().__init__(now_ns=now_ns)
        self._start_ns = now_ns
        self.changes: list[tuple[int, State]] = []
        self.rates: list[tuple[int, int]] = []

    def on_heard(self, packet: HeardPacket, now_ns: int) -> None:
        super().on_heard(packet, now_ns)
        self._look(now_ns)

    def on_report(
        self, settled: Sequence[ReportedPacket], rtt_ns: int | None, loss_ratio: float, now_ns: int
    ) -> None:
        super().on_report(settled, rtt_ns, loss_ratio, now_ns)
        self._look(now_ns)

    def on_timer(self, now_ns: int) -> None:
        super().on_timer(now_ns)
        self._look(now_ns)

    def rate_at(self, at_ns: int) -> int:
        return next((rate for since_ns, rate in reversed(self.rates) if since_ns <= at_ns), 0)

    def alarms_until(self, at_ns: int) -> int:
        """How often it left `run`."""
        states = [state for since_ns, state in self.changes if since_ns < at_ns]
        if State.RUN not in states:
            return -1
        return sum(state is State.HOLD for state in states[states.index(State.RUN) :])

    def _look(self, now_ns: int) -> None:
        since_ns = now_ns - self._start_ns
        if not self.changes or self.changes[-1][1] is not self.state:
            self.changes.append((since_ns, self.state))
        if not self.rates or self.rates[-1][1] != self.rate_bps:
            self.rates.append((since_ns, self.rate_bps))


def _load(joints_hz: float, camera_at_ns: int) -> Load:
    """Heartbeats both ways, joints if any, and a camera later."""
    light, flood = load_named_or_file("light"), load_named_or_file("camera-flood")
    beats = [topic for topic in light.topics if topic.key.endswith("heartbeat")]
    image = next(topic for topic in flood.topics if topic.key == "robot/image")
    joints = next(topic for topic in flood.topics if topic.key == "robot/joints")
    quiet = [replace(joints, rate_hz=joints_hz)] if joints_hz else []
    return Load("idle", (*beats, *quiet, replace(image, starts_at_ns=camera_at_ns)))


def fly(row: str, profile_name: str, seed: int) -> IdleFigures:
    """One mission: minutes of little, then ten seconds of camera."""
    joints_hz, quiet_s = ROWS[row]
    profile, camera_ns = load_profile(profile_name), round(quiet_s * NS_PER_S)
    made: list[_Watched] = []

    def estimator(_: Sequence[PresetBand], now_ns: int) -> AdaptiveEstimator:
        made.append(_Watched(now_ns))
        return made[-1]

    packets: list[tuple[int, int]] = []
    delivered: list[int] = []

    def note(name: str, record: Record) -> None:
        t_ns = record["t_ns"]
        assert isinstance(t_ns, int)
        if name == "link" and record["event"] == "packet" and record["direction"] == "down":
            packets.append((t_ns, int(str(record["wire_bytes"]))))
        if name == "operator" and record["event"] == "delivered" and record["topic"] == "robot/image":
            delivered.append(t_ns)

    load = _load(joints_hz, camera_ns)
    settings = MissionSettings(profile, load, camera_ns + 10 * NS_PER_S, seed, estimator=estimator)
    run_mission(settings, note)
    rate_bps = profile.down.bands[0].rate_bps
    first = next(t_ns for t_ns, wire_bytes in packets if t_ns >= camera_ns and wire_bytes > 250)
    until = first + round(FIRST_S * NS_PER_S)
    sent_bits = 8 * sum(wire_bytes for t_ns, wire_bytes in packets if first <= t_ns < until)
    offered_bits = rate_bps * FIRST_S
    return IdleFigures(
        row=row,
        profile=profile_name,
        seed=seed,
        alarms=sum(estimator.alarms_until(camera_ns) for estimator in made),
        early_bps=made[0].rate_at(60 * NS_PER_S),
        late_bps=made[0].rate_at(camera_ns),
        true_bps=rate_bps,
        first_use=sent_bits / offered_bits,
        first_image_s=(min(delivered) - first) / NS_PER_S if delivered else float("nan"),
    )


ROWS = {"idle": (0.0, 300.0), "quiet": (10.0, 600.0)}  # joints (Hz), seconds before the camera
PROFILES = ("constant-100k-500ms", "constant-1m-50ms", "lossy-10")


def main() -> None:
    """Print a table, or JSON; either way leave the figures in out/bench/link_idle.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", nargs="*", default=list(ROWS), choices=list(ROWS))
    parser.add_argument("--profiles", nargs="*", default=list(PROFILES[:2]))
    parser.add_argument("--seeds", nargs="*", type=int, default=[1, 2, 3])
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    figures = [fly(r, p, s) for r in arguments.rows for p in arguments.profiles for s in arguments.seeds]
    document = {**provenance(), "rows": [asdict(f) for f in figures]}
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text(json.dumps(document, indent=1))
    if arguments.json:
        print(OUT.read_text())
        return
    print(
        f"{'row':6} {'profile':20} seed alarms  after 60 s  before camera  true    first 2 s  first image s"
    )
    for f in figures:
        rates = f"{f.early_bps / 1e3:9.1f} k {f.late_bps / 1e3:12.1f} k {f.true_bps / 1e3:5.0f} k"
        first = f"{f.first_use:10.1%} {f.first_image_s:13.2f}"
        print(f"{f.row:6} {f.profile:20} {f.seed:4} {f.alarms:6} {rates} {first}")


if __name__ == "__main__":
    main()
