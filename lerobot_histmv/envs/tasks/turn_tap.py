"""Open one of the tap's two knobs."""

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lerobot_histmv.envs.tasks.base import Region, Task, nearest_turn
from lerobot_histmv.motion import Motion

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

OPEN = np.pi / 2
"""A knob is open once it has turned this far [rad], as in RLBench."""
TURN = 1.75
"""How far the expert turns it [rad]."""
ABOVE = 0.12
"""Height [m] of the via point over a knob."""
DIRECTIONS = {"left": 1, "right": -1}
"""Knob -> sense of turning about z in which it opens."""


class TurnTap(Task):
    """After RLBench's ``turn_tap``.

    | | |
    |---|---|
    | objects | a tap with two knobs; the left one, seen from the robot, is red, the right one blue |
    | scene | post at x 0.36 to 0.52, y -0.18 to 0.18 m, turned by up to 45 degrees |
    | variations | left, right |
    | success | the named knob has turned by more than 90 degrees |
    | failure | wrong object: the other knob was grasped |
    | macro steps | 4: above, grasp, half the turn, the rest |
    | difficulty | the turn is 100 degrees: the key pose after the grasp differs from it by rotation alone |
    """

    name = "turn_tap"
    objects: ClassVar[Mapping[str, str]] = {"tap": "tap"}
    regions: Mapping[str, Region] = MappingProxyType(
        {"tap": Region((0.36, 0.52), (-0.18, 0.18), (-np.pi / 4, np.pi / 4))}
    )
    variations = (("left",), ("right",))
    templates: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "train": (
            "turn the {} tap",
            "open the {} tap",
            "rotate the {} knob of the tap",
            "turn the {} knob",
            "twist the {} handle open",
            "turn the water on with the {} handle",
        ),
        "held_out": (
            "give the {} knob a turn",
            "let water flow from the {} tap",
            "the {} handle has to be opened",
        ),
    }

    def place(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """Anywhere in the area, with the spout more or less towards the robot."""
        self.stand(simulation, "tap", rng)

    @property
    def wanted(self) -> list[str]:
        """The named knob."""
        return [f"tap/{side}" for side in self.goal]

    @property
    def unwanted(self) -> list[str]:
        """The other one."""
        return [f"tap/{side}" for side in DIRECTIONS if side not in self.goal]

    def is_success(self, simulation: "Simulation") -> bool:
        """Turned far enough."""
        return simulation.joint(f"tap/{self.goal[0]}") > OPEN

    def expert(self, simulation: "Simulation") -> Iterator[Motion]:
        """Grasp the bar across and turn the wrist."""
        (side,) = self.goal
        bar = simulation.site(f"tap/{side}")
        yaw = nearest_turn(simulation.yaw("tap"), np.pi)
        grasp = bar.turned((0, 0, 1), yaw - simulation.yaw("tap"))
        yield Motion(via=(grasp.raised(ABOVE),), target=grasp, gripper=0.0)
        half, whole = (grasp.turned((0, 0, 1), DIRECTIONS[side] * TURN * share) for share in (0.5, 1))
        yield Motion(via=(half,), target=whole, gripper=0.0)

    @classmethod
    def macro_steps(cls, variation: int) -> int:
        """Above, grasp, half the turn, the whole turn."""
        return 4
