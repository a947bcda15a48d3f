"""The gymnasium environment around a task, a simulation and its cameras."""

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from jaxtyping import Float, UInt8

from lerobot_histmv import keys
from lerobot_histmv.envs import interface
from lerobot_histmv.envs.disturbances import CLEAN, Disturbances
from lerobot_histmv.envs.interface import CAMERA_NAMES
from lerobot_histmv.envs.tasks import suites
from lerobot_histmv.motion import Motion, Tick

if TYPE_CHECKING:
    from lerobot_histmv.envs.stage import Stage

SERVO_TICKS = 40
"""With ``control="servo"`` each macro step of the time limit is worth this many ticks."""

Observation = dict[str, Any]


class UR5Env(gymnasium.Env[Observation, Float[np.ndarray, " 8"]]):
    """A UR5e with a Robotiq 2F-85 at a table, doing a task.

    Frame: the robot's base (ROS ``base_link``) = world, metres, z up, table top at z = 0. The tool is the pinch point
    between the finger pads; its z axis points back to the wrist, its y axis from finger to finger, so that a gripper
    pointing down has the quaternion (cos(yaw / 2), 0, 0, sin(yaw / 2)).

    **Action**, float32 (8,), absolute:

    | index | name | meaning | min | max | unit |
    |---|---|---|---|---|---|
    | 0 | ee.x.pos | tool target x | 0.15 | 0.75 | m |
    | 1 | ee.y.pos | tool target y | -0.45 | 0.45 | m |
    | 2 | ee.z.pos | tool target z | 0.01 | 0.60 | m |
    | 3 to 6 | ee.qw.pos, ee.qx.pos, ee.qy.pos, ee.qz.pos | tool target quaternion, normalised here | -1 | 1 | |
    | 7 | gripper.pos | gripper command: above 0.5 open, else closed | 0 | 1 | |

    With ``control="macro"`` a step is a macro step: the tool moves to the target in a straight line with the gripper as
    it is (where that crosses a singularity, in a straight line in joint space), then the gripper takes its command
    (0.5 s, if it changed), then the arm rests for 0.1 s. With ``control="servo"`` a step is one tick of 50 ms towards
    the target, no joint faster than 180 degrees per second. Positions outside the box are clipped to it. A pose that
    the arm cannot reach leaves the arm where it is; the gripper still takes its command. An arm that is blocked stops
    (protective stop) and the step ends. An action of another shape, with a number that is not finite or a quaternion
    of length 0 raises ValueError.

    **Observation**, for n = ``image_size`` and K ``cameras``:

    | key | type, shape | meaning |
    |---|---|---|
    | pixels/<camera> | uint8 (n, n, 3) | colour |
    | <camera>_depth | uint16 (n, n, 1) | distance along the optical axis [mm], 0 = none |
    | agent_pos | float32 (14,) | measured tool pose (7), gripper opening (1 open), joint angles [rad] (6) |
    | camera_intrinsics | float32 (4 K) | fx fy cx cy [pixels] of each camera |
    | camera_extrinsics | float32 (12 K) | rows of the 3x4 T_world_cam of each camera |

    Cameras: front and left_shoulder are fixed, wrist moves with the gripper.

    **Tasks.** The classes in ``lerobot_histmv.envs.tasks`` specify them: objects, scene, variations, success, failure
    and the expert's macro steps. Success is judged when a step ends; what must be remembered (a press, a grasp) is
    noted at every tick. Reward: 1 on success, else 0.
    **End**: ``terminated`` at success; ``truncated`` after twice the expert's macro steps (servo: 40 ticks for each).

    **Reset.** The tool is at (0.28, 0, 0.40), pointing down; the gripper is open, but closed where it is the
    pushing tool. The seed alone decides variation, instruction and scene; fixing the variation by argument or
    by ``options={"variation": i}`` leaves the objects' places as they are. Seeds below 100,000 are for recording, those
    up to 199,999 for evaluation during training, those from 200,000 for reported results.

    **Kept back** from recording and training: three paraphrases of every instruction
    (``instruction_split="held_out"``); orange, pink and white as colours of what is to be lifted (task
    ``pick_and_lift_unseen_colors``); cylinders, hexagonal prisms and bricks as its shapes
    (``pick_and_lift_unseen_shapes``).

    **Info**: ``is_success`` bool, ``instruction`` str, ``variation`` int, ``ticks`` (control periods so far), in
    chains ``stages`` (name -> whether it is done) and ``failure``: empty until an episode is truncated, then the first
    that holds of

    | failure | meaning |
    |---|---|
    | ik | an action of this episode was out of reach |
    | wrong object | another object was grasped, touched or pressed, or a named button out of turn |
    | grasp missed | the gripper closed, but never on the target |
    | not reached | nothing was grasped, touched or pressed |
    | time | the right thing was begun and not finished |

    Args:
        task: name of a task, or of one of its variations (``turn_tap.left``).
        cameras: which cameras to render, in which order.
        image_size: side of the images [pixels].
        control: ``macro`` or ``servo``.
        variation: the one variation to use, or None to draw it from the seed.
        instruction_split: paraphrases to draw from, ``train`` or ``held_out``.
        render_mode: ``rgb_array``.
        render_size: side of what ``render`` and ``substep_frames`` return [pixels]; they show the scene undisturbed.
        disturbances: what makes episodes harder than clean ones.
    """

    metadata = {"render_modes": list(interface.RENDER_MODES), "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        task: str,
        cameras: Sequence[str] = CAMERA_NAMES,
        image_size: int = 128,
        control: str = "macro",
        variation: int | None = None,
        instruction_split: str = "train",
        render_mode: str = "rgb_array",
        render_size: int = 256,
        disturbances: Disturbances = CLEAN,
    ) -> None:
        interface.check_options(
            task, cameras, image_size, control, variation, instruction_split, render_mode, render_size
        )
        self.task = task
        self.task_class = suites.find(task)[0]
        self.cameras = tuple(cameras)
        self.image_size, self.render_size = image_size, render_size
        self.control, self.render_mode = control, render_mode
        self.instruction_split = instruction_split
        if not isinstance(disturbances, Disturbances):
            raise ValueError(
                f"disturbances is {disturbances!r}; it must be a lerobot_histmv.envs.disturbances.Disturbances"
            )
        disturbances.check_cameras(self.cameras)
        self.disturbances = disturbances
        self.record_substeps = False
        self.action_space = interface.action_space()
        self.observation_space = interface.observation_space(self.cameras, image_size)
        self._fixed_variation = interface.fixed_variation(task, variation)
        self._stage: Stage | None = None
        self.variation = self._fixed_variation or 0
        self.task_description = self.paraphrases[0]

    @property
    def paraphrases(self) -> tuple[str, ...]:
        """All instructions of the current variation, in the split that ``instruction_split`` names."""
        return self.task_class.instructions(self.variation, self.instruction_split)

    @property
    def variations(self) -> Sequence[int]:
        """Variations of which an episode's seed draws one."""
        return range(len(self.task_class.variations)) if self._fixed_variation is None else (self._fixed_variation,)

    @property
    def _max_episode_steps(self) -> int:
        """Most steps of any episode; LeRobot's evaluation reads it."""
        return max(self._step_limit(variation) for variation in self.variations)

    def _step_limit(self, variation: int) -> int:
        limit = 2 * self.task_class.macro_steps(variation)
        return limit if self.control == "macro" else limit * SERVO_TICKS

    @property
    def stage(self) -> "Stage":
        """Simulation, controller, task and cameras; they exist from the first reset on."""
        if self._stage is None:
            raise gymnasium.error.ResetNeeded("reset the environment first")
        return self._stage

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: decides the episode; None draws one from the environment's own generator.
            options: ``{"variation": i}`` fixes the variation of this episode.
        """
        super().reset(seed=seed)
        rng = np.random.default_rng(self.np_random.integers(2**63) if seed is None else seed)
        drawn = int(rng.integers(len(self.task_class.variations)))
        asked = (options or {}).get("variation", self._fixed_variation)
        fixed = interface.fixed_variation(self.task, asked)
        self.variation = drawn if fixed is None else fixed
        self.task_description = self.paraphrases[int(rng.random() * len(self.paraphrases))]
        if self._stage is None:
            from lerobot_histmv.envs.stage import Stage

            self._stage = Stage(self.task_class, max(self.image_size, self.render_size), self.disturbances)
        self._steps, self._out_of_reach = 0, False
        self._frames: list[UInt8[np.ndarray, "h w 3"]] = []
        self.stage.reset(self.variation, rng, self.cameras)
        self._capture()
        return self.observe(), self._info(ended=False)

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Go to ``action``; the class says what that means and what comes back."""
        pose, gripper = interface.parse_action(action)
        stage = self.stage
        self._frames = []
        with stage.watching(self._capture):
            reached = stage.go(Motion(via=(), target=pose, gripper=gripper), servo=self.control == "servo")
        self._out_of_reach |= not reached
        self._steps += 1
        success = self.is_success()
        truncated = not success and self._steps >= self._step_limit(self.variation)
        return self.observe(), float(success), success, truncated, self._info(ended=truncated)

    def is_success(self) -> bool:
        """Whether the task is fulfilled now."""
        return self.stage.task.is_success(self.stage.simulation)

    def failure(self) -> str:
        """Why the task is not fulfilled yet: one of the failure kinds."""
        return "ik" if self._out_of_reach else self.stage.task.failure()

    def _info(self, ended: bool) -> dict[str, Any]:
        return {
            "is_success": self.is_success(),
            "instruction": self.task_description,
            "variation": self.variation,
            "failure": self.failure() if ended else "",
            "ticks": self.stage.controller.ticks,
            **self.stage.task.details(),
        }

    def observe(self) -> Observation:
        """The current observation, freshly rendered."""
        views = {camera: self.stage.look(camera, self.image_size) for camera in self.cameras}
        return {
            "pixels": {camera: view.image for camera, view in views.items()},
            "agent_pos": self.stage.state(),
            **{f"{camera}{keys.DEPTH_SUFFIX}": view.depth for camera, view in views.items()},
            "camera_intrinsics": np.concatenate([view.intrinsics for view in views.values()]).astype(np.float32),
            "camera_extrinsics": np.concatenate([view.extrinsics.ravel() for view in views.values()], dtype=np.float32),
        }

    def expert(self) -> Iterator[Motion]:
        """Motions of the scripted expert; each is planned from the scene as it then is."""
        return self.stage.task.expert(self.stage.simulation)

    def execute(self, motion: Motion, on_tick: Callable[[Tick], None] | None = None) -> None:
        """Run one blended motion at 20 Hz, whatever ``control`` is. It does not count as a step.

        Args:
            motion: what to do.
            on_tick: called before each tick is simulated; it may call ``observe``.

        Raises:
            ValueError: the target is out of reach.
        """
        controller = self.stage.controller
        controller.on_tick = on_tick
        try:
            if not self.stage.go(motion):
                raise ValueError(f"{motion.target} is out of the arm's reach")
        finally:
            controller.on_tick = None

    def render(self) -> UInt8[np.ndarray, "h w 3"]:
        """The front camera's view, ``render_size`` pixels a side."""
        return self.stage.renderer.render(self.stage.simulation.data, "front", self.render_size)[0]

    def substep_frames(self) -> list[UInt8[np.ndarray, "h w 3"]]:
        """What ``render`` showed after each tick of the last step or after reset; empty unless ``record_substeps``."""
        return list(self._frames)

    def _capture(self) -> None:
        if self.record_substeps:
            self._frames.append(self.render())

    def close(self) -> None:
        """Free the graphics context."""
        if self._stage is not None:
            self._stage.close()
            self._stage = None

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the simulation: an unpickled environment wants a reset."""
        return {**self.__dict__, "_stage": None}
