"""A trace file: one JSON object per line, whole lines also after a kill."""

from __future__ import annotations

import json
from pathlib import Path

from shaper.trace_records import Record


class TraceFile:
    """Writes records as they come; each line is handed to the kernel at once."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("a", buffering=1, encoding="utf-8")

    def write(self, record: Record) -> None:
        """Append one record."""
        self._file.write(json.dumps(record, separators=(",", ":")) + "\n")

    def close(self) -> None:
        """Flush and close."""
        self._file.close()
