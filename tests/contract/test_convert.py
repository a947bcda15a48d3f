"""A converted dataset shows each point where its calibration projects it, and says what the arm did in our terms.

The laws hold for every format: the formats differ in axes, order of quaternions, code of depth and sign of the gripper.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.foreign_episodes import (
    CAMERAS,
    CLOSES_AT,
    FOCAL,
    FRAMES,
    HEIGHT,
    POINT_COLOUR,
    SENTENCES,
    WALL,
    WIDTH,
    Scene,
    write_rlbench,
    write_robomimic,
)
from lerobot.datasets import LeRobotDataset

from dataset_tools import cli
from dataset_tools.convert import command as convert
from dataset_tools.convert.rlbench import RLBenchSource
from lerobot_histmv import keys
from lerobot_histmv.geometry import matrix_from_quaternion, project

SCENES = [Scene(seed) for seed in range(3)]


def write_source(kind: str, folder: Path) -> Path:
    """The scenes in a format: a task with two variations, or a file."""
    if kind == "robomimic":
        return write_robomimic(folder / "demos.hdf5", SCENES)
    for scene, place in zip(SCENES, ("variation0/episodes/episode0", "variation0/episodes/episode1", "v"), strict=True):
        place = place if scene.seed < 2 else "variation10/episodes/episode0"
        write_rlbench(folder / "close_jar" / place, scene)
    return folder


def command(kind: str, source: Path, root: Path, *further: str) -> list[str]:
    sentences = ["--instructions=[close the jar,screw the lid on]"] if kind == "robomimic" else []
    places = [f"--format={kind}", f"--source={source}", "--output.repo_id=test/converted", f"--output.root={root}"]
    return ["convert", *places, *sentences, *further]


@pytest.fixture(scope="module", params=["rlbench", "robomimic"])
def dataset(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> LeRobotDataset:
    folder = tmp_path_factory.mktemp(request.param)
    (folder / "in").mkdir()
    cli.main(command(request.param, write_source(request.param, folder / "in"), folder / "out"))
    assert [path.name for path in folder.iterdir() if path.name != "in"] == ["out"]
    return LeRobotDataset("test/converted", root=folder / "out")


def test_points_are_seen_where_the_calibration_projects_them(dataset: LeRobotDataset) -> None:
    assert dataset.num_frames == len(SCENES) * FRAMES
    for row in range(dataset.num_frames):
        sample, scene, frame = dataset[row], SCENES[row // FRAMES], row % FRAMES
        intrinsics = sample[keys.INTRINSICS].double().numpy().reshape(len(CAMERAS), 4)
        poses = sample[keys.EXTRINSICS].double().numpy().reshape(len(CAMERAS), 3, 4)
        for number, camera in enumerate(CAMERAS):
            ((u, v),), (depth,) = project(scene.points[[frame]], intrinsics[number], poses[number])
            red = (sample[keys.rgb_key(camera)].permute(1, 2, 0) * 255).round() == np.float32(POINT_COLOUR)
            ((row_seen, column_seen),) = red.all(-1).nonzero().tolist()
            assert abs(u - column_seen) <= 0.501
            assert abs(v - row_seen) <= 0.501
            stored = sample[keys.depth_key(camera)][0]
            assert stored[row_seen, column_seen] == round(1000 * float(depth))
            assert stored[-1, 0] == round(1000 * WALL)
            assert not stored[0].any(), "where nothing was measured depth is 0"


def test_calibration_is_the_scenes(dataset: LeRobotDataset) -> None:
    assert dataset.features[keys.INTRINSICS]["names"] == keys.intrinsics_names(CAMERAS)
    assert dataset.features[keys.EXTRINSICS]["names"] == keys.extrinsics_names(CAMERAS)
    assert dataset[0][keys.INTRINSICS].tolist() == [FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2] * 2
    for row in range(dataset.num_frames):
        scene, frame = SCENES[row // FRAMES], row % FRAMES
        poses = np.stack([scene.opencv_pose(camera, frame)[:3] for camera in CAMERAS])
        assert dataset[row][keys.EXTRINSICS].numpy() == pytest.approx(poses.ravel(), abs=1e-6)


def test_the_arm_is_told_in_our_terms(dataset: LeRobotDataset) -> None:
    state = np.stack(dataset.hf_dataset.with_format("numpy")[keys.STATE])
    action = np.stack(dataset.hf_dataset.with_format("numpy")[keys.ACTION])
    assert dataset.features[keys.ACTION]["names"] == list(keys.POSE_NAMES)
    for number, scene in enumerate(SCENES):
        rows = slice(number * FRAMES, (number + 1) * FRAMES)
        assert state[rows, :3] == pytest.approx(scene.tool_position, abs=1e-6)
        assert matrix_from_quaternion(state[rows, 3:7]) == pytest.approx(scene.tool_rotation.as_matrix(), abs=1e-6)
        assert (state[rows, 3] >= 0).all()
        assert state[rows, 8:] == pytest.approx(scene.joints, abs=1e-6)
        assert action[rows][:-1, :7] == pytest.approx(state[rows][1:, :7]), "an action leads to the next pose"
        assert action[rows][-1, :7] == pytest.approx(state[rows][-1, :7])
        assert state[rows, 7].tolist() == [1.0] * CLOSES_AT + [0.0] * (FRAMES - CLOSES_AT)
        assert action[rows, 7].tolist() == [1.0] * (CLOSES_AT - 1) + [0.0] * (FRAMES - CLOSES_AT + 1), (
            "closing is commanded one frame before it is seen"
        )


def test_instructions_and_origins_are_kept(dataset: LeRobotDataset) -> None:
    table = json.loads((dataset.root / keys.INSTRUCTIONS_FILE).read_text())
    assert table == {SENTENCES[0]: SENTENCES, SENTENCES[1]: SENTENCES}
    assert [dataset[row]["task"] for row in range(0, dataset.num_frames, FRAMES)] == [*SENTENCES, SENTENCES[0]]
    report = json.loads((dataset.root / convert.CONVERSION_FILE).read_text())
    assert [episode["task"] for episode in report["episodes"]] in (["close_jar"] * 3, ["Lift"] * 3)
    assert dataset.fps == (20 if report["settings"]["format"] == "rlbench" else 10)


def test_keyframing_accepts_it(dataset: LeRobotDataset, tmp_path: Path) -> None:
    places = [f"--dataset.root={dataset.root}", f"--output.root={tmp_path / 'keys'}"]
    cli.main(["keyframe", "--dataset.repo_id=test/converted", "--output.repo_id=test/keys", *places])
    keyframed = LeRobotDataset("test/keys", root=tmp_path / "keys")
    assert keyframed.num_episodes == len(SCENES)
    rows = keyframed.hf_dataset.with_format("numpy")[:]
    for number, scene in enumerate(SCENES):
        actions = rows[keys.ACTION][rows[keys.SOURCE_EPISODE] == number]
        closing = actions[actions[:, 7] == 0][0]
        assert closing[:3] == pytest.approx(scene.tool_position[CLOSES_AT - 1], abs=1e-6)


def test_a_broken_conversion_goes_on_where_it_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_source("rlbench", tmp_path / "in")
    again = command("rlbench", tmp_path / "in", tmp_path / "out", "--workers=1", "--cameras=[wrist]")
    damaged = tmp_path / "in/close_jar/variation10/episodes/episode0/wrist_rgb/6.png"
    whole = damaged.read_bytes()
    damaged.write_bytes(whole[:40])
    with pytest.raises(SystemExit, match="1"):
        cli.main(again)
    assert not (tmp_path / "out").exists()
    damaged.write_bytes(whole)
    read: list[int] = []
    original = RLBenchSource.read
    monkeypatch.setattr(RLBenchSource, "read", lambda self, index: read.append(index) or original(self, index))
    cli.main(again)
    assert read == [2]
    dataset = LeRobotDataset("test/converted", root=tmp_path / "out")
    assert (dataset.num_frames, dataset.meta.camera_keys) == (
        len(SCENES) * FRAMES,
        [keys.rgb_key("wrist"), keys.depth_key("wrist")],
    )


def test_the_robots_base_becomes_the_origin(dataset: LeRobotDataset, tmp_path: Path) -> None:
    write_rlbench(tmp_path / "in/episode0", SCENES[0])
    cli.main(command("rlbench", tmp_path / "in", tmp_path / "out", "--base=[-0.3,0.1,0.75]"))
    moved = LeRobotDataset("test/converted", root=tmp_path / "out")
    base = np.array([-0.3, 0.1, 0.75])
    sample, before = moved[1], dataset[1]
    for key in (keys.STATE, keys.ACTION):
        assert sample[key][:3].numpy() == pytest.approx(before[key][:3].numpy() - base, abs=1e-6)
        assert sample[key][3:].numpy() == pytest.approx(before[key][3:].numpy(), abs=1e-6)
    found, old = (one[keys.EXTRINSICS].numpy().reshape(2, 3, 4) for one in (sample, before))
    assert found[..., :3] == pytest.approx(old[..., :3])
    assert found[..., 3] == pytest.approx(old[..., 3] - base, abs=1e-6)


def test_nothing_is_overwritten_unasked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_rlbench(tmp_path / "in/episode0", Scene(frames=2))
    arguments = command("rlbench", tmp_path / "in", tmp_path / "out")
    cli.main(arguments)
    before = (tmp_path / "out/meta/info.json").stat().st_mtime_ns
    with pytest.raises(SystemExit, match="1"):
        cli.main(arguments)
    assert "--overwrite" in capsys.readouterr().err
    assert (tmp_path / "out/meta/info.json").stat().st_mtime_ns == before
    cli.main([*arguments, "--overwrite=true"])
    assert (tmp_path / "out/meta/info.json").stat().st_mtime_ns != before
