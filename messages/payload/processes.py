"""Processes by 16-bit hashes of their names: a name crosses until a report with it has arrived, then no more.

Hashes are CRC-16 of "host/name"; of two that meet, the later one in the alphabet moves on to the next free
number, and the names beside the report tell so.
"""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Iterable
from typing import Any

from google.protobuf.message import Message

from messages.dccl import DcclError
from messages.payload.bounded import BoundedEncoding, OutOfRange
from messages.payload.protobuf import parse, protobuf
from messages.payload.topic_encoding import Encoded, Payload, PayloadError
from messages.proto.straitlink.bounded.process_report_pb2 import ProcessReport
from messages.proto.straitlink.process_status_pb2 import ProcessStatus

_HASHES = 1 << 16
_MIB = 1 << 20
_SENT = 64  # reports whose arrival may still be told
_KNOWN = 4096  # names that a receiver keeps; a report has 100 at most

Name = tuple[str, str]


def name_hash(host: str, name: str) -> int:
    """CRC-16-CCITT of "host/name"."""
    return crc_hqx(f"{host}/{name}".encode(), 0xFFFF)


class ProcessStatusMap:
    """straitlink.ProcessStatus as a report that has all of its names."""

    bus_type = protobuf(ProcessStatus)
    description = "processes 1"

    def to_message(self, payload: bytes) -> Message:
        """The report. A process's load crosses if the publisher tells it: is not 0."""
        status = parse(ProcessStatus, payload)
        hashes = _hashes_of((process.host, process.name) for process in status.processes)
        report = ProcessReport()
        for process in status.processes:
            state = int(process.state)
            if state not in ProcessReport.State.values():
                raise PayloadError(f"process {process.name!r}: state = {state} is none that is known")
            row = report.processes.add(
                name_hash=hashes[process.host, process.name],
                state=ProcessReport.State.ValueType(state),
            )
            if process.cpu_ratio:
                row.cpu_ratio = process.cpu_ratio
            if process.memory_bytes:
                row.memory = (process.memory_bytes + _MIB // 2) // _MIB
        for (host, name), number in hashes.items():
            report.names.add(name_hash=number, host=host, name=name)
        return report

    def to_payload(self, message: Any, capture_unix_ns: int | None) -> bytes:
        """The status. Raises PayloadError where a name is missing."""
        status = ProcessStatus(capture_ns=max(0, capture_unix_ns or 0))
        names = {entry.name_hash: entry for entry in message.names}
        for row in message.processes:
            entry = names.get(row.name_hash)
            if entry is None:
                raise PayloadError(f"a report tells of process {row.name_hash:04x}, whose name has not come")
            status.processes.add(
                name=entry.name,
                host=entry.host,
                state=ProcessStatus.State.ValueType(row.state),
                cpu_ratio=row.cpu_ratio,
                memory_bytes=row.memory * _MIB,
            )
        return status.SerializeToString()


class ProcessEncoding(BoundedEncoding):
    """Process states as reports. Each topic has a writer on one side and a reader on the other."""

    def __init__(self, *, out_of_range: OutOfRange = "raise", assume: str = "", publish: str = "") -> None:
        super().__init__(
            ProcessReport, [ProcessStatusMap()], out_of_range=out_of_range, assume=assume, publish=publish
        )
        self.description += " names once"

    def writer(self) -> ProcessWriter:
        """What a topic's sender keeps."""
        return ProcessWriter(self)

    def reader(self) -> ProcessReader:
        """What a topic's receiver keeps."""
        return ProcessReader(self)


class ProcessWriter:
    """The sender's half of one topic: leaves out the names that have arrived."""

    def __init__(self, encoding: ProcessEncoding) -> None:
        self._encoding = encoding
        self._held: dict[int, Name] = {}
        self._sent: dict[int, dict[int, Name]] = {}  # by message number, the names that it brings

    def encode(self, payload: Payload, number: int) -> Encoded:
        """The report, with the names that the receiver is not known to hold."""
        report: Any = self._encoding.to_message(payload)
        names = {entry.name_hash: (entry.host, entry.name) for entry in report.names}
        new = {at: name for at, name in names.items() if self._held.get(at) != name}
        del report.names[:]
        for at, (host, name) in new.items():
            report.names.add(name_hash=at, host=host, name=name)
        try:
            encoded = self._encoding.codec.encode_checked(report)
        except DcclError as error:
            raise PayloadError(str(error)) from error
        # What is held under a number stays known only while nothing else has left under it.
        self._held = {at: name for at, name in self._held.items() if at in names and at not in new}
        self._sent[number] = new
        for old in [n for n in self._sent if n <= number - _SENT]:
            del self._sent[old]
        return Encoded(encoded.data, self._encoding.altered(encoded.deviations))

    def on_arrived(self, number: int) -> None:
        """The receiver holds this report's names, but for those that a later one has replaced."""
        later = {at: name for n, names in self._sent.items() if n > number for at, name in names.items()}
        for at, name in self._sent.get(number, {}).items():
            if later.get(at, name) == name:
                self._held[at] = name

    def on_receiver_restarted(self) -> None:
        """It holds none."""
        self._held.clear()
        self._sent.clear()


class ProcessReader:
    """The receiver's half of one topic: adds the names that came earlier."""

    def __init__(self, encoding: ProcessEncoding) -> None:
        self._encoding = encoding
        self._known: dict[int, tuple[int, Name]] = {}  # and the number of the message that brought it

    def decode(
        self, data: bytes, number: int, bus_type: str, max_bytes: int, capture_unix_ns: int | None
    ) -> Payload:
        """The status with names. Raises PayloadError where one has not come, or means another by now."""
        try:
            report: Any = self._encoding.codec.decode(data)
        except DcclError as error:
            raise PayloadError(str(error)) from error
        told = {entry.name_hash: (entry.host, entry.name) for entry in report.names}
        for at, name in told.items():
            if self._known.get(at, (number, name))[0] <= number:
                self._known[at] = number, name
        for at in [row.name_hash for row in report.processes if row.name_hash not in told]:
            since, name = self._known.pop(at, (number, ("", "")))
            if since < number:
                report.names.add(name_hash=at, host=name[0], name=name[1])
            if since != number:
                self._known[at] = since, name  # the last to be forgotten
        while len(self._known) > _KNOWN:
            del self._known[next(iter(self._known))]
        return self._encoding.to_payload(report, bus_type, max_bytes, capture_unix_ns)


def _hashes_of(names: Iterable[Name]) -> dict[Name, int]:
    """A number for each name. Raises PayloadError where a process is named twice."""
    taken: dict[int, Name] = {}
    last = None
    for host, name in sorted(names):
        if (host, name) == last:
            raise PayloadError(f"process {name!r} of host {host!r} is there more than once")
        last = host, name
        number = name_hash(host, name)
        while number in taken:
            number = (number + 1) % _HASHES
        taken[number] = host, name
    return {name: number for number, name in taken.items()}
