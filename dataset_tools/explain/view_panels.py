"""Pictures of the view attention over an episode: which view acted when, and what the views share."""

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from dataset_tools.explain.board import tile
from dataset_tools.explain.episode import Explained
from dataset_tools.figure_style import FAINT, INK, legend_below, new_figure
from dataset_tools.inspect.cloud import CAMERA_COLORS

THUMB = 160
"""Side of the small pictures [pixels]."""
PER_ROW = 6
"""Small pictures or matrices beside each other."""


def color_of(index: int) -> str:
    """Colour of a view."""
    return CAMERA_COLORS[index % len(CAMERA_COLORS)]


def draw_weights(episode: Explained) -> Figure:
    """The view that acted at every decision, and below them what chose it; lines mark where another view takes over.

    After Figure 4 of the paper.
    """
    n = len(episode.records)
    rows = -(-n // PER_ROW)
    figure = new_figure(1.75 * rows + 3.0)
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.75 * rows, 3.0))[:, 0]
    grid = above.subplots(rows, PER_ROW, squeeze=False).ravel()
    for axes in grid:
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
    for index, (axes, record) in enumerate(zip(grid, episode.records, strict=False)):
        truth = None if episode.truth is None else episode.truth[index]
        axes.imshow(np.asarray(tile(record, record.chosen, THUMB, truth)))
        changed = index in episode.changes
        title = f"{index + 1}: {episode.cameras[record.chosen]}"
        axes.set_title(title, fontsize=9, color=INK, fontweight="bold" if changed else "normal")
        axes.spines[:].set(visible=True, linewidth=4, color=color_of(record.chosen))
    weights, scores = below.subplots(1, 2, sharex=True)
    _lines(weights, episode, episode.weights, "view weight")
    _lines(scores, episode, episode.scores, f"{episode.records[0].choosing.score}: the largest acts")
    handles = [
        Line2D([], [], color=color_of(index), linewidth=2.5, label=camera)
        for index, camera in enumerate(episode.cameras)
    ]
    handles.append(Line2D([], [], color=INK, marker="o", linestyle="", markersize=7, label="acts"))
    handles.append(Line2D([], [], color=INK, linestyle=":", label="another view takes over"))
    legend_below(figure, handles)
    return figure


def _lines(axes: Axes, episode: Explained, values: Float[np.ndarray, "n k"], title: str) -> None:
    """One line per view over the decisions, with a dot where it acted."""
    steps = np.arange(1, len(values) + 1)
    for index, line in enumerate(values.T):
        acts = episode.chosen == index
        axes.plot(steps, line, color=color_of(index), linewidth=2)
        axes.plot(steps[acts], line[acts], "o", color=color_of(index), markersize=7)
    for step in episode.changes:
        axes.axvline(step + 0.5, color=INK, linestyle=":", linewidth=1)
    axes.set(xlim=(0.5, len(steps) + 0.5), ylim=(0, 1.1 * values.max()), xlabel="decision")
    axes.set_title(title, fontsize=10, color=INK)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3)


def draw_information(episode: Explained) -> Figure:
    """The normalised mutual information between the views: its mean over the episode, and at every decision."""
    matrices = [episode.information.mean(axis=0), *episode.information]
    titles = ["mean", *(f"{index + 1}" for index in range(len(episode.records)))]
    rows = -(-len(matrices) // PER_ROW)
    figure = new_figure(1.75 * rows + 0.3)
    grid = figure.subplots(rows, PER_ROW, squeeze=False)
    for axes in grid.ravel()[len(matrices) :]:
        axes.set_axis_off()
    for index, (axes, matrix, title) in enumerate(zip(grid.ravel(), matrices, titles, strict=False)):
        picture = axes.imshow(matrix, vmin=0, vmax=1, cmap="viridis")
        for (row, column), value in np.ndenumerate(matrix):
            color = "white" if value < 0.6 else "black"
            axes.text(column, row, f"{value:.2f}", ha="center", va="center", fontsize=8, color=color)
        axes.set_title(title, fontsize=9, color=INK, fontweight="bold" if index == 0 else "normal")
        ticks = range(len(episode.cameras))
        axes.set_xticks(ticks, episode.cameras if index == 0 else [], fontsize=7, rotation=90)
        axes.set_yticks(ticks, episode.cameras if index == 0 else [], fontsize=7)
        axes.tick_params(length=0)
    bar = figure.colorbar(picture, ax=grid, fraction=0.02)
    bar.outline.set_edgecolor(FAINT)
    return figure
