"""The gymnasium environment around a task, a simulation and its cameras."""

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces
from jaxtyping import Float, UInt8

from lerobot_histmv import geometry, keys
from lerobot_histmv.envs.motion import Motion, Pose, Tick
from lerobot_histmv.envs.tasks import TASKS

if TYPE_CHECKING:
    from lerobot_histmv.envs.stage import Stage

CAMERA_NAMES = ("front", "left_shoulder", "wrist")
CONTROLS = ("macro", "servo")
WORKSPACE_LOW = np.array([0.15, -0.45, 0.01])
WORKSPACE_HIGH = np.array([0.75, 0.45, 0.60])
"""Commanded positions [m] are clipped to this box."""
SERVO_TICKS = 40
"""With ``control="servo"`` each macro step of the time limit is worth this many ticks."""
STATE_SIZE = 14

Observation = dict[str, Any]


class UR5Env(gymnasium.Env[Observation, Float[np.ndarray, " 8"]]):
    """A UR5e with a Robotiq 2F-85 at a table."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 20}

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
    ) -> None:
        if task not in TASKS:
            raise ValueError(f"task {task!r} is unknown; tasks are {sorted(TASKS)}")
        unknown = [camera for camera in cameras if camera not in CAMERA_NAMES]
        if unknown or not cameras or len(set(cameras)) < len(cameras):
            raise ValueError(f"cameras {list(cameras)} must be different names out of {list(CAMERA_NAMES)}")
        for name, value, accepted in (
            ("control", control, CONTROLS),
            ("instruction_split", instruction_split, ("train", "held_out")),
            ("render_mode", render_mode, self.metadata["render_modes"]),
        ):
            if value not in accepted:
                raise ValueError(f"{name} is {value!r}; accepted are {list(accepted)}")
        for name, size in (("image_size", image_size), ("render_size", render_size)):
            if not 8 <= size <= 1024:
                raise ValueError(f"{name} is {size}; it must lie between 8 and 1024 pixels")
        self.task = task
        self.cameras = tuple(cameras)
        self.image_size, self.render_size = image_size, render_size
        self.control, self.render_mode = control, render_mode
        self.instruction_split = instruction_split
        self.record_substeps = False
        self._fixed_variation = None if variation is None else self._checked_variation(variation)
        self._stage: Stage | None = None
        self.task_description = TASKS[task].instructions(variation or 0, instruction_split)[0]
        self.action_space = spaces.Box(
            np.float32([*WORKSPACE_LOW, -1, -1, -1, -1, 0]), np.float32([*WORKSPACE_HIGH, 1, 1, 1, 1, 1])
        )
        self.observation_space = _observation_space(self.cameras, image_size)

    def _checked_variation(self, variation: int) -> int:
        count = len(TASKS[self.task].variations)
        if not 0 <= variation < count:
            raise ValueError(f"variation {variation} of {self.task} does not exist; there are 0 to {count - 1}")
        return variation

    @property
    def _max_episode_steps(self) -> int:
        """Most steps of any episode; LeRobot's evaluation reads it."""
        fixed = self._fixed_variation
        variations = range(len(TASKS[self.task].variations)) if fixed is None else [fixed]
        return max(self._step_limit(variation) for variation in variations)

    def _step_limit(self, variation: int) -> int:
        """Twice the expert's macro steps, or as much time in ticks."""
        limit = 2 * TASKS[self.task].macro_steps(variation)
        return limit if self.control == "macro" else limit * SERVO_TICKS

    @property
    def stage(self) -> "Stage":
        """Simulation, controller, task and cameras; built on first use."""
        if self._stage is None:
            from lerobot_histmv.envs.stage import Stage

            self._stage = Stage(self.task, max(self.image_size, self.render_size))
        return self._stage

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode. ``seed`` alone decides the scene; ``options={"variation": 2}`` fixes what is asked for."""
        super().reset(seed=seed)
        rng = np.random.default_rng(self.np_random.integers(2**63) if seed is None else seed)
        drawn = int(rng.integers(len(TASKS[self.task].variations)))
        asked = (options or {}).get("variation", self._fixed_variation)
        self.variation = drawn if asked is None else self._checked_variation(asked)
        phrase = rng.random()
        self.task_description = self.paraphrases[int(phrase * len(self.paraphrases))]
        self._frames: list[UInt8[np.ndarray, "h w 3"]] = []
        self._steps = 0
        self._out_of_reach = False
        self.stage.reset(self.variation, rng)
        self._capture()
        return self.observe(), self._info(ended=False)

    @property
    def paraphrases(self) -> tuple[str, ...]:
        """All instructions of the current variation, in the split that ``instruction_split`` names."""
        return TASKS[self.task].instructions(self.variation, self.instruction_split)

    def step(
        self, action: Float[np.ndarray, " 8"]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Go to ``action``; see the class for what that means and for what comes back."""
        pose, gripper = self._parse(action)
        self._frames = []
        with self.stage.watching(self._capture if self.record_substeps else None):
            reached = self.stage.go(pose, gripper, servo=self.control == "servo")
        self._out_of_reach |= not reached
        self._steps += 1
        success = self.is_success()
        truncated = not success and self._steps >= self._step_limit(self.variation)
        return self.observe(), float(success), success, truncated, self._info(ended=truncated)

    def _parse(self, action: Float[np.ndarray, " 8"]) -> tuple[Pose, float]:
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (8,):
            raise ValueError(f"action has shape {action.shape}; it must be (8,): {', '.join(keys.POSE_NAMES)}")
        if not np.isfinite(action).all():
            raise ValueError(f"action {action.tolist()} is not finite ({', '.join(keys.POSE_NAMES)})")
        norm = np.linalg.norm(action[3:7])
        if norm < 1e-6:
            raise ValueError(f"action's quaternion {action[3:7].tolist()} has no direction; it must be a rotation (wxyz)")
        position = np.clip(action[:3], WORKSPACE_LOW, WORKSPACE_HIGH)
        return Pose(position, geometry.canonical(action[3:7] / norm)), float(action[7] > 0.5)

    def is_success(self) -> bool:
        """Whether the task is fulfilled now."""
        return self.stage.task.is_success(self.stage.simulation)

    def _info(self, ended: bool) -> dict[str, Any]:
        success = self.is_success()
        failure = ""
        if ended and not success:
            failure = "ik" if self._out_of_reach else self.stage.task.failure()
        return {
            "is_success": success,
            "instruction": self.task_description,
            "variation": self.variation,
            "failure": failure,
            "ticks": self.stage.controller.ticks,
        }

    def observe(self) -> Observation:
        """The current observation, freshly rendered; see ``observation_space``."""
        stage, size = self.stage, self.image_size
        pixels, observation = {}, {}
        for camera in self.cameras:
            color, depth = stage.renderer.render(stage.simulation.data, camera, size)
            pixels[camera], observation[f"{camera}{keys.DEPTH_SUFFIX}"] = color, depth
        intrinsics = [stage.renderer.intrinsics(camera, size) for camera in self.cameras]
        extrinsics = [stage.renderer.extrinsics(stage.simulation.data, camera).ravel() for camera in self.cameras]
        return {
            "pixels": pixels,
            "agent_pos": stage.state(),
            "camera_intrinsics": np.concatenate(intrinsics).astype(np.float32),
            "camera_extrinsics": np.concatenate(extrinsics).astype(np.float32),
            **observation,
        }

    def expert(self) -> Iterator[Motion]:
        """Motions of the scripted expert; each is planned from the scene as it then is."""
        return self.stage.task.expert(self.stage.simulation)

    def execute(self, motion: Motion, on_tick: Callable[[Tick], None] | None = None) -> None:
        """Run one blended motion of an expert at 20 Hz.

        Args:
            motion: what to do.
            on_tick: called before each tick is simulated; it may call ``observe``.

        Raises:
            ValueError: the target is out of reach.
        """
        self.stage.controller.on_tick = on_tick
        try:
            if not self.stage.controller.execute(motion):
                raise ValueError(f"{motion.target} is out of the arm's reach")
        finally:
            self.stage.controller.on_tick = None

    def render(self) -> UInt8[np.ndarray, "h w 3"]:
        """The front camera's view, ``render_size`` pixels a side."""
        return self.stage.renderer.render(self.stage.simulation.data, "front", self.render_size)[0]

    def substep_frames(self) -> list[UInt8[np.ndarray, "h w 3"]]:
        """Front camera frames of every tick of the last step, or of the last reset; empty unless ``record_substeps``."""
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
        return {**self.__dict__, "_stage": None}


def _observation_space(cameras: Sequence[str], size: int) -> spaces.Dict:
    def floats(count: int) -> spaces.Box:
        return spaces.Box(-np.inf, np.inf, (count,), np.float32)

    pixels = spaces.Dict({camera: spaces.Box(0, 255, (size, size, 3), np.uint8) for camera in cameras})
    depths = {f"{camera}{keys.DEPTH_SUFFIX}": spaces.Box(0, 65535, (size, size, 1), np.uint16) for camera in cameras}
    calibration = {
        "camera_intrinsics": floats(len(keys.intrinsics_names(cameras))),
        "camera_extrinsics": floats(len(keys.extrinsics_names(cameras))),
    }
    return spaces.Dict({"pixels": pixels, "agent_pos": floats(STATE_SIZE), **depths, **calibration})
