"""What a training step costs, and what that means for GPUs that are not here: computed, not measured.

    python benchmarks/training_cost.py

Counts the floating-point operations, kernels and saved activations of the default network's training step on windows
of full length (three views, 128 x 128 pixels), and of CLIP's towers on the meta device. ``GPUS`` and the shares below
it are assumptions. Writes ``benchmarks/results/training_cost.json`` and prints the tables of ``docs/scaling.md``.
"""

import functools
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from decision_speed import CAMERAS, SIZE, make_policy, observations
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from dataset_tools.shards import write_json
from lerobot_histmv import keys
from lerobot_histmv.model.config import SemanticsConfig
from lerobot_histmv.model.semantics import ClipTowers
from lerobot_histmv.modeling_histmv import MEANINGS

RESULTS = Path(__file__).parent / "results" / "training_cost.json"
ROWS = 11
"""Rows of a window amid a long episode, all of which are encoded: it teaches the last six."""
BATCHES = {"tiny": (6, 64), "ViT-B-32": (6, 32)}
"""Windows per GPU of the estimates: the default preset's, and what fills a GPU better."""

GPUS = {
    "A100 80 GB": {"tf32": 156e12, "bf16": 312e12, "memory": 2.0e12, "link": 300e9},
    "H100 80 GB": {"tf32": 495e12, "bf16": 989e12, "memory": 3.35e12, "link": 450e9},
}
"""Data sheets: dense peak [FLOP/s], memory bandwidth and NVLink bandwidth in one direction [bytes/s]."""
OF_PEAK, OF_BANDWIDTH = 0.4, 0.7
TRAFFIC = 6
"""Times that a saved activation's bytes move: written, read by the next layer and by the backward pass, and as much
again for what is not saved."""
LAUNCH = 6e-6
"""Seconds that Python and the driver take per kernel."""
GPUS_PER_NODE = 8


@dataclass
class Cost:
    """Of one training step: FLOPs, bytes saved for the backward pass, kernels."""

    flops: float = 0.0
    saved: float = 0.0
    kernels: float = 0.0

    def __add__(self, other: "Cost") -> "Cost":
        return Cost(self.flops + other.flops, self.saved + other.saved, self.kernels + other.kernels)

    def __mul__(self, factor: float) -> "Cost":
        return Cost(factor * self.flops, factor * self.saved, factor * self.kernels)


class Kernels(TorchDispatchMode):
    """Counts operations that compute: views cost nothing on the device."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += not operation.is_view
        return operation(*args, **(kwargs or {}))


def cost(step: Callable[[], Tensor], parameters: list[Tensor]) -> Cost:
    """Of ``step``, which gives a loss, and its backward pass."""
    for parameter in parameters:
        parameter.grad = None
    own = {parameter.untyped_storage()._cdata for parameter in parameters}
    kept: dict[int, Tensor] = {}

    def keep(tensor: Tensor) -> Tensor:
        if tensor.untyped_storage()._cdata not in own:
            kept[tensor.untyped_storage()._cdata] = tensor
        return tensor

    flops, kernels = FlopCounterMode(display=False), Kernels()
    with flops, kernels, torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        loss = step()
        saved = sum(tensor.untyped_storage().nbytes() for tensor in kept.values())
        loss.backward()
    return Cost(flops.get_total_flops(), saved, kernels.count)


def windows(count: int) -> dict[str, Any]:
    """A batch of windows whose ``ROWS`` rows, 2s + 1 around each drawn row, all are inside of the episode."""
    rows = [row for _, row in zip(range(ROWS), [*observations(), *observations()], strict=False)]
    batch = {key: torch.cat([row[key] for row in rows])[None].expand(count, *[-1] * rows[0][key].ndim).clone()
             for key in rows[0] if key != "task"}  # fmt: skip
    batch[keys.ACTION] = batch[keys.STATE][..., :8].clone()
    pads = {f"{key}_is_pad": torch.zeros(count, ROWS, dtype=torch.bool) for key in batch}
    return batch | pads | {"task": rows[0]["task"] * count}


@functools.cache
def clip_towers(model: str) -> ClipTowers:
    """Both towers, trained, without values: shapes are all that is needed."""
    return ClipTowers(SemanticsConfig(clip_model=model)).to("meta")


def towers(model: str, images: int, sentences: int) -> tuple[Cost, int]:
    """Of both CLIP towers, and how many parameters they have."""
    clip = clip_towers(model)
    pictures = torch.empty(images, 3, SIZE, SIZE, device="meta")
    found = cost(lambda: clip.images(pictures).sum() + clip.text(["a"] * sentences).sum(), list(clip.parameters()))
    return found, sum(parameter.numel() for parameter in clip.parameters())


def trunk() -> tuple[Cost, Cost, int]:
    """The default network without CLIP's towers: cost per step, cost per window, parameters."""
    policy = make_policy().train()

    def measure(n: int) -> Cost:
        return cost(lambda: policy(windows(n))[0], list(policy.parameters()))

    measured = [measure(n) for n in (1, 2)]
    own = [
        whole + towers("tiny", n * ROWS * len(CAMERAS), 2)[0] * -1 for n, whole in zip((1, 2), measured, strict=True)
    ]
    each = own[1] + own[0] * -1
    parameters = sum(parameter.numel() for parameter in policy.parameters()) - towers("tiny", 1, 1)[1]
    return own[0] + each * -1, each, parameters


def estimate(total: Cost, parameters: int, batch: int, gpu: dict[str, float], precision: str) -> dict[str, float]:
    """Milliseconds that each limit alone would give, and the rates that follow from the largest."""
    size = 0.5 if precision == "bf16" else 1.0
    limits = {
        "arithmetic_ms": 1e3 * total.flops / (OF_PEAK * gpu[precision]),
        "memory_ms": 1e3 * TRAFFIC * size * total.saved / (OF_BANDWIDTH * gpu["memory"]),
        "launch_ms": 1e3 * LAUNCH * total.kernels,
    }
    share = 2 * (GPUS_PER_NODE - 1) / GPUS_PER_NODE
    step = max(limits.values())
    return {
        **limits,
        "all_reduce_ms": 1e3 * share * 4 * parameters / (OF_BANDWIDTH * gpu["link"]),
        "windows_per_second": 1e3 * batch / step,
        "windows_per_second_8": 1e3 * GPUS_PER_NODE * batch / step,
    }


def main() -> None:
    """Count, estimate, write, print."""
    fixed, each, base = trunk()
    results: dict[str, Any] = {"rows_per_window": ROWS, "views": len(CAMERAS), "pixels": SIZE, "policies": []}
    titles = "CLIP", "windows per GPU", "GFLOP", "activations", "kernels", "GPU", "arithmetic", "memory", "launches"
    print(*titles, "windows/s, 1 GPU", "8 GPUs", sep=" | ")
    for clip in BATCHES:
        for batch in BATCHES[clip]:
            tower, size = towers(clip, batch * ROWS * len(CAMERAS), batch + 2 * MEANINGS)
            total, parameters = fixed + each * batch + tower, base + size
            times = {name: {precision: estimate(total, parameters, batch, gpu, precision) for precision in
                            ("tf32", "bf16")} for name, gpu in GPUS.items()}  # fmt: skip
            policy = {"clip_model": clip, "windows": batch, "parameters": parameters, "state_bytes": 16 * parameters}
            results["policies"].append(policy | asdict(total) | {"estimates": times})
            for name, found in times.items():
                counted = f"{total.flops / 1e9:,.0f}", f"{total.saved / 1e9:.1f} GB", f"{total.kernels:,.0f}"
                limits = [f"{found['bf16'][key]:.1f} ms" for key in ("arithmetic_ms", "memory_ms", "launch_ms")]
                rates = [f"{found['bf16'][key]:,.0f}" for key in ("windows_per_second", "windows_per_second_8")]
                print(clip, batch, *counted, name, *limits, *rates, sep=" | ")
    write_json(RESULTS, results)
    print(json.dumps({"trunk_per_step": asdict(fixed), "trunk_per_window": asdict(each)}, indent=1))


if __name__ == "__main__":
    main()
