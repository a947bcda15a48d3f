"""An episode with everything that the policy made of it, and the numbers that its pictures show."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from dataset_tools.explain.watch import Record
from lerobot_histmv.geometry import angle_between


@dataclass(frozen=True, eq=False)
class Explained:
    """An episode of n decisions.

    Attributes:
        name: "episode 3" of a dataset, "scene 200000" of an environment.
        instruction: what the policy was told.
        records: its decisions.
        truth: the key poses that the demonstration went to; None where nobody knows them.
        outcome: how a rollout ended; empty for an episode of a dataset.
    """

    name: str
    instruction: str
    records: Sequence[Record]
    truth: Float[np.ndarray, "n 8"] | None = None
    outcome: str = ""

    @property
    def cameras(self) -> list[str]:
        """The policy's views."""
        return list(self.records[0].views)

    @cached_property
    def weights(self) -> Float[np.ndarray, "n k"]:
        """View weights."""
        return np.stack([one.weights for one in self.records])

    @cached_property
    def scores(self) -> Float[np.ndarray, "n k"]:
        """What the acting view has most of."""
        return np.stack([one.scores for one in self.records])

    @cached_property
    def chosen(self) -> Int[np.ndarray, " n"]:
        """Index of the view that acted."""
        return np.array([one.chosen for one in self.records])

    @cached_property
    def changes(self) -> list[int]:
        """Decisions at which another view acted than before."""
        return (np.flatnonzero(np.diff(self.chosen)) + 1).tolist()

    @cached_property
    def actions(self) -> Float[np.ndarray, "n 8"]:
        """What was decided."""
        return np.stack([one.action for one in self.records])

    @cached_property
    def information(self) -> Float[np.ndarray, "n k k"]:
        """Normalised mutual information between the views."""
        return np.stack([one.information for one in self.records])

    def over_steps(self, values: Sequence[Float[np.ndarray, " _"]], back: int = 0) -> Float[np.ndarray, "n n"]:
        """What each decision (row) says of each step (column), NaN where it says nothing.

        Args:
            values: per decision, one number per step of its history, old to new.
            back: how many steps before the decision the last number is of.
        """
        matrix = np.full((len(values), len(values)), np.nan)
        for row, numbers in enumerate(values):
            end = row + 1 - back
            matrix[row, end - len(numbers) : end] = numbers
        return matrix

    @property
    def errors(self) -> Float[np.ndarray, " n"]:
        """Distance of the decided positions to the true ones [m]; there must be a truth."""
        assert self.truth is not None
        return np.linalg.norm(self.actions[:, :3] - self.truth[:, :3], axis=1)

    @property
    def turns(self) -> Float[np.ndarray, " n"]:
        """Angle between the decided rotations and the true ones [degrees]; there must be a truth."""
        assert self.truth is not None
        return np.degrees(angle_between(self.actions[:, 3:7], self.truth[:, 3:7]))

    @property
    def gripper_right(self) -> Bool[np.ndarray, " n"]:
        """Whether the decided gripper command is the true one; there must be a truth."""
        assert self.truth is not None
        return (self.actions[:, 7] > 0.5) == (self.truth[:, 7] > 0.5)
