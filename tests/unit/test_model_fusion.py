"""TransFuse: image tokens gather from a set of points, so neither points nor views have an order."""

import pytest
import torch

from lerobot_histmv.model.fusion import TransFuse

N, K, D, H, W, P = 2, 3, 8, 5, 7, 11


def inputs() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    features, cells = torch.randn(N, K, D, H, W, generator=generator), torch.randn(N, K, 3, H, W, generator=generator)
    return features, cells, torch.randn(N, P, D, generator=generator)


@pytest.fixture
def fuse() -> TransFuse:
    torch.manual_seed(0)
    return TransFuse(D, 2)


def test_point_order_does_not_matter(fuse: TransFuse) -> None:
    features, cells, points = inputs()
    torch.testing.assert_close(fuse(features, cells, points[:, torch.randperm(P)]), fuse(features, cells, points))


def test_view_order_does_not_matter(fuse: TransFuse) -> None:
    features, cells, points = inputs()
    order = torch.tensor([1, 2, 0])
    torch.testing.assert_close(
        fuse(features[:, order], cells[:, order], points), fuse(features, cells, points)[:, order]
    )


def test_each_token_keeps_its_place_and_sees_points_but_no_other_token(fuse: TransFuse) -> None:
    features, cells, points = (values.requires_grad_() for values in inputs())
    fused = fuse(features, cells, points)
    assert fused.shape == features.shape
    for_features, for_cells, for_points = torch.autograd.grad(
        fused[1, 2, :, 3, 4].square().sum(), (features, cells, points)
    )
    for gradient in (for_features, for_cells):
        touched = gradient.abs().sum(dim=2).nonzero().tolist()
        assert touched == [[1, 2, 3, 4]]
    assert for_points.abs().sum(dim=2)[1].gt(0).all()
    assert for_points[0].eq(0).all()
