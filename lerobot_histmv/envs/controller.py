"""Moves the arm: Cartesian paths with a joint-space fallback, the gripper, settling, and a protective stop."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from lerobot_histmv.envs.simulation import ELBOW_UP, Simulation
from lerobot_histmv.geometry import angle_between
from lerobot_histmv.motion import MAX_SPEED, TICK, Motion, Pose, Tick, make_action, timed_path

ARRIVED = 0.002
"""The arm has arrived when the tool is this close [m] ..."""
ARRIVED_TURN = 0.02
"""... and this close [rad]."""
MAX_SETTLE_TICKS = 6
GRIPPER_TICKS = 10
MAX_JOINT_STEP = 0.35
"""A larger change [rad] in one tick means that the straight path crosses a singularity."""
JOINT_SPEED = 1.5
"""Peak joint speed [rad/s] of the joint-space fallback."""
MAX_JOINT_SPEED = np.pi
"""Joint speed limit [rad/s] of the UR5e, which servo control keeps to."""
STOP_LAG = 0.25
"""The arm stops when a joint is this far [rad] behind its reference: it pushes against something."""

OnTick = Callable[[Tick], None]


class Controller:
    """Executes motions tick by tick on a simulation. ``gripper`` is the command in force."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self.on_tick: OnTick | None = None
        self.gripper_delay = 0
        """Ticks until the gripper takes a command."""
        self.ticks = 0
        self.reset(1.0)

    def reset(self, gripper: float) -> None:
        """Forget the past; the arm is at home."""
        self.reference = self._simulation.home.copy()
        self.gripper = gripper
        self.ticks = 0

    def plan(self, via: Sequence[Pose], target: Pose, speed: float = MAX_SPEED) -> list[Float[np.ndarray, " 6"]] | None:
        """Joint references [rad] per tick, or None where ``target`` is out of reach.

        The path is straight with rounded corners; if the arm cannot follow it, it goes straight in joint space.
        """
        start = self._simulation.kinematics.tool_pose(self.reference)
        joints, plan = self.reference, []
        for pose in timed_path([start, *via, target], speed):
            following = self._simulation.kinematics.solve(pose, joints)
            if following is None or np.abs(following - joints).max() > MAX_JOINT_STEP:
                return self._plan_in_joint_space(target)
            plan.append(following)
            joints = following
        return plan

    def _plan_in_joint_space(self, target: Pose) -> list[Float[np.ndarray, " 6"]] | None:
        turned = ELBOW_UP + np.arctan2(target.position[1], target.position[0]) * np.eye(6)[0]
        for seed in (self.reference, self._simulation.home, turned):
            goal = self._simulation.kinematics.solve(target, seed)
            if goal is not None:
                ticks = max(2, int(np.ceil(1.5 * np.abs(goal - self.reference).max() / JOINT_SPEED / TICK)))
                share = np.arange(1, ticks + 1) / ticks
                share = share * share * (3 - 2 * share)
                return list(self.reference + share[:, None] * (goal - self.reference))
        return None

    def execute(self, motion: Motion) -> bool:
        """Move, arrive, drive the gripper if its command changes, dwell. False (the arm stays) if out of reach."""
        plan = self.plan(motion.via, motion.target, motion.speed)
        if plan is not None and self.follow(plan):
            self._arrive(motion.target)
        if motion.gripper != self.gripper:
            late = min(self.gripper_delay, GRIPPER_TICKS)
            self.hold(late)
            self.gripper = motion.gripper
            self.hold(GRIPPER_TICKS - late)
        self.hold(motion.dwell)
        return plan is not None

    def servo(self, target: Pose, gripper: float) -> bool:
        """One tick towards ``target``, no joint above ``MAX_JOINT_SPEED``. False (the arm stays) if out of reach."""
        self.gripper = gripper
        goal = self._simulation.kinematics.solve(target, self.reference)
        change = np.zeros(6) if goal is None else goal - self.reference
        self.follow([self.reference + change * min(1, MAX_JOINT_SPEED * TICK / max(np.abs(change).max(), 1e-9))])
        return goal is not None

    def follow(self, plan: Sequence[Float[np.ndarray, " 6"]]) -> bool:
        """Execute joint references; False if a protective stop ended the motion."""
        for joints in plan:
            self._tick(joints)
            if np.abs(self._simulation.joints() - self.reference).max() > STOP_LAG:
                self.reference = self._simulation.joints()
                return False
        return True

    def hold(self, ticks: int) -> None:
        """Keep the reference for a number of ticks."""
        for _ in range(ticks):
            self._tick(self.reference)

    def _arrive(self, target: Pose) -> None:
        for _ in range(MAX_SETTLE_TICKS):
            tool = self._simulation.tool_pose()
            near = np.linalg.norm(tool.position - target.position) < ARRIVED
            if near and angle_between(tool.quaternion, target.quaternion) < ARRIVED_TURN:
                return
            self.hold(1)

    def _tick(self, joints: Float[np.ndarray, " 6"]) -> None:
        if self.on_tick is not None:
            pose = self._simulation.kinematics.tool_pose(joints)
            self.on_tick(Tick(make_action(pose, self.gripper)))
        self._simulation.tick(self.reference, joints, self.gripper)
        self.reference = joints
        self.ticks += 1
