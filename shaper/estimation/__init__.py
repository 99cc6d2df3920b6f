"""The link estimator: what each direction carries, with no presets and no agreement of clocks.

docs/link_estimation.md explains it; `adaptive` composes the parts.
"""
