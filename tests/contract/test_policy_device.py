"""The policy works on whatever device it is moved to: nothing stays behind, nothing large comes back, same numbers."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers.elsewhere import DEVICE, Elsewhere, second_device
from helpers.gradients import assert_same_gradients
from helpers.networks import CHOICES, networks
from tiny_policy import episode, observation, stack, tiny_config, tiny_policy, window

from lerobot_histmv.chance import drawn_from
from lerobot_histmv.control import ControlConfig
from lerobot_histmv.model.augment import AugmentConfig
from lerobot_histmv.model.config import NetworkConfig
from lerobot_histmv.modeling_histmv import HistMVPolicy

WAITS_TO_TRAIN, WAITS_TO_ACT = 36, 6
"""Numbers that a step asks the device for: sizes of what masks pick, the loss, whether an action is finite."""
OFF = ["global vector alone", "texture alone"]


def moved(batch: dict[str, Any]) -> dict[str, Any]:
    """The batch as LeRobot's device step hands it over."""
    return {key: value.to(DEVICE) if isinstance(value, torch.Tensor) else value for key, value in batch.items()}


@pytest.fixture(scope="module")
def kinds(tmp_path_factory: pytest.TempPathFactory) -> dict[str, NetworkConfig]:
    return networks(tmp_path_factory.mktemp("weights"))


def train(policy: HistMVPolicy, batch: dict[str, Any]) -> tuple[dict[str, float], dict[str, torch.Tensor]]:
    """What one step with augmentation logs, its loss beside it, and its gradients."""
    torch.manual_seed(3)
    loss, log = policy.train()(batch)
    loss.backward()
    gradients = {name: p.grad for name, p in policy.named_parameters() if p.grad is not None}
    return log | {"loss": loss.item()}, gradients


@pytest.mark.parametrize("name", ["all", "mean", "tokens", *CHOICES, "frozen", *OFF])
def test_training_elsewhere_gives_the_same_numbers_and_gradients(name: str, kinds: dict[str, NetworkConfig]) -> None:
    """The drawn rows' numbers come back, and all that is logged at once; beside them, single numbers, and not many."""
    config = tiny_config(network=kinds[name], augment=AugmentConfig(depth_noise=0.01))
    batch = stack([window(episode(5), 4), window(episode(5), 1), window(episode(1), 0)]) | {"index": torch.arange(3)}
    expected, gradients = train(tiny_policy(config), batch)
    policy = tiny_policy(config)
    with second_device() as returned:
        policy.to(DEVICE)
        assert all(isinstance(parameter, Elsewhere) for parameter in policy.parameters())
        found, others = train(policy, moved(batch))
    assert [shape for shape in returned if shape] == [(len(batch["index"]),), (len(found) - 1,)]
    assert returned.count(()) <= WAITS_TO_TRAIN
    assert found == pytest.approx(expected, rel=1e-5)
    assert gradients.keys() == others.keys()
    assert_same_gradients([others[key].values for key in gradients], list(gradients.values()), list(gradients))


@pytest.mark.parametrize("name", ["all", "mean", "tokens", "ranked", "weight", "frozen", *OFF])
def test_acting_elsewhere_gives_the_same_actions(name: str, kinds: dict[str, NetworkConfig]) -> None:
    config, rows = tiny_config(network=kinds[name]), episode(3)
    here = tiny_policy(config)
    expected = [here.select_action(observation(rows, step)) for step in range(3)]
    policy = tiny_policy(config)
    with second_device() as returned:
        policy.to(DEVICE)
        for step in range(3):
            action = policy.select_action(moved(observation(rows, step)))
            assert isinstance(action, Elsewhere)
            torch.testing.assert_close(action.values, expected[step])
    assert set(returned) == {()}, "no tensor comes back"
    assert len(returned) <= len(expected) * WAITS_TO_ACT


def test_a_target_is_held_elsewhere_as_here() -> None:
    """In a loop of 20 Hz the held target leaves the device as eight numbers per robot, and nothing else does."""
    config, rows = tiny_config(control=ControlConfig(rate=20)), episode(1)
    here, policy = tiny_policy(config), tiny_policy(config)
    expected = [here.select_action(observation(rows, 0)) for _ in range(3)]
    with second_device() as returned:
        policy.to(DEVICE)
        for one in expected:
            action = policy.select_action(moved(observation(rows, 0)))
            assert isinstance(action, Elsewhere)
            torch.testing.assert_close(action.values, one)
    assert all(torch.Size(shape).numel() <= 8 for shape in returned), returned


def test_second_device_refuses_what_a_gpu_refuses() -> None:
    with second_device() as returned:
        there = torch.arange(3, device=DEVICE)
        refused: list[Callable[[], Any]] = [
            lambda: there + torch.arange(3),
            lambda: torch.arange(3)[there],
            lambda: torch.zeros(3, dtype=torch.long).index_put((there,), there),
            lambda: there.index_put((torch.tensor([2]),), torch.tensor([5])),
        ]
        for operation in refused:
            with pytest.raises(RuntimeError, match="two devices"):
                operation()
        there[torch.tensor([2])] += 1
    assert returned == []
    assert there.values.tolist() == [0, 1, 3]


def test_second_device_notes_all_that_comes_back() -> None:
    with second_device() as returned:
        there = torch.arange(3, device=DEVICE)
        assert there[1:].tolist() == there[1:].cpu().tolist() == [1, 2]
        assert returned == [(2,), (2,)]
        asked: list[Callable[[], Any]] = [
            lambda: there[1].item(),
            lambda: bool(there[1] > 0),
            lambda: there.equal(there + 1),
            lambda: (there > 0).nonzero(),
            lambda: there[there > 0],
            lambda: there.repeat_interleave(there),
        ]
        for number in asked:
            returned.clear()
            number()
            assert returned == [()]


def test_random_numbers_follow_from_the_rows_and_leave_no_trace() -> None:
    def draw(*rows: int) -> float:
        with drawn_from(torch.tensor(rows)):
            return torch.rand(()).item()

    torch.manual_seed(5)
    expected = torch.rand(2).tolist()
    torch.manual_seed(5)
    first, found = draw(7, 11), torch.rand(()).item()
    assert [found, torch.rand(()).item()] == expected
    assert draw(7, 11) == first
    assert len({first, draw(11, 7), draw(7, 13), draw(7), *expected}) == 6
    with drawn_from(None):
        torch.manual_seed(5)
    assert torch.rand(2).tolist() == expected
