"""UR5e manipulation tasks in MuJoCo, as gymnasium environments.

Importing this package registers ``ur5/<task>-v0`` for every name in ``TASKS``; mujoco itself is imported when the first
environment is reset. Without a display and with ``MUJOCO_GL`` unset, rendering goes through EGL.
"""

import os
from typing import Any

import gymnasium

from lerobot_histmv.envs.tasks import TASKS
from lerobot_histmv.envs.ur5 import UR5Env

__all__ = ["TASKS", "UR5Env", "make"]

if "MUJOCO_GL" not in os.environ and not os.environ.get("DISPLAY"):
    os.environ["MUJOCO_GL"] = "egl"

for _name in TASKS:
    _id = f"ur5/{_name}-v0"
    if _id not in gymnasium.registry:
        gymnasium.register(_id, entry_point="lerobot_histmv.envs.ur5:UR5Env", kwargs={"task": _name})


def make(task: str, **kwargs: Any) -> UR5Env:
    """``UR5Env(task, **kwargs)``, without gymnasium's wrappers."""
    return UR5Env(task, **kwargs)
