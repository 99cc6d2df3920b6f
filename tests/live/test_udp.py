"""The link's socket with a real kernel's MTU below it."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.live.processes import ROOT
from tests.live.test_tun import why_no_namespaces

pytestmark = [
    pytest.mark.live,
    pytest.mark.skipif(bool(why_no_namespaces()), reason=why_no_namespaces() or "it can"),
]

THROUGH_A_NARROW_DEVICE = """
import asyncio, subprocess
from shaper.udp import UdpLink

async def main():
    subprocess.run(["ip", "link", "set", "lo", "mtu", "1300", "up"], check=True)
    here, there = ("127.0.0.1", 7001), ("127.0.0.1", 7002)
    sizes = []
    receiver = await UdpLink.open(there, here, lambda batch: sizes.extend(len(data) for data, _, _ in batch))
    sender = await UdpLink.open(here, there, print)
    for size in (1272, 1273, 1472, 100):
        sender.send(bytes(size), there)
    await asyncio.sleep(0.2)
    print(sizes, sender.send_errors)
    sender.close(), receiver.close()

asyncio.run(main())
"""


def test_no_datagram_leaves_in_pieces() -> None:
    """Else the size that a probe finds would be one that leaves as two packets."""
    done = subprocess.run(
        ["unshare", "--net", sys.executable, "-c", THROUGH_A_NARROW_DEVICE],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=20,
        check=True,
    )
    assert done.stdout.strip() == "[1272, 100] 2"
