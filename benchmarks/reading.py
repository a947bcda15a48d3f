"""Samples per second of a keyframed dataset: LeRobot's reader against the frame reader and against plain memory.

    python benchmarks/reading.py [--episodes=30] [--steps=6] [--batch_size=16]

Writes ``benchmarks/results/reading.json``. Wall-clock figures mean something only on an idle machine, so the load and
the processor time (of all threads, loader workers included) are recorded beside them.
"""

import argparse
import json
import os
import platform
import resource
import tempfile
import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

os.environ |= {"HF_HUB_OFFLINE": "1", "HF_DATASETS_DISABLE_PROGRESS_BARS": "1"}

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset
from torch.utils.data import DataLoader

from dataset_tools.dense_features import dense_features
from lerobot_histmv import keys
from lerobot_histmv.data.hook import install
from lerobot_histmv.data.memory import keep_freed_memory

RESULTS = Path(__file__).parent / "results" / "reading.json"
CAMERAS = ("front", "left_shoulder", "wrist")
SIZE, ROWS_PER_EPISODE, REPO, SEED = 128, 5, "local/reading", 0
STOCK_SAMPLES = 16
FEATURES = dense_features(CAMERAS, SIZE)


def cpu_seconds() -> float:
    """Processor time of this process and of its children that have ended."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def measured(samples: int, work: Callable[[], Any]) -> dict[str, float]:
    """Samples per second of wall clock, and milliseconds of processor time per sample."""
    wall, cpu = time.perf_counter(), cpu_seconds()
    work()
    wall, cpu = time.perf_counter() - wall, cpu_seconds() - cpu
    return {"samples": samples, "samples_per_second": samples / wall, "cpu_ms_per_sample": 1000 * cpu / samples}


def exhaust(samples: Iterable[Any]) -> None:
    """Take every sample."""
    for _ in samples:
        pass


def make_dataset(root: Path, episodes: int) -> None:
    """Smooth images with some noise, which compress about as rendered ones do, and unit quaternions."""
    chance = np.random.default_rng(SEED)
    dataset = LeRobotDataset.create(REPO, fps=1, features=FEATURES, root=root, use_videos=False)
    ramp = np.linspace(0, 200, SIZE * SIZE * 3).reshape(SIZE, SIZE, 3)
    for _ in range(episodes):
        for _ in range(ROWS_PER_EPISODE):
            frame: dict[str, Any] = {"task": "lift the red cube"}
            for key, feature in FEATURES.items():
                if key.endswith(keys.DEPTH_SUFFIX):
                    frame[key] = (700 + ramp[..., :1] + chance.integers(9, size=(SIZE, SIZE, 1))).astype(np.uint16)
                elif feature["dtype"] == "image":
                    frame[key] = (ramp + chance.integers(9, size=(SIZE, SIZE, 3))).astype(np.uint8)
                else:
                    frame[key] = chance.normal(size=feature["shape"]).astype(np.float32)
            for key in (keys.STATE, keys.ACTION):
                frame[key][3:7] = (1, 0, 0, 0)
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()


def load(root: Path, steps: int) -> LeRobotDataset:
    """As ``lerobot-train`` does for a policy with ``steps - 1`` past steps."""
    window = [float(step) for step in range(1 - steps, 1)]
    return LeRobotDataset(REPO, root=root, delta_timestamps=dict.fromkeys(FEATURES, window), return_uint8=True)


def assert_same(first: dict[str, Any], second: dict[str, Any]) -> None:
    """Two samples are equal bit for bit."""
    assert first.keys() == second.keys()
    for key, value in first.items():
        same = torch.equal(value, second[key]) if isinstance(value, torch.Tensor) else value == second[key]
        assert same, key


def loader_epochs(dataset: LeRobotDataset, batch_size: int, workers: int, epochs: int = 3) -> dict[str, float]:
    """Whole batches, from the first batch of warm workers on."""
    options: dict[str, Any] = (
        {"persistent_workers": True, "multiprocessing_context": "spawn", "prefetch_factor": 2} if workers else {}
    )
    loader = DataLoader(dataset, batch_size, shuffle=True, num_workers=workers, **options)
    exhaust(loader)
    started = time.perf_counter()
    for _ in range(epochs):
        exhaust(loader)
    seconds = time.perf_counter() - started
    samples = epochs * len(dataset)
    return {"samples_per_second": samples / seconds, "ms_per_batch": 1000 * seconds / (epochs * len(loader))}


def readers(root: Path, steps: int) -> dict[str, Any]:
    """Sample by sample in one process: LeRobot, the frame reader from nothing and again, copies of ready samples.

    The last two in memory that the process keeps, as ``lerobot-train`` does for histmv.
    """
    stock, fast = load(root, steps), load(root, steps)
    chosen = np.random.default_rng(SEED).choice(len(stock), STOCK_SAMPLES, replace=False).tolist()

    def later_pass() -> None:
        exhaust(fast[index] for index in range(len(fast)))

    def first_pass() -> None:
        install(fast)
        later_pass()

    results = {
        "stock": measured(len(chosen), lambda: exhaust(stock[index] for index in chosen)),
        "first_pass_decoding_all": measured(len(fast), first_pass),
        "later_pass_default_allocator": measured(len(fast), later_pass),
    }
    keep_freed_memory()
    results["later_pass"] = measured(len(fast), later_pass)
    for index in chosen:
        assert_same(fast[index], stock[index])
    ready = [[value for value in fast[index].values() if isinstance(value, torch.Tensor)] for index in chosen]
    results["memory_copy"] = measured(len(ready), lambda: exhaust([v.clone() for v in sample] for sample in ready))
    return results


def main() -> None:
    """Measure, print, store."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=30)
    parser.add_argument("--steps", type=int, default=6)
    parser.add_argument("--batch_size", type=int, default=16)
    options = parser.parse_args()
    results: dict[str, Any] = {
        "command": vars(options),
        "images": f"{len(CAMERAS)} RGB and {len(CAMERAS)} depth, {SIZE} x {SIZE}",
        "machine": {"cores": os.cpu_count(), "python": platform.python_version(), "load_before": os.getloadavg()[0]},
    }
    with tempfile.TemporaryDirectory() as scratch:
        os.environ["HISTMV_CACHE"] = f"{scratch}/cache"
        root = Path(scratch, "dataset")
        make_dataset(root, options.episodes)
        results["one_process"] = readers(root, options.steps)
        dataset = load(root, options.steps)
        install(dataset)
        epochs = partial(loader_epochs, dataset, options.batch_size)
        results["loader"] = {f"{workers}_workers": epochs(workers) for workers in (0, 2)}
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps(results, indent=2) + "\n")
    print(RESULTS.read_text())


if __name__ == "__main__":
    main()
