"""One Hypothesis profile: the same examples on every run, no deadline on a machine that others use."""

from __future__ import annotations

from hypothesis import settings

settings.register_profile("straitlink", derandomize=True, deadline=None, max_examples=100)
settings.load_profile("straitlink")
