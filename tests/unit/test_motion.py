"""Paths: smooth, bounded, through the neighbourhood of their via points, and the same as straight macro steps."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lerobot_histmv.geometry import angle_between, canonical
from lerobot_histmv.motion import MAX_TURN_RATE, TICK, Motion, Pose, timed_path, top_down

SPEED = 0.3
START, VIA, END = top_down((0.3, 0.0, 0.4)), top_down((0.5, 0.2, 0.16), 0.6), top_down((0.5, 0.2, 0.02), 0.6)


def random_pose(rng: np.random.Generator) -> Pose:
    quaternion = Rotation.random(random_state=int(rng.integers(1 << 30))).as_quat(scalar_first=True)
    return Pose(rng.uniform(-1, 1, 3), canonical(quaternion))


def positions(path: list[Pose]) -> np.ndarray:
    return np.array([pose.position for pose in path])


@pytest.mark.parametrize("waypoints", [2, 3, 5])
def test_a_path_ends_at_its_target_and_keeps_to_its_speeds(waypoints: int) -> None:
    rng = np.random.default_rng(waypoints)
    poses = [random_pose(rng) for _ in range(waypoints)]
    path = [poses[0], *timed_path(poses, SPEED)]
    np.testing.assert_allclose(path[-1].position, poses[-1].position, atol=1e-9)
    assert angle_between(path[-1].quaternion, poses[-1].quaternion) < 1e-6
    steps = np.linalg.norm(np.diff(positions(path), axis=0), axis=1)
    turns = [angle_between(a.quaternion, b.quaternion) for a, b in pairwise(path)]
    assert steps.max() <= 1.001 * SPEED * TICK
    assert max(turns) <= 1.001 * MAX_TURN_RATE * TICK
    assert steps[0] < steps.max() / 3
    assert steps[-1] < steps.max() / 3


def test_without_via_points_the_path_is_straight() -> None:
    path = positions(timed_path([START, END], SPEED))
    direction = (END.position - START.position) / np.linalg.norm(END.position - START.position)
    off_line = np.cross(path - START.position, direction)
    np.testing.assert_allclose(off_line, 0, atol=1e-9)


def test_a_via_point_rounds_the_corner_without_a_stop() -> None:
    path = positions(timed_path([START, VIA, END], SPEED))
    distance = np.linalg.norm(path - VIA.position, axis=1)
    nearest = distance.argmin()
    assert 0.002 < distance[nearest] < 0.02
    speeds = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert speeds[nearest - 1 : nearest + 1].min() > 0.4 * speeds.max()


def test_staying_in_place_and_turning_on_the_spot_work() -> None:
    assert len(timed_path([START, START], SPEED)) == 1
    turned = top_down(START.position, 1.0)
    path = timed_path([START, turned], SPEED)
    assert angle_between(path[-1].quaternion, turned.quaternion) < 1e-6
    np.testing.assert_allclose(positions(path), np.tile(START.position, (len(path), 1)), atol=1e-12)


def test_macro_steps_of_a_motion_change_the_gripper_only_at_the_target() -> None:
    actions = Motion(via=(VIA,), target=END, gripper=0.0).actions(gripper_before=1.0)
    assert [action[7] for action in actions] == [1.0, 0.0]
    np.testing.assert_allclose(actions[0][:3], VIA.position, atol=1e-7)
    np.testing.assert_allclose(actions[1][3:7], END.quaternion, atol=1e-7)
    assert all(action.dtype == np.float32 for action in actions)


def test_the_fingers_of_a_downward_tool_turn_with_yaw() -> None:
    yaw = 0.7
    rotation = Rotation.from_quat(top_down((0.0, 0.0, 0.0), yaw).quaternion, scalar_first=True).as_matrix()
    np.testing.assert_allclose(rotation[:, 2], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(rotation[:, 0], [np.cos(yaw), np.sin(yaw), 0], atol=1e-12)
