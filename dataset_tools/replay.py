"""Do the key poses work? Each episode's are executed in the scene in which it was recorded."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from dataset_tools.keyframes import Keyframing
from dataset_tools.record_place import RECORDING_FILE
from lerobot_histmv import keys

IMAGE_SIZE = 8
"""Nobody looks: the smallest image [pixels] that the environment renders."""


@dataclass(frozen=True)
class Scenes:
    """What the recorded episodes took place in: the task, and per episode the scene's seed and the variation."""

    task: str
    seeds: tuple[int, ...]
    variations: tuple[int, ...]


def read_scenes(root: Path, episodes: int) -> Scenes:
    """Scenes of a dataset that ``histmv record`` made.

    Args:
        root: the dataset.
        episodes: how many episodes it has.

    Raises:
        ValueError: it was not recorded so, or episodes were removed or added since.
    """
    path = root / RECORDING_FILE
    if not path.is_file():
        raise ValueError(f"replay needs {path}, which histmv record writes: other data have no scene to replay in")
    told = json.loads(path.read_text(encoding="utf-8"))
    if len(told["seeds"]) != episodes:
        raise ValueError(f"replay needs one scene per episode, but {path} tells {len(told['seeds'])} of {episodes}")
    return Scenes(told["settings"]["task"], tuple(told["seeds"]), tuple(told["variations"]))


def replay(scenes: Scenes, actions: Mapping[int, Float32[np.ndarray, "k a"]]) -> Iterator[tuple[int, str]]:
    """Execute each episode's key poses; gives episode and failure (``UR5Env``'s kinds; empty for a success) in turn.

    Args:
        scenes: of all episodes of the dataset.
        actions: labels of an episode's keyframes after the first, by episode.

    Raises:
        ValueError: the actions are not tool pose and gripper (``keys.POSE_NAMES``).
    """
    from lerobot_histmv.envs import make

    env = make(scenes.task, cameras=("front",), image_size=IMAGE_SIZE, render_size=IMAGE_SIZE)
    try:
        for episode, rows in actions.items():
            if rows.shape[1] != len(keys.POSE_NAMES):
                raise ValueError(
                    f"replay needs actions of {', '.join(keys.POSE_NAMES)}; these have {rows.shape[1]} entries"
                )
            env.reset(seed=scenes.seeds[episode], options={"variation": scenes.variations[episode]})
            yield episode, _failure(env, rows)
    finally:
        env.close()


def without_failures(found: Mapping[int, Keyframing], failures: Mapping[int, str]) -> dict[int, Keyframing]:
    """The episodes whose key poses succeeded; ValueError if there is none."""
    kept = {number: one for number, one in found.items() if not failures[number]}
    if not kept:
        raise ValueError(f"no episode's key poses succeed ({failures}); a smaller --epsilon keeps more of them")
    return kept


def _failure(env: Any, rows: Float32[np.ndarray, "k 8"]) -> str:
    info: dict[str, Any] = {}
    for row in rows:
        _, _, terminated, truncated, info = env.step(row)
        if terminated or truncated:
            break
    return "" if info["is_success"] else info["failure"] or "not finished"
