"""Mandatory keyframes: pauses, gripper changes, both ends, and the two frames that each keyframe has."""

import numpy as np
import pytest

from dataset_tools.signals import Keyframe, PauseOptions, Trajectory, mandatory_keyframes, pauses
from lerobot_histmv import keys

FAST = 0.02
"""Step of a moving tool [m]: 0.4 m/s at 20 Hz."""


def path(*legs: tuple[int, bool]) -> np.ndarray:
    """Positions along x out of legs (number of steps, whether the tool moves)."""
    steps = np.concatenate([np.full(count, FAST if moves else 0.0) for count, moves in legs])
    x = np.concatenate([[0], np.cumsum(steps)])
    return np.stack([x, 0 * x, 0 * x], axis=-1)


def closed_from(frame: int, n: int) -> np.ndarray:
    return (np.arange(n) < frame).astype(float)


def found(position: np.ndarray, gripper: np.ndarray | None = None, **options: float) -> list[tuple[int, int, str]]:
    frames = mandatory_keyframes(Trajectory(position, 20.0, gripper=gripper), PauseOptions(**options))
    return [(frame.pose_frame, frame.observation_frame, frame.reason) for frame in frames]


def test_a_moving_tool_has_only_its_two_ends() -> None:
    assert found(path((13, True))) == [(0, 0, "start"), (13, 13, "end")]


def test_a_pause_is_one_keyframe_seen_when_the_arm_is_about_to_move_on() -> None:
    assert found(path((7, True), (5, False), (11, True))) == [(0, 0, "start"), (7, 12, "pause"), (23, 23, "end")]


def test_a_stop_shorter_than_the_dwell_is_no_pause() -> None:
    motion = path((7, True), (2, False), (11, True))
    assert found(motion) == [(0, 0, "start"), (20, 20, "end")]
    assert found(motion, dwell=0.1)[1] == (7, 9, "pause")


def test_a_change_of_the_gripper_in_a_pause_is_that_pauses_keyframe_at_the_commanded_frame() -> None:
    motion = path((7, True), (11, False), (5, True))
    assert found(motion, closed_from(9, 24)) == [(0, 0, "start"), (9, 18, "gripper"), (23, 23, "end")]


def test_a_change_just_before_the_arm_stops_belongs_to_the_pause() -> None:
    motion = path((7, True), (11, False), (5, True))
    assert found(motion, closed_from(5, 24)) == [(0, 0, "start"), (5, 18, "gripper"), (23, 23, "end")]
    assert found(motion, closed_from(5, 24), settle=0.0) == [
        (0, 0, "start"), (5, 5, "gripper"), (7, 18, "pause"), (23, 23, "end"),
    ]  # fmt: skip


def test_two_changes_in_one_pause_are_two_keyframes_whose_spans_do_not_overlap() -> None:
    motion = path((7, True), (23, False), (5, True))
    gripper = np.where((np.arange(36) >= 9) & (np.arange(36) < 20), 0.0, 1.0)
    assert found(motion, gripper) == [(0, 0, "start"), (9, 19, "gripper"), (20, 30, "gripper"), (35, 35, "end")]


def test_a_change_on_the_move_is_seen_where_it_is_commanded() -> None:
    assert found(path((23, True)), closed_from(11, 24)) == [(0, 0, "start"), (11, 11, "gripper"), (23, 23, "end")]


def test_a_paused_start_is_the_start_and_a_paused_end_the_end() -> None:
    motion = path((7, False), (11, True), (5, False))
    assert found(motion) == [(0, 7, "start"), (18, 23, "end")]


def test_a_change_in_a_paused_start_comes_after_the_start() -> None:
    motion = path((7, False), (11, True))
    assert found(motion, closed_from(3, 19)) == [(0, 2, "start"), (3, 7, "gripper"), (18, 18, "end")]


def test_a_change_in_a_paused_end_is_the_end() -> None:
    motion = path((11, True), (7, False))
    assert found(motion, closed_from(13, 19)) == [(0, 0, "start"), (13, 18, "gripper")]


@pytest.mark.parametrize("n", [2, 3, 19])
def test_an_arm_that_never_moves_has_two_keyframes(n: int) -> None:
    frames = found(np.zeros((n, 3)), dwell=0.0)
    assert [reason for *_, reason in frames] == ["start", "end"]
    assert frames[0][:2] == (0, n - 2)
    assert frames[1][:2] == (n - 1, n - 1)


def test_one_noisy_step_does_not_split_a_pause() -> None:
    motion = path((7, True), (11, False), (5, True))
    motion[12:] += [0.003, 0, 0]
    assert pauses(Trajectory(motion, 20.0), PauseOptions()) == [(7, 18)]


def test_turning_on_the_spot_is_no_pause() -> None:
    motion = path((7, True), (11, False), (5, True))
    turn = np.clip(np.arange(24) - 9, 0, 5) * 0.1
    quaternion = np.stack([np.cos(turn / 2), np.sin(turn / 2), 0 * turn, 0 * turn], axis=-1)
    assert pauses(Trajectory(motion, 20.0, quaternion), PauseOptions(dwell=0.1)) == [(7, 9), (14, 18)]


def test_an_arm_told_to_rest_pauses_although_it_creeps() -> None:
    told = path((7, True), (11, False), (5, True))
    creeping = told + np.arange(24)[:, None] * np.array([0.0, 0.0, 0.002])
    upright = np.tile([1.0, 0, 0, 0], (24, 1))
    assert pauses(Trajectory(creeping, 20.0, upright), PauseOptions()) == []
    trajectory = Trajectory(creeping, 20.0, upright, None, told, upright)
    assert pauses(trajectory, PauseOptions()) == [(7, 18)]


def test_the_pose_of_a_pause_is_taken_once_the_arm_has_arrived() -> None:
    motion = path((7, True), (0, False))
    slowing = motion[-1] + np.cumsum([[0.0004, 0, 0]] * 3 + [[0.0, 0, 0]] * 9, axis=0)
    moving = slowing[-1] + np.cumsum([[0.0, FAST, 0]] * 5, axis=0)
    _, pause, _ = found(np.concatenate([motion, slowing, moving]))
    assert pause == (9, 19, "pause")


def test_every_reason_has_a_number_in_the_data() -> None:
    assert {"start", "pause", "gripper", "ga", "end", "user"} == set(keys.REASONS)


def test_a_keyframe_rests_if_it_is_seen_later_than_its_pose() -> None:
    assert Keyframe(3, 5, "pause").rests
    assert not Keyframe(3, 3, "ga").rests


@pytest.mark.parametrize("name", ["speed", "turn_speed", "dwell", "settle"])
def test_negative_thresholds_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=rf"pause\.{name} is -1"):
        PauseOptions(**{name: -1.0})
