"""One look for all pictures of keyframes: a colour and a marker per reason, so that no legend need be learnt twice."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import matplotlib.patheffects
import numpy as np
from jaxtyping import Float
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

WIDTH = 10.0
"""Width of a figure [inches]; with ``DPI`` 1,200 pixels."""
DPI = 120
LETTERS = 150
"""How many letters of a legend fit beside each other."""
INK, FAINT = "#343a40", "#adb5bd"
AXIS_COLORS = {"x": "#e03131", "y": "#2f9e44", "z": "#1971c2"}
HALO = [matplotlib.patheffects.withStroke(linewidth=2.5, foreground="white")]
"""Makes text and lines readable on anything."""


@dataclass(frozen=True)
class Look:
    """How keyframes of one reason are drawn."""

    color: str
    marker: str
    label: str


LOOKS = {
    "start": Look("#0b7285", "o", "start"),
    "pause": Look("#9c36b5", "s", "pause"),
    "gripper": Look("#e8590c", "D", "gripper change"),
    "ga": Look("#1c7ed6", "^", "added by the method (ga)"),
    "end": Look("#c2255c", "X", "end"),
}


def look(reason: str) -> Look:
    """How a keyframe kept for ``reason`` is drawn."""
    return LOOKS.get(reason, Look(INK, "P", reason))


def new_figure(height: float) -> Figure:
    """An empty figure of the common width, ``height`` inches high."""
    return Figure(figsize=(WIDTH, height), dpi=DPI, layout="constrained")


def legend_below(figure: Figure, handles: Sequence[Artist]) -> None:
    """One legend for the whole figure, under it."""
    longest = max(len(str(handle.get_label())) for handle in handles)
    columns = min(len(handles), max(1, LETTERS // (longest + 6)))
    figure.legend(handles=list(handles), loc="outside lower center", ncols=columns, fontsize=9, frameon=False)


def reason_handles(reasons: Iterable[str]) -> list[Line2D]:
    """Legend entries for the reasons that occur, in their usual order."""
    found = set(reasons)
    ordered = [reason for reason in LOOKS if reason in found] + sorted(found - set(LOOKS))
    return [
        Line2D([], [], color=look(reason).color, marker=look(reason).marker, linestyle="", label=look(reason).label)
        for reason in ordered
    ]


def shared_labels(
    points: Float[np.ndarray, "k d"], within: float, first: int = 0
) -> list[tuple[Float[np.ndarray, " d"], str]]:
    """What to write beside points numbered from ``first``; those closer than ``within`` share a text: ``2, 5``.

    Points that are not finite get none.
    """
    places: list[tuple[Float[np.ndarray, " d"], list[int]]] = []
    for number, point in enumerate(points, first):
        near = next((numbers for place, numbers in places if np.linalg.norm(place - point) < within), None)
        if near is not None:
            near.append(number)
        elif np.isfinite(point).all():
            places.append((point, [number]))
    return [(place, ", ".join(map(str, numbers))) for place, numbers in places]
