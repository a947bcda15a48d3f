"""The physics of one scene: stepping in control ticks, measuring the robot, placing and querying objects."""

from collections.abc import Callable, Iterable, Mapping

import mujoco
import numpy as np
from jaxtyping import Float

from lerobot_histmv.envs import scene
from lerobot_histmv.envs.kinematics import JOINTS, ArmKinematics, pose_at
from lerobot_histmv.geometry import quaternion_from_matrix
from lerobot_histmv.motion import TICK, Point, Pose, top_down

HOME = top_down((0.28, 0.0, 0.40))
"""Tool pose at the start of every episode: above the near edge of the workspace, pointing down."""
ELBOW_UP = np.array([0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0])
"""Joint angles [rad] from which inverse kinematics finds the elbow-up branch."""
FEED_FORWARD = 0.2
"""Ratio of damping to stiffness [s] of the arm's actuators; adding it times the velocity removes their lag."""
REFERENCE_STEPS = 5
"""Physics steps between updates of the actuators' reference inside a tick."""
GRIPPER_CLOSED_CONTROL = 255.0
FREE = mujoco.mjtJoint.mjJNT_FREE
SLEEP = int(mujoco.mjtEnableBit.mjENBL_SLEEP)
"""While ticking, what lies still is not simulated until something touches it: half of the physics' time. Not while a
scene is set up: MuJoCo takes fixed bodies for asleep, and would leave them where they were."""
DRIVER_CLOSED = 0.8
"""Angle [rad] of the finger drivers when closed."""


class Simulation:
    """One MuJoCo model and its state.

    Objects go by their name ("cube0"), their parts by name and part ("cabinet/top").

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
        self._geoms_of: dict[str, frozenset[int]] = {}
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
        """Bring body, site and camera poses up to date with what was placed; the dynamics do not notice."""
        self.model.opt.enableflags = 0
        self._update_poses()

    def _update_poses(self) -> None:
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def tick(self, start: Float[np.ndarray, " 6"], end: Float[np.ndarray, " 6"], gripper: float) -> None:
        """Simulate one control period while the joint reference [rad] moves linearly from ``start`` to ``end``."""
        lead = FEED_FORWARD * (end - start) / TICK
        self.data.ctrl[6] = GRIPPER_CLOSED_CONTROL * (1 - gripper)
        self.model.opt.enableflags = SLEEP
        for step in range(0, self._steps, REFERENCE_STEPS):
            share = (step + REFERENCE_STEPS) / self._steps
            self.data.ctrl[:6] = start + share * (end - start) + lead
            mujoco.mj_step(self.model, self.data, REFERENCE_STEPS)
        self._update_poses()
        for callback in self.after_tick:
            callback()

    def joints(self) -> Float[np.ndarray, " 6"]:
        """Measured joint angles [rad]."""
        return self.data.qpos[self._qpos].copy()

    def tool_pose(self) -> Pose:
        """Measured pose of the tool."""
        return pose_at(self.data.site_xpos[self._tool], self.data.site_xmat[self._tool])

    def gripper_opening(self) -> float:
        """Measured opening: 1 open, 0 closed."""
        return float(np.clip(1 - self.data.qpos[self._driver] / DRIVER_CLOSED, 0, 1))

    def position(self, name: str) -> Float[np.ndarray, " 3"]:
        """Position [m] of an object or of one of its parts."""
        return self.data.body(_full(name, "body")).xpos.copy()

    def rotation(self, name: str) -> Float[np.ndarray, "3 3"]:
        """Orientation of an object or of one of its parts; the columns are its axes in the base frame."""
        return self.data.body(_full(name, "body")).xmat.reshape(3, 3).copy()

    def yaw(self, name: str) -> float:
        """Angle [rad] of an object about world z."""
        rotation = self.rotation(name)
        return float(np.arctan2(rotation[1, 0], rotation[0, 0]))

    def site(self, name: str) -> Pose:
        """Pose of an object's site; a site that marks a grasp has the tool's axes."""
        site = self.data.site(_full(name, "grasp"))
        return pose_at(site.xpos, site.xmat)

    def joint(self, name: str) -> float:
        """Position [m or rad] of an object's joint with one degree of freedom."""
        return float(self.data.joint(_full(name, "joint")).qpos[0])

    def place_free(self, name: str, position: Point, yaw: float) -> None:
        """Put an object that has a free joint somewhere, at rest."""
        joint = self.data.joint(_full(name, "joint"))
        joint.qpos[:] = [*position, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
        joint.qvel[:] = 0

    def place_fixed(self, name: str, position: Point, yaw: float = 0.0) -> None:
        """Put an object that is fixed to the world somewhere."""
        body = self.model.body(_full(name, "body"))
        body.pos[:] = position
        body.quat[:] = [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]

    def latch(self, name: str, closed: bool) -> None:
        """Switch an equality constraint of an object on or off, until the next reset."""
        self.data.eq_active[self.model.equality(_full(name, "latch")).id] = closed

    def paint(self, name: str, rgb: Iterable[float]) -> None:
        """Colour all that has an object's material ``paint``."""
        self.model.material(_full(name, "paint")).rgba[:] = [*rgb, 1]

    def gripped(self, name: str) -> bool:
        """Whether both finger pads touch an object or part."""
        partners = self._touching(self._geoms(name))
        return all(partners & pad for pad in self._pads)

    def is_alone(self, name: str) -> bool:
        """Whether an object, where it was just placed or rests, touches nothing but the table."""
        self._find_contacts()
        return self._touching(self._geoms(name)) <= {self.model.geom("table").id}

    def overlap(self) -> float:
        """How deep [m] something lies inside something else, at worst."""
        self._find_contacts()
        return float(-self.data.contact.dist.min(initial=0))

    def _find_contacts(self) -> None:
        """Of everything where it is now; the contacts of the last tick leave out what slept."""
        self.model.opt.enableflags = 0
        mujoco.mj_fwdPosition(self.model, self.data)

    def loose(self, names: Iterable[str]) -> list[str]:
        """Those of the objects that lie about: they have a free joint."""
        joints = {name: _full(name, "joint") for name in names}
        known = {self.model.joint(i).name for i in range(self.model.njnt) if self.model.jnt_type[i] == FREE}
        return [name for name, joint in joints.items() if joint in known]

    def _touching(self, geoms: frozenset[int]) -> set[int]:
        """Geoms in contact with any of ``geoms``."""
        pairs = self.data.contact.geom[: self.data.ncon].tolist()
        return {b for a, b in pairs if a in geoms} | {a for a, b in pairs if b in geoms}

    def _geoms(self, name: str) -> frozenset[int]:
        """All geoms of an object or part and of what hangs on it."""
        if name not in self._geoms_of:
            root = self.model.body(_full(name, "body")).id
            bodies = {root}
            for body in range(root + 1, self.model.nbody):  # children come after their parents
                if self.model.body_parentid[body] in bodies:
                    bodies.add(body)
            owners = self.model.geom_bodyid.tolist()
            self._geoms_of[name] = frozenset(geom for geom, owner in enumerate(owners) if owner in bodies)
        return self._geoms_of[name]


def _full(name: str, default: str) -> str:
    """Name in the model: ``object`` means its element ``default``, ``object/element`` another one."""
    owner, _, element = name.partition("/")
    return f"{owner}_{element or default}"
