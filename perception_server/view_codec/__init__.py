"""Views as bytes: maps, clouds, octrees and pictures, each message decodable alone.

The first byte names the codec (`CodecId`); docs/view_codecs.md has the rest, byte for byte. Encoders
raise EncodeError, decoders DecodeError, and nothing else.
"""

from __future__ import annotations

from .cloud import CloudView, decode_cloud, encode_cloud
from .codec_id import CodecId, codec_of
from .draco import encode_draco
from .errors import DecodeError, EncodeError, ViewCodecError
from .image import encode_image
from .jpeg import pack_jpeg, unpack_jpeg
from .kernels import warm_up
from .map_codec import MapView, decode_map, encode_map
from .octree import OctreeView, decode_octree, encode_octree

__all__ = [
    "CloudView",
    "CodecId",
    "DecodeError",
    "EncodeError",
    "MapView",
    "OctreeView",
    "ViewCodecError",
    "codec_of",
    "decode_cloud",
    "decode_map",
    "decode_octree",
    "encode_cloud",
    "encode_draco",
    "encode_image",
    "encode_map",
    "encode_octree",
    "pack_jpeg",
    "unpack_jpeg",
    "warm_up",
]
