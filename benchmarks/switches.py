"""What single switches of the default preset bring: short trainings on the same demonstrations, the same unseen scenes.

    python benchmarks/switches.py [--switches default constant_rate] [--setting=pick_and_lift] [--steps=400] [--seeds 0]

A training of a third of the default's steps tells switches apart where the whole one ends near 100 %. Data are those of
``success.py``. Killed and started again, it continues. Successes per switch and seed go to
``benchmarks/results/switches.json``.
"""

import argparse
from pathlib import Path

from ablations import outcome
from rich.console import Console
from success import SETTINGS, add_result, anywhere, begin, evaluation_stage, training_stage

from dataset_tools.demo import last_checkpoint
from dataset_tools.stages import read_state, run_stages

RESULTS = Path(__file__).parent / "results" / "switches.json"
AUGMENT = "--policy.augment."
CLIP = "--policy.network.semantics."
OWN_CLIP = f"{CLIP}clip_pretrained=outputs/tiny_clip/tiny.pt"
"""Weights that ``tiny_clip.py`` makes."""
ONE_VIEW, CHOICE = "--policy.network.views.decode=one", "--policy.network.views.train_choice"
SWITCHES: dict[str, tuple[str, ...]] = {
    "default": (),
    "constant_rate": ("--policy.final_lr_fraction=1",),
    "half_rate": ("--policy.optimizer_lr=5e-4",),
    "double_rate": ("--policy.optimizer_lr=2e-3",),
    "no_augmentation": tuple(
        f"{AUGMENT}{name}=0" for name in ("yaw", "shift", "pixels", "brightness", "contrast", "lost_view", "card")
    ),
    "no_failures": (f"{AUGMENT}lost_view=0", f"{AUGMENT}card=0"),
    "no_world_motion": (f"{AUGMENT}yaw=0", f"{AUGMENT}shift=0"),
    "no_pixel_shift": (f"{AUGMENT}pixels=0",),
    "no_colour": (f"{AUGMENT}brightness=0", f"{AUGMENT}contrast=0"),
    "any_yaw": (f"{AUGMENT}yaw=3.14159",),
    "twice_colour": (f"{AUGMENT}brightness=0.12", f"{AUGMENT}contrast=0.2"),
    "depth_noise": (f"{AUGMENT}depth_noise=0.002",),
    "past_1": ("--policy.network.history.past_steps=1",),
    "past_2": ("--policy.network.history.past_steps=2",),
    "past_9": ("--policy.network.history.past_steps=9",),
    "own_clip": (OWN_CLIP, f"{CLIP}train_clip=true"),
    "own_clip_frozen": (OWN_CLIP,),
    "quaternion": ("--policy.network.decoder.tool_frame=false",),
    "untold": ("--policy.network.decoder.opening=false",),
    "nearest_surface": ("--policy.loss.approach=[0,0,0]",),
    "no_heatmap_loss": ("--policy.loss.heatmap=0",),
    "one_view": (ONE_VIEW,),
    **{f"one_view_{choice}": (ONE_VIEW, f"{CHOICE}={choice}") for choice in ("argmax", "sampled", "expected")},
}
"""Options of ``lerobot-train`` beside the preset."""


def measure(args: argparse.Namespace, name: str, seed: int, environment: dict[str, str]) -> None:
    """Train the preset with one switch and one seed, evaluate it and write down what came out."""
    folder = args.output / args.setting
    own = folder / f"{name}_{args.steps}_steps_seed_{seed}"
    options = (f"--steps={args.steps}", f"--save_freq={args.steps}", *SWITCHES[name])
    train = training_stage(args.setting, seed, folder, own, "train/default", *options)
    evaluate = evaluation_stage(args.setting, last_checkpoint(own / "train"), own / "evaluation")
    run_stages([train, evaluate], own, Console(), environment)
    state = read_state(own)
    result = {
        "demonstrations": SETTINGS[args.setting][1],
        "threads": args.threads,
        "training_minutes": round(state["train"].seconds / 60, 1),
        **outcome(own / "evaluation"),
        "commands": [anywhere(" ".join(record.command), args.output) for record in state.values()],
    }
    add_result(f"{args.setting}, {args.steps} steps, {name}, seed {seed}", result, RESULTS)


def main() -> None:
    """Run the chosen switches with all training seeds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--switches", nargs="+", choices=SWITCHES, default=list(SWITCHES))
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    args, environment = begin(parser, "pick_and_lift")
    for name in args.switches:
        for seed in args.seeds:
            measure(args, name, seed, environment)


if __name__ == "__main__":
    main()
