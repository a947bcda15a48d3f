"""``histmv eval``: the success of a checkpoint over unseen scenes.

On top of what ``lerobot-eval`` does: task names, 95 % intervals, why each episode failed, resume, and videos at 20 Hz
with heat map, view weights and chosen view drawn in. Results do not depend on the batch size, on the number of runs
that it took, or on which episodes are filmed.
"""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from hashlib import sha256
from itertools import batched
from pathlib import Path
from typing import Any

import draccus
from lerobot.envs import close_envs, make_env
from rich.console import Console

from dataset_tools.eval_checkpoint import Pilot, check_fits, fingerprint, load_config
from dataset_tools.eval_report import circumstances, progress_bar, results_table, success_rate
from dataset_tools.eval_results import INFO_FILE, Episode, EpisodeLog, evaluation_info
from dataset_tools.eval_rollout import Rollout, Scenes
from dataset_tools.eval_settings import EvaluateConfig
from dataset_tools.locks import only_one
from dataset_tools.shards import write_json
from dataset_tools.video import TEMPORARY

EPISODES_FILE, SETTINGS_FILE = "episodes.jsonl", "settings.json"
UNRELATED_ENV = ("task", "features", "features_map", "render_size", "max_parallel_tasks", "disable_env_checker")
"""Fields of an environment's configuration that do not change what an episode of one task is."""


class Evaluation:
    """One checkpoint on the tasks of one environment, written to one folder.

    Args:
        config: what to evaluate.

    Raises:
        ValueError: no such checkpoint, or one that does not fit the environment.
    """

    def __init__(self, config: EvaluateConfig) -> None:
        self.config = config
        self.policy_config = load_config(config.policy)
        check_fits(self.policy_config, config.env)
        env = {name: value for name, value in draccus.encode(config.env).items() if name not in UNRELATED_ENV}
        self.settings = {"policy": fingerprint(self.policy_config), "env": env}
        self.output = config.output_dir or self._default_output()

    def _default_output(self) -> Path:
        digest = sha256(json.dumps(self.settings, sort_keys=True).encode()).hexdigest()[:8]
        task = str(self.config.env.task).replace(",", "_")
        return Path("outputs/eval") / f"{self.config.env.type}_{task}_{self.policy_config.type}_{digest}"

    @cached_property
    def pilot(self) -> Pilot:
        """The policy, loaded when the first episode needs it."""
        return Pilot.load(self.policy_config, self.config.env)

    @cached_property
    def tasks(self) -> dict[tuple[str, int], str]:
        """LeRobot's task group and index to the task's name."""
        envs = make_env(self.config.env, n_envs=1)
        names = {
            (group, index): str(env.call("task")[0])
            for group, members in envs.items()
            for index, env in members.items()
        }
        close_envs(envs)
        return names

    @property
    def seeds(self) -> range:
        """Scenes of every task."""
        return range(self.config.seed, self.config.seed + self.config.eval.n_episodes)

    @contextmanager
    def scenes(self, group: str, index: int, count: int) -> Iterator[Scenes]:
        """``count`` environments of one task."""
        envs = make_env(self.config.env, n_envs=count, use_async_envs=self.config.eval.use_async_envs)
        try:
            yield envs[group][index]
        finally:
            close_envs(envs)

    def claim(self) -> None:
        """Write down what this folder's episodes are of, and remove what a killed evaluation left unfinished.

        Raises:
            ValueError: they are of something else.
        """
        for unfinished in self.output.glob(f"videos/*/*{TEMPORARY}"):
            unfinished.unlink()
        path = self.output / SETTINGS_FILE
        if not path.exists():
            write_json(path, self.settings)
            return
        found = json.loads(path.read_text(encoding="utf-8"))
        wanted = json.loads(json.dumps(self.settings))
        if differing := sorted(_differences(found, wanted)):
            raise ValueError(
                f"{self.output} holds an evaluation of something else (differing: {', '.join(differing)}); "
                "choose another --output_dir"
            )

    def finished(self, task: str, log: EpisodeLog) -> list[Episode]:
        """The task's finished episodes in order of their seeds."""
        return [log.finished[task, seed] for seed in self.seeds if (task, seed) in log.finished]

    def video(self, task: str, seed: int) -> str:
        """Path of an episode's video below the output folder; empty for episodes that are not filmed."""
        filmed = seed in self.seeds[: self.config.videos]
        return f"videos/{task}/{seed}.mp4" if filmed else ""

    def missing(self, task: str, log: EpisodeLog) -> list[list[int]]:
        """Seeds still to run, in batches, filmed and unfilmed ones apart; a filmed episode needs its video, too."""
        size = self.config.eval.batch_size or len(os.sched_getaffinity(0))
        filmed: list[int] = []
        unfilmed: list[int] = []
        for seed in self.seeds:
            video = self.video(task, seed)
            if (task, seed) not in log.finished or (video and not (self.output / video).exists()):
                (filmed if video else unfilmed).append(seed)
        return [list(batch) for seeds in (filmed, unfilmed) for batch in batched(seeds, size)]

    def run_task(self, group: str, index: int, log: EpisodeLog) -> Iterator[Episode]:
        """Run and log the task's missing episodes."""
        task = self.tasks[group, index]
        batches = self.missing(task, log)
        for count in sorted(set(map(len, batches)), reverse=True):
            with self.scenes(group, index, count) as envs:
                for seeds in batches:
                    if len(seeds) == count:
                        videos = {seed: self.video(task, seed) for seed in seeds if self.video(task, seed)}
                        for episode in Rollout(envs, self.pilot, task, seeds, videos, self.output).episodes():
                            log.append(episode)
                            yield episode

    def provenance(self) -> dict[str, Any]:
        """What was evaluated on which scenes."""
        return {
            "checkpoint": str(self.config.policy.path),
            "env_type": self.config.env.type,
            "seeds": {"first": self.seeds[0], "last": self.seeds[-1]},
            "batch_size": self.config.eval.batch_size,
            "settings": self.settings,
        }


def _differences(first: Any, second: Any, name: str = "") -> Iterator[str]:
    """Dotted names at which two JSON values differ."""
    if isinstance(first, dict) and isinstance(second, dict):
        for key in first.keys() | second.keys():
            yield from _differences(first.get(key), second.get(key), f"{name}.{key}".lstrip("."))
    elif first != second:
        yield name


def run(config: EvaluateConfig) -> None:
    """Evaluate, or complete an evaluation, and write ``eval_info.json``."""
    console = Console()
    evaluation = Evaluation(config)
    evaluation.output.mkdir(parents=True, exist_ok=True)
    refusal = f"another evaluation is writing to {evaluation.output}; wait for it or choose --output_dir"
    with only_one(evaluation.output, refusal):
        evaluation.claim()
        log = EpisodeLog(evaluation.output / EPISODES_FILE)
        results = {}
        with progress_bar(console) as progress:
            for (group, index), task in evaluation.tasks.items():
                done = evaluation.finished(task, log)
                bar = progress.add_task(task, total=len(evaluation.seeds), completed=len(done), rate=success_rate(done))
                for _ in evaluation.run_task(group, index, log):
                    done = evaluation.finished(task, log)
                    progress.update(bar, completed=len(done), rate=success_rate(done))
                results[group, index] = done
        info = evaluation_info(results, evaluation.output, evaluation.provenance() | circumstances())
        write_json(evaluation.output / INFO_FILE, info)
    console.print(results_table(info))
    console.print(f"results: {evaluation.output / INFO_FILE}", soft_wrap=True)
