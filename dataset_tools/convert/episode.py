"""An episode of another format in the terms of ours: conventions are changed here and nowhere else."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32, UInt8, UInt16

from dataset_tools.calibrate.checks import pinhole, rigid
from lerobot_histmv import keys
from lerobot_histmv.geometry import unit_quaternion

_TURN_ABOUT_AXIS = np.diag([-1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Camera:
    """One camera over an episode.

    Attributes:
        rgb: colours.
        depth: millimetres along the optical axis, 0 = invalid.
        intrinsics: fx, fy, cx, cy [pixels]; pixel (u, v) has its centre at (u, v).
        extrinsics: rows of ``T_world_cam``, axes x right, y down, z ahead.
    """

    rgb: UInt8[np.ndarray, "n y x 3"]
    depth: UInt16[np.ndarray, "n y x 1"]
    intrinsics: Float[np.ndarray, "n 4"]
    extrinsics: Float[np.ndarray, "n 12"]


@dataclass(frozen=True, eq=False)
class Motion:
    """The arm over an episode.

    Attributes:
        position: tool [m] in the world.
        quaternion: its rotation, w, x, y, z.
        opening: measured gripper, 1 open.
        command: gripper command in force from each frame on, 1 open.
        joints: joint angles [rad].
    """

    position: Float[np.ndarray, "n 3"]
    quaternion: Float[np.ndarray, "n 4"]
    opening: Float[np.ndarray, " n"]
    command: Float[np.ndarray, " n"]
    joints: Float[np.ndarray, "n j"]

    def state(self) -> Float32[np.ndarray, "n s"]:
        """What was measured: pose, opening, joints."""
        parts = [self.position, self.quaternion, self.opening[:, None], self.joints]
        return np.hstack(parts).astype(np.float32)

    def action(self) -> Float32[np.ndarray, "n 8"]:
        """The pose of the frame after (the last one's own), and the gripper command."""
        pose = np.hstack([self.position, self.quaternion])
        following = np.vstack([pose[1:], pose[-1:]])
        return np.hstack([following, self.command[:, None]]).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode; ``name`` says where it comes from, ``instructions`` are the paraphrases of what was asked for."""

    name: str
    task: str
    variation: int
    instructions: Sequence[str]
    cameras: Mapping[str, Camera]
    motion: Motion

    def columns(self) -> dict[str, np.ndarray]:
        """Columns of a dense dataset."""
        cameras = self.cameras.values()
        columns: dict[str, np.ndarray] = {keys.rgb_key(name): camera.rgb for name, camera in self.cameras.items()}
        columns |= {keys.depth_key(name): camera.depth for name, camera in self.cameras.items()}
        columns[keys.STATE] = self.motion.state()
        columns[keys.INTRINSICS] = np.hstack([camera.intrinsics for camera in cameras]).astype(np.float32)
        columns[keys.EXTRINSICS] = np.hstack([camera.extrinsics for camera in cameras]).astype(np.float32)
        columns[keys.ACTION] = self.motion.action()
        return columns


def relative_to(episode: Episode, base: Float[np.ndarray, " 3"]) -> Episode:
    """The same episode in a world whose origin is at ``base`` [m] and whose axes are the old ones."""
    shift = np.zeros(12)
    shift[3::4] = base
    cameras = {name: replace(camera, extrinsics=camera.extrinsics - shift) for name, camera in episode.cameras.items()}
    motion = replace(episode.motion, position=episode.motion.position - base)
    return replace(episode, cameras=cameras, motion=motion)


class EpisodeSource(ABC):
    """Episodes of another format, found and described, not yet read.

    Attributes:
        names: where each comes from, relative to the source.
        sizes: height and width of the images, by camera.
        joints: number of joint angles in the state.
        fps: frames per second, if the source tells.
        robot_type: the arm, if the source tells.
    """

    names: Sequence[str]
    sizes: Mapping[str, tuple[int, int]]
    joints: int
    fps: int | None
    robot_type: str | None

    @abstractmethod
    def read(self, index: int) -> Episode:
        """One episode; ValueError names what is wrong with it."""


def wxyz(quaternion_xyzw: Float[np.ndarray, "n 4"], what: str) -> Float[np.ndarray, "n 4"]:
    """Canonical unit quaternions of ``x, y, z, w``, the order of CoppeliaSim and robosuite."""
    return unit_quaternion(quaternion_xyzw[:, [3, 0, 1, 2]], what)


def calibration(
    matrices: Float[np.ndarray, "n r c"],
    poses: Float[np.ndarray, "n p q"],
    pixel_centre: float,
    size: tuple[int, int],
    what: str,
) -> tuple[Float[np.ndarray, "n 4"], Float[np.ndarray, "n 12"]]:
    """Intrinsics and extrinsics in our conventions.

    A camera matrix with negative focal lengths belongs to a camera whose x points left and y up (CoppeliaSim). Turned
    by half a turn about its optical axis it is one with positive focal lengths that sees the same pixels.

    Args:
        matrices: 3x3 camera matrices.
        poses: camera poses in the world, 3x4 or 4x4.
        pixel_centre: where ``matrices`` place the centre of the first pixel: 0.5 if they count from its corner.
        size: height and width of the images.
        what: begins the messages.

    Raises:
        ValueError: matrices that are no pinhole camera without skew, or poses that are not rigid.
    """
    if matrices.shape[-2:] != (3, 3):
        raise ValueError(f"{what}: the camera matrix has shape {matrices.shape[-2:]}; it must be 3x3")
    skew = np.abs(matrices[:, [0, 1, 2, 2], [1, 0, 0, 1]]).max() + np.abs(matrices[:, 2, 2] - 1).max()
    focal = matrices[:, [0, 1], [0, 1]]
    signs = np.sign(focal[0])
    if skew > 1e-6 or signs[0] != signs[1] or (np.sign(focal) != signs).any():
        raise ValueError(
            f"{what}: {matrices[0].tolist()} is no camera matrix fx 0 cx, 0 fy cy, 0 0 1 with fx, fy alike"
        )
    extrinsics = rigid(poses, f"{what}: the pose")
    if signs[0] < 0:
        extrinsics = np.concatenate([extrinsics[..., :3] @ _TURN_ABOUT_AXIS, extrinsics[..., 3:]], axis=-1)
    intrinsics = np.hstack([np.abs(focal), matrices[:, :2, 2] - pixel_centre])
    return pinhole(intrinsics, size, what), extrinsics.reshape(-1, 12)
