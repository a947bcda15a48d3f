"""Pictures of an episode's motion: the path in space with its keyframes, and the error of every frame over time."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from dataset_tools.figure_style import FAINT, HALO, INK, legend_below, look, new_figure, reason_handles, shared_labels
from dataset_tools.inspect.episodes import Episode, KeyPose, Motion

CLOSED, CLOSED_LABEL = "#f59f00", "gripper told to be closed"
"""The path while the gripper is told to be closed."""
STRAIGHT = "#74a9e0"
"""The straight lines between keyframes."""
ELEVATION, AZIMUTH = 22.0, -58.0
"""From where the path is seen in space [degrees]."""
MARGIN = 0.1
"""Room around the path, as a share of its largest extent."""
THINNEST = 0.4
"""Least side of the drawn box, as a share of its largest."""
SAME_PLACE = 0.035
"""Keyframes closer than this share of the path's largest extent are numbered together."""


def draw_trajectory(episode: Episode) -> Figure:
    """The tool's path in space, from above and from the side; positions must be tool positions [m]."""
    figure = new_figure(6.2)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.55, 1))
    space = figure.add_subplot(grid[:, 0], projection="3d")
    _draw_path(space, episode, (0, 1, 2))
    _stand_on_floor(space, episode)
    for row, (order, title) in enumerate((((0, 1), "from above"), ((0, 2), "from the side"))):
        axes = figure.add_subplot(grid[row, 1])
        _draw_path(axes, episode, order)
        axes.set_title(title, fontsize=10, color=INK)
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(x=2 * MARGIN, y=MARGIN)
        axes.grid(alpha=0.3)
    handles = [*_path_handles(episode), *reason_handles(pose.reason for pose in episode.poses)]
    legend_below(figure, handles)
    return figure


def _draw_path(axes: Any, episode: Episode, order: Sequence[int]) -> None:
    """Path, straight lines and numbered keyframes, with the world axes ``order`` as the picture's."""
    key_points = key_positions(episode)[:, order]
    axes.plot(*key_points.T, color=STRAIGHT, linewidth=1.6, linestyle=(0, (4, 2)), zorder=2)
    if episode.motion:
        points = episode.motion.trajectory.position[:, order]
        axes.plot(*points.T, color=INK, linewidth=1.4, zorder=3)
        axes.plot(*np.where(_closed(episode.motion)[:, None], points, np.nan).T, color=CLOSED, linewidth=2.4, zorder=4)
    for point, pose in zip(key_points, episode.poses, strict=True):
        style = look(pose.reason)
        axes.plot(
            *point[:, None], marker=style.marker, color=style.color, markersize=8, markeredgecolor="white", zorder=5
        )
    for place, text in shared_labels(key_points, SAME_PLACE * _extent(episode)):
        _write(axes, place, text)
    for name, axis in zip(("set_xlabel", "set_ylabel", "set_zlabel"), order, strict=False):
        getattr(axes, name)(f"{'xyz'[axis]} [m]", fontsize=9)
    axes.tick_params(labelsize=8)


def _write(axes: Any, place: Float[np.ndarray, " d"], text: str) -> None:
    """A number beside a keyframe."""
    style: dict[str, Any] = {"fontsize": 9, "color": INK, "path_effects": HALO, "zorder": 10}
    if len(place) == 3:
        axes.text(*place, f"   {text}", **style)
    else:
        axes.annotate(text, place, xytext=(7, 5), textcoords="offset points", **style)


def _stand_on_floor(space: Any, episode: Episode) -> None:
    """Equal scales, and a shadow with a stem below each keyframe, which tell heights apart."""
    points = key_positions(episode)
    everything = np.vstack([points, *([episode.motion.trajectory.position] if episode.motion else [])])
    room = MARGIN * _extent(episode)
    middle, half = (everything.max(0) + everything.min(0)) / 2, np.ptp(everything, axis=0) / 2 + room
    half = np.maximum(half, THINNEST * half.max())
    low, high = middle - half, middle + half
    for name, begin, end in zip("xyz", low, high, strict=True):
        getattr(space, f"set_{name}lim")(begin, end)
        getattr(space, f"{name}axis").set_major_locator(MaxNLocator(max(2, round(6 * (end - begin) / half.max() / 2))))
    space.set_box_aspect(high - low)
    floor = np.full(len(everything), low[2])
    path = everything[len(points) :] if episode.motion else points
    space.plot(path[:, 0], path[:, 1], floor[: len(path)], color=FAINT, linewidth=1, zorder=1)
    for x, y, z in points:
        space.plot([x, x], [y, y], [low[2], z], color=FAINT, linewidth=0.8, linestyle=":", zorder=1)
    space.view_init(ELEVATION, AZIMUTH)
    for axis in (space.xaxis, space.yaxis, space.zaxis):
        axis.set_pane_color((0.97, 0.97, 0.98))


def _path_handles(episode: Episode) -> list[Line2D]:
    """Legend entries of the lines."""
    straight = Line2D([], [], color=STRAIGHT, linestyle=(0, (4, 2)), label="straight lines between keyframes")
    if not episode.motion:
        return [straight]
    recorded = Line2D([], [], color=INK, label="recorded path")
    closed = Line2D([], [], color=CLOSED, linewidth=2.4, label=CLOSED_LABEL)
    return [recorded, *([closed] if _closed(episode.motion).any() else []), straight]


def key_positions(episode: Episode) -> Float[np.ndarray, "k d"]:
    """Where the keyframes lie: on the recorded path, from which errors count, or else where the rows say."""
    if episode.motion:
        return episode.motion.trajectory.position[[keyframe.pose_frame for keyframe in episode.motion.keyframes]]
    return np.stack([pose.position for pose in episode.poses])


def _closed(motion: Motion) -> Bool[np.ndarray, " n"]:
    """Frames at which the gripper is told to be closed."""
    gripper = motion.trajectory.gripper
    return np.zeros(len(motion.errors), bool) if gripper is None else gripper < 0.5


def _extent(episode: Episode) -> float:
    """Largest side of the box around the path [m]; 1 mm at least."""
    points = episode.motion.trajectory.position if episode.motion else key_positions(episode)
    return max(float(np.ptp(points, axis=0).max()), 1e-3)


def draw_errors(episode: Episode) -> Figure:
    """Error of every frame over time, the tool's speed and the gripper command below; needs the recorded path."""
    motion = episode.motion
    assert motion is not None
    trajectory, options = motion.trajectory, motion.options
    figure = new_figure(4.6)
    error, speed = figure.subplots(2, 1, sharex=True, height_ratios=(2.4, 1))
    seconds = np.arange(len(trajectory)) / trajectory.fps
    error.plot(seconds, 1000 * motion.errors, color=INK, linewidth=1.5)
    error.fill_between(seconds, 1000 * motion.errors, color=INK, alpha=0.12, linewidth=0)
    mean = 1000 * float(np.nanmean(motion.errors))
    error.axhline(mean, color=INK, linewidth=1, linestyle=":", label=f"mean {mean:.2f} m{episode.unit}")
    accepted = f"accepted {'largest' if options.method == 'awe' else 'mean'} {1000 * options.epsilon:g} m{episode.unit}"
    error.axhline(1000 * options.epsilon, color="#e03131", linewidth=1, linestyle="--", label=accepted)
    error.set_ylabel(f"error [m{episode.unit}]", fontsize=9)
    error.set_ylim(bottom=0)
    steps = np.linalg.norm(np.diff(trajectory.position, axis=0), axis=-1) * trajectory.fps
    speed.plot(seconds[1:] - 0.5 / trajectory.fps, steps, color=INK, linewidth=1.2)
    speed.axhline(
        options.pause.speed, color=look("pause").color, linewidth=1, linestyle="--", label="slower counts as still"
    )
    speed.set_ylabel(f"speed [{episode.unit}/s]", fontsize=9)
    speed.set_xlabel(f"time [s]; frames at {trajectory.fps:g} Hz", fontsize=9)
    strip = speed.get_xaxis_transform()
    speed.fill_between(
        seconds, 0.94, 1, where=_closed(motion).tolist(), transform=strip, color=CLOSED, label=CLOSED_LABEL
    )
    for axes in (error, speed):
        _mark_keyframes(axes, motion, episode.poses)
        axes.tick_params(labelsize=8)
        axes.margins(x=0.01)
        axes.spines[["top", "right"]].set_visible(False)
    _number_keyframes(error, motion)
    handles = [line for axes in (error, speed) for line in axes.get_legend_handles_labels()[0]]
    legend_below(figure, [*handles, *reason_handles(pose.reason for pose in episode.poses)])
    return figure


def _mark_keyframes(axes: Axes, motion: Motion, poses: Sequence[KeyPose]) -> None:
    """A line at every pose frame, the rest that follows shaded, and where the gripper is told to be closed."""
    fps = motion.trajectory.fps
    for keyframe, pose in zip(motion.keyframes, poses, strict=True):
        color = look(pose.reason).color
        axes.axvline(keyframe.pose_frame / fps, color=color, linewidth=1.2)
        if keyframe.rests:
            axes.axvspan(keyframe.pose_frame / fps, keyframe.observation_frame / fps, color=color, alpha=0.12, lw=0)


def _number_keyframes(axes: Axes, motion: Motion) -> None:
    """The keyframes' numbers along the upper edge."""
    times = np.array([[keyframe.pose_frame / motion.trajectory.fps] for keyframe in motion.keyframes])
    for (time,), text in shared_labels(times, 0.012 * len(motion.errors) / motion.trajectory.fps):
        place = (time, 1.01)
        axes.annotate(text, place, xycoords=("data", "axes fraction"), ha="center", va="bottom", fontsize=8, color=INK)
