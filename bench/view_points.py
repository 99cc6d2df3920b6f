"""Clouds and octrees for the table of view codecs, and reading the PCD file they are made of."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.view_rows import Row, coded, row
from perception_server.view_codec import decode_cloud, decode_octree, encode_cloud, encode_octree

ROOM = Path("../shared/data/clouds/room_scan1.pcd")
BOX_M, VOXEL_M = 5.0, 0.03
Points = NDArray[np.float32]  # (N, 3) metres


def cloud_rows() -> Iterator[Row]:
    """A room, and its voxels' centres, at 8 and 10 bits per axis, against interleaved x, y, z + zlib in the
    order of the source."""
    points = room()
    centres = ((np.floor(points / VOXEL_M) + 0.5) * VOXEL_M).astype(np.float32)
    for name, cloud in (("cloud", points), ("cloud of voxels", centres)):
        for bits in (8, 10):
            paper = [coded(cloud, partial(encode_cloud, bits=bits, codec="zlib"), decode_cloud)]
            for codec in ("zlib", "zstd", "context"):
                done = [coded(cloud, partial(encode_cloud, bits=bits, codec=codec), decode_cloud)]
                yield row(f"{name}, {bits} bit", codec, done, paper)


def octree_rows() -> Iterator[Row]:
    """The room's leaves, against their keys interleaved + zlib."""
    cloud = room()
    leaves = decode_octree(encode_octree(cloud, leaf_m=VOXEL_M)).keys
    bits = int(np.ptp(leaves, axis=0).max()).bit_length()
    paper = [coded(leaves, partial(encode_cloud, bits=bits, codec="zlib"), decode_cloud)]
    for codec in ("zstd", "context"):
        done = [coded(cloud, partial(encode_octree, leaf_m=VOXEL_M, codec=codec), decode_octree)]
        yield row(f"octree, {1e2 * VOXEL_M:g} cm leaves", codec, done, paper)


def room() -> Points:
    """The first point of each voxel in a box about the middle of a room: a scan, or one of our own."""
    points = read_pcd(ROOM) if ROOM.exists() else own_room()
    box = points[(np.abs(points - points.mean(axis=0)) <= BOX_M / 2).all(axis=1)]
    _, first = np.unique(np.floor(box / VOXEL_M), axis=0, return_index=True)
    return box[np.sort(first)]


def own_room() -> Points:
    """Floor, walls and boxes with a scanner's noise of 8 mm."""
    source = np.random.default_rng(1)
    points = source.uniform(-2.5, 2.5, (120_000, 3)) * [1, 1, 0.5]
    surface = source.integers(0, 4, len(points))
    points[np.arange(len(points)), np.array([0, 1, 2, 2])[surface]] = np.array([-2.4, 2.0, -1.2, -0.4])[
        surface
    ]
    return (points + source.normal(0, 0.008, points.shape)).astype(np.float32)


def read_pcd(path: Path) -> Points:
    """The x, y, z of a PCD file of kind binary_compressed whose fields are all float32."""
    data = path.read_bytes()
    start = data.index(b"\n", data.index(b"DATA")) + 1
    header = dict(line.split(" ", 1) for line in data[:start].decode().splitlines() if " " in line)
    fields = len(header["FIELDS"].split())
    packed, size = np.frombuffer(data, np.uint32, 2, start)
    content = _unpacked(data[start + 8 : start + 8 + int(packed)], int(size))
    return np.ascontiguousarray(np.frombuffer(content, np.float32).reshape(fields, -1)[:3].T)


def _unpacked(data: bytes, size: int) -> bytes:
    """LZF: a byte below 32 starts a run of literals; above, length and distance of a copy."""
    content, position = bytearray(), 0
    while position < len(data):
        control = data[position]
        position += 1
        if control < 32:
            content += data[position : position + control + 1]
            position += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += data[position]
            position += 1
        source = len(content) - ((control & 31) << 8) - data[position] - 1
        position += 1
        for _ in range(length + 2):
            content.append(content[source])
            source += 1
    if len(content) != size:
        raise ValueError(f"the PCD file holds {len(content)} bytes, not {size}")
    return bytes(content)
