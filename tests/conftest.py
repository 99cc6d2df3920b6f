"""Hypothesis: the same examples on every run, no deadline on a machine that others use.

`--hypothesis-profile=thorough` (`make test-thorough`) draws twenty times as many where a test names no
number, and others each time.
"""

from __future__ import annotations

from hypothesis import settings

settings.register_profile("straitlink", derandomize=True, deadline=None, max_examples=100)
settings.register_profile("thorough", derandomize=False, deadline=None, max_examples=2000)
settings.load_profile("straitlink")
