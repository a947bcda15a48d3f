"""Checks of camera calibration: intrinsics that fit the image, rotations that are rotations, cameras that move."""

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from dataset_tools.doctor.findings import Finding
from lerobot_histmv.geometry import project

FOCAL = (0.2, 20.0)
"""Accepted focal lengths, in image sizes: fields of view from 136 down to 3 degrees."""
OFF_CENTRE = 0.2
"""How far the principal point may be from the image's centre, in image sizes."""
ROTATION_TOLERANCE = 1e-3
"""Largest accepted entry of R'R - 1."""
TOOL_MOVES = 0.05
"""A camera on the tool must move when the tool moves this far [m]."""
STILL = 1e-6
"""Changes of T_world_cam below this are none."""
MOSTLY = 0.5
"""Share of an episode's frames in which some view must hold the tool."""
LOOKED_AT = 30
"""How many frames of an episode are looked at for that."""
FAR = 10
"""Where no tool is [m]."""

_ON_TOOL = {"wrist", "hand", "gripper", "ee", "eef", "tcp", "tool", "eih", "effector", "flange"}


def on_tool(camera: str) -> bool:
    """Whether a camera's name tells that it moves with the tool."""
    return bool(_ON_TOOL & set(re.split("[^a-z]+", camera.lower())))


def intrinsics_size(
    intrinsics: Float[np.ndarray, "n 4"], size: tuple[int, int], camera: str, episode: int
) -> list[Finding]:
    """fx, fy, cx, cy [pixels] belong to images of ``size`` (rows, columns)."""
    image = np.array(size[::-1])
    focal, centre = intrinsics[:, :2], intrinsics[:, 2:]
    good = (focal >= FOCAL[0] * image) & (focal <= FOCAL[1] * image)
    good &= np.abs(centre - (image - 1) / 2) <= OFF_CENTRE * image
    bad = np.flatnonzero(~good.all(axis=1))
    if not len(bad):
        return []
    fx, fy, cx, cy = intrinsics[bad[0]]
    message = (
        f"fx {fx:.5g}, fy {fy:.5g}, cx {cx:.5g}, cy {cy:.5g}, as of an image about {2 * cx + 1:.0f} wide and "
        f"{2 * cy + 1:.0f} high, but it is {image[0]} wide and {image[1]} high"
    )
    return [Finding.of("intrinsics_size", message, episode, int(bad[0]), camera)]


def extrinsics_rotation(extrinsics: Float[np.ndarray, "n 3 4"], camera: str, episode: int) -> list[Finding]:
    """The left 3 x 3 of T_world_cam is orthonormal with determinant 1."""
    rotation = extrinsics[..., :3]
    error = np.abs(np.swapaxes(rotation, -1, -2) @ rotation - np.eye(3)).max(axis=(-1, -2))
    mirrored = np.linalg.det(rotation) < 0
    bad = np.flatnonzero((error > ROTATION_TOLERANCE) | mirrored)
    if not len(bad):
        return []
    message = f"R'R differs from 1 by {error[bad[0]]:.2g}"
    if mirrored[bad[0]]:
        message = "R is mirrored (its determinant is negative)"
    return [Finding.of("extrinsics_rotation", message, episode, int(bad[0]), camera)]


def is_still(extrinsics: Float[np.ndarray, "n 3 4"]) -> bool:
    """Whether T_world_cam stays the same."""
    return bool(np.ptp(extrinsics, axis=0).max() <= STILL)


def extrinsics_constant(
    extrinsics: Float[np.ndarray, "n 3 4"], position: Float[np.ndarray, "n 3"], camera: str, episode: int
) -> list[Finding]:
    """A camera that is called after the tool moves when the tool moves."""
    moved = float(np.linalg.norm(position - position[0], axis=-1).max())
    if not on_tool(camera) or moved < TOOL_MOVES or not is_still(extrinsics):
        return []
    message = f"the tool moves {moved:.2f} m, but T_world_cam of its camera stays the same"
    return [Finding.of("extrinsics_constant", message, episode, camera=camera)]


def tool_outside(
    position: Float[np.ndarray, "n 3"],
    views: Sequence[tuple[Float[np.ndarray, "n 4"], Float[np.ndarray, "n 3 4"], tuple[int, int]]],
    episode: int,
) -> list[Finding]:
    """Some view holds the tool in most frames.

    Args:
        position: of the tool [m].
        views: intrinsics [pixels], T_world_cam, and rows and columns of every camera.
        episode: which episode.
    """
    frames = evenly(len(position), LOOKED_AT)
    lost = [
        frame for frame in frames if not any(holds(position[frame], k[frame], t[frame], size) for k, t, size in views)
    ]
    if len(lost) <= MOSTLY * len(frames):
        return []
    x, y, z = position[lost[0]]
    message = f"in {len(lost)} of {len(frames)} frames looked at; here it is at ({x:.4g}, {y:.4g}, {z:.4g}) m"
    if np.abs(position).max() > FAR:
        message += ", which looks like millimetres"
    return [Finding.of("tool_outside", message, episode, lost[0])]


def holds(
    point: Float[np.ndarray, " 3"],
    intrinsics: Float[np.ndarray, " 4"],
    extrinsics: Float[np.ndarray, "3 4"],
    size: tuple[int, int],
) -> bool:
    """Whether a world point [m] lies in an image of ``size`` (rows, columns)."""
    pixels, _ = project(point[None], intrinsics, extrinsics)
    u, v = pixels[0]
    return bool(-0.5 <= u <= size[1] - 0.5 and -0.5 <= v <= size[0] - 0.5)


def evenly(length: int, count: int) -> list[int]:
    """At most ``count`` of the numbers below ``length``, evenly spread, first and last among them."""
    return sorted(set(np.linspace(0, length - 1, min(length, count)).round().astype(int).tolist()))
