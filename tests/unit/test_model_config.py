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
