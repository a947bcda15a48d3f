"""``observation.state`` of a keyframed dataset: tool pose and gripper opening first, as the policy reads it."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int64

from dataset_tools.columns import Columns, Features, entry_names, vectors
from dataset_tools.signals import Trajectory
from lerobot_histmv import geometry, keys


def names(features: Features, columns: Columns) -> tuple[str, ...]:
    """Names of the state's entries if it has to be written anew; none where it stays as recorded.

    It stays where it already begins with ``keys.POSE_NAMES`` and the gripper counts from 0 to 1, and where no tool pose
    or no gripper is known.
    """
    if columns.is_joints or columns.rotation is None or columns.gripper is None:
        return ()
    recorded = _recorded(features)
    if recorded[: len(keys.POSE_NAMES)] == keys.POSE_NAMES and columns.opening_range == (0, 1):
        return ()
    return (*keys.POSE_NAMES, *(recorded[i] for i in _others(features, columns)))


def values(
    features: Features, columns: Columns, trajectory: Trajectory, rows: Mapping[str, Any]
) -> Float32[np.ndarray, "n s"]:
    """The entries that ``names`` tells, of the keyframed rows of an episode.

    Args:
        features: of the dense dataset.
        columns: which of them tell the pose and the gripper, which must be there.
        trajectory: the whole episode.
        rows: the columns of some of its frames (``build.rows``).

    Raises:
        ValueError: the measured opening lies outside of its range.
    """
    assert trajectory.quaternion is not None
    assert trajectory.gripper is not None
    frames = rows[keys.SOURCE_FRAME]
    parts = [trajectory.position[frames], trajectory.quaternion[frames]]
    parts.append(_opening(columns, trajectory.gripper, rows, frames)[:, None])
    if others := _others(features, columns):
        parts.append(np.asarray(rows[keys.STATE], np.float64)[:, others])
    return np.hstack(parts).astype(np.float32)


def _opening(
    columns: Columns, command: Float[np.ndarray, " t"], rows: Mapping[str, Any], frames: Int64[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """From 0, closed, to 1, open: as measured, else as commanded before the frame."""
    if columns.opening is None or columns.opening_range is None:
        return command[np.maximum(frames - 1, 0)]
    closed, opened = columns.opening_range
    measured = columns.opening.of({columns.opening.feature: rows[columns.opening.feature]})[:, 0]
    opening = (measured - closed) / (opened - closed)
    if (worst := geometry.odd_gripper(opening)) is not None:
        raise ValueError(
            f"episode {rows[keys.SOURCE_EPISODE][0]}, frame {frames[worst]}: {columns.opening} is {measured[worst]:g}, "
            f"but {closed:g} is closed and {opened:g} open; give --columns.opening_range=[closed,open]"
        )
    return opening


def _recorded(features: Features) -> tuple[str, ...]:
    """Names of the recorded state's entries, numbered where it has none; none without a state."""
    if keys.STATE not in vectors(features):
        return ()
    size = features[keys.STATE]["shape"][0]
    return entry_names(features[keys.STATE]) or tuple(f"state_{i}.pos" for i in range(size))


def _others(features: Features, columns: Columns) -> list[int]:
    """Entries of the recorded state that are neither pose nor gripper."""
    told = (columns.curve, columns.rotation, columns.gripper, columns.opening)
    used = {i for column in told if column and column.feature == keys.STATE for i in column.indices}
    return [i for i, name in enumerate(_recorded(features)) if i not in used and name not in keys.POSE_NAMES]
