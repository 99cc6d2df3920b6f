"""From the JSON of real runs to docs/benchmarks.md and one HTML page: `python -m bench.page`."""
