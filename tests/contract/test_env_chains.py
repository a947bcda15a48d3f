"""Chains: tasks in one scene, done in order, each stage reported."""

import pytest

pytest.importorskip("mujoco")

from tiny_ur5 import AWAY, expert_actions, tiny

from lerobot_histmv.envs.tasks import TASKS
from lerobot_histmv.envs.tasks.base import Region
from lerobot_histmv.envs.tasks.chain import Chain, Stage

CHAINS = [name for name, task in TASKS.items() if issubclass(task, Chain)]


@pytest.mark.parametrize("name", CHAINS)
def test_chains_are_long(name: str) -> None:
    env = tiny(name)
    assert env.task_class.macro_steps(0) >= 20
    env.reset(seed=500_000)
    for motion in env.expert():
        env.execute(motion)
    assert env.is_success()
    assert env.stage.controller.ticks > 100
    env.close()


def test_stages_are_done_one_after_the_other() -> None:
    env = tiny("kitchen")
    _, info = env.reset(seed=1)
    names = [stage.task.name for stage in TASKS["kitchen"].stages]
    assert info["stages"] == dict.fromkeys(names, False)
    done = []
    for action in expert_actions(env):
        *_, info = env.step(action)
        done.append(sum(info["stages"].values()))
        assert list(info["stages"].values()) == sorted(info["stages"].values(), reverse=True)
    assert done == sorted(done)
    assert set(done) == {0, 1, 2, 3}
    env.close()


def test_a_later_stage_does_not_count_before_its_turn() -> None:
    env = tiny("kitchen")
    env.reset(seed=1)
    tap = env.stage.task._tasks[1]
    for motion in tap.expert(env.stage.simulation):
        env.execute(motion)
    assert tap.is_success(env.stage.simulation)
    *_, info = env.step(AWAY)
    assert not any(info["stages"].values())
    env.close()


def test_objects_of_two_stages_must_have_different_names() -> None:
    with pytest.raises(TypeError, match="Twice have objects of the same name"):

        class Twice(Chain):
            stages = (Stage(TASKS["turn_tap"]), Stage(TASKS["turn_tap"], {"tap": Region((0.4, 0.4), (0.2, 0.2))}))
