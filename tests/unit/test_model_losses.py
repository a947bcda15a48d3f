"""Loss terms: each in closed form, named, and finite when a view sees nothing."""

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from lerobot_histmv.model import losses
from lerobot_histmv.model.config import LossConfig
from lerobot_histmv.model.decoder import Prediction, spatial_log_softmax
from lerobot_histmv.model.losses import (
    AXIS_REACH,
    BEHIND,
    PARAPHRASE_TEMPERATURE,
    action_losses,
    paraphrase_loss,
    quaternion_loss,
    term_weights,
    weighted_sum,
)

M, Y, X = 3, 5, 7


def heat_loss(
    log_heat: torch.Tensor, cloud: torch.Tensor, target: torch.Tensor, approach: tuple[float, ...] = (0.0, 0.0, 0.0)
) -> torch.Tensor:
    """The loss where all pixels that have any heat count."""
    return losses.heat_loss(log_heat, cloud, log_heat > -torch.inf, target, approach)


def unit(count: int, seed: int) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 4, generator=torch.Generator().manual_seed(seed)), dim=1)


def test_rotation_loss_chooses_the_nearer_sign_for_each_sample() -> None:
    predicted, target = unit(11, 0), unit(11, 1)
    signs = torch.tensor([1, -1] * 5 + [1])[:, None]
    loss = quaternion_loss(predicted, target)
    torch.testing.assert_close(quaternion_loss(predicted, signs * target), loss)
    torch.testing.assert_close(quaternion_loss(signs * predicted, target), loss)
    torch.testing.assert_close(loss, 2 - 2 * (predicted * target).sum(dim=1).abs())
    torch.testing.assert_close(quaternion_loss(target, signs * target), torch.zeros(11))


def heat_case() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A flat cloud with pixels 1 cm apart, uniform heat, and targets on pixels (2, 3)."""
    rows, columns = torch.meshgrid(torch.arange(Y), torch.arange(X), indexing="ij")
    cloud = 0.01 * torch.stack([columns, rows, torch.zeros(Y, X)]).expand(M, 3, Y, X)
    uniform = torch.full((M, Y, X), -math.log(Y * X))
    return uniform, cloud.contiguous(), torch.cat([cloud[:, :, 2, 3], unit(M, 2)], dim=1)


def test_heat_loss_of_a_uniform_map_is_the_logarithm_of_its_pixels() -> None:
    torch.testing.assert_close(heat_loss(*heat_case()), torch.full((M,), math.log(Y * X)))


def test_heat_loss_of_a_key_pose_above_the_surface_wants_the_pixels_below_it() -> None:
    _, cloud, target = heat_case()
    heights = torch.tensor([0.03, 0.07, 0.13])[:, None] * torch.eye(7)[2]
    log_heat = torch.randn(M, Y * X, generator=torch.Generator().manual_seed(0)).log_softmax(dim=1).view(M, Y, X)
    torch.testing.assert_close(heat_loss(log_heat, cloud, target + heights), heat_loss(log_heat, cloud, target))


def random_case() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Any heat over a cube of 20 cm of points, 0.7 m from the origin, and key poses of any turn in its middle."""
    log_heat = torch.randn(M, Y * X, generator=torch.Generator().manual_seed(0)).log_softmax(dim=1).view(M, Y, X)
    cloud = 0.7 + torch.rand(M, 3, Y, X, generator=torch.Generator().manual_seed(1)) / 5
    return log_heat, cloud, torch.cat([torch.full((M, 3), 0.8), unit(M, 2)], dim=1)


@pytest.mark.parametrize("approach", [(0.0, 0.0, -1.0), (0.6, 0.8, 0.0)])
def test_surface_that_the_key_pose_points_at_comes_first(approach: tuple[float, ...]) -> None:
    """As if all else were far away; unless there is none."""
    log_heat, cloud, target = random_case()
    turn = torch.from_numpy(Rotation.from_quat(target[:, 3:].numpy(), scalar_first=True).as_matrix()).float()
    in_tool = torch.einsum("mij,miyx->mjyx", turn, cloud - target[:, :3, None, None])
    ahead = torch.einsum("mjyx,j->myx", in_tool, torch.tensor(approach))
    aside = (in_tool.square().sum(dim=1) - ahead.square()).clamp_min(0).sqrt()
    pointed = (ahead > -BEHIND) & (aside < AXIS_REACH)
    assert pointed.flatten(1).any(dim=1).all()
    assert ((aside < AXIS_REACH) & ~pointed).any()
    alone = cloud + 10 * ~pointed[:, None]
    found = heat_loss(log_heat, cloud, target, approach)
    torch.testing.assert_close(found, heat_loss(log_heat, alone, target), atol=1e-5, rtol=1e-4)
    assert not torch.allclose(found, heat_loss(log_heat, cloud, target), atol=1e-3)
    others = cloud + 10 * pointed[:, None]
    torch.testing.assert_close(heat_loss(log_heat, others, target, approach), heat_loss(log_heat, others, target))


@pytest.mark.parametrize("approach", [(0.0, 0.0, 0.0), (0.6, 0.8, 0.0)])
def test_heat_loss_is_the_cross_entropy_to_a_gaussian_of_15_mm_on_the_surface_value_and_gradient(
    approach: tuple[float, float, float],
) -> None:
    """Pixel by pixel, in double precision and plain words; a third of the pixels is invalid."""
    log_heat, cloud, target = random_case()
    invalid = torch.rand(M, Y, X, generator=torch.Generator().manual_seed(3)) < 1 / 3
    log_heat = log_heat.masked_fill(invalid, -torch.inf).requires_grad_()
    found = heat_loss(log_heat, cloud, target, approach)
    (gradient,) = torch.autograd.grad(found.sum(), log_heat)
    for m in range(M):
        axis = Rotation.from_quat(target[m, 3:].double().numpy(), scalar_first=True).apply(approach)
        way = {
            (y, x): (cloud[m, :, y, x] - target[m, :3]).double().numpy()
            for y in range(Y)
            for x in range(X)
            if not invalid[m, y, x]
        }
        ahead = {pixel: float(one @ axis) for pixel, one in way.items()}
        pointed = {
            pixel: one
            for pixel, one in way.items()
            if any(approach) and ahead[pixel] > -BEHIND and one @ one - ahead[pixel] ** 2 < AXIS_REACH**2
        }
        chosen = pointed or way
        density = {pixel: math.exp(-0.5 * (one @ one) / 0.015**2) for pixel, one in chosen.items()}
        total = sum(density.values())
        expected = -sum(share / total * log_heat[m, *pixel].item() for pixel, share in density.items())
        assert found[m].item() == pytest.approx(expected, rel=1e-4)
        for y in range(Y):
            for x in range(X):
                wanted = -density.get((y, x), 0.0) / total
                assert gradient[m, y, x].item() == pytest.approx(wanted, rel=1e-3, abs=1e-6)


def test_a_pose_over_an_object_wants_heat_on_the_object_and_not_on_the_gripper_beside_and_above_it() -> None:
    """Over pixel (2, 3) and pointing down; the last two pixels, of a gripper, are nearer, aside and behind."""
    uniform, cloud, target = heat_case()
    target[:, 2], target[:, 3:] = 0.13, torch.eye(4)[0]
    cloud[:, :, -1, -1] = target[:, :3] + torch.tensor([0.09, 0.0, 0.0])
    cloud[:, :, -1, -2] = target[:, :3] + torch.tensor([0.01, 0.0, 0.08])
    steps = uniform.requires_grad_()
    for approach, shares in (((0.0, 0.0, -1.0), (0, 0)), ((0.0, 0.0, 1.0), (1, 0)), ((0.0, 0.0, 0.0), (1, 0))):
        wanted = -torch.autograd.grad(heat_loss(steps, cloud, target, approach).sum(), steps)[0]
        expected = torch.tensor(shares, dtype=torch.float32).expand(M, 2)
        torch.testing.assert_close(wanted[:, -1, -2:], expected, atol=0.03, rtol=0)


def test_surface_pointed_at_from_too_far_away_does_not_count() -> None:
    """17 cm below the pose; a pixel 9 cm beside it is what is left."""
    uniform, cloud, target = heat_case()
    target[:, 2], target[:, 3:] = 0.17, torch.eye(4)[0]
    cloud[:, :, -1, -1] = target[:, :3] + torch.tensor([0.09, 0.0, 0.0])
    found = heat_loss(uniform, cloud, target, (0.0, 0.0, -1.0))
    torch.testing.assert_close(found, torch.full((M,), math.log(Y * X)))


def test_half_precision_leaves_the_heat_map_s_target_alone() -> None:
    """Many points about as far from the axis as is asked: rounded products would take others in."""
    log_heat, cloud, target = random_case()
    with torch.autocast("cpu", torch.bfloat16):
        half = heat_loss(log_heat, cloud, target, (0.6, 0.8, 0.0))
    assert half.equal(heat_loss(log_heat, cloud, target, (0.6, 0.8, 0.0)))


def test_heat_loss_falls_when_heat_moves_to_the_target() -> None:
    _, cloud, target = heat_case()
    centimetres = 100 * (cloud - target[:, :3, None, None]).norm(dim=1)
    maps = [(sign * centimetres).flatten(1).log_softmax(dim=1).unflatten(1, (Y, X)) for sign in (-1, 0, 1)]
    losses = [heat_loss(log_heat, cloud, target) for log_heat in maps]
    assert (losses[0] < losses[1]).all()
    assert (losses[1] < losses[2]).all()


def test_heat_loss_is_zero_where_the_target_is_not_seen() -> None:
    uniform, cloud, target = heat_case()
    torch.testing.assert_close(heat_loss(uniform, cloud, target + 5 * torch.eye(7)[2]), torch.zeros(M))


def test_heat_loss_is_finite_with_invalid_pixels_and_0_for_a_view_without_any() -> None:
    """Such a view's heat map is uniform, over points that all lie in its camera."""
    _, cloud, target = heat_case()
    valid = torch.ones(M, Y, X, dtype=torch.bool)
    valid[0, 2:] = False
    valid[1] = False
    cloud[1] = target[1, :3, None, None] + 0.1
    logits = torch.randn(M, Y, X, generator=torch.Generator().manual_seed(0)).requires_grad_()
    loss = losses.heat_loss(spatial_log_softmax(logits, valid), cloud, valid, target)
    loss.sum().backward()
    assert loss.isfinite().all()
    assert logits.grad is not None
    assert logits.grad.isfinite().all()
    assert loss[1] == 0
    assert not logits.grad[1].any()
    assert loss[[0, 2]].gt(0).all()


def prediction() -> tuple[Prediction, torch.Tensor, torch.Tensor, torch.Tensor]:
    log_heat, cloud, target = heat_case()
    position = target[:, :3]
    gripper = torch.tensor([2.0, -1.0, 0.5])
    reached = position + torch.tensor([0.0, 0.03, 0.04])
    predicted = Prediction(reached, position, unit(M, 2), gripper, log_heat, certainty=torch.ones(M))
    wanted = torch.cat([position, unit(M, 3), torch.tensor([[1.0], [0.0], [0.0]])], dim=1)
    return predicted, wanted, cloud, torch.ones(M, Y, X, dtype=torch.bool)


def test_position_loss_is_the_squared_distance_in_its_unit() -> None:
    for length in (0.01, 0.05, 0.1):
        terms = action_losses(*prediction(), LossConfig(position_unit=length))
        torch.testing.assert_close(terms["position"], torch.full((M,), (0.05 / length) ** 2), rtol=1e-4, atol=0)


@pytest.mark.parametrize("form", ["bce", "mse"])
def test_gripper_loss_in_both_forms(form: str) -> None:
    logits, wanted = torch.tensor([2.0, -1.0, 0.5]), torch.tensor([1.0, 0.0, 0.0])
    probability = 1 / (1 + torch.exp(-logits))
    right = torch.where(wanted == 1, probability, 1 - probability)
    expected = -right.log() if form == "bce" else (1 - right).square()
    torch.testing.assert_close(action_losses(*prediction(), LossConfig(gripper=form))["gripper"], expected)


@pytest.mark.parametrize("heatmap", [0.0, 0.5])
def test_every_term_has_a_weight_of_its_name(heatmap: float) -> None:
    config = LossConfig(action=3.0, mutual_information=0.2, heatmap=heatmap, choice=0.7)
    terms, weights = action_losses(*prediction(), config), term_weights(config)
    assert {*terms, "mutual_information", "choice", "paraphrase"} == {*weights} - (
        {"heatmap"} if heatmap == 0 else set()
    )
    assert ("heatmap" in terms) == (heatmap > 0)
    assert [weights[name] for name in ("position", "rotation", "gripper")] == [3.0] * 3
    assert (weights["mutual_information"], weights["heatmap"], weights["choice"]) == (0.2, heatmap, 0.7)


def test_loss_is_the_weighted_sum_of_its_terms() -> None:
    config = LossConfig(action=3.0, mutual_information=0.2, heatmap=0.5)
    terms = action_losses(*prediction(), config) | {"mutual_information": torch.arange(M) + 1.0}
    weights = term_weights(config)
    torch.testing.assert_close(weighted_sum(terms, config), sum(weights[name] * term for name, term in terms.items()))


def test_paraphrase_loss_of_orthogonal_meanings_in_closed_form() -> None:
    """Five meanings of two equal sentences: one partner at cosine 1, eight others at cosine 0."""
    meanings = torch.arange(5).repeat_interleave(2)
    vectors = torch.nn.functional.one_hot(meanings, 7).float()
    expected = math.log(1 + 8 * math.exp(-1 / PARAPHRASE_TEMPERATURE))
    torch.testing.assert_close(paraphrase_loss(vectors, meanings), torch.tensor(expected))
    confused = torch.ones_like(vectors) / 7**0.5
    torch.testing.assert_close(paraphrase_loss(confused, meanings), torch.tensor(math.log(9)))


def test_paraphrase_loss_without_partners_is_zero_with_finite_gradients() -> None:
    vectors = unit(3, 0).requires_grad_()
    loss = paraphrase_loss(vectors, torch.arange(3))
    loss.backward()
    assert loss.item() == 0
    assert vectors.grad is not None and vectors.grad.isfinite().all()
