"""LeRobot's side of the environments: configuration, vector environments and the names of observations."""

from dataclasses import dataclass

import draccus
import numpy as np
import pytest

pytest.importorskip("mujoco")

from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import env_to_policy_features, preprocess_observation

from lerobot_histmv import keys
from lerobot_histmv.envs.configuration_ur5 import UR5EnvConfig

SIZE = 13
HOLD = np.array([0.28, 0, 0.4, 1, 0, 0, 0, 1], np.float32)


@dataclass
class Command:
    """What LeRobot's scripts nest an environment in."""

    env: EnvConfig


def test_the_command_line_makes_a_configuration() -> None:
    flags = ["--env.type=ur5", "--env.task=reach_target,pick_and_lift", "--env.cameras=[front, wrist]"]
    config = draccus.parse(Command, args=[*flags, "--env.image_size=31"]).env
    assert isinstance(config, UR5EnvConfig)
    assert config.tasks == ["reach_target", "pick_and_lift"]
    assert config.gym_kwargs["cameras"] == ("front", "wrist")
    again = draccus.decode(EnvConfig, draccus.encode(config, EnvConfig))
    assert again == config


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "juggle"}, "juggle"),
        ({"max_parallel_tasks": 2}, "histories"),
        ({"fps": 30}, "20 Hz"),
        ({"cameras": ["ceiling"]}, "ceiling"),
        ({"cameras": ["wrist", "front"]}, "in this order"),
    ],
)
def test_bad_options_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        UR5EnvConfig(**options)


@pytest.mark.parametrize("asynchronous", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["sync", "async"])
def test_vector_environments_speak_the_datasets_language(asynchronous: bool) -> None:
    config = UR5EnvConfig(task="reach_target", image_size=SIZE, render_size=SIZE, cameras=["front", "wrist"])
    (vector,) = config.create_envs(2, use_async_envs=asynchronous)["reach_target"].values()
    processor, _ = config.get_env_processors()
    try:
        observation, info = vector.reset(seed=[3, 5])
        assert not info["is_success"].any()
        assert list(vector.call("task_description")) == list(info["instruction"])
        assert vector.call("_max_episode_steps") == (4, 4)
        for _ in range(4):
            observation, _, terminated, truncated, info = vector.step(np.stack([HOLD, HOLD]))
        assert (truncated | terminated).all()
        assert list(info["failure"]) == ["not reached"] * 2
        batch = processor(preprocess_observation(observation))
    finally:
        vector.close()
    features = env_to_policy_features(config)
    observed = {key: value for key, value in batch.items() if key.startswith(keys.OBS_PREFIX)}
    assert set(observed) == set(features) - {keys.ACTION}
    for key, value in observed.items():
        assert tuple(value.shape) == (2, *features[key].shape)
    depth = batch[keys.depth_key("front")]
    np.testing.assert_array_equal(depth[:, 0], observation["front_depth"][..., 0])
    assert 400 < depth.median() < 2000


def test_scenes_do_not_depend_on_how_environments_are_run() -> None:
    config = UR5EnvConfig(task="pick_and_lift", image_size=SIZE, render_size=SIZE)
    images = []
    for count, seeds in ((2, [7, 8]), (1, [8])):
        (vector,) = config.create_envs(count)["pick_and_lift"].values()
        observation, _ = vector.reset(seed=seeds)
        images.append(observation["pixels"]["front"][-1])
        vector.close()
    np.testing.assert_array_equal(*images)


def test_a_suite_names_its_tasks_and_variations() -> None:
    envs = UR5EnvConfig(task="set1", image_size=SIZE, render_size=SIZE).create_envs(1)
    assert list(envs)[:3] == ["turn_tap.left", "turn_tap.right", "stack_cups.red"]
    assert all(list(group) == [0] for group in envs.values())
    assert all(group[0].get_attr("task") == (name,) for name, group in envs.items())
