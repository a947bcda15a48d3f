"""Reading episodes of robomimic's HDF5 files, with depth and camera matrices.

``data/demo_<i>`` holds ``actions`` and ``obs``: ``<camera>_image``, ``<camera>_depth`` (metres, or integers in
millimetres), ``robot0_eef_pos``, ``robot0_eef_quat`` (x, y, z, w), ``robot0_gripper_qpos``, ``robot0_joint_pos``. A
camera's matrix and pose (``T_world_cam``, axes x right, y down, z ahead) are datasets ``<camera>_intrinsics`` and
``<camera>_extrinsics`` in ``obs``, one for all frames or one per frame, or in the attribute ``camera_info``.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt16

from dataset_tools.convert import hdf5
from dataset_tools.convert.episode import Camera, Episode, EpisodeSource, Motion, calibration, wxyz

if TYPE_CHECKING:
    import h5py

CAMERA_INFO = "camera_info"
_IN_HAND = "eye_in_hand"
_ANY_IMAGE = (-1, -1, -1, 3)


class RobomimicSource(EpisodeSource):
    """The demonstrations of a file.

    Args:
        path: the file.
        cameras: which to read; empty for all that have colour and depth.
        instructions: what was asked for; by default the ``lang`` of a demonstration's ``ep_meta``.
        pixel_centre: where the camera matrices place the centre of the first pixel.
        gripper_width: distance [m] between the fingers of an open gripper.

    Raises:
        ValueError: the file is not as described above, or has no such cameras.
    """

    def __init__(
        self, path: Path, cameras: Sequence[str], instructions: Sequence[str], pixel_centre: float, gripper_width: float
    ) -> None:
        self._path, self._instructions = path, instructions
        self._pixel_centre, self._gripper_width = pixel_centre, gripper_width
        with hdf5.open_file(path) as file:
            data = hdf5.group(file, "data")
            self.names = sorted((n for n in hdf5.names(data) if re.fullmatch(r"demo_\d+", n)), key=lambda n: int(n[5:]))
            if not self.names:
                raise ValueError(f"{path} has no data/demo_0; there are {', '.join(data) or 'no entries'}")
            observed = hdf5.group(hdf5.group(data, self.names[0]), "obs")
            entries = hdf5.names(observed)
            found = [key.removesuffix("_image") for key in entries if key.endswith("_image")]
            found = [camera for camera in found if f"{camera}_depth" in entries]
            unknown = sorted(set(cameras) - set(found))
            if unknown or not found:
                raise ValueError(f"{path} has no image and depth of {unknown or 'any camera'}; cameras are {found}")
            self.sizes = {name: self._size(observed, name) for name in cameras or found}
            self.joints = self._joints(observed).shape[1]
            arguments = _mapping(hdf5.attribute(data, "env_args"))
        self._task = str(arguments.get("env_name") or path.stem)
        details = _mapping(arguments.get("env_kwargs"))
        robots = details.get("robots")
        self.robot_type = str(robots[0] if isinstance(robots, list) and robots else robots).lower() if robots else None
        self.fps = int(details["control_freq"]) if isinstance(details.get("control_freq"), int | float) else None

    def read(self, index: int) -> Episode:
        """One demonstration; ValueError names what is missing, refused or not as it must be."""
        name = self.names[index]
        with hdf5.open_file(self._path) as file:
            demo = hdf5.group(hdf5.group(file, "data"), name)
            observed = hdf5.group(demo, "obs")
            return Episode(
                name=name,
                task=self._task,
                variation=0,
                instructions=self._instructions or self._told(demo),
                cameras={camera: self._camera(demo, observed, camera) for camera in self.sizes},
                motion=self._motion(demo, observed),
            )

    def _told(self, demo: "h5py.Group") -> list[str]:
        said = _mapping(hdf5.attribute(demo, "ep_meta")).get("lang")
        if not isinstance(said, str) or not said.strip():
            raise ValueError(f"{self._path} does not say what was asked for; tell it: --instructions='[lift the cube]'")
        return [said]

    def _motion(self, demo: "h5py.Group", observed: "h5py.Group") -> Motion:
        actions = hdf5.numbers(demo, "actions", (-1, -1))
        n = len(actions)
        fingers = hdf5.numbers(observed, "robot0_gripper_qpos", (n, -1))
        opening = np.ptp(fingers, axis=1) / self._gripper_width
        return Motion(
            position=hdf5.numbers(observed, "robot0_eef_pos", (n, 3)),
            quaternion=wxyz(hdf5.numbers(observed, "robot0_eef_quat", (n, 4)), f"{demo.name}: robot0_eef_quat"),
            opening=np.clip(opening, 0, 1),
            command=gripper_command(actions[:, -1]),
            joints=self._joints(observed),
        )

    def _joints(self, observed: "h5py.Group") -> Float[np.ndarray, "n j"]:
        """Joint angles; a file without them has a state of the pose only."""
        if "robot0_joint_pos" in hdf5.names(observed):
            return hdf5.numbers(observed, "robot0_joint_pos", (-1, -1))
        return np.zeros((len(hdf5.numbers(observed, "robot0_eef_pos", (-1, 3))), 0))

    def _size(self, observed: "h5py.Group", camera: str) -> tuple[int, int]:
        _, height, width, _ = hdf5.dataset(observed, f"{camera}_image", _ANY_IMAGE, "u").shape
        return height, width

    def _camera(self, demo: "h5py.Group", observed: "h5py.Group", camera: str) -> Camera:
        n, size = len(hdf5.numbers(demo, "actions", (-1, -1))), self.sizes[camera]
        rgb = hdf5.dataset(observed, f"{camera}_image", (n, *size, 3), "u")[()]
        if rgb.dtype != np.uint8:
            raise ValueError(f"{demo.name}: {camera}_image is {rgb.dtype}; it must be uint8")
        depth = hdf5.dataset(observed, f"{camera}_depth", (n, *size, 1), "fu")[()]
        matrices, poses = self._calibration(demo, observed, camera, n)
        what = f"{demo.name}: {camera}"
        intrinsics, extrinsics = calibration(matrices, poses, self._pixel_centre, size, what)
        return Camera(rgb, _millimetres(depth, f"{what}_depth"), intrinsics, extrinsics)

    def _calibration(self, demo: "h5py.Group", observed: "h5py.Group", camera: str, n: int) -> list[np.ndarray]:
        """Camera matrices and poses, one per frame."""
        info = _mapping(_mapping(hdf5.attribute(demo, CAMERA_INFO)).get(camera))
        found = []
        for name in ("intrinsics", "extrinsics"):
            keys = [key for key in (f"{camera}_{name}", f"{camera}_{name[:-1]}") if key in hdf5.names(observed)]
            if keys:
                matrix = hdf5.numbers(observed, keys[0], (..., -1, -1))
            elif name in info and (name == "intrinsics" or _IN_HAND not in camera):
                matrix = _matrix(info[name], f"{demo.name}: {CAMERA_INFO} of {camera}, {name}")
            else:
                raise ValueError(self._missing(demo, camera, name))
            if matrix.shape[:-2] not in ((), (n,)):
                raise ValueError(
                    f"{demo.name}: {camera}_{name} has shape {matrix.shape}; it must be one, or {n} of them"
                )
            found.append(np.broadcast_to(matrix, (n, *matrix.shape[-2:])))
        return found

    def _missing(self, demo: "h5py.Group", camera: str, name: str) -> str:
        hint = ""
        if _IN_HAND in camera:
            hint = f", one per frame: {CAMERA_INFO} does not tell where a camera in the hand is in the world"
        return (
            f"{self._path}:{demo.name} has no obs/{camera}_{name}{hint}; add them, or leave the camera out with "
            "--cameras=[...]"
        )


def gripper_command(actions: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """The command of robosuite (-1 opens, 1 closes, 0 changes nothing) as 1 open, 0 closed; open before the first."""
    told = np.maximum.accumulate(np.where(actions != 0, np.arange(len(actions)), -1))
    return np.where(told < 0, True, actions[told] < 0).astype(np.float64)


def _millimetres(depth: np.ndarray, what: str) -> UInt16[np.ndarray, "n y x 1"]:
    if depth.dtype == np.uint16:
        return depth
    if depth.dtype.kind != "f" or not (np.isfinite(depth) & (depth >= 0)).all():
        raise ValueError(
            f"{what} is {depth.dtype} or has values below 0 or not finite; it must be metres, or uint16 mm"
        )
    scaled = np.rint(1000 * depth.astype(np.float64))
    return np.where(scaled > np.iinfo(np.uint16).max, 0, scaled).astype(np.uint16)


def _matrix(rows: object, what: str) -> Float[np.ndarray, "r c"]:
    try:
        return np.array(rows, dtype=np.float64).reshape(len(rows), -1)  # type: ignore[arg-type]
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what} is no matrix: {error}") from error


def _mapping(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}
