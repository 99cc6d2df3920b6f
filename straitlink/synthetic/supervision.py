"""Beats of both sides and the robot's list of processes."""

from __future__ import annotations

import numpy as np

from messages.catalogue import CatalogueTopic
from messages.proto.straitlink.heartbeat_pb2 import Heartbeat
from messages.proto.straitlink.process_status_pb2 import ProcessStatus
from straitlink.synthetic.gait import TRAVEL_M, walking_pose
from straitlink.synthetic.robot_state import Samples
from straitlink.synthetic.settings import SyntheticSettings
from straitlink.synthetic.ticks import blocks

HEARTBEAT_BYTES = 64
_PADDING = bytes(36)
PROCESSES = 100
_UPTIME_AT_START_S = 300
_BATTERY_LIFE_S = 3600.0
_STREAM = 120
_RESTART_EVERY_S = 12.0  # mean time between two restarts of any process
_RESTART_TAKES_S = 2.0
_GROUPS = ("lidar_driver", "camera_driver", "joint_controller", "state_estimator", "walking_planner")
_HOSTS = ("atlas0", "atlas1", "atlas2")


def robot_heartbeat(topic: CatalogueTopic, settings: SyntheticSettings) -> Samples:
    """Ten beats a second, 64 bytes each; the mode says whether the robot is at the valve."""
    beat = Heartbeat(padding=_PADDING)
    sequence = 0
    for block in blocks(topic, settings):
        at_valve = walking_pose(block.times_s)[:, 0, 3] > TRAVEL_M - 0.2
        rows = zip(block.capture_ns.tolist(), block.times_s.tolist(), at_valve.tolist(), strict=True)
        for capture_ns, time_s, manipulating in rows:
            beat.capture_ns, beat.sequence = capture_ns, sequence
            beat.uptime_s = _UPTIME_AT_START_S + int(time_s)
            beat.mode = Heartbeat.MODE_MANIPULATING if manipulating else Heartbeat.MODE_WALKING
            beat.battery_ratio = max(0.0, 0.9 - time_s / _BATTERY_LIFE_S)
            yield capture_ns, beat.SerializeToString()
            sequence += 1


def operator_heartbeat(topic: CatalogueTopic, settings: SyntheticSettings) -> Samples:
    """The operator's side, ten beats a second."""
    beat = Heartbeat(padding=_PADDING, mode=Heartbeat.MODE_UNSPECIFIED, battery_ratio=1.0)
    sequence = 0
    for block in blocks(topic, settings):
        for capture_ns, time_s in zip(block.capture_ns.tolist(), block.times_s.tolist(), strict=True):
            beat.capture_ns, beat.sequence = capture_ns, sequence
            beat.uptime_s = _UPTIME_AT_START_S + int(time_s)
            yield capture_ns, beat.SerializeToString()
            sequence += 1


def process_status(topic: CatalogueTopic, settings: SyntheticSettings) -> Samples:
    """A hundred processes once a second; nothing changes but when one of them restarts, now and then."""
    random = np.random.default_rng([settings.seed, _STREAM])
    message = _processes(random)
    restarts_at_s, back_at_s, restarted = random.exponential(_RESTART_EVERY_S), np.inf, 0
    for block in blocks(topic, settings):
        for capture_ns, time_s in zip(block.capture_ns.tolist(), block.times_s.tolist(), strict=True):
            if time_s >= back_at_s:
                process = message.processes[restarted]
                process.state = ProcessStatus.STATE_RUNNING
                process.memory_bytes = int(random.integers(4, 400)) << 20
                restarts_at_s, back_at_s = time_s + random.exponential(_RESTART_EVERY_S), np.inf
            elif time_s >= restarts_at_s and np.isinf(back_at_s):
                restarted = int(random.integers(PROCESSES))
                message.processes[restarted].state = ProcessStatus.STATE_RESTARTING
                back_at_s = time_s + _RESTART_TAKES_S
            message.capture_ns = capture_ns
            yield capture_ns, message.SerializeToString()


SUPERVISION_SOURCES = {
    "robot/heartbeat": robot_heartbeat,
    "robot/process_status": process_status,
    "operator/heartbeat": operator_heartbeat,
}


def _processes(random: np.random.Generator) -> ProcessStatus:
    message = ProcessStatus()
    for index in range(PROCESSES):
        message.processes.add(
            name=f"{_GROUPS[index % len(_GROUPS)]}_{index:02d}",
            host=_HOSTS[index % len(_HOSTS)],
            state=ProcessStatus.STATE_STOPPED if index % 17 == 16 else ProcessStatus.STATE_RUNNING,
            cpu_ratio=round(float(random.uniform(0.0, 0.6)), 2),
            memory_bytes=int(random.integers(4, 400)) << 20,
        )
    return message
