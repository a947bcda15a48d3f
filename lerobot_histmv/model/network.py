"""The whole network on one screen: features, fusion, view attention, history, decoder (paper figure 2)."""

from dataclasses import dataclass
from functools import partial

import torch
from einops import rearrange, reduce
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor, nn

from lerobot_histmv.model.cameras import Workspace, deproject, pose_heat_map, project
from lerobot_histmv.model.config import NetworkConfig
from lerobot_histmv.model.decoder import Decoder, Prediction
from lerobot_histmv.model.features import POSE_STRIDE, STRIDE, RgbaFeatures
from lerobot_histmv.model.fusion import TransFuse
from lerobot_histmv.model.history import History, Lookback
from lerobot_histmv.model.layers import full_precision
from lerobot_histmv.model.points import PointEncoder
from lerobot_histmv.model.rotations import matrix_of
from lerobot_histmv.model.semantics import Semantics
from lerobot_histmv.model.view_attention import (
    EvenViews,
    ViewAttention,
    choose_views,
    fuse_views,
    most_informative,
    stack_views,
)


@dataclass
class Observation:
    """What the network sees of ``n`` steps from ``k`` views.

    Args:
        rgb: colours in [0, 1].
        depth: distance along the optical axis [m], 0 where invalid.
        intrinsics: fx, fy, cx, cy [pixels].
        extrinsics: T_world_cam.
        tool: current and past tool positions in the base frame [m].
        heat: intensity of each tool position, 1 now, less with age, 0 where absent.
        turn: current rotation of the tool, as a unit quaternion w, x, y, z.
        opening: current opening of the gripper, 1 open.
        text: instruction vectors.
        clip: semantic vector of each view, if it is stored with the data; else the image tower gives it.
    """

    rgb: Float[Tensor, "n k 3 y x"]
    depth: Float[Tensor, "n k y x"]
    intrinsics: Float[Tensor, "n k 4"]
    extrinsics: Float[Tensor, "n k 3 4"]
    tool: Float[Tensor, "n p 3"]
    heat: Float[Tensor, "n p"]
    turn: Float[Tensor, "n 4"]
    opening: Float[Tensor, " n"]
    text: Float[Tensor, "n c"]
    clip: Float[Tensor, "n k g"] | None = None

    def at(self, steps: Int[Tensor, " r"]) -> "Observation":
        """The given steps."""
        return Observation(**{name: values[steps] for name, values in vars(self).items() if values is not None})


@dataclass
class Encoding:
    """Features of ``n`` steps; ``fused`` is all that later steps need of earlier ones.

    Args:
        fused: FT, the views' weighted sum; with fusion="tokens" the maps of all views, one below the other.
        maps: F of every view.
        features: FR of every view.
        skips: PANet levels of all n * k images, fine to coarse.
        cloud: world coordinates of every pixel [m].
        valid: pixels with a measurement inside the workspace.
        weights: view weights w; equal ones where view attention is off.
        eyes: position of every camera [m].
        tool: rotation matrix of the tool.
        opening: of the gripper, 1 open.
    """

    fused: Float[Tensor, "n d kh w"]
    maps: Float[Tensor, "n k d h w"]
    features: Float[Tensor, "n k d h w"]
    skips: list[Float[Tensor, "nk _ _ _"]]
    cloud: Float[Tensor, "n k 3 y x"]
    valid: Bool[Tensor, "n k y x"]
    weights: Float[Tensor, "n k"]
    eyes: Float[Tensor, "n k 3"]
    tool: Float[Tensor, "n 3 3"]
    opening: Float[Tensor, " n"]

    def at(self, steps: Int[Tensor, " r"]) -> "Encoding":
        """The given steps; the same tensors where they are all, in order."""
        n, k = self.weights.shape
        everything = torch.arange(n, device=steps.device)
        if steps.equal(everything):
            return self
        images = rearrange(steps[:, None] * k + everything.new_tensor(range(k)), "r k -> (r k)")
        own = {name: values[steps] for name, values in vars(self).items() if name != "skips"}
        return Encoding(**own, skips=[skip[images] for skip in self.skips])


def pick_images(images: Shaped[Tensor, "nk *s"], views: Int[Tensor, "m 2"], k: int) -> Shaped[Tensor, "m *s"]:
    """Images of (step, view) pairs, out of all views of all steps; the same tensor where the pairs are all, in order.

    Even a slice of all of them would be a copy in the backward pass, and one in another memory layout.
    """
    return images if len(views) == len(images) else images[views[:, 0] * k + views[:, 1]]


class HistMVNet(nn.Module):
    """RGB-D views, tool history and instruction to the next key pose.

    Args:
        config: sizes and switches.
        size: rows and columns of the images, multiples of 16.
    """

    def __init__(self, config: NetworkConfig, size: tuple[int, int]) -> None:
        super().__init__()
        if any(side % STRIDE for side in size):
            raise ValueError(
                f"images of {size[0]} x {size[1]} pixels cannot be halved four times; use multiples of {STRIDE}"
            )
        grid = (size[0] // STRIDE, size[1] // STRIDE)
        self.workspace = Workspace(config.workspace)
        self.semantics = Semantics(config.semantics)
        text_width = self.semantics.text_width
        self.rgba = RgbaFeatures(config.texture, self.semantics.image_width, text_width, config.width)
        if config.points.enabled:
            self.points = PointEncoder(config.points, self.workspace, config.width)
            self.transfuse = TransFuse(config.width, config.history.heads)
        self.view_attention: ViewAttention | EvenViews = EvenViews()
        if config.views.fusion == "attention":
            self.view_attention = ViewAttention(config.views, config.width, text_width)
        self.fuse = stack_views if config.views.fusion == "tokens" else fuse_views
        self.history = History(config.history, config.width, text_width, grid)
        self.decoder = Decoder(config.width, self.rgba.skip_channels, config.decoder, self.workspace.centre)
        self.config = config

    def forward(
        self, seen: Observation, lookback: Lookback, choice: str
    ) -> tuple[Encoding, Prediction, Int[Tensor, "m 2"], Float[Tensor, " m"]]:
        """Encode all steps and decode those asked for from the views that ``choice`` picks, or from the "best".

        Returns the encoding of the steps asked for, the decoded (step, view) pairs, the pairs, which count these steps,
        and each pair's share of its step's loss.
        """
        if not self.config.history.memory:
            seen, lookback = seen.at(lookback.decided), lookback.alone()
        encoding = self.encode(seen)
        enriched = self.remember(encoding.fused, seen.text, lookback)
        encoding = encoding.at(lookback.decided)
        if choice == "best":
            predicted, views = self.decode_best(encoding, enriched)
            return encoding, predicted, views, torch.ones_like(predicted.certainty)
        views, shares = choose_views(encoding.weights, choice)
        return encoding, self.decode(encoding, enriched, views), views, shares

    def encode(self, seen: Observation) -> Encoding:
        """Everything that depends on one step only: texture, semantics, points, fusion and view weights."""
        cells = (seen.depth.shape[-2] // POSE_STRIDE, seen.depth.shape[-1] // POSE_STRIDE)
        with full_precision(seen.depth):
            cloud = deproject(seen.depth, seen.intrinsics, seen.extrinsics)
            scaled, valid = self.workspace.normalise_map(cloud, seen.depth)
            pixels, depths = project(seen.tool, seen.intrinsics, seen.extrinsics)
            # Only the current position has the full heat of 1: without memory the others go out.
            heat = seen.heat if self.config.history.memory else seen.heat.floor()
            poses = pose_heat_map(pixels, depths, heat, cells, POSE_STRIDE)
            tool = matrix_of(seen.turn)

        meanings = self.semantics.images(seen.rgb) if seen.clip is None else seen.clip
        features, skips = self.rgba(seen.rgb, scaled, poses, meanings, seen.text)
        maps = features
        if self.config.points.enabled:
            points = self.points(cloud, seen.rgb, valid)
            maps = self.transfuse(features, self._cell_means(scaled, valid), points)
        weights = self.view_attention(maps, seen.text, valid.any(dim=(-2, -1)))
        fused = self.fuse(maps, weights)
        eyes = seen.extrinsics[..., 3]
        return Encoding(fused, maps, features, skips, cloud, valid, weights, eyes, tool, seen.opening)

    def remember(
        self, fused: Float[Tensor, "n d kh w"], text: Float[Tensor, "n c"], lookback: Lookback
    ) -> Float[Tensor, "r d kh w"]:
        """History-enriched maps of the r steps asked for, from all n."""
        last = (lookback.rows * lookback.real).amax(dim=1)
        return self.history(fused[lookback.rows], text[last], lookback.real)[lookback.asked]

    def decode(self, encoding: Encoding, enriched: Float[Tensor, "n d h w"], views: Int[Tensor, "m 2"]) -> Prediction:
        """Decode (step, view) pairs given as rows of ``views``."""
        pick = partial(pick_images, views=views, k=encoding.weights.shape[1])
        return self.decoder(
            enriched[views[:, 0]],
            pick(encoding.features.flatten(0, 1)),
            [pick(skip) for skip in encoding.skips],
            pick(encoding.cloud.flatten(0, 1)),
            pick(encoding.valid.flatten(0, 1)),
            pick(encoding.eyes.flatten(0, 1)),
            encoding.tool[views[:, 0]],
            encoding.opening[views[:, 0]],
        )

    def decode_best(
        self, encoding: Encoding, enriched: Float[Tensor, "n d kh w"]
    ) -> tuple[Prediction, Int[Tensor, "n 2"]]:
        """Decode each step as when acting: from its best view, or from all together; and the (step, view) pairs.

        The best view is that of the largest weight, or of the largest product of weight and certainty, for which all
        are decoded: the weights know how good a view usually is; that the arm hides the target in it shows in a torn
        heat map.
        """
        if self.config.views.decode == "all":
            return self._decode_together(encoding, enriched)
        if self.config.views.act == "weight":
            views = choose_views(encoding.weights, "argmax")[0]
            return self.decode(encoding, enriched, views), views
        views = choose_views(encoding.weights, "expected")[0]
        predicted = self.decode(encoding, enriched, views)
        n, k = encoding.weights.shape
        best = most_informative(encoding.weights * predicted.certainty.view(n, k))
        rows = torch.arange(n, device=best.device) * k + best
        return predicted.at(rows), views[rows]

    def _decode_together(
        self, encoding: Encoding, enriched: Float[Tensor, "n d kh w"]
    ) -> tuple[Prediction, Int[Tensor, "n 2"]]:
        """Decode all views of each step with one softmax; the view named is the one with most of the heat."""
        h = encoding.features.shape[-2]
        own = rearrange(enriched, "n d (k h) w -> n k d h w", h=h)  # k is 1 for a map that all views share
        maps = own.expand_as(encoding.features)
        predicted, shares = self.decoder.together(
            maps,
            encoding.features,
            encoding.skips,
            encoding.cloud,
            encoding.valid,
            encoding.eyes,
            encoding.tool,
            encoding.opening,
            encoding.weights,
        )
        steps = torch.arange(len(shares), device=shares.device)
        return predicted, torch.stack([steps, most_informative(shares)], dim=-1)

    def heat_cloud(
        self, encoding: Encoding, views: Int[Tensor, "m 2"]
    ) -> tuple[Float[Tensor, "m 3 y x"], Bool[Tensor, "m y x"]]:
        """World points [m] under the heat maps of decoded pairs, of the pair's view or of all of its step's views.

        Also which of them are valid.
        """
        cloud, valid = encoding.cloud, encoding.valid
        if self.config.views.decode == "all":
            return rearrange(cloud, "n k c y x -> n c (k y) x"), rearrange(valid, "n k y x -> n (k y) x")
        pick = partial(pick_images, views=views, k=encoding.weights.shape[1])
        return pick(cloud.flatten(0, 1)), pick(valid.flatten(0, 1))

    @staticmethod
    def _cell_means(scaled: Float[Tensor, "n k 3 y x"], valid: Bool[Tensor, "n k y x"]) -> Float[Tensor, "n k 3 h w"]:
        """Mean normalised position of the valid pixels of each cell; 0 where a cell has none."""
        total = reduce(scaled, "n k c (h i) (w j) -> n k c h w", "sum", i=STRIDE, j=STRIDE)
        count = reduce(valid.to(scaled.dtype), "n k (h i) (w j) -> n k 1 h w", "sum", i=STRIDE, j=STRIDE)
        return total / count.clamp_min(1)
