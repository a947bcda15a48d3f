"""What the history transformer looked at, computed again from what went into its layers.

The layers use a fused kernel that never holds its weights. Here they are spelt out, so that acting stays as fast as it
is; a test proves that a layer with these weights gives what the layer gave.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from einops import einsum, rearrange, reduce
from jaxtyping import Bool, Float
from torch import Tensor

from lerobot_histmv.model.history import History, SelfAttentionBlock


def attention_weights(
    layer: SelfAttentionBlock, tokens: Float[Tensor, "b l d"], mask: Bool[Tensor, "b 1 l l"]
) -> Float[Tensor, "b g l l"]:
    """How much each token (third axis) takes from each (last axis) in every head; sums to 1 over the last axis."""
    packed = layer.project_in(layer.attention_norm(tokens))
    queries, keys, _ = rearrange(packed, "b l (three g e) -> three b g l e", three=3, g=layer.heads)
    scores = einsum(queries, keys, "b g q e, b g p e -> b g q p") / queries.shape[-1] ** 0.5
    return scores.masked_fill(~mask, -torch.inf).softmax(dim=-1)


def step_shares(weights: Float[Tensor, "b g l l"], steps: int) -> Float[Tensor, "b t t"]:
    """Share of each step (last axis) in what each step (second axis) takes: mean over heads and patches.

    Args:
        weights: of one layer.
        steps: t, steps in the window; patches of a step are next to each other.
    """
    return reduce(weights, "b g (q i) (p j) -> b q p", "mean", q=steps, p=steps) * (weights.shape[-1] // steps)


@contextmanager
def forgotten(history: History, steps: Sequence[int], window: int) -> Iterator[None]:
    """While this lasts, no other step of the ``window`` sees the given ``steps``."""
    hide = partial(_hide, steps=steps, window=window)
    handles = [layer.register_forward_pre_hook(hide) for layer in history.layers]
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()


def _hide(_: Any, inputs: tuple[Tensor, Tensor], steps: Sequence[int], window: int) -> tuple[Tensor, Tensor]:
    tokens, mask = inputs
    patches = tokens.shape[1] // window
    owner = torch.arange(tokens.shape[1], device=tokens.device) // patches
    gone = torch.isin(owner, torch.tensor(steps, device=tokens.device))
    return tokens, mask & ~(gone & (owner[:, None] != owner))
