"""RGB-A features: PANet texture, semantic vector and projected tool poses of every view (paper 3.2)."""

from typing import Any

import timm
import torch
from einops import rearrange, repeat
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from lerobot_histmv.model.config import TextureConfig
from lerobot_histmv.model.layers import ConvBlock, Modulation, upsample_to

STRIDE = 16
"""Pixels per cell of the fused feature map: 128 x 128 pixels give an 8 x 8 map."""

POSE_STRIDE = 8
"""Pixels per cell of the level that carries texture, pose and semantics before pooling."""


class PlainBackbone(nn.Module):
    """Four stages that halve the map: features at strides 2, 4, 8 and 16."""

    def __init__(self, channels_in: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.channels = list(widths)
        pairs = zip((channels_in, *widths[:-1]), widths, strict=True)
        self.stages = nn.ModuleList(ConvBlock(a, b, stride=2, normalise=i > 0) for i, (a, b) in enumerate(pairs))

    def forward(self, maps: Float[Tensor, "n c y x"]) -> list[Float[Tensor, "n _ _ _"]]:
        """Maps at strides 2, 4, 8 and 16, fine to coarse."""
        levels = []
        for stage in self.stages:
            maps = stage(maps)
            levels.append(maps)
        return levels


class TimmBackbone(nn.Module):
    """Any timm model with ``features_only``; keeps its levels at strides 2, 4, 8 and 16."""

    def __init__(self, name: str, channels_in: int, pretrained: bool) -> None:
        super().__init__()
        if not timm.is_model(name):
            raise ValueError(f"texture.backbone={name!r} is neither 'plain' nor a model that timm knows")
        probe: Any = timm.create_model(name, features_only=True, in_chans=channels_in, pretrained=False)
        strides = probe.feature_info.reduction()
        missing = {2, 4, 8, 16} - set(strides)
        if missing:
            raise ValueError(f"texture.backbone={name!r} has strides {strides}, but 2, 4, 8 and 16 are needed")
        indices = [strides.index(stride) for stride in (2, 4, 8, 16)]
        body: Any = timm.create_model(
            name, features_only=True, in_chans=channels_in, pretrained=pretrained, out_indices=indices
        )
        self.body = body
        self.channels: list[int] = body.feature_info.channels()

    def forward(self, maps: Float[Tensor, "n c y x"]) -> list[Float[Tensor, "n _ _ _"]]:
        """Maps at strides 2, 4, 8 and 16, fine to coarse."""
        return list(self.body(maps))


class PANet(nn.Module):
    """Path aggregation neck: top-down, then bottom-up, over strides 4, 8 and 16 (Liu et al. 2018, fig. 1)."""

    def __init__(self, channels: list[int], width: int) -> None:
        super().__init__()
        self.lateral = nn.ModuleList(nn.Conv2d(c, width, 1) for c in channels)
        self.top_down = nn.ModuleList(ConvBlock(width, width) for _ in channels[:-1])
        self.shrink = nn.ModuleList(ConvBlock(width, width, stride=2) for _ in channels[:-1])
        self.bottom_up = nn.ModuleList(ConvBlock(width, width) for _ in channels[:-1])

    def forward(self, levels: list[Float[Tensor, "n _ _ _"]]) -> list[Float[Tensor, "n _ _ _"]]:
        """Aggregated maps of ``width`` channels, fine to coarse, each the size of its input."""
        maps = [lateral(level) for lateral, level in zip(self.lateral, levels, strict=True)]
        for i in reversed(range(len(maps) - 1)):
            maps[i] = self.top_down[i](maps[i] + upsample_to(maps[i + 1], maps[i]))
        for i in range(len(maps) - 1):
            maps[i + 1] = self.bottom_up[i](maps[i + 1] + self.shrink[i](maps[i]))
        return maps


class NoTexture(nn.Module):
    """Stands where a backbone is, without one: of texture and pose the levels have the pose alone."""

    channels = (1, 1, 1, 1)

    def forward(self, poses: Float[Tensor, "n 1 y8 x8"]) -> list[Float[Tensor, "n 1 _ _"]]:
        """The poses' map at strides 2, 4, 8 and 16."""
        coarse = functional.avg_pool2d(poses, 2)
        return [*(functional.interpolate(poses, scale_factor=times, mode="nearest") for times in (4, 2)), poses, coarse]


class RgbaFeatures(nn.Module):
    """Texture pyramid and RGB-A feature map FR of every view.

    Args:
        config: texture part of the network's configuration.
        semantic_width: length of the global semantic vector; 0 for none.
        text_width: length of the instruction vector.
        width: d, channels of FR.
    """

    def __init__(self, config: TextureConfig, semantic_width: int, text_width: int, width: int) -> None:
        super().__init__()
        self.use_xyz = config.use_xyz
        self.backbone = self._make_backbone(config)
        language = config.language and config.encoder != "none"
        channels = list(self.backbone.channels)
        self.listen = nn.ModuleList(Modulation(count, text_width) for count in (channels if language else []))
        if config.encoder == "panet":
            self.neck: nn.Module = PANet(channels[1:], config.neck)
            channels = [channels[0], *[config.neck] * 3]
        else:
            self.neck = nn.Identity()
        self.skip_channels = channels
        # Without a semantic vector an empty one is joined.
        expanded = config.neck if semantic_width else 0
        self.semantic = nn.Linear(semantic_width, expanded) if semantic_width else nn.Identity()
        self.fuse = ConvBlock(channels[2] + 1 + expanded, width // 2)
        self.refine = ConvBlock(width // 2 + channels[3], width)

    @staticmethod
    def _make_backbone(config: TextureConfig) -> PlainBackbone | TimmBackbone | NoTexture:
        channels_in = 6 if config.use_xyz else 3
        if config.encoder == "none":
            return NoTexture()
        if config.backbone == "plain":
            return PlainBackbone(channels_in, config.widths)
        return TimmBackbone(config.backbone, channels_in, config.pretrained)

    def forward(
        self,
        rgb: Float[Tensor, "n k 3 y x"],
        xyz: Float[Tensor, "n k 3 y x"],
        poses: Float[Tensor, "n k 1 y8 x8"],
        semantics: Float[Tensor, "n k c"],
        text: Float[Tensor, "n e"],
    ) -> tuple[Float[Tensor, "n k d y16 x16"], list[Float[Tensor, "nk _ _ _"]]]:
        """FR of every view and the PANet levels (strides 2, 4, 8, 16) of all n * k images for the decoder's skips.

        Args:
            rgb: colours in [0, 1].
            xyz: world coordinates scaled to about [-1, 1], 0 where depth is invalid.
            poses: thermal map of projected tool positions at stride 8.
            semantics: global vector of each view.
            text: instruction vector.
        """
        k = rgb.shape[1]
        first, *rest = self._listened(self._texture(rgb, xyz, poses), text)
        levels = self.neck(rest)
        texture, coarse = levels[1], levels[2]
        expanded = self.semantic(rearrange(semantics, "n k c -> (n k) c"))
        expanded = repeat(expanded, "n c -> n c y x", y=texture.shape[2], x=texture.shape[3])
        joined = torch.cat([texture, rearrange(poses, "n k c y x -> (n k) c y x"), expanded], dim=1)
        pooled = functional.avg_pool2d(self.fuse(joined), 2)
        features = self.refine(torch.cat([pooled, coarse], dim=1))
        return rearrange(features, "(n k) c y x -> n k c y x", k=k), [first, *levels]

    def _texture(
        self, rgb: Float[Tensor, "n k 3 y x"], xyz: Float[Tensor, "n k 3 y x"], poses: Float[Tensor, "n k 1 y8 x8"]
    ) -> list[Float[Tensor, "nk _ _ _"]]:
        """The backbone's levels at strides 2, 4, 8 and 16."""
        if isinstance(self.backbone, NoTexture):
            return self.backbone(rearrange(poses, "n k c y x -> (n k) c y x"))
        flat = rearrange(rgb, "n k c y x -> (n k) c y x") * 2 - 1
        if self.use_xyz:
            flat = torch.cat([flat, rearrange(xyz, "n k c y x -> (n k) c y x")], dim=1)
        return self.backbone(flat.contiguous(memory_format=torch.channels_last))

    def _listened(
        self, levels: list[Float[Tensor, "nk _ _ _"]], text: Float[Tensor, "n e"]
    ) -> list[Float[Tensor, "nk _ _ _"]]:
        """Levels whose channels the instruction has weighted: which texture matters depends on what is asked for."""
        if not len(self.listen):
            return levels
        each = text.repeat_interleave(len(levels[0]) // len(text), dim=0)
        return [listen(level, each) for listen, level in zip(self.listen, levels, strict=True)]
