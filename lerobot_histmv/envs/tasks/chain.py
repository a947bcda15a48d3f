"""Several tasks in one scene, to be done one after the other under one instruction."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from lerobot_histmv.envs.tasks.base import Region, Task
from lerobot_histmv.motion import Motion

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation


@dataclass(frozen=True)
class Stage:
    """One task of a chain.

    Args:
        task: what is to be done.
        regions: where its objects stand in the chain's scene; those not named stand where the task puts them.
        variation: which of the task's variations.
    """

    task: type[Task]
    regions: Mapping[str, Region] = field(default_factory=dict)
    variation: int = 0


class Chain(Task):
    """A task made of tasks (paper, section 4.3).

    Subclasses name their ``stages``, whose objects must have different names, and write the instruction. A stage is
    done once its task was fulfilled at the end of a tick while its turn had come.
    """

    stages: ClassVar[tuple[Stage, ...]]
    variations: ClassVar[tuple[tuple[str, ...], ...]] = ((),)

    def __init_subclass__(cls) -> None:
        """Collect the stages' objects."""
        cls.objects = {name: kind for stage in cls.stages for name, kind in stage.task.objects.items()}
        cls.initial_gripper = cls.stages[0].task.initial_gripper
        if len(cls.objects) < sum(len(stage.task.objects) for stage in cls.stages):
            raise TypeError(f"two stages of {cls.__name__} have objects of the same name")

    def __init__(self) -> None:
        self._tasks = [stage.task() for stage in self.stages]
        for task, stage in zip(self._tasks, self.stages, strict=True):
            task.regions = {**task.regions, **stage.regions}

    def place(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """Every stage places its own objects."""
        for task, stage in zip(self._tasks, self.stages, strict=True):
            task.reset(simulation, stage.variation, rng)
        self._done, self._gripper = 0, self.initial_gripper

    def watch(self, simulation: "Simulation", gripper: float) -> None:
        """Let every stage watch; go on to the next when the current one is done."""
        self._gripper = gripper
        for task in self._tasks:
            task.watch(simulation, gripper)
        if self._done < len(self._tasks) and self._tasks[self._done].is_success(simulation):
            self._done += 1

    def is_success(self, simulation: "Simulation") -> bool:
        """All stages done."""
        return self._done == len(self._tasks)

    def details(self) -> dict[str, Any]:
        """``stages``: name of each stage -> whether it is done."""
        return {"stages": {task.name: index < self._done for index, task in enumerate(self._tasks)}}

    def failure(self) -> str:
        """Why the first stage that is not done failed."""
        return self._tasks[min(self._done, len(self._tasks) - 1)].failure()

    def expert(self, simulation: "Simulation") -> Iterator[Motion]:
        """The stages' experts; between them the gripper is cleared and set for the next."""
        for index, task in enumerate(self._tasks):
            if self._gripper != task.initial_gripper:
                yield Motion(via=(), target=simulation.tool_pose(), gripper=task.initial_gripper)
            yield from task.expert(simulation)
            if index + 1 < len(self._tasks):
                yield from task.clear(simulation)

    @classmethod
    def macro_steps(cls, variation: int) -> int:
        """Of all stages, of clearing after all but the last, and of setting the gripper."""
        tasks = [stage.task for stage in cls.stages]
        acting = sum(stage.task.macro_steps(stage.variation) for stage in cls.stages)
        clearing = sum(task.clear_steps for task in tasks[:-1])
        return acting + clearing + sum(task.initial_gripper == 0 for task in tasks[1:])
