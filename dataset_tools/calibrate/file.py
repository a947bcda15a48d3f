"""Camera calibrations written by hand: a YAML file with an entry per camera, checked entry by entry.

    front:
      {fx: 612.3, fy: 611.9, cx: 319.6, cy: 240.2}       # pixels; the first pixel's centre is at 0, as in OpenCV
      T_world_cam: [[0, 0, 1, 0.4], [-1, 0, 0, 0], [0, -1, 0, 0.5]]
    wrist:
      ...
      mounted_on: tool
      T_tool_cam: {position: [0, 0.05, 0.02], quaternion_xyzw: [0, 0, 0, 1]}

Camera axes are x right, y down, z ahead.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float

from dataset_tools.calibrate.checks import pinhole, rigid
from lerobot_histmv import keys
from lerobot_histmv.geometry import matrix_from_quaternion, unit_quaternion

TOOL = "tool"
_FIXED_POSE, _MOUNTED, _TOOL_POSE = "T_world_cam", "mounted_on", "T_tool_cam"
_QUATERNIONS = {"quaternion_wxyz": [0, 1, 2, 3], "quaternion_xyzw": [3, 0, 1, 2]}
Sizes = Mapping[str, tuple[int, int]]
"""Height and width of the images, by camera."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """One camera.

    Attributes:
        intrinsics: fx, fy, cx, cy [pixels].
        pose: ``T_world_cam``, or ``T_tool_cam`` of a camera that moves with the tool.
        on_tool: which of the two.
    """

    intrinsics: Float[np.ndarray, " 4"]
    pose: Float[np.ndarray, "3 4"]
    on_tool: bool

    def extrinsics(self, world_from_tool: Float[np.ndarray, "n 3 4"] | None, frames: int) -> Float[np.ndarray, "n 12"]:
        """Rows of ``T_world_cam`` at every frame; a camera on the tool needs the tool's poses."""
        if not self.on_tool:
            return np.tile(self.pose.ravel(), (frames, 1))
        assert world_from_tool is not None
        rotation = world_from_tool[..., :3]
        position = world_from_tool[..., 3:] + rotation @ self.pose[:, 3:]
        return np.concatenate([rotation @ self.pose[:, :3], position], axis=-1).reshape(-1, 12)


def read_calibrations(path: Path, sizes: Sizes) -> dict[str, Calibration]:
    """Calibrations by camera, in the order of the file.

    Args:
        path: YAML file.
        sizes: the dataset's cameras.

    Raises:
        ValueError: the file is no such YAML, names a camera that does not exist, or an entry is not as it must be.
    """
    try:
        found = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no YAML: {error}") from error
    if not isinstance(found, dict) or not found:
        raise ValueError(f"{path} must have an entry per camera; cameras are {', '.join(sizes)}")
    unknown = [str(camera) for camera in found if camera not in sizes]
    if unknown:
        raise ValueError(
            f"{path}: {', '.join(unknown)} are no cameras with colour and depth; those are {', '.join(sizes) or 'none'}"
        )
    return {camera: _calibration(entry, sizes[camera], f"{path}: {camera}") for camera, entry in found.items()}


def _calibration(entry: Any, size: tuple[int, int], what: str) -> Calibration:
    if not isinstance(entry, dict):
        raise ValueError(f"{what} must have {', '.join(keys.INTRINSICS_FIELDS)} and {_FIXED_POSE} or {_TOOL_POSE}")
    on_tool = _MOUNTED in entry
    if on_tool and entry[_MOUNTED] != TOOL:
        raise ValueError(f"{what}: {_MOUNTED} is {entry[_MOUNTED]!r}; it must be {TOOL!r}, or be left out")
    pose_name = _TOOL_POSE if on_tool else _FIXED_POSE
    wanted = {*keys.INTRINSICS_FIELDS, pose_name} | ({_MOUNTED} if on_tool else set())
    if entry.keys() != wanted:
        missing, surplus = wanted - entry.keys(), set(map(str, entry.keys() - wanted))
        raise ValueError(f"{what}: missing are {sorted(missing)}, not understood {sorted(surplus)}")
    intrinsics = _numbers([entry[name] for name in keys.INTRINSICS_FIELDS], 4, what)
    return Calibration(pinhole(intrinsics, size, what), _pose(entry[pose_name], f"{what}: {pose_name}"), on_tool)


def _pose(value: Any, what: str) -> Float[np.ndarray, "3 4"]:
    """A matrix as rows, or a position and a quaternion whose name tells its order."""
    if isinstance(value, dict):
        order = next((name for name in _QUATERNIONS if name in value), "")
        if value.keys() != {"position", order}:
            raise ValueError(
                f"{what} must have position and quaternion_wxyz or quaternion_xyzw; it has {sorted(value)}"
            )
        quaternion = _numbers(value[order], 4, f"{what}: {order}")[_QUATERNIONS[order]]
        rotation = matrix_from_quaternion(unit_quaternion(quaternion, f"{what}: {order}, in the order w, x, y, z,"))
        return np.hstack([rotation, _numbers(value["position"], 3, f"{what}: position")[:, None]])
    if not isinstance(value, list) or len(value) not in (3, 4):
        raise ValueError(f"{what} must be a list of 3 or 4 rows of 4 numbers, or have position and quaternion_wxyz")
    return rigid(np.stack([_numbers(row, 4, what) for row in value]), what)


def _numbers(values: Any, count: int, what: str) -> Float[np.ndarray, " n"]:
    """Numbers of a list; YAML takes 1e-3 (without a point) for text."""
    if not isinstance(values, list) or len(values) != count:
        raise ValueError(f"{what} must be {count} numbers; it is {str(values)[:80]}")
    try:
        found = np.array([float(value) for value in values])
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what}: {str(values)[:80]} are no numbers") from error
    if not np.isfinite(found).all():
        raise ValueError(f"{what}: {found.tolist()} must be finite")
    return found
