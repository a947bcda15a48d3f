"""What ``histmv eval`` found, for cards: the table, the Hub's front matter, and the command that measures it again.

Episodes under disturbances, with held-out sentences or under another control are not comparable to plain ones, so every
figure comes with the options that were not the usual ones.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import draccus
from huggingface_hub import EvalResult
from lerobot.envs.configs import EnvConfig

from lerobot_histmv.command_text import command, flat, plain
from lerobot_histmv.configuration_histmv import HistMVConfig

ENVIRONMENT = "ur5"
"""Of results that do not name theirs, and of commands for policies without results."""
TOLD_ELSEWHERE = ("cameras", "image_size")
"""Options of the environment in which it must agree with the policy: no choice of the evaluation's."""
DISTURBANCES = "env.disturbances."
USUAL = "usual"

Evaluation = Mapping[str, Any]
"""Content of an ``eval_info.json``."""


def unusual_options(evaluation: Evaluation, config: HistMVConfig) -> dict[str, Any]:
    """Options, by their names on the command line, in which an evaluation was not the usual one.

    Args:
        evaluation: tells the options of its environment and its policy.
        config: the checkpoint's; what the evaluated policy had otherwise was asked for.
    """
    settings = evaluation.get("settings", {})
    kind = EnvConfig.get_known_choices().get(environment(evaluation))
    env = _differing(settings.get("env", {}), draccus.encode(kind()) if kind else {})
    policy = _differing(settings.get("policy", {}).get("options", {}), draccus.encode(config))
    return {f"env.{name}": value for name, value in env.items() if name not in TOLD_ELSEWHERE} | {
        f"policy.{name}": value for name, value in policy.items()
    }


def environment(evaluation: Evaluation | None) -> str:
    """LeRobot's name for the kind of environment."""
    return (evaluation or {}).get("env_type", ENVIRONMENT)


def _differing(found: Mapping[str, Any], usual: Mapping[str, Any]) -> dict[str, Any]:
    """Entries of ``found`` that ``usual`` has otherwise or not at all, as JSON gives them back."""
    known = dict(flat(json.loads(json.dumps(usual))))
    return {name: _without_place(value) for name, value in flat(found) if known.get(name) != value}


def _without_place(value: Any) -> Any:
    """Of a path on the measuring machine only the name."""
    return Path(value).name if isinstance(value, str) and Path(value).is_absolute() else value


def in_words(options: Mapping[str, Any]) -> str:
    """``unusual_options`` for people: ``held-out sentences; disturbances: dead_camera=1, camera=wrist``."""
    words, disturbances = [], []
    for name, value in options.items():
        said = f"{name.removeprefix('env.')}={f'{value:g}' if isinstance(value, float) else plain(value)}"
        if name.startswith(DISTURBANCES):
            disturbances.append(said.removeprefix("disturbances."))
        else:
            words.append("held-out sentences" if said == "instruction_split=held_out" else said)
    return "; ".join([*words, *(["disturbances: " + ", ".join(disturbances)] if disturbances else [])])


def hub_results(evaluation: Evaluation, config: HistMVConfig) -> list[EvalResult]:
    """The successes as the Hub's front matter tells them."""
    settings = in_words(unusual_options(evaluation, config))
    return [
        EvalResult(
            task_type="robotics",
            task_name=task["task"],
            dataset_type=f"{environment(evaluation)}/{task['task']}",
            dataset_name=f"{task['n_episodes']} unseen scenes of {task['task']}" + (settings and f" ({settings})"),
            dataset_config=settings or None,
            metric_type="success_rate",
            metric_name="success [%]",
            metric_value=round(task["pc_success"], 1),
        )
        for task in evaluation["per_task"]
    ]


def measured(evaluation: Evaluation, config: HistMVConfig) -> str:
    """Table of successes, one row per task, each with the settings under which it was measured."""
    settings = in_words(unusual_options(evaluation, config)) or USUAL
    lines = ["| task | success | 95 % interval (Wilson) | failures | settings |", "|---|---|---|---|---|"]
    for task in evaluation["per_task"]:
        low, high = task["wilson_95"]
        failures = ", ".join(f"{kind} {count}" for kind, count in task["failures"].items()) or "none"
        share = f"{task['n_successes']} of {task['n_episodes']}"
        lines.append(f"| `{task['task']}` | {share} | {low:.1f} to {high:.1f} % | {failures} | {settings} |")
    seeds = evaluation["seeds"]
    scenes = f"Scenes {seeds['first']} to {seeds['last']} of the environment `{environment(evaluation)}`."
    return "\n".join([*lines, "", scenes])


def evaluation_command(config: HistMVConfig, evaluation: Evaluation | None, place: str, program: str) -> str:
    """Command that measures the same again, or for a policy without results one with TASK to fill in.

    Args:
        config: the policy's.
        evaluation: what was measured.
        place: folder or name of the policy.
        program: ``histmv eval`` or ``lerobot-eval``.
    """
    tasks = "TASK"
    rest: dict[str, Any] = {"eval.n_episodes": 100}
    if evaluation:
        first, last = evaluation["seeds"]["first"], evaluation["seeds"]["last"]
        tasks = ",".join(task["task"] for task in evaluation["per_task"])
        rest = {**unusual_options(evaluation, config), "eval.n_episodes": last - first + 1, "seed": first}
    views = {"env.cameras": list(config.cameras), "env.image_size": config.image_size[0]}
    options = {"policy.path": place, "env.type": environment(evaluation), "env.task": tasks, **views, **rest}
    return command(program, options)
