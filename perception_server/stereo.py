"""Disparity images as points in the world."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from perception_server.errors import PoseError
from perception_server.frames import FloatArray, FrameTree
from perception_server.pictures import Disparity
from perception_server.point_ring import BlockView, PointRing
from perception_server.region import Window
from perception_server.scan_geometry import RawCloud, ScanPlacement, place_cloud

MAX_DEPTH_M = 30.0  # beyond, a pixel of disparity is metres of depth


def optical_points(disparity: Disparity) -> NDArray[np.float32]:
    """(N, 3) in the camera's optical frame (z forward, x right, y down); pixels without a match left out."""
    pixels = disparity.disparity_px
    rows, columns = np.nonzero(np.isfinite(pixels) & (pixels > 0))
    focal = disparity.focal_px
    depth = focal * disparity.baseline_m / pixels[rows, columns].astype(np.float64)
    near = depth <= MAX_DEPTH_M
    rows, columns, depth = rows[near], columns[near], depth[near]
    points: FloatArray = np.stack(
        [
            (columns - disparity.centre_x_px) * depth / focal,
            (rows - disparity.centre_y_px) * depth / focal,
            depth,
        ],
        axis=-1,
    )
    return points.astype(np.float32)


def placed(
    disparities: tuple[Disparity, ...], window: Window, tree: FrameTree, placement: ScanPlacement
) -> tuple[BlockView, ...]:
    """The images of a window as blocks of points in the world; those without a pose are left out."""
    ring = PointRing(max_points=1 << 40, max_age_ns=1 << 62)
    for disparity in disparities:
        if window.start_ns <= disparity.capture_ns <= window.end_ns:
            cloud = RawCloud(
                disparity.source, disparity.frame_id, disparity.capture_ns, optical_points(disparity)
            )
            try:
                ring.append(place_cloud(cloud, tree, placement))
            except PoseError:
                continue
    return ring.views
