"""Processes by 16-bit hashes of their names: the names cross once, the states as often as they change.

Hashes are CRC-16 of "host/name"; of two that meet, the later one in the alphabet moves on to the next
free number, which the table tells. Memory and load cross only where asked for.
"""

from __future__ import annotations

from binascii import crc_hqx

from messages.payload import PayloadError
from messages.proto.straitlink.bounded.process_report_pb2 import ProcessNames, ProcessReport
from messages.proto.straitlink.process_status_pb2 import ProcessStatus

_HASHES = 1 << 16
_TABLES = 1 << 8
_MIB = 1 << 20

Name = tuple[str, str]


def name_hash(host: str, name: str) -> int:
    """CRC-16-CCITT of "host/name"."""
    return crc_hqx(f"{host}/{name}".encode(), 0xFFFF)


class ProcessReporter:
    """The sender's half: turns a status into a report, and into a new table when names have changed."""

    def __init__(self, *, with_load: bool = False) -> None:
        self._with_load = with_load
        self._hashes: dict[Name, int] = {}
        self._table_id = 0

    def report(self, status: ProcessStatus) -> tuple[ProcessReport, ProcessNames | None]:
        """The report, and the table if this status has other processes than the one before.

        Raises PayloadError where a process is named twice.
        """
        names = sorted((process.host, process.name) for process in status.processes)
        if len(set(names)) != len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise PayloadError(f"process {twice[1]!r} of host {twice[0]!r} is there more than once")
        is_new = self._hashes.keys() != set(names)
        if is_new:
            self._hashes = _hashes_of(names)
            self._table_id = (self._table_id + 1) % _TABLES
        report = ProcessReport(table_id=self._table_id)
        for process in status.processes:
            row = report.processes.add(
                name_hash=self._hashes[process.host, process.name],
                state=ProcessReport.State.ValueType(process.state),
            )
            if self._with_load:
                row.cpu_ratio = min(1.25, max(0.0, process.cpu_ratio))
                row.memory = min(65535, process.memory_bytes // _MIB)
        return report, self.names() if is_new else None

    def names(self) -> ProcessNames:
        """The present table, for a receiver that has started anew."""
        table = ProcessNames(table_id=self._table_id)
        for (host, name), number in self._hashes.items():
            table.entries.add(name_hash=number, host=host, name=name)
        return table


class ProcessReader:
    """The receiver's half: knows the newest table."""

    def __init__(self) -> None:
        self._table_id: int | None = None
        self._names: dict[int, Name] = {}

    def learn(self, table: ProcessNames) -> None:
        """A table has come."""
        self._table_id = table.table_id
        self._names = {entry.name_hash: (entry.host, entry.name) for entry in table.entries}

    def status(self, report: ProcessReport, capture_unix_ns: int) -> ProcessStatus | None:
        """The status with names; None while the table of this report has not come."""
        if report.table_id != self._table_id:
            return None
        status = ProcessStatus(capture_ns=capture_unix_ns)
        for row in report.processes:
            host, name = self._names.get(row.name_hash, ("", f"{row.name_hash:04x}"))
            status.processes.add(
                name=name,
                host=host,
                state=ProcessStatus.State.ValueType(row.state),
                cpu_ratio=row.cpu_ratio,
                memory_bytes=row.memory * _MIB,
            )
        return status


def _hashes_of(names: list[Name]) -> dict[Name, int]:
    taken: dict[int, Name] = {}
    for host, name in names:
        number = name_hash(host, name)
        while number in taken:
            number = (number + 1) % _HASHES
        taken[number] = host, name
    return {name: number for number, name in taken.items()}
