"""Merged point cloud and PointNet++ set abstraction in plain torch (paper 3.2; Qi et al. 2017)."""

import torch
from einops import rearrange
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional

from lerobot_histmv.model.cameras import Workspace
from lerobot_histmv.model.config import PointsConfig


def gather_points(values: Float[Tensor, "n p c"], indices: Int[Tensor, "n *q"]) -> Float[Tensor, "n *q c"]:
    """Rows of ``values`` at ``indices``, per batch element."""
    batch = torch.arange(len(values), device=values.device).reshape(-1, *[1] * (indices.ndim - 1))
    return values[batch, indices]


def exact_distances(centres: Float[Tensor, "n c 3"], points: Float[Tensor, "n p 3"]) -> Float[Tensor, "n c p"]:
    """Distance [m] of all pairs.

    Not by the faster product form, which cancels to centimetres of error for points far from the origin.
    """
    return torch.cdist(centres, points, compute_mode="donot_use_mm_for_euclid_dist")


def farthest_points(points: Float[Tensor, "n p 3"], valid: Bool[Tensor, "n p"], count: int) -> Int[Tensor, "n c"]:
    """Indices of ``count`` farthest points: each next one is the valid point farthest from all chosen before.

    Starts at the first valid point. When fewer valid points than ``count`` exist, points repeat.
    """
    batch = torch.arange(len(points), device=points.device)
    nearest = torch.where(valid, torch.inf, -1.0)
    chosen = valid.float().argmax(dim=1)
    picks = []
    for _ in range(count):
        picks.append(chosen)
        distances = exact_distances(points[batch, chosen, None], points)
        nearest = torch.minimum(nearest, distances[:, 0])
        chosen = nearest.argmax(dim=1)
    return torch.stack(picks, dim=1)


def ball_query(
    centres: Float[Tensor, "n c 3"],
    points: Float[Tensor, "n p 3"],
    valid: Bool[Tensor, "n p"],
    radius: float,
    count: int,
) -> Int[Tensor, "n c m"]:
    """Indices of the ``count`` nearest valid points within ``radius`` [m]; the nearest fills the missing places."""
    distances = exact_distances(centres, points).masked_fill(~valid[:, None], torch.inf)
    near, indices = distances.topk(min(count, points.shape[1]), dim=-1, largest=False)
    return torch.where(near <= radius, indices, indices[..., :1])


class SetAbstraction(nn.Module):
    """Farthest-point sampling, ball query, shared MLP on offsets and features, maximum over each ball."""

    def __init__(self, channels_in: int, channels_out: int, centres: int, radius: float, neighbours: int) -> None:
        super().__init__()
        self.centres, self.radius, self.neighbours = centres, radius, neighbours
        self.first = nn.Linear(3 + channels_in, channels_out)
        self.second = nn.Linear(channels_out, channels_out)

    def forward(
        self, points: Float[Tensor, "n p 3"], features: Float[Tensor, "n p c"], valid: Bool[Tensor, "n p"]
    ) -> tuple[Float[Tensor, "n q 3"], Float[Tensor, "n q e"], Bool[Tensor, "n q"]]:
        """Centres, their features, and whether each centre is a valid point."""
        with torch.no_grad():
            picks = farthest_points(points, valid, self.centres)
            centres = gather_points(points, picks)
            balls = ball_query(centres, points, valid, self.radius, self.neighbours)
        offsets = (gather_points(points, balls) - centres[:, :, None]) / self.radius
        grouped = torch.cat([offsets, gather_points(features, balls)], dim=-1)
        hidden = self.second(functional.gelu(self.first(grouped)))
        return centres, hidden.amax(dim=2), gather_points(valid[..., None].float(), picks)[..., 0] > 0


class PointEncoder(nn.Module):
    """Coloured world points of all views to a few point tokens FP with position codes.

    Args:
        config: points part of the network's configuration.
        workspace: scales coordinates for the position codes.
        width: d, length of a point token.
    """

    def __init__(self, config: PointsConfig, workspace: Workspace, width: int) -> None:
        super().__init__()
        self.samples = config.samples
        self.workspace = workspace
        sizes = [3, *[width // 2] * (len(config.centres) - 1), width]
        self.levels = nn.ModuleList(
            SetAbstraction(sizes[i], sizes[i + 1], centres, radius, config.neighbours)
            for i, (centres, radius) in enumerate(zip(config.centres, config.radii, strict=True))
        )
        self.code = nn.Sequential(nn.Linear(3, width), nn.GELU(), nn.Linear(width, width))

    def forward(
        self, xyz: Float[Tensor, "n k 3 y x"], rgb: Float[Tensor, "n k 3 y x"], valid: Bool[Tensor, "n k y x"]
    ) -> Float[Tensor, "n p d"]:
        """Point tokens of world coordinates [m] with colours in [0, 1]; only ``valid`` pixels take part.

        In training the points are drawn at random, otherwise always the same way.
        """
        with torch.no_grad():
            points, features, valid_points = self._draw(xyz, rgb, valid)
        for level in self.levels:
            points, features, valid_points = level(points, features, valid_points)
        kept = rearrange(valid_points, "n p -> n p 1").to(features.dtype)
        return features * kept + self.code(self.workspace.normalise(points))

    def _draw(
        self, xyz: Float[Tensor, "n k 3 y x"], rgb: Float[Tensor, "n k 3 y x"], valid: Bool[Tensor, "n k y x"]
    ) -> tuple[Float[Tensor, "n p 3"], Float[Tensor, "n p 3"], Bool[Tensor, "n p"]]:
        """``samples`` points of all views: a coarse grid over every image first, then a draw among its valid pixels."""
        stride = max(1, int((valid[0].numel() / (4 * self.samples)) ** 0.5))
        row, column = torch.randint(stride, (2,)).tolist() if self.training else (stride // 2, stride // 2)
        points = rearrange(xyz[..., row::stride, column::stride], "n k c y x -> n (k y x) c")
        colours = rearrange(rgb[..., row::stride, column::stride], "n k c y x -> n (k y x) c")
        usable = rearrange(valid[..., row::stride, column::stride], "n k y x -> n (k y x)")
        if self.training:
            score = torch.rand(usable.shape, device=xyz.device)
        else:
            # Multiples of the golden ratio spread evenly over any subset: a fixed draw without a stored table.
            score = (torch.arange(usable.shape[1], device=xyz.device) * 0.6180339887).frac().expand_as(usable)
        count = min(self.samples, usable.shape[1])
        picks = (score + usable).topk(count, dim=1).indices
        return gather_points(points, picks), gather_points(colours, picks) * 2 - 1, usable.gather(1, picks)
