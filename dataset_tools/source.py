"""Reading the episodes of any LeRobot v3 dataset, whose files are checked before anything is made of them."""

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from jaxtyping import Float
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata

from dataset_tools.columns import vectors
from dataset_tools.data_files import read_rows
from dataset_tools.hub import repositories
from lerobot_histmv import keys


@dataclass(frozen=True)
class Source:
    """A dataset on disk; ``episodes`` are those to read."""

    meta: LeRobotDatasetMetadata
    root: Path
    episodes: tuple[int, ...]

    @cached_property
    def features(self) -> dict[str, dict[str, Any]]:
        """LeRobot's feature dictionary."""
        return self.meta.features

    @cached_property
    def depth_keys(self) -> frozenset[str]:
        """Keys of the cameras declared as depth."""
        return frozenset(self.meta.depth_keys)

    @property
    def is_keyframed(self) -> bool:
        """Whether rows are macro steps, as ``histmv keyframe`` writes them."""
        return keys.SOURCE_FRAME in self.features

    def length(self, episode: int) -> int:
        """Frames of an episode."""
        return int(self.meta.episodes[episode]["length"])

    def table(self, episode: int, columns: Sequence[str], frames: Sequence[int] | None = None) -> pa.Table:
        """Stored columns at strictly rising ``frames`` of an episode (all by default).

        Raises:
            ValueError: the file is damaged or lacks some of these rows.
        """
        path = self.root / self.meta.get_data_file_path(episode)
        told = self.meta.episodes[episode]
        length, names = self.length(episode), tuple(dict.fromkeys((*columns, "episode_index", "frame_index")))
        try:
            table = read_rows(path, told["dataset_from_index"], told["dataset_to_index"], names)
            if not _is_episode(table, episode, length):  # rows lie elsewhere when another episode has lost some
                table = pq.read_table(path, columns=list(names), filters=pc.field("episode_index") == episode)
        except (OSError, KeyError, pa.ArrowException) as error:
            raise ValueError(f"episode {episode}: cannot read {', '.join(columns)} from {path}: {error}") from error
        if not _is_episode(table, episode, length):
            raise ValueError(
                f"episode {episode}: {path} holds {len(table)} of {length} rows, or not in order; the dataset is not "
                "whole, so copy it again"
            )
        return table if frames is None else table.take(list(frames))

    def vectors(self, episode: int, wanted: Collection[str] | None = None) -> dict[str, Float[np.ndarray, "n _"]]:
        """Numeric columns of action and observation of a whole episode, all or the ``wanted``, (frames, size) each.

        Raises:
            ValueError: a value is missing, infinite or not a number; the message names episode, frame and entry.
        """
        known = vectors(self.features)
        names = known if wanted is None else {name: known[name] for name in wanted}
        table = self.table(episode, list(names))
        arrays = {}
        for name, entries in names.items():
            array = np.array(table.column(name).to_pylist(), dtype=np.float64).reshape(len(table), -1)
            bad = np.argwhere(~np.isfinite(array))
            if len(bad):
                frame, entry = bad[0].tolist()
                which = entries[entry] if entries else entry
                raise ValueError(f"episode {episode}, frame {frame}: {name}[{which}] is {array[frame, entry]}")
            arrays[name] = array
        return arrays

    def task(self, index: int) -> str:
        """Instruction that a ``task_index`` stands for."""
        return str(self.meta.tasks.iloc[index].name)


def _is_episode(table: pa.Table, episode: int, length: int) -> bool:
    """Whether ``table`` holds the rows of an episode, all of them and in order."""
    own = np.asarray(table["episode_index"]) == episode
    return len(own) == length and bool(own.all()) and np.array_equal(table["frame_index"], np.arange(length))


def open_source(
    repo_id: str, root: str | Path | None = None, episodes: Sequence[int] | None = None, revision: str | None = None
) -> Source:
    """Dataset to keyframe: ``open_dataset``, but not of one that is keyframed already, which is a ValueError too."""
    source = open_dataset(repo_id, root, episodes, revision)
    if source.is_keyframed:
        raise ValueError(f"{repo_id} is keyframed already (it has the column {keys.SOURCE_FRAME}); give the dense one")
    return source


def open_dataset(
    repo_id: str,
    root: str | Path | None = None,
    episodes: Sequence[int] | None = None,
    revision: str | None = None,
    most: int | None = None,
) -> Source:
    """Dense or keyframed dataset; without ``root`` the local copy, else downloaded from the Hub as LeRobot does.

    Args:
        repo_id: its name.
        root: folder that holds it.
        episodes: those to read.
        revision: branch, tag or commit on the Hub.
        most: without ``episodes``, how many to take from the start; all by default.

    Raises:
        ValueError: no dataset at ``root``, damaged or missing files, an episode that does not exist, or a dataset that
            the Hub does not give.
    """
    if root is not None:
        check_files(Path(root))
    with repositories.explained(repo_id):
        meta = LeRobotDatasetMetadata(repo_id, root, revision)
    chosen = tuple(range(meta.total_episodes)[:most] if episodes is None else episodes)
    unknown = sorted(set(chosen) - set(range(meta.total_episodes)))
    if unknown or not chosen:
        raise ValueError(
            f"episodes {unknown} do not exist; {repo_id} has {meta.total_episodes} of them, counted from 0"
        )
    missing = missing_files(meta, chosen)
    if missing and root is None:
        with repositories.explained(repo_id):
            meta = LeRobotDataset(repo_id, episodes=list(chosen), revision=revision).meta
        missing = missing_files(meta, chosen)
    if missing:
        raise ValueError(f"{meta.root} lacks {', '.join(map(str, missing))}; copy the dataset again")
    check_files(Path(meta.root))
    return Source(meta, Path(meta.root), chosen)


def missing_files(meta: LeRobotDatasetMetadata, episodes: Sequence[int]) -> list[Path]:
    """Data and video files of ``episodes`` that are not there, relative to the dataset's folder."""
    wanted = {meta.get_data_file_path(episode) for episode in episodes}
    wanted |= {meta.get_video_file_path(episode, key) for key in meta.video_keys for episode in episodes}
    return sorted(path for path in wanted if not (meta.root / path).is_file())


def check_files(root: Path) -> None:
    """ValueError unless ``root`` holds LeRobot metadata and parquet files that are whole."""
    if not (root / "meta/info.json").is_file():
        raise ValueError(
            f"no LeRobot dataset at {root}: meta/info.json is missing (leave --dataset.root out to load from the Hub)"
        )
    try:
        json.loads((root / "meta/info.json").read_text())
    except json.JSONDecodeError as error:
        raise ValueError(f"{root}/meta/info.json is damaged: {error}") from error
    for path in sorted(root.glob("**/*.parquet")):
        try:
            pq.read_metadata(path)
        except (OSError, pa.ArrowException) as error:
            raise ValueError(
                f"{path} is damaged or was never finished ({error}); copy the dataset again, or record it again"
            ) from error
