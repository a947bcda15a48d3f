"""What a decision looked like, for pictures of it."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from einops import rearrange
from jaxtyping import Float, Int
from torch import Tensor

from lerobot_histmv.model.decoder import Prediction
from lerobot_histmv.model.network import Encoding


@dataclass
class Decision:
    """The last decision of a batch of environments.

    Args:
        weights: view weights.
        view: index of the chosen view.
        heat: heat map over the chosen view's pixels, sums to 1; to the view's share with decode="all", where the view
            chosen is the one with most of the heat.
        surface: expectation of the heat map over the cloud, before the offset [m].
    """

    weights: Float[Tensor, "b k"]
    view: Int[Tensor, " b"]
    heat: Float[Tensor, "b y x"]
    surface: Float[Tensor, "b 3"]

    @classmethod
    def of(cls, encoding: Encoding, predicted: Prediction, view: Int[Tensor, " b"]) -> "Decision":
        """The decision that took ``view`` of each environment."""
        rows = torch.arange(len(view), device=view.device)
        heat = rearrange(predicted.log_heat.exp(), "b (k y) x -> b k y x", y=encoding.cloud.shape[-2])
        own = heat[rows, view.clamp_max(heat.shape[1] - 1)]  # one view's heat map stands alone, whichever it is
        return cls(encoding.weights, view, own, predicted.surface)

    def updated(self, rows: Sequence[int], newer: "Decision") -> "Decision":
        """This one with the environments ``rows`` replaced by ``newer``, in their order."""
        return Decision(
            **{
                name: old.index_copy(0, torch.tensor(rows, device=old.device), getattr(newer, name))
                for name, old in ((field.name, getattr(self, field.name)) for field in fields(self))
            }
        )
