"""Pinhole cameras in torch, batched; conventions as in ``lerobot_histmv.geometry``, which states them in numpy."""

import torch
from einops import einsum, rearrange
from jaxtyping import Bool, Float
from torch import Tensor, nn

COORDINATE_UNIT = 0.3
"""Length [m] that the network sees as 1."""


class Workspace(nn.Module):
    """The box that holds every target: which points count, and how coordinates are scaled for the network."""

    low: Tensor
    high: Tensor

    def __init__(self, corners: tuple[float, ...]) -> None:
        super().__init__()
        self.register_buffer("low", torch.tensor(corners[:3]), persistent=False)
        self.register_buffer("high", torch.tensor(corners[3:]), persistent=False)

    @property
    def centre(self) -> Float[Tensor, " 3"]:
        """Middle of the box [m]."""
        return (self.low + self.high) / 2

    def normalise(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """World points [m] as offsets from the centre in units of ``COORDINATE_UNIT``."""
        return (points - self.centre) / COORDINATE_UNIT

    def normalise_map(
        self, cloud: Float[Tensor, "n k 3 y x"], depth: Float[Tensor, "n k y x"]
    ) -> tuple[Float[Tensor, "n k 3 y x"], Bool[Tensor, "n k y x"]]:
        """``normalise`` for maps, and which pixels hold a measurement inside the box; the others become 0."""
        centre, half = (rearrange(part, "c -> c 1 1") for part in (self.centre, (self.high - self.low) / 2))
        scaled = (cloud - centre) / COORDINATE_UNIT
        x, y, z = (scaled.abs() <= half / COORDINATE_UNIT).unbind(2)
        valid = x & y & z & (depth > 0)
        return scaled * valid[:, :, None], valid


def deproject(
    depth_nkyx: Float[Tensor, "n k y x"],
    intrinsics_nk4: Float[Tensor, "n k 4"],
    extrinsics_nk34: Float[Tensor, "n k 3 4"],
) -> Float[Tensor, "n k 3 y x"]:
    """World coordinates [m] of every pixel of depth images [m]; a pixel's centre is (column, row)."""
    y, x = depth_nkyx.shape[-2:]
    fx, fy, cx, cy = (rearrange(part, "n k -> n k 1") for part in intrinsics_nk4.unbind(-1))
    extrinsics_nk34 = extrinsics_nk34.contiguous()  # the maps take over the order in which its axes lie in memory
    right, down, ahead = extrinsics_nk34[..., :3].unbind(-1)
    # The ray of pixel (u, v) is affine in u and v, so the whole map of rays is two broadcast sums.
    origin = ahead - right * cx / fx - down * cy / fy
    columns = torch.arange(x, device=depth_nkyx.device, dtype=depth_nkyx.dtype)
    rows = torch.arange(y, device=depth_nkyx.device, dtype=depth_nkyx.dtype)
    across = rearrange(right / fx, "n k c -> n k c 1 1") * columns + rearrange(origin, "n k c -> n k c 1 1")
    along = rearrange(down / fy, "n k c -> n k c 1 1") * rows[:, None]
    return torch.addcmul(
        rearrange(extrinsics_nk34[..., 3], "n k c -> n k c 1 1"), across + along, depth_nkyx[:, :, None]
    )


def squared_distances(cloud_m3yx: Float[Tensor, "m 3 y x"], points_m3: Float[Tensor, "m 3"]) -> Float[Tensor, "m y x"]:
    """Squared distance [m^2] of every pixel's world point from one point each."""
    x, y, z = (cloud_m3yx - points_m3[:, :, None, None]).unbind(1)
    return (x * x).addcmul_(y, y).addcmul_(z, z)


def project(
    points_np3: Float[Tensor, "n p 3"],
    intrinsics_nk4: Float[Tensor, "n k 4"],
    extrinsics_nk34: Float[Tensor, "n k 3 4"],
) -> tuple[Float[Tensor, "n k p 2"], Float[Tensor, "n k p"]]:
    """Pixel coordinates (column, row) and depth z [m] of world points in every view; z <= 0 is behind the camera."""
    offsets = points_np3[:, None] - extrinsics_nk34[:, :, None, :, 3]
    in_camera = einsum(extrinsics_nk34[..., :3], offsets, "n k i j, n k p i -> n k p j")
    x, y, z = in_camera.unbind(-1)
    fx, fy, cx, cy = (rearrange(part, "n k -> n k 1") for part in intrinsics_nk4.unbind(-1))
    ahead = torch.where(z > 0, z, torch.ones_like(z))
    return torch.stack([fx * x / ahead + cx, fy * y / ahead + cy], dim=-1), z


def pose_heat_map(
    pixels_nkp2: Float[Tensor, "n k p 2"],
    depths_nkp: Float[Tensor, "n k p"],
    heats_np: Float[Tensor, "n p"],
    size: tuple[int, int],
    stride: int,
    sigma: float = 1.0,
) -> Float[Tensor, "n k 1 y x"]:
    """Thermal image of projected tool positions (paper 3.1): Gaussian splats whose intensity is the step's heat.

    Args:
        pixels_nkp2: full-resolution pixel coordinates of p tool positions in each view.
        depths_nkp: their depth [m]; points behind the camera draw nothing.
        heats_np: intensity in [0, 1], 1 for the current step, less with age, 0 for absent steps.
        size: rows and columns of the map.
        stride: full-resolution pixels per map cell.
        sigma: width of a splat in cells.
    """
    rows = torch.arange(size[0], device=pixels_nkp2.device) * stride + (stride - 1) / 2
    columns = torch.arange(size[1], device=pixels_nkp2.device) * stride + (stride - 1) / 2
    scale = -0.5 / (sigma * stride) ** 2
    across = torch.exp(scale * (pixels_nkp2[..., 0:1] - columns) ** 2)
    along = torch.exp(scale * (pixels_nkp2[..., 1:2] - rows) ** 2)
    heats_nkp = heats_np[:, None] * (depths_nkp > 0)
    splats = einsum(heats_nkp, along, across, "n k p, n k p y, n k p x -> n k p y x")
    return splats.amax(dim=2, keepdim=True)
