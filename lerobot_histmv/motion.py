"""Poses, motions and the blended Cartesian paths between them, in plain numpy.

A motion leads through via points without stopping (its corners are rounded) to a target, where the gripper then acts.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from lerobot_histmv.geometry import canonical

TICK = 0.05
"""Control period [s]: 20 Hz."""
MAX_SPEED = 0.5
"""Default peak speed of the tool [m/s]."""
MAX_TURN_RATE = 2.0
"""Peak angular speed of the tool [rad/s]."""
MAX_ACCELERATION = 3.0
"""Peak acceleration along the path [m/s^2]."""
BLEND_RADIUS = 0.04
"""Distance from a via point at which the path leaves the straight line [m]."""
SAMPLES_PER_SEGMENT = 64

Point = Sequence[float] | Float[np.ndarray, " 3"]
"""x, y, z [m]."""


@dataclass(frozen=True, eq=False)
class Pose:
    """Pose of the tool (the pinch point between the finger pads, z from there to the wrist) in the base frame.

    Args:
        position: x, y, z [m], shape (3,).
        quaternion: w, x, y, z, unit and canonical, shape (4,).
    """

    position: Float[np.ndarray, " 3"]
    quaternion: Float[np.ndarray, " 4"]

    def moved(self, offset: Point) -> "Pose":
        """The same orientation, ``offset`` [m, base frame] away."""
        return Pose(self.position + np.asarray(offset, dtype=np.float64), self.quaternion)

    def raised(self, height: float) -> "Pose":
        """The same pose ``height`` [m] further up."""
        return self.moved((0, 0, height))

    def retracted(self, distance: float) -> "Pose":
        """The same pose ``distance`` [m] back along the tool's own z axis, towards the wrist."""
        return self.moved(distance * _rotation(self).as_matrix()[:, 2])

    def turned(self, axis: Point, angle: float, pivot: Point | None = None) -> "Pose":
        """Turned by ``angle`` [rad] about ``axis`` (base frame, unit) through ``pivot`` [m]; None: about itself."""
        turn = Rotation.from_rotvec(angle * np.asarray(axis, dtype=np.float64))
        centre = self.position if pivot is None else np.asarray(pivot, dtype=np.float64)
        position = centre + turn.apply(self.position - centre)
        return Pose(position, canonical((turn * _rotation(self)).as_quat(scalar_first=True)))


def top_down(position: Point, yaw: float = 0.0) -> Pose:
    """Pose of a gripper that points straight down, its fingers apart along the y axis turned by ``yaw`` [rad]."""
    quaternion = canonical([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
    return Pose(np.asarray(position, dtype=np.float64), quaternion)


def _rotation(pose: Pose) -> Rotation:
    return Rotation.from_quat(pose.quaternion, scalar_first=True)


@dataclass(frozen=True)
class Motion:
    """What an expert does next: pass by ``via`` without stopping, stop at ``target``, then command the gripper.

    Args:
        via: poses near which the path bends; it comes within about 1.5 cm of them.
        target: pose at which the arm stops.
        gripper: command given there, 1 open, 0 closed.
        speed: peak speed of the tool [m/s].
        dwell: ticks of ``TICK`` seconds to rest at the end.
    """

    via: tuple[Pose, ...]
    target: Pose
    gripper: float
    speed: float = MAX_SPEED
    dwell: int = 2

    def actions(self, gripper_before: float) -> list[Float[np.ndarray, " 8"]]:
        """The same motion as straight macro steps: one action per via point and one for the target."""
        steps = [(pose, gripper_before) for pose in self.via] + [(self.target, self.gripper)]
        return [make_action(pose, gripper) for pose, gripper in steps]


@dataclass(frozen=True, eq=False)
class Tick:
    """One control period about to be simulated.

    Args:
        action: tool pose commanded for the period's end and the gripper command in force (``keys.POSE_NAMES``), (8,).
    """

    action: Float[np.ndarray, " 8"] = field(repr=True)


def make_action(pose: Pose, gripper: float) -> Float[np.ndarray, " 8"]:
    """Action vector (``keys.POSE_NAMES``), float32, of a tool pose and a gripper command."""
    return np.concatenate([pose.position, pose.quaternion, [gripper]]).astype(np.float32)


def _smoothstep(u: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    return u * u * (3 - 2 * u)


def _round_corner(
    positions: Float[np.ndarray, "n 3"], tau: Float[np.ndarray, " n"], corners: Float[np.ndarray, "c 3"], at: int
) -> None:
    """Replace the polyline around ``corners[at]`` by a quadratic Bezier curve, in place."""
    before, after = (float(np.linalg.norm(corners[at] - corners[at + step])) for step in (-1, 1))
    radius = min(BLEND_RADIUS, before / 2, after / 2)
    if radius < 1e-6:
        return
    reach_in, reach_out = radius / before, radius / after
    s = np.where(tau < at, 0.5 + (tau - at) / (2 * reach_in), 0.5 + (tau - at) / (2 * reach_out))
    near = (s > 0) & (s < 1)
    s = s[near, None]
    first = corners[at] + (corners[at - 1] - corners[at]) * reach_in
    last = corners[at] + (corners[at + 1] - corners[at]) * reach_out
    positions[near] = (1 - s) ** 2 * first + 2 * s * (1 - s) * corners[at] + s**2 * last


def _geometric_path(waypoints: Sequence[Pose]) -> tuple[Float[np.ndarray, "n 3"], Rotation]:
    """Finely sampled positions and orientations along the rounded polyline; turning eases in and out per segment."""
    corners = np.array([pose.position for pose in waypoints])
    turns = Rotation.from_quat([pose.quaternion for pose in waypoints], scalar_first=True)
    segments = len(waypoints) - 1
    tau = np.linspace(0, segments, segments * SAMPLES_PER_SEGMENT + 1)
    index = np.minimum(tau.astype(int), segments - 1)
    fraction = tau - index
    positions = corners[index] + fraction[:, None] * (corners[index + 1] - corners[index])
    for corner in range(1, segments):
        _round_corner(positions, tau, corners, corner)
    steps = (turns[1:] * turns[:-1].inv()).as_rotvec()
    return positions, Rotation.from_rotvec(steps[index] * _smoothstep(fraction)[:, None]) * turns[index]


def timed_path(
    waypoints: Sequence[Pose], speed: float, turn_rate: float = MAX_TURN_RATE, tick: float = TICK
) -> list[Pose]:
    """Poses at the end of every ``tick`` [s] of one smooth motion through ``waypoints`` (the first is where it starts).

    The motion starts and ends at rest and keeps to ``speed`` [m/s], ``turn_rate`` [rad/s] and ``MAX_ACCELERATION``.
    """
    positions, rotations = _geometric_path(waypoints)
    moved = np.linalg.norm(np.diff(positions, axis=0), axis=1) / speed
    turned = (rotations[1:] * rotations[:-1].inv()).magnitude() / turn_rate
    clock = np.concatenate([[0], np.cumsum(np.maximum(moved, turned))])
    duration = max(1.5 * clock[-1], np.sqrt(6 * clock[-1] * speed / MAX_ACCELERATION))
    ticks = max(1, int(np.ceil(duration / tick)))
    when = _smoothstep(np.arange(1, ticks + 1) / ticks) * clock[-1]
    place = np.interp(when, clock, np.arange(len(clock)))
    low = np.minimum(place.astype(int), len(clock) - 2)
    share = place - low
    at = positions[low] + share[:, None] * (positions[low + 1] - positions[low])
    between = (rotations[low + 1] * rotations[low].inv()).as_rotvec() * share[:, None]
    quaternions = canonical((Rotation.from_rotvec(between) * rotations[low]).as_quat(scalar_first=True))
    return [Pose(p, q) for p, q in zip(at, quaternions, strict=True)]
