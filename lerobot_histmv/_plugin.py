"""Registers HistMV with LeRobot: policy ``histmv``, environment ``ur5``, robot ``ur5_sim``, processors, fast reader.

LeRobot imports this (through the module ``lerobot_policy_histmv``) at the start of each of its commands; a failing
import is only logged there, so nothing here may be optional. Neither mujoco nor CLIP is imported.
"""

from lerobot_histmv import configuration_histmv, processor_histmv
from lerobot_histmv.data.hook import install_hook
from lerobot_histmv.envs import configuration_ur5, processor_ur5
from lerobot_histmv.robots import config_ur5_sim

__all__ = ["config_ur5_sim", "configuration_histmv", "configuration_ur5", "processor_histmv", "processor_ur5"]

install_hook()
