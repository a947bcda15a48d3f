"""The simulated UR5e behind LeRobot's ``Robot`` interface; also a pattern for a class around a real arm."""

import logging
import signal
from typing import Any

import numpy as np
from lerobot.robots import Robot

from lerobot_histmv import keys
from lerobot_histmv.envs import UR5Env, make
from lerobot_histmv.motion import TICK
from lerobot_histmv.robots.config_ur5_sim import UR5SimConfig

logger = logging.getLogger(__name__)


class UR5Sim(Robot):
    """One scene of a task, controlled at 20 Hz.

    The scene's time stands still between two calls of ``send_action``, each of which lasts one tick of 50 ms: the pace
    of the loop around it changes nothing.

    Observation: measured tool pose, gripper opening and joint angles (``keys.POSE_NAMES``, ``keys.JOINT_NAMES``), the
    cameras' calibration (``keys.calibration_state_names``), per camera a colour image ``<camera>`` uint8 (h, w, 3) and
    ``<camera>_depth`` uint16 (h, w, 1) [mm], 0 invalid. Action: tool pose and gripper command (``keys.POSE_NAMES``).

    Args:
        config: which scene.
    """

    config_class = UR5SimConfig
    name = "ur5_sim"

    def __init__(self, config: UR5SimConfig) -> None:
        super().__init__(config)
        self.config = config
        self._env: UR5Env | None = None
        self._ended = False

    @property
    def observation_features(self) -> dict[str, Any]:
        """Names and shapes of what ``get_observation`` gives; numbers in the order of the state vector."""
        size, cameras = self.config.image_size, self.config.camera_names
        numbers = (*keys.POSE_NAMES, *keys.JOINT_NAMES, *keys.calibration_state_names(cameras))
        images = dict.fromkeys(cameras, (size, size, 3))
        return {
            **dict.fromkeys(numbers, float),
            **images,
            **{f"{c}{keys.DEPTH_SUFFIX}": (size, size, 1) for c in cameras},
        }

    @property
    def action_features(self) -> dict[str, Any]:
        """Names of what ``send_action`` takes."""
        return dict.fromkeys(keys.POSE_NAMES, float)

    @property
    def is_connected(self) -> bool:
        """Whether there is a scene."""
        return self._env is not None

    @property
    def is_calibrated(self) -> bool:
        """The simulated cameras know where they are."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Build the scene that the seed decides, and log its instruction."""
        config = self.config
        self._env = make(
            config.task,
            cameras=config.camera_names,
            image_size=config.image_size,
            control="servo",
            variation=config.variation,
            instruction_split=config.instruction_split,
        )
        self._seen, _ = self._env.reset(seed=config.seed)
        self._ended = False
        logger.info("%s, scene %d: %r", config.task, config.seed, self._env.task_description)

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do."""

    @property
    def scene(self) -> UR5Env:
        """The environment behind the robot.

        Raises:
            ConnectionError: the robot is not connected.
        """
        if self._env is None:
            raise ConnectionError("ur5_sim is not connected: call connect() first")
        return self._env

    def get_observation(self) -> dict[str, Any]:
        """What was measured and seen at the end of the last tick."""
        cameras, seen = self.scene.cameras, self._seen
        vectors = (seen["agent_pos"], seen["camera_intrinsics"], seen["camera_extrinsics"])
        names = (*keys.POSE_NAMES, *keys.JOINT_NAMES, *keys.calibration_state_names(cameras))
        depths = {f"{camera}{keys.DEPTH_SUFFIX}": seen[f"{camera}{keys.DEPTH_SUFFIX}"] for camera in cameras}
        return {**dict(zip(names, np.concatenate(vectors).tolist(), strict=True)), **seen["pixels"], **depths}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Simulate one tick towards the tool pose in ``action``; other names in it are ignored.

        Raises:
            ValueError: a component is missing or not finite, or the quaternion has length 0.
        """
        missing = [name for name in keys.POSE_NAMES if name not in action]
        if missing:
            raise ValueError(f"the action lacks {missing}; ur5_sim takes {list(keys.POSE_NAMES)}")
        command = np.array([action[name] for name in keys.POSE_NAMES])
        self._seen, _, success, out_of_time, info = self.scene.step(command)
        if not self._ended and (success or out_of_time):
            self._ended = True
            outcome = "success" if success else f"failed ({info['failure']})"
            logger.info(
                "%s, scene %d: %s after %.2f s", self.config.task, self.config.seed, outcome, TICK * info["ticks"]
            )
            if self.config.stop_when_done:
                signal.raise_signal(signal.SIGINT)
        return {name: action[name] for name in keys.POSE_NAMES}

    def disconnect(self) -> None:
        """Free the scene."""
        self.scene.close()
        self._env = None
