"""Rotations, poses, projection and deprojection in numpy: one quaternion order, one frame convention.

* World = robot base, metres, z up. Camera frame: x right, y down, z forward (OpenCV).
* ``T_world_cam`` maps camera points to world points.
* Quaternions are ``w, x, y, z``, unit and canonical (first non-zero component positive, so w >= 0).
* The centre of the pixel in column u, row v is ``(u, v)``; a symmetric camera has ``cx = (width - 1) / 2``.
"""

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from lerobot_histmv import keys

UNIT_TOLERANCE = 1e-2
"""How far from 1 a quaternion's norm may be before the data is refused."""


def canonical(quaternion: ArrayLike) -> Float[np.ndarray, "... 4"]:
    """The one of q and -q whose first non-zero component is positive; both are the same rotation."""
    q = np.asarray(quaternion, dtype=np.float64)
    first = np.take_along_axis(q, (np.abs(q) > 1e-12).argmax(-1)[..., None], axis=-1)
    return np.where(first < 0, -q, q)


def unit_quaternion(quaternion: ArrayLike, what: str = "quaternion") -> Float[np.ndarray, "... 4"]:
    """Canonical unit quaternion, or ValueError naming ``what`` if the norm is not 1 within ``UNIT_TOLERANCE``."""
    q = np.asarray(quaternion, dtype=np.float64)
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    if not np.all(np.abs(norm - 1) < UNIT_TOLERANCE):
        worst = q.reshape(-1, 4)[np.nanargmax(np.nan_to_num(np.abs(norm - 1), nan=np.inf).ravel())]
        raise ValueError(f"{what} {worst.tolist()} is not a unit quaternion (w, x, y, z); its norm must be 1")
    return canonical(q / norm)


def odd_gripper(gripper: Float[np.ndarray, " n"]) -> int | None:
    """Index of the opening or command furthest outside of 0 (closed) to 1 (open), if it is beyond the slack."""
    away = np.abs(gripper - 0.5)
    worst = int(away.argmax())
    return worst if away[worst] > 0.5 + keys.GRIPPER_SLACK else None


def quaternion_from_matrix(rotation: ArrayLike) -> Float[np.ndarray, "... 4"]:
    """Canonical ``w, x, y, z`` of rotation matrices (..., 3, 3)."""
    return canonical(Rotation.from_matrix(np.asarray(rotation)).as_quat(scalar_first=True))


def matrix_from_quaternion(quaternion: ArrayLike) -> Float[np.ndarray, "... 3 3"]:
    """Rotation matrices of ``w, x, y, z`` quaternions (..., 4)."""
    return Rotation.from_quat(np.asarray(quaternion), scalar_first=True).as_matrix()


def angle_between(first: ArrayLike, second: ArrayLike) -> Float[np.ndarray, "..."]:
    """Angle [rad] in [0, pi] between rotations given as unit quaternions (..., 4)."""
    dot = np.abs(np.sum(np.asarray(first) * np.asarray(second), axis=-1))
    return np.asarray(2 * np.arccos(np.clip(dot, 0, 1)))


def deproject(
    depth: Float[np.ndarray, "h w"], intrinsics: Float[np.ndarray, " 4"], world_from_cam: Float[np.ndarray, "3 4"]
) -> Float[np.ndarray, "h w 3"]:
    """World points [m] of a depth image [m] (distance along the optical axis).

    Args:
        depth: z in the camera frame; pixels without a measurement hold 0 and map to the camera's centre.
        intrinsics: fx, fy, cx, cy in pixels.
        world_from_cam: ``T_world_cam``.
    """
    fx, fy, cx, cy = intrinsics
    v, u = np.indices(depth.shape)
    in_camera = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(depth.shape)], axis=-1) * depth[..., None]
    return in_camera @ world_from_cam[:, :3].T + world_from_cam[:, 3]


def project(
    points: Float[np.ndarray, "... 3"], intrinsics: Float[np.ndarray, " 4"], world_from_cam: Float[np.ndarray, "3 4"]
) -> tuple[Float[np.ndarray, "... 2"], Float[np.ndarray, "..."]]:
    """Pixel coordinates (u, v) and depth z [m] of world points [m]; behind the camera z <= 0 and pixels are NaN."""
    fx, fy, cx, cy = intrinsics
    in_camera = (np.asarray(points) - world_from_cam[:, 3]) @ world_from_cam[:, :3]
    x, y, z = np.moveaxis(in_camera, -1, 0)
    ahead = np.where(z > 0, z, np.nan)
    return np.stack([fx * x / ahead + cx, fy * y / ahead + cy], axis=-1), z
