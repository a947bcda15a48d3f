"""Success against training minutes: this policy beside what a user of LeRobot would pick, on the same demonstrations.

    python benchmarks/peers.py [--methods histmv act] [--minutes 5 10 15 25] [--setting=pick_and_lift_fixed]
    python benchmarks/peers.py --methods act act_keyframes diffusion --minutes 15 30 60 120

Every method trains with ``lerobot-train`` for the same wall-clock minutes on the same machine, one after another, and
is evaluated with ``histmv eval`` on the same 100 scenes. ``METHODS`` tells what each sees and learns from. ACT and
Diffusion Policy take no instruction: give them settings with one variation. Diffusion Policy needs
``pip install 'lerobot[diffusion]'``. Killed and started again, it continues.
"""

import argparse
import json
import os
import shutil
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from peers_figure import draw
from rich.console import Console
from success import SETTINGS, add_result, anywhere, command_environment, data_stages
from timed_training import TimedTraining, checkpoint

from dataset_tools import config_files
from dataset_tools.eval_settings import REPORTED_SEEDS
from dataset_tools.stages import Command, Stage, read_state, run_stages
from lerobot_histmv import keys
from lerobot_histmv.envs.interface import CAMERA_NAMES

RESULTS = Path(__file__).parent / "results" / "peers.json"
FIGURE = Path(__file__).parents[1] / "docs" / "images" / "peers.png"
OUTPUT = Path("outputs/peers")
NOT_FOR_PEERS = [*map(keys.depth_key, CAMERA_NAMES), keys.INTRINSICS, keys.EXTRINSICS]
"""LeRobot's policies take every image for a colour camera and know no calibration."""
RGB_D = "three RGB-D cameras, calibration, tool poses, instruction"
RGB = "three RGB cameras, tool pose, joints"
DENSE, MACRO = "every frame at 20 Hz, as video", "keyframes, a decision per macro step"


@dataclass(frozen=True)
class Method:
    """One line of the figure.

    Args:
        label: its name there.
        config: name of its YAML file.
        dataset: which of the data folders it learns from.
        control: how the environment takes its actions.
        sees: its inputs.
        learns_from: rows of its data and what it decides.
    """

    label: str
    config: str
    dataset: str
    control: str
    sees: str
    learns_from: str


METHODS = {
    "histmv": Method("HistMV", "train/default", "keyframes", "macro", RGB_D, MACRO),
    "hiveformer": Method("Hiveformer-style", "train/hiveformer", "keyframes", "macro", RGB_D, MACRO),
    "act": Method("ACT", "peers/act", "episodes_video", "servo", RGB, DENSE),
    "act_keyframes": Method("ACT on keyframes", "peers/act_keyframes", "keyframes_rgb", "macro", RGB, MACRO),
    "diffusion": Method("Diffusion Policy", "peers/diffusion", "episodes_video", "servo", RGB, DENSE),
}


def edit_stage(folder: Path, old: str, new: str, title: str, *operation: str) -> Stage:
    """Copy a dataset with ``lerobot-edit-dataset``; it does not write into what a killed one has left."""
    command = (
        "lerobot-edit-dataset", f"--repo_id=local/{old}", f"--root={folder / old}",
        f"--new_repo_id=local/{new}", f"--new_root={folder / new}", *operation,
    )  # fmt: skip

    def again() -> Command:
        shutil.rmtree(folder / new, ignore_errors=True)
        return command

    return Stage(new, title, command, again)


def colour_stage(folder: Path, dataset: str) -> Stage:
    """Copy a dataset without what LeRobot's policies do not take."""
    names = f"--operation.feature_names={json.dumps(NOT_FOR_PEERS)}"
    title = f"copy the {dataset} without depth and calibration"
    return edit_stage(folder, dataset, f"{dataset}_rgb", title, "--operation.type=remove_feature", names)


def video_stages(folder: Path) -> list[Stage]:
    """Copy the dense episodes' colour images to videos, the form in which LeRobot records.

    For images LeRobot decodes those of every action of a chunk: 0.13 s of CPU time per sample for 40 actions, 0.025 s
    with videos. The conversion leaves out the images' statistics, which training wants.
    """
    operation = ("--operation.type=convert_image_to_video", "--operation.num_workers=2")
    stats = [str(folder / name / "meta" / "stats.json") for name in ("episodes_rgb", "episodes_video")]
    return [
        edit_stage(folder, "episodes_rgb", "episodes_video", "make videos of them", *operation),
        Stage("episodes_stats", "copy the images' statistics", ("cp", *stats)),
    ]


def training_command(method: Method, folder: Path, seed: int) -> Command:
    """``lerobot-train`` without steps, saving and output folder."""
    return (
        "lerobot-train", f"--config_path={config_files.find(method.config)}", "--policy.device=cpu",
        f"--dataset.repo_id=local/{method.dataset}", f"--dataset.root={folder / method.dataset}", f"--seed={seed}",
    )  # fmt: skip


def evaluation_stage(method: Method, task: str, training: TimedTraining, step: int, scenes: int) -> Stage:
    """Evaluate one checkpoint."""
    command = (
        "histmv", "eval", f"--policy.path={checkpoint(training.training, step) / 'pretrained_model'}", "--env.type=ur5",
        f"--env.task={task}", f"--env.control={method.control}", f"--eval.n_episodes={scenes}",
        f"--seed={REPORTED_SEEDS}", "--videos=0", f"--output_dir={training.folder / f'evaluation_{step}'}",
    )  # fmt: skip
    return Stage(f"evaluate_{step}", f"evaluate step {step} on {scenes} scenes", command)


def point(folder: Path, step: int, seconds: float) -> dict[str, Any]:
    """What the evaluation of one checkpoint found."""
    (task,) = json.loads((folder / f"evaluation_{step}" / "eval_info.json").read_text())["per_task"]
    found = ("n_successes", "n_episodes", "wilson_95", "failures", "decision_ms", "steps")
    return {"minutes": round(seconds / 60, 2), "step": step, **{name: task[name] for name in found}}


def compare(name: str, args: argparse.Namespace, environment: dict[str, str]) -> None:
    """Train one method, evaluate its checkpoints and write down what came out."""
    method, folder, console = METHODS[name], args.output / args.setting, Console()
    task, episodes = SETTINGS[args.setting]
    own = folder / f"{name}_{max(args.minutes)}_minutes_seed_{args.seed}"
    training = TimedTraining(training_command(method, folder, args.seed), own, args.minutes, console, environment)
    reached = training.run()
    run_stages(
        [evaluation_stage(method, task, training, step, args.scenes) for step in reached], own, console, environment
    )
    commands = [training.command, *(record.command for record in read_state(own).values())]
    result = {
        "setting": args.setting, "method": name, "label": method.label, "task": task, "demonstrations": episodes,
        "sees": method.sees, "learns_from": method.learns_from, "budget_minutes": max(args.minutes),
        "seed": args.seed, "threads": args.threads, "seconds_per_step": round(training.plan.seconds_per_step, 3),
        "planned_steps": training.plan.steps,
        "points": [point(own, step, seconds) for step, seconds in reached.items()],
        "commands": [anywhere(" ".join(command), args.output, OUTPUT) for command in commands],
    }  # fmt: skip
    add_result(f"{args.setting}, {name}, {max(args.minutes)} minutes, seed {args.seed}", result, args.results)


def prepare(args: argparse.Namespace, environment: dict[str, str]) -> None:
    """Record, keyframe and make the copies that the chosen methods need."""
    folder = args.output / args.setting
    needed = {METHODS[name].dataset for name in args.methods}
    copies = [colour_stage(folder, "keyframes")] if "keyframes_rgb" in needed else []
    if "episodes_video" in needed:
        copies += [colour_stage(folder, "episodes"), *video_stages(folder)]
    run_stages([*data_stages(args.setting, folder), *copies], folder, Console(), environment)


def parse() -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=list(METHODS), help="none: only draw")
    parser.add_argument("--minutes", type=int, nargs="+", default=[5, 10, 15, 25], help="the largest is the budget")
    parser.add_argument("--setting", choices=SETTINGS, default="pick_and_lift_fixed")
    parser.add_argument("--scenes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--figure", type=Path, default=FIGURE)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    args = parser.parse_args()
    if min(args.minutes) < 1:
        parser.error(f"--minutes {args.minutes}: give whole minutes, at least 1")
    if "diffusion" in args.methods and find_spec("diffusers") is None:
        parser.error("Diffusion Policy needs diffusers: pip install 'lerobot[diffusion]', or choose other --methods")
    return args


def main() -> None:
    """Compare the chosen methods and draw all results so far."""
    args = parse()
    for name in args.methods:
        config_files.find(METHODS[name].config)
    environment = command_environment(args.threads)
    if args.methods:
        prepare(args, environment)
    for name in args.methods:
        compare(name, args, environment)
    draw(json.loads(args.results.read_text()), args.setting, args.figure)


if __name__ == "__main__":
    main()
