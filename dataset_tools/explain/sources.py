"""The two sources of an episode: rows of a keyframed dataset, or a rollout in an environment."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.envs import close_envs, make_env
from lerobot.envs.configs import EnvConfig

from dataset_tools.eval_checkpoint import Actor, Pilot
from dataset_tools.eval_rollout import Rollout
from dataset_tools.explain.episode import Explained
from dataset_tools.explain.sheet import ExplainedFilm, film_rows
from dataset_tools.explain.watch import watched
from dataset_tools.source import Source, open_dataset
from lerobot_histmv import keys
from lerobot_histmv.configuration_histmv import HistMVConfig

FPS = 20


def open_keyframes(config: HistMVConfig, repo_id: str, root: Path | None, episode: int, revision: str | None) -> Source:
    """The dataset that holds a demonstration which the policy can be asked about.

    Raises:
        ValueError: it is not keyframed, has no such episode, or its cameras are not those of the policy.
    """
    source = open_dataset(repo_id, root, [episode], revision)
    if not source.is_keyframed:
        raise ValueError(
            f"{repo_id} is a dense dataset, but the policy decides at keyframes; make a keyframed one of it with "
            "histmv keyframe"
        )
    config.set_dataset_feature_metadata(source.features)
    shape = tuple(source.features[keys.rgb_key(config.cameras[0])]["shape"][:2])
    if shape != tuple(config.image_size):
        wanted = tuple(config.image_size)
        raise ValueError(f"the policy was trained with images of {wanted} pixels, those of {repo_id} have {shape}")
    return source


def explain_dataset(config: HistMVConfig, source: Source, film_path: Path) -> Explained:
    """Let the policy decide at every row of an episode, each time after the demonstration's own past."""
    (number,) = source.episodes
    rows = LeRobotDataset(source.meta.repo_id, root=source.root, episodes=[number])
    deciding = replace(config, control=replace(config.control, rate=0))  # each row is a macro step
    actor = Actor.load(deciding)
    actor.policy.reset()
    truth = []
    with watched(actor.policy) as records:
        for index in range(len(rows)):
            row: dict[str, Any] = dict(rows[index])
            truth.append(row.pop(keys.ACTION).numpy())
            actor.act(row)
    episode = Explained(f"episode {number}", row["task"], records, np.stack(truth))
    film_rows(episode, film_path, FPS)
    return episode


def explain_rollout(config: PreTrainedConfig, env: EnvConfig, seed: int, film_path: Path) -> Explained:
    """Let the policy act in a scene.

    Raises:
        ValueError: the environment is more than one task.
    """
    pilot = Pilot.load(config, env)
    groups = make_env(env, n_envs=1)
    try:
        members = [(name, scenes) for group in groups.values() for name, scenes in group.items()]
        if len(members) != 1:
            raise ValueError(f"env.task={env.task} is {len(members)} tasks; name one of them: {', '.join(groups)}")
        ((_, scenes),) = members
        with watched(pilot.policy) as records:
            rollout = Rollout(
                scenes,
                pilot,
                str(env.task),
                [seed],
                {seed: film_path.name},
                film_path.parent,
                film=partial(ExplainedFilm, records),
            )
            (ended,) = rollout.episodes()
    finally:
        close_envs(groups)
    outcome = "success" if ended.success else f"failed: {ended.failure}"
    return Explained(f"scene {seed}", ended.instruction, records, outcome=outcome)
