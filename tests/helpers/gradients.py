"""Whether two ways to compute give the same gradients, as far as float32 can tell."""

from collections.abc import Sequence

import torch
from torch import Tensor

OWN_ROUNDING, OTHERS_ROUNDING = 1e-3, 1e-5
"""Errors allowed, as shares of the largest number in the tensor and in all tensors.

A gradient that is zero in exact arithmetic is what is left of large numbers that cancel.
"""
IGNORED, LEFT = "position.heat.bias", 1e-4
"""The softmax ignores the heat map's bias: both gradients are zero but for this share of the largest of all tensors."""


def largest(tensors: Sequence[Tensor]) -> float:
    return max(tensor.abs().max().item() for tensor in tensors)


def assert_same_gradients(found: Sequence[Tensor], expected: Sequence[Tensor], names: Sequence[str] = ()) -> None:
    """Compares tensors in pairs; ``names`` tell which pair differs."""
    floor = OTHERS_ROUNDING * largest(expected)
    for at, (one, other) in enumerate(zip(found, expected, strict=True)):
        allowed = max(OWN_ROUNDING * largest([other]), floor)
        name = names[at] if names else f"gradient {at}"
        if name.endswith(IGNORED):
            assert largest([one, other]) < LEFT * largest(expected), name
            continue
        torch.testing.assert_close(one, other, rtol=0, atol=allowed, msg=lambda text, name=name: f"{name}: {text}")
