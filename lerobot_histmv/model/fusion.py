"""TransFuse: image tokens of each view gather from the point tokens of the whole scene (paper 3.2)."""

from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from lerobot_histmv.model.layers import CrossAttention


class TransFuse(nn.Module):
    """Cross-attention F = TransFuse(FR, FP) per view; a cell's mean world position is its position code."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.code = nn.Sequential(nn.Linear(3, width), nn.GELU(), nn.Linear(width, width))
        self.layer = CrossAttention(width, heads)

    def forward(
        self,
        features: Float[Tensor, "n k d h w"],
        cells: Float[Tensor, "n k 3 h w"],
        points: Float[Tensor, "n p d"],
    ) -> Float[Tensor, "n k d h w"]:
        """Fused maps F.

        Args:
            features: RGB-A features FR.
            cells: mean normalised world position of each cell.
            points: point tokens FP, shared by all views.
        """
        k, h = features.shape[1], features.shape[3]
        tokens = rearrange(features, "n k d h w -> n (k h w) d")
        codes = self.code(rearrange(cells, "n k c h w -> n (k h w) c"))
        fused = self.layer(tokens, points, codes)
        return rearrange(fused, "n (k h w) d -> n k d h w", k=k, h=h)
