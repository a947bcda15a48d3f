"""Do the key poses work? Each episode's are executed in the scene in which it was recorded."""

import itertools
import json
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from dataset_tools.keyframes import Keyframing
from dataset_tools.record_place import RECORDING_FILE
from lerobot_histmv import keys
from lerobot_histmv.envs.disturbances import CLEAN, Disturbances

IMAGE_SIZE = 8
"""Nobody looks: the smallest image [pixels] that the environment renders."""


@dataclass(frozen=True)
class Scenes:
    """What the recorded episodes took place in: per episode the task, the scene's seed and the variation."""

    tasks: tuple[str, ...]
    seeds: tuple[int, ...]
    variations: tuple[int, ...]
    disturbances: Disturbances = CLEAN


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
    disturbances = Disturbances(**told["settings"]["disturbances"])
    return Scenes(tuple(told["tasks"]), tuple(told["seeds"]), tuple(told["variations"]), disturbances)


def replay(scenes: Scenes, actions: Mapping[int, Float32[np.ndarray, "k a"]]) -> Iterator[tuple[int, str]]:
    """Execute each episode's key poses; gives episode and failure (``UR5Env``'s kinds; empty for a success) in turn.

    Args:
        scenes: of all episodes of the dataset.
        actions: labels of an episode's keyframes after the first, by episode.

    Raises:
        ValueError: the actions are not tool pose and gripper (``keys.POSE_NAMES``).
    """
    for task, episodes in itertools.groupby(actions, key=lambda episode: scenes.tasks[episode]):
        with closing(_make(task, scenes.disturbances)) as env:
            for episode in episodes:
                rows = actions[episode]
                if rows.shape[1] != len(keys.POSE_NAMES):
                    wanted = ", ".join(keys.POSE_NAMES)
                    raise ValueError(f"replay needs actions of {wanted}; these have {rows.shape[1]} entries")
                env.reset(seed=scenes.seeds[episode], options={"variation": scenes.variations[episode]})
                yield episode, _failure(env, rows)


def _make(task: str, disturbances: Disturbances) -> Any:
    from lerobot_histmv.envs import make

    return make(task, cameras=("front",), image_size=IMAGE_SIZE, render_size=IMAGE_SIZE, disturbances=disturbances)


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
