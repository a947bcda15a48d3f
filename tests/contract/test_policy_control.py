"""``policy.control.rate``: the policy looks once per macro step, whenever each environment's own step is over."""

import numpy as np
import pytest
import torch
from tiny_policy import episode, observation, stack, tiny_config, tiny_policy

from lerobot_histmv import keys
from lerobot_histmv.control import ControlConfig
from lerobot_histmv.modeling_histmv import HistMVPolicy
from lerobot_histmv.processor_histmv import make_histmv_pre_post_processors

STEPS = 3
POSE = slice(0, len(keys.POSE_NAMES))
CONTROL = ControlConfig(rate=20, speed=2.0, turn_rate=20.0, lead=0.5, turn_lead=4.0)
"""Fast, so that a step takes few ticks."""


@pytest.fixture(scope="module")
def macro() -> HistMVPolicy:
    return tiny_policy(tiny_config(past_steps=STEPS))


@pytest.fixture
def policy(macro: HistMVPolicy) -> HistMVPolicy:
    held = tiny_policy(tiny_config(past_steps=STEPS, control=CONTROL))
    held.load_state_dict(macro.state_dict())
    return held


class Arm:
    """A robot that is, one tick later, where it was told to be; the scene changes with every tick."""

    def __init__(self, seed: int, delay: int = 0) -> None:
        self.rows = episode(200, seed)
        self.state, self.tick, self.delay = self.rows[keys.STATE][:1].clone(), 0, delay
        self.outputs: list[torch.Tensor] = []

    def see(self) -> dict:
        return observation(self.rows, self.tick) | {keys.STATE: self.state.clone()}

    def go(self, output: torch.Tensor) -> None:
        self.outputs.append(output)
        if self.tick >= self.delay:
            self.state[0, POSE] = output
        self.tick += 1


def looks(policy: HistMVPolicy, monkeypatch: pytest.MonkeyPatch) -> list[list[int]]:
    """Filled with the environments of each decision."""
    seen: list[list[int]] = []
    decide = policy._decide
    monkeypatch.setattr(
        policy, "_decide", lambda batch, past, rows: seen.append(list(rows)) or decide(batch, past, rows)
    )
    return seen


def test_each_step_is_held_until_reached_and_equals_the_decision_of_macro_steps(macro, policy, monkeypatch) -> None:
    arm, seen, targets = Arm(seed=1), looks(policy, monkeypatch), []
    macro.reset()
    while len(seen) <= STEPS:
        batch = arm.see()
        output = policy.select_action(batch)[0]
        if len(seen) > len(targets):
            if targets:
                torch.testing.assert_close(arm.outputs[-1], targets[-1], atol=2e-4, rtol=0)
            targets.append(macro.select_action(batch)[0])
        arm.go(output)
    assert arm.tick > 3 * STEPS, "most ticks hold"


def test_environments_of_a_batch_hold_and_look_on_their_own(policy, monkeypatch) -> None:
    alone = []
    for seed, delay in ((1, 0), (2, 7), (3, 19)):
        policy.reset()
        arm = Arm(seed, delay)
        for _ in range(60):
            arm.go(policy.select_action(arm.see())[0])
        alone.append(arm)
    policy.reset()
    together, seen = [Arm(arm_seed, delay) for arm_seed, delay in ((1, 0), (2, 7), (3, 19))], looks(policy, monkeypatch)
    for _ in range(60):
        for arm, output in zip(together, policy.select_action(stack([arm.see() for arm in together])), strict=True):
            arm.go(output)
    assert {len(rows) for rows in seen} > {3}, "they get out of step"
    for one, other in zip(alone, together, strict=True):
        torch.testing.assert_close(torch.stack(one.outputs), torch.stack(other.outputs), atol=1e-4, rtol=0)
    assert policy.last_decision is not None
    assert len(policy.last_decision.view) == 3


def test_reset_drops_the_held_target(policy) -> None:
    first, other = Arm(seed=1), Arm(seed=2)
    fresh = policy.select_action(other.see())
    policy.reset()
    policy.select_action(first.see())
    policy.reset()
    assert policy.select_action(other.see()).equal(fresh)


def test_another_number_of_environments_needs_a_reset(policy) -> None:
    policy.select_action(Arm(seed=1).see())
    with pytest.raises(ValueError, match=r"call reset\(\) first"):
        policy.select_action(stack([Arm(seed=1).see(), Arm(seed=2).see()]))


@pytest.mark.parametrize("ticks", [0, 2])
@pytest.mark.parametrize("component", range(POSE.stop))
def test_a_state_with_nan_stops_the_policy_also_between_decisions(policy, ticks: int, component: int) -> None:
    arm = Arm(seed=1)
    for _ in range(ticks):
        arm.go(policy.select_action(arm.see())[0])
    bad = arm.see()
    bad[keys.STATE][0, component] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        policy.select_action(bad)


INPUTS = [keys.STATE, keys.INTRINSICS, keys.EXTRINSICS, keys.rgb_key("front"), keys.depth_key("wrist")]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("key", INPUTS)
def test_one_number_that_is_not_finite_anywhere_in_the_input_stops_at_the_door(key: str, value: float) -> None:
    before, _ = make_histmv_pre_post_processors(tiny_config())
    batch = observation(episode(1), 0)
    before(dict(batch))
    values = batch[key].clone()
    values.flatten()[values.numel() // 2] = value
    with pytest.raises(ValueError, match=f"{key} holds NaN or infinity"):
        before(batch | {key: values})


def test_a_gripper_that_is_not_finite_is_no_command(policy) -> None:
    with pytest.raises(ValueError, match="gripper"):
        policy._action(torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([torch.nan]))


@pytest.mark.parametrize("rate", [0.0, 20.0])
def test_the_box_of_the_control_confines_every_action(macro, rate: float) -> None:
    first = Arm(seed=1)
    middle = first.state[0, :3].tolist()
    box = (*(value - 0.01 for value in middle), *(value + 0.01 for value in middle))
    policy = tiny_policy(tiny_config(past_steps=STEPS, control=ControlConfig(rate=rate, box=box)))
    policy.load_state_dict(macro.state_dict())
    for _ in range(5):
        output = policy.select_action(first.see())[0]
        assert (output[:3] >= torch.tensor(box[:3]) - 1e-6).all()
        assert (output[:3] <= torch.tensor(box[3:]) + 1e-6).all()
        first.go(output)
