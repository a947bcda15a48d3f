"""An episode as a rerun recording: path, keyframes, cameras, images, depth and cloud, to be turned and scrubbed."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from dataset_tools.figure_style import AXIS_COLORS, INK, look
from dataset_tools.inspect.cameras import CameraView, merged_cloud
from dataset_tools.inspect.episodes import Episode, Motion, Observation
from dataset_tools.inspect.paths import key_positions
from dataset_tools.inspect.views import TRIAD, tool_triad

TIME = "time"


def require_rerun() -> Any:
    """The rerun module.

    Raises:
        ValueError: it is not installed.
    """
    try:
        return importlib.import_module("rerun")
    except ImportError as error:
        raise ValueError(
            "--rerun=true needs the package rerun-sdk, which is not installed: pip install rerun-sdk, or leave it out"
        ) from error


def write_recording(episode: Episode, path: Path) -> None:
    """Write an ``.rrd`` file that ``rerun <file>`` opens; seconds of the recorded episode are its timeline.

    Raises:
        ValueError: rerun is not installed.
    """
    rr = require_rerun()
    with rr.RecordingStream(f"histmv inspect: episode {episode.number}") as recording:
        recording.save(path)
        rr.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        rr.log("instruction", rr.TextDocument(episode.instruction), static=True)
        if not episode.is_joints:
            _log_path(rr, episode)
        if episode.motion:
            _log_errors(rr, episode.motion)
        for observation in episode.observations:
            rr.set_time(TIME, duration=observation.seconds)
            _log_observation(rr, episode, observation)


def _log_path(rr: Any, episode: Episode) -> None:
    points = key_positions(episode)
    colors = [look(pose.reason).color for pose in episode.poses]
    labels = [f"{number}: {pose.reason}" for number, pose in enumerate(episode.poses)]
    rr.log(
        "world/key_poses",
        rr.Points3D(points, colors=[_rgb(c) for c in colors], radii=0.006, labels=labels),
        static=True,
    )
    rr.log("world/straight", rr.LineStrips3D([points], colors=[_rgb("#74a9e0")], radii=0.0015), static=True)
    if episode.motion:
        path = episode.motion.trajectory.position
        rr.log("world/path", rr.LineStrips3D([path], colors=[_rgb(INK)], radii=0.001), static=True)


def _log_errors(rr: Any, motion: Motion) -> None:
    for frame, error in enumerate(motion.errors):
        rr.set_time(TIME, duration=frame / motion.trajectory.fps)
        rr.log("error", rr.Scalars(error) if np.isfinite(error) else rr.Clear(recursive=False))


def _log_observation(rr: Any, episode: Episode, observation: Observation) -> None:
    triad = tool_triad(observation)
    if not episode.is_joints and len(triad):
        colors = [_rgb(color) for color in AXIS_COLORS.values()]
        arrows = rr.Arrows3D(origins=triad[:, 0], vectors=triad[:, 1] - triad[:, 0], colors=colors, radii=TRIAD / 20)
        rr.log("world/tool", arrows)
    for camera, view in observation.views.items():
        _log_view(rr, f"world/{camera}", view)
    if cloud := merged_cloud(observation.views):
        rr.log("world/cloud", rr.Points3D(cloud.points, colors=cloud.colors, radii=0.0015))


def _log_view(rr: Any, place: str, view: CameraView) -> None:
    if view.intrinsics is not None and view.world_from_cam is not None:
        height, width = view.color.shape[:2]
        fx, fy, cx, cy = view.intrinsics
        world_from_cam = view.world_from_cam
        rr.log(place, rr.Transform3D(translation=world_from_cam[:, 3], mat3x3=world_from_cam[:, :3]))
        camera_matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        pinhole = rr.Pinhole(image_from_camera=camera_matrix, resolution=(width, height), image_plane_distance=0.1)
        rr.log(place, pinhole)
    rr.log(f"{place}/color", rr.Image(view.color))
    if view.depth is not None:
        rr.log(f"{place}/depth", rr.DepthImage(view.depth, meter=1000.0))


def _rgb(color: str) -> tuple[int, int, int]:
    """Colour of a ``#rrggbb`` text."""
    red, green, blue = bytes.fromhex(color.removeprefix("#"))
    return red, green, blue
