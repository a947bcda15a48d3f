"""How well what the heat map is taught to point at tells the key pose: its distance from there, row by row.

    python benchmarks/heat_targets.py [--settings stack_blocks pick_and_lift] [--episodes=16]

The decoder adds to the heat map's expectation an offset that one map has to tell: where a row's offsets differ between
episodes, the position is learned slowly. Data are those of ``success.py``. Per setting and row of an episode, the
offset's spread [mm] for the nearest surface and for the surface that the key pose points at goes to
``benchmarks/results/heat_targets.json``.
"""

import argparse
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from einops import einsum, rearrange
from lerobot.datasets import LeRobotDataset
from rich.console import Console
from success import OUTPUT, SETTINGS, add_result, command_environment, data_stages
from torch import Tensor

from dataset_tools.stages import run_stages
from lerobot_histmv import keys
from lerobot_histmv.model.cameras import Workspace, deproject
from lerobot_histmv.model.config import LossConfig, NetworkConfig
from lerobot_histmv.model.losses import heat_loss

RESULTS = Path(__file__).parent / "results" / "heat_targets.json"
RULES = {"nearest surface": (0.0, 0.0, 0.0), "pointed at": LossConfig().approach}
MOVED = 0.01
"""Rows whose target lies farther [m] from the nearest surface's than this are counted."""


def offset(cloud: Tensor, valid: Tensor, pose: Tensor, approach: tuple[float, ...]) -> Tensor:
    """Key pose minus the expectation of the heat map's target [m], which is the loss's gradient; NaN without one."""
    log_heat = torch.zeros(valid.shape).masked_fill(~valid, -torch.inf).flatten(1).log_softmax(dim=1).view(valid.shape)
    (gradient,) = torch.autograd.grad(
        heat_loss(log_heat.requires_grad_(), cloud, valid, pose, approach).sum(), log_heat
    )
    if not gradient.any():
        return torch.full((3,), torch.nan)
    return pose[0, :3] + einsum(gradient, cloud, "m y x, m c y x -> c")


def offsets(dataset: LeRobotDataset) -> dict[int, list[list[np.ndarray]]]:
    """Row of an episode -> per episode one offset [m] for each of the rules, over the pixels of all views."""
    workspace, found = Workspace(NetworkConfig().workspace), defaultdict(list)
    cameras = list(dataset.meta.depth_keys)
    for sample in dataset:
        depth = torch.stack([sample[key].float().squeeze() for key in cameras])[None] / 1000
        intrinsics = rearrange(sample[keys.INTRINSICS], "(k i) -> 1 k i", i=4)
        extrinsics = rearrange(sample[keys.EXTRINSICS], "(k i j) -> 1 k i j", i=3, j=4)
        cloud = deproject(depth, intrinsics, extrinsics)
        _, valid = workspace.normalise_map(cloud, depth)
        cloud, valid = rearrange(cloud, "n k c y x -> n c (k y) x"), rearrange(valid, "n k y x -> n (k y) x")
        pose = sample[keys.ACTION][None, :7]
        found[int(sample["frame_index"])].append(
            [offset(cloud, valid, pose, approach).numpy() for approach in RULES.values()]
        )
    return found


def summary(rows: dict[int, list[list[np.ndarray]]]) -> dict[str, Any]:
    """Per row the spread of the rules' offsets [mm], how often they differ, and how many episodes have a target."""
    told: dict[str, Any] = {}
    for row, episodes in sorted(rows.items()):
        values = np.array(episodes)
        values = values[np.isfinite(values).all(axis=(1, 2))]
        spread = np.sqrt(values.var(axis=0).sum(axis=-1))
        moved = np.linalg.norm(values[:, 1] - values[:, 0], axis=-1) > MOVED
        told[str(row)] = {name: round(1000 * one, 1) for name, one in zip(RULES, spread.tolist(), strict=True)}
        told[str(row)] |= {"differ": int(moved.sum()), "episodes": len(values)}
    return told


def main() -> None:
    """Do the chosen settings."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=["stack_blocks", "pick_and_lift"])
    parser.add_argument("--episodes", type=int, default=16)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    args, console = parser.parse_args(), Console()
    for setting in args.settings:
        folder = args.output / setting
        run_stages(data_stages(setting, folder), folder, console, command_environment(1))
        dataset = LeRobotDataset(
            f"local/{setting}_keyframes",
            root=folder / "keyframes",
            episodes=list(range(args.episodes)),
            depth_output_unit="mm",
        )
        found = summary(offsets(dataset))
        add_result(setting, found, RESULTS)
        for row, told in found.items():
            console.print(f"{setting}, row {row}: {told}", highlight=False)


if __name__ == "__main__":
    main()
