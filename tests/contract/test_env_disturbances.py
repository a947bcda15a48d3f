"""Disturbances: off by default, as strong as asked, drawn from the seed, and beside the scene."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import draccus
import numpy as np
import pytest

pytest.importorskip("mujoco")

from test_env_ur5 import equal, places
from tiny_ur5 import AWAY, expert_actions, tiny

from lerobot_histmv.envs import UR5Env
from lerobot_histmv.envs.configuration_ur5 import UR5EnvConfig
from lerobot_histmv.envs.disturbances import Disturbances
from lerobot_histmv.envs.tasks.colors import COLORS

EVERYTHING = Disturbances(1, 1, 1, 1, 1, 1, 1, 2, 1, 1, 1)


@contextmanager
def disturbed(task: str = "pick_and_lift", **strengths: Any) -> Iterator[UR5Env]:
    env = tiny(task, disturbances=Disturbances(**strengths))
    yield env
    env.close()


def first(env: UR5Env, seed: int = 7) -> dict[str, Any]:
    return env.reset(seed=seed)[0]


@pytest.fixture(scope="module")
def clean() -> dict[str, Any]:
    with disturbed() as env:
        return first(env)


CHANGES = {
    "lighting": {"pixels"},
    "camera_pose": {"camera_extrinsics"},
    "camera_intrinsics": {"camera_intrinsics"},
    "rgb_noise": {"pixels"},
    "depth": {"front_depth", "left_shoulder_depth", "wrist_depth"},
    "moved_object": set(),
    "action_noise": set(),
    "gripper_delay": set(),
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_disturbance_changes_what_it_says_and_nothing_else(name: str, clean: dict[str, Any]) -> None:
    with disturbed(**{name: 1}) as env:
        observation = first(env)
    assert {key for key in clean if not equal(clean[key], observation[key])} == CHANGES[name]


def test_all_at_once_repeat_from_the_seed_and_leave_the_scene() -> None:
    with disturbed() as env:
        env.reset(seed=3)
        expected = places(env)
    runs = []
    for _ in range(2):
        with disturbed(**vars(EVERYTHING)) as env:
            observations = [env.reset(seed=3)[0]]
            assert {name: place for name, place in places(env).items() if name in expected} == expected
            observations += [env.step(action)[0] for action in expert_actions(env)]
        runs.append(observations)
    assert all(equal(one, other) for one, other in zip(*runs, strict=True))


def test_a_dead_camera_is_black_without_depth(clean: dict[str, Any]) -> None:
    with disturbed(dead_camera=1) as env:
        seen = [first(env, seed) for seed in range(23)]
    dead = [[camera for camera, image in one["pixels"].items() if not image.any()] for one in seen]
    assert all(
        len(cameras) == 1 and not one[f"{cameras[0]}_depth"].any() for one, cameras in zip(seen, dead, strict=True)
    )
    assert {camera for (camera,) in dead} == {"front", "left_shoulder", "wrist"}


def test_the_camera_that_suffers_may_be_named(clean: dict[str, Any]) -> None:
    with disturbed(dead_camera=1, camera="left_shoulder") as env:
        seen = [first(env, seed) for seed in range(5)]
    assert all(not one["pixels"]["left_shoulder"].any() and one["pixels"]["wrist"].any() for one in seen)
    with disturbed(occluder=1, camera="wrist") as env:
        observation = first(env)
    same = {camera: equal(image, observation["pixels"][camera]) for camera, image in clean["pixels"].items()}
    assert same == {"front": True, "left_shoulder": True, "wrist": False}
    with pytest.raises(ValueError, match=r"disturbances\.camera is 'side'; the cameras are \['front'"):
        tiny("pick_and_lift", disturbances=Disturbances(camera="side"))


def test_an_occluder_hides_part_of_one_fixed_camera(clean: dict[str, Any]) -> None:
    with disturbed(occluder=1) as env:
        observation = first(env)
    changed = [
        camera for camera in clean["pixels"] if not equal(clean["pixels"][camera], observation["pixels"][camera])
    ]
    assert changed in (["front"], ["left_shoulder"])


def test_distractors_lie_free_and_the_expert_still_succeeds() -> None:
    with disturbed(distractors=3) as env:
        for seed in range(3):
            env.reset(seed=seed)
            simulation = env.stage.simulation
            assert all(simulation.is_alone(f"distractor{i}") for i in range(3))
            for action in expert_actions(env):
                *_, info = env.step(action)
            assert info["is_success"]


def test_distractors_have_no_colour_that_is_named_or_kept_back() -> None:
    allowed = {rgb for color, rgb in COLORS.items() if color != "purple"}
    with disturbed("pick_and_lift.purple", distractors=6) as env:
        for seed in range(10):
            env.reset(seed=seed)
            colors = [env.stage.simulation.model.material(f"distractor{i}_paint").rgba[:3] for i in range(6)]
            assert all(np.isclose(list(allowed), color).all(axis=1).any() for color in colors)


def moved(before: dict[str, tuple[float, ...]], after: dict[str, tuple[float, ...]]) -> list[str]:
    gone = [name for name in before if before[name] != after[name]]
    assert all(0.02 < np.linalg.norm(np.subtract(before[name], after[name])) < 0.07 for name in gone)
    return gone


@pytest.mark.parametrize("control", ["macro", "servo"])
def test_an_object_is_moved_once_in_an_episode(control: str) -> None:
    env = tiny("pick_and_lift", control=control, disturbances=Disturbances(moved_object=1))
    env.reset(seed=1)
    before, moves = places(env), 0
    while env.stage.controller.ticks < 80:
        env.step(AWAY if env.stage.controller.ticks < 40 else AWAY * [1, -1, 1, 1, 1, 1, 1, 1])
        moves += len(moved(before, after := places(env)))
        before = after
    env.close()
    assert moves == 1


def test_the_expert_follows_a_moved_object_and_aims_with_the_noise() -> None:
    with disturbed(moved_object=1, action_noise=0.5) as env:
        succeeded, misses = [], []
        for seed in range(7):
            env.reset(seed=seed)
            for motion in env.expert():
                env.execute(motion)
                misses.append(env.stage.simulation.tool_pose().position - motion.target.position)
            succeeded.append(env.is_success())
    assert sum(succeeded) >= 6
    assert 0.001 < np.std(misses) < 0.004


def test_action_noise_moves_the_target_by_millimetres() -> None:
    with disturbed(action_noise=1) as env:
        env.reset(seed=1)
        misses = []
        for _ in range(20):
            observation, *_ = env.step(AWAY)
            misses.append(observation["agent_pos"][:3] - AWAY[:3])
            env.reset(seed=len(misses))
    assert 0.002 < np.std(misses) < 0.007


def test_a_late_gripper_is_still_closing_when_the_step_ends() -> None:
    openings = []
    for delay in (0, 2):
        with disturbed(gripper_delay=delay) as env:
            env.reset(seed=1)
            observation, *_ = env.step(AWAY * [1, 1, 1, 1, 1, 1, 1, 0])
            openings.append(observation["agent_pos"][7])
    assert openings[0] < 0.1 < openings[1]


@pytest.mark.parametrize(
    ("strengths", "message"),
    [
        ({"depth": -1}, r"disturbances\.depth is -1; it must not be negative"),
        ({"rgb_noise": float("nan")}, "rgb_noise is nan; it must be a finite number"),
        ({"lighting": "strong"}, "lighting is 'strong'; it must be a finite number"),
        ({"dead_camera": 1.5}, "probability"),
        ({"distractors": 9}, "a table holds 0 to 6"),
        ({"occluder": 4}, "nine tenths"),
    ],
)
def test_impossible_strengths_are_refused(strengths: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Disturbances(**strengths)


def test_strengths_come_from_the_command_line() -> None:
    config = draccus.parse(
        UR5EnvConfig, args=["--task=turn_tap", "--disturbances.depth=1", "--disturbances.distractors=2"]
    )
    assert config.gym_kwargs["disturbances"] == Disturbances(depth=1, distractors=2)
