"""Put a square ring onto the peg of the named colour."""

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lerobot_histmv.envs.tasks.base import RETREAT, Region, Task
from lerobot_histmv.envs.tasks.colors import COLORS
from lerobot_histmv.motion import Motion

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

PEGS = ("left", "middle", "right")
OFF_AXIS = 0.006
"""The ring is on a peg when its centre is this close to the axis [m] ..."""
HEIGHT = 0.05
"""... and below this height over the board [m]: the peg's top is at 0.07."""
ABOVE_PEG = 0.10
"""Height [m] of the via point over a peg's foot; the ring then hangs above the top."""
RELEASE = 0.035
"""Height [m] over the board at which the expert lets the ring go."""
ABOVE = 0.14


class InsertOntoSquarePeg(Task):
    """After RLBench's ``insert_onto_square_peg``.

    | | |
    |---|---|
    | objects | a board with three coloured pegs; a square ring with a tab |
    | scene | middle peg at x 0.46 to 0.56, y -0.1 to 0.1 m, turned by up to 22 degrees; ring at x 0.28 to 0.36, |
    | | y -0.24 to 0.24 m, turned by up to 60 degrees |
    | variations | six colours, on the left, middle or right peg; the two others differ |
    | success | the ring is on the named peg, less than 5 cm up, and not held (RLBench: held or not; it should |
    | | stay there by itself) |
    | failure | time: the ring was held; grasp missed; not reached |
    | macro steps | 5: above, grasp, up, over the peg, down |
    | difficulty | 2.5 mm of play on each side |
    """

    name = "insert_onto_square_peg"
    objects: ClassVar[Mapping[str, str]] = {"pegs": "pegs", "ring": "square_ring"}
    wanted = ("ring",)
    regions: Mapping[str, Region] = MappingProxyType(
        {
            "pegs": Region((0.46, 0.56), (-0.1, 0.1), (-np.pi / 8, np.pi / 8)),
            "ring": Region((0.28, 0.36), (-0.24, 0.24), (-np.pi / 3, np.pi / 3)),
        }
    )
    clear_steps = 1
    variations = tuple((color,) for color in COLORS)
    templates: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "train": (
            "put the ring on the {} peg",
            "insert the square ring onto the {} spoke",
            "slide the ring over the {} peg",
            "place the square onto the {} pole",
            "move the ring to the {} peg and drop it there",
            "hang the square ring on the {} spoke",
        ),
        "held_out": (
            "the ring belongs on the {} pole",
            "thread the square onto the {} peg",
            "let the ring sit on the {} spoke",
        ),
    }

    def place(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """Board at the back, ring in front of it."""
        self.stand(simulation, "pegs", rng)
        x, y, yaw = self.regions["ring"].draw(rng)
        simulation.place_free("ring", (x, y, 0.0101), yaw)
        pegs = [PEGS[i] for i in rng.permutation(len(PEGS))]
        self._peg = pegs[0]
        others = [color for color in COLORS if color not in self.goal]
        drawn = rng.choice(len(others), 2, replace=False)
        for peg, color in zip(pegs, (*self.goal, *(others[i] for i in drawn)), strict=True):
            simulation.paint(f"pegs/{peg}", COLORS[color])

    def is_success(self, simulation: "Simulation") -> bool:
        """Around the named peg, low, released."""
        x, y, z = simulation.position("ring") - simulation.position(f"pegs/{self._peg}")
        return bool(np.hypot(x, y) < OFF_AXIS and z < HEIGHT) and not simulation.gripped("ring")

    def expert(self, simulation: "Simulation") -> Iterator[Motion]:
        """By the tab, over the peg, down; the ring is turned as the peg is."""
        grasp = simulation.site("ring")
        yield Motion(via=(grasp.raised(ABOVE),), target=grasp, gripper=0.0)
        held = simulation.site("ring")  # where the tab really is between the fingers
        tool = simulation.tool_pose()
        turn = simulation.yaw("pegs") - simulation.yaw("ring")
        foot = tool.turned((0, 0, 1), turn, pivot=simulation.position("ring"))
        foot = foot.moved(simulation.position(f"pegs/{self._peg}") - simulation.position("ring"))
        over = foot.raised(ABOVE_PEG)
        yield Motion(via=(held.raised(ABOVE),), target=over, gripper=0.0, dwell=4)
        yield Motion(via=(), target=foot.raised(RELEASE), gripper=1.0, dwell=4)

    def clear(self, simulation: "Simulation") -> Iterator[Motion]:
        """Away: the ring is let go already."""
        yield Motion(via=(), target=simulation.tool_pose().retracted(RETREAT), gripper=1.0)

    @classmethod
    def macro_steps(cls, variation: int) -> int:
        """Above, grasp, up, over the peg, down."""
        return 5
