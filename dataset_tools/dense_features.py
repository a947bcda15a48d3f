"""The columns of the dense episode dataset, and how one observation of the environment fills them.

A frame is one tick of the control loop: what was seen before the tick, and what was commanded for the end of it.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lerobot_histmv import keys

ROBOT_TYPE = "ur5e"


def dense_features(cameras: Sequence[str], image_size: int) -> dict[str, dict[str, Any]]:
    """LeRobot feature dictionary of a dense dataset, in column order.

    Args:
        cameras: names, in the order of the calibration vectors.
        image_size: side of the square images [pixels].

    Returns:
        Per camera an RGB and a depth image (uint16 mm, 0 = invalid), then state (14), intrinsics (4 per camera: fx fy
        cx cy), extrinsics (12 per camera: rows of the 3x4 ``T_world_cam``) and action (8), all float32.
    """
    return arm_features(dict.fromkeys(cameras, (image_size, image_size)), keys.JOINT_NAMES)


def arm_features(sizes: Mapping[str, tuple[int, int]], joint_names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """The same for any arm and any cameras.

    Args:
        sizes: height and width [pixels] of each camera's images, in the order of the calibration vectors.
        joint_names: what follows the measured pose in the state.
    """
    cameras = list(sizes)
    features: dict[str, dict[str, Any]] = {}
    for camera, size in sizes.items():
        features[keys.rgb_key(camera)] = _image(size, channels=3)
    for camera, size in sizes.items():
        info = {"is_depth_map": True, "depth_unit": "mm"}
        features[keys.depth_key(camera)] = {**_image(size, channels=1), "info": info}
    features[keys.STATE] = _vector((*keys.POSE_NAMES, *joint_names))
    features |= calibration_features(cameras)
    features[keys.ACTION] = _vector(keys.POSE_NAMES)
    return features


def calibration_features(cameras: Sequence[str]) -> dict[str, dict[str, Any]]:
    """LeRobot features of the two calibration vectors."""
    return {
        keys.INTRINSICS: _vector(keys.intrinsics_names(cameras)),
        keys.EXTRINSICS: _vector(keys.extrinsics_names(cameras)),
    }


def frame_columns(observation: Mapping[str, Any], cameras: Sequence[str]) -> dict[str, np.ndarray]:
    """One environment observation under the dataset's column names (``action`` is not part of it)."""
    columns = {keys.rgb_key(camera): observation["pixels"][camera] for camera in cameras}
    columns |= {keys.depth_key(camera): observation[f"{camera}{keys.DEPTH_SUFFIX}"] for camera in cameras}
    columns[keys.STATE] = observation["agent_pos"]
    columns[keys.INTRINSICS] = observation["camera_intrinsics"]
    columns[keys.EXTRINSICS] = observation["camera_extrinsics"]
    return columns


def _image(size: tuple[int, int], channels: int) -> dict[str, Any]:
    return {"dtype": "image", "shape": (*size, channels), "names": ["height", "width", "channels"]}


def _vector(names: Sequence[str]) -> dict[str, Any]:
    return {"dtype": "float32", "shape": (len(names),), "names": list(names)}
