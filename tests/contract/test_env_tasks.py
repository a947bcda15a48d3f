"""When tasks count as fulfilled, and what is said of those that are not."""

from collections.abc import Iterator
from itertools import islice

import numpy as np
import pytest

pytest.importorskip("mujoco")

from tiny_ur5 import AWAY, above, act_until_the_end, expert_actions, tiny

from lerobot_histmv.envs import UR5Env
from lerobot_histmv.envs.tasks.stack_blocks import SIDE
from lerobot_histmv.motion import Motion, top_down


@pytest.fixture(scope="module")
def lifting() -> Iterator[UR5Env]:
    built = tiny("pick_and_lift")
    yield built
    built.close()


def test_never_closing_the_gripper_lifts_nothing(lifting: UR5Env) -> None:
    lifting.reset(seed=500_001)
    for action in expert_actions(lifting):
        action[7] = 1
        _, _, terminated, _, _ = lifting.step(action)
        assert not terminated


def test_why_lifting_failed(lifting: UR5Env) -> None:
    lifting.reset(seed=6)
    target = lifting.stage.simulation.position(lifting.stage.task.targets[0])
    assert act_until_the_end(lifting, [above(target, 0.2, 0)]) == "grasp missed"

    lifting.reset(seed=6)
    grasp = list(islice(expert_actions(lifting), 2))
    assert act_until_the_end(lifting, grasp) == "time"

    lifting.reset(seed=6)
    task = lifting.stage.task
    task.slots[:2] = task.slots[1::-1]
    grasp = list(islice(expert_actions(lifting), 2))
    task.slots[:2] = task.slots[1::-1]
    assert act_until_the_end(lifting, grasp) == "wrong object"


@pytest.fixture(scope="module")
def two_buttons() -> Iterator[UR5Env]:
    built = tiny("push_buttons", variation=6)
    yield built
    built.close()


@pytest.mark.parametrize(
    ("slots", "success"),
    [((0, 1), True), ((0, 0, 1), True), ((1, 0), False), ((0, 2, 1), False), ((0,), False)],
    ids=["in order", "the first one twice", "reversed", "a third one between", "one missing"],
)
def test_buttons_must_be_pressed_in_order(two_buttons: UR5Env, slots: tuple[int, ...], success: bool) -> None:
    two_buttons.reset(seed=1)
    places = [two_buttons.stage.simulation.position(name) for name in two_buttons.stage.task.slots]
    for slot in slots:
        two_buttons.step(above(places[slot], 0.14, 0))
        *_, info = two_buttons.step(above(places[slot], 0.032, 0))
    assert info["is_success"] == success
    assert info["failure"] == ""


@pytest.mark.parametrize(("slot", "failure"), [(0, "time"), (1, "wrong object"), (2, "wrong object")])
def test_why_pushing_failed(two_buttons: UR5Env, slot: int, failure: str) -> None:
    two_buttons.reset(seed=1)
    place = two_buttons.stage.simulation.position(two_buttons.stage.task.slots[slot])
    assert act_until_the_end(two_buttons, [above(place, 0.14, 0), above(place, 0.032, 0)]) == failure


def test_over_a_button_only_the_past_tells_whether_it_was_pressed(two_buttons: UR5Env) -> None:
    two_buttons.reset(seed=1)
    over, push, back = islice(expert_actions(two_buttons), 3)
    before, *_ = two_buttons.step(over)
    two_buttons.step(push)
    assert two_buttons.stage.task.failure() == "time", "one of two is pressed"
    after, *_ = two_buttons.step(back)
    np.testing.assert_allclose(before["agent_pos"][:8], after["agent_pos"][:8], atol=3e-3)  # the arm lags by 2 mm
    away = AWAY * [1, 1, 1, 1, 1, 1, 1, 0]
    seen, *_ = two_buttons.step(away)
    two_buttons.reset(seed=1)
    unpressed, *_ = two_buttons.step(away)
    np.testing.assert_allclose(unpressed["pixels"]["front"], seen["pixels"]["front"], atol=1)


def test_a_stack_does_not_count_while_anything_is_held() -> None:
    env = tiny("stack_blocks.two-red")
    env.reset(seed=1)
    task, simulation = env.stage.task, env.stage.simulation
    other = top_down(simulation.position(task.unwanted[0]), simulation.yaw(task.unwanted[0]))
    env.execute(Motion(via=(other.raised(0.12),), target=other, gripper=0.0))
    assert simulation.gripped(task.unwanted[0])
    for level, name in enumerate(task.wanted[:2]):
        simulation.place_free(name, simulation.position("plane") + np.array([0, 0, SIDE * (level + 0.5)]), 0)
    simulation.refresh()
    assert not env.is_success()
    env.execute(Motion(via=(), target=simulation.tool_pose(), gripper=1.0))
    assert env.is_success()
    env.close()


def test_why_reaching_failed() -> None:
    env = tiny("reach_target")
    env.reset(seed=0)
    x, y, z = env.stage.simulation.position(env.stage.task.distractors[0])
    assert act_until_the_end(env, [above(np.array([x, y]), z, 1)]) == "wrong object"
    env.close()
