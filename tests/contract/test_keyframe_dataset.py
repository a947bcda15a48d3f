"""``histmv keyframe`` on our own dense format: rows, labels, provenance, images, files, and what it prints."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.episodes import (
    CAMERAS,
    CLOSED_AT,
    FPS,
    PARAPHRASES,
    REST,
    TASK,
    dense_features,
    edit_column,
    pick,
    write_picks,
    write_vector_picks,
)
from lerobot.datasets import LeRobotDataset, delete_episodes
from lerobot.utils.constants import HF_LEROBOT_HOME

from dataset_tools import cli
from dataset_tools import keyframe as keyframe_command
from dataset_tools.hub import repositories
from dataset_tools.images import encode_depth
from lerobot_histmv import keys

LENGTH = len(pick(np.random.default_rng(0))["position"])
SEEN_AFTER_GRASP = CLOSED_AT + REST


def keyframe(dense: Path, output: Path, *arguments: str) -> Path:
    places = ["--dataset.repo_id=test/dense", f"--dataset.root={dense}", "--output.repo_id=test/keys"]
    cli.main(["keyframe", *places, f"--output.root={output}", *arguments])
    return output


@pytest.fixture(scope="module")
def dense(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_picks(tmp_path_factory.mktemp("dense") / "dense")


@pytest.fixture(scope="module")
def keyed(dense: Path) -> LeRobotDataset:
    return LeRobotDataset("test/keys", root=keyframe(dense, dense.parent / "keys"))


@pytest.fixture(scope="module")
def source(dense: Path) -> LeRobotDataset:
    return LeRobotDataset("test/dense", root=dense)


def test_k_keyframes_give_k_minus_one_rows_per_episode(keyed: LeRobotDataset) -> None:
    told = json.loads((keyed.root / keys.KEYFRAMING_FILE).read_text())
    counts = [len(episode["keyframes"]) for episode in told["episodes"]]
    assert [int(length) for length in keyed.meta.episodes["length"]] == [count - 1 for count in counts]
    assert counts == [4, 4]
    assert len(keyed) == told["totals"]["rows"] == 6


def test_rows_hold_what_was_seen_at_the_observation_frame(keyed: LeRobotDataset, source: LeRobotDataset) -> None:
    corner = CLOSED_AT + REST + 7
    for row, frame in zip(keyed, 2 * [0, SEEN_AFTER_GRASP, corner], strict=True):
        assert row[keys.SOURCE_FRAME] == frame
        seen = source[int(row[keys.SOURCE_EPISODE]) * LENGTH + frame]
        assert row[keys.SOURCE_TIMESTAMP] == seen["timestamp"] == pytest.approx(frame / FPS)
        for key in dense_features():
            if key.startswith(keys.OBS_PREFIX):
                assert torch.equal(row[key], seen[key]), key
        assert row["task"] == TASK


def test_actions_are_the_next_key_pose_and_the_command_in_force_after_it(keyed: LeRobotDataset) -> None:
    for episode in range(2):
        motion = pick(np.random.default_rng(episode))
        for i, frame in enumerate((CLOSED_AT, CLOSED_AT + REST + 7, LENGTH - 1)):
            action = keyed[3 * episode + i][keys.ACTION].numpy()
            np.testing.assert_allclose(action[:3], motion["position"][frame], atol=1e-6)
            np.testing.assert_allclose(action[3:7], motion["quaternion"][frame], atol=1e-6)
            assert action[7] == 0


def test_reasons_are_those_of_the_keyframe_seen_in_the_row(keyed: LeRobotDataset) -> None:
    assert [keys.REASONS[int(row[keys.REASON])] for row in keyed] == 2 * ["start", "gripper", "ga"]


def test_features_are_images_and_vectors_at_a_nominal_rate(keyed: LeRobotDataset) -> None:
    assert keyed.fps == 1
    assert [float(row["timestamp"]) for row in keyed] == 2 * [0.0, 1.0, 2.0]
    for camera in CAMERAS:
        assert keyed.features[keys.rgb_key(camera)]["dtype"] == "image"
        assert keyed.features[keys.depth_key(camera)]["info"] == {"is_depth_map": True, "depth_unit": "mm"}
    assert tuple(keyed.features[keys.ACTION]["names"]) == keys.POSE_NAMES
    assert set(keyed.meta.stats) >= {*dense_features(), keys.SOURCE_FRAME, keys.REASON}
    assert keyed.meta.stats[keys.depth_key("front")]["max"].shape == (1, 1, 1)


def test_the_dataset_tells_how_it_was_made(keyed: LeRobotDataset) -> None:
    told = json.loads((keyed.root / keys.KEYFRAMING_FILE).read_text())
    assert told["options"]["method"] == "ga"
    assert told["options"]["epsilon"] == 0.005
    assert told["options"]["seed"] == 0
    assert told["source"] == "test/dense"
    assert told["columns"]["gripper"] == f"{keys.ACTION}:{keys.GRIPPER_NAME}"
    assert set(told["versions"]) >= {"histmv", "lerobot"}
    first = told["episodes"][0]
    assert first["source_episode"] == 0
    assert first["keyframes"][1] == {
        "pose_frame": CLOSED_AT, "observation_frame": SEEN_AFTER_GRASP, "reason": "gripper",
    }  # fmt: skip
    assert {"error_sum", "error_mean", "error_max", "gap", "seconds"} <= set(first)
    page = (keyed.root / keys.KEYFRAMING_FILE).with_suffix(".md").read_text()
    assert "gap to the exact optimum" in page
    assert f"0s {CLOSED_AT}g" in page


def test_paraphrases_come_along(keyed: LeRobotDataset) -> None:
    assert json.loads((keyed.root / keys.INSTRUCTIONS_FILE).read_text()) == {TASK: PARAPHRASES}


def test_lerobots_editing_keeps_the_provenance(keyed: LeRobotDataset, tmp_path: Path) -> None:
    rest = delete_episodes(keyed, [0], output_dir=tmp_path / "rest", repo_id="test/rest")
    assert len(rest) == 3
    assert {int(row[keys.SOURCE_EPISODE]) for row in rest} == {1}
    assert torch.equal(rest[1][keys.depth_key("front")], keyed[4][keys.depth_key("front")])


def test_chosen_episodes_keep_their_numbers_as_provenance(dense: Path, tmp_path: Path) -> None:
    rows = LeRobotDataset("test/keys", root=keyframe(dense, tmp_path / "keys", "--dataset.episodes=[1]"))
    assert {int(row[keys.SOURCE_EPISODE]) for row in rows} == {1}
    assert {int(row["episode_index"]) for row in rows} == {0}


def test_the_same_seed_gives_the_same_data(tmp_path: Path) -> None:
    dense = write_vector_picks(tmp_path / "dense")
    files = [keyframe(dense, tmp_path / name) / "data/chunk-000/file-000.parquet" for name in ("first", "second")]
    assert files[0].read_bytes() == files[1].read_bytes()


def test_without_roots_the_datasets_lie_where_lerobot_keeps_them_and_may_be_uploaded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    done: list[tuple[Any, ...]] = []
    monkeypatch.setattr(repositories, "prepare", lambda *arguments: done.append(arguments))
    monkeypatch.setattr(keyframe_command, "push_dataset", lambda *arguments: done.append(arguments))
    write_vector_picks(HF_LEROBOT_HOME / "test/home")
    cli.main(["keyframe", "--dataset.repo_id=test/home", "--output.repo_id=test/away", "--output.push_to_hub=true"])
    assert (HF_LEROBOT_HOME / "test/away" / keys.KEYFRAMING_FILE).is_file()
    root = (HF_LEROBOT_HOME / "test/away").resolve()
    assert done == [("test/away", False), (root, "test/away", False, None)]


def test_what_is_printed_tells_why_frames_were_kept_and_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    keyframe(write_vector_picks(tmp_path / "dense"), tmp_path / "keys")
    printed = " ".join(capsys.readouterr().out.split())
    assert "2 start, 0 pause, 2 gripper, 2 ga, 2 end" in printed
    assert "the histmv policy cannot train on it: it lacks depth images" in printed


def test_depth_without_a_single_measurement_is_reported(dense: Path, tmp_path: Path) -> None:
    blank = shutil.copytree(dense, tmp_path / "blank")

    def erase(cells: list[dict[str, bytes]]) -> None:
        cells[SEEN_AFTER_GRASP]["bytes"] = encode_depth(np.zeros((17, 19, 1), np.uint16))

    edit_column(blank, keys.depth_key("wrist"), erase)
    told = json.loads((keyframe(blank, tmp_path / "keys") / keys.KEYFRAMING_FILE).read_text())
    assert (
        f"episode 0, frame {SEEN_AFTER_GRASP}: {keys.depth_key('wrist')} has no valid depth at all" in told["notices"]
    )


def test_help_teaches_the_options(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["keyframe", "--help"])
    assert not stop.value.code
    printed = " ".join(capsys.readouterr().out.split())
    for part in (
        "--epsilon",
        "--columns.position",
        "--method {ga,exact,heuristic,rdp,awe,uniform}",
        "Accepted mean distance",
    ):
        assert part in printed
