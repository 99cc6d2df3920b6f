"""Link records as JSON lines in a file."""

from __future__ import annotations

import json
from pathlib import Path
from types import TracebackType

from .records import LinkRecord, event_of


class LinkTrace:
    """Writes each record as one line, at once, so that a killed process leaves whole lines behind."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", encoding="utf-8", buffering=1)

    def write(self, record: LinkRecord) -> None:
        """Append one record."""
        self._file.write(json.dumps(event_of(record), separators=(",", ":")) + "\n")

    def close(self) -> None:
        """Close the file; nothing may be written afterwards."""
        self._file.close()

    def __enter__(self) -> LinkTrace:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
