"""Writing a keyframed LeRobot dataset: one row per macro step, its provenance, and how it was made.

Of an episode's k keyframes, row i holds what was seen at keyframe i (its observation frame) and, as the action, the
pose and gripper command of keyframe i + 1. The dataset appears under its name only when it is whole.
"""

import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.compute_stats import get_feature_stats
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.utils.constants import HF_LEROBOT_HOME

from dataset_tools.assembly import DataFiles
from dataset_tools.columns import Columns
from dataset_tools.demonstrations import Demonstrations
from dataset_tools.frames import CameraFrames, camera_frames
from dataset_tools.images import image_statistics
from dataset_tools.keyframes import Keyframing
from dataset_tools.signals import Trajectory
from dataset_tools.source import Source
from dataset_tools.trajectories import label_names, labels
from lerobot_histmv import keys

FPS = 1
"""Nominal: rows are macro steps, whose true time is in ``keyframe.source_timestamp``."""

_PROVENANCE = {
    keys.SOURCE_EPISODE: "int64",
    keys.SOURCE_FRAME: "int64",
    keys.SOURCE_TIMESTAMP: "float32",
    keys.REASON: "int64",
}


def keyframed_features(source: Source, columns: Columns) -> dict[str, dict[str, Any]]:
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
    names = label_names(columns)
    features[keys.ACTION] = {"dtype": "float32", "shape": (len(names),), "names": names}
    return features | {key: {"dtype": dtype, "shape": (1,), "names": None} for key, dtype in _PROVENANCE.items()}


def observed(source: Source) -> list[str]:
    """Columns that a keyframed dataset keeps; the dense action and LeRobot's counters are replaced, others dropped."""
    return [key for key in source.features if key.startswith(keys.OBS_PREFIX)]


def write_dataset(
    root: Path,
    demonstrations: Demonstrations,
    found: Mapping[int, Keyframing],
    repo_id: str,
    on_episode: Callable[[], None] = lambda: None,
) -> list[str]:
    """Write the rows of all episodes in ``found``.

    Args:
        root: where to; must not exist.
        demonstrations: the dense data.
        found: keyframes by episode.
        repo_id: name of the new dataset.
        on_episode: called after each.

    Returns:
        Warnings about what was written (depth images without a single measurement).

    Raises:
        ValueError: see ``frames.camera_frames``.
    """
    source, columns = demonstrations.source, demonstrations.columns
    features = keyframed_features(source, columns)
    meta = LeRobotDatasetMetadata.create(
        repo_id, FPS, features, robot_type=source.meta.robot_type, root=root, use_videos=False
    )
    warnings = []
    with DataFiles(meta) as files:
        for episode, keyframing in found.items():
            rows, blank = _rows(source, demonstrations.trajectories[episode], keyframing, episode)
            warnings += blank
            tasks = rows.pop("task")
            meta.save_episode_tasks(list(dict.fromkeys(tasks)))
            statistics = _statistics(rows, meta.features)
            place = files.append(_table(rows, tasks, meta))
            meta.save_episode(meta.total_episodes, len(tasks), list(dict.fromkeys(tasks)), statistics, place)
            on_episode()
    meta.finalize()
    instructions = source.root / keys.INSTRUCTIONS_FILE
    if instructions.is_file():
        shutil.copyfile(instructions, root / keys.INSTRUCTIONS_FILE)
    return warnings


def _rows(
    source: Source, trajectory: Trajectory, keyframing: Keyframing, episode: int
) -> tuple[dict[str, Any], list[str]]:
    """Columns of one episode's rows by name (arrays, camera frames, instructions), and warnings."""
    seen = keyframing.keyframes[:-1]
    frames = [keyframe.observation_frame for keyframe in seen]
    kept = [key for key in observed(source) if source.features[key]["dtype"] != "video"]
    stored = source.table(episode, [*kept, "timestamp", "task_index"], frames)
    rows: dict[str, Any] = {}
    warnings = []
    for key in observed(source):
        dtype = source.features[key]["dtype"]
        if dtype not in ("image", "video"):
            rows[key] = np.array(stored.column(key).to_pylist(), dtype=object if dtype == "string" else dtype)
            continue
        rows[key] = camera_frames(source, episode, key, frames, stored)
        if key in source.depth_keys:
            blank = np.flatnonzero(~rows[key].pixels.any(axis=(1, 2, 3)))
            warnings += [f"episode {episode}, frame {frames[i]}: {key} has no valid depth at all" for i in blank]
    rows[keys.ACTION] = labels(trajectory, keyframing.keyframes[1:])
    rows[keys.SOURCE_EPISODE] = np.full(len(frames), episode)
    rows[keys.SOURCE_FRAME] = np.array(frames)
    rows[keys.SOURCE_TIMESTAMP] = np.array(stored.column("timestamp").to_pylist(), dtype=np.float32)
    rows[keys.REASON] = np.array([keys.REASONS.index(keyframe.reason) for keyframe in seen])
    rows["task"] = [source.task(index) for index in stored.column("task_index").to_pylist()]
    return rows, warnings


def _statistics(rows: Mapping[str, Any], features: Mapping[str, Any]) -> dict[str, dict[str, np.ndarray]]:
    """LeRobot's statistics of one episode; text has none."""
    statistics = {}
    for key, column in rows.items():
        if isinstance(column, CameraFrames):
            statistics[key] = image_statistics(column.pixels)
        elif features[key]["dtype"] != "string":
            values = column.reshape(len(column)) if tuple(features[key]["shape"]) == (1,) else column
            statistics[key] = get_feature_stats(values, axis=0, keepdims=values.ndim == 1)
    return statistics


def _table(rows: Mapping[str, Any], tasks: list[str], meta: LeRobotDatasetMetadata) -> pa.Table:
    """Rows with LeRobot's counters, in the form of its data files."""
    count = np.arange(len(tasks))
    columns: dict[str, Any] = {
        "timestamp": count / meta.fps,
        "frame_index": count,
        "episode_index": np.full_like(count, meta.total_episodes),
        "index": meta.total_frames + count,
        "task_index": np.array([meta.get_task_index(task) for task in tasks]),
    }
    for key, column in rows.items():
        if isinstance(column, CameraFrames):
            columns[key] = [{"bytes": file, "path": None} for file in column.files]
        else:
            columns[key] = column.reshape(len(column)) if tuple(meta.features[key]["shape"]) == (1,) else column
    schema = get_hf_features_from_features(meta.features).arrow_schema
    return pa.table([_cells(columns[field.name], field.type) for field in schema], schema=schema)


def _cells(column: Any, kind: pa.DataType) -> pa.Array:
    """Arrow array of a column; LeRobot keeps matrices as an extension of nested lists."""
    values = column.tolist() if isinstance(column, np.ndarray) else column
    if isinstance(kind, pa.BaseExtensionType):
        return pa.ExtensionArray.from_storage(kind, pa.array(values, kind.storage_type))
    return pa.array(values, kind)


@dataclass(frozen=True)
class Kind:
    """A kind of folder that is written as a whole.

    Args:
        mark: a file that every such folder has; others are never replaced.
        name: what it is, for messages.
        option: the option that says where it goes.
    """

    mark: str
    name: str
    option: str


DATASET = Kind("meta/info.json", "LeRobot dataset", "--output.root")


@contextmanager
def published(root: Path, overwrite: bool, kind: Kind = DATASET) -> Iterator[Path]:
    """A path to write a folder to, which becomes ``root`` when the block ends without an error.

    Until then ``root`` keeps what it holds; what an interrupted run left beside it is cleared away.

    Raises:
        ValueError: ``root`` exists and ``overwrite`` is not set, or it holds something that is not of this ``kind``.
    """
    partial, old = (root.with_name(f".{root.name}.{what}") for what in ("partial", "old"))
    if old.exists() and not root.exists():
        old.rename(root)
    check_free(root, overwrite, kind)
    root.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(partial, ignore_errors=True)
    try:
        yield partial
        if root.exists():
            root.rename(old)
        partial.rename(root)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        if root.exists():
            shutil.rmtree(old, ignore_errors=True)


def check_free(root: Path, overwrite: bool, kind: Kind = DATASET) -> None:
    """ValueError if a folder of this ``kind`` cannot be written to ``root``."""
    if not root.exists() or (root.is_dir() and not any(root.iterdir())):
        return
    if not (root / kind.mark).is_file():
        raise ValueError(f"{root} exists and is no {kind.name}; give another {kind.option}")
    if not overwrite:
        raise ValueError(f"{root} holds a {kind.name}; give another {kind.option}, or --overwrite=true to replace it")


def default_root(repo_id: str) -> Path:
    """Where LeRobot keeps a local dataset of this name."""
    return Path(HF_LEROBOT_HOME) / repo_id


def push(repo_id: str, root: Path, private: bool) -> None:
    """Upload a dataset to the Hub, with a card and the version tag that LeRobot asks for."""
    LeRobotDataset(repo_id, root=root).push_to_hub(private=private or None, tags=["histmv", "keyframes"])
