"""View weights: a softmax over present views, taught by fusion, redundancy and the decoding of every view."""

import math

import pytest
import torch

from lerobot_histmv.model.config import ViewConfig
from lerobot_histmv.model.view_attention import (
    EXPLORE,
    ViewAttention,
    best_shares,
    choice_loss,
    choose_views,
    explored,
    fuse_views,
    most_informative,
    ranking_loss,
)

N, K, D, H, W, TEXT = 2, 3, 11, 5, 7, 13


def attention(**changes: object) -> ViewAttention:
    torch.manual_seed(0)
    return ViewAttention(ViewConfig(mi_dims=3, **changes), D, TEXT)


def inputs() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    maps = torch.randn(N, K, D, H, W, generator=generator)
    return maps, torch.randn(N, TEXT, generator=generator), torch.ones(N, K, dtype=torch.bool)


def test_weights_are_a_distribution_that_depends_on_views_and_instruction() -> None:
    maps, text, present = inputs()
    weights = attention()(maps, text, present)
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(N))
    assert (weights > 0).all()
    assert not torch.allclose(weights, attention()(maps.flip(1), text, present))
    assert not torch.allclose(weights, attention()(maps, -text, present))


def test_weights_follow_the_order_of_views() -> None:
    maps, text, present = inputs()
    order = torch.tensor([2, 0, 1])
    torch.testing.assert_close(attention()(maps[:, order], text, present), attention()(maps, text, present)[:, order])


def test_absent_views_weigh_nothing_and_do_not_matter() -> None:
    maps, text, present = inputs()
    present[:, 1] = False
    weights = attention()(maps, text, present)
    assert weights[:, 1].eq(0).all()
    maps[:, 1] = 1e3
    torch.testing.assert_close(attention()(maps, text, present), weights)


def test_weights_are_finite_when_no_view_is_present() -> None:
    """Valid depth that lies outside of the workspace everywhere must not turn weights into NaN."""
    maps, text, _ = inputs()
    weights = attention()(maps, text, torch.zeros(N, K, dtype=torch.bool))
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(N))


@pytest.mark.parametrize("form", ["nmi", "text", "literal"])
def test_redundancy_teaches_weights_but_not_features(form: str) -> None:
    maps, text, present = inputs()
    module, maps = attention(mi_loss=form), maps.requires_grad_()
    weights = module(maps.detach(), text, present)
    weights.retain_grad()
    module.redundancy(maps, weights).sum().backward()
    assert maps.grad is None, "features must not win by turning into noise"
    assert weights.grad is not None
    assert weights.grad.abs().sum() > 0


@pytest.mark.parametrize("form", ["nmi", "text", "literal"])
def test_redundancy_teaches_features_where_asked(form: str) -> None:
    maps, text, present = inputs()
    module, maps = attention(mi_loss=form, mi_gradient=True), maps.requires_grad_()
    module.redundancy(maps, module(maps.detach(), text, present)).sum().backward()
    assert maps.grad is not None
    assert maps.grad.isfinite().all()
    assert maps.grad.abs().sum() > 0


@pytest.mark.parametrize("form", ["nmi", "text", "literal"])
def test_redundancy_of_maps_that_tell_nothing_has_finite_gradients(form: str) -> None:
    """Constant maps share nothing, equal ones all there is: the ends of the normalised form's root and logarithm."""
    _, text, present = inputs()
    for maps in (torch.full((N, K, D, H, W), 5.0), torch.randn(N, 1, D, H, W).expand(N, K, D, H, W)):
        module, maps = attention(mi_loss=form, mi_gradient=True), maps.clone().requires_grad_()
        redundancy = module.redundancy(maps, module(maps.detach(), text, present))
        redundancy.sum().backward()
        assert redundancy.isfinite().all()
        assert maps.grad is not None and maps.grad.isfinite().all()


@pytest.mark.parametrize(("form", "sign"), [("text", 1), ("literal", -1)])
def test_equation_6_sums_information_in_nats(form: str, sign: int) -> None:
    """Gaussian views of correlation rho share I = -d/2 ln(1 - rho^2) (d = 3); one that shares nothing adds nothing."""
    generator, rho = torch.Generator().manual_seed(0), 0.6
    first, noise, alone = torch.randn(3, D, 101, 103, generator=generator)
    maps = torch.stack([first, rho * first + (1 - rho**2) ** 0.5 * noise, alone])[None]
    weights = torch.tensor([[0.5, 0.3, 0.2]])
    found = attention(mi_loss=form).redundancy(maps, weights)
    expected = sign * 2 * 0.5 * 0.3 * -3 / 2 * math.log(1 - rho**2)
    assert found.item() == pytest.approx(expected, rel=0.03)


def test_default_redundancy_is_the_views_weighted_pairs_by_absolute_correlation() -> None:
    """w' NMI w, in which NMI is |rho| of Gaussian views: each pair counts twice, each view once with itself."""
    generator, rho = torch.Generator().manual_seed(0), 0.6
    first, noise = torch.randn(2, D, 101, 103, generator=generator)
    maps = torch.stack([first, noise, (1 - rho**2) ** 0.5 * noise - rho * first])[None]
    w = [0.5, 0.3, 0.2]
    shared = {(0, 2): rho, (1, 2): (1 - rho**2) ** 0.5}
    expected = sum(share**2 for share in w) + sum(2 * w[i] * w[j] * nmi for (i, j), nmi in shared.items())
    found = attention().redundancy(maps, torch.tensor([w]))
    assert found.item() == pytest.approx(expected, rel=0.01)


def test_projection_does_not_depend_on_the_global_seed_and_is_orthogonal() -> None:
    torch.manual_seed(5)
    first = attention().projection
    torch.manual_seed(7)
    torch.testing.assert_close(first, attention().projection)
    torch.testing.assert_close(first.T @ first, torch.eye(first.shape[1]), atol=1e-5, rtol=0)


def test_fusion_is_the_weighted_sum_and_the_best_view_its_largest_weight() -> None:
    maps, text, present = inputs()
    weights = attention()(maps, text, present)
    expected = sum(weights[:, k, None, None, None] * maps[:, k] for k in range(K))
    torch.testing.assert_close(fuse_views(maps, weights), expected)
    torch.testing.assert_close(fuse_views(maps, torch.eye(K)[[1, 2]]), torch.stack([maps[0, 1], maps[1, 2]]))
    assert most_informative(torch.tensor([[0.2, 0.5, 0.3], [0.6, 0.1, 0.3]])).tolist() == [1, 0]


WEIGHTS = torch.tensor([[0.2, 0.5, 0.3], [0.6, 0.0, 0.4]])


def test_argmax_decodes_the_most_informative_view_of_each_step() -> None:
    pairs, shares = choose_views(WEIGHTS, "argmax")
    assert pairs.tolist() == [[0, 1], [1, 0]]
    assert shares.tolist() == [1, 1]


def test_sampling_draws_each_view_about_as_often_as_its_weight_and_absent_ones_never() -> None:
    torch.manual_seed(0)
    for weights in WEIGHTS:
        pairs, shares = choose_views(weights.expand(4001, 3), "sampled")
        frequency = torch.bincount(pairs[:, 1], minlength=3) / len(pairs)
        torch.testing.assert_close(frequency, explored(weights[None], weights[None])[0], atol=0.03, rtol=0)
        torch.testing.assert_close(frequency, weights, atol=EXPLORE, rtol=0)
        assert frequency[weights == 0].eq(0).all()
        assert shares.eq(1).all()


def test_score_function_points_along_the_gradient_of_the_expected_loss() -> None:
    """With each view drawn exactly as often as it should be, the estimate has no variance left."""
    wanted, losses = torch.tensor([0.2, 0.5, 0.3]), torch.tensor([3.0, 1.0, 7.0])
    logits = ((wanted - EXPLORE / 3) / (1 - EXPLORE)).log().requires_grad_()
    picked = torch.tensor([0] * 2 + [1] * 5 + [2] * 3)
    estimate = choice_loss(logits.softmax(dim=0).expand(10, 3), picked, losses[picked]).mean()
    _, shares = choose_views(logits.softmax(dim=0)[None], "expected")
    gradients = [torch.autograd.grad(loss, logits)[0] for loss in (estimate, shares @ losses)]
    assert gradients[0].norm() > 0
    torch.testing.assert_close(*(torch.nn.functional.normalize(gradient, dim=0) for gradient in gradients))


def test_score_function_teaches_weights_only() -> None:
    losses = torch.tensor([3.0, 1.0], requires_grad=True)
    weights = WEIGHTS.clone().requires_grad_()
    choice_loss(weights, torch.tensor([0, 2]), losses).sum().backward()
    assert losses.grad is None
    assert weights.grad is not None
    assert weights.grad[0, 0] > 0 > weights.grad[1, 2], "the worse choice becomes less likely"


@pytest.mark.parametrize("choice", ["expected", "ranked"])
def test_all_views_are_decoded_and_share_one_unit_among_the_present(choice: str) -> None:
    pairs, shares = choose_views(WEIGHTS, choice)
    assert pairs.tolist() == [[n, k] for n in range(2) for k in range(3)]
    per_step = shares.unflatten(0, (2, 3))
    torch.testing.assert_close(per_step.sum(dim=1), torch.ones(2))
    assert per_step[1, 1] == 0, "an absent view takes no part"
    assert (per_step[WEIGHTS > 0] > 0).all()
    if choice == "ranked":
        torch.testing.assert_close(per_step, torch.tensor([[1 / 3] * 3, [0.5, 0.0, 0.5]]))


def test_best_views_get_most_of_the_training_and_no_present_view_starves() -> None:
    losses = torch.tensor([[1.0, 0.1, 2.0], [1.0, 0.0, 0.1]], requires_grad=True)
    shares = best_shares(WEIGHTS, losses.flatten()).view(2, 3)
    torch.testing.assert_close(shares.sum(dim=1), torch.ones(2))
    assert shares.argmax(dim=1).tolist() == [1, 2]
    assert shares[1, 1] == 0, "an absent view takes no part"
    assert (shares[WEIGHTS > 0] > EXPLORE / 3 - 1e-6).all()
    assert not shares.requires_grad
    torch.testing.assert_close(best_shares(WEIGHTS, 100 * losses.flatten()).view(2, 3), shares, rtol=1e-3, atol=0)


def test_expected_loss_takes_weight_from_views_that_decode_worse() -> None:
    weights = WEIGHTS.clone().requires_grad_()
    _, shares = choose_views(weights, "expected")
    (shares * torch.arange(6)).sum().backward()
    assert weights.grad is not None
    assert weights.grad[0].diff().gt(0).all()


def ranked_weights(losses: torch.Tensor, present: torch.Tensor) -> torch.Tensor:
    """Weights of the present views after learning to rank them."""
    logits = torch.zeros(losses.shape, requires_grad=True)
    optimizer = torch.optim.Adam([logits], lr=0.3)
    for _ in range(60):
        optimizer.zero_grad()
        weights = logits.masked_fill(~present, -torch.inf).softmax(dim=1)
        ranking_loss(weights, losses).sum().backward()
        optimizer.step()
    return weights.detach()


def test_ranking_orders_present_views_by_their_loss() -> None:
    losses = torch.tensor([[3.0, 1.0, 2.0], [3.0, 1.0, 2.0], [1.0, 1.0, 1.0]])
    present = torch.tensor([[True] * 3, [True, False, True], [True] * 3])
    weights = ranked_weights(losses, present)
    assert weights[0].argsort().tolist() == [0, 2, 1]
    assert weights[1, 1] == 0
    assert weights[1, 2] > 0.7
    torch.testing.assert_close(weights[2], torch.full((3,), 1 / 3), atol=0.01, rtol=0)


def test_ranking_depends_on_ratios_of_losses_and_teaches_weights_only() -> None:
    losses = torch.tensor([[3.0, 1.0, 2.0], [0.5, 0.1, 0.7]], requires_grad=True)
    weights = torch.full((2, 3), 1 / 3, requires_grad=True)
    loss = ranking_loss(weights, losses)
    torch.testing.assert_close(ranking_loss(weights, losses / 100), loss, rtol=1e-3, atol=0)
    loss.sum().backward()
    assert losses.grad is None
    assert weights.grad is not None
    assert weights.grad.argmin(dim=1).tolist() == [1, 1], "the best view gains most"


def test_ranking_does_not_depend_on_the_loss_of_absent_views() -> None:
    weights = torch.tensor([[0.3, 0.0, 0.7]])
    first, second = (ranking_loss(weights, torch.tensor([[1.0, absent, 2.0]])) for absent in (1.0, 100.0))
    torch.testing.assert_close(first, second)
