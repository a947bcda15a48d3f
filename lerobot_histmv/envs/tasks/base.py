"""What a task is: objects, variations, success, failure, instructions and a scripted expert."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from jaxtyping import Float

from lerobot_histmv.envs.motion import Motion

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

SPLITS = ("train", "held_out")
"""Instructions for recording and training, and paraphrases kept back for evaluation."""
COLORS = {
    "red": (0.85, 0.1, 0.1),
    "green": (0.1, 0.65, 0.2),
    "blue": (0.1, 0.25, 0.85),
    "yellow": (0.95, 0.8, 0.1),
    "purple": (0.55, 0.15, 0.7),
    "cyan": (0.1, 0.75, 0.8),
}
"""The six colours of the tasks (RGB)."""
HELD_OUT_COLORS = {"orange": (0.95, 0.45, 0.05), "pink": (0.95, 0.45, 0.65), "white": (0.92, 0.92, 0.92)}
"""Colours that no task uses, kept for tests of generalisation."""
WORKSPACE = np.array([[0.3, 0.6], [-0.28, 0.28]])
"""Range of x and of y [m] in which objects lie."""


class Task(ABC):
    """One task; an instance holds the state of one episode.

    A variation is what the instruction asks for: a sequence of colours, in order. ``slots`` lists the scene's objects:
    those of the named colours, in order, then the distractors.
    """

    name: ClassVar[str]
    objects: ClassVar[Mapping[str, str]]
    """Object name -> description in ``envs/objects``; at least as many as the longest variation names."""
    variations: ClassVar[tuple[tuple[str, ...], ...]]
    initial_gripper: ClassVar[float] = 1.0
    """Gripper command at the start: 1 open, 0 closed."""

    def reset(self, simulation: "Simulation", variation: int, rng: np.random.Generator) -> None:
        """Colour and place all objects and forget the last episode; ``rng`` decides what the variation leaves open."""
        self.goal = self.variations[variation]
        names = list(self.objects)
        self.slots = [names[i] for i in rng.permutation(len(names))]
        self.place(simulation, rng)
        others = [color for color in COLORS if color not in self.goal]
        drawn = rng.choice(len(others), len(self.distractors), replace=False)
        for slot, color in zip(self.slots, [*self.goal, *(others[i] for i in drawn)], strict=True):
            simulation.paint(slot, COLORS[color])

    @property
    def targets(self) -> list[str]:
        """Objects that the instruction names, in order."""
        return self.slots[: len(self.goal)]

    @property
    def distractors(self) -> list[str]:
        """Objects that the instruction does not name."""
        return self.slots[len(self.goal) :]

    @abstractmethod
    def place(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """Put the objects somewhere and reset the episode's own state."""

    @abstractmethod
    def watch(self, simulation: "Simulation", gripper: float) -> None:
        """Called after each tick with the gripper command in force."""

    @abstractmethod
    def is_success(self, simulation: "Simulation") -> bool:
        """Whether the task is fulfilled now."""

    @abstractmethod
    def failure(self) -> str:
        """Why an episode that has run out of time failed: wrong object, grasp missed, not reached or time."""

    @abstractmethod
    def expert(self, simulation: "Simulation") -> Iterator[Motion]:
        """Motions that fulfil the task; object poses are read again before each motion."""

    @classmethod
    @abstractmethod
    def macro_steps(cls, variation: int) -> int:
        """Macro steps of the expert, via points included."""

    @classmethod
    @abstractmethod
    def instructions(cls, variation: int, split: str) -> tuple[str, ...]:
        """Paraphrases of a variation's instruction; ``split`` is ``train`` or ``held_out``."""


def scatter(rng: np.random.Generator, count: int, apart: float) -> Float[np.ndarray, "count 2"]:
    """Uniform positions [m] in ``WORKSPACE``, at least ``apart`` from one another."""
    while True:
        points = rng.uniform(WORKSPACE[:, 0], WORKSPACE[:, 1], (count, 2))
        distances = np.linalg.norm(points[:, None] - points[None], axis=-1)
        if distances[np.triu_indices(count, 1)].min() >= apart:
            return points
