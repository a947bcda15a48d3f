"""Small synthetic LeRobot datasets: an arm that approaches, closes the gripper, lifts over a bend and stops."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDataset

from lerobot_histmv import keys

FPS = 20
HEIGHT, WIDTH = 17, 19
CAMERAS = ("front", "wrist")
JOINTS = tuple(f"{joint}.pos" for joint in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"))
CLOSED_AT, REST = 13, 7
"""Frame at which the synthetic pick commands the gripper to close, and how many frames the arm then rests."""
TASK = "lift the red cube"
PARAPHRASES = [TASK, "pick up the red cube"]

Features = dict[str, dict[str, Any]]
Frame = dict[str, Any]


def pick(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Positions (n, 3) [m], quaternions (n, 4) and gripper command (n,) of a pick: straight down, close, bend up.

    The arm reaches the object at frame ``CLOSED_AT``, rests ``REST`` frames, and never rests elsewhere.
    """
    start, grasp = np.array([0.4, 0.0, 0.3]), np.array([0.5, 0.1, 0.02]) + rng.uniform(-0.02, 0.02, 3)
    corner, end = grasp + np.array([0, 0, 0.2]), grasp + np.array([0.15, -0.1, 0.25])
    legs = [straight(start, grasp, CLOSED_AT + 1), np.tile(grasp, (REST, 1))]
    legs += [straight(grasp, corner, 8)[1:], straight(corner, end, 8)[1:]]
    position = np.concatenate(legs)
    travelled = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(position, axis=0), axis=-1))])
    angle = 0.5 * travelled / travelled[-1]
    quaternion = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], axis=-1)
    gripper = (np.arange(len(position)) < CLOSED_AT).astype(np.float64)
    return {"position": position, "quaternion": quaternion, "gripper": gripper}


def straight(start: np.ndarray, end: np.ndarray, frames: int) -> np.ndarray:
    """Constant speed from ``start`` to ``end``, both included, in ``frames`` points."""
    return start + np.linspace(0, 1, frames)[:, None] * (end - start)


def vector_frames(motion: dict[str, np.ndarray]) -> list[Frame]:
    """State and action of our own dense format for a motion, without cameras and task."""
    pose = np.hstack([motion["position"], motion["quaternion"], motion["gripper"][:, None]]).astype(np.float32)
    commanded = np.vstack([pose[1:], pose[-1:]])
    commanded[:, 7] = pose[:, 7]
    joints = np.linspace(0, 1, len(pose), dtype=np.float32)[:, None].repeat(6, axis=1)
    state = np.hstack([pose, joints])
    return [{keys.STATE: state[i], keys.ACTION: commanded[i]} for i in range(len(pose))]


def with_cameras(frames: Sequence[Frame], rng: np.random.Generator) -> list[Frame]:
    """The frames with random images, depth [mm] and calibration."""
    intrinsics = np.tile([20.0, 21.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2], len(CAMERAS)).astype(np.float32)
    extrinsics = np.tile(np.eye(4)[:3].ravel(), len(CAMERAS)).astype(np.float32)
    seen = []
    for frame in frames:
        images: Frame = {}
        for camera in CAMERAS:
            images[keys.rgb_key(camera)] = rng.integers(256, size=(HEIGHT, WIDTH, 3), dtype=np.uint8)
            images[keys.depth_key(camera)] = rng.integers(1, 2000, size=(HEIGHT, WIDTH, 1)).astype(np.uint16)
        seen.append({**frame, **images, keys.INTRINSICS: intrinsics, keys.EXTRINSICS: extrinsics})
    return seen


def vector_features() -> Features:
    """LeRobot features of ``vector_frames``."""
    return {
        keys.STATE: vector_feature((*keys.POSE_NAMES, *JOINTS)),
        keys.ACTION: vector_feature(keys.POSE_NAMES),
    }


def dense_features() -> Features:
    """LeRobot features of our own dense format at a tiny size."""
    features: Features = {}
    for camera in CAMERAS:
        features[keys.rgb_key(camera)] = image_feature(3)
        features[keys.depth_key(camera)] = {**image_feature(1), "info": {"is_depth_map": True}}
    features |= vector_features()
    features[keys.INTRINSICS] = vector_feature(keys.intrinsics_names(CAMERAS))
    features[keys.EXTRINSICS] = vector_feature(keys.extrinsics_names(CAMERAS))
    return features


def image_feature(channels: int, dtype: str = "image", size: tuple[int, int] = (HEIGHT, WIDTH)) -> dict[str, Any]:
    return {"dtype": dtype, "shape": (*size, channels), "names": ["height", "width", "channels"]}


def vector_feature(names: Sequence[str]) -> dict[str, Any]:
    return {"dtype": "float32", "shape": (len(names),), "names": list(names)}


def write(root: Path, episodes: Sequence[Sequence[Frame]], features: Features, paraphrases: bool = True) -> Path:
    """LeRobot dataset of the given frames, all with the instruction ``TASK``; returns ``root``."""
    dataset = LeRobotDataset.create("test/dense", FPS, features, root=root)
    for episode in episodes:
        for frame in episode:
            dataset.add_frame({**frame, "task": TASK})
        dataset.save_episode()
    dataset.finalize()
    if paraphrases:
        (root / keys.INSTRUCTIONS_FILE).write_text(json.dumps({TASK: PARAPHRASES}))
    return root


def write_picks(root: Path, count: int = 2) -> Path:
    """Picks in our own dense format, cameras and all."""
    generators = [np.random.default_rng(episode) for episode in range(count)]
    return write(root, [with_cameras(vector_frames(pick(rng)), rng) for rng in generators], dense_features())


def write_vector_picks(root: Path, count: int = 2) -> Path:
    """Picks without cameras: quick to write, enough for what does not look at images."""
    return write(root, [vector_frames(pick(np.random.default_rng(e))) for e in range(count)], vector_features())


def edit_column(root: Path, key: str, change: Callable[[list[Any]], None]) -> None:
    """Change a column's stored values (one per row of the whole dataset) in place."""
    (path,) = root.glob("data/*/*.parquet")
    table = pq.read_table(path)
    values = table.column(key).to_pylist()
    change(values)
    column = pa.array(values, type=table.schema.field(key).type)
    pq.write_table(table.set_column(table.schema.get_field_index(key), table.schema.field(key), column), path)


def edit_info(root: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change ``meta/info.json`` in place."""
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    change(info)
    path.write_text(json.dumps(info))


def snapshot(root: Path) -> Mapping[str, bytes]:
    """All files below a folder."""
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}
