"""A trace file: one JSON object per line, whole lines also after a kill."""

from __future__ import annotations

import json
from pathlib import Path

from shaper.trace_records import Record


class TraceFile:
    """Appends records as they come.

    line_buffered: hand each line to the kernel at once, so that a kill loses none.
    """

    def __init__(self, path: Path, *, line_buffered: bool = True) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("a", buffering=1 if line_buffered else -1, encoding="utf-8")

    def write(self, record: Record) -> None:
        """Append one record."""
        self._file.write(json.dumps(record, separators=(",", ":")) + "\n")

    def close(self) -> None:
        """Flush and close."""
        self._file.close()
