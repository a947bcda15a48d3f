"""Open a drawer and put an item into it."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lerobot_histmv.envs.tasks.base import nearest_turn
from lerobot_histmv.envs.tasks.open_drawer import APPROACH, Drawers
from lerobot_histmv.motion import Motion, top_down

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

TOP = 0.263
"""Height [m] of the cabinet's top."""
ITEM_AREA = np.array([[0.05, 0.14], [-0.06, 0.06]])
"""Range of x and y [m] of the item on the cabinet, in the cabinet's frame."""
INSIDE = np.array([0.083, 0.098, 0.035])
"""Half extents [m] of a drawer's inside."""
DROP = np.array([0.058, 0.0, 0.04])
"""Where the expert lets the item go, from the middle of the drawer's front [m]."""
ABOVE = 0.12
"""Height [m] of the via points over item and drawer."""


class PutItemInDrawer(Drawers):
    """After RLBench's ``put_item_in_drawer``.

    | | |
    |---|---|
    | objects | a cabinet with three drawers, a block on its top |
    | scene | as in open_drawer; the item anywhere on the middle of the top, any yaw |
    | variations | bottom, middle, top |
    | success | the item is inside the named drawer and not held (RLBench: held or not; an item in the |
    | | gripper is not put away) |
    | failure | wrong object: another handle was grasped |
    | macro steps | 9: before the handle, grasp, pull; away, above the item, grasp; up, over the drawer, down |
    | difficulty | long; nothing but the history tells the way to the item from the way to the handle |
    """

    name = "put_item_in_drawer"
    objects: ClassVar[Mapping[str, str]] = {"cabinet": "cabinet", "item": "item"}
    templates: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "train": (
            "put the item in the {} drawer",
            "place the block in the {} drawer",
            "open the {} drawer and put the item inside",
            "store the block in the {} drawer",
            "move the item from the cabinet's top into the {} drawer",
            "leave the block in the {} drawer",
        ),
        "held_out": (
            "the item belongs into the {} drawer",
            "stow the block away in the {} drawer",
            "let the item disappear in the {} drawer",
        ),
    }

    def place(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """The cabinet, and the item on it."""
        super().place(simulation, rng)
        simulation.refresh()
        offset = simulation.rotation("cabinet") @ np.array([*rng.uniform(*ITEM_AREA.T), TOP + 0.0205])
        simulation.place_free("item", simulation.position("cabinet") + offset, rng.uniform(-np.pi, np.pi))

    @property
    def wanted(self) -> list[str]:
        """The item and the named handle."""
        return ["item", *super().wanted]

    def is_success(self, simulation: "Simulation") -> bool:
        """In the drawer, let go."""
        drawer = f"cabinet/drawer{self.number}"
        offset = simulation.rotation(drawer).T @ (simulation.position("item") - simulation.position(drawer))
        within = np.abs(offset - np.array([0.09, 0, 0])) < INSIDE
        return bool(within.all()) and not simulation.gripped("item")

    def expert(self, simulation: "Simulation") -> Iterator[Motion]:
        """Open the drawer, fetch the item, let it go over the drawer."""
        yield from self.pull_open(simulation, gripper=1.0)
        away = simulation.tool_pose().retracted(APPROACH)
        grasp = top_down(simulation.position("item"), nearest_turn(simulation.yaw("item"), np.pi / 2))
        yield Motion(via=(away, grasp.raised(ABOVE)), target=grasp, gripper=0.0)
        drawer = f"cabinet/drawer{self.number}"
        place = simulation.position(drawer) + simulation.rotation(drawer) @ DROP
        drop = top_down(place, simulation.yaw("cabinet"))
        over = drop.moved((0, 0, TOP + ABOVE - drop.position[2]))
        yield Motion(via=(grasp.raised(ABOVE), over), target=drop, gripper=1.0, dwell=6)

    @classmethod
    def macro_steps(cls, variation: int) -> int:
        """Before the handle, grasp, pull, away, above the item, grasp, up, over the drawer, down."""
        return 9
