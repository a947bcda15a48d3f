"""Set abstraction against its definitions: farthest points, ball queries, and what each centre may depend on."""

import math
from collections.abc import Callable

import pytest
import torch
from torch.nn import functional

from lerobot_histmv.model.cameras import Workspace
from lerobot_histmv.model.config import PointsConfig
from lerobot_histmv.model.points import PointEncoder, SetAbstraction, ball_query, farthest_points, gather_points

N, P, C = 2, 31, 5


def cloud(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Points in the unit cube (n, p, 3), and which are valid: about two in three."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(N, P, 3, generator=generator)
    return points, torch.rand(N, P, generator=generator) < 0.66


def test_gather_takes_rows_of_each_batch_element() -> None:
    points, _ = cloud()
    indices = torch.randint(P, (N, 3, 7), generator=torch.Generator().manual_seed(0))
    gathered = gather_points(points, indices)
    assert gathered.shape == (N, 3, 7, 3)
    for n, i, j in torch.cartesian_prod(*map(torch.arange, indices.shape)):
        assert gathered[n, i, j].equal(points[n, indices[n, i, j]])


@pytest.mark.parametrize("seed", range(3))
def test_each_farthest_point_is_farthest_from_all_before(seed: int) -> None:
    points, valid = cloud(seed)
    picks = farthest_points(points, valid, 11)
    for cloud_n, valid_n, picks_n in zip(points, valid, picks, strict=True):
        assert valid_n[picks_n].all(), "invalid points are never chosen"
        assert len(set(picks_n.tolist())) == 11
        for i in range(1, 11):
            to_chosen = torch.cdist(cloud_n[valid_n], cloud_n[picks_n[:i]]).amin(dim=1)
            its_own = (cloud_n[picks_n[i]] - cloud_n[picks_n[:i]]).norm(dim=1).amin()
            torch.testing.assert_close(its_own, to_chosen.max())


def test_few_valid_points_repeat_and_one_suffices() -> None:
    points, _ = cloud()
    valid = torch.zeros(N, P, dtype=torch.bool)
    valid[0, [3, 17, 29]] = True
    valid[1, 7] = True
    picks = farthest_points(points, valid, 5)
    assert set(picks[0].tolist()) == {3, 17, 29}
    assert picks[1].tolist() == [7] * 5


@pytest.mark.parametrize("radius", [0.05, 0.3, 2.0])
def test_ball_query_is_the_nearest_valid_points_within_the_radius(radius: float) -> None:
    points, valid = cloud()
    centres, count = gather_points(points, farthest_points(points, valid, 7)), 5
    balls = ball_query(centres, points, valid, radius, count)
    assert balls.shape == (N, 7, count)
    for n, c in torch.cartesian_prod(torch.arange(N), torch.arange(7)).tolist():
        distance = (points[n] - centres[n, c]).norm(dim=1)
        inside = [i for i in distance.argsort().tolist() if valid[n, i] and distance[i] <= radius]
        assert set(balls[n, c].tolist()) == set(inside[:count])
        assert balls[n, c, 0] == inside[0]


def test_ball_without_a_point_within_the_radius_falls_back_to_the_nearest_valid_one() -> None:
    points, valid = cloud()
    far_away = torch.full((N, 2, 3), 5.0)
    balls = ball_query(far_away, points, valid, 0.1, 3)
    nearest = (points - far_away[:, :1]).norm(dim=2).masked_fill(~valid, torch.inf).argmin(dim=1)
    assert balls.eq(nearest[:, None, None]).all()


def abstraction(centres: int = 7, radius: float = 0.4) -> SetAbstraction:
    torch.manual_seed(0)
    return SetAbstraction(C, 13, centres, radius, 3)


def features() -> torch.Tensor:
    return torch.randn(N, P, C, generator=torch.Generator().manual_seed(9))


def plain_ball(points: torch.Tensor, valid: torch.Tensor, centre: torch.Tensor, radius: float) -> list[int]:
    """The at most three valid points nearest to the centre and within the radius, near to far."""
    near = sorted((math.dist(points[i].tolist(), centre.tolist()), i) for i in range(P) if valid[i])
    return [i for distance, i in near[:3] if distance <= radius]


@pytest.mark.parametrize(("radius", "sizes"), [(0.05, {1}), (0.3, {1, 2, 3}), (2.0, {3})])
def test_set_abstraction_equals_a_loop_over_centres_and_their_neighbours(radius: float, sizes: set[int]) -> None:
    points, valid = cloud()
    module, found = abstraction(radius=radius), set()
    centres, abstracted, kept = module(points, features(), valid)
    assert centres.equal(gather_points(points, farthest_points(points, valid, 7)))
    assert kept.all()
    for n, c in torch.cartesian_prod(torch.arange(N), torch.arange(7)).tolist():
        ball = plain_ball(points[n], valid[n], centres[n, c], radius)
        found.add(len(ball))
        strongest = torch.full((13,), -torch.inf)
        for i in ball:
            row = torch.cat([(points[n, i] - centres[n, c]) / radius, features()[n, i]])
            hidden = functional.gelu(module.first.weight @ row + module.first.bias)
            strongest = torch.maximum(strongest, module.second.weight @ hidden + module.second.bias)
        torch.testing.assert_close(abstracted[n, c], strongest)
    assert found == sizes, "balls of every size that the radius allows"


def test_invalid_points_never_matter() -> None:
    points, valid = cloud()
    changed_points = torch.where(valid[..., None], points, torch.full_like(points, 0.5))
    changed_features = torch.where(valid[..., None], features(), torch.full_like(features(), 1e6))
    expected = abstraction()(points, features(), valid)
    found = abstraction()(changed_points, changed_features, valid)
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


def test_features_are_relative_to_their_centre() -> None:
    points, valid = cloud()
    shift = torch.tensor([3.0, -2.0, 1.0])
    centres, expected, _ = abstraction()(points, features(), valid)
    moved_centres, found, _ = abstraction()(points + shift, features(), valid)
    torch.testing.assert_close(moved_centres, centres + shift)
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)


def test_cloud_without_any_valid_point_gives_finite_features_marked_invalid() -> None:
    points, _ = cloud()
    _, abstracted, kept = abstraction()(points, features(), torch.zeros(N, P, dtype=torch.bool))
    assert abstracted.isfinite().all()
    assert not kept.any()


def encoder(samples: int = 53) -> PointEncoder:
    torch.manual_seed(0)
    config = PointsConfig(samples=samples, centres=(13, 7), radii=(0.2, 0.4), neighbours=3)
    return PointEncoder(config, Workspace((0.0, 0.0, 0.0, 1.0, 1.0, 1.0)), 8).eval()


def views(k: int = 3) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    xyz, rgb = torch.rand(2, N, k, 3, 11, 13, generator=generator)
    return xyz, rgb, torch.rand(N, k, 11, 13, generator=generator) < 0.5


@pytest.mark.parametrize("k", [1, 2, 3, 5])
def test_encoder_gives_the_same_number_of_tokens_for_any_number_of_views(k: int) -> None:
    tokens = encoder()(*views(k))
    assert tokens.shape == (N, 7, 8)
    assert tokens.equal(encoder()(*views(k))), "outside of training the draw is fixed"


def test_encoder_draws_at_random_in_training() -> None:
    module = encoder().train()
    torch.manual_seed(1)
    assert not torch.equal(module(*views()), module(*views()))


@pytest.mark.parametrize("spoil", [lambda v: torch.full_like(v, torch.nan), lambda v: v + 100])
def test_encoder_ignores_invalid_pixels(spoil: Callable[[torch.Tensor], torch.Tensor]) -> None:
    xyz, rgb, valid = views()
    expected = encoder()(xyz, rgb, valid)
    spoiled = [torch.where(valid[:, :, None], v, spoil(v)) for v in (xyz, rgb)]
    torch.testing.assert_close(encoder()(*spoiled, valid), expected)


def test_encoder_is_finite_with_few_valid_pixels_and_with_none() -> None:
    xyz, rgb, valid = views()
    valid[0] = False
    valid[1, 1:] = False
    valid[1, 0, :5] = False
    tokens = encoder()(xyz, rgb, valid)
    assert tokens.isfinite().all()
