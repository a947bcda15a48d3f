"""A decision held over many ticks of a control loop: move, drive the gripper, settle, then ask for the next one.

In plain numpy; one ``HeldStep`` per robot. What it puts out is a smooth, straight path, so that whatever was decided
and whatever is measured, no output leaves the box or moves faster than the limits (paper 4.6).
"""

import math
from collections import deque
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float

from lerobot_histmv.geometry import angle_between, unit_quaternion
from lerobot_histmv.model.config import check_box
from lerobot_histmv.motion import MAX_SPEED, MAX_TURN_RATE, Pose, make_action, timed_path


@dataclass(frozen=True)
class ControlConfig:
    """How a decision becomes outputs.

    Args:
        rate: calls of ``select_action`` per second of the robot's time. 0: each call is a whole macro step, for
            environments that execute one; only ``box`` then matters.
        box: lower and upper corner [m] of the box that no output leaves; empty for the network's workspace.
        speed: largest speed of the output [m/s].
        turn_rate: largest angular speed of the output [rad/s].
        tolerance: the target is reached when the tool is this close to it [m] ...
        turn_tolerance: ... and this close [rad].
        lead: the output waits where its next pose would be further ahead of the tool than this [m] ...
        turn_lead: ... or this [rad].
        timeout: how long the output may wait for the tool during one step [s]; then it returns to where the tool is,
            and the step goes on from there.
        gripper_time: how long the gripper is given when its command changes [s].
        settle_time: rest at the end of a step [s].
    """

    rate: float = 0.0
    box: tuple[float, ...] = ()
    speed: float = MAX_SPEED
    turn_rate: float = MAX_TURN_RATE
    tolerance: float = 0.002
    turn_tolerance: float = 0.02
    lead: float = 0.1
    turn_lead: float = 0.5
    timeout: float = 1.0
    gripper_time: float = 0.5
    settle_time: float = 0.1

    def __post_init__(self) -> None:
        for name in (field.name for field in fields(self) if field.name != "box"):
            value = getattr(self, name)
            if not math.isfinite(value) or value < 0 or (value == 0 and name in ("speed", "turn_rate")):
                raise ValueError(f"control.{name}={value} must be a finite number, not negative; speeds above 0")
        if self.box:
            check_box("control.box", self.box)
        if self.rate and (self.lead * self.rate <= self.speed or self.turn_lead * self.rate <= self.turn_rate):
            raise ValueError(
                f"control.lead={self.lead} m and turn_lead={self.turn_lead} rad must exceed one tick's way at "
                f"{self.speed} m/s, {self.turn_rate} rad/s and {self.rate} ticks per second, else nothing moves"
            )

    def ticks(self, seconds: float) -> int:
        """Ticks that last at least ``seconds``."""
        return math.ceil(seconds * self.rate - 1e-9)


class HeldStep:
    """What one robot is doing: the macro step under way, tick by tick.

    Args:
        config: limits and times; ``rate`` above 0.
        low: lower corner of the box [m].
        high: upper corner of the box [m].
        state: measured tool pose and gripper opening (``keys.POSE_NAMES``) at the start.

    Raises:
        ValueError: the tool is outside of the box, or the state is no pose.
    """

    def __init__(
        self,
        config: ControlConfig,
        low: Float[np.ndarray, " 3"],
        high: Float[np.ndarray, " 3"],
        state: Float[np.ndarray, " 8"],
    ) -> None:
        self._config, self._low, self._high = config, low, high
        tool = measured_pose(state)
        self._output = self._inside(tool)
        outside = np.linalg.norm(tool.position - self._output.position)
        if outside > config.speed / config.rate:
            raise ValueError(
                f"the tool is at {tool.position.round(3).tolist()} m, {outside:.3f} m outside of the box from "
                f"{low.round(3).tolist()} to {high.round(3).tolist()}; move it inside, or enlarge policy.control.box"
            )
        self._gripper = self._next_gripper = float(state[7] > 0.5)
        self._path: deque[Pose] = deque()
        self._moving = self._timed_out = False
        self._waited = self._rest = 0

    def begin(self, decision: Float[np.ndarray, " 8"], state: Float[np.ndarray, " 8"]) -> Float[np.ndarray, " 8"]:
        """Start a macro step towards ``decision`` (``keys.POSE_NAMES``), and give the command for its first tick.

        Raises:
            ValueError: the decision or the state is no pose.
        """
        if not np.isfinite(decision).all():
            raise ValueError(f"the decision {decision.tolist()} is not finite: the robot stays where it is")
        self._set_path(self._inside(Pose(decision[:3], unit_quaternion(decision[3:7], "the decision's quaternion"))))
        self._next_gripper = float(decision[7] > 0.5)
        self._moving, self._timed_out, self._waited = True, False, 0
        drive = self._config.gripper_time if self._next_gripper != self._gripper else 0.0
        self._rest = self._config.ticks(drive) + self._config.ticks(self._config.settle_time)
        self._advance(measured_pose(state))
        return make_action(self._output, self._gripper)

    def output(self, state: Float[np.ndarray, " 8"]) -> Float[np.ndarray, " 8"] | None:
        """Command for the coming tick (``keys.POSE_NAMES``), float32; None when a decision is due.

        Raises:
            ValueError: the state is no pose.
        """
        tool = measured_pose(state)
        if self._moving:
            self._advance(tool)
        if not self._moving:
            if not self._rest:
                return None
            self._rest -= 1
            self._gripper = self._next_gripper
        return make_action(self._output, self._gripper)

    def _advance(self, tool: Pose) -> None:
        config = self._config
        if self._path:
            free = self._timed_out or is_near(tool, self._path[0], config.lead, config.turn_lead)
        else:
            free = self._timed_out or is_near(tool, self._output, config.tolerance, config.turn_tolerance)
        if not free and self._waited < config.ticks(config.timeout):
            self._waited += 1
            return
        if not free:
            self._timed_out = True
            self._set_path(self._inside(tool))
        if self._path:
            self._output = self._path.popleft()
        else:
            self._moving = False

    def _set_path(self, target: Pose) -> None:
        config = self._config
        self._path = deque(timed_path([self._output, target], config.speed, config.turn_rate, 1 / config.rate))

    def _inside(self, pose: Pose) -> Pose:
        return Pose(np.clip(pose.position, self._low, self._high), pose.quaternion)


def measured_pose(state: Float[np.ndarray, " 8"]) -> Pose:
    """The tool pose in a measured state.

    Raises:
        ValueError: a number is not finite, or the quaternion is not unit.
    """
    if not np.isfinite(state).all():
        raise ValueError(f"observation.state {state.tolist()} is not finite: the policy stops rather than act on it")
    return Pose(state[:3], unit_quaternion(state[3:7], "the quaternion of observation.state"))


def is_near(first: Pose, second: Pose, distance: float, angle: float) -> bool:
    """Whether two poses are at most ``distance`` [m] and ``angle`` [rad] apart."""
    apart = np.linalg.norm(first.position - second.position)
    return bool(apart <= distance and angle_between(first.quaternion, second.quaternion) <= angle)
