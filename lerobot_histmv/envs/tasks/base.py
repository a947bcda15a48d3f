"""What a task is: objects, variations, success, failure, instructions and a scripted expert."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from jaxtyping import Float

from lerobot_histmv.motion import Motion

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

SPLITS = ("train", "held_out")
"""Instructions for recording and training, and paraphrases kept back for evaluation."""
RETREAT = 0.12
"""How far [m] the tool moves back before it turns to another task."""
WORKSPACE = np.array([[0.3, 0.6], [-0.28, 0.28]])
"""Range of x and of y [m] in which objects lie."""


@dataclass(frozen=True)
class Region:
    """Where something may stand: ranges of x and y [m] and of yaw [rad], in the base frame."""

    x: tuple[float, float]
    y: tuple[float, float]
    yaw: tuple[float, float] = (0.0, 0.0)

    def draw(self, rng: np.random.Generator) -> tuple[float, float, float]:
        """x, y, yaw."""
        x, y, yaw = rng.uniform(*np.array([self.x, self.y, self.yaw]).T).tolist()
        return x, y, yaw

    @property
    def area(self) -> Float[np.ndarray, "2 2"]:
        """Ranges of x and y."""
        return np.array([self.x, self.y])


class Task(ABC):
    """One task; an instance holds the state of one episode.

    A variation is what the instruction asks for: the words that fill the gaps of the templates.
    """

    name: ClassVar[str]
    objects: ClassVar[Mapping[str, str]]
    """Object name -> description in ``envs/objects``."""
    variations: ClassVar[tuple[tuple[str, ...], ...]]
    templates: ClassVar[Mapping[str, tuple[str, ...]]]
    """Split -> paraphrases, with a pair of braces for each word of the variation."""
    initial_gripper: ClassVar[float] = 1.0
    """Gripper command at the start: 1 open, 0 closed."""
    regions: Mapping[str, Region] = MappingProxyType({})
    """Where the objects that are not scattered stand; a chain puts them elsewhere."""
    clear_steps: ClassVar[int] = 2
    """Macro steps of ``clear``."""

    def reset(self, simulation: "Simulation", variation: int, rng: np.random.Generator) -> None:
        """Place all objects and forget the last episode; ``rng`` decides what the variation leaves open."""
        self.goal = self.variations[variation]
        self.grasps = Grasps()
        self.place(simulation, rng)

    @abstractmethod
    def place(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """Put the objects somewhere and reset the episode's own state."""

    def stand(self, simulation: "Simulation", name: str, rng: np.random.Generator) -> tuple[float, float, float]:
        """Put an object that stands fast somewhere in its region; x, y [m] and yaw [rad] of the place."""
        x, y, yaw = self.regions[name].draw(rng)
        simulation.place_fixed(name, (x, y, 0), yaw)
        return x, y, yaw

    @property
    def wanted(self) -> Collection[str]:
        """Objects or parts ("cabinet/handle0") to be grasped."""
        return ()

    @property
    def unwanted(self) -> Collection[str]:
        """Those that the gripper might grasp by mistake."""
        return ()

    def watch(self, simulation: "Simulation", gripper: float) -> None:
        """Called after each tick with the gripper command in force; notes what is grasped."""
        self.grasps.watch(simulation, gripper, [*self.wanted, *self.unwanted])

    @abstractmethod
    def is_success(self, simulation: "Simulation") -> bool:
        """Whether the task is fulfilled now."""

    def failure(self) -> str:
        """Why an episode that has run out of time failed: wrong object, grasp missed, not reached or time."""
        return self.grasps.failure(self.wanted)

    def details(self) -> dict[str, Any]:
        """What the environment's ``info`` says beyond success and failure."""
        return {}

    @abstractmethod
    def expert(self, simulation: "Simulation") -> Iterator[Motion]:
        """Motions that fulfil the task; object poses are read again before each motion."""

    def clear(self, simulation: "Simulation") -> Iterator[Motion]:
        """Motions after success that leave the gripper empty and out of the way, when another task follows."""
        tool = simulation.tool_pose()
        yield Motion(via=(), target=tool, gripper=1.0)
        yield Motion(via=(), target=tool.retracted(RETREAT), gripper=1.0)

    @classmethod
    @abstractmethod
    def macro_steps(cls, variation: int) -> int:
        """Macro steps of the expert, via points included."""

    @classmethod
    def instructions(cls, variation: int, split: str) -> tuple[str, ...]:
        """Paraphrases of a variation's instruction; ``split`` is ``train`` or ``held_out``."""
        return tuple(template.format(*cls.variations[variation]) for template in cls.templates[split])


class Grasps:
    """What the gripper has closed on since the episode began."""

    def __init__(self) -> None:
        self.closed = False
        self.held: set[str] = set()

    def watch(self, simulation: "Simulation", gripper: float, objects: Collection[str]) -> None:
        """Note which of ``objects`` (or parts, "cabinet/top") are between the finger pads."""
        if gripper < 0.5:
            self.closed = True
            self.held |= {name for name in objects if simulation.gripped(name)}

    def failure(self, wanted: Collection[str]) -> str:
        """Anything else held; something wanted held, but the task not finished; closed on nothing; never closed."""
        if self.held - set(wanted):
            return "wrong object"
        if self.held:
            return "time"
        return "grasp missed" if self.closed else "not reached"


def scatter(
    rng: np.random.Generator, count: int, apart: float, area: Float[np.ndarray, "2 2"] = WORKSPACE
) -> Float[np.ndarray, "count 2"]:
    """Uniform positions [m] in ``area`` (ranges of x and y), at least ``apart`` from one another."""
    while True:
        points = rng.uniform(area[:, 0], area[:, 1], (count, 2))
        distances = np.linalg.norm(points[:, None] - points[None], axis=-1)
        if distances[np.triu_indices(count, 1)].min(initial=np.inf) >= apart:
            return points


def nearest_turn(yaw: float, period: float) -> float:
    """The angle [rad] nearest to 0 that differs from ``yaw`` by whole periods: a symmetric object's easiest grasp."""
    return float((yaw + period / 2) % period - period / 2)
