"""Seconds per step of ``lerobot-train`` with the default preset, and what of it data take.

    python benchmarks/training_speed.py KEYFRAMED_ROOT [--steps=60] [--threads=2]

The first 20 steps, in which the frame cache fills and memory is allocated, are left out. What LeRobot logs as the time
of data holds its processors, which run in the training process; the rest of it is waiting for the loader. Results are
filed under the dataset's name in ``benchmarks/results/training_speed.json``; they mean something on an idle machine
only.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import mean
from typing import Any

from success import command_environment

from dataset_tools import config_files
from dataset_tools.shards import write_json

RESULTS = Path(__file__).parent / "results" / "training_speed.json"
WARM_UP = 20
PRESET = "train/default"
TIMED = "from training_speed import timed_training; timed_training()"


def timed_training() -> None:
    """``lerobot-train``, which prints at its end how long its processors took per batch [s]."""
    from lerobot.processor import DataProcessorPipeline
    from lerobot.scripts import lerobot_train

    process, seconds = DataProcessorPipeline.__call__, []

    def timed(self: Any, data: Any) -> Any:
        start = time.perf_counter()
        processed = process(self, data)
        seconds.append(time.perf_counter() - start)
        return processed

    DataProcessorPipeline.__call__ = timed
    lerobot_train.main()
    print(f"processors_s:{mean(seconds[WARM_UP:]):.4f}")


def train(root: Path, steps: int, threads: int) -> str:
    """What a short training logs."""
    environment = os.environ | command_environment(threads) | {"PYTHONPATH": str(Path(__file__).parent)}
    with tempfile.TemporaryDirectory() as folder:
        command = (
            sys.executable, "-c", TIMED, f"--config_path={config_files.find(PRESET)}", "--policy.device=cpu",
            "--dataset.repo_id=local/speed", f"--dataset.root={root}",
            f"--output_dir={folder}/train", f"--steps={steps}", "--log_freq=10", "--save_checkpoint=false",
        )  # fmt: skip
        found = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return found.stdout + found.stderr


def main() -> None:
    """Train for a minute and read the log."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("root", type=Path)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    args = parser.parse_args()
    if args.steps < WARM_UP + 10:
        parser.error(f"--steps {args.steps}: the first {WARM_UP} are not counted, so give at least {WARM_UP + 10}")
    load = os.getloadavg()[0]
    log = train(args.root, args.steps, args.threads)
    logged = re.findall(r"updt_s:([\d.]+) data_s:([\d.]+)", log)
    updates, data = zip(*[map(float, pair) for pair in logged[WARM_UP // 10 :]], strict=True)
    preset_steps = int(re.findall(r"^steps: (\d+)", config_files.find(PRESET).read_text(), re.MULTILINE)[0])
    seconds = mean(updates) + mean(data)
    processors = float(re.findall(r"processors_s:([\d.]+)", log)[0])
    result = {
        "threads": args.threads,
        "load_before": round(load, 1),
        "steps_measured": 10 * len(updates),
        "seconds_per_step": round(seconds, 3),
        "share_in_processors": round(processors / seconds, 3),
        "share_waiting_for_loader": round(max(0.0, mean(data) - processors) / seconds, 3),
        "preset_minutes": round(seconds * preset_steps / 60, 1),
    }
    known = json.loads(RESULTS.read_text()) if RESULTS.is_file() else {}
    name = args.root.resolve().parent.name
    write_json(RESULTS, known | {f"{name}, {args.threads} threads": result})
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
