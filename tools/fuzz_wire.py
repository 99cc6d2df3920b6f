"""Coverage-guided fuzzing of everything that reads bytes from the network: datagrams, payloads, views.

    pip install .[fuzz]
    python tools/fuzz_wire.py datagram -max_total_time=600       # any option of libFuzzer
    python tools/fuzz_wire.py --seeds                            # writes the seed corpus anew

A target returns or raises DecodeError; whatever else it raises is a finding, and so is an input that takes
longer than ten seconds or more than 512 MB. Seeds: tests/fuzz_corpus, which a test runs too.
"""

from __future__ import annotations

import json
import random
import re
import sys
import tempfile
import zlib
from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path
from types import ModuleType
from typing import Any

try:
    import atheris
except ImportError:  # the targets are of use without it
    atheris = None

ROOT = Path(__file__).resolve().parents[1]
CORPUS = ROOT / "tests" / "fuzz_corpus"
sys.path.insert(0, str(ROOT))


def _instrumented() -> AbstractContextManager[object]:
    """Imports whose branches libFuzzer sees; Numba takes the bytecode of kernels, which stays as it is."""
    if atheris is None or __name__ != "__main__":
        return nullcontext()
    kernels = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in (ROOT / "perception_server").rglob("*.py")
        if re.search(r"@(compiled|inlined|numba)|njit", path.read_text())
    ]
    made: AbstractContextManager[object] = atheris.instrument_imports(
        include=["shaper", "messages", "perception_server"], exclude=kernels
    )
    return made


with _instrumented():
    from shaper.agreement import make_table, unpack_table
    from shaper.carousel_receiver import CarouselReceiver
    from shaper.carousel_wire import CarouselMessage, Chunk, encode_chunk, encode_message
    from shaper.compression import unpack
    from shaper.datagram import decode_datagram
    from shaper.endpoint import Endpoint
    from shaper.endpoint_settings import EndpointSettings
    from shaper.errors import DecodeError
    from shaper.frames import VERSION
    from shaper.handshake import Hello, Identity, decode_hello, encode_hello
    from shaper.incoming import Limits
    from shaper.journal import MemoryJournal
    from shaper.link_end import LinkEnd
    from shaper.link_estimator import PresetBand, PresetBands
    from shaper.link_key import LinkKey
    from shaper.parity import decode_shares, encode_shares
    from shaper.secure_channel import Address, SecureChannel
    from shaper.shared_state import decode_entries, encode_entries
    from shaper.table_exchange import TableExchange
    from shaper.traffic_class import DEFAULT_CLASSES, TopicRule
    from tools import fuzz_payloads, fuzz_views
    from tools.fuzz_parts import join_parts, split_parts

_KEY = LinkKey(b"fuzz", bytes(32))
_HERE, _THERE = ("10.0.0.1", 1), ("10.0.0.2", 2)
_ANYWHERE = (_THERE, ("10.0.0.3", 3), ("10.0.0.4", 4))
_LIMITS = Limits(max_topics=16, max_message_bytes=20_000, max_reassembly_bytes=50_000)
_RULES = tuple(TopicRule(f"*/{name}/**", each) for name, each in DEFAULT_CLASSES.items())
_S = 1_000_000_000


def datagram(data: bytes) -> None:
    """Header and frames."""
    decode_datagram(data)


def endpoint(data: bytes) -> None:
    """Datagrams one after the other (each with its length in front), into an endpoint that answers."""
    now_ns = 10 * _S
    victim = _endpoint(now_ns)
    for part in split_parts(data):
        victim.receive_datagram(part, now_ns)
        now_ns += 20_000_000
        while victim.next_datagram(now_ns) is not None:
            pass
        while victim.next_event() is not None:
            pass
    held_bytes = victim.held_bytes
    assert held_bytes <= 3 * _LIMITS.max_reassembly_bytes, f"{held_bytes} bytes are held"


def channel(data: bytes) -> None:
    """Datagrams from anywhere, into a channel without a session."""
    victim = _link(10 * _S)
    for part in split_parts(data):
        victim.receive(part, _THERE, 11 * _S)
        while victim.channel.next_handshake(11 * _S) is not None:
            pass


def control(data: bytes) -> None:
    """What the peer's channel says, once it is opened."""
    victim = _link(10 * _S)
    assert victim.tables is not None
    victim.tables.meet(b"somehash", 10 * _S)
    for part in split_parts(data):
        victim._on_control(part, 11 * _S)


def peer(data: bytes) -> None:
    """Whatever somebody with the key seals, from wherever it comes: he may lie, but not harm."""
    now_ns = 10 * _S
    victim, enemy = _acquainted(now_ns)
    received: Counter[Address] = Counter({_THERE: 1 << 30})
    for at, part in enumerate(split_parts(data)):
        now_ns += 20_000_000
        head = part[0] if part else 0
        kind, source = head % 16 % 3, _ANYWHERE[len(part) % len(_ANYWHERE)]
        plain = bytes([VERSION | head & 0xF0]) + bytes(2) + (at + 100).to_bytes(3, "little") + part[1:]
        sealed = enemy.seal(plain, at + 100) if kind == 0 else enemy.seal_control(part[1:])
        victim.receive(part[1:] if kind == 2 else sealed, source, now_ns)
        received[source] += len(part) + 30
        while (outgoing := victim.next_datagram(now_ns)) is not None:
            received[outgoing[1]] -= len(outgoing[0]) / 3 if outgoing[1] != victim.channel.peer_address else 0
        while victim.next_event() is not None:
            pass
        victim.on_timer(now_ns)
    held_bytes = victim.endpoint.held_bytes
    assert held_bytes <= 3 * _LIMITS.max_reassembly_bytes, f"{held_bytes} bytes are held"
    assert min(received.values()) >= 0, f"more than three times what came went to {min(received)}"


def carousel(data: bytes) -> None:
    """What an authentic but mad sender of a carousel says, part by part."""
    victim = CarouselReceiver(_LIMITS, ("**",), {}, lambda stamp_us, now_ns: now_ns - stamp_us * 1000)
    for part in split_parts(data):
        victim.receive(part, 10 * _S)
    assert victim.held_bytes <= 2 * _LIMITS.max_reassembly_bytes, f"{victim.held_bytes} bytes are held"


def state(data: bytes) -> None:
    """The entries of a shared state."""
    decode_entries(data)


def table(data: bytes) -> None:
    """A topic table: packed, and as the text that it unpacks to."""
    for packed in (data, zlib.compress(data)):
        try:
            unpack_table(packed)
        except DecodeError:
            continue


def hello(data: bytes) -> None:
    """The payload of a handshake."""
    decode_hello(data)


def shares(data: bytes) -> None:
    """An erasure code's shares."""
    parts = list(split_parts(data))
    if parts and len(parts[0]) >= 2:
        needed, total = parts[0][0], parts[0][1] * 10
        if 0 < needed <= total:
            decode_shares({i * 3 % 256: part for i, part in enumerate(parts[1:])}, needed, total)


def compressed(data: bytes) -> None:
    """A compressed payload."""
    unpack(data, 20_000)


_OTHERS: tuple[ModuleType, ...] = (fuzz_payloads, fuzz_views)
TARGETS: dict[str, Callable[[bytes], None]] = {
    each.__name__: each
    for each in (
        *(datagram, endpoint, channel, control, peer, carousel),
        *(state, table, hello, shares, compressed),
    )
} | {name: target for module in _OTHERS for name, target in module.TARGETS.items()}


def run_target(name: str, data: bytes) -> None:
    """One input: returns, or raises what is a finding."""
    with suppress(DecodeError):
        TARGETS[name](data)


def seeds() -> dict[str, list[bytes]]:
    """What the targets start from: true datagrams, of which the fuzzer makes others."""
    golden = json.loads((ROOT / "tests" / "golden" / "datagrams.json").read_text())
    datagrams = [bytes.fromhex(text) for text in golden.values()]
    tables = make_table(_RULES, ["robot/**"], {})
    noise = random.Random(1)
    link = _link(0)
    handshakes = []
    for _ in range(3):
        outgoing = link.channel.next_handshake(0)
        handshakes += [outgoing[0]] if outgoing else []
    bodies = [bytes([each[0] & 0xF0]) + each[6:] for each in datagrams[:6]]
    own = {
        "datagram": datagrams,
        "endpoint": [join_parts(datagrams[i : i + 4]) for i in range(0, len(datagrams), 3)],
        "channel": [
            join_parts([*handshakes, bytes([2]) + noise.randbytes(60), bytes([4]) + noise.randbytes(78)])
        ],
        "control": [
            join_parts([b"", b"\x01" + bytes(50), b"\x02\xb0\x04", b"\x04somehash\x00\x01x", b"\x03"])
        ],
        "peer": [join_parts([*bodies, b"\1\x05" + bytes(8), b"\2" * 60])],
        "carousel": [join_parts([encode_chunk(chunk) for chunk in _chunks()])],
        "state": [encode_entries({1: b"one", 7: b""}, whole=True), encode_entries({9: b"x"}, whole=False)],
        "table": [tables.packed(), b'{"sends":{"a":{"class":"x"}},"takes":["**"],"reads":[]}'],
        "hello": [encode_hello(Hello(7, 1_750_000_000 * _S, Identity(9, bytes(8), bytes(8))))],
        "shares": [join_parts([bytes([3, 6]), *encode_shares(bytes(60), 3, 2)])],
        "compressed": [bytes.fromhex("28b52ffd0400410000" + "61" * 8)],
    }
    return own | {name: inputs for module in _OTHERS for name, inputs in module.seeds().items()}


def _chunks() -> list[Chunk]:
    """Of one message in three parts, and of a newer one in one."""
    blobs = [encode_message(CarouselMessage("a/b", "raw", bytes(n), 1, 2, 0, True)) for n in (60, 5)]
    parts = [blobs[0][at : at + 32] for at in range(0, len(blobs[0]), 32)]
    chunks = [Chunk(7, 0, index, len(parts), part) for index, part in enumerate(parts)]
    return [*chunks, Chunk(7, 1, 0, 1, blobs[1])]


def _endpoint(now_ns: int, journal: MemoryJournal | None = None) -> Endpoint:
    estimator = PresetBands((PresetBand("only", 1_000_000, 50_000_000),), now_ns=now_ns)
    settings = EndpointSettings(_RULES, limits=_LIMITS)
    made = Endpoint(settings, estimator, 0xCAFE, now_ns, 1_750_000_000 * _S, journal)
    for key in ("robot/command/a", "robot/state/a", "robot/status/a"):
        made.offer(key, bytes(40), now_ns, now_ns)
    return made


def _link(now_ns: int, journal: MemoryJournal | None = None) -> LinkEnd:
    tables = TableExchange(make_table(_RULES, ["**"], {}))
    identity = Identity(1, bytes(8), tables.hash)
    source = random.Random(1).randbytes
    channel = SecureChannel("robot", [_KEY], identity, _THERE, source, now_ns, 1_750_000_000 * _S)
    return LinkEnd(_endpoint(now_ns, journal), channel, None, tables)


def _acquainted(now_ns: int) -> tuple[LinkEnd, SecureChannel]:
    """One end, and a channel that it has just shaken hands with."""
    victim = _link(now_ns, MemoryJournal(bytes(8)))
    stranger = Identity(0, bytes(8), b"another!")
    source = random.Random(2).randbytes
    enemy = SecureChannel("operator", [_KEY], stranger, _HERE, source, now_ns, 1_750_000_000 * _S)
    hello = enemy.next_handshake(now_ns)
    assert hello is not None
    victim.receive(hello[0], _THERE, now_ns)
    while not enemy.ready:
        outgoing = victim.channel.next_handshake(now_ns)
        assert outgoing is not None
        enemy.receive(outgoing[0], _HERE, now_ns)
    proof = enemy.next_handshake(now_ns)
    assert proof is not None
    victim.receive(proof[0], _THERE, now_ns)
    return victim, enemy


def _write_seeds() -> None:
    for name, inputs in seeds().items():
        folder = CORPUS / name
        folder.mkdir(parents=True, exist_ok=True)
        for index, data in enumerate(inputs):
            (folder / f"{index:02}").write_bytes(data)


def main(arguments: list[str]) -> None:
    """Fuzz one target for as long as libFuzzer's options say."""
    if arguments == ["--seeds"]:
        return _write_seeds()
    if not arguments or arguments[0] not in TARGETS:
        sys.exit(f"usage: fuzz_wire.py TARGET [libFuzzer options] | --seeds; targets: {', '.join(TARGETS)}")
    if atheris is None:
        sys.exit("atheris is not installed: pip install .[fuzz]")
    name, *options = arguments
    if name in fuzz_views.TARGETS:
        fuzz_views.load_kernels()
    limits = ["-timeout=10", "-rss_limit_mb=768", "-max_len=4096"]
    with tempfile.TemporaryDirectory() as found:  # libFuzzer adds what it finds to the first folder
        command: list[Any] = [sys.argv[0], *limits, *options, found, str(CORPUS / name)]
        atheris.Setup(command, lambda data: run_target(name, data))
        atheris.Fuzz()


if __name__ == "__main__":
    main(sys.argv[1:])
