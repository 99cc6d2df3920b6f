"""A received view as a file: PNG or JPEG to look at, NPZ to compute with, PLY for other programs."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from messages.proto.straitlink.view_pb2 import VIEW_STATUS_RENDERED, Image, ViewRequest
from perception_server.decode import DecodedView, decode_view_message
from perception_server.dispatch import Reply
from perception_server.errors import PerceptionError
from perception_server.fisheye import Picture
from perception_server.foveation import Compositor, received_image
from perception_server.image_file import png
from perception_server.picture_file import decode_picture, plain_file
from perception_server.view_picture import ply, view_picture


class SaveError(PerceptionError):
    """A view cannot be saved as asked; the message says what it can be saved as."""


def describe(reply: Reply) -> str:
    """One line of what came."""
    if reply.status != VIEW_STATUS_RENDERED:
        raise SaveError(f"no view: {reply.error}")
    size_bytes = reply.ByteSize()
    if isinstance(reply, Image):
        parts = [f"{reply.source}: {size_bytes} bytes"]
        if reply.data:
            parts.append(f"{reply.width_px}x{reply.height_px} at quality {reply.quality}")
        parts += [
            f"chip {c.region.width_px}x{c.region.height_px} at quality {c.quality}" for c in reply.chips
        ]
        return ", ".join(parts) + (", coarsened to fit" if reply.coarsened else "")
    name = ViewRequest.Format.Name(reply.format).removeprefix("FORMAT_").lower().replace("_", " ")
    parts = [f"{name}: {size_bytes} bytes", f"{reply.point_count} points of {reply.source_count} sources"]
    if reply.resolution_m:
        parts.append(f"{reply.resolution_m * 1000:.0f} mm cells")
    parts.append(f"error at most {reply.max_error_m * 1000:.1f} mm")
    return ", ".join(parts) + (", coarsened to fit" if reply.coarsened else "")


def save_view(reply: Reply, path: Path) -> None:
    """Write the file that the path's suffix says. Raises SaveError, OSError, DecodeError."""
    if isinstance(reply, Image):
        write = _IMAGE_WRITERS.get(path.suffix.lower())
        if write is None:
            raise SaveError(f"{path}: an image can be saved as {', '.join(_IMAGE_WRITERS)}")
        path.write_bytes(write(reply))
        return
    draw = _VIEW_WRITERS.get(path.suffix.lower())
    if draw is None:
        raise SaveError(f"{path}: a view can be saved as {', '.join(_VIEW_WRITERS)}")
    path.write_bytes(draw(decode_view_message(reply)))


def _seen(image: Image) -> Picture:
    """The base as it was sent where it is alone, the composite at full resolution where chips are on it.

    Chips without their base: side by side.
    """
    received = received_image(image)
    if received.base is not None and not received.chips:
        return decode_picture(received.base)
    composite = Compositor().take(received)
    if composite.picture is not None:
        return composite.picture
    chips = [chip.decoded() for chip in received.chips]
    tall = max(chip.shape[0] for chip in chips)
    padded = [cv2.copyMakeBorder(c, 0, tall - c.shape[0], 0, 0, cv2.BORDER_CONSTANT) for c in chips]
    return np.concatenate(padded, axis=1)


def _jpeg(image: Image) -> bytes:
    """The base picture's own file: no second generation of loss."""
    data = plain_file(image.data)
    if image.chips or not data.startswith(b"\xff\xd8"):
        raise SaveError("only a base picture in JPEG can be saved as .jpg: save .png")
    return data


def _image_arrays(image: Image) -> bytes:
    buffer = io.BytesIO()
    regions = [[c.region.x_px, c.region.y_px, c.region.width_px, c.region.height_px] for c in image.chips]
    np.savez_compressed(
        buffer,
        picture_bgr=_seen(image),
        frame_ns=np.int64(image.frame_ns),
        full_size_px=np.array([image.full_width_px, image.full_height_px]),
        chips_px=np.array(regions, np.int64).reshape(-1, 4),
    )
    return buffer.getvalue()


def _view_arrays(view: DecodedView) -> bytes:
    buffer = io.BytesIO()
    arrays: dict[str, Any] = {
        "world_points_m": view.world_points_m,
        "world_from_view": view.world_from_view,
        "max_error_m": np.float64(view.max_error_m),
        "newest_ns": np.int64(view.header.newest_ns),
        "world_frame_id": np.array(view.header.world_frame_id),
    }
    if view.values is not None:
        arrays["values_m"] = view.values
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


_VIEW_WRITERS: dict[str, Callable[[DecodedView], bytes]] = {
    ".png": lambda view: png(view_picture(view)),
    ".npz": _view_arrays,
    ".ply": ply,
}
_IMAGE_WRITERS: dict[str, Callable[[Image], bytes]] = {
    ".png": lambda image: png(_seen(image)),
    ".jpg": _jpeg,
    ".npz": _image_arrays,
}
