"""The handshake against its public test vectors, and against what nobody with the key would send."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from hypothesis import given
from hypothesis import strategies as st

from shaper.errors import DecodeError
from shaper.noise import OVERHEAD_BYTES, PROTOCOL_NAME, Initiator, Responder

VECTOR: dict[str, Any] = json.loads((Path(__file__).parents[1] / "golden" / "noise.json").read_text())
MESSAGES = [(bytes.fromhex(m["payload"]), bytes.fromhex(m["ciphertext"])) for m in VECTOR["messages"]]
PSK = bytes.fromhex(VECTOR["init_psks"][0])
PROLOGUE = bytes.fromhex(VECTOR["init_prologue"])
OURS, THEIRS = (bytes.fromhex(VECTOR[name]) for name in ("init_ephemeral", "resp_ephemeral"))


def test_the_public_vectors_of_the_handshake_and_of_its_keys_hold() -> None:
    assert VECTOR["protocol_name"].encode() == PROTOCOL_NAME
    (first, sealed_first), (second, sealed_second), *transport = MESSAGES
    initiator, responder = Initiator(PSK, PROLOGUE, OURS), Responder(PSK, PROLOGUE)
    assert initiator.write(first) == sealed_first
    assert responder.read(sealed_first) == first
    # The file's hash is that of the transcript after the first message.
    assert responder._state.hash == initiator._state.hash == bytes.fromhex(VECTOR["handshake_hash"])
    answer, theirs = responder.write(second, THEIRS)
    assert answer == sealed_second
    payload, ours = initiator.read(answer)
    assert payload == second
    assert ours.handshake_hash == theirs.handshake_hash
    assert (ours.send, ours.receive) == (theirs.receive, theirs.send)
    for index, (plain, sealed) in enumerate(transport):  # in turn, the initiator first
        key = (ours.send, theirs.send)[index % 2]
        nonce = bytes(4) + (index // 2).to_bytes(8, "little")
        assert ChaCha20Poly1305(key).encrypt(nonce, plain, None) == sealed


@pytest.mark.parametrize("what", ["key", "prologue"])
def test_another_key_or_prologue_is_no_holder_of_the_key(what: str) -> None:
    psk, prologue = (bytes(32), PROLOGUE) if what == "key" else (PSK, b"another")
    with pytest.raises(DecodeError, match="not from a holder of the link key"):
        Responder(psk, prologue).read(MESSAGES[0][1])


def test_an_ephemeral_key_of_small_order_is_refused() -> None:
    initiator, responder = Initiator(PSK, PROLOGUE, OURS), Responder(PSK, PROLOGUE)
    initiator._state.mix_ephemeral(bytes(32))
    responder.read(bytes(32) + initiator._state.encrypt_and_hash(b""))
    with pytest.raises(DecodeError, match="small order"):
        responder.write(b"", THEIRS)


@given(st.integers(0, len(MESSAGES[1][1]) * 8 - 1), st.integers(0, 1))
def test_a_flipped_bit_is_noticed_in_either_message(bit: int, which: int) -> None:
    sealed = bytearray(MESSAGES[which][1])
    sealed[bit // 8 % len(sealed)] ^= 1 << bit % 8
    initiator = Initiator(PSK, PROLOGUE, OURS)
    initiator.write(MESSAGES[0][0])
    with pytest.raises(DecodeError):
        _ = initiator.read(bytes(sealed)) if which else Responder(PSK, PROLOGUE).read(bytes(sealed))


@given(st.binary(max_size=2 * OVERHEAD_BYTES))
def test_reading_anything_returns_or_raises_a_decode_error(data: bytes) -> None:
    with pytest.raises(DecodeError):
        Responder(PSK, PROLOGUE).read(data)
