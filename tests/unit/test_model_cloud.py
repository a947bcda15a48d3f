"""Which points of the cloud go with what: a cell's position code with its pixels, a heat map's points with its view."""

from dataclasses import replace

import pytest
import torch
from einops import einsum, repeat
from tiny_scene import SIZE, tiny_net, tiny_observation
from torch import Tensor, nn

from lerobot_histmv.model.config import TextureConfig, ViewConfig
from lerobot_histmv.model.features import STRIDE
from lerobot_histmv.model.history import Lookback
from lerobot_histmv.model.network import Encoding, HistMVNet, Observation

N, K = 2, 3
COLOURS_ALONE = TextureConfig(widths=(4, 4, 8, 8), neck=4, use_xyz=False)
ROWS, COLUMNS = (slice(STRIDE, 2 * STRIDE), slice(2 * STRIDE, 3 * STRIDE))
"""Pixels of the cell in row 1 and column 2 of the feature map."""


class SamePoints(nn.Module):
    """In place of the point encoder: tokens that do not depend on the scene."""

    def forward(self, cloud: Tensor, rgb: Tensor, valid: Tensor) -> Tensor:
        return repeat(torch.eye(8)[:7], "p d -> n p d", n=len(cloud))


def coded(monkeypatch: pytest.MonkeyPatch) -> tuple[HistMVNet, Observation, list[Tensor]]:
    """A network whose fused maps know positions from the cells' codes alone, a scene with a cell that shows nothing,
    and the cells' positions that TransFuse is given."""
    net = tiny_net(texture=COLOURS_ALONE)
    monkeypatch.setattr(net, "points", SamePoints())
    given: list[Tensor] = []
    net.transfuse.register_forward_pre_hook(lambda _, args: given.append(args[1]))
    seen = tiny_observation(N, K, net.semantics.text_width)
    seen.depth[0, 1, ROWS, COLUMNS] = 0
    seen.depth[1, 2, ROWS, COLUMNS] += 20  # measured, but outside of the workspace
    return net, seen, given


def test_a_cell_s_position_code_is_of_the_mean_of_its_valid_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    net, seen, given = coded(monkeypatch)
    encoding = net.encode(seen)
    (cells,) = given
    for n, k, i, j in torch.cartesian_prod(*map(torch.arange, (N, K, SIZE[0] // STRIDE, SIZE[1] // STRIDE))).tolist():
        pixels = (slice(i * STRIDE, (i + 1) * STRIDE), slice(j * STRIDE, (j + 1) * STRIDE))
        inside = encoding.valid[n, k][pixels]
        points = encoding.cloud[n, k][:, *pixels][:, inside]
        assert len(points.T) < STRIDE**2, "some pixels do not count"
        expected = net.workspace.normalise(points.T).mean(dim=0) if inside.any() else torch.zeros(3)
        torch.testing.assert_close(cells[n, k, :, i, j], expected, atol=1e-5, rtol=1e-5)
    assert cells[0, 1, :, 1, 2].eq(0).all() and cells[1, 2, :, 1, 2].eq(0).all()


def test_points_that_move_reach_their_own_cell_s_fused_map_through_its_code(monkeypatch: pytest.MonkeyPatch) -> None:
    net, seen, _ = coded(monkeypatch)
    depth = seen.depth.clone()
    depth[0, 0, ROWS, COLUMNS] += 0.05 * (depth[0, 0, ROWS, COLUMNS] > 0)
    before, after = net.encode(seen), net.encode(replace(seen, depth=depth))
    assert after.valid.equal(before.valid)
    assert (after.maps != before.maps).any(dim=2).nonzero().tolist() == [[0, 0, 1, 2]]


def encoded(net: HistMVNet) -> tuple[Encoding, Tensor]:
    """A scene, and the history-enriched maps of its unrelated steps."""
    seen = tiny_observation(N, K, net.semantics.text_width)
    encoding = net.encode(seen)
    return encoding, net.remember(encoding.fused, seen.text, Lookback.over(torch.ones(N, 1, dtype=torch.bool)))


def assert_under(log_heat: Tensor, surface: Tensor, cloud: Tensor, valid: Tensor) -> None:
    """The points are those whose expectation over the heat is the surface, and the valid ones alone have heat."""
    assert log_heat.isfinite().equal(valid)
    torch.testing.assert_close(einsum(log_heat.exp(), cloud, "m y x, m c y x -> m c"), surface)


def test_points_under_a_heat_map_over_all_views_are_each_view_s_own() -> None:
    net = tiny_net().train()
    encoding, enriched = encoded(net)
    predicted, views = net.decode_best(encoding, enriched)
    cloud, valid = net.heat_cloud(encoding, views)
    assert_under(predicted.log_heat, predicted.surface, cloud, valid)
    for k in range(K):
        own = slice(k * SIZE[0], (k + 1) * SIZE[0])
        assert cloud[:, :, own].equal(encoding.cloud[:, k])
        assert valid[:, own].equal(encoding.valid[:, k])


@pytest.mark.parametrize(
    "pairs", [[[0, 2], [1, 1]], [[1, 0], [0, 1], [1, 2]], [[n, k] for n in range(N) for k in range(K)]]
)
def test_points_under_a_heat_map_over_one_view_are_those_of_the_pair(pairs: list[list[int]]) -> None:
    net = tiny_net(views=ViewConfig(decode="one")).train()
    encoding, enriched = encoded(net)
    views = torch.tensor(pairs)
    predicted = net.decode(encoding, enriched, views)
    cloud, valid = net.heat_cloud(encoding, views)
    assert_under(predicted.log_heat, predicted.surface, cloud, valid)
    for m, (n, k) in enumerate(pairs):
        assert cloud[m].equal(encoding.cloud[n, k])
        assert valid[m].equal(encoding.valid[n, k])
