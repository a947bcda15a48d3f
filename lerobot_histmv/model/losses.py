"""Named loss terms and their weighted sum (paper Eq. 9)."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from lerobot_histmv.model.cameras import squared_distances
from lerobot_histmv.model.config import LossConfig
from lerobot_histmv.model.decoder import Prediction
from lerobot_histmv.model.rotations import matrix_of

HEAT_SIGMA = 0.015
"""Width [m] of the heat map's target around the surface nearest the true position."""
HEAT_REACH = 0.15
"""Farthest [m] that surface may be: beyond it, the view is taken not to show what matters."""


def quaternion_loss(predicted: Float[Tensor, "m 4"], target: Float[Tensor, "m 4"]) -> Float[Tensor, " m"]:
    """Squared distance to the nearer of q and -q, chosen per sample: both are the same rotation."""
    same = (predicted - target).square().sum(dim=-1)
    opposite = (predicted + target).square().sum(dim=-1)
    return torch.minimum(same, opposite)


def heat_loss(
    log_heat: Float[Tensor, "m y x"],
    cloud: Float[Tensor, "m 3 y x"],
    target: Float[Tensor, "m 7"],
    approach: float = 0.0,
) -> Float[Tensor, " m"]:
    """Cross-entropy to a Gaussian around the surface nearest the target; 0 where the view sees nothing near it.

    Many key poses lie in free space, above the object that they are about: it is the nearest surface. Where the gripper
    that moves there is nearer, it is not: so what lies on the pose's approach axis comes first.

    Args:
        log_heat: log-probabilities of the pixels.
        cloud: their world coordinates [m].
        target: position [m] and quaternion wxyz of the key pose.
        approach: distance [m] from the pose's z axis within which surface is sought first; 0 seeks everywhere at once.
    """
    seen = log_heat > -torch.inf
    distance = squared_distances(cloud, target[:, :3]).masked_fill_(~seen, torch.inf)
    if approach:
        # Element by element, as autocast would round a matrix product to a hundredth of the distance.
        axis = matrix_of(target[:, 3:])[..., 2, None, None]
        along = (axis * (cloud - target[:, :3, None, None])).sum(dim=1)
        ahead = distance.masked_fill(distance - along.square() > approach**2, torch.inf)
        found = ahead.amin(dim=(1, 2), keepdim=True) < HEAT_REACH**2
        distance = torch.where(found, ahead, distance)
    distance = distance.flatten(1)
    near = distance.amin(dim=1) < HEAT_REACH**2
    wanted = (-0.5 * distance[near] / HEAT_SIGMA**2).softmax(dim=1)
    log_seen = log_heat.masked_fill(~seen, 0).flatten(1)[near]
    return torch.zeros_like(log_heat[:, 0, 0]).masked_scatter(near, -(wanted * log_seen).sum(dim=1))


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
    predicted: Prediction, target: Float[Tensor, "m 8"], cloud: Float[Tensor, "m 3 y x"], config: LossConfig
) -> dict[str, Float[Tensor, " m"]]:
    """Position, rotation, gripper and heat map term of every decoded (step, view) pair, unweighted.

    Args:
        predicted: decoded actions.
        target: position [m], quaternion wxyz, gripper in {0, 1}.
        cloud: world coordinates of the decoded view [m].
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
        terms["heatmap"] = heat_loss(predicted.log_heat, cloud, target[:, :7], config.approach)
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
