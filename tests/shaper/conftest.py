"""One Hypothesis profile: the same examples on every run, no deadline on a shared machine."""

from hypothesis import settings

settings.register_profile("shaper", derandomize=True, deadline=None, max_examples=100)
settings.load_profile("shaper")
