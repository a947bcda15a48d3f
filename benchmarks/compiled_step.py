"""Does torch.compile pay on a CPU? Training steps of the default network, plain and compiled, taking turns.

    python benchmarks/compiled_step.py [--steps=12] [--threads=2]

Parts are compiled with inductor as far as shapes let them: the backbone with its RGB-A maps and history, then the
position decoder and the fusion with the cloud as well. Windows are full ones (6 rows of three views), six of them.
Results go to ``benchmarks/results/compiled_step.json``; they mean something on an idle machine only.
"""

import argparse
import json
import os
import time
from pathlib import Path
from statistics import median

import torch
from decision_speed import make_policy
from torch import nn
from torch.optim import Optimizer
from tqdm import tqdm
from training_cost import windows

from dataset_tools.shards import write_json
from lerobot_histmv.data.memory import keep_freed_memory
from lerobot_histmv.modeling_histmv import HistMVPolicy

RESULTS = Path(__file__).parent / "results" / "compiled_step.json"
BATCH = 6
SOME = ("rgba", "history")
COMPILED: dict[str, tuple[str, ...]] = {
    "plain": (),
    "backbone and history": SOME,
    "with decoder and fusion of the cloud": (*SOME, "decoder.position", "transfuse"),
}
"""Parts of the network that each variant compiles."""


def prepared(parts: tuple[str, ...]) -> tuple[HistMVPolicy, Optimizer]:
    """A policy in training with these parts compiled, and its optimiser."""
    policy = make_policy().train()
    for part in parts:
        policy.net.get_submodule(part).compile()
    return policy, policy.config.get_optimizer_preset().build(policy.get_optim_params())


def step(policy: HistMVPolicy, optimizer: Optimizer, batch: dict[str, object]) -> float:
    """Seconds of one training step."""
    start = time.perf_counter()
    policy(batch)[0].backward()
    nn.utils.clip_grad_norm_(policy.parameters(), policy.config.optimizer_grad_clip_norm)
    optimizer.step()
    optimizer.zero_grad()
    return time.perf_counter() - start


def main() -> None:
    """Time the variants by turns, after a first step of each that compiles."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=12, help="of each variant, after the first")
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    keep_freed_memory()
    batch = windows(BATCH)
    variants = {name: prepared(parts) for name, parts in COMPILED.items()}
    first = {name: step(*variant, batch) for name, variant in variants.items()}
    seconds: dict[str, list[float]] = {name: [] for name in variants}
    for _ in tqdm(range(args.steps), unit="round"):
        for name, variant in variants.items():
            seconds[name].append(step(*variant, batch))
    result = {
        name: {"first_step_s": round(first[name], 1), "step_s": round(median(taken), 3)}
        for name, taken in seconds.items()
    }
    write_json(RESULTS, {"threads": args.threads, "windows": BATCH, "steps": args.steps, "seconds": result})
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
