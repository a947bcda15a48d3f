"""The cameras of a dataset in a Markdown table, for cards."""

from typing import Any

import numpy as np

from lerobot_histmv import keys

STANDING = 1e-6
"""A camera whose pose changes less [m, or entries of the rotation] is a fixed one."""


def calibration_table(meta: Any) -> str:
    """Size, mean intrinsics and, of fixed cameras, the position.

    Args:
        meta: LeRobot's metadata of a dataset with calibration.
    """
    cameras = keys.cameras_of(meta.features[keys.INTRINSICS]["names"])
    mean = np.asarray(meta.stats[keys.INTRINSICS]["mean"]).reshape(len(cameras), 4)
    low, high = (np.asarray(meta.stats[keys.EXTRINSICS][end]).reshape(len(cameras), 3, 4) for end in ("min", "max"))
    lines = ["| camera | size | fx, fy, cx, cy [pixels] | position [m] |", "|---|---|---|---|"]
    for camera, values, first, last in zip(cameras, mean, low, high, strict=True):
        fixed = np.abs(last - first).max() < STANDING
        where = ", ".join(f"{value:.3f}" for value in first[:, 3]) if fixed else "moves"
        size = meta.features.get(keys.rgb_key(camera), {}).get("shape", ("?", "?"))
        lines.append(f"| {camera} | {size[1]} x {size[0]} | {', '.join(f'{v:.2f}' for v in values)} | {where} |")
    return "\n".join(lines)
