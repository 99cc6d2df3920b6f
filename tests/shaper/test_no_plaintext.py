"""What somebody sees who records the link and opens the recording with scapy."""

from __future__ import annotations

import re
import zlib
from pathlib import Path

import pytest
from scapy.fields import ByteField, LEShortField, StrField, StrFixedLenField
from scapy.layers.inet import IP, UDP
from scapy.packet import Packet, Raw
from scapy.utils import rdpcap, wrpcap

from messages.catalogue import CATALOGUE
from shaper.handshake import ANSWER_BYTES, INITIATION_BYTES
from shaper.link_key import format_link_key
from shaper.traffic_class import DEFAULT_CLASSES
from tests.shaper.pair import MS, S
from tests.shaper.secured import KEY, SecuredPair

SECRETS = (b"secret payload", b"secret_topic", b"the quick brown fox")


class Protected(Packet):
    """A datagram of a session, as docs/wire_format.md has it."""

    name = "straitlink protected or control"
    fields_desc = (
        ByteField("kind", 0),
        LEShortField("session", 0),
        StrFixedLenField("number", b"", 3),
        StrField("sealed", b""),
    )


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A minute of traffic of every class both ways, through a restart and a change of address."""
    pair = SecuredPair(journals=True)
    pair.advance(1 * S)
    for i in range(60):
        for host in pair.hosts:
            kind = list(DEFAULT_CLASSES)[i % len(DEFAULT_CLASSES)]
            pair.offer(host, f"{host.side}/{kind}/secret_topic", SECRETS[i % 3] * (1 + i % 40))
        pair.advance(1000 * MS)
        if i == 20:
            pair.start(pair.robot)
        if i == 40:
            pair.operator.address = ("10.0.0.9", 999)
    assert any(SECRETS[0] in payload for payload in pair.operator.payloads), "something has crossed"
    path = tmp_path_factory.mktemp("recording") / "link.pcap"
    sent = sorted((at_ns, data, host.address, to) for host in pair.hosts for at_ns, data, to in host.sent)
    packets = [
        IP(src=source[0], dst=to[0]) / UDP(sport=source[1], dport=to[1]) / Raw(data)
        for _, data, source, to in sent
    ]
    wrpcap(str(path), packets)
    return path


def datagrams(recording: Path) -> list[bytes]:
    return [bytes(packet[UDP].payload) for packet in rdpcap(str(recording))]


def test_a_recording_holds_no_payload_no_topic_and_no_key(recording: Path) -> None:
    data = recording.read_bytes() + b"".join(datagrams(recording))
    names = [name.encode() for name in DEFAULT_CLASSES if len(name) > 4]
    names += [topic.key.encode() for topic in CATALOGUE]
    for plain in (*SECRETS, *names, b"secret", b"robot/", KEY.secret, format_link_key(KEY).encode()):
        assert plain not in data
        assert plain.hex().encode() not in data


def test_every_datagram_is_a_handshake_or_sealed(recording: Path) -> None:
    crossed = datagrams(recording)
    assert len(crossed) > 300
    sessions = set()
    for data in crossed:
        kind = data[0] & 0x0F
        if kind == 3:
            assert len(data) == INITIATION_BYTES and data[1:5] == KEY.id
        elif kind == 4:
            assert len(data) == ANSWER_BYTES
        else:
            packet = Protected(data)
            assert kind in (2, 5) and len(packet.sealed) >= 8
            sessions.add(packet.session)
    assert len(sessions) >= 4, "two sessions, a number of each side for each"


def test_what_is_sealed_cannot_be_told_from_noise(recording: Path) -> None:
    """Text would compress; counters and padding would repeat; bytes would not be even."""
    sealed = b"".join(Protected(d).sealed for d in datagrams(recording) if d[0] & 0x0F in (2, 5))
    assert len(sealed) > 20_000
    assert len(zlib.compress(sealed, 9)) >= len(sealed)
    even = len(sealed) / 256
    chi_square = sum((sealed.count(value) - even) ** 2 / even for value in range(256))
    assert chi_square < 380, "255 degrees of freedom: noise exceeds 380 once in 500,000 times"
    longest = max(map(len, re.findall(rb"[\x20-\x7e]+", sealed)))
    assert longest < 24, "no run of text"
