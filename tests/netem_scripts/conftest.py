"""Hypothesis without its deadline: an example's wall time says nothing on a machine that others use."""

from __future__ import annotations

from hypothesis import settings

settings.register_profile("netem_scripts", deadline=None)
settings.load_profile("netem_scripts")
