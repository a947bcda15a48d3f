"""Reading episodes in RLBench's format: folders of PNG files beside pickles of what was measured.

``<task>/<variation>/episodes/episode<i>/`` holds ``<camera>_rgb/<frame>.png``, ``<camera>_depth/<frame>.png`` and
``low_dim_obs.pkl``; ``variation_descriptions.pkl`` lies there too, or beside ``episodes``. A camera's calibration and
clipping planes are in each observation's ``misc``. A depth pixel holds a 24-bit number, the share of the way from the
near to the far plane.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8, UInt16
from PIL import Image

from dataset_tools.convert.episode import Camera, Episode, EpisodeSource, Motion, calibration, wxyz
from dataset_tools.convert.pickle import Record, load, numbers

OBSERVATIONS = "low_dim_obs.pkl"
DESCRIPTIONS = "variation_descriptions.pkl"
VARIATION = "variation_number.pkl"
DEPTH_CODES = 2**24 - 1
"""The largest depth code. It means the far plane, where nothing was hit."""

_PLACES = ("episode*", "episodes/episode*", "*/episodes/episode*", "*/*/episodes/episode*")


class RLBenchSource(EpisodeSource):
    """The episodes below a folder: of a data set of tasks, a task, a variation, or its ``episodes``.

    Args:
        root: the folder.
        cameras: which to read; empty for all that have colour and depth.
        instructions: what to say instead of the descriptions in the files.
        pixel_centre: where the camera matrices place the centre of the first pixel.

    Raises:
        ValueError: no episodes, or no such cameras.
    """

    fps = None
    robot_type = None

    def __init__(
        self, root: Path, cameras: Sequence[str], instructions: Sequence[str], pixel_centre: float = 0.5
    ) -> None:
        self._root = root.resolve()
        self._folders = _episodes(self._root)
        self._instructions, self._pixel_centre = instructions, pixel_centre
        self.names = [str(folder.relative_to(self._root)) for folder in self._folders]
        first = self._folders[0]
        found = sorted(path.name.removesuffix("_depth") for path in first.glob("*_depth") if any(path.iterdir()))
        found = [camera for camera in found if (first / f"{camera}_rgb" / "0.png").is_file()]
        unknown = sorted(set(cameras) - set(found))
        if unknown or not found:
            raise ValueError(
                f"{first} has no colour and depth images of {unknown or 'any camera'}; cameras are {found}"
            )
        self.sizes = {camera: self._size(first / f"{camera}_rgb" / "0.png") for camera in cameras or found}
        self.joints = len(_field(self._observations(first)[0], "joint_positions", (-1,), f"{first}, frame 0"))

    def read(self, index: int) -> Episode:
        """One episode.

        Raises:
            ValueError: a file is missing, damaged, outside of the source or not as RLBench writes it.
        """
        folder = self._folders[index]
        observations = self._observations(folder)
        variation = self._variation(folder)
        return Episode(
            name=self.names[index],
            task=folder.parents[2].name,
            variation=variation,
            instructions=self._instructions or self._descriptions(folder),
            cameras={camera: self._camera(folder, camera, observations) for camera in self.sizes},
            motion=self._motion(folder, observations),
        )

    def _motion(self, folder: Path, observations: Sequence[Record]) -> Motion:
        pose = _series(observations, "gripper_pose", (7,), folder)
        opening = _series(observations, "gripper_open", (), folder)
        if ((opening < 0) | (opening > 1)).any():
            raise ValueError(f"{folder}: gripper_open is {opening.min():g} to {opening.max():g}; it must be 0 to 1")
        return Motion(
            position=pose[:, :3],
            quaternion=wxyz(pose[:, 3:], f"{folder}: gripper_pose"),
            opening=opening,
            command=np.append(opening[1:], opening[-1]),
            joints=_series(observations, "joint_positions", (self.joints,), folder),
        )

    def _camera(self, folder: Path, camera: str, observations: Sequence[Record]) -> Camera:
        size, count = self.sizes[camera], len(observations)
        what = f"{folder}: {camera}"
        misc = [_misc(observation, folder, frame) for frame, observation in enumerate(observations)]
        matrices, poses, near, far = (
            np.stack([_entry(entries, f"{camera}_camera_{name}", shape, folder) for entries in misc])
            for name, shape in (("intrinsics", (3, 3)), ("extrinsics", (4, 4)), ("near", ()), ("far", ()))
        )
        if not ((near > 0) & (far > near)).all():
            raise ValueError(
                f"{what}: clipping planes {near[0]:g} and {far[0]:g} m; near must be above 0, far above near"
            )
        codes = [self._pixels(folder / f"{camera}_depth" / f"{frame}.png", size, "RGB") for frame in range(count)]
        depth = [decode_depth(code, float(a), float(b)) for code, a, b in zip(codes, near, far, strict=True)]
        rgb = [self._pixels(folder / f"{camera}_rgb" / f"{frame}.png", size) for frame in range(count)]
        intrinsics, extrinsics = calibration(matrices, poses, self._pixel_centre, size, what)
        return Camera(np.stack(rgb), np.stack(depth)[..., None], intrinsics, extrinsics)

    def _observations(self, folder: Path) -> list[Record]:
        demo = load(self._inside(folder / OBSERVATIONS))
        found = vars(demo).get("_observations") if isinstance(demo, Record) else demo
        if not isinstance(found, list) or not found or not all(isinstance(one, Record) for one in found):
            raise ValueError(f"{folder / OBSERVATIONS} holds no demonstration: a Demo of at least one Observation")
        return found

    def _descriptions(self, folder: Path) -> list[str]:
        for place in (folder / DESCRIPTIONS, folder.parents[1] / DESCRIPTIONS):
            if place.is_file():
                found = load(self._inside(place))
                if isinstance(found, list) and found and all(isinstance(one, str) and one.strip() for one in found):
                    return found
                raise ValueError(f"{place} holds no list of sentences")
        raise ValueError(
            f"{folder} has no {DESCRIPTIONS}, nor has its variation; say what is asked for: --instructions=..."
        )

    def _variation(self, folder: Path) -> int:
        """From the file, else from the folder's name, else 0."""
        if (folder / VARIATION).is_file():
            return int(numbers(load(self._inside(folder / VARIATION)), (), f"{folder / VARIATION}"))
        named = re.fullmatch(r"variation(\d+)", folder.parents[1].name)
        return int(named[1]) if named else 0

    def _pixels(self, path: Path, size: tuple[int, int], mode: str | None = None) -> UInt8[np.ndarray, "y x 3"]:
        """Pixels of a PNG file; a ``mode`` that it must have keeps depth codes from being converted."""
        try:
            with Image.open(self._inside(path), formats=["PNG"]) as image:
                if (image.height, image.width) != size or mode not in (None, image.mode):
                    raise ValueError(
                        f"{image.width} x {image.height} pixels of mode {image.mode}; expected are "
                        f"{size[1]} x {size[0]} of mode {mode or 'RGB'}"
                    )
                return np.array(image.convert("RGB"))
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            raise ValueError(f"cannot read {path}: {error}") from error

    def _size(self, path: Path) -> tuple[int, int]:
        with Image.open(self._inside(path), formats=["PNG"]) as image:
            return image.height, image.width

    def _inside(self, path: Path) -> Path:
        """The file; ValueError if a link leads out of the source."""
        if not path.resolve().is_relative_to(self._root):
            raise ValueError(
                f"{path} leads out of {self._root}, to {path.resolve()}; copy the file in place of the link"
            )
        return path


def decode_depth(code_yxc: UInt8[np.ndarray, "y x 3"], near: float, far: float) -> UInt16[np.ndarray, "y x"]:
    """Millimetres of a depth image; 0 where nothing was hit, or beyond 65.5 m.

    Args:
        code_yxc: red holds the high byte, blue the low one.
        near: depth of code 0 [m].
        far: depth of the largest code [m].
    """
    code = code_yxc.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], dtype=np.uint32)
    millimetres = np.rint(1000 * (near + code / DEPTH_CODES * (far - near)))
    measured = (code < DEPTH_CODES) & (millimetres <= np.iinfo(np.uint16).max)
    return np.where(measured, millimetres, 0).astype(np.uint16)


def _episodes(root: Path) -> list[Path]:
    """Episode folders below ``root``, in the order of their numbers, each once; links must stay inside."""
    found = {path.resolve() for place in _PLACES for path in root.glob(place) if re.fullmatch(r"episode\d+", path.name)}
    outside = sorted(path for path in found if not path.is_relative_to(root))
    if outside:
        raise ValueError(f"an episode of {root} is a link out of it, to {outside[0]}; copy the folder in its place")
    episodes = [path for path in found if (path / OBSERVATIONS).is_file()]
    if not episodes:
        raise ValueError(
            f"no RLBench episodes at {root}: looked for <task>/<variation>/episodes/episode0/{OBSERVATIONS}"
        )
    return sorted(episodes, key=_by_numbers)


def _by_numbers(path: Path) -> list[str | int]:
    """Sorts episode 2 before episode 10."""
    return [int(part) if i % 2 else part for i, part in enumerate(re.split(r"(\d+)", str(path)))]


def _misc(observation: Record, folder: Path, frame: int) -> dict[str, Any]:
    misc = vars(observation).get("misc")
    if not isinstance(misc, dict):
        raise ValueError(f"{folder}, frame {frame}: no misc, which holds the cameras; RLBench before 1.1 wrote none")
    return misc


def _entry(misc: dict[str, Any], name: str, shape: tuple[int, ...], folder: Path) -> np.ndarray:
    if name not in misc:
        raise ValueError(f"{folder}: misc has no {name}; there are {', '.join(sorted(map(str, misc)))}")
    return numbers(misc[name], shape, f"{folder}: {name}")


def _series(
    observations: Sequence[Record], name: str, shape: tuple[int, ...], folder: Path
) -> Float[np.ndarray, "n *d"]:
    values = [_field(one, name, shape, f"{folder}, frame {frame}") for frame, one in enumerate(observations)]
    return np.stack(values)


def _field(observation: Record, name: str, shape: tuple[int, ...], where: str) -> np.ndarray:
    return numbers(vars(observation).get(name), shape, f"{where}: {name}")
