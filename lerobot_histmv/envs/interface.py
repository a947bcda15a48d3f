"""What goes into the environment and what comes out: options, spaces, and the checks on actions."""

from collections.abc import Sequence
from numbers import Integral

import numpy as np
from gymnasium import spaces

from lerobot_histmv import geometry, keys
from lerobot_histmv.envs.tasks import suites
from lerobot_histmv.envs.tasks.base import SPLITS
from lerobot_histmv.motion import Pose

CAMERA_NAMES = ("front", "left_shoulder", "wrist")
CONTROLS = ("macro", "servo")
RENDER_MODES = ("rgb_array",)
IMAGE_SIZES = (8, 1024)
"""Least and largest image side [pixels]."""
REACH_LOW = np.array([0.15, -0.45, 0.01])
REACH_HIGH = np.array([0.75, 0.45, 0.60])
"""Commanded positions [m] are clipped to this box."""
ACTION_SIZE = len(keys.POSE_NAMES)
STATE_SIZE = ACTION_SIZE + 6
MAX_JOINT = 6.4
"""Bound of the measured joint angles [rad], a little beyond the mechanical limit."""


def check_options(
    task: str,
    cameras: Sequence[str] = CAMERA_NAMES,
    image_size: int = 128,
    control: str = "macro",
    variation: int | None = None,
    instruction_split: str = "train",
    render_mode: str = "rgb_array",
    render_size: int = 256,
) -> None:
    """Raise ValueError for an option of ``UR5Env`` that is not accepted, saying what would be."""
    fixed_variation(task, variation)
    for name, value, accepted in (
        ("control", control, CONTROLS),
        ("instruction_split", instruction_split, SPLITS),
        ("render_mode", render_mode, RENDER_MODES),
    ):
        if value not in accepted:
            raise ValueError(f"{name} is {value!r}; accepted are {', '.join(accepted)}")
    if not cameras or list(cameras) != [camera for camera in CAMERA_NAMES if camera in cameras]:
        raise ValueError(
            f"cameras are {list(cameras)}; they must be different names out of {', '.join(CAMERA_NAMES)}, "
            "in this order: calibration is a plain vector, and another order would give every view another's camera"
        )
    low, high = IMAGE_SIZES
    for name, size in (("image_size", image_size), ("render_size", render_size)):
        if not (isinstance(size, Integral) and low <= size <= high):
            raise ValueError(f"{name} is {size!r}; it must be a whole number between {low} and {high} pixels")


def fixed_variation(task: str, variation: int | None) -> int | None:
    """The one variation that ``task`` ("turn_tap.left") or ``variation`` names; None if both leave it open.

    Raises:
        ValueError: no such task or variation, or two different ones.
    """
    found, named = suites.find(task)
    if variation is None:
        return named
    count = len(found.variations)
    if not (isinstance(variation, Integral) and 0 <= variation < count):
        names = ", ".join(suites.variation_names(found.name))
        raise ValueError(f"variation {variation!r} of {task} does not exist; there are 0 to {count - 1} ({names})")
    if named not in (None, variation):
        raise ValueError(f"task {task} is variation {named}, but variation is {variation}; give one of the two")
    return int(variation)


def action_space() -> spaces.Box:
    """Bounds of an action: the reachable box, quaternion components, gripper."""
    low, high = (*REACH_LOW, -1, -1, -1, -1, 0), (*REACH_HIGH, 1, 1, 1, 1, 1)
    return spaces.Box(np.array(low, np.float32), np.array(high, np.float32))


def observation_space(cameras: Sequence[str], size: int) -> spaces.Dict:
    """Shapes, types and bounds of an observation; see ``UR5Env``."""
    pixels = spaces.Dict({camera: spaces.Box(0, 255, (size, size, 3), np.uint8) for camera in cameras})
    depths = {f"{camera}{keys.DEPTH_SUFFIX}": spaces.Box(0, 65535, (size, size, 1), np.uint16) for camera in cameras}
    calibration = {
        "camera_intrinsics": spaces.Box(0, 1e4, (len(keys.intrinsics_names(cameras)),), np.float32),
        "camera_extrinsics": spaces.Box(-5, 5, (len(keys.extrinsics_names(cameras)),), np.float32),
    }
    state = np.array([*[2] * 3, *[1] * 5, *[MAX_JOINT] * 6], np.float32)
    return spaces.Dict({"pixels": pixels, "agent_pos": spaces.Box(-state, state), **depths, **calibration})


def parse_action(action: np.ndarray) -> tuple[Pose, float]:
    """Tool pose, clipped to the reachable box, and gripper command (0 or 1) of an action.

    Raises:
        ValueError: wrong shape, a number that is not finite, or a quaternion of length zero.
    """
    values = np.asarray(action, dtype=np.float64)
    if values.shape != (ACTION_SIZE,):
        raise ValueError(f"action has shape {values.shape}; it must be ({ACTION_SIZE},): {', '.join(keys.POSE_NAMES)}")
    if not np.isfinite(values).all():
        raise ValueError(f"action {values.tolist()} is not finite ({', '.join(keys.POSE_NAMES)})")
    norm = np.linalg.norm(values[3:7])
    if norm < 1e-6:
        raise ValueError(f"action's quaternion {values[3:7].tolist()} has length 0; it must be a rotation (w, x, y, z)")
    position = np.clip(values[:3], REACH_LOW, REACH_HIGH)
    return Pose(position, geometry.canonical(values[3:7] / norm)), float(values[7] > 0.5)
