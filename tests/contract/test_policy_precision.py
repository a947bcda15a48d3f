"""Half precision, another memory layout and a compiler change how the policy computes, not what."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.gradients import assert_same_gradients
from helpers.networks import networks
from helpers.ranks import in_ranks
from tiny_policy import episode, observation, stack, tiny_config, tiny_policy, window

from lerobot_histmv.modeling_histmv import HistMVPolicy


def step(policy: HistMVPolicy) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Loss and gradients of a training step."""
    batch = stack([window(episode(5), 4), window(episode(5), 1), window(episode(1), 0)])
    torch.manual_seed(3)
    loss, _ = policy.train()(batch)
    loss.backward()
    return loss, [p.grad for p in policy.parameters() if p.grad is not None]


def actions(policy: HistMVPolicy) -> torch.Tensor:
    rows = episode(3)
    return torch.cat([policy.select_action(observation(rows, at)) for at in range(3)])


KINDS = ["all", "mean", "tokens", "ranked", "frozen"]
"""Networks in which rounding cannot make another view act."""


@pytest.mark.parametrize("kind", KINDS)
def test_bfloat16_keeps_the_loss_and_the_direction_of_the_gradient(kind: str, tmp_path: Path) -> None:
    """Bounds are about twice what was measured: the loss within 0.22 %, the cosine from 0.963 up."""
    config = tiny_config(network=networks(tmp_path)[kind])
    expected, gradient = step(tiny_policy(config))
    with torch.autocast("cpu", torch.bfloat16):
        loss, found = step(tiny_policy(config))
    assert {loss.dtype, *(one.dtype for one in found)} == {torch.float32}
    torch.testing.assert_close(loss, expected, rtol=0.005, atol=0)
    both = (torch.cat([one.flatten() for one in gradients]) for gradients in (found, gradient))
    assert 0.925 < torch.cosine_similarity(*both, dim=0) < 1 - 1e-6, "1 would mean that nothing was rounded"


@pytest.mark.parametrize("kind", KINDS)
def test_bfloat16_moves_no_action_by_millimetres(kind: str, tmp_path: Path) -> None:
    """Bounds are about twice what was measured, with AVX-512 and AVX2: 0.6 mm, 0.0045 in a quaternion's components.

    The seed keeps all networks away from three edges of an untrained one, where the least rounding decides: which of
    two equal peaks is the higher, which sign of a quaternion is the nearer, and whether the gripper opens.
    """
    config = tiny_config(network=networks(tmp_path)[kind])
    expected = actions(tiny_policy(config, seed=2))
    with torch.autocast("cpu", torch.bfloat16):
        found = actions(tiny_policy(config, seed=2))
    assert found.dtype == torch.float32
    assert 0 < (found - expected)[:, :3].norm(dim=1).max() < 1.2e-3, "0 would mean that nothing was rounded"
    torch.testing.assert_close(found[:, 3:7], expected[:, 3:7], atol=0.01, rtol=0)
    assert found[:, 7].equal(expected[:, 7])


def test_bfloat16_leaves_geometry_alone() -> None:
    """Half precision would round a metre to four millimetres."""
    policy = tiny_policy()
    seen: list[torch.Tensor] = []
    encode: Callable[..., Any] = policy.net.encode

    def listen(observed: Any) -> Any:
        encoding = encode(observed)
        seen.append(encoding.cloud)
        return encoding

    policy.net.encode = listen  # type: ignore[method-assign]
    actions(policy)
    policy.reset()
    with torch.autocast("cpu", torch.bfloat16):
        acted = actions(policy)
    assert all(plain.equal(half) for plain, half in zip(seen[:3], seen[3:], strict=True))
    assert acted.dtype == torch.float32
    torch.testing.assert_close(acted[:, 3:7].norm(dim=-1), torch.ones(3))


def test_channels_last_weights_give_the_same_loss_and_gradients() -> None:
    expected, gradient = step(tiny_policy())
    loss, found = step(tiny_policy().to(memory_format=torch.channels_last))  # type: ignore[call-overload]
    torch.testing.assert_close(loss, expected)
    assert_same_gradients(found, gradient)


def compiled(_: int, loaded: Path) -> None:
    """Traced and differentiated by the compiler, without its code generator, which would take minutes."""
    policy = tiny_policy()
    policy.net.rgba.compile(backend="aot_eager", fullgraph=True)
    policy.net.history.compile(backend="aot_eager", fullgraph=True)
    torch.save(step(policy), loaded)


@pytest.mark.slow
def test_compiled_parts_give_the_same_loss_and_gradients(tmp_path: Path) -> None:
    """In a process of its own: the compiler cannot trace the checks of array shapes that tests run with."""
    in_ranks(1, tmp_path / "log", compiled, tmp_path / "step.pt")
    expected, gradient = step(tiny_policy())
    loss, found = torch.load(tmp_path / "step.pt")
    torch.testing.assert_close(loss, expected)
    assert_same_gradients(found, gradient)
