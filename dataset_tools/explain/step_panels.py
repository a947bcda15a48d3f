"""Pictures of an episode over its steps: what the history was used for, and where the tool was sent."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from dataset_tools.explain.episode import Explained
from dataset_tools.figure_style import AXIS_COLORS, INK, legend_below, new_figure

MOST_NUMBERS = 12
"""Decisions up to which a matrix has its numbers written in."""
CENTIMETRE, MILLIMETRE, PERCENT = 100.0, 1000.0, 100.0


def draw_history(episode: Explained) -> Figure:
    """Attention over steps in every layer, and how far the target would move without a step."""
    layers = range(len(episode.records[0].attention))
    shares = [episode.over_steps([one.attention[layer] for one in episode.records]) for layer in layers]
    moved = episode.over_steps([CENTIMETRE * one.influence for one in episode.records], back=1)
    figure = new_figure(3.9)
    grid = figure.subplots(1, len(shares) + 1, squeeze=False)[0]
    for layer, (axes, matrix) in enumerate(zip(grid, shares, strict=False)):
        _matrix(axes, PERCENT * matrix, f"attention in layer {layer + 1} [%]", "Blues", PERCENT)
    most = max(1.0, float(np.nanmax(moved, initial=0)))
    _matrix(grid[-1], moved, "target moves without the step [cm]", "Oranges", most)
    grid[0].set_ylabel("decision")
    return figure


def _matrix(axes: Axes, matrix: Float[np.ndarray, "n n"], title: str, colors: str, most: float) -> None:
    n = len(matrix)
    edges = (0.5, n + 0.5, n + 0.5, 0.5)
    axes.imshow(matrix, vmin=0, vmax=most, cmap=colors, extent=edges)
    axes.set_title(title, fontsize=10, color=INK)
    axes.set_xlabel("step looked at")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(nbins=12, integer=True))
    if n > MOST_NUMBERS:
        return
    for (row, column), value in np.ndenumerate(matrix):
        if np.isfinite(value):
            color = "white" if value > 0.6 * most else INK
            text = f"{value:.0f}" if most == PERCENT else f"{value:.1f}"
            axes.text(column + 1, row + 1, text, ha="center", va="center", fontsize=7, color=color)


def draw_poses(episode: Explained) -> Figure:
    """Predicted positions over the decisions beside the true ones, or those that were reached; errors below."""
    steps = np.arange(1, len(episode.records) + 1)
    other, name = compared(episode)
    figure = new_figure(6.2 if episode.truth is not None else 4.6)
    grid = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1), squeeze=False)[:, 0]
    for axis, (letter, color) in enumerate(AXIS_COLORS.items()):
        grid[0].plot(steps[: len(other)], other[:, axis], color=color, linewidth=5, alpha=0.3)
        grid[0].plot(steps, episode.actions[:, axis], color=color, marker="o", markersize=5, label=letter)
    closed = episode.actions[:, 7] <= 0.5
    for step in steps[closed]:
        grid[0].axvspan(step - 0.5, step + 0.5, color="#f59f00", alpha=0.12, linewidth=0)
    grid[0].set_ylabel("position [m]")
    errors = MILLIMETRE * np.linalg.norm(episode.actions[: len(other), :3] - other, axis=1)
    _bars(grid[1], steps[: len(other)], errors, f"distance to the\n{name} one [mm]")
    if episode.truth is not None:
        for step in steps[~episode.gripper_right]:
            grid[1].annotate("gripper wrong", (step, 0), (0, 8), textcoords="offset points", rotation=90, fontsize=8)
    grid[1].set_xlabel("decision")
    grid[1].xaxis.set_major_locator(MaxNLocator(integer=True))
    grid[0].set_xlim(0.5, len(steps) + 0.5)
    handles = [Line2D([], [], color=color, linewidth=2, label=letter) for letter, color in AXIS_COLORS.items()]
    handles += [
        Line2D([], [], color=INK, marker="o", label="predicted"),
        Line2D([], [], color=INK, linewidth=5, alpha=0.3, label=name),
        Line2D([], [], color="#f59f00", alpha=0.4, linewidth=8, label="gripper told to be closed"),
    ]
    legend_below(figure, handles)
    return figure


def compared(episode: Explained) -> tuple[Float[np.ndarray, "m 3"], str]:
    """Positions to hold the predicted ones against, and what they are."""
    if episode.truth is not None:
        return episode.truth[:, :3], "true"
    reached: Sequence[Float[np.ndarray, " 3"]] = [one.tool for one in episode.records[1:]]
    return np.array(reached).reshape(-1, 3), "reached"


def _bars(axes: Axes, steps: Int[np.ndarray, " m"], values: Float[np.ndarray, " m"], label: str) -> None:
    axes.bar(steps, values, color=INK, width=0.5)
    for step, value in zip(steps, values, strict=True):
        axes.annotate(f"{value:.0f}", (step, value), (0, 2), textcoords="offset points", ha="center", fontsize=8)
    axes.set_ylabel(label)
    axes.margins(y=0.2)
    axes.grid(alpha=0.3, axis="y")
