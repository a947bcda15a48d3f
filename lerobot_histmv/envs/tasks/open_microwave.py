"""Open a microwave's door."""

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lerobot_histmv.envs.tasks.base import Region, Task
from lerobot_histmv.motion import Motion

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

OPEN = np.radians(80)
"""The door is open once it has turned this far [rad], as in RLBench."""
TURN = np.radians(90)
"""How far the expert turns it [rad]."""
ARC = 6
"""Key poses along the arc."""
ABOVE = 0.12


class OpenMicrowave(Task):
    """After RLBench's ``open_microwave``.

    | | |
    |---|---|
    | objects | a microwave; its door, hinged at the left, has an upright bar as handle |
    | scene | front at x 0.50 to 0.55, y -0.12 to 0.12 m, turned by up to 22 degrees |
    | variations | one |
    | success | the door has turned by more than 80 degrees |
    | failure | grasp missed: the gripper closed beside the bar |
    | macro steps | 8: above the bar, grasp its upper end, six along the arc |
    | difficulty | an arc of 90 degrees that leads through position and yaw together |
    """

    name = "open_microwave"
    objects: ClassVar[Mapping[str, str]] = {"microwave": "microwave"}
    wanted = ("microwave/handle",)
    regions: Mapping[str, Region] = MappingProxyType(
        {"microwave": Region((0.5, 0.55), (-0.12, 0.12), (-np.pi / 8, np.pi / 8))}
    )
    variations = ((),)
    templates: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "train": (
            "open the microwave",
            "pull the microwave's door open",
            "open the door of the microwave",
            "grasp the bar and open the microwave",
            "swing the microwave door open",
            "open up the microwave oven",
        ),
        "held_out": ("the microwave should be open", "make the inside of the microwave accessible", "unclose the oven"),
    }

    def place(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """At the back, its front more or less towards the robot."""
        self.stand(simulation, "microwave", rng)

    def is_success(self, simulation: "Simulation") -> bool:
        """Far enough open."""
        return simulation.joint("microwave/door") > OPEN

    def expert(self, simulation: "Simulation") -> Iterator[Motion]:
        """Take the bar's upper end from above, follow the arc."""
        grasp = simulation.site("microwave/grasp")
        yield Motion(via=(grasp.raised(ABOVE),), target=grasp, gripper=0.0)
        hinge = simulation.position("microwave/door")
        *arc, end = (grasp.turned((0, 0, 1), -TURN * (i + 1) / ARC, pivot=hinge) for i in range(ARC))
        yield Motion(via=tuple(arc), target=end, gripper=0.0, speed=0.3)

    @classmethod
    def macro_steps(cls, variation: int) -> int:
        """Above, grasp, along the arc."""
        return 2 + ARC
