"""The frame cache is built once, whole or not at all, stays within its limit and survives damage."""

import multiprocessing
import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from lerobot_histmv.data import frame_cache
from lerobot_histmv.data.columns import Chunk, Columns

ROWS, KEYS = 7, ["colours", "depth", "pose"]


@pytest.fixture(autouse=True)
def frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("HISTMV_CACHE", str(tmp_path))
    return tmp_path / "frames"


def chunks(seed: int = 0) -> Iterator[Chunk]:
    chance = np.random.default_rng(seed)
    for rows in (3, 4):
        yield {
            "colours": chance.integers(0, 2**8, (rows, 3, 5, 11), dtype=np.uint8),
            "depth": chance.integers(0, 2**16, (rows, 1, 5, 11), dtype=np.uint16),
            "pose": chance.normal(size=(rows, 13)).astype(np.float32),
        }


def opened(name: str = "source-content", seed: int = 0) -> Columns:
    return frame_cache.open_or_build(name, KEYS, ROWS, lambda: chunks(seed))


def same(first: Columns, second: Columns) -> bool:
    return all(np.array_equal(first.arrays[key], second.arrays[key]) for key in KEYS)


def test_mapped_columns_equal_those_in_memory() -> None:
    assert same(opened(), Columns.in_memory(chunks()))
    assert same(opened(seed=1), Columns.in_memory(chunks(seed=0))), "a finished cache is not built again"


def test_reading_copies_and_converts() -> None:
    columns = opened()
    colours = columns.read("colours", [2, 2, 0])
    assert colours.shape == (3, 3, 5, 11)
    assert colours.max() <= 1
    colours.zero_()
    assert same(columns, Columns.in_memory(chunks()))
    assert columns.read("depth", 6).shape == (1, 5, 11)
    assert np.array_equal(columns.read("depth", 6).numpy(), columns.arrays["depth"][6].astype(np.float32))


@pytest.mark.parametrize("size", [0, 100, 300])
def test_truncated_file_is_rebuilt(frames: Path, size: int) -> None:
    opened()
    path = frames / "source-content/depth.npy"
    path.write_bytes(path.read_bytes()[:size])
    assert same(opened(), Columns.in_memory(chunks()))


def test_failed_build_leaves_nothing(frames: Path) -> None:
    def failing() -> Iterator[Chunk]:
        yield next(chunks())
        raise ValueError("row 5 is damaged")

    with pytest.raises(ValueError, match="row 5"):
        frame_cache.open_or_build("source-content", KEYS, ROWS, failing)
    assert not [path for path in frames.iterdir() if path.is_dir()]


def _build_slowly(log: str) -> None:
    def slow() -> Iterator[Chunk]:
        with open(log, "a") as file:
            file.write("built\n")
        for chunk in chunks():
            time.sleep(0.1)
            yield chunk

    assert same(frame_cache.open_or_build("source-content", KEYS, ROWS, slow), Columns.in_memory(chunks()))


def test_processes_at_the_same_time_build_once(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    processes = [context.Process(target=_build_slowly, args=(str(tmp_path / "log"),)) for _ in range(3)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0, 0, 0]
    assert (tmp_path / "log").read_text() == "built\n"


def test_least_recently_used_go_first(frames: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = ["a-1", "b-1", "c-1"]
    for age, name in enumerate(names):
        opened(name)
        os.utime(frames / name, (age, age))
    size = sum(path.stat().st_size for path in (frames / "a-1").iterdir())
    monkeypatch.setenv("HISTMV_CACHE_GB", str(3.5 * size / 1e9))
    opened("a-1")
    opened("d-1")
    assert sorted(path.name for path in frames.iterdir() if path.is_dir()) == ["a-1", "c-1", "d-1"]


def test_new_content_and_finished_builds_clear_what_is_stale(frames: Path) -> None:
    opened("source-old")
    (frames / "killed-1.partial").mkdir()
    opened("source-new")
    assert [path.name for path in frames.iterdir() if path.is_dir()] == ["source-new"]


@pytest.mark.parametrize("text", ["many", "-1", "nan"])
def test_limit_must_be_a_size(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setenv("HISTMV_CACHE_GB", text)
    with pytest.raises(ValueError, match=f"HISTMV_CACHE_GB='{text}'"):
        frame_cache.size_limit()
