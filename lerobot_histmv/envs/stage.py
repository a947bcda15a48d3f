"""What is built when an environment is first used: simulation, controller, task and cameras, wired together."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from lerobot_histmv.envs.camera import Renderer, samples_for
from lerobot_histmv.envs.controller import Controller
from lerobot_histmv.envs.disturbances import CLEAN, Disturbances
from lerobot_histmv.envs.disturber import Disturber
from lerobot_histmv.envs.simulation import Simulation
from lerobot_histmv.envs.tasks.base import Task
from lerobot_histmv.motion import Motion

SETTLE_TICKS = 10
"""Ticks before an episode starts: objects come to rest and the gripper takes its initial command."""


@dataclass(frozen=True, eq=False)
class View:
    """What a camera gives.

    Args:
        image: colour.
        depth: distance along the optical axis [mm], 0 invalid.
        intrinsics: fx, fy, cx, cy [pixels].
        extrinsics: ``T_world_cam`` (OpenCV axes).
    """

    image: UInt8[np.ndarray, "h w 3"]
    depth: UInt16[np.ndarray, "h w 1"]
    intrinsics: Float[np.ndarray, " 4"]
    extrinsics: Float[np.ndarray, "3 4"]


class Stage:
    """Everything behind an environment that cannot be pickled.

    Args:
        task: what is to be done in it.
        disturbances: what makes it harder.
        image_size: largest image side [pixels] that will be rendered.
    """

    def __init__(self, task: type[Task], image_size: int, disturbances: Disturbances) -> None:
        self.task = task()
        self.simulation = Simulation({**self.task.objects, **disturbances.objects}, samples_for(image_size))
        self.controller = Controller(self.simulation)
        self.renderer = Renderer(self.simulation.model)
        loose = self.simulation.loose(self.task.objects)
        self.disturber = None if disturbances == CLEAN else Disturber(disturbances, self.simulation, loose)
        self.simulation.after_tick.append(lambda: self.task.watch(self.simulation, self.controller.gripper))

    def reset(self, variation: int, rng: np.random.Generator, cameras: tuple[str, ...]) -> None:
        """A new scene, at rest; ``cameras`` are those that will look at it."""
        self.simulation.reset()
        self.task.reset(self.simulation, variation, rng)
        if self.disturber is not None:
            self.disturber.reset(rng.spawn(1)[0], cameras, named=self.task.goal)
            self.controller.gripper_delay = self.disturber.gripper_delay
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

    def go(self, motion: Motion, servo: bool = False) -> bool:
        """Run a whole motion, or one tick towards its target. False (the arm stays) if that is out of reach."""
        act = self._servo if servo else self.controller.execute
        if self.disturber is None:
            return act(motion)
        reached = act(self.disturber.act(motion))
        self.disturber.after_motion(self.controller.ticks)
        self.simulation.refresh()
        return reached

    def _servo(self, motion: Motion) -> bool:
        return self.controller.servo(motion.target, motion.gripper)

    def look(self, camera: str, size: int) -> View:
        """A camera's picture and calibration."""
        image, depth = self.renderer.render(self.simulation.data, camera, size)
        view = View(
            image,
            depth,
            self.renderer.intrinsics(camera, size),
            self.renderer.extrinsics(self.simulation.data, camera),
        )
        if self.disturber is None:
            return view
        return View(
            *self.disturber.see(camera, view.image, view.depth),
            self.disturber.intrinsics(camera, view.intrinsics),
            self.disturber.extrinsics(camera, view.extrinsics),
        )

    def state(self) -> Float[np.ndarray, " 14"]:
        """Measured tool pose (7), gripper opening (1 open), joint angles [rad] (6); float32."""
        pose = self.simulation.tool_pose()
        parts = (pose.position, pose.quaternion, [self.simulation.gripper_opening()], self.simulation.joints())
        return np.concatenate(parts).astype(np.float32)

    def close(self) -> None:
        """Free the graphics context."""
        self.renderer.close()
