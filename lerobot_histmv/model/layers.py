"""Shared blocks of the network; knows nothing of robots, cameras or steps."""

from contextlib import AbstractContextManager, nullcontext

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

GROUP = 8
"""Channels that are normalised together: a CPU's vector. With six, group normalisation in channels_last memory takes
ten times as long, longer than the convolution before it."""


def group_norm(channels: int) -> nn.GroupNorm:
    """Group normalisation in groups of ``GROUP`` channels, or of all channels where that leaves a rest."""
    return nn.GroupNorm(1 if channels % GROUP else channels // GROUP, channels)


class ConvBlock(nn.Module):
    """3x3 convolution, group normalisation, leaky ReLU. ``stride=2`` halves the map.

    ``normalise=False`` is for maps of half the image's size, where the normalisation's memory traffic costs more than
    the convolution.
    """

    def __init__(self, channels_in: int, channels_out: int, stride: int = 1, normalise: bool = True) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels_in, channels_out, 3, stride, 1, bias=not normalise)
        self.norm = group_norm(channels_out) if normalise else nn.Identity()

    def forward(self, maps: Float[Tensor, "n c y x"]) -> Float[Tensor, "n e y2 x2"]:
        """Maps (n, channels_in, y, x) to (n, channels_out, ceil(y / stride), ceil(x / stride))."""
        return functional.leaky_relu(self.norm(self.conv(maps)), 0.02)


def upsample_to(maps: Float[Tensor, "n c y x"], like: Float[Tensor, "n e y2 x2"]) -> Float[Tensor, "n c y2 x2"]:
    """Nearest-neighbour resize of ``maps`` to the height and width of ``like``."""
    return functional.interpolate(maps, size=like.shape[-2:], mode="nearest")


def resize_bilinear(maps: Float[Tensor, "n y x"], size: tuple[int, int]) -> Float[Tensor, "n y2 x2"]:
    """Bilinear resize (pixel centres at half numbers) as two matrix products.

    The same numbers as ``functional.interpolate``, whose backward pass takes eight times as long on a CPU.
    """
    down, across = (
        functional.interpolate(torch.eye(old, dtype=maps.dtype, device=maps.device)[None], new, mode="linear")[0]
        for old, new in zip(maps.shape[-2:], size, strict=True)
    )
    return down.T @ maps @ across


class CrossAttention(nn.Module):
    """Pre-norm cross-attention and feed-forward layer with residual connections (paper Eq. 8)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.query_norm = nn.LayerNorm(width)
        self.key_norm = nn.LayerNorm(width)
        self.attend = nn.MultiheadAttention(width, heads, batch_first=True)
        self.mix = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width)
        )

    def forward(
        self, queries: Float[Tensor, "n q d"], keys: Float[Tensor, "n p d"], codes: Float[Tensor, "n q d"]
    ) -> Float[Tensor, "n q d"]:
        """Let ``queries``, with position ``codes`` added, gather from ``keys``."""
        context = self.key_norm(keys)
        gathered, _ = self.attend(self.query_norm(queries) + codes, context, context, need_weights=False)
        queries = queries + gathered
        return queries + self.mix(queries)


class Modulation(nn.Module):
    """A sentence picks channels: gain and bias per channel from its vector (FiLM, Perez et al. 2018)."""

    def __init__(self, channels: int, text_width: int) -> None:
        super().__init__()
        self.gain, self.bias = nn.Linear(text_width, channels), nn.Linear(text_width, channels)
        for part in (self.gain, self.bias):
            nn.init.normal_(part.weight, std=0.02)
            nn.init.zeros_(part.bias)

    def forward(self, maps: Float[Tensor, "n c y x"], text: Float[Tensor, "n e"]) -> Float[Tensor, "n c y x"]:
        """Maps after gain and bias; the sentence vectors may have any scale."""
        text = functional.layer_norm(text, text.shape[-1:])
        return torch.addcmul(self.bias(text)[:, :, None, None], maps, 1 + self.gain(text)[:, :, None, None])


def full_precision(like: Tensor) -> AbstractContextManager:
    """Context for geometry and information inside mixed precision: half precision would round metres to millimetres."""
    return nullcontext() if like.is_meta else torch.autocast(like.device.type, enabled=False)


def masked_mean(values: Float[Tensor, "*s"], weights: Float[Tensor, "*s"]) -> Float[Tensor, ""]:
    """Weighted mean; 0 when all weights are 0."""
    return (values * weights).sum() / weights.sum().clamp_min(torch.finfo(values.dtype).tiny)
