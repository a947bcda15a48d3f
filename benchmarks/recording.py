"""Rows per second of recording: LeRobot's own writing against ours, the recording processes, and the whole command.

    python benchmarks/recording.py [--episodes=20] [--task=pick_and_lift]

Writes ``benchmarks/results/recording.json``. Wall-clock figures mean something only on an idle machine, so the load and
the processor time are recorded beside them.
"""

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

os.environ |= {
    "OMP_NUM_THREADS": "1",
    "LP_NUM_THREADS": "1",
    "HF_HUB_OFFLINE": "1",
    "HF_DATASETS_DISABLE_PROGRESS_BARS": "1",
}

from dataset_tools.attempts import make_attempts
from dataset_tools.dense_features import dense_features
from dataset_tools.record_worker import Demonstration, WorkerSetup, commit_episode
from dataset_tools.shards import Outcome
from lerobot_histmv import keys
from lerobot_histmv.envs import make
from lerobot_histmv.envs.interface import CAMERA_NAMES

RESULTS = Path(__file__).parent / "results" / "recording.json"
SIZE, FPS, SEED = 128, 20, 90_000
FEATURES = dense_features(CAMERA_NAMES, SIZE)


def measured(rows: int, work: Callable[[], Any]) -> dict[str, float]:
    """Rows per second of wall clock, and milliseconds of this process's time per row."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return {"rows": rows, "rows_per_second": rows / wall, "cpu_ms_per_row": 1000 * cpu / rows}


def write_stock(demonstration: Demonstration, root: Path) -> None:
    """As ``lerobot-record`` does. LeRobot is imported here because the recording processes import this file too."""
    from lerobot.datasets import LeRobotDataset

    dataset = LeRobotDataset.create("local/stock", FPS, FEATURES, root=root, use_videos=False)
    for frame, action in zip(demonstration.frames, demonstration.actions, strict=True):
        dataset.add_frame({**frame, keys.ACTION: action, "task": "lift"})
    dataset.save_episode()
    dataset.finalize()


def write_fast(demonstration: Demonstration, directory: Path) -> None:
    """As ``histmv record`` does, its assembly included."""
    from dataset_tools.assembly import assemble

    outcome = Outcome(0, SEED, "lift", 0, "lift", ["lift"], "", len(demonstration.actions))
    outcome = commit_episode(directory, outcome, demonstration.columns())
    assemble(directory, [outcome], FEATURES, FPS, "local/fast", directory / "dataset")


def writing(task: str) -> dict[str, Any]:
    """One real demonstration, written both ways, and the cost of rendering it."""
    env = make(task, render_size=SIZE)
    env.reset(seed=SEED)
    demonstration = Demonstration(env, CAMERA_NAMES, stride=1)
    import lerobot.datasets  # noqa: F401 (so that no import is timed)

    started = time.process_time()
    assert demonstration.run() == "", "the benchmark's seed must be a success"
    rows = len(demonstration.actions)
    simulation = {"cpu_ms_per_row": 1000 * (time.process_time() - started) / rows}
    with tempfile.TemporaryDirectory() as scratch:
        stock = measured(rows, partial(write_stock, demonstration, Path(scratch) / "stock"))
        fast = measured(rows, partial(write_fast, demonstration, Path(scratch)))
    return {"simulation_and_rendering": simulation, "stock": stock, "fast": fast}


def children_seconds() -> float:
    """Processor time of all child processes that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def attempts_per_second(task: str, episodes: int, workers: int) -> dict[str, float]:
    """Rows per second once all processes work: between each process's first shard and the last of all."""
    before = children_seconds()
    with tempfile.TemporaryDirectory() as scratch:
        make_env = partial(make, render_size=SIZE)
        setup = WorkerSetup(Path(scratch), (task,), make_env, CAMERA_NAMES, stride=1, seed=SEED)
        finished = [(time.perf_counter(), outcome.rows) for outcome in make_attempts(setup, workers, {}, episodes)]
    seconds = finished[-1][0] - finished[workers - 1][0]
    cpu = 1000 * (children_seconds() - before) / sum(rows for _, rows in finished)
    rate = sum(rows for _, rows in finished[workers:]) / seconds
    return {"workers": workers, "rows_per_second": rate, "cpu_ms_per_row": cpu}


def whole_command(task: str, episodes: int) -> dict[str, float]:
    """``histmv record`` from its start to the finished dataset, imports included."""
    with tempfile.TemporaryDirectory() as scratch:
        options = [f"--env.task={task}", f"--episodes={episodes}", f"--root={scratch}/dataset", f"--seed={SEED}"]
        started, before = time.perf_counter(), children_seconds()
        subprocess.run([Path(sys.executable).with_name("histmv"), "record", *options], check=True)
        seconds, cpu = time.perf_counter() - started, children_seconds() - before
        rows = json.loads(Path(scratch, "dataset", "meta", "recording.json").read_text())["rows"]
    speed = {"seconds": seconds, "rows_per_second": rows / seconds, "cpu_seconds": cpu}
    return {"episodes": episodes, "rows": rows, **speed}


def main() -> None:
    """Measure, print, store."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--task", default="pick_and_lift")
    options = parser.parse_args()
    load = os.getloadavg()[0]
    results = {
        "task": options.task,
        "images": f"{len(CAMERA_NAMES)} RGB and {len(CAMERA_NAMES)} depth, {SIZE} x {SIZE}",
        "machine": {"cores": os.cpu_count(), "python": platform.python_version(), "load_before": load},
        "writing_one_core": writing(options.task),
        "recording": [attempts_per_second(options.task, options.episodes, workers) for workers in (1, 2)],
        "whole_command_two_workers": whole_command(options.task, options.episodes),
    }
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps(results, indent=2) + "\n")
    print(RESULTS.read_text())


if __name__ == "__main__":
    main()
