"""``HistMVPolicy.select_action``: the cached path decides as the whole window would, for any batch of environments."""

import logging
from typing import Any

import pytest
import torch
from tiny_policy import CAMERAS, TASK, episode, observation, stack, tiny_config, tiny_policy
from tiny_policy import window as window_of
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode

from lerobot_histmv import keys
from lerobot_histmv.geometry import canonical
from lerobot_histmv.model.history import Lookback
from lerobot_histmv.modeling_histmv import HistMVPolicy
from lerobot_histmv.windows import look_back, read_window

LONG = 5
"""Steps of an episode that fits into one window."""


def act(policy: HistMVPolicy, rows: dict[str, torch.Tensor], steps: int) -> torch.Tensor:
    """Actions (steps, 8) of one environment that shows the rows in turn."""
    policy.reset()
    return torch.cat([policy.select_action(observation(rows, step)) for step in range(steps)])


@pytest.fixture(scope="module")
def policy() -> HistMVPolicy:
    return tiny_policy(tiny_config(past_steps=LONG - 1))


def test_action_is_a_canonical_pose_in_the_workspace_and_a_gripper_command(
    policy: HistMVPolicy,
) -> None:
    actions = act(policy, episode(LONG), LONG)
    assert actions.shape == (LONG, 8)
    workspace = policy.net.workspace
    assert ((actions[:, :3] >= workspace.low) & (actions[:, :3] <= workspace.high)).all()
    torch.testing.assert_close(actions[:, 3:7].norm(dim=1), torch.ones(LONG))
    torch.testing.assert_close(actions[:, 3:7].double(), torch.from_numpy(canonical(actions[:, 3:7].numpy())))
    assert set(actions[:, 7].tolist()) <= {0.0, 1.0}


def whole_window(policy: HistMVPolicy, rows: dict[str, torch.Tensor], steps: int) -> Any:
    """Predictions for every step of the window before ``steps``, encoded and decoded at once, as training does it."""
    window = read_window(window_of(rows, steps - 1, LONG - 1), policy.config.cameras)
    assert window.real.sum() == min(steps, LONG)
    seen = window.observe(policy.net.semantics.text([TASK], torch.device("cpu")))
    with torch.no_grad():
        return policy.net(seen, Lookback.over(window.real), "best")


@pytest.mark.parametrize("steps", [1, 2, 3, LONG])
def test_cached_decisions_equal_those_of_the_whole_window(policy: HistMVPolicy, steps: int) -> None:
    rows = episode(steps, seed=steps)
    actions = act(policy, rows, steps)
    encoding, predicted, views, _ = whole_window(policy, rows, steps)
    torch.testing.assert_close(actions[:, :3], predicted.position, atol=1e-5, rtol=0)
    quaternions = torch.from_numpy(canonical(predicted.quaternion.numpy())).float()
    torch.testing.assert_close(actions[:, 3:7], quaternions, atol=1e-5, rtol=0)
    assert actions[:, 7].bool().equal(predicted.gripper > 0)
    assert policy.last_decision is not None
    torch.testing.assert_close(policy.last_decision.weights, encoding.weights[-1:], atol=1e-5, rtol=0)
    assert policy.last_decision.view.equal(views[-1:, 1])


@pytest.mark.parametrize("steps", [LONG + 1, 2 * LONG - 1, 3 * LONG])
def test_cached_decisions_equal_those_of_the_last_window_of_a_long_episode(policy: HistMVPolicy, steps: int) -> None:
    """Also the oldest map of the window shows the tool's path before it, as it does when it is remembered."""
    rows = episode(steps, seed=steps)
    action = act(policy, rows, steps)[-1]
    predicted = whole_window(policy, rows, steps)[1]
    torch.testing.assert_close(action[:3], predicted.position[-1], atol=1e-5, rtol=0)
    quaternion = torch.from_numpy(canonical(predicted.quaternion[-1:].numpy())).float()[0]
    torch.testing.assert_close(action[3:7], quaternion, atol=1e-5, rtol=0)
    assert bool(action[7]) == bool(predicted.gripper[-1] > 0)


def assert_training_learns_what_acting_does(policy: HistMVPolicy, rows: dict[str, torch.Tensor], drawn: int) -> None:
    """Of all rows around the drawn one whose history is there, and of these only."""
    actions = act(policy, rows, len(rows[keys.STATE]))
    window = read_window(window_of(rows, drawn, LONG - 1), policy.config.cameras)
    lookback, _ = look_back(window.real)
    seen = window.observe(policy.net.semantics.text([TASK], torch.device("cpu")))
    with torch.no_grad():
        predicted = policy.net(seen, lookback, "best")[1]
    learned = drawn - (LONG - 1) + lookback.decided
    assert learned.tolist() == list(range(drawn, drawn + LONG))
    torch.testing.assert_close(predicted.position, actions[learned, :3], atol=1e-5, rtol=0)
    torch.testing.assert_close(
        torch.from_numpy(canonical(predicted.quaternion)).float(), actions[learned, 3:7], atol=1e-5, rtol=0
    )
    assert (predicted.gripper > 0).float().equal(actions[learned, 7])


def test_training_learns_the_decisions_that_acting_makes(policy: HistMVPolicy) -> None:
    """Around a row amid a long episode."""
    assert_training_learns_what_acting_does(policy, episode(3 * LONG), LONG)


def test_decisions_far_beyond_the_window_stay_finite_and_forget_the_oldest_step(policy: HistMVPolicy) -> None:
    rows = episode(3 * LONG)
    other = episode(1, seed=99)
    forgotten = {key: torch.cat([other[key], values[1:]]) for key, values in rows.items()}
    first, second = act(policy, rows, 3 * LONG), act(policy, forgotten, 3 * LONG)
    assert first.isfinite().all()
    assert not torch.allclose(first[0], second[0])
    torch.testing.assert_close(first[2 * LONG :], second[2 * LONG :])


def test_batch_of_environments_equals_one_by_one(policy: HistMVPolicy) -> None:
    episodes = [episode(LONG, seed=seed) for seed in (1, 2, 3)]
    alone = torch.stack([act(policy, rows, LONG) for rows in episodes], dim=1)
    policy.reset()
    for step in range(LONG):
        together = policy.select_action(stack([observation(rows, step) for rows in episodes]))
        torch.testing.assert_close(together, alone[step], atol=1e-5, rtol=0)


def test_environments_of_a_batch_have_their_own_instructions(policy: HistMVPolicy) -> None:
    rows = episode(1)
    tasks = [TASK, "press the green button"]
    weights = []
    for batch in ([observation(rows, 0, task) for task in tasks], [observation(rows, 0, task) for task in tasks[::-1]]):
        policy.reset()
        policy.select_action(stack(batch))
        assert policy.last_decision is not None
        weights.append(policy.last_decision.weights)
    torch.testing.assert_close(weights[0], weights[1].flip(0))
    assert not torch.allclose(weights[0][0], weights[0][1], atol=1e-6)


def test_reset_forgets_everything(policy: HistMVPolicy) -> None:
    rows = episode(LONG)
    first = act(policy, rows, LONG)
    torch.testing.assert_close(act(policy, rows, LONG), first, atol=0, rtol=0)
    policy.reset()
    assert policy.last_decision is None


def test_an_instruction_is_encoded_once_until_reset(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also by a trained text tower, whose weights change between two evaluations during a training."""
    policy = tiny_policy(tiny_config(past_steps=LONG - 1))
    rows, tower = episode(3), policy.net.semantics._text_tower[0]
    heard: list[list[str]] = []
    encode = tower.text
    monkeypatch.setattr(tower, "text", lambda sentences: heard.append(sentences) or encode(sentences))
    first = act(policy, rows, 3)
    assert heard == [[TASK]]
    policy.select_action(observation(rows, 2, "press the green button"))
    assert heard == [[TASK], ["press the green button"]]
    with torch.no_grad():
        for parameter in tower.parameters():
            parameter.mul_(1.5)
    assert not torch.allclose(act(policy, rows, 3), first, atol=1e-6)
    assert heard[2:] == [[TASK]]


def test_history_changes_the_third_decision(policy: HistMVPolicy) -> None:
    rows = episode(3)
    after_two = act(policy, rows, 3)[-1]
    policy.reset()
    assert not torch.allclose(policy.select_action(observation(rows, 2))[0], after_two, atol=1e-6)


def test_another_number_of_environments_needs_a_reset(policy: HistMVPolicy) -> None:
    rows = episode(2)
    policy.reset()
    policy.select_action(observation(rows, 0))
    both = stack([observation(rows, 0), observation(rows, 1)])
    with pytest.raises(ValueError, match=r"2 environments, but the memory holds 1: call reset\(\)"):
        policy.select_action(both)
    policy.reset()
    assert policy.select_action(both).shape == (2, 8)


def test_chunk_is_the_one_action(policy: HistMVPolicy) -> None:
    rows = episode(1)
    policy.reset()
    chunk = policy.predict_action_chunk(observation(rows, 0))
    assert chunk.shape == (1, 1, 8)
    assert chunk[0].equal(act(policy, rows, 1))


def test_acting_leaves_observation_and_weights_alone(policy: HistMVPolicy) -> None:
    batch = observation(episode(1), 0)
    kept = {key: values.clone() for key, values in batch.items() if isinstance(values, torch.Tensor)}
    policy.reset()
    assert not policy.select_action(batch).requires_grad
    assert all(batch[key].equal(values) for key, values in kept.items())
    assert all(parameter.grad is None for parameter in policy.parameters())


def test_last_decision_shows_heat_over_the_chosen_view(policy: HistMVPolicy) -> None:
    rows = episode(1)
    act(policy, rows, 1)
    decision = policy.last_decision
    assert decision is not None
    heat = decision.heat.sum()
    assert 1 / len(CAMERAS) <= heat <= 1 + 1e-6, "all views share one heat map, of which this one holds most"
    camera = CAMERAS[decision.view.item()]
    assert decision.heat[0][rows[keys.depth_key(camera)][0, 0] == 0].eq(0).all()


def test_unknown_instruction_is_warned_of_once(policy: HistMVPolicy, caplog: pytest.LogCaptureFixture) -> None:
    rows = episode(2)
    policy.reset()
    with caplog.at_level(logging.WARNING):
        for step in range(2):
            policy.select_action(observation(rows, step, "dance the tango"))
        policy.reset()
        policy.select_action(observation(rows, 0, TASK))
    assert [r.getMessage() for r in caplog.records if "not in the training data" in r.getMessage()] == [
        "instruction 'dance the tango' was not in the training data; the action relies on similar ones"
    ]


def test_observation_full_of_nan_is_refused_rather_than_acted_on(policy: HistMVPolicy) -> None:
    batch = observation(episode(1), 0)
    batch[keys.rgb_key("front")] = torch.full_like(batch[keys.rgb_key("front")], torch.nan)
    policy.reset()
    with pytest.raises(ValueError, match="not finite"):
        policy.select_action(batch)
    policy.reset()


def test_scene_outside_of_the_workspace_gives_an_action(policy: HistMVPolicy) -> None:
    batch = observation(episode(1), 0)
    for camera in CAMERAS:
        batch[keys.depth_key(camera)] = batch[keys.depth_key(camera)] + 20_000
    policy.reset()
    assert policy.select_action(batch).isfinite().all()


def remembered_bytes(policy: HistMVPolicy) -> int:
    """Size of the memory of past steps: of whole storages, which a view into a larger tensor keeps alive."""
    leaves = tree_leaves(vars(policy._past))
    storages = [leaf.untyped_storage() for leaf in leaves if isinstance(leaf, torch.Tensor)]
    return sum({storage.data_ptr(): storage.nbytes() for storage in storages}.values())


def test_a_decision_late_in_a_long_episode_costs_what_the_first_with_full_memory_does(policy: HistMVPolicy) -> None:
    rows = episode(2 * LONG + 1)
    policy.reset()
    operations, remembered = [], []
    for step in range(2 * LONG + 1):
        with FlopCounterMode(display=False) as counter:
            policy.select_action(observation(rows, step))
        operations.append(counter.get_total_flops())
        remembered.append(remembered_bytes(policy))
    assert operations[0] > operations[1], "the first also encodes the instruction"
    assert 0 < operations[1] < operations[LONG - 1], "what is remembered costs something"
    assert 0 < remembered[0] < remembered[LONG - 1]
    assert set(operations[LONG - 1 :]) == {operations[LONG - 1]}
    assert set(remembered[LONG - 1 :]) == {remembered[LONG - 1]}
