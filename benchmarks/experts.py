"""Do the tasks hold? Experts, noisy experts, negative controls and starting scenes, per task.

    python benchmarks/experts.py [--tasks turn_tap stack_cups] [--seeds=100] [--scenes=1000] [--workers=2]

* expert: the scripted motions, blended as in recordings; the macro steps: the same as straight key poses;
* noisy: macro steps with 2 mm of Gaussian noise on each axis of every key pose;
* idle: the tool stays where it is; open: the expert's macro steps, but the gripper never closes;
* scenes: starts that are solved already, in which something overlaps by more than 2 mm, or whose first motion is out
  of reach.

Results go to ``benchmarks/results/experts.json``.
"""

import argparse
import json
import multiprocessing
import time
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from dataset_tools.shards import write_json
from lerobot_histmv.envs import TASKS, UR5Env, make
from lerobot_histmv.motion import make_action

RESULTS = Path(__file__).parent / "results" / "experts.json"
FIRST_SEED = 500_000
NOISE = 0.002
"""Standard deviation of the noisy expert's key poses [m]."""
OVERLAP = 0.002
"""Depth of contact [m] that counts as overlapping."""


def blended(env: UR5Env) -> bool:
    """Success of the expert's motions."""
    for motion in env.expert():
        env.execute(motion)
    return env.is_success()


def macro_steps(env: UR5Env, noise: float = 0.0, never_close: bool = False) -> bool:
    """Success of the expert's key poses, one straight step each."""
    rng = np.random.default_rng(0)
    before = env.stage.controller.gripper
    for motion in env.expert():
        for action in motion.actions(before):
            action[:3] += rng.normal(0, noise, 3)
            action[7] = 1 if never_close else action[7]
            *_, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                return terminated
        before = motion.gripper
    return False


def idle(env: UR5Env) -> bool:
    """Success of a tool that stays where it is."""
    action = make_action(env.stage.simulation.tool_pose(), env.stage.controller.gripper)
    ended = False
    while not ended:
        *_, success, truncated, _ = env.step(action)
        ended = success or truncated
    return success


CONTROLS = {
    "expert": blended,
    "macro_steps": macro_steps,
    "noisy": lambda env: macro_steps(env, noise=NOISE),
    "idle": idle,
    "open": lambda env: macro_steps(env, never_close=True),
}


def bad_start(env: UR5Env) -> bool:
    """Whether the scene is solved already, something overlaps, or the first motion is out of reach."""
    motion = next(env.expert())
    reachable = env.stage.controller.plan(motion.via, motion.target, motion.speed) is not None
    return env.is_success() or not reachable or env.stage.simulation.overlap() > OVERLAP


def examine(work: tuple[str, int, int]) -> dict[str, Any]:
    """All figures of one task."""
    task, seeds, scenes = work
    env = make(task, cameras=("front",), image_size=8, render_size=8)
    figures: dict[str, Any] = {"task": task}
    for name, control in CONTROLS.items():
        begin = time.process_time()
        failed = []
        for seed in range(FIRST_SEED, FIRST_SEED + seeds):
            env.reset(seed=seed)
            try:
                success = control(env)
            except ValueError:  # out of reach
                success = False
            failed += [] if success else [seed]
        figures[name] = {"successes": seeds - len(failed), "episodes": seeds}
        figures[name]["cpu_s_per_episode"] = round((time.process_time() - begin) / seeds, 2)
        if len(failed) <= seeds // 5:
            figures[name]["failed_seeds"] = failed
    bad = []
    for seed in range(FIRST_SEED, FIRST_SEED + scenes):
        env.reset(seed=seed)
        bad += [seed] if bad_start(env) else []
    figures["bad_starts"] = {"seeds": bad[:20], "count": len(bad), "scenes": scenes}
    env.close()
    return figures


def main() -> None:
    """Examine tasks side by side."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="*", choices=TASKS, default=list(TASKS))
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--scenes", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    results = json.loads(RESULTS.read_text()) if RESULTS.is_file() else {}
    work = [(task, args.seeds, args.scenes) for task in args.tasks]
    with multiprocessing.get_context("spawn").Pool(args.workers) as pool:
        for figures in tqdm(pool.imap_unordered(examine, work), total=len(work), unit="task"):
            task = figures.pop("task")
            results[task] = figures
            write_json(RESULTS, {name: results[name] for name in TASKS if name in results})
            line = ", ".join(f"{name} {figures[name]['successes']}" for name in CONTROLS)
            tqdm.write(f"{task}: {line} of {args.seeds}; bad starts {figures['bad_starts']['count']} of {args.scenes}")


if __name__ == "__main__":
    main()
