"""Named loss terms and their weighted sum (paper Eq. 9)."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from lerobot_histmv.model.config import LossConfig
from lerobot_histmv.model.decoder import Prediction

HEAT_SIGMA = 0.015
"""Width [m] of the target of the optional heat map loss around the true position."""


def quaternion_loss(predicted: Float[Tensor, "m 4"], target: Float[Tensor, "m 4"]) -> Float[Tensor, " m"]:
    """Squared distance to the nearer of q and -q, chosen per sample: both are the same rotation."""
    same = (predicted - target).square().sum(dim=-1)
    opposite = (predicted + target).square().sum(dim=-1)
    return torch.minimum(same, opposite)


def heat_loss(
    log_heat: Float[Tensor, "m y x"], cloud: Float[Tensor, "m 3 y x"], target: Float[Tensor, "m 3"]
) -> Float[Tensor, " m"]:
    """Cross-entropy to a Gaussian of pixels near the target position; 0 where the view sees nothing near it."""
    distance = (cloud - target[:, :, None, None]).square().sum(dim=1)
    seen = log_heat > -torch.inf
    wanted = torch.exp(-0.5 * distance / HEAT_SIGMA**2) * seen
    total = wanted.sum(dim=(-2, -1))
    log_seen = torch.where(seen, log_heat, torch.zeros_like(log_heat))
    entropy = -(wanted * log_seen).sum(dim=(-2, -1)) / total.clamp_min(1)
    return torch.where(total > 1, entropy, torch.zeros_like(entropy))


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
        terms["heatmap"] = heat_loss(predicted.log_heat, cloud, target[:, :3])
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
    }


def weighted_sum(terms: dict[str, Float[Tensor, " m"]], config: LossConfig) -> Float[Tensor, " m"]:
    """Sum of the named terms times their weights."""
    weights = term_weights(config)
    return torch.stack([weights[name] * term for name, term in terms.items()]).sum(dim=0)
