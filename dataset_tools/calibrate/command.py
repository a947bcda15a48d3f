"""``histmv calibrate-attach``: a LeRobot RGB-D dataset again, with its cameras' calibration in every frame."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.progress import Progress

from dataset_tools.calibrate.added_columns import NewColumns, write_with_columns
from dataset_tools.calibrate.file import Calibration, read_calibrations
from dataset_tools.column_guesses import resolve
from dataset_tools.columns import NONE, Columns, ColumnsConfig
from dataset_tools.dense_features import calibration_features
from dataset_tools.output_place import OutputPlace, WholeDataset
from dataset_tools.source import Source, open_source
from dataset_tools.trajectories import trajectory_of
from dataset_tools.workplace import Workplace
from lerobot_histmv import keys
from lerobot_histmv.geometry import matrix_from_quaternion


@dataclass
class AttachConfig:
    """Write a LeRobot dataset again with observation.camera_intrinsics and observation.camera_extrinsics.

        histmv calibrate-attach --dataset.repo_id=me/demos --calibration=cameras.yaml --output.repo_id=me/demos_rgbd

    The YAML file has an entry per camera: fx, fy, cx, cy [pixels] and T_world_cam, a 3x4 or 4x4 matrix that maps camera
    points (x right, y down, z ahead) to the robot's base; or, for a camera on the arm, mounted_on: tool and T_tool_cam,
    which is joined to the tool's measured pose at every frame.
    """

    dataset: WholeDataset
    # The YAML file.
    calibration: Path
    output: OutputPlace
    # Where the tool's pose is, if a camera is mounted on it and the names do not tell.
    columns: ColumnsConfig = field(default_factory=ColumnsConfig)
    # Replace an existing output dataset.
    overwrite: bool = False


def run(config: AttachConfig) -> None:
    """Check everything, then write the dataset; it appears whole or not at all.

    Raises:
        ValueError: see ``calibration_file``, ``source``, ``column_guesses``; or the dataset has a calibration already.
    """
    console = Console(highlight=False)
    root = config.output.folder()
    source = open_source(config.dataset.repo_id, config.dataset.root, None, config.dataset.revision)
    if root == source.root.resolve():
        raise ValueError(f"--output.root is the dataset itself ({root}); give another folder")
    there = [key for key in (keys.INTRINSICS, keys.EXTRINSICS) if key in source.features]
    if there:
        raise ValueError(
            f"{source.root} has {', '.join(there)} already; lerobot-edit-dataset's remove_feature drops them"
        )
    sizes = rgbd_cameras(source)
    calibrations = read_calibrations(config.calibration.expanduser(), sizes)
    columns = calibration_columns(source, calibrations, config.columns)
    frames = source.meta.total_frames
    features = calibration_features(list(calibrations))
    settings = {"source": str(source.root.resolve()), "calibration": str(config.calibration)}
    place = Workplace(root, settings, config.overwrite, "calibrated")
    with place.opened(), Progress(console=console) as progress:
        bar = progress.add_task("writing frames", total=frames)
        place.commit(
            lambda path: write_with_columns(source, features, columns, path, lambda rows: progress.advance(bar, rows))
        )
    left_out = sorted(sizes.keys() - calibrations.keys())
    console.print(
        f"calibration of {', '.join(calibrations)} in {len(columns)} episodes, {frames} frames"
        + (f"; not calibrated: {', '.join(left_out)}" if left_out else "")
        + f"\ndataset {config.output.repo_id} in {root}",
        soft_wrap=True,
    )


def rgbd_cameras(source: Source) -> dict[str, tuple[int, int]]:
    """Height and width of the images, by camera that has colour and depth."""
    depth = [key.removeprefix(keys.IMAGES_PREFIX).removesuffix(keys.DEPTH_SUFFIX) for key in sorted(source.depth_keys)]
    cameras = [camera for camera in depth if keys.rgb_key(camera) in source.features]
    shapes = {camera: source.features[keys.rgb_key(camera)]["shape"] for camera in cameras}
    return {camera: (int(shape[0]), int(shape[1])) for camera, shape in shapes.items()}


def calibration_columns(source: Source, calibrations: Mapping[str, Calibration], config: ColumnsConfig) -> NewColumns:
    """The two calibration columns of every episode.

    Raises:
        ValueError: a camera is on the tool, but the dataset's columns do not tell the tool's pose.
    """
    tool = tool_columns(source, config) if any(one.on_tool for one in calibrations.values()) else None
    intrinsics = np.concatenate([one.intrinsics for one in calibrations.values()])
    columns = {}
    for episode in source.episodes:
        frames = source.length(episode)
        poses = tool_poses(source, tool, episode) if tool else None
        extrinsics = np.hstack([one.extrinsics(poses, frames) for one in calibrations.values()])
        columns[episode] = {
            keys.INTRINSICS: np.tile(intrinsics, (frames, 1)).astype(np.float32),
            keys.EXTRINSICS: extrinsics.astype(np.float32),
        }
    return columns


def tool_columns(source: Source, config: ColumnsConfig) -> Columns:
    """Where the tool's measured pose is.

    Raises:
        ValueError: the columns have no rotation, or joints are given in place of a pose.
    """
    columns = resolve(source.features, replace(config, gripper=NONE, commanded=False))
    if columns.is_joints or columns.rotation is None:
        raise ValueError(
            "a camera mounted on the tool needs the tool's position and rotation; give --columns.position=... and "
            "--columns.rotation=... with --columns.rotation_format=..."
        )
    return columns


def tool_poses(source: Source, columns: Columns, episode: int) -> Float[np.ndarray, "n 3 4"]:
    """``T_world_tool`` at every frame; ValueError names a frame whose quaternion is not unit."""
    closed_and_open = (0.0, 1.0)
    motion = trajectory_of(source.vectors(episode), columns, closed_and_open, float(source.meta.fps), episode)
    assert motion.quaternion is not None
    return np.concatenate([matrix_from_quaternion(motion.quaternion), motion.position[..., None]], axis=-1)
