"""Rows read by their place equal the file's rows, however it is cut into row groups, also after it has changed."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from dataset_tools.data_files import read_rows

FIRST, ROWS = 1000, 53
NAMES = ("observation.state", "action", "index")


def write(path: Path, group: int, seed: int = 0) -> pa.Table:
    chance = np.random.default_rng(seed)
    vectors = {
        name: list(chance.random((ROWS, 3))) for name in ("observation.state", "observation.state.more", "action")
    }
    table = pa.table({**vectors, "index": np.arange(FIRST, FIRST + ROWS)})
    pq.write_table(table, path, row_group_size=group)
    return table


@pytest.mark.parametrize("group", [1, 7, 17, ROWS])
@pytest.mark.parametrize(("first", "last"), [(0, ROWS), (0, 1), (5, 31), (34, 51), (52, ROWS)])
def test_rows_are_those_of_the_file(tmp_path: Path, group: int, first: int, last: int) -> None:
    table = write(tmp_path / "file.parquet", group)
    found = read_rows(tmp_path / "file.parquet", FIRST + first, FIRST + last, NAMES)
    assert found.equals(table.slice(first, last - first).select(NAMES))


def test_rows_beyond_the_file_are_missing(tmp_path: Path) -> None:
    write(tmp_path / "file.parquet", 7)
    assert read_rows(tmp_path / "file.parquet", FIRST + 50, FIRST + 60, NAMES).num_rows == 3
    assert read_rows(tmp_path / "file.parquet", FIRST + 60, FIRST + 70, NAMES).num_rows == 0
    assert read_rows(tmp_path / "file.parquet", 0, 10, NAMES).num_rows == 0


def test_a_changed_file_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "file.parquet"
    write(path, 7)
    read_rows(path, FIRST, FIRST + 9, NAMES)
    changed = write(path, 11, seed=1)
    assert read_rows(path, FIRST, FIRST + 9, NAMES).equals(changed.slice(0, 9).select(NAMES))
