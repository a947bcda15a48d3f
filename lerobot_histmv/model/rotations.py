"""Rotations as tensors that gradients flow through: quaternions w, x, y, z and matrices."""

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

EPSILON = 1e-6


def multiply_quaternions(first: Float[Tensor, "*n 4"], second: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 4"]:
    """Hamilton product: the rotation ``second`` followed by ``first``."""
    w, x, y, z = first.unbind(-1)
    a, b, c, d = second.unbind(-1)
    return torch.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        dim=-1,
    )


def matrix_of(quaternion: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Rotation matrices of unit quaternions."""
    w, x, y, z = quaternion.unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def quaternion_of(rotation: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 4"]:
    """Unit quaternions of rotation matrices, of either sign.

    Each row of the table below is the quaternion times four of its components: the one with the largest component is
    far from 0 for every rotation, and so is its gradient from infinity (Shepperd 1978).
    """
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in rotation.unbind(-2))
    table = [
        [1 + a + e + i, h - f, c - g, d - b],
        [h - f, 1 + a - e - i, b + d, c + g],
        [c - g, b + d, 1 - a + e - i, f + h],
        [d - b, c + g, f + h, 1 - a - e + i],
    ]
    rows = torch.stack([torch.stack(row, dim=-1) for row in table], dim=-2)
    largest = rows.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    return functional.normalize(rows[torch.arange(len(rows), device=rows.device), largest], dim=-1)


def matrix_from_columns(columns: Float[Tensor, "n 3 2"]) -> Float[Tensor, "n 3 3"]:
    """Rotation matrix whose first two columns are these after Gram-Schmidt (Zhou et al. 2019, section 4)."""
    x, y = columns.unbind(-1)
    x = functional.normalize(x, dim=-1, eps=EPSILON)
    y = functional.normalize(y - (x * y).sum(dim=-1, keepdim=True) * x, dim=-1, eps=EPSILON)
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=-1)


def turned_with(tool: Float[Tensor, "n 3 3"], numbers: Float[Tensor, "n 12"]) -> Float[Tensor, "n 4"]:
    """Quaternion of the sum of two parts of a rotation's first columns: in the world's axes, and in the tool's."""
    world, own = rearrange(numbers, "n (part i column) -> part n i column", part=2, i=3)
    return quaternion_of(matrix_from_columns(world + tool @ own))
