"""Refuses settings and datasets that RGB-D keyframe training would silently misread."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.lib
import pyarrow.parquet
from lerobot.configs import DEPTH_MILLIMETER_UNIT
from lerobot.configs.train import TrainPipelineConfig
from lerobot.transforms import ImageTransformsConfig

from lerobot_histmv import geometry, keys
from lerobot_histmv.model.config import LossConfig

COLOUR_TRANSFORMS = frozenset({
    "Identity", "ColorJitter", "Grayscale", "RandomGrayscale", "RandomPhotometricDistort", "RandomChannelPermutation",
    "RandomAutocontrast", "RandomEqualize", "RandomInvert", "RandomPosterize", "RandomSolarize", "GaussianBlur",
    "RandomAdjustSharpness", "SharpnessJitter", "MotionBlur", "GaussianNoise", "RandomErasing", "CoarseDropout", "JPEG",
    "JPEGCompression", "GaussianPatchBrightness", "RandomShadow", "GammaCorrection", "PlanckianJitter",
})  # fmt: skip
"""Image transforms, of torchvision and LeRobot, that leave every pixel where depth and calibration say it is."""
CLEAR_MOVE, CLEAR_SHARE, CLEAR_COUNT = 0.01, 0.75, 5
"""Length [m] of moves that tell where the tool points, the share of them that must agree, and the fewest."""


def check_training(config: TrainPipelineConfig) -> None:
    """Raise ValueError if ``lerobot-train``'s settings would silently break the policy.

    They are: image transforms that move pixels, image transforms on a streamed dataset (LeRobot applies them to depth
    there) and depth in metres.
    """
    transforms = config.dataset.image_transforms
    check_transforms(transforms)
    if config.dataset.streaming and transforms.enable:
        raise ValueError(
            "--dataset.image_transforms.enable with --dataset.streaming also distorts depth; use one of them"
        )
    unit = config.dataset.depth_output_unit
    if unit != DEPTH_MILLIMETER_UNIT:
        raise ValueError(
            f"--dataset.depth_output_unit={unit}: histmv reads depth in {DEPTH_MILLIMETER_UNIT}; drop the option"
        )


def check_transforms(transforms: ImageTransformsConfig) -> None:
    """Raise ValueError if an enabled transform may move pixels, which takes colours off their depth and calibration."""
    if not transforms.enable:
        return
    moving = [
        f"{name} ({transform.type})"
        for name, transform in transforms.tfs.items()
        if transform.weight > 0 and transform.type not in COLOUR_TRANSFORMS
    ]
    if moving:
        raise ValueError(
            f"--dataset.image_transforms: {', '.join(moving)} may move pixels away from their depth and calibration. "
            "Give --dataset.image_transforms.tfs with colour transforms only, such as "
            """'{"brightness": {"type": "ColorJitter", "kwargs": {"brightness": [0.8, 1.2]}}}'. """
            f"Allowed: {sorted(COLOUR_TRANSFORMS)}. histmv itself moves images, depth and calibration together"
        )


def check_dataset(meta: Any, columns: Mapping[str, np.ndarray]) -> None:
    """Raise ValueError if a loaded dataset lacks rows or units, or holds numbers that no policy can learn from.

    Args:
        meta: LeRobot's metadata of the dataset.
        columns: its columns, rows first, of all or of selected episodes.
    """
    for key in meta.depth_keys:
        if (meta.features[key].get("info") or {}).get("depth_unit") is None:
            raise ValueError(f"{key} of {meta.root} has no depth_unit in meta/info.json; set it to 'mm' or 'm'")
    episodes = columns["episode_index"]
    for episode, count in zip(*np.unique(episodes, return_counts=True), strict=True):
        length = meta.episodes[int(episode)]["length"]
        if length != count:
            raise ValueError(f"episode {episode} of {meta.root} has {count} rows, but its metadata says {length}")
    for key, values in columns.items():
        if values.ndim == 2 and values.dtype == np.float32 and not np.isfinite(values).all():
            row = int(np.argwhere(~np.isfinite(values))[0, 0])
            raise ValueError(f"{key} of {meta.root} is not finite in row {row}, episode {episodes[row]}: {values[row]}")
    for key in (keys.ACTION, keys.STATE):
        names = list(meta.features.get(key, {}).get("names") or [])
        if key in columns and set(keys.QUATERNION_NAMES) <= set(names):
            components = [names.index(name) for name in keys.QUATERNION_NAMES]
            geometry.unit_quaternion(columns[key][:, components], f"{key} of {meta.root}: quaternion")
        if key in columns and keys.GRIPPER_NAME in names:
            gripper = columns[key][:, names.index(keys.GRIPPER_NAME)]
            if (odd := geometry.odd_gripper(gripper)) is not None:
                raise ValueError(
                    f"{key} of {meta.root} holds a {keys.GRIPPER_NAME} of {gripper[odd]:.3g} in row {odd}, episode "
                    f"{episodes[odd]}; it must be from 0 (closed) to 1 (open): run `histmv doctor` on the dataset"
                )


def check_approach(loss: LossConfig, meta: Any, columns: Mapping[str, np.ndarray]) -> None:
    """Raise ValueError if the tool moves backwards to where it closes: its frame is not the one ``approach`` is in.

    Args:
        loss: of the policy; without heat map term or direction nothing is checked.
        meta: LeRobot's metadata of a keyframed dataset.
        columns: its columns, rows first.
    """
    names = [meta.features[key]["names"][: len(keys.POSE_NAMES)] for key in (keys.STATE, keys.ACTION)]
    if not loss.heatmap or not any(loss.approach) or any(tuple(found) != keys.POSE_NAMES for found in names):
        return
    state, action = columns[keys.STATE], columns[keys.ACTION]
    closing = (action[:, 7] < 0.5) & (state[:, 7] > action[:, 7] + 0.5)
    direction = geometry.matrix_from_quaternion(action[closing, 3:7]) @ loss.approach
    forward = ((action[closing, :3] - state[closing, :3]) * direction).sum(axis=1)
    if len(forward) >= CLEAR_COUNT and np.quantile(forward, CLEAR_SHARE) < -CLEAR_MOVE:
        raise ValueError(
            f"in {(forward < 0).sum()} of the {len(forward)} rows of {meta.root} in which the gripper closes, the tool "
            f"moves against loss.approach={loss.approach}, from wrist to finger tips in the tool's frame; where "
            "the tool's z axis points out of the flange it is [0,0,1], and [0,0,0] does without"
        )


def check_files(root: Path) -> None:
    """Raise ValueError if a local dataset has no metadata, a truncated parquet file or fewer frames than it says."""
    info = root / "meta/info.json"
    if not info.is_file():
        raise ValueError(f"{root} is no LeRobot dataset: meta/info.json is missing")
    for path in sorted(root.rglob("*.parquet")):
        try:
            pyarrow.parquet.read_metadata(path)
        except (pyarrow.lib.ArrowException, OSError) as error:
            size = path.stat().st_size
            raise ValueError(
                f"{path} ({size} bytes) is truncated or no parquet file; make the dataset again"
            ) from error
    found = sum(pyarrow.parquet.read_metadata(path).num_rows for path in root.glob("data/*/*.parquet"))
    told = json.loads(info.read_text())["total_frames"]
    if found != told:
        raise ValueError(f"{root} has {found} frames in data/, but meta/info.json says {told}; files are missing")
