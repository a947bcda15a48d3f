"""What is computed another way because it is faster gives the same values and gradients as the plain way."""

from collections.abc import Callable

import pytest
import torch
from tiny_policy import tiny_policy
from torch import Tensor
from torch.func import functional_call
from torch.nn import functional

from lerobot_histmv.model.cameras import squared_distances
from lerobot_histmv.model.decoder import Merge
from lerobot_histmv.model.image_tower import resized
from lerobot_histmv.model.layers import GROUP, group_norm, resize_bilinear
from lerobot_histmv.model.network import pick_images


def value_and_gradients(function: Callable[..., Tensor], *inputs: Tensor) -> list[Tensor]:
    leaves = [one.clone().requires_grad_() for one in inputs]
    value = function(*leaves)
    generator = torch.Generator().manual_seed(0)
    (value * torch.randn(value.shape, generator=generator, dtype=value.dtype)).sum().backward()
    return [value.detach(), *(leaf.grad for leaf in leaves if leaf.grad is not None)]


def assert_same(fast: Callable[..., Tensor], plain: Callable[..., Tensor], *inputs: Tensor) -> None:
    found, expected = value_and_gradients(fast, *inputs), value_and_gradients(plain, *inputs)
    assert len(found) == 1 + len(inputs)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("size", [(14, 22), (3, 5), (13, 7)])
def test_bilinear_resizing(size: tuple[int, int]) -> None:
    maps = torch.randn(3, 7, 11, dtype=torch.float64)
    assert_same(
        lambda maps: resize_bilinear(maps, size),
        lambda maps: functional.interpolate(maps[:, None], size=size, mode="bilinear", align_corners=False)[:, 0],
        maps,
    )


def test_halving_images() -> None:
    images = torch.rand(2, 3, 10, 14, dtype=torch.float64)
    assert_same(
        lambda rgb: resized(rgb, (5, 7)), lambda rgb: functional.interpolate(rgb, size=(5, 7), mode="area"), images
    )


def test_squared_distances() -> None:
    cloud, points = torch.randn(5, 3, 7, 11, dtype=torch.float64), torch.randn(5, 3, dtype=torch.float64)
    assert_same(
        squared_distances, lambda cloud, points: (cloud - points[:, :, None, None]).square().sum(dim=1), cloud, points
    )


def merging(normalise: bool) -> tuple[Callable[..., Tensor], list[Tensor]]:
    """``Merge`` as a function of both maps and its weights, and these: the coarse map's, the skip's, the bias."""
    merge, names = Merge(3, 5, 7, normalise).double(), ["coarse.weight", "skip.weight", "skip.bias"]

    def function(maps: Tensor, skip: Tensor, *values: Tensor) -> Tensor:
        return functional_call(merge, dict(zip(names, values, strict=True)), (maps, skip))

    return function, [merge.get_parameter(name).detach() for name in names]


def finished(joined: Tensor, normalise: bool) -> Tensor:
    if normalise:
        rest = joined - joined.mean(dim=(1, 2, 3), keepdim=True)
        joined = rest / (rest.square().mean(dim=(1, 2, 3), keepdim=True) + 1e-5).sqrt()
    return torch.where(joined < 0, 0.02 * joined, joined)


@pytest.mark.parametrize("normalise", [True, False])
def test_merging_maps_of_one_size_is_a_convolution_of_both_side_by_side(normalise: bool) -> None:
    merge, weights = merging(normalise)
    maps, skip = torch.randn(2, 3, 11, 13, dtype=torch.float64), torch.randn(2, 5, 11, 13, dtype=torch.float64)

    def plain(maps: Tensor, skip: Tensor, coarse: Tensor, fine: Tensor, bias: Tensor) -> Tensor:
        kernel = torch.cat([coarse, fine], dim=1)
        return finished(functional.conv2d(torch.cat([maps, skip], dim=1), kernel, bias, padding=1), normalise)

    assert_same(merge, plain, maps, skip, *weights)


@pytest.mark.parametrize("normalise", [True, False])
def test_merging_a_coarser_map_repeats_each_pixel_of_its_part_of_the_convolution(normalise: bool) -> None:
    merge, weights = merging(normalise)
    maps, skip = torch.randn(2, 3, 11, 13, dtype=torch.float64), torch.randn(2, 5, 22, 26, dtype=torch.float64)

    def plain(maps: Tensor, skip: Tensor, coarse: Tensor, fine: Tensor, bias: Tensor) -> Tensor:
        part = functional.conv2d(maps, coarse, padding=1)
        repeated = part.repeat_interleave(2, dim=2).repeat_interleave(2, dim=3)
        return finished(repeated + functional.conv2d(skip, fine, bias, padding=1), normalise)

    assert_same(merge, plain, maps, skip, *weights)


@pytest.mark.parametrize("views", [[[0, 0], [0, 1], [0, 2], [1, 0], [1, 1], [1, 2]], [[1, 2], [0, 1]]])
def test_picking_images(views: list[list[int]]) -> None:
    images, pairs = torch.randn(2, 3, 5, 7), torch.tensor(views)
    assert_same(
        lambda images: pick_images(images.flatten(0, 1), pairs, 3), lambda images: images[tuple(pairs.T)], images
    )


def test_groups_are_whole_vectors_or_all_channels() -> None:
    assert [group_norm(channels).num_groups for channels in (4, GROUP, 3 * GROUP, GROUP + 4)] == [1, 1, 3, 1]


def test_optimizer_is_fused_and_moves_weights_as_a_plain_one() -> None:
    policies = [tiny_policy(), tiny_policy()]
    preset = policies[0].config.get_optimizer_preset()
    plain = [{"params": policies[1].get_optim_params()[0]["params"]}]
    optimizers = [preset.build(policies[0].get_optim_params()), preset.build(plain)]
    assert [optimizer.param_groups[0]["fused"] for optimizer in optimizers] == [True, None]
    for optimizer in optimizers:
        generator = torch.Generator().manual_seed(0)
        for _ in range(3):
            for parameter in optimizer.param_groups[0]["params"]:
                parameter.grad = torch.randn(parameter.shape, generator=generator)
            optimizer.step()
    start = tiny_policy().state_dict()
    assert any(not value.equal(start[name]) for name, value in policies[0].state_dict().items())
    for name, value in policies[0].state_dict().items():
        torch.testing.assert_close(value, policies[1].state_dict()[name])
