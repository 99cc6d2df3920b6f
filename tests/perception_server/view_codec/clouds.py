"""Clouds as sensors give them, made from a seed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def room_cloud(points: int = 3000, seed: int = 0) -> NDArray[np.float32]:
    """Points on the floor and two walls of a room, with 5 mm of noise; (points, 3) metres."""
    random = np.random.default_rng(seed)
    on = random.uniform(-2, 2, (points, 3))
    surface = random.integers(0, 3, points)
    on[np.arange(points), surface] = np.array([-2.0, 1.5, -1.0])[surface]
    return (on + random.normal(0, 0.005, (points, 3))).astype(np.float32)
