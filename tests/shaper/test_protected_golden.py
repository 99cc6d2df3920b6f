"""The bytes of a protected session, from fixed keys and randomness: changing one is a decision."""

from __future__ import annotations

import json
import random
from pathlib import Path

from shaper.handshake import ANSWER_BYTES, INITIATION_BYTES, Identity
from shaper.link_key import make_link_key
from shaper.secure_channel import SecureChannel

GOLDEN = Path(__file__).parents[1] / "golden" / "protected.json"
UNIX_NS = 1_750_000_000_000_000_000
PLAIN = bytes.fromhex("11efbe452301efbeaddeff") + b"frames"


def session() -> dict[str, str]:
    """What crosses when the operator's side meets the robot's and each says one thing."""
    key = make_link_key(random.Random(1).randbytes)
    robot, operator = (
        SecureChannel(
            side, [key], Identity(epoch, bytes(8), bytes(8)), peer, random.Random(seed).randbytes, 0, UNIX_NS
        )
        for side, epoch, peer, seed in (
            ("robot", 0xBEEF, ("operator", 0), 2),
            ("operator", 0xCAFE, ("robot", 0), 3),
        )
    )
    asked = operator.next_handshake(0)
    assert asked is not None
    robot._initiate_at_ns = 1 << 60  # it only answers
    robot.receive(asked[0], ("operator", 0), 0)
    answered = robot.next_handshake(0)
    assert answered is not None
    operator.receive(answered[0], ("robot", 0), 0)
    proof = operator.next_handshake(0)
    assert proof is not None
    robot.receive(proof[0], ("operator", 0), 0)
    return {
        "initiation": asked[0].hex(),
        "answer": answered[0].hex(),
        "proof": proof[0].hex(),
        "from the robot": robot.seal(PLAIN, 0x12345).hex(),
        "from the operator": operator.seal(PLAIN, 7).hex(),
        "control": operator.seal_control(b"\x02\xb0\x04").hex(),
    }


def test_the_bytes_of_a_protected_session_are_those_decided_on() -> None:
    assert session() == json.loads(GOLDEN.read_text())


def test_the_sizes_are_those_of_the_page() -> None:
    page = (Path(__file__).parents[2] / "docs" / "security.md").read_text()
    made = {name: len(bytes.fromhex(text)) for name, text in session().items()}
    assert f"initiation, {made['initiation']} bytes" in page and made["initiation"] == INITIATION_BYTES
    assert f"answer, {made['answer']} bytes" in page and made["answer"] == ANSWER_BYTES
    assert f"proof, {made['proof']} bytes" in page
    total = sum(made[name] + 28 for name in ("initiation", "answer", "proof"))
    assert f"that is {total} bytes in all" in page and total <= 400
    assert made["from the robot"] - len(b"frames") == 19
