"""Plug a USB stick into a computer."""

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lerobot_histmv.envs.tasks.base import Region, Task
from lerobot_histmv.motion import Motion

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

YAWS = (-np.pi / 8, np.pi / 8)
LYING = 0.0216
"""Height [m] of the stick's axis on its pedestal; the port is as high."""
INSERTED = 0.007
"""The stick is in when the plug's tip is this far behind the port's mouth [m] ..."""
OFF_AXIS = 0.006
"""... and this close to its axis [m]."""
DEPTH = 0.012
"""How far the expert pushes the tip in [m]."""
BEFORE = 0.06
"""Distance [m] of the tip from the mouth where the expert aligns the stick."""
ABOVE = 0.12


class InsertUsbInComputer(Task):
    """After RLBench's ``insert_usb_in_computer``.

    | | |
    |---|---|
    | objects | a computer with one port in its front, a stick on a pedestal |
    | scene | front at x 0.46 to 0.54, y -0.12 to 0.12 m; stick at x 0.29 to 0.36, y -0.22 to 0.22 m; |
    | | each turned by up to 22 degrees |
    | variations | one |
    | success | the plug's tip is at least 7 mm inside the port |
    | failure | grasp missed: the gripper closed beside the stick |
    | macro steps | 6: above, grasp, up, above the port, before it, in |
    | difficulty | 1.5 mm of play behind a bevelled mouth |
    """

    name = "insert_usb_in_computer"
    objects: ClassVar[Mapping[str, str]] = {"computer": "computer", "pedestal": "pedestal", "stick": "usb_stick"}
    wanted = ("stick",)
    regions: Mapping[str, Region] = MappingProxyType(
        {"computer": Region((0.46, 0.54), (-0.12, 0.12), YAWS), "stick": Region((0.29, 0.36), (-0.22, 0.22), YAWS)}
    )
    variations = ((),)
    templates: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "train": (
            "insert the usb stick in the computer",
            "plug the usb stick into the computer",
            "put the usb drive into the port",
            "pick up the usb stick and plug it in",
            "connect the usb stick to the computer",
            "push the usb stick into the slot",
        ),
        "held_out": ("the computer needs the usb stick", "attach the memory stick", "the stick goes into the port"),
    }

    def place(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """The computer at the back, the stick in front of it, its plug away from the robot."""
        self.stand(simulation, "computer", rng)
        x, y, yaw = self.regions["stick"].draw(rng)
        simulation.place_fixed("pedestal", (x, y, 0), yaw)
        simulation.place_free("stick", (x, y, LYING), yaw)

    def is_success(self, simulation: "Simulation") -> bool:
        """The tip in the port."""
        offset = simulation.site("stick/tip").position - simulation.site("computer/port").position
        depth, *aside = simulation.rotation("computer").T @ offset
        return bool(depth > INSERTED and np.linalg.norm(aside) < OFF_AXIS)

    def expert(self, simulation: "Simulation") -> Iterator[Motion]:
        """By its body, in front of the port, straight in."""
        grasp = simulation.site("stick")
        yield Motion(via=(grasp.raised(ABOVE),), target=grasp, gripper=0.0)
        tip = simulation.site("stick/tip").position
        turn = simulation.yaw("computer") - simulation.yaw("stick")
        turned = simulation.tool_pose().turned((0, 0, 1), turn, pivot=tip)
        inwards = simulation.rotation("computer")[:, 0]
        mouth = turned.moved(simulation.site("computer/port").position - tip)
        before = mouth.moved(-BEFORE * inwards)
        yield Motion(via=(grasp.raised(ABOVE), before.raised(ABOVE)), target=before, gripper=0.0, dwell=4)
        yield Motion(via=(), target=mouth.moved(DEPTH * inwards), gripper=0.0, speed=0.1, dwell=4)

    @classmethod
    def macro_steps(cls, variation: int) -> int:
        """Above, grasp, up, above the port, before it, in."""
        return 6
