"""A trained policy with the processors around it, checked against the environment before anything is simulated."""

import hashlib
import io
import time
from collections.abc import Sequence
from contextlib import nullcontext, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import torch
from huggingface_hub import snapshot_download
from jaxtyping import Float
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.envs import make_env_pre_post_processors, preprocess_observation
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import env_to_policy_features
from lerobot.policies import PreTrainedPolicy, make_pre_post_processors
from lerobot.policies.factory import get_policy_class
from lerobot.utils.constants import ACTION
from torch import Tensor

from dataset_tools.hub import repositories
from lerobot_histmv import _plugin  # noqa: F401  (registers the policy, its processors and the environments)

WEIGHTS, CONFIG = "model.safetensors", "config.json"
RUN_PARTS = ("pretrained_model", "checkpoints/last/pretrained_model", "last/pretrained_model")
"""Where a checkpoint lies below the folders that one easily names instead of it."""
UNRELATED = ("device", "pretrained_path", "pretrained_revision", "push_to_hub", "repo_id", "private", "tags", "license")
"""Fields of a policy's configuration that do not change what it does."""


@dataclass
class PolicySource:
    """Which policy to evaluate."""

    # folder of a checkpoint (outputs/train/.../checkpoints/last/pretrained_model), or a model on the Hub
    path: str = ""
    # options that differ from the checkpoint's; on the command line each by its name, as --policy.device=cpu
    overrides: list[str] = field(default_factory=list)


def checkpoint_folder(path: str) -> Path:
    """Local folder of the checkpoint ``path``; a model on the Hub is downloaded.

    Raises:
        ValueError: there is no checkpoint, here or on the Hub.
    """
    local = Path(path).expanduser()
    if not path:
        raise ValueError("name the checkpoint: --policy.path=outputs/train/.../checkpoints/last/pretrained_model")
    if (local / CONFIG).is_file() and (local / WEIGHTS).is_file():
        return local
    if local.is_dir():
        inside = [str(local / part) for part in RUN_PARTS if (local / part / CONFIG).is_file()]
        hint = f"; did you mean --policy.path={inside[0]}?" if inside else ""
        raise ValueError(f"{path} is no checkpoint: it lacks {CONFIG} or {WEIGHTS}{hint}")
    if path.count("/") != 1 or path.startswith((".", "/", "~")):
        raise ValueError(f"there is no folder {path}; a checkpoint is a folder with {CONFIG} and {WEIGHTS}")
    with repositories.explained(path):
        return Path(snapshot_download(path))


def load_config(source: PolicySource) -> PreTrainedConfig:
    """The checkpoint's configuration with ``source.overrides`` applied; ``pretrained_path`` is its local folder."""
    folder = checkpoint_folder(source.path)
    config = PreTrainedConfig.from_pretrained(folder, cli_overrides=source.overrides)
    config.pretrained_path = folder
    return config


def load_policy(config: PreTrainedConfig) -> PreTrainedPolicy:
    """The policy in evaluation mode, with exactly the weights of its checkpoint.

    Raises:
        ValueError: weights are missing, left over or of another size: the checkpoint is of another configuration.
    """
    try:
        with redirect_stdout(io.StringIO()):
            return get_policy_class(config.type).from_pretrained(config.pretrained_path, config=config, strict=True)
    except RuntimeError as error:
        raise ValueError(
            f"the weights in {config.pretrained_path} do not fit the configuration they are loaded with; leave out "
            f"--policy options that change the network ({error})"
        ) from error


def check_fits(policy: PreTrainedConfig, env: EnvConfig) -> None:
    """Refuse an environment whose cameras, sizes, camera order or control the policy would fail on or, worse, misread.

    Raises:
        ValueError: names what differs and the option that cures it.
    """
    if policy.type == "histmv":
        control = getattr(env, "control", "macro")
        rate = 0 if control == "macro" else env.fps
        if policy.control.rate != rate:
            raise ValueError(
                f"policy.control.rate={policy.control.rate:g} does not fit env.control={control}: "
                f"set --policy.control.rate={rate} or another --env.control (macro: a step is a whole motion, rate 0; "
                f"servo: a step is one of {env.fps} ticks per second)"
            )
    offered = env_to_policy_features(env)
    wanted = policy.input_features or {}
    cameras, env_cameras = (list(getattr(config, "cameras", [])) for config in (policy, env))
    if cameras and env_cameras and cameras != env_cameras:
        raise ValueError(
            f"the policy was trained with the cameras {cameras}, in this order, but the environment has {env_cameras}; "
            f"set --env.cameras=[{','.join(cameras)}]"
        )
    missing = [key for key, feature in wanted.items() if feature.type is FeatureType.VISUAL and key not in offered]
    if missing:
        raise ValueError(f"the policy needs {missing}, but the environment only gives {sorted(offered)}")
    for key, feature in wanted.items():
        if key in offered and tuple(offered[key].shape) != tuple(feature.shape):
            raise ValueError(
                f"the policy was trained with {key} of shape {tuple(feature.shape)}, but the environment's has "
                f"{tuple(offered[key].shape)}; for images set --env.image_size"
            )


def fingerprint(config: PreTrainedConfig) -> dict[str, Any]:
    """What makes two policies the same: SHA-256 of the weights, and every option that changes what they do."""
    digest = hashlib.sha256((Path(config.pretrained_path) / WEIGHTS).read_bytes()).hexdigest()
    options = {name: value for name, value in draccus.encode(config).items() if name not in UNRELATED}
    return {"type": config.type, "weights_sha256": digest, "options": options}


@dataclass
class Actor:
    """A policy and the processors that were saved with it."""

    policy: PreTrainedPolicy
    before_policy: Any
    after_policy: Any

    @classmethod
    def load(cls, config: PreTrainedConfig) -> "Actor":
        """Load the checkpoint that ``config.pretrained_path`` names."""
        before, after = make_pre_post_processors(
            config,
            str(config.pretrained_path),
            preprocessor_overrides={"device_processor": {"device": str(config.device)}},
        )
        return cls(load_policy(config), before, after)

    def act(self, batch: dict[str, Any]) -> tuple[Float[Tensor, "b a"], float]:
        """Actions for a batch of observations, and the time that ``select_action`` took [s]."""
        batch = self.before_policy(batch)
        device = torch.device(self.policy.config.device)
        precision = torch.autocast(device.type) if self.policy.config.use_amp else nullcontext()
        with torch.inference_mode(), precision:
            started = time.perf_counter()
            action = self.policy.select_action(batch)
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            seconds = time.perf_counter() - started
        return self.after_policy(action), seconds


@dataclass
class Pilot:
    """A policy and all processors between it and a vector environment."""

    actor: Actor
    before_env: Any
    after_env: Any

    @classmethod
    def load(cls, config: PreTrainedConfig, env: EnvConfig) -> "Pilot":
        """Load the checkpoint that ``config.pretrained_path`` names."""
        return cls(Actor.load(config), *make_env_pre_post_processors(env_cfg=env, policy_cfg=config))

    @property
    def policy(self) -> PreTrainedPolicy:
        """The policy itself."""
        return self.actor.policy

    def decide(
        self, observation: dict[str, Any], instructions: Sequence[str], running: Sequence[int]
    ) -> tuple[Float[np.ndarray, "b a"], float]:
        """Actions for all scenes, and the time that ``select_action`` took [s].

        What a finished scene shows is replaced by a running one's, so that nothing in it can disturb the others.

        Args:
            observation: the vector environment's.
            instructions: one per scene.
            running: indices of the scenes whose episodes have not ended.
        """
        rows = [row if row in running else running[0] for row in range(len(instructions))]
        batch = preprocess_observation(observation)
        batch = {key: value[rows] if isinstance(value, Tensor) else value for key, value in batch.items()}
        batch["task"] = [instructions[row] for row in rows]
        action, seconds = self.actor.act(self.before_env(batch))
        return self.after_env({ACTION: action})[ACTION].cpu().numpy(), seconds
