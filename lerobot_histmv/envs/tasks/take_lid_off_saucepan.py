"""Lift the lid off a saucepan."""

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lerobot_histmv.envs.tasks.base import RETREAT, Region, Task, nearest_turn
from lerobot_histmv.motion import Motion

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

SUCCESS_HEIGHT = 0.15
"""The region of success begins this far above the pan's rim [m]."""
LIFT = 0.22
"""How far the expert lifts [m]."""
ABOVE = 0.12
LID_ON_TABLE = 0.011
"""Height [m] of the lid's origin when it lies on the table."""


class TakeLidOffSaucepan(Task):
    """After RLBench's ``take_lid_off_saucepan``.

    | | |
    |---|---|
    | objects | a saucepan with its lid on |
    | scene | x 0.36 to 0.52, y -0.2 to 0.2 m, any yaw |
    | variations | one |
    | success | the lid is held and at least 15 cm above the pan's rim |
    | failure | grasp missed: the gripper closed beside the knob |
    | macro steps | 3: above, grasp, up |
    | difficulty | none beyond finding the knob |
    """

    name = "take_lid_off_saucepan"
    objects: ClassVar[Mapping[str, str]] = {"saucepan": "saucepan", "lid": "lid"}
    wanted = ("lid",)
    regions: Mapping[str, Region] = MappingProxyType(
        {"saucepan": Region((0.36, 0.52), (-0.2, 0.2), (-np.pi, np.pi)), "rest": Region((0.3, 0.3), (0.0, 0.0))}
    )
    """``rest`` is where ``clear`` puts the lid down."""
    clear_steps = 3
    variations = ((),)
    templates: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "train": (
            "take the lid off the saucepan",
            "remove the lid from the pan",
            "lift the lid off the pot",
            "grasp the knob and raise the lid",
            "uncover the saucepan",
            "pick up the saucepan's lid",
        ),
        "held_out": ("open the pot", "the pan should be without its lid", "get the cover off the saucepan"),
    }

    def place(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """Anywhere in the area; the handle points anywhere, and so does the lid's knob."""
        x, y, _ = self.stand(simulation, "saucepan", rng)
        self._rest = self.regions["rest"].draw(rng)
        simulation.place_free("lid", (x, y, 0.068), rng.uniform(-np.pi, np.pi))

    def is_success(self, simulation: "Simulation") -> bool:
        """Held high above the pan."""
        height = simulation.position("lid")[2] - simulation.site("saucepan/seat").position[2]
        return bool(height > SUCCESS_HEIGHT) and simulation.gripped("lid")

    def expert(self, simulation: "Simulation") -> Iterator[Motion]:
        """Grasp the knob across, straight up."""
        knob = simulation.site("lid")
        yaw = simulation.yaw("lid")
        grasp = knob.turned((0, 0, 1), nearest_turn(yaw, np.pi) - yaw)
        yield Motion(via=(grasp.raised(ABOVE),), target=grasp, gripper=0.0)
        yield Motion(via=(), target=grasp.raised(LIFT), gripper=0.0, dwell=4)

    def clear(self, simulation: "Simulation") -> Iterator[Motion]:
        """Put the lid down on the table."""
        x, y, _ = self._rest
        tool = simulation.tool_pose()
        held = simulation.position("lid")
        down = tool.moved((x - held[0], y - held[1], LID_ON_TABLE - held[2]))
        over = tool.moved((x - held[0], y - held[1], 0))
        yield Motion(via=(over,), target=down, gripper=1.0)
        yield Motion(via=(), target=down.retracted(RETREAT), gripper=1.0)

    @classmethod
    def macro_steps(cls, variation: int) -> int:
        """Above, grasp, up."""
        return 3
