"""Rows of an episode out of LeRobot's data files, at a cost that does not grow with the size of the file.

A file holds many episodes, in one row group each or all in a few. Opening it reads the description of every group, so
open files are kept; where an episode is only a part of a group, the decoded group is kept for the next episode.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Int


@dataclass(frozen=True, eq=False)
class DataFile:
    """An open data file.

    Attributes:
        parquet: the file.
        first: index in the dataset of its first row.
        starts: row of the file at which each row group begins, and the number of all rows.
    """

    parquet: pq.ParquetFile
    first: int
    starts: Int[np.ndarray, " g"]


def read_rows(path: Path, first: int, last: int, columns: tuple[str, ...]) -> pa.Table:
    """Rows ``first`` to ``last`` - 1, counted in the whole dataset; fewer if the file does not hold them all.

    Raises:
        OSError, pyarrow.ArrowException: the file cannot be read, or lacks a column.
    """
    changed = path.stat().st_mtime_ns
    file = _opened(path, changed)
    begin, end = max(first - file.first, 0), min(last - file.first, int(file.starts[-1]))
    groups = np.flatnonzero((file.starts[:-1] < end) & (file.starts[1:] > begin))
    if not len(groups):
        return file.parquet.schema_arrow.empty_table().select(list(columns))
    table = _decoded(path, changed, tuple(groups.tolist()), columns)
    return table.slice(begin - int(file.starts[groups[0]]), end - begin)


@lru_cache(maxsize=4)
def _opened(path: Path, changed: int) -> DataFile:
    """The file as it was ``changed`` last."""
    parquet = pq.ParquetFile(path)
    sizes = [parquet.metadata.row_group(group).num_rows for group in range(parquet.num_row_groups)]
    starts = np.concatenate([[0], np.cumsum(sizes, dtype=np.int64)])
    index = parquet.read_row_group(0, columns=["index"])["index"] if sizes else [0]
    return DataFile(parquet, int(np.asarray(index)[0]), starts)


@lru_cache(maxsize=2)
def _decoded(path: Path, changed: int, groups: tuple[int, ...], columns: tuple[str, ...]) -> pa.Table:
    """Whole row groups; two are kept, since episodes are read in their order."""
    table = _opened(path, changed).parquet.read_row_groups(list(groups), columns=list(columns))
    return table.select(list(columns))  # the reader takes names for prefixes
