"""What there is to draw of one episode: its key poses, what was seen at them, and the recorded path if it is known."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Shaped

from dataset_tools.fitness import Distance, path_deviations
from dataset_tools.inspect.cameras import CameraView
from dataset_tools.keyframes import KeyframeOptions, curve, moving_frames
from dataset_tools.signals import Keyframe, Trajectory
from lerobot_histmv import keys


@dataclass(frozen=True, eq=False)
class KeyPose:
    """One keyframe as a policy learns it.

    Attributes:
        reason: why it was kept, one of ``keys.REASONS``.
        position: tool position [m] (3,), or joint angles [rad].
        quaternion: tool rotation, unit w, x, y, z; None if not recorded.
        gripper: command in force from here on, 1 open, 0 closed; None if not known.
        frames: where it lies in the recorded episode; None if not known.
    """

    reason: str
    position: Float[np.ndarray, " d"]
    quaternion: Float[np.ndarray, " 4"] | None = None
    gripper: float | None = None
    frames: Keyframe | None = None


@dataclass(frozen=True, eq=False)
class Observation:
    """What was measured at a keyframe's observation frame.

    Attributes:
        seconds: its time in the recorded episode.
        position: measured tool position [m] (3,), or joint angles [rad].
        quaternion: measured tool rotation, unit w, x, y, z; None if not recorded.
        views: what each camera saw.
    """

    seconds: float
    position: Float[np.ndarray, " d"]
    quaternion: Float[np.ndarray, " 4"] | None
    views: Mapping[str, CameraView]


@dataclass(frozen=True, eq=False)
class Motion:
    """The recorded path of an episode of n frames.

    Attributes:
        trajectory: what the tool did.
        keyframes: at least two, in order of time.
        options: how they were chosen.
        errors: distance of each frame to the path between the keyframes [m or rad] (n,); NaN while the arm rests.
    """

    trajectory: Trajectory
    keyframes: Sequence[Keyframe]
    options: KeyframeOptions
    errors: Float[np.ndarray, " n"]

    @classmethod
    def of(cls, trajectory: Trajectory, keyframes: Sequence[Keyframe], options: KeyframeOptions) -> "Motion":
        """Motion with its errors filled in."""
        points = curve(trajectory, options.rotation_scale)
        return cls(trajectory, keyframes, options, frame_errors(points, keyframes, options.distance))


@dataclass(frozen=True, eq=False)
class Episode:
    """Everything that is drawn of one episode.

    Attributes:
        number: its index in the inspected dataset.
        instruction: the task's text.
        poses: the k >= 2 keyframes.
        observations: what was seen at the first of them: all k of a dense dataset, k - 1 of a keyframed one.
        motion: the recorded path; None if only the keyframes are known.
        is_joints: positions are joint angles [rad], not tool positions [m].
        notes: sentences about what is missing or assumed.
    """

    number: int
    instruction: str
    poses: Sequence[KeyPose]
    observations: Sequence[Observation]
    motion: Motion | None
    is_joints: bool
    notes: Sequence[str]

    @property
    def unit(self) -> str:
        """Unit of positions and errors."""
        return "rad" if self.is_joints else "m"

    @property
    def cameras(self) -> list[str]:
        """Cameras that saw it."""
        return list(self.observations[0].views)


def frame_errors(
    points: Float[np.ndarray, "n d"], keyframes: Sequence[Keyframe], distance: Distance
) -> Float[np.ndarray, " n"]:
    """Distance of every recorded frame to the simplified path, in the unit of ``points``; NaN while the arm rests.

    Frames of a rest count neither here nor in the error that ``extract`` tells; the others do, also those that the
    search left out of a long path.
    """
    moving = moving_frames(list(keyframes))
    kept = np.searchsorted(moving, [keyframe.pose_frame for keyframe in keyframes])
    errors = np.full(len(points), np.nan)
    errors[moving] = path_deviations(points[moving], kept, distance)
    return errors


def key_poses(
    labels: Shaped[np.ndarray, "k a"], names: Sequence[str], reasons: Sequence[str], frames: Sequence[Keyframe | None]
) -> list[KeyPose]:
    """Key poses out of action labels.

    Args:
        labels: rows of ``trajectories.labels``.
        names: names of their entries, as ``trajectories.label_names`` gives them.
        reasons: why each was kept.
        frames: where each lies in the recorded episode.
    """
    turned, gripped = set(keys.QUATERNION_NAMES) <= set(names), keys.GRIPPER_NAME in names
    size = len(names) - 4 * turned - gripped
    return [
        KeyPose(
            reason=reason,
            position=label[:size].astype(np.float64),
            quaternion=label[size : size + 4].astype(np.float64) if turned else None,
            gripper=float(label[-1]) if gripped else None,
            frames=keyframe,
        )
        for label, reason, keyframe in zip(labels, reasons, frames, strict=True)
    ]
