"""Texture pyramid, PANet neck and RGB-A features: sizes, and what may influence what."""

import pytest
import torch
from tiny_scene import SIZE

from lerobot_histmv.model.config import TextureConfig
from lerobot_histmv.model.features import POSE_STRIDE, STRIDE, PANet, RgbaFeatures
from lerobot_histmv.model.layers import ConvBlock, masked_mean, upsample_to

N, K, WIDTH, SEMANTIC, TEXT = 2, 3, 8, 5, 7
TINY = TextureConfig(widths=(4, 4, 8, 8), neck=4)


def test_panet_keeps_the_size_of_every_level() -> None:
    torch.manual_seed(0)
    channels, sizes = [3, 5, 7], [(8, 12), (4, 6), (2, 3)]
    levels = [torch.randn(N, c, *size) for c, size in zip(channels, sizes, strict=True)]
    aggregated = PANet(channels, 11)(levels)
    assert [level.shape for level in aggregated] == [(N, 11, *size) for size in sizes]


def test_panet_aggregates_paths_both_ways() -> None:
    """Every output level depends on every input level: coarse reaches fine and fine reaches coarse."""
    torch.manual_seed(0)
    levels = [torch.randn(1, 3, side, side, requires_grad=True) for side in (8, 4, 2)]
    for output in PANet([3, 3, 3], 4)(levels):
        gradients = torch.autograd.grad(output.square().sum(), levels, retain_graph=True)
        assert all(gradient.abs().sum() > 0 for gradient in gradients)


def test_panet_equals_its_definition_level_by_level() -> None:
    """Down: a level's own lateral map and the coarser one repeated; up: its own map of the way down and the finer one
    halved, so that the finest is that of the way down alone."""
    torch.manual_seed(0)
    channels, sizes = [3, 5, 7, 2], [(8, 24), (4, 12), (2, 6), (1, 3)]
    levels = [torch.randn(N, c, *size) for c, size in zip(channels, sizes, strict=True)]
    neck = PANet(channels, 11)

    def down(i: int) -> torch.Tensor:
        lateral = neck.lateral[i]
        own = torch.einsum("ec,ncyx->neyx", lateral.weight[..., 0, 0], levels[i]) + lateral.bias[:, None, None]
        if i == len(levels) - 1:
            return own
        return neck.top_down[i](own + down(i + 1).repeat_interleave(2, dim=2).repeat_interleave(2, dim=3))

    def up(i: int) -> torch.Tensor:
        return neck.bottom_up[i - 1](down(i) + neck.shrink[i - 1](up(i - 1))) if i else down(0)

    for i, found in enumerate(neck(levels)):
        torch.testing.assert_close(found, up(i))


def images(k: int = K) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(k)
    return {
        "rgb": torch.rand(N, k, 3, *SIZE, generator=generator) * 2 - 1,
        "xyz": torch.rand(N, k, 3, *SIZE, generator=generator) * 2 - 1,
        "poses": torch.rand(N, k, 1, SIZE[0] // POSE_STRIDE, SIZE[1] // POSE_STRIDE, generator=generator),
        "semantics": torch.randn(N, k, SEMANTIC, generator=generator),
        "text": torch.randn(N, TEXT, generator=generator),
    }


def rgba(config: TextureConfig = TINY) -> RgbaFeatures:
    torch.manual_seed(0)
    return RgbaFeatures(config, SEMANTIC, TEXT, WIDTH).eval()


@pytest.mark.parametrize(
    "config",
    [
        TINY,
        TextureConfig(backbone="mobilenetv3_small_050", neck=4),
        TextureConfig(backbone="resnet10t", use_xyz=False, neck=4),
    ],
    ids=lambda config: config.backbone,
)
def test_every_backbone_gives_strides_2_to_16(config: TextureConfig) -> None:
    module = rgba(config)
    features, skips = module(**images())
    assert features.shape == (N, K, WIDTH, SIZE[0] // STRIDE, SIZE[1] // STRIDE)
    assert [skip.shape[1] for skip in skips] == module.skip_channels
    assert [(SIZE[0] // s.shape[2], SIZE[1] // s.shape[3]) for s in skips] == [
        (stride, stride) for stride in (2, 4, 8, 16)
    ]
    assert all(len(skip) == N * K for skip in skips)


def test_backbone_may_name_the_weights_it_starts_from() -> None:
    assert rgba(TextureConfig(backbone="resnet10t.c3_in1k", neck=4)).skip_channels


@pytest.mark.parametrize("name", ["vit_tiny_patch16_224", "no_such_model"])
def test_unfit_backbones_are_refused_by_name(name: str) -> None:
    with pytest.raises(ValueError, match=rf"texture\.backbone='{name}'"):
        rgba(TextureConfig(backbone=name))


@pytest.mark.parametrize(
    ("switches", "influential"),
    [
        ({}, {"rgb", "xyz", "poses", "semantics", "text"}),
        ({"use_xyz": False}, {"rgb", "poses", "semantics", "text"}),
        ({"language": False}, {"rgb", "xyz", "poses", "semantics"}),
    ],
)
def test_every_input_that_the_configuration_names_influences_the_features(
    switches: dict[str, bool], influential: set[str]
) -> None:
    module = rgba(TextureConfig(widths=TINY.widths, neck=TINY.neck, **switches))
    leaves = {name: values.requires_grad_() for name, values in images().items()}
    features, _ = module(**leaves)
    features.square().sum().backward()
    assert {name for name, leaf in leaves.items() if leaf.grad is not None and leaf.grad.abs().sum() > 0} == influential


def test_views_are_encoded_alone_by_the_same_weights() -> None:
    module, order = rgba(), torch.tensor([2, 0, 1])
    features, skips = module(**images())
    inputs = images()
    views = {name: values[:, order] for name, values in inputs.items() if name != "text"}
    permuted, permuted_skips = module(**views, text=inputs["text"])
    torch.testing.assert_close(permuted, features[:, order])
    for skip, other in zip(skips, permuted_skips, strict=True):
        torch.testing.assert_close(other.unflatten(0, (N, K)), skip.unflatten(0, (N, K))[:, order])


@pytest.mark.parametrize("size", [(7, 11), (8, 12)])
@pytest.mark.parametrize("stride", [1, 2])
def test_convolution_block_divides_sizes_upwards(size: tuple[int, int], stride: int) -> None:
    maps = ConvBlock(3, 5, stride)(torch.randn(N, 3, *size))
    assert maps.shape == (N, 5, *(-(-side // stride) for side in size))


def test_upsampling_repeats_the_nearest_value() -> None:
    maps = torch.tensor([[[[1.0, 2.0]]]])
    assert upsample_to(maps, torch.empty(1, 7, 2, 4)).tolist() == [[[[1, 1, 2, 2]] * 2]]


def test_masked_mean_is_the_weighted_mean_and_0_without_weight() -> None:
    values = torch.tensor([1.0, 5.0, 100.0])
    assert masked_mean(values, torch.tensor([3.0, 1.0, 0.0])) == 2
    assert masked_mean(values, torch.zeros(3)) == 0
