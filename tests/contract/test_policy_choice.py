"""The loss of a policy that decodes one view: what each view's decoding weighs, and what that teaches the weights."""

from typing import Any

import pytest
import torch
from helpers.gradients import assert_same_gradients
from helpers.networks import CHOICES
from tiny_policy import episode, stack, tiny_config, tiny_policy, window
from tiny_scene import tiny_network
from torch import Tensor

from lerobot_histmv import keys
from lerobot_histmv.model.config import LossConfig, ViewConfig
from lerobot_histmv.model.losses import action_losses
from lerobot_histmv.model.view_attention import EXPLORE, RANKING_TEMPERATURE
from lerobot_histmv.modeling_histmv import HistMVPolicy
from lerobot_histmv.windows import look_back, read_window

CAMERAS = ["front", "left", "wrist"]


def policy_of(train_choice: str, **loss: float) -> HistMVPolicy:
    """A policy in training whose loss has the terms of actions and heat maps, and those given."""
    network = tiny_network(views=ViewConfig(decode="one", train_choice=train_choice))
    weights = LossConfig(**{"mutual_information": 0.0, "choice": 0.0, "paraphrase": 0.0} | loss)
    return tiny_policy(tiny_config(CAMERAS, network=network, loss=weights)).train()


def batch_with_a_view_that_shows_nothing() -> dict[str, Any]:
    rows = episode(5, cameras=CAMERAS)
    rows[keys.depth_key("left")][1:3] = 0
    return stack([window(rows, 4), window(rows, 1)])


def share(choice: str, weights: Tensor, losses: Tensor) -> Tensor:
    """What each decoding of one step counts: ``weights`` and action ``losses`` of the views that show something."""
    even = torch.full_like(weights, 1 / len(weights))
    if choice == "expected":
        return (1 - EXPLORE) * weights + EXPLORE * even
    if choice == "ranked":
        good = (-losses / (RANKING_TEMPERATURE * losses.mean())).exp()
        return ((1 - EXPLORE) * good / good.sum() + EXPLORE * even).detach()
    return torch.ones(1)


def plain_loss(policy: HistMVPolicy, batch: dict[str, Any], given: Any, found: Any) -> Tensor:
    """Step by step, from what went into the network and what came out."""
    (_, lookback, choice), (encoding, predicted, views, _) = given, found
    read = read_window(batch, CAMERAS)
    target = read.target[lookback.decided]
    steps, seen_by = views.unbind(1)
    cloud, valid = encoding.cloud[steps, seen_by], encoding.valid[steps, seen_by]
    terms = action_losses(predicted, target[steps], cloud, valid, policy.config.loss)
    acted, heat = (
        terms["position"] + terms["rotation"] + terms["gripper"],
        policy.config.loss.heatmap * terms["heatmap"],
    )
    total = torch.zeros(())
    for step, row in enumerate(look_back(read.real)[1]):
        own = (steps == step) & (encoding.weights[steps, seen_by] > 0)
        each = share(choice, encoding.weights[step, seen_by[own]], acted[own])
        total = total + row * (each @ acted[own] + each.detach() @ heat[own])
    return total / len(read.real)


@pytest.mark.parametrize("choice", CHOICES)
def test_loss_and_gradients_are_those_of_each_view_s_share(choice: str) -> None:
    """Shares of "expected" carry a gradient to the weights; heat map terms teach no weights."""
    policy, batch, calls = policy_of(choice), batch_with_a_view_that_shows_nothing(), []
    policy.net.register_forward_hook(lambda _, given, found: calls.append((given, found)))
    torch.manual_seed(1)
    loss, _ = policy(batch)
    ((given, found),) = calls
    assert found[0].weights.eq(0).any(), "some view shows nothing"
    expected = plain_loss(policy, batch, given, found)
    torch.testing.assert_close(loss, expected)
    names, trained = zip(*((name, p) for name, p in policy.named_parameters() if p.requires_grad), strict=True)
    gradients, plain = (
        torch.autograd.grad(value, trained, retain_graph=True, materialize_grads=True) for value in (loss, expected)
    )
    assert_same_gradients(gradients, plain, names)


@pytest.mark.parametrize("choice", ["ranked", "sampled"])
def test_the_term_that_judges_views_teaches_their_weights_alone(choice: str) -> None:
    gradients = []
    for weight in (0.0, 0.5):
        policy = policy_of(choice, choice=weight)
        torch.manual_seed(1)
        policy(batch_with_a_view_that_shows_nothing())[0].backward()
        gradients.append({name: p.grad for name, p in policy.named_parameters() if p.grad is not None})
    moved = {name for name, gradient in gradients[0].items() if not torch.allclose(gradient, gradients[1][name])}
    assert moved
    assert all(name.startswith("net.view_attention.score") for name in moved)
