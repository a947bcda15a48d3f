"""Inverse kinematics inverts forward kinematics and knows what is out of reach."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

from lerobot_histmv.envs.kinematics import POSITION_TOLERANCE, ROTATION_TOLERANCE, ArmKinematics
from lerobot_histmv.envs.simulation import ELBOW_UP
from lerobot_histmv.geometry import angle_between
from lerobot_histmv.motion import top_down


@pytest.fixture(scope="module")
def arm() -> ArmKinematics:
    return ArmKinematics(np.array([0.01, 0.25, 0.03]), np.array([0.5, 0.5, -0.5, 0.5]))


def test_solutions_reach_their_targets(arm: ArmKinematics) -> None:
    rng = np.random.default_rng(0)
    for _ in range(23):
        target = arm.tool_pose(ELBOW_UP + rng.uniform(-0.5, 0.5, 6))
        joints = arm.solve(target, ELBOW_UP)
        assert joints is not None
        reached = arm.tool_pose(joints)
        assert np.linalg.norm(reached.position - target.position) < POSITION_TOLERANCE
        assert angle_between(reached.quaternion, target.quaternion) < ROTATION_TOLERANCE
        assert (joints >= arm.lower).all()
        assert (joints <= arm.upper).all()


def test_a_distant_target_has_no_solution(arm: ArmKinematics) -> None:
    assert arm.solve(top_down((1.5, 0.0, 0.2)), ELBOW_UP) is None


def test_the_seed_is_left_alone(arm: ArmKinematics) -> None:
    seed = ELBOW_UP.copy()
    arm.solve(top_down((0.4, 0.2, 0.2)), seed)
    np.testing.assert_array_equal(seed, ELBOW_UP)
