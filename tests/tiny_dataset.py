"""Keyframed datasets on disk, as LeRobot writes them, for the tiny policy: see ``tiny_policy`` for its episodes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset
from tiny_policy import CAMERAS, STATE_SIZE, TASK, episode
from tiny_scene import SIZE

from lerobot_histmv import keys


def features() -> dict[str, dict[str, Any]]:
    """A keyframed dataset's features for two cameras."""
    state = [*keys.POSE_NAMES, *(f"joint_{i}.pos" for i in range(STATE_SIZE - len(keys.POSE_NAMES)))]
    named = {
        keys.STATE: state,
        keys.ACTION: list(keys.POSE_NAMES),
        keys.INTRINSICS: keys.intrinsics_names(CAMERAS),
        keys.EXTRINSICS: keys.extrinsics_names(CAMERAS),
    }
    found: dict[str, dict[str, Any]] = {
        key: {"dtype": "float32", "shape": (len(names),), "names": names} for key, names in named.items()
    }
    axes = ["height", "width", "channels"]
    for camera in CAMERAS:
        found[keys.rgb_key(camera)] = {"dtype": "image", "shape": (*SIZE, 3), "names": axes}
        depth = {"dtype": "image", "shape": (*SIZE, 1), "names": axes, "info": {"is_depth_map": True}}
        found[keys.depth_key(camera)] = depth
    return found | {keys.SOURCE_FRAME: {"dtype": "int64", "shape": (1,), "names": None}}


def frame(rows: dict[str, torch.Tensor], step: int, task: str = TASK) -> dict[str, Any]:
    """One row as LeRobot's writer wants it: channels last, depth in whole millimetres."""
    values = {key: rows[key][step].numpy() for key in features() if key in rows}
    for camera in CAMERAS:
        for key, dtype, factor in ((keys.rgb_key(camera), np.uint8, 255), (keys.depth_key(camera), np.uint16, 1)):
            values[key] = (factor * values[key]).round().astype(dtype).transpose(1, 2, 0)
    return values | {keys.SOURCE_FRAME: np.array([step]), "task": task}


def write_dataset(root: Path, repo_id: str, lengths: Sequence[int], task: str = TASK) -> Path:
    """A dataset with an episode of each length; episode i holds ``tiny_policy.episode(length, seed=i)``."""
    dataset = LeRobotDataset.create(repo_id, fps=1, features=features(), root=root, use_videos=False)
    for number, length in enumerate(lengths):
        rows = episode(length, seed=number)
        for step in range(length):
            dataset.add_frame(frame(rows, step, task))
        dataset.save_episode()
    dataset.finalize()
    return root
