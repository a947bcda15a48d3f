"""Named loss terms and their weighted sum (paper Eq. 9)."""

import torch
from einops import einsum
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from lerobot_histmv.model.cameras import squared_distances
from lerobot_histmv.model.config import LossConfig
from lerobot_histmv.model.decoder import Prediction
from lerobot_histmv.model.layers import full_precision
from lerobot_histmv.model.rotations import matrix_of

HEAT_SIGMA = 0.015
"""Width [m] of the heat map's target around the surface nearest the true position."""
HEAT_REACH = 0.15
"""Farthest [m] that surface may be: beyond it, the view is taken not to show what matters."""
AXIS_REACH = 0.04
"""Distance [m] from the axis through a pose up to which the tool points at surface there: half an open gripper."""
BEHIND = 0.03
"""How far [m] behind a pose the tool still points at surface: an object between the fingers reaches up there."""


def quaternion_loss(predicted: Float[Tensor, "m 4"], target: Float[Tensor, "m 4"]) -> Float[Tensor, " m"]:
    """Squared distance to the nearer of q and -q, chosen per sample: both are the same rotation."""
    same = (predicted - target).square().sum(dim=-1)
    opposite = (predicted + target).square().sum(dim=-1)
    return torch.minimum(same, opposite)


def heat_loss(
    log_heat: Float[Tensor, "m y x"],
    cloud: Float[Tensor, "m 3 y x"],
    valid: Bool[Tensor, "m y x"],
    target: Float[Tensor, "m 7"],
    approach: tuple[float, ...] = (0.0, 0.0, 0.0),
) -> Float[Tensor, " m"]:
    """Cross-entropy to a Gaussian around the target over the surface; 0 where the view sees nothing near it.

    Many key poses lie in free space, above the object that they are about: it is the surface that the tool would point
    at there, and where there is none, the nearest surface. The nearest one alone is often the gripper before it moves.

    Args:
        log_heat: log-probabilities of the pixels.
        cloud: their world coordinates [m].
        valid: which of them count: where none does, the heat map is uniform and says nothing.
        target: position [m] and quaternion wxyz of the key pose.
        approach: unit vector in which the tool points, in its own frame; zeros take the nearest surface.
    """
    distance = squared_distances(cloud, target[:, :3]).masked_fill_(~valid, torch.inf)
    if any(approach):
        pointed = distance.masked_fill(~pointed_at(distance, cloud, target, approach), torch.inf)
        found = pointed.amin(dim=(1, 2), keepdim=True) < HEAT_REACH**2
        distance = torch.where(found, pointed, distance)
    distance = distance.flatten(1)
    near = distance.amin(dim=1) < HEAT_REACH**2
    wanted = (-0.5 * distance[near] / HEAT_SIGMA**2).softmax(dim=1)
    log_seen = log_heat.masked_fill(~valid, 0).flatten(1)[near]
    return torch.zeros_like(log_heat[:, 0, 0]).masked_scatter(near, -(wanted * log_seen).sum(dim=1))


def pointed_at(
    distance: Float[Tensor, "m y x"],
    cloud: Float[Tensor, "m 3 y x"],
    pose: Float[Tensor, "m 7"],
    approach: tuple[float, ...],
) -> Bool[Tensor, "m y x"]:
    """Pixels within ``AXIS_REACH`` of the line along ``approach`` through the pose, from a little behind it on.

    ``distance`` is each pixel's squared distance from the pose [m^2], infinite where it does not count.
    """
    with full_precision(cloud):
        direction = (matrix_of(pose[:, 3:]) * pose.new_tensor(approach)).sum(dim=-1)
        start = (direction * pose[:, :3]).sum(dim=-1)
        ahead = einsum(direction, cloud, "m c, m c y x -> m y x") - start[:, None, None]
    return (ahead > -BEHIND) & (distance - ahead.square() < AXIS_REACH**2)


PARAPHRASE_TEMPERATURE = 0.1


def paraphrase_loss(vectors: Float[Tensor, "n c"], meanings: Int[Tensor, " n"]) -> Float[Tensor, ""]:
    """Supervised contrastive loss: sentences of one meaning together, all others apart (Khosla et al. 2020, Eq. 2).

    Args:
        vectors: sentence vectors of unit length.
        meanings: number of each sentence's meaning; sentences without a partner only serve as others.
    """
    itself = torch.eye(len(vectors), dtype=torch.bool, device=vectors.device)
    logits = (vectors @ vectors.T / PARAPHRASE_TEMPERATURE).masked_fill(itself, -torch.inf)
    partners = (meanings[:, None] == meanings) & ~itself
    log_share = logits.log_softmax(dim=1).masked_fill(~partners, 0)
    return -log_share.sum() / partners.sum().clamp_min(1)


def action_losses(
    predicted: Prediction,
    target: Float[Tensor, "m 8"],
    cloud: Float[Tensor, "m 3 y x"],
    valid: Bool[Tensor, "m y x"],
    config: LossConfig,
) -> dict[str, Float[Tensor, " m"]]:
    """Position, rotation, gripper and heat map term of every decoded (step, view) pair, unweighted.

    Args:
        predicted: decoded actions.
        target: position [m], quaternion wxyz, gripper in {0, 1}.
        cloud: world coordinates of the decoded pixels [m].
        valid: which of them count.
        config: forms and weights.
    """
    error = (predicted.position - target[:, :3]) / config.position_unit
    if config.gripper == "bce":
        gripper = functional.binary_cross_entropy_with_logits(predicted.gripper, target[:, 7], reduction="none")
    else:
        gripper = (predicted.gripper.sigmoid() - target[:, 7]).square()
    terms = {
        "position": error.square().sum(dim=-1),
        "rotation": quaternion_loss(predicted.quaternion, target[:, 3:7]),
        "gripper": gripper,
    }
    if config.heatmap > 0:
        terms["heatmap"] = heat_loss(predicted.log_heat, cloud, valid, target[:, :7], config.approach)
    return terms


def term_weights(config: LossConfig) -> dict[str, float]:
    """Weight of every term by name: lambda_1 on the action terms, lambda_2 on mutual information."""
    return {
        "position": config.action,
        "rotation": config.action,
        "gripper": config.action,
        "heatmap": config.heatmap,
        "mutual_information": config.mutual_information,
        "choice": config.choice,
        "paraphrase": config.paraphrase,
    }


def weighted_sum(terms: dict[str, Float[Tensor, " m"]], config: LossConfig) -> Float[Tensor, " m"]:
    """Sum of the named terms times their weights."""
    weights = term_weights(config)
    return torch.stack([weights[name] * term for name, term in terms.items()]).sum(dim=0)
