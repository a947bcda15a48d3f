"""A held decision: outputs keep to box and speeds whatever is decided and measured, in a macro step's order."""

from dataclasses import replace
from itertools import groupby, pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lerobot_histmv.control import ControlConfig, HeldStep
from lerobot_histmv.geometry import angle_between, canonical
from lerobot_histmv.motion import timed_path, top_down

LOW, HIGH = np.array([0.1, -0.5, 0.0]), np.array([0.8, 0.5, 0.7])
CONFIG = ControlConfig(rate=20)
GRIPPER_TICKS, SETTLE_TICKS, TIMEOUT_TICKS = 10, 2, 20
START = np.array([0.3, 0.1, 0.4, 1, 0, 0, 0, 1.0])
GOAL = np.array([0.5, -0.2, 0.1, np.cos(0.4), 0, 0, np.sin(0.4), 0.0])

FEW = settings(max_examples=60, deadline=None, derandomize=True)
configs = st.builds(
    ControlConfig,
    rate=st.sampled_from([7.0, 20.0, 53.0]),
    speed=st.floats(0.05, 0.7),
    turn_rate=st.floats(0.1, 3),
    lead=st.floats(0.11, 0.3),
    turn_lead=st.floats(0.45, 1),
    timeout=st.floats(0, 0.5),
    gripper_time=st.floats(0, 0.3),
    settle_time=st.floats(0, 0.3),
)


@st.composite
def poses(draw: st.DrawFn, low: float, high: float) -> np.ndarray:
    quaternion = draw(arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 0.1))
    position = draw(arrays(np.float64, 3, elements=st.floats(low, high)))
    return np.concatenate([position, canonical(quaternion / np.linalg.norm(quaternion)), [draw(st.floats(0, 1))]])


def held(config: ControlConfig = CONFIG, state: np.ndarray = START) -> HeldStep:
    return HeldStep(config, LOW, HIGH, state)


def follow(step: HeldStep, decision: np.ndarray, state: np.ndarray = START, stuck: float = 0) -> list[np.ndarray]:
    """Outputs of one macro step with an arm that is, one tick later, where it was told to be.

    It stands still until the output has waited for it ``stuck`` ticks.
    """
    outputs, waited = [step.begin(decision, state)], 0
    while True:
        state = outputs[-1].astype(np.float64) if waited >= stuck else state
        if (output := step.output(state)) is None:
            return outputs
        waited += np.array_equal(output, outputs[-1])
        outputs.append(output)


def turned(angle: float, offset: float = 0.0) -> np.ndarray:
    """The start, turned [rad] and moved [m]."""
    return np.array([START[0] + offset, *START[1:3], np.cos(angle / 2), 0, 0, np.sin(angle / 2), START[7]])


def longest_rest(outputs: list[np.ndarray]) -> int:
    """Most ticks in a row for which the output stayed where it was."""
    return max(sum(1 for _ in same) for _, same in groupby(map(tuple, outputs))) - 1


@FEW
@given(configs, poses(-3, 3), st.lists(poses(-3, 3), min_size=1, max_size=4), st.randoms(use_true_random=False))
def test_no_output_leaves_the_box_exceeds_the_speeds_or_runs_ahead(config, start, decisions, chance) -> None:
    """The arm follows, lags, stands still or seems to jump or to be twisted, as chance has it.

    An output that is ahead when the tool jumps away stays where it is: it may not move on.
    """
    inside = np.concatenate([np.clip(start[:3], LOW, HIGH), start[3:]])
    step, last, state = held(config, inside), inside, inside
    for decision in decisions:
        waited = 0
        for tick in range(50):
            output = step.output(state) if tick else step.begin(decision, state)
            if output is None:
                break
            assert ((output[:3] >= LOW - 1e-6) & (output[:3] <= HIGH + 1e-6)).all()
            assert np.linalg.norm(output[:3] - last[:3]) <= 1.001 * config.speed / config.rate + 1e-6
            assert angle_between(output[3:7], last[3:7]) <= 1.001 * config.turn_rate / config.rate + 2e-3
            assert output[7] in (0, 1)
            if np.array_equal(output[:7], last[:7]):
                waited += 1
            elif waited < config.ticks(config.timeout):
                assert np.linalg.norm(output[:3] - state[:3]) <= config.lead + 1e-6
                assert angle_between(output[3:7], state[3:7]) <= config.turn_lead + 2e-3
            last = output.astype(np.float64)
            twisted = np.concatenate([last[:3], start[3:]])
            state = chance.choice([last, last, last, state, start, twisted])


@FEW
@given(poses(0.15, 0.45), poses(0.15, 0.45))
def test_moves_then_drives_the_gripper_then_settles(start, decision) -> None:
    outputs = np.array(follow(held(state=start), decision, start))
    before, after = float(start[7] > 0.5), float(decision[7] > 0.5)
    still = SETTLE_TICKS + GRIPPER_TICKS * (before != after)
    moving, resting = outputs[:-still], outputs[-still:]
    assert (moving[:, 7] == before).all()
    assert (resting[:, 7] == after).all()
    np.testing.assert_allclose(moving[-1, :3], decision[:3], atol=1e-6)
    np.testing.assert_allclose(resting[:, :7], np.tile(moving[-1, :7], (still, 1)), atol=0)
    assert angle_between(moving[-1, 3:7], decision[3:7]) < 2e-3
    way = timed_path([top_down(start[:3]), top_down(decision[:3])], CONFIG.speed)
    assert len(moving) >= len(way)


def test_the_second_step_starts_where_the_first_ended_with_its_gripper() -> None:
    step = held()
    first = follow(step, GOAL)
    second = np.array(follow(step, START, first[-1].astype(np.float64)))
    np.testing.assert_allclose(second[0, :3], GOAL[:3], atol=0.01)
    assert second[0, 7] == GOAL[7]
    assert second[-1, 7] == START[7]


def test_decisions_outside_of_the_box_are_clipped_to_it() -> None:
    beyond = np.array([2.0, -0.2, -1.0, 1, 0, 0, 0, 1])
    np.testing.assert_allclose(follow(held(), beyond)[-1][:3], [HIGH[0], -0.2, LOW[2]], atol=1e-6)


def test_an_arm_that_does_not_move_ends_the_step_in_time_where_it_is() -> None:
    step = held()
    outputs = [step.begin(GOAL, START)]
    while (output := step.output(START)) is not None:
        outputs.append(output)
    path = len(timed_path([top_down(START[:3]), top_down(GOAL[:3], 0.8)], CONFIG.speed))
    assert len(outputs) <= 2 * path + TIMEOUT_TICKS + GRIPPER_TICKS + SETTLE_TICKS
    assert max(np.linalg.norm(output[:3] - START[:3]) for output in outputs) <= CONFIG.lead + 1e-6
    np.testing.assert_allclose(outputs[-1][:3], START[:3], atol=1e-6)
    assert outputs[-1][7] == GOAL[7], "the gripper takes its command where the arm is, as in a macro step"


def test_a_slow_arm_is_waited_for() -> None:
    step, state = held(replace(CONFIG, timeout=60)), START.copy()
    step.begin(np.concatenate([GOAL[:3], START[3:]]), state)
    arrived = []
    while (output := step.output(state)) is not None:
        assert np.linalg.norm(output[:3] - state[:3]) <= CONFIG.lead + 1e-6
        arrived.append(np.linalg.norm(state[:3] - GOAL[:3]) <= CONFIG.tolerance)
        state[:3] += 0.1 * (output[:3] - state[:3])
    assert not any(arrived[:-SETTLE_TICKS])
    assert all(arrived[-SETTLE_TICKS:])


def test_an_arm_that_is_there_but_not_yet_turned_is_waited_for() -> None:
    goal, angle = 2.0, 0.0
    step, state = held(replace(CONFIG, timeout=60)), START
    step.begin(turned(goal), state)
    ahead, missing = [], []
    while (output := step.output(state)) is not None:
        commanded = angle_between(output[3:7], START[3:7])
        ahead.append(commanded - angle)
        missing.append(goal - angle)
        angle += 0.1 * (commanded - angle)
        state = turned(angle)
    assert CONFIG.turn_lead - 0.1 < max(ahead) <= CONFIG.turn_lead + 2e-3
    assert min(missing[:-SETTLE_TICKS]) > CONFIG.turn_tolerance
    assert max(missing[-SETTLE_TICKS:]) <= CONFIG.turn_tolerance


BLOCKED = {
    "on the way": turned(0, 0.4),
    "at the end": turned(0, 0.07),
    "on the turn": turned(1.3),
    "at the turn's end": turned(0.3),
}


@pytest.mark.parametrize("decision", BLOCKED.values(), ids=BLOCKED)
def test_a_blocked_arm_is_waited_for_as_long_as_the_timeout_says(decision: np.ndarray) -> None:
    assert len(follow(held(), decision, stuck=TIMEOUT_TICKS)) == len(follow(held(), decision)) + TIMEOUT_TICKS
    outputs = follow(held(), decision, stuck=np.inf)
    assert longest_rest(outputs) == TIMEOUT_TICKS
    np.testing.assert_allclose(outputs[-1], START, atol=1e-6)


@pytest.mark.parametrize("first", [13, np.inf], ids=["waited for", "timed out"])
@pytest.mark.parametrize("decision", BLOCKED.values(), ids=BLOCKED)
def test_each_step_waits_anew(decision: np.ndarray, first: float) -> None:
    """The arm is blocked in two steps; in the second it comes free with the last tick of patience, and follows."""
    step = held()
    start = follow(step, decision, stuck=first)[-1].astype(np.float64)
    back = START if first == 13 else decision
    outputs = follow(step, back, start, stuck=TIMEOUT_TICKS)
    assert len(outputs) == len(follow(held(state=start), back, start)) + TIMEOUT_TICKS
    resting = next(tick for tick, (one, other) in enumerate(pairwise(outputs)) if np.array_equal(one, other))
    assert np.linalg.norm(outputs[resting][:3] - start[:3]) <= CONFIG.lead + 1e-6
    assert angle_between(outputs[resting][3:7], start[3:7]) <= CONFIG.turn_lead + 2e-3
    np.testing.assert_allclose(outputs[-1], back, atol=1e-6)


@pytest.mark.parametrize("component", range(8))
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_pose_that_is_not_finite_stops_with_an_error(component: int, value: float) -> None:
    """Measured at the start, measured on the way, or decided."""
    bad = START.copy()
    bad[component] = value
    with pytest.raises(ValueError, match="not finite"):
        held(state=bad)
    step = held()
    with pytest.raises(ValueError, match=r"the decision .* is not finite"):
        step.begin(bad, START)
    step.begin(GOAL, START)
    with pytest.raises(ValueError, match="not finite"):
        step.output(bad)


def test_a_start_outside_of_the_box_is_refused() -> None:
    with pytest.raises(ValueError, match=r"0\.300 m outside of the box"):
        held(state=np.concatenate([[0.3, 0.1, 1.0], START[3:]]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"speed": 0.0}, "speed=0.0"),
        ({"timeout": -1.0}, "timeout=-1.0"),
        ({"rate": np.nan}, "rate=nan"),
        ({"box": (0.0, 0.0, 0.0, 1.0, 1.0)}, "control.box"),
        ({"rate": 20.0, "lead": 0.01}, "one tick's way"),
    ],
)
def test_settings_that_cannot_work_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ControlConfig(**changes)
