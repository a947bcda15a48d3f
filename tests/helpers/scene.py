"""A world whose camera images are computed exactly: a chequered floor, a box, and a ball where the tool is.

Every view is ray-cast, so depth, calibration and tool pose agree to the millimetre's rounding, and a dataset made of it
is healthy until a test spoils it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from helpers.episodes import Features, Frame, image_feature, vector_feature, write

from lerobot_histmv import keys
from lerobot_histmv.geometry import canonical, matrix_from_quaternion

SIZE = (29, 37)
LENGTHS = (11, 13, 23)
FOCAL = 31.0
BOX = np.array([[0.45, -0.25, 0.0], [0.57, -0.13, 0.11]])
BALL = 0.03
"""Radius of the ball at the tool [m]."""
TOOL_FROM_WRIST = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0.05], [0, 0, -1, 0.1]])
"""``T_tool_cam`` of the wrist camera: above the tool, looking down."""


def look_at(position: Sequence[float], target: Sequence[float]) -> np.ndarray:
    """``T_world_cam`` (3, 4) of a camera with the world's z up in its image."""
    forward = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    right = np.cross(forward, [0, 0, 1]) / np.linalg.norm(np.cross(forward, [0, 0, 1]))
    return np.column_stack([right, np.cross(forward, right), forward, position])


STILL = {"front": look_at((1.1, 0.1, 0.6), (0.45, 0, 0.1)), "side": look_at((0.4, 0.8, 0.5), (0.5, 0, 0.1))}
"""The default cameras that stand still; beside them ``wrist`` rides on the tool."""


@dataclass(frozen=True)
class Rig:
    """Cameras: those that stand still by name, the name of the one on the tool (empty: none), and the image size."""

    still: Mapping[str, np.ndarray]
    moving: str = "wrist"
    size: tuple[int, int] = SIZE

    @property
    def cameras(self) -> list[str]:
        return [*self.still, *([self.moving] if self.moving else [])]

    @property
    def intrinsics(self) -> np.ndarray:
        rows, columns = self.size
        focal = FOCAL * columns / SIZE[1]
        return np.array([focal, focal, (columns - 1) / 2, (rows - 1) / 2])


RIG = Rig(STILL)


def tool_motion(length: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 3) [m] and canonical quaternions (n, 4) on a curve above the floor, turning all the time."""
    start = np.array([0.42, -0.12, 0.32]) + np.random.default_rng(seed).uniform(-0.02, 0.02, 3)
    s = np.linspace(0, 1, length)[:, None]
    position = start + s * np.array([0.12, 0.22, -0.12]) + np.sin(np.pi * s) * np.array([0.0, 0.0, 0.04])
    angle = 0.3 + 0.9 * s
    axis = np.array([0.1, 0.15, 0.98]) / np.linalg.norm([0.1, 0.15, 0.98])
    return position, canonical(np.hstack([np.cos(angle / 2), np.sin(angle / 2) * axis]))


def episode(rig: Rig, length: int, seed: int) -> list[Frame]:
    """Frames of a dense episode in which every action is reached by the next state."""
    position, quaternion = tool_motion(length, seed)
    gripper = (np.arange(length) < length // 2).astype(float)
    pose = np.column_stack([position, quaternion, gripper])
    action = np.vstack([pose[1:], pose[-1:]])
    noise = np.random.default_rng(seed)
    frames = []
    for i in range(length):
        rotation = matrix_from_quaternion(quaternion[i])
        held = np.column_stack([rotation @ TOOL_FROM_WRIST[:, :3], position[i] + rotation @ TOOL_FROM_WRIST[:, 3]])
        poses = dict(rig.still) | ({rig.moving: held} if rig.moving else {})
        frame: Frame = {keys.STATE: pose[i].astype(np.float32), keys.ACTION: action[i].astype(np.float32)}
        frame[keys.INTRINSICS] = np.tile(rig.intrinsics, len(poses)).astype(np.float32)
        frame[keys.EXTRINSICS] = np.concatenate([one.ravel() for one in poses.values()]).astype(np.float32)
        for camera, camera_pose in poses.items():
            colour, depth = ray_cast(rig, camera_pose, position[i])
            frame[keys.rgb_key(camera)] = colour + noise.integers(0, 5, colour.shape, np.uint8)
            frame[keys.depth_key(camera)] = depth
        frames.append(frame)
    return frames


def ray_cast(rig: Rig, world_from_cam: np.ndarray, ball: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colour (y, x, 3) uint8 and depth (y, x, 1) uint16 [mm], 0 where a ray hits nothing."""
    fx, fy, cx, cy = rig.intrinsics
    v, u = np.indices(rig.size)
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(rig.size)], axis=-1) @ world_from_cam[:, :3].T
    eye = world_from_cam[:, 3]
    hits = np.stack([floor_hit(eye, rays), box_hit(eye, rays), ball_hit(eye, rays, ball)])
    nearest, depth = hits.argmin(axis=0), hits.min(axis=0)
    valid = np.isfinite(depth)
    points = eye + np.where(valid, depth, 0)[..., None] * rays
    chequered = (np.floor(points[..., :2] / 0.1).sum(axis=-1) % 2).astype(int)
    colours = np.array(
        [[[90, 90, 80], [150, 150, 140]], [[200, 60, 50], [170, 40, 30]], [[30, 60, 220], [30, 60, 220]]]
    )
    image = np.where(valid[..., None], colours[nearest, chequered], 20).astype(np.uint8)
    return image, np.where(valid, np.rint(1000 * np.where(valid, depth, 0)), 0).astype(np.uint16)[..., None]


def floor_hit(eye: np.ndarray, rays: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        far = -eye[2] / rays[..., 2]
    return np.where((far > 0) & (far < 3), far, np.inf)


def box_hit(eye: np.ndarray, rays: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (BOX[:, None, None] - eye) / rays
    enter, leave = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
    return np.where((enter < leave) & (enter > 0), enter, np.inf)


def ball_hit(eye: np.ndarray, rays: np.ndarray, centre: np.ndarray) -> np.ndarray:
    squared, along = (rays**2).sum(-1), rays @ (centre - eye)
    root = along**2 - squared * (((centre - eye) ** 2).sum() - BALL**2)
    return np.where((root > 0) & (along > 0), (along - np.sqrt(np.maximum(root, 0))) / squared, np.inf)


def scene_features(rig: Rig = RIG) -> Features:
    """LeRobot features of ``episode``."""
    features: Features = {
        keys.STATE: vector_feature(keys.POSE_NAMES),
        keys.ACTION: vector_feature(keys.POSE_NAMES),
        keys.INTRINSICS: vector_feature(keys.intrinsics_names(rig.cameras)),
        keys.EXTRINSICS: vector_feature(keys.extrinsics_names(rig.cameras)),
    }
    for camera in rig.cameras:
        features[keys.rgb_key(camera)] = image_feature(3, size=rig.size)
        depth: dict[str, Any] = {**image_feature(1, size=rig.size), "info": {"is_depth_map": True}}
        features[keys.depth_key(camera)] = depth
    return features


def write_scene(root: Path, rig: Rig = RIG, lengths: Sequence[int] = LENGTHS) -> Path:
    """A healthy dataset."""
    episodes = [episode(rig, length, seed) for seed, length in enumerate(lengths)]
    return write(root, episodes, scene_features(rig))
