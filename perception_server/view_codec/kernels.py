"""The compiled kernels of all codecs, made ready before the first view."""

from __future__ import annotations

import numpy as np

from . import map_codec
from .cloud import decode_cloud, encode_cloud
from .image import encode_image
from .jpeg import unpack_jpeg


def warm_up() -> None:
    """Load or compile every kernel, so that the first view does not wait, and check what the maps' write.

    The first time takes some twenty seconds, later ones about two; to be called once by a server or a
    console as it starts. Raises RuntimeError as `map_codec.warm_up` does.
    """
    map_codec.warm_up()
    decode_cloud(encode_cloud(np.arange(30.0).reshape(10, 3), bits=4))
    unpack_jpeg(encode_image(np.arange(768, dtype=np.uint16).astype(np.uint8).reshape(16, 16, 3)))
