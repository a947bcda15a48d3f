"""The class token of a frozen open_clip Vision Transformer at three quarters of the cost, the same up to rounding.

Two things that open_clip cannot know: nothing but the class token leaves the last block, and the weights never change,
so that a CPU need not rearrange them for every product.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from einops import rearrange
from jaxtyping import Float
from open_clip.transformer import ResidualAttentionBlock, VisionTransformer
from torch import Tensor, nn
from torch.nn import functional

Product = Callable[[Tensor], Tensor]

ROWS = 150
"""Rows for which the weights are arranged, three views of 50 tokens (ViT-B/32); any other number gives the same."""


def can_arrange(weight: Tensor) -> bool:
    """Whether oneDNN's products with rearranged weights are there, those that torch.compile calls when it freezes."""
    return weight.is_cpu and weight.dtype == torch.float32 and hasattr(torch.ops.mkldnn, "_linear_pointwise")


def product(weight: Float[Tensor, "o i"], bias: Float[Tensor, " o"]) -> Product:
    """``x @ weight.T + bias`` for weights that stay as they are."""
    weight, bias = weight.detach(), bias.detach()
    if not can_arrange(weight):
        return partial(functional.linear, weight=weight, bias=bias)
    arranged = torch.ops.mkldnn._reorder_linear_weight(weight.contiguous(), ROWS)
    return lambda x: torch.ops.mkldnn._linear_pointwise(x, arranged, bias, "none", [], "")


class Products:
    """The products of one block, on the device and in the precision that its weights have now."""

    def __init__(self, block: ResidualAttentionBlock) -> None:
        attention, width = block.attn, block.attn.embed_dim
        weight, bias = attention.in_proj_weight, attention.in_proj_bias
        self.query = product(weight[:width], bias[:width])
        self.key_value = product(weight[width:], bias[width:])
        self.attended = product(attention.out_proj.weight, attention.out_proj.bias)
        self.up = product(block.mlp.c_fc.weight, block.mlp.c_fc.bias)
        self.down = product(block.mlp.c_proj.weight, block.mlp.c_proj.bias)


def block_output(
    block: ResidualAttentionBlock, products: Products, tokens: Float[Tensor, "n t c"], leaving: int | None
) -> Float[Tensor, "n t2 c"]:
    """The first ``leaving`` tokens (None: all) of what ``block(tokens)`` gives."""
    seen = block.ln_1(tokens)
    query = rearrange(products.query(seen[:, :leaving]), "n t (h c) -> n h t c", h=block.attn.num_heads)
    key, value = rearrange(products.key_value(seen), "n t (j h c) -> j n h t c", j=2, h=block.attn.num_heads)
    attended = functional.scaled_dot_product_attention(query, key, value)
    tokens = tokens[:, :leaving] + block.ls_1(products.attended(rearrange(attended, "n h t c -> n t (h c)")))
    return tokens + block.ls_2(products.down(block.mlp.gelu(products.up(block.ln_2(tokens)))))


class FrozenBlocks(nn.Module):
    """Takes the place of ``VisionTransformer.transformer``, with its parameters under their names."""

    def __init__(self, resblocks: nn.ModuleList) -> None:
        super().__init__()
        self.resblocks = resblocks
        self._arranged: tuple[Any, list[Products]] = (None, [])

    def forward(self, tokens: Float[Tensor, "n t c"]) -> Float[Tensor, "n 1 c"]:
        """The class token, the first one, after all blocks."""
        # Autocast would round all weights at every call, which takes a CPU ten times as long as the products.
        with torch.no_grad(), torch.autocast("cpu", enabled=False):
            products = self._products()
            tokens = tokens.to(next(self.parameters()).dtype)  # patches are embedded under autocast
            for block, own in zip(self.resblocks[:-1], products[:-1], strict=True):
                tokens = block_output(block, own, tokens, leaving=None)
            return block_output(self.resblocks[-1], products[-1], tokens, leaving=1)

    def _products(self) -> list[Products]:
        weight = next(self.parameters())
        place = (weight.device, weight.dtype)
        if self._arranged[0] != place:
            self._arranged = place, [Products(block) for block in self.resblocks]
        return self._arranged[1]

    def __getstate__(self) -> dict[str, Any]:
        """Copies arrange the weights anew: oneDNN's arrangement can be neither copied nor sent to a process."""
        return {**self.__dict__, "_arranged": (None, [])}


def quicken(visual: nn.Module) -> None:
    """Let a frozen image tower compute no more than its vector, if it is a plain Vision Transformer of open_clip."""
    if not isinstance(visual, VisionTransformer) or visual.pool_type != "tok" or visual.attn_pool is not None:
        return
    blocks = visual.transformer.resblocks
    if all(type(block) is ResidualAttentionBlock for block in blocks):
        visual.transformer = FrozenBlocks(blocks)
