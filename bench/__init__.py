"""Measured comparisons; run from the repository's root: `python -m bench`."""
