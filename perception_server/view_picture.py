"""A view of geometry as a picture, and as PLY: to be looked at without a viewer."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from messages.proto.straitlink.view_pb2 import ViewRequest
from perception_server.decode import DecodedView
from perception_server.fisheye import Picture

_CELL_PX = 3
_CLOUD_SIDE_PX = 600
_MOST_DOT_PX = 24
_HOLE_BGR = (40, 40, 40)


def view_picture(view: DecodedView) -> Picture:
    """(rows, columns, 3) BGR in false colours.

    Height maps lie with x to the right and y up, range maps as the camera sees them; clouds and octrees are
    seen from above, coloured by height.
    """
    if view.values is None:
        return _from_above(view.points_m, view.header.resolution_m)
    values = view.values[::-1] if view.header.format == ViewRequest.FORMAT_HEIGHT_MAP else view.values
    small = _coloured(values)
    return np.repeat(np.repeat(small, _CELL_PX, axis=0), _CELL_PX, axis=1)


def ply(view: DecodedView) -> bytes:
    """The view's points in the world frame as binary PLY with doubles, which every point tool reads."""
    points = np.ascontiguousarray(view.world_points_m, dtype="<f8")
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"comment frame {view.header.world_frame_id}, newest data {view.header.newest_ns} ns\n"
        f"element vertex {len(points)}\nproperty double x\nproperty double y\nproperty double z\nend_header\n"
    )
    return header.encode() + points.tobytes()


def _coloured(values: NDArray[np.float32]) -> Picture:
    """Near or low is blue, far or high is red; holes are dark grey. The scale spans 2 to 98 %."""
    known = np.isfinite(values)
    picture: Picture = np.empty((*values.shape, 3), np.uint8)
    picture[:] = _HOLE_BGR
    if known.any():
        low, high = np.percentile(values[known], (2, 98))
        share = np.clip((values[known] - low) / max(float(high - low), 1e-6), 0, 1)
        levels = (share * 255).astype(np.uint8)
        picture[known] = cv2.applyColorMap(levels[:, None], cv2.COLORMAP_TURBO)[:, 0]
    return picture


def _from_above(points_m: NDArray[np.float32], cell_m: float) -> Picture:
    """The highest cell of each pixel, x to the right and y up."""
    picture: Picture = np.empty((_CLOUD_SIDE_PX, _CLOUD_SIDE_PX, 3), np.uint8)
    picture[:] = _HOLE_BGR
    points = points_m[np.isfinite(points_m).all(axis=1)]
    if not len(points):
        return picture
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    scale = (_CLOUD_SIDE_PX - 1) / max(float((high - low).max()) + cell_m, 1e-3)
    side = min(max(2, int(np.ceil(cell_m * scale))), _MOST_DOT_PX)
    ordered = points[np.argsort(points[:, 2], kind="stable")]
    columns, rows = ((ordered[:, :2] - low) * scale).astype(int).T
    colours = _coloured(ordered[:, 2][None])[0]
    last = _CLOUD_SIDE_PX - 1
    for column, row, colour in zip(columns.tolist(), rows.tolist(), colours, strict=True):
        top = max(0, last - row - side + 1)
        picture[top : last - row + 1, column : column + side] = colour
    return picture
