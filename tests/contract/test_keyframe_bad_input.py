"""What ``histmv keyframe`` refuses: each mistake gets a message that names it, and nothing is written or lost."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from helpers.episodes import edit_column, edit_info, snapshot, vector_features, vector_frames, write, write_vector_picks
from helpers.episodes import pick as motion_of

from dataset_tools import build, keyframe_worker
from dataset_tools.columns import ColumnsConfig
from dataset_tools.keyframe import KeyframeConfig, OutputConfig, SourceConfig, run
from dataset_tools.keyframes import KeyframeOptions, extract
from dataset_tools.signals import Trajectory
from dataset_tools.source import open_source
from lerobot_histmv import keys

LENGTH = len(motion_of(np.random.default_rng(0))["position"])


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_vector_picks(tmp_path_factory.mktemp("written") / "dense")


@pytest.fixture
def dense(written: Path, tmp_path: Path) -> Path:
    """A copy to spoil."""
    return shutil.copytree(written, tmp_path / "dense")


def config(dense: Path, **options: Any) -> KeyframeConfig:
    output = OutputConfig("test/keys", dense.parent / "keys")
    return KeyframeConfig(SourceConfig("test/dense", dense), output, **options)


def assert_refused(dense: Path, message: str, **options: Any) -> None:
    before = snapshot(dense.parent)
    with pytest.raises(ValueError, match=message):
        run(config(dense, **options))
    assert snapshot(dense.parent) == before
    assert not (dense.parent / "keys").exists()


def spoil(row: int, entry: int, value: float | None) -> Callable[[list[list[float | None]]], None]:
    def change(values: list[list[float | None]]) -> None:
        values[row][entry] = value

    return change


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_number_that_is_none_is_named_with_episode_frame_and_entry(dense: Path, value: float) -> None:
    edit_column(dense, keys.STATE, spoil(LENGTH + 5, 1, value))
    assert_refused(dense, rf"episode 1, frame 5: observation\.state\[ee\.y\.pos\] is {value}")


def test_a_quaternion_that_is_not_unit_is_named(dense: Path) -> None:
    edit_column(dense, keys.STATE, spoil(7, 3, 0.5))
    assert_refused(dense, r"episode 0, frame 7: .*a quaternion of norm 0\.5.*; its norm must be 1")


def test_a_rotation_of_unnamed_order_needs_its_format(dense: Path) -> None:
    edit_info(dense, lambda info: info["features"][keys.STATE].update(names=None))
    columns = ColumnsConfig(position="observation.state:0:3", rotation="observation.state:3:7")
    assert_refused(dense, "do not tell the order", columns=columns)


def test_an_episode_of_one_frame_is_named_with_what_to_do(tmp_path: Path) -> None:
    frames = vector_frames(motion_of(np.random.default_rng(0)))
    dense = write(tmp_path / "dense", [frames[:3], frames[:1]], vector_features())
    assert_refused(dense, r"episode 1 has 1 frame.*--dataset\.episodes")
    chosen = config(dense)
    chosen.dataset.episodes = [0]
    run(chosen)
    assert (tmp_path / "keys/meta/info.json").is_file()


def test_a_data_file_that_was_never_finished_is_named(dense: Path) -> None:
    path = dense / "data/chunk-000/file-000.parquet"
    path.write_bytes(path.read_bytes()[:-99])
    assert_refused(dense, r"file-000\.parquet is damaged or was never finished")


def test_a_missing_data_file_is_named(dense: Path) -> None:
    (dense / "data/chunk-000/file-000.parquet").unlink()
    assert_refused(dense, r"lacks data/chunk-000/file-000\.parquet")


def test_missing_rows_are_noticed(dense: Path) -> None:
    path = dense / "data/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(path).slice(0, LENGTH + 3), path)
    assert_refused(dense, rf"episode 1: .* holds 3 of {LENGTH} rows")


def test_a_folder_without_a_dataset_is_not_made_one(tmp_path: Path) -> None:
    assert_refused(tmp_path / "nothing", "no LeRobot dataset at .*nothing.*leave --dataset.root out")
    assert not (tmp_path / "nothing").exists()


def test_damaged_metadata_is_named(dense: Path) -> None:
    (dense / "meta/info.json").write_text('{"codebase_version": ')
    assert_refused(dense, r"info\.json is damaged")


def test_an_episode_that_does_not_exist_is_named(dense: Path) -> None:
    wrong = config(dense)
    wrong.dataset.episodes = [1, 7]
    with pytest.raises(ValueError, match=r"episodes \[7\] do not exist; test/dense has 2"):
        run(wrong)


def test_a_keyframed_dataset_is_not_keyframed_again(dense: Path) -> None:
    run(config(dense))
    again = KeyframeConfig(SourceConfig("test/keys", dense.parent / "keys"), OutputConfig("test/x", dense.parent / "x"))
    with pytest.raises(ValueError, match="keyframed already"):
        run(again)
    assert not (dense.parent / "x").exists()


def test_an_existing_dataset_is_replaced_only_on_request(dense: Path) -> None:
    run(config(dense))
    before = snapshot(dense.parent / "keys")
    with pytest.raises(ValueError, match="--overwrite=true"):
        run(config(dense, epsilon=0.1))
    assert snapshot(dense.parent / "keys") == before
    run(config(dense, epsilon=0.1, overwrite=True))
    assert snapshot(dense.parent / "keys") != before


def test_what_is_no_dataset_is_never_replaced(dense: Path) -> None:
    precious = dense.parent / "keys/letter.txt"
    precious.parent.mkdir()
    precious.write_text("dear reader")
    with pytest.raises(ValueError, match="is no LeRobot dataset"):
        run(config(dense, overwrite=True))
    assert precious.read_text() == "dear reader"


def test_a_dataset_is_not_written_onto_itself(dense: Path) -> None:
    before = snapshot(dense)
    onto_itself = KeyframeConfig(SourceConfig("test/dense", dense), OutputConfig("test/dense", dense), overwrite=True)
    with pytest.raises(ValueError, match="is the dataset itself"):
        run(onto_itself)
    assert snapshot(dense) == before


def test_an_interrupted_run_leaves_the_old_dataset_and_can_be_repeated(
    dense: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(config(dense))
    before = snapshot(dense.parent / "keys")

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(build, "statistics", interrupt)
        with pytest.raises(KeyboardInterrupt):
            run(config(dense, overwrite=True))
    assert snapshot(dense.parent / "keys") == before
    run(config(dense, overwrite=True))
    assert sorted(path.name for path in dense.parent.iterdir()) == ["dense", "keys"]


def test_a_stopped_run_goes_on_with_the_missing_episodes(dense: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen: list[int] = []

    def extract_or_stop(
        trajectory: Trajectory, options: KeyframeOptions, episode: int, asked: tuple[int, ...]
    ) -> object:
        if episode == 1 and not chosen[1:]:
            chosen.append(-1)
            raise KeyboardInterrupt
        chosen.append(episode)
        return extract(trajectory, options, episode, asked)

    monkeypatch.setattr(keyframe_worker, "extract", extract_or_stop)
    with pytest.raises(KeyboardInterrupt):
        run(config(dense))
    with pytest.raises(ValueError, match=r"epsilon was 0\.005 and is now 0\.1"):
        run(config(dense, epsilon=0.1))
    run(config(dense))
    assert chosen == [0, -1, 1]


def test_the_number_of_processes_does_not_change_the_data(dense: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def data() -> dict[str, bytes]:
        return {name: content for name, content in snapshot(dense.parent / "keys").items() if "keyframing" not in name}

    run(config(dense, workers=1))
    alone = data()
    monkeypatch.setattr(keyframe_worker, "WORTH_A_PROCESS", 1)
    run(config(dense, workers=2, overwrite=True))
    assert data() == alone


def test_other_episodes_are_read_although_one_has_lost_rows(dense: Path) -> None:
    path = next(dense.glob("data/*/*.parquet"))
    table = pq.read_table(path)
    pq.write_table(table.slice(3), path)
    assert len(open_source("test/dense", dense).vectors(1)[keys.STATE]) == LENGTH
    with pytest.raises(ValueError, match=rf"episode 0: .* holds {LENGTH - 3} of {LENGTH} rows"):
        open_source("test/dense", dense).vectors(0)
