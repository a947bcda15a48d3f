"""Rotations of the network against scipy's, and what the sum of a world's and a tool's part means."""

import torch
from scipy.spatial.transform import Rotation

from lerobot_histmv.model.rotations import (
    matrix_from_columns,
    matrix_of,
    multiply_quaternions,
    quaternion_of,
    turned_with,
)

N = 11


def random_quaternions(seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(N, 4, generator=generator, dtype=torch.float64), dim=1)


def scipy_matrices(quaternions: torch.Tensor) -> torch.Tensor:
    return torch.from_numpy(Rotation.from_quat(quaternions.numpy(), scalar_first=True).as_matrix())


HALF_TURNS = torch.eye(4, dtype=torch.float64)
"""No rotation, and half turns about x, y and z, for which w is 0."""


def test_hamilton_product_equals_scipy() -> None:
    first, second = random_quaternions(0), random_quaternions(1)
    expected = scipy_matrices(first) @ scipy_matrices(second)
    torch.testing.assert_close(scipy_matrices(multiply_quaternions(first, second)), expected)


def test_matrices_equal_scipy_and_turn_back_into_the_quaternion_of_either_sign() -> None:
    for quaternions in (random_quaternions(), HALF_TURNS):
        matrices = matrix_of(quaternions)
        torch.testing.assert_close(matrices, scipy_matrices(quaternions))
        same = (quaternion_of(matrices) * quaternions).sum(dim=1).abs()
        torch.testing.assert_close(same, torch.ones(len(quaternions), dtype=torch.float64))


def test_columns_of_a_rotation_give_it_back_and_any_others_give_a_rotation() -> None:
    matrices = matrix_of(random_quaternions())
    stretched = matrices[..., :2] * torch.tensor([0.3, 7.0], dtype=torch.float64)
    torch.testing.assert_close(matrix_from_columns(stretched), matrices)
    found = matrix_from_columns(torch.randn(N, 3, 2, dtype=torch.float64))
    torch.testing.assert_close(found @ found.mT, torch.eye(3, dtype=torch.float64).expand(N, 3, 3))
    torch.testing.assert_close(torch.linalg.det(found), torch.ones(N, dtype=torch.float64))


def test_gradients_are_right_and_finite_where_all_numbers_are_zero() -> None:
    tool = matrix_of(random_quaternions())
    numbers = torch.randn(N, 12, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    assert torch.autograd.gradcheck(turned_with, (tool, numbers))
    zeros = torch.zeros(N, 12, dtype=torch.float64, requires_grad=True)
    turned_with(tool, zeros).sum().backward()
    assert zeros.grad is not None
    assert zeros.grad.isfinite().all()


def rotation_numbers(matrices: torch.Tensor) -> torch.Tensor:
    return matrices[..., :2].flatten(1)


def test_the_tool_s_part_turns_with_the_tool_and_the_world_s_part_does_not() -> None:
    tool, wanted = matrix_of(random_quaternions(0)), matrix_of(random_quaternions(1))
    nothing, still = torch.zeros(N, 6, dtype=torch.float64), torch.eye(3, dtype=torch.float64).expand(N, 3, 3)
    kept = turned_with(tool, torch.cat([nothing, rotation_numbers(still)], dim=1))
    torch.testing.assert_close(matrix_of(kept), tool)
    turned = turned_with(tool, torch.cat([nothing, rotation_numbers(wanted)], dim=1))
    torch.testing.assert_close(matrix_of(turned), tool @ wanted)
    absolute = turned_with(tool, torch.cat([rotation_numbers(wanted), nothing], dim=1))
    torch.testing.assert_close(matrix_of(absolute), wanted)
