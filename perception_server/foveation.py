"""The operator's side of foveation: chips at full resolution on the frame that they were cut from.

A chip belongs to one frame of one camera, by name, capture time and direction of view. It is drawn on that
frame or not at all; what is of another time is told, with how far it is off.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field

import cv2
import numpy as np

from messages.proto.straitlink.view_pb2 import VIEW_STATUS_RENDERED, Image, ImageRequest
from perception_server.fisheye import Picture
from perception_server.image_wish import Look, Region
from perception_server.picture_file import MAX_FILE_BYTES, MAX_PIXELS, decode_picture
from perception_server.view_codec.errors import DecodeError

MAX_CHIPS = 16  # of one frame, from several messages
_MAX_FRAMES = 8  # that are kept of a camera, as files
_MAX_SOURCES = 32
_MAX_KEPT_BYTES = 16_000_000
_MAX_NAME_BYTES = 128


@dataclass(frozen=True, slots=True)
class FrameKey:
    """What makes two pictures parts of one: camera, capture time, direction and full size."""

    source: str
    frame_ns: int
    look: Look | None
    width_px: int
    height_px: int


@dataclass(frozen=True, slots=True)
class Chip:
    """A region of a frame as a picture file."""

    region: Region
    form: ImageRequest.Format.ValueType
    data: bytes

    def decoded(self) -> Picture:
        """(rows, columns, 3) BGR of the region's size. Raises DecodeError."""
        picture = decode_picture(self.data, self.region.width_px * self.region.height_px)
        if picture.shape[:2] != (self.region.height_px, self.region.width_px):
            raise DecodeError("a chip's picture is not of its region's size")
        return _in_colour(picture)


@dataclass(frozen=True, slots=True)
class ReceivedImage:
    """An Image message in parts, checked, its pictures still files. base: None with chips only."""

    key: FrameKey
    frame_id: str
    base: bytes | None
    chips: tuple[Chip, ...]


@dataclass(frozen=True, slots=True)
class OtherChip:
    """A chip of another time than the frame shown. later_by_ns: negative if it is older."""

    chip: Chip
    frame_ns: int
    later_by_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Composite:
    """One frame with all that has come of it.

    picture: (rows, columns, 3) BGR at full resolution; None while only chips of this frame are here.
    pasted: the regions that show full resolution. others: the newest chips of each region that are of
    other times, not drawn.
    """

    key: FrameKey
    frame_id: str
    picture: Picture | None
    pasted: tuple[Region, ...]
    others: tuple[OtherChip, ...]


@dataclass(slots=True)
class _Kept:
    frame_id: str
    base: bytes | None = None
    chips: dict[Region, Chip] = field(default_factory=dict)

    @property
    def held_bytes(self) -> int:
        return len(self.base or b"") + sum(len(chip.data) for chip in self.chips.values())


def read_image(data: bytes) -> ReceivedImage:
    """Parse and check a serialised Image from the link. Raises DecodeError."""
    image = Image()
    try:
        image.ParseFromString(data)
    except Exception as error:  # protobuf's own DecodeError has several ancestors, by implementation
        raise DecodeError(f"the bytes are no Image message: {error}") from error
    return received_image(image)


def received_image(image: Image) -> ReceivedImage:
    """Check a parsed Image. Raises DecodeError, also for a reply that carries no picture."""
    if image.status != VIEW_STATUS_RENDERED:
        raise DecodeError(f"the reply carries no picture: {image.error or 'status ' + str(image.status)}")
    width, height = image.full_width_px, image.full_height_px
    if not 0 < width * height <= MAX_PIXELS:
        raise DecodeError(f"a frame of {width}x{height} is outside 1..{MAX_PIXELS} pixels")
    if max(len(image.source.encode()), len(image.frame_id.encode())) > _MAX_NAME_BYTES:
        raise DecodeError(f"source or frame_id has more than {_MAX_NAME_BYTES} bytes")
    if len(image.chips) > MAX_CHIPS:
        raise DecodeError(f"{len(image.chips)} chips: at most {MAX_CHIPS} belong to one frame")
    if image.ByteSize() > MAX_FILE_BYTES:
        raise DecodeError(f"an Image of {image.ByteSize()} bytes has more than {MAX_FILE_BYTES}")
    chips = tuple(_chip(chip, width, height) for chip in image.chips)
    if not image.data and not chips:
        raise DecodeError("the Image has neither a picture nor chips")
    look = None
    if image.HasField("horizontal_fov_rad"):
        look = Look(image.pan_rad, image.tilt_rad, image.horizontal_fov_rad)
    key = FrameKey(image.source, image.frame_ns, look, width, height)
    return ReceivedImage(key, image.frame_id, image.data or None, chips)


def _chip(chip: Image.Chip, width: int, height: int) -> Chip:
    said = chip.region
    region = Region(said.x_px, said.y_px, said.width_px, said.height_px)
    if not region.width_px or not region.height_px or not region.within(width, height):
        raise DecodeError(f"a chip's region {region} is not within the frame of {width}x{height}")
    return Chip(region, chip.format, chip.data)


class Compositor:
    """Collects what comes of each camera's frames, whatever is lost, repeated or out of order."""

    def __init__(self) -> None:
        self._frames: OrderedDict[FrameKey, _Kept] = OrderedDict()  # the least recently touched first

    def take(self, image: ReceivedImage) -> Composite:
        """Add an image and show its frame. Raises DecodeError if its pictures cannot be decoded."""
        kept = self._frames.pop(image.key, None) or _Kept(image.frame_id)
        trial = _Kept(kept.frame_id, kept.base, dict(kept.chips))
        if image.base is not None:
            trial.base = image.base
        for chip in image.chips:
            trial.chips.pop(chip.region, None)
            trial.chips[chip.region] = chip
        while len(trial.chips) > MAX_CHIPS:
            trial.chips.pop(next(iter(trial.chips)))
        try:
            composite = self._compose(image.key, trial)
        except DecodeError:
            if kept.base is not None or kept.chips:
                self._frames[image.key] = kept
            raise
        self._frames[image.key] = trial
        self._forget()
        return composite

    def compose(self, key: FrameKey) -> Composite | None:
        """A frame as it is known now; None if nothing of it is kept."""
        kept = self._frames.get(key)
        return None if kept is None else self._compose(key, kept)

    def _compose(self, key: FrameKey, kept: _Kept) -> Composite:
        picture = None
        if kept.base is not None:
            base = decode_picture(kept.base, key.width_px * key.height_px)
            size = (key.width_px, key.height_px)
            picture = _in_colour(np.asarray(cv2.resize(base, size, interpolation=cv2.INTER_CUBIC), np.uint8))
        for chip in kept.chips.values():
            decoded = chip.decoded()
            if picture is not None:
                paste(picture, chip.region, decoded)
        pasted = tuple(kept.chips) if picture is not None else ()
        return Composite(key, kept.frame_id, picture, pasted, self._others(key))

    def _others(self, key: FrameKey) -> tuple[OtherChip, ...]:
        """The newest chip of each region among this camera's frames of other times."""
        newest: dict[Region, OtherChip] = {}
        for other, kept in self._frames.items():
            if other.source != key.source or other == key or other.look != key.look:
                continue
            for region, chip in kept.chips.items():
                if region not in newest or newest[region].frame_ns < other.frame_ns:
                    newest[region] = OtherChip(chip, other.frame_ns, other.frame_ns - key.frame_ns)
        return tuple(newest.values())

    def _forget(self) -> None:
        """Keep the limits of frames, cameras and bytes; what was touched last stays."""
        per_source: dict[str, int] = {}
        held_bytes = 0
        for key in reversed(list(self._frames)):
            per_source[key.source] = per_source.get(key.source, 0) + 1
            held_bytes += self._frames[key].held_bytes
            newest = held_bytes == self._frames[key].held_bytes
            if newest:
                continue
            if (
                per_source[key.source] > _MAX_FRAMES
                or len(per_source) > _MAX_SOURCES
                or held_bytes > _MAX_KEPT_BYTES
            ):
                held_bytes -= self._frames.pop(key).held_bytes


def paste(picture: Picture, region: Region, chip: Picture) -> None:
    """Put a chip's pixels where they were cut from, in place."""
    rows = slice(region.y_px, region.y_px + region.height_px)
    columns = slice(region.x_px, region.x_px + region.width_px)
    picture[rows, columns] = chip


def paste_marked(composite: Composite, other: OtherChip) -> Picture:
    """A copy of the composite with a chip of another time on it, framed and labelled with its offset.

    For an operator who wants to see it all the same. Raises ValueError if the frame has no picture or the
    chip does not lie within it.
    """
    picture, region = composite.picture, other.chip.region
    if picture is None or not region.within(picture.shape[1], picture.shape[0]):
        raise ValueError(f"a chip at {region} cannot be drawn on {composite.key}")
    marked = picture.copy()
    paste(marked, region, other.chip.decoded())
    right, bottom = region.x_px + region.width_px - 1, region.y_px + region.height_px - 1
    cv2.rectangle(marked, (region.x_px, region.y_px), (right, bottom), (0, 0, 255), 2)
    label = f"{other.later_by_ns / 1e9:+.1f} s"
    cv2.putText(
        marked, label, (region.x_px + 4, region.y_px + 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 255), 1
    )
    return marked


def _in_colour(picture: Picture) -> Picture:
    if picture.ndim == 3:
        return picture
    coloured: Picture = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
    return coloured
