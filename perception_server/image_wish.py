"""What an image request asks for: presets and defaults filled in, every field checked."""

from __future__ import annotations

from dataclasses import dataclass

from messages.proto.straitlink.view_pb2 import ImageRegion, ImageRequest
from perception_server.errors import RequestError
from perception_server.request_bounds import check_bounds

ImageFormat = ImageRequest.Format

CHIP_SIDE_PX = 200  # of the chip that a request gets which names no region
_DOWNSAMPLE = 4
_QUALITY = 50
_WORST_QUALITY = 10
_CHIP_QUALITY = 70
ANY_SIDE_PX = 1 << 16  # no limit to this side

_PACKED = ImageRequest.FORMAT_PACKED_JPEG

# Table 1 of the paper: head camera low and high, chest camera, chip. "chest" is a straight view into the
# fisheye; its picture as it is, shrunk into the same size, is "chest_fisheye".
IMAGE_PRESETS: dict[str, ImageRequest] = {
    "head_low": ImageRequest(format=_PACKED, width_px=256, height_px=136, quality=50),
    "head_high": ImageRequest(format=_PACKED, width_px=512, height_px=272, quality=50),
    "chest": ImageRequest(format=_PACKED, width_px=256, height_px=320, quality=50, horizontal_fov_rad=1.1),
    "chest_fisheye": ImageRequest(format=_PACKED, width_px=256, height_px=320, quality=50),
    "chip": ImageRequest(format=_PACKED, chips_only=True, chip_quality=70),
    "head_with_chip": ImageRequest(format=_PACKED, width_px=256, height_px=136, quality=50, chip_quality=70),
}
_WITH_CHIP = frozenset({"chip", "head_with_chip"})


@dataclass(frozen=True, slots=True)
class Region:
    """A rectangle of a camera's full-resolution picture."""

    x_px: int
    y_px: int
    width_px: int
    height_px: int

    def within(self, width_px: int, height_px: int) -> bool:
        """Whether it lies in a picture of this size."""
        return self.x_px + self.width_px <= width_px and self.y_px + self.height_px <= height_px


@dataclass(frozen=True, slots=True)
class Look:
    """Where a virtual camera looks: pan to the left, tilt up, and how wide it sees."""

    pan_rad: float
    tilt_rad: float
    horizontal_fov_rad: float


@dataclass(frozen=True, slots=True)
class ImageWish:
    """A request with everything said.

    source: "" for the only camera, or the one of the name camera_hint.
    at_ns: capture time wanted; None for the newest frame.
    limits_px: the base picture is as large as fits in, proportions kept; None: by the whole factor
    downsample. chips: regions at full resolution; None for one in the middle.
    """

    source: str = ""
    camera_hint: str = ""
    at_ns: int | None = None
    again: bool = False
    grey: bool = False
    form: ImageFormat.ValueType = ImageFormat.FORMAT_JPEG
    quality: int = _QUALITY
    worst_quality: int = _WORST_QUALITY
    downsample: int = _DOWNSAMPLE
    limits_px: tuple[int, int] | None = None
    look: Look | None = None
    chips: tuple[Region, ...] | None = ()
    chip_quality: int = _CHIP_QUALITY
    chips_only: bool = False


def image_wish(request: ImageRequest) -> ImageWish:
    """Fill in the preset and the defaults. Raises RequestError that begins with the field's name."""
    check_bounds(request)
    if request.preset and request.preset not in IMAGE_PRESETS:
        known = ", ".join(IMAGE_PRESETS)
        raise RequestError(f"preset = {request.preset!r}: must be one of {known}")
    said = ImageRequest()
    if request.preset:
        said.CopyFrom(IMAGE_PRESETS[request.preset])
    if request.HasField("downsample"):  # instead of the preset's size
        said.ClearField("width_px")
        said.ClearField("height_px")
    said.MergeFrom(request)
    if said.format == ImageFormat.FORMAT_AVIF:
        raise RequestError(
            "format = FORMAT_AVIF: is not offered: no peer's AVIF file can be read within bounds; "
            "FORMAT_WEBP takes a tenth more bytes"
        )
    worst = said.worst_quality if said.HasField("worst_quality") else _WORST_QUALITY
    quality = said.quality if said.HasField("quality") else _QUALITY
    if said.HasField("worst_quality") and worst > quality:
        raise RequestError(f"worst_quality = {worst}: must be at most quality = {quality}")
    chips: tuple[Region, ...] | None = tuple(_region(i, chip) for i, chip in enumerate(said.chips))
    if not chips and (said.chips_only or request.preset in _WITH_CHIP):
        chips = None
    return ImageWish(
        source=said.source,
        camera_hint=request.preset.partition("_")[0],
        at_ns=said.at_ns if said.HasField("at_ns") else None,
        again=said.again,
        grey=said.grey,
        form=said.format or ImageFormat.FORMAT_JPEG,
        quality=quality,
        worst_quality=min(worst, quality),
        downsample=said.downsample if said.HasField("downsample") else _DOWNSAMPLE,
        limits_px=_limits_px(said),
        look=_look(said),
        chips=chips,
        chip_quality=said.chip_quality if said.HasField("chip_quality") else _CHIP_QUALITY,
        chips_only=said.chips_only,
    )


def _limits_px(said: ImageRequest) -> tuple[int, int] | None:
    if not said.HasField("width_px") and not said.HasField("height_px"):
        return None
    return said.width_px or ANY_SIDE_PX, said.height_px or ANY_SIDE_PX


def _look(said: ImageRequest) -> Look | None:
    if not said.HasField("horizontal_fov_rad"):
        for field in ("pan_rad", "tilt_rad"):
            if said.HasField(field):
                raise RequestError(f"{field}: is of a virtual view; say horizontal_fov_rad too")
        return None
    return Look(said.pan_rad, said.tilt_rad, said.horizontal_fov_rad)


def _region(index: int, chip: ImageRegion) -> Region:
    for field in ("width_px", "height_px"):
        if not chip.HasField(field):
            raise RequestError(f"chips[{index}].{field}: is missing")
    return Region(chip.x_px, chip.y_px, chip.width_px, chip.height_px)
