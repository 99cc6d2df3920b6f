"""A received picture as other programs take it: files and Foxglove's message, without a second loss."""

from __future__ import annotations

import cv2
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

from messages.proto.straitlink.view_pb2 import Image
from perception_server.errors import PerceptionError
from perception_server.fisheye import Picture
from perception_server.foveation import Composite, ReceivedImage, received_image
from perception_server.picture_file import plain_file

_NS_PER_S = 1_000_000_000
_FORMATS = ((b"\xff\xd8", "jpeg"), (b"\x89PNG", "png"), (b"RIFF", "webp"))


def png(picture: Picture) -> bytes:
    """A picture as a PNG file: what was decoded is not compressed with loss again."""
    written, data = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not written:
        raise PerceptionError(f"a picture of shape {picture.shape} cannot be written as PNG")
    return data.tobytes()


def compressed_image(received: ReceivedImage, composite: Composite) -> CompressedImage | None:
    """What Foxglove shows of a frame; None while only chips of it are here.

    The base picture's own file where it is alone, a PNG at full resolution where chips are on it.
    """
    if composite.picture is None:
        return None
    if composite.pasted or received.base is None:
        return _message(received.key.frame_ns, received.frame_id, png(composite.picture))
    return _message(received.key.frame_ns, received.frame_id, plain_file(received.base))


def base_as_compressed_image(image: Image) -> CompressedImage:
    """The base picture of an Image as it is, without its chips. Raises DecodeError."""
    received = received_image(image)
    data = b"" if received.base is None else plain_file(received.base)
    return _message(image.frame_ns, image.frame_id, data)


def _message(frame_ns: int, frame_id: str, data: bytes) -> CompressedImage:
    form = next((name for start, name in _FORMATS if data.startswith(start)), "")
    message = CompressedImage(frame_id=frame_id, format=form, data=data)
    message.timestamp.seconds, message.timestamp.nanos = divmod(frame_ns, _NS_PER_S)
    return message
