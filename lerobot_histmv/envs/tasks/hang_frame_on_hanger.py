"""Hang a picture frame on a hook."""

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lerobot_histmv.envs.tasks.base import Region, Task
from lerobot_histmv.motion import Motion

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

YAWS = (-np.pi / 8, np.pi / 8)
STANDING = 0.0641
"""Height [m] of the standing frame's centre."""
HANGING = -0.044
"""Height [m] of a hanging frame's centre over the hook's seat."""
TOLERANCE = (0.025, 0.03, 0.012)
"""A frame hangs when its centre is this close to the place below the seat, in the board's frame [m]."""
CLEAR = 0.03
"""Height [m] at which the frame passes over the hook's tip."""
BEFORE = 0.08
"""Distance [m] in front of the hook at which the frame waits."""
ABOVE = 0.12


class HangFrameOnHanger(Task):
    """After RLBench's ``hang_frame_on_hanger``.

    | | |
    |---|---|
    | objects | a frame in a stand, a board with a hook |
    | scene | board at x 0.48 to 0.56, y -0.1 to 0.1 m; stand at x 0.30 to 0.36, y -0.2 to 0.2 m; |
    | | each turned by up to 22 degrees |
    | variations | one |
    | success | the frame hangs on the hook and is not held (RLBench: held or not; a frame that is carried |
    | | does not hang) |
    | failure | grasp missed: the gripper closed beside the frame's tab |
    | macro steps | 6: above, grasp, up, before the hook, over it, down |
    | difficulty | the rail goes over the hook's raised tip, then down by its length |
    """

    name = "hang_frame_on_hanger"
    objects: ClassVar[Mapping[str, str]] = {"hook": "wall_hook", "stand": "frame_stand", "frame": "frame"}
    wanted = ("frame",)
    regions: Mapping[str, Region] = MappingProxyType(
        {"hook": Region((0.48, 0.56), (-0.1, 0.1), YAWS), "stand": Region((0.3, 0.36), (-0.2, 0.2), YAWS)}
    )
    variations = ((),)
    templates: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "train": (
            "hang the frame on the hanger",
            "hang the picture frame on the hook",
            "put the frame onto the hook",
            "take the frame out of its stand and hang it up",
            "hang up the frame",
            "place the picture on the hanger",
        ),
        "held_out": ("the picture should hang on the board", "mount the frame on the hook", "hook the frame on"),
    }

    def place(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """The board at the back, the frame in its stand in front."""
        self.stand(simulation, "hook", rng)
        x, y, yaw = self.stand(simulation, "stand", rng)
        simulation.place_free("frame", (x, y, STANDING), yaw)

    def is_success(self, simulation: "Simulation") -> bool:
        """At the hook, let go."""
        place = simulation.site("hook/seat").position + np.array([0, 0, HANGING])
        offset = simulation.rotation("hook").T @ (simulation.position("frame") - place)
        return bool((np.abs(offset) < TOLERANCE).all()) and not simulation.gripped("frame")

    def expert(self, simulation: "Simulation") -> Iterator[Motion]:
        """By the tab, around the stand's walls, over the hook's tip, down."""
        grasp = simulation.site("frame")
        yield Motion(via=(grasp.raised(ABOVE),), target=grasp, gripper=0.0)
        frame = simulation.position("frame")
        turned = simulation.tool_pose().turned((0, 0, 1), simulation.yaw("hook") - simulation.yaw("frame"), pivot=frame)
        hung = turned.moved(simulation.site("hook/seat").position + np.array([0, 0, HANGING]) - frame)
        over = hung.raised(CLEAR)
        before = over.moved(-BEFORE * simulation.rotation("hook")[:, 0])
        yield Motion(via=(grasp.raised(ABOVE), before, over), target=hung, gripper=1.0, dwell=4)

    @classmethod
    def macro_steps(cls, variation: int) -> int:
        """Above, grasp, up, before, over, down."""
        return 6
