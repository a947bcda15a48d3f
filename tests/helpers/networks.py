"""Tiny networks of every kind that the configuration knows."""

from pathlib import Path

from tiny_scene import tiny_network
from tiny_weights import clip_file

from lerobot_histmv.model.config import (
    DecoderConfig,
    HistoryConfig,
    NetworkConfig,
    PointsConfig,
    SemanticsConfig,
    TextureConfig,
    ViewConfig,
)

CHOICES = ["argmax", "sampled", "expected", "ranked"]
"""Views decoded in training where one view decides."""


def networks(folder: Path) -> dict[str, NetworkConfig]:
    """Every way to fuse and to choose views; frozen towers, which lie outside of the policy's module tree; parts off.

    "global vector alone" has neither texture nor points nor history nor what the paper's decoder lacks, "texture alone"
    no image tower.
    """
    weights = clip_file(folder / "clip.pt", seed=2)
    return {
        "all": tiny_network(),
        **{choice: tiny_network(views=ViewConfig(decode="one", train_choice=choice)) for choice in CHOICES},
        **{fusion: tiny_network(views=ViewConfig(fusion=fusion)) for fusion in ("mean", "tokens")},
        "weight": tiny_network(views=ViewConfig(decode="one", act="weight")),
        "frozen": tiny_network(semantics=SemanticsConfig(clip_pretrained=str(weights))),
        "global vector alone": tiny_network(
            texture=TextureConfig(encoder="none", widths=(4, 4, 8, 8), neck=4),
            points=PointsConfig(enabled=False),
            history=HistoryConfig(enabled=False, past_steps=2, layers=2, heads=2),
            decoder=DecoderConfig(opening=False, tool_frame=False, ray=False, local=False, peak=False),
        ),
        "texture alone": tiny_network(semantics=SemanticsConfig(image="none")),
    }
