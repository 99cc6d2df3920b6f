"""Pictures of views of a recorded log: `python tools/draw_views.py LOG.mcap FOLDER --world map --frame head`.

Reads scans, clouds and transforms of any MCAP file (ROS 2 CDR or Foxglove protobufs), asks for presets at
its end, sends each through bytes, and writes what the operator's side decodes: one PNG a view, heights and
ranges in colour (blue low or near, red high or far, black for holes), forward up.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from mcap.reader import make_reader
from numpy.typing import NDArray

from messages.proto.straitlink.view_pb2 import VIEW_STATUS_RENDERED, ViewRequest
from perception_server.answer import answer
from perception_server.decode import DecodedView, decode_view
from perception_server.geometry_inputs import GeometryInputs
from perception_server.history import History
from perception_server.pictures import Disparity
from perception_server.scan_geometry import RawCloud, RawScan, ScanPlacement

PRESETS = (
    "height_map_scene",
    "height_map_corridor",
    "height_map_coarse",
    "range_map_scene",
    "range_map_workspace",
    "cloud_scene",
    "octree_scene",
)
_MEDIA = {"cdr": "application/cdr", "protobuf": "application/protobuf"}
_PIXELS_PER_CELL = 4


def history_of(log: Path, placement: ScanPlacement, until_s: float = np.inf) -> History:
    """Everything of a log that a history takes, in the log's order, for its first until_s seconds."""
    history, inputs = History(placement=placement), GeometryInputs()
    with log.open("rb") as stream:
        first_ns = None
        for schema, channel, message in make_reader(stream).iter_messages():
            first_ns = first_ns or message.log_time
            if schema is None or message.log_time - first_ns > until_s * 1e9:
                continue
            encoding = f"{_MEDIA.get(channel.message_encoding, '')};{schema.name}"
            item = inputs.decode(channel.topic.lstrip("/"), encoding, message.data)
            if isinstance(item, list):
                history.insert_transforms(item, message.log_time)
            elif isinstance(item, RawScan):
                history.insert_scan(item, message.log_time)
            elif isinstance(item, RawCloud):
                history.insert_cloud(item, message.log_time)
            elif isinstance(item, Disparity):
                history.insert_disparity(item)
    return history


def picture(view: DecodedView) -> NDArray[np.uint8]:
    """(rows, columns, 3) BGR of any view; clouds and octrees are seen from above."""
    if view.values is None:
        x, y, z = view.points_m.T
        step_m = max(0.02, float(view.header.resolution_m) / 2)
        column, row = ((x - x.min()) / step_m).astype(int), ((y - y.min()) / step_m).astype(int)
        values = np.full((row.max() + 1, column.max() + 1), np.nan)
        order = np.argsort(z)
        values[row[order], column[order]] = z[order]
    else:
        values = view.values
    known = np.isfinite(values)
    low, high = np.quantile(values[known], [0.01, 0.99]) if known.any() else (0.0, 1.0)
    scaled = np.clip((np.where(known, values, low) - low) / max(high - low, 1e-6), 0, 1)
    coloured = cv2.applyColorMap((scaled * 255).astype(np.uint8), cv2.COLORMAP_TURBO)
    coloured[~known] = 0
    if view.header.format != ViewRequest.FORMAT_RANGE_MAP:
        coloured = cv2.rotate(coloured[::-1], cv2.ROTATE_90_COUNTERCLOCKWISE)  # x up, y to the left
    scale = max(1, min(_PIXELS_PER_CELL, 1200 // max(coloured.shape[:2])))
    return cv2.resize(coloured, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)


def main() -> None:
    """Write the pictures and say what each view cost."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("log", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--world", default="map", help="the fixed frame")
    parser.add_argument("--frame", default="head", help="the frame that views stand in")
    parser.add_argument("--sweep-frame", default="", help="against which the spindle turns")
    parser.add_argument("--until", type=float, default=np.inf, help="seconds of the log to take")
    parser.add_argument("--budget", type=int, default=1 << 20, help="bytes a view")
    parser.add_argument("--denoise", action="store_true")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    history = history_of(
        arguments.log, ScanPlacement(arguments.world, arguments.sweep_frame), arguments.until
    ).snapshot()
    for preset in PRESETS:
        request = ViewRequest(preset=preset, frame_id=arguments.frame, denoise=arguments.denoise)
        view = answer(request, history, arguments.budget)
        if view.status != VIEW_STATUS_RENDERED:
            print(f"{preset:22} {view.error}")
            continue
        path = arguments.folder / f"{preset}.png"
        cv2.imwrite(str(path), picture(decode_view(view.SerializeToString())))
        print(f"{preset:22} {view.ByteSize():6} B, {view.point_count:7} points of {view.source_count} scans")


if __name__ == "__main__":
    main()
