"""Augmentation that keeps colours, depth, calibration and poses consistent."""

from dataclasses import dataclass

import torch
from einops import einsum, rearrange
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional


@dataclass(frozen=True)
class AugmentConfig:
    """Strength of each augmentation; 0 switches it off.

    Args:
        yaw: rotation of the whole world about the vertical through the workspace's centre [rad].
        shift: horizontal translation of the whole world [m]; vertical is half of it.
        pixels: shift of each image, its depth and its principal point [pixels].
        brightness: additive change of each view's brightness.
        contrast: relative change of each view's colour channels.
        depth_noise: standard deviation of depth noise at 1 m, growing with z squared [m].
        lost_view: probability that one view of a window shows nothing: black, without depth.
        card: probability that a card before the camera hides a part of one view of a window, or all of it.
    """

    yaw: float = 0.5
    shift: float = 0.06
    pixels: int = 8
    brightness: float = 0.06
    contrast: float = 0.1
    depth_noise: float = 0.0
    lost_view: float = 0.2
    card: float = 0.2

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value < 0:
                raise ValueError(f"augment.{name}={value} is a strength and must be >= 0")
        for name in ("lost_view", "card"):
            if getattr(self, name) > 1:
                raise ValueError(f"augment.{name}={getattr(self, name)} is a probability and must be <= 1")


def uniform(shape: tuple[int, ...], like: Tensor) -> Tensor:
    """Uniform numbers in [-1, 1] of ``shape``."""
    return torch.rand(shape, device=like.device, dtype=like.dtype) * 2 - 1


def random_world_motion(
    count: int, config: AugmentConfig, centre: Float[Tensor, " 3"]
) -> tuple[Float[Tensor, "b 3 4"], Float[Tensor, "b 4"]]:
    """Random motions of the world, as 3x4 matrices and as the quaternions (w, x, y, z) of their rotations."""
    angle = config.yaw * uniform((count,), centre)
    cos, sin, zero, one = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    rotation = rearrange(
        torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], dim=-1), "b (i j) -> b i j", i=3
    )
    travel = config.shift * uniform((count, 3), centre) * centre.new_tensor([1.0, 1.0, 0.5])
    offset = centre - einsum(rotation, centre, "b i j, j -> b i") + travel
    quaternion = torch.stack([(angle / 2).cos(), zero, zero, (angle / 2).sin()], dim=-1)
    return torch.cat([rotation, offset[:, :, None]], dim=-1), quaternion


def move_points(motion: Float[Tensor, "b 3 4"], points: Float[Tensor, "b t 3"]) -> Float[Tensor, "b t 3"]:
    """World points after the motion."""
    return einsum(motion[..., :3], points, "b i j, b t j -> b t i") + motion[:, None, :, 3]


def move_cameras(motion: Float[Tensor, "b 3 4"], extrinsics: Float[Tensor, "b t k 3 4"]) -> Float[Tensor, "b t k 3 4"]:
    """``T_world_cam`` after the motion: what the cameras see moves with them, so clouds follow."""
    moved = einsum(motion[..., :3], extrinsics, "b i j, b t k j c -> b t k i c")
    moved[..., 3] += motion[:, None, None, :, 3]
    return moved


def shift_pixels(
    rgb: Float[Tensor, "n k 3 y x"], depth: Float[Tensor, "n k y x"], intrinsics: Float[Tensor, "n k 4"], most: int
) -> tuple[Float[Tensor, "n k 3 y x"], Float[Tensor, "n k y x"], Float[Tensor, "n k 4"]]:
    """Shift each view by whole pixels and its principal point with it; uncovered pixels become 0 (invalid depth)."""
    n, k, rows, columns = depth.shape
    most = min(most, rows - 1, columns - 1)
    steps = torch.randint(-most, most + 1, (n, k, 2))
    top, left = (most - steps).flatten(0, 1).to(depth.device).unbind(-1)

    def shift(maps: Float[Tensor, "n k c y x"]) -> Float[Tensor, "n k c y x"]:
        """All cut-outs of the padded images are one view of them: picking one of each is a single operation."""
        padded = functional.pad(rearrange(maps, "n k c y x -> (n k) c y x"), [most] * 4)
        cut = padded.unfold(2, rows, 1).unfold(3, columns, 1)[torch.arange(n * k, device=maps.device), :, top, left]
        return rearrange(cut, "(n k) c y x -> n k c y x", n=n)

    moved = intrinsics.clone()
    moved[..., 2] += steps[..., 1].to(intrinsics)
    moved[..., 3] += steps[..., 0].to(intrinsics)
    return shift(rgb), shift(depth[:, :, None])[:, :, 0], moved


def jitter_colours(rgb: Float[Tensor, "n k 3 y x"], config: AugmentConfig) -> Float[Tensor, "n k 3 y x"]:
    """Random gain per view and channel and random brightness per view; colours stay in [0, 1]."""
    n, k = rgb.shape[:2]
    gain = 1 + config.contrast * uniform((n, k, 3, 1, 1), rgb)
    return (rgb * gain).add_(config.brightness * uniform((n, k, 1, 1, 1), rgb)).clamp_(0, 1)


def noisy_depth(depth: Float[Tensor, "n k y x"], strength: float) -> Float[Tensor, "n k y x"]:
    """Gaussian noise whose deviation grows with z squared; invalid pixels stay 0."""
    return (depth + strength * depth.square() * torch.randn_like(depth)) * (depth > 0)


def draw_views(count: int, views: int, probability: float) -> Bool[Tensor, "b k"]:
    """One view of each window with ``probability``, else none; an only view is never lost."""
    which = functional.one_hot(torch.randint(views, (count,)), views).bool()
    return which & (torch.rand(count, 1) < (probability if views > 1 else 0))


CARD_SIDE = 0.3
"""Shortest side of a card, as a share of the picture's."""
CARD_DEPTH = (0.1, 0.4)
"""Least and largest distance of a card [m]; as often, it gives no depth."""


@dataclass
class Cards:
    """A card before each view of b windows.

    Args:
        hides: pixels that it hides; none where there is no card.
        colour: its colour.
        depth: its distance [m], 0 without a measurement.
    """

    hides: Bool[Tensor, "b k y x"]
    colour: Float[Tensor, "b k 3"]
    depth: Float[Tensor, "b k"]

    @classmethod
    def draw(cls, count: int, views: int, probability: float, size: tuple[int, int]) -> "Cards":
        """Cards of random size, place, colour and distance, before one view of a window with ``probability``."""
        inside = []
        for pixels in size:
            length = CARD_SIDE + (1 - CARD_SIDE) * torch.rand(count, 1)
            begin = (1 - length) * torch.rand(count, 1)
            place = (torch.arange(pixels) + 0.5) / pixels
            inside.append((begin <= place) & (place <= begin + length))
        hides = rearrange(inside[0], "b y -> b 1 y 1") & rearrange(inside[1], "b x -> b 1 1 x")
        near, far = CARD_DEPTH
        depth = (near + (far - near) * torch.rand(count, views)) * (torch.rand(count, views) < 0.5)
        before = draw_views(count, views, probability)
        return cls(hides & before[..., None, None], torch.rand(count, views, 3), depth)

    def hide(
        self, rgb: Float[Tensor, "n k 3 y x"], depth: Float[Tensor, "n k y x"], owner: Int[Tensor, " n"]
    ) -> tuple[Float[Tensor, "n k 3 y x"], Float[Tensor, "n k y x"]]:
        """Colours and depth of rows that belong to the windows ``owner``, with the cards before the cameras."""
        hides, colour, far = (each.to(rgb.device)[owner] for each in (self.hides, self.colour, self.depth))
        return torch.where(hides[:, :, None], colour[..., None, None], rgb), torch.where(
            hides, far[..., None, None], depth
        )
