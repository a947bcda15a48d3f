"""History-sensitive transformer: patches of a step attend to patches of that step and of past steps (paper 3.4)."""

from dataclasses import dataclass, replace

import torch
from einops import rearrange, repeat
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional

from lerobot_histmv.model.config import HistoryConfig
from lerobot_histmv.model.layers import Modulation


@dataclass(frozen=True)
class Lookback:
    """Which of n steps each of m spans of attention holds, and of which of them a decision is wanted.

    Args:
        rows: the steps of a span, old to new; any number where there is none.
        real: where there is one.
        asked: steps whose history-enriched map is wanted from this span.
    """

    rows: Int[Tensor, "m t"]
    real: Bool[Tensor, "m t"]
    asked: Bool[Tensor, "m t"]

    @property
    def decided(self) -> Int[Tensor, " r"]:
        """The steps whose maps come out, in their order."""
        return self.rows[self.asked]

    @classmethod
    def over(cls, real: Bool[Tensor, "m t"]) -> "Lookback":
        """Spans whose real steps lie packed in row-major order; all are asked for."""
        return cls(pack(real), real, real)

    def alone(self) -> "Lookback":
        """The decided steps, once nothing but them is kept, without any history."""
        return self.over(torch.ones_like(self.decided, dtype=torch.bool)[:, None])

    def newest(self) -> "Lookback":
        """The same spans, each asked for its last step only."""
        return replace(self, asked=self.real & (step_index(self.real) == self.real.sum(dim=1, keepdim=True) - 1))


def pack(real: Bool[Tensor, "m t"]) -> Int[Tensor, "m t"]:
    """Number of each real step when those alone are kept, in row-major order."""
    return (real.flatten().cumsum(dim=0) - 1).clamp_min(0).view_as(real)


class SelfAttentionBlock(nn.Module):
    """Pre-norm transformer layer whose attention mask is given per batch element."""

    def __init__(self, width: int, heads: int, dropout: float) -> None:
        super().__init__()
        self.heads, self.dropout = heads, dropout
        self.attention_norm, self.mix_norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.project_in, self.project_out = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.mix = nn.Sequential(nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width))
        self.drop = nn.Dropout(dropout)

    def forward(self, tokens: Float[Tensor, "b l d"], mask: Bool[Tensor, "b 1 l l"]) -> Float[Tensor, "b l d"]:
        """``mask[b, 0, q, p]`` tells whether token q may attend to token p."""
        packed = self.project_in(self.attention_norm(tokens))
        q, k, v = rearrange(packed, "b l (three g e) -> three b g l e", three=3, g=self.heads)
        dropout = self.dropout if self.training else 0.0
        mixed = functional.scaled_dot_product_attention(q, k, v, attn_mask=mask, dropout_p=dropout)
        tokens = tokens + self.drop(self.project_out(rearrange(mixed, "b g l e -> b l (g e)")))
        return tokens + self.drop(self.mix(self.mix_norm(tokens)))


def step_mask(real: Bool[Tensor, "b t"], skip_first: bool) -> Bool[Tensor, "b t t"]:
    """Which steps each step may look at: itself and real earlier ones.

    Padding steps see only themselves. With ``skip_first`` the first two real steps see only themselves: "where the
    current step is less than two, the strategy relies solely on the current observation" (paper 3.1).
    """
    t = real.shape[1]
    causal = torch.ones(t, t, dtype=torch.bool, device=real.device).tril()
    mask = causal & real[:, None, :] & real[:, :, None]
    if skip_first:
        mask = mask & (step_index(real) >= 2)[:, :, None]
    return mask | torch.eye(t, dtype=torch.bool, device=real.device)


def step_index(real: Bool[Tensor, "b t"]) -> Int[Tensor, "b t"]:
    """Number of real steps before each step of the window."""
    return (real.cumsum(dim=1) - 1).clamp_min(0)


class History(nn.Module):
    """Language, step and patch codes, then causal self-attention over the window's patches.

    Args:
        config: history part of the network's configuration.
        width: d.
        text_width: length of the instruction vector.
        grid: rows and columns of a view's feature map. A step's map has these, or a multiple of the rows when it holds
            several views, one below the other.
    """

    def __init__(self, config: HistoryConfig, width: int, text_width: int, grid: tuple[int, int]) -> None:
        super().__init__()
        self.skip_first = config.skip_first
        self.patch_in, self.patch_out = nn.Conv2d(width, width, 1), nn.Conv2d(width, width, 1)
        self.modulation = Modulation(width, text_width)
        self.step_code = nn.Embedding(config.memory + 1, width)
        self.patch_code = nn.Parameter(torch.randn(width, *grid) * 0.02)
        nn.init.normal_(self.step_code.weight, std=0.02)
        self.layers = nn.ModuleList(
            SelfAttentionBlock(width, config.heads, config.dropout) for _ in range(config.layers)
        )

    def forward(
        self, fused: Float[Tensor, "b t d h w"], text: Float[Tensor, "b c"], real: Bool[Tensor, "b t"]
    ) -> Float[Tensor, "b t d h w"]:
        """History-enriched maps of every step; maps of padding steps (``real`` false) are meaningless.

        Args:
            fused: FT of each step, old to new.
            text: instruction vector.
            real: False for steps before the episode's start.
        """
        t, h, w = fused.shape[1], *fused.shape[-2:]
        maps = self.speak(fused, text) + rearrange(self.step_code(step_index(real)), "b t d -> b t d 1 1")
        tokens = rearrange(maps, "b t d h w -> b (t h w) d")
        mask = repeat(step_mask(real, self.skip_first), "b q p -> b 1 (q i) (p j)", i=h * w, j=h * w)
        for layer in self.layers:
            tokens = layer(tokens, mask)
        return rearrange(tokens, "b (t h w) d -> b t d h w", t=t, h=h)

    def speak(self, fused: Float[Tensor, "b t d h w"], text: Float[Tensor, "b c"]) -> Float[Tensor, "b t d h w"]:
        """Mix the sentence vector into every patch and add the patch codes.

        A convolution over a patch's channels joined by the sentence vector is a sum of one over the patch and one over
        the sentence; the gain beside that sum lets the sentence pick channels, which a sum alone learns slowly.
        """
        b, t = fused.shape[:2]
        patches = self.patch_in(rearrange(fused, "b t d h w -> (b t) d h w"))
        spoken = functional.gelu(self.modulation(patches, repeat(text, "b c -> (b t) c", t=t)))
        views = fused.shape[-2] // self.patch_code.shape[-2]
        codes = repeat(self.patch_code, "d h w -> d (k h) w", k=views)
        return fused + rearrange(self.patch_out(spoken), "(b t) d h w -> b t d h w", b=b) + codes
