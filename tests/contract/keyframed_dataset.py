"""A small keyframed dataset as LeRobot itself writes it: two cameras with depth, sizes that are distinct primes."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset

from lerobot_histmv import keys

CAMERAS = ("front", "wrist")
HEIGHT, WIDTH = 17, 23
VIDEO_HEIGHT, VIDEO_WIDTH = 64, 96
"""Encoders need even sizes, of 64 and more."""
LENGTHS = (3, 1, 5, 2)
REPO = "local/keyframed"


def features(colour: str = "image") -> dict[str, dict[str, Any]]:
    image = ["height", "width", "channels"]
    height, width = (VIDEO_HEIGHT, VIDEO_WIDTH) if colour == "video" else (HEIGHT, WIDTH)
    found: dict[str, dict[str, Any]] = {
        keys.STATE: {"dtype": "float32", "shape": (8,), "names": list(keys.POSE_NAMES)},
        keys.INTRINSICS: {"dtype": "float32", "shape": (8,), "names": keys.intrinsics_names(CAMERAS)},
        keys.EXTRINSICS: {"dtype": "float32", "shape": (24,), "names": keys.extrinsics_names(CAMERAS)},
        keys.ACTION: {"dtype": "float32", "shape": (8,), "names": list(keys.POSE_NAMES)},
        keys.SOURCE_FRAME: {"dtype": "int64", "shape": (1,), "names": None},
        keys.SOURCE_TIMESTAMP: {"dtype": "float32", "shape": (1,), "names": None},
        "keyframe.checked": {"dtype": "bool", "shape": (1,), "names": None},
        "keyframe.note": {"dtype": "string", "shape": (1,), "names": None},
    }
    for camera in CAMERAS:
        found[keys.rgb_key(camera)] = {"dtype": colour, "shape": (height, width, 3), "names": image}
        depth = {"dtype": "image", "shape": (height, width, 1), "names": image, "info": {"is_depth_map": True}}
        found[keys.depth_key(camera)] = depth
    return found


def _value(key: str, feature: dict[str, Any], chance: np.random.Generator) -> Any:
    if feature["dtype"] == "string":
        return f"note {chance.integers(97)}"
    if key.endswith(keys.DEPTH_SUFFIX):
        return chance.integers(0, 2**16, feature["shape"], dtype=np.uint16)
    if feature["dtype"] in ("image", "video"):
        return chance.integers(0, 2**8, feature["shape"], dtype=np.uint8)
    value = chance.normal(size=feature["shape"])
    if key in (keys.ACTION, keys.STATE):
        value[3:7] /= np.linalg.norm(value[3:7])
        value[7] = chance.uniform()
    return (10 * value if feature["dtype"] == "int64" else value).astype(feature["dtype"])


def make(root: Path, seed: int = 0, colour: str = "image") -> Path:
    dataset = LeRobotDataset.create(REPO, fps=1, features=features(colour), root=root, use_videos=colour == "video")
    chance = np.random.default_rng(seed)
    for episode, length in enumerate(LENGTHS):
        for _ in range(length):
            frame = {key: _value(key, feature, chance) for key, feature in features(colour).items()}
            dataset.add_frame(frame | {"task": f"task {episode % 3}"})
        dataset.save_episode()
    dataset.finalize()
    return root


def load(root: Path, steps: int = 4, **options: Any) -> LeRobotDataset:
    """The dataset, with ``steps - 1`` past rows and the present one in every observation and action."""
    window = [float(step) for step in range(1 - steps, 1)]
    deltas = {key: window for key in features() if key.startswith(keys.OBS_PREFIX) or key == keys.ACTION}
    return LeRobotDataset(REPO, root=root, delta_timestamps=deltas if steps else None, **options)


def assert_same(first: dict[str, Any], second: dict[str, Any]) -> None:
    """Two samples are equal bit for bit, in type, shape, value and order of keys."""
    assert list(first) == list(second)
    for key, value in first.items():
        if isinstance(value, torch.Tensor):
            assert (value.dtype, value.shape) == (second[key].dtype, second[key].shape), key
            assert torch.equal(value, second[key]), key
        else:
            assert value == second[key], key
