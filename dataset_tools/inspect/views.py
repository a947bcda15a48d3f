"""The tool projected into every view: on a right calibration it lies on the picture of the gripper."""

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dataset_tools.figure_style import (
    AXIS_COLORS,
    HALO,
    INK,
    WIDTH,
    legend_below,
    look,
    new_figure,
    reason_handles,
    shared_labels,
)
from dataset_tools.inspect.cameras import CameraView
from dataset_tools.inspect.episodes import Episode, Observation
from lerobot_histmv.geometry import matrix_from_quaternion, project

TRIAD = 0.03
"""Length of the tool's drawn axes [m]."""
SAME_PLACE = 0.04
"""Key poses closer than this share of a picture's width are numbered together."""
TOOL = "tool"
NEXT = "next"
"""Names (``gid``) of the drawn lines: the tool point, and the path from it over the next key poses."""


def tool_triad(observation: Observation) -> Float[np.ndarray, "axes 2 3"]:
    """World points of the tool's axes, each from the tool point outwards [m]; none without a rotation."""
    if observation.quaternion is None:
        return np.empty((0, 2, 3))
    tips = observation.position + TRIAD * matrix_from_quaternion(observation.quaternion).T
    return np.stack([np.broadcast_to(observation.position, (3, 3)), tips], axis=1)


def draw_projections(episode: Episode) -> Figure:
    """Every view at every keyframe with the measured tool, and the way over the next key poses, projected into it."""
    observations = episode.observations
    cameras = [camera for camera, view in observations[0].views.items() if view.calibrated]
    columns = len(cameras)
    side = (WIDTH - 0.5) / columns
    tallest = max(view.color.shape[0] / view.color.shape[1] for view in observations[0].views.values())
    figure = new_figure(len(observations) * (side * tallest + 0.05) + 0.8)
    grid = figure.subplots(len(observations), columns, squeeze=False)
    for row, observation in enumerate(observations):
        for camera, axes in zip(cameras, grid[row], strict=True):
            draw_projection(axes, observation.views[camera], episode, row)
        style = look(episode.poses[row].reason)
        label = f"{row}: {episode.poses[row].reason}, {observation.seconds:.2f} s"
        grid[row, 0].set_ylabel(label, fontsize=10, color=style.color)
    for camera, axes in zip(cameras, grid[0], strict=True):
        axes.set_title(camera, fontsize=10, color=INK)
    triad = [Line2D([], [], color=color, linewidth=3, label=f"tool {name}") for name, color in AXIS_COLORS.items()]
    handles = [*triad, *reason_handles(pose.reason for pose in episode.poses[1:])]
    legend_below(figure, handles)
    return figure


def draw_projection(axes: Axes, view: CameraView, episode: Episode, row: int) -> None:
    """One calibrated view at keyframe ``row``; what lies outside the picture or behind the camera is not drawn."""
    assert view.intrinsics is not None and view.world_from_cam is not None
    height, width = view.color.shape[:2]
    axes.imshow(view.color, interpolation="bicubic")
    axes.set(xticks=[], yticks=[], xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    observation, following = episode.observations[row], episode.poses[row + 1 :]
    route = np.stack([observation.position, *(pose.position for pose in following)])
    pixels, _ = project(route, view.intrinsics, view.world_from_cam)
    axes.plot(*pixels.T, color="white", linewidth=1.6, alpha=0.85, gid=NEXT)
    for pixel, pose in zip(pixels[1:], following, strict=True):
        style = look(pose.reason)
        axes.plot(*pixel, marker=style.marker, color=style.color, markersize=7, markeredgecolor="white")
    for (u, v), text in shared_labels(pixels[1:], SAME_PLACE * width, first=row + 1):
        axes.annotate(text, (u, v), (6, 4), textcoords="offset points", fontsize=8, path_effects=HALO, clip_on=True)
    triad, _ = project(tool_triad(observation), view.intrinsics, view.world_from_cam)
    for line, color in zip(triad, AXIS_COLORS.values(), strict=False):
        axes.plot(*line.T, color=color, linewidth=3, solid_capstyle="round")
    axes.plot(*pixels[0], marker="o", color=INK, markersize=6, markeredgecolor="white", gid=TOOL)
    if not _inside(pixels[0], width, height):
        text = "tool outside this view"
        axes.text(0.5, 0.03, text, transform=axes.transAxes, ha="center", fontsize=9, path_effects=HALO)


def _inside(pixel: Float[np.ndarray, " 2"], width: int, height: int) -> bool:
    """Whether a pixel is in the picture; NaN is not."""
    return bool(-0.5 <= pixel[0] <= width - 0.5 and -0.5 <= pixel[1] <= height - 0.5)
