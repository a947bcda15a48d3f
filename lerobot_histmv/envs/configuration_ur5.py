"""LeRobot's view of the tasks: ``--env.type=ur5 --env.task=pick_and_lift``."""

import multiprocessing
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import _LazyAsyncVectorEnv, freeze_after_episode_end
from lerobot.processor import PolicyProcessorPipeline
from lerobot.utils.constants import ACTION, OBS_STATE

from lerobot_histmv import keys
from lerobot_histmv.envs import UR5Env, make
from lerobot_histmv.envs.disturbances import Disturbances
from lerobot_histmv.envs.interface import ACTION_SIZE, CAMERA_NAMES, STATE_SIZE
from lerobot_histmv.envs.processor_ur5 import UR5DepthProcessorStep
from lerobot_histmv.envs.tasks import suites


@EnvConfig.register_subclass("ur5")
@dataclass
class UR5EnvConfig(EnvConfig):
    """UR5e tasks.

    Args:
        task: a task (turn_tap), a variation (turn_tap.left) or a suite (set1), or several joined by commas.
        fps: control ticks per second of simulated time; fixed.
        cameras: which of front, left_shoulder and wrist to render, in this order.
        image_size: width and height of the images [pixels].
        control: ``macro`` (one action = one whole motion) or ``servo`` (one action = one tick of 50 ms).
        variation: number of the variation to use always; None draws one per episode.
        instruction_split: paraphrases to draw from, ``train`` or ``held_out``.
        render_size: width and height of video frames [pixels].
        disturbances: strengths of what makes episodes harder, such as ``--env.disturbances.depth=1``.
        max_parallel_tasks: must stay 1: LeRobot would share one policy, and so one history, between tasks.
    """

    task: str | None = "pick_and_lift"
    fps: int = 20
    cameras: list[str] = field(default_factory=lambda: list(CAMERA_NAMES))
    image_size: int = 128
    control: str = "macro"
    variation: int | None = None
    instruction_split: str = "train"
    render_size: int = 256
    disturbances: Disturbances = field(default_factory=Disturbances)

    def __post_init__(self) -> None:
        """Check the options and describe observations and actions."""
        for task in self.tasks:
            UR5Env(task, **self.gym_kwargs)
        if self.fps != UR5Env.metadata["render_fps"]:
            raise ValueError(f"env.fps is {self.fps}; the simulated robot is controlled at 20 Hz")
        if self.max_parallel_tasks != 1:
            raise ValueError(
                f"env.max_parallel_tasks is {self.max_parallel_tasks}; it must be 1, "
                "because LeRobot shares one policy between parallel tasks and would mix their histories"
            )
        self._describe(ACTION, ACTION, FeatureType.ACTION, (ACTION_SIZE,))
        self._describe("agent_pos", OBS_STATE, FeatureType.STATE, (STATE_SIZE,))
        size, cameras = self.image_size, self.cameras
        for camera in cameras:
            self._describe(f"pixels/{camera}", keys.rgb_key(camera), FeatureType.VISUAL, (size, size, 3))
            depth = f"{camera}{keys.DEPTH_SUFFIX}"
            self._describe(depth, keys.depth_key(camera), FeatureType.VISUAL, (size, size, 1))
        for key, names in (
            (keys.INTRINSICS, keys.intrinsics_names(cameras)),
            (keys.EXTRINSICS, keys.extrinsics_names(cameras)),
        ):
            self._describe(key.removeprefix(keys.OBS_PREFIX), key, FeatureType.STATE, (len(names),))

    def _describe(self, name: str, key: str, kind: FeatureType, shape: tuple[int, ...]) -> None:
        self.features[name] = PolicyFeature(kind, shape)
        self.features_map[name] = key

    @property
    def tasks(self) -> list[str]:
        """Tasks and variations that ``task`` names; without a name, all tasks."""
        return suites.expand(self.task or "all")

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of ``UR5Env`` other than the task."""
        return {
            "cameras": tuple(self.cameras),
            "image_size": self.image_size,
            "control": self.control,
            "variation": self.variation,
            "instruction_split": self.instruction_split,
            "render_size": self.render_size,
            "disturbances": self.disturbances,
        }

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, Any]]:
        """``{task: {0: its vector environment}}``: LeRobot's results then name the tasks and variations.

        Finished sub-environments stand still.
        """
        vectorize = _asynchronous if use_async_envs and n_envs > 1 else _synchronous
        return {task: {0: vectorize([partial(make, task, **self.gym_kwargs)] * n_envs)} for task in self.tasks}

    def get_env_processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        """Observations get their dataset names; actions stay as they are."""
        return PolicyProcessorPipeline(steps=[UR5DepthProcessorStep()]), PolicyProcessorPipeline(steps=[])


def _asynchronous(factories: list[Callable[[], UR5Env]]) -> _LazyAsyncVectorEnv:
    """One process per environment, started at the first reset.

    Processes come from a server that has done the imports already, else each would spend seconds on them.
    """
    multiprocessing.get_context("forkserver").set_forkserver_preload([__name__, "lerobot_histmv.envs.stage"])
    return _LazyAsyncVectorEnv(factories)


def _synchronous(factories: list[Callable[[], UR5Env]]) -> gymnasium.vector.SyncVectorEnv:
    """All environments in this process."""
    return gymnasium.vector.SyncVectorEnv(
        [freeze_after_episode_end(factory) for factory in factories],
        autoreset_mode=gymnasium.vector.AutoresetMode.NEXT_STEP,
    )
