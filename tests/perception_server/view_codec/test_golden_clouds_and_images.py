"""Bytes that are fixed: what was once written must be read, and written again, everywhere.

`python -m tests.perception_server.view_codec.test_golden_clouds_and_images` prints them anew; a change is
a decision, as peers of another version then read no more.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perception_server.view_codec import (
    CodecId,
    decode_cloud,
    decode_octree,
    encode_cloud,
    encode_octree,
    pack_jpeg,
    unpack_jpeg,
)
from perception_server.view_codec.compiled import IS_COMPILED

ROOT = Path(__file__).parents[3]
GOLDEN = ROOT / "tests" / "golden" / "clouds_and_images.json"
OWN_CODERS = ("IMAGE_JPEG", "IMAGE_FILE", "IMAGE_JPEG_CONTEXT", "CLOUD_CONTEXT", "OCTREE_CONTEXT")
# The others leave the last word to zlib and zstd, whose versions may choose other bytes for the same.


def grid_cloud() -> np.ndarray:
    """A bent sheet of 400 points, on whole sixteenths of a metre."""
    across, along = np.mgrid[0:20, 0:20]
    return np.stack([across, along, (across * across + 3 * along) // 9], axis=2).reshape(-1, 3) / 16


def messages(jpeg: bytes) -> dict[str, bytes]:
    """One message per codec."""
    coded = {}
    for codec in CodecId:
        if codec.name.startswith("IMAGE"):
            coded[codec.name] = pack_jpeg(jpeg, codec=codec)
        elif codec.name.startswith("CLOUD"):
            coded[codec.name] = encode_cloud(grid_cloud(), bits=8, codec=codec)
        elif codec.name.startswith("OCTREE"):
            coded[codec.name] = encode_octree(grid_cloud(), leaf_m=0.125, codec=codec)
    return coded


def golden() -> dict[str, Any]:
    return json.loads(GOLDEN.read_text())


def check() -> None:
    """All of it, in this process's arithmetic."""
    held = golden()
    jpeg = bytes.fromhex(held["jpeg"])
    now = messages(jpeg)
    assert set(now) == set(held["messages"])
    for name, text in held["messages"].items():
        data = bytes.fromhex(text)
        if name in OWN_CODERS:
            assert now[name] == data, name
        if name.startswith("IMAGE"):
            assert unpack_jpeg(data) == jpeg
        elif name.startswith("CLOUD"):
            view = decode_cloud(data)
            expected = np.unique(decode_cloud(now[name]).points, axis=0)
            np.testing.assert_array_equal(np.unique(view.points, axis=0), expected)
            assert np.abs(np.unique(view.points, axis=0) - np.unique(grid_cloud(), axis=0)).max() < 0.01
        else:
            keys = np.unique(np.floor(grid_cloud() / 0.125).astype(np.int64), axis=0)
            np.testing.assert_array_equal(np.unique(decode_octree(data).keys, axis=0), keys)


def test_clouds_from_before_points_were_coded_on_their_own_lattice_are_still_read() -> None:
    for text in golden()["earlier"].values():
        points = np.unique(decode_cloud(bytes.fromhex(text)).points, axis=0)
        assert np.abs(points - np.unique(grid_cloud(), axis=0)).max() < 0.01


def test_every_codec_reads_and_writes_the_golden_bytes() -> None:
    check()


@pytest.mark.skipif(not IS_COMPILED, reason="the kernels run as plain Python already")
def test_plain_python_reads_and_writes_the_golden_bytes_too() -> None:
    program = f"from {Path(__file__).stem} import check; check()"
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), str(Path(__file__).parent)])
    subprocess.run([sys.executable, "-c", program], env=environment, check=True, timeout=60)


if __name__ == "__main__":
    held = golden()
    written = messages(bytes.fromhex(held["jpeg"]))
    print(json.dumps({**held, "messages": {name: data.hex() for name, data in written.items()}}, indent=1))
