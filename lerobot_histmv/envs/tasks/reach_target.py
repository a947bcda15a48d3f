"""Bring the tool to the sphere that the instruction names."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lerobot_histmv.envs.tasks.base import scatter
from lerobot_histmv.envs.tasks.colors import COLORS, ColorTask
from lerobot_histmv.motion import Motion, top_down

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

APART = 0.12
"""Least horizontal distance between the spheres' centres [m]."""
HEIGHTS = (0.05, 0.20)
"""Range of the spheres' heights [m]."""
REACHED = 0.02
"""The target is reached when the tool is this close to its centre [m]; also the spheres' radius."""
ABOVE = 0.10
"""Height [m] of the via point over the target."""


class ReachTarget(ColorTask):
    """After RLBench's ``reach_target``.

    | | |
    |---|---|
    | objects | three balls of 2 cm radius that hang in the air and can be passed through |
    | scene | x 0.3 to 0.6, y -0.28 to 0.28, z 0.05 to 0.20 m, at least 12 cm apart on the ground plan |
    | variations | six colours |
    | success | the tool is within 2 cm of the named ball's centre when a step ends (RLBench: also in passing; |
    | | a key pose is where the tool stops) |
    | failure | wrong object: the tool came to another ball |
    | macro steps | 2: over the target, down to it |
    | difficulty | 2 cm is the tolerance of the whole position: of depth, too |
    """

    name = "reach_target"
    objects: ClassVar[Mapping[str, str]] = {"sphere0": "sphere", "sphere1": "sphere", "sphere2": "sphere"}
    variations = tuple((color,) for color in COLORS)
    templates: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "train": (
            "reach the {} target",
            "touch the {} ball",
            "move to the {} sphere",
            "bring the gripper to the {} ball",
            "go to the {} target",
            "put the fingertips at the {} sphere",
        ),
        "held_out": ("head for the {} ball", "the {} sphere is where the gripper should be", "approach the {} target"),
    }

    def place(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """Spheres at least 12 cm apart on the ground plan, 5 to 20 cm above the table."""
        for name, (x, y) in zip(self.slots, scatter(rng, len(self.slots), APART), strict=True):
            simulation.place_fixed(name, (x, y, rng.uniform(*HEIGHTS)))
        self._touched_other = False

    def watch(self, simulation: "Simulation", gripper: float) -> None:
        """Remember whether the tool came to another sphere."""
        self._touched_other |= any(self._distance(simulation, name) < REACHED for name in self.distractors)

    def _distance(self, simulation: "Simulation", name: str) -> float:
        return float(np.linalg.norm(simulation.tool_pose().position - simulation.position(name)))

    def is_success(self, simulation: "Simulation") -> bool:
        """Tool at the target."""
        return self._distance(simulation, self.targets[0]) < REACHED

    def failure(self) -> str:
        """The tool went to another sphere, or to none."""
        return "wrong object" if self._touched_other else "not reached"

    def expert(self, simulation: "Simulation") -> Iterator[Motion]:
        """Over the target without stopping, then down to it."""
        target = top_down(simulation.position(self.targets[0]))
        yield Motion(via=(target.raised(ABOVE),), target=target, gripper=1.0, dwell=4)

    @classmethod
    def macro_steps(cls, variation: int) -> int:
        """Above and down."""
        return 2
