"""Picture of the merged cloud of all views, in its own colours and coloured by the view each point comes from."""

from itertools import cycle
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dataset_tools.figure_style import INK, legend_below, look, new_figure, reason_handles
from dataset_tools.inspect.cameras import Cloud, merged_cloud
from dataset_tools.inspect.episodes import Episode

AROUND = 0.25
"""How far around the key poses the cloud is shown [m]."""
MOST_POINTS = 40_000
CAMERA_COLORS = ("#82c91e", "#3bc9db", "#f783ac", "#fcc419", "#868e96", "#a47551")
"""Other colours than those of the reasons."""
ELEVATION, AZIMUTH = 28.0, 35.0
"""From where the cloud is seen [degrees]."""


def draw_cloud(episode: Episode) -> Figure:
    """The merged cloud at the first keyframe, in its own colours and coloured by the view each point comes from.

    Where two views see the same surface their points must lie on it together: doubled or tilted surfaces in the second
    picture tell of a wrong calibration.
    """
    cloud = merged_cloud(episode.observations[0].views)
    assert cloud is not None
    route = np.stack([pose.position for pose in episode.poses])
    shown = _near(cloud, None if episode.is_joints else route)
    figure = new_figure(5.4)
    by_camera = np.array([to_rgb(color) for color in CAMERA_COLORS])[cloud.camera % len(CAMERA_COLORS)]
    pictures = ((cloud.colors / 255, "in its own colours"), (by_camera, "by the view each point comes from"))
    for column, (colors, title) in enumerate(pictures):
        axes = figure.add_subplot(1, 2, column + 1, projection="3d")
        _scatter(axes, cloud.points[shown], colors[shown])
        axes.text2D(0.5, 0.97, title, transform=axes.transAxes, ha="center", fontsize=10, color=INK)
        if not episode.is_joints:
            _draw_route(axes, episode, route)
    handles = [
        Line2D([], [], color=color, marker="s", markersize=9, linestyle="", label=f"seen by {camera}")
        for camera, color in zip(cloud.cameras, cycle(CAMERA_COLORS), strict=False)
    ]
    handles += [] if episode.is_joints else reason_handles(pose.reason for pose in episode.poses)
    legend_below(figure, handles)
    return figure


def _near(cloud: Cloud, route: Float[np.ndarray, "k 3"] | None) -> Int[np.ndarray, " shown"]:
    """Indices of the points around the key poses, thinned evenly; without key poses around the median point."""
    around = np.median(cloud.points, axis=0, keepdims=True) if route is None else route
    low, high = around.min(0) - AROUND, around.max(0) + AROUND
    inside = np.flatnonzero(np.all((cloud.points >= low) & (cloud.points <= high), axis=-1))
    return inside[:: max(1, -(-len(inside) // MOST_POINTS))]


def _scatter(axes: Any, points: Float[np.ndarray, "n 3"], colors: Float[np.ndarray, "n 3"]) -> None:
    """Points with equal scales and labelled axes."""
    axes.scatter(*points.T, c=colors, s=1.5, linewidths=0, depthshade=False)
    if len(points):
        axes.set_box_aspect(np.maximum(np.ptp(points, axis=0), 1e-3))
    for name in "xyz":
        getattr(axes, f"set_{name}label")(f"{name} [m]", fontsize=9)
    axes.tick_params(labelsize=7)
    axes.view_init(ELEVATION, AZIMUTH)


def _draw_route(axes: Any, episode: Episode, route: Float[np.ndarray, "k 3"]) -> None:
    """The way over the key poses."""
    axes.plot(*route.T, color=INK, linewidth=1.2, zorder=9)
    for point, pose in zip(route, episode.poses, strict=True):
        style = look(pose.reason)
        axes.plot(
            *point[:, None], marker=style.marker, color=style.color, markersize=7, markeredgecolor="white", zorder=10
        )
