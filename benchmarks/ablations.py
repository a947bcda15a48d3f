"""What the parts bring: files of ``configs/ablation/`` on the same demonstrations, training seeds and unseen scenes.

    python benchmarks/ablations.py --setting=push_buttons --files full mva_st --seeds 0 1 2
    python benchmarks/ablations.py --setting=pick_and_lift --files full history_st --camera=wrist --scenes dead_camera
    python benchmarks/ablations.py --setting=reach_target --files one_view history_st --camera=wrist --scenes covered \
        --without_failures
    python benchmarks/ablations.py --setting=pick_and_lift --files full --seeds 0 1 2 --scenes clean held_out

Data are those of ``success.py``, which are recorded once, and so are its trainings: the full network is the default
preset. Killed and started again, it continues. Successes per file, seed and kind of scene, and which views acted, go to
``benchmarks/results/ablations.json``.
"""

import argparse
import json
from collections import Counter
from pathlib import Path
from typing import Any

from rich.console import Console
from success import SETTINGS, add_result, anywhere, begin, evaluation_stage, training_stage

from dataset_tools import config_files
from dataset_tools.demo import last_checkpoint
from dataset_tools.eval_results import read_episodes
from dataset_tools.evaluate import EPISODES_FILE
from dataset_tools.stages import read_state, run_stages

RESULTS = Path(__file__).parent / "results" / "ablations.json"
FOLDER = "ablation/"
FILES = [name.removeprefix(FOLDER) for name in config_files.names() if name.startswith(FOLDER)]
FULL = "full"
SCENES: dict[str, tuple[str, ...]] = {
    "clean": (),
    "held_out": ("--env.instruction_split=held_out",),
    "dead_camera": ("--env.disturbances.dead_camera=1",),
    "occluder": ("--env.disturbances.occluder=2",),
    "covered": ("--env.disturbances.occluder=3",),
}
"""Kinds of scenes; the same seeds in each, so that the rows of a table are paired. A card hides 60 or 90 % of the width
of a camera's picture."""
WITHOUT_FAILURES = ("--policy.augment.lost_view=0", "--policy.augment.card=0")
"""Options of a training that never sees a camera fail."""


def options(kind: str, camera: str) -> tuple[str, ...]:
    """Options of the environment for a kind of scene; ``camera`` names the one that suffers, if not drawn."""
    suffers = any("disturbances" in option for option in SCENES[kind])
    return (*SCENES[kind], f"--env.disturbances.camera={camera}") if suffers and camera else SCENES[kind]


def outcome(folder: Path) -> dict[str, Any]:
    """What one evaluation found, with the number of decisions that each view took."""
    (task,) = json.loads((folder / "eval_info.json").read_text())["per_task"]
    views = Counter(view for one in read_episodes(folder / EPISODES_FILE) for view in one.views)
    found = ("n_successes", "n_episodes", "wilson_95", "failures")
    return {name: task[name] for name in found} | {"views": dict(sorted(views.items()))}


def ablate(args: argparse.Namespace, file: str, seed: int, environment: dict[str, str]) -> None:
    """Train one file with one seed, evaluate it on every kind of scene and write down what came out."""
    folder = args.output / args.setting
    training, changed = ("without failures", WITHOUT_FAILURES) if args.without_failures else ("", ())
    short, preset = ("", "train/default") if file == FULL else (file, FOLDER + file)
    own = folder / "_".join(filter(None, [short, training.replace(" ", "_"), f"seed_{seed}"]))
    train = training_stage(args.setting, seed, folder, own, preset, *changed)
    policy = last_checkpoint(own / "train")
    places = {kind: own / f"evaluation_{kind}{args.camera and '_'}{args.camera}" for kind in args.scenes}
    evaluations = [
        evaluation_stage(args.setting, policy, place, *options(kind, args.camera)) for kind, place in places.items()
    ]
    run_stages([train, *evaluations], own, Console(), environment)
    state = read_state(own)
    add_result(
        ", ".join(filter(None, [args.setting, file, f"seed {seed}", args.camera, training])),
        {
            "demonstrations": SETTINGS[args.setting][1],
            "threads": args.threads,
            "training_minutes": round(state["train"].seconds / 60, 1),
            "scenes": {kind: outcome(place) for kind, place in places.items()},
            "commands": [anywhere(" ".join(state[stage.name].command), args.output) for stage in [train, *evaluations]],
        },
        RESULTS,
    )


def main() -> None:
    """Run the chosen files with all training seeds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", nargs="+", choices=FILES, default=FILES)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=["clean"])
    parser.add_argument("--camera", default="", help="that is dead or hidden; by default drawn per episode")
    parser.add_argument("--without_failures", action="store_true", help="train without lost views and cards")
    args, environment = begin(parser, "push_buttons")
    for file in args.files:
        for seed in args.seeds:
            ablate(args, file, seed, environment)


if __name__ == "__main__":
    main()
