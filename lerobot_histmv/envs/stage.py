"""What is built when an environment is first used: simulation, controller, task and cameras, wired together."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from jaxtyping import Float

from lerobot_histmv.envs.camera import Renderer, samples_for
from lerobot_histmv.envs.controller import Controller
from lerobot_histmv.envs.motion import Motion, Pose
from lerobot_histmv.envs.simulation import Simulation
from lerobot_histmv.envs.tasks.base import Task

SETTLE_TICKS = 10
"""Ticks before an episode starts: objects come to rest and the gripper takes its initial command."""


class Stage:
    """Everything behind an environment that cannot be pickled.

    Args:
        task: what is to be done in it.
        image_size: largest image side [pixels] that will be rendered.
    """

    def __init__(self, task: type[Task], image_size: int) -> None:
        self.task = task()
        self.simulation = Simulation(self.task.objects, samples_for(image_size))
        self.controller = Controller(self.simulation)
        self.renderer = Renderer(self.simulation.model)
        self.simulation.after_tick.append(lambda: self.task.watch(self.simulation, self.controller.gripper))

    def reset(self, variation: int, rng: np.random.Generator) -> None:
        """A new scene, at rest."""
        self.simulation.reset()
        self.task.reset(self.simulation, variation, rng)
        self.simulation.refresh()
        self.controller.reset(self.task.initial_gripper)
        self.controller.hold(SETTLE_TICKS)
        self.controller.ticks = 0

    @contextmanager
    def watching(self, callback: Callable[[], None]) -> Iterator[None]:
        """Call ``callback`` after every tick inside the block."""
        self.simulation.after_tick.append(callback)
        try:
            yield
        finally:
            self.simulation.after_tick.remove(callback)

    def go(self, pose: Pose, gripper: float, servo: bool) -> bool:
        """One step of the environment: a whole macro step, or one tick towards ``pose``. False if out of reach."""
        if servo:
            return self.controller.servo(pose, gripper)
        return self.controller.execute(Motion(via=(), target=pose, gripper=gripper))

    def state(self) -> Float[np.ndarray, " 14"]:
        """Measured tool pose (7), gripper opening (1 open), joint angles [rad] (6); float32."""
        pose = self.simulation.tool_pose()
        parts = (pose.position, pose.quaternion, [self.simulation.gripper_opening()], self.simulation.joints())
        return np.concatenate(parts).astype(np.float32)

    def close(self) -> None:
        """Free the graphics context."""
        self.renderer.close()
