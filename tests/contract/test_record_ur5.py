"""Real demonstrations: what the columns of a recorded episode mean."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset

from dataset_tools.assembly import assemble
from dataset_tools.dense_features import dense_features
from dataset_tools.record_worker import Worker, WorkerSetup
from dataset_tools.shards import Outcome, shard_path
from lerobot_histmv import keys
from lerobot_histmv.envs import make

CAMERAS = ("front", "wrist")
SIZE = 32
pytest.importorskip("mujoco")


def worker(directory: Path, task: str = "pick_and_lift") -> Worker:
    directory.mkdir(exist_ok=True)
    make_env = partial(make, cameras=CAMERAS, image_size=SIZE, render_size=SIZE)
    return Worker(WorkerSetup(directory, (task,), make_env, CAMERAS, stride=1, seed=0))


@pytest.fixture(scope="module")
def episode(tmp_path_factory: pytest.TempPathFactory) -> tuple[Outcome, Path, LeRobotDataset]:
    directory = tmp_path_factory.mktemp("ur5")
    outcome = worker(directory).make_attempt(0)
    assert outcome.success
    assemble(directory, [outcome], dense_features(CAMERAS, SIZE), 20, "local/ur5", directory / "dataset")
    return outcome, directory, LeRobotDataset("local/ur5", root=directory / "dataset")


def column(dataset: LeRobotDataset, key: str) -> np.ndarray:
    return np.array(dataset.hf_dataset.with_format(None)[key])


def test_columns_are_named_and_typed(episode: tuple[Outcome, Path, LeRobotDataset]) -> None:
    features = episode[2].meta.features
    assert features[keys.ACTION]["names"] == list(keys.POSE_NAMES)
    assert features[keys.STATE]["names"] == [*keys.POSE_NAMES, *keys.JOINT_NAMES]
    assert features[keys.INTRINSICS]["names"][:5] == ["front.fx", "front.fy", "front.cx", "front.cy", "wrist.fx"]
    assert keys.cameras_of(features[keys.EXTRINSICS]["names"]) == list(CAMERAS)
    assert episode[2].meta.depth_keys == [keys.depth_key(camera) for camera in CAMERAS]
    assert (episode[2].meta.robot_type, episode[2].meta.fps) == ("ur5e", 20)


def test_commands_lead_and_measurements_follow(episode: tuple[Outcome, Path, LeRobotDataset]) -> None:
    action, state = column(episode[2], keys.ACTION), column(episode[2], keys.STATE)
    reached_next = np.linalg.norm(action[:-1, :3] - state[1:, :3], axis=1)
    assert np.median(reached_next) < 0.005
    for quaternions in (action[:, 3:7], state[:, 3:7]):
        assert np.linalg.norm(quaternions, axis=1) == pytest.approx(1, abs=1e-5)
        assert np.all(quaternions[:, 0] >= -1e-6)


def test_the_gripper_is_commanded_before_it_is_measured(episode: tuple[Outcome, Path, LeRobotDataset]) -> None:
    command, opening = (column(episode[2], key)[:, 7] for key in (keys.ACTION, keys.STATE))
    assert set(np.unique(command)) == {0, 1}
    commanded = int(np.flatnonzero(np.diff(command))[0]) + 1
    assert (command[commanded], opening[commanded] > 0.9) == (0, True)
    assert opening[commanded + 10] < 0.9
    tool = column(episode[2], keys.STATE)[commanded : commanded + 10, :3]
    assert np.ptp(tool, axis=0).max() < 0.005


def test_depth_is_millimetres_where_the_calibration_says(episode: tuple[Outcome, Path, LeRobotDataset]) -> None:
    dataset = episode[2]
    last = dataset[len(dataset) - 1]
    depth = last[keys.depth_key("front")].numpy()[0] / 1000
    fx, fy, cx, cy = last[keys.INTRINSICS].numpy()[:4]
    world_from_camera = np.vstack([last[keys.EXTRINSICS].numpy()[:12].reshape(3, 4), [0, 0, 0, 1]])
    v, u = np.nonzero(depth > 0)
    z = depth[v, u]
    points = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z, np.ones_like(z)])
    heights = (world_from_camera @ points)[2]
    assert np.abs(np.median(heights)) < 0.01


def test_a_seed_decides_every_byte(episode: tuple[Outcome, Path, LeRobotDataset], tmp_path: Path) -> None:
    outcome, directory, _ = episode
    again = worker(tmp_path / "again")
    again.make_attempt(1)
    assert again.make_attempt(0) == outcome
    assert shard_path(tmp_path / "again", 0).read_bytes() == shard_path(directory, 0).read_bytes()
