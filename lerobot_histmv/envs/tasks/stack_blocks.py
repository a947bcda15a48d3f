"""Stack two to four blocks of the named colour."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lerobot_histmv.envs.tasks.base import Task, nearest_turn, scatter
from lerobot_histmv.envs.tasks.colors import COLORS
from lerobot_histmv.motion import Motion, Pose, top_down

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

COUNTS = {"two": 2, "three": 3, "four": 4}
APART = 0.09
"""Least distance between all centres [m]: the open fingers fit between two blocks."""
SIDE = 0.04
"""Edge of a block [m]."""
OFF_AXIS = 0.02
"""Blocks of a stack are within this distance of the square's centre [m] ..."""
LEVEL_TOLERANCE = 0.005
"""... and within this of their level's height [m]."""
ABOVE = 0.12
"""Height [m] of the via points over a block."""
CLEARANCE = 0.001
"""Height [m] above its seat at which the expert lets a block go."""


class StackBlocks(Task):
    """After RLBench's ``stack_blocks``.

    | | |
    |---|---|
    | objects | a white square; four blocks of the named colour, two of another (RLBench: four of another) |
    | scene | x 0.3 to 0.6, y -0.28 to 0.28 m, at least 9 cm apart, any yaw |
    | variations | two, three or four blocks of six colours |
    | success | that many named blocks stand on each other over the square, and nothing is held (RLBench: they |
    | | are in a region over the square; there, blocks that lean on each other count) |
    | failure | wrong object: a block of the other colour was held |
    | macro steps | 11, 17, 23: above, grasp, above, over, place; away and the same again |
    | difficulty | 2 cm off the square's centre is a failure; the history tells how many blocks are left |
    """

    name = "stack_blocks"
    objects: ClassVar[Mapping[str, str]] = {"plane": "stack_plane"} | {f"block{i}": "cube" for i in range(6)}
    variations = tuple((count, color) for count in COUNTS for color in COLORS)
    templates: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "train": (
            "stack {} {} blocks",
            "build a tower of {} {} blocks",
            "put {} {} cubes on top of each other",
            "pile up {} {} cubes",
            "place {} {} blocks one upon the other",
            "make a stack of {} {} cubes on the square",
        ),
        "held_out": (
            "erect a tower from {} {} cubes",
            "there should be {} {} blocks upon each other",
            "heap {} {} blocks up",
        ),
    }

    def place(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """Everything anywhere, at least 9 cm apart."""
        names = [f"block{i}" for i in rng.permutation(6)]
        self._blocks, self._named, self._others = names, names[:4], names[4:]
        plane, *places = scatter(rng, 7, APART)
        simulation.place_fixed("plane", (*plane, 0))
        for name, (x, y) in zip(names, places, strict=True):
            simulation.place_free(name, (x, y, SIDE / 2), rng.uniform(-np.pi, np.pi))
        others = [color for color in COLORS if color != self.goal[1]]
        other = others[rng.integers(len(others))]
        for name in names:
            simulation.paint(name, COLORS[self.goal[1] if name in self._named else other])

    @property
    def wanted(self) -> list[str]:
        """Blocks of the named colour."""
        return self._named

    @property
    def unwanted(self) -> list[str]:
        """Blocks of the other colour."""
        return self._others

    def is_success(self, simulation: "Simulation") -> bool:
        """A named block at each of the lowest levels, and nothing held."""
        levels = self._levels(simulation)
        return set(range(COUNTS[self.goal[0]])) <= levels and not any(map(simulation.gripped, self._blocks))

    def _levels(self, simulation: "Simulation") -> set[int]:
        """Levels of the tower over the square that named blocks fill."""
        offsets = [simulation.position(name) - simulation.position("plane") for name in self._named]
        tower = [z / SIDE - 0.5 for x, y, z in offsets if np.hypot(x, y) < OFF_AXIS]
        return {round(level) for level in tower if abs(level - round(level)) * SIDE < LEVEL_TOLERANCE}

    def expert(self, simulation: "Simulation") -> Iterator[Motion]:
        """The blocks nearest to the square, one after the other."""
        away: tuple[Pose, ...] = ()
        square = simulation.position("plane")
        nearest = sorted(self._named, key=lambda name: float(np.linalg.norm(simulation.position(name) - square)))
        for level, name in enumerate(nearest[: COUNTS[self.goal[0]]]):
            grasp = top_down(simulation.position(name), nearest_turn(simulation.yaw(name), np.pi / 2))
            yield Motion(via=(*away, grasp.raised(ABOVE)), target=grasp, gripper=0.0)
            seat = top_down(square + np.array([0, 0, SIDE * (level + 0.5) + CLEARANCE]))
            yield Motion(via=(grasp.raised(ABOVE), seat.raised(ABOVE)), target=seat, gripper=1.0)
            away = (seat.raised(ABOVE),)

    @classmethod
    def macro_steps(cls, variation: int) -> int:
        """Six for each block; the first needs no way back."""
        return 6 * COUNTS[cls.variations[variation][0]] - 1
