"""The frame reader gives LeRobot's samples bit for bit: here, in pickles, in spawned workers and without a cache."""

import json
import logging
import pickle
import shutil
from pathlib import Path
from typing import Any

import keyframed_dataset as sample
import pyarrow.parquet
import pytest
import torch
from lerobot.transforms import ImageTransformConfig, ImageTransforms, ImageTransformsConfig
from torch.utils.data import DataLoader

from lerobot_histmv import keys
from lerobot_histmv.data.hook import install
from lerobot_histmv.data.reader import FrameReader


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sample.make(tmp_path_factory.mktemp("dataset") / "keyframed")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("HISTMV_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def both(root: Path, **options: Any) -> tuple[Any, Any]:
    """LeRobot's dataset and the same with the frame reader."""
    fast = sample.load(root, **options)
    assert install(fast)
    assert isinstance(fast.reader, FrameReader)
    return sample.load(root, **options), fast


def assert_all_same(stock: Any, fast: Any) -> None:
    assert len(stock) == len(fast) > 0
    for index in range(-1, len(stock)):
        torch.manual_seed(index)
        expected = stock[index]
        torch.manual_seed(index)
        sample.assert_same(fast[index], expected)


COLOURS = ImageTransformsConfig(
    enable=True, tfs={"hue": ImageTransformConfig(type="ColorJitter", kwargs={"hue": (-0.3, 0.3), "brightness": 0.4})}
)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"steps": 7, "return_uint8": True, "depth_output_unit": "m"},
        {"episodes": [2, 0]},
        {"image_transforms": ImageTransforms(COLOURS)},
        {"steps": 0, "image_transforms": ImageTransforms(COLOURS)},
    ],
    ids=["window", "long-metres", "episodes", "transforms", "no-window"],
)
def test_samples_equal_lerobots(root: Path, options: dict[str, Any]) -> None:
    assert_all_same(*both(root, **options))


def test_windows_are_clamped_to_the_episode_and_padding_is_told(root: Path) -> None:
    _, fast = both(root)
    alone = sum(sample.LENGTHS[:1])
    assert fast[alone][f"{keys.ACTION}_is_pad"].tolist() == [True, True, True, False]
    assert (fast[alone][keys.STATE] == fast[alone][keys.STATE][-1]).all()


def test_transforms_can_be_set_and_cleared_later(root: Path) -> None:
    stock, fast = both(root)
    for dataset in (stock, fast):
        dataset.set_image_transforms(ImageTransforms(COLOURS))
    assert_all_same(stock, fast)
    for dataset in (stock, fast):
        dataset.clear_image_transforms()
    assert_all_same(stock, fast)


def test_raw_table_and_row_mapping_stay_lerobots(root: Path) -> None:
    stock, fast = both(root, episodes=[0, 2])
    sample.assert_same(fast.get_raw_item(4), stock.get_raw_item(4))
    assert fast.absolute_to_relative_idx == stock.absolute_to_relative_idx


def test_images_too_many_for_the_cache_are_read_live(
    root: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("HISTMV_CACHE_GB", "0")
    stock, fast = both(root)
    assert "HISTMV_CACHE_GB=0" in caplog.text
    assert_all_same(stock, fast)


def test_unwritable_cache_falls_back_to_memory(root: Path, cache: Path, caplog: pytest.LogCaptureFixture) -> None:
    cache.write_text("a file where the folder should be")
    stock, fast = both(root)
    assert "kept in the memory" in caplog.text
    assert_all_same(stock, fast)
    sample.assert_same(pickle.loads(pickle.dumps(fast))[2], stock[2])


def test_pickle_reopens_the_cache_and_rebuilds_a_removed_one(root: Path, cache: Path) -> None:
    stock, fast = both(root)
    pickled = pickle.dumps(fast)
    assert len(pickled) < 100_000
    sample.assert_same(pickle.loads(pickled)[2], stock[2])
    shutil.rmtree(cache)
    sample.assert_same(pickle.loads(pickled)[2], stock[2])


def test_spawned_workers_read_the_same(root: Path) -> None:
    stock, fast = both(root)
    expected = next(iter(DataLoader(stock, batch_size=len(stock))))
    batches = list(DataLoader(fast, batch_size=len(stock), num_workers=1, multiprocessing_context="spawn"))
    assert len(batches) == 1
    sample.assert_same(batches[0], expected)


def test_second_use_decodes_nothing(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    both(root)
    monkeypatch.setattr("lerobot_histmv.data.reader.decode", None)
    stock, fast = both(root)
    assert_all_same(stock, fast)


def test_changed_dataset_is_decoded_anew_and_the_old_cache_goes(tmp_path: Path, cache: Path) -> None:
    root = sample.make(tmp_path / "changing", seed=1)
    _, before = both(root)
    shutil.rmtree(root)
    sample.make(root, seed=2)
    stock, after = both(root)
    assert_all_same(stock, after)
    assert not torch.equal(before[0][keys.rgb_key("front")], after[0][keys.rgb_key("front")])
    assert len([path for path in (cache / "frames").iterdir() if path.is_dir()]) == 1


def test_videos_are_decoded_by_lerobot(tmp_path: Path) -> None:
    assert_all_same(*both(sample.make(tmp_path / "video", colour="video"), steps=2))


def damaged(root: Path, tmp_path: Path, column: str, row: int, value: Any) -> Path:
    """A copy of the dataset with one value replaced."""
    copy = Path(shutil.copytree(root, tmp_path / "damaged"))
    path = next((copy / "data").rglob("*.parquet"))
    table = pyarrow.parquet.read_table(path)
    values = table.column(column).to_pylist()
    values[row] = value
    index = table.column_names.index(column)
    array = pyarrow.array(values, type=table.schema.field(column).type)
    pyarrow.parquet.write_table(table.set_column(index, table.schema.field(column), array), path)
    return copy


def test_undecodable_frame_is_named(root: Path, tmp_path: Path) -> None:
    bad = damaged(root, tmp_path, keys.rgb_key("wrist"), 4, {"bytes": b"\x89PNG\r\n\x1a\n cut", "path": None})
    with pytest.raises(ValueError, match=r"observation\.images\.wrist of row 4 cannot be decoded"):
        install(sample.load(bad))


def test_numbers_that_are_not_finite_are_named(root: Path, tmp_path: Path) -> None:
    bad = damaged(root, tmp_path, keys.STATE, 5, [0.0] * 7 + [float("nan")])
    with pytest.raises(ValueError, match=r"observation\.state .* is not finite in row 5, episode 2"):
        install(sample.load(bad))


def test_quaternions_must_be_unit(root: Path, tmp_path: Path) -> None:
    bad = damaged(root, tmp_path, keys.ACTION, 5, [0.0, 0.0, 0.0, 0.0, 3.0, 0.0, 0.0, 1.0])
    with pytest.raises(ValueError, match=r"action of .*: quaternion \[0\.0, 3\.0, 0\.0, 0\.0\] is not a unit"):
        install(sample.load(bad))


@pytest.mark.parametrize("key", [keys.STATE, keys.ACTION])
def test_grippers_must_lie_between_closed_and_open(key: str, root: Path, tmp_path: Path) -> None:
    still = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    install(sample.load(damaged(root, tmp_path / "little", key, 5, [*still, 1.04])))
    bad = damaged(root, tmp_path / "far", key, 5, [*still, 87.0])
    with pytest.raises(ValueError, match=rf"{key} of .* holds a gripper\.pos of 87 in row 5, episode 2; it must be"):
        install(sample.load(bad))


def test_rows_must_match_the_metadata(root: Path, tmp_path: Path) -> None:
    bad = damaged(root, tmp_path, "episode_index", 2, 1)
    with pytest.raises(ValueError, match=r"episode 0 of .* has 2 rows, but its metadata says 3"):
        install(sample.load(bad))


def test_depth_without_a_unit_is_refused(root: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(root, tmp_path / "unitless"))
    info = json.loads((copy / "meta/info.json").read_text())
    del info["features"][keys.depth_key("front")]["info"]["depth_unit"]
    (copy / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(ValueError, match=r"observation\.images\.front_depth .* has no depth_unit"):
        install(sample.load(copy))


def test_unchecked_lerobot_keeps_its_own_reader(
    root: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("lerobot_histmv.data.hook.version", lambda name: "0.7.0")
    dataset = sample.load(root)
    with caplog.at_level(logging.WARNING):
        assert not install(dataset)
    assert "LeRobot 0.7.0" in caplog.text
    assert not isinstance(dataset.reader, FrameReader)
