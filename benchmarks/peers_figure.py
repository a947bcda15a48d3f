"""The figure of ``peers.py``: success with its 95 % interval against training minutes, a line per method and budget."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, NullLocator

from dataset_tools.figure_style import new_figure

COLORS = {
    "histmv": "#1971c2",
    "hiveformer": "#2f9e44",
    "act": "#e8590c",
    "act_keyframes": "#c2255c",
    "diffusion": "#9c36b5",
}
MARKERS = {"histmv": "o", "hiveformer": "s", "act": "D", "act_keyframes": "^", "diffusion": "X"}
MINUTES = (1, 2, 5, 10, 15, 25, 30, 60, 120)
"""Ticks of the logarithmic axis."""
ASIDE = 0.015
"""Lines are drawn this share of the time apart, so that equal results stay readable."""


def draw_line(axes: Axes, result: Mapping[str, Any], factor: float, dashed: bool) -> None:
    """Draw one training; ``factor`` moves it along the axis of minutes."""
    points = result["points"]
    shares = [100 * point["n_successes"] / point["n_episodes"] for point in points]
    bounds = [[share - point["wilson_95"][0] for share, point in zip(shares, points, strict=True)]]
    bounds.append([point["wilson_95"][1] - share for share, point in zip(shares, points, strict=True)])
    label = f"{result['label']}, budget {result['budget_minutes']} min: {result['sees']}; {result['learns_from']}"
    axes.errorbar(
        [factor * point["minutes"] for point in points],
        shares,
        yerr=bounds,
        label=label,
        color=COLORS[result["method"]],
        marker=MARKERS[result["method"]],
        linestyle="--" if dashed else "-",
        markersize=6,
        capsize=3,
        linewidth=1.6,
    )


def draw(results: Mapping[str, Mapping[str, Any]], setting: str, file: Path) -> None:
    """Write the figure of one setting.

    Args:
        results: content of ``peers.json``.
        setting: whose results to draw.
        file: PNG file.

    Raises:
        ValueError: there is nothing to draw.
    """
    chosen = [result for result in results.values() if result["setting"] == setting and result["points"]]
    if not chosen:
        raise ValueError(f"no results of setting {setting!r}; there are {sorted(results)}")
    chosen.sort(key=lambda result: (list(COLORS).index(result["method"]), result["budget_minutes"], result["seed"]))
    shortest = min(result["budget_minutes"] for result in chosen)
    figure = new_figure(5.2 + 0.2 * len(chosen))
    axes = figure.add_subplot()
    for number, result in enumerate(chosen):
        factor = 1 + ASIDE * (number - (len(chosen) - 1) / 2)
        draw_line(axes, result, factor, dashed=result["budget_minutes"] > shortest)
    scenes = max(point["n_episodes"] for result in chosen for point in result["points"])
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(FixedLocator(MINUTES))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set(
        xlabel="training [minutes on this machine]", ylabel=f"success in {scenes} unseen scenes [%]", ylim=(-3, 103)
    )
    axes.set_title(f"{chosen[0]['task']}, {chosen[0]['demonstrations']} demonstrations", loc="left")
    axes.grid(color="#e9ecef")
    axes.set_axisbelow(True)
    figure.legend(loc="outside lower left", ncols=1, fontsize=9, frameon=False)
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file)
