"""Do the key poses work? Each episode's are executed in the scene in which it was recorded."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from lerobot_histmv import keys
from lerobot_histmv.envs.disturbances import CLEAN, Disturbances

SOURCE_RECORDING_FILE = "meta/source_recording.json"
"""In a keyframed dataset: what ``histmv record`` wrote about the dense one."""
IMAGE_SIZE = 8
"""Nobody looks: the smallest image [pixels] that the environment renders."""


@dataclass(frozen=True)
class Scenes:
    """What the recorded episodes took place in: per episode the task, the scene's seed and the variation."""

    tasks: tuple[str, ...]
    seeds: tuple[int, ...]
    variations: tuple[int, ...]
    disturbances: Disturbances = CLEAN


def read_scenes(path: Path, episodes: int | None = None) -> Scenes:
    """Scenes of a dataset that ``histmv record`` made.

    Args:
        path: what ``histmv record`` wrote about it.
        episodes: how many episodes it must tell; None: any number.

    Raises:
        ValueError: there is no such file, or episodes were removed from the dataset or added since.
    """
    if not path.is_file():
        raise ValueError(f"replay needs {path}, which histmv record writes: other data have no scene to replay in")
    told = json.loads(path.read_text(encoding="utf-8"))
    if episodes not in (None, len(told["seeds"])):
        raise ValueError(f"replay needs one scene per episode, but {path} tells {len(told['seeds'])} of {episodes}")
    disturbances = Disturbances(**told["settings"]["disturbances"])
    return Scenes(tuple(told["tasks"]), tuple(told["seeds"]), tuple(told["variations"]), disturbances)


class Replayer:
    """Executes key poses in the scenes of a recording, with one environment at a time."""

    def __init__(self, scenes: Scenes) -> None:
        self._scenes = scenes
        self._task = ""
        self._env: Any = None

    def failure(self, episode: int, actions: Float32[np.ndarray, "k a"]) -> str:
        """Why executing an episode's key poses fails: one of ``UR5Env``'s kinds; empty for a success.

        Args:
            episode: its number in the recording.
            actions: labels of its keyframes after the first.

        Raises:
            ValueError: the actions are not tool pose and gripper (``keys.POSE_NAMES``).
        """
        if actions.shape[1] != len(keys.POSE_NAMES):
            wanted = ", ".join(keys.POSE_NAMES)
            raise ValueError(f"replay needs actions of {wanted}; these have {actions.shape[1]} entries")
        env = self._environment(self._scenes.tasks[episode])
        env.reset(seed=self._scenes.seeds[episode], options={"variation": self._scenes.variations[episode]})
        info: dict[str, Any] = {}
        for row in actions:
            _, _, terminated, truncated, info = env.step(row)
            if terminated or truncated:
                break
        return "" if info["is_success"] else info["failure"] or "not finished"

    def _environment(self, task: str) -> Any:
        from lerobot_histmv.envs import make

        if self._env is None or task != self._task:
            self.close()
            size, disturbances = IMAGE_SIZE, self._scenes.disturbances
            self._env = make(task, cameras=("front",), image_size=size, render_size=size, disturbances=disturbances)
            self._task = task
        return self._env

    def close(self) -> None:
        """Close the environment."""
        if self._env is not None:
            self._env.close()
            self._env = None
