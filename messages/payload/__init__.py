"""Between what a bus carries and what a thin link should. See docs/encodings.md."""

from messages.payload.topic_encoding import (
    Encoded,
    Payload,
    PayloadError,
    StreamEncoding,
    StreamReader,
    StreamWriter,
    TopicEncoding,
    digest_of,
)

__all__ = [
    "Encoded",
    "Payload",
    "PayloadError",
    "StreamEncoding",
    "StreamReader",
    "StreamWriter",
    "TopicEncoding",
    "digest_of",
]
