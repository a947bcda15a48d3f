"""Success of the default preset on unseen scenes: record, keyframe, train with ``lerobot-train``, evaluate.

    python benchmarks/success.py --setting=pick_and_lift [--seeds 0 1] [--output=outputs/success] [--threads=2]

Each setting's demonstrations are recorded once and shared by its seeds; with an empty list of seeds, nothing else is
done. Killed and started again, it continues. Two processes with one thread each may train two seeds at once. The
commands, the training time and the evaluation's figures go to ``benchmarks/results/success.json``.
"""

import argparse
import json
import os
from pathlib import Path
from typing import Any

from filelock import FileLock
from rich.console import Console

from dataset_tools import config_files
from dataset_tools.demo import last_checkpoint, resume_training
from dataset_tools.eval_settings import REPORTED_SEEDS
from dataset_tools.shards import write_json
from dataset_tools.stages import Stage, read_state, run_stages

RESULTS = Path(__file__).parent / "results" / "success.json"
SETTINGS: dict[str, tuple[str, int]] = {
    "reach_target": ("reach_target", 50),
    "reach_target_10": ("reach_target", 10),
    "pick_and_lift": ("pick_and_lift", 50),
    "pick_and_lift_10": ("pick_and_lift", 10),
    "pick_and_lift_fixed": ("pick_and_lift.red", 50),
    "push_buttons_fixed": ("push_buttons.red-green", 50),
    "push_buttons": ("push_buttons", 100),
    "turn_tap": ("turn_tap.left", 50),
    "take_lid_off_saucepan": ("take_lid_off_saucepan", 50),
    "put_item_in_drawer": ("put_item_in_drawer.middle", 50),
    "stack_blocks": ("stack_blocks.two-red", 50),
    "insert_onto_square_peg": ("insert_onto_square_peg.red", 50),
}
"""Task, demonstrations. One fixed variation is the paper's single-task protocol (section 4.1)."""
SCENES = 100
OUTPUT = Path("outputs/success")


def data_stages(setting: str, folder: Path, episodes: int | None = None) -> list[Stage]:
    """Record and keyframe; the seeds share what they make. ``episodes`` replaces the setting's own number."""
    task, usual = SETTINGS[setting]
    record = (
        "histmv", "record", f"--env.task={task}", f"--episodes={episodes or usual}", "--seed=0",
        f"--repo_id=local/{setting}", f"--root={folder / 'episodes'}",
    )  # fmt: skip
    keyframe = (
        "histmv", "keyframe", f"--dataset.repo_id=local/{setting}", f"--dataset.root={folder / 'episodes'}",
        f"--output.repo_id=local/{setting}_keyframes", f"--output.root={folder / 'keyframes'}",
    )  # fmt: skip
    return [Stage("record", f"record {setting}", record), Stage("keyframe", "find keyframes", keyframe)]


def training_stage(setting: str, seed: int, folder: Path, own: Path, preset: str, *options: str) -> Stage:
    """Train a preset with one seed on the setting's data in ``folder``; the run goes to ``own``."""
    training = own / "train"
    train = (
        "lerobot-train", f"--config_path={config_files.find(preset)}", "--policy.device=cpu",
        f"--dataset.repo_id=local/{setting}_keyframes", f"--dataset.root={folder / 'keyframes'}",
        f"--output_dir={training}", f"--seed={seed}", *options,
    )  # fmt: skip
    title = f"train {preset} on {setting}, seed {seed}"
    return Stage("train", title, train, resume=resume_training(train, training))


def evaluation_stage(setting: str, policy: Path, output: Path, *scenes: str, count: int = SCENES) -> Stage:
    """Evaluate a checkpoint on ``count`` scenes; ``scenes`` are further options of the environment."""
    command = (
        "histmv", "eval", f"--policy.path={policy}", "--env.type=ur5", f"--env.task={SETTINGS[setting][0]}", *scenes,
        f"--eval.n_episodes={count}", f"--seed={REPORTED_SEEDS}", "--videos=0", f"--output_dir={output}",
    )  # fmt: skip
    return Stage(output.name, f"evaluate on {count} scenes", command)


def anywhere(command: str, output: Path, default: Path = OUTPUT) -> str:
    """The command as one would type it in a checkout, with the default output folder."""
    return command.replace(f"{config_files.folder().parent}/", "").replace(str(output), str(default))


def add_result(name: str, result: dict[str, Any], file: Path = RESULTS) -> None:
    """Put one result among the others; several benchmarks may do so at once."""
    file.parent.mkdir(exist_ok=True)
    with FileLock(file.parent / ".lock"):
        known = json.loads(file.read_text()) if file.is_file() else {}
        write_json(file, dict(sorted((known | {name: result}).items())))


def told(setting: str, threads: int, own: Path, output: Path, default: Path = OUTPUT) -> dict[str, Any]:
    """What the run in ``own`` learned from, what its evaluation found, and the commands that made it."""
    state = read_state(own)
    (task,) = json.loads((own / "evaluation" / "eval_info.json").read_text())["per_task"]
    return {
        "demonstrations": SETTINGS[setting][1],
        "threads": threads,
        "training_minutes": round(state["train"].seconds / 60, 1),
        **{key: task[key] for key in ("n_successes", "n_episodes", "wilson_95", "failures", "decision_ms")},
        "commands": [anywhere(" ".join(record.command), output, default) for record in state.values()],
    }


def learn(setting: str, seed: int, folder: Path, threads: int, environment: dict[str, str]) -> None:
    """Train and evaluate one seed and write down what came out."""
    own = folder / f"seed_{seed}"
    evaluate = evaluation_stage(setting, last_checkpoint(own / "train"), own / "evaluation")
    run_stages([training_stage(setting, seed, folder, own, "train/default"), evaluate], own, Console(), environment)
    add_result(f"{setting}, seed {seed}", told(setting, threads, own, folder.parent))


def command_environment(threads: int) -> dict[str, str]:
    """Variables for the commands: no downloads, and so many threads."""
    return {"HF_HUB_OFFLINE": "1", "TOKENIZERS_PARALLELISM": "false", "OMP_NUM_THREADS": str(threads)}


def begin(parser: argparse.ArgumentParser, setting: str) -> tuple[argparse.Namespace, dict[str, str]]:
    """Parse the command line and make the data of the chosen setting; the options, and the commands' environment.

    Args:
        parser: with the benchmark's own options; those that all trainings share are added.
        setting: the default one.
    """
    parser.add_argument("--setting", choices=SETTINGS, default=setting)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    args = parser.parse_args()
    environment, folder = command_environment(args.threads), args.output / args.setting
    run_stages(data_stages(args.setting, folder), folder, Console(), environment)
    return args, environment


def main() -> None:
    """Run one setting with its training seeds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1])
    args, environment = begin(parser, "pick_and_lift")
    folder = args.output / args.setting
    for seed in args.seeds:
        learn(args.setting, seed, folder, args.threads, environment)


if __name__ == "__main__":
    main()
