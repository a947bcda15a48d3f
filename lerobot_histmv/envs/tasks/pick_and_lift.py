"""Pick up the cube that the instruction names and lift it."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lerobot_histmv.envs.tasks.base import nearest_turn, scatter
from lerobot_histmv.envs.tasks.colors import COLORS, ColorTask
from lerobot_histmv.motion import Motion, Pose, top_down

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

APART = 0.10
"""Least distance between the cubes' centres [m]."""
CUBE_HEIGHT = 0.0201
"""Height [m] of a cube's centre on the table."""
SUCCESS_HEIGHT = 0.2
"""The region of success is the space above this height [m] of the cube's centre."""
ABOVE = 0.14
"""Height [m] of the via points over the cube."""


class PickAndLift(ColorTask):
    """After RLBench's ``pick_and_lift``.

    | | |
    |---|---|
    | objects | three cubes of 4 cm and 50 g |
    | scene | x 0.3 to 0.6, y -0.28 to 0.28 m, at least 10 cm apart, any yaw |
    | variations | six colours |
    | success | the named cube is held and its centre is above 0.2 m (RLBench: held, inside a ball that is shown; |
    | | a ball would hide cubes, and no instruction here names it) |
    | failure | wrong object: another cube was held |
    | macro steps | 4: above, grasp, above, carry |
    | difficulty | none beyond finding the cube: 1 cm aside is still a grasp |
    """

    name = "pick_and_lift"
    objects: ClassVar[Mapping[str, str]] = {"cube0": "cube", "cube1": "cube", "cube2": "cube"}
    variations = tuple((color,) for color in COLORS)
    carry: ClassVar[tuple[float, float, float]] = (0.28, 0.0, 0.30)
    """Where the expert brings what it holds [m]: in front of the robot."""
    templates: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "train": (
            "pick up the {} cube and lift it",
            "lift the {} cube",
            "grasp the {} block and raise it",
            "take the {} cube and hold it up",
            "grab the {} block and lift it up",
            "raise the {} cube off the table",
        ),
        "held_out": (
            "hoist the {} block",
            "get hold of the {} cube and bring it up",
            "the {} cube should go up in the air",
        ),
    }

    def place(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """Cubes at least 10 cm apart, turned by any angle."""
        for name, (x, y) in zip(self.slots, scatter(rng, len(self.slots), APART), strict=True):
            simulation.place_free(name, (x, y, CUBE_HEIGHT), rng.uniform(-np.pi, np.pi))

    def grasp(self, simulation: "Simulation") -> Pose:
        """Pose that takes the target."""
        (target,) = self.targets
        return top_down(simulation.position(target), nearest_turn(simulation.yaw(target), self.symmetry()))

    def symmetry(self) -> float:
        """Least turn [rad] that leaves a block as it is."""
        return np.pi / 2

    def is_success(self, simulation: "Simulation") -> bool:
        """Grasped and lifted."""
        target = self.targets[0]
        return bool(simulation.position(target)[2] > SUCCESS_HEIGHT) and simulation.gripped(target)

    def expert(self, simulation: "Simulation") -> Iterator[Motion]:
        """Down over the cube, grasp, up and back towards the robot."""
        grasp = self.grasp(simulation)
        yield Motion(via=(grasp.raised(ABOVE),), target=grasp, gripper=0.0)
        yield Motion(
            via=(grasp.raised(ABOVE),), target=Pose(np.array(self.carry), grasp.quaternion), gripper=0.0, dwell=4
        )

    @classmethod
    def macro_steps(cls, variation: int) -> int:
        """Above, grasp, above, carry."""
        return 4
