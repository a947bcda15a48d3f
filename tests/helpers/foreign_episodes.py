"""Small episodes in the formats of other projects, drawn by a renderer that knows only those projects' conventions.

A scene is one bright point, moving with the frames, before a wall. CoppeliaSim's camera looks along z with x to the
left and y up; a pixel's centre lies half a pixel from its corner; the stored depth is the share of the way from the
near to the far plane. robosuite's camera is OpenCV's, with pixels counted from their corner, too.
"""

import pickle
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

HEIGHT, WIDTH = 23, 29
FRAMES = 7
JOINTS = 7
CLOSES_AT = 4
"""The first frame at which the gripper is seen closed."""
NEAR, FAR, WALL = 0.01, 3.5, 2.9
FOCAL = 31.0
CAMERAS = ("front", "wrist")
SENTENCES = ["close the jar", "screw the lid on"]
POINT_COLOUR, WALL_COLOUR = (250, 30, 20), (10, 60, 90)


@dataclass
class Scene:
    """What happens in an episode, in words that are no format's."""

    seed: int = 0
    frames: int = FRAMES

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        steps = np.arange(self.frames)[:, None]
        self.tool_position = np.array([0.3, 0.1, 0.9]) + steps * rng.uniform(-0.012, 0.012, 3)
        self.tool_rotation = Rotation.from_rotvec([2.9, 0.2, 0.1] + steps * np.array([0.0, 0.01, -0.02]))
        below = self.tool_position[0] + 0.3 * self.tool_rotation[0].as_matrix()[:, 2]
        self.points = below + steps * rng.uniform(-0.004, 0.004, 3)
        self.joints = rng.uniform(-1, 1, (self.frames, JOINTS))
        self.open = (np.arange(self.frames) < CLOSES_AT).astype(float)

    def opencv_pose(self, camera: str, frame: int) -> np.ndarray:
        """4x4 pose of a camera with x right, y down, z ahead: front is fixed, wrist rides on the tool."""
        if camera == "front":
            return looking_at(np.array([1.3, 0.2, 1.5]), np.array([0.25, 0.0, 0.8]))
        tool = np.eye(4)
        tool[:3, :3], tool[:3, 3] = self.tool_rotation[frame].as_matrix(), self.tool_position[frame]
        return tool @ tool_camera()

    def pixel(self, camera: str, frame: int) -> tuple[int, int, float]:
        """Column, row and depth [m] of the pixel that shows the point: the centre of column 0 is half a pixel in."""
        x, y, z, _ = np.linalg.inv(self.opencv_pose(camera, frame)) @ np.append(self.points[frame], 1)
        return int(np.floor(FOCAL * x / z + WIDTH / 2)), int(np.floor(FOCAL * y / z + HEIGHT / 2)), float(z)

    def images(self, camera: str, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Colours (y, x, 3) and depth (y, x) [m]: the point, the wall, and a top row in which there is nothing."""
        rgb = np.full((HEIGHT, WIDTH, 3), WALL_COLOUR, np.uint8)
        depth = np.full((HEIGHT, WIDTH), WALL)
        depth[0] = np.inf
        column, row, z = self.pixel(camera, frame)
        rgb[row, column], depth[row, column] = POINT_COLOUR, z
        return rgb, depth


def looking_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """OpenCV pose of an upright camera."""
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([right, np.cross(ahead, right), ahead], axis=1), eye
    return pose


def tool_camera() -> np.ndarray:
    """``T_tool_cam`` of the wrist camera: behind the tool point, looking along it, a little turned."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec([0.05, -0.1, 0.2]).as_matrix(), [0.03, 0.01, -0.1]
    return pose


def coppelia_pose(opencv: np.ndarray) -> np.ndarray:
    """The pose that CoppeliaSim reports of a camera: x to the left, y up."""
    left, up = -opencv[:, 0], -opencv[:, 1]
    return np.stack([left, up, opencv[:, 2], opencv[:, 3]], axis=1)


@contextmanager
def rlbench_classes() -> Iterator[tuple[type, type]]:
    """RLBench's ``Observation`` and ``Demo``, importable while this lasts, as its generators' pickles name them."""
    names = ("rlbench", "rlbench.backend", "rlbench.backend.observation", "rlbench.demo")
    modules = {name: ModuleType(name) for name in names}
    observation = type("Observation", (), {"__module__": "rlbench.backend.observation"})
    demo = type("Demo", (), {"__module__": "rlbench.demo"})
    vars(modules["rlbench.backend.observation"])["Observation"] = observation
    vars(modules["rlbench.demo"])["Demo"] = demo
    sys.modules.update(modules)
    try:
        yield observation, demo
    finally:
        for name in names:
            del sys.modules[name]


def rlbench_observations(scene: Scene, observation: type) -> list[Any]:
    """What the generator pickles per frame."""
    found = []
    for frame in range(scene.frames):
        one = observation()
        one.front_rgb = None
        one.gripper_open = scene.open[frame]
        one.gripper_pose = np.concatenate([scene.tool_position[frame], scene.tool_rotation[frame].as_quat()])
        one.joint_positions = scene.joints[frame]
        one.task_low_dim_state = np.array([0.5, None], dtype=object)
        one.misc = {"variation_index": np.int64(5)}
        for camera in CAMERAS:
            one.misc[f"{camera}_camera_intrinsics"] = np.array(
                [[-FOCAL, 0, WIDTH / 2], [0, -FOCAL, HEIGHT / 2], [0, 0, 1]]
            )
            one.misc[f"{camera}_camera_extrinsics"] = coppelia_pose(scene.opencv_pose(camera, frame))
            one.misc[f"{camera}_camera_near"], one.misc[f"{camera}_camera_far"] = NEAR, FAR
        found.append(one)
    return found


def write_rlbench(folder: Path, scene: Scene, sentences: Sequence[str] = SENTENCES, protocol: int = 4) -> Path:
    """One episode folder, as the generators write it; the sentences lie in it."""
    for frame in range(scene.frames):
        for camera in CAMERAS:
            rgb, depth = scene.images(camera, frame)
            share = np.clip((depth - NEAR) / (FAR - NEAR), 0, 1)
            code = np.floor(share * (2**24 - 1) + 0.5).astype(np.uint32)
            coded = np.stack([code // 65536, code // 256 % 256, code % 256], axis=-1).astype(np.uint8)
            for kind, pixels in (("rgb", rgb), ("depth", coded)):
                (folder / f"{camera}_{kind}").mkdir(parents=True, exist_ok=True)
                Image.fromarray(pixels).save(folder / f"{camera}_{kind}" / f"{frame}.png")
    with rlbench_classes() as (observation, demo):
        recorded = demo()
        recorded._observations = rlbench_observations(scene, observation)
        recorded.random_seed = np.random.RandomState(scene.seed).get_state()
        (folder / "low_dim_obs.pkl").write_bytes(pickle.dumps(recorded, protocol=protocol))
    (folder / "variation_descriptions.pkl").write_bytes(pickle.dumps(list(sentences)))
    (folder / "variation_number.pkl").write_bytes(pickle.dumps(3))
    return folder


def write_robomimic(path: Path, scenes: Sequence[Scene]) -> Path:
    """A file of demonstrations as robomimic's extraction script writes them, with calibration per frame."""
    import json

    import h5py

    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        arguments = {"env_name": "Lift", "type": 1, "env_kwargs": {"control_freq": 10, "robots": ["Panda"]}}
        data.attrs["env_args"] = json.dumps(arguments)
        for number, scene in enumerate(scenes):
            demo = data.create_group(f"demo_{number}")
            demo.attrs["num_samples"] = scene.frames
            told = np.where(np.append(scene.open[1:], scene.open[-1]) > 0, -1.0, 1.0)
            demo["actions"] = np.column_stack([np.zeros((scene.frames, 6)), told])
            observed = demo.create_group("obs")
            observed["robot0_eef_pos"] = scene.tool_position
            observed["robot0_eef_quat"] = scene.tool_rotation.as_quat()
            observed["robot0_joint_pos"] = scene.joints
            observed["robot0_gripper_qpos"] = np.outer(scene.open, [0.04, -0.04])
            for camera in CAMERAS:
                images = [scene.images(camera, frame) for frame in range(scene.frames)]
                depth = np.stack([np.where(np.isfinite(image), image, 0) for _, image in images])
                observed[f"{camera}_image"] = np.stack([image for image, _ in images])
                observed[f"{camera}_depth"] = depth.astype(np.float32)[..., None]
                observed[f"{camera}_intrinsics"] = [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]
                poses = [scene.opencv_pose(camera, frame) for frame in range(scene.frames)]
                observed[f"{camera}_extrinsics"] = np.stack(poses)
    return path
