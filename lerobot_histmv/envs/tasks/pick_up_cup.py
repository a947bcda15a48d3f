"""Pick up the cup of the named colour."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lerobot_histmv.envs.motion import Motion, Pose, top_down
from lerobot_histmv.envs.tasks.base import scatter
from lerobot_histmv.envs.tasks.colors import COLORS, ColorTask

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

APART = 0.12
"""Least distance between the cups' centres [m]."""
RIM = 0.037
"""Distance of the rim's middle from the cup's axis [m]."""
GRASP_DEPTH = 0.006
"""How far below the rim the tool grasps [m]."""
SUCCESS_HEIGHT = 0.2
ABOVE = 0.14
"""Height [m] of the via points over the rim."""
CARRY = (0.28, 0.0, 0.34)
"""Where the expert brings the rim [m]."""


class PickUpCup(ColorTask):
    """After RLBench's ``pick_up_cup``.

    | | |
    |---|---|
    | objects | three cups, 7 cm high |
    | scene | x 0.3 to 0.6, y -0.28 to 0.28 m, at least 12 cm apart |
    | variations | six colours |
    | success | the named cup is held and its foot is above 0.2 m |
    | failure | wrong object: another cup was held |
    | macro steps | 4: above the rim, grasp, above, carry |
    | difficulty | one finger goes into the cup: the rim must be met within 2 cm |
    """

    name = "pick_up_cup"
    objects: ClassVar[Mapping[str, str]] = {"cup0": "cup", "cup1": "cup", "cup2": "cup"}
    variations = tuple((color,) for color in COLORS)
    templates: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "train": (
            "pick up the {} cup",
            "grasp the {} cup and lift it",
            "lift the {} mug",
            "take the {} cup by its rim and raise it",
            "grab the {} mug and hold it up",
            "raise the {} cup off the table",
        ),
        "held_out": ("hoist the {} mug", "I would like to have the {} cup", "the {} cup should leave the table"),
    }

    def place(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """Cups standing anywhere, at least 12 cm apart."""
        for name, (x, y) in zip(self.slots, scatter(rng, len(self.slots), APART), strict=True):
            simulation.place_free(name, (x, y, 0.0005), 0)

    def watch(self, simulation: "Simulation", gripper: float) -> None:
        """Remember what has been grasped."""
        self.grasps.watch(simulation, gripper, self.slots)

    def is_success(self, simulation: "Simulation") -> bool:
        """Held high up."""
        target = self.targets[0]
        return bool(simulation.position(target)[2] > SUCCESS_HEIGHT) and simulation.gripped(target)

    def failure(self) -> str:
        """Which cup was held, if any."""
        return self.grasps.failure(self.targets)

    def expert(self, simulation: "Simulation") -> Iterator[Motion]:
        """Grasp the rim at its left, lift, carry."""
        grasp = rim_grasp(simulation, self.targets[0])
        yield Motion(via=(grasp.raised(ABOVE),), target=grasp, gripper=0.0)
        yield Motion(via=(grasp.raised(ABOVE),), target=top_down(CARRY), gripper=0.0, dwell=4)

    @classmethod
    def macro_steps(cls, variation: int) -> int:
        """Above, grasp, above, carry."""
        return 4


def rim_grasp(simulation: "Simulation", cup: str) -> Pose:
    """Pose that takes an upright cup by the wall at its left, one finger inside."""
    return top_down(simulation.site(f"{cup}/rim").position + np.array([0, RIM, -GRASP_DEPTH]))
