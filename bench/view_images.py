"""Camera views for the table of view codecs: frames of a recording, where it is there, and synthetic ones."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from mcap.reader import make_reader
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from bench.view_rows import Row, coded, row
from perception_server.view_codec import encode_image, pack_jpeg, unpack_jpeg
from straitlink.synthetic.mission_log import synthesize
from straitlink.synthetic.settings import TEXTURES, SyntheticSettings

RECORDING = Path("../shared/data/logs/g1_teleop_ep001.mcap")
RECORDING_TOPIC = "/head_camera/image/compressed"
EVERY = 40  # frames: 4/3 s of the recording, 4 s of the synthetic mission
SYNTHETIC_S = 10.0
Picture = NDArray[np.uint8]


def image_rows() -> Iterator[Row]:
    """JPEG as OpenCV writes it and packed, the same pixels; WebP at JPEG's PSNR or better."""
    frames = list(_frames())
    for product, quality, view in (
        ("head camera 256x136 q50", 50, lambda frame: _shrunk(frame, 256, 136)),
        ("head camera 512x272 q50", 50, lambda frame: _shrunk(frame, 512, 272)),
        ("chip 200x200 q70", 70, _chip),
    ):
        views = [view(frame) for frame in frames]
        jpegs = [_jpeg(picture, quality) for picture in views]
        paper = [coded(jpeg, lambda jpeg: jpeg, lambda message: message) for jpeg in jpegs]
        yield row(product, "jpeg", paper, paper)
        for codec in ("huffman", "context"):
            done = [
                coded(jpeg, lambda jpeg, codec=codec: pack_jpeg(jpeg, codec=codec), unpack_jpeg)
                for jpeg in jpegs
            ]
            yield row(product, codec, done, paper)
        for form in ("webp",):
            alike = [_least_quality(picture, jpeg, form) for picture, jpeg in zip(views, jpegs, strict=True)]
            done = [
                coded(
                    picture,
                    lambda picture, wish=wish, form=form: encode_image(picture, form, wish),
                    unpack_jpeg,
                )
                for picture, wish in zip(views, alike, strict=True)
            ]
            yield row(product, f"{form} (PSNR)", done, paper)


def _least_quality(picture: Picture, jpeg: bytes, form: str) -> int:
    """The lowest quality at which a format is no farther from the picture than the JPEG is."""
    goal = cv2.PSNR(_pixels(jpeg), picture)
    low, high = 1, 100
    while low < high:
        quality = (low + high) // 2
        near = cv2.PSNR(_pixels(unpack_jpeg(encode_image(picture, form, quality))), picture) >= goal
        low, high = (low, quality) if near else (quality + 1, high)
    return low


def _frames() -> Iterator[Picture]:
    if RECORDING.exists():
        types = get_typestore(Stores.ROS2_HUMBLE)
        read = types.deserialize_cdr
        yield from _pictures(
            RECORDING, lambda data: bytes(read(data, "sensor_msgs/msg/CompressedImage").data), RECORDING_TOPIC
        )
    for texture in TEXTURES:
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder) / "mission.mcap"
            synthesize(log, SyntheticSettings(duration_s=SYNTHETIC_S, texture=texture))
            yield from _pictures(
                log, lambda data: CompressedImage.FromString(data).data, "robot/head_camera/image"
            )


def _pictures(log: Path, image_file: Callable[[bytes], bytes], topic: str) -> Iterator[Picture]:
    """Every EVERY-th picture of a topic."""
    with log.open("rb") as stream:
        messages = make_reader(stream).iter_messages()
        matching = (m.data for _, channel, m in messages if channel.topic.strip("/") == topic.strip("/"))
        for number, data in enumerate(matching):
            if number % EVERY == 0:
                yield _pixels(image_file(data))


def _shrunk(frame: Picture, width: int, height: int) -> Picture:
    return cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA)


def _chip(frame: Picture) -> Picture:
    top, left = (frame.shape[0] - 200) // 2, (frame.shape[1] - 200) // 2
    return np.ascontiguousarray(frame[top : top + 200, left : left + 200])


def _jpeg(picture: Picture, quality: int) -> bytes:
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def _pixels(file: bytes) -> Picture:
    return cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_COLOR)
