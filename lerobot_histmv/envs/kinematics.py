"""Forward and inverse kinematics of the arm, on a model without meshes."""

import mujoco
import numpy as np
from jaxtyping import Float

from lerobot_histmv.envs.scene import arm_spec
from lerobot_histmv.geometry import canonical
from lerobot_histmv.motion import Pose

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
POSITION_TOLERANCE = 1e-4
ROTATION_TOLERANCE = 1e-3
MAX_ITERATIONS = 60
DAMPING = 1e-3
MAX_JOINT_STEP = 0.5


def pose_at(position: Float[np.ndarray, " 3"], rotation: Float[np.ndarray, " 9"]) -> Pose:
    """Pose from what MuJoCo keeps of a body or site; for single ones MuJoCo converts ten times faster than scipy."""
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, rotation)
    return Pose(position.copy(), canonical(quaternion))


class ArmKinematics:
    """Damped least squares inverse kinematics of the UR5e with a tool fixed to its last link.

    Args:
        tool_position: tool in the frame of ``wrist_3_link`` [m].
        tool_quaternion: w, x, y, z of the tool in that frame.
    """

    def __init__(self, tool_position: Float[np.ndarray, " 3"], tool_quaternion: Float[np.ndarray, " 4"]) -> None:
        spec = arm_spec()
        for element in [*spec.geoms, *spec.meshes]:
            spec.delete(element)
        spec.body("wrist_3_link").add_site(name="tool", pos=tool_position, quat=tool_quaternion)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._site = self._model.site("tool").id
        self._jacobian = np.zeros((6, 6))
        self.lower, self.upper = self._model.jnt_range.T

    def tool_pose(self, joints: Float[np.ndarray, " 6"]) -> Pose:
        """Tool pose in the base frame for joint angles [rad]."""
        self._data.qpos[:] = joints
        mujoco.mj_kinematics(self._model, self._data)
        return pose_at(self._data.site_xpos[self._site], self._data.site_xmat[self._site])

    def solve(self, target: Pose, seed: Float[np.ndarray, " 6"]) -> Float[np.ndarray, " 6"] | None:
        """Joint angles [rad] near ``seed`` that bring the tool to ``target``, or None if none are found.

        The result is within 0.1 mm and 1 mrad of the target and inside the joint limits.
        """
        joints = np.array(seed, dtype=np.float64)
        for _ in range(MAX_ITERATIONS):
            error = self._error(target, joints)
            if np.linalg.norm(error[:3]) < POSITION_TOLERANCE and np.linalg.norm(error[3:]) < ROTATION_TOLERANCE:
                return joints
            mujoco.mj_jacSite(self._model, self._data, self._jacobian[:3], self._jacobian[3:], self._site)
            damping = DAMPING * max(1e-3, float(error @ error)) * np.eye(6)
            step = self._jacobian.T @ np.linalg.solve(self._jacobian @ self._jacobian.T + damping, error)
            step *= min(1.0, MAX_JOINT_STEP / max(np.abs(step).max(), 1e-9))
            joints = np.clip(joints + step, self.lower, self.upper)
        return None

    def _error(self, target: Pose, joints: Float[np.ndarray, " 6"]) -> Float[np.ndarray, " 6"]:
        """Position [m] and rotation vector [rad] from the tool at ``joints`` to ``target``, in the base frame."""
        data = self._data
        data.qpos[:] = joints
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_comPos(self._model, data)
        current, turn = np.zeros(4), np.zeros(3)
        mujoco.mju_mat2Quat(current, data.site_xmat[self._site])
        mujoco.mju_subQuat(turn, target.quaternion, current)
        rotation = data.site_xmat[self._site].reshape(3, 3)
        return np.concatenate([target.position - data.site_xpos[self._site], rotation @ turn])
