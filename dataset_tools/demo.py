"""The whole pipeline on one task: record, keyframe, train, evaluate, and a page that shows the result.

Killed and started again it continues: finished stages are kept, training goes on from its last checkpoint.
"""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from dataset_tools import config_files
from dataset_tools.stages import Command, Stage, run_stages, say

EPISODES = "episodes"
KEYFRAMES = "keyframes"
TRAINING = "train"
EVALUATION = "evaluation"
PAGE = "index.html"

OFFLINE = {"HF_HUB_OFFLINE": "1", "TOKENIZERS_PARALLELISM": "false"}
"""The demo fetches nothing, and says so to the libraries that would ask."""


@dataclass
class DemoConfig:
    """Watch a UR5e learn a task from demonstrations: record, keyframe, train, evaluate, report."""

    # folder for everything that the demo makes; give the same folder again to continue
    output: Path = Path("outputs/demo")
    # task to learn: pick_and_lift, reach_target or push_buttons
    task: str = "pick_and_lift"
    # demonstrations to record
    episodes: int = 50
    # unseen scenes to evaluate on
    scenes: int = 50
    # training settings: a name that `histmv configs` lists
    preset: str = "train/demo"
    # seed of the recorded scenes and of the training
    seed: int = 0


def stages(config: DemoConfig) -> list[Stage]:
    """The demo's commands: each can as well be typed by hand."""
    episodes, keyframes, training, evaluation = (
        config.output / name for name in (EPISODES, KEYFRAMES, TRAINING, EVALUATION)
    )
    record = (
        "histmv", "record", f"--env.task={config.task}", f"--episodes={config.episodes}", f"--seed={config.seed}",
        "--repo_id=local/demo", f"--root={episodes}",
    )  # fmt: skip
    keyframe = (
        "histmv", "keyframe", "--dataset.repo_id=local/demo", f"--dataset.root={episodes}",
        "--output.repo_id=local/demo_keyframes", f"--output.root={keyframes}",
    )  # fmt: skip
    train = (
        "lerobot-train", f"--config_path={config_files.find(config.preset)}",
        "--dataset.repo_id=local/demo_keyframes", f"--dataset.root={keyframes}",
        f"--output_dir={training}", f"--seed={config.seed}",
    )  # fmt: skip
    evaluate = (
        "histmv", "eval", f"--policy.path={last_checkpoint(training)}", "--env.type=ur5", f"--env.task={config.task}",
        f"--eval.n_episodes={config.scenes}", f"--output_dir={evaluation}",
    )  # fmt: skip
    return [
        Stage("record", f"record {config.episodes} demonstrations of {config.task}", record),
        Stage("keyframe", "find their keyframes", keyframe),
        Stage("train", "train the policy", train, resume=resume_training(train, training)),
        Stage("evaluate", f"evaluate on {config.scenes} unseen scenes", evaluate),
        Stage("report", "write the report", ("histmv", "report", f"--folder={config.output}")),
    ]


def last_checkpoint(training: Path) -> Path:
    """Where LeRobot links the newest checkpoint of a training folder."""
    return training / "checkpoints" / "last" / "pretrained_model"


def resume_training(command: Command, training: Path) -> Callable[[], Command]:
    """How to continue an unfinished training: from its last checkpoint, or anew when it has written none."""

    def resume() -> Command:
        settings = last_checkpoint(training) / "train_config.json"
        if settings.is_file():
            return ("lerobot-train", f"--config_path={settings}", "--resume=true")
        if training.exists():  # LeRobot does not start in an existing folder
            shutil.rmtree(training)
        return command

    return resume


def run(config: DemoConfig) -> None:
    """Run all stages and say where to look.

    Raises:
        ValueError: the output folder holds a run with other settings, or is in use.
        ChildProcessError: a stage failed.
    """
    console = Console()
    try:
        run_stages(stages(config), config.output, console, OFFLINE)
    except KeyboardInterrupt:
        say(console, "Stopped. The same command continues.")
        raise
    say(console, f"Look at {config.output / PAGE}")
