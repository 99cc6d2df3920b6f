"""A pose in 20 bytes of a view's header, and the matrix that both ends take from those bytes."""

from __future__ import annotations

import numpy as np

from messages.proto.straitlink.view_pb2 import CompactPose
from perception_server.frames import FloatArray, matrices

_UM_PER_M = 1e6
_MILLIONTHS = 1e6
MAX_UM = 1 << 52  # exact in float64: 4.5 million kilometres


def compact_pose(matrix: FloatArray) -> CompactPose:
    """Round (4, 4) to whole micrometres and millionths of a quaternion."""
    x, y, z = (round(value * _UM_PER_M) for value in matrix[:3, 3].tolist())
    qx, qy, qz, qw = quaternion(matrix[:3, :3])
    sign = -1 if qw < 0 else 1
    turn = [round(sign * q * _MILLIONTHS) for q in (qx, qy, qz)]
    return CompactPose(
        x_um=x, y_um=y, z_um=z, qx_millionths=turn[0], qy_millionths=turn[1], qz_millionths=turn[2]
    )


def pose_matrix(pose: CompactPose) -> FloatArray:
    """(4, 4). Raises ValueError for a pose that no encoder writes."""
    translation = (pose.x_um, pose.y_um, pose.z_um)
    if max(map(abs, translation)) > MAX_UM:
        raise ValueError(f"a position of {translation} um is above {MAX_UM} um")
    turn = np.array([pose.qx_millionths, pose.qy_millionths, pose.qz_millionths]) / _MILLIONTHS
    rest = 1.0 - float(turn @ turn)
    if rest < -1e-5:
        raise ValueError(f"a quaternion with {turn.tolist()} is longer than 1")
    row = np.array([*(value / _UM_PER_M for value in translation), *turn, np.sqrt(max(rest, 0.0))])
    row[3:] /= np.linalg.norm(row[3:])
    matrix: FloatArray = matrices(row)
    return matrix


def quaternion(rotation: FloatArray) -> tuple[float, float, float, float]:
    """x, y, z, w of (3, 3), by the largest of four divisors (Shepperd 1978)."""
    r = rotation
    diagonal = np.array([r[0, 0], r[1, 1], r[2, 2]])
    trace = float(diagonal.sum())
    squares = [1 + 2 * float(d) - trace for d in diagonal] + [1 + trace]
    best = int(np.argmax(squares))
    row = np.empty(4)
    if best == 3:
        row[:] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], squares[3]
    else:
        i, j, k = best, (best + 1) % 3, (best + 2) % 3
        row[i], row[j], row[k] = squares[i], r[j, i] + r[i, j], r[k, i] + r[i, k]
        row[3] = r[k, j] - r[j, k]
    x, y, z, w = (row / np.linalg.norm(row)).tolist()
    return x, y, z, w
