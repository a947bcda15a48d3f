"""Pick up the cup of the named colour."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lerobot_histmv.envs.tasks.base import scatter
from lerobot_histmv.envs.tasks.pick_and_lift import PickAndLift
from lerobot_histmv.motion import Pose, top_down

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

APART = 0.12
"""Least distance between the cups' centres [m]."""
RIM = 0.037
"""Distance of the rim's middle from the cup's axis [m]."""
GRASP_DEPTH = 0.006
"""How far below the rim the tool grasps [m]."""


class PickUpCup(PickAndLift):
    """After RLBench's ``pick_up_cup``.

    | | |
    |---|---|
    | objects | three cups, 7 cm high (RLBench: two) |
    | scene | x 0.3 to 0.6, y -0.28 to 0.28 m, at least 12 cm apart |
    | variations | six colours |
    | success | the named cup is held and its foot is above 0.2 m (RLBench: held, away from where it stood; that |
    | | would count a cup that is dragged) |
    | failure | wrong object: another cup was held |
    | macro steps | 4: above the rim, grasp, above, carry |
    | difficulty | one finger goes into the cup: the rim must be met within 2 cm |
    """

    name = "pick_up_cup"
    objects: ClassVar[Mapping[str, str]] = {"cup0": "cup", "cup1": "cup", "cup2": "cup"}
    carry = (0.28, 0.0, 0.34)
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
        stand_cups(simulation, self.slots, APART, rng)

    def grasp(self, simulation: "Simulation") -> Pose:
        """The rim at its left."""
        return rim_grasp(simulation, self.targets[0])


def rim_grasp(simulation: "Simulation", cup: str) -> Pose:
    """Pose that takes an upright cup by the wall at its left, one finger inside."""
    return top_down(simulation.site(f"{cup}/rim").position + np.array([0, RIM, -GRASP_DEPTH]))


def stand_cups(simulation: "Simulation", cups: Sequence[str], apart: float, rng: np.random.Generator) -> None:
    """Upright cups anywhere, at least ``apart`` [m] from one another."""
    for name, (x, y) in zip(cups, scatter(rng, len(cups), apart), strict=True):
        simulation.place_free(name, (x, y, 0.0005), 0)
