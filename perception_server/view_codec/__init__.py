"""Views as bytes: maps, clouds, octrees and pictures, each message decodable alone.

The first byte names the codec (`CodecId`); docs/view_codecs.md has the rest, byte for byte. Encoders
raise EncodeError, decoders DecodeError, and nothing else.
"""

from __future__ import annotations

from .codec_id import CodecId, codec_of
from .errors import DecodeError, EncodeError, ViewCodecError
from .jpeg import pack_jpeg, unpack_jpeg

__all__ = ["CodecId", "DecodeError", "EncodeError", "ViewCodecError", "codec_of", "pack_jpeg", "unpack_jpeg"]
