"""Methods that choose k nodes of a path; all read the same cost table and give the same kind of answer."""

from collections.abc import Callable, Iterator
from itertools import islice
from typing import Literal

import numpy as np
from jaxtyping import Int

from dataset_tools.fitness import Problem, cost_table, deviations, path_deviations
from dataset_tools.genetic import GeneticOptions, evolve

Method = Literal["ga", "exact", "heuristic", "rdp", "awe", "uniform"]

Chooser = Callable[[int], Int[np.ndarray, " k"]]
"""Sorted nodes for a wanted number of keyframes (at least the mandatory ones, at most every node)."""


_NODE_PENALTY = 1e6
"""One node more costs more than any summed error [m]."""


def growing(problem: Problem) -> Iterator[Int[np.ndarray, " k"]]:
    """Ramer-Douglas-Peucker selections, each with one node more: the one farthest from the simplified path."""
    selection = problem.mandatory
    away = path_deviations(problem.points, selection, problem.distance)
    away[selection] = -1
    yield selection
    for _ in problem.free:
        node = int(away.argmax())
        place = int(np.searchsorted(selection, node))
        for start, stop in ((int(selection[place - 1]), node), (node, int(selection[place]))):
            away[start + 1 : stop] = deviations(problem.points, start, stop, problem.distance)
        away[node] = -1
        selection = np.insert(selection, place, node)
        yield selection


def rdp(problem: Problem, k: int) -> Int[np.ndarray, " k"]:
    """Ramer-Douglas-Peucker selection of k nodes."""
    return next(islice(growing(problem), k - len(problem.mandatory), None))


def uniform(problem: Problem, k: int) -> Int[np.ndarray, " k"]:
    """Mandatory nodes, and the others evenly spread in time over the free ones."""
    extra = k - len(problem.mandatory)
    picks = (np.arange(extra) + 0.5) * len(problem.free) / max(extra, 1)
    return np.sort(np.append(problem.mandatory, problem.free[picks.astype(np.int64)]))


def genetic(problem: Problem, k: int, entropy: tuple[int, ...], options: GeneticOptions) -> Int[np.ndarray, " k"]:
    """Genetic algorithm started from Ramer-Douglas-Peucker; the same ``entropy`` and k give the same answer."""
    return evolve(problem, rdp(problem, k), np.random.default_rng([*entropy, k]), options)


def awe(problem: Problem, limit: float) -> Int[np.ndarray, " k"]:
    """Fewest nodes whose largest deviation is at most ``limit`` [m] (Automatic Waypoint Extraction).

    Among equally few, those with the smallest summed error.
    """
    worst = cost_table(problem.points, problem.mandatory.tolist(), problem.distance, np.max)
    jump = np.where(worst <= limit, problem.cost + _NODE_PENALTY, np.inf)
    reach, previous = np.zeros(len(jump)), np.zeros(len(jump), dtype=np.int64)
    for node in range(1, len(jump)):
        through = reach[:node] + jump[:node, node]
        previous[node] = through.argmin()
        reach[node] = through[previous[node]]
    nodes = [len(jump) - 1]
    while nodes[-1] > 0:
        nodes.append(int(previous[nodes[-1]]))
    return np.array(nodes[::-1])


def fewest(
    choose: Chooser, low: int, high: int, good: Callable[[Int[np.ndarray, " k"]], bool]
) -> Int[np.ndarray, " k"]:
    """Selection with the fewest nodes, by bisection over ``low..high``, that is good; that of ``high`` if none is."""
    best = None
    while low < high:
        middle = (low + high) // 2
        candidate = choose(middle)
        if good(candidate):
            best, high = candidate, middle
        else:
            low = middle + 1
    return choose(high) if best is None else best
