"""How near a training step comes to the throughput that its own layers reach alone, and how much memory it takes.

    python benchmarks/training_profile.py [--threads=2] [--windows=6] [--steps=7] [--table]

Runs the default network's training step on full windows (11 rows, three views, 128 x 128 pixels), times every operation
that has FLOPs (convolutions, matrix products, attention; forward and backward) inside of the step, then repeats each
alone with the same shapes and memory layouts: means inside against the shortest time alone. ``--table`` also prints the
operations that take longest. Writes ``benchmarks/results/training_profile.json``, one entry per number of windows.
"""

import argparse
import json
import os
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import torch
from decision_speed import make_policy
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_map_only
from torch.utils.flop_counter import flop_registry
from training_cost import windows

from dataset_tools.shards import write_json
from lerobot_histmv.data.memory import keep_freed_memory

RESULTS = Path(__file__).parent / "results" / "training_profile.json"
WARM_UP, REPEATS, ROWS = 3, 9, 40


@dataclass
class Operation:
    """One kind of call: an operation with tensors of given shapes and strides."""

    call: Any
    arguments: Any
    flops: float
    seconds: list[float] = field(default_factory=list)

    def alone(self) -> float:
        """Shortest time [s] of the call by itself, on other numbers in the same layout."""
        args, kwargs = tree_map_only(Tensor, like, self.arguments)
        times = []
        for _ in range(WARM_UP + REPEATS):
            started = time.perf_counter()
            self.call(*args, **kwargs)
            times.append(time.perf_counter() - started)
        return min(times[WARM_UP:])


def like(tensor: Tensor) -> Tensor:
    """A tensor of the same layout on the CPU: normal noise, or ones where numbers are whole."""
    made = torch.empty_strided(tensor.shape, tensor.stride(), dtype=tensor.dtype)
    return made.normal_() if made.is_floating_point() else made.fill_(1)


class Share:
    """What one kind of call takes of a step."""

    def __init__(self, name: str, operation: Operation, steps: int) -> None:
        self.name, self.calls = name, len(operation.seconds) / steps
        self.inside, self.alone = sum(operation.seconds) / steps, self.calls * operation.alone()
        self.flops = self.calls * operation.flops

    def __str__(self) -> str:
        times = f"{1e3 * self.inside:7.1f} ms, alone {1e3 * self.alone:7.1f} ms"
        return f"{times}, {1e-9 * self.flops:6.2f} GFLOP, {self.calls:3.0f} x {self.name}"


class Clock(TorchDispatchMode):
    """Times all operations that have FLOPs."""

    def __init__(self) -> None:
        super().__init__()
        self.operations: dict[str, Operation] = {}

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        packet, kwargs = operation._overloadpacket, kwargs or {}
        if packet not in flop_registry:
            return operation(*args, **kwargs)
        started = time.perf_counter()
        result = operation(*args, **kwargs)
        spent = time.perf_counter() - started
        name = f"{packet.__name__} {tree_map_only(Tensor, lambda t: (*t.shape, *t.stride()), (args, kwargs))}"
        if name not in self.operations:
            layout = tree_map_only(Tensor, lambda t: t.detach().to("meta"), (args, kwargs))
            flops = flop_registry[packet](*args, **kwargs, out_val=result)
            self.operations[name] = Operation(operation, layout, flops)
        self.operations[name].seconds.append(spent)
        return result


def training_step(windows_count: int) -> Callable[[], None]:
    """What one step of ``lerobot-train`` does with a batch."""
    policy, batch = make_policy().train(), windows(windows_count)
    preset = policy.config.get_optimizer_preset()
    optimizer = preset.build(policy.get_optim_params())

    def step() -> None:
        policy(batch)[0].backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), preset.grad_clip_norm)
        optimizer.step()
        optimizer.zero_grad()

    return step


def measure(count: int, steps: int, table: bool) -> dict[str, Any]:
    """Figures of training steps of ``count`` windows."""
    step = training_step(count)
    walls = []
    for _ in range(WARM_UP + steps):
        started = time.perf_counter()
        step()
        walls.append(time.perf_counter() - started)
    wall, memory = median(walls[WARM_UP:]), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    clock = Clock()
    with clock:
        for _ in range(steps):
            step()
    found = [Share(name, one, steps) for name, one in clock.operations.items()]
    if table:
        print(*sorted(found, key=lambda share: -share.inside)[:ROWS], sep="\n")
    convolutions = [share for share in found if share.name.startswith("convolution")]
    inside, alone = (sum(getattr(share, which) for share in convolutions) for which in ("inside", "alone"))
    everything, flops = sum(share.alone for share in found), sum(share.flops for share in found)
    return {
        "seconds_per_step": round(wall, 3),
        "gflop_per_step": round(flops / 1e9, 1),
        "gflop_per_second": round(flops / 1e9 / wall, 1),
        "convolutions_s": round(inside, 3),
        "convolutions_alone_s": round(alone, 3),
        "convolutions_share_of_alone": round(alone / inside, 3),
        "all_layers_alone_s": round(everything, 3),
        "step_share_of_alone": round(everything / wall, 3),
        "peak_memory_mb": round(memory),
    }


def main() -> None:
    """Measure, print and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--windows", type=int, default=6)
    parser.add_argument("--steps", type=int, default=7)
    parser.add_argument("--table", action="store_true")
    options = parser.parse_args()
    keep_freed_memory()  # as in training
    torch.set_num_threads(options.threads)
    load = round(os.getloadavg()[0], 1)
    result = {"threads": options.threads, "load_before": load, **measure(options.windows, options.steps, options.table)}
    known = json.loads(RESULTS.read_text()) if RESULTS.is_file() else {}
    write_json(RESULTS, known | {f"{options.windows} windows": result})
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
