"""The same checkpoint on the same scenes three ways: macro steps, 20 Hz servo control, and ``lerobot-rollout``.

    python benchmarks/deployment.py --policy=outputs/.../pretrained_model --task=pick_and_lift [--episodes=20]

Killed and started again, it continues. Per way: successes, 95 % interval, failed scenes and simulated seconds go to
``benchmarks/results/deployment.json``, with the fingerprint of the checkpoint's weights.
"""

import argparse
import json
import logging
import re
import signal
import sys
from pathlib import Path
from typing import Any

from filelock import FileLock
from lerobot.scripts import lerobot_rollout

from dataset_tools.cli import main as histmv
from dataset_tools.eval_results import read_episodes, wilson_interval
from dataset_tools.eval_settings import REPORTED_SEEDS
from dataset_tools.evaluate import EPISODES_FILE
from dataset_tools.shards import write_json
from lerobot_histmv.robots.ur5_sim import UR5Sim

RESULTS = Path(__file__).parent / "results" / "deployment.json"
RATE = 20
PACE = 1000
"""Calls per second that lerobot-rollout aims at: the simulated robot's time does not depend on it."""


def evaluate(control: str, policy: str, task: str, episodes: int, folder: Path) -> dict[int, tuple[str, bool]]:
    """Seed -> instruction and success, by ``histmv eval``."""
    rate = 0 if control == "macro" else RATE
    scenes = ["--env.type=ur5", f"--env.task={task}", f"--env.control={control}", f"--eval.n_episodes={episodes}"]
    rest = [f"--seed={REPORTED_SEEDS}", "--eval.batch_size=5", "--eval.use_async_envs=false", "--videos=0"]
    output = folder / control
    histmv(
        ["eval", f"--policy.path={policy}", f"--policy.control.rate={rate}", *scenes, *rest, f"--output_dir={output}"]
    )
    return {one.seed: (one.instruction, one.success) for one in read_episodes(output / EPISODES_FILE)}


def roll_out(policy: str, task: str, seed: int, instruction: str) -> str:
    """What ``ur5_sim`` reports at the end of one ``lerobot-rollout``."""
    said: list[str] = []
    listener = logging.Handler()
    listener.emit = lambda record: said.append(record.getMessage())  # type: ignore[method-assign]
    robot_log = logging.getLogger(UR5Sim.__module__)
    robot_log.addHandler(listener)
    logging.getLogger("lerobot").setLevel(logging.ERROR)  # else a line per tick says that the pace is not reached
    robot = ["--robot.type=ur5_sim", f"--robot.task={task}", f"--robot.seed={seed}", "--robot.stop_when_done=true"]
    loop = [f"--policy.control.rate={RATE}", f"--fps={PACE}", "--return_to_initial_position=false"]
    sys.argv = ["lerobot-rollout", f"--policy.path={policy}", f"--task={instruction}", *robot, *loop]
    lerobot_rollout.main()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # LeRobot's handler would ignore the next Ctrl-C
    robot_log.removeHandler(listener)
    return said[-1]


def roll_out_all(policy: str, task: str, instructions: dict[int, str], path: Path) -> dict[str, str]:
    """Seed -> what was reported; scenes in ``path`` are not run again."""
    known: dict[str, str] = json.loads(path.read_text()) if path.is_file() else {}
    for seed, instruction in instructions.items():
        if str(seed) not in known:
            known[str(seed)] = roll_out(policy, task, seed, instruction)
            write_json(path, known)
    return known


def summary(successes: dict[int, bool]) -> dict[str, Any]:
    """Figures of one way."""
    good = sum(successes.values())
    return {
        "n_successes": good,
        "n_episodes": len(successes),
        "wilson_95": [round(100 * bound, 1) for bound in wilson_interval(good, len(successes))],
        "failed_seeds": [seed for seed, success in successes.items() if not success],
    }


def main() -> None:
    """Run all three ways and add the figures to the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", required=True)
    parser.add_argument("--task", default="pick_and_lift")
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--output", type=Path, default=Path("outputs/deployment"))
    args = parser.parse_args()
    folder = args.output / args.task
    found = {
        control: evaluate(control, args.policy, args.task, args.episodes, folder) for control in ("macro", "servo")
    }
    ways = {control: summary({seed: good for seed, (_, good) in one.items()}) for control, one in found.items()}
    instructions = {seed: told for seed, (told, _) in found["macro"].items()}
    reports = roll_out_all(args.policy, args.task, instructions, folder / "rollout.json")
    ways["lerobot-rollout"] = summary({int(seed): ": success" in said for seed, said in reports.items()})
    seconds = [float(re.findall(r"after ([\d.]+) s", said)[0]) for said in reports.values()]
    ways["lerobot-rollout"]["mean_seconds"] = round(sum(seconds) / len(seconds), 2)
    settings = json.loads((folder / "macro" / "eval_info.json").read_text())["settings"]
    result = ways | {"weights_sha256": settings["policy"]["weights_sha256"]}
    RESULTS.parent.mkdir(exist_ok=True)
    with FileLock(RESULTS.parent / ".lock"):
        known = json.loads(RESULTS.read_text()) if RESULTS.is_file() else {}
        write_json(RESULTS, dict(sorted((known | {args.task: result}).items())))
    print(json.dumps(ways, indent=2))


if __name__ == "__main__":
    main()
