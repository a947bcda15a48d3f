"""What the cameras of a dataset saw at some frames, with their calibration, and the merged cloud of all of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8, UInt16

from dataset_tools.columns import Column, entry_names
from dataset_tools.frames import camera_frames
from dataset_tools.source import Source
from dataset_tools.trajectories import Vectors
from lerobot_histmv import keys
from lerobot_histmv.geometry import deproject


@dataclass(frozen=True, eq=False)
class CameraView:
    """One picture of one camera.

    Attributes:
        color: its pixels.
        depth: distance along the optical axis [mm], 0 invalid; None without depth.
        intrinsics: fx, fy, cx, cy [pixels]; None if not recorded.
        world_from_cam: ``T_world_cam``; None if not recorded.
    """

    color: UInt8[np.ndarray, "y x 3"]
    depth: UInt16[np.ndarray, "y2 x2"] | None = None
    intrinsics: Float[np.ndarray, " 4"] | None = None
    world_from_cam: Float[np.ndarray, "3 4"] | None = None

    @property
    def calibrated(self) -> bool:
        """Whether world points can be found in it."""
        return self.intrinsics is not None and self.world_from_cam is not None

    @property
    def has_cloud(self) -> bool:
        """Whether its pixels can be placed in the world: calibrated, with depth that lies on the colours."""
        return self.calibrated and self.depth is not None and self.depth.shape == self.color.shape[:2]


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of all views in the world.

    Attributes:
        points: world points [m].
        colors: their colours.
        camera: index into ``cameras`` of the view each comes from.
        cameras: the views that took part.
    """

    points: Float[np.ndarray, "n 3"]
    colors: UInt8[np.ndarray, "n 3"]
    camera: Int[np.ndarray, " n"]
    cameras: Sequence[str]


def cameras_of(source: Source) -> list[str]:
    """Names of the colour cameras."""
    return [
        key.removeprefix(keys.IMAGES_PREFIX)
        for key in source.meta.camera_keys
        if key not in source.depth_keys and key.startswith(keys.IMAGES_PREFIX)
    ]


def read_views(source: Source, episode: int, frames: Sequence[int], vectors: Vectors) -> list[dict[str, CameraView]]:
    """What every camera saw at strictly rising ``frames``; ``vectors`` are the whole episode's.

    Raises:
        ValueError: images that cannot be read, see ``frames.camera_frames``.
    """
    cameras = cameras_of(source)
    depth = {camera: keys.depth_key(camera) for camera in cameras if keys.depth_key(camera) in source.depth_keys}
    wanted = [*map(keys.rgb_key, cameras), *depth.values()]
    columns = [key for key in wanted if source.features[key]["dtype"] != "video"]
    stored = source.table(episode, [*columns, "timestamp"], frames)
    pixels = {key: camera_frames(source, episode, key, frames, stored).pixels for key in wanted}
    intrinsics = {camera: _calibration(source, keys.INTRINSICS, camera, vectors) for camera in cameras}
    extrinsics = {camera: _calibration(source, keys.EXTRINSICS, camera, vectors) for camera in cameras}
    return [
        {
            camera: CameraView(
                color=pixels[keys.rgb_key(camera)][row],
                depth=pixels[depth[camera]][row, ..., 0] if camera in depth else None,
                intrinsics=None if (k := intrinsics[camera]) is None else k[frame],
                world_from_cam=None if (t := extrinsics[camera]) is None else t[frame].reshape(3, 4),
            )
            for camera in cameras
        }
        for row, frame in enumerate(frames)
    ]


def _calibration(source: Source, key: str, camera: str, vectors: Vectors) -> Float[np.ndarray, "n c"] | None:
    """A camera's entries of a calibration feature at every frame; None unless its names tell which they are."""
    names = entry_names(source.features[key]) if key in source.features else ()
    wanted = (keys.intrinsics_names if key == keys.INTRINSICS else keys.extrinsics_names)([camera])
    if not set(wanted) <= set(names):
        return None
    return Column(key, tuple(map(names.index, wanted))).of(vectors)


def merged_cloud(views: Mapping[str, CameraView]) -> Cloud | None:
    """Valid pixels of all views that have depth and calibration, as world points; None if there is no such view."""
    seen = {camera: view for camera, view in views.items() if view.has_cloud}
    if not seen:
        return None
    points, colors, camera = [], [], []
    for index, view in enumerate(seen.values()):
        assert view.depth is not None and view.intrinsics is not None and view.world_from_cam is not None
        valid = view.depth > 0
        points.append(deproject(view.depth / 1000, view.intrinsics, view.world_from_cam)[valid])
        colors.append(view.color[valid])
        camera.append(np.full(np.count_nonzero(valid), index))
    return Cloud(np.concatenate(points), np.concatenate(colors), np.concatenate(camera), list(seen))
