"""Small keyframed datasets that the tiny network can be trained on with ``lerobot-train``."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import draccus
import numpy as np
from helpers.episodes import JOINTS, image_feature, vector_feature, write
from tiny_policy import CAMERAS
from tiny_scene import SEEN, cameras_around, tiny_network

from lerobot_histmv import keys

SIZE = 32
"""Rows and columns of every image."""


def keyframed(root: Path, lengths: Sequence[int] = (2, 2)) -> Path:
    """One episode per length, noise in every image."""
    features: dict[str, Any] = {
        keys.STATE: vector_feature((*keys.POSE_NAMES, *JOINTS)),
        keys.ACTION: vector_feature(keys.POSE_NAMES),
        keys.INTRINSICS: vector_feature(keys.intrinsics_names(CAMERAS)),
        keys.EXTRINSICS: vector_feature(keys.extrinsics_names(CAMERAS)),
    }
    for camera in CAMERAS:
        features[keys.rgb_key(camera)] = image_feature(3, size=(SIZE, SIZE))
        depth = {**image_feature(1, size=(SIZE, SIZE)), "info": {"is_depth_map": True}}
        features[keys.depth_key(camera)] = depth
    chance = np.random.default_rng(0)
    return write(root, [[_frame(chance) for _ in range(length)] for length in lengths], features)


def _frame(chance: np.random.Generator) -> dict[str, Any]:
    intrinsics, extrinsics = (values.numpy().ravel() for values in cameras_around(len(CAMERAS)))
    pose = np.float32([*SEEN + chance.uniform(-0.1, 0.1, 3).astype(np.float32), 1, 0, 0, 0, chance.integers(2)])
    frame: dict[str, Any] = {keys.STATE: np.append(pose, np.zeros(6, np.float32)), keys.ACTION: pose}
    frame |= {keys.INTRINSICS: intrinsics, keys.EXTRINSICS: extrinsics}
    for camera in CAMERAS:
        frame[keys.rgb_key(camera)] = chance.integers(256, size=(SIZE, SIZE, 3), dtype=np.uint8)
        frame[keys.depth_key(camera)] = chance.integers(300, 700, size=(SIZE, SIZE, 1), dtype=np.uint16)
    return frame


def training(repo: str, **changes: Any) -> dict[str, Any]:
    """What a training preset of the tiny network says; ``changes`` replace or add entries."""
    return {
        "policy": {"type": "histmv", "device": "cpu", "network": draccus.encode(tiny_network())},
        "dataset": {"repo_id": repo, "depth_output_unit": "mm", "use_imagenet_stats": False},
        "num_workers": 0,
        "env_eval_freq": 0,
        "log_freq": 1,
    } | changes
