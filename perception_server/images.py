"""Pictures of cameras as an operator asked for them, in no more bytes than there is room for."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import cv2
import numpy as np

from messages.proto.straitlink.view_pb2 import (
    VIEW_STATUS_DOES_NOT_FIT,
    VIEW_STATUS_RENDERED,
    Image,
    ImageRegion,
)
from perception_server.camera_model import CameraModel
from perception_server.errors import RequestError
from perception_server.fisheye import MAX_VIEW_SIDE_PX, Picture, VirtualView, rectify
from perception_server.image_wish import ANY_SIDE_PX, CHIP_SIDE_PX, ImageWish, Look, Region
from perception_server.picture_file import MAX_PIXELS, decode_frame, encode_picture
from perception_server.pictures import CameraFrame

_SHRINKINGS = tuple(0.5 ** (step / 2) for step in range(1, 7))  # when the lowest quality is not enough
_SMALLEST_SIDE_PX = 16
_WELL_USED_RATIO = 0.93  # of a budget: a rung or two more would hardly show


@dataclass(frozen=True, slots=True)
class _Effort:
    """One rung of the ladder that a budget walks down."""

    quality: int
    chip_quality: int
    scale: float

    @property
    def expected_log_size(self) -> float:
        """Logarithm of the size, but for a factor: how JPEGs of one picture differ, roughly."""
        steps = math.log(_table_scale(self.quality)) + math.log(_table_scale(self.chip_quality))
        return 1.6 * math.log(self.scale) - 0.3 * steps


def render_image(
    wish: ImageWish, frame: CameraFrame, camera: CameraModel | None, budget_bytes: int, request_id: int = 0
) -> Image:
    """The frame as wished, in at most budget_bytes as serialised.

    What must give is quality, down to the wish's worst, then the base picture's size, down to an eighth;
    chips keep full resolution. If that is still too much, the reply says so and how much it takes.
    camera: needed for a virtual view. Raises RequestError naming the field, or NoDataError.
    """
    whole = _whole_picture(wish, frame, camera)
    rows, columns = whole.shape[:2]
    chips = () if wish.chips == () else _chips(wish, columns, rows)
    head = Image(
        request_id=request_id,
        status=VIEW_STATUS_RENDERED,
        source=frame.source,
        frame_ns=frame.capture_ns,
        frame_id=frame.frame_id,
        full_width_px=columns,
        full_height_px=rows,
        grey=wish.grey,
    )
    if wish.look is not None:
        head.pan_rad, head.tilt_rad = wish.look.pan_rad, wish.look.tilt_rad
        head.horizontal_fov_rad = wish.look.horizontal_fov_rad

    def encode(effort: _Effort) -> Image:
        return _encode(head, wish, whole, chips, effort)

    return _fit(encode, _ladder(wish), budget_bytes)


def _whole_picture(wish: ImageWish, frame: CameraFrame, camera: CameraModel | None) -> Picture:
    """What base and chips are cut from: the frame, or a straight view into it at its own resolution."""
    picture = decode_frame(frame)
    if wish.grey and picture.ndim == 3:
        picture = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    if wish.look is None:
        factor = math.ceil(math.sqrt(picture.shape[0] * picture.shape[1] / MAX_PIXELS))
        return picture if factor <= 1 else _shrunk(picture, factor)
    if camera is None:
        raise RequestError(
            f"horizontal_fov_rad = {wish.look.horizontal_fov_rad:g}: {frame.source} has no calibration yet"
        )
    return rectify(picture, camera, _virtual_view(wish, wish.look, camera))


def _shrunk(picture: Picture, factor: int) -> Picture:
    """By a whole factor: an operator's side composes no picture of more than MAX_PIXELS."""
    rows, columns = picture.shape[:2]
    size = (max(1, columns // factor), max(1, rows // factor))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def _virtual_view(wish: ImageWish, look: Look, camera: CameraModel) -> VirtualView:
    """As large as asked for, or, with chips or without a size, as fine as the camera's own middle."""
    across = camera.width_px / camera.height_px
    limit_x, limit_y = wish.limits_px or (camera.width_px, camera.height_px)
    width, height = float(limit_x), float(limit_y)
    if limit_x == ANY_SIDE_PX:
        width = height * across
    elif limit_y == ANY_SIDE_PX:
        height = width / across
    if wish.limits_px is None or wish.chips != ():
        native = 2 * camera.focal_x_px * math.tan(look.horizontal_fov_rad / 2)
        scale = min(native, MAX_VIEW_SIDE_PX, MAX_VIEW_SIDE_PX * width / height) / width
        width, height = width * max(scale, 1.0), height * max(scale, 1.0)
    return VirtualView(
        look.pan_rad, look.tilt_rad, look.horizontal_fov_rad, max(1, round(width)), max(1, round(height))
    )


def _chips(wish: ImageWish, columns: int, rows: int) -> tuple[Region, ...]:
    if wish.chips is None:
        width, height = min(CHIP_SIDE_PX, columns), min(CHIP_SIDE_PX, rows)
        return (Region((columns - width) // 2, (rows - height) // 2, width, height),)
    for index, chip in enumerate(wish.chips):
        if not chip.within(columns, rows):
            raise RequestError(
                f"chips[{index}] = {chip.width_px}x{chip.height_px} at ({chip.x_px}, {chip.y_px}): must lie "
                f"within the picture of {columns}x{rows}"
            )
    return wish.chips


def _base_size(wish: ImageWish, columns: int, rows: int, scale: float) -> tuple[int, int]:
    """Width and height of the base picture, proportions kept and never enlarged."""
    if wish.limits_px is None:
        fitted = 1 / wish.downsample
    else:
        fitted = min(1.0, wish.limits_px[0] / columns, wish.limits_px[1] / rows)
    sides = (columns * fitted * scale, rows * fitted * scale)
    floors = [min(_SMALLEST_SIDE_PX, math.ceil(side / scale)) for side in sides]
    return max(floors[0], round(sides[0])), max(floors[1], round(sides[1]))


def _encode(head: Image, wish: ImageWish, whole: Picture, chips: Sequence[Region], effort: _Effort) -> Image:
    image = Image()
    image.CopyFrom(head)
    rows, columns = whole.shape[:2]
    if not wish.chips_only:
        size = _base_size(wish, columns, rows, effort.scale)
        small = whole if size == (columns, rows) else cv2.resize(whole, size, interpolation=cv2.INTER_AREA)
        image.format, image.quality = wish.form, effort.quality
        image.width_px, image.height_px = size
        image.data = encode_picture(np.asarray(small), wish.form, effort.quality)
        image.coarsened = effort.quality < wish.quality or effort.scale < 1
    for chip in chips:
        cut = whole[chip.y_px : chip.y_px + chip.height_px, chip.x_px : chip.x_px + chip.width_px]
        image.chips.add(
            region=ImageRegion(
                x_px=chip.x_px, y_px=chip.y_px, width_px=chip.width_px, height_px=chip.height_px
            ),
            format=wish.form,
            quality=effort.chip_quality,
            data=encode_picture(np.ascontiguousarray(cut), wish.form, effort.chip_quality),
        )
        image.coarsened |= effort.chip_quality < wish.chip_quality
    return image


def _table_scale(quality: int) -> float:
    """Percent by which libjpeg scales its quantisation tables."""
    return max(1.0, 5000 / quality if quality < 50 else 200 - 2 * quality)


def _ladder(wish: ImageWish) -> list[_Effort]:
    """From all that was wished to the least: base and chips lose quality together, then the base shrinks."""
    if wish.chips_only:
        worst = min(wish.worst_quality, wish.chip_quality)
        return [_Effort(wish.quality, q, 1.0) for q in range(wish.chip_quality, worst - 1, -1)]
    worst_chip = min(wish.worst_quality, wish.chip_quality)
    span = max(1, wish.quality - wish.worst_quality)
    falling = [
        _Effort(q, worst_chip + (wish.chip_quality - worst_chip) * (q - wish.worst_quality) // span, 1.0)
        for q in range(wish.quality, wish.worst_quality - 1, -1)
    ]
    falling[0] = replace(falling[0], chip_quality=wish.chip_quality)
    last = replace(falling[-1], chip_quality=worst_chip)
    return list(chain(falling, (replace(last, scale=scale) for scale in _SHRINKINGS)))


def _fit(encode: Callable[[_Effort], Image], ladder: Sequence[_Effort], budget_bytes: int) -> Image:
    """A rung that fits and uses the budget well: sizes fall from rung to rung, but for a few bytes.

    The next guess is where the expected size, fitted to the two known rungs around, meets the budget: three
    or four encodings, where halving takes six.
    """
    best = encode(ladder[0])
    if (above_bytes := best.ByteSize()) <= budget_bytes:
        return best
    found = encode(ladder[-1])
    if (below_bytes := found.ByteSize()) > budget_bytes:
        return does_not_fit(found, below_bytes)
    expected = [effort.expected_log_size for effort in ladder]
    above, below = 0, len(ladder) - 1
    while below - above > 1 and below_bytes < _WELL_USED_RATIO * budget_bytes:
        share = math.log(above_bytes / budget_bytes) / math.log(above_bytes / below_bytes)
        wanted = expected[above] + share * (expected[below] - expected[above])
        guess = next(i for i in range(above + 1, below + 1) if expected[i] <= wanted or i == below)
        guess = min(max(guess, above + 1), below - 1)
        image = encode(ladder[guess])
        size_bytes = image.ByteSize()
        if size_bytes <= budget_bytes:
            below, below_bytes, found = guess, size_bytes, image
        else:
            above, above_bytes = guess, size_bytes
    return found


def does_not_fit(smallest: Image, smallest_bytes: int) -> Image:
    """The reply that carries no picture but says how much one takes."""
    return Image(
        request_id=smallest.request_id,
        status=VIEW_STATUS_DOES_NOT_FIT,
        error=f"does not fit: smallest is {smallest_bytes} bytes",
        smallest_bytes=smallest_bytes,
        source=smallest.source,
        frame_ns=smallest.frame_ns,
    )
