"""The demonstration: both buses, both shapers and the link as processes, a mission through them."""

from straitlink.demo.configs import OwnConfigs
from straitlink.demo.demo import DemoSettings, run_demo

__all__ = ["DemoSettings", "OwnConfigs", "run_demo"]
