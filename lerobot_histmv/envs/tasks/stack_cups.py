"""Put two cups into a third."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lerobot_histmv.envs.tasks.colors import COLORS, ColorTask
from lerobot_histmv.envs.tasks.pick_up_cup import rim_grasp, stand_cups
from lerobot_histmv.motion import Motion

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

APART = 0.14
"""Least distance between the cups' centres [m]."""
NESTED = 0.021
"""How much higher than the cup below a nested cup stands [m]."""
OFF_AXIS = 0.01
"""A cup is in another when their axes are this close [m] ..."""
HEIGHTS = (0.005, 0.06)
"""... and the lowest stacked one is this much higher [m]; each further one, again."""
DROP = 0.006
"""Height [m] above its seat at which the expert lets a cup go."""
ABOVE = 0.14


class StackCups(ColorTask):
    """After RLBench's ``stack_cups``.

    | | |
    |---|---|
    | objects | three cups that nest |
    | scene | x 0.3 to 0.6, y -0.28 to 0.28 m, at least 14 cm apart |
    | variations | six colours: the cup that stays |
    | success | the two others stand in the named cup, and none is held |
    | failure | wrong object: the named cup was held |
    | macro steps | 11: above, grasp, above, over, place; away and the same again |
    | difficulty | 7 mm of play when a cup enters the other |
    """

    name = "stack_cups"
    objects: ClassVar[Mapping[str, str]] = {"cup0": "cup", "cup1": "cup", "cup2": "cup"}
    variations = tuple((color,) for color in COLORS)
    templates: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "train": (
            "stack the other cups on top of the {} cup",
            "put the other cups into the {} one",
            "place two cups onto the {} cup",
            "stack the mugs in the {} mug",
            "pile the cups up with the {} one at the bottom",
            "nest the other two cups in the {} cup",
        ),
        "held_out": (
            "the {} cup should hold the others",
            "collect the cups in the {} one",
            "make a pile of cups on the {} mug",
        ),
    }

    def place(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """Cups standing anywhere, at least 14 cm apart."""
        stand_cups(simulation, self.slots, APART, rng)

    @property
    def wanted(self) -> list[str]:
        """The cups that move."""
        return self.distractors

    @property
    def unwanted(self) -> list[str]:
        """The cup that stays."""
        return self.targets

    def is_success(self, simulation: "Simulation") -> bool:
        """Both others stand over the named cup, one in the other, released."""
        pile = sorted((simulation.position(name) for name in self.slots), key=lambda place: place[2])
        base = simulation.position(self.targets[0])
        steps = np.diff([place[2] for place in pile])
        return (
            bool(pile[0][2] == base[2])
            and all(np.linalg.norm((place - base)[:2]) < OFF_AXIS for place in pile)
            and bool(((steps > HEIGHTS[0]) & (steps < HEIGHTS[1])).all())
            and not any(simulation.gripped(name) for name in self.slots)
        )

    def expert(self, simulation: "Simulation") -> Iterator[Motion]:
        """The nearer cup first; each over the pile, down into it, let go."""
        away: tuple = ()
        base = simulation.position(self.targets[0])
        nearest = sorted(self.distractors, key=lambda name: float(np.linalg.norm(simulation.position(name) - base)))
        for level, name in enumerate(nearest, start=1):
            grasp = rim_grasp(simulation, name)
            yield Motion(via=(*away, grasp.raised(ABOVE)), target=grasp, gripper=0.0)
            base = simulation.position(self.targets[0])
            seat = grasp.moved(base - simulation.position(name) + np.array([0, 0, level * NESTED + DROP]))
            yield Motion(via=(grasp.raised(ABOVE), seat.raised(ABOVE)), target=seat, gripper=1.0)
            away = (seat.raised(ABOVE),)

    @classmethod
    def macro_steps(cls, variation: int) -> int:
        """Five for the first cup, six for the second."""
        return 11
