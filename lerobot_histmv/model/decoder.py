"""From the history-enriched map and the chosen view's PANet levels to position, rotation and gripper (paper 3.4)."""

from dataclasses import dataclass

import torch
from einops import einsum, rearrange, reduce, repeat
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional

from lerobot_histmv.model.cameras import squared_distances
from lerobot_histmv.model.config import DecoderConfig
from lerobot_histmv.model.layers import ConvBlock, full_precision, group_norm, resize_bilinear, upsample_to
from lerobot_histmv.model.rotations import turned_with

TEMPERATURE = 0.1
LEAST_WEIGHT = 1e-6
"""A view's weight counts as at least so much: its logarithm stays finite."""
LOCAL_CHANNELS = 24
"""Channels of the decoded map at stride 4."""
PEAK_REACH = 0.05
"""Distance [m] from the heat map's peak up to which it counts when the policy acts."""
OFFSET_UNIT = 0.1
"""Length [m] that the second decoder's offset outputs see as 1."""


@dataclass
class Prediction:
    """Decoded action of ``m`` (step, view) pairs, or of ``m`` steps from all views together.

    Args:
        position: tool position in the base frame [m].
        surface: heat map's expectation over the cloud, the position without its offset [m].
        quaternion: w, x, y, z, unit.
        gripper: logit of "open".
        log_heat: log-probabilities over the pixels of the view, or of all views one below the other; -inf where the
            cloud is invalid.
        certainty: share of the heat near its peak when the policy acts; 1 in training, which does not ask.
    """

    position: Float[Tensor, "m 3"]
    surface: Float[Tensor, "m 3"]
    quaternion: Float[Tensor, "m 4"]
    gripper: Float[Tensor, " m"]
    log_heat: Float[Tensor, "m y x"]
    certainty: Float[Tensor, " m"]

    def at(self, rows: Int[Tensor, " r"]) -> "Prediction":
        """The predictions of the given pairs."""
        return Prediction(**{name: values[rows] for name, values in vars(self).items()})


def spatial_log_softmax(logits: Float[Tensor, "m y x"], valid: Bool[Tensor, "m y x"]) -> Float[Tensor, "m y x"]:
    """Log-softmax over valid pixels; uniform over all pixels where none is valid."""
    usable = valid | ~valid.any(dim=(-2, -1), keepdim=True)
    masked = (logits / TEMPERATURE).masked_fill(~usable, -torch.inf)
    return masked.flatten(1).log_softmax(dim=-1).view_as(logits)


def around_peak(
    heat: Float[Tensor, "m y x"], cloud: Float[Tensor, "m 3 y x"]
) -> tuple[Float[Tensor, "m y x"], Float[Tensor, " m"]]:
    """The heat within ``PEAK_REACH`` of its strongest pixel's point, scaled to sum to 1 again, and its share of all.

    Where the heat map is torn between two objects, its expectation over all pixels lies at neither.
    """
    peak = heat.flatten(1).argmax(dim=1)
    centre = cloud.flatten(2).gather(2, repeat(peak, "m -> m c 1", c=3))[..., 0]
    near = squared_distances(cloud, centre) < PEAK_REACH**2
    kept = heat * near
    share = kept.sum(dim=(-2, -1))
    return kept / share[:, None, None], share


class Merge(nn.Module):
    """A decoded map joined with a finer skip: convolve each at its own size, add, normalise, leaky ReLU.

    For maps of one size this is a convolution of both side by side, without the copy that puts them together. A coarser
    one is upsampled (nearest neighbour) after its part of the convolution instead of before: another function, whose
    kernel spans coarse pixels, for a quarter of the work.
    """

    def __init__(self, coarse: int, skip: int, channels_out: int, normalise: bool) -> None:
        super().__init__()
        self.coarse = nn.Conv2d(coarse, channels_out, 3, padding=1, bias=False)
        self.skip = nn.Conv2d(skip, channels_out, 3, padding=1)
        self.norm = group_norm(channels_out) if normalise else nn.Identity()

    def forward(self, maps: Float[Tensor, "m c y x"], skip: Float[Tensor, "m s y2 x2"]) -> Float[Tensor, "m e y2 x2"]:
        """Decoded map of the skip's height and width."""
        joined = self.skip(skip) + upsample_to(self.coarse(maps), skip)
        return functional.leaky_relu(self.norm(joined), 0.02)


class PositionDecoder(nn.Module):
    """Upsampling path with PANet skips to one heat map over the view's pixels."""

    def __init__(self, width: int, skip_channels: list[int]) -> None:
        super().__init__()
        channels = [width, 32, LOCAL_CHANNELS, 8]
        skips = skip_channels[::-1]
        self.merge = nn.ModuleList(
            Merge(channels[max(i - 1, 0)], skip, channels[i], normalise=i < 3) for i, skip in enumerate(skips)
        )
        self.heat = nn.Conv2d(channels[-1], 1, 3, padding=1)

    def forward(
        self, maps: Float[Tensor, "m d h w"], skips: list[Float[Tensor, "m _ _ _"]], size: tuple[int, int]
    ) -> tuple[Float[Tensor, "m y x"], Float[Tensor, "m c y4 x4"]]:
        """Heat map logits at full resolution and the decoded map at stride 4.

        ``skips`` run from fine (stride 2) to coarse (stride 16).
        """
        decoded = []
        for merge, skip in zip(self.merge, reversed(skips), strict=True):
            maps = merge(maps, skip)
            decoded.append(maps)
        return resize_bilinear(rearrange(self.heat(maps), "m 1 y x -> m y x"), size), decoded[-2]


class PoseDecoder(nn.Module):
    """Two convolutions, pooling and two dense layers: offset, rotation, gripper and, with ``ray``, depth.

    Beside the paper's pooled map, the dense layers see with ``local`` the decoded map where the heat map points: the
    turn of an object and the way from its surface to its centre are local. With ``opening`` they are told how far the
    gripper is open, which images show badly.
    """

    def __init__(self, width: int, config: DecoderConfig) -> None:
        super().__init__()
        self.local, self.told = config.local, config.opening
        self.convolve = nn.Sequential(ConvBlock(2 * width, width, stride=2), ConvBlock(width, width))
        self.sizes = [3, 12 if config.tool_frame else 4, 1, int(config.ray)]
        seen, numbers = 4 * width + LOCAL_CHANNELS * config.local + config.opening, sum(self.sizes)
        self.dense = nn.Sequential(nn.Linear(seen, 2 * width), nn.GELU(), nn.Linear(2 * width, numbers))

    def forward(
        self,
        maps: Float[Tensor, "m d h w"],
        view: Float[Tensor, "m d h w"],
        decoded: Float[Tensor, "m c y4 x4"],
        heat: Float[Tensor, "m y x"],
        opening: Float[Tensor, " m"],
    ) -> Float[Tensor, "m e"]:
        """The numbers from the history map F_t, the view's features FR_t, the decoded map, heat map and opening."""
        pooled = functional.adaptive_avg_pool2d(self.convolve(torch.cat([maps, view], dim=1)), 2)
        seen = [rearrange(pooled, "m d i j -> m (d i j)")]
        if self.local:
            share = reduce(heat, "m (y i) (x j) -> m y x", "sum", y=decoded.shape[2], x=decoded.shape[3])
            seen.append(einsum(share, decoded, "m y x, m c y x -> m c"))
        if self.told:
            seen.append(opening[:, None])
        return self.dense(torch.cat(seen, dim=-1))


@dataclass
class Place:
    """Where the heat maps of ``m`` decodings point: what ``Prediction`` takes of it, and the heat over the pixels."""

    surface: Float[Tensor, "m 3"]
    log_heat: Float[Tensor, "m y x"]
    certainty: Float[Tensor, " m"]
    heat: Float[Tensor, "m y x"]


class Decoder(nn.Module):
    """Both decoders.

    Args:
        width: d.
        skip_channels: channels of a view's levels, fine to coarse.
        config: decoder part of the network's configuration.
        middle: where a heat map points that no pixel is valid for: the middle of the workspace [m].
    """

    middle: Tensor

    def __init__(
        self, width: int, skip_channels: list[int], config: DecoderConfig, middle: Float[Tensor, " 3"]
    ) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("middle", middle, persistent=False)
        self.position = PositionDecoder(width, skip_channels)
        self.pose = PoseDecoder(width, self.config)

    def forward(
        self,
        maps: Float[Tensor, "m d h w"],
        view: Float[Tensor, "m d h w"],
        skips: list[Float[Tensor, "m _ _ _"]],
        cloud: Float[Tensor, "m 3 y x"],
        valid: Bool[Tensor, "m y x"],
        eye: Float[Tensor, "m 3"],
        tool: Float[Tensor, "m 3 3"],
        opening: Float[Tensor, " m"],
    ) -> Prediction:
        """Decode (step, view) pairs, each from the pixels of its view.

        Args:
            maps: history-enriched map F_t of the step.
            view: RGB-A features FR_t of the view.
            skips: the view's PANet levels, fine to coarse.
            cloud: world coordinates of the view's pixels [m].
            valid: pixels with a measurement inside the workspace.
            eye: position of the view's camera [m].
            tool: rotation matrix of the tool at that step.
            opening: of the gripper, 1 open.
        """
        logits, decoded = self.position(maps, skips, (cloud.shape[-2], cloud.shape[-1]))
        place = self._locate(logits, cloud, valid)
        return self._predict(place, maps, view, decoded, eye, tool, opening)

    def together(
        self,
        maps: Float[Tensor, "n k d h w"],
        views: Float[Tensor, "n k d h w"],
        skips: list[Float[Tensor, "nk _ _ _"]],
        cloud: Float[Tensor, "n k 3 y x"],
        valid: Bool[Tensor, "n k y x"],
        eyes: Float[Tensor, "n k 3"],
        tool: Float[Tensor, "n 3 3"],
        opening: Float[Tensor, " n"],
        weights: Float[Tensor, "n k"],
    ) -> tuple[Prediction, Float[Tensor, "n k"]]:
        """Decode all views of each step with one softmax over the pixels of all; also each view's share of the heat.

        The views' pixels lie one below the other, as in a single tall image. The view weights w are the prior of the
        views: a pixel's heat is proportional to w exp(logit / T). Where the second decoder needs one view, it gets the
        mean of all, weighted by their shares. Arguments as in ``forward``, of every view.
        """
        k = maps.shape[1]
        size = (cloud.shape[-2], cloud.shape[-1])
        logits, decoded = self.position(maps.flatten(0, 1), skips, size)
        prior = TEMPERATURE * weights.clamp_min(LEAST_WEIGHT).log()
        logits = logits + rearrange(prior, "n k -> (n k) 1 1")
        place = self._locate(
            rearrange(logits, "(n k) y x -> n (k y) x", k=k),
            rearrange(cloud, "n k c y x -> n c (k y) x"),
            rearrange(valid, "n k y x -> n (k y) x"),
        )
        shares = reduce(place.heat.detach(), "n (k y) x -> n k", "sum", k=k)
        predicted = self._predict(
            place,
            einsum(shares, maps, "n k, n k d h w -> n d h w"),
            einsum(shares, views, "n k, n k d h w -> n d h w"),
            rearrange(decoded, "(n k) c y x -> n c (k y) x", k=k),
            einsum(shares, eyes, "n k, n k c -> n c"),
            tool,
            opening,
        )
        return predicted, shares

    def _locate(
        self, logits: Float[Tensor, "m y x"], cloud: Float[Tensor, "m 3 y x"], valid: Bool[Tensor, "m y x"]
    ) -> Place:
        """Heat map and its expectation over the cloud; the middle of the workspace where nothing is seen."""
        with full_precision(logits):
            log_heat = spatial_log_softmax(logits.float(), valid)
            heat, certainty = log_heat.exp(), torch.ones_like(log_heat[:, 0, 0])
            if not self.training:  # training needs the gradient from all pixels; acting needs one object
                near, certainty = around_peak(heat, cloud)
                heat = near if self.config.peak else heat
            surface = einsum(heat, cloud, "m y x, m c y x -> m c")
            seeing = valid.any(dim=-1).any(dim=-1, keepdim=True)
            return Place(torch.where(seeing, surface, self.middle), log_heat, certainty, heat)

    def _predict(
        self,
        place: Place,
        maps: Float[Tensor, "m d h w"],
        view: Float[Tensor, "m d h w"],
        decoded: Float[Tensor, "m c y4 x4"],
        eye: Float[Tensor, "m 3"],
        tool: Float[Tensor, "m 3 3"],
        opening: Float[Tensor, " m"],
    ) -> Prediction:
        """The action at a place.

        A view sees the near side of an object, its centre lies deeper along the ray: that part of the way from surface
        to key pose turns with the camera and has a number of its own beside the offset in the world's axes. Likewise,
        rotation has a part in the tool's axes: many motions keep it, whatever it is.
        """
        numbers = self.pose(maps, view, decoded, place.heat.detach(), opening).float()
        with full_precision(numbers):
            offset, turn, gripper, along = numbers.split(self.pose.sizes, dim=-1)
            if self.config.ray:
                offset = offset + along * functional.normalize(place.surface - eye, dim=-1)
            if self.config.tool_frame:
                quaternion = turned_with(tool, turn)
            else:
                quaternion = functional.normalize(turn, dim=-1, eps=1e-6)
        return Prediction(
            position=place.surface + OFFSET_UNIT * offset,
            surface=place.surface,
            quaternion=quaternion,
            gripper=gripper[:, 0],
            log_heat=place.log_heat,
            certainty=place.certainty,
        )
