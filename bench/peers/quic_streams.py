"""QUIC by aioquic: small messages of a topic share a stream, each large one has its own: none blocks another.

aioquic has no priorities between streams: it serves them in turn. Congestion control is its default (Reno).
"""

from __future__ import annotations

import asyncio
import ipaddress
import ssl
import struct
import tempfile
import threading
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

from aioquic.asyncio import QuicConnectionProtocol, connect, serve
from aioquic.quic.configuration import QuicConfiguration
from aioquic.quic.events import ConnectionTerminated, QuicEvent, StreamDataReceived
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from bench.peers.transport import OnMessage, Session

_PORT = 7600
_OWN_STREAM_BYTES = 4096
_HEAD = struct.Struct("<BI")
_ALPN = ["straitlink-bench"]


class QuicPeer(QuicConnectionProtocol):
    """One connection: cuts the streams of the other side into messages."""

    on_message: OnMessage = staticmethod(lambda key, payload: None)
    on_connected: Callable[[QuicPeer], None] = staticmethod(lambda peer: None)

    def quic_event_received(self, event: QuicEvent) -> None:
        """Of aioquic."""
        if isinstance(event, StreamDataReceived):
            buffers: dict[int, bytearray] = self.__dict__.setdefault("buffers", {})
            buffer = buffers.setdefault(event.stream_id, bytearray())
            buffer += event.data
            while len(buffer) >= _HEAD.size:
                name_bytes, payload_bytes = _HEAD.unpack_from(buffer)
                end = _HEAD.size + name_bytes + payload_bytes
                if len(buffer) < end:
                    break
                key = bytes(buffer[_HEAD.size : _HEAD.size + name_bytes]).decode()
                self.on_message(key, bytes(buffer[_HEAD.size + name_bytes : end]))
                del buffer[:end]
            if event.end_stream:
                buffers.pop(event.stream_id, None)
        elif isinstance(event, ConnectionTerminated):
            print(f"the QUIC connection has ended: {event.reason_phrase or event.error_code}", flush=True)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Of asyncio."""
        super().connection_made(transport)  # type: ignore[arg-type]
        self.on_connected(self)


class QuicStreams:
    """publish never blocks: aioquic keeps whatever has not left."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._peer: QuicPeer | None = None
        self._streams: dict[str, int] = {}
        self._loop = asyncio.new_event_loop()
        threading.Thread(target=self._loop.run_forever, daemon=True).start()
        future = asyncio.run_coroutine_threadsafe(self._start(), self._loop)
        future.result(20)

    def publish(self, key: str, payload: bytes) -> None:
        """To the loop, from where it goes to its stream."""
        self._loop.call_soon_threadsafe(self._send, key, payload)

    def close(self) -> None:
        """The process ends with it."""
        self._loop.call_soon_threadsafe(self._loop.stop)

    def _send(self, key: str, payload: bytes) -> None:
        if self._peer is None:
            return
        quic = self._peer._quic
        name = key.encode()
        data = _HEAD.pack(len(name), len(payload)) + name + payload
        if len(payload) >= _OWN_STREAM_BYTES:
            stream = quic.get_next_available_stream_id(is_unidirectional=True)
            quic.send_stream_data(stream, data, end_stream=True)
        else:
            if key not in self._streams:
                self._streams[key] = quic.get_next_available_stream_id(is_unidirectional=True)
                quic.send_stream_data(self._streams[key], b"")
            quic.send_stream_data(self._streams[key], data)
        self._peer.transmit()

    async def _start(self) -> None:
        session = self._session

        class Protocol(QuicPeer):
            on_message = staticmethod(session.on_message)
            on_connected = staticmethod(lambda peer: setattr(self, "_peer", peer))

        if session.side == "operator":
            configuration = QuicConfiguration(is_client=False, alpn_protocols=_ALPN, idle_timeout=120)
            _certify(configuration, session.address)
            await serve(session.address, _PORT, configuration=configuration, create_protocol=Protocol)
            return
        configuration = QuicConfiguration(
            is_client=True, alpn_protocols=_ALPN, idle_timeout=120, verify_mode=ssl.CERT_NONE
        )
        self._connection = connect(  # kept: leaving its context would close it
            session.peer_address, _PORT, configuration=configuration, create_protocol=Protocol
        )
        await self._connection.__aenter__()


def _certify(configuration: QuicConfiguration, address: str) -> None:
    """A certificate for this run; the client does not check it."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, address)])
    now = datetime(2020, 1, 1)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now)
        .not_valid_after(now + timedelta(days=36_500))
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address(address))]), False)
        .sign(key, hashes.SHA256())
    )
    with tempfile.TemporaryDirectory() as folder:
        pem = Path(folder) / "key.pem"
        pem.write_bytes(
            key.private_bytes(
                serialization.Encoding.PEM,
                serialization.PrivateFormat.PKCS8,
                serialization.NoEncryption(),
            )
        )
        chain = Path(folder) / "certificate.pem"
        chain.write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
        configuration.load_cert_chain(chain, pem)


def open_transport(_name: str, session: Session) -> QuicStreams:
    """The operator serves, the robot connects."""
    return QuicStreams(session)
