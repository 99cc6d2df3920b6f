"""The table of presets as docs/perception.md has it."""

from __future__ import annotations

import math

from messages.proto.straitlink.view_pb2 import ViewRequest
from perception_server.view_presets import VIEW_PRESETS


def preset_rows() -> list[str]:
    """One Markdown row a preset."""
    return [_row(name, request) for name, request in VIEW_PRESETS.items()]


def _row(name: str, r: ViewRequest) -> str:
    form = ViewRequest.Format.Name(r.format).removeprefix("FORMAT_").lower().replace("_", " ")
    box = ", ".join(
        f"{axis} {getattr(r, f'min_{axis}_m'):g}..{getattr(r, f'max_{axis}_m'):g}"
        for axis in "xyz"
        if r.HasField(f"min_{axis}_m")  # type: ignore[arg-type]
    )
    size = f"{100 * r.resolution_m:g} cm"
    if r.format == ViewRequest.FORMAT_RANGE_MAP:
        across, up = math.degrees(r.horizontal_fov_rad), math.degrees(r.vertical_fov_rad)
        box = f"{across:.0f} x {up:.0f} deg" + (f" to {math.degrees(r.yaw_rad):.0f} deg" if r.yaw_rad else "")
        size = f"{r.width_px}x{r.height_px}"
    elif r.format == ViewRequest.FORMAT_HEIGHT_MAP:
        columns = round((r.max_x_m - r.min_x_m) / r.resolution_m)
        size += f", {columns}x{round((r.max_y_m - r.min_y_m) / r.resolution_m)}"
    window = f"{r.window_s:g} s" if r.time_mode == ViewRequest.TIME_MODE_RELATIVE else "sweep"
    error = "" if r.format == ViewRequest.FORMAT_OCTREE else f"{1000 * r.max_error_m:g}"
    return f"| `{name}` | {form} | {box} | {size} | {error} | {window} |"


if __name__ == "__main__":
    print("\n".join(preset_rows()))
