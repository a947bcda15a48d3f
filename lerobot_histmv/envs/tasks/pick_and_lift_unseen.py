"""Pick up and lift what training does not show: other colours, other shapes (paper, section 4.4)."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lerobot_histmv.envs.tasks.colors import COLORS, HELD_OUT_COLORS
from lerobot_histmv.envs.tasks.pick_and_lift import PickAndLift

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

SYMMETRY = {"cylinder": 2 * np.pi, "hexagon": np.pi / 3, "brick": np.pi}
"""Shape -> the least turn [rad] that leaves it as it is; a cylinder is grasped as it stands."""
UNDER_THE_TABLE = -0.73
"""Height [m] of the blocks that an episode does not use."""


class PickAndLiftUnseenColors(PickAndLift):
    """``pick_and_lift`` with colours that no training task names or gives to what it names.

    | | |
    |---|---|
    | objects | three cubes in the held-out colours |
    | scene | as in pick_and_lift |
    | variations | orange, pink, white |
    | success | as in pick_and_lift |
    | failure | as in pick_and_lift |
    | macro steps | 4: above, grasp, above, carry |
    | difficulty | the colour words must mean something to the text encoder |
    """

    name = "pick_and_lift_unseen_colors"
    palette = HELD_OUT_COLORS
    variations = tuple((color,) for color in HELD_OUT_COLORS)


class PickAndLiftUnseenShapes(PickAndLift):
    """``pick_and_lift`` with blocks of other shapes.

    | | |
    |---|---|
    | objects | three blocks of one shape: cylinders, hexagonal prisms or bricks of 3 x 5 cm, all 4 cm high |
    | scene | as in pick_and_lift |
    | variations | six colours of each shape: cylinder (0 to 5), hexagon (6 to 11), brick (12 to 17) |
    | success | as in pick_and_lift |
    | failure | as in pick_and_lift |
    | macro steps | 4: above, grasp, above, carry |
    | difficulty | a brick fits between the fingers in one direction only |
    """

    name = "pick_and_lift_unseen_shapes"
    objects: ClassVar[Mapping[str, str]] = {f"{shape}{i}": f"block_{shape}" for shape in SYMMETRY for i in range(3)}
    variations = tuple((color, shape) for shape in SYMMETRY for color in COLORS)
    templates: ClassVar[Mapping[str, tuple[str, ...]]] = {
        split: tuple(sentence.replace("{} cube", "{} {}").replace("{} block", "{} {}") for sentence in sentences)
        for split, sentences in PickAndLift.templates.items()
    }

    def candidates(self) -> list[str]:
        """The three blocks of the named shape."""
        return [name for name in self.objects if name.startswith(self.goal[1])]

    def place(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """The named shape as in ``pick_and_lift``, the other blocks out of sight."""
        super().place(simulation, rng)
        for index, name in enumerate(self.objects):
            if name not in self.slots:
                simulation.place_free(name, (0.1 + 0.07 * index, 0, UNDER_THE_TABLE), 0)

    def symmetry(self) -> float:
        """Of the named shape."""
        return SYMMETRY[self.goal[1]]
