"""The physics of one scene: stepping in control ticks, measuring the robot, placing and querying objects."""

from collections.abc import Callable, Iterable, Mapping

import mujoco
import numpy as np
from jaxtyping import Float

from lerobot_histmv.envs import scene
from lerobot_histmv.envs.kinematics import JOINTS, ArmKinematics
from lerobot_histmv.envs.motion import TICK, Point, Pose, top_down
from lerobot_histmv.geometry import quaternion_from_matrix

HOME = top_down((0.28, 0.0, 0.40))
"""Tool pose at the start of every episode: above the near edge of the workspace, pointing down."""
ELBOW_UP = np.array([0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0])
"""Joint angles [rad] from which inverse kinematics finds the elbow-up branch."""
FEED_FORWARD = 0.2
"""Ratio of damping to stiffness [s] of the arm's actuators; adding it times the velocity removes their lag."""
REFERENCE_STEPS = 5
"""Physics steps between updates of the actuators' reference inside a tick."""
GRIPPER_CLOSED_CONTROL = 255.0
DRIVER_CLOSED = 0.8
"""Angle [rad] of the finger drivers when closed."""


class Simulation:
    """One MuJoCo model and its state.

    Args:
        objects: object name -> description file, see ``scene.build_model``.
        render_size: largest image side [pixels] that will be rendered.
    """

    def __init__(self, objects: Mapping[str, str], render_size: int) -> None:
        self.model = scene.build_model(objects, render_size)
        self.data = mujoco.MjData(self.model)
        self.kinematics = ArmKinematics(*self._tool_in_wrist())
        home = self.kinematics.solve(HOME, ELBOW_UP)
        assert home is not None
        self.home = home
        names = [f"{scene.ARM_PREFIX}{joint}_joint" for joint in JOINTS]
        self._qpos = np.array([self.model.joint(name).qposadr[0] for name in names])
        self._driver = self.model.joint(f"{scene.GRIPPER_PREFIX}right_driver_joint").qposadr[0]
        self._tool = self.model.site(scene.TOOL_SITE).id
        self._pads = [frozenset(self.model.geom(name).id for name in pads) for pads in scene.PADS.values()]
        self._steps = round(TICK / self.model.opt.timestep)
        self.after_tick: list[Callable[[], None]] = []

    def _tool_in_wrist(self) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 4"]]:
        mujoco.mj_kinematics(self.model, self.data)
        wrist, tool = self.data.body(f"{scene.ARM_PREFIX}wrist_3_link"), self.data.site(scene.TOOL_SITE)
        from_world = wrist.xmat.reshape(3, 3).T
        return from_world @ (tool.xpos - wrist.xpos), quaternion_from_matrix(from_world @ tool.xmat.reshape(3, 3))

    def reset(self) -> None:
        """Arm at home, gripper open, objects where the model has them, everything at rest."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self._qpos] = self.home
        self.data.ctrl[:6] = self.home
        self.refresh()

    def refresh(self) -> None:
        """Bring body, site and camera poses up to date with the joint positions; the dynamics do not notice."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def tick(self, start: Float[np.ndarray, " 6"], end: Float[np.ndarray, " 6"], gripper: float) -> None:
        """Simulate one control period while the joint reference [rad] moves linearly from ``start`` to ``end``."""
        lead = FEED_FORWARD * (end - start) / TICK
        self.data.ctrl[6] = GRIPPER_CLOSED_CONTROL * (1 - gripper)
        for step in range(0, self._steps, REFERENCE_STEPS):
            share = (step + REFERENCE_STEPS) / self._steps
            self.data.ctrl[:6] = start + share * (end - start) + lead
            mujoco.mj_step(self.model, self.data, REFERENCE_STEPS)
        self.refresh()
        for callback in self.after_tick:
            callback()

    def joints(self) -> Float[np.ndarray, " 6"]:
        """Measured joint angles [rad]."""
        return self.data.qpos[self._qpos].copy()

    def tool_pose(self) -> Pose:
        """Measured pose of the tool."""
        rotation = self.data.site_xmat[self._tool].reshape(3, 3)
        return Pose(self.data.site_xpos[self._tool].copy(), quaternion_from_matrix(rotation))

    def gripper_opening(self) -> float:
        """Measured opening: 1 open, 0 closed."""
        return float(np.clip(1 - self.data.qpos[self._driver] / DRIVER_CLOSED, 0, 1))

    def position(self, name: str) -> Float[np.ndarray, " 3"]:
        """Position [m] of an object."""
        return self.data.body(f"{name}_body").xpos.copy()

    def yaw(self, name: str) -> float:
        """Angle [rad] of an object about world z."""
        rotation = self.data.body(f"{name}_body").xmat
        return float(np.arctan2(rotation[3], rotation[0]))

    def slide(self, name: str) -> float:
        """Position [m] of an object's own one-degree-of-freedom joint."""
        return float(self.data.joint(f"{name}_joint").qpos[0])

    def place_free(self, name: str, position: Point, yaw: float) -> None:
        """Put an object that has a free joint somewhere."""
        self.data.joint(f"{name}_joint").qpos[:] = [*position, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]

    def place_fixed(self, name: str, position: Point) -> None:
        """Put an object that is fixed to the world somewhere."""
        self.model.body(f"{name}_body").pos[:] = position

    def paint(self, name: str, rgb: Iterable[float]) -> None:
        """Colour an object's ``paint`` geom."""
        self.model.geom(f"{name}_paint").rgba[:] = [*rgb, 1]

    def gripped(self, name: str) -> bool:
        """Whether both finger pads touch an object's ``paint`` geom."""
        geom = self.model.geom(f"{name}_paint").id
        contacts = self.data.contact.geom[: self.data.ncon]
        partners = set(contacts[contacts[:, 0] == geom, 1]) | set(contacts[contacts[:, 1] == geom, 0])
        return all(partners & pad for pad in self._pads)
