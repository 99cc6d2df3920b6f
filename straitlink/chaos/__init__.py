"""Chaos missions: everything that can happen to a link and its two ends, in virtual time, from a seed."""

from straitlink.chaos.run import ChaosError, ChaosReport, run_chaos

__all__ = ["ChaosError", "ChaosReport", "run_chaos"]
