"""Tasks whose instruction names objects by their colours."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lerobot_histmv.envs.tasks.base import Task

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

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
"""Colours that only tests of generalisation use."""


class ColorTask(Task):
    """A task about like objects of different colours.

    A variation names colours in order. ``slots`` lists the objects: those of the named colours, in order, then the
    distractors. Every description in ``objects`` has a material ``paint``.
    """

    palette: ClassVar[Mapping[str, tuple[float, float, float]]] = COLORS
    """Colours of targets and distractors."""

    @property
    def colors(self) -> list[str]:
        """Colours that the variation names, in order."""
        return [word for word in self.goal if word in self.palette]

    @property
    def wanted(self) -> list[str]:
        """The targets."""
        return self.targets

    @property
    def unwanted(self) -> list[str]:
        """The distractors."""
        return self.distractors

    def candidates(self) -> list[str]:
        """Objects of the episode."""
        return list(self.objects)

    def reset(self, simulation: "Simulation", variation: int, rng: np.random.Generator) -> None:
        """Place and colour the objects."""
        self.goal = self.variations[variation]
        names = self.candidates()
        self.slots = [names[i] for i in rng.permutation(len(names))]
        super().reset(simulation, variation, rng)
        others = [color for color in self.palette if color not in self.goal]
        drawn = rng.choice(len(others), len(self.distractors), replace=False)
        for slot, color in zip(self.slots, [*self.colors, *(others[i] for i in drawn)], strict=True):
            simulation.paint(slot, self.palette[color])

    @property
    def targets(self) -> list[str]:
        """Objects that the instruction names, in order."""
        return self.slots[: len(self.colors)]

    @property
    def distractors(self) -> list[str]:
        """Objects that the instruction does not name."""
        return self.slots[len(self.colors) :]
