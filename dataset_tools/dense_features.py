"""The columns of the dense episode dataset, and how one observation of the environment fills them.

A frame is one tick of the control loop: what was seen before the tick, and what was commanded for the end of it.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lerobot_histmv import keys

ROBOT_TYPE = "ur5e"
JOINT_NAMES = tuple(
    f"{joint}.pos" for joint in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
)
"""The six joint angles [rad] that follow the measured pose in ``observation.state``."""

STATE_NAMES = (*keys.POSE_NAMES, *JOINT_NAMES)


def dense_features(cameras: Sequence[str], image_size: int) -> dict[str, dict[str, Any]]:
    """LeRobot feature dictionary of a dense dataset, in column order.

    Args:
        cameras: names, in the order of the calibration vectors.
        image_size: side of the square images [pixels].

    Returns:
        Per camera an RGB and a depth image (uint16 mm, 0 = invalid), then state (14), intrinsics (4 per camera: fx fy
        cx cy), extrinsics (12 per camera: rows of the 3x4 ``T_world_cam``) and action (8), all float32.
    """
    features: dict[str, dict[str, Any]] = {}
    for camera in cameras:
        features[keys.rgb_key(camera)] = _image(image_size, channels=3)
    for camera in cameras:
        info = {"is_depth_map": True, "depth_unit": "mm"}
        features[keys.depth_key(camera)] = {**_image(image_size, channels=1), "info": info}
    features[keys.STATE] = _vector(STATE_NAMES)
    features[keys.INTRINSICS] = _vector(keys.intrinsics_names(cameras))
    features[keys.EXTRINSICS] = _vector(keys.extrinsics_names(cameras))
    features[keys.ACTION] = _vector(keys.POSE_NAMES)
    return features


def frame_columns(observation: Mapping[str, Any], cameras: Sequence[str]) -> dict[str, np.ndarray]:
    """One environment observation under the dataset's column names (``action`` is not part of it)."""
    columns = {keys.rgb_key(camera): observation["pixels"][camera] for camera in cameras}
    columns |= {keys.depth_key(camera): observation[f"{camera}{keys.DEPTH_SUFFIX}"] for camera in cameras}
    columns[keys.STATE] = observation["agent_pos"]
    columns[keys.INTRINSICS] = observation["camera_intrinsics"]
    columns[keys.EXTRINSICS] = observation["camera_extrinsics"]
    return columns


def _image(image_size: int, channels: int) -> dict[str, Any]:
    return {"dtype": "image", "shape": (image_size, image_size, channels), "names": ["height", "width", "channels"]}


def _vector(names: Sequence[str]) -> dict[str, Any]:
    return {"dtype": "float32", "shape": (len(names),), "names": list(names)}
