"""Frames that must be keyframes: the first, the last, pauses of the tool and gripper changes (paper 3.1).

A keyframe has two frames. At its *pose frame* the arm has arrived (and a gripper change is commanded); its *observation
frame* is the last one before the arm moves on, so that the gripper has settled.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from lerobot_histmv.geometry import angle_between

Span = tuple[int, int]
"""First and last frame of a pause."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One recorded episode of n >= 2 frames, as far as keyframing looks at it.

    Attributes:
        position: tool position [m] (n, 3), or joint angles [rad] (n, joints) where no tool position was recorded.
        fps: frames per second.
        quaternion: tool rotation, unit w, x, y, z (n, 4); None if not recorded.
        gripper: command in force from each frame on, 1 open, 0 closed (n,); None without a gripper.
        commanded_position: where the tool was told to be at each frame [m] (n, 3); None if the action does not say.
        commanded_quaternion: and how turned, unit w, x, y, z (n, 4).
    """

    position: Float[np.ndarray, "n d"]
    fps: float
    quaternion: Float[np.ndarray, "n 4"] | None = None
    gripper: Float[np.ndarray, " n"] | None = None
    commanded_position: Float[np.ndarray, "n 3"] | None = None
    commanded_quaternion: Float[np.ndarray, "n 4"] | None = None

    def __len__(self) -> int:
        return len(self.position)


@dataclass(frozen=True)
class Keyframe:
    """A kept pose. ``reason`` is one of ``keys.REASONS``; 0 <= pose_frame <= observation_frame."""

    pose_frame: int
    observation_frame: int
    reason: str

    @property
    def rests(self) -> bool:
        """Whether the arm stands still here, rather than passing through."""
        return self.observation_frame > self.pose_frame


@dataclass(frozen=True)
class PauseOptions:
    """When a tool counts as standing still.

    Args:
        speed: below this tool speed [m/s; rad/s for joint angles].
        turn_speed: and below this rate of rotation [rad/s].
        dwell: for at least this long [s].
        settle: a gripper change up to this long before a pause belongs to it [s].
    """

    speed: float = 0.01
    turn_speed: float = 0.1
    dwell: float = 0.15
    settle: float = 0.25

    def __post_init__(self) -> None:
        for name in ("speed", "turn_speed", "dwell", "settle"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"pause.{name} is {getattr(self, name)}; it must be at least 0")


def pauses(trajectory: Trajectory, options: PauseOptions) -> list[Span]:
    """Spans of frames during which the tool stands still, or is told to, in order, not touching each other.

    A step between two frames is still if it, and most of its neighbourhood of three, is slower than the thresholds: one
    noisy step does not split a pause. The commanded motion counts too: an arm that pushes against something creeps.
    """
    still = _still(trajectory.position, trajectory.quaternion, trajectory.fps, options)
    if trajectory.commanded_position is not None:
        still |= _still(trajectory.commanded_position, trajectory.commanded_quaternion, trajectory.fps, options)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(np.int8)))
    shortest = max(1, round(options.dwell * trajectory.fps))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2) if b - a >= shortest]


def gripper_changes(gripper: Float[np.ndarray, " n"] | None) -> list[int]:
    """Frames at which the command differs from that of the frame before."""
    return [] if gripper is None else (np.flatnonzero(np.diff(gripper)) + 1).tolist()


def mandatory_keyframes(trajectory: Trajectory, options: PauseOptions, asked: Collection[int] = ()) -> list[Keyframe]:
    """Keyframes that every method keeps, in order: the first has pose frame 0, the last is observed at the last frame.

    A pause is one keyframe; one that holds a gripper change is that change's, one at either end of the episode is the
    start's or the end's. Spans from pose to observation frame do not overlap.

    Args:
        trajectory: the episode.
        options: what a pause is.
        asked: frames that the user wants; one inside the span of another keyframe is that keyframe already.

    Raises:
        ValueError: the episode has no such frame.
    """
    last = len(trajectory) - 1
    spans = pauses(trajectory, options)
    found = _gripper_keyframes(trajectory, spans, options)
    for begin, end in spans:
        if begin > 0 and not any(begin <= frame.observation_frame and frame.pose_frame <= end for frame in found):
            rest = _resting_frame(trajectory, begin, end, options)
            found.append(Keyframe(rest, end, "end" if end == last else "pause"))
    waiting = spans[0][1] if spans and spans[0][0] == 0 else 0
    ordered = [Keyframe(0, waiting, "start"), *sorted(found, key=lambda frame: frame.pose_frame)]
    if len(ordered) == 1 or ordered[-1].observation_frame < last:
        ordered.append(Keyframe(last, last, "end"))
    ordered = _with_asked(ordered, asked, last)
    return [
        replace(frame, observation_frame=min(frame.observation_frame, following.pose_frame - 1))
        for frame, following in pairwise(ordered)
    ] + ordered[-1:]


def _with_asked(keyframes: list[Keyframe], asked: Collection[int], last: int) -> list[Keyframe]:
    """All keyframes in order, with those that the user asks for."""
    outside = [frame for frame in asked if not 0 <= frame <= last]
    if outside:
        raise ValueError(f"frames {outside} are asked for, but the episode has frames 0 to {last}")
    new = [
        Keyframe(frame, frame, "user")
        for frame in sorted(set(asked))
        if not any(known.pose_frame <= frame <= known.observation_frame for known in keyframes)
    ]
    return sorted([*keyframes, *new], key=lambda keyframe: keyframe.pose_frame)


def _gripper_keyframes(trajectory: Trajectory, spans: list[Span], options: PauseOptions) -> list[Keyframe]:
    """One keyframe per gripper change, observed at the end of the pause in which, or just before which, it falls."""
    slack = round(options.settle * trajectory.fps)
    found = []
    for change in gripper_changes(trajectory.gripper):
        held = [span for span in spans if span[0] <= change <= span[1]]
        held = held or [span for span in spans if 0 < span[0] - change <= slack]
        found.append(Keyframe(change, held[0][1] if held else change, "gripper"))
    return found


def _resting_frame(trajectory: Trajectory, begin: int, end: int, options: PauseOptions) -> int:
    """First frame of a pause that is within one still step of where the tool rests (the median position)."""
    position = trajectory.position[begin : end + 1]
    away = np.linalg.norm(position - np.median(position, axis=0), axis=-1)
    return begin + int(np.argmax(away <= max(options.speed / trajectory.fps, away.min())))


def _still(
    position: Float[np.ndarray, "n d"], quaternion: Float[np.ndarray, "n 4"] | None, fps: float, options: PauseOptions
) -> Bool[np.ndarray, " steps"]:
    """Which steps from one frame to the next are slower than the thresholds."""
    still = _median3(np.linalg.norm(np.diff(position, axis=0), axis=-1)) * fps < options.speed
    if quaternion is not None:
        still &= _median3(angle_between(quaternion[1:], quaternion[:-1])) * fps < options.turn_speed
    return still


def _median3(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Median of each value and its two neighbours; removes single outliers, keeps edges."""
    padded = np.pad(values, 1, mode="edge")
    return np.median(np.stack([padded[:-2], values, padded[2:]]), axis=0)
