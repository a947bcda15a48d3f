"""Press a door's lever and push the door open."""

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lerobot_histmv.envs.tasks.base import RETREAT, Region, Task
from lerobot_histmv.motion import Motion, top_down

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

UNLOCKED = np.radians(25)
"""The latch opens, for good, once the lever has turned this far [rad] ..."""
OPEN = np.radians(25)
"""... and the door is open once it has turned this far [rad], as in RLBench."""
PRESS = 0.045
"""How far the expert presses the lever's end down [m]."""
TURN = np.radians(30)
"""How far the expert pushes the door [rad]."""
ABOVE = 0.09
"""Height [m] of the via point over the lever's end."""
BEFORE = 0.05
"""Distance [m] from the panel at which the push begins."""


class OpenDoor(Task):
    """After RLBench's ``open_door``.

    | | |
    |---|---|
    | objects | a door with a lever between two posts, without a lintel, so that the gripper passes |
    | scene | door at x 0.42 to 0.50, y -0.12 to 0.12 m, turned by up to 22 degrees |
    | variations | one |
    | success | the door has turned by more than 25 degrees; the latch holds it until the lever has turned by 25 |
    | failure | time: the lever was turned; not reached: it was not |
    | macro steps | 5: above the lever, press, up, before the panel, push |
    | difficulty | the order; the pressed lever looks little different |

    The gripper stays closed: it is the tool that presses and pushes.
    """

    name = "open_door"
    objects: ClassVar[Mapping[str, str]] = {"door": "door"}
    regions: Mapping[str, Region] = MappingProxyType(
        {"door": Region((0.42, 0.5), (-0.12, 0.12), (-np.pi / 8, np.pi / 8))}
    )
    clear_steps = 1
    variations = ((),)
    initial_gripper = 0.0
    templates: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "train": (
            "open the door",
            "press the lever and open the door",
            "turn the handle and push the door open",
            "unlatch the door and open it",
            "push the door open after turning its handle",
            "use the handle to open the door",
        ),
        "held_out": ("make way through the door", "the door should stand open", "get the door to open"),
    }

    def place(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """Upright, the lever more or less towards the robot; latched."""
        self.stand(simulation, "door", rng)
        self._unlocked = False

    def watch(self, simulation: "Simulation", gripper: float) -> None:
        """Open the latch when the lever has turned."""
        if not self._unlocked and simulation.joint("door/lever") > UNLOCKED:
            self._unlocked = True
            simulation.latch("door", closed=False)

    def is_success(self, simulation: "Simulation") -> bool:
        """Far enough open."""
        return simulation.joint("door/panel") > OPEN

    def failure(self) -> str:
        """Whether the lever was turned."""
        return "time" if self._unlocked else "not reached"

    def expert(self, simulation: "Simulation") -> Iterator[Motion]:
        """Press the lever's end down, go up and to the panel's free edge, push."""
        yaw = simulation.yaw("door")
        tip = top_down(simulation.site("door/tip").position, yaw)
        yield Motion(via=(tip.raised(ABOVE),), target=tip.raised(-PRESS), gripper=0.0)
        contact = top_down(simulation.site("door/push").position, yaw)
        before = contact.moved(-BEFORE * simulation.rotation("door")[:, 0])
        hinge = simulation.position("door/panel")
        pushed = contact.turned((0, 0, 1), TURN, pivot=hinge)
        yield Motion(via=(tip.raised(ABOVE), before), target=pushed, gripper=0.0, dwell=4)

    def clear(self, simulation: "Simulation") -> Iterator[Motion]:
        """Up, out of the doorway, and open the gripper."""
        yield Motion(via=(), target=simulation.tool_pose().retracted(RETREAT), gripper=1.0)

    @classmethod
    def macro_steps(cls, variation: int) -> int:
        """Above, press, up, before the panel, push."""
        return 5
