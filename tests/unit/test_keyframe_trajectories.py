"""Trajectories and labels out of columns: one quaternion order, one meaning of the gripper, checked numbers."""

from collections.abc import Collection

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dataset_tools.columns import Column, Columns
from dataset_tools.demonstrations import gripper_ends
from dataset_tools.signals import Keyframe, Trajectory
from dataset_tools.source import Source
from dataset_tools.trajectories import command, label_names, labels, trajectory_of
from lerobot_histmv import keys
from lerobot_histmv.geometry import canonical

POSITION = Column("state", (0, 1, 2))


def columns(
    rotation: Column | None = None, rotation_format: str = "", gripper_range: tuple[float, float] | None = None
) -> Columns:
    return Columns(POSITION, False, rotation, rotation_format, Column("action", (0,)), gripper_range)


@pytest.mark.parametrize("rotation_format", ["wxyz", "xyzw", "rotvec", "rpy"])
def test_every_rotation_format_becomes_canonical_wxyz(rotation_format: str) -> None:
    turn = Rotation.random(11, rng=np.random.default_rng(0))
    values = {
        "wxyz": -turn.as_quat(scalar_first=True),
        "xyzw": turn.as_quat(),
        "rotvec": turn.as_rotvec(),
        "rpy": turn.as_euler("xyz"),
    }[rotation_format]
    vectors = {"state": np.hstack([np.zeros((11, 3)), values]), "action": np.ones((11, 1))}
    rotation = Column("state", tuple(range(3, 3 + values.shape[1])))
    found = trajectory_of(vectors, columns(rotation, rotation_format), (0.0, 1.0), 20.0, 0)
    assert found.quaternion is not None
    np.testing.assert_allclose(found.quaternion, canonical(turn.as_quat(scalar_first=True)), atol=1e-12)


def test_a_quaternion_that_is_not_unit_is_named_with_episode_and_frame() -> None:
    values = np.tile([1.0, 0, 0, 0], (7, 1))
    values[5] = [0.5, 0.5, 0, 0]
    vectors = {"state": np.hstack([np.zeros((7, 3)), values]), "action": np.ones((7, 1))}
    with pytest.raises(ValueError, match=r"episode 3, frame 5: state:3,4,5,6 .*norm 0\.707"):
        trajectory_of(vectors, columns(Column("state", (3, 4, 5, 6)), "wxyz"), (0.0, 1.0), 20.0, 3)


def test_the_gripper_becomes_one_or_zero_whatever_its_range_and_small_wobbles_do_not_count() -> None:
    opening = np.array([1.0, 0.9, 0.55, 0.45, 0.52, 0.3, 0.0, 0.55, 0.45, 0.7])
    expected = [1, 1, 1, 1, 1, 0, 0, 0, 0, 1]
    assert command(opening, (0.0, 1.0)).tolist() == expected
    assert command(0.08 * opening, (0.0, 0.08)).tolist() == expected
    assert command(1 - 2 * opening, (1.0, -1.0)).tolist() == expected


class Recorded(Source):
    """A dataset that has nothing but gripper commands by episode."""

    commands: dict[int, list[float]]

    def __init__(self, commands: dict[int, list[float]]) -> None:
        object.__setattr__(self, "commands", commands)
        object.__setattr__(self, "episodes", tuple(commands))

    def vectors(self, episode: int, wanted: Collection[str] | None = None) -> dict[str, np.ndarray]:
        assert wanted == ["action"]
        return {"action": np.array(self.commands[episode], dtype=np.float64)[:, None]}


def test_the_range_of_an_unknown_gripper_is_that_of_all_episodes() -> None:
    assert gripper_ends(Recorded({0: [3, 5], 4: [4, 9]}), columns()) == (3, 9)
    assert gripper_ends(Recorded({0: [3, 5]}), columns(gripper_range=(100.0, 0.0))) == (100.0, 0.0)
    still = gripper_ends(Recorded({0: [3, 3]}), columns())
    assert command(np.full(5, 3.0), still).tolist() == [1, 1, 1, 1, 1]


def test_a_gripper_outside_its_range_is_named_with_episode_and_frame() -> None:
    vectors = {"state": np.zeros((2, 3)), "action": np.array([[1.0], [57.0]])}
    with pytest.raises(ValueError, match=r"episode 4, frame 1: action:0 is 57, outside 0 to 1"):
        trajectory_of(vectors, columns(gripper_range=(0.0, 1.0)), (0.0, 1.0), 20.0, 4)


def test_labels_are_the_pose_at_the_pose_frame_and_the_command_in_force_after_it() -> None:
    position = np.arange(21.0).reshape(7, 3)
    quaternion = np.tile([0.6, 0.8, 0, 0], (7, 1))
    gripper = np.array([1.0, 1, 1, 0, 0, 0, 0])
    trajectory = Trajectory(position, 20.0, quaternion, gripper)
    rows = labels(trajectory, [Keyframe(2, 2, "ga"), Keyframe(3, 5, "gripper"), Keyframe(6, 6, "end")])
    np.testing.assert_allclose(rows[:, :3], position[[2, 3, 6]])
    np.testing.assert_allclose(rows[:, 3:7], quaternion[[2, 3, 6]])
    assert rows[:, 7].tolist() == [1, 0, 0]


def test_a_resting_pose_is_labelled_with_the_command_for_that_frame_and_a_passing_one_with_the_measurement() -> None:
    own = Columns(
        curve=POSITION,
        is_joints=False,
        rotation=Column("state", (3, 4, 5, 6)),
        rotation_format="wxyz",
        gripper=None,
        gripper_range=None,
        commanded=(Column("action", (0, 1, 2)), Column("action", (3, 4, 5, 6))),
    )
    upright, turned = np.tile([1.0, 0, 0, 0], (5, 1)), np.tile([0.6, 0.8, 0, 0], (5, 1))
    measured, told = np.arange(15.0).reshape(5, 3), 100 + np.arange(15.0).reshape(5, 3)
    vectors = {"state": np.hstack([measured, upright]), "action": np.hstack([told, turned])}
    trajectory = trajectory_of(vectors, own, (0.0, 1.0), 20.0, 0)
    passing, resting = labels(trajectory, [Keyframe(2, 2, "ga"), Keyframe(3, 4, "pause")])
    np.testing.assert_allclose(passing, [*measured[2], *upright[2]])
    np.testing.assert_allclose(resting, [*told[2], *turned[2]], rtol=1e-6)


def test_label_names_are_our_pose_names_as_far_as_they_go() -> None:
    assert label_names(columns(Column("state", (3, 4, 5, 6)), "wxyz")) == list(keys.POSE_NAMES)
    assert label_names(columns()) == [*keys.POSITION_NAMES, keys.GRIPPER_NAME]
    joints = Columns(Column("state", (0, 1), ("a.pos", "b.pos")), True, None, "", None, None)
    assert label_names(joints) == ["a.pos", "b.pos"]
    unnamed = Columns(Column("state", (4, 5)), True, None, "", None, None)
    assert label_names(unnamed) == ["joint_4.pos", "joint_5.pos"]
