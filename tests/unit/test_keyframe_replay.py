"""Replaying key poses: scenes come from the recording, the environment decides, and what fails is told."""

import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lerobot_histmv.envs
from dataset_tools import replay_check
from dataset_tools.columns import Column, Columns
from dataset_tools.keyframe import without_failures
from dataset_tools.keyframe_shards import Keyframed
from dataset_tools.keyframes import KeyframeOptions, extract
from dataset_tools.replay import Replayer, Scenes, read_scenes
from dataset_tools.report import Report
from dataset_tools.signals import Trajectory
from lerobot_histmv.envs.disturbances import Disturbances

SCENES = Scenes(("push_buttons", "turn_tap.left", "push_buttons"), seeds=(11, 13, 17), variations=(2, 3, 5))


class FakeEnv:
    """Succeeds at the step whose x equals the scene's seed; gives up after three steps."""

    def __init__(self) -> None:
        self.resets: list[tuple[int, int]] = []
        self.closed = False

    def reset(self, seed: int, options: dict[str, int]) -> None:
        self.resets.append((seed, options["variation"]))
        self.steps = 0

    def step(self, action: np.ndarray) -> tuple[None, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        success = bool(action[0] == self.resets[-1][0])
        gives_up = not success and self.steps == 3
        return None, 0.0, success, gives_up, {"is_success": success, "failure": "wrong object" if gives_up else ""}

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def env(monkeypatch: pytest.MonkeyPatch) -> FakeEnv:
    fake = FakeEnv()
    monkeypatch.setattr(lerobot_histmv.envs, "make", lambda task, **_: fake)
    return fake


def rows(*x: float) -> np.ndarray:
    return np.array([[value, 0, 0, 1, 0, 0, 0, 1] for value in x], dtype=np.float32)


def test_each_episode_is_replayed_in_its_own_scene_until_it_succeeds_or_ends(env: FakeEnv) -> None:
    actions = {0: rows(5, 11, 99), 2: rows(1, 2, 3, 17), 1: rows(5)}
    with closing(Replayer(SCENES)) as replayer:
        failures = {episode: replayer.failure(episode, action) for episode, action in actions.items()}
    assert failures == {0: "", 2: "wrong object", 1: "not finished"}
    assert env.resets == [(11, 2), (17, 5), (13, 3)]
    assert env.closed


def test_actions_that_are_no_tool_poses_are_refused(env: FakeEnv) -> None:
    with pytest.raises(ValueError, match=r"replay needs actions of ee\.x\.pos.*these have 4"):
        Replayer(SCENES).failure(0, np.zeros((2, 4), np.float32))


def test_scenes_are_read_from_the_recording(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="other data have no scene"):
        read_scenes(tmp_path / "recording.json", 3)
    told = {
        "settings": {"disturbances": {"distractors": 2}}, "tasks": list(SCENES.tasks),
        "seeds": [11, 13, 17], "variations": [2, 3, 5],
    }  # fmt: skip
    path = tmp_path / "recording.json"
    path.write_text(json.dumps(told))
    assert read_scenes(path, 3) == read_scenes(path) == replace(SCENES, disturbances=Disturbances(distractors=2))
    with pytest.raises(ValueError, match="tells 3 of 2"):
        read_scenes(path, 2)


def test_what_fails_in_replay_is_told_with_what_became_of_it() -> None:
    columns = Columns(Column("state", (0, 1, 2)), False, None, "", None, None)
    one = extract(Trajectory(np.linspace([0.0, 0, 0], [1, 0, 0], 7), 20.0), KeyframeOptions())
    kept = {0: one, 2: one}
    report = Report(KeyframeOptions(), "me/demos", columns, kept, {0: "", 1: "grasp missed", 2: "time"}, [])
    told = "\n".join(report.summary())
    assert "succeed in 1 of 3 episodes" in told
    assert "episode 1: its key poses fail in replay (grasp missed); left out" in told
    assert "episode 2: its key poses fail in replay (time); kept" in told
    assert report.as_json()["replay"] == {"0": "", "1": "grasp missed", "2": "time"}
    done = [Keyframed(number, one, failure, (), {}, ()) for number, failure in ((0, ""), (1, "time"))]
    assert without_failures(done) == done[:1]
    with pytest.raises(ValueError, match="no episode's key poses succeed"):
        without_failures(done[1:])


def test_a_folder_without_a_dataset_is_told(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no LeRobot dataset at"):
        replay_check.run(replay_check.ReplayConfig(replay_check.KeyframedConfig("test/keys", tmp_path)))
