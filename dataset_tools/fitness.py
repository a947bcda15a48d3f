"""How far a recorded path is from the straight lines between its keyframes (paper 3.1, Eq. 1 to 3).

Every method reads the same table: ``cost[i, j]`` is what jumping from node i straight to node j costs, so the error of
a selection is a sum of k - 1 look-ups.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

Distance = Literal["segment", "line"]
DELTA = 1e-9
"""Keeps ``1 / (E + delta)`` finite for a perfect selection [m]."""

_DEGENERATE = 1e-12
"""Squared length [m^2] below which a segment is a point."""
_CHUNK = 64
"""Segment ends handled at once: bounds memory and wastes at most this much of the triangle."""
_BEFORE_END = np.tri(_CHUNK, k=-1)


def fitness(error: Float[np.ndarray, " g"], delta: float = DELTA) -> Float[np.ndarray, " g"]:
    """Eq. 3: ``1 / (E + delta)``, higher is better."""
    return 1 / (error + delta)


def deviations(
    points: Float[np.ndarray, "n d"], start: int, stop: int, distance: Distance = "segment"
) -> Float[np.ndarray, " m"]:
    """Distance of each point strictly between ``start`` and ``stop`` to the straight line joining these two.

    Args:
        points: the path [m].
        start: index of the first end.
        stop: index of the other end, > start.
        distance: ``segment`` clamps to the ends; ``line`` is Eq. 1, an infinite line. Coinciding ends give the
            distance to that point.
    """
    offset = points[start + 1 : stop] - points[start]
    chord = points[stop] - points[start]
    return _distances(offset @ chord, np.sum(offset**2, axis=-1), float(chord @ chord), distance)


def path_deviations(
    points: Float[np.ndarray, "n d"], selection: Int[np.ndarray, " k"], distance: Distance = "segment"
) -> Float[np.ndarray, " n"]:
    """Distance of every point to the simplified path [m]; 0 at the selected ones."""
    away = np.zeros(len(points))
    for start, stop in pairwise(selection.tolist()):
        away[start + 1 : stop] = deviations(points, start, stop, distance)
    return away


def cost_table(
    points: Float[np.ndarray, "n d"],
    mandatory: Sequence[int],
    distance: Distance = "segment",
    reduce: Callable[..., Any] = np.sum,
) -> Float[np.ndarray, "n n"]:
    """``cost[i, j]`` for i < j: sum of the deviations of the points strictly between [m].

    Args:
        points: the path.
        mandatory: sorted nodes that every selection keeps, first and last node included; nothing jumps over them.
        distance: see ``deviations``.
        reduce: ``np.sum``, or ``np.max`` for a table of the largest deviations.

    Returns:
        Upper-triangular table; ``inf`` where i >= j or a mandatory node lies strictly between.
    """
    table = np.full((len(points), len(points)), np.inf)
    for first, last in pairwise(mandatory):
        block = points[first : last + 1]
        for i in range(len(block) - 1):
            table[first + i, first + i + 1 : last + 1] = _jumps(block[i:], distance, reduce)
    return table


def _jumps(points: Float[np.ndarray, "n d"], distance: Distance, reduce: Callable[..., Any]) -> Float[np.ndarray, " m"]:
    """Costs of jumping from the first of ``points`` to each of the others."""
    offset = points[1:] - points[0]
    square = np.sum(offset**2, axis=-1)
    costs = np.empty(len(offset))
    for begin in range(0, len(offset), _CHUNK):
        end = min(begin + _CHUNK, len(offset))
        along = offset[begin:end] @ offset[:end].T
        away = _distances(along, square[:end], square[begin:end, None], distance)
        away[:, begin:] *= _BEFORE_END[: end - begin, : end - begin]
        costs[begin:end] = reduce(away, axis=-1)
    return costs


def _distances(
    along: Float[np.ndarray, "..."], square: Float[np.ndarray, "..."], length: ArrayLike, distance: Distance
) -> Float[np.ndarray, "..."]:
    """Distances from dot products with the chord (overwritten), squared offsets and the squared chord length."""
    length = np.asarray(length)
    inverse = np.divide(1.0, length, out=np.zeros_like(length), where=length > _DEGENERATE)
    reach = along.copy()
    if distance == "segment":
        np.minimum(np.maximum(reach, 0, out=reach), length, out=reach)
    along *= 2
    along -= reach
    along *= reach
    along *= inverse
    np.subtract(square, along, out=along)
    return np.sqrt(np.maximum(along, 0, out=along), out=along)


@dataclass(frozen=True, eq=False)
class Problem:
    """What every method solves: choose k nodes of a path, the mandatory ones among them.

    Attributes:
        points: nodes of the path, in metres per axis (n, d).
        mandatory: sorted nodes that are always kept, first and last included.
        distance: see ``deviations``.
        cost: table of ``cost_table``.
        free: the other nodes.
    """

    points: Float[np.ndarray, "n d"]
    mandatory: Int[np.ndarray, " m"]
    distance: Distance
    cost: Float[np.ndarray, "n n"]
    free: Int[np.ndarray, " f"]

    @classmethod
    def of(
        cls, points: Float[np.ndarray, "n d"], mandatory: Sequence[int], distance: Distance = "segment"
    ) -> "Problem":
        """Problem with its cost table filled in."""
        kept = np.asarray(mandatory, dtype=np.int64)
        free = np.setdiff1d(np.arange(len(points)), kept)
        return cls(points, kept, distance, cost_table(points, kept.tolist(), distance), free)

    def errors(self, selections: Int[np.ndarray, "g k"]) -> Float[np.ndarray, " g"]:
        """Eq. 2: summed error [m] of each of the sorted selections, which include the mandatory nodes."""
        return self.cost[selections[:, :-1], selections[:, 1:]].sum(-1)

    def error(self, selection: Int[np.ndarray, " k"]) -> float:
        """Eq. 2 for one selection."""
        return float(self.errors(selection[None])[0])
