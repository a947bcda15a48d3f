"""A tiny world for tests, without LeRobot: cameras around the workspace, noisy images and a small network."""

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lerobot_histmv.model.config import HistoryConfig, NetworkConfig, PointsConfig, TextureConfig
from lerobot_histmv.model.network import HistMVNet, Observation

SIZE = (32, 48)
"""Rows and columns: the smallest images whose feature grid, 2 x 3, is not square."""

SEEN = torch.tensor([0.45, 0.0, 0.375])
"""Where all cameras look [m], inside the default workspace."""


def tiny_network(past_steps: int = 2, **changes: Any) -> NetworkConfig:
    """The default network with everything made small; ``changes`` replace its parts."""
    config = NetworkConfig(
        width=8,
        texture=TextureConfig(widths=(4, 4, 8, 8), neck=4),
        points=PointsConfig(samples=53, centres=(13, 7), radii=(0.1, 0.3), neighbours=3),
        history=HistoryConfig(past_steps=past_steps, layers=2, heads=2),
    )
    return replace(config, **changes)


def tiny_net(seed: int = 0, past_steps: int = 2, **changes: Any) -> HistMVNet:
    """A seeded network in evaluation mode."""
    torch.manual_seed(seed)
    return HistMVNet(tiny_network(past_steps, **changes), SIZE).eval()


def look_at(position: Float[Tensor, " 3"], target: Float[Tensor, " 3"]) -> Float[Tensor, "3 4"]:
    """``T_world_cam`` of a camera at ``position`` that looks at ``target`` with the world's z up in its image."""
    forward = torch.nn.functional.normalize(target - position, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, forward.new_tensor([0.0, 0.0, 1.0])), dim=0)
    down = torch.linalg.cross(forward, right)
    return torch.stack([right, down, forward, position], dim=1)


def cameras_around(k: int) -> tuple[Float[Tensor, "k 4"], Float[Tensor, "k 3 4"]]:
    """Intrinsics and extrinsics of ``k`` cameras on a circle above the workspace, no two alike."""
    angles = torch.arange(k) * 2.4
    circle = torch.stack([0.4 * angles.cos(), 0.4 * angles.sin(), 0.3 + 0.05 * torch.arange(k)], dim=1)
    extrinsics = torch.stack([look_at(SEEN + offset, SEEN) for offset in circle])
    rows, columns = SIZE
    symmetric = torch.tensor([41.0, 41.0, (columns - 1) / 2, (rows - 1) / 2])
    return symmetric + 0.5 * torch.arange(k)[:, None], extrinsics


def noise_images(
    n: int, k: int, generator: torch.Generator
) -> tuple[Float[Tensor, "n k 3 y x"], Float[Tensor, "n k y x"]]:
    """Random colours in [0, 1] and depth around the workspace's centre [m]; about one pixel in ten has no depth."""
    rgb = torch.rand(n, k, 3, *SIZE, generator=generator)
    depth = 0.35 + 0.3 * torch.rand(n, k, *SIZE, generator=generator)
    return rgb, depth * (torch.rand(depth.shape, generator=generator) > 0.1)


def tiny_observation(n: int, k: int, text_width: int, seed: int = 0) -> Observation:
    """``n`` unrelated steps seen from ``k`` views, each with its own tool position as the only heat."""
    generator = torch.Generator().manual_seed(seed)
    rgb, depth = noise_images(n, k, generator)
    intrinsics, extrinsics = cameras_around(k)
    tool = SEEN + 0.1 * torch.randn(n, 1, 3, generator=generator)
    text = torch.nn.functional.normalize(torch.randn(n, text_width, generator=generator), dim=-1)
    return Observation(
        rgb=rgb,
        depth=depth,
        intrinsics=intrinsics.expand(n, k, 4),
        extrinsics=extrinsics.expand(n, k, 3, 4),
        tool=tool,
        heat=torch.ones(n, 1),
        turn=torch.nn.functional.normalize(torch.randn(n, 4, generator=generator), dim=-1),
        opening=torch.rand(n, generator=generator),
        text=text,
    )
