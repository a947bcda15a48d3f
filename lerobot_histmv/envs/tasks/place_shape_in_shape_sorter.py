"""Put the named shape through its hole."""

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lerobot_histmv.envs.tasks.base import Region, Task, nearest_turn, scatter
from lerobot_histmv.motion import Motion

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

SYMMETRY = {
    "cube": np.pi / 2,
    "cylinder": 2 * np.pi,
    "triangle": 2 * np.pi / 3,
    "hexagon": np.pi / 3,
    "cross": np.pi / 2,
}
"""Shape -> the least turn [rad] that leaves it as it is; a cylinder need not be turned at all."""
APART = 0.07
"""Least distance between the shapes' centres [m]."""
INSIDE = np.array([0.03, 0.15, 0.027])
"""Half extents [m] of the sorter's inside."""
IN_HOLE = 0.005
"""Height [m] of a shape's centre over the lid's when the expert lets it go: its foot is in the hole."""
MOUTH = 0.02
"""Height [m] over that of the last key pose before."""
ABOVE = 0.12


class PlaceShapeInShapeSorter(Task):
    """After RLBench's ``place_shape_in_shape_sorter``.

    | | |
    |---|---|
    | objects | a box with five holes in its lid, five shapes |
    | scene | box at x 0.47 to 0.55, y -0.06 to 0.06 m, turned by up to 20 degrees; shapes at x 0.28 to 0.39, any yaw |
    | variations | cube, cylinder, triangle, hexagon, cross (RLBench: star and moon for the last two, whose |
    | | outlines straight boards do not leave open) |
    | success | the named shape is inside the box |
    | failure | wrong object: another shape was held |
    | macro steps | 6: above, grasp, up, over the hole, at its mouth, into it |
    | difficulty | 3 mm of play on each side, and the shape must be turned to fit |
    """

    name = "place_shape_in_shape_sorter"
    objects: ClassVar[Mapping[str, str]] = {"sorter": "shape_sorter"} | {shape: f"shape_{shape}" for shape in SYMMETRY}
    regions: Mapping[str, Region] = MappingProxyType(
        {
            "sorter": Region((0.47, 0.55), (-0.06, 0.06), (-np.pi / 9, np.pi / 9)),
            "shapes": Region((0.28, 0.39), (-0.28, 0.28)),
        }
    )
    variations = tuple((shape,) for shape in SYMMETRY)
    templates: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "train": (
            "put the {} in the shape sorter",
            "place the {} into its hole",
            "pick up the {} and put it in the sorter",
            "drop the {} through the matching hole",
            "insert the {} into the shape sorter",
            "sort the {} into the box",
        ),
        "held_out": ("the {} belongs in the box", "find the hole for the {}", "let the {} fall into the sorter"),
    }

    def place(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """The box at the back, the shapes in front of it."""
        self.stand(simulation, "sorter", rng)
        places = scatter(rng, len(SYMMETRY), APART, self.regions["shapes"].area)
        for shape, (x, y) in zip(SYMMETRY, places, strict=True):
            simulation.place_free(shape, (x, y, 0.0121), rng.uniform(-np.pi, np.pi))

    @property
    def wanted(self) -> list[str]:
        """The named shape."""
        return list(self.goal)

    @property
    def unwanted(self) -> list[str]:
        """The others."""
        return [shape for shape in SYMMETRY if shape not in self.goal]

    def is_success(self, simulation: "Simulation") -> bool:
        """In the box."""
        offset = simulation.rotation("sorter").T @ (simulation.position(self.goal[0]) - simulation.position("sorter"))
        return bool((np.abs(offset - np.array([0, 0, 0.033])) < INSIDE).all())

    def expert(self, simulation: "Simulation") -> Iterator[Motion]:
        """By its pin, turned to fit, down into the hole."""
        (shape,) = self.goal
        pin, yaw = simulation.site(shape), simulation.yaw(shape)
        grasp = pin.turned((0, 0, 1), nearest_turn(yaw, np.pi / 2) - yaw)
        yield Motion(via=(grasp.raised(ABOVE),), target=grasp, gripper=0.0)
        held = simulation.position(shape)
        turn = 0.0 if shape == "cylinder" else simulation.yaw("sorter") - simulation.yaw(shape)
        turned = simulation.tool_pose().turned((0, 0, 1), nearest_turn(turn, SYMMETRY[shape]), pivot=held)
        drop = turned.moved(simulation.position(f"sorter/{shape}") + np.array([0, 0, IN_HOLE]) - held)
        over = (drop.raised(ABOVE), drop.raised(MOUTH))
        yield Motion(via=(grasp.raised(ABOVE), *over), target=drop, gripper=1.0, dwell=6)

    @classmethod
    def macro_steps(cls, variation: int) -> int:
        """Above, grasp, up, over the hole, at its mouth, into it."""
        return 6
