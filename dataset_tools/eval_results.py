"""What an evaluation found: one line per finished episode, from which every table and file is made again.

The lines survive a kill at any moment: each is one write to a file opened for appending, and a line that was cut short
is dropped when the evaluation is taken up again.
"""

import dataclasses
import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

NORMAL_975 = 1.959963984540054
"""97.5 % quantile of the normal distribution: two-sided 95 % intervals."""
INFO_FILE = "eval_info.json"
"""LeRobot's name for the results of an evaluation."""
OUT_OF_STEPS = "time"
"""Failure of an episode that ended without success and without a reason."""


@dataclass(frozen=True)
class Episode:
    """One finished episode.

    Args:
        task: the environment's name for it.
        seed: decides the scene.
        success: whether the task was fulfilled.
        failure: why not: "wrong object", "grasp missed", "not reached", "ik" or "time"; empty on success.
        steps: decisions made.
        sum_reward: sum of the rewards.
        max_reward: largest reward.
        instruction: what the policy was told.
        decision_ms: median time of ``select_action`` [ms], divided by the number of scenes decided at once.
        seconds: wall-clock time [s] since the episode before it ended; sums up to the time that the evaluation took.
        variation: which variation of the task the seed drew; None if the environment has none.
        views: camera of the most informative view at each decision; empty for policies that choose none.
        video: path of the video relative to the results; empty without.
    """

    task: str
    seed: int
    success: bool
    failure: str
    steps: int
    sum_reward: float
    max_reward: float
    instruction: str
    decision_ms: float
    seconds: float
    variation: int | None = None
    views: list[str] = field(default_factory=list)
    video: str = ""


class EpisodeLog:
    """Append-only file of finished episodes; ``finished`` holds the latest one per task and seed.

    Args:
        path: the file; made when the first episode is appended.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.finished = {(episode.task, episode.seed): episode for episode in read_episodes(path)}

    def append(self, episode: Episode) -> None:
        """Add one episode; it is on disk when this returns."""
        line = json.dumps(dataclasses.asdict(episode), ensure_ascii=False) + "\n"
        descriptor = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        try:
            os.write(descriptor, line.encode())
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        self.finished[episode.task, episode.seed] = episode


def read_episodes(path: Path) -> list[Episode]:
    """Episodes in the order in which they were written; a last line cut short by a kill is removed from the file.

    Raises:
        ValueError: a whole line is damaged.
    """
    if not path.exists():
        return []
    text = path.read_bytes()
    whole = text[: text.rfind(b"\n") + 1]
    if len(whole) < len(text):
        os.truncate(path, len(whole))
    episodes = []
    for number, line in enumerate(whole.decode().splitlines(), start=1):
        try:
            episodes.append(Episode(**json.loads(line)))
        except (json.JSONDecodeError, TypeError) as error:
            raise ValueError(f"line {number} of {path} is no finished episode ({error}); remove it to go on") from error
    return episodes


def wilson_interval(successes: int, episodes: int) -> tuple[float, float]:
    """95 % score interval of a success probability (Wilson 1927); (0, 1) without episodes."""
    if not 0 <= successes <= episodes:
        raise ValueError(f"{successes} successes of {episodes} episodes are impossible")
    if episodes == 0:
        return 0.0, 1.0
    z2, share = NORMAL_975**2, successes / episodes
    centre = (successes + z2 / 2) / (episodes + z2)
    spread = NORMAL_975 * (successes * (1 - share) + z2 / 4) ** 0.5 / (episodes + z2)
    return max(0.0, min(share, centre - spread)), min(1.0, max(share, centre + spread))


def summarise(episodes: Sequence[Episode], output: Path) -> dict[str, Any]:
    """LeRobot's aggregate of ``episodes`` (at least one; its keys, its units) and what it lacks.

    Added: ``wilson_95`` [%], ``failures`` (kind -> episodes), ``decision_ms`` (median), ``steps`` (median).
    """
    rewards = [episode.sum_reward for episode in episodes]
    successes = sum(episode.success for episode in episodes)
    low, high = wilson_interval(successes, len(episodes))
    seconds = sum(episode.seconds for episode in episodes)
    return {
        "avg_sum_reward": sum(rewards) / len(rewards),
        "avg_max_reward": sum(episode.max_reward for episode in episodes) / len(episodes),
        "pc_success": 100 * successes / len(episodes),
        "wilson_95": [100 * low, 100 * high],
        "n_successes": successes,
        "n_episodes": len(episodes),
        "failures": dict(Counter(episode.failure or OUT_OF_STEPS for episode in episodes if not episode.success)),
        "decision_ms": median(episode.decision_ms for episode in episodes),
        "steps": median(episode.steps for episode in episodes),
        "eval_s": seconds,
        "eval_ep_s": seconds / len(episodes),
        "video_paths": [str(output / episode.video) for episode in episodes if episode.video],
        "predicted_video_paths": [],
    }


def task_entry(group: str, index: int, episodes: Sequence[Episode], output: Path) -> dict[str, Any]:
    """One task's entry of ``per_task``: LeRobot's lists in ``metrics``, the task's name and its aggregate."""
    summary = summarise(episodes, output)
    metrics = {
        "sum_rewards": [episode.sum_reward for episode in episodes],
        "max_rewards": [episode.max_reward for episode in episodes],
        "successes": [episode.success for episode in episodes],
        "video_paths": summary["video_paths"],
        "predicted_video_paths": [],
    }
    return {"task_group": group, "task_id": index, "task": episodes[0].task, "metrics": metrics, **summary}


def evaluation_info(
    results: Mapping[tuple[str, int], Sequence[Episode]], output: Path, provenance: Mapping[str, Any]
) -> dict[str, Any]:
    """Content of ``eval_info.json``: LeRobot's ``per_task``, ``per_group`` and ``overall``, then ``provenance``.

    Args:
        results: task group and task index, as LeRobot numbers them, to episodes in order of their seeds.
        output: folder that the episodes' video paths are relative to.
        provenance: what was evaluated and how.
    """
    groups: dict[str, list[Episode]] = {}
    for (group, _), episodes in results.items():
        groups.setdefault(group, []).extend(episodes)
    return {
        "per_task": [task_entry(group, index, episodes, output) for (group, index), episodes in results.items()],
        "per_group": {group: summarise(episodes, output) for group, episodes in groups.items()},
        "overall": summarise([episode for episodes in groups.values() for episode in episodes], output),
        **provenance,
    }
