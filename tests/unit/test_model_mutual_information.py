"""The Gaussian estimate of mutual information against closed forms, and the view weights that each loss form wants."""

import math
from collections.abc import Callable

import pytest
import torch

from lerobot_histmv.model.view_attention import (
    gaussian_mutual_information,
    mutual_information_loss,
    mutual_information_matrix,
    normalised_mutual_information,
    standardise,
)

DRAWS, SAMPLES, DIMS = 11, 4096, 5
Measure = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]


def correlated(
    rho: float, samples: int = SAMPLES, dims: int = DIMS, draws: int = DRAWS
) -> tuple[torch.Tensor, torch.Tensor]:
    """Standard normal x and y whose channel pairs are correlated with ``rho``."""
    x, noise = torch.randn(2, draws, samples, dims, generator=torch.Generator().manual_seed(samples + dims))
    return x, rho * x + math.sqrt(1 - rho**2) * noise


@pytest.mark.parametrize("rho", [0.3, 0.5, 0.9])
def test_estimate_is_the_closed_form_of_gaussians(rho: float) -> None:
    truth = -DIMS / 2 * math.log(1 - rho**2)
    estimate = gaussian_mutual_information(*correlated(rho)).mean().item()
    assert math.isclose(estimate, truth, rel_tol=0.05)


def test_independent_variables_share_nothing() -> None:
    assert gaussian_mutual_information(*correlated(0.0)).mean() < 0.01
    x, y = correlated(0.9)
    assert gaussian_mutual_information(x, y.roll(1, dims=1)).mean() < 0.01, "shuffled pairs are independent"


def test_estimate_hardly_depends_on_the_number_of_samples() -> None:
    """Without the correction of d^2 / 2n, 64 samples of 8 channels would overestimate by half a nat."""
    few, many = (gaussian_mutual_information(*correlated(0.5, n, 8, 101)).mean().item() for n in (64, 4096))
    assert abs(few - many) < 0.15


def test_estimate_is_symmetric_nonnegative_monotone_and_largest_of_a_variable_with_itself() -> None:
    estimates = []
    for rho in (0.0, 0.1, 0.3, 0.6, 0.9):
        x, y = correlated(rho, samples=211)
        estimates.append(gaussian_mutual_information(x, y))
        torch.testing.assert_close(estimates[-1], gaussian_mutual_information(y, x), rtol=1e-4, atol=1e-5)
        assert (estimates[-1] >= 0).all()
    means = torch.stack(estimates).mean(dim=1)
    assert (means.diff() > 0).all()
    assert (gaussian_mutual_information(x, x) > estimates[-1]).all()


def test_estimate_ignores_scale_sign_and_offset_of_each_channel() -> None:
    x, y = correlated(0.6, samples=211)
    scale = torch.tensor([2.0, -3.0, 0.5, 7.0, -1.0])
    changed = gaussian_mutual_information(x * scale + 5, y * scale.flip(0) - 11)
    torch.testing.assert_close(changed, gaussian_mutual_information(x, y), rtol=1e-3, atol=1e-3)


def test_purely_nonlinear_dependence_is_not_seen() -> None:
    """The documented limit of the Gaussian estimate: x and x^2 are uncorrelated."""
    x, _ = correlated(0.0)
    assert gaussian_mutual_information(x, x.square()).mean() < 0.05


def test_constant_channels_standardise_to_zero() -> None:
    constant = torch.full((7, 3), 5.0)
    assert standardise(constant).eq(0).all()


@pytest.mark.parametrize("samples", [2, 7, 64])
@pytest.mark.parametrize("kind", ["constant", "one channel", "noise", "equal"])
def test_gradients_are_finite_also_for_degenerate_maps(samples: int, kind: str) -> None:
    """Constant maps, rank one and fewer samples than channels (n < 2d) all keep the covariance positive definite."""
    noise = torch.randn(2, 3, samples, 8, generator=torch.Generator().manual_seed(samples))
    maps = {
        "constant": torch.ones_like(noise),
        "one channel": noise[..., :1].expand_as(noise),
        "noise": noise,
        "equal": noise[:1].expand_as(noise),
    }[kind]
    maps = maps.clone().requires_grad_()
    information = gaussian_mutual_information(maps[0], maps[1])
    information.sum().backward()
    assert information.isfinite().all()
    assert maps.grad is not None
    assert maps.grad.isfinite().all()


def test_gradient_equals_finite_differences() -> None:
    x, y = (v.double().requires_grad_() for v in correlated(0.8, samples=13, dims=2, draws=1))
    assert torch.autograd.gradcheck(gaussian_mutual_information, (x, y))


def maps_of(views: list[torch.Tensor], height: int, width: int) -> torch.Tensor:
    """Feature maps (n, k, d, h, w) whose positions are the samples of each view."""
    stacked = torch.stack(views, dim=1)
    return stacked.transpose(-1, -2).unflatten(-1, (height, width))


def test_normalised_information_is_the_absolute_correlation() -> None:
    rho = 0.6
    x, y = correlated(rho, samples=59 * 61)
    matrix = normalised_mutual_information(
        maps_of([x, -y, x[..., torch.randperm(59 * 61), :]], 59, 61), torch.eye(DIMS)
    )
    assert matrix.shape == (DRAWS, 3, 3)
    torch.testing.assert_close(matrix, matrix.transpose(1, 2))
    torch.testing.assert_close(matrix.diagonal(dim1=1, dim2=2), torch.ones(DRAWS, 3))
    assert math.isclose(matrix[:, 0, 1].mean().item(), rho, abs_tol=0.02)
    assert matrix[:, 0, 2].mean() < 0.05
    assert ((matrix >= 0) & (matrix <= 1)).all()


@pytest.mark.parametrize("k", [1, 2, 5])
def test_normalised_information_follows_the_order_of_views(k: int) -> None:
    maps = torch.randn(2, k, 11, 3, 5, generator=torch.Generator().manual_seed(k))
    maps = maps + maps.mean(dim=1, keepdim=True)
    projection = torch.linalg.qr(torch.randn(11, 3, generator=torch.Generator().manual_seed(1)))[0]
    order = torch.arange(k).roll(1)
    matrix = normalised_mutual_information(maps, projection)
    torch.testing.assert_close(normalised_mutual_information(maps[:, order], projection), matrix[:, order][:, :, order])


@pytest.mark.parametrize("measure", [mutual_information_matrix, normalised_mutual_information])
def test_information_of_maps_ignores_gain_sign_and_offset_of_each_channel(measure: Measure) -> None:
    """Also through the projection, in which otherwise the loudest channel would decide."""
    maps = torch.randn(2, 3, 11, 13, 17, generator=torch.Generator().manual_seed(0))
    maps[:, 1, 4] += 2 * maps[:, 0, 4]
    projection = torch.linalg.qr(torch.randn(11, 3, generator=torch.Generator().manual_seed(1)))[0]
    gain = torch.logspace(-2, 2, 11)[torch.randperm(11, generator=torch.Generator().manual_seed(2))]
    changed = gain[:, None, None] * maps + torch.arange(11.0)[:, None, None]
    torch.testing.assert_close(measure(changed, projection), measure(maps, projection), atol=1e-3, rtol=1e-3)


REDUNDANT_PAIR = torch.tensor([[1.0, 0.9, 0.1], [0.9, 1.0, 0.1], [0.1, 0.1, 1.0]])
"""Views 0 and 1 say nearly the same, view 2 something of its own."""


def weights_wanted(form: str, matrix: torch.Tensor) -> torch.Tensor:
    """Softmax weights that minimise one form of the loss, from nearly equal ones."""
    logits = 0.05 * torch.arange(len(matrix), dtype=torch.float64)
    logits.requires_grad_()
    optimizer = torch.optim.Adam([logits], lr=0.3)
    for _ in range(120):
        optimizer.zero_grad()
        mutual_information_loss(logits.softmax(dim=0)[None], matrix[None].double(), form).sum().backward()
        optimizer.step()
    return logits.detach().softmax(dim=0).float()


def test_default_form_gives_the_redundant_pair_one_share() -> None:
    """w' M w over the simplex is least at M^-1 1 / (1' M^-1 1) = (.257, .257, .486)."""
    wanted = weights_wanted("nmi", REDUNDANT_PAIR)
    ones = torch.linalg.solve(REDUNDANT_PAIR, torch.ones(3))
    torch.testing.assert_close(wanted, ones / ones.sum(), atol=1e-3, rtol=0)
    torch.testing.assert_close(wanted, torch.tensor([0.257, 0.257, 0.486]), atol=0.01, rtol=0)


def test_default_form_prefers_neither_of_two_views() -> None:
    torch.testing.assert_close(
        weights_wanted("nmi", REDUNDANT_PAIR[:2, :2]), torch.tensor([0.5, 0.5]), atol=0.01, rtol=0
    )


def test_plus_sign_without_diagonal_collapses_to_one_view() -> None:
    assert weights_wanted("text", REDUNDANT_PAIR).max() > 0.95


def test_literal_minus_sign_rewards_the_redundant_pair() -> None:
    torch.testing.assert_close(
        weights_wanted("literal", REDUNDANT_PAIR), torch.tensor([0.5, 0.5, 0.0]), atol=0.02, rtol=0
    )


def test_forms_of_the_loss_at_a_vertex_and_at_equal_weights() -> None:
    vertex, equal = torch.eye(3)[:1], torch.full((1, 3), 1 / 3)
    values = {
        form: [mutual_information_loss(w, REDUNDANT_PAIR[None], form).item() for w in (vertex, equal)]
        for form in ("nmi", "text", "literal")
    }
    off_diagonal = 2 * (0.9 + 0.1 + 0.1) / 9
    assert values["nmi"] == pytest.approx([1, 1 / 3 + off_diagonal])
    assert values["text"] == pytest.approx([0, off_diagonal])
    assert values["literal"] == pytest.approx([0, -off_diagonal])
