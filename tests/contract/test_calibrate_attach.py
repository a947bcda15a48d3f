"""Attaching a calibration gives the dataset that would have been recorded with it; the source stays as it was."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from helpers import episodes as synthetic
from helpers.foreign_episodes import Scene, looking_at, tool_camera
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.dataset_tools import delete_episodes, remove_feature
from lerobot.datasets.io_utils import load_stats

from dataset_tools import cli
from lerobot_histmv import keys

FPS, LENGTHS = 20, (5, 1, 7)
FIXED = looking_at(np.array([1.2, 0.1, 1.1]), np.array([0.3, 0.0, 0.7]))
INTRINSICS = {"front": [31.0, 32.0, 9.0, 8.0], "wrist": [41.0, 42.0, 9.5, 7.5]}
CAMERAS = {
    camera: {**dict(zip(keys.INTRINSICS_FIELDS, numbers, strict=True)), **pose}
    for (camera, numbers), pose in zip(
        INTRINSICS.items(),
        [{"T_world_cam": FIXED.tolist()}, {"mounted_on": "tool", "T_tool_cam": tool_camera().tolist()}],
        strict=True,
    )
}


def write_dense(root: Path, calibrated: bool) -> Path:
    """Episodes with a moving tool, with or without the calibration of the two cameras, otherwise the same."""
    features = synthetic.dense_features()
    if not calibrated:
        features = {key: feature for key, feature in features.items() if key not in (keys.INTRINSICS, keys.EXTRINSICS)}
    dataset = LeRobotDataset.create("test/dense", FPS, features, root=root)
    rng = np.random.default_rng(0)
    for number, length in enumerate(LENGTHS):
        scene = Scene(number, length)
        for frame in range(length):
            dataset.add_frame({**observed(scene, frame, rng, calibrated), "task": synthetic.TASK})
        dataset.save_episode()
    dataset.finalize()
    (root / keys.INSTRUCTIONS_FILE).write_text(json.dumps({synthetic.TASK: synthetic.PARAPHRASES}))
    return root


def observed(scene: Scene, frame: int, rng: np.random.Generator, calibrated: bool) -> dict[str, Any]:
    pose = np.concatenate([scene.tool_position[frame], scene.tool_rotation[frame].as_quat(scalar_first=True), [1]])
    found: dict[str, Any] = {keys.STATE: np.append(pose, np.zeros(6)).astype(np.float32)}
    found[keys.ACTION] = pose.astype(np.float32)
    for camera in INTRINSICS:
        found[keys.rgb_key(camera)] = rng.integers(256, size=(synthetic.HEIGHT, synthetic.WIDTH, 3), dtype=np.uint8)
        depth = rng.integers(1, 2000, size=(synthetic.HEIGHT, synthetic.WIDTH, 1))
        found[keys.depth_key(camera)] = depth.astype(np.uint16)
    if calibrated:
        found[keys.INTRINSICS] = np.float32([*INTRINSICS["front"], *INTRINSICS["wrist"]])
        poses = [FIXED[:3], scene.opencv_pose("wrist", frame)[:3]]
        found[keys.EXTRINSICS] = np.stack(poses).ravel().astype(np.float32)
    return found


def attach(source: Path, output: Path, cameras: Any, *further: str) -> None:
    source.with_suffix(".yaml").write_text(yaml.safe_dump(cameras))
    places = [f"--dataset.root={source}", f"--output.root={output}", f"--calibration={source.with_suffix('.yaml')}"]
    cli.main(["calibrate-attach", "--dataset.repo_id=test/dense", "--output.repo_id=test/rgbd", *places, *further])


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dense(tmp_path_factory.mktemp("attach") / "plain", calibrated=False)


@pytest.fixture(scope="module")
def attached(source: Path) -> LeRobotDataset:
    before = synthetic.snapshot(source)
    attach(source, source.with_name("attached"), CAMERAS)
    assert synthetic.snapshot(source) == before
    assert sorted(path.name for path in source.parent.iterdir()) == ["attached", "plain", "plain.yaml"]
    return LeRobotDataset("test/rgbd", root=source.with_name("attached"))


def test_it_is_the_dataset_that_would_have_been_recorded(attached: LeRobotDataset, tmp_path: Path) -> None:
    recorded = LeRobotDataset("test/dense", root=write_dense(tmp_path / "recorded", calibrated=True))
    assert len(attached) == len(recorded) == sum(LENGTHS)
    assert attached.features == recorded.features
    for row in range(len(recorded)):
        mine, theirs = attached[row], recorded[row]
        assert mine.keys() == theirs.keys()
        for key, value in theirs.items():
            if key == keys.EXTRINSICS:
                assert mine[key].numpy() == pytest.approx(value.numpy(), abs=1e-6)
            else:
                assert torch.equal(mine[key], value) if isinstance(value, torch.Tensor) else mine[key] == value, key
    mine, theirs = load_stats(attached.root), load_stats(recorded.root)
    assert mine.keys() == theirs.keys()
    for key, statistics in theirs.items():
        for name, value in statistics.items():
            assert mine[key][name] == pytest.approx(value, abs=1e-5), (key, name)
    assert set(attached.meta.episodes.features) == set(recorded.meta.episodes.features)
    table = json.loads((attached.root / keys.INSTRUCTIONS_FILE).read_text())
    assert table == {synthetic.TASK: synthetic.PARAPHRASES}


def test_lerobots_editing_tools_work(attached: LeRobotDataset, tmp_path: Path) -> None:
    edited = delete_episodes(attached, [0], output_dir=tmp_path / "edited", repo_id="test/edited")
    assert torch.equal(edited[1][keys.EXTRINSICS], attached[LENGTHS[0] + 1][keys.EXTRINSICS])


def test_a_calibration_that_lerobot_removed_can_be_attached_again(attached: LeRobotDataset, tmp_path: Path) -> None:
    remove_feature(attached, [keys.INTRINSICS, keys.EXTRINSICS], output_dir=tmp_path / "plain", repo_id="test/plain")
    attach(tmp_path / "plain", tmp_path / "again", CAMERAS)
    again = LeRobotDataset("test/rgbd", root=tmp_path / "again")
    assert again.features.keys() == attached.features.keys()
    assert torch.equal(again[3][keys.EXTRINSICS], attached[3][keys.EXTRINSICS])


def test_what_cannot_be_attached_is_refused_and_leaves_nothing(
    source: Path, attached: LeRobotDataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    unnamed = tmp_path / "unnamed"
    shutil.copytree(source, unnamed)
    synthetic.edit_info(unnamed, lambda info: info["features"][keys.STATE].update(names=None))
    skewed = tmp_path / "skewed"
    shutil.copytree(source, skewed)
    synthetic.edit_column(skewed, keys.STATE, lambda rows: rows[6].__setitem__(slice(3, 7), [0.5, 0.5, 0.5, 0.9]))
    cases: list[tuple[Path, Any, tuple[str, ...], str]] = [
        (attached.root, CAMERAS, (), "has observation.camera_intrinsics, observation.camera_extrinsics already"),
        (source, {"top": CAMERAS["front"]}, (), "those are front, wrist"),
        (unnamed, CAMERAS, (), "no tool position found"),
        (unnamed, CAMERAS, ("--columns.position=observation.state:0:3",), "needs the tool's position and rotation"),
        (skewed, CAMERAS, (), "episode 2, frame 0"),
    ]
    for root, cameras, options, message in cases:
        with pytest.raises(SystemExit, match="1"):
            attach(root, tmp_path / "out", cameras, *options)
        assert message in capsys.readouterr().err.replace("\n", " ")
        assert not (tmp_path / "out").exists()


def test_columns_without_names_are_told_with_their_order(
    source: Path, attached: LeRobotDataset, tmp_path: Path
) -> None:
    unnamed = tmp_path / "unnamed"
    shutil.copytree(source, unnamed)
    synthetic.edit_info(unnamed, lambda info: info["features"][keys.STATE].update(names=None))
    synthetic.edit_column(
        unnamed, keys.STATE, lambda rows: [row.__setitem__(slice(3, 7), [*row[4:7], row[3]]) for row in rows]
    )
    columns = ["position=observation.state:0:3", "rotation=observation.state:3:7", "rotation_format=xyzw"]
    attach(unnamed, tmp_path / "out", CAMERAS, *(f"--columns.{column}" for column in columns))
    found = LeRobotDataset("test/rgbd", root=tmp_path / "out")
    assert torch.equal(found[3][keys.EXTRINSICS], attached[3][keys.EXTRINSICS])
