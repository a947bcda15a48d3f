"""Small UR5 environments for tests, and ways to act in them."""

from collections.abc import Iterator

import numpy as np

from lerobot_histmv.envs import UR5Env, make

SIZE = 17
AWAY = np.array([0.3, -0.4, 0.3, 1, 0, 0, 0, 1], np.float32)
"""An action that reaches nothing."""
OUT_OF_REACH = np.array([0.75, 0.45, 0.6, 1, 0, 1, 0, 1], np.float32)
"""A corner of the box, with the gripper pointing back at the robot."""


def tiny(task: str, **options: object) -> UR5Env:
    return make(task, image_size=SIZE, render_size=SIZE, **options)


def expert_actions(env: UR5Env) -> Iterator[np.ndarray]:
    """The expert's motions as straight macro steps."""
    for motion in env.expert():
        yield from motion.actions(env.stage.controller.gripper)


def act_until_the_end(env: UR5Env, actions: list[np.ndarray]) -> str:
    for action in actions:
        env.step(action)
    truncated = False
    while not truncated:
        _, _, terminated, truncated, info = env.step(AWAY)
        assert not terminated
    return str(info["failure"])


def above(position: np.ndarray, height: float, gripper: float) -> np.ndarray:
    return np.array([*position[:2], height, 1, 0, 0, 0, gripper], np.float32)
