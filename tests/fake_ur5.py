"""A stand-in with the UR5 environments' interface without a simulator, and checkpoints of tiny untrained policies."""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end
from lerobot.policies import make_pre_post_processors
from lerobot.processor import ObservationProcessorStep, PolicyProcessorPipeline
from tiny_policy import tiny_config, tiny_policy
from tiny_scene import SEEN, SIZE, cameras_around

from lerobot_histmv import keys

CAMERAS = ("front", "wrist")
INSTRUCTION = "lift the fake cube"
FAILURES = ("wrong object", "grasp missed", "not reached")
FRAMES_PER_STEP = 3


class FakeUR5(gymnasium.Env):
    """The seed decides what the cameras see, how long an episode is and how it ends; actions decide where the tool is.

    The reward is the first number of the action, so that it tells whether the policy saw the right observations. Pixels
    do not depend on actions: rounding them to integers would turn float noise into visible differences.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 20}
    render_mode = "rgb_array"
    _max_episode_steps = 5

    def __init__(self, task: str = "fake_lift", cameras: tuple[str, ...] = CAMERAS) -> None:
        self.task, self.task_description = task, INSTRUCTION
        self.cameras = cameras
        self.record_substeps = False
        rows, columns = SIZE
        self.action_space = spaces.Box(-1, 1, (8,), np.float32)
        floats = {"agent_pos": 14, "camera_intrinsics": 4 * len(cameras), "camera_extrinsics": 12 * len(cameras)}
        self.observation_space = spaces.Dict(
            {name: spaces.Box(-np.inf, np.inf, (n,), np.float32) for name, n in floats.items()}
            | {f"{name}_depth": spaces.Box(0, 65535, (rows, columns, 1), np.uint16) for name in cameras}
            | {"pixels": spaces.Dict({name: spaces.Box(0, 255, (rows, columns, 3), np.uint8) for name in cameras})}
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.scene = np.random.default_rng(seed)
        self.variation, self.length = int(self.scene.integers(3)), int(self.scene.integers(2, 6))
        self.outcome = (*FAILURES, "")[int(self.np_random_seed) % 4]
        self.tool = SEEN.numpy().copy()
        self.steps = 0
        return self._observe(), self._info(False)

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.tool = 0.7 * self.tool + 0.3 * action[:3]
        self.steps += 1
        ended = self.steps == self.length
        success = ended and not self.outcome
        return self._observe(), float(action[0]), success, ended and not success, self._info(ended)

    def _info(self, ended: bool) -> dict[str, Any]:
        success = ended and not self.outcome
        return {"is_success": success, "failure": self.outcome if ended else "", "variation": self.variation}

    def _observe(self) -> dict[str, Any]:
        intrinsics, extrinsics = cameras_around(len(self.cameras))
        noise = {name: self.scene.random((*SIZE, 3)) for name in self.cameras}
        return {
            "agent_pos": np.concatenate([self.tool, [1], np.zeros(10)]).astype(np.float32),
            "camera_intrinsics": intrinsics.numpy().ravel(),
            "camera_extrinsics": extrinsics.numpy().ravel(),
            "pixels": {name: (250 * noise[name]).astype(np.uint8) for name in self.cameras},
            **{f"{name}_depth": (350 + 300 * noise[name][..., :1]).astype(np.uint16) for name in self.cameras},
        }

    def substep_frames(self) -> list[np.ndarray]:
        frame = np.full((16, 16, 3), 40 * self.steps, np.uint8)
        return [frame] * (FRAMES_PER_STEP if self.steps else 1) if self.record_substeps else []

    def render(self) -> np.ndarray:
        return np.zeros((16, 16, 3), np.uint8)


class FakeDepthStep(ObservationProcessorStep):
    """What the UR5 environments' processor does: depth images become channel-first image features."""

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        return {
            f"observation.images.{key.removeprefix('observation.')}" if key.endswith("_depth") else key: (
                value.permute(0, 3, 1, 2) if key.endswith("_depth") else value
            )
            for key, value in observation.items()
        }

    def transform_features(self, features: Any) -> Any:
        return features


def visual(channels: int) -> PolicyFeature:
    return PolicyFeature(FeatureType.VISUAL, (*SIZE, channels))


@EnvConfig.register_subclass("fake_ur5")
@dataclass
class FakeUR5Config(EnvConfig):
    """Environments of comma-separated tasks."""

    task: str | None = "fake_lift"
    cameras: list[str] = field(default_factory=lambda: list(CAMERAS))
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = self.cameras
        vectors = {"agent_pos": 14, "camera_intrinsics": 4 * len(names), "camera_extrinsics": 12 * len(names)}
        mapping = dict(zip(vectors, (keys.STATE, keys.INTRINSICS, keys.EXTRINSICS), strict=True))
        self.features = {"action": PolicyFeature(FeatureType.ACTION, (8,))}
        self.features |= {name: PolicyFeature(FeatureType.STATE, (n,)) for name, n in vectors.items()}
        self.features_map = {"action": "action", **mapping}
        for camera in names:
            self.features |= {f"pixels/{camera}": visual(3), f"{camera}_depth": visual(1)}
            self.features_map |= {
                f"pixels/{camera}": keys.rgb_key(camera),
                f"{camera}_depth": keys.depth_key(camera),
            }

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {"cameras": tuple(self.cameras)}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, SyncVectorEnv]]:
        tasks = str(self.task).split(",")
        make = [freeze_after_episode_end(partial(FakeUR5, task, **self.gym_kwargs)) for task in tasks]
        return {
            self.type: {
                index: SyncVectorEnv([make[index]] * n_envs, autoreset_mode=AutoresetMode.NEXT_STEP)
                for index in range(len(tasks))
            }
        }

    def get_env_processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        return PolicyProcessorPipeline(steps=[FakeDepthStep()]), PolicyProcessorPipeline(steps=[])


def write_checkpoint(folder: Path, seed: int = 0, size: tuple[int, int] = SIZE) -> Path:
    """Save a tiny, untrained policy for images of ``size`` with its processors, as lerobot-train saves it."""
    config = tiny_config(list(CAMERAS), instructions={INSTRUCTION: [INSTRUCTION]})
    for feature in config.image_features.values():
        feature.shape = (feature.shape[0], *size)
    policy = tiny_policy(config, seed)
    policy.save_pretrained(folder)
    for processor in make_pre_post_processors(policy.config):
        processor.save_pretrained(folder)
    return folder
