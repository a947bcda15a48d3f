"""Decisions per second: encode one new observation and decode the next key pose, batch 1, rendering excluded.

    python benchmarks/decision_speed.py [--threads=2] [--episodes=4] [--profile]

Writes ``benchmarks/results/decision_speed.json``, one entry per vector instructions of the processor, for the default
network with the tiny CLIP and with a frozen ViT-B/32 in both precisions (random weights: only time matters). Wall-clock
figures mean something only on an idle machine, so the load and the processor time are recorded beside them.
``--profile`` prints instead how much each part of the tiny network takes.
"""

import argparse
import json
import os
import platform
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ |= {"HF_HUB_OFFLINE": "1"}

import numpy as np
import open_clip
import torch
from lerobot.configs import FeatureType, PolicyFeature
from torch import Tensor, nn

from dataset_tools.shards import write_json
from lerobot_histmv import keys
from lerobot_histmv.configuration_histmv import HistMVConfig
from lerobot_histmv.model.config import NetworkConfig, SemanticsConfig
from lerobot_histmv.modeling_histmv import HistMVPolicy

RESULTS = Path(__file__).parent / "results" / "decision_speed.json"
CAMERAS = ("front", "left_shoulder", "wrist")
SIZE, STEPS, SEED, FOCAL = 128, 9, 0, 150.0
TASK = "pick up the red cube and lift it"
LARGE = "ViT-B-32"


def make_policy(semantics: SemanticsConfig | None = None) -> HistMVPolicy:
    """The default policy for three views, untrained; with another CLIP than its own tiny one."""
    vectors = {keys.STATE: 14, keys.INTRINSICS: 4 * len(CAMERAS), keys.EXTRINSICS: 12 * len(CAMERAS)}
    inputs = {key: PolicyFeature(FeatureType.STATE, (count,)) for key, count in vectors.items()}
    for camera in CAMERAS:
        inputs[keys.rgb_key(camera)] = PolicyFeature(FeatureType.VISUAL, (3, SIZE, SIZE))
        inputs[keys.depth_key(camera)] = PolicyFeature(FeatureType.VISUAL, (1, SIZE, SIZE))
    config = HistMVConfig(
        network=NetworkConfig(semantics=semantics or SemanticsConfig()),
        cameras=list(CAMERAS),
        instructions={TASK: [TASK]},
        input_features=inputs,
        output_features={keys.ACTION: PolicyFeature(FeatureType.ACTION, (len(keys.POSE_NAMES),))},
        device="cpu",
        push_to_hub=False,
    )
    torch.manual_seed(SEED)
    return HistMVPolicy(config).eval()


def observations() -> Iterator[dict[str, Any]]:
    """Observations of one episode: three cameras 0.9 m above the workspace, noise for colours and for a bumpy floor."""
    rng = torch.Generator().manual_seed(SEED)
    downward = torch.tensor([[0.0, -1.0, 0.0, 0.45], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.9]])
    shifts = torch.tensor([0.0, 0.1, -0.1])
    extrinsics = downward + nn.functional.pad(shifts[:, None, None], (3, 0, 0, 2))
    intrinsics = torch.tensor([FOCAL, FOCAL, (SIZE - 1) / 2, (SIZE - 1) / 2])
    for _ in range(STEPS):
        state = torch.tensor([0.45, 0.0, 0.3, 0.0, 1.0, 0.0, 0.0, 1.0, *[0.0] * 6])
        state[:3] += 0.05 * torch.randn(3, generator=rng)
        depths = {keys.depth_key(name): 900 - 100 * torch.rand(1, 1, SIZE, SIZE, generator=rng) for name in CAMERAS}
        yield {
            keys.STATE: state[None],
            keys.INTRINSICS: intrinsics.repeat(len(CAMERAS))[None],
            keys.EXTRINSICS: extrinsics.flatten()[None],
            "task": [TASK],
            **{keys.rgb_key(name): torch.rand(1, 3, SIZE, SIZE, generator=rng) for name in CAMERAS},
            **depths,
        }


@torch.inference_mode()
def decision_times(policy: HistMVPolicy, episodes: int) -> tuple[list[float], list[float]]:
    """Wall-clock and processor time [ms] of every decision of ``episodes`` episodes, after one to warm up."""
    seen = list(observations())
    wall, cpu = [], []
    for episode in range(episodes + 1):
        policy.reset()
        for batch in seen:
            started, used = time.perf_counter(), time.process_time()
            policy.select_action(batch)
            if episode:
                wall.append(1e3 * (time.perf_counter() - started))
                cpu.append(1e3 * (time.process_time() - used))
    return wall, cpu


def settings(folder: str) -> list[SemanticsConfig]:
    """The tiny CLIP, and a frozen one whose weights come from a file in ``folder``, as pretrained ones do."""
    weights = f"{folder}/{LARGE}.pt"
    torch.save(open_clip.create_model(LARGE).state_dict(), weights)
    large = [SemanticsConfig(clip_model=LARGE, clip_pretrained=weights, bfloat16=half) for half in (False, True)]
    return [SemanticsConfig(), *large]


def measure(semantics: SemanticsConfig, episodes: int) -> dict[str, Any]:
    """Figures of one policy."""
    policy = make_policy(semantics)
    wall, cpu = decision_times(policy, episodes)
    tower: Any = policy.net.semantics._image_tower[0]
    return {
        "clip_model": semantics.clip_model,
        "image_tower": "bfloat16" if semantics.bfloat16 else "float32",
        "parameters": sum(parameter.numel() for parameter in {*policy.parameters(), *tower.parameters()}),
        "decisions": len(wall),
        "decisions_per_second": round(1e3 / float(np.median(wall)), 1),
        "median_ms": round(float(np.median(wall)), 2),
        "fastest_tenth_ms": round(float(np.quantile(wall, 0.1)), 2),
        "cpu_ms": round(float(np.median(cpu)), 2),
    }


def print_profile(episodes: int) -> None:
    """Share of each part of the tiny network in a decision."""
    policy = make_policy()
    parts: dict[str, nn.Module] = dict(policy.net.named_children())
    parts |= {f"rgba.{name}": module for name, module in policy.net.rgba.named_children()}
    parts |= {f"decoder.{name}": module for name, module in policy.net.decoder.named_children()}
    image, text = (getattr(policy.net.semantics, f"_{kind}_tower")[0].clip for kind in ("image", "text"))
    parts |= {"clip image tower": image.visual, "clip text tower": text.transformer}
    spent: dict[str, float] = dict.fromkeys(parts, 0.0)
    for name, module in parts.items():
        clock: list[float] = []
        module.register_forward_pre_hook(lambda *_, clock=clock: clock.append(time.process_time()))

        def stop(_: nn.Module, __: Any, ___: Tensor, name: str = name, clock: list[float] = clock) -> None:
            spent[name] += time.process_time() - clock.pop()

        module.register_forward_hook(stop)
    _, cpu = decision_times(policy, episodes)
    for name, seconds in sorted(spent.items(), key=lambda item: -item[1]):
        per_decision = 1e3 * seconds / (len(cpu) + STEPS)
        print(f"{name:24} {per_decision:7.2f} ms  {100 * per_decision / float(np.mean(cpu)):4.0f} %")
    print(f"{'whole decision':24} {float(np.mean(cpu)):7.2f} ms  (processor time)")


def main() -> None:
    """Measure, print and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--episodes", type=int, default=4)
    parser.add_argument("--profile", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.profile:
        print_profile(options.episodes)
        return
    with tempfile.TemporaryDirectory() as folder:
        policies = [measure(semantics, options.episodes) for semantics in settings(folder)]
    results = {
        "command": f"python benchmarks/decision_speed.py --threads={options.threads} --episodes={options.episodes}",
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}",
        "torch": torch.__version__,
        "policies": policies,
    }
    stored = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    write_json(RESULTS, stored | {torch.backends.cpu.get_cpu_capability(): results})
    print(json.dumps(results, indent=2))


if __name__ == "__main__":
    main()
