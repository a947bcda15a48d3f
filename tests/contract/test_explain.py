"""Records of decisions: their numbers are those of the policy that acted."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch
from helpers.explaining import CHOOSING, STEPS, act, policy_choosing
from tiny_policy import TASK, episode, observation, tiny_policy, window

from dataset_tools.explain.attention import attention_weights, forgotten, step_shares
from dataset_tools.explain.episode import Explained
from dataset_tools.explain.watch import Record, watched
from lerobot_histmv import keys
from lerobot_histmv.control import ControlConfig
from lerobot_histmv.model.history import Lookback
from lerobot_histmv.modeling_histmv import HistMVPolicy
from lerobot_histmv.windows import read_window


@pytest.fixture(scope="module", params=CHOOSING)
def policy(request: pytest.FixtureRequest) -> HistMVPolicy:
    return policy_choosing(request.param)


@pytest.fixture(scope="module")
def acted(policy: HistMVPolicy) -> tuple[torch.Tensor, list[Record]]:
    return act(policy)


def test_watching_changes_nothing_and_leaves_nothing(
    policy: HistMVPolicy, acted: tuple[torch.Tensor, list[Record]]
) -> None:
    policy.reset()
    actions = torch.cat([policy.select_action(observation(episode(STEPS), step)) for step in range(STEPS)])
    assert actions.equal(acted[0])
    assert "_decide" not in vars(policy)
    assert not any(module._forward_hooks or module._forward_pre_hooks for module in policy.modules())


def test_a_decision_held_over_ticks_is_recorded_once(policy: HistMVPolicy) -> None:
    held = tiny_policy(dataclasses.replace(policy.config, control=ControlConfig(rate=20)))
    held.load_state_dict(policy.state_dict())
    batch = observation(episode(1), 0)
    policy.reset()
    with watched(held) as records:
        outputs = [held.select_action(batch) for _ in range(3)]
    (record,) = records
    np.testing.assert_allclose(record.action, policy.select_action(batch)[0], atol=1e-6)
    assert not torch.allclose(outputs[0][0, :3], torch.from_numpy(record.action[:3]), atol=1e-3)


def test_records_hold_what_the_policy_decided(policy: HistMVPolicy) -> None:
    rows = episode(STEPS)
    policy.reset()
    with watched(policy) as records:
        for step in range(STEPS):
            action = policy.select_action(observation(rows, step))
            record, decision = records[-1], policy.last_decision
            assert decision is not None
            np.testing.assert_array_equal(record.action, action[0])
            np.testing.assert_array_equal(record.weights, decision.weights[0])
            assert record.chosen == decision.view[0]
            together = policy.config.network.views.decode == "all"
            heat = decision.heat[0].numpy()
            np.testing.assert_allclose(record.heat[record.chosen], heat / heat.sum(), rtol=1e-4, atol=1e-9)
            workspace = policy.net.workspace
            limited = np.clip(record.targets[record.chosen], workspace.low.numpy(), workspace.high.numpy())
            assert together or record.action[:3] == pytest.approx(limited, abs=1e-6)
            assert (record.opening > 0.5) == bool(action[0, 7])
            np.testing.assert_allclose(record.tool, rows[keys.STATE][step, :3])


def test_shares_are_shares(acted: tuple[torch.Tensor, list[Record]]) -> None:
    for step, record in enumerate(acted[1]):
        assert record.weights.sum() == pytest.approx(1, abs=1e-6)
        assert record.chosen == record.scores.argmax()
        expected = {
            "share of the heat": record.support,
            "weight x certainty": record.weights * record.support,
            "weight": record.weights,
        }
        np.testing.assert_allclose(record.scores, expected[record.choosing.score])
        assert record.choosing.support == "certainty" or record.support.sum() == pytest.approx(1, abs=1e-5)
        np.testing.assert_allclose(record.heat.sum(axis=(1, 2)), 1, atol=1e-5)
        assert record.attention.shape == (2, step + 1)
        np.testing.assert_allclose(record.attention.sum(axis=1), 1, atol=1e-5)
        np.testing.assert_allclose(np.diagonal(record.information), 1)
        for index, view in enumerate(record.views.values()):
            assert view.depth is not None
            assert (record.heat[index][view.depth == 0] == 0).all()


def test_the_first_two_decisions_have_no_past(acted: tuple[torch.Tensor, list[Record]]) -> None:
    """The paper's rule: "where the current step is less than two, the strategy relies solely on the current"."""
    second, third = acted[1][1], acted[1][2]
    np.testing.assert_allclose(second.attention, [[0, 1]] * 2, atol=1e-6)
    assert second.memory == second.influence[0] == 0
    assert third.memory > 0
    assert (third.influence > 0).all()


def test_records_equal_the_whole_window(policy: HistMVPolicy, acted: tuple[torch.Tensor, list[Record]]) -> None:
    """Attention and information of an episode that is encoded at once, as training does it."""
    explained = Explained("episode", TASK, acted[1])
    whole = read_window(window(episode(STEPS), STEPS - 1, STEPS - 1), policy.config.cameras)
    seen = whole.observe(policy.net.semantics.text([TASK], torch.device("cpu")))
    shares = []
    hooks = [
        layer.register_forward_hook(
            lambda layer, inputs, _: shares.append(step_shares(attention_weights(layer, *inputs), STEPS)[0])
        )
        for layer in policy.net.history.layers
    ]
    with torch.no_grad():
        encoding, predicted, *_ = policy.net(seen, Lookback.over(whole.real[:, :STEPS]), "best")
        redundancy = policy.net.view_attention.redundancy(encoding.maps, encoding.weights)
    for hook in hooks:
        hook.remove()
    for layer, expected in enumerate(shares):
        found = explained.over_steps([one.attention[layer] for one in acted[1]])
        np.testing.assert_allclose(np.nan_to_num(found), expected, atol=1e-5)
    np.testing.assert_allclose(explained.actions[:, :3], predicted.position, atol=1e-5)
    own = np.einsum("ni,nij,nj->n", explained.weights, explained.information, explained.weights)
    np.testing.assert_allclose(own, redundancy, atol=1e-5)


def test_memory_and_influence_tell_how_far_the_target_moves_without_those_steps(
    policy: HistMVPolicy, acted: tuple[torch.Tensor, list[Record]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last step is decided again and again, each time with other steps out of its sight."""
    rows, past, positions = episode(STEPS), range(STEPS - 1), []
    decode = policy.net.decode_best

    def noting(*inputs: Any) -> Any:
        found = decode(*inputs)
        positions.append(found[0].position[0])
        return found

    def target(hidden: Sequence[int]) -> torch.Tensor:
        policy.reset()
        for step in past:
            policy.select_action(observation(rows, step))
        with forgotten(policy.net.history, hidden, STEPS):
            policy.select_action(observation(rows, STEPS - 1))
        return positions[-1]

    monkeypatch.setattr(policy.net, "decode_best", noting)
    usual, alone, without = target([]), target(past), torch.stack([target([step]) for step in past])
    record = acted[1][-1]
    assert record.memory == pytest.approx(float((alone - usual).norm()), abs=1e-6)
    moved = (without - usual).norm(dim=1)
    assert moved.unique().shape == moved.shape
    np.testing.assert_allclose(record.influence, moved, atol=1e-6)
