"""Episodes in a vector environment: one policy, one history per scene, each scene until its own end.

An episode's result does not depend on which others run beside it: its seed alone decides the scene, each row of the
policy's memory is its own, and rows influence each other only by floating-point rounding.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8
from lerobot.envs.utils import NEW_ROLLOUT_OPTION

from dataset_tools.eval_checkpoint import Pilot
from dataset_tools.eval_film import Film, chosen_views, describe
from dataset_tools.eval_results import OUT_OF_STEPS, Episode


@runtime_checkable
class Scenes(Protocol):
    """What LeRobot's vector environments, synchronous or not, have in common."""

    metadata: dict[str, Any]

    def reset(self, *, seed: list[int], options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Start an episode in every scene."""

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Observation, reward, terminated, truncated and info of every scene."""

    def call(self, name: str, *args: Any) -> Sequence[Any]:
        """Call a method, or read an attribute, of every scene."""


@dataclass
class Run:
    """An episode under way.

    Args:
        seed: its scene.
        instruction: what the policy is told.
        film: its video; None when it is not filmed.
        frames: pictures not yet in the video.
        rewards: one per step.
        decision_ms: time of each decision [ms], divided by the number of scenes.
        views: most informative view of each decision.
    """

    seed: int
    instruction: str
    film: Film | None
    frames: list[UInt8[np.ndarray, "y x 3"]] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    decision_ms: list[float] = field(default_factory=list)
    views: list[str] = field(default_factory=list)


class Rollout:
    """One episode per seed, all at once.

    Args:
        envs: as many scenes as seeds; a finished scene must stand still (LeRobot's ``FreezeAfterEpisodeEnd``).
        pilot: the policy; its memory is cleared.
        task: name to file the episodes under.
        seeds: scenes.
        videos: seed -> path below ``output``, for the episodes to film.
        output: folder of the evaluation.
        film: makes the film of an episode from its path and its frames per second.
    """

    def __init__(
        self,
        envs: Scenes,
        pilot: Pilot,
        task: str,
        seeds: Sequence[int],
        videos: Mapping[int, str],
        output: Path,
        film: Callable[[Path, int], Film] = Film,
    ) -> None:
        self.envs, self.pilot, self.task, self.videos = envs, pilot, task, videos
        self.mark = time.perf_counter()
        pilot.policy.reset()
        envs.call("set_wrapper_attr", "record_substeps", bool(videos))
        self.observation, _ = envs.reset(seed=list(seeds), options={NEW_ROLLOUT_OPTION: True})
        self.limit = max(envs.call("_max_episode_steps"))
        fps = int(envs.metadata["render_fps"])
        films = [film(output / videos[seed], fps) if seed in videos else None for seed in seeds]
        told = envs.call("task_description")
        self.runs = [Run(seed, text, film) for seed, text, film in zip(seeds, told, films, strict=True)]
        self.running = list(range(len(seeds)))
        self._collect_frames()

    def episodes(self) -> Iterator[Episode]:
        """Run to the end, giving each episode when it ends.

        Raises:
            ValueError: the environment does not report success.
        """
        try:
            for step in range(1, self.limit + 1):
                ended, info = self._advance(step)
                for row in tuple(self.running):
                    if ended[row] or step == self.limit:
                        self.running.remove(row)
                        yield self._finish(row, info)
                if not self.running:
                    return
        finally:
            for row in self.running:
                if (film := self.runs[row].film) is not None:
                    film.abandon()

    def _advance(self, step: int) -> tuple[Sequence[bool], dict[str, Any]]:
        """Decide and act once in all scenes; which of them have ended, and the environment's info."""
        seen = self.observation
        action, seconds = self.pilot.decide(seen, [run.instruction for run in self.runs], self.running)
        chosen = chosen_views(self.pilot.policy)
        self.observation, rewards, terminated, truncated, info = self.envs.step(action)
        if "is_success" not in info:
            raise ValueError(f"the environment of {self.task} does not report info['is_success'] at every step")
        self._collect_frames()
        for row in self.running:
            run = self.runs[row]
            run.rewards.append(float(rewards[row]))
            run.decision_ms.append(1e3 * seconds / len(self.runs))
            run.views += [chosen[row]] if chosen else []
            if run.film:
                run.film.show(describe(self.pilot.policy, seen, action, run.instruction, step, row), run.frames)
                run.frames = []
        return (terminated | truncated).tolist(), info

    def _collect_frames(self) -> None:
        if self.videos:
            for run, frames in zip(self.runs, self.envs.call("substep_frames"), strict=True):
                run.frames += frames if run.film else []

    def _finish(self, row: int, info: Mapping[str, Any]) -> Episode:
        """The finished episode; its video, if any, is complete."""
        run = self.runs[row]
        success = bool(info["is_success"][row])
        failure = "" if success else _of_row(info, "failure", row) or OUT_OF_STEPS
        if run.film:
            run.film.finish(failure, success)
        now = time.perf_counter()
        seconds, self.mark = now - self.mark, now
        return Episode(
            task=self.task,
            seed=run.seed,
            success=success,
            failure=failure,
            steps=len(run.rewards),
            sum_reward=sum(run.rewards),
            max_reward=max(run.rewards),
            instruction=run.instruction,
            decision_ms=round(median(run.decision_ms), 3),
            seconds=round(seconds, 3),
            variation=_of_row(info, "variation", row),
            views=run.views,
            video=self.videos.get(run.seed, ""),
        )


def _of_row(info: Mapping[str, Any], key: str, row: int) -> Any:
    """One scene's value of ``key`` as a plain Python object; None where the scene gave none."""
    if key not in info or not info[f"_{key}"][row]:
        return None
    value = info[key][row]
    return value.item() if isinstance(value, np.generic) else value
