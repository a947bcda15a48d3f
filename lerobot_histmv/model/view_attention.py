"""Mutual-information view attention: which views say something of their own (paper 3.3, Eq. 4 to 7)."""

import math

import torch
from einops import einsum, rearrange, reduce, repeat
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional

from lerobot_histmv.model.config import ViewConfig
from lerobot_histmv.model.layers import full_precision

RIDGE = 1e-3


def log_det_covariance(samples: Float[Tensor, "*n s d"]) -> Float[Tensor, "*n"]:
    """Log-determinant of the ridged covariance of ``s`` centred samples."""
    covariance = einsum(samples, samples, "... s d, ... s e -> ... d e") / samples.shape[-2]
    eye = torch.eye(samples.shape[-1], dtype=samples.dtype, device=samples.device)
    return torch.linalg.cholesky_ex(covariance + RIDGE * eye)[0].diagonal(dim1=-2, dim2=-1).log().sum(-1) * 2


def standardise(samples: Float[Tensor, "*n s d"]) -> Float[Tensor, "*n s d"]:
    """Zero mean and unit variance per channel; constant channels become 0."""
    centred = samples - samples.mean(dim=-2, keepdim=True)
    return centred * (centred.square().mean(dim=-2, keepdim=True) + 1e-12).rsqrt()


def gaussian_mutual_information(first: Float[Tensor, "*n s d"], second: Float[Tensor, "*n s d"]) -> Float[Tensor, "*n"]:
    """Mutual information [nat] of Gaussian samples (Eq. 4), minus the estimator's bias d^2 / 2s, at least 0.

    Exact for jointly Gaussian variables and blind to purely nonlinear dependence.
    """
    x, y = standardise(first), standardise(second)
    joint = log_det_covariance(torch.cat([x, y], dim=-1))
    information = (log_det_covariance(x) + log_det_covariance(y) - joint) / 2
    return (information - x.shape[-1] ** 2 / (2 * x.shape[-2])).clamp_min(0)


def mutual_information_matrix(
    maps: Float[Tensor, "n k d h w"], projection: Float[Tensor, "d e"]
) -> Float[Tensor, "n k k"]:
    """I [nat] between all pairs of views (Eq. 5), diagonal 0: what a map tells of itself has no bound.

    Channels are standardised before they are mixed: gain and bias of a channel do not matter, and no loud one decides.
    """
    samples = standardise(rearrange(maps, "n k d h w -> n k (h w) d")) @ projection
    k = samples.shape[1]
    first, second = torch.triu_indices(k, k, offset=1, device=maps.device).unbind(0)
    pairs = gaussian_mutual_information(samples[:, first], samples[:, second])
    matrix = pairs.new_zeros(len(maps), k, k)
    matrix[:, first, second] = pairs
    matrix[:, second, first] = pairs
    return matrix


def normalised_mutual_information(
    maps: Float[Tensor, "n k d h w"], projection: Float[Tensor, "d e"]
) -> Float[Tensor, "n k k"]:
    """NMI = sqrt(1 - exp(-2 I / e)) in [0, 1] between all pairs of views, diagonal 1.

    For equal correlations of all channel pairs this is the absolute correlation.
    """
    information = mutual_information_matrix(maps, projection)
    # The derivative of the root is infinite at 0: independent views must not give infinite gradients.
    shared = (1 - torch.exp(-2 * information / projection.shape[1]) + 1e-12).sqrt()
    own = torch.eye(maps.shape[1], dtype=torch.bool, device=maps.device)
    return shared.masked_fill(own, 1)


def mutual_information_loss(
    weights: Float[Tensor, "n k"], matrix: Float[Tensor, "n k k"], form: str
) -> Float[Tensor, " n"]:
    """View redundancy (Eq. 6) in three forms.

    "nmi": w' M w with unit diagonal, which no single view minimises. "text": the sum over i != j with the plus sign
    that the text describes. "literal": the same with the printed minus sign, which rewards redundancy.

    Args:
        weights: w of the views.
        matrix: what each pair shares; normalised for "nmi".
        form: as above.
    """
    off_diagonal = matrix * (1 - torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device))
    if form == "nmi":
        return einsum(weights, matrix, weights, "n i, n i j, n j -> n")
    redundancy = einsum(weights, off_diagonal, weights, "n i, n i j, n j -> n")
    return -redundancy if form == "literal" else redundancy


class ViewAttention(nn.Module):
    """Weights of the views from their pooled features and the instruction.

    Args:
        config: views part of the network's configuration.
        width: d, channels of a view's map.
        text_width: length of the instruction vector.
    """

    projection: Tensor

    def __init__(self, config: ViewConfig, width: int, text_width: int) -> None:
        super().__init__()
        self.form, self.teaches_features = config.mi_loss, config.mi_gradient
        # The softmax cancels a last bias.
        last = nn.Linear(width, 1, bias=False)
        self.score = nn.Sequential(nn.Linear(2 * width + text_width, width), nn.GELU(), last)
        noise = torch.randn(width, config.mi_dims, generator=torch.Generator().manual_seed(0))
        self.register_buffer("projection", torch.linalg.qr(noise)[0])

    def forward(
        self, maps: Float[Tensor, "n k d h w"], text: Float[Tensor, "n c"], present: Bool[Tensor, "n k"]
    ) -> Float[Tensor, "n k"]:
        """Softmax weights w over the ``present`` views; absent ones get 0, unless no view is present."""
        pooled = torch.cat(
            [reduce(maps, "n k d h w -> n k d", "mean"), reduce(maps, "n k d h w -> n k d", "max")], dim=-1
        )
        text = functional.layer_norm(text, text.shape[-1:])
        scores = self.score(torch.cat([pooled, repeat(text, "n c -> n k c", k=maps.shape[1])], dim=-1))
        usable = present | ~present.any(dim=-1, keepdim=True)  # no view at all must not turn weights into NaN
        return rearrange(scores, "n k 1 -> n k").masked_fill(~usable, -math.inf).softmax(dim=-1)

    def redundancy(self, maps: Float[Tensor, "n k d h w"], weights: Float[Tensor, "n k"]) -> Float[Tensor, " n"]:
        """L_MI per sample; without ``mi_gradient`` it teaches weights only: features cannot win by becoming noise."""
        measure = normalised_mutual_information if self.form == "nmi" else mutual_information_matrix
        with full_precision(maps):
            matrix = measure((maps if self.teaches_features else maps.detach()).float(), self.projection)
            return mutual_information_loss(weights.float(), matrix, self.form)


class EvenViews(nn.Module):
    """Equal weights of the views that show something: view attention switched off."""

    def forward(
        self, maps: Float[Tensor, "n k d h w"], text: Float[Tensor, "n c"], present: Bool[Tensor, "n k"]
    ) -> Float[Tensor, "n k"]:
        """1 over the number of ``present`` views for each of them, 0 for the others; unless no view is present."""
        usable = present | ~present.any(dim=-1, keepdim=True)
        return even_shares(usable.to(maps.dtype))


def stack_views(maps: Float[Tensor, "n k d h w"], weights: Float[Tensor, "n k"]) -> Float[Tensor, "n d kh w"]:
    """The maps of all views, one below the other; those of views without weight become 0."""
    return rearrange(maps * (weights > 0)[:, :, None, None, None], "n k d h w -> n d (k h) w")


def fuse_views(maps: Float[Tensor, "n k d h w"], weights: Float[Tensor, "n k"]) -> Float[Tensor, "n d h w"]:
    """FT = sum_k w_k F_k (Eq. 7)."""
    return einsum(maps, weights, "n k d h w, n k -> n d h w")


def most_informative(weights: Float[Tensor, "n k"]) -> Int[Tensor, " n"]:
    """Index of the view with the largest weight."""
    return weights.argmax(dim=-1)


EXPLORE = 0.3
"""Share of training spread evenly over the present views: without it one view wins early and the others starve."""
RANKING_TEMPERATURE = 0.3
"""How many times smaller than the mean loss a difference between views must be to hardly matter."""


def even_shares(weights: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    """Uniform distribution over the present views; absent ones have weight 0."""
    present = (weights > 0).to(weights.dtype)
    return present / present.sum(dim=-1, keepdim=True)


def explored(shares: Float[Tensor, "n k"], weights: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    """Mixture of ``shares`` and the uniform distribution over the present views."""
    return (1 - EXPLORE) * shares + EXPLORE * even_shares(weights)


def choose_views(weights: Float[Tensor, "n k"], choice: str) -> tuple[Int[Tensor, "m 2"], Float[Tensor, " m"]]:
    """Which (step, view) pairs to decode, and the share of its step's loss that each pair gets.

    * "argmax": the most informative view.
    * "expected": every present view, its loss weighted by w, so that w learns which view decodes best.
    * "ranked": every present view, alike until their losses are known, see ``best_shares``; ``ranking_loss`` teaches w.
    * "sampled": one view drawn from w; ``choice_loss`` teaches w what "expected" does at 1/k of the cost.
    """
    n, k = weights.shape
    steps = torch.arange(n, device=weights.device)
    if choice in ("expected", "ranked"):
        pairs = torch.cartesian_prod(steps, torch.arange(k, device=weights.device))
        shares = explored(weights, weights) if choice == "expected" else even_shares(weights)
        return pairs, rearrange(shares, "n k -> (n k)")
    picked = most_informative(weights)
    if choice == "sampled":
        picked = explored(weights, weights).detach().multinomial(1)[:, 0]
    return torch.stack([steps, picked], dim=-1), weights.new_ones(n)


def choice_loss(
    weights: Float[Tensor, "n k"], picked: Int[Tensor, " n"], losses: Float[Tensor, " n"]
) -> Float[Tensor, " n"]:
    """Score-function surrogate: its gradient points where the loss expected over the views falls (Williams 1992).

    The losses are standardised over the batch, which serves as baseline; only the weights receive a gradient.
    """
    centred = (losses - losses.mean()).detach()
    advantage = centred / (centred.square().mean().sqrt() + 1e-6)
    return advantage * explored(weights, weights).gather(1, picked[:, None])[:, 0].log()


def loss_softmin(weights: Float[Tensor, "n k"], losses: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    """Softmin over the present views of the loss that each gave; without gradient.

    The temperature follows the step's mean loss, so that late in training small differences still count.
    """
    mean = (losses * even_shares(weights)).sum(dim=-1, keepdim=True)
    scores = -losses / (RANKING_TEMPERATURE * mean + 1e-6)
    return scores.detach().masked_fill(weights <= 0, -math.inf).softmax(dim=-1)


def best_shares(weights: Float[Tensor, "n k"], losses: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
    """Shares of all (step, view) pairs that favour the views that decode a step well.

    A view that does not show the target can only learn to guess; with equal shares that guessing outweighs the rest.
    """
    return rearrange(explored(loss_softmin(weights, losses.view_as(weights)), weights), "n k -> (n k)")


def ranking_loss(weights: Float[Tensor, "n k"], losses: Float[Tensor, "n k"]) -> Float[Tensor, " n"]:
    """Cross-entropy between w and the views' softmin of their losses; its gradient never vanishes on a wrong choice."""
    return -(loss_softmin(weights, losses) * weights.clamp_min(1e-6).log()).sum(dim=-1)
