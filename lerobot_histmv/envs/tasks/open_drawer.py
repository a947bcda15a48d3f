"""Open one of a cabinet's three drawers."""

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lerobot_histmv.envs.tasks.base import Region, Task
from lerobot_histmv.motion import Motion

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

DRAWERS = ("bottom", "middle", "top")
"""Named from below."""
OPEN = 0.15
"""A drawer is open once it has come out this far [m], as in RLBench."""
PULL = 0.16
"""How far the expert pulls [m]."""
APPROACH = 0.10
"""Distance [m] of the via point in front of a handle."""
FACING = -np.pi / 2
"""Yaw [rad] of the cabinet in the middle of its range: drawers come out to the left (+y), where a camera sees them and
the arm does not have to fold up."""


class Drawers(Task):
    """What tasks with the cabinet share."""

    variations = tuple((drawer,) for drawer in DRAWERS)
    regions: Mapping[str, Region] = MappingProxyType(
        {"cabinet": Region((0.4, 0.5), (-0.07, 0.03), (FACING - np.pi / 8, FACING + np.pi / 8))}
    )

    def place(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """The cabinet at the right, its front more or less towards the left."""
        self.stand(simulation, "cabinet", rng)
        self.number = DRAWERS.index(self.goal[0])

    @property
    def wanted(self) -> list[str]:
        """The named handle."""
        return [f"cabinet/handle{self.number}"]

    @property
    def unwanted(self) -> list[str]:
        """The other handles."""
        return [f"cabinet/handle{i}" for i in range(len(DRAWERS)) if i != self.number]

    def opened(self, simulation: "Simulation") -> float:
        """How far the named drawer is out [m]."""
        return simulation.joint(f"cabinet/drawer{self.number}")

    def pull_open(self, simulation: "Simulation", gripper: float) -> Iterator[Motion]:
        """Grasp the named handle from its front and above, and pull; ``gripper`` is the command afterwards."""
        grasp = simulation.site(f"cabinet/grasp{self.number}")
        yield Motion(via=(grasp.retracted(APPROACH),), target=grasp, gripper=0.0)
        outwards = -simulation.rotation("cabinet")[:, 0]
        yield Motion(via=(), target=simulation.tool_pose().moved(PULL * outwards), gripper=gripper, speed=0.3)


class OpenDrawer(Drawers):
    """After RLBench's ``open_drawer``.

    | | |
    |---|---|
    | objects | a cabinet with three drawers |
    | scene | front at x 0.40 to 0.50, y -0.07 to 0.03 m, facing left, turned by up to 22 degrees |
    | variations | bottom, middle, top |
    | success | the named drawer is more than 15 cm out |
    | failure | wrong object: another handle was grasped |
    | macro steps | 3: before the handle, grasp, pull |
    | difficulty | tilted grasp; which handle is which shows in the height only |
    """

    name = "open_drawer"
    objects: ClassVar[Mapping[str, str]] = {"cabinet": "cabinet"}
    templates: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "train": (
            "open the {} drawer",
            "pull the {} drawer out",
            "slide the {} drawer open",
            "grip the {} handle and pull the drawer open",
            "open the cabinet's {} drawer",
            "pull on the {} drawer's handle",
        ),
        "held_out": ("the {} drawer should be open", "draw the {} drawer towards you", "get the {} drawer open"),
    }

    def is_success(self, simulation: "Simulation") -> bool:
        """Far enough out."""
        return self.opened(simulation) > OPEN

    def expert(self, simulation: "Simulation") -> Iterator[Motion]:
        """Grasp and pull."""
        yield from self.pull_open(simulation, gripper=0.0)

    @classmethod
    def macro_steps(cls, variation: int) -> int:
        """Before the handle, grasp, pull."""
        return 3
