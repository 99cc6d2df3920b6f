"""Messages for `bench.view_fuzz`: damaged ones, full ones, and small ones that stand for much."""

from __future__ import annotations

import lzma
import struct
import zlib
from functools import cache
from typing import Literal

import cv2
import numpy as np
import zstandard
from numpy.typing import NDArray

from bench.view_points import own_room
from messages.proto.straitlink.view_pb2 import VIEW_STATUS_RENDERED, View, ViewRequest
from perception_server.view_codec import encode_cloud, encode_map, encode_octree, pack_jpeg
from perception_server.view_codec.map_header import MAX_CONTEXT_CELLS
from perception_server.view_codec.map_plain import FILTERS
from perception_server.view_codec.zstd_frame import zstd_frame

Kind = Literal["map", "cloud", "octree", "image", "view"]
Random = np.random.Generator
_NOISE_BYTES = 400_000
_GRIDS = {"cloud": struct.pack("<5f", 0, 0, 0, 1e-3, 0), "octree": struct.pack("<d3i", 0.1, 0, 0, 0)}
_EXTREMES = (0, 1, 0x7F, 0x80, 0xFF)


@cache
def whole_messages() -> dict[Kind, list[bytes]]:
    """Valid messages of every codec, small and at the codecs' limits."""
    random = np.random.default_rng(11)
    maps = [_terrain(random, rows, columns) for rows, columns in ((1, 1), (30, 41), (133, 200))]
    cloud = own_room()[::4]
    pictures = [
        np.kron(random.integers(0, 255, (9, 12, 3)), np.ones((8, 8, 1))).astype(np.uint8) for _ in "ab"
    ]
    pictures[1] = random.integers(0, 255, (96, 130, 3)).astype(np.uint8)
    jpegs = [cv2.imencode(".jpg", each)[1].tobytes() for each in pictures]
    whole: dict[Kind, list[bytes]] = {
        "map": [
            encode_map(each, max_error_m=0.002, codec=codec, denoise=flags, close_gaps=flags)
            for each in maps
            for codec in ("zlib", "serpentine", "context")
            for flags in (False, True)
        ],
        "cloud": [
            encode_cloud(cloud, bits=bits, codec=c) for bits in (4, 10) for c in ("zlib", "zstd", "context")
        ],
        "octree": [
            encode_octree(cloud, leaf_m=leaf, codec=c) for leaf in (0.05, 0.5) for c in ("zstd", "context")
        ],
        "image": [pack_jpeg(jpeg, codec=c) for jpeg in jpegs for c in ("huffman", "context", None)],
    }
    forms: tuple[tuple[Kind, ViewRequest.Format.ValueType], ...] = (
        ("map", ViewRequest.FORMAT_HEIGHT_MAP),
        ("map", ViewRequest.FORMAT_RANGE_MAP),
        ("cloud", ViewRequest.FORMAT_CLOUD),
        ("octree", ViewRequest.FORMAT_OCTREE),
    )
    whole["view"] = [_view(form, message) for kind, form in forms for message in whole[kind][-4:]]
    return whole


def changed_bytes(random: Random, kind: Kind, whole: list[bytes]) -> bytes:
    """One to eight bytes, at the front more often than not."""
    message = bytearray(_any_of(random, whole))
    for _ in range(random.integers(1, 9)):
        reach = len(message) if random.random() < 0.4 else min(len(message), 40)
        extreme = random.random() < 0.3
        message[random.integers(reach)] = random.choice(_EXTREMES) if extreme else random.integers(256)
    return bytes(message)


def cut_or_lengthened(random: Random, kind: Kind, whole: list[bytes]) -> bytes:
    """A part of a message, or more than it."""
    message = _any_of(random, whole)
    if random.random() < 0.5:
        return message[: random.integers(len(message))]
    return message + random.bytes(int(random.integers(1, 50)))


def spliced(random: Random, kind: Kind, whole: list[bytes]) -> bytes:
    """The front of one message and the rest of another."""
    front, rest = _any_of(random, whole), _any_of(random, whole)
    at = int(random.integers(1, 40))
    return front[:at] + rest[at:]


def noise(random: Random, kind: Kind, whole: list[bytes]) -> bytes:
    """A message's first bytes, then anything."""
    return _any_of(random, whole)[: random.integers(0, 40)] + random.bytes(int(random.integers(0, 3000)))


def promises(random: Random, kind: Kind, whole: list[bytes]) -> bytes | None:
    """The largest sizes that a header can hold, then a long body of noise or of one byte, or a bomb."""
    if kind == "map":
        return _map_header(random) + _body(random)
    if kind in ("cloud", "octree"):
        codec = random.choice([0x20, 0x21, 0x22] if kind == "cloud" else [0x31, 0x32])
        depth = random.choice([1, 4, 7, 10, 15, 20])
        cells = random.choice([1, 5000, 1 << 17, 1 << 19])
        return bytes([codec]) + _GRIDS[kind] + struct.pack("<BI", depth, cells) + _body(random)
    if kind == "image":
        side = random.choice([8, 500, 830, 1020, 4000, 65535])
        form = random.integers(0, 16)
        codec = random.choice([0x40, 0x42])
        return struct.pack("<BBBHH", codec, form, random.integers(1, 101), side, side) + _body(random)
    return None


def full(random: Random, kind: Kind, whole: list[bytes]) -> bytes | None:
    """As large as a codec takes, sound or with a few bytes changed."""
    if kind == "view":
        return None
    message = _any_of(random, full_messages()[kind])
    return changed_bytes(random, kind, [message]) if random.random() < 0.5 else message


@cache
def full_messages() -> dict[Kind, list[bytes]]:
    """Sound messages that take their decoders longest."""
    random = np.random.default_rng(12)
    full: dict[Kind, list[bytes]] = {"map": [], "cloud": [], "octree": [], "image": []}
    for holes in (0.0, 0.5):
        for bits in (8, 16):
            noisy = random.normal(0, 1.0, (256, 256)).astype(np.float32)
            noisy[random.random(noisy.shape) < holes] = np.nan
            full["map"].append(encode_map(noisy, bits=bits, codec="context", denoise=True, close_gaps=True))
            noisy = random.normal(0, 1.0, (362, 362)).astype(np.float32)
            full["map"].append(encode_map(noisy, bits=bits, codec="zlib", denoise=True, close_gaps=True))
    for depth in (7, 12, 20):
        coded = _full_octree(depth)
        full["cloud"].append(b"\x21" + _GRIDS["cloud"] + coded)
        full["octree"].append(b"\x31" + _GRIDS["octree"] + coded)
    sparse = random.integers(0, 1 << 20, (7_900, 3)).astype(np.float64)
    full["cloud"].append(encode_cloud(sparse, max_error_m=1.0, codec="context"))
    full["octree"].append(encode_octree(sparse, leaf_m=1.0, codec="context"))
    for rows, columns, quality in ((680, 1020, 60), (480, 640, 95), (256, 320, 100)):
        picture = random.integers(0, 256, (rows, columns, 3)).astype(np.uint8)
        jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        full["image"].append(pack_jpeg(jpeg, codec="context"))
    return full


def _full_octree(depth: int) -> bytes:
    """Six levels of eight children, then two each until a codec's most cells, then one each."""
    parts, cells = [b"\xff" * 8**level for level in range(6)], 8**6
    for _ in range(depth - 6):
        node = 0x80 if cells > 1 << 18 else 0x11
        parts.append(bytes([node]) * cells)
        cells *= node.bit_count()
    return struct.pack("<BI", depth, cells) + zstd_frame(parts)


MAKERS = (changed_bytes, cut_or_lengthened, changed_bytes, spliced, noise, promises, promises, full)


def _map_header(random: Random) -> bytes:
    codec = random.choice([0x10, 0x11, 0x12])
    sides = [(256, 256), (362, 362), (16, 4096), (4096, 16), (32, 4096), (1, 1), (65535, 65535)]
    rows, columns = sides[random.integers(len(sides))]
    levels = random.choice([1, 2, 255, 256, 257, 65534, 65535])
    return struct.pack("<BBHHHfff", codec, random.integers(8), rows, columns, levels, -1, 1e-3, 1e-3)


def _body(random: Random) -> bytes:
    """A long one, a short one that stands for megabytes, or a sound one of zeros."""
    which = random.integers(6)
    size = int(random.choice([1 << 10, 1 << 17, 1 << 18, 1 << 26]))
    content = random.bytes(1) * size
    if which == 0:
        return random.bytes(_NOISE_BYTES)
    if which == 1:
        return random.bytes(1) * _NOISE_BYTES
    if which == 2:
        return zlib.compress(content, 1)
    if which == 3:
        return zstandard.ZstdCompressor(level=1).compress(content)[4:]
    if which == 4:
        packed = lzma.compress(content[: 1 << 22], format=lzma.FORMAT_RAW, filters=FILTERS)
        return bytes([random.integers(8)]) + struct.pack("<H", min(len(packed), 65535)) + packed + packed
    return random.bytes(int(random.integers(4, MAX_CONTEXT_CELLS)))


def _any_of(random: Random, messages: list[bytes]) -> bytes:
    return messages[random.integers(len(messages))]


def _terrain(random: Random, rows: int, columns: int) -> NDArray[np.float32]:
    y, x = np.mgrid[:rows, :columns]
    heights = 0.01 * x + 0.2 * ((x // 13 + y // 9) % 2) + random.normal(0, 0.008, (rows, columns))
    heights[random.random(heights.shape) < 0.15 * (rows > 1)] = np.nan
    terrain: NDArray[np.float32] = heights.astype(np.float32)
    return terrain


def _view(form: ViewRequest.Format.ValueType, data: bytes) -> bytes:
    view = View(status=VIEW_STATUS_RENDERED, format=form, data=data, resolution_m=0.03)
    view.horizontal_fov_rad = view.vertical_fov_rad = 1.0
    view.world_from_view.SetInParent()
    return view.SerializeToString()
