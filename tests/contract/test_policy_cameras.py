"""The policy serves one camera as well as many: each learns, and acts as it learns."""

import pytest
import torch
from test_policy_acting import LONG, assert_training_learns_what_acting_does
from tiny_policy import episode, stack, tiny_config, tiny_policy, window
from tiny_scene import tiny_network

from lerobot_histmv.model.augment import AugmentConfig
from lerobot_histmv.model.config import ViewConfig

NAMES = ["front", "left", "wrist", "right", "top"]


@pytest.mark.parametrize("decode", ["all", "one"])
@pytest.mark.parametrize("k", [1, 3, 5])
def test_any_number_of_cameras_learns_and_acts_as_it_learns(k: int, decode: str) -> None:
    network = tiny_network(past_steps=LONG - 1, views=ViewConfig(decode=decode))
    augment = AugmentConfig(lost_view=1.0, card=1.0)
    policy = tiny_policy(tiny_config(NAMES[:k], network=network, augment=augment))
    rows = episode(2 * LONG, cameras=NAMES[:k])
    assert_training_learns_what_acting_does(policy, rows, LONG)

    torch.manual_seed(1)
    loss, log = policy.train()(stack([window(rows, end, LONG - 1) for end in (1, LONG)]))
    loss.backward()
    assert {name for name in log if name.startswith("view_")} == {f"view_{name}" for name in NAMES[:k]}
    for name, parameter in policy.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), name
