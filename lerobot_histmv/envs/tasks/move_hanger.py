"""Move a clothes hanger from one rack to another."""

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lerobot_histmv.envs.tasks.base import Region, Task
from lerobot_histmv.motion import Motion

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

RACKS = ("left_rack", "right_rack")
YAWS = (-np.pi / 9, np.pi / 9)
HANGS = 0.0005
"""Height [m] of a hanging hanger's origin over the rod's axis ..."""
TOLERANCE = (0.025, 0.05, 0.012)
"""... and how close [m] to the seat, in the rack's frame, counts as on the rack."""
LIFT = 0.027
"""Height [m] at which the rod passes through the hook's opening."""
OUT = 0.07
"""How far [m] the hanger then moves away from the robot to be free of the rod."""
UP = 0.13
"""Height [m] over that at which it crosses to the other rack."""
ABOVE = 0.1


class MoveHanger(Task):
    """After RLBench's ``move_hanger``.

    | | |
    |---|---|
    | objects | two racks, a clothes hanger on one of them |
    | scene | racks at x 0.35 to 0.49, y 0.13 to 0.21 and -0.17 to -0.09 m, turned by up to 20 degrees |
    | variations | one |
    | success | the hanger is on the other rack and not held |
    | failure | grasp missed: the gripper closed beside the hanger's tab |
    | macro steps | 9: above, grasp, lift, out, up, across, beside the other rod, over it, down |
    | difficulty | the hook opens towards the robot only; the place to go is where the hanger was not |
    """

    name = "move_hanger"
    objects: ClassVar[Mapping[str, str]] = dict.fromkeys(RACKS, "rack") | {"hanger": "coat_hanger"}
    wanted = ("hanger",)
    regions: Mapping[str, Region] = MappingProxyType(
        {
            "left_rack": Region((0.35, 0.49), (0.13, 0.21), YAWS),
            "right_rack": Region((0.35, 0.49), (-0.17, -0.09), YAWS),
        }
    )
    variations = ((),)
    templates: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "train": (
            "move the hanger to the other rack",
            "move the hanger onto the other rod",
            "take the clothes hanger and hang it on the other rack",
            "hang the hanger on the empty rack",
            "bring the clothes hanger to the free rod",
            "put the hanger on the other side",
        ),
        "held_out": (
            "the hanger belongs on the empty rod",
            "transfer the hanger between the racks",
            "the other rack should hold the hanger",
        ),
    }

    def place(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """Racks left and right, the hanger on either."""
        for rack in RACKS:
            self.stand(simulation, rack, rng)
        self._start, self._goal = (RACKS[i] for i in rng.permutation(2))
        simulation.refresh()
        seat = simulation.site(f"{self._start}/seat").position
        simulation.place_free("hanger", seat + np.array([0, 0, HANGS]), simulation.yaw(self._start))

    def is_success(self, simulation: "Simulation") -> bool:
        """On the other rod, let go."""
        seat = simulation.site(f"{self._goal}/seat").position
        offset = simulation.rotation(self._goal).T @ (simulation.position("hanger") - seat)
        return bool((np.abs(offset) < TOLERANCE).all()) and not simulation.gripped("hanger")

    def expert(self, simulation: "Simulation") -> Iterator[Motion]:
        """Free the hook by lifting and moving it away from the robot; at the other rack the same way back."""
        grasp = simulation.site("hanger")
        yield Motion(via=(grasp.raised(ABOVE),), target=grasp, gripper=0.0)
        held, hanger = simulation.tool_pose(), simulation.position("hanger")
        lifted = held.raised(LIFT)
        out = lifted.moved(OUT * simulation.rotation(self._start)[:, 0])
        yield Motion(via=(lifted, out), target=out.raised(UP), gripper=0.0)
        turn = simulation.yaw(self._goal) - simulation.yaw(self._start)
        seat = simulation.site(f"{self._goal}/seat").position + np.array([0, 0, HANGS])
        hung = held.turned((0, 0, 1), turn, pivot=hanger).moved(seat - hanger)
        over = hung.raised(LIFT)
        beside = over.moved(OUT * simulation.rotation(self._goal)[:, 0])
        yield Motion(via=(beside.raised(UP), beside, over), target=hung, gripper=1.0, dwell=4)

    @classmethod
    def macro_steps(cls, variation: int) -> int:
        """Above, grasp, lift, out, up, across, beside the other rod, over it, down."""
        return 9
