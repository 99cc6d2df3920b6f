"""Missions in virtual time: two endpoints, two links and the mission's traffic in one process."""

from straitlink.mission.load import Load, LoadTopic, load_named_or_file
from straitlink.mission.mission import MissionSettings, run_mission

__all__ = ["Load", "LoadTopic", "MissionSettings", "load_named_or_file", "run_mission"]
