"""Configuration of the network: what cannot work is refused when it is written down, by name and value."""

from collections.abc import Callable
from typing import Any

import pytest
from tiny_scene import SIZE, tiny_network

from lerobot_histmv.model.config import (
    HistoryConfig,
    LossConfig,
    NetworkConfig,
    PointsConfig,
    SemanticsConfig,
    TextureConfig,
    ViewConfig,
)
from lerobot_histmv.model.network import HistMVNet


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: TextureConfig(widths=(4, 8, 16)), r"texture\.widths=\(4, 8, 16\)"),
        (lambda: SemanticsConfig(text="bert"), r"semantics\.text='bert'.*'clip', 'minilm'"),
        (lambda: PointsConfig(centres=(7, 5), radii=(0.1,)), r"points\.centres=\(7, 5\).*points\.radii=\(0\.1,\)"),
        (lambda: ViewConfig(mi_loss="minus"), r"views\.mi_loss='minus'.*'nmi', 'text', 'literal'"),
        (lambda: ViewConfig(train_choice="best"), r"views\.train_choice='best'.*'argmax', 'sampled', 'expected'"),
        (lambda: ViewConfig(fusion="sum"), r"views\.fusion='sum'.*'attention', 'mean', 'tokens'"),
        (lambda: ViewConfig(decode="some"), r"views\.decode='some'.*'one', 'all'"),
        (lambda: ViewConfig(act="luck"), r"views\.act='luck'.*'certainty', 'weight'"),
        (
            lambda: ViewConfig(fusion="mean", decode="one"),
            r"views\.decode='one'.*views\.fusion='mean'.*views\.decode='all'",
        ),
        (lambda: ViewConfig(act="weight"), r"views\.act='weight'.*views\.decode='one'"),
        (lambda: ViewConfig(train_choice="argmax"), r"views\.train_choice='argmax'.*views\.decode='one'"),
        (lambda: ViewConfig(fusion="tokens", decode="one"), r"views\.decode='one'.*views\.fusion='tokens'"),
        (lambda: TextureConfig(encoder="unet"), r"texture\.encoder='unet'.*'panet', 'backbone', 'none'"),
        (lambda: SemanticsConfig(image="dino"), r"semantics\.image='dino'.*'clip', 'r3m', 'none'"),
        (lambda: SemanticsConfig(image="r3m"), r"semantics\.image='r3m'.*semantics\.r3m_pretrained=None"),
        (lambda: SemanticsConfig(r3m_pretrained="a.pt"), r"semantics\.image='clip'.*r3m_pretrained='a\.pt'"),
        (lambda: HistoryConfig(past_steps=-1), r"history\.past_steps=-1"),
        (
            lambda: NetworkConfig(texture=TextureConfig(encoder="none"), semantics=SemanticsConfig(image="none")),
            r"texture\.encoder='none' and semantics\.image='none'",
        ),
        (lambda: ViewConfig(fusion="mean", mi_gradient=True), r"views\.mi_gradient=True.*views\.fusion='mean'"),
        (lambda: ViewConfig(fusion="tokens", mi_loss="text"), r"views\.mi_loss='text'.*views\.fusion='tokens'"),
        (lambda: LossConfig(approach=(0.0, 0.0, 2.0)), r"loss\.approach=\(0\.0, 0\.0, 2\.0\).*unit vector"),
        (lambda: LossConfig(approach=(0.0, 1.0)), r"loss\.approach=\(0\.0, 1\.0\).*three numbers"),
        (lambda: LossConfig(gripper="l1"), r"loss\.gripper='l1'.*'bce', 'mse'"),
        (lambda: NetworkConfig(width=30), r"width \(30\).*history\.heads \(4\)"),
        (lambda: NetworkConfig(workspace=(0.0, 0.0, 0.0, 1.0, -1.0, 1.0)), r"workspace=.*lower < upper"),
        (lambda: NetworkConfig(workspace=(0.0, 0.0, 0.0, 1.0)), r"workspace="),
    ],
    ids=[
        "widths",
        "text tower",
        "point levels",
        "form of loss",
        "choice of view",
        "fusion",
        "decoding",
        "acting view",
        "no weights to choose a view by",
        "acting view without choice",
        "training choice without choice",
        "no weights beside tokens",
        "encoder",
        "image tower",
        "r3m without a file",
        "a file without r3m",
        "negative history",
        "no colours at all",
        "gradient of nothing",
        "information of nothing",
        "no direction",
        "flat world",
        "gripper",
        "heads",
        "box",
        "corners",
    ],
)
def test_impossible_settings_are_refused_with_what_is_accepted(make: Callable[[], Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        make()


@pytest.mark.parametrize("size", [(32, 40), (31, 32)])
def test_images_that_cannot_be_halved_four_times_are_refused(size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=rf"{size[0]} x {size[1]} pixels.*multiples of"):
        HistMVNet(tiny_network(), size)


def test_every_setting_of_the_tiny_network_differs_from_the_default_only_in_size() -> None:
    assert tiny_network().history.skip_first == HistoryConfig().skip_first
    assert all(side % 16 == 0 for side in SIZE)
