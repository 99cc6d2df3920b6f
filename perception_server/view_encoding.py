"""Points drawn and coded at a given fidelity: header and data of a view."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from messages.proto.straitlink.view_pb2 import VIEW_STATUS_RENDERED, View, ViewRequest
from perception_server.height_map import render_height_map
from perception_server.range_map import render_range_map
from perception_server.region import ViewPoints
from perception_server.view_codec import CodecId, encode_cloud, encode_map, encode_octree
from perception_server.view_codec.cloud import unpack_lattice
from perception_server.view_codec.compiled import IS_COMPILED
from perception_server.view_codec.map_header import MAX_CONTEXT_CELLS, unpack_header
from perception_server.view_wish import Fidelity, ViewWish
from perception_server.voxels import resample

_MAP_CODECS = {
    ViewRequest.CODEC_UNSPECIFIED: None,
    ViewRequest.CODEC_ZLIB: CodecId.MAP_ZLIB,
    ViewRequest.CODEC_SERPENTINE: CodecId.MAP_SERPENTINE,
    ViewRequest.CODEC_CONTEXT: CodecId.MAP_CONTEXT,
}


def has_draft(wish: ViewWish) -> bool:
    """Whether a faster encoder makes somewhat larger views of this kind, to search a budget with."""
    return wish.form == ViewRequest.FORMAT_OCTREE or (
        wish.form == ViewRequest.FORMAT_CLOUD and wish.codec != ViewRequest.CODEC_ZLIB
    )


class Drawing:
    """A view's points as they are drawn at a resolution; the search for a budget asks for it again."""

    def __init__(self, wish: ViewWish, points: ViewPoints) -> None:
        self._wish = wish
        self._points = points
        self._last: tuple[float, NDArray[np.float32]] | None = None

    def at(self, resolution: float) -> NDArray[np.float32]:
        """A map (rows, columns), or one point of each voxel (N, 3). Raises EncodeError for too many."""
        if self._last is None or self._last[0] != resolution:
            self._last = resolution, self._draw(resolution)
        return self._last[1]

    def _draw(self, resolution: float) -> NDArray[np.float32]:
        points, wish = self._points, self._wish
        if wish.form == ViewRequest.FORMAT_HEIGHT_MAP:
            grid = wish.grid(resolution)
            return render_height_map(points.points_m, grid, points.origins_m, points.stops)
        if wish.form == ViewRequest.FORMAT_RANGE_MAP:
            return render_range_map(points.points_m, wish.shrunk_projection(resolution))
        return resample(points.points_m, resolution)  # of octrees too: the coder would sort them all


def encode_view(
    header: View, wish: ViewWish, drawing: Drawing, fidelity: Fidelity, draft: bool = False
) -> View:
    """One view. Raises view_codec.EncodeError for more than a codec holds.

    draft: clouds and octrees without context mixing, a fifth larger in a tenth of the time.
    """
    view = View()
    view.CopyFrom(header)
    view.status = VIEW_STATUS_RENDERED
    view.coarsened = fidelity != wish.finest
    drawn = drawing.at(fidelity.resolution)
    if wish.form == ViewRequest.FORMAT_HEIGHT_MAP:
        grid = wish.grid(fidelity.resolution)
        view.min_x_m, view.min_y_m, view.resolution_m = grid.min_x_m, grid.min_y_m, grid.resolution_m
        _put_map(view, drawn, wish, fidelity)
    elif wish.form == ViewRequest.FORMAT_RANGE_MAP:
        projection = wish.shrunk_projection(fidelity.resolution)
        view.horizontal_fov_rad = projection.horizontal_fov_rad
        view.vertical_fov_rad = projection.vertical_fov_rad
        _put_map(view, drawn, wish, fidelity)
    elif wish.form == ViewRequest.FORMAT_CLOUD:
        codec = CodecId.CLOUD_ZSTD if draft else None
        if wish.codec == ViewRequest.CODEC_ZLIB:
            codec = CodecId.CLOUD_ZLIB
        view.data = encode_cloud(drawn, max_error_m=fidelity.max_error_m, codec=codec)
        lattice, view.max_error_m = unpack_lattice(view.data)
        view.resolution_m, view.step_m = fidelity.resolution, lattice.step_m
    else:
        view.resolution_m = fidelity.resolution
        view.max_error_m = fidelity.resolution * 3**0.5 / 2  # from a leaf's middle to its corner
        codec = CodecId.OCTREE_ZSTD if draft else None
        view.data = encode_octree(drawn, leaf_m=fidelity.resolution, codec=codec)
    return view


def _put_map(view: View, values: NDArray[np.float32], wish: ViewWish, fidelity: Fidelity) -> None:
    view.data = encode_map(
        values,
        max_error_m=fidelity.max_error_m,
        codec=_MAP_CODECS[wish.codec] or _best_codec(values.size),
        denoise=wish.denoise,
        close_gaps=wish.close_gaps,
    )
    coded = unpack_header(view.data)
    view.step_m, view.max_error_m = coded.step_m, coded.max_error_m
    view.denoised, view.gaps_closed = wish.denoise, wish.close_gaps


def _best_codec(cells: int) -> CodecId:
    """Context mixing wins on whatever was measured; to try the other as well takes half as long again."""
    return CodecId.MAP_CONTEXT if IS_COMPILED and cells <= MAX_CONTEXT_CELLS else CodecId.MAP_SERPENTINE
