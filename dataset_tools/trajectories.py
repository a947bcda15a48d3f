"""Tool motion and action labels out of an episode's columns: one quaternion order, one meaning of the gripper."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial.transform import Rotation

from dataset_tools.columns import Column, Columns
from dataset_tools.signals import Keyframe, Trajectory
from lerobot_histmv import keys
from lerobot_histmv.geometry import UNIT_TOLERANCE, canonical

Vectors = Mapping[str, np.ndarray]
"""An episode's numeric columns, (frames, size) each."""
GripperEnds = tuple[float, float]
"""Column values that mean closed and open."""

_HYSTERESIS = 0.1
"""The command changes where the opening passes 0.5 by this much."""
_OUTSIDE = 0.1
"""Share of the gripper's range by which a value may lie outside it."""


def trajectory_of(vectors: Vectors, columns: Columns, ends: GripperEnds, fps: float, episode: int) -> Trajectory:
    """Tool motion of one episode.

    Raises:
        ValueError: a quaternion that is not unit, or a gripper outside its range; the message names episode and frame.
    """
    gripper = None
    if columns.gripper:
        values = columns.gripper.of(vectors)[:, 0]
        _check_range(values, columns, episode)
        gripper = command(values, ends)
    commanded_position = commanded_quaternion = None
    if columns.commanded:
        position, rotation = columns.commanded
        commanded_position = _one_later(position.of(vectors))
        commanded_quaternion = _one_later(_quaternion(rotation, "wxyz", vectors, episode))
    return Trajectory(
        position=columns.curve.of(vectors),
        fps=fps,
        quaternion=_quaternion(columns.rotation, columns.rotation_format, vectors, episode)
        if columns.rotation
        else None,
        gripper=gripper,
        commanded_position=commanded_position,
        commanded_quaternion=commanded_quaternion,
    )


def _check_range(values: Float[np.ndarray, " n"], columns: Columns, episode: int) -> None:
    """ValueError, naming episode and frame, if the gripper leaves the range of ``columns``."""
    if columns.gripper_range is None:
        return
    low, high = sorted(columns.gripper_range)
    slack = _OUTSIDE * (high - low)
    outside = np.flatnonzero((values < low - slack) | (values > high + slack))
    if len(outside):
        raise ValueError(
            f"episode {episode}, frame {outside[0]}: {columns.gripper} is {values[outside[0]]:g}, outside {low:g} "
            f"to {high:g}; give --columns.gripper_range=[closed,open]"
        )


def command(values: Float[np.ndarray, " n"], ends: GripperEnds) -> Float[np.ndarray, " n"]:
    """Gripper as 1 open or 0 closed; small changes about the middle do not count."""
    opening = (values - ends[0]) / (ends[1] - ends[0])
    clear = np.abs(opening - 0.5) >= _HYSTERESIS
    clear[0] = True
    latest = np.maximum.accumulate(np.where(clear, np.arange(len(values)), 0))
    return (opening[latest] > 0.5).astype(np.float64)


def label_names(columns: Columns) -> list[str]:
    """Names of the entries of a keyframe's label: our pose names as far as recorded, or those of the joints."""
    names = list(columns.curve.names) if columns.is_joints else list(keys.POSITION_NAMES)
    if columns.is_joints and not names:
        names = [f"joint_{index}.pos" for index in columns.curve.indices]
    names += keys.QUATERNION_NAMES if columns.rotation else ()
    return [*names, keys.GRIPPER_NAME] if columns.gripper else names


def labels(trajectory: Trajectory, keyframes: Sequence[Keyframe]) -> Float32[np.ndarray, "k a"]:
    """Pose at each pose frame, and the gripper command in force from then on.

    The pose is the measured one; where the arm rests, the commanded one if there is one.
    """
    frames = [keyframe.pose_frame for keyframe in keyframes]
    rests = np.array([keyframe.rests for keyframe in keyframes])[:, None]
    parts = [trajectory.position[frames]]
    if trajectory.quaternion is not None:
        parts.append(trajectory.quaternion[frames])
    if trajectory.commanded_position is not None and trajectory.commanded_quaternion is not None:
        told = (trajectory.commanded_position[frames], trajectory.commanded_quaternion[frames])
        parts = [np.where(rests, commanded, measured) for commanded, measured in zip(told, parts, strict=True)]
    if trajectory.gripper is not None:
        parts.append(trajectory.gripper[frames, None])
    return np.hstack(parts).astype(np.float32)


def _one_later(values: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    """What was commanded for each frame: an action leads to the frame after it."""
    return np.concatenate([values[:1], values[:-1]])


def _quaternion(column: Column, rotation_format: str, vectors: Vectors, episode: int) -> Float[np.ndarray, "n 4"]:
    """Canonical unit quaternions w, x, y, z."""
    values = column.of(vectors)
    quaternions = wxyz(values, rotation_format)
    norms = np.linalg.norm(quaternions, axis=-1)
    bad = np.flatnonzero(np.abs(norms - 1) >= UNIT_TOLERANCE)
    if len(bad):
        raise ValueError(
            f"episode {episode}, frame {bad[0]}: {column} is {values[bad[0]].tolist()}, a quaternion of norm "
            f"{norms[bad[0]]:.3g}; its norm must be 1"
        )
    return canonical(quaternions / norms[:, None])


def wxyz(values: Float[np.ndarray, "n d"], rotation_format: str) -> Float[np.ndarray, "n 4"]:
    """Rotations of one of ``columns.ROTATION_FORMATS`` as w, x, y, z, norm and sign of quaternions as stored."""
    if rotation_format in ("rotvec", "rpy"):
        turn = Rotation.from_rotvec(values) if rotation_format == "rotvec" else Rotation.from_euler("xyz", values)
        return turn.as_quat(scalar_first=True)
    return values if rotation_format == "wxyz" else values[:, [3, 0, 1, 2]]
