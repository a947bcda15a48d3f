"""Replaying key poses: scenes come from the recording, the environment decides, and what fails is told."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lerobot_histmv.envs
from dataset_tools.replay import Scenes, read_scenes, replay

SCENES = Scenes("push_buttons", seeds=(11, 13, 17), variations=(2, 3, 5))


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
    assert list(replay(SCENES, actions)) == [(0, ""), (2, "wrong object"), (1, "not finished")]
    assert env.resets == [(11, 2), (17, 5), (13, 3)]
    assert env.closed


def test_actions_that_are_no_tool_poses_are_refused(env: FakeEnv) -> None:
    with pytest.raises(ValueError, match=r"replay needs actions of ee\.x\.pos.*these have 4"):
        list(replay(SCENES, {0: np.zeros((2, 4), np.float32)}))
    assert env.closed


def test_scenes_are_read_from_the_recording(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="other data have no scene"):
        read_scenes(tmp_path, 3)
    told = {"settings": {"task": "push_buttons"}, "seeds": [11, 13, 17], "variations": [2, 3, 5]}
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta/recording.json").write_text(json.dumps(told))
    assert read_scenes(tmp_path, 3) == SCENES
    with pytest.raises(ValueError, match="tells 3 of 2"):
        read_scenes(tmp_path, 2)
