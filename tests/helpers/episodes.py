"""Small synthetic LeRobot datasets: an arm that approaches, closes the gripper, lifts over a bend and stops."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets import LeRobotDataset

from lerobot_histmv import keys

FPS = 20
HEIGHT, WIDTH = 17, 19
CAMERAS = ("front", "wrist")
JOINTS = tuple(f"{joint}.pos" for joint in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"))
CLOSED_AT, REST = 20, 8
"""Frame at which the synthetic pick commands the gripper to close, and how many frames the arm then rests."""


def pick(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Positions (n, 3) [m], quaternions (n, 4) and gripper command (n,) of a pick: straight down, close, bend up.

    The arm reaches the object at frame ``CLOSED_AT``, rests ``REST`` frames, and never rests elsewhere.
    """
    start, grasp = np.array([0.4, 0.0, 0.3]), np.array([0.5, 0.1, 0.02]) + rng.uniform(-0.02, 0.02, 3)
    corner, end = grasp + [0, 0, 0.2], grasp + [0.15, -0.1, 0.25]
    legs = [straight(start, grasp, CLOSED_AT + 1), np.tile(grasp, (REST, 1))]
    legs += [straight(grasp, corner, 12)[1:], straight(corner, end, 12)[1:]]
    position = np.concatenate(legs)
    travelled = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(position, axis=0), axis=-1))])
    angle = 0.5 * travelled / travelled[-1]
    quaternion = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], axis=-1)
    gripper = (np.arange(len(position)) < CLOSED_AT).astype(np.float64)
    return {"position": position, "quaternion": quaternion, "gripper": gripper}


def straight(start: np.ndarray, end: np.ndarray, frames: int) -> np.ndarray:
    """Constant speed from ``start`` to ``end``, both included, in ``frames`` points."""
    return start + np.linspace(0, 1, frames)[:, None] * (end - start)


def dense_frames(motion: dict[str, np.ndarray], rng: np.random.Generator) -> list[dict[str, Any]]:
    """Frames of our own dense format (without task) for a motion."""
    pose = np.hstack([motion["position"], motion["quaternion"], motion["gripper"][:, None]]).astype(np.float32)
    count = len(pose)
    commanded = np.vstack([pose[1:], pose[-1:]])
    commanded[:, 7] = pose[:, 7]
    frames = []
    for i in range(count):
        frame: dict[str, Any] = {
            keys.STATE: np.concatenate([pose[i], np.full(6, i / count)]).astype(np.float32),
            keys.ACTION: commanded[i],
            keys.INTRINSICS: np.tile([20.0, 21.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2], len(CAMERAS)).astype(np.float32),
            keys.EXTRINSICS: np.tile(np.eye(4)[:3].ravel(), len(CAMERAS)).astype(np.float32),
        }
        for camera in CAMERAS:
            frame[keys.rgb_key(camera)] = rng.integers(256, size=(HEIGHT, WIDTH, 3), dtype=np.uint8)
            frame[keys.depth_key(camera)] = rng.integers(1, 2000, size=(HEIGHT, WIDTH, 1)).astype(np.uint16)
        frames.append(frame)
    return frames


def dense_features() -> dict[str, dict[str, Any]]:
    """LeRobot features of our own dense format at a tiny size."""
    features: dict[str, dict[str, Any]] = {}
    for camera in CAMERAS:
        features[keys.rgb_key(camera)] = image_feature(3)
        features[keys.depth_key(camera)] = {**image_feature(1), "info": {"is_depth_map": True}}
    features[keys.STATE] = vector_feature((*keys.POSE_NAMES, *JOINTS))
    features[keys.INTRINSICS] = vector_feature(keys.intrinsics_names(CAMERAS))
    features[keys.EXTRINSICS] = vector_feature(keys.extrinsics_names(CAMERAS))
    features[keys.ACTION] = vector_feature(keys.POSE_NAMES)
    return features


def image_feature(channels: int, dtype: str = "image") -> dict[str, Any]:
    return {"dtype": dtype, "shape": (HEIGHT, WIDTH, channels), "names": ["height", "width", "channels"]}


def vector_feature(names: Sequence[str]) -> dict[str, Any]:
    return {"dtype": "float32", "shape": (len(names),), "names": list(names)}


def write(
    root: Path,
    episodes: Sequence[Sequence[dict[str, Any]]],
    features: dict[str, dict[str, Any]] | None = None,
    task: str = "lift the red cube",
    repo_id: str = "test/dense",
) -> Path:
    """LeRobot dataset of the given frames, each episode with the instruction ``task``; returns ``root``."""
    dataset = LeRobotDataset.create(repo_id, FPS, features or dense_features(), root=root)
    for episode in episodes:
        for frame in episode:
            dataset.add_frame({**frame, "task": task})
        dataset.save_episode()
    dataset.finalize()
    (root / keys.INSTRUCTIONS_FILE).write_text(json.dumps({task: [task, "pick up the red cube"]}))
    return root


def write_picks(
    root: Path, count: int = 2, change: Callable[[int, list[dict[str, Any]]], None] = lambda episode, frames: None
) -> Path:
    """Dense dataset of ``count`` picks; ``change`` may alter an episode's frames in place before they are written."""
    episodes = []
    for episode in range(count):
        rng = np.random.default_rng(episode)
        frames = dense_frames(pick(rng), rng)
        change(episode, frames)
        episodes.append(frames)
    return write(root, episodes)
