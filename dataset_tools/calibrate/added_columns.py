"""A LeRobot dataset again, with further columns: images and videos are copied as they are, never decoded."""

import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float32
from lerobot.datasets.compute_stats import aggregate_stats, get_feature_stats
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.io_utils import write_stats

from dataset_tools.shards import write_json
from dataset_tools.source import Source

NewColumns = Mapping[int, Mapping[str, Float32[np.ndarray, "n _"]]]
"""Values of the new columns, (frames, size) each, by episode and name."""
Statistics = dict[str, dict[str, np.ndarray]]


def write_with_columns(
    source: Source,
    features: Mapping[str, dict[str, Any]],
    columns: NewColumns,
    root: Path,
    on_rows: Callable[[int], None] = lambda rows: None,
) -> None:
    """Write the dataset with its new columns.

    Args:
        source: all episodes of a dataset.
        features: LeRobot features of the new columns: float32 vectors.
        columns: their values.
        root: where to; must not exist.
        on_rows: called with the number of rows just written.

    Raises:
        ValueError: the data files hold a frame that the metadata do not know.
    """
    for folder in ("meta", "videos"):
        if (source.root / folder).is_dir():
            shutil.copytree(source.root / folder, root / folder)
    everything = {**source.features, **features}
    schema = get_hf_features_from_features(everything).arrow_schema
    for path in sorted(source.root.glob("data/*/*.parquet")):
        _write_data(path, root / path.relative_to(source.root), schema, columns, on_rows)
    _add_features(root / "meta/info.json", features)
    statistics = {episode: _statistics(added) for episode, added in columns.items()}
    for path in sorted(root.glob("meta/episodes/*/*.parquet")):
        _add_statistics(path, statistics)
    write_stats({**(source.meta.stats or {}), **aggregate_stats(list(statistics.values()))}, root)


def _write_data(path: Path, copy: Path, schema: pa.Schema, columns: NewColumns, on_rows: Callable[[int], None]) -> None:
    """Copy a data file row group by row group, which bounds the memory."""
    copy.parent.mkdir(parents=True, exist_ok=True)
    stored = pq.ParquetFile(path)
    with pq.ParquetWriter(copy, schema, compression="snappy", use_dictionary=True) as writer:
        for group in range(stored.num_row_groups):
            table = stored.read_row_group(group)
            for name, values in _rows(table, columns, path).items():
                table = table.append_column(name, pa.array(list(values), schema.field(name).type))
            writer.write_table(table.select(schema.names).cast(schema))
            on_rows(table.num_rows)


def _rows(table: pa.Table, columns: NewColumns, path: Path) -> dict[str, np.ndarray]:
    """The new columns at the frames of ``table``."""
    places = list(zip(table["episode_index"].to_pylist(), table["frame_index"].to_pylist(), strict=True))
    names = next(iter(columns.values())).keys()
    try:
        return {name: np.stack([columns[episode][name][frame] for episode, frame in places]) for name in names}
    except (KeyError, IndexError) as error:
        raise ValueError(f"{path} holds frames that meta/episodes does not know; copy the dataset again") from error


def _statistics(added: Mapping[str, np.ndarray]) -> Statistics:
    return {name: get_feature_stats(values, axis=0, keepdims=False) for name, values in added.items()}


def _add_features(path: Path, features: Mapping[str, dict[str, Any]]) -> None:
    info = json.loads(path.read_text(encoding="utf-8"))
    info["features"] |= features
    write_json(path, info)


def _add_statistics(path: Path, statistics: Mapping[int, Statistics]) -> None:
    """Statistics of the new columns in the episodes' metadata, one column each, as LeRobot names them.

    LeRobot's ``remove_feature`` leaves the statistics of what it removed: those of the same names go first.
    """
    table = pq.read_table(path)
    added = {f"stats/{name}/" for name in next(iter(statistics.values()))}
    table = table.drop_columns([name for name in table.column_names if name[: name.rfind("/") + 1] in added])
    episodes = [statistics[episode] for episode in table["episode_index"].to_pylist()]
    for name, of_first in episodes[0].items():
        for statistic in of_first:
            values = [one[name][statistic].tolist() for one in episodes]
            table = table.append_column(f"stats/{name}/{statistic}", pa.array(values))
    pq.write_table(table, path)
