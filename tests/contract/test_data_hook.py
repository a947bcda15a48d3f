"""``lerobot-train`` gets the frame reader, and refusals of what would break RGB-D training, for histmv alone."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import draccus
import keyframed_dataset as sample
import numpy as np
import pytest
import torch
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import EpisodeAwareSampler, LeRobotDataset, factory
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.scripts import lerobot_train
from scipy.spatial.transform import Rotation

from lerobot_histmv import keys
from lerobot_histmv.configuration_histmv import HistMVConfig
from lerobot_histmv.data import checks, hook
from lerobot_histmv.data.reader import FrameReader
from lerobot_histmv.data.resume import ResumedSampler
from lerobot_histmv.model.config import HistoryConfig, LossConfig, NetworkConfig


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sample.make(tmp_path_factory.mktemp("dataset") / "keyframed")


@pytest.fixture(autouse=True)
def hooked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("HISTMV_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("lerobot_histmv.data.memory.keep_freed_memory", lambda: True)
    hook.install_hook()
    yield
    hook.remove_hook()


def configured(root: Path, *flags: str, policy: Any = None) -> TrainPipelineConfig:
    args = [f"--dataset.repo_id={sample.REPO}", f"--dataset.root={root}", *flags]
    config = draccus.parse(TrainPipelineConfig, args=args)
    config.policy = HistMVConfig(device="cpu") if policy is None else policy
    return config


def test_hook_replaces_the_name_that_the_script_uses_once_and_can_be_undone() -> None:
    assert lerobot_train.make_train_eval_datasets is factory.make_train_eval_datasets
    wrapped = factory.make_train_eval_datasets
    hook.install_hook()
    assert factory.make_train_eval_datasets is wrapped
    hook.remove_hook()
    assert lerobot_train.make_train_eval_datasets is factory.make_train_eval_datasets is wrapped.__wrapped__


def test_histmv_gets_the_frame_reader(root: Path) -> None:
    training, held_out = lerobot_train.make_train_eval_datasets(configured(root))
    assert isinstance(training.reader, FrameReader)
    assert held_out is None


def test_states_reach_as_far_before_a_window_as_the_window_is_long(root: Path) -> None:
    """Maps that are remembered show the tool's path before them: training has to know it for the window's first row."""
    config = configured(root)
    config.policy = HistMVConfig(device="cpu", network=NetworkConfig(history=HistoryConfig(past_steps=2)))
    dataset, _ = lerobot_train.make_train_eval_datasets(config)
    plain = LeRobotDataset(sample.REPO, root=root)
    for row in range(len(dataset)):
        item, around = dataset[row], torch.arange(row - 4, row + 3)
        episodes = torch.tensor([plain[int(i)]["episode_index"] if 0 <= i < len(plain) else -1 for i in around])
        outside = episodes != item["episode_index"]
        assert item[f"{keys.STATE}_is_pad"].equal(outside)
        for i in around[~outside]:
            assert item[keys.STATE][i - row + 4].equal(plain[int(i)][keys.STATE])
        assert len(item[keys.INTRINSICS]) == len(item[keys.ACTION]) == 5


def test_held_out_episodes_get_it_too(root: Path) -> None:
    training, held_out = lerobot_train.make_train_eval_datasets(configured(root, "--dataset.eval_split=0.3"))
    assert isinstance(training.reader, FrameReader)
    assert isinstance(held_out.reader, FrameReader)
    assert len(training) + len(held_out) == sum(sample.LENGTHS)
    for dataset in (training, held_out):
        assert len(list(dataset)) == len(dataset)


def test_a_resumed_training_gets_the_sampler_that_goes_on_and_others_keep_lerobots(root: Path) -> None:
    config = configured(root)
    lerobot_train.make_train_eval_datasets(config)
    assert lerobot_train.EpisodeAwareSampler is EpisodeAwareSampler
    config.resume = True
    lerobot_train.make_train_eval_datasets(config)
    assert isinstance(lerobot_train.EpisodeAwareSampler([0], [7]), ResumedSampler)
    hook.remove_hook()
    assert lerobot_train.EpisodeAwareSampler is EpisodeAwareSampler


def test_other_policies_are_left_alone(root: Path) -> None:
    flags = ("--dataset.image_transforms.enable=true", "--dataset.depth_output_unit=m")
    training, _ = lerobot_train.make_train_eval_datasets(configured(root, *flags, policy=ACTConfig(device="cpu")))
    assert not isinstance(training.reader, FrameReader)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--dataset.image_transforms.enable=true"], r"affine \(RandomAffine\)"),
        (["--dataset.depth_output_unit=m"], r"depth_output_unit=m: histmv reads depth in mm"),
        (
            [
                "--dataset.streaming=true",
                "--dataset.image_transforms.enable=true",
                "--dataset.image_transforms.tfs={hue: {type: ColorJitter, kwargs: {hue: 0.1}}}",
            ],
            "streaming also distorts depth",
        ),
    ],
)
def test_settings_that_break_rgbd_training_are_refused(root: Path, flags: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        lerobot_train.make_train_eval_datasets(configured(root, *flags))


@pytest.mark.parametrize(
    "tfs", ["{hue: {type: ColorJitter, kwargs: {hue: 0.1}}}", "{a: {type: RandomAffine, weight: 0}}"]
)
def test_colour_transforms_are_allowed(root: Path, tfs: str) -> None:
    flags = ("--dataset.image_transforms.enable=true", f"--dataset.image_transforms.tfs={tfs}")
    dataset, _ = lerobot_train.make_train_eval_datasets(configured(root, *flags))
    assert isinstance(dataset.reader, FrameReader)
    assert dataset.reader._image_transforms is not None


def test_damaged_datasets_are_named(root: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(root, tmp_path / "copy"))
    data = next((copy / "data").rglob("*.parquet"))
    data.write_bytes(data.read_bytes()[:1009])
    with pytest.raises(ValueError, match=rf"{data.name} \(1009 bytes\) is truncated"):
        lerobot_train.make_train_eval_datasets(configured(copy))
    data.unlink()
    with pytest.raises(ValueError, match=r"has 0 frames in data/, but meta/info\.json says 11"):
        lerobot_train.make_train_eval_datasets(configured(copy))
    with pytest.raises(ValueError, match=r"nowhere is no LeRobot dataset: meta/info\.json is missing"):
        lerobot_train.make_train_eval_datasets(configured(tmp_path / "nowhere"))


def test_a_tool_frame_that_points_the_other_way_is_refused(tmp_path: Path) -> None:
    """Five moves of 7 cm along the tool's own z axis, at the end of which the gripper closes."""
    columns = {key: np.zeros((7, 8), np.float32) for key in (keys.STATE, keys.ACTION)}
    turns = Rotation.random(7, np.random.default_rng(0))
    columns[keys.ACTION][:, :3] = 0.07 * turns.apply([0, 0, 1])
    columns[keys.ACTION][:, 3:7] = turns.as_quat(scalar_first=True)
    columns[keys.ACTION][5:, :3] *= -1
    columns[keys.STATE][:5, 7] = 1
    features = {key: {"names": list(keys.POSE_NAMES)} for key in columns}
    meta = SimpleNamespace(root=tmp_path, features=features)
    for allowed in ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)):
        checks.check_approach(LossConfig(approach=allowed), meta, columns)
    checks.check_approach(LossConfig(heatmap=0.0), meta, columns)
    with pytest.raises(ValueError, match=r"5 of the 5 rows .* against loss\.approach=\(0\.0, 0\.0, -1\.0\).*\[0,0,1\]"):
        checks.check_approach(LossConfig(), meta, columns)
    columns[keys.STATE][4, 7] = 0
    checks.check_approach(LossConfig(), meta, columns)
