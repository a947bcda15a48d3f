"""Water a plant with a watering can."""

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lerobot_histmv.envs.tasks.base import RETREAT, Region, Task
from lerobot_histmv.motion import Motion

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

DROPS = tuple(f"drop{i}" for i in range(5))
APART = 0.2
"""Least distance between plant and can [m]."""
CAN_YAW = np.pi / 6
"""The spout points to the plant, give or take this angle [rad]."""
POURS = np.cos(np.radians(45))
"""Water leaves the spout once the can's axis is tilted by 45 degrees."""
TILT = np.radians(62)
"""How far the expert tilts the can [rad]."""
POT_RADIUS, POT_HEIGHT = 0.05, 0.07
SPOUT_HEIGHT = 0.11
"""Height [m] of the spout over the table while the expert pours."""
ABOVE = 0.14
UNDER_THE_TABLE = -0.745
"""Height [m] of the drops on the floor before they are poured."""


class WaterPlants(Task):
    """After RLBench's ``water_plants``.

    | | |
    |---|---|
    | objects | a watering can, a plant in a pot, five drops that come into being at the spout |
    | scene | can at x 0.32 to 0.50, plant at x 0.38 to 0.52, y -0.24 to 0.24 m, at least 20 cm apart; |
    | | the spout points to the plant within 30 degrees |
    | variations | one |
    | success | five drops are in the pot; a can tilted by more than 45 degrees loses one every 50 ms |
    | | (RLBench: it loses all at once where its head comes to a point over the pot, tilted or not) |
    | failure | time: the can was held, but the pot is not watered |
    | macro steps | 6: above, grasp, up, spout over the pot, half the tilt, the whole tilt |
    | difficulty | a tilt of 62 degrees with the spout kept in place; five drops cannot be poured twice |
    """

    name = "water_plants"
    objects: ClassVar[Mapping[str, str]] = {"can": "watering_can", "plant": "plant"} | dict.fromkeys(DROPS, "drop")
    regions: Mapping[str, Region] = MappingProxyType(
        {"can": Region((0.32, 0.5), (-0.24, 0.24)), "plant": Region((0.38, 0.52), (-0.24, 0.24))}
    )
    clear_steps = 4
    wanted = ("can",)
    variations = ((),)
    templates: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "train": (
            "water the plant",
            "pour water on the plant",
            "use the watering can to water the plant",
            "pick up the watering can and water the plant",
            "give the plant some water",
            "empty the can into the flower pot",
        ),
        "held_out": ("the plant is thirsty", "the flower needs water", "sprinkle the plant in the pot"),
    }

    def place(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """Can and plant anywhere, the spout more or less towards the plant; no drop in sight."""
        while True:
            plant, can = (np.array(self.regions[name].draw(rng)[:2]) for name in ("plant", "can"))
            if np.linalg.norm(plant - can) > APART:
                break
        simulation.place_fixed("plant", (*plant, 0))
        towards = np.arctan2(*(plant - can)[::-1])
        simulation.place_free("can", (*can, 0.0005), towards + rng.uniform(-CAN_YAW, CAN_YAW))
        for i, drop in enumerate(DROPS):
            simulation.place_free(drop, (0.3 + 0.05 * i, 0, UNDER_THE_TABLE), 0)
        self._poured = 0

    def watch(self, simulation: "Simulation", gripper: float) -> None:
        """Remember whether the can was held; pour when it is tilted."""
        super().watch(simulation, gripper)
        if self._poured < len(DROPS) and simulation.rotation("can")[2, 2] < POURS:
            simulation.place_free(DROPS[self._poured], simulation.site("can/spout").position, 0)
            self._poured += 1

    def is_success(self, simulation: "Simulation") -> bool:
        """All drops in the pot."""
        offsets = [simulation.position(drop) - simulation.position("plant") for drop in DROPS]
        return all(np.hypot(x, y) < POT_RADIUS and 0 < z < POT_HEIGHT for x, y, z in offsets)

    def expert(self, simulation: "Simulation") -> Iterator[Motion]:
        """Take the can by its handle, bring the spout over the pot, tilt about the spout."""
        grasp = simulation.site("can/grasp")
        yield Motion(via=(grasp.raised(ABOVE),), target=grasp, gripper=0.0)
        tool, spout = simulation.tool_pose(), simulation.site("can/spout").position
        goal = simulation.position("plant") + np.array([0, 0, SPOUT_HEIGHT])
        upright = tool.moved(goal - spout)
        self._way_back = (upright, tool.raised(ABOVE), tool)
        across = simulation.rotation("can")[:, 1]
        half, tilted = (upright.turned(across, share * TILT, pivot=goal) for share in (0.5, 1))
        yield Motion(via=(tool.raised(ABOVE), upright, half), target=tilted, gripper=0.0, dwell=8)

    def clear(self, simulation: "Simulation") -> Iterator[Motion]:
        """Put the can back where it was."""
        upright, above, stand = self._way_back
        yield Motion(via=(upright, above), target=stand, gripper=1.0)
        yield Motion(via=(), target=stand.retracted(RETREAT), gripper=1.0)

    @classmethod
    def macro_steps(cls, variation: int) -> int:
        """Above, grasp, up, over the pot, half the tilt, the whole tilt."""
        return 6
