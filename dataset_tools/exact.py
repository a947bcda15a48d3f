"""The judge: a dynamic program that finds the best selection for every number of keyframes at once."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from dataset_tools.fitness import Problem


@dataclass(frozen=True, eq=False)
class Optimum:
    """Smallest error of any selection with k nodes, for each k.

    Attributes:
        errors: summed error [m] by k, from 0 to k_max; ``inf`` where fewer than the mandatory nodes, or more nodes than
            the path has, would be needed. Never rises with k among the finite ones.
        previous: the node before node j in the best selection of k nodes that ends in j (k_max + 1, n).
    """

    errors: Float[np.ndarray, " k"]
    previous: Int[np.ndarray, "k n"]

    def selection(self, k: int) -> Int[np.ndarray, " k"]:
        """Sorted nodes of a best selection with k nodes; ValueError where there is none."""
        if not (k < len(self.errors) and np.isfinite(self.errors[k])):
            possible = np.flatnonzero(np.isfinite(self.errors)).tolist()
            raise ValueError(f"no selection of {k} keyframes exists; possible are {possible}")
        nodes = [self.previous.shape[1] - 1]
        for size in range(k, 1, -1):
            nodes.append(int(self.previous[size, nodes[-1]]))
        return np.array(nodes[::-1])


def solve(problem: Problem, k_max: int) -> Optimum:
    """Best selections of 2 to ``k_max`` nodes in O(k_max n^2)."""
    n = len(problem.points)
    reach = np.full((k_max + 1, n), np.inf)
    previous = np.zeros((k_max + 1, n), dtype=np.int64)
    reach[1, 0] = 0
    for k in range(2, k_max + 1):
        through = reach[k - 1][:, None] + problem.cost
        previous[k] = through.argmin(axis=0)
        reach[k] = np.take_along_axis(through, previous[k][None], axis=0)[0]
    return Optimum(reach[:, -1], previous)
