"""The operator's side: what comes over the link as messages that any viewer shows."""

from __future__ import annotations

from typing import NamedTuple

from messages.proto.straitlink.view_pb2 import VIEW_STATUS_RENDERED, View, ViewRequest
from perception_server.bus_messages import IMAGE_ENCODING, VIEW_ENCODING
from perception_server.decode import decode_view_message, parse_view, to_grid, to_point_cloud
from perception_server.foveation import Compositor, read_image
from perception_server.image_file import compressed_image
from perception_server.view_codec import DecodeError

_FOXGLOVE = "application/protobuf;foxglove."


class Shown(NamedTuple):
    """A message for viewers: what it is ("image", "grid", "cloud"), its Zenoh encoding, its bytes."""

    what: str
    encoding: str
    payload: bytes


class ViewDecoder:
    """Decodes views and images as they come, in any order; chips are drawn on their own frames.

    refused: how many could not be decoded. others: chips told as of another time, not drawn.
    """

    def __init__(self) -> None:
        self.refused = 0
        self.others = 0
        self._compositor = Compositor()

    def take(self, encoding: str, payload: bytes) -> tuple[Shown, ...]:
        """What a message shows; nothing for replies without a picture and for other encodings."""
        try:
            if encoding == IMAGE_ENCODING:
                return self._image(payload)
            if encoding == VIEW_ENCODING:
                return _view(parse_view(payload))
        except DecodeError:
            self.refused += 1
        return ()

    def _image(self, payload: bytes) -> tuple[Shown, ...]:
        received = read_image(payload)
        composite = self._compositor.take(received)
        self.others += len(composite.others)
        message = compressed_image(received, composite)
        if message is None:
            return ()
        return (Shown("image", f"{_FOXGLOVE}CompressedImage", message.SerializeToString()),)


def _view(view: View) -> tuple[Shown, ...]:
    if view.status != VIEW_STATUS_RENDERED:
        return ()
    decoded = decode_view_message(view)
    cloud = Shown("cloud", f"{_FOXGLOVE}PointCloud", to_point_cloud(decoded).SerializeToString())
    if view.format != ViewRequest.FORMAT_HEIGHT_MAP:
        return (cloud,)
    return Shown("grid", f"{_FOXGLOVE}Grid", to_grid(decoded).SerializeToString()), cloud
