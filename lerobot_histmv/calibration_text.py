"""The cameras of a dataset in a Markdown table, for cards."""

from typing import Any

import numpy as np
from jaxtyping import Float

from lerobot_histmv import keys

STANDING = 1e-6
"""A camera whose pose changes less [m, or entries of the rotation] is a fixed one."""
MOVING = f"moves with the tool: `{keys.EXTRINSICS}` tells the pose in every frame"


def calibration_table(meta: Any) -> str:
    """Size, mean intrinsics and, of fixed cameras, ``T_world_cam`` as ``histmv calibrate-attach`` takes it.

    Args:
        meta: LeRobot's metadata of a dataset with calibration.
    """
    cameras = keys.cameras_of(meta.features[keys.INTRINSICS]["names"])
    mean = np.asarray(meta.stats[keys.INTRINSICS]["mean"]).reshape(len(cameras), 4)
    low, high = (np.asarray(meta.stats[keys.EXTRINSICS][end]).reshape(len(cameras), 3, 4) for end in ("min", "max"))
    lines = ["| camera | size | fx, fy, cx, cy [pixels] | rows of T_world_cam [m] |", "|---|---|---|---|"]
    for camera, values, first, last in zip(cameras, mean, low, high, strict=True):
        fixed = np.abs(last - first).max() < STANDING
        where = _rows(first) if fixed else MOVING
        size = meta.features.get(keys.rgb_key(camera), {}).get("shape", ("?", "?"))
        lines.append(f"| {camera} | {size[1]} x {size[0]} | {', '.join(f'{v:.2f}' for v in values)} | {where} |")
    return "\n".join(lines)


def _rows(matrix: Float[np.ndarray, "3 4"]) -> str:
    exact = matrix.round(5) + 0.0  # no minus zero
    return "[" + ", ".join("[" + ", ".join(f"{value:.5f}" for value in row) + "]" for row in exact) + "]"
