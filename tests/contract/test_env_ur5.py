"""What the class docstring of ``UR5Env`` promises, for every task."""

import pickle
import subprocess
import sys
import warnings
from collections.abc import Iterator

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

pytest.importorskip("mujoco")

from tiny_ur5 import AWAY, OUT_OF_REACH, SIZE, expert_actions, tiny

from lerobot_histmv import keys
from lerobot_histmv.envs import TASKS, UR5Env
from lerobot_histmv.envs.interface import REACH_HIGH, REACH_LOW


@pytest.fixture(scope="module", params=sorted(TASKS))
def env(request: pytest.FixtureRequest) -> Iterator[UR5Env]:
    """One environment per task, used again by each test."""
    built = tiny(request.param)
    yield built
    built.close()


@pytest.fixture(scope="module")
def lifting() -> Iterator[UR5Env]:
    built = tiny("pick_and_lift")
    yield built
    built.close()


def equal(first: object, second: object) -> bool:
    """Bit-equality of nested observations."""
    if isinstance(first, dict):
        return (
            isinstance(second, dict)
            and first.keys() == second.keys()
            and all(equal(first[k], second[k]) for k in first)
        )
    return bool(np.array_equal(first, second))


def roll_out(env: UR5Env) -> tuple[bool, int]:
    """Follow the expert in macro steps; success and number of steps."""
    for count, action in enumerate(expert_actions(env), start=1):
        _, _, terminated, truncated, info = env.step(action)
        assert not truncated
        if terminated:
            return info["is_success"], count
    return False, count


def test_gymnasium_finds_nothing_to_complain_about_but_absolute_poses(env: UR5Env) -> None:
    made = gymnasium.make(f"ur5/{env.task}-v0", image_size=SIZE, render_size=SIZE)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(made.unwrapped)
    made.close()
    messages = [str(warning.message) for warning in caught]
    assert [message for message in messages if "symmetric and normalized space" not in message] == []


@pytest.mark.parametrize("seed", (500_000, 500_001))
def test_experts_succeed_blended_and_in_macro_steps(env: UR5Env, seed: int) -> None:
    env.reset(seed=seed)
    for motion in env.expert():
        env.execute(motion)
    assert env.is_success()
    _, info = env.reset(seed=seed)
    success, steps = roll_out(env)
    assert success
    assert steps <= TASKS[env.task].macro_steps(info["variation"])


def test_the_same_seed_gives_the_same_episode_in_fresh_and_used_environments(env: UR5Env) -> None:
    fresh = tiny(env.task)
    env.reset(seed=3)
    env.step(AWAY)
    results = []
    for candidate in (env, fresh):
        observation, info = candidate.reset(seed=11)
        results.append([(observation, info)])
        for action in expert_actions(candidate):
            results[-1].append(candidate.step(action))
    fresh.close()
    for first, second in zip(*results, strict=True):
        assert equal(first[0], second[0])
        assert first[1:] == second[1:]


def places(env: UR5Env) -> dict[str, tuple[float, ...]]:
    """Where the scene's objects are [m]."""
    simulation = env.stage.simulation
    return {name: tuple(np.round(simulation.position(name), 3).tolist()) for name in env.stage.task.objects}


def test_different_seeds_give_different_scenes_that_are_not_solved(env: UR5Env) -> None:
    scenes = set()
    for seed in range(5):
        env.reset(seed=seed)
        assert not env.is_success()
        scenes.add(tuple(places(env).values()))
    assert len(scenes) == 5


def test_objects_rest_where_they_were_put(env: UR5Env) -> None:
    for seed in range(3):
        env.reset(seed=seed)
        before = places(env)
        env.stage.controller.hold(11)
        for name, place in places(env).items():
            np.testing.assert_allclose(place, before[name], atol=0.003, err_msg=f"{name} moves by itself")


def test_objects_named_by_colour_lie_apart_in_the_documented_area() -> None:
    for name in ("reach_target", "push_buttons", "pick_and_lift", "pick_up_cup", "stack_cups"):
        env = tiny(name)
        for seed in range(11):
            env.reset(seed=seed)
            slots = env.stage.task.slots
            where = np.array([env.stage.simulation.position(slot)[:2] for slot in slots])
            assert (where >= [0.299, -0.281]).all()
            assert (where <= [0.601, 0.281]).all()
            assert min(np.linalg.norm(where[i] - where[j]) for i in range(3) for j in range(i)) >= 0.0999
            paints = [tuple(env.stage.simulation.model.material(f"{slot}_paint").rgba) for slot in slots]
            assert len(set(paints)) == 3
        env.close()


def test_fixing_the_variation_leaves_the_places(env: UR5Env) -> None:
    last = len(TASKS[env.task].variations) - 1
    scenes = []
    for variation in (0, last):
        _, info = env.reset(seed=7, options={"variation": variation})
        assert info["variation"] == variation
        assert info["instruction"] in TASKS[env.task].instructions(variation, "train")
        scenes.append(sorted(place for place in places(env).values() if place[2] > -0.5))
    assert scenes[0] == scenes[1], "of what is not kept under the table"


def test_the_documented_start_is_true(env: UR5Env) -> None:
    observation, info = env.reset(seed=5)
    state = observation["agent_pos"]
    np.testing.assert_allclose(state[:3], [0.28, 0, 0.40], atol=0.002)
    np.testing.assert_allclose(state[3:7], [1, 0, 0, 0], atol=1e-3)
    assert state[7] == pytest.approx(TASKS[env.task].initial_gripper, abs=0.05)
    assert info | {"is_success": False, "failure": "", "ticks": 0} == info
    assert env.observation_space.contains(observation)


def test_doing_nothing_fails_after_twice_the_experts_steps(env: UR5Env) -> None:
    _, info = env.reset(seed=9)
    limit = 2 * TASKS[env.task].macro_steps(info["variation"])
    for count in range(1, limit + 1):
        _, reward, terminated, truncated, info = env.step(AWAY)
        assert (reward, terminated, truncated, info["is_success"]) == (0, False, count == limit, False)
        assert info["failure"] == ("not reached" if truncated else "")
    assert limit <= env._max_episode_steps


def test_a_pose_out_of_reach_leaves_the_arm_and_is_told(env: UR5Env) -> None:
    before, info = env.reset(seed=2)
    truncated = False
    while not truncated:
        after, _, _, truncated, info = env.step(OUT_OF_REACH)
    np.testing.assert_allclose(after["agent_pos"][:7], before["agent_pos"][:7], atol=1e-3)
    assert info["failure"] == "ik"


def test_pickling_keeps_the_options_and_wants_a_reset(env: UR5Env) -> None:
    env.reset(seed=1)
    copy = pickle.loads(pickle.dumps(env))
    with pytest.raises(gymnasium.error.ResetNeeded):
        copy.step(AWAY)
    expected, info = env.reset(seed=4)
    observation, copied_info = copy.reset(seed=4)
    copy.close()
    assert equal(observation, expected)
    assert copied_info == info


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(7), r"shape \(7,\)"),
        (np.full(8, np.nan), "not finite"),
        (np.array([0.4, 0, np.inf, 1, 0, 0, 0, 1]), "not finite"),
        (np.array([0.4, 0, 0.2, 0, 0, 0, 0, 1]), "length 0"),
    ],
)
def test_impossible_actions_are_refused(lifting: UR5Env, action: np.ndarray, message: str) -> None:
    lifting.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        lifting.step(action)


def test_positions_are_clipped_and_quaternions_normalised(lifting: UR5Env) -> None:
    lifting.reset(seed=0)
    observation, *_ = lifting.step(np.array([-9, 0, 0.3, 0.3, 0, 0, 0, 1]))
    np.testing.assert_allclose(observation["agent_pos"][:3], [REACH_LOW[0], 0, 0.3], atol=0.003)


def test_wild_actions_break_nothing() -> None:
    env = tiny("pick_and_lift")
    env.action_space.seed(0)
    for seed in range(2):
        env.reset(seed=seed)
        for index in range(8):
            action = env.action_space.sample()
            if index % 2:
                action[2:7] = REACH_LOW[2], 1, 0, 0, 0
            observation, *_ = env.step(action)
            assert env.observation_space.contains(observation)
    simulation = env.stage.simulation
    assert np.abs([simulation.position(name) for name in env.stage.task.objects]).max() < 2
    assert (simulation.data.warning.number == 0).all()
    assert (simulation.tool_pose().position < REACH_HIGH + 0.2).all()
    env.close()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "juggle"}, "accepted are reach_target, push_buttons, pick_and_lift, "),
        ({"task": "pick_and_lift", "cameras": ("front", "back")}, "front, left_shoulder, wrist"),
        ({"task": "pick_and_lift", "cameras": ()}, "different names"),
        ({"task": "pick_and_lift", "control": "torque"}, "macro, servo"),
        ({"task": "turn_tap."}, "turn_tap.left, turn_tap.right"),
        ({"task": "pick_and_lift", "variation": 6}, "0 to 5"),
        ({"task": "turn_tap", "variation": "left"}, "turn_tap.left, turn_tap.right"),
        ({"task": "pick_and_lift", "variation": 0.5}, "variation 0.5"),
        ({"task": "pick_and_lift", "image_size": 4}, "between 8 and 1024"),
        ({"task": "pick_and_lift", "render_size": 64.5}, "render_size is 64.5; it must be a whole number"),
        ({"task": "pick_and_lift", "instruction_split": "test"}, "train, held_out"),
    ],
)
def test_options_are_checked(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        UR5Env(**options)


def test_servo_control_replays_a_recorded_expert() -> None:
    recorder, player = tiny("pick_and_lift"), tiny("pick_and_lift", control="servo")
    recorder.reset(seed=8)
    actions = []
    for motion in recorder.expert():
        recorder.execute(motion, on_tick=lambda tick: actions.append(tick.action))
    player.reset(seed=8)
    ends = [player.step(action)[2] for action in actions]
    assert any(ends)
    recorder.close()
    player.close()


def test_frames_between_steps_are_kept_on_request(lifting: UR5Env) -> None:
    lifting.record_substeps = True
    _, info = lifting.reset(seed=1)
    assert len(lifting.substep_frames()) == 1
    *_, info = lifting.step(AWAY)
    frames = lifting.substep_frames()
    lifting.record_substeps = False
    assert len(frames) == info["ticks"]
    assert frames[0].shape == (SIZE, SIZE, 3)
    np.testing.assert_array_equal(frames[-1], lifting.render())
    lifting.step(AWAY)
    assert lifting.substep_frames() == []


def test_observing_between_ticks_changes_nothing(lifting: UR5Env) -> None:
    ends = []
    for on_tick in (None, lambda _: lifting.observe()):
        lifting.reset(seed=12)
        for motion in lifting.expert():
            lifting.execute(motion, on_tick)
        ends.append(lifting.stage.simulation.data.qpos.copy())
    np.testing.assert_array_equal(*ends)


def test_cameras_are_an_option() -> None:
    env = tiny("reach_target", cameras=("front", "wrist"))
    observation, _ = env.reset(seed=0)
    assert list(observation["pixels"]) == ["front", "wrist"]
    assert len(observation["camera_intrinsics"]) == len(keys.intrinsics_names(env.cameras))
    assert env.observation_space.contains(observation)
    env.close()


def test_importing_the_package_does_not_import_mujoco() -> None:
    probe = "import os, sys, lerobot_histmv.envs; print('mujoco' in sys.modules, os.environ['MUJOCO_GL'])"
    clean = {"PATH": "", "PYTHONPATH": ":".join(sys.path)}
    result = subprocess.run([sys.executable, "-c", probe], env=clean, capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["False", "egl"]
