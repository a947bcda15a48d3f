"""Finished shards -> one LeRobot v3 dataset, episode by episode, through LeRobot's own metadata writer."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.compute_stats import get_feature_stats
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.utils import update_chunk_file_indices

from dataset_tools.dense_features import ROBOT_TYPE
from dataset_tools.shards import Outcome, Statistics, as_arrays, shard_path, write_json
from lerobot_histmv import keys


@dataclass(frozen=True, eq=False)
class Episode:
    """One finished episode.

    Attributes:
        table: its rows, without the columns that LeRobot adds.
        tasks: instruction of each row.
        statistics: LeRobot's, of those columns whose statistics are known already.
    """

    table: pa.Table
    tasks: Sequence[str]
    statistics: Statistics


def assemble(
    directory: Path,
    episodes: Iterable[Outcome],
    features: Mapping[str, dict[str, Any]],
    fps: int,
    repo_id: str,
    root: Path,
    robot_type: str | None = ROBOT_TYPE,
) -> None:
    """Write the dataset that holds the shards of recorded ``episodes``, in their order.

    Args:
        directory: where the shards lie.
        episodes: successful attempts.
        features: LeRobot features of the shards' columns.
        fps: frames per second.
        repo_id: name of the dataset.
        root: where to write it; must not exist.
        robot_type: what ``meta/info.json`` says about the robot.
    """
    paraphrases: dict[str, list[str]] = {}

    def recorded() -> Iterator[Episode]:
        for outcome in episodes:
            table = pq.read_table(shard_path(directory, outcome.attempt))
            yield Episode(table, [outcome.instruction] * table.num_rows, as_arrays(outcome.statistics))
            paraphrases[outcome.instruction] = outcome.paraphrases

    write_dataset(recorded(), features, fps, repo_id, root, robot_type)
    write_json(root / keys.INSTRUCTIONS_FILE, paraphrases)


def write_dataset(
    episodes: Iterable[Episode],
    features: Mapping[str, dict[str, Any]],
    fps: int,
    repo_id: str,
    root: Path,
    robot_type: str | None,
) -> None:
    """Write a LeRobot dataset of image features, one episode after the other; memory holds one of them.

    Args:
        episodes: rows with the columns of ``features``.
        features: LeRobot features.
        fps: frames per second.
        repo_id: name of the dataset.
        root: where to write it; must not exist.
        robot_type: name of the robot, None if it is not known.
    """
    meta = LeRobotDatasetMetadata.create(
        repo_id, fps, dict(features), robot_type=robot_type, root=root, use_videos=False
    )
    with DataFiles(meta) as files:
        for episode in episodes:
            tasks = list(dict.fromkeys(episode.tasks))
            meta.save_episode_tasks(tasks)
            table = _numbered(episode.table, meta, episode.tasks)
            place = files.append(table)
            statistics = _statistics(table, episode.statistics)
            meta.save_episode(meta.total_episodes, table.num_rows, tasks, statistics, place)
    meta.finalize()


class DataFiles:
    """The dataset's data files: one row group per episode, a new file whenever one would grow past the limit.

    The rules are those of LeRobot's own writer, so that its tools find what they expect.
    """

    def __init__(self, meta: LeRobotDatasetMetadata) -> None:
        self._meta = meta
        self._schema = get_hf_features_from_features(meta.features).arrow_schema
        self._chunk, self._file = 0, 0
        self._rows = self._rows_before_file = 0
        self._writer: pq.ParquetWriter | None = None
        self._path = Path()

    def append(self, table: pa.Table) -> dict[str, int]:
        """Write an episode's rows; returns where they lie, as LeRobot's episode metadata names it."""
        if self._writer is not None and self._is_full(table.num_rows):
            self.close()
            self._chunk, self._file = update_chunk_file_indices(self._chunk, self._file, self._meta.chunks_size)
            self._rows_before_file = self._rows
        if self._writer is None:
            place = self._meta.data_path.format(chunk_index=self._chunk, file_index=self._file)
            self._path = self._meta.root / place
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = pq.ParquetWriter(self._path, self._schema, compression="snappy", use_dictionary=True)
        self._writer.write_table(table.select(self._schema.names).cast(self._schema))
        first, self._rows = self._rows, self._rows + table.num_rows
        return {
            "data/chunk_index": self._chunk,
            "data/file_index": self._file,
            "dataset_from_index": first,
            "dataset_to_index": self._rows,
        }

    def _is_full(self, new_rows: int) -> bool:
        size = self._path.stat().st_size
        rows = self._rows - self._rows_before_file
        return size + size / rows * new_rows >= self._meta.data_files_size_in_mb * 1024**2

    def close(self) -> None:
        """Write the footer of the current file."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def __enter__(self) -> "DataFiles":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


def _numbered(table: pa.Table, meta: LeRobotDatasetMetadata, tasks: Sequence[str]) -> pa.Table:
    """The shard with the columns that LeRobot adds: time and the indices of frame, episode, row and task."""
    rows = np.arange(table.num_rows)
    numbering = {
        "timestamp": rows / meta.fps,
        "frame_index": rows,
        "episode_index": np.full_like(rows, meta.total_episodes),
        "index": meta.total_frames + rows,
        "task_index": np.array([meta.get_task_index(task) for task in tasks]),
    }
    for name, column in numbering.items():
        table = table.append_column(name, pa.array(column))
    return table


def _statistics(table: pa.Table, known: Statistics) -> Statistics:
    """LeRobot's statistics of all columns; text has none."""
    statistics = dict(known)
    for name in table.column_names:
        if name not in known and not pa.types.is_string(table[name].type):
            column = np.array(table[name].to_pylist(), dtype=_numpy_type(table[name].type))
            statistics[name] = get_feature_stats(column, axis=0, keepdims=column.ndim == 1)
    return statistics


def _numpy_type(arrow_type: pa.DataType) -> Any:
    value_type = arrow_type.value_type if pa.types.is_fixed_size_list(arrow_type) else arrow_type
    return value_type.to_pandas_dtype()
