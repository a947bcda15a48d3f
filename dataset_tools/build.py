"""Rows of a keyframed LeRobot dataset: one per macro step, with its provenance.

Of an episode's k keyframes, row i holds what was seen at keyframe i (its observation frame) and, as the action, the
pose and gripper command of keyframe i + 1.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Float32
from lerobot.datasets.compute_stats import get_feature_stats
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.utils.constants import HF_LEROBOT_HOME

from dataset_tools import state
from dataset_tools.columns import Columns
from dataset_tools.frames import CameraFrames, camera_frames
from dataset_tools.images import image_statistics
from dataset_tools.keyframes import Keyframing
from dataset_tools.shards import Statistics
from dataset_tools.source import Source
from dataset_tools.trajectories import label_names
from lerobot_histmv import keys

FPS = 1
"""Nominal: rows are macro steps, whose true time is in ``keyframe.source_timestamp``."""

_PROVENANCE = {
    keys.SOURCE_EPISODE: "int64",
    keys.SOURCE_FRAME: "int64",
    keys.SOURCE_TIMESTAMP: "float32",
    keys.REASON: "int64",
}


Features = dict[str, dict[str, Any]]


def keyframed_features(source: Source, columns: Columns) -> Features:
    """LeRobot features of the keyframed dataset: all ``observation.*`` with cameras as images, action, provenance."""
    features = {}
    for key in observed(source):
        feature = source.features[key]
        features[key] = {name: feature[name] for name in ("dtype", "shape", "names")}
        features[key]["shape"] = tuple(feature["shape"])
        if feature["dtype"] == "video":
            features[key]["dtype"] = "image"
        if key in source.depth_keys:
            features[key]["info"] = {"is_depth_map": True, "depth_unit": "mm"}
    if written := state.names(source.features, columns):
        features[keys.STATE] = {"dtype": "float32", "shape": (len(written),), "names": list(written)}
    names = label_names(columns)
    features[keys.ACTION] = {"dtype": "float32", "shape": (len(names),), "names": names}
    return features | {key: {"dtype": dtype, "shape": (1,), "names": None} for key, dtype in _PROVENANCE.items()}


def observed(source: Source) -> list[str]:
    """Columns that a keyframed dataset keeps; the dense action and LeRobot's counters are replaced, others dropped."""
    return [key for key in source.features if key.startswith(keys.OBS_PREFIX)]


def rows(
    source: Source, keyframing: Keyframing, action: Float32[np.ndarray, "k a"], episode: int
) -> tuple[dict[str, Any], list[str], list[str]]:
    """Rows of one episode.

    Args:
        source: the dense data.
        keyframing: the episode's keyframes.
        action: labels of the keyframes after the first.
        episode: its number.

    Returns:
        Columns by name (arrays or camera frames), the instruction of each row, and warnings about what was seen.

    Raises:
        ValueError: see ``frames.camera_frames``.
    """
    seen = keyframing.keyframes[:-1]
    frames = [keyframe.observation_frame for keyframe in seen]
    kept = [key for key in observed(source) if source.features[key]["dtype"] != "video"]
    stored = source.table(episode, [*kept, "timestamp", "task_index"], frames)
    columns: dict[str, Any] = {}
    warnings = []
    for key in observed(source):
        dtype = source.features[key]["dtype"]
        if dtype not in ("image", "video"):
            columns[key] = np.array(stored.column(key).to_pylist(), dtype=object if dtype == "string" else dtype)
            continue
        columns[key] = camera_frames(source, episode, key, frames, stored)
        if key in source.depth_keys:
            blank = np.flatnonzero(~columns[key].pixels.any(axis=(1, 2, 3)))
            warnings += [f"episode {episode}, frame {frames[i]}: {key} has no valid depth at all" for i in blank]
    columns[keys.ACTION] = action
    columns[keys.SOURCE_EPISODE] = np.full(len(frames), episode)
    columns[keys.SOURCE_FRAME] = np.array(frames)
    columns[keys.SOURCE_TIMESTAMP] = np.array(stored.column("timestamp").to_pylist(), dtype=np.float32)
    columns[keys.REASON] = np.array([keys.REASONS.index(keyframe.reason) for keyframe in seen])
    return columns, [source.task(index) for index in stored.column("task_index").to_pylist()], warnings


def statistics(columns: Mapping[str, Any], features: Features) -> Statistics:
    """LeRobot's statistics of one episode's columns; text has none."""
    found = {}
    for key, column in columns.items():
        if isinstance(column, CameraFrames):
            found[key] = image_statistics(column.pixels)
        elif features[key]["dtype"] != "string":
            values = _flat(column, features[key])
            found[key] = get_feature_stats(values, axis=0, keepdims=values.ndim == 1)
    return found


def table(columns: Mapping[str, Any], features: Features) -> pa.Table:
    """One episode's columns in the form of LeRobot's data files."""
    schema = get_hf_features_from_features(features).arrow_schema
    return pa.table([_cells(columns[field.name], features[field.name], field.type) for field in schema], schema=schema)


def _flat(column: np.ndarray, feature: Mapping[str, Any]) -> np.ndarray:
    """LeRobot keeps vectors with one entry as plain numbers."""
    return column.reshape(len(column)) if tuple(feature["shape"]) == (1,) else column


def _cells(column: Any, feature: Mapping[str, Any], kind: pa.DataType) -> pa.Array:
    """Arrow array of a column; LeRobot keeps matrices as an extension of nested lists."""
    if isinstance(column, CameraFrames):
        return pa.array([{"bytes": file, "path": None} for file in column.files], kind)
    values = _flat(column, feature).tolist()
    if isinstance(kind, pa.BaseExtensionType):
        return pa.ExtensionArray.from_storage(kind, pa.array(values, kind.storage_type))
    return pa.array(values, kind)


def default_root(repo_id: str) -> Path:
    """Where LeRobot keeps a local dataset of this name."""
    return Path(HF_LEROBOT_HOME) / repo_id
