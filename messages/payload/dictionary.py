"""zstd with a dictionary trained on a topic's own messages: for payloads that no schema bounds."""

from __future__ import annotations

import hashlib

import zstandard

from messages.payload.topic_encoding import Encoded, Payload, PayloadError

_LEVEL = 12  # payloads of a topic worth a dictionary are small: microseconds each
_RAW, _ZSTD = b"\0", b"\1"
_MAX_WINDOW_BYTES = 1 << 23  # what a frame may make the receiver allocate


class DictionaryEncoding:
    """One byte that says how, then the payload through zstd, or as it is where that is no smaller.

    dictionary: as `zstd --train` and `straitlink messages train-dictionary` write it.
    Raises PayloadError if it is none.
    """

    def __init__(self, dictionary: bytes) -> None:
        trained = zstandard.ZstdCompressionDict(dictionary)
        if not trained.dict_id():
            raise PayloadError(f"{len(dictionary)} bytes are no trained zstd dictionary: they have no id")
        self.dictionary_id = trained.dict_id()
        self.description = f"zstd dictionary sha256 {hashlib.sha256(dictionary).hexdigest()}"
        # The topic's name on the link tells the dictionary; its id in every frame would be four bytes more.
        parameters = zstandard.ZstdCompressionParameters.from_level(
            _LEVEL, write_dict_id=False, write_checksum=False, format=zstandard.FORMAT_ZSTD1_MAGICLESS
        )
        try:
            trained.precompute_compress(level=_LEVEL)
        except zstandard.ZstdError as error:
            raise PayloadError(f"the zstd dictionary cannot be used: {error}") from error
        self._compressor = zstandard.ZstdCompressor(compression_params=parameters, dict_data=trained)
        self._decompressor = zstandard.ZstdDecompressor(
            dict_data=trained, format=zstandard.FORMAT_ZSTD1_MAGICLESS, max_window_size=_MAX_WINDOW_BYTES
        )

    def encode(self, payload: Payload) -> Encoded:
        """The payload, compressed if that makes it smaller."""
        packed = self._compressor.compress(payload.data)
        if len(packed) < len(payload.data):
            return Encoded(_ZSTD + packed)
        return Encoded(_RAW + payload.data)

    def decode(self, data: bytes, bus_type: str, max_bytes: int, capture_unix_ns: int | None) -> Payload:
        """The payload as it was, of at most max_bytes."""
        how, packed = data[:1], data[1:]
        if how == _RAW:
            return Payload(packed, bus_type)
        if how != _ZSTD:
            raise PayloadError(
                f"a payload under a dictionary starts with {how.hex() or 'nothing'}, not 00 or 01"
            )
        try:
            declared = zstandard.get_frame_parameters(packed, format=zstandard.FORMAT_ZSTD1_MAGICLESS)
            size = declared.content_size
            if size > max_bytes:
                raise PayloadError(f"a payload of {size} bytes is beyond {max_bytes}")
            return Payload(self._decompressor.decompress(packed, max_bytes, allow_extra_data=False), bus_type)
        except zstandard.ZstdError as error:
            raise PayloadError(f"a payload is not zstd under this dictionary: {error}") from error
